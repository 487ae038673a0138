"""Earth-moving tasks: what they ask for, and how results are measured."""

import numpy as np
import pytest

import jaxsand as js
from jaxsand.goals.tasks import TASKS, Task, figures, make_task

SCENE = js.make_scene((4, 5), 0.01, tool=js.Blade(depth=0.0))
DIG = np.zeros((4, 5), bool)
DIG[1:3, 1:3] = True
GOAL = js.Goal(np.where(DIG, -0.01, 0.0), above=DIG * 1.0)
HOLE = Task("hole", SCENE, np.zeros((4, 5), np.float32), GOAL, DIG, 2)


@pytest.mark.parametrize("name", [*TASKS])
def test_a_task_is_there_again_by_its_key_and_can_be_done(name):
    task, again, other = make_task(name, 3), make_task(name, 3), make_task(name, 4)
    np.testing.assert_array_equal(task.start, again.start)
    np.testing.assert_array_equal(task.goal.height, again.goal.height)
    wanted, more = (np.where(one.cells, np.nan_to_num(one.goal.height), one.start) for one in (task, other))
    assert not np.array_equal(wanted - task.start, more - other.start)
    assert task.cells.any()
    assert task.goal.cost(task.start) > 0
    mu = np.tan(np.max(np.asarray(task.scene.material.repose_angle)))
    assert js.steepest_slope(task.scene, task.start) < mu + 2e-3
    wanted = np.where(task.goal.free, np.nan, task.goal.height)
    slopes = [np.nanmax(np.abs(np.diff(wanted, axis=axis))) / float(task.scene.grid.spacing) for axis in (0, 1)]
    assert (max(slopes) < mu + 2e-3) == (name != "vertical")  # sand can keep the goal's slopes, but no walls
    if name in ("level", "spread", "relief", "pit-and-heap"):  # all of the bed counts, so there is sand for it
        assert np.mean(wanted - task.start) == pytest.approx(0, abs=1e-6)


def test_figures_of_nothing_done_of_all_and_of_too_much():
    before = figures(HOLE, HOLE.start)
    assert before["mean_mm"] == before["before_mm"] == pytest.approx(10)
    assert (before["changed"], before["coverage"], before["completion"], before["iou"], before["reduction"]) == (0,) * 5
    done = figures(HOLE, GOAL.height)
    assert (done["mean_mm"], done["changed"], done["coverage"], done["completion"]) == (0, 1, 1, 1)
    assert (done["iou"], done["reduction"], done["dug_outside_mm"]) == (1, 1, 0)
    heaps = figures(HOLE, GOAL.height + ~DIG * 0.02)  # they may lie there
    assert heaps == done
    holes = figures(HOLE, GOAL.height - ~DIG * 0.004)
    assert holes["dug_outside_mm"] == pytest.approx(4)
    assert holes["reduction"] == pytest.approx(1 - 0.004 * 4 / (0.01 * 2))


def test_half_of_the_cells_dug_is_half_the_coverage():
    half = np.array(GOAL.height)
    half[1] = 0.0
    found = figures(HOLE, half)
    assert (found["coverage"], found["completion"], found["changed"], found["iou"]) == (0.5, 0, 0.5, 0.5)
    assert found["mean_mm"] == pytest.approx(5)


def test_where_nothing_is_to_be_dug_there_is_no_coverage():
    found = figures(make_task("ring", 0), make_task("ring", 0).start)
    assert found["coverage"] is found["completion"] is found["iou"] is None


def test_unknown_tasks_and_keys_are_named():
    with pytest.raises(ValueError, match="name: got 'dance'; give one of level, pad, ramp"):
        make_task("dance")
    with pytest.raises(ValueError, match="key: got -1"):
        make_task("ramp", -1)
