"""Derivatives by hand (_advance.py, _contact_sweeps.py) against central differences, on the ways where they differ."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxsand as js
from jaxsand.autodiff.while_loop import repeat
from jaxsand.interaction._contact_sweeps import Beside
from jaxsand.relaxation.flux import tool_in_sand
from jaxsand.relaxation.ghost_cells import prepare, quantum
from jaxsand.relaxation.sweep import Flow

SHAPE = (14, 16)
RNG = np.random.default_rng(4)
WEIGHTS = RNG.standard_normal(SHAPE)
HEIGHT = 2e-3 * np.sin(np.arange(14)[:, None] / 2.1) * np.cos(np.arange(16)[None, :] / 2.7)
ANGLES = 0.5 + 0.03 * RNG.uniform(size=SHAPE)
SOLID = np.zeros(SHAPE, bool)
SOLID[5:7, 9:11] = True
PATH = np.array([[0.0413, 0.0627], [0.1131, 0.0842], [0.0727, 0.0311]])


def central(f, x, seed=0, e=1e-8):
    """The gradient of f at a tuple x; checked, along one random direction of each argument, both ways."""
    slopes = jax.jit(jax.grad(f, range(len(x))))(*x)
    forward = jax.jit(lambda x, v: jax.jvp(f, x, v))
    size = np.sqrt(sum(np.sum(np.square(np.nan_to_num(g))) for g in slopes))
    for i, g in enumerate(slopes):
        v = np.random.default_rng(seed).standard_normal(np.shape(x[i]))
        v = np.where(np.isfinite(x[i]), v / np.linalg.norm(v), 0)
        tangents = tuple(jnp.asarray(v) if k == i else jnp.zeros_like(a) for k, a in enumerate(x))
        up, down = (forward((*x[:i], x[i] + s * e * v, *x[i + 1 :]), tangents)[0] for s in (1, -1))
        slope = float(np.sum(np.where(v == 0, 0, g) * v))
        assert slope == pytest.approx(float(up - down) / (2 * e), rel=1e-5, abs=1e-5 * size), i
        assert float(forward(x, tangents)[1]) == pytest.approx(slope, rel=1e-8, abs=1e-9 * size), i
    return slopes


def test_sweeps_around_a_tool_that_stands_in_the_sand():
    """Those of the closed form between two legs."""
    bed, rng = prepare(js.make_scene(SHAPE, 0.01, 0.5)), np.random.default_rng(5)
    cover = rng.uniform(0.1, 0.8, SHAPE)

    def loss(height, cover, bottom, rate):
        params = bed, Flow(rate, quantum(jnp.asarray(1.0))), tool_in_sand(cover, bottom)
        return jnp.sum(WEIGHTS * repeat(Beside(3), 1, params, (height, None))[0])

    central(loss, tuple(jnp.asarray(v, float) for v in (rng.normal(0, 0.01, SHAPE), cover, -0.0061, 0.11)))


WAYS = {
    "walls and a draining edge": {"walls": SOLID, "edge": js.Draining(-0.003)},
    "isotropic, angles and a window": {"window": js.Window((12, 12), 1.0), "angle": ANGLES, "neighbours": "isotropic"},
}


@pytest.mark.slow  # by default, test_gradients.py and relaxation/test_settling.py have the derivatives' parts
@pytest.mark.parametrize("name", WAYS)
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
