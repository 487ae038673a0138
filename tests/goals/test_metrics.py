"""When a glyph counts as right: known answers, and what the rule is to tell apart."""

import numpy as np
import pytest

from jaxsand.bench.stroke_goals import letters
from jaxsand.goals.success import right, strict, strokes_right
from jaxsand.planning.stroke_loss import sand_loss
from jaxsand.scene.tools import Blade

DEPTH = float(Blade().depth)


@pytest.fixture(scope="module")
def letter():
    """An E, of four strokes."""
    return letters("E")[0]


def left(letter, strokes):
    return sand_loss(letter.scene, letter.start, letter.goal).maps(np.asarray(strokes, np.float32)[None])[0]


def test_the_goal_itself_is_right_and_strict_and_level_sand_is_not(letter):
    assert right(letter.goal, letter.goal, DEPTH)
    assert strict(letter.goal, letter.start, letter.goal, DEPTH)
    assert not right(letter.goal, letter.start, DEPTH)
    assert not strict(letter.goal, letter.start, letter.start, DEPTH)
    assert right(letter.start, letter.start, DEPTH)  # nothing was asked for, and nothing was dug


@pytest.mark.wide
def test_one_stroke_less_or_another_one_is_wrong_and_a_small_shift_is_right_but_not_strict(letter):
    assert not right(letter.goal, left(letter, letter.strokes[:-1]), DEPTH)
    assert not right(letter.goal, left(letter, [*letter.strokes[:-1], [0.06, 0.06, 0.26, 0.26]]), DEPTH)
    shifted = left(letter, letter.strokes + np.array([0.005, 0, 0.005, 0]))
    assert right(letter.goal, shifted, DEPTH)
    assert not strict(letter.goal, letter.start, shifted, DEPTH)


def test_cells_count_within_one_cell_by_eight_neighbours():
    goal, off = np.zeros((9, 9)), np.zeros((9, 9))
    goal[4, 2:7] = -DEPTH
    off[5, 3:8] = -DEPTH  # one cell to the side and one on
    assert right(goal, off, DEPTH)
    off = np.roll(off, 1, 0)
    assert not right(goal, off, DEPTH)


def test_strokes_count_in_either_direction_each_push_once():
    strokes = np.array([[0.1, 0.1, 0.2, 0.1], [0.1, 0.1, 0.2, 0.1], [0.1, 0.2, 0.2, 0.2]])
    pushes = np.array([[0.2, 0.1, 0.1, 0.1], [0.1, 0.2, 0.2, 0.2299]])
    assert strokes_right(strokes, pushes) == 2  # one of the two like ones has no push left; 3 cm are 12% of 25 cm
    assert strokes_right(strokes[2:], pushes + 0.001) == 0
    assert strokes_right(strokes, np.zeros((0, 4))) == 0
    assert strokes_right(strokes, strokes[::-1, [2, 3, 0, 1]]) == 3
