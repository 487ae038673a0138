"""Runs are the same bit for bit whatever befalls them, and what they leave behind is whole."""

import errno
import json
import os
import signal
import subprocess
import sys
import threading
import time
from dataclasses import dataclass, replace
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxsand.bench.kept import known_rows
from train.curves import curve
from train.replay.her import Final, Future
from train.runs import checkpoints, runs
from train.runs.runs import learner_of, load, run

pytestmark = pytest.mark.compiled  # as processes of their own are, with which they are compared

STEPS = 40


@dataclass(frozen=True)
class Tiny:
    """A state of each kind: typed keys, jax and numpy arrays of several types, in dictionaries and lists."""

    rate: float = 0.5
    every: int = 7
    pause: float = 0.0  # s
    parts: tuple[Final | Future, ...] = (Final(), Future(3))
    name: str = "tiny"

    def init(self, seed):
        return {"key": jax.random.key(seed), "x": [np.zeros(3), jnp.zeros(2, jnp.float32)], "count": np.int64(0)}

    def advance(self, state):
        time.sleep(self.pause)
        key, draw = jax.random.split(state["key"])
        x, y = state["x"]
        y = y + self.rate * jax.random.normal(draw, (2,), jnp.float32)
        new = {"key": key, "x": [np.sin(x + float(y[0])) + self.rate, y], "count": state["count"] + 1}
        return new, {"loss": float(y[1])}

    def validate(self, state):
        return {"score": float(np.sin(state["count"]))}


def same(a, b):
    assert jax.tree.structure(a) == jax.tree.structure(b)
    for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True):
        assert x.dtype == y.dtype
        assert bits(x) == bits(y)


def bits(leaf):
    is_key = jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)
    return np.asarray(jax.random.key_data(leaf) if is_key else leaf).tobytes()


def rows(out):
    kept = [json.loads(line) for line in (out / "metrics.jsonl").read_text().splitlines()]
    return [{k: v for k, v in row.items() if k not in ("seconds", "chunks_per_second")} for row in kept]


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory):
    out = tmp_path_factory.mktemp("run") / "undisturbed"
    run(Tiny(), out, 3, steps=STEPS)
    return out


def alike(out, undisturbed):
    for which in ("last", "best"):
        same(load(out, Tiny(), which), load(undisturbed, Tiny(), which))
    assert rows(out) == rows(undisturbed)


def test_a_run_leaves_its_configuration_its_metrics_and_both_states(undisturbed):
    state = Tiny().init(3)
    for _ in range(STEPS):
        state, _ = Tiny().advance(state)
    same(load(undisturbed, Tiny(), "last"), state)
    scores = {chunk: np.sin(chunk) for chunk in (7, 14, 21, 28, 35, 40)}
    best = max(scores, key=scores.get)
    assert load(undisturbed, Tiny(), "best")["count"] == best
    kept = rows(undisturbed)
    assert [row["chunk"] for row in kept if row["kind"] == "train"] == [*range(1, STEPS + 1)]
    assert {row["chunk"]: row["score"] for row in kept if row["kind"] == "validate"} == scores
    config = json.loads((undisturbed / "config.json").read_text())
    assert config["seed"] == 3
    assert config["learner"]["parts"][1] == {"is": "train.replay.her:Future", "copies": 3}
    assert config["versions"]["jax"] == jax.__version__
    assert {path.name for path in undisturbed.iterdir()} == {"config.json", "metrics.jsonl", "last.npz", "best.npz"}


CHILD = """
import os, signal, sys
from pathlib import Path
from tests.train.test_runs import Tiny
from train.runs import checkpoints
from train.runs.runs import run

out, moment, resume = Path(sys.argv[1]), sys.argv[2], sys.argv[3] == "resume"
die = lambda: os.kill(os.getpid(), signal.SIGKILL)
if moment == "half written":
    saves = [0]
    def fsync(number):
        saves[0] += 1
        if saves[0] == 8:  # of the metrics and a checkpoint in turn
            os.ftruncate(number, 100)
            die()
    os.fsync = fsync
if moment in ("before the rename", "between both", "before there is a last"):
    put, puts = Path.replace, [0]
    def replace(self, target):
        puts[0] += self.name == "best.npz.part"
        if moment == "before the rename" and puts[0] == 2:
            die()
        put(self, target)
        if puts[0] == {"between both": 2, "before there is a last": 1}.get(moment):
            die()
    Path.replace = replace
seldom = 100.0 if moment == "before there is a last" else 0.05
run(Tiny(pause=0.02 if moment == "any" else 0.0), out, 3, steps=40, resume=resume, save_every=seldom)
"""


