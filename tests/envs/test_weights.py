"""Goals that say what matters, in environments: rewards by hand, what an agent sees, and what is refused."""

import warnings
from dataclasses import replace

import chex
import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

import jaxsand as js
import jaxsand.gym
from jaxsand import envs

from .cases import KEY, QUICK, SMALL, digging, level, program, small

RNG = np.random.default_rng(0)
SHAPE, DEPTH = (16, 16), SMALL.tool.depth
MAPS = RNG.normal(0, 0.004, (3, *SHAPE)).astype(np.float32)
HOLES = np.where(RNG.random((3, *SHAPE)) < 0.3, np.nan, MAPS)
ABOVE, BELOW = RNG.uniform(0, 2, (2, 3, *SHAPE)).astype(np.float32)
GOAL = js.Goal(HOLES, ABOVE, BELOW[0])
PUSHES = jnp.float32([[-0.5, -0.3, 0.4, 0.2], [0.6, 0.5, -0.2, 0.1]])


def weighed(goals=GOAL, **options):
    return small(goals=goals, **options)


def by_hand(goal, above, below, power, height):
    """The distance of a map, cell by cell."""
    total = 0.0
    for g, a, b, h in zip(
        *(np.broadcast_to(x, SHAPE).ravel().astype(float) for x in (goal, above, below, height)), strict=True
    ):
        if not np.isnan(g):
            total += a * max(h - g, 0) ** power + b * max(g - h, 0) ** power
    return total ** (1 / power)


def test_rewards_are_what_the_goals_distance_fell_by():
    env, params = weighed()
    _, state = env.reset(KEY, params)
    goal, above, below = (np.asarray(x) for x in (state.goal.height, state.goal.above, state.goal.below))
    for push in PUSHES:
        before, (_, state, reward, *_) = state, program(env)(KEY, state, push, params)
        far = [by_hand(goal, above, below, 2, one.height) / DEPTH for one in (before, state)]
        assert float(reward) == pytest.approx(far[0] - far[1], abs=2e-6 * far[0])
        assert far[0] != far[1]
    by_sums = replace(state, goal=replace(state.goal, power=1))
    assert float(env.distance(by_sums, params)) * DEPTH == pytest.approx(
        by_hand(goal, above, below, 1, state.height), rel=1e-5
    )


def test_a_goal_is_drawn_with_its_weights_and_shown_with_them():
    env, params = weighed()
    obs, states = jax.vmap(env.reset, (0, None))(jax.random.split(KEY, 16), params)
    free = np.isnan(HOLES)
    own = [np.argmin([np.abs(np.where(free[k], 0, MAPS[k]) - goal).max() for k in range(3)]) for goal in states.goal.height]
    assert set(own) == {0, 1, 2}
    for i, k in enumerate(own):
        for name, map_ in (("goal", MAPS[k] / DEPTH), ("above", ABOVE[k]), ("below", BELOW[0]), ("current", 0 * MAPS[k])):
            np.testing.assert_allclose(obs[name][i], np.where(free[k], 0, map_), rtol=1e-6)
    space = env.observation_space(params)
    assert set(space.spaces) == {"goal", "current", "above", "below"}
    assert space.contains(jax.tree.map(lambda x: x[0], obs))


def test_free_cells_do_not_matter():
    env, params = weighed()
    _, state = env.reset(KEY, params)
    free = (np.asarray(state.goal.above) == 0) & (np.asarray(state.goal.below) == 0)
    heaped = replace(state, height=jnp.where(free, 1.0, state.height))
    assert free.any()
    assert float(env.distance(state, params)) == float(env.distance(heaped, params))


def test_weights_that_are_numbers_are_neither_shown_nor_compiled_for():
    """They are leaves: another number is the same program, and may differ from one environment to the next."""
    plain, own = level(goals=MAPS)
    env, params = weighed(js.Goal(MAPS, above=0.0, below=2.0))
    assert env == plain
    assert env.observation_space(params) == plain.observation_space(own)
    _, state = env.reset(KEY, params)
    height = jnp.asarray(MAPS.mean(0))
    far = float(env.distance(replace(state, height=height), params)) * DEPTH
    assert far == pytest.approx(by_hand(np.asarray(state.goal.height), 0, 2, 2, height), rel=1e-5)

    def distance(above):
        return env.distance(replace(state, height=height, goal=replace(state.goal, above=above)), params)

    several = jax.vmap(distance)(jnp.float32([0, 1, 4]))
    assert (np.diff(several) > 0).all()
    assert float(jax.grad(distance)(jnp.float32(1))) == pytest.approx(
        float(distance(jnp.float32(1.01)) - distance(jnp.float32(0.99))) / 0.02, rel=1e-2
    )


