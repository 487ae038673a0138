"""Coverage paths, plans of least work, and what the search makes of them."""

import numpy as np
import pytest

import jaxsand as js
from jaxsand.bench.rivals import earth
from jaxsand.goals.goal import as_goal
from jaxsand.planning.search.actions import Job
from jaxsand.planning.search.coverage import READINGS, coverage
from jaxsand.planning.search.drafts import best_coverage, least_work
from jaxsand.planning.search.rollouts import distance, replay
from jaxsand.planning.search.transport import flows, heaviest

SHAPE, DX = (12, 16), 0.01
SCENE = js.make_scene(SHAPE, DX, tool=js.Blade(width=0.03, thickness=0.01, depth=0.0))
LEVEL = np.zeros(SHAPE, np.float32)
DIG = np.zeros(SHAPE, bool)
DIG[3:9, 4:12] = True
PIT = as_goal(SCENE, js.Goal(np.where(DIG, -0.005, 0.0), above=DIG * 1.0))
JOB = Job(SCENE, LEVEL, PIT, 4, js.Rising())


@pytest.mark.parametrize("along_y", [False, True])
def test_rows_cover_the_box_there_and_back_at_the_goals_depth(along_y):
    """Two blades of 30 mm side by side cover 60 mm, three the 80 mm across."""
    rows = coverage(SCENE, PIT, LEVEL, (1.0, 1, along_y, False)).reshape(-1, 2, 3)
    if along_y:
        rows = rows[..., [1, 0, 2]]
    across, ends = ([0.055, 0.08, 0.105], (0.03, 0.09)) if along_y else ([0.045, 0.075], (0.04, 0.12))
    np.testing.assert_allclose(rows[:, 0, 1], across)
    np.testing.assert_allclose(rows[:, 1, 1], across)
    for k, row in enumerate(rows):
        np.testing.assert_allclose(row[:, 0], ends if k % 2 == 0 else ends[::-1])
    np.testing.assert_allclose(rows[..., 2], -0.005)


def test_layers_go_down_step_by_step_and_may_begin_at_the_far_side():
    rows = coverage(SCENE, PIT, LEVEL, (1.0, 2, False, True))
    np.testing.assert_allclose(rows[:, 2], [-0.0025, -0.0025, -0.005, -0.005])
    assert rows[0, 1] > rows[1, 1]
    assert len(set(READINGS)) == 36


def test_sand_goes_the_least_way():
    """Of two heaps each fills the hole beside it, and what a goal lacks stays lacking."""
    goal, height = np.zeros(SHAPE), np.zeros(SHAPE)
    height[2, 3], height[9, 12] = 0.01, 0.02
    height[2, 5], height[9, 10] = -0.01, -0.02
    height[5, 7] = -0.001  # for which there is no sand
    sources, sinks, amounts = flows(as_goal(SCENE, goal), height)
    ways = {(*map(int, a), *map(int, b)): float(c) for a, b, c in zip(sources, sinks, amounts, strict=True)}
    assert ways[2, 3, 2, 5] == pytest.approx(0.01)
    assert sum(ways.values()) == pytest.approx(0.03)
    assert sum(c for way, c in ways.items() if way[2:] == (9, 10)) + sum(
        c for way, c in ways.items() if way[2:] == (5, 7)
    ) == pytest.approx(0.02)


def test_what_is_dug_goes_to_the_nearest_place_where_heaps_may_lie():
    sources, sinks, amounts = flows(PIT, LEVEL)
    assert amounts.sum() == pytest.approx(0.005 * DIG.sum())
    assert not DIG[tuple(np.round(sinks).astype(int).T)].any()
    away = np.hypot(*(sinks - sources).T)
    rows, columns = np.round(sources).astype(int).T
    border = np.minimum(np.minimum(rows - 2, 9 - rows), np.minimum(columns - 3, 12 - columns))
    np.testing.assert_allclose(away, border, atol=0.8)  # blocks of a few cells are taken for their middles


def test_a_stroke_of_least_work_begins_behind_and_ends_where_the_sand_may_lie():
    (stroke,) = heaviest(SCENE, PIT, LEVEL)
    assert stroke[2] == pytest.approx(-0.005)
    assert heaviest(SCENE, as_goal(SCENE, LEVEL), LEVEL).shape == (0, 6)


@pytest.mark.parametrize("budget", [3, 40])
def test_paths_cost_no_more_than_their_budget_and_are_replayed(budget):
    for make in (best_coverage, least_work):
        (plan, left), effort = make(JOB, budget)
        assert effort.cost <= budget
        assert len(plan) <= JOB.strokes
        after = replay(SCENE, LEVEL, [stroke.reshape(2, 3) for stroke in plan])
        assert float(distance(after, PIT)) == pytest.approx(left, rel=1e-3)
    if budget == 40:
        assert left < distance(LEVEL, PIT)


@pytest.mark.slow
def test_the_search_beats_what_it_begins_with():
    found = js.plan_sand(SCENE, LEVEL, PIT, strokes=4, actions=js.Rising(), budget=200)
    for rival in (earth.random_strokes, earth.coverage_paths, earth.transported):
        (_, left), effort = rival(JOB, 200, np.random.default_rng(0))
        assert effort.cost <= 200
        assert found.after < left
