"""Optimising strokes: what prints are, what is counted, and goals whose strokes are known."""

import json

import jax
import numpy as np
import pytest

import jaxsand as js
from jaxsand.__main__ import main
from jaxsand.bench.stroke_goals import letters, many_strokes, stroke_goal
from jaxsand.planning.gradient import as_many_as_pay, print_of, search
from jaxsand.planning.gradient.account import Account
from jaxsand.planning.gradient.moves import Plans, reordered
from jaxsand.planning.gradient.sketch import guesses, printed, prints
from jaxsand.planning.stroke_loss import GRADIENT, sand_loss


@pytest.fixture(scope="module")
def bar():
    return stroke_goal("bar", np.array([[0.083, 0.117, 0.212, 0.171]]))


@pytest.fixture(scope="module")
def short():
    """On a quarter of the map."""
    return stroke_goal(
        "short", np.array([[0.047, 0.068, 0.108, 0.091]]), scene=js.make_scene((16, 16), 0.01, tool=js.Blade())
    )


@pytest.fixture(scope="module")
def tee():
    return letters("T")[0]


def account(goal, budget):
    return Account(sand_loss(goal.scene, goal.start, goal.goal), budget)


@pytest.mark.wide
def test_a_print_is_its_stroke_wherever_it_is_moved(bar):
    counted = account(bar, 100)
    mark = print_of(counted)
    assert counted.calls == 1
    stroke = np.array([8.0, 16.5, 24.0, 16.5])
    moved = stroke + np.array([2, -3, 2, -3])
    rolled = prints(mark, moved, (32, 32))
    pushed = js.step(bar.scene, np.zeros((32, 32), np.float32), np.float32(0.01 * moved)).height
    assert np.allclose(rolled, pushed, atol=2e-6)
    turned = prints(mark, np.array([16.5, 8.0, 16.5, 24.0]), (32, 32))
    assert np.allclose(turned, np.asarray(prints(mark, stroke, (32, 32))).T, atol=1e-7)
    longer = np.asarray(prints(mark, np.array([6.0, 16.5, 26.0, 16.5]), (32, 32)))
    assert np.allclose(longer[:, :14], np.roll(pushed, (3, -4), (0, 1))[:, :14], atol=2e-6)  # the same beginning, and end
    assert np.allclose(longer[:, 20:], np.roll(pushed, (3, 0), (0, 1))[:, 20:], atol=2e-6)


@pytest.mark.wide
def test_the_sketch_of_one_stroke_is_within_a_quarter_of_a_cell(bar):
    mark = print_of(account(bar, 1))
    plans, left = guesses(mark, bar.start, bar.goal, 1, np.random.default_rng(0))
    assert np.abs(plans[0, 0] * 0.01 - bar.strokes[0]).max() < 0.0025
    assert left[0] < 0.3
    assert np.all(np.diff(left) >= 0)


@pytest.mark.wide
def test_where_strokes_cross_prints_one_after_the_other_come_closer_than_their_sum():
    ends = []
    for crossed in many_strokes(goals=3):
        mark, cells = print_of(account(crossed, 1)), crossed.strokes / 0.01
        each = prints(mark, cells, (32, 32))
        laid = printed(mark, cells, crossed.start)
        assert float(laid.min()) >= float(each.min()) - 1e-9  # no deeper than the blade
        ends.append([float(((np.asarray(h) - crossed.goal) ** 2).sum()) for h in (laid, each.sum(0))])
    ours, summed = np.sum(ends, axis=0)
    assert ours < 0.75 * summed


@pytest.mark.slow
def test_gradients_are_those_of_the_losses_and_are_counted(tee):
    counted = account(tee, 1000)
    plan = tee.strokes[None] + 1e-3 * np.random.default_rng(0).standard_normal((1, 2, 4))
    loss, slope = counted.gradient(plan, 0.0)
    assert counted.calls == 2 * (1 + GRADIENT)
    assert counted.losses(plan)[0] == pytest.approx(loss[0], rel=1e-5)
    assert counted.calls == 2 * (2 + GRADIENT)
    along = slope / np.linalg.norm(slope)
    far = counted.sand(np.concatenate([plan + e * along for e in (-1e-5, 1e-5)]))
    assert (far[1] - far[0]) / 2e-5 == pytest.approx(np.linalg.norm(slope), rel=0.02)
    soft = counted.gradient(plan, 1.0)[1]
    assert np.sum(soft * slope) > 0.3 * np.linalg.norm(soft) * np.linalg.norm(slope)


def test_a_plan_in_the_wrong_order_and_direction_is_put_right(tee):
    counted = account(tee, 1000)
    wrong = tee.strokes[::-1].copy()
    wrong[0] = wrong[0, [2, 3, 0, 1]]
    found = reordered(counted, Plans(wrong[None], counted.losses(wrong[None])))
    assert found.losses[0] < 1e-4 * counted.before
    assert np.allclose(found.strokes[0], tee.strokes) or found.losses[0] == 0


