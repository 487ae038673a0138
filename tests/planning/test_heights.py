"""Planning with strokes that have heights: ramps, free cells of a goal, and what is counted."""

from types import SimpleNamespace

import numpy as np
import pytest

import jaxsand as js
from jaxsand.goals.goal import Goal, as_goal
from jaxsand.goals.metrics import fits_where_it_counts
from jaxsand.planning import stroke_loss
from jaxsand.planning.search import heights, rollouts
from jaxsand.planning.search.actions import Job
from jaxsand.planning.search.heights import search_heights
from jaxsand.planning.search.proposals import around, propose_heights, within
from jaxsand.planning.search.reach import volume_distance
from jaxsand.planning.search.rollouts import distance, replay
from jaxsand.planning.stroke_loss import sand_loss

SHAPE = (12, 20)
SCENE = js.make_scene(SHAPE, 0.02, tool=js.Blade(width=0.1, thickness=0.03, depth=0.0))
LEVEL = np.zeros(SHAPE, np.float32)
X, Y = np.meshgrid((np.arange(20) + 0.5) * 0.02, (np.arange(12) + 0.5) * 0.02)
INSIDE = (X > 0.08) & (X < 0.3) & (Y > 0.06) & (Y < 0.16)
RAMP = np.where(INSIDE, 0.2 * (X - 0.19), np.nan)
WANTED = as_goal(SCENE, RAMP)
BUDGET = 60


@pytest.fixture(scope="module")
def found():
    return js.plan_sand(SCENE, LEVEL, RAMP, strokes=2, actions=js.Rising(), budget=BUDGET)


def test_a_plan_with_heights_replayed_leaves_what_it_says(found):
    np.testing.assert_array_equal(replay(SCENE, LEVEL, found.paths), found.height)
    assert float(distance(found.height, WANTED)) == found.after
    assert all(path.shape == (2, 3) for path in found.paths)
    assert found.strokes.shape == (len(found.paths), 6)
    assert 0.9 * BUDGET < found.effort.cost <= BUDGET
    assert found.lower_bound == 0
    np.testing.assert_array_equal(
        js.plan_sand(SCENE, LEVEL, RAMP, strokes=2, actions=js.Rising(), budget=BUDGET).strokes, found.strokes
    )


def test_strokes_that_rise_build_a_ramp_which_one_depth_cannot(found):
    """A blade at height 0 moves no level sand; strokes along the slope do half of what there is to do."""
    assert found.after < 0.6 * found.before
    scraped = js.plan_sand(SCENE, LEVEL, RAMP, strokes=2, actions=js.Flat(lowest=0.0, highest=0.0), budget=8)
    assert scraped.paths == ()
    assert scraped.reason.endswith("allow more strokes or pushes, or give the tool another size or depth")


def test_gradients_take_a_plan_with_heights_on(found):
    """With no budget for a gradient, the guess comes back with its loss; a guess that does nothing is no plan."""
    kept = js.optimise_strokes(SCENE, RAMP, guess=found.strokes, budget=len(found.strokes))
    np.testing.assert_array_equal(kept.strokes, found.strokes)
    assert kept.losses[-1] == pytest.approx(found.after**2, rel=1e-3)
    assert kept.spent == len(found.strokes)
    above = np.array([[0.1, 0.1, 0.05, 0.2, 0.1, 0.05]])
    assert js.optimise_strokes(SCENE, RAMP, guess=above, budget=1).strokes.shape == (0, 6)
    with pytest.raises(ValueError, match=r"guess: got shape \[1, 5\]; give \[N, 4\], finite .* or \[N, 6\] with heights"):
        js.optimise_strokes(SCENE, RAMP, guess=np.zeros((1, 5)))


def test_goals_planned_side_by_side_have_the_plans_that_each_has_alone():
    other, given = np.where(INSIDE, -0.01, np.nan), {"strokes": 2, "actions": js.Rising(), "budget": 8}
    both = js.plan_sand_batch(SCENE, LEVEL, [RAMP, other], seed=3, **given)
    for k, (plan, goal) in enumerate(zip(both, (RAMP, other), strict=True)):
        alone = js.plan_sand(SCENE, LEVEL, goal, seed=3 + k, **given)
        np.testing.assert_allclose(plan.strokes, alone.strokes, atol=1e-9)
        np.testing.assert_allclose(plan.height, alone.height, atol=1e-6)
        assert (plan.effort.cost, plan.before) == (alone.effort.cost, alone.before)
    with pytest.raises(
        ValueError, match=r"height: got shape \[3, 12, 20\]; give \[H, W\], or \[2, H, W\], one for each goal"
    ):
        js.plan_sand_batch(SCENE, np.zeros((3, *SHAPE)), [RAMP, other])
    assert js.plan_sand_batch(SCENE, LEVEL, []) == []


