"""How near to a goal sand can come at best: closed forms, another solver, and bounds that no map at rest gets below."""

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import linprog

import jaxsand as js
from jaxsand.goals.feasible import CellCosts, _iterates, _limits, at_best, lagrangian
from jaxsand.goals.goal import as_goal

SHAPE, DX = (9, 12), 0.01
SIZE = SHAPE[0] * SHAPE[1]
LEVEL = np.zeros(SHAPE)
RNG = np.random.default_rng(0)
ROUGH = RNG.normal(size=SHAPE) * 0.02
FREE = np.where(RNG.random(SHAPE) < 0.3, np.nan, ROUGH)
ABOVE, BELOW = 10 ** RNG.uniform(-1, 1, (2, *SHAPE))
ANGLES = RNG.uniform(0.3, 0.7, SHAPE)
SOLID = np.zeros(SHAPE, bool)
SOLID[4], SOLID[:3, 5] = True, True
STEEP = np.where(np.arange(12) < 6, -0.05, -0.005) * np.ones(SHAPE)

SCENES = {
    "closed": {},
    "four": {"neighbours": 4, "repose_angle": ANGLES},
    "walls": {"walls": js.Walls(SOLID), "repose_angle": ANGLES},
    "draining": {"edge": js.Draining(-0.01)},
    "tray": {"base": js.Base(-0.01)},
    "all": {"walls": js.Walls(SOLID), "edge": js.Draining(-0.005), "base": js.Base(-0.01)},
}
RELAXED = {
    "isotropic": {"neighbours": "isotropic", "walls": js.Walls(SOLID), "repose_angle": ANGLES},
    "isotropic tray": {"neighbours": "isotropic", "base": js.Base(-0.01)},
    "steep floor": {"base": js.Base(STEEP)},
}
GOALS = [js.Goal(ROUGH), js.Goal(ROUGH, ABOVE, BELOW, 1), js.Goal(FREE, above=(ROUGH < 0) * 1.0), js.Goal(FREE, power=1)]


def scene_of(kind):
    return js.make_scene(SHAPE, DX, **(SCENES | RELAXED)[kind])


def multipliers(scene, start, goal):
    """The limits and costs of a programme, and the solver's last map and multipliers."""
    limits, goal = _limits(scene, start, 1e-3), as_goal(scene, goal)
    cells = CellCosts(*(np.asarray(x)[limits.sand] for x in (goal.height, goal.above, goal.below)), goal.power)
    for k, found in enumerate(_iterates(limits, cells)):
        if k == 12:
            return limits, cells, found
    raise AssertionError


@pytest.mark.parametrize("power", [1, 2])
@pytest.mark.parametrize("rows", [1, 3])
def test_a_trench_with_vertical_walls(rows, power):
    """Of the cells j beyond and j within a wall the first stands at most m (2 j - 1) above the second. So both together
    cost at least 2 (d / 2 - m (j - 1/2))^p, and do, where the ramps through both walls do not meet.
    """
    scene, depth, goal = js.make_scene((rows, 80), DX, 0.4), 0.03, np.zeros((rows, 80))
    goal[:, 32:48] = -depth
    best = at_best(scene, np.zeros((rows, 80)), js.Goal(goal, above=goal < 0, power=power), tolerance=0)
    short = np.maximum(depth / 2 - np.tan(0.4) * DX * (np.arange(1, 9) - 0.5), 0)
    assert best.cost == pytest.approx(rows * 4 * (short**power).sum(), rel=1e-3)
    assert best.bound == pytest.approx(best.cost, rel=1e-3)
    assert best.bound <= rows * 4 * (short**power).sum() * (1 + 1e-9)


def test_a_goal_at_rest_of_the_same_volume_costs_nothing():
    scene = js.make_scene(SHAPE, DX)
    goal = np.asarray(js.settle(scene, ROUGH).height)
    best = at_best(scene, np.full(SHAPE, goal.mean()), goal)
    assert best.distance < 1e-4 * np.linalg.norm(goal - goal.mean())
    assert best.bound == pytest.approx(0, abs=best.cost)
    np.testing.assert_allclose(best.height, goal, atol=1e-5)


