"""What a wheel leaves behind, in sub-steps and in one go."""

import math
from itertools import pairwise

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxsand as js
from jaxsand.goals.metrics import volume_error
from jaxsand.interaction import simulate
from jaxsand.terramechanics.wheel_trench import Pass, relaxed

from ..conftest import ANGLE, MU, turned

SHAPE, DX = (40, 40), 0.01
SIDE = SHAPE[0] * DX
STEPPED, SPLIT = js.SteppedPush(), js.SplitPush()
STROKE = (0.12, 0.2, 0.28, 0.2)
SLANTED = (0.123, 0.154, 0.261, 0.227)
PATH = np.array([[0.1, 0.12], [0.27, 0.12], [0.27, 0.27], [0.15, 0.18]])
LIMIT = {"float32": 1e-6, "float64": 1e-14}  # of rough sand, whose heights are no whole quanta

both = pytest.mark.parametrize("push", [STEPPED, SPLIT], ids=["stepped", "split"])
heavy = pytest.mark.parametrize("push", [pytest.param(STEPPED, marks=pytest.mark.slow), SPLIT], ids=["stepped", "split"])


def scene(slip=0.5, sinkage=0.015, grousers=None, shape=SHAPE, **parts):
    wheel = js.Wheel(sinkage=sinkage, slip_angle=slip, grousers=grousers or js.Smooth())
    return js.make_scene(shape, DX, ANGLE, tool=wheel, **parts)


def level(dtype="float64", shape=SHAPE):
    return np.zeros(shape, dtype)


def rough(dtype="float64", seed=1):
    start = np.random.default_rng(seed).uniform(-0.01, 0.01, SHAPE).astype(dtype)
    return np.asarray(js.settle(js.make_scene(SHAPE, DX, ANGLE), start).height)


def quick(f):
    """Compiled in half the time, for what runs a few times only."""
    return jax.jit(f, compiler_options={"xla_backend_optimization_level": 0})


def rolled(push, start=None, stroke=STROKE, sand=None):
    """The settled map, once its outcome is clean."""
    out = js.step(scene() if sand is None else sand, level() if start is None else start, stroke, push=push)
    js.check(out)
    return np.asarray(out.height)


@both
def test_volume_is_kept(dtype, push):
    """In a corner a wheel heaps up columns of half a metre, whose float32 are coarser than the quanta."""
    corner = (0.39, 0.05, 0.39, 0.4)
    strokes = (STROKE, SLANTED, (0.02, 0.01, 0.3, 0.03), (-0.3, 0.2, 0.9, 0.25), (0.2, 0.2) * 2)
    slips, dunes = (0, -0.1, 0.7, math.pi / 2), rough(dtype)
    for slip, stroke in [*zip((*slips, 0.7), strokes, strict=True), (0, corner), (0.7, corner)]:
        coarse = 1e-7 if stroke == corner and dtype == "float32" else 0
        for start, limit in ((level(dtype), coarse), (dunes, LIMIT[dtype])):
            h = rolled(push, start, stroke, scene(slip))
            assert volume_error(start, h) <= limit
            assert not np.array_equal(start, h)
            assert np.abs(h).max() < 0.06


@pytest.mark.wide
@both
def test_volume_is_kept_pass_after_pass(push):
    h = start = rough("float32")
    for slip, stroke in zip((0.3, -1.2, 0.0), (STROKE, SLANTED, (0.2, -0.1, 0.22, 0.5)), strict=True):
        h = rolled(push, h, stroke, scene(slip, 0.02))
    assert volume_error(start, h) <= 1e-6


@pytest.mark.wide
@both
def test_the_sand_rests_and_lies_no_deeper_than_the_wheel_went(dtype, push):
    for slip in (0, 0.5, 1.2):
        for sinkage in (0.005, 0.015, 0.03):
            sand = scene(slip, sinkage)
            h = rolled(push, level(dtype), STROKE, sand)
            assert h.min() >= -sinkage * (1 + 1e-6)
            assert h.min() < -0.5 * sinkage
            assert float(js.steepest_slope(sand, h)) <= MU + 1.1e-3


