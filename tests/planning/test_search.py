"""Planning on real sand: what a plan says of itself holds, and its bound does."""

import math
import re
from types import SimpleNamespace

import jax.numpy as jnp
import numpy as np
import pytest

import jaxsand as js
from jaxsand.bench.rivals.search import binary, greedy, shooting
from jaxsand.bench.sand import bench_sand
from jaxsand.goals.goal import as_goal
from jaxsand.planning.no_strokes import why_no_strokes
from jaxsand.planning.search import rollouts
from jaxsand.planning.search import steps as of_steps
from jaxsand.planning.search import strokes as of_strokes
from jaxsand.planning.search.actions import Job, corners, longest_stroke, moved, propose
from jaxsand.planning.search.binary import binary_paths, straight_runs
from jaxsand.planning.search.reach import least_distance, most_lowered
from jaxsand.planning.search.rollouts import CHEAP, Effort, distance, distinct, marks, pushed, replay, roughly_pushed, walked
from jaxsand.planning.search.tasks import SAND_TASKS, sand_task

SHAPE = (14, 14)
SCENE = js.make_scene(SHAPE, 0.01, tool=js.Blade())
LEVEL = np.zeros(SHAPE, np.float32)
STROKES = np.array([[0.03, 0.05, 0.11, 0.05], [0.03, 0.09, 0.11, 0.09]])
BUDGET = 200


@pytest.fixture(scope="module")
def goal():
    return replay(SCENE, LEVEL, [s.reshape(2, 2) for s in STROKES])


@pytest.fixture(scope="module")
def wanted(goal):
    return as_goal(SCENE, goal)


@pytest.fixture(scope="module")
def found(goal):
    return js.plan_sand(SCENE, LEVEL, goal, strokes=2, budget=BUDGET)


def test_a_plan_replayed_leaves_what_it_says(found, wanted):
    height = replay(SCENE, LEVEL, found.paths)
    np.testing.assert_array_equal(height, found.height)
    assert float(distance(height, wanted)) == found.after
    rolled = js.rollout(SCENE, jnp.asarray(LEVEL), jnp.asarray(found.strokes, jnp.float32))
    assert float(distance(np.asarray(rolled.height[-1]), wanted)) == pytest.approx(found.after, rel=1e-3)
    assert found.before == float(distance(LEVEL, wanted))
    assert 0 < len(found.paths) <= 2
    assert found.reason is None


def test_a_plan_gains_and_its_bounds_hold(found):
    assert found.after < 0.8 * found.before
    assert found.lower_bound <= found.after
    assert found.estimate <= found.after + 1e-9
    assert found.gap == found.after - found.lower_bound
    assert found.reduction == 1 - found.after / found.before
    assert 0.9 * BUDGET < found.effort.cost <= BUDGET


@pytest.mark.wide
def test_equal_seeds_give_equal_plans(found, goal):
    again = js.plan_sand(SCENE, LEVEL, goal, strokes=2, budget=BUDGET)
    np.testing.assert_array_equal(again.strokes, found.strokes)
    assert again.effort == found.effort
    other = js.plan_sand(SCENE, LEVEL, goal, strokes=2, budget=BUDGET, seed=1)
    assert not np.array_equal(other.strokes, found.strokes)