@pytest.mark.parametrize("kind", [*SCENES, *RELAXED])
def test_whatever_is_at_rest_lies_within_the_limits(kind):
    """It is then its own best map, and a bound above 0 would be false."""
    scene = scene_of(kind)
    bed = np.maximum(3 * ROUGH, scene.base.height) if isinstance(scene.base, js.Base) else 3 * ROUGH
    left = np.asarray(js.settle(scene, bed).height)
    best = at_best(scene, left, left)
    assert best.bound < 1e-12
    assert best.distance < 1e-6


def test_a_goal_that_lacks_sand_lacks_it_everywhere():
    best = at_best(js.make_scene(SHAPE, DX), LEVEL, np.full(SHAPE, 0.02))
    assert best.cost == pytest.approx((0.02 * SIZE) ** 2 / SIZE, rel=1e-9)
    assert best.distance == pytest.approx(0.02 * np.sqrt(SIZE), rel=1e-9)
    assert best.gap < 1e-6
    assert (
        at_best(js.make_scene(SHAPE, DX, edge=js.Draining(1.0)), LEVEL, np.full(SHAPE, -0.02)).cost < 1e-12
    )  # it may leave


def test_no_more_lies_on_a_table_than_its_rims_carry():
    scene = js.make_scene(SHAPE, DX, 0.5, 4, edge=js.Draining(0.01))
    i, j = np.indices(SHAPE)
    heap = 0.01 + np.tan(0.5) * DX * (np.minimum(np.minimum(i, 8 - i), np.minimum(j, 11 - j)) + 0.5)
    best = at_best(scene, np.full(SHAPE, 1.0), np.full(SHAPE, 0.5), tolerance=0)
    np.testing.assert_allclose(best.height, heap, atol=1e-5)
    assert best.cost == pytest.approx(((0.5 - heap) ** 2).sum(), rel=1e-3)


@pytest.mark.parametrize("kind", SCENES)
@pytest.mark.parametrize("goal", GOALS)
def test_the_best_map_is_at_rest_and_nothing_at_rest_is_better(kind, goal):
    scene = scene_of(kind)
    best = at_best(scene, LEVEL, goal)
    settled = js.settle(scene, best.height)
    assert (int(settled.sweeps), int(settled.outcome)) == (0, 0)
    assert abs(best.height.sum()) < 1e-14 or ("edge" in SCENES[kind] and best.height.sum() < 0)
    assert (best.height[SOLID] == 0).all() or "walls" not in SCENES[kind]
    assert best.cost == pytest.approx(as_goal(scene, goal).cost(best.height), rel=1e-12)
    assert 0 < best.bound <= best.cost <= 1.002 * best.bound
    assert best.gap == best.distance - best.distance_bound
    left = np.asarray(js.settle(scene, np.maximum(ROUGH / 3, -0.01) if "base" in SCENES[kind] else ROUGH / 3).height)
    assert at_best(scene, left, goal).bound <= as_goal(scene, goal).cost(left)


@pytest.mark.parametrize("kind", [pytest.param("isotropic", marks=pytest.mark.wide), "isotropic tray", "steep floor"])
def test_where_the_programme_allows_too_much_the_bound_still_holds(kind):
    scene, start, goal = scene_of(kind), np.zeros(SHAPE), as_goal(scene_of(kind), GOALS[0])
    best = at_best(scene, start, goal)
    assert int(js.settle(scene, best.height).sweeps) == 0
    assert abs(best.height.sum()) < 1e-12
    assert 0 < best.bound <= best.cost < 1.3 * best.bound
    floor = scene.base.height if isinstance(scene.base, js.Base) else -1
    for size in (1e-4, 3e-3):  # maps at rest near the best
        rough = np.maximum(best.height + size * ROUGH / 0.02, floor)
        left = np.asarray(js.settle(scene, np.where(SOLID, 0, rough) if kind == "isotropic" else rough).height)
        assert at_best(scene, left, goal).bound <= goal.cost(left)


@pytest.mark.parametrize("kind", ["four", "walls", "all"])
@pytest.mark.parametrize("goal", GOALS)
def test_any_multipliers_give_a_bound(kind, goal):
    """The solver's own come near the cost, and no others, however wrong, get above it."""
    scene, rng = scene_of(kind), np.random.default_rng(2)
    limits, cells, (h, flow, price) = multipliers(scene, LEVEL, goal)
    best = float(cells.cost(limits.feasible(h)).sum())
    level = float(cells.cost(limits.feasible(np.zeros_like(h))).sum())
    assert 0.98 * best < lagrangian(limits, cells, flow, price, level) <= best
    for size in (1e-3, 0.03, 1, 30):
        wrong = flow * (1 + size * rng.normal(size=flow.shape)) + size * 1e-2 * np.abs(flow).max() * rng.normal()
        assert lagrangian(limits, cells, wrong, price * (1 + size * rng.normal()), level) <= best


