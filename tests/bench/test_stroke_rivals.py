"""Searches for strokes without gradients: on a loss of known optimum, and the bench that compares them."""

import json
from dataclasses import replace

import numpy as np
import pytest

import jaxsand as js
from jaxsand.__main__ import main
from jaxsand.bench import strokes as strokebench
from jaxsand.bench.rivals.strokes import RIVALS, random_shooting
from jaxsand.bench.stroke_goals import letters_on_rough_sand, many_strokes, stroke_goal, turned_letters
from jaxsand.bench.strokes import reached, run_all
from jaxsand.interaction.simulate import rollout
from jaxsand.planning.stroke_loss import sand_loss
from jaxsand.relaxation.stopping import Outcome
from jaxsand.scene.window import Window
from jaxsand.viz.strokes import strokes_figure

BOUNDS = np.array([[0.0, 0.0, 0.0, 0.0], [0.3, 0.2, 0.3, 0.2]])
SPOTS = np.array([[0.1, 0.05, 0.2, 0.15], [0.25, 0.1, 0.05, 0.02]])


class Quadratic:
    """Squared distance (m^2) of each stroke from its own spot; a map is the loss so far and the number of strokes."""

    start = np.zeros(2)

    def __init__(self):
        self.calls, self.seen = 0, []

    def __call__(self, candidates):
        self.calls += candidates.shape[0] * candidates.shape[1]
        self.seen.append(candidates.reshape(-1, 4))
        return ((candidates - SPOTS[: candidates.shape[1]]) ** 2).sum((1, 2))

    def after(self, maps, strokes):
        self.calls += len(strokes)
        self.seen.append(strokes)
        far = maps[:, 0] + ((strokes - SPOTS[maps[:, 1].astype(int)]) ** 2).sum(1)
        return far, np.stack([far, maps[:, 1] + 1], 1)


@pytest.mark.parametrize("name", RIVALS)
def test_a_search_finds_the_optimum_within_budget_and_bounds(name):
    loss = Quadratic()
    found = RIVALS[name](loss, 2, BOUNDS, 3001, 3)
    assert found.calls == loss.calls == 3000
    assert found.strokes.shape == (2, 4)
    assert np.abs(found.strokes - SPOTS).max() < (0.1 if name == "random shooting" else 5e-3)
    seen = np.concatenate(loss.seen)
    assert np.all((seen >= BOUNDS[0]) & (seen <= BOUNDS[1]))
    calls, losses = ([getattr(best, field) for best in found.history] for field in ("calls", "loss"))
    assert np.all(np.diff(losses) < 0)
    assert np.all(np.diff(calls) > 0)
    assert calls[-1] <= 3000
    for best in found.history:
        assert best.loss == pytest.approx(((best.strokes - SPOTS) ** 2).sum())


@pytest.mark.parametrize("name", RIVALS)
def test_the_same_seed_gives_the_same_strokes(name):
    one, again, other = (RIVALS[name](Quadratic(), 2, BOUNDS, 600, seed) for seed in (1, 1, 2))
    np.testing.assert_array_equal(one.strokes, again.strokes)
    assert [best.calls for best in one.history] == [best.calls for best in again.history]
    assert np.any(one.strokes != other.strokes)


@pytest.mark.parametrize("name", RIVALS)
@pytest.mark.parametrize("budget", [2, 3, 77])
def test_small_budgets_are_kept(name, budget):
    loss = Quadratic()
    found = RIVALS[name](loss, 2, BOUNDS, budget, 0)
    assert found.calls == loss.calls == budget // 2 * 2


def test_bad_input_is_named():
    with pytest.raises(ValueError, match=r"budget: got 1 calls for 2 strokes"):
        random_shooting(Quadratic(), 2, BOUNDS, 1, 0)
    with pytest.raises(ValueError, match=r"n_strokes: got 0"):
        random_shooting(Quadratic(), 0, BOUNDS, 1, 0)
    with pytest.raises(ValueError, match=r"bounds: got"):
        random_shooting(Quadratic(), 1, BOUNDS[::-1], 1, 0)


@pytest.fixture(scope="module")
def bar():
    return stroke_goal("bar", np.array([[0.1, 0.15, 0.2, 0.15], [0.15, 0.1, 0.15, 0.2]]))


@pytest.mark.wide
def test_many_plans_at_once_leave_what_the_simulator_leaves(bar):
    loss = sand_loss(bar.scene, bar.start, bar.goal)
    low, high = loss.bounds
    plans = low + np.random.default_rng(0).random((5, 2, 4)) * (high - low)
    plans[0] = bar.strokes
    maps = loss.maps(plans)
    for plan, after in zip(plans, maps, strict=True):
        np.testing.assert_allclose(after, rollout(bar.scene, bar.start, plan.astype(np.float32)).height[-1], atol=5e-7)
    np.testing.assert_allclose(loss(plans), ((maps - bar.goal) ** 2).sum((1, 2)), rtol=1e-5, atol=1e-12)
    assert loss(plans)[0] < 1e-10
    losses, once = loss.after(np.repeat(bar.start[None], 5, axis=0), plans[:, 0])
    np.testing.assert_allclose(losses, ((once - bar.goal) ** 2).sum((1, 2)), rtol=1e-5)


