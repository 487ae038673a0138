"""Buckets: what they take up, carry and pour; sand that is put down or taken away."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxsand as js

from ..conftest import ANGLE, MU, turned

DX = 0.01
N = 24
SIDE = N * DX
BUCKET = js.Bucket(width=0.06, length=0.04, capacity=2e-4)
SAND = js.make_scene((N, N), DX, ANGLE, tool=BUCKET)
LEVEL = np.zeros((N, N))
ROUGH = np.random.default_rng(5).uniform(-0.002, 0.002, (N, N))


def held(scene, load):
    return float(js.load_volume(scene, load))


@pytest.mark.wide
@pytest.mark.parametrize(
    ("heights", "mean"), [((-0.01, -0.01), 0.01), ((0.0, -0.01), 0.005), ((-0.01, 0.0), 0.005), ((0.005, -0.01), 1 / 300)]
)
def test_a_scoop_holds_its_width_times_its_way_times_its_depth(heights, mean):
    out = js.scoop(SAND, LEVEL, [[0.06, 0.12, heights[0]], [0.16, 0.12, heights[1]]])
    js.check(out)
    assert held(SAND, out.load) == pytest.approx(0.06 * 0.1 * mean, rel=3e-3)  # the edge enters within a cell
    assert float(js.volume(SAND, out.height)) == pytest.approx(-held(SAND, out.load), rel=1e-12)
    assert np.asarray(out.height).max() < 1e-3  # nothing is pushed ahead while there is room


@pytest.mark.wide
@pytest.mark.parametrize("last", [0.5, 0.1, 0.0])
def test_short_legs_at_the_ends_change_little(last):
    """The edge is a cell thick, however short a leg is; it cuts up to half a cell beyond a shorter one."""
    path = np.array([[0.06, 0.12, -0.01], [0.16 - last * DX, 0.12, -0.01], [0.16, 0.12, -0.01]])
    for way in (path, path[::-1] * [1, 1, 1]):
        load = held(SAND, js.scoop(SAND, LEVEL, way).load)
        assert 6e-5 * (1 - 1e-3) < load < 6e-5 * 1.06


def test_a_scoop_of_a_cell_keeps_its_heading():
    for end, z in (([0.101, 0.133], -0.006), ([0.123, 0.126], -0.008), ([0.101, 0.127], -0.01)):
        out = js.scoop(SAND, LEVEL, [[0.101, 0.123, -0.01], [*end, z]])
        js.check(out)
        run = np.subtract(end, [0.101, 0.123])
        assert float(out.pose.cos) == pytest.approx(run[0] / np.hypot(*run), abs=1e-6)
        assert held(SAND, out.load) == pytest.approx(0.06 * np.hypot(*run) * (0.01 - z) / 2, rel=0.1)


def test_a_full_bucket_pushes_the_rest_ahead():
    small = js.make_scene((N, N), DX, ANGLE, tool=js.Bucket(0.06, 0.04, 2e-5))
    out = js.scoop(small, LEVEL, [[0.06, 0.12, -0.01], [0.16, 0.12, -0.01]])
    js.check(out)
    assert held(small, out.load) == pytest.approx(2e-5, rel=1e-9)
    assert np.asarray(out.height)[12, 16:].max() > 0.008
    again = js.scoop(small, LEVEL, [[0.06, 0.12, -0.01], [0.16, 0.12, -0.01]], out.load)
    assert held(small, again.load) == held(small, out.load)


def test_at_the_tools_own_depth():
    out = js.scoop(SAND, LEVEL, [[0.06, 0.12], [0.16, 0.12]])
    assert held(SAND, out.load) == pytest.approx(0.06 * 0.1 * BUCKET.depth, rel=1e-6)


def test_mirrors_and_quarter_turns():
    start, stop = (0.05, 0.06), (0.13, 0.11)
    out = js.scoop(SAND, ROUGH, [[*start, 0.0], [*stop, -0.012]])
    for turn, (x0, y0, x1, y1) in turned((*start, *stop), SIDE):
        other = js.scoop(SAND, turn(ROUGH), [[x0, y0, 0.0], [x1, y1, -0.012]])
        assert np.abs(other.height - turn(np.asarray(out.height))).max() < 2e-6
        assert held(SAND, other.load) == pytest.approx(held(SAND, out.load), rel=1e-4)


@pytest.mark.parametrize(
    ("count", "most"), [(30, 1e-8), pytest.param(3000, 2e-8, marks=[pytest.mark.slow, pytest.mark.compiled])]
)
def test_bed_and_bucket_keep_their_sand_in_float32(count, most):
    """Drift is a walk of roundings, 1e-8 after 3,000 actions; what is finer than a tall column's digits is kept aside."""
    rng = np.random.default_rng(1)
    scene = js.make_scene((N, N), DX, ANGLE, tool=js.Bucket(0.06, 0.04, 6e-5))
    none = jnp.zeros((), jnp.float32)
    height, load = jnp.asarray(ROUGH, jnp.float32), js.Load(none, none)
    before = float(np.asarray(height, float).sum())
    for k in range(count):
        path = rng.uniform([-0.02, -0.02, -0.015], [0.26, 0.26, 0.005], (2, 3))
        if k % 3 == 2:
            asked = None if k % 2 else rng.uniform(0, 4e-5)
            out = js.dump(scene, height, path[: 1 + k % 2], load, amount=asked)
        else:
            out = js.scoop(scene, height, path, load)
        height, load = out.height, out.load
    now = np.asarray(height, float)
    moved = max(np.abs(ROUGH).sum(), np.abs(now - ROUGH).sum())
    assert abs(now.sum() + float(load.high) + float(load.low) - before) < most * moved
    assert 0 <= held(scene, load) <= 6e-5 * (1 + 1e-6)


