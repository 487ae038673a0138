"""The learners' command line: what it leaves, what it says, and how mistakes end."""

import json
import os
import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from jaxsand.planning.learned.policy import Policy, about_policy, load_policy
from train import commands
from train.__main__ import main
from train.ddpg.learner import Ddpg
from train.imitation.hindsight import Hindsight, Progress
from train.runs.runs import learner_of, run

SMALL = Hindsight(plans=2, batch=2, widths=(8, 8, 8), blocks=(0, 0, 0), every=1)


class Quick:
    """A learner's stand-in inside a real run: no lessons, so that the command alone is tried."""

    def __init__(self, monkeypatch):
        self.chunks = 0
        monkeypatch.setattr(Hindsight, "init", lambda _, seed: self.begin(seed))
        monkeypatch.setattr(Hindsight, "advance", lambda _, state: self.advance(state))
        monkeypatch.setattr(Hindsight, "validate", lambda _, state: {"score": float(state.chunk)})
        monkeypatch.setattr(commands, "_learner", lambda options: (SMALL, None))

    def begin(self, seed):
        params = {"params": {"eye": np.full(3, float(seed), np.float32)}}
        return Progress(params, params, {}, np.int32(0), np.int32(seed))

    def advance(self, state):
        self.chunks += 1
        return replace(state, chunk=np.int32(state.chunk + 1)), {"loss": 1.0}


@pytest.fixture
def quick(monkeypatch):
    return Quick(monkeypatch)


def said(capsys, code, *arguments):
    """What a mistake leaves on standard error: one line, and nothing on standard output."""
    try:
        got = main(list(map(str, arguments)))
    except SystemExit as error:
        got = error.code
    out, err = capsys.readouterr()
    assert (got, out) == (code, "")
    assert err.count("\n") == 1
    return err


