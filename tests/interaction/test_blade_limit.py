"""The push against what is known of its quasi-static limit: a wall, a triangle, turns that sweep, rims with a level."""

import itertools
import math

import numpy as np
import pytest

import jaxsand as js
from jaxsand.bench import pushes as bench_pushes
from jaxsand.bench.pushes import half_turn, heap, push_speed
from jaxsand.bench.timing import Timed
from jaxsand.goals.metrics import volume_error

from ..conftest import ANGLE, padded

DX = 0.01


def square(n=40, neighbours=8, **parts):
    return js.make_scene((n, n), DX, ANGLE, neighbours, **parts)


@pytest.mark.wide
@pytest.mark.parametrize(
    ("neighbours", "thickness", "degrees"),
    [(8, 1.0, 22.5), (8, 1.5, 0), (8, 2.0, 45), (4, 1.0, 45), ("isotropic", 1.5, 30)],
)
def test_a_blade_is_a_wall(neighbours, thickness, degrees):
    """Wider than the bed, it leaves the floor behind it clean: nothing got through."""
    blade = js.Blade(width=0.8, thickness=thickness * DX, depth=0.012)
    sand = square(neighbours=neighbours, tool=blade)
    way = 0.08 * np.array([math.cos(math.radians(degrees)), math.sin(math.radians(degrees))])
    start, end = 0.2 - way, 0.2 + way
    h = np.asarray(js.act(sand, np.zeros((40, 40)), [*start, *end]).height)
    x, y = np.meshgrid((np.arange(40) + 0.5) * DX, (np.arange(40) + 0.5) * DX)
    along = ((x - end[0]) * way[0] + (y - end[1]) * way[1]) / 0.08
    behind = h[(along < -0.5 * blade.thickness - DX) & (along > -0.1)]
    assert behind.max() < -0.995 * blade.depth
    assert volume_error(np.zeros((40, 40)), h) < 1e-12


@pytest.mark.wide
@pytest.mark.parametrize("spacing", [0.01, 0.005, pytest.param(0.0025, marks=pytest.mark.slow)])
def test_the_heap_of_a_blade_as_wide_as_its_bed_is_a_triangle(spacing):
    found = heap(spacing, js.SteppedPush())
    assert found["error"] < 0.02
    assert found["volume"] == pytest.approx(1, abs=0.012)


@pytest.mark.slow
@pytest.mark.long
@pytest.mark.parametrize(
    "case",
    [{"way": 0.05}, {"way": 0.5}, {"depth": 0.006}, {"angle": math.radians(20)}, {"angle": math.radians(40), "depth": 0.03}],
)
def test_heaps_of_many_kinds_are_triangles(case):
    found = heap(0.005, js.SteppedPush(), **case)
    assert found["toe_cells"] < 8 or found["error"] < 0.02


@pytest.mark.slow
def test_the_result_goes_to_a_limit_with_the_sub_step():
    """Also where they are far shorter than the slivers of cells that a blade leaves open: these once pumped, the more the
    shorter the sub-steps, and no limit was in sight."""
    strokes = np.array([[0.08, 0.1, 0.2, 0.17], [0.22, 0.2, 0.1, 0.12]])
    sand = js.make_scene((32, 32), DX, ANGLE, tool=js.Blade())
    maps = [
        np.asarray(js.step_batch(sand, np.zeros((2, 32, 32)), strokes, push=js.SteppedPush(a, 32)).height)
        for a in (1 / 8, 1 / 32, 1 / 128)
    ]
    apart = [np.abs(a - b).sum() / np.abs(maps[-1]).sum() for a, b in itertools.pairwise(maps)]
    assert apart[1] < 0.6 * apart[0]
    assert apart[1] < 0.015


@pytest.mark.parametrize("neighbours", ["isotropic", pytest.param(8, marks=pytest.mark.wide)])
def test_a_turn_sweeps_and_does_not_depend_on_its_parts(neighbours):
    sand = square(32, neighbours, tool=js.Blade(width=0.1, thickness=0.015, depth=0.0075))
    maps = [np.asarray(js.follow(sand, np.zeros((32, 32)), padded(half_turn(parts), 65)).height) for parts in (1, 2, 4, 16)]
    for h in maps[1:]:
        assert np.abs(h - maps[0]).sum() < 0.02 * np.abs(maps[0]).sum()
    x, y = np.meshgrid(np.arange(32) + 0.5 - 16, np.arange(32) + 0.5 - 16)
    disc = maps[0][np.hypot(x, y) < 2]
    assert disc.mean() < -0.8 * 0.0075  # it dug where it swept


