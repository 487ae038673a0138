"""The main job, on all letters."""

import string
import tracemalloc
from types import SimpleNamespace

import numpy as np
import pytest

import jaxsand as js
from jaxsand.goals import letters, metrics, surfaces
from jaxsand.goals.metrics import volume_error
from jaxsand.planning import pipeline, targets
from jaxsand.scene.scene import make_scene
from jaxsand.scene.tools import Blade

GLYPHS = make_scene((32, 32), 0.01, tool=Blade())


def shape(target, before=None):
    return pipeline.shape(target, None if before is None else np.asarray(before))


@pytest.mark.wide
@pytest.mark.parametrize("letter", ["A", *(pytest.param(letter, marks=pytest.mark.slow) for letter in "SQ")])
def test_a_letter_map_is_trenched(letter):
    dig, start = letters.letter_map(letter)
    result = shape(targets.map_target(dig, start, letter, targets.Layout()))
    assert result.figures["iou"] > 0.84  # a reversal is half a turn, which sweeps: A, with two of them, has 0.849
    assert result.figures["l2_reduction"] > 0.6
    assert result.figures["volume_error"] <= 1e-6
    assert 28 < result.figures["max_slope_deg"] < 29.1
    assert not result.lifted
    assert result.steps == len(result.strokes)
    assert len(result.frames) == len(result.tools) == result.steps + 2
    assert volume_error(result.before, result.after) <= 1e-6


LETTERS = [*"IT", *(pytest.param(a, marks=pytest.mark.slow) for a in "AKQSWZ")]


@pytest.mark.wide
@pytest.mark.parametrize("letter", LETTERS)
def test_letters_run(letter):
    """`jaxsand bench letters` takes all of them."""
    dig, start = letters.letter_map(letter)
    result = shape(targets.map_target(dig, start, letter, targets.Layout()))
    assert result.figures["iou"] >= 0.7
    assert result.target.optimal
    own = shape(pipeline.glyph_target(letters.letter_strokes(letter), letter))
    assert own.figures["iou"] == own.figures["l2_reduction"] == 1
    assert own.figures["volume_error"] <= 1e-6


@pytest.mark.parametrize("letter", string.ascii_uppercase)
def test_every_letter_is_planned(letter):
    dig, start = letters.letter_map(letter)
    assert targets.map_target(dig, start, letter, targets.Layout()).optimal


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
    layout = targets.Layout(margin=6)
    result = shape(targets.height_target(targets.image_goal(picture, layout, 48), "image", "two", layout))
    assert result.lifted
    assert len(result.target.paths) == 2
    assert result.figures["iou"] > 0.5


@pytest.mark.wide
def test_a_rough_surface_is_settled_first():
    dig, start = letters.letter_map("L")
    target = targets.map_target(dig, start, "L", targets.Layout())
    land = surfaces.terrain_surface(target.scene.grid.shape, 0.006)
    assert np.ptp(land) == pytest.approx(0.006)
    result = shape(target, land)
    assert result.figures["iou"] > 0.5
    with pytest.raises(ValueError, match="surface: got shape"):
        shape(target, np.zeros((3, 3)))


@pytest.mark.wide
def test_terrain_as_a_goal():
    layout = targets.Layout(depth=0.0075)
    result = shape(targets.height_target(surfaces.terrain_surface((48, 48), 0.03), "terrain", "terrain", layout))
    assert not result.target.drawn
    assert result.figures["l2_reduction"] == result.figures["l2_reduction_with_berms"]
    assert result.figures["iou"] > 0.3


def test_goals_that_cannot_be_dug():
    layout = targets.Layout()
    with pytest.raises(ValueError, match="nothing to dig"):
        targets.height_target(np.zeros((12, 12)), "heights", "flat", layout)
    with pytest.raises(ValueError, match="fewer than the 6"):
        targets.height_target(-np.ones((4, 12)), "heights", "small", layout)
    with pytest.raises(ValueError, match="1 cells that are not finite"):
        goal = -np.ones((12, 12))
        goal[8, 8] = np.inf
        targets.height_target(goal, "heights", "broken", layout)


