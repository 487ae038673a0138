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
      more: words that go on with what is there.
      result: of what it has ended with, what has to be the same however often it was gone on with; None if it starts anew.
    """

    words: Sequence[str]
    more: Sequence[str] = ()
    result: Callable[[Path], Any] | None = None


def _rows(out: Path) -> list[dict[str, Any]]:
    rows = known_rows(out / "strokes.jsonl", {"goal"})
    return [{name: value for name, value in row.items() if name != "seconds"} for row in rows]


def _trained(out: Path) -> list[Any]:
    rows = known_rows(out / "metrics.jsonl", {"kind"})
    losses = [{name: value for name, value in row.items() if "second" not in name} for row in rows]
    with np.load(out / "last.npz") as parts:
        return [losses, {name: parts[name].tobytes() for name in parts if "second" not in name}]


JOBS = {
    "plan": Job(["-m", "jaxsand", "plan", "S", "--out", "out"]),
    "shape": Job(["-m", "jaxsand", "shape", "L", "--out", "out"]),
    "strokes": Job(
        ["-m", "jaxsand", "bench", "strokes", "--methods", "random", "--calls", "250", "--out", "out"], result=_rows
    ),
    "train": Job(["-m", "train", "dqn", "--steps", "60", "--out", "out"], ["--resume"], _trained),
}


def whole(path: Path) -> None:
    """Reads a file. BrokenError if it is not a whole one."""
    from PIL import Image

    try:
        if path.suffix == ".json":
            json.loads(path.read_text(encoding="utf-8"))
        elif path.suffix == ".npz":
            with path.open("rb") as file, np.load(file) as parts:
                dict(parts)
        elif path.suffix in {".png", ".gif"}:
            with Image.open(path) as image:
                image.load()
    except (OSError, ValueError, SyntaxError, zipfile.BadZipFile) as error:
        raise BrokenError(f"{path.name} is not whole: {error}") from error


def killed_often(job: Job, kills: int, folder: Path, seed: int = 0) -> str:
    """Kills a command so often in an empty folder; says what was seen. BrokenError if it broke something."""
    chance, out = random.Random(seed), folder / "out"

    def end() -> Any:
        """What the command has ended with, which is taken away if one could go on with it."""
        result = job.result(out) if job.result else None
        if job.result:
            shutil.rmtree(out)
        return result

    _runs(job, folder)  # what it compiles may be kept
    files, undisturbed = {path.name for path in out.iterdir()}, end()
    began = time.monotonic()
    _runs(job, folder)
    longest, killed, ended = time.monotonic() - began, 0, 0
    while killed < kills or (job.result and not ended):
        done = _runs(job, folder, longest * chance.random() if killed < kills else None)
        killed, ended = killed + (not done), ended + done
        there = files & {path.name for path in out.iterdir()} if out.exists() else set[str]()
        for name in there:
            whole(out / name)
        if not job.result and there < files:
            raise BrokenError(f"gone: {', '.join(files - there)}")
        if done and end() != undisturbed:
            raise BrokenError("gone on with, it ended otherwise than undisturbed")
    return f"{killed} kills, each within {longest:.0f} s of a start; ended {ended} times"


def _runs(job: Job, folder: Path, seconds: float | None = None) -> bool:
    """Whether the command ended within so many seconds; it is killed if not."""
    environment = os.environ | {
        "PYTHONPATH": str(ROOT),
        "XDG_CACHE_HOME": str(folder / "cache"),
        "MPLCONFIGDIR": str(folder / "cache"),
        "JAX_COMPILATION_CACHE_DIR": str(folder / "cache"),
    }
    goes_on = job.more if (folder / "out" / "config.json").exists() else ()
    words = [sys.executable, *job.words, *goes_on]
    pipes = {"stdout": subprocess.DEVNULL, "stderr": subprocess.PIPE}
    with subprocess.Popen(words, cwd=folder, env=environment, **pipes) as process:
        try:
            _, said = process.communicate(timeout=seconds)
        except subprocess.TimeoutExpired:
            process.kill()
            return False
    if process.returncode:
        raise BrokenError(f"ended with {process.returncode}: {said.decode()[-500:]}")
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
