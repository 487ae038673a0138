"""Runs that can be resumed: a learner advances chunk by chunk, and its folder holds enough to go on bit for bit.

RUN/config.json    the learner, its fields, the seed, the versions
RUN/metrics.jsonl  a row for every chunk, and one for every validation
RUN/last.npz       the state to go on from
RUN/best.npz       the state that validated best
"""

import os
import platform
import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from types import FrameType
from typing import Any, BinaryIO, Literal, Protocol

from jaxsand.cli.files import as_json, folder, progress, write_json
from jaxsand.goals.untrusted import read_json
from jaxsand.goals.writing import reason
from jaxsand.scene.progress import Tell
from train.runs.checkpoints import At, State, described, restored, save, unwritable, where
from train.runs.checkpoints import load as load_state

Metrics = dict[str, float]
Watch = Callable[[dict[str, Any]], None]

_CONFIG, _METRICS = "config.json", "metrics.jsonl"
_LAST, _BEST = "last.npz", "best.npz"
_PACKAGES = ("jaxsand", "jax", "jaxlib", "numpy", "flax", "optax")


class Learner(Protocol):
    """A learner: a frozen dataclass whose fields (numbers, texts, and tuples of them) are its configuration."""

    @property
    def name(self) -> str:
        """Its name on the command line."""

    @property
    def every(self) -> int:
        """How many chunks lie between validations; a run also validates at its end."""

    def init(self, seed: int) -> State:
        """The state before the first chunk."""

    def advance(self, state: State) -> tuple[State, Metrics]:
        """One chunk of work (0.2 to 5 s). The next state is a pure function of this one."""

    def validate(self, state: State) -> Metrics:
        """Figures on goals set apart, letters never among them; the larger their `score`, the better."""


@dataclass(frozen=True)
class Ran:
    """What a run reached.

    Attributes:
      state: after the last chunk.
      chunk: chunks done in all.
      seconds: of work in all.
      score: the best so far; -inf before the first validation.
      stopped: whether it was asked to stop before its end.
      did: chunks done by this call.
    """

    state: State
    chunk: int
    seconds: float
    score: float
    stopped: bool
    did: int


def run(
    learner: Learner,
    out: Path,
    seed: int = 0,
    *,
    minutes: float | None = None,
    steps: int | None = None,
    resume: bool = False,
    save_every: float = 30.0,
    tell: Tell | None = None,
    watch: Watch = lambda _: None,
) -> Ran:
    """Trains until `minutes` of work or `steps` chunks are done, those before a resumption included.

    Validation, checkpoints and compiling count as work. The last state is saved every `save_every` seconds, when it
    validates best, at the end, and on SIGINT or SIGTERM, which let the chunk end first.

    Args:
      learner: what is trained.
      out: the run's folder.
      seed: of everything drawn by chance.
      minutes, steps: when to end; at least one is needed.
      resume: whether to go on with the run in the folder.
      save_every: seconds between checkpoints.
      tell: is called with a line of progress.
      watch: is called with every row of the metrics.

    Raises:
      ValueError: when neither end is given, a run is there without `resume`, none is there with it, it has another
        configuration or seed, or `out` cannot be written; the last checkpoint stays good.
    """
    if minutes is None and steps is None:
        raise ValueError("minutes: got none, and no steps; give one of them")
    tell = tell or progress()
    began = time.monotonic()
    _check_there(out, resume)  # which makes the folder
    with ExitStack() as held:
        held.enter_context(_alone(out))
        there = _check_there(out, resume)  # another run may have begun, and ended, until now
        state, at = _begin(learner, out, seed, there)
        rows, asked = held.enter_context(_rows(out, at.rows)), held.enter_context(_asked_to_stop())
        started = began - at.seconds

        def spent() -> float:
            return time.monotonic() - started

        chunk, best = at.chunk, at.score
        score: float | None = None
        begun, first, saved = spent(), chunk, time.monotonic()

        def note(kind: str, figures: Metrics, **more: float) -> None:
            row = {"kind": kind, "chunk": chunk, "seconds": round(spent(), 3), **figures, **more}
            _append(rows, out, row)
            watch(row)

        def keep(name: str) -> None:
            os.fsync(rows.fileno())
            save(out / name, state, At(chunk, spent(), best, rows.tell()))

        def over() -> bool:
            return (steps is not None and chunk >= steps) or (minutes is not None and spent() >= 60 * minutes)

        ends = over()
        while not asked and not ends:
            state, figures = learner.advance(state)
            chunk += 1
            rate = (chunk - first) / max(spent() - begun, 1e-9)
            note("train", figures, chunks_per_second=round(rate, 4))
            ends = over()
            is_best = False
            if chunk % learner.every == 0 or ends:
                figures = learner.validate(state)
                score = figures["score"]
                note("validate", figures)
                is_best = figures["score"] > best
            if is_best:
                best = figures["score"]
                keep(_BEST)
            if is_best or ends or time.monotonic() - saved >= save_every:
                keep(_LAST)
                saved = time.monotonic()
            tell(_line(learner, chunk, rate, score, best, _to_go(chunk, rate, spent(), minutes, steps)))
        if asked and chunk > first:
            keep(_LAST)
    return Ran(state, chunk, spent(), best, stopped=bool(asked), did=chunk - first)


def load(out: Path, learner: Learner, which: Literal["best", "last"] = "best") -> State:
    """A state of the run in a folder: the one that validated best, or the last one.

    Raises:
      ValueError: if there is none, it cannot be read, or it is another learner's.
    """
    seed = _config(out)["seed"]
    try:
        like = learner.init(seed)
    except Exception as error:  # fields that another version, or another hand, wrote may break it anywhere
        raise ValueError(f"run: cannot begin the learner in {out / _CONFIG} ({reason(error)}); train anew") from None
    return load_state(out / f"{which}.npz", like)[0]


