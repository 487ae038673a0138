"""Derivatives against central differences in float64, forward against reverse mode, and what is refused."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxsand as js

from ..conftest import ANGLE

SHAPE = (20, 24)
WEIGHTS = np.random.default_rng(9).standard_normal(SHAPE)
NAMES = ("stroke", "width", "thickness", "depth", "angle", "height")


def loss(stroke, width, thickness, depth, angle, height):
    scene = js.make_scene(SHAPE, 0.01, angle, tool=js.Blade(width, thickness, depth))
    return jnp.sum(WEIGHTS * js.step(scene, height, stroke).height)


gradient = jax.jit(jax.grad(loss, range(6)))
forward = jax.jit(lambda x, v: jax.jvp(loss, x, v))


def point(seed):
    """A random stroke on random gentle dunes, below repose by 5 degrees or more: away from the kink of links at repose."""
    rng = np.random.default_rng(seed)
    y, x = np.indices(SHAPE) / 10
    height = sum(rng.uniform(-1, 1) * 2e-3 * np.sin(rng.uniform(0.5, 2) * x + rng.uniform(0.5, 2) * y + k) for k in range(4))
    return (rng.uniform(0.03, 0.17, 4), 0.023, 0.0152, 0.0077, 0.5, height)


@pytest.mark.wide
@pytest.mark.usefixtures("both_ways")
@pytest.mark.parametrize("seed", range(3))
def test_a_push_and_its_settling(seed):
    x = tuple(jnp.asarray(v, float) for v in point(seed))
    g = gradient(*x)
    size = np.sqrt(sum(np.sum(np.square(v)) for v in g[:5]))
    assert size > 0.01
    for i, name in enumerate(NAMES):
        v = np.random.default_rng(seed).standard_normal(x[i].shape)
        v = v / np.linalg.norm(v)
        e = 1e-7
        tangents = tuple(jnp.asarray(v) if k == i else jnp.zeros_like(a) for k, a in enumerate(x))
        up, down = (forward((*x[:i], x[i] + sign * e * v, *x[i + 1 :]), tangents)[0] for sign in (1, -1))
        slope = float(jnp.sum(g[i] * v))
        assert slope == pytest.approx(float(up - down) / (2 * e), rel=1e-5, abs=1e-5 * size), name
        assert float(forward(x, tangents)[1]) == pytest.approx(slope, rel=1e-9, abs=1e-12)


@pytest.mark.wide
def test_where_nothing_changes_there_is_no_gradient():
    x = tuple(jnp.asarray(v, float) for v in point(0))
    assert np.array_equal(gradient(jnp.array([5.0, 5.0, 6.0, 6.0]), *x[1:])[0], np.zeros(4))
    assert np.all(np.isfinite(gradient(jnp.array([0.1013, 0.0972] * 2), *x[1:])[0]))  # no length: finite all the same


@pytest.mark.wide
def test_the_gradient_of_settling_is_that_of_its_sweeps():
    h = np.random.default_rng(0).uniform(-0.02, 0.02, SHAPE)
    scene = js.make_scene(SHAPE, 0.01, ANGLE)
    sweeps = int(js.settle(scene, h).sweeps)

    def of(stop):
        def f(h, angle):
            return jnp.sum(WEIGHTS * js.settle(js.make_scene(SHAPE, 0.01, angle), h, stop=stop).height)

        return jax.grad(f, (0, 1))(jnp.asarray(h), ANGLE)

    for a, b in zip(of(None), of(js.Sweeps(sweeps)), strict=True):
        assert np.allclose(a, b, rtol=1e-12, atol=1e-14)


@pytest.mark.slow
@pytest.mark.parametrize("push", [js.SteppedPush(), js.SwathPush()], ids=["stepped", "swath"])
def test_a_blade_of_no_width_has_finite_derivatives(push):
    def pushed(size):
        scene = replace(js.make_scene((12, 12), 0.01), tool=js.Blade(size[0], size[1], 0.0075))
        left = js.step(scene, jnp.zeros((12, 12)), jnp.array([0.03, 0.06, 0.08, 0.07]), push=push)
        return jnp.sum(jnp.sin(300 * left.height))

    slopes = jax.jit(jax.vmap(jax.grad(pushed)))(jnp.array([[0.0, 0.015], [0.02, 0.0], [0.0, 0.0]]))
    assert np.all(np.isfinite(slopes))


@pytest.mark.slow  # by default, batches' gradients are those of test_batched.py
def test_gradients_under_vmap_and_jit_and_where_nothing_changes():
    scene = js.make_scene(SHAPE, 0.01, ANGLE, tool=js.Blade())
    strokes = jnp.array(
        [[0.0513, 0.0627, 0.1531, 0.1042], [0.1017, 0.0533, 0.1241, 0.1529], [5.0, 5.0, 6.0, 6.0], [0.1013, 0.0972] * 2]
    )

    def f(s):
        return jnp.sum(WEIGHTS * js.step(scene, jnp.zeros(SHAPE), s).height)

    many = jax.jit(jax.vmap(jax.grad(f)))(strokes)
    summed = jax.grad(lambda s: jax.vmap(f)(s).sum())(strokes)
    assert np.allclose(many, summed, rtol=1e-9, atol=1e-12)
    assert np.array_equal(many[2], np.zeros(4))
    assert np.all(np.isfinite(many[3]))  # no length: finite all the same


@pytest.mark.slow
def test_a_blade_at_the_edge_of_its_window_has_a_finite_derivative_by_the_spacing():
    def pushed(dx):
        scene = js.make_scene((12, 12), dx, tool=js.Blade(0.05, 0.05, 0.0075), window=js.Window((4, 4)))
        return jnp.sum(js.act(scene, jnp.zeros((12, 12)), jnp.array([0.03, 0.06, 0.08, 0.07])).height)

    assert jnp.isfinite(jax.grad(pushed)(0.01))
