"""Derivatives of an environment's step: by default, in both modes, of batches too, and through episodes."""

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxsand as js
from jaxsand.envs.pushing import ByLength, Together, by_length

from .cases import KEY, LINES, SMALL

STROKES = np.random.default_rng(0).uniform(0.1, 0.9, (5, 4))
MAPS = np.random.default_rng(1).uniform(-1, 1, (5, 3, 2))


def push(scene, height, stroke):
    """As a push is: a map and a code, of a scene that holds floats and more."""
    mean = jnp.where(scene["solid"], 0, height).mean()
    return jnp.sin(height * stroke[0]) + scene["angle"] * stroke[3] * mean, (stroke[2:] * 9).astype(int).sum()


def score(way):
    return lambda scene, height, stroke: (way({**scene, "solid": SOLID}, height, stroke)[0] ** 3).sum()


SOLID = np.arange(6).reshape(3, 2) == 4
WAYS = score(by_length(ByLength(2), push)), score(push)


@pytest.mark.wide
@pytest.mark.parametrize("axes", [(0, 0, 0), (None, 0, 0), (None, 0, None), (None, None, 0)])
def test_derivatives_are_those_of_the_push_alone(axes):
    everything = {"angle": np.linspace(0.3, 0.7, 5)}, MAPS, STROKES
    x = tuple(
        jax.tree.map(lambda leaf, axis=axis: jnp.asarray(leaf if axis == 0 else leaf[0]), part)
        for part, axis in zip(everything, axes, strict=True)
    )
    slopes, of_sum, forward = [], [], []
    for way in WAYS:
        slopes.append(jax.vmap(jax.grad(way, (0, 1, 2)), axes)(*x))
        of_sum.append(jax.grad(lambda x, way=way: jax.vmap(way, axes)(*x).sum())(x))
        forward.append(jax.vmap(lambda *x, way=way: jax.jvp(way, x, x)[1], axes)(*x))
    chex.assert_trees_all_close(*slopes, rtol=1e-10)
    chex.assert_trees_all_close(*of_sum, rtol=1e-10)
    chex.assert_trees_all_close(*forward, rtol=1e-10)


def test_one_push_and_pushes_one_after_the_other():
    scene = {"angle": jnp.float64(0.5)}
    chex.assert_trees_all_close(*(jax.grad(way, (0, 1, 2))(scene, MAPS[0], jnp.asarray(STROKES[0])) for way in WAYS))
    ends = []
    for way in (by_length(ByLength(2), push), push):

        def end(strokes, way=way):
            one = lambda height, stroke: (way(scene | {"solid": SOLID}, height, stroke)[0], None)  # noqa: E731
            return (jax.lax.scan(one, jnp.asarray(MAPS[0]), strokes)[0] ** 3).sum()

        ends.append(jax.grad(end)(jnp.asarray(STROKES)))
    chex.assert_trees_all_close(*ends)


def test_a_second_derivative_is_refused():
    scene = {"angle": jnp.float64(0.5)}
    slope = jax.grad(lambda stroke: WAYS[0](scene, MAPS[0], stroke))
    with pytest.raises(NotImplementedError, match="second derivatives"):
        jax.grad(lambda stroke: slope(stroke).sum())(jnp.asarray(STROKES[0]))


@pytest.mark.slow
def test_by_default_an_environment_has_gradients():
    actions = jnp.float32([[-0.5, -0.4, 0.3, 0.2], [0.1, -0.5, 0.2, -0.3]])
    slopes = []
    for options in ({}, {"batching": Together()}):
        own = {"goals": LINES, "scene": SMALL, "push": js.SwathPush(), "settle": js.Sweeps(8)}
        env, params = js.make("multi-stroke", **own, **options)
        state = env.reset(KEY, params)[1]
        reward = jax.jit(jax.grad(lambda a, env=env, state=state, params=params: env.step(KEY, state, a, params)[2]))
        slopes.append(np.stack([reward(a) for a in actions]))
    assert isinstance(js.env.MultiStroke().batching, ByLength)
    assert np.abs(slopes).max(2).min() > 0.01
    np.testing.assert_allclose(*slopes, rtol=2e-3, atol=2e-3 * np.abs(slopes).max())
