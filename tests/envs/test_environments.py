"""Environments: contracts, rewards that telescope, batches that are their maps."""

from dataclasses import replace

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxsand as js
from jaxsand import envs
from jaxsand.envs.pushing import ByLength, pushing, sorted_by_length

from .cases import KEY, QUICK, SMALL, digging, on_sand, program, rising, small, walks

SLOW = pytest.mark.slow
each = pytest.mark.parametrize(
    "make", [walks, pytest.param(on_sand, marks=SLOW), small, pytest.param(rising, marks=SLOW), digging]
)


def batch(env, params, count):
    keys, draws = (jax.random.split(key, count) for key in jax.random.split(KEY))
    obs, state = jax.vmap(env.reset, (0, None))(keys, params)
    actions = jax.vmap(env.action_space(params).sample)(draws)
    return keys, obs, state, actions


@pytest.mark.wide
@each
def test_spaces_hold_and_one_is_as_many(make):
    env, params = make()
    keys, obs, state, actions = batch(env, params, 5)
    space = env.observation_space(params)
    assert all(space.contains(jax.tree.map(lambda x, i=i: x[i], obs)) for i in range(5))
    many = jax.jit(jax.vmap(env.step, (0, 0, 0, None)))(keys, state, actions, params)
    assert jax.tree.structure(many[1]) == jax.tree.structure(state)
    chex.assert_trees_all_equal_shapes_and_dtypes(many[1], state)
    step = program(env, "step")
    for i in range(5):
        alone = step(keys[i], jax.tree.map(lambda x, i=i: x[i], state), actions[i], params)
        assert space.contains(alone[0])
        chex.assert_trees_all_close(alone, jax.tree.map(lambda x, i=i: x[i], many), atol=2e-5)
    eager = env.step(keys[0], jax.tree.map(lambda x: x[0], state), actions[0], params)
    chex.assert_trees_all_close(eager, jax.tree.map(lambda x: x[0], many), atol=2e-5)


@pytest.mark.wide
@each
def test_a_new_episode_begins_where_one_ended(make):
    env, params = make()
    params = replace(params, limit=2)
    step, go_on = program(env, "step"), program(env)
    key, (obs, state) = KEY, env.reset(KEY, params)
    for time in (1, 2):
        key, own = jax.random.split(key)
        action = (
            jnp.argmax(env.legal(state, params))
            if hasattr(env, "legal")
            else jnp.linspace(-0.5, 0.4, env.size, dtype="float32")
        )
        alone = go_on(own, state, action, params)
        obs, state, reward, terminated, truncated, info = step(own, state, action, params)
        chex.assert_trees_all_close(info["final_observation"], alone[0], atol=1e-5)
        assert float(reward) == pytest.approx(float(alone[2]), abs=1e-5)
        assert (bool(terminated), bool(truncated)) == (False, time == 2)
        assert bool(info["truncated"]) == (time == 2)
        assert not info["terminated"]
        if time == 1:
            chex.assert_trees_all_close((obs, state), alone[:2], atol=1e-5)
    first = env.reset(jax.random.split(own)[1], params)
    chex.assert_trees_all_close((obs, state), first, atol=1e-5)
    assert np.abs(np.asarray(alone[0]["current"]) - np.asarray(obs["current"])).max() > 0.5


@each
def test_rewards_add_up_to_what_was_gained(make):
    env, params = make()
    measure = env.left if isinstance(env, envs.OnMap) else lambda state: env.distance(state, params)
    _, state = env.reset(KEY, params)
    begun, earned = float(measure(state)), 0.0
    step = program(env)
    for k in range(6):
        action = env.action_space(params).sample(jax.random.fold_in(KEY, k))
        _, state, reward, *_ = step(KEY, state, action, params)
        earned += float(reward)
    assert earned == pytest.approx(begun - float(measure(state)), abs=1e-4)
    assert begun != float(measure(state))


@pytest.mark.wide
@each
def test_numbers_never_retrace(make):
    env, params = make()
    chex.clear_trace_counter()

    @jax.jit
    @chex.assert_max_traces(n=1)
    def step(key, state, action, params):
        return env.step(key, state, action, params)

    _, state = env.reset(KEY, params)
    action = env.action_space(params).sample(KEY)
    for k in range(3):
        changed = jax.tree.map(
            lambda x, k=k: x * (1 + 0.01 * k) if jnp.issubdtype(jnp.result_type(x), jnp.floating) else x, params
        )
        _, state, *_ = step(KEY, state, action, replace(changed, limit=20 + k))


def test_actions_reach_from_the_first_to_the_last_cell():
    env, params = small()
    assert env.stroke(jnp.array([-1.0, -1, 1, 1]), params).tolist() == pytest.approx([0.005, 0.005, 0.155, 0.155])
    with_stop, _ = small(stop=envs.Stop())
    assert with_stop.action([0.005, 0.005, 0.155, 0.155], params).tolist() == pytest.approx([-1, -1, 1, 1, -1])


def test_a_stop_ends_an_episode_in_place_of_a_push():
    env, params = small(stop=envs.Stop())
    _, state = env.reset(KEY, params)
    push = jnp.array([-0.5, -0.5, 0.5, 0.3])
    _, after, _, goes_on, _, _ = program(env)(KEY, state, jnp.append(push, -1), params)
    assert not goes_on
    assert np.abs(after.height).max() > 0
    _, after, reward, terminated, truncated, _ = program(env)(KEY, state, jnp.append(push, 1), params)
    assert (float(reward), bool(terminated), bool(truncated)) == (0, True, False)
    assert not np.abs(after.height).any()


