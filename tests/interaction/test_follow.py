"""Paths of legs without lifting: corners, reversals, the carried heap."""

from functools import partial

import jax
import numpy as np
import pytest

import jaxsand as js
from jaxsand.goals.metrics import volume_error
from jaxsand.interaction import simulate

from ..conftest import ANGLE

DX = 0.005
SHAPE = (64, 80)
SAND = js.make_scene(SHAPE, DX, ANGLE, tool=js.Blade(0.05, 0.02, 0.005))
LEVEL = np.zeros(SHAPE)
START, CORNER, END = (0.1, 0.1), (0.25, 0.1), (0.25, 0.22)


def stroked(start, stop, height=LEVEL):
    """One leg, of the program of two: the path's repeated end changes nothing."""
    return js.follow(SAND, height, [start, stop, stop])


@pytest.mark.wide
def test_two_points_are_a_stroke():
    assert np.array_equal(js.follow(SAND, LEVEL, [START, CORNER]).height, js.step(SAND, LEVEL, (*START, *CORNER)).height)


def test_a_point_on_the_way_changes_little_and_the_heap_goes_along():
    whole = stroked(START, CORNER)
    halves = js.follow(SAND, LEVEL, [START, (0.175, 0.1), CORNER])
    js.check(halves)
    # Only where a sub-step is cut in two.
    assert np.abs(halves.height - whole.height).max() < 0.02 * np.abs(whole.height).max()
    lifted = stroked((0.175, 0.1), CORNER, stroked(START, (0.175, 0.1)).height)
    assert np.abs(lifted.height - whole.height).max() > 0.1 * np.abs(whole.height).max()


@pytest.mark.wide
def test_legs_of_no_length_do_nothing():
    path = js.follow(SAND, LEVEL, [START, CORNER, END])
    padded = js.follow(SAND, LEVEL, [START, CORNER, CORNER, END, END, END])
    assert np.allclose(path.height, padded.height, atol=1e-12)
    assert (float(padded.pose.cos), float(padded.pose.sin)) == pytest.approx((0, 1))


def test_at_a_corner_the_blade_turns_in_place_and_leaves_its_heap():
    out = js.follow(SAND, LEVEL, [START, CORNER, END])
    js.check(out)
    h = np.asarray(out.height)
    assert (float(out.pose.x), float(out.pose.y)) == pytest.approx(END)
    assert volume_error(LEVEL, h) < 1e-12

    def at(x, y):
        return h[int(y / DX), int(x / DX)]

    assert at(0.17, 0.1) == pytest.approx(-0.005, rel=0.05)
    assert at(0.25, 0.17) == pytest.approx(-0.005, rel=0.05)
    assert at(0.285, 0.1) > 0.002  # the heap of the first leg, left beyond the corner
    assert at(0.25, 0.245) > 0.002  # the heap of the second


def test_at_a_reversal_the_heap_stays_behind_and_the_trench_is_cleaned():
    out = js.follow(SAND, LEVEL, [START, CORNER, START])
    once = stroked(START, CORNER)
    h = np.asarray(out.height)
    row = int(0.1 / DX)
    assert h[row, int(0.28 / DX)] == pytest.approx(float(once.height[row, int(0.28 / DX)]), abs=1e-3)
    assert h[row, int(0.075 / DX)] > 0.001  # what the way back pushed out at the start
    middle = np.s_[:, int(0.13 / DX) : int(0.22 / DX)]
    assert np.minimum(h[middle], 0).sum() < 1.01 * np.minimum(np.asarray(once.height)[middle], 0).sum()
    assert float(out.pose.cos) == pytest.approx(-1)


def test_a_turn_is_the_same_to_the_left_and_to_the_right():
    y = SHAPE[0] * DX
    left = js.follow(SAND, LEVEL, [(0.1, y / 2), (0.2, y / 2), (0.2, y / 2 + 0.08)]).height
    right = js.follow(SAND, LEVEL, [(0.1, y / 2), (0.2, y / 2), (0.2, y / 2 - 0.08)]).height
    assert np.allclose(left, np.flipud(right), atol=1e-9)


@pytest.mark.wide
def test_frames_are_the_maps_after_each_leg():
    path = np.array([START, CORNER, END])
    out, frames = js.follow_frames(SAND, LEVEL, path)
    assert frames.shape == (2, *SHAPE)
    assert np.array_equal(out.height, js.follow(SAND, LEVEL, path).height)
    assert np.allclose(frames[0], js.act(SAND, LEVEL, (*START, *CORNER)).height, atol=1e-12)
    assert np.array_equal(js.settle(SAND, frames[1]).height, out.height)
    bare, still = js.follow_frames(js.make_scene(SHAPE, DX), LEVEL, path)
    assert np.array_equal(still, np.stack([LEVEL, LEVEL]))
    assert np.array_equal(bare.height, LEVEL)


@pytest.mark.wide
def test_paths_may_be_batched():
    paths = np.array([[START, CORNER, END], [START, END, CORNER]])
    many = jax.vmap(lambda p: js.follow(SAND, LEVEL, p).height)(paths)
    for path, h in zip(paths, many, strict=True):
        assert np.allclose(js.follow(SAND, LEVEL, path).height, h, atol=1e-9)


def test_a_rollout_is_steps_one_after_the_other():
    strokes = np.array([(*START, *CORNER), (*CORNER, *END)])
    out = js.rollout(SAND, LEVEL, strokes)
    first = js.step(SAND, LEVEL, strokes[0])
    assert np.allclose(out.height[0], first.height, atol=1e-12)
    assert np.allclose(out.height[1], js.step(SAND, first.height, strokes[1]).height, atol=1e-9)
    assert out.sweeps.shape == (2,)


def test_a_rollout_of_no_strokes_has_no_maps():
    for side in (16, 32):
        level, none = np.zeros((side, side)), np.zeros((0, 4))
        bed = js.make_scene(level.shape, 0.01, tool=js.Blade())
        assert js.rollout(bed, level, none).height.shape == (0, side, side)
        assert jax.jit(partial(js.rollout, bed))(level, none).height.shape == (0, side, side)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda h, s: js.step(None, h, s), "scene: got NoneType; give make_scene"),
        (lambda h, s: js.settle(None, h), "scene: got NoneType; give make_scene"),
        (lambda h, s: js.check(h), "result: got ndarray; give what"),
    ],
)
def test_what_is_no_scene_and_no_result_is_named(call, message):
    with pytest.raises(ValueError, match=message):
        call(np.zeros((8, 8)), np.zeros(4))


def test_schemes_that_depend_on_where_the_map_begins_settle_the_whole_map():
    """As of `settle`, which refuses a window for them: pairs and blocks of cells would lie otherwise in it."""
    scene = js.make_scene((200, 200), 0.01, ANGLE, tool=js.Blade())
    part = next(simulate.windows_for(scene, js.SteppedPush()))
    path = np.array([[0.98, 1.0], [1.06, 1.02]])
    assert isinstance(simulate._settling_window(part, path, js.SuperTimeStepping()), js.Window)
    for scheme in (js.Pairwise(), js.Multilevel()):
        assert isinstance(simulate._settling_window(part, path, scheme), js.Whole)
