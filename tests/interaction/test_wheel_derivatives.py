"""Derivatives of what a wheel leaves behind, in sub-steps and in one go."""

import math
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxsand as js

from ..conftest import ANGLE
from .test_wheel import DX, SPLIT, STEPPED, STROKE, both, level, quick

SMALL = (12, 24)
WEIGHTS = np.random.default_rng(9).standard_normal(SMALL)
NAMES = ("stroke", "radius", "width", "sinkage", "slip_angle", "height")


def loss(push, stroke, radius, width, sinkage, slip, height):
    sand = js.make_scene(SMALL, DX, ANGLE, tool=js.Wheel(radius, width, sinkage, slip))
    return jnp.sum(WEIGHTS * js.step(sand, height, stroke, push=push).height)


def point(seed):
    """A stroke on gentle dunes, and a direction for each of what the loss depends on."""
    rng = np.random.default_rng(seed)
    y, x = np.indices(SMALL) / 10
    dunes = sum(2e-3 * rng.uniform(-1, 1) * np.sin(rng.uniform(0.5, 2) * x + rng.uniform(0.5, 2) * y) for _ in range(4))
    stroke = np.array([0.06, 0.05, 0.17, 0.07]) + rng.uniform(-0.01, 0.01, 4)
    at = tuple(jnp.asarray(v, float) for v in (stroke, 0.041, 0.043, 0.0122, 0.47, dunes))
    ways = [rng.standard_normal(v.shape) for v in at]
    return at, [v / np.linalg.norm(v) for v in ways]


def moved(at, i, step):
    return (*at[:i], at[i] + step, *at[i + 1 :])


@pytest.mark.slow
def test_forward_derivatives_in_sub_steps():
    """Against central differences of 1e-9, to 1e-5 and 1e-6 (a gradient is some 10 long)."""
    f = partial(loss, STEPPED)
    forward = quick(lambda at, v: jax.jvp(f, at, v))
    zero = tuple(jnp.zeros_like(v) for v in point(0)[0])
    for seed in range(2):
        at, ways = point(seed)
        for i, (name, v) in enumerate(zip(NAMES, ways, strict=True)):
            up, down = (float(forward(moved(at, i, sign * 1e-9 * v), zero)[0]) for sign in (1, -1))
            slope = float(forward(at, moved(zero, i, v))[1])
            assert slope == pytest.approx((up - down) / 2e-9, rel=1e-5, abs=1e-6), name


@pytest.mark.parametrize(
    "push", [pytest.param(STEPPED, marks=pytest.mark.slow, id="stepped"), pytest.param(SPLIT, id="split")]
)
def test_gradients(push):
    """As forward; and finite at the ends of what wheels and strokes there are."""
    f = partial(loss, push)
    value_and_grad = quick(jax.value_and_grad(f, range(6)))
    for seed in range(2):
        at, ways = point(seed)
        g = value_and_grad(*at)[1]
        for i, (name, v) in enumerate(zip(NAMES, ways, strict=True)):
            up, down = (float(value_and_grad(*moved(at, i, sign * 1e-9 * v))[0]) for sign in (1, -1))
            assert float(jnp.sum(g[i] * v)) == pytest.approx((up - down) / 2e-9, rel=1e-5, abs=1e-6), name
    ends = [(jnp.asarray(s), *at[1:]) for s in ([0.1, 0.06, 0.1, 0.06], [5.0, 5.0, 6.0, 6.0], [0.1, 0.06, 5.0, 0.06])]
    for slip, sinkage in ((0.0, 0.0122), (math.pi / 2, 0.0122), (0.3, 0.041), (0.0, 1e-6)):
        ends.append((*at[:3], jnp.asarray(sinkage, float), jnp.asarray(slip, float), at[5]))
    for end in ends:
        assert all(np.all(np.isfinite(v)) for v in value_and_grad(*end)[1])
    assert not np.any(value_and_grad(*ends[1])[1][0])


def left(v):
    """Of a pass in one go, by slip angle, sinkage, radius, width, and how far to the side."""
    wheel = js.Wheel(sinkage=v[1], radius=v[2], width=v[3], slip_angle=v[0])
    sand = js.make_scene((41, 41), 0.008, ANGLE, tool=wheel)
    stroke = jnp.array([0.1013, 0.1643, 0.2227, 0.1643]) + v[4] * jnp.array([0, 1, 0, 1])
    return 1e6 * jnp.sum(js.step(sand, jnp.zeros((41, 41)), stroke, push=SPLIT).height ** 2)


left_and_slopes = quick(lambda some: jax.lax.map(jax.value_and_grad(left), some))


@pytest.mark.wide
@pytest.mark.parametrize(("slip", "which"), [(0.0, 3), (0.7, 3), (0.7, 0), (0.7, 4)])
def test_derivatives_in_one_go_add_up_to_the_change(slip, which):
    """Over a cell's width, in steps larger than a sample: edges of the cut count."""
    base, steps = np.array([slip, 0.0153, 0.0481, 0.0507, 0.0007]), np.linspace(-1, 1, 41)
    many = np.repeat(base[None], len(steps), axis=0)
    many[:, which] += steps * (0.1 if which == 0 else 0.004)
    values, slopes = left_and_slopes(many)
    summed = np.trapezoid(slopes[:, which], many[:, which])
    assert abs(summed - (values[-1] - values[0])) < 0.03 * np.ptp(values)


@pytest.mark.wide
@pytest.mark.parametrize("field", [{"sinkage": -0.01}, {"sinkage": 0.06}, {"slip_angle": 1.7}])
@both
def test_a_traced_wheel_that_is_none_is_flagged(push, field):
    name, value = next(iter(field.items()))

    def tow(traced):
        return js.step(
            js.make_scene((12, 16), 0.02, tool=js.Wheel(**{name: traced})), level(shape=(12, 16)), STROKE, push=push
        )

    out = quick(tow)(value)
    assert int(out.outcome) == js.Outcome.NOT_FINITE
    assert not np.any(out.height)