@pytest.mark.parametrize("budget", [1, 2, 3, 5, 7, 12, 40, 100, 300])
def test_a_search_costs_no_more_than_its_budget(monkeypatch, budget, wanted):
    """With sand that costs nothing: what is pushed is what is counted, and is within the budget, for strokes and legs."""
    pushes = {"full": 0, "rough": 0}
    dig = np.random.default_rng(0)

    def step_batch(scene, maps, ways, push=None, stop=None):
        pushes["rough" if push else "full"] += len(ways)
        return SimpleNamespace(height=maps + dig.normal(0, 1e-4, maps.shape), outcome=np.zeros(len(maps), int))

    def follow_padded(scene, height, path, legs):
        pushes["full"] += len(path) - 1
        return height

    monkeypatch.setattr(rollouts, "step_batch", step_batch)
    monkeypatch.setattr(rollouts, "act_batch", step_batch)
    monkeypatch.setattr(
        rollouts, "settle_batch", lambda _, maps: SimpleNamespace(height=maps, outcome=np.zeros(len(maps), int))
    )
    monkeypatch.setattr(of_steps, "follow_padded", follow_padded)
    hints = propose(SCENE, js.Lattice(), LEVEL, wanted, 24, dig)
    for count in (1, 2, 6):
        for hinted in (hints, hints[:0]):
            pushes.update(full=0, rough=0)
            job = Job(SCENE, LEVEL, wanted, count, js.Lattice())
            found, effort = of_strokes.search_strokes(job, hinted, budget, np.random.default_rng(1))
            assert (effort.full, effort.rough) == (pushes["full"], pushes["rough"])
            assert effort.full + CHEAP * effort.rough <= budget + 1e-9
            assert len(found) <= count
            assert effort.cost > min(0.6 * budget, budget - 1.5 * count)  # nor does it leave much of it
        for hint in (np.array([[1, 1], [1, 2], [1, 3], [2, 3]]), np.zeros((0, 2), int)):
            pushes.update(full=0, rough=0)
            job = Job(SCENE, LEVEL, wanted, count, js.Steps(2))
            _, effort = of_steps.search_steps(job, hint, budget, np.random.default_rng(1))
            assert effort.full == pushes["full"] <= budget


def test_at_the_goal_there_is_nothing_to_do(goal):
    done = js.plan_sand(SCENE, goal, goal, strokes=2, budget=BUDGET)
    assert (done.paths, done.before, done.after, done.reduction, done.effort) == ((), 0.0, 0.0, 0.0, Effort())
    assert done.strokes.shape == (0, 4)
    assert done.reason.startswith("the sand lies as the goal has it already")


@pytest.mark.wide
def test_where_no_stroke_is_found_the_plan_says_why():
    trench = LEVEL.copy()
    trench[7, 3:11] = -0.0005  # far shallower than the blade digs
    done = js.plan_sand(SCENE, LEVEL, trench, strokes=1, budget=30)
    assert done.paths == ()
    assert re.match("no stroke .* berms count: the goal has 4e-07 m.3 less sand .*; give .* berms of what", done.reason)
    assert "4e-07 m^3 more sand" in why_no_strokes(SCENE, LEVEL, as_goal(SCENE, -trench))
    for scene in (
        js.make_scene(SHAPE, 0.01, tool=js.Blade(), edge=js.Draining(-0.1)),  # sand may go, or has been walled in
        js.make_scene(SHAPE, 0.01, tool=js.Blade(), walls=js.Walls(np.indices(SHAPE)[0] == 7)),
    ):
        assert "less sand" not in why_no_strokes(scene, LEVEL, as_goal(scene, trench))
    assert re.match(
        "no stroke .* berms count; allow more", why_no_strokes(SCENE, trench, as_goal(SCENE, np.roll(trench, 1, 0)))
    )


@pytest.mark.wide
def test_steps_find_a_path_again():
    steps = js.Steps(cell=2)
    at = corners(SCENE, steps)
    goal = replay(SCENE, LEVEL, [at[3, 1:5]])
    plan = js.plan_sand(SCENE, LEVEL, goal, strokes=3, actions=steps, budget=200)
    assert plan.after == pytest.approx(0, abs=1e-7)
    assert len(plan.paths) == 1
    runs = np.abs(np.diff(plan.paths[0], axis=0))
    np.testing.assert_allclose(runs.sum(1), steps.cell * 0.01)