@pytest.mark.parametrize(("spacing", "volume"), [(0.01, 6e-5), (0.01, 1e-3), (0.05, 5.0)])
def test_what_is_poured_is_as_still_as_it_says(spacing, volume):
    """However tall the column was, 0.6 m, 10 m and 2 km, whose digits are a part of the tolerance, or more than that."""
    scene, bed = js.make_scene((N, N), spacing, ANGLE), ROUGH.astype(np.float32) * np.float32(spacing / 0.01)
    heap = js.deposit(scene, js.settle(scene, bed).height, [12.5 * spacing, 12.5 * spacing], volume)
    again = js.settle(scene, heap.height)
    assert int(heap.outcome) == int(again.outcome)
    assert float(js.steepest_slope(scene, heap.height)) - math.tan(ANGLE) <= 1.001e-3 or int(heap.outcome)
    assert int(heap.outcome) or int(again.sweeps) == 0


def test_poured_on_a_point_it_is_a_cone():
    n, dx = 65, 0.005
    scene = js.make_scene((n, n), dx, ANGLE, "isotropic", tool=BUCKET)
    volume, middle = 2e-4, n * dx / 2
    load = js.Load(jnp.asarray(volume / dx**2), jnp.zeros(()))
    out = js.dump(scene, np.zeros((n, n)), [[middle, middle]], load)
    js.check(out)
    peak = (3 * MU**2 * volume / math.pi) ** (1 / 3)
    x = (np.arange(n) + 0.5) * dx - middle
    cone = np.maximum(peak - MU * np.hypot(x[:, None], x[None]), 0)
    assert np.abs(out.height - cone).sum() < 0.02 * cone.sum()
    assert float(js.volume(scene, out.height)) == pytest.approx(volume, rel=1e-12)
    assert held(scene, out.load) < 1e-9 * volume


def test_along_a_path_it_is_spread_evenly():
    load = js.Load(jnp.asarray(1.0), jnp.zeros(()))
    out = js.dump(SAND, LEVEL, [[0.04, 0.12], [0.2, 0.12]], load, amount=0.004 * 0.16 * 0.06)
    inside = np.asarray(out.height)[11:13, 6:18]
    assert inside == pytest.approx(0.004, rel=0.02)
    assert held(SAND, out.load) == pytest.approx(1e-4 - 0.004 * 0.16 * 0.06, rel=1e-9)
    assert float(out.pose.x) == pytest.approx(0.2)


def test_more_than_there_is_and_off_the_map_are_outcomes():
    load = js.Load(jnp.asarray(0.1), jnp.zeros(()))
    more = js.dump(SAND, LEVEL, [[0.1, 0.1]], load, amount=1.0)
    assert js.Outcome.NOT_POURED in js.Outcome(int(more.outcome))
    assert float(js.volume(SAND, more.height)) == pytest.approx(1e-5, rel=1e-9)
    with pytest.raises(js.OutcomeError, match="load_volume"):
        js.check(more)
    off = js.dump(SAND, LEVEL, [[3.0, 0.1]], load)
    assert js.Outcome.NOT_POURED in js.Outcome(int(off.outcome))
    assert held(SAND, off.load) == pytest.approx(1e-5)
    assert not np.asarray(off.height).any()
    lost = js.dump(SAND, LEVEL, [[math.nan, 0.1]], load)
    assert js.Outcome.NOT_FINITE in js.Outcome(int(lost.outcome))
    assert held(SAND, lost.load) == pytest.approx(1e-5)