def test_without_weights_nothing_changes():
    env, params = level(goals=MAPS)
    assert isinstance(params.goals.goals, jax.Array)
    obs, state = env.reset(KEY, params)
    assert set(obs) == {"goal", "current"}
    ones = weighed(js.Goal(MAPS, np.ones(SHAPE)))[1]
    same = env.reset(KEY, ones)[1]
    assert np.array_equal(state.goal, same.goal.height)
    assert float(env.distance(same, ones)) == pytest.approx(float(env.distance(state, params)), rel=1e-6)


def test_a_map_is_a_goal_and_its_gaps_are_free():
    for goals in (MAPS[0], js.Goal(MAPS[0])):
        assert envs.weights.heights(weighed(goals)[1].goals.goals).shape == (1, *SHAPE)
    masked = weighed(np.ma.masked_invalid(HOLES))[1].goals.goals
    chex.assert_trees_all_equal(masked, weighed(HOLES)[1].goals.goals)
    assert np.array_equal(masked.above == 0, np.isnan(HOLES))


def test_sand_to_begin_from_can_be_given():
    start = np.abs(MAPS) / 4
    for starts, own in ((start[0], start[[0, 0, 0]]), (jnp.asarray(start), start)):
        env, params = weighed(starts=starts)
        assert np.array_equal(params.goals.starts, own)
    _, state = env.reset(KEY, params)
    assert any(np.array_equal(state.height, one) for one in start)


def test_digs_take_such_goals_too():
    env, params = digging(goals=GOAL)
    obs, state = env.reset(KEY, params)
    assert set(obs) == {"goal", "current", "load", "above", "below"}
    assert env.observation_space(params).contains(obs)
    far = float(env.distance(state, params)) * params.scene.tool.depth
    goal = np.asarray(state.goal.height)
    assert far == pytest.approx(by_hand(goal, state.goal.above, state.goal.below, 2, np.zeros(SHAPE)), rel=1e-5)


def gym(goals=GOAL, **options):
    return gymnasium.make(jaxsand.gym.MULTI, goals=goals, scene=SMALL, push=QUICK, batching=envs.Together(), **options)


def test_gymnasium_finds_nothing_wrong():
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", ".*(infinity|render_fps).*")  # heights have no bounds
        check_env(gym(render_mode="rgb_array").unwrapped)


def test_relabelled_goals_are_rewarded_by_their_weights():
    """As an algorithm with hindsight calls it: batches of what was achieved, of goals, and of infos."""
    env = gym()
    env.reset(seed=0)
    rows = [(obs, reward, info) for obs, reward, *_, info in (env.step(np.asarray(push)) for push in PUSHES)]
    achieved, desired = (np.stack([row[0][name] for row in rows]) for name in ("achieved_goal", "desired_goal"))
    assert achieved.shape == desired.shape == (2, *env.observation_space["desired_goal"].shape) == (2, 3, *SHAPE)
    infos, reward_of = np.array([row[2] for row in rows]), env.unwrapped.compute_reward
    assert reward_of(achieved, desired, infos).tolist() == [row[1] for row in rows]
    assert reward_of(achieved.reshape(2, -1), desired.reshape(2, -1), infos).tolist() == [row[1] for row in rows]
    core, state, params = (getattr(env.unwrapped, name) for name in ("core", "state", "params"))
    before = replace(state, height=jnp.asarray(rows[1][2]["previous"] * DEPTH))
    assert rows[1][1] == pytest.approx(float(core.distance(before, params) - core.distance(state, params)), abs=2e-5)
    reached = reward_of(achieved, achieved, infos)  # what was reached is the goal, and weighs as the goal did
    sand, previous = rows[1][0]["observation"], rows[1][2]["previous"]
    assert reached[1] == pytest.approx(by_hand(sand, state.goal.above, state.goal.below, 2, previous), rel=1e-6)
    with pytest.raises(
        ValueError, match=r"^desired_goal: got shape \[1, 3, 16, 16\] for 2 infos; give \[3, 16, 16\] with one"
    ):
        reward_of(achieved, desired[:1], infos)