@pytest.mark.wide
@pytest.mark.parametrize("neighbours", [4, 8])
@pytest.mark.parametrize("surface", ["level", "rough"])
def test_no_stroke_lowers_more_than_the_proven_amount(surface, neighbours):
    """And the map stays above u of `reach`, which the amount is the sum below."""
    scene = js.make_scene(SHAPE, 0.01, tool=js.Blade(), neighbours=neighbours)
    rng = np.random.default_rng(3)
    rough = {"level": 0.0, "rough": 0.02}[surface] * rng.normal(size=SHAPE)
    height = np.asarray(js.settle(scene, rough.astype(np.float32)).height)
    most, longest = 0.0, 0.08
    ways = propose(scene, js.Lattice(longest=8), height, as_goal(scene, height), 32, rng)
    maps = np.repeat(height[None], 32, axis=0)
    for _ in range(2):
        maps = pushed(scene, maps, ways)
        ways = ways[::-1]
        most += most_lowered(scene, height, longest)
        assert np.maximum(height - maps, 0).sum((1, 2)).max() <= most
        assert np.maximum(maps - height, 0).sum((1, 2)).max() <= most * (1 + 1e-4)
    assert np.all(maps >= np.minimum(height, -0.0075) - 1e-5)


def test_the_bound_is_exact_where_it_can_be_told():
    high = LEVEL + np.float32(0.001)
    assert least_distance(SCENE, high, as_goal(SCENE, LEVEL), 9, 0.1) == pytest.approx(0.014)  # no sand to be lost
    far = LEVEL.copy()
    far[:7], far[7:] = 1.0, -1.0  # far more to move than a stroke can
    amount = most_lowered(SCENE, LEVEL, 0.05)
    assert math.sqrt(98 * 1 + 98 * 0.9925**2) - 0.1 < least_distance(SCENE, LEVEL, as_goal(SCENE, far), 1, 0.05) < 14
    assert least_distance(SCENE, LEVEL, as_goal(SCENE, far), 2, 0.05) < least_distance(
        SCENE, LEVEL, as_goal(SCENE, far), 1, 0.05
    )
    assert amount > 0.0075 * 2 * 5
    isotropic = js.make_scene(SHAPE, 0.01, tool=js.Blade(), neighbours="isotropic")
    assert least_distance(isotropic, LEVEL, as_goal(isotropic, far), 1, 0.05) == 0


def test_nodes_that_look_alike_are_one():
    maps = np.random.default_rng(0).normal(size=(4, *SHAPE)).astype(np.float32)
    maps[2] = maps[0] + 1e-7
    names = marks(maps, 0.1)
    parent = np.array([0, 0, 1, 1])
    assert distinct(names, parent, np.array([2, 0, 1, 3]), 4, 4) == [2, 1, 3]
    assert distinct(names, parent, np.array([0, 1, 2, 3]), 4, 1) == [0, 3]
    assert distinct(names, parent, np.array([3, 1, 2, 0]), 2, 4) == [3, 1]


@pytest.mark.wide
def test_children_are_pushed_as_they_would_be_alone(goal):
    ways = np.concatenate([STROKES, STROKES[:, [2, 3, 0, 1]], STROKES / 2])
    maps = pushed(SCENE, np.repeat(goal[None], len(ways), axis=0), ways)
    for one, way in zip(maps, ways, strict=True):
        np.testing.assert_allclose(one, js.step(SCENE, goal, way.astype(np.float32)).height, atol=2e-5)
    rough = roughly_pushed(SCENE, np.repeat(goal[None], len(ways), axis=0), ways)
    assert np.abs(rough - maps).sum() < 0.65 * np.abs(maps - goal).sum()  # here over trenches that are there already
    down, lifted = walked(SCENE, np.repeat(LEVEL[None], 2, axis=0), STROKES)
    np.testing.assert_allclose(lifted[0], js.step(SCENE, LEVEL, STROKES[0].astype(np.float32)).height, atol=2e-5)
    assert np.abs(down - lifted).max() > 1e-3


def test_strokes_stay_on_the_map_and_within_their_length(wanted):
    rng = np.random.default_rng(0)
    actions = js.Lattice(pitch=2.0, shortest=3.0, longest=6.0)
    ways = propose(SCENE, actions, LEVEL, wanted, 50, rng)
    assert ways.shape == (50, 4)
    np.testing.assert_allclose((ways / 0.01 - 1) % 2, 0, atol=1e-6)
    for strokes, least in ((ways, 0.03), (moved(SCENE, actions, ways, rng), 0)):
        length = np.hypot(*(strokes[:, 2:] - strokes[:, :2]).T)
        assert np.all((length >= least - 1e-9) & (length <= longest_stroke(SCENE, actions) + 1e-9))
        assert np.all(np.abs(strokes - 0.07) <= 0.065 + 1e-9)