@pytest.mark.slow
def test_isotropic_sand_does_not_overshoot():
    """A blade whose ends leave quarters of cells open once dug up to 60% too much, in one place of hundreds, and below its
    own bottom: what was known of the flow over links that were closed came back when they opened."""
    sand = js.make_scene((64, 64), 0.005, ANGLE, "isotropic", tool=js.Blade(0.06, 0.03, 0.02))
    places = np.array([[0.24, 0], [0.25, 0], [0.26, 0], [0.25, 0.5], [0.75, 0.25], [0.5, 0.125], [0, 0], [0.0625, 0.875]])
    strokes = np.array([0.1, 0.16, 0.22, 0.16]) + 0.005 * np.tile(places[:, ::-1], 2)
    maps = np.asarray(js.step_batch(sand, np.zeros((8, 64, 64), np.float32), strokes).height)
    dug = np.minimum(maps, 0).sum((1, 2))
    assert np.abs(dug / np.median(dug) - 1).max() < 0.08
    assert maps.min() > -0.0201


LINES = [
    pytest.param(tool, apart, n, heading, marks=() if heading == 0.4 and n == own else pytest.mark.slow)
    for tool, apart, own in (
        (js.Blade(), 1e-6, "isotropic"),
        (js.Wheel(slip_angle=0.5), 0.02, 8),
    )  # under a wheel sand waits
    for n in (4, 8, "isotropic")
    for heading in (0.4, 2.8, -1.9)
]


@pytest.mark.wide
@pytest.mark.parametrize(("tool", "apart", "neighbours", "heading"), LINES)
def test_a_line_is_the_same_in_one_leg_and_in_many(tool, apart, neighbours, heading):
    """How sand flows is kept from leg to leg: without it, legs of a quarter of a cell left a map 2 to 27% off."""
    sand = square(32, neighbours, tool=tool)
    way = 0.16 + np.linspace(-0.08, 0.08, 65)[:, None] * np.array([math.cos(heading), math.sin(heading)])
    paths = (padded(way[[0, -1]], 65), way)
    one, many = (np.asarray(js.follow(sand, np.zeros((32, 32)), path).height) for path in paths)
    assert np.abs(many - one).sum() < apart * np.abs(one).sum()


@pytest.mark.parametrize(
    "neighbours", ["isotropic", pytest.param(8, marks=pytest.mark.wide), pytest.param(4, marks=pytest.mark.slow)]
)
def test_how_sand_flows_is_kept_from_one_frame_to_another(neighbours):
    """Legs whose headings lie in turns on the two sides of a bound between octants, so that frames are mirrored or swapped."""
    sand = square(32, neighbours, tool=js.Blade())
    for octant in range(8):
        headings = octant * math.pi / 4 + 1e-4 * (-1.0) ** np.arange(64)
        way = np.cumsum(np.stack([np.cos(headings), np.sin(headings)], 1), 0) * 0.16 / 64
        way = 0.1612 + np.concatenate([np.zeros((1, 2)), way]) - way[-1] / 2
        paths = (padded(way[[0, -1]], 65), way)
        one, many = (np.asarray(js.follow(sand, np.zeros((32, 32)), path).height) for path in paths)
        assert np.abs(many - one).sum() < 1e-3 * np.abs(one).sum(), octant


@pytest.mark.wide
@pytest.mark.compiled
def test_isotropic_sand_moves_alike_in_float32():
    """A gradient that was just at repose once counted as far beyond it, where a compiler rounded its square differently in two
    places: in float32 these strokes were 17 and 16% off."""
    sand = js.make_scene((50, 44), 0.005, ANGLE, "isotropic", tool=js.Blade(0.06, 0.03, 0.02))
    strokes = np.array([0.1, 0.16, 0.14, 0.16]) + 0.005 * np.array([[0, 0.18, 0, 0.18], [0, 0.27, 0, 0.27]])
    push = js.SteppedPush(1 / 32, 32)
    maps = [np.asarray(js.step_batch(sand, np.zeros((2, 50, 44), d), strokes, push=push).height) for d in ("f4", "f8")]
    apart = np.abs(maps[0] - maps[1]).sum((1, 2)) / np.abs(maps[1]).sum((1, 2))
    assert apart.max() < 1e-3


