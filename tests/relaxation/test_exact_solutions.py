"""Settling against exact solutions, with fitted orders of convergence. Lengths in m, float64."""

import math

import numpy as np
import pytest

import jaxsand as js

from ..conftest import ANGLE, MU


def order(spacings, errors):
    return np.polyfit(np.log(spacings), np.log(errors), 1)[0]


def line(n, width, shape_of):
    """A settled 1-D map [n] over [-width/2, width/2] and its cell centres."""
    dx = width / n
    x = (np.arange(n) + 0.5) * dx - width / 2
    scene = js.make_scene((1, n), dx, ANGLE)
    stop = js.UntilStill(1e-7, bound=400_000, interval=32)
    s = js.settle(scene, shape_of(x)[None], scheme=js.Relaxation(0.5), stop=stop)
    js.check(s)
    return x, np.asarray(s.height)[0], dx


def ridge(x, a, h):
    if h <= 2 * MU * a:
        return np.clip(MU * (a + h / (2 * MU) - np.abs(x)), 0, h)
    return np.maximum(math.sqrt(2 * a * h * MU) - MU * np.abs(x), 0)


@pytest.mark.parametrize("sign", [1, -1])
def test_ridge_and_slot(sign):
    """A low block leaves a trapezoid, to the tolerance; a high one a triangle, to second order in the spacing."""
    spacings, errors = [], []
    for n in (32, 64, 128, 256):
        x, s, dx = line(n, 2.0, lambda x: sign * 0.2 * (np.abs(x) < 0.25))
        assert np.abs(s - sign * ridge(x, 0.25, 0.2)).max() < 1e-6
        x, s, dx = line(n, 2.0, lambda x: sign * 0.4 * (np.abs(x) < 0.125))
        spacings.append(dx)
        errors.append(np.abs(s - sign * ridge(x, 0.125, 0.4)).sum() * dx / 0.1)
    assert errors[-1] < 0.001
    assert order(spacings, errors) > 1.5


def test_point_source_between_walls_in_one_dimension():
    """A column against the closed edge spreads as half of a column twice as wide."""
    _, whole, _ = line(128, 2.0, lambda x: 0.4 * (np.abs(x) < 0.125))
    _, half, _ = line(64, 1.0, lambda x: 0.4 * (x < -0.375))
    assert np.allclose(whole[64:], half, atol=2e-6)


def radius(n, dx):
    c = (np.arange(n) - (n - 1) / 2) * dx
    return np.hypot(c[:, None], c[None, :])


def settle2d(h, dx, edge=None, tolerance=1e-4):
    scene = js.make_scene(h.shape, dx, ANGLE, edge=edge)
    s = js.settle(scene, h, scheme=js.Relaxation(1 / 6.83), stop=js.UntilStill(tolerance, bound=400_000, interval=32))
    js.check(s)
    return np.asarray(s.height), s


@pytest.mark.parametrize("sign", [1, -1])
@pytest.mark.parametrize(("wide", "h"), [(0.5, 0.2), (0.2, 0.3)])
def test_cylinder_and_pit(sign, wide, h):
    """A low one leaves a frustum, a high one a cone: within the 8-neighbour anisotropy (a cone's peak is x1.036)."""
    n, dx = 65, 2 / 65
    r = radius(n, dx)
    start = h * (r < wide)
    volume = start.sum() * dx**2
    got, _ = settle2d(sign * start, dx)
    got = sign * got
    R = math.sqrt(volume / (math.pi * h))  # of the cylinder of the same volume
    if h <= math.sqrt(3) * MU * R:
        toe = h / (2 * MU) + math.sqrt(R**2 - h**2 / (12 * MU**2))
        exact = np.clip(MU * (toe - r), 0, h)
        assert got[n // 2, n // 2] == pytest.approx(h, abs=1e-3)
    else:
        toe = (3 * R**2 * h / MU) ** (1 / 3)
        exact = np.maximum(MU * (toe - r), 0)
        assert got[n // 2, n // 2] / (MU * toe) == pytest.approx(1.018, abs=0.035)
    assert np.abs(got - exact).sum() * dx**2 / volume < 0.08
    assert np.abs(got).sum() * dx**2 == pytest.approx(volume, rel=1e-9)


def grow(n, centre, volume, deposits=20):
    h = np.zeros((n, n))
    for _ in range(deposits):
        h[centre] += volume / deposits
        h = settle2d(h, 1.0, tolerance=1e-3)[0].copy()
    return h


def test_point_source_its_wall_and_its_corner():
    """The peak of a pile grown at a point is that of the exact cone times the 8-neighbour factor 1.036, and no more; against
    a wall it is the pile of twice the volume, in a corner of four times."""
    n = 49
    volume = math.pi * MU * (0.26 * n) ** 3 / 3
    free = grow(n, (n // 2, n // 2), volume)
    exact = (3 * MU**2 * volume / math.pi) ** (1 / 3)
    assert free[n // 2, n // 2] / exact == pytest.approx(1.036, abs=0.036)
    wall = grow(n, (0, n // 2), volume / 2)
    corner = grow(n, (0, 0), volume / 4)
    # The source cell of the halved pile lies beside the wall, half a cell off the mirror line.
    assert wall[0, n // 2] / exact == pytest.approx(1.036, abs=0.05)
    assert corner[0, 0] / exact == pytest.approx(1.036, abs=0.06)


@pytest.mark.wide
@pytest.mark.parametrize(("rows", "columns"), [(24, 24), (16, 32)])
def test_overfilled_draining_table(rows, columns):
    """Open edges: h = mu times the distance to the edge; V = mu W^2 (3 L - W) / 12. Second order in the volume."""
    spacings, errors = [], []
    for k in (1, 2):
        dx = 1 / (24 * k)
        h = np.full((rows * k, columns * k), 0.5)
        got, s = settle2d(h, dx, js.Draining(0.0))
        y, x = ((np.arange(n) + 0.5) * dx for n in h.shape)
        L, W = max(h.shape) * dx, min(h.shape) * dx
        distance = np.minimum(np.minimum(x, h.shape[1] * dx - x)[None, :], np.minimum(y, h.shape[0] * dx - y)[:, None])
        assert np.abs(got - MU * distance).max() < 1e-4 * L
        exact = MU * W**2 * (3 * L - W) / 12
        spacings.append(dx)
        errors.append(abs(got.sum() * dx**2 - exact) / exact)
        assert float(s.drained) == pytest.approx(0.5 * L * W - got.sum() * dx**2, rel=1e-9)
    assert errors[-1] < 0.01
    assert order(spacings, errors) > 1.5
