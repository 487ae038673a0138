"""Paths with heights: tools that rise and sink on their way."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxsand as js
from jaxsand.goals.metrics import volume_error

from ..conftest import ANGLE, turned

DX = 0.01
N = 24
SIDE = N * DX
BLADE = js.Blade(width=0.04, thickness=0.03, depth=0.01)
SAND = js.make_scene((N, N), DX, ANGLE, tool=BLADE)
ROUGH = np.random.default_rng(3).uniform(-0.002, 0.002, (N, N))
DIVING = np.array([[0.05, 0.06, 0.02], [0.12, 0.09, -0.012], [0.19, 0.17, 0.004]])
WHEEL = js.Wheel(radius=0.04, width=0.03, sinkage=0.012, slip_angle=0.3)


@pytest.mark.wide
@pytest.mark.parametrize("tool", [BLADE, WHEEL])
def test_a_path_at_one_height_is_the_level_path(tool):
    sand = js.make_scene((N, N), DX, ANGLE, tool=tool)
    deep = tool.depth if isinstance(tool, js.Blade) else tool.sinkage
    level, path = np.zeros((N, N)), DIVING[:, :2]
    at_height = js.follow(sand, level, np.column_stack([path, np.full(3, -deep)]))
    flat = js.follow(sand, level, path)
    assert np.abs(at_height.height - flat.height).max() < 1e-9
    assert np.abs(flat.height).max() > 0.5 * deep


def test_sand_is_kept_and_the_outcome_is_clean():
    out = js.follow(SAND, ROUGH, DIVING)
    js.check(out)
    h = np.asarray(out.height)
    assert volume_error(ROUGH, h) < 1e-12
    assert np.array_equal(h[:4, :5], ROUGH[:4, :5])  # where the blade was still in the air, nothing moved
    assert h.min() < -0.011
    assert float(out.residual) <= 1e-3


@pytest.mark.wide
def test_mirrors_and_quarter_turns():
    start, stop = DIVING[0], DIVING[1]
    height = np.asarray(js.step(SAND, ROUGH, [*start, *stop]).height)
    for turn, (x0, y0, x1, y1) in turned((*start[:2], *stop[:2]), SIDE):
        other = js.step(SAND, turn(ROUGH), [x0, y0, start[2], x1, y1, stop[2]]).height
        assert np.abs(other - turn(height)).max() < 2e-6


def channel(spacing, heights, way=0.16):
    """A blade 20 mm thick, as wide as its bed, just before it is lifted: distance from the blade (m), and the height."""
    cells = round(0.4 / spacing)
    scene = js.make_scene((4, cells), spacing, math.radians(31), tool=js.Blade(0.05, 0.02, 0.012))
    y = 2 * spacing
    path = [[0.05, y, heights[0]], [0.05 + way, y, heights[1]]]
    height = np.asarray(js.act(scene, np.zeros((4, cells)), np.ravel(path)).height)[1]
    return (np.arange(cells) + 0.5) * spacing - 0.05 - way, height


@pytest.mark.parametrize(
    ("heights", "cut"), [((0.0, -0.012), 0.012 * 0.18 / 2 + 0.012 * 0.01), ((-0.012, 0.0), 0.012 * 0.18 / 2)]
)
def test_what_is_cut_stands_ahead_as_a_triangle(heights, cut):
    """A flat sole of thickness t leaves the floor where its rear passes as it sinks, and where its front passes as it rises;
    all that it cut, the integral of that floor, stands ahead of it."""
    x, h = channel(0.005, heights)
    slope = (heights[1] - heights[0]) / 0.16
    behind = (x > -0.13) & (x < -0.02)
    lag = 0.01 if slope < 0 else -0.01  # of the centre behind the edge that leaves the floor
    floor = heights[1] + slope * (x + lag)
    assert np.abs(h - floor)[behind].max() < 1e-4
    ahead = x > 0.01
    volume = h[ahead].sum() * 0.005
    whole = -floor[(x > -0.17 - lag) & (x < 0.01)].clip(-0.012, 0).sum() * 0.005
    assert volume == pytest.approx(whole, rel=0.02)
    assert h[ahead].max() == pytest.approx(math.sqrt(2 * math.tan(math.radians(31)) * volume), rel=0.06)


@pytest.mark.wide
def test_a_wheel_that_rises_leaves_a_rut_that_rises():
    sand = js.make_scene((N, N), 0.005, ANGLE, tool=js.Wheel(radius=0.03, width=0.05, sinkage=0.012))
    h = np.asarray(js.act(sand, np.zeros((N, N)), [0.02, 0.06, -0.008, 0.1, 0.06, -0.001]).height)
    x = (np.arange(N) + 0.5) * 0.005
    rut = h[11:13].mean(0)[(x > 0.04) & (x < 0.075)]
    slope = np.polyfit(x[(x > 0.04) & (x < 0.075)], rut, 1)[0]
    assert slope == pytest.approx(0.0875, abs=0.01)
    assert volume_error(np.zeros((N, N)), h) < 1e-12


@pytest.mark.wide
def test_a_batch_is_its_strokes():
    strokes = np.array([[*DIVING[0], *DIVING[1]], [*DIVING[2], *DIVING[1]]])
    batch = js.step_batch(SAND, np.stack([ROUGH, ROUGH]), strokes)
    for k in range(2):
        assert np.abs(batch.height[k] - js.step(SAND, ROUGH, strokes[k]).height).max() < 1e-9
    rolled = js.rollout(SAND, ROUGH, strokes)
    assert np.abs(rolled.height[0] - batch.height[0]).max() < 1e-9


@pytest.mark.parametrize("neighbours", [8, pytest.param("isotropic", marks=pytest.mark.slow)])
def test_derivatives_by_heights(neighbours):
    sand = js.make_scene((16, 16), DX, ANGLE, neighbours, tool=BLADE)
    rough, weights = ROUGH[:16, :16], np.random.default_rng(4).standard_normal((16, 16))

    @jax.jit
    @jax.value_and_grad
    def loss_and_slope(stroke):
        return jnp.sum(weights * js.act(sand, rough, stroke).height)

    for numbers in ([0.031, 0.042, 0.001, 0.102, 0.083, -0.011], [0.031, 0.042, -0.012, 0.102, 0.083, -0.0013]):
        stroke = np.array(numbers)
        slope, step = np.asarray(loss_and_slope(stroke)[1]), 1e-8
        for way in (*np.eye(6)[[2, 5]], np.array([0.6, -0.5, 0, 0.4, 0.48, 0])):  # by each height, and along the ground
            up, down = (float(loss_and_slope(stroke + sign * step * way)[0]) for sign in (1, -1))
            assert slope @ way == pytest.approx((up - down) / (2 * step), rel=1e-4, abs=1e-4 * np.abs(slope).max())


@pytest.mark.parametrize(("place", "value"), [((1, 2), math.nan), ((0, 2), math.inf)])
def test_a_height_that_is_not_finite_is_an_outcome(place, value):
    path = DIVING.copy()
    path[place] = value
    out = js.follow(SAND, ROUGH, path)
    assert js.Outcome.NOT_FINITE in js.Outcome(int(out.outcome))
    assert np.array_equal(out.height, ROUGH)


def test_a_leg_straight_down_is_an_outcome_and_one_of_no_length_is_none():
    down = js.follow(SAND, ROUGH, np.stack([DIVING[0], DIVING[1], DIVING[1] - [0, 0, 0.003]]))
    assert js.Outcome.NOT_FINITE in js.Outcome(int(down.outcome))
    assert np.array_equal(down.height, ROUGH)
    still = js.follow(SAND, ROUGH, np.stack([DIVING[0], DIVING[1], DIVING[1]]))
    assert not int(still.outcome)


def test_pushes_at_one_depth_refuse_heights():
    with pytest.raises(ValueError, match=r"path: got heights.*give SteppedPush"):
        js.step(SAND, ROUGH, [*DIVING[0], *DIVING[1]], push=js.SwathPush())
    with pytest.raises(
        ValueError, match=r"stroke: got shape \[5\]; give x0, y0, x1, y1 in metres, or x0, y0, z0, x1, y1, z1"
    ):
        js.step(SAND, ROUGH, np.zeros(5))
    with pytest.raises(ValueError, match=r"path: got shape \[3, 4\]; give at least two points"):
        js.follow(SAND, ROUGH, np.zeros((3, 4)))
