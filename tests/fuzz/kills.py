"""Kills commands at random moments, and judges what they leave.

    python -m tests.fuzz.kills [NAME ...] [--kills N] [--seed K] [--list]

Moments are uniform over the time that the command takes undisturbed. Whenever it is killed, every file of it is a whole one.
A command that keeps what it has done is gone on with, again and again, and has to end as it ends undisturbed. Exits with 1 if
something is broken.
"""

import argparse
import json
import os
import random
import shutil
import subprocess
import sys
import tempfile
import time
import zipfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from jaxsand.bench.kept import known_rows

from .judge import BrokenError

ROOT = Path(__file__).parents[2]


@dataclass(frozen=True)
class Job:
    """A command that writes to the folder `out`.

    Attributes:
      words: what Python is called with.
      more: words that go on with what is there, once `out` has a configuration.
      result: of what it has ended with, what has to be the same however often it was gone on with; None if it starts anew.
    """

    words: Sequence[str]
    more: Sequence[str] = ()
    result: Callable[[Path], Any] | None = None


def _rows(out: Path) -> list[dict[str, Any]]:
    rows = known_rows(out / "strokes.jsonl", {"goal"})
    if not rows:
        raise BrokenError("strokes.jsonl has no rows")
    return [{name: value for name, value in row.items() if name != "seconds"} for row in rows]


def _trained(out: Path) -> list[Any]:
    timed = {"seconds", "chunks_per_second"}
    rows = known_rows(out / "metrics.jsonl", {"kind", "chunk"})
    with np.load(out / "last.npz") as parts:
        about = json.loads(str(parts["about"]))
        state = {name: parts[name].tobytes() for name in parts if name != "about"}
    return [[{k: v for k, v in row.items() if k not in timed} for row in rows], about["chunk"], about["score"], state]


JOBS = {
    "plan": Job(["-m", "jaxsand", "plan", "S", "--out", "out"]),
    "shape": Job(["-m", "jaxsand", "shape", "L", "--out", "out"]),
    "strokes": Job(
        ["-m", "jaxsand", "bench", "strokes", "--methods", "random shooting", "--calls", "40", "--out", "out"], result=_rows
    ),
    "train": Job(["-m", "train", "dqn", "--steps", "8", "--out", "out"], ["--resume"], _trained),
}
LIMIT = 900.0
"""Seconds after which a command that nobody kills hangs."""


def whole(path: Path) -> None:
    """Reads a file, but for rows, of which a kill may cut off the last. BrokenError if it is not a whole one."""
    from PIL import Image, ImageSequence

    try:
        if path.suffix == ".json":
            json.loads(path.read_text(encoding="utf-8"))
        elif path.suffix == ".npz":
            with path.open("rb") as file, np.load(file) as parts:
                dict(parts)
        elif path.suffix in {".png", ".gif"}:
            with Image.open(path) as image:
                for frame in ImageSequence.Iterator(image):
                    frame.load()
            if path.suffix == ".gif" and not path.read_bytes().endswith(b";"):
                raise ValueError("it has no end")
        elif path.suffix != ".jsonl":
            raise BrokenError(f"{path.name}: no one knows how to read it")
    except (OSError, EOFError, ValueError, SyntaxError, zipfile.BadZipFile) as error:
        raise BrokenError(f"{path.name} is not whole: {error}") from error


def killed_often(job: Job, kills: int, folder: Path, seed: int = 0) -> str:
    """Kills a command so often in an empty folder; says what was seen. BrokenError if it broke something."""
    chance, out = random.Random(seed), folder / "out"
    ended_in_time(job, folder, LIMIT)  # what it compiles may be kept
    files = {path.name for path in out.iterdir()}
    undisturbed = _taken(job, out)
    began = time.monotonic()
    ended_in_time(job, folder, LIMIT)
    longest, killed, ended = time.monotonic() - began, 0, 0
    if _taken(job, out) != undisturbed:
        raise BrokenError("undisturbed, it ends otherwise each time")
    while killed < kills:
        done = ended_in_time(job, folder, longest * chance.random())
        killed, ended = killed + (not done), ended + done
        there = files & {path.name for path in out.iterdir()} if out.exists() else set[str]()
        for name in there:
            whole(out / name)
        if not job.result and there < files:
            raise BrokenError(f"gone: {', '.join(files - there)}")
        if done and _taken(job, out) != undisturbed:
            raise BrokenError("gone on with, it ends otherwise than undisturbed")
    ended_in_time(job, folder, LIMIT)
    if _taken(job, out) != undisturbed:
        raise BrokenError("gone on with, it ends otherwise than undisturbed")
    return f"{killed} kills, each within {longest:.0f} s of a start; ended {ended + 1} times"


def _taken(job: Job, out: Path) -> Any:
    """What a command has ended with, which is taken away lest it be gone on with; None if it starts anew."""
    if not job.result:
        return None
    result = job.result(out)
    shutil.rmtree(out)
    return result


def child(words: Sequence[str], folder: Path) -> "subprocess.Popen[str]":
    """Starts Python in a folder, which has its caches too."""
    environment = os.environ | {
        "PYTHONPATH": str(ROOT),
        "XDG_CACHE_HOME": str(folder / "cache"),
        "MPLCONFIGDIR": str(folder / "cache"),
        "JAX_COMPILATION_CACHE_DIR": str(folder / "cache"),
    }
    return subprocess.Popen(
        [sys.executable, *words], cwd=folder, env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True
    )


def ended_in_time(job: Job, folder: Path, seconds: float) -> bool:
    """Runs a command in a folder, for so many seconds at most: whether it has ended; else it is killed.

    Raises:
      BrokenError: if it failed, or hangs.
    """
    with child([*job.words, *(job.more if (folder / "out" / "config.json").exists() else ())], folder) as process:
        try:
            _, said = process.communicate(timeout=seconds)
        except subprocess.TimeoutExpired:
            if seconds == LIMIT:
                raise BrokenError(f"not done after {seconds:g} s") from None
            return False
        finally:
            process.kill()
    if process.returncode:
        raise BrokenError(f"ended with {process.returncode}: {said[-500:]}")
    return True


def main() -> int:
    """Runs the command."""
    parser = argparse.ArgumentParser(prog="python -m tests.fuzz.kills", description=__doc__.splitlines()[0])
    parser.add_argument("names", nargs="*", metavar="NAME", help="commands; by default all")
    parser.add_argument("--kills", type=int, default=25, metavar="N", help="of each command (25)")
    parser.add_argument("--seed", type=int, default=0, metavar="K")
    parser.add_argument("--list", action="store_true", help="list the commands")
    options = parser.parse_args()
    if unknown := [name for name in options.names if name not in JOBS]:
        parser.error(f"no such command: {', '.join(unknown)}; --list shows all")
    if options.list:
        print(*(f"{name}: {' '.join(job.words[1:])}" for name, job in JOBS.items()), sep="\n")
        return 0
    broken = 0
    for name in options.names or JOBS:
        with tempfile.TemporaryDirectory() as folder:
            try:
                print(f"{name}: {killed_often(JOBS[name], options.kills, Path(folder), options.seed)}", flush=True)
            except BrokenError as error:
                broken += 1
                print(f"{name}: BROKEN: {error}", flush=True)
    return int(broken > 0)


if __name__ == "__main__":
    sys.exit(main())
