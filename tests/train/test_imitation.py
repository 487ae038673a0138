"""What hindsight teaches is true: the strokes that a lesson calls due lead from its sand to its goal."""

import jax
import numpy as np
import pytest

from jaxsand.goals.metrics import GLYPH_SQUARE
from jaxsand.goals.usual import SHAPE, SPACING, usual_scene
from jaxsand.planning.stroke_loss import pushed
from jaxsand.relaxation.settling import steepest_slope
from train.imitation.hindsight import Hindsight, _labels, _pairs, _turned
from train.imitation.lessons import lessons
from train.imitation.plans import MOST, anywhere, random_plans
from train.imitation.sand import other_scene, starts

SCENE = usual_scene()


def rng(seed=0):
    return np.random.default_rng(seed)


def led_to(scene, current, due, counts):
    """The maps that strokes due leave, in their order."""
    maps = current
    for k in range(MOST):
        if counts[:, k].any():
            maps = np.where(counts[:, k, None, None], pushed(scene, maps, due[:, k]), maps)
    return maps


def test_plans_fill_the_square_with_strokes_of_some_length():
    strokes, numbers = random_plans(rng(), 500)
    assert strokes.shape == (500, MOST, 4)
    assert set(numbers) == set(range(1, MOST + 1))
    side = GLYPH_SQUARE[1] - GLYPH_SQUARE[0]
    assert strokes.min() >= GLYPH_SQUARE[0] - 0.05 * side
    assert strokes.max() <= GLYPH_SQUARE[1] + 0.05 * side
    assert np.mean(np.hypot(*(strokes[..., 2:] - strokes[..., :2]).T) >= 0.15 * side) > 0.999
    again, _ = random_plans(rng(), 500)
    np.testing.assert_array_equal(strokes, again)


def test_plans_are_moved_over_the_whole_map():
    strokes, _ = random_plans(rng(), 2000)
    moved = anywhere(rng(1), strokes)
    same = np.all(moved == strokes, axis=(1, 2))
    assert 0.4 < same.mean() < 0.6
    assert 0 < moved.min() < 0.02
    assert 0.3 < moved.max() < 0.32
    old, new = (x[~same] for x in (strokes, moved))
    scale = np.ptp(new[..., ::2], (1, 2)) / np.ptp(old[..., ::2], (1, 2))
    assert 0.6 <= scale.min() < 0.65
    assert 1.05 < scale.max() <= 1.1 + 1e-9
    np.testing.assert_allclose(np.ptp(new[..., 1::2], (1, 2)) / np.ptp(old[..., 1::2], (1, 2)), scale)


@pytest.mark.wide
def test_strokes_due_lead_to_the_goal():
    start = starts(SCENE, rng(1), 8, rough=0.5)
    lesson = lessons(SCENE, rng(), 8, start)
    numbers = lesson.counts[:8].sum(1)
    np.testing.assert_array_equal(lesson.current[:8], start)
    after = led_to(SCENE, lesson.current, lesson.due, lesson.counts)
    far = ((lesson.current - lesson.goal) ** 2).sum((1, 2))
    left = ((after - lesson.goal) ** 2).sum((1, 2)) / far
    first = numbers.sum()  # the way that made the goals; the other way is a little wrong
    assert np.all(left[:first] <= 1e-6)
    assert first < len(left)
    assert np.median(left[first:]) < 0.7


def test_its_own_way_leaves_what_it_did_not_do():
    generator = rng()
    strokes, numbers = random_plans(generator, 6)
    strokes = anywhere(generator, strokes)
    level = np.zeros((6, SHAPE[0], SHAPE[0]), np.float32)
    goals = lessons(SCENE, rng(), 6, level).goal[:6]

    def last(goal, current):
        """The last stroke of each plan, whatever was done: the second time astray, or mistaken for one nearby."""
        which = [int(np.argmin(((goals - g) ** 2).sum((1, 2)))) for g in goal]
        return np.stack([strokes[k, numbers[k] - 1] for k in which])

    lesson = lessons(SCENE, rng(), 6, level, last)
    own = [k for k in range(len(lesson.goal)) if k >= numbers.sum() and lesson.current[k].any()]
    several = [k for k in range(6) if numbers[k] > 1]
    assert len(own) >= len(several) > 2
    for k, plan in zip(own, several, strict=False):  # after one stroke
        np.testing.assert_array_equal(lesson.goal[k], goals[plan])
        due = lesson.due[k][lesson.counts[k]]
        others = strokes[plan, : numbers[plan] - 1].astype(np.float32)
        np.testing.assert_array_equal(due[np.lexsort(due.T)], others[np.lexsort(others.T)])


def test_turned_lessons_are_as_true():
    lesson = lessons(SCENE, rng(), 4, np.zeros((4, SHAPE[0], SHAPE[0]), np.float32))
    depth = float(SCENE.tool.depth)
    goal, current, due, counts = _turned(lesson, np.arange(4), rng(5), depth)
    assert not np.allclose(goal, lesson.goal[:4] / depth)
    after = led_to(SCENE, current * depth, due.reshape(4, -1, 4) * SPACING, counts)
    np.testing.assert_allclose(after, goal * depth, atol=2e-6)


def test_pairs_are_labelled_by_the_strokes_due():
    due = np.array([[[[4, 4], [20, 4]], [[9, 9], [9, 25]]]], np.float32)
    pairs = _pairs(jax.random.key(0), due)
    for counts, own in ((np.array([[True, True]]), [1, 1]), (np.array([[True, False]]), [1, 0])):
        label = _labels(pairs, due, counts)
        np.testing.assert_array_equal(label.due[0, :2], own)
        np.testing.assert_array_equal(label.due[0, 2:4], [0, 0])  # turned round they are none
        assert np.all(np.asarray(label.clear[0, :4]) == 1)
    near = pairs[0, 10:]  # moved ones
    off = np.abs(near[:, None] - due.reshape(1, 2, 4)).max(-1)
    label = _labels(pairs, due, np.array([[True, True]]))
    np.testing.assert_array_equal(label.due[0, 10:], off.min(1) <= 1)
    np.testing.assert_array_equal(label.strokes[0, 10:], due.reshape(2, 4)[off.argmin(1)])


def test_sand_to_practise_on_is_at_rest_and_varied():
    scene = other_scene(rng(3))
    assert scene.grid.shape == SHAPE
    maps = starts(scene, rng(4), 16, rough=0.5)
    rough = np.ptp(maps, axis=(1, 2)) > 0
    assert 3 <= rough.sum() <= 13
    assert np.ptp(maps) < 0.016
    angle = float(scene.material.repose_angle)
    assert max(float(steepest_slope(scene, m)) for m in maps) <= np.tan(angle) + 2e-3
    assert float(other_scene(rng(5)).tool.depth) != float(scene.tool.depth)


@pytest.mark.slow
def test_a_small_network_learns():
    learner = Hindsight(plans=48, batch=32, widths=(16, 16, 16), blocks=(1, 1, 1), own=3)
    state, losses = learner.init(0), []
    for _ in range(8):
        before = state
        state, metrics = learner.advance(state)
        losses.append(metrics["loss"])
    assert losses[-1] < losses[0] - 1.5
    again, _ = learner.advance(before)
    for a, b in zip(jax.tree.leaves(state), jax.tree.leaves(again), strict=True):
        np.testing.assert_array_equal(a, b)
