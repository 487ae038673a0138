"""A push in one go: its laws, and how close it comes to the push in sub-steps."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxsand as js
from jaxsand.goals.metrics import volume_error

from ..conftest import ANGLE, MU, turned

SHAPE, DX = (32, 32), 0.01
SIDE = SHAPE[0] * DX
FAST = js.SwathPush()
STROKE = np.array([0.083, 0.104, 0.221, 0.187])
BATCH = np.random.default_rng(0).uniform(0.1 * SIDE, 0.9 * SIDE, (32, 4))


def scene(tool=js.Blade(), **parts):
    return js.make_scene(SHAPE, DX, ANGLE, tool=tool, **parts)


def rough(dtype="float64", seed=1):
    return js.settle(
        js.make_scene(SHAPE, DX, ANGLE), np.random.default_rng(seed).uniform(-0.01, 0.01, SHAPE).astype(dtype)
    ).height


def level(dtype="float64"):
    return np.zeros(SHAPE, dtype)


@pytest.mark.wide
@pytest.mark.usefixtures("both_ways")
def test_volume_is_kept(dtype):
    wild = np.random.default_rng(2).uniform(-0.05, SIDE + 0.05, (32, 4)).astype(dtype)
    for start, limit in ((level(dtype), 0.0), (rough(dtype), 1e-6 if dtype == "float32" else 1e-14)):
        out = js.step_batch(scene(), np.broadcast_to(start, (32, *SHAPE)), wild, push=FAST)
        js.check(out)
        assert max(volume_error(start, h) for h in out.height) <= limit
    many = js.rollout(scene(), level(dtype), wild, push=FAST)
    js.check(many)
    assert volume_error(level(dtype), many.height[-1]) == 0
    assert np.abs(many.height).max() < 0.05


def test_a_wide_trench_has_a_floor_berms_and_a_heap(dtype):
    pushed = js.act(scene(js.Blade(0.12, 0.015, 0.0075)), level(dtype), (0.08, 0.16, 0.22, 0.16), push=FAST)
    js.check(pushed)
    h = np.asarray(pushed.height)
    assert h.min() >= -0.0075 - 1e-8
    assert h[14:18, 10:20].max() < -0.8 * 0.0075
    assert h[12:20, 23:25].min() > 0.002
    assert h[8:10, 10:20].min() > 0


@pytest.mark.usefixtures("both_ways")
def test_mirrors_and_quarter_turns(dtype):
    start, atol = np.asarray(rough(dtype)), 4e-6 if dtype == "float32" else 1e-12
    h = np.asarray(js.step(scene(), start, STROKE, push=FAST).height)
    for turn, moved in turned(STROKE, SIDE):
        assert np.allclose(js.step(scene(), turn(start), moved, push=FAST).height, turn(h), atol=atol), turn


@pytest.mark.wide
@pytest.mark.parametrize("edge", [js.Closed(), js.Draining(0.0)])
def test_the_result_is_continuous_in_the_stroke(edge):
    run = jax.jit(jax.vmap(lambda s: js.act(scene(edge=edge), jnp.zeros(SHAPE), s, push=FAST).height))
    for base in (STROKE, np.array([0.1, 0.16, 0.4, 0.16])):
        for direction in ([0, 0, 1, 0], [1, 0, 0, 0], [0, 0, 0, 1], [1, 1, 1, 1]):
            for step in (5e-4, 1e-6):
                maps = np.asarray(run(base + step * np.arange(64)[:, None] * np.array(direction)))
                change = np.abs(np.diff(maps, axis=0)).max((1, 2))
                assert change.max() < 6 * step


@pytest.mark.wide
def test_angles_far_away_and_in_walls_do_not_matter():
    angles = np.full(SHAPE, 0.5)
    far = angles.copy()
    far[:, 26:] = 1.5
    stroke = (0.05, 0.1, 0.1, 0.1)
    plain, other = (
        js.act(js.make_scene(SHAPE, DX, a, tool=js.Blade()), level(), stroke, push=FAST).height for a in (angles, far)
    )
    assert np.abs(np.asarray(plain) - other).max() < 1e-8
    walls = js.Walls(np.zeros(SHAPE, bool))
    walls.solid[0, 0] = True
    steep = angles.copy()
    steep[0, 0] = 1.57
    plain, other = (
        js.act(js.make_scene(SHAPE, DX, a, tool=js.Blade(), walls=walls), level(), stroke, push=FAST).height
        for a in (angles, steep)
    )
    assert np.array_equal(plain, other)


WEIGHTS = np.random.default_rng(9).standard_normal(SHAPE)
NAMES = ("stroke", "width", "thickness", "depth", "angle", "height")


def loss(stroke, width, thickness, depth, angle, height):
    sand = js.make_scene(SHAPE, DX, angle, tool=js.Blade(width, thickness, depth))
    return jnp.sum(WEIGHTS * js.step(sand, height, stroke, push=FAST).height)


@pytest.mark.slow
def test_gradients():
    value, gradient = jax.jit(loss), jax.jit(jax.grad(loss, range(6)))
    forward = jax.jit(lambda x, v: jax.jvp(loss, x, v)[1])
    for seed in (0, 1):
        rng = np.random.default_rng(seed)
        y, x = np.indices(SHAPE) / 10
        dunes = sum(2e-3 * rng.uniform(-1, 1) * np.sin(rng.uniform(0.5, 2) * x + rng.uniform(0.5, 2) * y) for _ in range(4))
        at = tuple(jnp.asarray(v, float) for v in (rng.uniform(0.06, 0.26, 4), 0.023, 0.0152, 0.0077, 0.5, dunes))
        g = gradient(*at)
        size = math.sqrt(sum(float(jnp.sum(v**2)) for v in g[:5]))
        for i, name in enumerate(NAMES):
            v = rng.standard_normal(at[i].shape)
            v = v / np.linalg.norm(v)
            e = 1e-7
            up, down = ([*at[:i], at[i] + sign * e * v, *at[i + 1 :]] for sign in (1, -1))
            slope = float(jnp.sum(g[i] * v))
            difference = float(value(*up) - value(*down)) / (2 * e)
            assert slope == pytest.approx(difference, rel=1e-4, abs=1e-4 * size), name
            tangents = tuple(jnp.asarray(v) if k == i else jnp.zeros_like(a) for k, a in enumerate(at))
            assert float(forward(at, tangents)) == pytest.approx(slope, rel=1e-8, abs=1e-10 * size)
    for stroke in ([0.1, 0.1, 0.1, 0.1], [5.0, 5.0, 6.0, 6.0], [0.1, 0.16, 5.0, 0.16]):
        assert all(np.all(np.isfinite(v)) for v in gradient(jnp.asarray(stroke), *at[1:]))
    assert not np.any(gradient(jnp.array([5.0, 5.0, 6.0, 6.0]), *at[1:])[0])
    assert all(np.all(np.isfinite(v)) for v in gradient(at[0], at[1], at[2], jnp.asarray(-0.05), *at[4:]))


@pytest.mark.wide
@pytest.mark.parametrize("tool", [js.Blade(depth=-0.02), js.NoTool()])
def test_a_tool_above_the_sand_changes_nothing(dtype, tool):
    start = rough(dtype)
    path = np.array([[0.05, 0.1], [0.2, 0.1], [0.2, 0.2]])
    assert np.array_equal(js.follow(scene(tool), start, path, push=FAST).height, start)


@pytest.mark.parametrize("stroke", [(-1.0, -1.0, -0.5, -0.7), (1e6, 0.16, 1e6 + 1, 0.16)])
def test_a_stroke_off_the_map_touches_nothing(dtype, stroke):
    start = rough(dtype)
    out = js.step(scene(), start, stroke, push=FAST)
    js.check(out)
    assert np.array_equal(out.height, start)


def test_what_is_not_finite_is_flagged():
    for stroke in ((0.1, 0.1, np.nan, 0.2), (-1e20, 0.1, 1e20, 0.1)):
        out = js.step(scene(), level(), stroke, push=FAST)
        assert int(out.outcome) == js.Outcome.NOT_FINITE
        assert np.array_equal(out.height, level())


@pytest.mark.wide
def test_solid_cells_are_left_alone_and_sand_without_room_stays():
    solid = np.zeros(SHAPE, bool)
    solid[:, 22:] = solid[:14] = solid[18:] = True
    start = level()
    start[solid] = 0.3
    sand = scene(js.Blade(0.04, 0.015, 0.0075), walls=js.Walls(solid))  # as wide as the channel
    pushed = js.act(sand, start, (0.1, 0.16, 0.35, 0.16), push=FAST)
    js.check(pushed)
    h = np.asarray(pushed.height)
    assert np.array_equal(h[solid], start[solid])
    assert volume_error(start, h) < 1e-13
    assert h[14:18, 20:22].min() > 0  # carried to the channel's end
    assert h[14:18, 11:14].max() < 0


@pytest.mark.wide
def test_sand_pushed_over_a_draining_edge_is_counted(dtype):
    sand = scene(edge=js.Draining(0.0))
    out = js.step(sand, level(dtype), (0.16, 0.16, 0.5, 0.16), push=FAST)
    js.check(out)
    lost = -math.fsum(np.asarray(out.height, float).ravel()) * DX**2
    full = js.step(sand, level(dtype), (0.16, 0.16, 0.5, 0.16))
    assert float(out.drained) == pytest.approx(lost, rel=1e-5)
    assert float(out.drained) == pytest.approx(float(full.drained), rel=0.5)
    away = js.act(sand, level(dtype), STROKE, push=FAST)
    assert float(away.drained) == 0


@pytest.mark.slow
def test_vmap_equals_a_loop():
    strokes, maps = BATCH[:4].astype(np.float32), np.stack([rough("float32", k) for k in range(4)])
    loop = [js.step(scene(), h, s, push=FAST).height for h, s in zip(maps, strokes, strict=True)]
    many = jax.vmap(lambda h, s: js.step(scene(), h, s, push=FAST).height)(maps, strokes)
    assert np.allclose(many, loop, atol=4e-6)
    assert np.allclose(js.step_batch(scene(), maps, strokes, push=FAST, chunk=2).height, loop, atol=4e-6)


@pytest.mark.wide
def test_it_comes_close_to_the_push_in_sub_steps():
    strokes, start = BATCH.astype(np.float32), np.zeros((32, *SHAPE), np.float32)
    full = js.step_batch(scene(), start, strokes, push=js.SteppedPush(0.25, 64)).height
    fast = js.step_batch(scene(), start, strokes, push=FAST).height
    assert np.abs(fast - full).sum() < 0.3 * np.abs(full).sum()


@pytest.mark.slow
def test_a_path_of_legs_takes_its_heap_along(dtype):
    one = np.array([[0.08, 0.16], [0.24, 0.16]])
    three = np.array([[0.08, 0.16], [0.13, 0.16], [0.2, 0.16], [0.24, 0.16]])
    corner = np.array([[0.08, 0.08], [0.2, 0.08], [0.2, 0.2], [0.12, 0.2]])
    maps = [np.asarray(js.follow(scene(), level(dtype), path, push=FAST).height, float) for path in (one, three, corner)]
    assert np.abs(maps[0] - maps[1]).sum() < 0.35 * np.abs(maps[0]).sum()
    full = np.asarray(js.follow(scene(), level(dtype), corner).height, float)
    assert np.abs(maps[2] - full).sum() < 0.45 * np.abs(full).sum()
    for h in maps:
        assert volume_error(level(), h) < 1e-7
        assert h.max() < 0.02


def test_a_push_of_another_kind_is_refused():
    with pytest.raises(ValueError, match="push: got 3; give SteppedPush"):
        js.step(scene(), level(), STROKE, push=3)
    with pytest.raises(ValueError, match="push.sweeps"):
        js.step(scene(), level(), STROKE, push=js.SwathPush(sweeps=-1))


def channel(push, way, rim=None, cells=60, walls=1):
    """A blade 20 mm thick that cuts 12 mm deep pushes for `way` from 5 cm, in a channel of its own width, 8 cells of 5 mm.

    Returns the map before it settles, in the channel, and what drained.
    """
    solid = np.zeros((8 + 2 * walls, cells), bool)
    solid[:walls] = solid[8 + walls :] = True
    edge = js.Closed() if rim is None else js.Draining(rim)
    sand = js.make_scene(solid.shape, 0.005, ANGLE, tool=js.Blade(0.04, 0.02, 0.012), walls=js.Walls(solid), edge=edge)
    middle = solid.shape[0] * 0.0025
    path = (0.05, middle, 0.05 + way, middle)
    out = js.act(sand, np.zeros(solid.shape), path, push=push)
    js.check(out)
    assert not np.any(np.asarray(out.height)[solid])
    return np.asarray(out.height)[walls : walls + 8], float(out.drained), js.settle(sand, out.height).height[walls + 3]


@pytest.mark.wide
def test_in_a_channel_all_that_is_cut_stands_ahead_as_a_triangle():
    """Before, 0.62, 0.44 and 0.27 of it did after 5, 10 and 20 cm."""
    for way in (0.05, 0.1, 0.15):
        h, _, _ = channel(FAST, way)
        volume, face = 0.012 * (way + 0.01), 0.05 + way + 0.01
        edges = np.arange(61) * 0.005 - face
        toe = math.sqrt(2 * volume / MU)
        inside = np.clip(edges, 0, toe)
        exact = np.diff(MU * (toe * inside - inside**2 / 2)) / 0.005
        ahead = edges[:-1] > -1e-6
        assert h[:, ahead].sum() * 0.005 / 8 == pytest.approx(volume, rel=1e-3)
        assert np.abs(h[:, ahead] - exact[ahead]).max() < 0.01 * MU * toe


@pytest.mark.wide
def test_over_an_edge_all_leaves_that_passes_it_or_stands_above_its_rim():
    """The heap of 96 cm^3 that a channel holds goes over the edge whole, and as far as its toe passes it."""
    end = 60 * 0.005
    for rim in (0.0, 0.005, 10.0):
        for face in (end - 0.09, end - 0.04, end - 0.02, end + 0.02):
            way = face - 0.06
            _, drained, _ = channel(FAST, way, rim)
            room = max(end - face, 0)
            heap = 0.04 * 0.012 * min(way + 0.01, end - 0.05)
            stays = 0.04 * (MU * room**2 / 2 + rim * room)
            assert drained == pytest.approx(max(heap - stays, 0) if rim < 1 else 0, abs=1e-9)


@pytest.mark.wide
def test_nothing_drains_over_a_rim_above_the_sand():
    """Before, 4.2 cm^3 did."""
    sand = scene(edge=js.Draining(10.0))
    assert float(js.step(sand, level(), (0.16, 0.16, 0.16, 0.5), push=FAST).drained) == 0


@pytest.mark.wide
def test_half_a_blade_beside_a_closed_edge_is_half_of_one_twice_as_wide():
    """Before, the two lay 5% apart: the heap began farther ahead between two open ends than at one."""
    small = js.make_scene((16, 32), DX, ANGLE, tool=js.Blade(0.08, 0.015, 0.0075))
    stroke = (0.1, 0.16, 0.18, 0.16)  # so short that slices are as thick on either map
    whole = js.act(scene(js.Blade(0.08, 0.015, 0.0075)), level(), stroke, push=FAST).height
    half = js.act(small, level()[:16], stroke, push=FAST).height
    assert np.abs(half - whole[:16]).sum() < 1e-4 * np.abs(whole[:16]).sum()


@pytest.mark.parametrize(("depth", "degrees"), [(10.0, 29), (0.0075, 0.01)])
def test_a_blade_far_too_deep_for_its_width_leaves_a_clear_outcome(depth, degrees):
    """Nearly all of its berms slides back into the trench: the share that does not was once 0, and what stood there 0 / 0."""
    sand = js.make_scene((12, 12), 0.01, math.radians(degrees), tool=js.Blade(0.02, 0.015, depth))
    pushed = js.act(sand, np.zeros((12, 12)), np.array([0.03, 0.06, 0.09, 0.06]), push=js.SwathPush())
    js.check(pushed)
    assert volume_error(np.zeros((12, 12)), pushed.height) < 1e-12
    assert np.asarray(pushed.height).min() < -0.5 * depth