@pytest.mark.usefixtures("both_ways")
@both
def test_mirrors_turns_and_slip_to_the_other_side(dtype, push):
    start, atol = rough(dtype), 1e-5 if dtype == "float32" else 1e-12
    h = rolled(push, start, SLANTED)
    for turn, moved in turned(SLANTED, SIDE):
        slip = 0.5 if turn is np.rot90 else -0.5  # a mirror turns the wheel to the other side
        assert np.allclose(rolled(push, turn(start), moved, scene(slip)), turn(h), atol=atol), turn


@both
def test_a_wheel_that_does_not_slip_leaves_a_symmetric_trench(dtype, push):
    h = rolled(push, level(dtype), (-0.2, 0.2, 0.6, 0.2), scene(0))
    assert np.allclose(h, np.flipud(h), atol=2e-6 if dtype == "float32" else 1e-9)
    middle = h[:, SHAPE[1] // 2]
    assert middle[19] < -0.01
    assert middle[:17].max() > 0.004


def test_in_one_go_more_sand_goes_to_the_side_that_leads():
    """Dragged at a slip angle above 0 the left flank leads, and left is where y is larger."""
    h = rolled(SPLIT, sand=scene(1.2, 0.025))
    left, right = np.maximum(h[20:, 20], 0).sum(), np.maximum(h[:20, 20], 0).sum()
    assert left > 1.5 * right


@pytest.mark.wide
@both
def test_a_wheel_above_the_sand_moves_nothing(dtype, push):
    for start in (level(dtype) - 0.0151, rough(dtype) - 0.036):
        settled = np.asarray(js.settle(scene(), start).height)
        for slip in (0, 0.7):
            assert np.array_equal(rolled(push, settled, SLANTED, scene(slip)), settled)


@both
@pytest.mark.parametrize("stroke", [(-1.0, -1.0, -0.5, -0.7), (1e6, 0.2, 1e6 + 1, 0.2), (-1e5, 5.0, 1e5, 5.0)])
def test_a_stroke_off_the_map_touches_nothing(push, stroke):
    start = rough("float32")
    assert np.array_equal(rolled(push, start, stroke), start)


@pytest.mark.wide
@both
def test_how_far_off_the_map_a_stroke_starts_does_not_matter(push):
    near, far = (rolled(push, stroke=(x, 0.2, 0.25, 0.2)) for x in (-0.2, -3.2))
    assert np.allclose(near, far, atol=1e-12)


@pytest.mark.wide
@both
def test_a_second_pass_on_the_same_line_moves_little(push):
    """But for what had slid back; each pass moves less than the one before."""
    for sinkage in (0.005, 0.015):
        maps = [level()]
        for _ in range(4):
            maps.append(rolled(push, maps[-1], (-0.2, 0.2, 0.6, 0.2), scene(0, sinkage)))
        moved = [np.abs(b - a).sum() for a, b in pairwise(maps)]
        assert moved[1] < (0.35 if sinkage > 0.01 else 0.25) * moved[0]
        assert np.all(np.diff(moved) < 0)


@both
def test_what_is_not_finite_is_flagged(push):
    for stroke in ((0.1, 0.1, np.nan, 0.2), (-1e20, 0.1, 1e20, 0.1)):
        out = js.step(scene(), level(), stroke, push=push)
        assert int(out.outcome) == js.Outcome.NOT_FINITE
        assert np.array_equal(out.height, level())
    for name in ("radius", "width", "sinkage", "slip_angle"):
        wheel = js.Wheel(**{name: jnp.asarray(np.nan)})
        sand = js.Scene(scene().grid, scene().material, tool=wheel)  # as traced: unchecked
        out = js.step(sand, level(), STROKE, push=push)
        assert int(out.outcome) == js.Outcome.NOT_FINITE
        assert np.array_equal(out.height, level())


@pytest.mark.wide
@both
def test_extreme_wheels_and_strokes_are_sound(push):
    wheels = (
        js.Wheel(sinkage=0.048),
        js.Wheel(sinkage=1e-9, slip_angle=0.3),
        js.Wheel(slip_angle=math.pi / 2),
        js.Wheel(slip_angle=-math.pi / 2, sinkage=0.048),
        js.Wheel(radius=0.05, width=0.5, sinkage=0.03, slip_angle=1.0),  # wider than the map
        js.Wheel(radius=0.5, width=0.05, sinkage=0.3, slip_angle=0.2),
        js.Wheel(radius=0.01, width=0.01, sinkage=0.01, slip_angle=0.7),
    )
    for wheel in wheels:
        for stroke in (SLANTED, (0.2, 0.2, 0.2, 0.2), (-9.0, 0.2, 9.0, 0.2), (0.0, 0.0, 0.0, 0.4)):
            h = rolled(push, stroke=stroke, sand=js.make_scene(SHAPE, DX, ANGLE, tool=wheel))
            assert np.all(np.isfinite(h))
            assert volume_error(level(), h) <= 1e-14
    for spacing in (1e-4, 1e3):
        wheel = js.Wheel(radius=5 * spacing, width=4 * spacing, sinkage=2 * spacing, slip_angle=0.5)
        stroke = np.array(SLANTED) / DX * spacing
        h = rolled(push, stroke=stroke, sand=js.make_scene(SHAPE, spacing, ANGLE, tool=wheel)) / spacing
        assert np.all(np.isfinite(h))
        assert h.min() >= -2 - 1e-9
        assert volume_error(level(), h) <= 1e-14


@pytest.mark.wide
@both
def test_a_map_of_one_cell(push):
    sand = js.make_scene((1, 1), 0.1, ANGLE, tool=js.Wheel(0.1, 0.1, 0.05, 0.5))
    run = quick(lambda stroke: js.step(sand, jnp.zeros((1, 1)), stroke, push=push).height)
    for stroke in ((0.0, 0.05, 0.1, 0.05), (-9.0, 0.03, 9.0, 0.05)):
        assert np.array_equal(run(np.array(stroke)), [[0.0]])


@pytest.fixture(
    scope="module",
    params=[pytest.param(STEPPED, marks=[pytest.mark.slow, pytest.mark.compiled]), SPLIT],
    ids=["stepped", "split"],
)
def fenced(request):
    """Paths of four points on a map that drains and may hold walls, in float32: results, checked."""
    program = quick(lambda sand, h, path: js.follow(sand, h, path, push=request.param))

    def run(path, start, slip=0.5, solid=None):
        walls = js.Walls(level("bool") if solid is None else solid)
        sand = jax.tree.map(jnp.asarray, scene(slip, walls=walls, edge=js.Draining(0.0)))
        out = program(sand, start, path.astype("float32"))
        js.check(out)
        return out

    return run


def lost(start, out):
    return math.fsum([*start.astype(float).ravel(), *-np.asarray(out.height, float).ravel()]) * DX**2


@pytest.mark.wide
def test_sand_over_a_draining_edge_is_counted(fenced):
    for slip in (0, 0.5, -1.2):
        out = fenced(np.array([[0.2, 0.02]] + [[0.5, 0.02]] * 3), level("float32"), slip)
        assert lost(level(), out) > 1e-6
        assert float(out.drained) == pytest.approx(lost(level(), out), rel=1e-5)
    away = fenced(np.array([[0.18, 0.2]] + [[0.22, 0.2]] * 3), level("float32"))
    assert volume_error(level(), away.height) == float(away.drained) == 0


def test_solid_cells_are_left_alone(fenced):
    solid = level("bool")
    solid[:, 30:32] = solid[17:19, 15:20] = True
    start = level("float32")
    start[solid] = 0.3
    out = fenced(np.array([[0.1, 0.2]] + [[0.29, 0.2]] * 3), start, 0.3, solid)
    assert np.array_equal(out.height[solid], start[solid])
    assert float(out.drained) == 0
    assert volume_error(start, out.height) <= 1e-7


def test_a_path_of_legs(fenced):
    """It may corner, reverse and stand; straight ahead its legs are as one, but for what it meets at their joints."""
    start = np.where(np.abs(np.indices(SHAPE) - 19.5).max(0) < 17, rough("float32"), 0).astype("float32")
    for path in (PATH, PATH[[0, 1, 0, 0]], PATH[[0, 0, 0, 0]]):
        out = fenced(path, start)
        assert lost(start, out) == pytest.approx(float(out.drained), abs=1e-6 * float(np.abs(start).sum()) * DX**2)
        assert np.abs(out.height - start).max() > 0.005
        assert float(js.steepest_slope(scene(), out.height)) <= MU + 1.1e-3
    line = np.array([[0.12, 0.2], [0.17, 0.2], [0.24, 0.2], [0.28, 0.2]])
    legs, one = (np.asarray(fenced(path, level("float32"), 0).height) for path in (line, line[[0, 3, 3, 3]]))
    assert np.abs(legs - one).sum() < 0.1 * np.abs(one).sum()


def shallower(trenches):
    """Whether each of these moved less sand than the one before, and none is deeper."""
    moved = [np.abs(h).sum() for h in trenches]
    return np.all(np.diff(moved) < 0) and np.all(np.diff([-h.min() for h in trenches]) <= 1e-9)


@pytest.mark.wide
def test_grousers_fill_the_trench():
    run = quick(lambda sand, h, stroke: js.step(sand, h, stroke).height)

    def left_by(slip, spin, start, stroke=(-0.2, 0.2, 0.6, 0.2)):
        return np.asarray(
            run(jax.tree.map(jnp.asarray, scene(slip, grousers=js.Grousers(spin=spin))), start, np.array(stroke))
        )

    maps = [left_by(0.0, spin, level()) for spin in (0.0, 2.0, 5.0, 1e6)]
    assert shallower([h[:, 20] for h in maps])
    assert all(volume_error(level(), h) == 0 for h in maps)
    assert np.allclose(maps[0], rolled(STEPPED, stroke=(-0.2, 0.2, 0.6, 0.2), sand=scene(0.0)), atol=1e-12)
    for slip in (-0.9, math.pi / 2):
        assert volume_error(rough(), left_by(slip, 2.0, rough(), SLANTED)) <= 1e-14


LONG = (121, 12)


def trench(one, spacing):
    """The map with the trench that a pass in one go leaves on level sand, from edge to edge."""
    grousers = js.Grousers(one.grouser_height, one.grouser_fill, one.spin)
    wheel = js.Wheel(one.radius, one.width, one.sinkage, one.slip_angle, grousers)
    middle = LONG[0] * spacing / 2
    sand = js.make_scene(LONG, spacing, ANGLE, tool=wheel)
    h = rolled(SPLIT, level(shape=LONG), (-1.0, middle, 1.0, middle), sand)
    assert np.ptp(h, axis=1).max() < 0.02 * spacing
    return h


def distances(spacing, spin=0.0):
    """Of the fifteen trenches from their exact relaxation, at the cells' centres (m)."""
    runs = [Pass(math.radians(b), h, spin=spin) for h in (0.005, 0.015, 0.025) for b in (0, 22.5, 45, 67.5, 90)]
    maps = [trench(one, spacing) for one in runs]
    assert all(volume_error(level(shape=LONG), h) == 0 for h in maps)
    across = (np.arange(LONG[0]) - LONG[0] // 2) * spacing
    left_to_right = [h[::-1, LONG[1] // 2] for h in maps]
    return np.abs([h - exact(across) for h, exact in zip(left_to_right, relaxed(runs, 5e-4), strict=True)])


@pytest.mark.wide
@pytest.mark.long
def test_the_push_in_one_go_is_the_exact_relaxation_to_the_spacing():
    spacings = (0.01, 0.005, 0.0025)
    errors = [distances(spacing) for spacing in spacings]
    assert all(e.max() < 0.1 * spacing for e, spacing in zip(errors, spacings, strict=True))
    mean = [e.mean() * spacing for e, spacing in zip(errors, spacings, strict=True)]
    assert mean[0] > 3 * mean[1] > 9 * mean[2]
    assert distances(0.005, 2.0).max() < 0.1 * 0.005


@pytest.mark.long
def test_grousers_fill_the_trench_in_one_go():
    for slip in (0.0, 1.2, math.pi / 2):
        maps = [trench(Pass(slip, 0.015, spin=spin), 0.005)[:, 6] for spin in (0.0, 2.0, 5.0, 1e6)]
        assert shallower(maps)
    assert np.array_equal(maps[-1], np.zeros(LONG[0]))  # of two piles alike nothing remains


@pytest.mark.wide
@pytest.mark.usefixtures("both_ways")
@heavy
def test_vmap_and_batches_equal_a_loop(push):
    strokes = np.random.default_rng(5).uniform(0.05, 0.35, (3, 4)).astype(np.float32)
    maps = np.stack([rough("float32", k) for k in range(3)])
    slips = np.array([0.0, 0.5, -1.2], np.float32)
    loop = [rolled(push, h, s, scene(slip)) for h, s, slip in zip(maps, strokes, slips, strict=True)]
    many = quick(jax.vmap(lambda h, s, slip: js.step(scene(slip), h, s, push=push).height))(maps, strokes, slips)
    assert np.allclose(many, loop, atol=5e-5)
    out = js.step_batch(scene(), maps, strokes, push=push, chunk=2)
    js.check(out)
    assert np.allclose(out.height, [rolled(push, h, s) for h, s in zip(maps, strokes, strict=True)], atol=5e-5)


@both
def test_other_wheels_and_strokes_need_no_other_program(push):
    rolled(push, level("float32"))
    before = simulate._follow._cache_size()
    for sinkage, slip, radius in ((0.01, 0, 0.048), (np.float32(0.02), np.float64(0.3), 1), (jnp.float32(0.02), -1, 0.05)):
        wheel = js.Wheel(radius if radius < 1 else np.float64(0.04), 0.06, sinkage, slip)
        js.step(js.make_scene(SHAPE, DX, 0.4, tool=wheel), level("float32"), [0.1, 0.1, 0.2, 0.3], push=push)
    assert simulate._follow._cache_size() == before


@pytest.mark.wide
@pytest.mark.usefixtures("both_ways")
def test_a_window_that_follows_the_wheel():
    window = js.Window((36, 24), 1e-3)
    stroke = np.array([0.17, 0.2, 0.22, 0.2])
    part = quick(lambda s: js.step(scene(0.5, 0.01, window=window), level(), s))(stroke)
    js.check(part)
    assert np.abs(rolled(STEPPED, stroke=stroke, sand=scene(0.5, 0.01)) - part.height).max() < 1e-6


@pytest.mark.wide
def test_the_push_in_sub_steps_comes_close_to_the_push_in_one_go():
    """As far as sand flows around the ends of a wheel, which sections that exchange nothing do not know."""
    for slip in (0.0, 0.8, math.pi / 2):
        a, b = (rolled(push, stroke=(-0.2, 0.2, 0.6, 0.2), sand=scene(slip))[:, 20] for push in (STEPPED, SPLIT))
        assert np.abs(a - b).mean() < 0.4 * np.abs(b).mean()


@pytest.mark.parametrize(
    ("name", "value", "says"),
    [
        ("radius", 0.0, "one finite number above 0"),
        ("radius", 0.004, "less than a cell"),
        ("radius", 9.0, "more than the map's diagonal"),
        ("width", math.inf, "one finite number above 0"),
        ("width", 0.004, "less than a cell"),
        ("width", 0.9, "more than the map's diagonal"),
        ("sinkage", -0.01, "one finite number above 0"),
        ("sinkage", 0.049, "deeper than the axle"),
        ("sinkage", "deep", "one finite number above 0"),
        ("slip_angle", math.nan, "one finite number"),
        ("slip_angle", 45.0, "math.radians"),
        ("grousers", 3, "give Smooth"),
        ("grousers.spin", -1.0, "0 or more"),
        ("grousers.height", math.nan, "0 or more"),
        ("grousers.fill", np.ones(2), "0 or more"),
    ],
)
def test_a_bad_wheel_names_the_field(name, value, says):
    first, _, inner = name.partition(".")
    parts = {"sinkage": 0.003, first: js.Grousers(**{inner: value}) if inner else value}
    with pytest.raises(ValueError, match=rf"^tool\.{name}: got .*{says}"):
        js.make_scene(SHAPE, DX, ANGLE, tool=js.Wheel(**parts))


def test_pushes_are_for_their_tools():
    with pytest.raises(ValueError, match=r"push: got SwathPush for a Wheel; SwathPush\(\) is for a Blade, SteppedPush"):
        js.step(scene(), level(), STROKE, push=js.SwathPush())
    with pytest.raises(ValueError, match=r"push: got SplitPush for a Blade; SplitPush\(\) is for a Wheel, SteppedPush"):
        js.step(js.make_scene(SHAPE, DX, ANGLE, tool=js.Blade()), level(), STROKE, push=SPLIT)
    still = js.step(js.make_scene(SHAPE, DX, ANGLE), level(), STROKE, push=SPLIT)
    assert np.array_equal(still.height, level())