@pytest.mark.parametrize(
    ("goals", "message"),
    [
        (as_goal(SCENE, RAMP), "^goals: got Goal; give a list of goals"),
        (None, "^goals: got NoneType; give a list"),
        ([RAMP, LEVEL[:3]], r"^goal\[1\]: got shape \[3, 20\]"),
        ([RAMP, 1e3 * LEVEL, "x"], r"^goal\[2\]: "),
    ],
)
def test_goals_that_are_none_are_named(goals, message):
    with pytest.raises(ValueError, match=message):
        js.plan_sand_batch(SCENE, LEVEL, goals)


@pytest.mark.slow
@pytest.mark.long
def test_gradients_bring_a_ramp_closer(found):
    """Some 140 pushes go to the strokes' order and direction first."""
    refined = js.optimise_strokes(SCENE, RAMP, guess=found.strokes, budget=600)
    assert refined.losses[-1] < 0.9 * found.after**2
    assert refined.spent <= 600


@pytest.mark.parametrize("budget", [1, 3, 10, 41, 200])
def test_a_search_with_heights_costs_no_more_than_its_budget(monkeypatch, budget):
    pushes, dig = [], np.random.default_rng(0)

    def step_batch(scene, maps, ways):
        pushes.append(len(ways))
        return SimpleNamespace(height=maps + dig.normal(0, 1e-3, maps.shape), outcome=np.zeros(len(maps), int))

    for module in (rollouts, stroke_loss):
        monkeypatch.setattr(module, "step_batch", step_batch)
    for strokes in (1, 2, 6):
        pushes.clear()
        job = Job(SCENE, LEVEL, WANTED, strokes, js.Rising())
        found, effort = search_heights(job, budget, np.random.default_rng(1))
        assert effort.full == sum(pushes) <= budget
        assert effort.full > budget - 2 * strokes - 1
        assert len(found) <= strokes


@pytest.mark.parametrize("strokes", [2, pytest.param(6, marks=pytest.mark.wide)])
def test_gradients_in_a_search_cost_no_more_than_its_budget(monkeypatch, strokes):
    """Each counts as five pushes; they are left out with few pushes, and for few steps; strokes stay as they are allowed."""
    pushes, gradients, rng = [], [], np.random.default_rng(0)

    def step_batch(scene, maps, ways):
        pushes.append(len(ways))
        moved = np.asarray(maps) + rng.normal(0, 1e-3, np.shape(maps))
        return SimpleNamespace(height=moved, outcome=np.zeros(len(maps), int))

    def value_and_grad_batch(scene, loss, maps, ways, back):
        gradients.append(len(ways))
        assert (ways[:, [2, 5]] <= 0.01 + 1e-6).all()
        return np.zeros(len(ways)), (back, rng.normal(size=ways.shape))

    for module in (rollouts, stroke_loss):
        monkeypatch.setattr(module, "step_batch", step_batch)
    monkeypatch.setattr(stroke_loss, "value_and_grad_batch", value_and_grad_batch)
    job = Job(SCENE, LEVEL, WANTED, strokes, js.Rising(highest=0.01))
    for budget in (999, 1300):
        pushes.clear()
        found, effort = search_heights(job, budget, np.random.default_rng(1))
        assert effort.full == sum(pushes) + stroke_loss.GRADIENT * sum(gradients) <= budget
        assert effort.full > budget - 2 * strokes - 1
        assert len(found) <= strokes
        assert all(path[:, 2].max() <= 0.01 for path in found)
        assert (0.2 if budget > 1000 else 0) <= 5 * sum(gradients) / budget <= (0.6 if budget > 1000 else 0)


@pytest.mark.slow
@pytest.mark.long
def test_a_search_that_ends_with_gradients_comes_closer(monkeypatch):
    with_them = js.plan_sand(SCENE, LEVEL, RAMP, strokes=4, actions=js.Rising(), budget=1000)
    monkeypatch.setattr(heights, "_PAYS", 1001)
    without = js.plan_sand(SCENE, LEVEL, RAMP, strokes=4, actions=js.Rising(), budget=1000)
    assert with_them.after < 0.95 * without.after