@pytest.mark.slow
@pytest.mark.long
def test_a_push_that_touches_its_window_is_pushed_again_on_the_whole_map(bar, monkeypatch):
    small = replace(bar.scene, window=Window((6, 6)))
    assert int(js.step_batch(small, bar.start[None], bar.strokes[:1]).outcome[0]) == Outcome.WINDOW_EDGE
    monkeypatch.setattr("jaxsand.interaction.batched.windows_for", lambda *_: [small])
    after = sand_loss(bar.scene, bar.start, bar.goal).maps(bar.strokes[None])[0]
    np.testing.assert_allclose(after, bar.goal, atol=5e-7)


@pytest.mark.wide
def test_a_plan_that_is_not_finite_is_infinitely_far(bar):
    loss = sand_loss(bar.scene, bar.start, bar.goal)
    assert np.isinf(loss(np.full((1, 2, 4), np.nan)))[0]


@pytest.mark.wide
def test_the_bench_writes_what_it_computes_and_does_not_compute_it_again(bar, tmp_path):
    methods = {"random shooting": random_shooting}
    rows = run_all(methods, [bar], (4, 16), (0, 1), tmp_path)
    assert [row["seed"] for row in rows] == [0, 1]
    for row in rows:
        assert row["calls"] == 16
        assert [at["budget"] for at in row["at"]] == [4, 16]
        assert row["at"][0]["l2_reduction"] <= row["at"][1]["l2_reduction"] == row["curve"][-1][1]
        assert row["curve"][-1][0] <= 16
    lines = (tmp_path / "strokes.jsonl").read_text().splitlines()
    assert [json.loads(line) for line in lines] == rows

    def never(*_):
        raise AssertionError

    assert run_all({"random shooting": never}, [bar], (4, 16), (0, 1), tmp_path) == rows
    (tmp_path / "strokes.jsonl").write_text("\n".join(lines)[:-300])
    assert [row["at"] for row in run_all(methods, [bar], (4, 16), (0, 1), tmp_path)] == [row["at"] for row in rows]
    assert [row["at"] for row in run_all({"random shooting": never}, [bar], (4, 16), (0, 1), tmp_path)] == [
        row["at"] for row in rows
    ]
    fewer = run_all({"random shooting": never}, [bar], (4,), (0,), tmp_path)[0]
    assert fewer["at"] == rows[0]["at"][:1]
    assert fewer["curve"][-1][0] <= 4
    line = reached(rows)[0]
    assert line["method"] == "random shooting"
    assert line["goals"] == 1
    assert line["reached_at_16"] in (0, 1)
    assert len(strokes_figure(rows, 0.8).axes) == 2


@pytest.mark.wide
def test_the_command_prints_writes_and_draws(bar, tmp_path, capsys, monkeypatch):
    def short(evaluate, n_strokes, bounds, budget, seed):
        return random_shooting(evaluate, n_strokes, bounds, min(budget, 16), seed)

    monkeypatch.setitem(strokebench.GOALS, "letters", lambda: [bar])
    monkeypatch.setattr(strokebench, "METHODS", {"random shooting": short})
    assert main(["bench", "strokes", "--out", str(tmp_path)]) == 0
    text = capsys.readouterr().out
    assert "reached at 4000" in text
    assert "random shooting" in text
    assert "bar" in text
    pictures = {"bench-strokes.png", "bench-strokes-found.png"}
    assert {path.name for path in tmp_path.iterdir()} == {"strokes.jsonl", "bench-strokes.json", *pictures}
    assert main(["bench", "strokes", "--out", str(tmp_path), "--seed", "1", "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    assert report["strokes"][0]["goals"] == 1
    assert [row["seed"] for row in report["strokes_curves"]] == [0, 1]
    assert report["strokes"][0]["seeds_at_4000"] == 2
    (tmp_path / "strokes.jsonl").write_text('{"a": 1}\n')
    for line, message in {
        "strokes --methods shooting": "methods: got 'shooting'; give some of random shooting",
        f"strokes --out {tmp_path}": "out: line 1 of ",
        "grad --calls 50": "calls: has an effect on bench strokes and bench tasks only; leave it out",
        "push --points 9": "points: has an effect on bench tools only; leave it out",
    }.items():
        assert main(["bench", *line.split()]) == 2
        assert message in capsys.readouterr().err


@pytest.mark.slow
@pytest.mark.long
def test_goals_of_other_kinds():
    turned = turned_letters("I", 90)[0]
    np.testing.assert_allclose(turned.strokes, [[0.265, 0.16, 0.055, 0.16]], atol=1e-9)
    rough = letters_on_rough_sand("I")[0]
    assert np.ptp(rough.start) == pytest.approx(0.01, rel=0.2)
    assert rough.iou(rough.goal) == 1
    assert rough.iou(rough.start) == 0
    some = many_strokes(3, 2)
    assert [goal.strokes.shape for goal in some] == [(3, 4), (3, 4)]
    assert np.all(np.hypot(*(some[0].strokes[:, 2:] - some[0].strokes[:, :2]).T) >= 0.0625)


def test_a_goal_of_another_shape_is_refused(bar):
    with pytest.raises(ValueError, match="start: got shape"):
        sand_loss(bar.scene, bar.start[:4], bar.goal)