def test_a_run_is_trained_gone_on_with_and_told_of_in_json(tmp_path, quick, capsys):
    out = tmp_path / "run"
    assert main(["hindsight", "--steps", "2", "--seed", "4", "--out", str(out), "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    assert (report["run"], report["chunks"], report["best_score"]) == (str(out), 2, 2.0)
    assert quick.chunks == 2
    assert learner_of(out) == SMALL
    assert "there is a run in" in said(capsys, 2, "hindsight", "--steps", 3, "--out", out)
    assert main(["hindsight", "--steps", "5", "--seed", "4", "--out", str(out), "--resume"]) == 0
    assert "chunks: 5" in capsys.readouterr().out
    assert quick.chunks == 5
    assert main(["hindsight", "--steps", "5", "--seed", "4", "--out", str(out), "--resume"]) == 0
    assert "was at its end already; give more --minutes or --steps" in capsys.readouterr().err
    assert "seed: the run in" in said(capsys, 2, "hindsight", "--steps", 9, "--seed", 5, "--out", out, "--resume")


def test_a_run_that_is_asked_to_stop_says_how_to_go_on(tmp_path, quick, capsys, monkeypatch):
    def advance(self, state):
        os.kill(os.getpid(), signal.SIGTERM)
        return quick.advance(state)

    monkeypatch.setattr(Hindsight, "advance", advance)
    assert main(["hindsight", "--minutes", "5", "--out", str(tmp_path)]) == 130
    assert "go on with --resume --out" in capsys.readouterr().err
    assert (tmp_path / "last.npz").exists()


def test_metrics_are_written_for_tensorboard_too(tmp_path, quick, capsys):
    assert main(["hindsight", "--steps", "2", "--out", str(tmp_path), "--tensorboard"]) == 0
    events = list((tmp_path / "tensorboard").iterdir())
    assert len(events) == 1
    assert b"validate/score" in events[0].read_bytes()
    assert b"train/loss" in events[0].read_bytes()


def test_without_tensorboardx_that_is_said_before_any_work(tmp_path, quick, capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "tensorboardX", None)
    assert said(capsys, 2, "hindsight", "--steps", 2, "--out", tmp_path / "run", "--tensorboard").startswith(
        "error: tensorboard: "
    )
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize(
    ("arguments", "minutes", "steps", "name"),
    [
        (["hindsight"], 30.0, None, "hindsight-0"),
        (["ddpg"], 10.0, None, "ddpg-0"),
        (["ddpg", "--minutes", "0.5", "--seed", "3"], 0.5, None, "ddpg-3"),
        (["ddpg", "--paper"], None, 157, "ddpg-paper-0"),
        (["ddpg", "--paper", "--steps", "7"], None, 7, "ddpg-paper-0"),
        (["ddpg", "--paper", "--minutes", "7"], 7.0, None, "ddpg-paper-0"),
    ],
)
def test_how_long_and_where_unless_told(arguments, minutes, steps, name, monkeypatch, capsys):
    asked = {}

    def stand_in(learner, out, seed, **options):
        asked.update(options, learner=learner, out=out, seed=seed)
        return type("Ran", (), {"chunk": 1, "seconds": 1.0, "score": 0.0, "stopped": False, "did": 1})

    monkeypatch.setattr("train.runs.runs.run", stand_in)
    assert main(arguments) == 0
    assert (asked["minutes"], asked["steps"], asked["out"]) == (minutes, steps, Path("runs") / name)
    paper = "--paper" in arguments
    assert asked["learner"] == (Hindsight() if arguments[0] == "hindsight" else Ddpg.paper() if paper else Ddpg())


def test_a_run_s_best_policy_is_shipped_with_how_it_was_made(tmp_path, quick, capsys):
    run(SMALL, tmp_path / "run", 6, steps=2)
    file = tmp_path / "policy.npz"
    assert main(["ship", str(tmp_path / "run"), "--out-file", str(file), "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    assert report["bytes"] == file.stat().st_size
    about = about_policy(file)
    assert (about["seed"], about["chunks"], about["score"]) == (6, 2, 2.0)
    assert about["command"] == "python -m train hindsight --seed 6 --steps 2"
    fields = {name: getattr(SMALL.net, name) for name in ("widths", "blocks", "features", "sights")}
    assert about["net"] == json.loads(json.dumps(fields))
    with np.load(file) as arrays:
        np.testing.assert_array_equal(arrays["params/eye"], [6.0, 6.0, 6.0])


def test_what_is_evaluated_where_and_how_it_is_told(tmp_path, quick, capsys, monkeypatch):
    run(SMALL, tmp_path / "run", steps=1)
    glyphs = tmp_path / "glyphs.json"
    glyphs.write_text('{"bar": [[0.2, 0.5, 0.8, 0.5]]}')
    asked = {}

    def stand_in(policy, glyphs, stages, tell):
        asked.update(policy=policy, glyphs=glyphs, stages=stages)
        row = {"iou": 0.5, "l2_reduction": 0.25, "right": True, "strict": False, "strokes_right": 1, "strokes": 1}
        rows = {"bar": row | {"pushes": [[0.1, 0.16, 0.2, 0.16]]}}
        return {"right": 1, "strict": 0, "total": 1, "stroke_right": 1, "glyphs": rows, "seconds": 1.0}

    monkeypatch.setattr("train.evaluation.glyphs.read_glyphs", lambda path: [path])
    monkeypatch.setattr("train.evaluation.scores.evaluate", stand_in)
    arguments = ["evaluate", str(tmp_path / "run"), "--glyphs", str(glyphs)]
    assert main([*arguments, "--json", "--lookahead", "3", "--refine"]) == 0
    report = json.loads(capsys.readouterr().out)
    assert {"right", "strict", "total", "stroke_right", "glyphs", "seconds"} == set(report)
    assert isinstance(asked["policy"], Policy)
    assert asked["glyphs"] == [glyphs]
    assert (asked["stages"].width, asked["stages"].polish > 0) == (3, True)
    assert main(arguments) == 0
    table = capsys.readouterr().out
    assert (asked["stages"].width, asked["stages"].polish) == (0, 0)
    assert "bar" in table
    assert "stroke_right: 1" in table
    assert "0.16" not in table


def test_mistakes_end_with_one_line_and_exit_code_2(tmp_path, quick, capsys, monkeypatch):
    run(SMALL, tmp_path / "run", steps=1)
    for arguments, starts in (
        (["hindsight", "--minutes", "0"], "error: minutes: got '0', which is no number above 0"),
        (["hindsight", "--minutes", "1", "--steps", "1"], "error: steps: not allowed with argument --minutes"),
        (["hindsight", "--steps", "-1"], "error: steps: got '-1'"),
        (["hindsight", "--paper"], "error: arguments: unrecognized arguments: --paper"),
        (["hindsight", "--seed", str(2**31)], "error: seed: got '2147483648', which is no whole number from 0 to"),
        (
            ["evaluate", "pretrained", "--lookahead", "65"],
            "error: lookahead: got '65', which is no whole number from 1 to 64",
        ),
        (["sarsa"], "error: COMMAND: invalid choice: 'sarsa'"),
        ([], "error: arguments: the following arguments are required: COMMAND"),
        (["hindsight", "--resume", "--steps", "1", "--out", tmp_path / "none"], "error: out: there is no run in "),
        (["evaluate", tmp_path / "none"], "error: run: there is none in "),
        (["ship", tmp_path / "none"], "error: run: there is none in "),
        (["evaluate", tmp_path / "run", "--html"], "error: html: goes to a folder; add --out DIR"),
        (["evaluate", tmp_path / "run", "--goals", "runes"], "error: goals: got 'runes'; give one of letters, "),
        (["evaluate", tmp_path / "run", "--glyphs", tmp_path / "none"], "error: "),
    ):
        assert said(capsys, 2, *arguments).startswith(starts)
    (tmp_path / "run" / "config.json").write_text('{"seed": 1, "learner": {"is": "os:system"}}')
    assert said(capsys, 2, "evaluate", tmp_path / "run").startswith("error: config: got 'os:system'")
    (tmp_path / "run" / "config.json").write_text("{")
    assert said(capsys, 2, "evaluate", tmp_path / "run").startswith("error: run: cannot read ")


def test_a_policy_is_exported(tmp_path, quick, capsys, monkeypatch):
    run(SMALL, tmp_path / "run", 6, steps=2)
    got = []
    monkeypatch.setattr(Policy, "export", lambda *call: got.append(call) or Path(call[1]).write_bytes(b"1234"))
    for of in (str(tmp_path / "run"), "pretrained"):
        assert main(["export", of, "--out", str(tmp_path / "policy.jax"), "--count", "3", "--json"]) == 0
        assert json.loads(capsys.readouterr().out) == {"file": str(tmp_path / "policy.jax"), "bytes": 4, "strokes": 3}
    (trained, *call), (shipped, *_) = got
    assert call == [tmp_path / "policy.jax", 3]
    np.testing.assert_array_equal(trained.params["params"]["eye"], [6.0, 6.0, 6.0])
    assert shipped is load_policy()


def test_only_what_hindsight_learned_is_shipped_or_exported(tmp_path, capsys):
    (tmp_path / "config.json").write_text(json.dumps({"seed": 0, "learner": {"is": "train.ddpg.learner:Ddpg"}}))
    assert said(capsys, 2, "ship", tmp_path).startswith("error: run: got one of ddpg")
    assert said(capsys, 2, "export", tmp_path, "--out", tmp_path / "file").startswith("error: run: got one of ddpg")


def test_help_answers_without_jax():
    code = "import sys; sys.argv = ['train', '--help']\ntry:\n import train.__main__ as m; m.main()\nfinally:\n assert 'jax' not in sys.modules"
    root = str(Path(__file__).parents[2])
    got = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, env=os.environ | {"PYTHONPATH": root}, check=False
    )
    assert got.returncode == 0, got.stderr
    for word in ("hindsight", "dqn", "actor-critic", "ddpg", "evaluate", "ship", "export"):
        assert word in got.stdout