@pytest.mark.parametrize(
    "actions", [js.Rising(3.0, 6.0, -0.01, 0.02), js.Flat(3.0, 6.0, -0.01, 0.02), js.Flat(3.0, 6.0, 0.0, 0.0)]
)
def test_strokes_keep_to_the_map_and_to_what_is_allowed(actions):
    rng = np.random.default_rng(0)
    job = Job(SCENE, LEVEL, WANTED, 1, actions)
    drawn = propose_heights(job, LEVEL, 97, rng)
    near = around(job, LEVEL, drawn, 50, 3.0, rng)
    still = within(job, np.array([[0.2, 0.1, 0.0, 0.2, 0.1, 0.0]]))
    for strokes in (drawn, near, still):
        places, z = strokes[:, [0, 1, 3, 4]].reshape(-1, 2), strokes[:, [2, 5]]
        assert np.all((places >= 0.01 - 1e-9) & (places <= np.array([0.39, 0.23]) + 1e-9))
        length = np.hypot(*(strokes[:, 3:5] - strokes[:, :2]).T)
        assert np.all(length <= 0.12 + 1e-9)
        assert np.all((z >= actions.lowest) & (z <= actions.highest))
        assert isinstance(actions, js.Rising) or np.all(z[:, 0] == z[:, 1])
    assert drawn.shape == (97, 6)
    assert float(np.hypot(*(still[0, 3:5] - still[0, :2]))) == pytest.approx(0.06)
    if isinstance(actions, js.Rising):
        assert np.ptp(drawn[:, [2, 5]], axis=1).max() > 0.005


def test_strokes_are_drawn_towards_where_sand_is_wanted():
    """From a heap to a hole of the goal run a quarter of the strokes, but for how far their ends are moved.

    Drawn anywhere, 0.014 of them would.
    """
    goal = np.zeros(SHAPE)
    height = LEVEL.copy()
    height[6, 3], goal[6, 16] = 0.01, 0.01
    drawn = propose_heights(
        Job(SCENE, height, as_goal(SCENE, goal), 1, js.Rising(longest=30.0)), height, 400, np.random.default_rng(0)
    )
    from_heap = np.hypot(drawn[:, 0] - 0.07, drawn[:, 1] - 0.13) < 0.06
    to_hole = np.hypot(drawn[:, 3] - 0.33, drawn[:, 4] - 0.13) < 0.06
    assert 0.08 < np.mean(from_heap & to_hole) < 0.25


def test_strokes_follow_the_slope_that_is_wanted():
    """Half of the strokes run along a plane goal to the last bit of it, wherever their ends are; not where none counts."""
    plane = 0.1 * X - 0.3 * Y
    drawn = propose_heights(
        Job(SCENE, LEVEL, as_goal(SCENE, plane), 1, js.Rising(shortest=1e-3)), LEVEL, 400, np.random.default_rng(0)
    )
    off = np.abs(drawn[:, [2, 5]] - 0.1 * drawn[:, [0, 3]] + 0.3 * drawn[:, [1, 4]]).max(1)
    assert 0.2 < np.mean(off < 1e-9) < 0.5
    nowhere = np.where(X < 0.03, 0.05, np.nan)
    drawn = propose_heights(Job(SCENE, LEVEL, as_goal(SCENE, nowhere), 1, js.Rising()), LEVEL, 400, np.random.default_rng(0))
    assert np.isfinite(drawn).all()


def test_free_cells_do_not_count():
    goal = np.full(SHAPE, np.nan)
    goal[2, 3] = 0.004
    assert distance(LEVEL[None], as_goal(SCENE, goal)).tolist() == [0.004]
    assert np.isinf(
        distance(np.full((1, *SHAPE), np.nan), as_goal(SCENE, goal))[0]
    )  # a map that is not clean is no solution
    assert np.count_nonzero(Goal(goal).off(LEVEL + 1)) == 1
    assert volume_distance(SCENE, LEVEL, as_goal(SCENE, goal)) == 0
    assert volume_distance(SCENE, LEVEL, as_goal(SCENE, LEVEL + 0.001)) == pytest.approx(0.001 * np.sqrt(240))
    loss = sand_loss(SCENE, LEVEL, goal)
    assert loss.loss_of(LEVEL) == pytest.approx(0.004**2)
    assert loss.target[2, 3] == 0.004
    assert np.count_nonzero(loss.target) == 1
    with pytest.raises(ValueError, match="goal: got 1 cells that are not finite; fill"):
        fits_where_it_counts(SCENE, np.where(goal > 0, np.inf, goal))
    with pytest.raises(ValueError, match="goal: got NaN, free, in every cell"):
        fits_where_it_counts(SCENE, goal * np.nan)
    masked = np.ma.masked_invalid(RAMP)
    assert js.plan_sand(SCENE, LEVEL, masked, strokes=1, actions=js.Rising(), budget=1).before == float(
        distance(LEVEL, WANTED)
    )


