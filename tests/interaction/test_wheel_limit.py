"""The wheel against what is known of its quasi-static limit: a wall, a triangle, turns that sweep, rims with a level."""

import itertools
import math

import numpy as np
import pytest

import jaxsand as js
from jaxsand.bench.pushes import half_turn
from jaxsand.goals.metrics import volume_error

from ..conftest import ANGLE, MU, padded

DX = 0.01


def heap(spacing, rows=3, neighbours=8, way=0.16, sinkage=0.012):
    """The map ahead of a wheel of 50 mm dragged broadside along a bed narrower than its chord, and the exact triangle."""
    wheel = js.Wheel(sinkage=sinkage, slip_angle=math.pi / 2)
    a = (np.arange(rows) - (rows - 1) / 2) * spacing
    depth = sinkage - np.mean(wheel.radius - np.sqrt(wheel.radius**2 - a**2))
    volume = depth * (way + wheel.width / 2)  # to a unit of width; half of what was under it leaves to the front
    peak, toe = math.sqrt(2 * MU * volume), math.sqrt(2 * volume / MU)
    margin = 0.055 + math.sqrt(depth * wheel.width / MU)
    columns = math.ceil((2 * margin + way + 1.3 * toe) / spacing)
    sand = js.make_scene((rows, columns), spacing, ANGLE, neighbours, tool=wheel)
    stroke = np.array([margin, rows * spacing / 2, margin + way, rows * spacing / 2])
    level = np.zeros((rows, columns), np.float32)
    h = np.asarray(js.act(sand, level, stroke).height, float)
    assert volume_error(level, h) == 0
    edges = np.arange(columns + 1) * spacing - (margin + way + wheel.width / 2)
    inside = np.clip(edges, 0, toe)
    exact = np.diff(inside * peak - MU * inside**2 / 2) / spacing
    ahead = edges[:-1] >= -1e-6 * spacing
    return h.max() / peak, np.abs(h - exact)[:, ahead].mean(0).sum() * spacing / volume


@pytest.mark.wide
@pytest.mark.parametrize(
    ("spacing", "neighbours"),
    [
        (0.008, 8),
        (0.004, 8),
        pytest.param(0.004, 4, marks=pytest.mark.slow),
        (0.004, "isotropic"),
        pytest.param(0.002, 8, marks=pytest.mark.slow),
    ],
)
def test_the_heap_of_a_wheel_as_wide_as_its_bed_is_a_triangle(spacing, neighbours):
    """A rule that sweeps a fixed number of times heaped it 1.3, 1.6, 2.5 times as high on cells of 8, 4, 2 mm."""
    peak, error = heap(spacing, neighbours=neighbours)
    assert peak == pytest.approx(1, abs=0.08)
    assert error < 0.05


@pytest.mark.wide
@pytest.mark.parametrize(("width", "degrees"), [(1.0, 20), (1.5, 0), (1.0, 30)])
def test_a_wheel_dragged_broadside_is_a_wall(width, degrees):
    """Of a chord wider than the bed, it leaves behind it what its rim shaped: nothing got through."""
    shape, wheel = (12, 40), js.Wheel(radius=0.4, width=width * DX, sinkage=0.012, slip_angle=math.pi / 2)
    sand = js.make_scene(shape, DX, ANGLE, tool=wheel)
    head = np.array([math.cos(math.radians(degrees)), math.sin(math.radians(degrees))])
    end = np.array([0.26, 0.06])
    h = np.asarray(js.act(sand, np.zeros(shape), [*(end - 0.14 * head), *end]).height)
    x, y = np.meshgrid((np.arange(shape[1]) + 0.5) * DX, (np.arange(shape[0]) + 0.5) * DX)
    along = (x - end[0]) * head[0] + (y - end[1]) * head[1]
    aside = (y - end[1]) * head[0] - (x - end[0]) * head[1]
    rim = wheel.radius - wheel.sinkage - np.sqrt(wheel.radius**2 - aside**2)
    behind = (along < -0.5 * wheel.width - DX) & (along > -0.06)
    assert (h - rim)[behind].max() < 0.05 * wheel.sinkage
    assert volume_error(np.zeros(shape), h) < 1e-12


@pytest.mark.slow
def test_shorter_sub_steps_change_ever_less():
    """Half of them in sum, from quarters to eighths to sixteenths of a spacing; a rule that drifts changes ever more."""
    strokes = np.array([[0.08, 0.1, 0.2, 0.17], [0.22, 0.2, 0.1, 0.12]])
    for slip in (0.0, 0.4):
        sand = js.make_scene((32, 32), DX, ANGLE, tool=js.Wheel(slip_angle=slip))
        maps = [
            np.asarray(js.step_batch(sand, np.zeros((2, 32, 32)), strokes, push=js.SteppedPush(a, 16)).height)
            for a in (1 / 4, 1 / 8, 1 / 16)
        ]
        apart = [np.abs(a - b).sum() for a, b in itertools.pairwise(maps)]
        assert apart[1] < 0.75 * apart[0]
        assert apart[1] < 0.03 * np.abs(maps[-1]).sum()


@pytest.mark.wide
def test_a_turn_sweeps_and_does_not_depend_on_its_parts():
    sand = js.make_scene((32, 32), DX, ANGLE, tool=js.Wheel(width=0.03, sinkage=0.012))
    maps = [np.asarray(js.follow(sand, np.zeros((32, 32)), padded(half_turn(parts), 6)).height) for parts in (1, 2, 4)]
    for h in maps[1:]:
        assert np.abs(h - maps[0]).sum() < 0.03 * np.abs(maps[0]).sum()
    x, y = np.meshgrid(np.arange(32) + 0.5 - 16, np.arange(32) + 0.5 - 16)
    assert maps[0][np.hypot(x, y) < 2].mean() < -0.7 * 0.012  # it dug where it swept


@pytest.mark.wide
def test_nothing_drains_over_a_rim_above_the_sand():
    stroke, level, drained = [0.16, 0.16, 0.16, 0.5], np.zeros((32, 32)), {}
    for rim in (10.0, 0.0, -0.02):
        sand = js.make_scene((32, 32), DX, ANGLE, tool=js.Wheel(), edge=js.Draining(rim))
        out = js.step(sand, level if rim >= 0 else js.settle(sand, level).height, stroke)
        drained[rim] = float(out.drained)
    assert drained[10.0] == 0
    assert 0 < drained[0.0] < drained[-0.02]