@pytest.mark.wide
def test_loads_and_numbers_that_make_no_sense_are_told_of_and_change_nothing():
    path = np.array([[0.06, 0.12, 0.0], [0.16, 0.12, -0.01]])
    one, nothing = jnp.asarray(1.0), jnp.zeros(())
    scooped = jax.jit(lambda high: js.scoop(SAND, ROUGH, path, js.Load(high, nothing)))
    dumped = jax.jit(lambda high: js.dump(SAND, ROUGH, path, js.Load(high, nothing)))
    poured = jax.jit(lambda volume, x: js.deposit(SAND, ROUGH, jnp.stack([x, x]), volume))
    for bad in (math.nan, math.inf, -1.0):
        for out in (scooped(bad), dumped(bad), poured(bad, 0.1)):
            assert js.Outcome.NOT_FINITE in js.Outcome(int(out.outcome))
            assert np.array_equal(out.height, ROUGH)
    assert js.Outcome.NOT_FINITE in js.Outcome(int(poured(1e-5, math.nan).outcome))
    far = js.dump(SAND, ROUGH, [[3e38, 0.12], [-3e38, 0.12]], js.Load(one, nothing))
    assert js.Outcome.NOT_FINITE in js.Outcome(int(far.outcome))
    assert float(far.load.high) == 1.0


def test_two_equal_points_are_one():
    load = js.Load(jnp.asarray(0.1), jnp.zeros(()))
    one, two = (js.dump(SAND, LEVEL, [[0.1, 0.1]] * n, load) for n in (1, 2))
    assert np.abs(one.height - two.height).max() < 1e-12


def test_a_large_footprint_is_even_in_float32():
    """Sums of a million cells of 2^23 quanta each overflow neither integers nor floats; what rounding leaves is spread."""
    shape = (520, 600)
    scene = js.make_scene(shape, DX, ANGLE)
    slab = np.asarray(
        js.deposit(scene, np.zeros(shape, np.float32), np.full(shape, 0.1, np.float32), 3.12e5 * DX**2 * 0.001).height
    )
    assert slab.dtype == np.float32
    assert np.abs(slab - 0.001).max() < 1e-6
    assert slab.sum(dtype=float) == pytest.approx(312.0, rel=1e-6)


def test_a_float64_load_is_not_rounded_by_float32_heights():
    load = js.Load(jnp.asarray(0.123456789012), jnp.zeros(()))
    left = js.dump(SAND, np.zeros((N, N), np.float32), [[0.1, 0.1]], load, amount=0.0).load
    assert left.high.dtype == jnp.float32
    assert float(left.high) + float(left.low) == pytest.approx(0.123456789012, rel=1e-13)


@pytest.mark.wide
def test_vmap_over_the_capacity():
    def high(capacity):
        scene = js.make_scene((N, N), DX, ANGLE, tool=js.Bucket(0.06, 0.04, capacity))
        return js.scoop(scene, LEVEL, [[0.06, 0.12, -0.01], [0.16, 0.12, -0.01]]).load.high

    assert jax.vmap(high)(np.array([1e-6, 2e-5, 1e30])) * DX**2 == pytest.approx([1e-6, 2e-5, 6e-5], rel=1e-9)


@pytest.mark.wide
def test_vmap_equals_a_loop():
    paths = np.array([[[0.06, 0.12, 0.0], [0.16, 0.1, -0.01]], [[0.2, 0.03, -0.01], [0.05, 0.18, -0.002]]])
    maps = jax.vmap(lambda h, p: js.scoop(SAND, h, p))(np.stack([ROUGH, LEVEL]), paths)
    for k, height in enumerate((ROUGH, LEVEL)):
        one = js.scoop(SAND, height, paths[k])
        assert np.abs(maps.height[k] - one.height).max() < 1e-9
        assert held(SAND, one.load) == pytest.approx(float(js.load_volume(SAND, maps.load)[k]), rel=1e-9)


@pytest.mark.slow
def test_derivatives_of_a_scoop():
    sand = js.make_scene((12, 12), DX, ANGLE, tool=js.Bucket(0.04, 0.03, 1e-3))
    rough, weights = ROUGH[:12, :12], np.random.default_rng(4).standard_normal((12, 12))
    path = np.array([[0.031, 0.042, 0.001], [0.082, 0.073, -0.011]])

    @jax.jit
    def loss(path):
        out = js.scoop(sand, rough, path, stop=js.Sweeps(16))
        return jnp.sum(weights * out.height) + 3e4 * js.load_volume(sand, out.load)

    slope, step = np.asarray(jax.jit(jax.grad(loss))(path)), 1e-8
    for place in np.ndindex(path.shape):
        way = np.zeros_like(path)
        way[place] = step
        difference = float(loss(path + way) - loss(path - way)) / (2 * step)
        assert slope[place] == pytest.approx(difference, rel=1e-4, abs=1e-4 * np.abs(slope).max())


