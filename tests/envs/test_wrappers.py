"""Environments as learners for gymnax expect them: arrays, five values, returns; the same numbers as unwrapped."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxsand as js
from jaxsand import envs
from jaxsand.envs.spaces import Box, Discrete

KEY = jax.random.key(0)


@pytest.fixture(scope="module")
def walks():
    return js.make("single-stroke", limit=5)


def test_a_vector_holds_all_maps_by_name(walks):
    env, params = walks
    wrapped = envs.GymnaxEnv(env, params)
    obs, state = env.reset(KEY, params)
    vector, same = wrapped.reset(KEY)
    assert np.array_equal(vector, np.concatenate([np.ravel(obs[name]) for name in sorted(obs)]))
    assert vector.dtype == jnp.float32
    assert jax.tree.all(jax.tree.map(jnp.array_equal, state, same))
    assert wrapped.observation_space().shape == vector.shape
    stacked = envs.GymnaxEnv(env, params, stacked=True).reset(KEY)[0]
    assert np.array_equal(stacked, np.stack([obs[name] for name in sorted(obs)], axis=-1))


def test_steps_are_the_environments_own(walks):
    """Through ends of episodes: done is terminated or truncated, and the last observation is in info."""
    env, params = walks
    wrapped = envs.GymnaxEnv(env, params)
    given = wrapped.default_params
    assert given.max_steps_in_episode == 5
    own, theirs = jax.jit(env.step), jax.jit(wrapped.step)
    (_, a), (_, b), ends = env.reset(KEY, params), wrapped.reset(KEY, given), 0
    for k in range(12):
        key = jax.random.key(k)
        obs, a, reward, terminated, truncated, info = own(key, a, k % 4, params)
        vector, b, same, done, told = theirs(key, b, k % 4, given)
        assert np.array_equal(vector, np.concatenate([np.ravel(obs[name]) for name in sorted(obs)]))
        final = info["final_observation"]
        assert np.array_equal(told["final_observation"], np.concatenate([np.ravel(final[name]) for name in sorted(final)]))
        assert reward == same
        assert done == (terminated | truncated)
        ends += int(done)
    assert ends >= 2


def test_spaces(walks):
    wrapped = envs.GymnaxEnv(*walks)
    action, obs = wrapped.action_space(), wrapped.observation_space(wrapped.default_params)
    assert type(action).__name__ == "Discrete"
    assert wrapped.num_actions == action.n == walks[0].action_space(walks[1]).n
    assert bool(obs.contains(wrapped.reset(KEY)[0]))
    assert wrapped.name == "OnMap"
    if not type(action).__module__.startswith("gymnax"):
        assert isinstance(action, Discrete)
        assert isinstance(obs, Box)


def test_it_is_static_and_its_parameters_are_not(walks):
    """A jitted function takes it as a static argument, and other parameters do not compile anew."""
    env, params = walks
    traced = []

    @jax.jit(static_argnums=0)
    def begin(wrapped, given):
        traced.append(wrapped)
        return wrapped.reset(KEY, given)[0]

    one, other = envs.GymnaxEnv(env, params), envs.GymnaxEnv(env, js.make("single-stroke", limit=7)[1])
    assert one == other
    assert hash(one) == hash(other)
    begin(one, one.default_params)
    begin(other, other.default_params)
    assert len(traced) == 1


def test_actions_are_cut_to_their_space(monkeypatch):
    taken = []

    class Fake(envs.MultiStroke):
        def step(self, key, state, action, params):
            taken.append(action)
            zero = jnp.zeros(())
            maps = {"goal": jnp.zeros((2, 2)), "current": jnp.zeros((2, 2))}
            return maps, state, zero, zero > 0, zero > 0, {"final_observation": maps}

    params = js.make("multi-stroke", goals=np.zeros((1, 32, 32)))[1]
    envs.GymnaxEnv(Fake(), params).step(KEY, None, jnp.array([3.0, -3.0, 0.5, jnp.inf]))
    assert taken[0].tolist() == [1, -1, 0.5, 1]


def test_returns_are_told(walks):
    """Against sums by hand: told from the step that ends an episode on, and kept until the next one does."""
    env = envs.GymnaxEnv(*walks)
    logged = envs.Logged(env)
    assert logged.default_params.max_steps_in_episode == 5
    assert logged.action_space().n == env.action_space().n
    step, plain = jax.jit(logged.step), jax.jit(env.step)
    (_, state), (_, own), total, length, last = logged.reset(KEY), env.reset(KEY), 0.0, 0, (0.0, 0)
    for k in range(12):
        key = jax.random.key(k)
        _, own, reward, done, _ = plain(key, own, k % 4)
        _, state, same, over, info = step(key, state, k % 4)
        assert same == reward
        total, length = total + float(reward), length + 1
        if done:
            last, total, length = (total, length), 0.0, 0
        assert bool(info["returned_episode"]) == bool(over) == bool(done)
        assert float(info["returned_episode_returns"]) == pytest.approx(last[0], abs=1e-6)
        assert (int(info["returned_episode_lengths"]), int(info["timestep"])) == (last[1], k + 1)
    assert last[1] > 0


def test_what_is_no_map_is_not_stacked():
    """A dig's observation holds its load beside its maps."""
    with pytest.raises(ValueError, match="^stacked: got observations of shapes .*leave it out"):
        envs.GymnaxEnv(*js.make("excavate", goals=np.zeros((1, 32, 32))), stacked=True)


@pytest.mark.slow
def test_an_outside_learner_improves():
    """rejax's PPO, its own code unchanged, for two minutes: better than untrained, on maps and on sand."""
    rejax = pytest.importorskip("rejax")
    walks = envs.GymnaxEnv(*js.make("single-stroke", limit=20))
    strokes = envs.GymnaxEnv(*js.make("multi-stroke", push=js.SwathPush(), settle=js.Sweeps(8)))
    for env, gain, options in (
        (walks, 1.0, {"total_timesteps": 32_768, "eval_freq": 16_384, "num_envs": 64, "num_steps": 64}),
        (
            strokes,
            0.5,
            {"total_timesteps": 60_000, "eval_freq": 20_000, "num_envs": 128, "num_steps": 16, "learning_rate": 1e-3},
        ),
    ):
        algo = rejax.get_algo("ppo").create(env=env, **options)
        _, (_, returns) = jax.jit(algo.train)(jax.random.key(0))
        assert returns[-1].mean() > returns[0].mean() + gain