def child(out, moment, resume=False):
    environment = os.environ | {"PYTHONPATH": str(Path(__file__).parents[2]), "JAX_ENABLE_X64": "1"}
    arguments = [sys.executable, "-c", CHILD, str(out), moment, "resume" if resume else "anew"]
    return subprocess.Popen(arguments, env=environment, stderr=subprocess.PIPE)


@pytest.mark.parametrize("moment", ["half written", "before the rename", "between both", "before there is a last"])
def test_killed_while_it_saves_a_run_goes_on_bit_for_bit(tmp_path, undisturbed, moment):
    with child(tmp_path / "run", moment) as process:
        _, said = process.communicate(timeout=100)
    assert process.returncode == -signal.SIGKILL, said.decode()
    assert (tmp_path / "run" / "last.npz").exists() == (moment != "before there is a last")
    ran = run(Tiny(), tmp_path / "run", 3, steps=STEPS, resume=True)
    assert ran.chunk == STEPS
    alike(tmp_path / "run", undisturbed)


@pytest.mark.wide
def test_killed_at_any_moment_and_again_a_run_goes_on_bit_for_bit(tmp_path, undisturbed):
    out = tmp_path / "run"
    for lines in (5, 24):
        with child(out, "any", resume=lines > 5) as process:
            while not (out / "metrics.jsonl").exists() or (out / "metrics.jsonl").read_bytes().count(b"\n") < lines:
                assert process.poll() is None, process.stderr.read().decode()
                time.sleep(0.003)
            process.kill()
    with (out / "metrics.jsonl").open("a") as file:
        file.write('{"kind": "tr')  # as if it had been cut off in a row
    config = json.loads((out / "config.json").read_text())
    config["learner"]["pause"] = 0.0
    (out / "config.json").write_text(json.dumps(config))
    assert run(Tiny(), out, 3, steps=STEPS, resume=True).chunk == STEPS
    alike(out, undisturbed)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_asked_to_stop_it_ends_its_chunk_saves_and_goes_on_later(tmp_path, undisturbed, number):
    before = signal.getsignal(number)
    ran = run(Tiny(), tmp_path, 3, steps=STEPS, watch=lambda row: row["chunk"] == 11 and os.kill(os.getpid(), number))
    assert (ran.stopped, ran.chunk) == (True, 11)
    assert signal.getsignal(number) == before
    assert load(tmp_path, Tiny(), "last")["count"] == 11
    assert not run(Tiny(), tmp_path, 3, steps=STEPS, resume=True).stopped
    alike(tmp_path, undisturbed)


def test_a_thread_runs_too(tmp_path, undisturbed):
    thread = threading.Thread(target=run, args=(Tiny(), tmp_path / "run", 3), kwargs={"steps": STEPS})
    thread.start()
    thread.join()
    alike(tmp_path / "run", undisturbed)


def test_minutes_are_of_work_over_all_resumptions(tmp_path):
    slow = Tiny(pause=0.02)
    first = run(slow, tmp_path, minutes=0.3 / 60)
    assert 0.3 <= first.seconds < 5
    again = run(slow, tmp_path, minutes=0.3 / 60, resume=True)
    assert (again.chunk, again.seconds < first.seconds + 1) == (first.chunk, True)
    more = run(slow, tmp_path, minutes=(first.seconds + 0.3) / 60, resume=True)
    assert more.chunk > first.chunk
    assert first.seconds + 0.3 <= more.seconds < first.seconds + 5


def test_a_full_disk_is_said_and_leaves_the_last_checkpoint_good(tmp_path, undisturbed, monkeypatch):
    saves, fsync = [], os.fsync

    def full(number):
        saves.append(number)
        if len(saves) > 5:
            raise OSError(errno.ENOSPC, "No space left on device")
        fsync(number)

    with monkeypatch.context() as patch:
        patch.setattr(os, "fsync", full)
        with pytest.raises(ValueError, match=r"^out: cannot write .* \(No space left on device\); make room"):
            run(Tiny(), tmp_path, 3, steps=STEPS, save_every=0.0)
    assert not list(tmp_path.glob("*.part"))
    assert 0 < load(tmp_path, Tiny(), "last")["count"] < STEPS
    run(Tiny(), tmp_path, 3, steps=STEPS, resume=True)
    alike(tmp_path, undisturbed)