@pytest.mark.slow
@pytest.mark.long
@pytest.mark.parametrize(
    ("tool", "push", "most"),
    [
        (js.Blade(), js.SteppedPush(), 1e-3),
        (js.Blade(), js.SteppedPush(1 / 32, 32), 1e-3),
        (js.Wheel(), js.SteppedPush(), 0.02),
    ],
)
@pytest.mark.parametrize("neighbours", [4, 8, "isotropic"])
def test_random_pushes_move_alike_in_float32(tool, push, most, neighbours):
    sand, strokes = square(32, neighbours, tool=tool), np.random.default_rng(1).uniform(0.04, 0.28, (32, 4))
    maps = [np.asarray(js.step_batch(sand, np.zeros((32, 32, 32), d), strokes, push=push).height) for d in ("f4", "f8")]
    apart = np.abs(maps[0] - maps[1]).sum((1, 2)) / np.abs(maps[1]).sum((1, 2))
    assert apart.max() < most


@pytest.mark.slow  # by default, in test_blade_closed_form.py
def test_nothing_drains_over_a_rim_above_the_sand():
    stroke, level = [0.16, 0.16, 0.16, 0.5], np.zeros((32, 32))
    drained = {}
    for rim in (10.0, 0.0, -0.02):
        sand = square(n=32, tool=js.Blade(), edge=js.Draining(rim))
        out = js.step(sand, level if rim >= 0 else js.settle(sand, level).height, stroke)
        drained[rim] = float(out.drained)
    assert drained[10.0] == 0
    assert 0 < drained[0.0] < drained[-0.02]


@pytest.mark.wide
@pytest.mark.parametrize("short", [0.05, -0.05])
def test_what_drains_from_a_channel_is_its_arithmetic(short):
    """A blade that fills the channel stops `short` of the edge: what does not fit between, at repose from the edge, drains.

    The default push is up to 6% off: sand that it lets run off too early does not come back.
    """
    dx, width, depth, thickness, way = 0.005, 0.015, 0.012, 0.02, 0.15
    columns = 64
    solid = np.zeros((5, columns), bool)
    solid[[0, -1]] = True
    blade = js.Blade(5 * dx, thickness, depth)
    sand = js.make_scene((5, columns), dx, ANGLE, tool=blade, walls=js.Walls(solid), edge=js.Draining(0.0))
    face = columns * dx - short - thickness / 2
    stroke = [face - way, 2.5 * dx, face, 2.5 * dx]
    heap = depth * (way + thickness / 2 + min(short, 0)) - math.tan(ANGLE) * max(short, 0) ** 2 / 2
    for push, off in ((js.SteppedPush(), 0.06), (js.SteppedPush(1 / 8, 32), 0.01)):
        out = js.act(sand, np.zeros((5, columns)), stroke, push=push)
        assert float(out.drained) == pytest.approx(width * heap, rel=off)


@pytest.mark.wide
@pytest.mark.usefixtures("both_ways")
def test_large_maps_are_computed_where_sand_moves():
    level = np.zeros((160, 160), np.float32)
    path = np.array([[0.6, 0.7], [0.75, 0.7], [0.72, 0.83]])
    near = js.follow(square(n=160, tool=js.Blade()), level, path)
    whole = js.follow(square(n=160, tool=js.Blade(), window=js.Whole()), level, path)
    js.check(near)
    assert np.abs(near.height - whole.height).max() < 2e-5


def test_the_benchmark_of_pushes_tells_pushes_a_second(monkeypatch):
    """Of 64 pushes, or of as many as the slower ways are given, by the best of their times."""
    timed = Timed(first=5.0, later=(0.5, 0.25), result=None)
    monkeypatch.setattr(bench_pushes, "race", lambda ways, tell: dict.fromkeys(ways, timed))
    rows = {row["name"]: row for row in push_speed(64)}
    pushes = {"step_batch, swath": 64, "vmap(step)": 64, "value_and_grad_batch": 16, "step, one map at a time": 16}
    assert {name: rows[name]["pushes_per_second"] * 0.25 for name in pushes} == pushes
    assert all((row["seconds"], row["compile_seconds"]) == (0.25, 4.75) for row in rows.values())