def test_plans_stay_on_the_map_and_heights_stay_as_they_are():
    loss = sand_loss(SCENE, LEVEL, RAMP)
    np.testing.assert_allclose(loss.inside(np.array([[-1.0, 9, -3, 9, -1, 3]])), [[0.01, 0.23, -3, 0.39, 0.01, 3]])
    np.testing.assert_allclose(loss.inside(np.array([[-1.0, 9, 9, -1]])), [[0.01, 0.23, 0.39, 0.01]])


@pytest.mark.parametrize(
    ("actions", "message"),
    [
        (js.Rising(shortest=0.0), "actions.shortest: got 0.0 with longest inf; give spacings, above 0, at most longest"),
        (js.Flat(longest=1.0), "actions.shortest: got 2.0 with longest 1.0; give"),
        (js.Rising(shortest=30.0), "actions.shortest: got 30.0 .* at most 21.95"),
        (
            js.Flat(lowest=0.1, highest=0.0),
            "actions.lowest: got 0.1 with highest 0.0; give heights in metres, at most highest",
        ),
        (js.Rising(lowest=float("nan")), "actions.lowest: got nan"),
    ],
)
def test_bad_input(actions, message):
    with pytest.raises(ValueError, match=message):
        js.plan_sand(SCENE, LEVEL, RAMP, actions=actions)


def test_of_several_blades_the_one_that_suits_is_chosen():
    """A wide one levels a ramp that a narrow one only scratches; what is tried counts, and the plan is that blade's."""
    narrow, wide = js.Blade(width=0.02, thickness=0.03, depth=0.0), SCENE.tool
    found = js.plan_sand(SCENE, LEVEL, RAMP, strokes=2, actions=js.Rising(), budget=24, tools=(narrow, wide))
    assert found.tool == wide
    assert found.effort.cost <= 24
    np.testing.assert_array_equal(replay(SCENE, LEVEL, found.paths), found.height)
    with pytest.raises(ValueError, match=r"tools: got a choice with Lattice\(\)"):
        js.plan_sand(SCENE, LEVEL, RAMP, tools=(narrow, wide))
    for tools, message in {
        (js.Wheel(),): r"tools\[0\]: got Wheel; give a Blade",
        (wide, js.Blade(width=0.004, thickness=0.03)): r"tools\[1\]: tool.width: got 0.004 m, less than a cell",
        narrow: "tools: got one Blade; give a list",
    }.items():
        with pytest.raises(ValueError, match=message):
            js.plan_sand(SCENE, LEVEL, RAMP, actions=js.Rising(), tools=tools)


def test_a_first_plan_is_kept_where_nothing_better_is_found():
    job, stroke = Job(SCENE, LEVEL, WANTED, 1, js.Rising()), np.array([[0.1, 0.1, -0.01, 0.2, 0.1, 0.01]])
    (path,), effort = search_heights(job, 1, np.random.default_rng(0), first=(stroke, 0.0))
    np.testing.assert_array_equal(path.ravel(), stroke[0])
    assert effort.cost <= 1


def test_a_map_too_small_for_a_stroke_is_named():
    scene = js.make_scene((1, 1), 0.02, tool=js.Blade(width=0.02, thickness=0.02))
    with pytest.raises(ValueError, match=r"height: got \[1, 1\] cells, too few for a stroke of 2 spacings"):
        js.plan_sand(scene, np.zeros((1, 1)), np.ones((1, 1)), actions=js.Rising())


def test_a_plan_carries_what_sand_can_do_at_best(found):
    best = js.at_best(SCENE, LEVEL, RAMP)
    assert found.at_best is not None
    assert found.at_best.distance_bound == best.distance_bound <= found.lower_bound + 1e-12
    np.testing.assert_array_equal(found.at_best.height, best.height)
