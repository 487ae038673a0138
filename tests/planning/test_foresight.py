"""What a stroke is foreseen to leave: known answers, symmetry, and the order of strokes against true pushes."""

import numpy as np
import pytest
from scipy.stats import spearmanr

import jaxsand as js
from jaxsand.goals.goal import as_goal
from jaxsand.planning.search.actions import Job
from jaxsand.planning.search.foresight import foreseen
from jaxsand.planning.search.proposals import propose_heights
from jaxsand.planning.search.rollouts import pushed

SCENE = js.make_scene((24, 32), 0.01, tool=js.Blade(width=0.08, thickness=0.02, depth=0.0))
LEVEL = np.zeros((24, 32), np.float32)
X, Y = np.meshgrid((np.arange(32) + 0.5) * 0.01, (np.arange(24) + 0.5) * 0.01)
MU = np.tan(np.radians(29))


def left(height, *strokes):
    return foreseen(SCENE, height, np.array(strokes))


def test_a_level_cut_is_as_deep_as_it_was_told_and_moves_its_sand_to_berms_and_a_heap():
    (after,) = left(LEVEL, [0.06, 0.12, -0.004, 0.2, 0.12, -0.004])
    floor = (abs(Y - 0.12) < 0.035) & (X > 0.06) & (X < 0.2)
    np.testing.assert_allclose(after[floor], -0.004, atol=1e-6)
    assert abs(after.sum()) < 0.1 * -after[after < 0].sum()  # nothing is lost but roundings of the berms to cells
    wedge = np.argmax(after[12])
    assert 0.21 <= X[12, wedge] <= 0.23  # the heap in front of the blade
    np.testing.assert_allclose(np.diff(after[12, wedge : wedge + 3]), -MU * 0.01, rtol=1e-3)
    np.testing.assert_allclose(after, after[::-1], atol=1e-6)


def test_a_ditch_on_the_way_is_filled_by_what_is_carried_and_no_higher_than_the_blade():
    ditch = np.where((X > 0.14) & (X < 0.17), -0.003, 0.0).astype(np.float32)
    (after,) = left(ditch, [0.04, 0.12, -0.003, 0.24, 0.12, 0.0])
    middle = after[8:16, (X[0] > 0.06) & (X[0] < 0.23)]
    bottom = -0.003 * (0.24 - X[0, (X[0] > 0.06) & (X[0] < 0.23)]) / 0.2
    np.testing.assert_allclose(middle[2:6], np.broadcast_to(bottom, (4, len(bottom))), atol=2e-4)


def test_a_stroke_above_the_sand_leaves_it():
    np.testing.assert_array_equal(left(LEVEL, [0.06, 0.12, 0.004, 0.2, 0.12, 0.001])[0], LEVEL)


def test_turned_maps_and_strokes_and_batches_of_maps():
    rough = np.random.default_rng(0).normal(0, 0.002, (24, 32)).astype(np.float32)
    stroke = [0.06, 0.1, -0.003, 0.21, 0.17, 0.001]
    turned = [0.24 - 0.1, 0.06, -0.003, 0.24 - 0.17, 0.21, 0.001]
    (after,) = left(rough, stroke)
    (other,) = left(np.rot90(rough, -1).copy(), turned)
    np.testing.assert_allclose(np.rot90(other), after, atol=1e-6)
    both = left(np.stack([rough, LEVEL]), stroke, stroke)
    np.testing.assert_array_equal(both[0], after)
    np.testing.assert_array_equal(both[1], left(LEVEL, stroke)[0])


@pytest.mark.slow
@pytest.mark.parametrize("name", ["level", "ramp", "rectangle", "v-trench", "foundation"])
def test_the_order_of_strokes_agrees_with_true_pushes(name):
    task = js.tasks.make_task(name, 0)
    goal, start = as_goal(task.scene, task.goal), task.start.astype(np.float32)
    strokes = propose_heights(Job(task.scene, start, goal, 1, js.Rising()), start, 256, np.random.default_rng(0))
    true = pushed(task.scene, np.repeat(start[None], 256, axis=0), strokes)
    costs = [goal.cost(maps.astype(float)) for maps in (true, foreseen(task.scene, start, strokes))]
    clean = np.isfinite(costs[0])
    assert spearmanr(costs[0][clean], costs[1][clean])[0] > 0.7
    assert costs[0][clean][np.argsort(costs[1][clean])[:8]].min() <= np.sort(costs[0][clean])[2]
