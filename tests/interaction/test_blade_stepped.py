"""What a pushed blade leaves behind."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxsand as js
from jaxsand.goals.metrics import volume_error
from jaxsand.scene.footprint import coverage
from jaxsand.scene.grid import centres

from ..conftest import ANGLE, MU, turned

DX = 0.005
SHAPE = (64, 96)
BLADE = js.Blade(width=0.06, thickness=0.015, depth=0.0075)
STROKE = (0.1, 0.16, 0.33, 0.16)


def scene(tool=BLADE, shape=SHAPE, **parts):
    return js.make_scene(shape, DX, ANGLE, tool=tool, **parts)


def level(dtype="float64", shape=SHAPE):
    return np.zeros(shape, dtype)


def along(angle, length=0.16, centre=(0.24, 0.16)):
    c, s = math.cos(angle) * length / 2, math.sin(angle) * length / 2
    return np.array([centre[0] - c, centre[1] - s, centre[0] + c, centre[1] + s])


def frame(stroke):
    """Cell centres along and across a stroke, measured from its start."""
    x, y = (np.asarray(c) for c in centres(scene().grid, "float64"))
    u = np.array(stroke[2:]) - stroke[:2]
    u = u / np.hypot(*u)
    return (x - stroke[0]) * u[0] + (y - stroke[1]) * u[1], (y - stroke[1]) * u[0] - (x - stroke[0]) * u[1]


@pytest.mark.wide
@pytest.mark.parametrize("degrees", [0, 30, 45, 90, 200])
def test_a_trench_has_a_level_floor_berms_at_repose_and_a_heap_ahead(dtype, degrees):
    stroke = along(math.radians(degrees))
    out = js.step(scene(), level(dtype), stroke)
    js.check(out)
    h = np.asarray(out.height, float)
    s, n = frame(stroke)
    # The walls slump by at most (depth + berm) / mu each, which leaves the middle of a 60 mm floor untouched.
    floor = h[(s > 0.03) & (s < 0.12) & (np.abs(n) < 0.004)]
    assert np.abs(floor + BLADE.depth).max() < 0.05 * BLADE.depth
    heap = h[(s > 0.16) & (s < 0.2) & (np.abs(n) < 0.02)]
    assert heap.max() > 0.5 * BLADE.depth
    for side in (1, -1):
        berm = h[(s > 0.06) & (s < 0.12) & (side * n > 0.02) & (side * n < 0.06)]
        assert berm.max() > 0.3 * BLADE.depth
    assert h[(s < -0.03) | (np.abs(n) > 0.07)].max() < 1e-9
    assert np.maximum(h, 0).sum() == pytest.approx(np.maximum(-h, 0).sum(), rel=1e-5)
    assert 0.9 * MU < float(js.steepest_slope(scene(), out.height)) <= MU + 1.1e-3


@pytest.mark.wide
def test_no_sand_inside_the_tool(dtype):
    for degrees in (0, 25, 60, 90, 135):
        stroke = along(math.radians(degrees)).astype(dtype)
        pushed = js.act(scene(), level(dtype), stroke)
        x, y = centres(scene().grid, dtype)
        cover = coverage(BLADE, pushed.pose, x, y, jnp.asarray(DX, dtype))
        inside = np.asarray(pushed.height)[np.asarray(cover) > 1 - 1e-6]
        assert inside.size >= 20
        assert inside.max() <= -BLADE.depth + (1e-8 if dtype == "float32" else 1e-15)


@pytest.mark.wide
@pytest.mark.long
@pytest.mark.parametrize("n", [100, pytest.param(500, marks=pytest.mark.slow)])
def test_volume_after_many_random_pushes(n):
    shape = (32, 32)
    sand = js.make_scene(shape, 0.01, ANGLE, tool=js.Blade())
    strokes = np.random.default_rng(0).uniform(-0.02, 0.34, (n, 4)).astype(np.float32)
    start = np.zeros(shape, np.float32)
    out = js.rollout(sand, start, strokes)
    js.check(out)
    assert volume_error(start, out.height[-1]) <= 1e-6
    assert np.abs(np.asarray(out.height[-1])).max() > 0.005
    assert np.abs(np.asarray(out.height)).max() < 0.1


@pytest.mark.wide
def test_rough_map_keeps_its_volume_and_rests(dtype):
    rough = np.random.default_rng(1).uniform(-0.01, 0.01, SHAPE).astype(dtype)
    out = js.step(scene(), rough, STROKE)
    js.check(out)
    assert volume_error(rough, out.height) <= 1e-6
    assert float(js.steepest_slope(scene(), out.height)) <= MU + 1.1e-3


def test_sand_that_reaches_the_windows_edge_is_told_and_kept():
    """What flows in a window that moves must not be lost over its edge."""
    rng = np.random.default_rng(0)
    rough = js.settle(js.make_scene((32, 32), 0.01), rng.uniform(0, 0.12, (32, 32))).height
    small = js.make_scene((32, 32), 0.01, tool=js.Blade(0.04, 0.01, -0.04), window=js.Window((12, 12)))
    for path in rng.uniform(0.06, 0.26, (8, 3, 2)):
        out = js.follow(small, rough, path)
        assert js.Outcome.WINDOW_EDGE in js.Outcome(int(out.outcome))
        assert np.sum(np.asarray(out.height) - rough) == pytest.approx(0, abs=1e-12)


@pytest.mark.parametrize(
    "stroke",
    [
        (-1.0, -1.0, -0.5, -0.7),  # off the map altogether
        (1e6, 0.16, 1e6 + 1, 0.16),
        (-1e5, 5.0, 1e5, 5.0),
    ],
)
def test_a_stroke_off_the_map_touches_nothing(dtype, stroke):
    start = js.settle(scene(), np.random.default_rng(1).uniform(-0.01, 0.01, SHAPE).astype(dtype)).height
    out = js.step(scene(), start, stroke)
    js.check(out)
    assert np.array_equal(out.height, start)


@pytest.mark.wide
@pytest.mark.parametrize("stroke", [(-0.1, 0.16, 0.3, 0.16), (0.2, 0.16, 0.9, 0.16), (0.24, -5.0, 0.24, 5.0)])
def test_a_stroke_may_start_or_end_off_the_map(dtype, stroke):
    out = js.step(scene(), level(dtype), stroke)
    js.check(out)
    h = np.asarray(out.height, float)
    assert volume_error(level(), h) <= 1e-6
    assert h.min() < -0.9 * BLADE.depth


@pytest.mark.wide
def test_how_far_off_the_map_a_stroke_starts_does_not_matter():
    near = js.step(scene(), level(), (-0.1, 0.16, 0.3, 0.16)).height
    far = js.step(scene(), level(), (-3.1, 0.16, 0.3, 0.16)).height
    assert np.allclose(near, far, atol=1e-12)


def test_a_stroke_of_no_length_lowers_and_lifts_the_tool(dtype):
    out = js.step(scene(), level(dtype), (0.24, 0.16, 0.24, 0.16))
    js.check(out)
    h = np.asarray(out.height, float)
    assert h[32, 48] < -0.5 * BLADE.depth
    assert np.allclose(h, np.flipud(h), atol=1e-8)
    assert np.allclose(h, np.fliplr(h), atol=1e-8)
    assert volume_error(level(), h) <= 1e-6


@pytest.mark.wide
@pytest.mark.parametrize("tool", [js.Blade(0.06, 0.015, -0.02), js.NoTool()])
def test_a_tool_above_the_sand_changes_nothing(dtype, tool):
    start = js.settle(scene(), np.random.default_rng(2).uniform(-0.01, 0.01, SHAPE).astype(dtype)).height
    out = js.step(scene(tool), start, STROKE)
    assert np.array_equal(out.height, start)


def test_passes_clean_and_deeper_ones_deepen(dtype):
    once = js.step(scene(), level(dtype), STROKE)
    twice = js.step(scene(), once.height, STROKE)
    back = js.step(scene(), once.height, (*STROKE[2:], *STROKE[:2]))
    deeper = js.step(scene(js.Blade(0.06, 0.015, 0.012)), once.height, STROKE)

    def dug(out, depth=BLADE.depth):
        return int((np.asarray(out.height) < -0.5 * depth).sum())

    assert dug(twice) > dug(once)
    assert dug(back) > dug(once)
    assert np.asarray(deeper.height)[32, 40] == pytest.approx(-0.012, rel=0.01)
    assert np.asarray(twice.height)[32, 40] == pytest.approx(-0.0075, rel=0.01)


@pytest.mark.wide
@pytest.mark.usefixtures("both_ways")
def test_mirrors_and_quarter_turns(dtype):
    tolerance = 2e-6 if dtype == "float32" else 1e-12
    shape = (48, 48)
    sand = scene(shape=shape)
    start = np.asarray(js.settle(sand, np.random.default_rng(3).uniform(-0.005, 0.005, shape).astype(dtype)).height)
    side = 48 * DX
    stroke = np.array([0.07, 0.09, 0.17, 0.13])
    h = np.asarray(js.step(sand, start, stroke).height)
    for turn, moved in turned(stroke, side):
        assert np.allclose(js.step(sand, turn(start), moved).height, turn(h), atol=tolerance), turn


@pytest.mark.wide
def test_sand_and_blade_may_be_raised_together():
    a = js.step(scene(), level(), STROKE).height
    b = js.step(scene(js.Blade(0.06, 0.015, 0.0075 - 0.5)), level() + 0.5, STROKE).height
    assert np.allclose(np.asarray(b) - 0.5, a, atol=1e-9)


@pytest.mark.slow
def test_the_result_is_continuous_in_the_stroke():
    """Steps of a stroke, over several sub-steps' lengths, move the sand by no more than a fixed multiple of their size: by 10,
    but where a blade in line with the cells moves into slivers of them, which is as steep as these are narrow."""
    sand = js.make_scene((32, 32), 0.01, ANGLE, tool=js.Blade())
    run = jax.jit(jax.vmap(lambda s: js.act(sand, jnp.zeros((32, 32)), s).height))
    base = np.array([0.08, 0.1, 0.2, 0.17])
    for near, far in (((0.1, 0.16, 0.42, 0.16),) * 2, ((0.1, 0.16, 0.3125, 0.16),) * 2, ((-0.5, 0.16, 0.82, 0.16),) * 2):
        maps = run(jnp.asarray([near, np.add(far, [0, 1e-6, 0, 1e-6]), np.add(far, [0, 0, 0, 1e-6])]))
        assert np.abs(maps - maps[:1]).max() < 1.2e-4  # a blade in line with the cells, up to and over a closed edge
    for direction in ([0, 0, 1, 0], [1, 0, 0, 0], [0, 0, 0, 1], [1, 1, 1, 1], [0, 1, 0, -1]):
        for step, first in ((1e-4, 0.0), (1e-6, 0.0), (1e-6, 0.0049)):
            k = np.arange(160)[:, None]
            maps = np.asarray(run(jnp.asarray(base + (first + k * step) * np.array(direction))))
            change = np.abs(np.diff(maps, axis=0)).max((1, 2))
            assert 0 < change.max() < 10 * step


def test_a_stroke_that_is_not_finite_is_flagged():
    out = js.step(scene(), level("float32"), (0.1, 0.1, np.nan, 0.2))
    assert int(out.outcome) == js.Outcome.NOT_FINITE
    assert np.array_equal(out.height, level())


@pytest.mark.wide
def test_a_tool_that_is_not_finite_is_flagged():
    push = jax.jit(lambda blade: js.step(js.make_scene(SHAPE, DX, ANGLE, tool=js.Blade(*blade)), level(), STROKE))
    for bad in range(3):
        out = push([np.nan if k == bad else size for k, size in enumerate((0.02, 0.015, 0.0075))])
        assert int(out.outcome) == js.Outcome.NOT_FINITE
        assert np.array_equal(out.height, level())


@pytest.mark.wide
def test_strokes_from_far_reach_the_map_or_are_flagged():
    for far in (1e3, 1e6):
        out = js.step(scene(), level("float32"), (0.2, 0.16, far, 0.16))
        js.check(out)
        assert float(out.height.min()) == pytest.approx(-BLADE.depth, rel=1e-3)
    out = js.step(scene(), level("float32"), (-1e20, 0.16, 1e20, 0.16))
    assert int(out.outcome) == js.Outcome.NOT_FINITE


@pytest.mark.wide
def test_sand_before_a_wall_stays_in_its_column_until_the_blade_is_lifted():
    """The one place where sand is inside the tool; see `step`."""
    stroke = (0.3, 0.16, SHAPE[1] * DX, 0.16)
    pushed = js.act(scene(), level(), stroke)
    js.check(pushed)
    assert volume_error(level(), pushed.height) < 1e-12
    assert float(pushed.height[32, -1]) > 0
    out = js.step(scene(), level(), stroke)
    js.check(out)
    assert volume_error(level(), out.height) < 1e-12


@pytest.mark.wide
def test_solid_cells_are_left_alone():
    solid = np.zeros(SHAPE, bool)
    solid[:, 70:73] = True
    start = level()
    start[solid] = 0.3
    out = js.step(scene(walls=js.Walls(solid)), start, STROKE)
    js.check(out)
    h = np.asarray(out.height)
    assert np.array_equal(h[solid], start[solid])
    assert np.array_equal(h[:, 73:], start[:, 73:])
    assert volume_error(start, h) <= 1e-12


def test_sand_pushed_over_a_draining_edge_is_counted(dtype):
    out = js.step(scene(edge=js.Draining(0.0)), level(dtype), (0.2, 0.16, 0.9, 0.16))
    js.check(out)
    lost = -math.fsum(np.asarray(out.height, float).ravel()) * DX**2
    assert lost > 0.02 * 0.06 * BLADE.depth
    assert float(out.drained) == pytest.approx(lost, rel=1e-5)


@pytest.mark.wide
@pytest.mark.parametrize("push", [js.SteppedPush(), js.SwathPush()])
def test_a_blade_that_skims_level_sand_at_0_leaves_it_to_drain(push):
    """Nothing but the rim, far below, tells the push how large heights are."""
    sand = js.make_scene((12, 12), 120.0, ANGLE, tool=js.Blade(300.0, 300.0, 0.0), edge=js.Draining(-240.0))
    out = js.act(sand, np.zeros((12, 12), np.float32), (300.0, 700.0, 900.0, 500.0), push=push)
    js.check(out)
    assert -240 <= float(out.height.min()) <= float(out.height.max()) == 0
    assert float(out.drained) == pytest.approx(-float(out.height.sum()) * 120.0**2, rel=1e-5)


@pytest.mark.slow
def test_more_sweeps_and_finer_sub_steps_converge():
    """Towards the push so slow that the sand is always at rest, against 64 sweeps to a quarter of a spacing."""
    sand = js.make_scene((48, 48), 0.01, ANGLE, tool=js.Blade(0.05, 0.05, 0.0075))
    stroke = (0.1, 0.24, 0.34, 0.24)
    best = np.asarray(js.step(sand, np.zeros((48, 48)), stroke, push=js.SteppedPush(0.25, 64)).height)

    def error(substep, sweeps):
        got = js.step(sand, np.zeros((48, 48)), stroke, push=js.SteppedPush(substep, sweeps)).height
        return np.abs(np.asarray(got) - best).sum() / np.abs(best).sum()

    errors = [error(1.0, 2), error(0.5, 8), error(0.25, 32)]
    assert errors[0] > 1.5 * errors[1] > 3 * errors[2]
    assert errors[1] < 0.12


@pytest.mark.slow
def test_vmap_equals_a_loop_over_maps_and_strokes():
    sand = js.make_scene((24, 24), 0.01, ANGLE, tool=js.Blade())
    rng = np.random.default_rng(5)
    strokes = rng.uniform(0.02, 0.22, (5, 4)).astype(np.float32)
    maps = np.stack(
        [np.asarray(js.settle(sand, m).height) for m in rng.uniform(-0.01, 0.01, (5, 24, 24)).astype(np.float32)]
    )
    loop = [js.step(sand, h, s) for h, s in zip(maps, strokes, strict=True)]
    for many in (jax.vmap(lambda h, s: js.step(sand, h, s))(maps, strokes), js.step_batch(sand, maps, strokes, chunk=2)):
        for i, one in enumerate(loop):
            # Compiled for a batch, XLA may fuse a multiplication with an addition: equal to rounding of a stroke's pose.
            assert np.allclose(many.height[i], one.height, atol=2e-6)
            assert int(many.outcome[i]) == 0


@pytest.mark.slow
def test_vmap_over_tools():
    rng = np.random.default_rng(5)
    stroke = rng.uniform(0.02, 0.22, 4).astype(np.float32)
    rough = js.settle(js.make_scene((24, 24), 0.01, ANGLE), rng.uniform(-0.01, 0.01, (24, 24)).astype(np.float32)).height

    def push(depth):
        return js.step(js.make_scene((24, 24), 0.01, ANGLE, tool=js.Blade(depth=depth)), rough, stroke).height

    shallow, deep = jax.vmap(push)(jnp.array([0.002, 0.0075], jnp.float32))
    assert np.allclose(deep, push(np.float32(0.0075)), atol=2e-6)
    assert not np.allclose(shallow, deep, atol=1e-4)
