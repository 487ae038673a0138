"""Goals that say what matters: costs, their derivatives, free cells, and what the planners make of them."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxsand as js
from jaxsand.goals.goal import Goal, as_goal
from jaxsand.goals.metrics import l2
from jaxsand.planning.search.reach import least_distance, volume_distance

SHAPE = (6, 7)
SCENE = js.make_scene(SHAPE, 0.01, tool=js.Blade())
RNG = np.random.default_rng(0)
HEIGHT, MAPS = RNG.normal(size=SHAPE), RNG.normal(size=(3, *SHAPE))
ABOVE, BELOW = RNG.uniform(0, 2, (2, *SHAPE))
LEVEL = np.zeros(SHAPE)


def test_weights_of_one_are_the_l2_distance():
    goal = Goal(HEIGHT)
    np.testing.assert_allclose(goal.distance(MAPS), l2(HEIGHT, MAPS), rtol=1e-12)
    np.testing.assert_allclose(goal.cost(MAPS), ((MAPS - HEIGHT) ** 2).sum((1, 2)), rtol=1e-12)


@pytest.mark.parametrize("power", [1, 2])
def test_what_stands_above_and_below_costs_by_its_own_weight(power):
    goal, one = Goal(HEIGHT, ABOVE, BELOW, power), HEIGHT.copy()
    one[1, 2] += 0.3
    one[4, 4] -= 0.2
    cost = ABOVE[1, 2] * 0.3**power + BELOW[4, 4] * 0.2**power
    assert goal.cost(one) == pytest.approx(cost, rel=1e-12)
    assert goal.distance(one) == pytest.approx(cost ** (1 / power), rel=1e-12)
    assert goal.distance(HEIGHT) == 0


@pytest.mark.parametrize("power", [1, 2])
def test_slopes_are_differences_and_jax_s_own(power):
    goal, way, step = Goal(HEIGHT, ABOVE, BELOW, power), RNG.normal(size=SHAPE), 1e-6
    ends = [goal.cost(MAPS[0] + sign * step * way) for sign in (-1, 1)]
    assert np.vdot(goal.slope(MAPS[0]), way) == pytest.approx((ends[1] - ends[0]) / (2 * step), rel=1e-7)
    residual, rate = goal.residual(MAPS[0])
    assert (np.abs(residual) ** power).sum() == pytest.approx(goal.cost(MAPS[0]), rel=1e-12)
    np.testing.assert_allclose(power * np.abs(residual) ** (power - 1) * np.sign(residual) * rate, goal.slope(MAPS[0]))
    by_jax = jax.grad(lambda h, g: js.Goal(g, ABOVE, BELOW, power).cost(h), (0, 1))(
        jnp.asarray(MAPS[0]), jnp.asarray(HEIGHT)
    )
    np.testing.assert_allclose(by_jax[0], goal.slope(MAPS[0]), rtol=1e-12)
    np.testing.assert_allclose(by_jax[1], -goal.slope(MAPS[0]), rtol=1e-12)
    assert np.isfinite(jax.grad(goal.distance)(jnp.asarray(HEIGHT))).all()


def test_the_nearest_map_costs_nothing_and_free_cells_keep_their_sand():
    height = HEIGHT.copy()
    height[0] = np.nan
    goal = as_goal(SCENE, js.Goal(height, above=np.where(np.arange(7) < 3, 0, 1.0) * np.ones(SHAPE)))
    nearest = MAPS[0] - goal.off(MAPS[0])
    assert goal.cost(nearest) == pytest.approx(0, abs=1e-30)
    np.testing.assert_array_equal(nearest[0], MAPS[0, 0])
    heaps = (MAPS[0] > HEIGHT) & (np.arange(7) < 3)
    np.testing.assert_array_equal(nearest[heaps], MAPS[0][heaps])
    assert goal.free.sum() == 7
    assert np.isnan(goal.off(np.full(SHAPE, np.nan))).all()  # what is not finite is not hidden by a free cell


def test_powers_and_ragged_lists_are_refused_at_once():
    for power in (3, np.array([1, 2])):
        with pytest.raises(ValueError, match=r"goal.power: got .*; give 1 or 2"):
            js.Goal(LEVEL, power=power)
    with pytest.raises(ValueError, match="goal.height: got rows of different lengths"):
        js.Goal([[1.0, 2.0], [3.0]])


def test_lists_and_masks_are_read_as_the_planners_do():
    assert js.Goal(np.ma.masked_equal(np.full((2, 3), 99.0), 99.0)).cost(np.ones((2, 3))) == 0
    assert js.Goal([[0.0, 0.0]], above=[[1, 0]], below=[[1, 0]]).free.tolist() == [[False, True]]


def test_derivatives_by_weights_are_what_stands_too_high_even_where_they_are_0():
    by_weight = jax.grad(lambda a: js.Goal(jnp.zeros((1, 2)), above=a).cost(jnp.array([[0.1, 0.2]])))
    np.testing.assert_allclose(by_weight(jnp.array([[0.0, 1.0]])), [[0.01, 0.04]])


def test_what_is_no_number_costs_nothing():
    goal = Goal(np.array([[np.nan, 0.0]]))
    assert goal.cost(np.array([[1.0, 2.0]])) == goal.cost(jnp.array([[1.0, 2.0]])) == 4.0
    assert jax.grad(goal.cost)(jnp.array([[1.0, 2.0]])).tolist() == [[0.0, 4.0]]


def test_a_masked_goal_is_a_free_one():
    masked = np.ma.masked_array(HEIGHT, mask=HEIGHT > 0)
    np.testing.assert_array_equal(as_goal(SCENE, masked).free, HEIGHT > 0)


def test_bounds_of_weighted_goals_hold():
    """The least cost of maps of equal volume is that of the formula: no map of many comes below, and one attains it."""
    weight = RNG.uniform(0.5, 2, SHAPE)
    for power in (1, 2):
        goal = as_goal(SCENE, js.Goal(LEVEL - 0.01, above=weight, power=power))  # the goal lacks 1 cm everywhere
        bound = volume_distance(SCENE, LEVEL, goal)
        drawn = RNG.dirichlet(np.ones(LEVEL.size), 500).reshape(-1, *SHAPE) * 0.01 * LEVEL.size - 0.01
        best = 1 / weight if power == 2 else (weight == weight.min()) * 1.0
        ends = goal.distance(np.concatenate([drawn, best[None] / best.sum() * 0.01 * LEVEL.size - 0.01]))
        assert ends.min() == pytest.approx(bound, rel=1e-9)
        assert ends.argmin() == 500
    assert volume_distance(SCENE, LEVEL, as_goal(SCENE, js.Goal(LEVEL - 0.01, above=0.0))) == 0
    assert volume_distance(SCENE, LEVEL, as_goal(SCENE, js.Goal(LEVEL + 0.01, above=0.0))) > 0


@pytest.mark.parametrize("power", [1, pytest.param(2, marks=pytest.mark.wide)])
def test_one_stroke_gains_no_more_than_the_weighted_bound(power):
    scene = js.make_scene((20, 24), 0.01, tool=js.Blade())
    level, far, weight = np.zeros((20, 24)), np.zeros((20, 24)), np.ones((20, 24))
    far[:, :12] = -0.004
    weight[:, :6], weight[:, 12:] = 4.0, 0.0  # beside what is to dig, heaps may lie
    goal = as_goal(scene, js.Goal(far, above=weight, below=0.0, power=power))
    bounds = [least_distance(scene, level, goal, strokes, 0.05) for strokes in (1, 2, 100)]
    assert goal.distance(level) > bounds[0] > bounds[1] > bounds[2] == 0
    after = js.step(scene, level, [0.025, 0.1, 0.075, 0.1]).height
    assert goal.distance(np.asarray(after, float)) >= bounds[0]


@pytest.mark.parametrize(
    ("goal", "message"),
    [
        (js.Goal(LEVEL, above=-1.0), r"goal.above: got -1.0; give a weight of 0 or more, or a map .* \[6, 7\]"),
        (js.Goal(LEVEL, below=LEVEL[:3]), r"goal.below: got an array of shape \[3, 7\]"),
        (js.Goal(LEVEL, below=np.nan), "goal.below: got nan"),
        (js.Goal(LEVEL[:3]), r"goal: got shape \[3, 7\]"),
        (js.Goal(LEVEL, 0.0, 0.0), "goal: got NaN, free, in every cell"),
        (js.Goal(LEVEL + np.inf), "goal: got 42 cells that are not finite"),
        ("none", "goal: got str; give a height map"),
        (js.Goal(js.Goal(LEVEL)), "goal: got Goal; give a height map"),
    ],
)
def test_goals_that_make_no_sense_are_refused(goal, message):
    with pytest.raises(ValueError, match=message):
        as_goal(SCENE, goal)
    with pytest.raises(ValueError, match=message):
        js.plan_sand(SCENE, LEVEL, goal)
    with pytest.raises(ValueError, match=message):
        js.optimise_strokes(SCENE, goal)
