"""Derivatives by hand (_advance.py, _contact_sweeps.py) against central differences, on the ways where they differ."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxsand as js
from jaxsand.autodiff.while_loop import Plain, repeat, repeat_until

SHAPE = (14, 16)
RNG = np.random.default_rng(4)
WEIGHTS = RNG.standard_normal(SHAPE)
HEIGHT = 2e-3 * np.sin(np.arange(14)[:, None] / 2.1) * np.cos(np.arange(16)[None, :] / 2.7)
ANGLES = 0.5 + 0.03 * RNG.uniform(size=SHAPE)
SOLID = np.zeros(SHAPE, bool)
SOLID[5:7, 9:11] = True
PATH = np.array([[0.0413, 0.0627], [0.1131, 0.0842], [0.0727, 0.0311]])


def central(f, x, seed=0, e=1e-7):
    """The gradient of f at a tuple x; checked, along one random direction of each argument, both ways."""
    slopes = jax.jit(jax.grad(f, range(len(x))))(*x)
    value, forward = jax.jit(f), jax.jit(lambda x, v: jax.jvp(f, x, v)[1])
    size = np.sqrt(sum(np.sum(np.square(np.nan_to_num(g))) for g in slopes))
    for i, g in enumerate(slopes):
        v = np.random.default_rng(seed).standard_normal(np.shape(x[i]))
        v = np.where(np.isfinite(x[i]), v / np.linalg.norm(v), 0)
        up, down = (value(*x[:i], x[i] + s * e * v, *x[i + 1 :]) for s in (1, -1))
        slope = float(np.sum(np.where(v == 0, 0, g) * v))
        assert slope == pytest.approx(float(up - down) / (2 * e), rel=1e-5, abs=1e-5 * size), i
        tangents = tuple(jnp.asarray(v) if k == i else jnp.zeros_like(a) for k, a in enumerate(x))
        assert float(forward(x, tangents)) == pytest.approx(slope, rel=1e-8, abs=1e-9 * size), i
    return slopes


WAYS = {
    "walls": {"walls": SOLID},
    "angles in a window": {"window": js.Window((12, 12), 1.0), "angle": ANGLES},
    "straight neighbours": {"neighbours": 4},
    "draining": {"edge": js.Draining(-0.003)},
    "isotropic": {"neighbours": "isotropic"},
}


@pytest.mark.parametrize("name", [pytest.param(n, marks=() if "window" in n else pytest.mark.slow) for n in WAYS])
def test_a_path_of_two_legs(name):
    options = dict(WAYS[name])
    walls, angle = options.pop("walls", None), jnp.asarray(options.pop("angle", 0.5))

    def loss(path, height, angle, width, thickness, depth, rate):
        tool = js.Blade(width, thickness, depth)
        if walls is not None:
            options["walls"] = js.Walls(walls)
        scene = js.make_scene(SHAPE, 0.01, angle, tool=tool, **options)
        done = js.follow(scene, height, path, push=js.SteppedPush(sweeps=4, rate=rate), stop=js.Sweeps(8))
        return jnp.sum(jnp.where(SOLID, 0, WEIGHTS * done.height))

    x = (PATH, HEIGHT, angle, 0.0231, 0.0152, 0.0077, 0.12)
    central(loss, tuple(jnp.asarray(v, float) for v in x))


@pytest.mark.parametrize("count", [0, 5, 16, 17, 100, 777])
def test_long_loops_restore_what_the_tape_lost(count):
    """x <- p x (1 - x), where every step's derivative differs, against the same steps in a scan; lanes of unequal length."""

    def body(p, k, x):
        return p * x * (1 - x) + 1e-3 * jnp.sin(1.0 * k)

    def scanned(p, x, n):
        return jax.lax.fori_loop(0, n, lambda k, x: body(p, k, x), x)

    def looped(p, x, n):
        return repeat_until(lambda q, k, x: k >= q[1], Plain(lambda q, k, x: body(q[0], k, x)), 1000, (p, n), x)[0]

    p, x = jnp.asarray(2.9), jnp.array([0.3, 0.4])
    ends = jnp.array([count, count // 2])
    found = jax.jit(jax.vmap(jax.grad(looped, (0, 1)), (None, 0, 0)))(p, x, ends)
    expected = jax.jit(jax.vmap(lambda x, n: jax.jacfwd(scanned, (0, 1))(p, x, n)))(x, ends)
    for a, b in zip(found, expected, strict=True):
        assert np.allclose(a, b, rtol=1e-10, atol=1e-300)


def test_a_counted_loop_is_restored_as_well():
    def looped(p, x):
        return repeat(Plain(lambda p, k, x: p * jnp.sin(x + k)), 60, p, x)

    x = jnp.array([0.3, 0.4])
    found = jax.vmap(jax.grad(looped), (None, 0))(1.1, x)
    assert np.allclose(found, jax.vmap(jax.jacfwd(looped), (None, 0))(1.1, x), rtol=1e-10)