@pytest.mark.wide
def test_derivatives_of_pouring():
    weights = np.random.default_rng(4).standard_normal((N, N))
    load = js.Load(jnp.asarray(1.0), jnp.zeros(()))

    @jax.jit
    def loss(path, amount):
        return jnp.sum(weights * js.dump(SAND, ROUGH, path, load, amount=amount, stop=js.Sweeps(16)).height)

    path, amount, step = np.array([[0.043, 0.121], [0.187, 0.094]]), 3e-5, 1e-7
    by_path, by_amount = jax.jit(jax.grad(loss, argnums=(0, 1)))(path, amount)
    for place in np.ndindex(path.shape):
        way = np.zeros_like(path)
        way[place] = step
        difference = float(loss(path + way, amount) - loss(path - way, amount)) / (2 * step)
        assert float(by_path[place]) == pytest.approx(difference, rel=1e-4, abs=1e-4 * float(np.abs(by_path).max()))
    difference = float(loss(path, amount + 1e-10) - loss(path, amount - 1e-10)) / 2e-10
    assert float(by_amount) == pytest.approx(difference, rel=1e-4)


def test_sand_is_put_down_and_taken_away():
    point = np.array([0.125, 0.085])
    heap = js.deposit(SAND, LEVEL, point, 4e-5)
    js.check(heap)
    assert float(js.volume(SAND, heap.height)) == pytest.approx(4e-5, rel=1e-12)
    assert np.unravel_index(np.argmax(heap.height), (N, N)) == (8, 12)
    pit = js.remove(SAND, LEVEL, point, 4e-5)
    assert np.abs(np.asarray(pit.height) + np.asarray(heap.height)).max() < 1e-9  # settling commutes with h -> -h
    footprint = np.zeros((N, N))
    footprint[4:20, 4:20] = 1
    slab = np.asarray(js.deposit(SAND, LEVEL, footprint, 256 * 0.003 * DX**2).height)
    assert slab[6:18, 6:18] == pytest.approx(0.003, rel=1e-9)
    nowhere = js.deposit(SAND, ROUGH, LEVEL, 1e-5)
    assert js.Outcome.NOT_POURED in js.Outcome(int(nowhere.outcome))


def test_bad_input_is_named():
    path = np.array([[0.06, 0.12, 0.0], [0.16, 0.12, -0.01]])
    for bad, message in [
        (lambda: js.scoop(js.make_scene((8, 8), DX), LEVEL[:8, :8], path), r"scene\.tool: got NoTool; give make_scene"),
        (lambda: js.scoop(SAND, LEVEL, path[:1]), r"path: got shape \[1, 3\]; give at least two points"),
        (lambda: js.scoop(SAND, LEVEL, path, 1e-5), r"load: got float; give the \.load"),
        (lambda: js.load_volume(SAND, 3.0), r"load: got float; give the \.load"),
        (lambda: js.dump(SAND, LEVEL, path, js.Load(np.zeros(3), np.zeros(3))), r"load\.high: got shape \[3\]; .*jax\.vmap"),
        (lambda: js.dump(SAND, LEVEL, path, js.Load(-1.0, 0.0)), r"load\.high: got -1\.0; it must be finite and 0 or more"),
        (lambda: js.dump(SAND, LEVEL, path, js.Load(object(), 0.0)), r"load\.high: got object, no array of numbers"),
        (lambda: js.scoop(SAND, LEVEL, path, push=js.SwathPush()), r"push: got SwathPush.*SteppedPush"),
        (lambda: js.step(SAND, LEVEL, path.ravel()), r"push: got SteppedPush for a Bucket; .*js\.scoop"),
        (
            lambda: js.dump(SAND, LEVEL, path, None, amount=-1e-6),
            r"amount: got -1e-06; it must be one finite number of m\^3",
        ),
        (lambda: js.dump(SAND, LEVEL, path, None, amount=math.nan), r"amount: got nan"),
        (lambda: js.deposit(SAND, LEVEL, [0.1], 1e-5), r"where: got shape \[1\]; give a point \[2\]"),
        (lambda: js.deposit(SAND, LEVEL, -1 - LEVEL, 1e-5), r"where: got a number that is not finite, or a weight below 0"),
        (lambda: js.remove(SAND, LEVEL, [0.1, 0.1], -1.0), r"volume: got -1\.0"),
        (lambda: js.make_scene((8, 8), DX, tool=js.Bucket(0.04, 0.03, 0.0)), r"tool\.capacity: got 0\.0"),
        (
            lambda: js.make_scene((8, 8), DX, tool=js.Bucket(0.004, 0.03, 1e-5)),
            r"tool\.width: got 0\.004 m, less than a cell",
        ),
    ]:
        with pytest.raises(ValueError, match=message):
            bad()
