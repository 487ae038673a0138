"""Masked arrays: what lies under a mask is no height."""

import numpy as np
import pytest

import jaxsand as js
from jaxsand.envs import map_pool
from jaxsand.goals.letters import stroke_list
from jaxsand.goals.metrics import resample, volume_error
from jaxsand.scene.masked import gaps

MASKED = np.ma.masked_equal(np.array([[0.0, -9999.0], [0.0, 0.0]]), -9999)
PLAIN, BLADED = js.make_scene((2, 2), 0.01), js.make_scene((2, 2), 0.01, tool=js.Blade())
LEVEL = np.zeros((2, 2))
OF_POINTS = "got 1 masked cells; give every coordinate, and leave out a stroke"
OF_DIG = "got 1 masked cells; say of each whether to dig it"
OF_MASKED = {
    "settle": (lambda: js.settle(PLAIN, MASKED), "height: got 1 masked cells; fill them first .*Walls"),
    "settle_batch": (lambda: js.settle_batch(PLAIN, MASKED[None]), "height: got 1 masked cells"),
    "settle_batch of several": (lambda: js.settle_batch(PLAIN, [MASKED, LEVEL]), "height: got 1 masked cells"),
    "step": (lambda: js.step(PLAIN, MASKED, [0, 0, 1, 1]), "height: got 1 masked cells"),
    "a stroke": (lambda: js.step(PLAIN, LEVEL, np.ma.masked_equal([0.0, 0, 1, 2], 2)), f"stroke: {OF_POINTS}"),
    "strokes": (lambda: js.rollout(PLAIN, LEVEL, np.ma.masked_equal([[0.0, 0, 1, 2]], 2)), f"strokes: {OF_POINTS}"),
    "strokes of a batch": (
        lambda: js.step_batch(PLAIN, LEVEL[None], np.ma.masked_equal([[0.0, 0, 1, 2]], 2)),
        f"stroke: {OF_POINTS}",
    ),
    "a stroke of a trial": (
        lambda: js.calibrate(BLADED, js.Trial(LEVEL, LEVEL, np.ma.masked_equal([0.0, 0, 1, 2], 2))),
        f"stroke: {OF_POINTS}",
    ),
    "a guess": (
        lambda: js.optimise_strokes(BLADED, LEVEL + 1, guess=np.ma.masked_equal([[0.0, 0, 1, 2]], 2)),
        f"guess: {OF_POINTS}",
    ),
    "a path": (lambda: js.follow(PLAIN, LEVEL, MASKED), f"path: {OF_POINTS}"),
    "volume": (lambda: js.volume(PLAIN, MASKED), "height: got 1 masked cells"),
    "walls": (lambda: js.make_scene((2, 2), 0.01, walls=js.Walls(MASKED == 0)), "walls.solid: got 1 masked cells; say of"),
    "angles": (lambda: js.make_scene((2, 2), 0.01, MASKED + 0.5), "repose_angle: got 1 masked cells; give every cell an"),
    "volume_error": (lambda: volume_error(LEVEL, MASKED), "after: got 1 masked cells"),
    "resample": (lambda: resample(MASKED, (1, 1)), "image: got 1 cells that are not finite"),
    "plan": (lambda: js.plan(np.ma.masked_array([[True, True]], [[False, True]])), f"map: {OF_DIG}"),
    "where a plan starts": (
        lambda: js.plan(np.ones((2, 2), bool), start=np.ma.masked_equal([0, 1], 1)),
        r"start: got 1 masked cells; give \(row, column\)",
    ),
    "map_pool": (lambda: map_pool([np.ma.masked_array([[True, True]], [[False, True]])]), f"maps: {OF_DIG}"),
    "starts": (
        lambda: js.make("multi-stroke", goals=LEVEL, starts=MASKED, scene=BLADED),
        "starts: got 1 cells that are not finite; fill them",
    ),
    "start": (lambda: js.optimise_strokes(BLADED, LEVEL, start=MASKED), "start: got 1 masked cells"),
    "before": (lambda: js.calibrate(BLADED, js.Trial(MASKED, LEVEL)), "before: got 1 masked cells"),
    "regions": (
        lambda: js.calibrate(BLADED, js.Trial(LEVEL, LEVEL), regions=MASKED.astype(int)),
        "regions: got 1 masked cells; give",
    ),
    "glyph": (lambda: stroke_list("goals", "x", np.ma.masked_equal([[0.0, 0, 1, 2]], 2)), f"goals: {OF_POINTS}"),
}


@pytest.mark.parametrize("name", OF_MASKED)
def test_what_lies_under_a_mask_is_never_used(name):
    run, message = OF_MASKED[name]
    with pytest.raises(ValueError, match=f"^{message}"):
        run()


def test_masked_arrays_without_a_masked_cell_are_arrays():
    whole = np.ma.masked_equal(np.zeros((2, 2)), -9999)
    assert np.array_equal(js.settle(PLAIN, whole).height, np.zeros((2, 2)))
    assert type(gaps(whole)) is np.ndarray


def test_gaps_are_nan():
    several = gaps([MASKED, LEVEL])
    assert np.array_equal(np.isnan(several), [np.ma.getmaskarray(MASKED), LEVEL != 0])
    assert gaps(MASKED.astype(np.float32)).dtype == np.float32
    assert np.array_equal(gaps(MASKED.astype(int)), [[0, np.nan], [0, 0]], equal_nan=True)