def learner_of(out: Path) -> Learner:
    """The learner of the run in a folder, as it was configured.

    Raises:
      ValueError: if there is no run, or this version cannot make its learner.
    """
    learner: Learner = restored(_config(out)["learner"])
    if not hasattr(learner, "advance"):
        raise ValueError(f"config: {out / _CONFIG} holds no learner but {learner!r}; use a run's own file")
    return learner


def about_run(out: Path) -> At:
    """Where the run in a folder was when its state validated best."""
    return where(out / _BEST)


def seed_of(out: Path) -> int:
    """The seed of the run in a folder."""
    return int(_config(out)["seed"])


def _config(out: Path) -> dict[str, Any]:
    """The configuration of the run in a folder."""
    path = out / _CONFIG
    if not path.exists():
        raise ValueError(f"run: there is none in {out}; train one: python -m train --help")
    try:
        config = read_json(path)
    except ValueError as error:
        raise ValueError(f"run: cannot read {path} ({error}); train anew in another folder") from None
    if not isinstance(config, dict) or type(config.get("seed")) is not int or "learner" not in config:
        raise ValueError(f"run: {path} is no run's; it needs a learner and a seed; train anew in another folder")
    return config


def _check_there(out: Path, resume: bool) -> bool:
    """Whether a run is in the folder, which can be written to; raises ValueError where `resume` does not go with that."""
    there = (out / _CONFIG).exists()
    if there and not resume:
        raise ValueError(f"out: there is a run in {out}; go on with --resume, or choose another folder")
    if resume and not there:
        raise ValueError(f"out: there is no run in {out} to go on with; leave --resume out, or check the name")
    folder(out)
    return there


@contextmanager
def _alone(out: Path) -> Iterator[None]:
    """Keeps other runs out of the folder, where the system can; raises ValueError if one is going on there."""
    try:
        import fcntl
    except ImportError:
        yield
        return
    number = os.open(out, os.O_RDONLY)
    try:
        try:
            fcntl.flock(number, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise ValueError(f"out: a run is going on in {out}; wait for its end, or choose another folder") from None
        except OSError:  # a file system without locks
            pass
        yield
    finally:
        os.close(number)


def _begin(learner: Learner, out: Path, seed: int, there: bool) -> tuple[State, At]:
    """The state to go on from, and where the run is."""
    if there:
        _compare(_config(out), described(learner), seed, out)
    state = learner.init(seed)  # what cannot begin leaves no run
    if not there:
        versions = {name: metadata.version(name) for name in _PACKAGES} | {"python": platform.python_version()}
        config = {"name": learner.name, "seed": seed, "learner": described(learner), "versions": versions}
        write_json(out / _CONFIG, config)
    for name in (_LAST, _BEST):  # the best is written first, and is a whole state too
        if (out / name).exists():
            return load_state(out / name, state)
    return state, At()


def _compare(config: dict[str, Any], learner: object, seed: int, out: Path) -> None:
    """Raises ValueError unless a run goes on with the configuration and the seed that it began with."""
    for field, have, want in _differences(config["learner"], learner, "learner"):
        raise ValueError(f"{field}: the run in {out} has {have}, got {want}; choose another folder, or give it the same")
    if config["seed"] != seed:
        raise ValueError(f"seed: the run in {out} has {config['seed']}, got {seed}; choose another folder, or give it that")


def _differences(have: object, want: object, field: str) -> Iterator[tuple[str, object, object]]:
    """The fields in which two configurations differ, with both values."""
    if isinstance(have, dict) and isinstance(want, dict):
        for name in dict.fromkeys([*have, *want]):
            yield from _differences(have.get(name), want.get(name), f"{field}.{name}")
    elif have != want:
        yield field, have, want


@contextmanager
def _rows(out: Path, size: int) -> Iterator[BinaryIO]:
    """The file of metrics, opened to append, and cut to what the checkpoint knows of."""
    path = out / _METRICS
    try:
        with path.open("ab") as file:
            if file.tell() < size:
                raise ValueError(f"out: {path} has lost rows; copy them back, or choose another folder")
            file.truncate(size)
            file.seek(size)
            yield file
    except OSError as error:
        raise unwritable(path, error) from None


def _append(rows: BinaryIO, out: Path, row: dict[str, Any]) -> None:
    try:
        rows.write(as_json(row).encode() + b"\n")
        rows.flush()
    except OSError as error:
        raise unwritable(out / _METRICS, error) from None


@contextmanager
def _asked_to_stop() -> Iterator[list[int]]:
    """Collects SIGINT and SIGTERM; a second one acts as usual. Threads other than the main one receive none."""
    asked: list[int] = []
    if threading.current_thread() is not threading.main_thread():
        yield asked
        return
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}

    def note(number: int, frame: FrameType | None) -> None:
        asked.append(number)
        signal.signal(number, before[signal.Signals(number)])

    for number in before:
        signal.signal(number, note)
    try:
        yield asked
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _to_go(chunk: int, rate: float, seconds: float, minutes: float | None, steps: int | None) -> float:
    """The seconds of work that are left at the present rate."""
    left = [60 * minutes - seconds] if minutes is not None else []
    return max(0.0, min(left + ([(steps - chunk) / rate] if steps is not None else [])))


def _line(learner: Learner, chunk: int, rate: float, score: float | None, best: float, to_go: float) -> str:
    scored = "" if score is None else f", score {score:.3f} (best {best:.3f})"
    return f"{learner.name}: chunk {chunk}, {rate:.2f} a second{scored}, {to_go / 60:.1f} min to go"