def test_another_solver_finds_the_same():
    """The programme with p = 1, link by link, by HiGHS."""
    goal = as_goal(scene_of("tray"), GOALS[1])
    number, mu = np.arange(SIZE).reshape(SHAPE), np.tan(js.DRY_SAND.repose_angle) + 1e-3
    rows, most = [], []
    for i, j in np.ndindex(*SHAPE):
        for k in (i - 1, i, i + 1):
            for m in (j - 1, j, j + 1):
                if (k, m) != (i, j) and 0 <= k < SHAPE[0] and 0 <= m < SHAPE[1]:
                    row = np.zeros(3 * SIZE)
                    row[number[i, j]], row[number[k, m]] = 1, -1
                    rows.append(row)
                    most.append(mu * DX * np.hypot(k - i, m - j))
    eye, none = np.eye(SIZE), np.zeros(SIZE)
    equal = np.concatenate([np.concatenate([eye, -eye, eye], 1), np.concatenate([none + 1, none, none])[None]])
    found = linprog(
        np.concatenate([none, goal.above.ravel(), goal.below.ravel()]),
        np.array(rows),
        np.array(most),
        equal,
        np.append(goal.height.ravel(), 0),
        [(-0.01, None)] * SIZE + [(0, None)] * (2 * SIZE),
    )
    best = at_best(scene_of("tray"), LEVEL, GOALS[1])
    assert best.bound <= found.fun * (1 + 1e-6)
    assert found.fun * (1 - 1e-6) <= best.cost <= 1.002 * best.bound


def test_strokes_leave_no_less():
    scene = js.make_scene(SHAPE, DX, tool=js.Blade(width=0.04, thickness=0.015, depth=0.01))
    goal = np.zeros(SHAPE)
    goal[3:6, 3:9] = -0.01
    for wanted in (js.Goal(goal), js.Goal(goal, above=goal < 0)):
        bound, height = at_best(scene, LEVEL, wanted).bound, jnp.zeros(SHAPE, "float32")
        for stroke in ([0.04, 0.045, 0.08, 0.045], [0.08, 0.045, 0.03, 0.045]):
            height = js.step(scene, height, jnp.array(stroke, "float32")).height
            assert 0 < bound <= wanted.cost(np.asarray(height, float))
        settled = js.settle(scene, goal).height
        assert at_best(scene, np.asarray(settled), wanted).bound <= wanted.cost(np.asarray(settled))


def test_solid_cells_cost_what_they_cost_before_and_a_map_of_no_links_is_its_own_best():
    scene, start = scene_of("walls"), np.where(SOLID, 0.3, 0)
    best = at_best(scene, start, np.zeros(SHAPE))
    assert best.cost == pytest.approx(0.09 * SOLID.sum())
    assert best.bound == pytest.approx(best.cost)
    single = at_best(js.make_scene((1, 1), DX), np.full((1, 1), 0.2), np.zeros((1, 1)))
    assert (single.cost, single.bound) == (pytest.approx(0.04), pytest.approx(0.04))


def test_what_makes_no_sense_is_refused():
    scene, holed = js.make_scene(SHAPE, DX), LEVEL.copy()
    holed[0, 0] = np.nan
    with pytest.raises(ValueError, match="start: got 1 cell"):
        at_best(scene, holed, LEVEL)
    with pytest.raises(ValueError, match=r"shape \[2, 2\], the scene has \[9, 12\]"):
        at_best(scene, np.zeros((2, 2)), LEVEL)
    with pytest.raises(ValueError, match="goal: got"):
        at_best(scene, LEVEL, np.full(SHAPE, np.nan))
    with pytest.raises(ValueError, match="tolerance: got -1; give a slope of 0 or more"):
        at_best(scene, LEVEL, LEVEL, tolerance=-1)
    with pytest.raises(ValueError, match="m below the floor; give a map above scene.base"):
        at_best(scene_of("tray"), LEVEL - 0.02, LEVEL)
    with pytest.raises(ValueError, match=r"scene.walls: got no cell that is not solid"):
        at_best(js.make_scene(SHAPE, DX, walls=js.Walls(np.ones(SHAPE, bool))), LEVEL, LEVEL)
