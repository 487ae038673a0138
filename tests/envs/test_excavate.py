"""Excavation: bed and bucket keep their sand, digs are the simulator's, goals can be met."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxsand as js
from jaxsand import envs
from jaxsand.envs.digs import placed
from jaxsand.envs.pushing import ByLength

from .cases import KEY, LINES, QUICK, SCOOPING, digging, program

CAPACITY = SCOOPING.tool.capacity
DOUBLE = envs.LevelGoals(np.zeros((1, 16, 16)))
SCOOP = [0.03, 0.05, -0.004, 0.07, 0.06, -0.01]
AIR = [0.03, 0.05, 0.001, 0.07, 0.06, 0.002]
HEAP = [0.11, 0.11]


def held(state):
    """What the bucket holds (m^3), as float64 has it."""
    return (float(state.load.high) + float(state.load.low)) * 1e-4


def lies(state):
    return float(np.asarray(state.height, float).sum()) * 1e-4


def dug(env, params, dig, state=None):
    state = env.reset(KEY, params)[1] if state is None else state
    action = env.action(jnp.asarray(dig, state.height.dtype), params)
    obs, after, reward, _, _, info = program(env)(KEY, state, action, params)
    assert env.observation_space(params).contains(obs)
    return after, float(reward), info


@pytest.mark.parametrize("dtype", ["float64", pytest.param("float32", marks=pytest.mark.slow)])
def test_bed_and_bucket_keep_their_sand_on_random_walks(dtype):
    env, params = digging(goals=envs.LevelGoals(np.zeros((1, 16, 16), dtype)))
    _, state = env.reset(KEY, params)
    loads, earned = [], 0.0
    for k in range(40):
        action = env.action_space(params).sample(jax.random.fold_in(KEY, k)).astype(dtype)
        obs, state, reward, *_ = program(env)(KEY, state, action, params)
        assert np.isfinite(np.asarray(state.height)).all()
        assert abs(lies(state) + held(state)) < (1e-8 if dtype == "float64" else 1e-6) * CAPACITY
        loads.append(float(obs["load"]))
        earned += float(reward)
    assert 0 <= min(loads) < 0.2
    assert 0.6 < max(loads) <= 1
    assert earned == pytest.approx(-float(env.distance(state, params)), abs=1e-4)


@pytest.mark.slow
def test_a_dig_is_the_simulators_scoop_and_dump():
    env, params = digging(goals=DOUBLE)
    scooped = js.scoop(SCOOPING, np.zeros((16, 16)), np.reshape(SCOOP, (2, 3)), push=QUICK)
    half = js.load_volume(SCOOPING, scooped.load) / 2
    poured = js.dump(SCOOPING, scooped.height, [HEAP], scooped.load, amount=half)
    after, _, info = dug(env, params, [*SCOOP, *HEAP, 0.5])
    assert int(info["outcome"]) == 0
    assert np.abs(after.height - poured.height).max() < 1e-9
    assert held(after) == pytest.approx(float(half), rel=1e-9)


def test_a_dump_of_part_leaves_the_rest_for_the_next():
    env, params = digging(goals=DOUBLE)
    state, _, _ = dug(env, params, [*SCOOP, *HEAP, 0.25])
    first = held(state) / 0.75
    assert first == pytest.approx(0.03 * np.hypot(0.04, 0.01) * 0.007, rel=0.05)  # width, length, mean depth
    state, _, _ = dug(env, params, [*AIR, *HEAP, 0.0], state)
    assert held(state) == pytest.approx(0.75 * first, rel=1e-12)
    state, _, info = dug(env, params, [*AIR, *HEAP, 1.0], state)
    assert int(info["outcome"]) == 0
    assert held(state) < 1e-15 * CAPACITY  # less than floats tell apart
    assert abs(lies(state)) < 1e-15 * CAPACITY


def test_a_full_bucket_pours_all_or_is_full():
    env, params = digging(goals=DOUBLE)
    long = [0.02, 0.05, -0.014, 0.14, 0.06, -0.014]
    state, _, _ = dug(env, params, [*long, *HEAP, 0.0])
    assert held(state) == pytest.approx(CAPACITY, rel=1e-6)
    assert float(env.observe(state, params)["load"]) == pytest.approx(1, abs=1e-6)
    state, _, info = dug(env, params, [*AIR, *HEAP, 1.0], state)
    assert int(info["outcome"]) == 0
    assert held(state) < 1e-15 * CAPACITY


def test_what_makes_no_sense_is_told_of():
    env, params = digging(goals=DOUBLE)
    state, _, _ = dug(env, params, [*SCOOP, *HEAP, 0.0])
    after, _, info = dug(env, params, [*AIR, *HEAP, 1.5], state)
    assert int(info["outcome"]) == js.Outcome.NOT_POURED
    assert held(after) < 1e-15 * CAPACITY
    for dig in ([*AIR, *HEAP, -0.5], [np.nan, *AIR[1:], *HEAP, 0.0], [*AIR, np.nan, 0.1, 0.5]):
        after, reward, info = dug(env, params, dig, state)
        assert int(info["outcome"]) & js.Outcome.NOT_FINITE
        assert reward == 0
        assert held(after) == held(state)
        assert np.array_equal(after.height, state.height)
    with pytest.raises(ValueError, match=r"^action: got shape \[6\]; give 9 numbers"):
        env.step_env(KEY, state, np.zeros(6), params)


@pytest.mark.slow
def test_a_stop_ends_an_episode_in_place_of_a_dig():
    env, params = digging(stop=envs.Stop())
    state, _, _ = dug(env, params, [*SCOOP, *HEAP, 0.5])
    action = env.action(jnp.float32([*SCOOP, *HEAP, 1.0]), params)
    assert action.shape == (10,)
    _, after, reward, terminated, _, _ = program(env)(KEY, state, action.at[9].set(1), params)
    assert (float(reward), bool(terminated), held(after)) == (0, True, held(state))
    assert np.array_equal(after.height, state.height)


@pytest.mark.wide
def test_the_digs_that_a_goal_was_drawn_from_make_it():
    drawn = envs.RandomDigs(goals=2, fewest=1, most=2)
    env, pool = digging(goals=drawn, seed=5)
    params = digging(goals=DOUBLE)[1]
    plans = drawn.plans(np.random.default_rng(5), env.heights)
    for plan, goal in zip(plans, pool.goals.goals, strict=True):
        state = replace(env.reset(KEY, params)[1], goal=goal.astype(float))
        begun, earned = float(env.distance(state, params)), 0.0
        for dig in placed(SCOOPING, plan):
            state, reward, info = dug(env, params, dig, state)
            assert int(info["outcome"]) == 0
            earned += reward
        assert begun > 2
        assert float(goal.min()) < -0.003
        assert float(goal.max()) > 0.003
        assert held(state) < 1e-15 * CAPACITY
        assert earned == pytest.approx(begun, rel=1e-3)


def test_heaps_are_apart_from_pits():
    for plan in envs.RandomDigs(goals=64, apart=0.3).plans(np.random.default_rng(1), envs.Heights()):
        assert ((plan[:, 2::3][:, :2] <= 0) & (plan[:, 2::3][:, :2] >= -2)).all()
        for x0, y0, _, x1, y1, _, x, y, share in plan:
            along = np.linspace(0, 1, 101)
            assert np.hypot(x0 + along * (x1 - x0) - x, y0 + along * (y1 - y0) - y).min() >= 0.3 - 1e-9
            assert share == 1


@pytest.mark.slow
def test_goals_of_other_environments_are_made_by_a_blade_as_wide():
    _, params = digging(goals={"line": LINES["line"]})
    scene = replace(SCOOPING, tool=js.Blade(width=0.03))
    strokes = np.array(LINES["line"][0]) * 0.125 + 0.0175  # a map half as wide
    expected = js.step(scene, np.zeros((16, 16), "float32"), strokes, push=QUICK).height
    assert np.abs(params.goals.goals[0] - expected).max() < 2e-6
    rough = digging(goals=np.zeros((2, 16, 16), "float32"), starts=envs.Rough(0.01))[1]
    assert isinstance(rough.goals, envs.RoughGoals)


RIGHT = np.arange(16) >= np.full((16, 1), 9)
THROUGH = [0.03, 0.055, -0.004, 0.13, 0.055, -0.014]


@pytest.mark.wide
def test_zones_keep_the_bucket_out_and_its_sand_in():
    env, params = digging(goals=DOUBLE, zones=envs.ClippedBy(RIGHT))
    state, _, info = dug(env, params, [*THROUGH, 0.04, 0.12, 0.0])
    assert (bool(info["clipped"]), bool(info["poured"])) == (True, True)
    assert float(info["went"]) == pytest.approx(0.6, abs=1e-9)  # the edge cuts up to where its way ends
    assert held(state) == pytest.approx(0.03 * 0.06 * (0.004 + 0.01) / 2, rel=0.05)  # and at the height that it had there
    left = float(state.height[:, 9:].min())
    state, _, info = dug(env, params, [*SCOOP, *HEAP, 1.0])
    assert (bool(info["clipped"]), bool(info["poured"]), float(info["went"])) == (True, False, 1)
    assert held(state) > 5e-6
    assert not np.asarray(state.height)[10:, 9:].any()
    assert left > -0.005  # what slid into the pit, and no more
    refused(env, params, [*HEAP, -0.01, 0.13, 0.055, -0.01, 0.04, 0.12, 1.0], state)


@pytest.mark.slow
def test_a_dig_that_meets_a_zone_may_be_refused():
    env, params = digging(zones=envs.RefusedBy(RIGHT))
    state, _, info = dug(env, params, [*SCOOP, *HEAP, 1.0])
    assert (bool(info["clipped"]), bool(info["poured"]), float(info["went"])) == (True, False, 1)
    refused(env, params, [*THROUGH, 0.04, 0.12, 1.0], state)


def refused(env, params, dig, state):
    """What may not be begun is not ended by pouring either."""
    after, reward, info = dug(env, params, dig, state)
    assert (bool(info["clipped"]), float(info["went"]), reward, int(info["outcome"])) == (True, 0, 0, 0)
    assert held(after) == held(state)
    assert np.array_equal(after.height, state.height)


@pytest.mark.slow
def test_derivatives_are_those_of_small_differences_however_it_is_batched():
    rng = np.random.default_rng(0)
    weight, worth = jnp.asarray(rng.normal(size=(16, 16))), 3.0
    slopes = []
    for batching in (envs.Together(), ByLength(2)):
        env, params = digging(goals=DOUBLE, batching=batching)
        state = env.reset(KEY, params)[1]

        def left(numbers, env=env, params=params, state=state):
            state = replace(state, load=replace(state.load, high=numbers[9]))
            after = env.step_env(KEY, state, env.action(numbers[:9], params), params)[1]
            return (after.height * weight).sum() + worth * after.load.high

        digs = jnp.array([[*SCOOP, *HEAP, 0.4, 0.03], [0.032, 0.051, -0.008, 0.081, 0.043, -0.004, 0.121, 0.112, 0.7, 0.02]])
        slopes.append(jax.jit(jax.vmap(jax.grad(left)))(digs))
    np.testing.assert_allclose(*slopes, atol=1e-9 * np.abs(slopes).max())
    loss, size = jax.jit(left), 1e-7
    for dig, slope in zip(digs, slopes[0], strict=True):
        differences = [float(loss(dig + size * e) - loss(dig - size * e)) / (2 * size) for e in jnp.eye(10)]
        np.testing.assert_allclose(slope, differences, atol=1e-4 * np.abs(differences).max())


@pytest.mark.parametrize(
    ("build", "message"),
    [
        (lambda: digging(scene=js.make_scene((16, 16), 0.01, tool=js.Blade())), "^scene.tool: got Blade; give make_scene"),
        (lambda: digging(scene="x"), r"^scene: got 'x'; give make_scene\(\.\.\., tool=Bucket"),
        (
            lambda: digging(scene=js.make_scene((16, 16), 0.01, tool=js.Bucket(0.03, 0.03, 2e-5, depth=-0.01))),
            "^scene.tool.depth: got -0.01 m; give a depth above 0",
        ),
        (lambda: digging(push=js.SwathPush()), "^push: got SwathPush.*one depth"),
        (lambda: digging(heights=envs.OwnDepth()), "^heights: got OwnDepth"),
        (
            lambda: digging(wind=1),
            "^wind: no option of excavate; give some of goals, starts, seed, scene, limit, zones, batching, heights, measure,",
        ),
        (lambda: digging(limit=0), "^limit: got 0"),
        (lambda: digging(goals="x"), "^goals: got str; give RandomStrokes"),
        (lambda: digging(goals=envs.RandomDigs(apart=0.7)), "^goals: got RandomDigs.*apart from 0 to 0.5"),
        (lambda: digging(goals=envs.RandomDigs(most=0)), "^goals: got RandomDigs.*fewest <= most"),
        (lambda: digging(goals=envs.RandomDigs(goals=1), starts="x"), "^starts: got 'x'; give Level"),
        (lambda: js.make("multi-stroke", goals=envs.RandomDigs()), "^goals: got RandomDigs; give RandomStrokes"),
    ],
)
def test_what_cannot_be_made_is_said(build, message):
    with pytest.raises(ValueError, match=message):
        build()