def test_a_push_that_is_not_finite_leaves_the_map():
    env, params = small()
    _, state = env.reset(KEY, params)
    _, after, reward, *_, info = program(env)(KEY, state, jnp.float32([0, jnp.nan, 0, 0]), params)
    assert int(info["outcome"]) & js.Outcome.NOT_FINITE
    assert float(reward) == 0
    assert np.array_equal(after.height, state.height)


@pytest.mark.slow
def test_the_angle_of_repose_may_differ_from_one_environment_to_the_next():
    env, params = small(batching=ByLength(2))
    angles = jnp.array([0.3, 0.5, 0.6, 0.45, 0.35])
    keys, _, state, actions = batch(env, params, 5)

    def sand(angle):
        return replace(params, scene=replace(params.scene, material=js.Material(angle)))

    axes = jax.tree.map(lambda _: None, params)
    axes = replace(axes, scene=replace(axes.scene, material=js.Material(0)))
    many = jax.vmap(env.step, (0, 0, 0, axes))(keys, state, actions, sand(angles))
    for i, angle in enumerate(angles):
        alone = env.step(keys[i], jax.tree.map(lambda x, i=i: x[i], state), actions[i], sand(angle))
        assert many[2][i] == pytest.approx(float(alone[2]), abs=1e-5)
    assert len(np.unique(np.asarray(many[2]).round(4))) == 5


@pytest.mark.wide
@pytest.mark.usefixtures("both_ways")
@pytest.mark.parametrize(("size", "chunk"), [(7, 2), (1, 4), (5, 8)])
def test_sorting_a_batch_changes_no_map(size, chunk):
    """Whatever is numpy's and whatever is batched; the next test does it with a real push."""

    def push(scene, height, stroke):
        return height * stroke[0] + scene["angle"], stroke[2:].astype(int).sum()

    rng = np.random.default_rng(0)
    strokes, maps, angles = rng.uniform(0, 9, (size, 4)), rng.uniform(size=(size, 3, 2)), rng.uniform(size=size)
    sorted_ = sorted_by_length(ByLength(chunk), push)
    for scenes, axes in (({"angle": angles}, (0, 0, 0)), ({"angle": 0.5}, (None, 0, 0)), ({"angle": 0.5}, (None, 0, None))):
        inputs = scenes, maps, strokes if axes[2] == 0 else jnp.asarray(strokes[0])
        chex.assert_trees_all_close(jax.vmap(sorted_, axes)(*inputs), jax.vmap(push, axes)(*inputs))
    seeds = jax.vmap(jax.vmap(sorted_, (None, 0, None)), (None, None, 0))({"angle": 0.5}, maps, strokes)
    expected = jax.vmap(jax.vmap(push, (None, 0, None)), (None, None, 0))({"angle": 0.5}, maps, strokes)
    chex.assert_trees_all_close(seeds, expected)


@pytest.mark.wide
@pytest.mark.usefixtures("both_ways")
def test_a_batch_by_length_is_its_maps():
    push = ByLength(2).batched(pushing(QUICK, js.Sweeps(8)))
    rng = np.random.default_rng(1)
    strokes, maps = rng.uniform(0.02, 0.14, (5, 4)).astype("float32"), np.zeros((5, 16, 16), "float32")
    many, outcome = jax.jit(jax.vmap(push, (None, 0, 0)))(SMALL, maps, strokes)
    assert len({round(float(h.min()), 5) for h in many}) > 1
    alone = jax.jit(push)
    for i in range(5):
        height, code = alone(SMALL, maps[i], strokes[i])
        np.testing.assert_allclose(many[i], height, atol=2e-6)
        assert int(code) == int(outcome[i])


@pytest.mark.wide
def test_the_fast_push_digs_too():
    env, params = small(push=js.SwathPush(), limit=jnp.array(2))
    _, state = env.reset(KEY, params)
    action = env.action(jnp.float32([0.03, 0.05, 0.13, 0.08]), params)
    _, after, *_, info = program(env)(KEY, state, action, params)
    assert int(info["outcome"]) == 0
    assert float(after.height.min()) < -0.005


def test_spaces_know_what_belongs_to_them():
    box, choice = envs.Box(-1, 1, (3,)), envs.Discrete(4)
    assert box.contains(jnp.array([0.0, 1, -1]))
    assert not box.contains(jnp.array([0.0, 1.1, -1]))
    assert not box.contains(jnp.array([jnp.nan, 0, 0]))
    assert not box.contains(jnp.zeros(2))
    assert choice.contains(3)
    assert not choice.contains(4)
    assert not choice.contains(0.5)
    both = envs.Dict({"a": box, "b": choice})
    assert both.contains(both.sample(KEY))
    assert not both.contains({"a": jnp.zeros(3)})
    drawn = jax.jit(jax.vmap(envs.Box(0, jnp.inf, ()).sample))(jax.random.split(KEY, 64))
    assert (drawn >= 0).all()
    assert drawn.max() > 1
    assert jax.vmap(envs.Box(-jnp.inf, jnp.inf, ()).sample)(jax.random.split(KEY, 64)).min() < -1
