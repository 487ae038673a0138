"""Command lines of random options, values and spoilt files, run in this process."""

import argparse
import io
import json
import re
import warnings
from collections.abc import Callable
from contextlib import ExitStack, redirect_stderr, redirect_stdout
from pathlib import Path
from unittest.mock import patch

import numpy as np

from .files import DRAWING, FILES, GLYPHS, MAP, METRICS, config, state
from .spoil import TEXTS, Rng, pick

LINE = re.compile(r"error: \S[^:]*: \S.*; \S.*\n")
ODD = (
    *TEXTS,
    " ",
    "-",
    "é",
    "\udc80",
    "../../x",
    "/",
    ".",
    "x" * 300,
    "x" * 300 + ".npy",
    "x" * 300 + ".json",
    "x" * 300 + ".txt",
    "a\nb",
    "#.S",
    "'",
    "0,0",
    "-1,5",
    "1,1,1",
    "a" * 5000,
)
VALUES = {
    "start": ("0,0", "1,1", "best"),
    "end": ("2,2",),
    "engine": ("auto", "paper", "astar", "exact", "anytime", "frontier"),
    "method": ("plan", "search", "optimise", "policy", "strokes"),
    "scheme": ("relaxation", "pairwise", "super-time-stepping", "multilevel"),
    "neighbours": ("4", "8", "isotropic"),
    "surface": ("level", "terrain", "flat.npy"),
    "first-row": ("bottom", "top"),
    "rule": ("own", "split"),
    "goals": ("letters", "eight", "pit"),
    "methods": ("search", "nothing"),
    "what": ("settle", "strokes", "tasks", "tools", "plan"),
    "free": ("flat.npy", "white.png"),
    "measured": ("x.csv", "good.csv"),
    "glyphs": ("x.json", "good.json"),
    "out": ("out", "a-file", "a-file/x", "deep/er/out"),
    "out-file": ("out.npy", "a-file/x.npy", "out/x.npy", "out.txt", "x.npy"),
    "weight": ("1", "2.5"),
    "seconds": ("0.1",),
    "spacing-mm": ("2",),
    "repose-deg": ("29",),
    "bound": ("10",),
    "relief-mm": ("10",),
}
GOALS = (
    "S",
    "L",
    "good.txt",
    "x.txt",
    "flat.npy",
    "x.npy",
    "white.png",
    "x.png",
    "good.json",
    "x.json",
    "terrain",
    "no.npy",
)
MAPS = ("S", "good.txt", "x.txt", "no.txt")


class CrashError(Exception):
    """A command did what it must not do."""


def case(program: str, heavy: bool, rng: Rng, folder: Path) -> Callable[[], object]:
    """A command line, in a folder of files; unless it is heavy, the command stops where its long work would begin."""
    write(rng, folder)
    main, parser = programs()[program]
    commands = next(a for a in parser._actions if isinstance(a, argparse._SubParsersAction)).choices
    name = pick(rng, HEAVY[program] if heavy else sorted(commands))
    words = [name, *arguments(rng, commands[name])]
    if rng.random() < 0.03:
        words[int(rng.integers(len(words)))] = pick(rng, ODD)
    words += ["--json"] * bool(rng.random() < 0.3)
    return lambda: run(main, words, folder, () if heavy else STUBS)


def arguments(rng: Rng, parser: argparse.ArgumentParser) -> list[str]:
    """Values for what a command needs, and for some of its options."""
    words = []
    for action in parser._actions:
        name = action.dest.replace("_", "-")
        if name in ("help", "json"):
            continue
        if not action.option_strings:
            words.append(value(rng, {"input": "settle-in", "goal": "shape-goal"}.get(name, name)))
        elif action.required or rng.random() < 0.2:
            words.append(action.option_strings[0])
            if action.nargs != 0:
                words.append(value(rng, name))
    return words


def value(rng: Rng, name: str) -> str:
    """A value for an argument: mostly a good one."""
    good = {"settle-in": ("flat.npy", "x.npy", "pile.npy"), "shape-goal": GOALS, "map": MAPS, "run": ("run", "pretrained")}
    if rng.random() < 0.15:
        return pick(rng, ODD)
    return pick(rng, good.get(name) or VALUES.get(name) or ("1", "2", "0.01", "3"))