@pytest.mark.wide
def test_the_binary_plan_and_the_rivals(wanted):
    drawn = LEVEL.copy()
    drawn[4:6, 2:10], drawn[6:10, 8:10] = -0.0075, -0.0075
    (walk,) = binary_paths(SCENE, LEVEL, as_goal(SCENE, drawn), js.Steps(2))
    assert len(walk) == 6
    assert [b - a for a, b in straight_runs(walk)] in ([3, 2], [2, 3])
    job = Job(SCENE, LEVEL, wanted, 2, js.Lattice())
    for rival in (binary, greedy, shooting):
        paths, effort = rival(job, 60, np.random.default_rng(0))
        assert distance(replay(SCENE, LEVEL, paths), wanted) <= distance(LEVEL, wanted)
        assert effort.full > 0
    assert greedy(job, 60, np.random.default_rng(0))[1].cost <= 60


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"strokes": 0}, "strokes: got 0; give a whole number"),
        ({"budget": 2.5}, "budget: got 2.5; give a whole number"),
        ({"seed": -1}, "seed: got -1; give a whole number"),
        ({"actions": "lattice"}, "actions: got 'lattice'; give Lattice"),
        ({"actions": js.Lattice(pitch=0.0)}, "actions.pitch: got 0.0; give spacings"),
        ({"actions": js.Lattice(longest=0.5)}, "actions.longest: got 0.5 with"),
        ({"actions": js.Steps(cell=0)}, "actions.cell: got 0; give a whole number"),
        ({"actions": js.Steps(cell=8)}, "actions.cell: got 8 with margin 0 on .* smaller"),
        ({"scene": js.make_scene(SHAPE, 0.01)}, "scene.tool: got NoTool, which moves no sand; give"),
        ({"goal": LEVEL[:5]}, "goal: got shape .*; make the scene as large"),
        ({"goal": LEVEL * np.nan}, "goal: got NaN, free, in every cell"),
        ({"height": LEVEL * np.nan}, "height: got 196 cells that are not finite; fill"),
        ({"height": LEVEL[0]}, "height: got shape"),
        ({"height": LEVEL + 0.1 * np.eye(14)}, "height: got a slope of .* settle it first"),
    ],
)
def test_bad_input(change, message, goal):
    given = {"scene": SCENE, "height": LEVEL, "goal": goal, **change}
    with pytest.raises(ValueError, match=message):
        js.plan_sand(given.pop("scene"), given.pop("height"), given.pop("goal"), **given)


@pytest.mark.slow
def test_every_task_is_at_rest_and_has_something_to_do():
    for name in SAND_TASKS:
        task = sand_task(name)
        assert float(js.steepest_slope(task.scene, task.height)) < math.tan(math.radians(29)) + 2e-3
        assert float(distance(task.height, as_goal(task.scene, task.goal))) > 0.01
        assert abs(float(np.mean(task.goal - task.height))) < 1e-6
    with pytest.raises(ValueError, match="task: got 'sieve'; give one of crossing, twin"):
        sand_task("sieve")


@pytest.mark.slow
@pytest.mark.long
def test_the_search_ends_a_fifth_closer_than_its_rivals():
    """On one task of those of `jaxsand bench sand`."""
    rows = bench_sand(names=("crossing",))
    closer = [row["closer"] for row in rows if row["method"] == "search"]
    assert len(closer) == 1
    assert min(closer) >= 0.2
    assert all(row["lower_bound"] <= row["after"] + 1e-9 for row in rows)


def test_maps_that_differ_in_their_last_row_alone_are_told_apart():
    maps = np.zeros((2, 5, 4))
    maps[1, 4] = 1
    assert len(set(marks(maps, 0.1))) == 2