def test_metrics_that_cannot_be_written_are_said(tmp_path, monkeypatch):
    def full(rows, out, row):
        raise checkpoints.unwritable(out, OSError(errno.ENOSPC, "No space left on device"))

    monkeypatch.setattr(runs, "_append", full)
    with pytest.raises(ValueError, match="out: cannot write"):
        run(Tiny(), tmp_path, steps=2)


@pytest.mark.parametrize("where", ["file/run", "locked"])
def test_a_folder_that_cannot_be_written_to_is_said_before_any_work(tmp_path, monkeypatch, where):
    (tmp_path / "file").write_text("")
    if where == "locked":

        def touch(self, *args, **kwargs):
            raise OSError(errno.EACCES, "Permission denied")

        monkeypatch.setattr(Path, "touch", touch)
    monkeypatch.setattr(Tiny, "advance", lambda self, state: pytest.fail("worked"))
    with pytest.raises(ValueError, match="out: cannot write to .*; choose another folder"):
        run(Tiny(), tmp_path / where, steps=2)


@pytest.mark.parametrize("spoil", [lambda b: b[: len(b) // 2], lambda b: b"", lambda b: b[:200] + b"!!!!" + b[204:]])
def test_a_spoilt_checkpoint_is_said_and_never_gone_on_from(tmp_path, spoil):
    run(Tiny(), tmp_path, 3, steps=9)
    last = tmp_path / "last.npz"
    last.write_bytes(spoil(last.read_bytes()))
    with pytest.raises(ValueError, match=r"run: cannot read .*last.npz .*; put a copy of best.npz in its place"):
        run(Tiny(), tmp_path, 3, steps=12, resume=True)
    last.write_bytes((tmp_path / "best.npz").read_bytes())
    assert run(Tiny(), tmp_path, 3, steps=12, resume=True).chunk == 12


def test_another_learner_s_state_is_said(tmp_path):
    run(Tiny(), tmp_path, steps=1)

    @dataclass(frozen=True)
    class Other(Tiny):
        def init(self, seed):
            return super().init(seed) | {"x": [np.zeros(3), jnp.zeros(3, jnp.float32)]}

    with pytest.raises(ValueError, match=r"holds float32\[2\] as x/1, this learner float32\[3\]"):
        load(tmp_path, Other())


@pytest.mark.parametrize(
    ("learner", "seed", "resume", "said"),
    [
        (Tiny(), 0, False, "out: there is a run in .*--resume"),
        (Tiny(rate=0.25), 0, True, r"learner.rate: the run in .* has 0.5, got 0.25"),
        (replace(Tiny(), parts=(Final(), Future(4))), 0, True, "learner.parts: the run in "),
        (Tiny(), 1, True, "seed: the run in .* has 0, got 1"),
    ],
)
def test_a_run_goes_on_only_as_what_it_is(tmp_path, learner, seed, resume, said):
    run(Tiny(), tmp_path, 0, steps=1)
    before = (tmp_path / "last.npz").read_bytes()
    with pytest.raises(ValueError, match=said):
        run(learner, tmp_path, seed, steps=2, resume=resume)
    assert (tmp_path / "last.npz").read_bytes() == before


def test_there_must_be_an_end_and_for_a_resumption_a_beginning(tmp_path):
    with pytest.raises(ValueError, match="minutes: got none, and no steps"):
        run(Tiny(), tmp_path / "run")
    with pytest.raises(ValueError, match="out: there is no run in .*; leave --resume out"):
        run(Tiny(), tmp_path / "run", steps=1, resume=True)
    with pytest.raises(ValueError, match="run: there is none in"):
        learner_of(tmp_path / "run")
    assert not (tmp_path / "run").exists()


def test_a_learner_is_known_by_its_configuration_and_nothing_else_is_made():
    thing = (Future(7), 0.1, "text", None, (True, Final()))
    assert checkpoints.restored(json.loads(json.dumps(checkpoints.described(thing)))) == thing
    with pytest.raises(ValueError, match="learner: got"):
        checkpoints.described(Tiny(parts=({},)))  # type: ignore[arg-type]
    for data in (
        {"is": "os:system"},
        {"is": "train.replay.her:Nothing"},
        {"is": "train.replay.her:Future", "copied": 3},
        {},
        {"is": "jaxsand.goals:terrain"},
        {"is": "train.replay.her:Future", "copies": "3"},
        {"is": "train.replay.her:Future", "copies": None},
        {"is": "train." * 10_000},
        {"is": "train.replay.her:Future", "x" * 10_000: 3},
    ):
        with pytest.raises(ValueError, match="config: ") as caught:
            checkpoints.restored(data)
        assert len(str(caught.value)) < 500


@pytest.mark.parametrize(
    "about", ["[]", "3", "null", '{"chunk": "x"}', '{"chunk": 1.5}', '{"score": null}', '{"more": 1}', "{"]
)
def test_a_checkpoint_that_says_nonsense_of_its_run_is_named(tmp_path, about):
    np.savez(tmp_path / "last.npz", about=np.array(about))
    with pytest.raises(ValueError, match=r"run: cannot read .*last.npz .*; put a copy of best.npz in its place"):
        checkpoints.where(tmp_path / "last.npz")


@pytest.mark.parametrize("fault", [TypeError("a"), OverflowError("b"), MemoryError()])
def test_a_learner_that_cannot_begin_is_named(tmp_path, monkeypatch, fault):
    run(Tiny(), tmp_path, steps=1)

    def init(self, seed):
        raise fault

    monkeypatch.setattr(Tiny, "init", init)
    with pytest.raises(ValueError, match="run: cannot begin the learner in .*config.json .*; train anew"):
        load(tmp_path, Tiny())


@pytest.mark.parametrize("seed", ["true", "1.5", '"3"', "null"])
def test_a_seed_that_is_none_is_named(tmp_path, seed):
    (tmp_path / "config.json").write_text(f'{{"seed": {seed}, "learner": null}}')
    with pytest.raises(ValueError, match="run: .*config.json is no run's"):
        learner_of(tmp_path)


@pytest.mark.parametrize(
    "row", ['{"kind": "train", "steps": 1e999}', '{"kind": "validate", "seconds": 1' + "0" * 400 + "}", "[" * 9999, "3"]
)
def test_metrics_that_are_spoilt_are_named(tmp_path, row):
    (tmp_path / "metrics.jsonl").write_text('{"kind": "validate", "seconds": 1, "score": 1}\n' + row + "\n")
    if "train" in row:
        assert curve(tmp_path)["score"] == [1]
        return
    with pytest.raises(ValueError, match="run: cannot read .*metrics.jsonl"):
        curve(tmp_path)


def test_rows_of_a_bench_that_are_no_text_are_left_out(tmp_path):
    (tmp_path / "rows.jsonl").write_bytes(b'{"a": 1}\n\xff\xfe\n' + b"[" * 9999 + b'\n{"a": 2}\n')
    assert known_rows(tmp_path / "rows.jsonl", {"a"}) == [{"a": 1}, {"a": 2}]


def test_progress_tells_the_rate_the_score_and_the_time_to_go(tmp_path):
    said = []
    run(Tiny(pause=0.05), tmp_path, steps=14, tell=said.append)
    assert len(said) == 14
    assert said[0].startswith("tiny: chunk 1, ")
    assert "a second, 0.0 min to go" in said[0]
    assert said[-1].endswith("score 0.991 (best 0.991), 0.0 min to go")


def test_what_keeps_a_run_from_going_on_is_named(tmp_path):
    state = {"key": jax.random.key(0), "w": np.zeros(3, np.float32), "x": np.zeros(2, np.float32)}
    checkpoints.save(tmp_path / "last.npz", state, checkpoints.At())
    wide = state | {"w": np.zeros(3), "x": np.zeros(2)}
    with pytest.raises(ValueError, match=r"holds float32\[3\] as w, this learner float64\[3\]; .*JAX_ENABLE_X64=0"):
        checkpoints.load(tmp_path / "last.npz", wide)
    with pytest.raises(ValueError, match=r"holds uint32\[2\] as key, this learner uint32\[4\]; set jax_default_prng_impl"):
        checkpoints.load(tmp_path / "last.npz", state | {"key": jax.random.key(0, impl="rbg")})
    with pytest.raises(ValueError, match=r"holds float32\[2\] as x, this learner float64\[5\]; use its own learner"):
        checkpoints.load(tmp_path / "last.npz", wide | {"x": np.zeros(5)})
    checkpoints.save(tmp_path / "wide.npz", wide, checkpoints.At())
    with pytest.raises(ValueError, match=r"JAX_ENABLE_X64=1"):
        checkpoints.load(tmp_path / "wide.npz", state)
