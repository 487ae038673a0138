"""The main job, on all letters."""

import string

import numpy as np
import pytest

from jaxsand.goals import letters, metrics, surfaces
from jaxsand.goals.metrics import volume_error
from jaxsand.planning import pipeline


def shape(target, before=None):
    return pipeline.shape(target, None if before is None else np.asarray(before))


@pytest.mark.parametrize("letter", "SAQ")
def test_a_letter_map_is_trenched(letter):
    dig, start = letters.letter_map(letter)
    result = shape(pipeline.map_target(dig, start, letter, pipeline.Layout()))
    assert result.figures["iou"] > 0.84  # a reversal is half a turn, which sweeps: A, with two of them, has 0.849
    assert result.figures["l2_reduction"] > 0.6
    assert result.figures["volume_error"] <= 1e-6
    assert 28 < result.figures["max_slope_deg"] < 29.1
    assert not result.lifted
    assert result.steps == len(result.strokes)
    assert len(result.frames) == len(result.tools) == result.steps + 2
    assert volume_error(result.before, result.after) <= 1e-6


@pytest.mark.parametrize("letter", string.ascii_uppercase)
def test_every_letter_runs(letter):
    dig, start = letters.letter_map(letter)
    result = shape(pipeline.map_target(dig, start, letter, pipeline.Layout()))
    assert result.figures["iou"] >= 0.7
    assert result.target.optimal
    own = shape(pipeline.glyph_target(letters.letter_strokes(letter), letter))
    assert own.figures["iou"] == own.figures["l2_reduction"] == 1
    assert own.figures["volume_error"] <= 1e-6


def test_a_glyph_pushed_by_its_own_strokes_is_its_goal():
    result = shape(pipeline.glyph_target(letters.letter_strokes("K"), "K"))
    assert result.figures["iou"] == 1
    assert result.figures["l2_reduction"] == 1
    assert result.lifted
    assert result.steps == 3
    assert np.allclose(result.strokes, metrics.place(letters.letter_strokes("K")))


@pytest.mark.slow
def test_a_picture_in_two_pieces_is_dug_in_two_strokes():
    picture = np.zeros((20, 40))
    picture[4:16, 4:10] = -1
    picture[4:16, 28:34] = -1
    result = shape(pipeline.image_target(picture, "two", pipeline.Layout(margin=6), 48))
    assert result.lifted
    assert len(result.target.paths) == 2
    assert result.figures["iou"] > 0.5


def test_a_rough_surface_is_settled_first():
    dig, start = letters.letter_map("L")
    target = pipeline.map_target(dig, start, "L", pipeline.Layout())
    land = surfaces.terrain_surface(target.scene.grid.shape, 0.006)
    assert np.ptp(land) == pytest.approx(0.006)
    result = shape(target, land)
    assert result.figures["iou"] > 0.5
    with pytest.raises(ValueError, match="goal: got shape"):
        shape(target, np.zeros((3, 3)))


def test_terrain_as_a_goal():
    layout = pipeline.Layout(depth=0.0075)
    result = shape(pipeline.height_target(surfaces.terrain_surface((48, 48), 0.03), "terrain", "terrain", layout))
    assert not result.target.drawn
    assert result.figures["l2_reduction"] == result.figures["l2_reduction_with_berms"]
    assert result.figures["iou"] > 0.3


def test_goals_that_cannot_be_dug():
    layout = pipeline.Layout()
    with pytest.raises(ValueError, match="nothing to dig"):
        pipeline.height_target(np.zeros((12, 12)), "heights", "flat", layout)
    with pytest.raises(ValueError, match="fewer than the 6"):
        pipeline.height_target(-np.ones((4, 12)), "heights", "small", layout)
    with pytest.raises(ValueError, match="1 cells that are not finite"):
        goal = -np.ones((12, 12))
        goal[8, 8] = np.inf
        pipeline.height_target(goal, "heights", "broken", layout)