def test_relabelled_goals_are_rewarded_by_weights_that_are_numbers():
    reward = gym(js.Goal(MAPS, 0.25, 1.0, 1)).unwrapped.compute_reward(MAPS[:2], MAPS[1:], [{"previous": 0 * MAPS[0]}] * 2)
    far = [[by_hand(goal, 0.25, 1, 1, one) for one in (0, after)] for goal, after in zip(MAPS[1:], MAPS, strict=False)]
    assert reward == pytest.approx(-np.diff(far)[:, 0])


def test_a_vector_shows_what_single_environments_show():
    options = {"goals": GOAL, "scene": SMALL, "push": QUICK, "batching": envs.Together(), "limit": 1}
    vector = gymnasium.make_vec(jaxsand.gym.MULTI, num_envs=2, **options)
    obs, _ = vector.reset(seed=3)
    alone = [gym(limit=1) for _ in range(2)]
    begun = [env.reset(seed=3 + i)[0] for i, env in enumerate(alone)]
    assert all(np.array_equal(obs[name][i], one[name]) for i, one in enumerate(begun) for name in obs)
    obs, reward, _, truncated, info = vector.step(np.asarray(PUSHES))
    assert truncated.all()
    assert not obs["observation"].any()  # begun anew
    for i, env in enumerate(alone):
        last, own, *_ = env.step(np.asarray(PUSHES[i]))
        assert reward[i] == pytest.approx(own, abs=2e-5)
        assert info["final_obs"][i]["achieved_goal"] == pytest.approx(last["achieved_goal"], abs=2e-5)
    assert vector.observation_space.contains(obs)


@pytest.mark.parametrize(
    ("build", "message"),
    [
        (lambda: weighed(measure=envs.OnlyDug()), "^measure: got OnlyDug.*leave it out, and give the weights as goals=Goal"),
        (lambda: digging(goals=GOAL, measure=envs.OnlyDug()), "^measure: got OnlyDug"),
        (lambda: weighed(HOLES, measure=envs.Weighted(0.0)), "^measure: got Weighted"),
        (lambda: weighed(js.Goal(MAPS, -1.0)), "^goals.above: got -1.0; give a weight of 0 or more"),
        (lambda: weighed(js.Goal(MAPS, below=np.ones((5, 5)))), r"^goals.below: got an array of shape \[5, 5\]"),
        (lambda: weighed(js.Goal(MAPS, ABOVE[:2])), "^goals.above: got 2 maps for 3 goals; give one map"),
        (lambda: weighed(js.Goal(MAPS, 0 * ABOVE[0], 0.0)), "^goals: got NaN, free, in every cell"),
        (lambda: weighed(js.Goal(MAPS + np.inf)), "^goals: got 256 cells that are not finite"),
        (lambda: weighed(js.Goal(MAPS[:, :5])), r"^goals: got shape \[5, 16\], the scene has \[16, 16\]"),
        (lambda: weighed(starts=MAPS[:2]), r"^starts: got float32 of shape \[2, 16, 16\] for 3 goals; give a map"),
        (lambda: weighed(starts=0.1 * np.eye(16)), r"^starts: got a slope of 1\d.*, steeper than repose .*settle it first"),
        (lambda: weighed(starts=MAPS[0, :5]), r"^starts: got shape \[5, 16\], the scene has"),
        (
            lambda: weighed(envs.LevelGoals(js.Goal(MAPS, ABOVE[0]))),
            r"^goals: got above of shape \[16, 16\] and below of shape \[\]; give two numbers, or",
        ),
        (lambda: weighed(envs.LevelGoals(js.Goal(MAPS, -ABOVE, BELOW))), "^goals.above: got a weight that is below 0"),
        (lambda: weighed(scene=js.make_scene(SHAPE, 0.01, tool=js.Blade(depth=0.0))), "^scene.tool.depth: got 0.0 m"),
    ],
)
def test_what_cannot_be_made_is_said(build, message):
    with pytest.raises(ValueError, match=message):
        build()


def test_goals_that_are_ready_may_have_weights():
    ready = envs.RoughGoals(js.Goal(MAPS, ABOVE, BELOW), np.abs(MAPS))
    env, params = weighed(ready)
    assert env.observation_space(params).contains(env.reset(KEY, params)[0])