def write(rng: Rng, folder: Path) -> None:
    """Good files, and a spoilt one of each kind called x."""
    for kind in ("text-map", "scans", "heights", "picture", "drawing"):
        suffix, make, _ = FILES[kind]
        (folder / f"x{suffix}").write_bytes(make(rng))
    (folder / "good.txt").write_text(MAP)
    (folder / "good.json").write_text(json.dumps(pick(rng, (DRAWING, GLYPHS))))
    (folder / "a-file").write_text("")
    np.save(folder / "flat.npy", np.zeros((12, 12), np.float32))
    np.save(folder / "pile.npy", np.eye(12, dtype=np.float32) * 0.05)
    from PIL import Image

    Image.new("L", (12, 12), 255).save(folder / "white.png")
    run = folder / "run"
    run.mkdir()
    (run / "config.json").write_bytes(config(rng))
    (run / "metrics.jsonl").write_text("".join(json.dumps(row) + "\n" for row in METRICS))
    (run / "best.npz").write_bytes(state(rng))


Main = Callable[[list[str]], int]


def programs() -> dict[str, tuple[Main, argparse.ArgumentParser]]:
    """The programs by name, each with its parser."""
    from jaxsand.cli import parser as jaxsand
    from train import __main__ as train

    return {"jaxsand": (jaxsand.main, jaxsand._parser()), "train": (train.main, train._parser())}


HEAVY = {"jaxsand": ("plan", "settle", "shape")}


def stop(*_: object, **__: object) -> None:
    """What stands in for long work."""
    raise ValueError("stub: got here; nothing to do")


STUBS = (
    "jaxsand.bench.report.bench",
    "jaxsand.terramechanics.trench_experiment.experiment",
    "jaxsand.planning.methods.searched",
    "jaxsand.planning.methods.optimised",
    "jaxsand.planning.methods.by_policy",
    "jaxsand.planning.pipeline.shape",
    "jaxsand.relaxation.settling.settle",
    "train.runs.runs.run",
    "train.evaluation.scores.evaluate",
    "train.evaluation.glyphs.stroke_goal",
    "jaxsand.bench.stroke_goals.stroke_goal",
)


def run(main: Main, words: list[str], folder: Path, stubs: tuple[str, ...]) -> None:
    """Runs a command, and judges its exit code, what it printed and what it left; CrashError if anything is amiss."""
    out, err = io.TextIOWrapper(io.BytesIO(), "utf-8"), io.TextIOWrapper(io.BytesIO(), "utf-8", "backslashreplace")
    before = contents(folder)
    with ExitStack() as all_of_them:
        for stub in stubs:
            all_of_them.enter_context(patch(stub, stop))
        all_of_them.enter_context(redirect_stdout(out))
        all_of_them.enter_context(redirect_stderr(err))
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("error")
                code = main(words)
        except SystemExit as end:
            code = end.code
        except Exception as error:
            raise CrashError(f"{words}: {type(error).__name__}: {error}") from error
    said, told = text(out), text(err)
    if code == 2 and (said or told.count("\n") != 1 or not LINE.fullmatch(told)):
        raise CrashError(f"{words}: not one line of field, fault and remedy: {said!r:.100} {told!r:.400}")
    if code not in (0, 2):
        raise CrashError(f"{words}: ended with {code}: {told!r:.300}")
    if code == 0 and "--json" in words:
        json.loads(said)
    left = {path: data for path, data in contents(folder).items() if before.get(path) != data}
    for path, data in left.items():
        whole(path, data, words)
    if code == 2 and left:
        raise CrashError(f"{words}: failed, and left {sorted(map(str, left))}: {told!r:.200}")


def text(stream: io.TextIOWrapper) -> str:
    """What was printed."""
    stream.flush()
    return stream.buffer.getvalue().decode()


def contents(folder: Path) -> dict[Path, bytes]:
    """The files in a folder and what they hold."""
    return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def whole(path: Path, data: bytes, words: list[str]) -> None:
    """CrashError if a file that a command left is not whole."""
    if path.name.startswith(".") or path.suffix == ".part":
        raise CrashError(f"{words}: left {path.name}")
    if path.suffix == ".json":
        json.loads(data)
    elif path.suffix == ".npy":
        np.load(io.BytesIO(data), allow_pickle=False)
    elif path.suffix == ".png":
        from PIL import Image

        Image.open(io.BytesIO(data)).load()
