"""A blade at an angle to its way: a windrow to one side."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxsand as js
from jaxsand.goals.metrics import volume_error

from ..conftest import ANGLE

DX = 0.01
SHAPE = (24, 32)
TALL = SHAPE[0] * DX
LEVEL = np.zeros(SHAPE)
ROUGH = np.random.default_rng(2).uniform(-0.002, 0.002, SHAPE)
STROKE = np.array([0.06, 0.1, 0.22, 0.13])


def sand(yaw, width=0.06, shape=SHAPE):
    return js.make_scene(shape, DX, ANGLE, tool=js.Blade(width, 0.015, 0.008, yaw))


@pytest.mark.wide
def test_square_is_square():
    found, square = (js.step(sand(yaw), ROUGH, STROKE).height for yaw in (0.0, None))
    assert np.abs(found - square).max() < 1e-12


def test_the_windrow_lies_on_the_side_to_which_the_face_looks():
    middle, stroke = SHAPE[0] // 2, [0.06, TALL / 2, 0.22, TALL / 2]
    heaps = []
    for yaw in (0.0, math.radians(30), math.radians(45)):
        out = js.step(sand(yaw), LEVEL, stroke)
        js.check(out)
        h = np.asarray(out.height)
        assert volume_error(LEVEL, h) < 1e-12
        assert h[middle - 1, 9:18] == pytest.approx(-0.008, abs=1e-4)  # a clean floor: nothing passed
        up = np.clip(h, 0, None)
        heaps.append([up[middle:].sum(), up[:middle].sum(), up[:, 25:].sum()])
    left, right, ahead = np.array(heaps).T
    assert left[0] == pytest.approx(right[0], rel=1e-6)
    assert (left > right)[1:].all()
    assert left[2] > 3 * right[2]
    assert (np.diff(right) < 0).all()
    assert (np.diff(ahead) < 0).all()


def test_mirrored_sand_is_pushed_by_the_mirrored_blade():
    x0, y0, x1, y1 = STROKE
    found = np.asarray(js.step(sand(0.6), ROUGH, STROKE).height)
    other = js.step(sand(-0.6), ROUGH[::-1], [x0, TALL - y0, x1, TALL - y1]).height
    assert np.abs(other - found[::-1]).max() < 1e-9
    turned = js.step(sand(-0.6, shape=SHAPE[::-1]), ROUGH.T, [y0, x0, y1, x1]).height
    assert np.abs(turned - found.T).max() < 1e-9


def test_with_its_leading_end_along_a_wall_the_windrow_is_on_the_other_side():
    yaw = math.radians(40)  # the right end leads
    lead = 0.06 / 2 * math.cos(yaw)
    h = np.asarray(js.step(sand(yaw), LEVEL, [0.06, lead, 0.22, lead]).height)
    behind = h[:, 9:18]
    assert behind[:3].max() < -0.004  # from the wall on it is dug
    assert behind[4:].max() > 0.006  # and the windrow lies beyond


@pytest.mark.slow
def test_derivatives_by_the_angle():
    weights = np.random.default_rng(4).standard_normal((12, 12))
    stroke, rough = np.array([0.031, 0.042, 0.082, 0.073]), ROUGH[:12, :12]

    @jax.jit
    def loss(yaw, stroke):
        scene = js.make_scene((12, 12), DX, ANGLE, tool=js.Blade(0.04, 0.015, 0.008, yaw))
        return jnp.sum(weights * js.act(scene, rough, stroke).height)

    by_yaw, by_stroke = jax.jit(jax.grad(loss, argnums=(0, 1)))(0.7, stroke)
    step = 1e-8
    assert float(by_yaw) == pytest.approx(float(loss(0.7 + step, stroke) - loss(0.7 - step, stroke)) / (2 * step), rel=1e-4)
    for k in range(4):
        way = step * np.eye(4)[k]
        difference = float(loss(0.7, stroke + way) - loss(0.7, stroke - way)) / (2 * step)
        assert float(by_stroke[k]) == pytest.approx(difference, rel=1e-4, abs=1e-4 * float(np.abs(by_stroke).max()))


@pytest.mark.wide
def test_an_angle_out_of_range_is_named():
    with pytest.raises(ValueError, match=r"tool\.yaw: got 1\.5 rad; give -pi/3 to pi/3: for degrees use math\.radians"):
        sand(1.5)
    with pytest.raises(ValueError, match=r"tool\.yaw: got nan; it must be one finite number"):
        sand(math.nan)
    out = jax.jit(lambda yaw: js.step(sand(yaw), LEVEL, STROKE))(2.0)  # traced, it is an outcome
    assert js.Outcome.NOT_FINITE in js.Outcome(int(out.outcome))
    with pytest.raises(ValueError, match=r"scene\.tool\.yaw: got 0\.5; give a blade that stands square"):
        js.step(sand(0.5), LEVEL, STROKE, push=js.SwathPush())
    with pytest.raises(ValueError, match=r"scene\.tool\.yaw: got 0\.5"):
        js.plan_sand(sand(0.5), LEVEL, LEVEL - 0.001 * (ROUGH > 0), strokes=1)
