"""The bench of earth-moving tasks: what it tells, and its options."""

import json

import numpy as np
import pytest

from jaxsand.__main__ import main
from jaxsand.bench import tasks
from jaxsand.bench.tasks import METHODS, bench_tasks
from jaxsand.goals.tasks import figures, make_task


@pytest.mark.slow
@pytest.mark.long
def test_rows_tell_what_methods_leave_and_spend():
    rows = bench_tasks(names=("rectangle",), methods=METHODS, pushes=120)["tasks"]
    assert [row["method"] for row in rows] == [*METHODS]
    for row in rows:
        assert row["before_mm"] > row["mean_mm"] == row["worst_mm"] or row["method"] == "random"
        assert 0 < row["pushes"] <= 120
        assert 0 < row["strokes"] <= 24
        assert row["path_m"] > 0.01 * row["strokes"]
        assert row["moved"] > 0
    left = {row["method"]: row["distance"] for row in rows}
    assert left["plan_sand"] <= min(left["least work"], left["random"])


def test_doing_nothing_is_told_as_that(monkeypatch):
    monkeypatch.setitem(tasks.RIVALS, "random", lambda *_: ((np.zeros((0, 6)), 0.0), tasks.Effort()))
    found = bench_tasks(names=("ring",), methods=("random",), instances=2)
    (row,) = found["tasks"]
    ((title, task, after),) = tasks.shown(found["tasks_maps"])
    np.testing.assert_array_equal(after, task.start)
    assert title == f"ring: {figures(task, after)['mean_mm']:.2g} to {figures(task, after)['mean_mm']:.2g} mm, random"
    means = [figures(make_task("ring", key), make_task("ring", key).start)["mean_mm"] for key in (0, 1)]
    assert row["mean_mm"] == row["before_mm"] == pytest.approx(np.mean(means))
    assert row["worst_mm"] == pytest.approx(max(means))
    assert row["distance_at_best"] < 1e-9
    assert row["at_best_mm"] < 1e-3
    assert (row["strokes"], row["path_m"], row["moved"], row["coverage"]) == (0, 0, 0, None)


def test_of_vertical_walls_the_floor_is_told(monkeypatch):
    monkeypatch.setitem(tasks.RIVALS, "random", lambda *_: ((np.zeros((0, 6)), 0.0), tasks.Effort()))
    (row,) = bench_tasks(names=("vertical",), methods=("random",), seed=1)["tasks"]  # 12 mm deep, walls of one cell
    assert 0.2 * row["distance"] < row["distance_at_best"] < 0.3 * row["distance"]
    assert row["at_best_mm"] == pytest.approx(1.65, rel=0.02)


def test_what_is_there_already_is_not_computed_again(monkeypatch, tmp_path):
    """A run that was cut off in the middle of a line goes on there; more instances are added; other options begin anew."""
    made = []

    def dig(job, budget, rng):
        made.append(rng.random())
        return (np.array([[0.05, 0.1, -0.004, 0.2, 0.1, -0.004]]), 0.0), tasks.Effort(full=int(budget))

    monkeypatch.setitem(tasks.RIVALS, "random", dig)
    monkeypatch.setitem(tasks.RIVALS, "coverage", dig)
    monkeypatch.setattr(tasks, "finish", lambda scene, plans, first, start: np.stack([start, start - 0.001]))
    given = {"names": ("ring", "spread"), "methods": ("random", "coverage"), "instances": 2, "pushes": 3, "out": tmp_path}
    told = []
    whole = bench_tasks(told.append, **given)
    assert told[0] == "0 of 8 done; ring by random, 2 at once"
    assert {line.partition(":")[0] for line in told[1:3]} == {"ring 0 by random", "ring 1 by random"}
    assert told[3] == "2 of 8 done; ring by coverage, 2 at once"
    assert len(made) == 8
    assert made[0] != made[1]
    lines = (tmp_path / "tasks.jsonl").read_text().splitlines()
    rows = [json.loads(line) for line in lines]
    assert {(row["task"], row["method"], row["key"]) for row in rows[:4]} == {
        ("ring", method, key) for method in ("random", "coverage") for key in (0, 1)
    }
    assert rows[0]["plan"] == [[0.05, 0.1, -0.004, 0.2, 0.1, -0.004]]
    assert bench_tasks(**given) == whole
    assert len(made) == 8
    (tmp_path / "tasks.jsonl").write_text("\n".join(lines[:5])[:-40])  # cut off in the fifth
    again = bench_tasks(**given)
    assert len(made) == 12
    assert [row["distance"] for row in again["tasks"]] == [row["distance"] for row in whole["tasks"]]
    assert again["tasks_maps"] == whole["tasks_maps"]
    assert len(bench_tasks(**given | {"instances": 3, "names": ("spread",)})["tasks"]) == 2
    assert len(made) == 14
    for other in ({"pushes": 4}, {"strokes": 1}):
        bench_tasks(**given | other | {"names": ("ring",), "methods": ("random",), "instances": 1})
    assert len(made) == 16
    (tmp_path / "tasks.jsonl").write_text('{"task": "ring"}\n')
    with pytest.raises(ValueError, match=r"out: line 1 of .* is no row of this bench"):
        bench_tasks(**given)


def test_names_that_do_not_exist_are_refused():
    with pytest.raises(ValueError, match="bench tasks: got 'dance'; give some of level, pad"):
        bench_tasks(names=("dance",))
    with pytest.raises(ValueError, match="bench tasks: got 'luck'; give some of random, coverage"):
        bench_tasks(methods=("luck",))


def test_the_command_passes_its_options_on(monkeypatch, capsys):
    asked = []
    monkeypatch.setattr(
        tasks, "bench_tasks", lambda tell, **given: asked.append(given) or {"tasks": [{"task": "pad", "mean_mm": 1.0}]}
    )
    given = ["--goals", "pad,ramp", "--methods", "coverage", "--calls", "7", "--seeds", "2", "--seed", "3", "--strokes", "5"]
    assert main(["bench", "tasks", *given, "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["tasks"] == [{"task": "pad", "mean_mm": 1.0}]
    assert asked == [
        {"seed": 3, "names": ("pad", "ramp"), "methods": ("coverage",), "instances": 2, "pushes": 7, "strokes": 5}
    ]
    assert main(["bench", "strokes", "--goals", "pad"]) == 2
    assert "goals: got 'pad'; give one of letters, turned" in capsys.readouterr().err