def test_what_is_left_over_of_blocks_is_planned_too():
    goal = np.zeros((53, 53))
    goal[10:16, 6:46] = goal[48:53, 6:46] = -0.0075
    layout = targets.Layout(depth=0.0075)
    found = targets.height_target(goal, "heights", "two", layout)
    assert len(found.paths) == 2
    assert found.missed == 40  # the trench's first row lies in a block of which it is a sixth
    assert found.optimal is found.lower_bound is None
    for path, (low, high) in zip(sorted(found.paths, key=lambda p: p[0, 1]), ((0.10, 0.16), (0.48, 0.53)), strict=True):
        assert np.all((path[:, 1] > low) & (path[:, 1] < high))
    for side in range(6, 40):  # no path misses what lies at an edge, and the blade covers every block
        goal = np.zeros((side, 18))
        goal[-min(6, 2 * side // 3) :] = -0.0075
        (path,) = targets.height_target(goal, "heights", "edge", layout).paths
        reach = layout.oversize * layout.cell * layout.spacing / 2
        assert path[:, 1].max() + reach >= side * layout.spacing - 1e-9
        assert path[:, 1].max() < side * layout.spacing


def test_what_is_left_out_of_a_goal_is_counted_and_nothing_proven():
    """A trench half in each of two rows of blocks, and one of two cells, beside one that fills its blocks."""
    layout = targets.Layout(depth=0.0075)
    goal = np.zeros((48, 48))
    goal[6:12, 6:30] = -0.0075
    whole = targets.height_target(goal, "heights", "whole", layout)
    assert (whole.missed, whole.optimal, whole.lower_bound) == (0, True, 3)
    for second in (slice(27, 33), slice(26, 28)):
        more = goal.copy()
        more[second, 6:30] = -0.0075
        found = targets.height_target(more, "heights", "more", layout)
        passed = (second.stop - second.start) * 24
        assert (found.missed, found.optimal, found.lower_bound) == (passed, None, None)
        assert np.array_equal(found.paths[0], whole.paths[0])


def test_blocks_of_whole_cells_lie_as_ever():
    goal = np.zeros((24, 30))
    goal[6:12, 12:24] = -0.0075
    (path,) = targets.height_target(goal, "heights", "slot", targets.Layout(depth=0.0075)).paths
    assert np.allclose(path, [[0.15, 0.09], [0.21, 0.09]]) or np.allclose(path, [[0.21, 0.09], [0.15, 0.09]])


def test_a_recording_takes_no_more_memory_than_its_frames(monkeypatch):
    """One path of 96 legs beside forty of two: nothing of what a padded program records stays but the frames that are
    shown, and their number is bounded."""
    scene = make_scene((40, 40), 0.01, tool=Blade())
    to_and_fro = np.stack([0.1 + 0.1 * (np.arange(97) % 2), np.full(97, 0.2)], 1)
    target = targets.Target(
        "many", "heights", "plan", scene, np.zeros((40, 40)), (to_and_fro, *[to_and_fro[:3]] * 40), True, 0.0
    )

    monkeypatch.setattr(pipeline, "check", lambda _: None)  # what stands in for a push is no result

    def program(scene, points, _):
        def run(height, path):
            frames = np.zeros((points - 1, *height.shape), np.float32)
            return SimpleNamespace(height=np.asarray(height) + 1, outcome=np.zeros((), int)), frames

        return run, 0.0

    monkeypatch.setattr(pipeline, "_program", program)
    monkeypatch.setattr(pipeline, "_figures", lambda *_: {})
    for kept, most in ((pipeline._KEPT, 1 + 97 + 40 * 3), (80 * 40 * 40 * 4, 1 + 41 * 2 + 96 // 3 + 1 + 40)):
        monkeypatch.setattr(pipeline, "_KEPT", kept)
        tracemalloc.start()
        result = shape(target)
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        assert len(result.frames) == len(result.tools) <= most
        assert peak < 3 * result.frames.nbytes + 4 * 127 * result.frames[0].nbytes  # and not 41 * 127
        assert np.array_equal(result.tools[-2], [*to_and_fro[2], -1, 0])


def test_one_push_gives_a_strokes_result_and_its_recording(monkeypatch):
    stroke, level = [0.08, 0.1, 0.2, 0.16], np.zeros((32, 32), np.float32)
    target = targets.Target("one", "glyph", "strokes", GLYPHS, level, (np.reshape(stroke, (2, 2)),), False, 0.0075)
    usual, pushes = pipeline._program, []

    def program(scene, points, columns):
        run, seconds = usual(scene, points, columns)
        return lambda height, path: pushes.append(path) or run(height, path), seconds

    monkeypatch.setattr(pipeline, "_program", program)
    result = shape(target)
    assert len(pushes) == 1
    assert len(result.frames) == len(result.tools) == 8
    middle = result.tools[3, :2]
    assert np.hypot(*(middle - [0.14, 0.13])) <= js.SteppedPush().substep * 0.01 / 2 + 1e-9
    assert result.tools[3, 2:] == pytest.approx([2 / 5**0.5, 1 / 5**0.5])
    half = js.act(GLYPHS, level, [*stroke[:2], *middle]).height
    assert np.abs(result.frames[3] - half).max() < 1e-6
    assert np.abs(result.after - js.step(GLYPHS, level, stroke).height).max() < 1e-6
    assert np.array_equal(result.frames[-1], result.after)


def test_a_stroke_is_divided_at_whole_substeps():
    substep = js.SteppedPush().substep * 0.01
    for length in (0.3, 0.0707, 0.013, 0.003, 0.0005):
        stroke = np.array([[0.1, 0.1], [0.1 + 0.6 * length, 0.1 - 0.8 * length]])
        way = pipeline._divided(stroke, 0.01)
        assert np.array_equal(way[[0, -1]], stroke)
        assert 2 <= len(way) <= 7
        legs = np.hypot(*np.diff(way, axis=0).T)
        assert legs.min() > 0
        assert legs.sum() == pytest.approx(length)
        np.testing.assert_allclose(legs[:-1] / substep, np.round(legs[:-1] / substep), atol=1e-9)
        assert len(way) < 7 or legs.max() - legs.min() <= 2 * substep
    for path in (stroke[[0, 0]], np.array([[0.1, 0.1], [0.2, 0.1], [0.2, 0.2]])):
        assert pipeline._divided(path, 0.01) is path
