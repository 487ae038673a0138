"""Laws of settling."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import jaxsand as js
from jaxsand.goals.metrics import volume_error

from ..conftest import ANGLE, MU

DX = 0.01


def rough(shape, dtype, seed=0, scale=0.1):
    """A jagged map whose heights are whole multiples of a power of two, so that sums of them are exact."""
    heights = np.random.default_rng(seed).uniform(-scale, scale, shape)
    return (np.round(heights * 2**20) / 2**20).astype(dtype)


@pytest.mark.compiled
@pytest.mark.parametrize("neighbours", [4, 8])
def test_volume_is_kept_to_the_last_bit(dtype, neighbours):
    h = rough((24, 31), dtype)
    settled = js.settle(js.make_scene(h.shape, DX, ANGLE, neighbours), h)
    assert int(settled.sweeps) > 0
    assert math.fsum(np.ravel(np.asarray(settled.height, float))) == math.fsum(np.ravel(h.astype(float)))


@pytest.mark.parametrize("neighbours", [4, 8])
def test_still_means_no_slope_above_repose(dtype, neighbours):
    h = rough((24, 31), dtype)
    scene = js.make_scene(h.shape, DX, ANGLE, neighbours)
    settled = js.settle(scene, h, stop=js.UntilStill(1e-4))
    assert int(settled.outcome) == 0
    assert float(js.steepest_slope(scene, h)) > 5 * MU
    assert float(js.steepest_slope(scene, settled.height)) <= MU + 1.1e-4
    s = np.asarray(settled.height, float)
    assert max(np.abs(np.diff(s, axis=0)).max(), np.abs(np.diff(s, axis=1)).max()) / DX <= MU + 1.1e-4
    if neighbours == 8:
        diagonal = max(np.abs(s[1:, 1:] - s[:-1, :-1]).max(), np.abs(s[1:, :-1] - s[:-1, 1:]).max())
        assert diagonal / (DX * math.sqrt(2)) <= MU + 1.1e-4


def test_a_settled_map_is_a_fixed_point(dtype):
    scene = js.make_scene((24, 31), DX, ANGLE)
    once = js.settle(scene, rough((24, 31), dtype))
    twice = js.settle(scene, once.height)
    assert int(twice.sweeps) == 0
    assert np.array_equal(once.height, twice.height)


def test_no_overshoot(dtype):
    h = rough((24, 31), dtype)
    s = js.settle(js.make_scene(h.shape, DX, ANGLE), h).height
    assert h.min() <= float(s.min())
    assert float(s.max()) <= h.max()


@pytest.mark.compiled
def test_symmetries_hold_to_the_last_bit(dtype):
    h = rough((24, 24), dtype)
    scene = js.make_scene(h.shape, DX, ANGLE)

    def settled(x):
        return np.asarray(js.settle(scene, x).height)

    s = settled(h)
    assert np.array_equal(settled(-h), -s)
    for turn in (np.flipud, np.fliplr, np.transpose, np.rot90):
        assert np.array_equal(settled(turn(h)), turn(s))


def test_a_constant_may_be_added(dtype):
    h = rough((24, 31), dtype)
    scene = js.make_scene(h.shape, DX, ANGLE)
    stop = js.Sweeps(60)
    difference = js.settle(scene, h + h.dtype.type(1.5), stop=stop).height - js.settle(scene, h, stop=stop).height
    assert np.abs(np.asarray(difference, float) - 1.5).max() < (1e-5 if dtype == "float32" else 1e-13)


def test_height_and_spacing_scale_together():
    h = rough((24, 31), "float64")
    s = js.settle(js.make_scene(h.shape, DX, ANGLE), h).height
    t = js.settle(js.make_scene(h.shape, 8 * DX, ANGLE), 8 * h).height
    assert np.array_equal(8 * np.asarray(s), t)


@pytest.mark.usefixtures("both_ways")
def test_jit_equals_eager_and_vmap_equals_a_loop(dtype):
    maps = np.stack([rough((16, 16), dtype, seed) * (1 + seed) for seed in range(4)]).astype(dtype)
    scene = js.make_scene((16, 16), DX, ANGLE)
    loop = [js.settle(scene, m) for m in maps]
    batch = jax.vmap(lambda h: js.settle(scene, h))(maps)
    chunks = js.settle_batch(scene, maps, chunk=3)
    assert len({int(one.sweeps) for one in loop}) > 1
    for i, one in enumerate(loop):
        for many in (batch, chunks):
            assert np.array_equal(many.height[i], one.height)
            assert int(many.sweeps[i]) == int(one.sweeps)
    inside = jax.jit(lambda h: js.settle(scene, h).height * 1)(maps[1])
    assert np.array_equal(inside, loop[1].height)
    with jax.disable_jit():
        eager = js.settle(scene, maps[1], stop=js.Sweeps(3)).height
    assert np.array_equal(eager, js.settle(scene, maps[1], stop=js.Sweeps(3)).height)


@pytest.mark.wide
def test_vmap_over_materials():
    h = rough((16, 16), "float64")
    angles = jnp.radians(jnp.array([10.0, 29.0, 45.0]))
    many = jax.vmap(lambda a: js.settle(js.make_scene((16, 16), DX, a), h).height)(angles)
    for angle, one in zip(angles, many, strict=True):
        assert np.array_equal(one, js.settle(js.make_scene((16, 16), DX, float(angle)), h).height)
    slopes = [float(js.steepest_slope(js.make_scene((16, 16), DX), m)) for m in many]
    assert np.all(np.abs(np.array(slopes) - np.tan(angles)) < 2e-3)


@pytest.mark.parametrize("neighbours", [8, "isotropic"])
def test_the_gradient_by_a_map_of_angles_is_right(neighbours):
    h, weights = rough((9, 10), "float64", scale=0.03), rough((9, 10), "float64", seed=1)

    def loss(angles):
        return jnp.sum(weights * js.settle(js.make_scene(h.shape, DX, angles, neighbours), h, stop=js.Sweeps(8)).height)

    angles, way = jnp.asarray(0.5 + rough((9, 10), "float64", seed=2)), rough((9, 10), "float64", seed=3)
    slope, value = jax.jit(jax.grad(loss))(angles), jax.jit(loss)
    difference = float(value(angles + 1e-7 * way) - value(angles - 1e-7 * way)) / 2e-7
    assert float(jnp.sum(slope * way)) == pytest.approx(difference, rel=1e-5)


def test_every_cell_may_have_its_own_angle():
    h = np.zeros((1, 40))
    h[0, 18:22] = 0.3
    angles = np.full((1, 40), math.radians(20))
    angles[0, 20:] = math.radians(40)
    scene = js.make_scene(h.shape, DX, angles)
    s = np.asarray(js.settle(scene, h, scheme=js.Relaxation(), stop=js.UntilStill(1e-6)).height)[0]
    slopes = np.abs(np.diff(s)) / DX
    moved = slopes > 0.2
    middle = (math.tan(math.radians(20)) + math.tan(math.radians(40))) / 2
    assert np.allclose(slopes[:19][moved[:19]].max(), math.tan(math.radians(20)), atol=1e-5)
    assert np.allclose(slopes[20:][moved[20:]].max(), math.tan(math.radians(40)), atol=1e-5)
    assert slopes[19] <= middle + 1e-5
    same = js.settle(js.make_scene(h.shape, DX, np.full(h.shape, ANGLE)), h).height
    assert np.array_equal(same, js.settle(js.make_scene(h.shape, DX, ANGLE), h).height)


def test_solid_cells_stop_the_sand_and_keep_their_height(dtype):
    h = rough((16, 16), dtype)
    solid = np.zeros(h.shape, bool)
    solid[:, 8] = True
    h[:, 8] = 5
    walled = js.make_scene(h.shape, DX, ANGLE, walls=js.Walls(solid))
    s = js.settle(walled, h, scheme=js.Relaxation())
    assert np.array_equal(s.height[:, 8], h[:, 8])
    for part in (np.s_[:, :8], np.s_[:, 9:]):
        alone = js.settle(
            js.make_scene(h[part].shape, DX, ANGLE), h[part], scheme=js.Relaxation(), stop=js.Sweeps(int(s.sweeps))
        )
        assert np.allclose(s.height[part], alone.height, atol=1e-6)
        assert volume_error(h[part], s.height[part]) == 0
    assert float(js.volume(walled, h)) == pytest.approx(float(h[~solid].sum()) * DX**2, rel=1e-5)


def test_a_draining_edge_returns_what_left(dtype):
    h = rough((20, 20), dtype, scale=0.01) + np.asarray(0.1, dtype)
    scene = js.make_scene(h.shape, DX, ANGLE, edge=js.Draining(0.02))
    s = js.settle(scene, h)
    js.check(s)
    left = (math.fsum(h.ravel().astype(float)) - math.fsum(np.asarray(s.height, float).ravel())) * DX**2
    assert float(s.drained) == pytest.approx(left, rel=1e-5 if dtype == "float32" else 1e-12)
    assert left > 0
    below = js.settle(scene, np.zeros((20, 20), dtype))
    assert int(below.sweeps) == 0
    assert float(below.drained) == 0


def test_one_bad_cell_is_flagged_and_touches_no_other_map(dtype):
    maps = np.stack([rough((12, 12), dtype)] * 3)
    maps[1, 5, 5] = np.nan
    maps[2, 0, 0] = np.inf
    scene = js.make_scene((12, 12), DX, ANGLE)
    s = jax.vmap(lambda h: js.settle(scene, h))(maps)
    assert [int(o) for o in s.outcome] == [0, js.Outcome.NOT_FINITE, js.Outcome.NOT_FINITE]
    assert np.array_equal(s.height[0], js.settle(scene, maps[0]).height)
    assert np.isnan(s.height[1, 5, 5])
    assert np.isinf(s.height[2, 0, 0])
    for i in (1, 2):
        good = np.isfinite(maps[i])
        assert np.all(np.isfinite(np.asarray(s.height[i])[good]))
        assert volume_error(maps[i][good], np.asarray(s.height[i])[good]) == 0
    with pytest.raises(js.OutcomeError, match="2 of 3 maps, first 1: .*NaN"):
        js.check(s)


def test_outcome_names_a_bound_that_is_too_small():
    h = np.zeros((16, 16))
    h[8, 8] = 1
    scene = js.make_scene(h.shape, DX, ANGLE)
    short = js.settle(scene, h, stop=js.UntilStill(bound=20))
    assert int(short.sweeps) == 16
    assert int(short.outcome) == js.Outcome.NOT_STILL
    assert float(short.residual) > 1e-3
    with pytest.raises(js.OutcomeError, match="not still .* after 16 sweeps.*raise the stop rule's bound"):
        js.check(short)
    assert int(js.settle(scene, h, stop=js.Sweeps(5)).outcome) == js.Outcome.NOT_STILL
    js.check(js.settle(scene, h))


@pytest.mark.wide
@pytest.mark.parametrize(("neighbours", "limit"), [(4, 1 / 4), (8, 1 / (2 + 2 * math.sqrt(2)))])
def test_the_stable_range_is_where_the_checkerboard_stops_shrinking(neighbours, limit):
    """Just inside the range a steep checkerboard calms down; just outside it is refused, and would grow."""
    from jaxsand.relaxation.flux import WholeCells
    from jaxsand.relaxation.ghost_cells import at, halo, prepare, quantum
    from jaxsand.relaxation.settling import relax
    from jaxsand.relaxation.sweep import Flow, Swept, sweep

    # Rows of alternating sign for 8 neighbours, the full checkerboard for 4: the fastest-growing modes.
    i, j = np.indices((16, 16))
    wave = (-1.0) ** (i if neighbours == 8 else i + j)
    scene = js.make_scene((16, 16), 1.0, 1e-6, neighbours)
    bed = prepare(scene)

    def growth(rate):
        sand = Swept(halo(jnp.asarray(wave)), None)
        for _ in range(2):
            sand = sweep(bed, Flow(jnp.asarray(rate), quantum(jnp.asarray(1.0))), WholeCells(), sand)
        return float(np.abs(np.asarray(at(sand.height))[4:12, 4:12]).max())

    assert growth(0.98 * limit) < 1 < growth(1.02 * limit)
    with pytest.raises(ValueError, match=r"scheme\.rate: .*unstable above"):
        js.settle(scene, wave, scheme=js.Relaxation(1.02 * limit))
    assert int(relax(scene, jnp.asarray(wave), js.Relaxation(0.98 * limit), js.UntilStill(bound=80)).sweeps) > 0


ANGLES, SPACINGS, SEEDS = st.floats(0.01, 89.9), st.sampled_from([1e-6, 1e-2, 1.0, 1e3]), st.integers(0, 2**32 - 1)


@pytest.mark.wide
@given(st.sampled_from([(1, 1, 8), (1, 9, 4), (7, 2, 8), (8, 9, 4), (9, 9, 8)]), ANGLES, SPACINGS, SEEDS)
@settings(max_examples=50, deadline=None)
def test_any_small_map_settles_or_says_why(size, degrees, spacing, seed):
    """Of a few sizes, since each is compiled."""
    settles_or_says_why(*size, degrees, spacing, "float32", seed)


@pytest.mark.slow
@given(
    st.integers(1, 9),
    st.integers(1, 9),
    st.sampled_from([4, 8]),
    ANGLES,
    SPACINGS,
    st.sampled_from(["float32", "float64"]),
    SEEDS,
)
@settings(max_examples=20, deadline=None)
def test_any_map_of_up_to_nine_cells_a_side_settles_or_says_why(rows, columns, neighbours, degrees, spacing, dtype, seed):
    settles_or_says_why(rows, columns, neighbours, degrees, spacing, dtype, seed)


def settles_or_says_why(rows, columns, neighbours, degrees, spacing, dtype, seed):
    h = (np.random.default_rng(seed).standard_normal((rows, columns)) * spacing * 10).astype(dtype)
    scene = js.make_scene(h.shape, spacing, math.radians(degrees), neighbours)
    s = js.settle(scene, h, stop=js.UntilStill(1e-2))
    assert np.all(np.isfinite(s.height))
    assert volume_error(h, s.height) < 1e-6
    slope = float(js.steepest_slope(scene, s.height))
    mu = math.tan(math.radians(degrees))
    assert int(s.outcome) == (js.Outcome.NOT_STILL if float(s.residual) > 1e-2 else 0)
    if not int(s.outcome):
        assert slope <= mu * (1 + 1e-5) + 1.1e-2


@pytest.mark.parametrize("height", [1e4, -1e4])
def test_cliffs_and_spikes_of_a_million_cells(dtype, height):
    h = np.zeros((12, 12), dtype)
    h[3, 4] = height
    s = js.settle(js.make_scene(h.shape, DX, ANGLE), h, stop=js.UntilStill(bound=4000))
    assert np.all(np.isfinite(s.height))
    assert volume_error(h, s.height) < 1e-6
    assert int(s.outcome) in (0, js.Outcome.NOT_STILL)


@pytest.mark.wide
@pytest.mark.compiled
def test_draining_keeps_account_of_every_quantum():
    h = np.full((49, 49), 1.0, "float32")
    s = js.settle(js.make_scene(h.shape, 1 / 49, ANGLE, edge=js.Draining(0.0)), h)
    left = (math.fsum(h.ravel().astype(float)) - math.fsum(np.asarray(s.height, float).ravel())) / 49**2
    assert float(s.drained) == pytest.approx(left, rel=3e-7)


def test_nothing_falls_below_a_draining_rim():
    h = np.zeros((1, 32))
    h[0, 12:20] = 0.1
    scene = js.make_scene(h.shape, DX, ANGLE, edge=js.Draining(0.0))
    assert float(js.settle(scene, h, scheme=js.Relaxation(0.25)).height.min()) >= 0
    with pytest.raises(ValueError, match="unstable above 0.25"):
        js.settle(scene, h, scheme=js.Relaxation(0.3))


def test_a_draining_rim_stands_half_a_cell_outside():
    """In a row every cell touches it."""
    scene = js.make_scene((1, 12), DX, ANGLE, edge=js.Draining(0.02))
    assert np.asarray(js.settle(scene, np.full((1, 12), 0.1)).height) == pytest.approx(0.02 + MU * DX / 2, abs=1e-4)


def test_traced_nonsense_and_overflow_are_flagged():
    h = np.zeros((6, 6), "float32")
    for angle in (np.nan, 2.0):
        out = jax.jit(lambda a: js.settle(js.make_scene((6, 6), DX, a), h))(angle)
        assert int(out.outcome) & js.Outcome.NOT_FINITE
    h[2, 2], h[2, 3] = 3e38, -3e38
    assert int(js.settle(js.make_scene((6, 6), DX), h).outcome) & js.Outcome.NOT_FINITE


def test_a_large_offset_ends_in_bounded_time_and_says_so():
    h = rough((12, 12), "float32") + np.float32(1000)
    s = js.settle(js.make_scene(h.shape, DX, ANGLE), h)
    assert int(s.sweeps) < 20_000
    assert volume_error(h, s.height) < 1e-6
    assert (int(s.outcome) == 0) == (float(s.residual) <= 1e-3)


@pytest.mark.wide
def test_the_height_rules_the_dtype():
    scene = js.make_scene((4, 4), np.float64(0.01), jnp.float32(0.5))
    for dtype in (jnp.float16, jnp.bfloat16, jnp.float32, jnp.float64):
        s = js.settle(scene, jnp.zeros((4, 4), dtype).at[1, 1].set(0.1))
        assert s.height.dtype == dtype
        assert s.residual.dtype == dtype
        assert np.all(np.isfinite(np.asarray(s.height, float)))


@pytest.mark.parametrize("neighbours", [8, "isotropic"])
@pytest.mark.parametrize("dx", [1e-3, 550.0])
def test_level_sand_at_0_drains_over_a_rim_below_it(neighbours, dx):
    """Nothing but the rim tells how large heights are."""
    scene = js.make_scene((6, 6), dx, 0.4, neighbours, edge=js.Draining(-1.7 * dx))
    settled = js.settle(scene, np.zeros((6, 6), np.float32))
    assert settled.outcome == 0
    assert -1.7 * dx <= float(settled.height.min()) < -dx
    assert float(settled.drained) == pytest.approx(-float(settled.height.sum()) * dx**2, rel=1e-5)