@pytest.mark.wide
def test_a_stroke_is_found_within_the_budget_and_again_by_the_same_key(short):
    found, again = (
        js.optimise_strokes(short.scene, short.goal, strokes=1, key=k, budget=100) for k in (3, jax.random.key(3))
    )
    assert found.strokes.shape == (1, 4)
    assert short.iou(found.height) >= 0.8
    assert found.losses[-1] < 0.02 * found.losses[0]
    assert np.all(np.diff(found.losses) < 0)
    assert np.all(np.diff(found.calls) > 0)
    assert found.calls[-1] <= found.spent <= 100
    assert np.array_equal(again.strokes, found.strokes)


@pytest.mark.slow
def test_a_letter_is_found_within_the_budget_and_again_by_the_same_key(tee):
    found = js.optimise_strokes(tee.scene, tee.goal, strokes=2, key=3, budget=300)
    assert found.strokes.shape == (2, 4)
    assert tee.iou(found.height) >= 0.8
    assert found.losses[-1] < 0.02 * found.losses[0]
    assert np.all(np.diff(found.losses) < 0)
    assert np.all(np.diff(found.calls) > 0)
    assert found.calls[-1] <= found.spent <= 300
    key = jax.random.key(3)
    one, other = (js.optimise_strokes(tee.scene, tee.goal, strokes=2, key=key, budget=50) for _ in range(2))
    assert len(one.strokes) == 2
    assert np.array_equal(one.strokes, other.strokes)


@pytest.mark.wide
@pytest.mark.parametrize("name", ["short", pytest.param("tee", marks=pytest.mark.slow)])
def test_the_number_of_strokes_is_found(name, request):
    goal = request.getfixturevalue(name)
    counted = account(goal, 100)
    assert as_many_as_pay(counted, print_of(counted), 5, np.random.default_rng(0)) == len(goal.strokes)


@pytest.mark.wide
@pytest.mark.parametrize("strokes", [1, pytest.param(None, marks=pytest.mark.slow)])
def test_strokes_that_would_make_it_worse_are_not_given(short, strokes):
    bump = np.zeros((16, 16), np.float32)
    bump[4:8, 4:8] = 5e-4
    found = js.optimise_strokes(short.scene, bump, strokes=strokes, budget=40)
    assert found.strokes.shape == (0, 4)
    assert found.losses.tolist() == [pytest.approx(16 * 5e-4**2)]
    assert not found.height.any()
    assert "the goal has 8e-07 m^3 more sand than the map" in found.reason
    assert 0 < found.spent <= 40


@pytest.mark.wide
def test_smoothing_can_be_left_out_and_changed(short):
    def blurs(smoothing):
        counted, seen = account(short, 400), []
        take = counted.gradient

        def noted(plans, blur):
            seen.append(blur)
            return take(plans, blur)

        counted.gradient = noted
        search(counted, 1, np.random.default_rng(0), smoothing=smoothing)
        return seen

    assert set(blurs(None)) == {0.0}
    assert blurs(js.Blurred((2.0, 1.0)))[:12] == [2.0] * 6 + [1.0] * 6
    with pytest.raises(ValueError, match=r"smoothing.cells: got \(0.0,\)"):
        js.Blurred((0.0,))


def test_what_is_refused(bar):
    for kwargs, message in [
        ({"goal": np.zeros((3, 3))}, r"goal: got shape \[3, 3\]"),
        ({"strokes": 0}, "strokes: got 0"),
        ({"budget": 0}, "budget: got 0"),
        ({"start": np.zeros((3, 3))}, r"start: got shape \[3, 3\]"),
        ({"start": np.full((32, 32), np.nan)}, "start: got 1024 cells that are not finite"),
        ({"key": 3.5}, "key: got 3.5"),
        ({"key": -1}, "key: got -1"),
        ({"key": None}, "key: got None"),
        ({"scene": js.make_scene((32, 32), 0.01)}, "scene.tool: got NoTool"),
    ]:
        with pytest.raises(ValueError, match=message):
            js.optimise_strokes(**({"scene": bar.scene, "goal": bar.goal} | kwargs))


def test_a_guess_without_the_calls_to_push_it_is_not_given(bar):
    for budget in (1, 2):
        found = js.optimise_strokes(bar.scene, bar.goal, guess=[[0.1, 0.1, 0.2, 0.1]] * 2, budget=budget)
        assert found.strokes.shape == (0, 4)
        assert found.spent <= budget


def test_a_goal_that_is_the_start_takes_no_strokes(bar):
    found = js.optimise_strokes(bar.scene, np.zeros((32, 32)), strokes=1, budget=30)
    assert found.strokes.shape == (0, 4)
    assert found.spent == 0
    assert not found.height.any()


@pytest.mark.slow
def test_the_command_shapes_a_letter(tmp_path, capsys):
    assert main(["shape", "I", "--method", "optimise", "--pushes", "120", "--json", "--out", str(tmp_path)]) == 0
    report = json.loads(capsys.readouterr().out)
    assert report["method"] == "optimise"
    assert report["goal_kind"] == "glyph"
    assert report["steps"] == 1
    assert report["iou"] >= 0.8
    assert report["search"]["rollouts"] <= 120
    assert main(["shape", "map.txt", "--method", "optimise"]) == 2
