"""Schemes of settling against the flow of small steps, and isotropic sand against exact solutions."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxsand as js
from jaxsand.bench import piles
from jaxsand.relaxation._rkl import RklStages
from jaxsand.relaxation.schemes import schedule

from ..conftest import ANGLE, MU
from .test_settling import DX, rough

SCHEMES = [js.Relaxation(), js.Pairwise(), js.SuperTimeStepping(), js.Multilevel(handover=16)]
NEIGHBOURS = [4, 8, "isotropic"]
SHAPES = [(32, 32), (33, 38)]
CASES = [
    pytest.param(s, n, marks=pytest.mark.slow if isinstance(s, js.Multilevel) else ())
    for s in SCHEMES
    for n in NEIGHBOURS
    if not (isinstance(s, js.Pairwise) and n == "isotropic")
]


def exact_sum(h):
    return math.fsum(np.ravel(np.asarray(h, float)))


def column(n, height=0.5):
    y, x = np.indices((n, n)) + 0.5
    return np.where(np.hypot(x - n / 2, y - n / 2) < n / 8, height * n, 0.0)


def limit(scene, h):
    """The end of the flow of small steps."""
    stop = js.UntilStill(1e-5, bound=400_000, interval=64)
    return np.asarray(js.settle(scene, h, scheme=js.Relaxation(1 / 64), stop=stop).height)


def distance(got, end, begin):
    return np.abs(np.asarray(got) - end).max() / np.abs(end - begin).max()


@pytest.mark.parametrize(("scheme", "neighbours"), CASES)
def test_every_scheme_keeps_volume_and_comes_to_rest(both_ways, scheme, neighbours):
    for shape in SHAPES[1:] if both_ways == "compiled" and not isinstance(scheme, js.Multilevel) else SHAPES:
        h = rough(shape, "float32")
        scene = js.make_scene(shape, DX, ANGLE, neighbours)
        s = js.settle(scene, h, scheme=scheme)
        js.check(s)
        assert float(js.steepest_slope(scene, s.height)) <= MU + 1.1e-3
        assert exact_sum(s.height) == exact_sum(h)
        again = js.settle(scene, s.height, scheme=scheme)
        assert int(again.sweeps) == 0
        assert np.array_equal(again.height, s.height)


@pytest.mark.usefixtures("both_ways")
@pytest.mark.parametrize("neighbours", [4, pytest.param(8, marks=pytest.mark.wide), "isotropic"])
def test_symmetries_hold(neighbours):
    """To the last bit where pairs flow on one grid; lengths of gradients and changes of coarse cells are rounded."""
    h = rough((32, 32), "float64")
    scene = js.make_scene(h.shape, DX, ANGLE, neighbours)
    for scheme in (js.SuperTimeStepping(), js.Multilevel(handover=16)):

        def settled(x, scheme=scheme):
            return np.asarray(js.settle(scene, x, scheme=scheme).height)

        s = settled(h)
        for turn in (np.negative, np.flipud, np.fliplr, np.transpose, np.rot90):
            exact = neighbours != "isotropic" and isinstance(scheme, js.SuperTimeStepping)
            assert np.abs(settled(turn(h)) - turn(s)).max() <= (0 if exact else 1e-12)


@pytest.mark.wide
@pytest.mark.parametrize("neighbours", NEIGHBOURS)
def test_super_time_stepping_is_faithful_and_needs_few_sweeps(neighbours):
    h = column(32 if neighbours == "isotropic" else 48)
    scene = js.make_scene(h.shape, 1.0, ANGLE, neighbours)
    end = limit(scene, h)
    slow, fast = js.settle(scene, h, scheme=js.Relaxation()), js.settle(scene, h)
    assert distance(slow.height, end, h) < 0.01
    assert distance(fast.height, end, h) < 0.005
    assert int(fast.sweeps) < int(slow.sweeps) / 5


@pytest.mark.wide
def test_super_time_stepping_is_first_order_in_growth():
    h = column(32)
    scene = js.make_scene(h.shape, 1.0, ANGLE)
    end = limit(scene, h)
    growths = np.array([1.6, 0.8, 0.4, 0.2])
    stop = js.UntilStill(1e-5)
    errors = [
        distance(js.settle(scene, h, scheme=js.SuperTimeStepping(g, g / 16), stop=stop).height, end, h) for g in growths
    ]
    assert np.polyfit(np.log(growths), np.log(errors), 1)[0] > 0.9


@pytest.mark.slow
def test_sweeps_grow_with_the_side_of_the_map_not_with_its_square():
    sides = np.array([32, 64, 128])
    for scheme, exponent in ((js.Relaxation(), 2.0), (js.SuperTimeStepping(), 1.0)):
        sweeps = [int(js.settle(js.make_scene((n, n), 1.0, ANGLE), column(n), scheme=scheme).sweeps) for n in sides]
        assert np.polyfit(np.log(sides), np.log(sweeps), 1)[0] == pytest.approx(exponent, abs=0.25)


@pytest.mark.slow
def test_multilevel_comes_close_and_closer_with_a_later_handover():
    h = column(64)
    scene = js.make_scene(h.shape, 1.0, ANGLE)
    end = np.asarray(js.settle(scene, h, scheme=js.SuperTimeStepping(0.05, 1 / 64), stop=js.UntilStill(1e-5)).height)
    errors = [distance(js.settle(scene, h, scheme=js.Multilevel(t)).height, end, h) for t in (4.0, 64.0)]
    assert errors[1] < 0.01
    assert errors[1] < errors[0] / 2


@pytest.mark.slow
def test_multilevel_respects_walls_and_draining_edges():
    h = rough((35, 44), "float32", scale=0.2) + np.float32(0.25)
    solid = np.zeros(h.shape, bool)
    solid[:, 20] = True
    scene = js.make_scene(h.shape, DX, ANGLE, walls=js.Walls(solid))
    s = js.settle(scene, h, scheme=js.Multilevel(handover=4))
    js.check(s)
    for part in (np.s_[:, :20], np.s_[:, 20], np.s_[:, 21:]):
        assert exact_sum(s.height[part]) == exact_sum(h[part])
    open_edge = js.settle(js.make_scene(h.shape, DX, ANGLE, edge=js.Draining()), h, scheme=js.Multilevel(handover=4))
    js.check(open_edge)
    left = (exact_sum(h) - exact_sum(open_edge.height)) * DX**2
    assert left > 0
    assert float(open_edge.drained) == pytest.approx(left, rel=1e-5)


def test_pairwise_is_quick_and_unfaithful_but_approaches_the_limit_with_its_share():
    h = rough((32, 32), "float64")
    scene = js.make_scene(h.shape, DX, ANGLE)
    end = limit(scene, h)
    whole, part = (js.settle(scene, h, scheme=js.Pairwise(s)) for s in (1.0, 1 / 32))
    assert int(whole.sweeps) < int(js.settle(scene, h, scheme=js.Relaxation()).sweeps) / 3
    assert distance(part.height, end, h) < 0.2 * distance(whole.height, end, h)
    for s in (whole, part):
        assert h.min() <= s.height.min()
        assert s.height.max() <= h.max()


@pytest.mark.parametrize(("neighbours", "wave"), [(4, "board"), (8, "stripes"), ("isotropic", "board")])
def test_stable_ranges_within_two_per_cent(neighbours, wave):
    """The fastest-growing mode, on sand that yields everywhere, shrinks just inside the range and grows just outside."""
    from jaxsand.relaxation.flux import WholeCells, fluxes_zero
    from jaxsand.relaxation.ghost_cells import at, halo, prepare, quantum
    from jaxsand.relaxation.schemes import stable_rate
    from jaxsand.relaxation.sweep import Flow, RklState, Swept, rkl_stage, sweep

    i, j = np.indices((64, 64))
    h = jnp.asarray((-1.0) ** (i + j if wave == "board" else i))
    scene = js.make_scene(h.shape, 1.0, 1e-7, neighbours)
    bed, best = prepare(scene), stable_rate(scene)
    quanta = quantum(jnp.asarray(1.0))

    @jax.jit
    def relaxed(rate):
        return jax.lax.fori_loop(
            0, 12, lambda _, sand: sweep(bed, Flow(rate, quanta), WholeCells(), sand), Swept(halo(h), None)
        ).height

    @jax.jit
    def stepped(rate):
        def stage(k, state):
            return rkl_stage(bed, Flow(rate * (2 - 1 / (k + 1)), quanta), k / (k + 1), WholeCells(), state)

        return jax.lax.fori_loop(0, 12, stage, RklState(halo(h), None, fluxes_zero(bed, halo(h)))).height

    for run in (relaxed, stepped):
        inside, outside = (float(jnp.abs(at(run(x * best))[28:36, 28:36]).max()) for x in (0.98, 1.02))
        assert inside < 1 < outside


@pytest.mark.parametrize(
    ("scheme", "field"),
    [
        (js.Pairwise(1.5), "share"),
        (js.SuperTimeStepping(growth=0), "growth"),
        (js.SuperTimeStepping(safety=1.5), "safety"),
        (js.Multilevel(handover=0.1), "handover"),
        (js.Multilevel(coarsest=1), "coarsest"),
        (js.SuperTimeStepping("a"), "growth"),
        (js.Relaxation(np.full((9, 9), 0.1)), "scheme.rate"),
        ("fast", "scheme"),
    ],
)
def test_schemes_out_of_range_are_refused(scheme, field):
    with pytest.raises(ValueError, match=field):
        js.settle(js.make_scene((9, 9), DX), np.zeros((9, 9)), scheme=scheme)


def test_schemes_that_do_not_fit_are_refused():
    isotropic = js.make_scene((9, 9), DX, neighbours="isotropic")
    with pytest.raises(ValueError, match="isotropic sand, which does not flow in pairs"):
        js.settle(isotropic, np.zeros((9, 9)), scheme=js.Pairwise())
    with pytest.raises(ValueError, match="until still"):
        js.settle(isotropic, np.zeros((9, 9)), scheme=js.Multilevel(), stop=js.Sweeps(3))
    with pytest.raises(ValueError, match="neighbours: got 'round'"):
        js.make_scene((9, 9), DX, neighbours="round")


@pytest.mark.parametrize(
    ("scheme", "neighbours"),
    [(js.SuperTimeStepping(), "isotropic"), pytest.param(js.Multilevel(4, 4), 8, marks=pytest.mark.slow)],
)
def test_gradients_agree_with_differences(scheme, neighbours):
    h = rough((16, 16), "float64", seed=3)
    weight = rough((16, 16), "float64", seed=4)
    scene = js.make_scene(h.shape, DX, ANGLE, neighbours)

    def loss(h):
        return jnp.sum(weight * js.settle(scene, h, scheme=scheme, stop=js.UntilStill(0.05, bound=160)).height)

    loss = jax.jit(loss)
    slope = jax.jit(jax.grad(loss))(jnp.asarray(h))
    for seed in range(3):
        way = np.random.default_rng(seed).standard_normal(h.shape)
        e = 1e-9
        difference = (loss(h + e * way) - loss(h - e * way)) / (2 * e)
        assert float(jnp.sum(slope * way)) == pytest.approx(float(difference), rel=1e-4, abs=1e-5)


@pytest.mark.wide
@pytest.mark.long
def test_an_isotropic_pile_converges_to_the_cone():
    sides = np.array([33, 65, 129])
    errors, maps = zip(*(piles.cone(n) for n in sides), strict=True)
    assert errors[1] < 0.02
    assert -np.polyfit(np.log(sides), np.log(errors), 1)[0] > 0.9
    assert np.abs(piles.slopes(maps[2]) - 29).max() < 0.5


@pytest.mark.slow
@pytest.mark.long
def test_an_isotropic_pile_on_a_slope():
    errors = [piles.on_a_slope(33, 640), piles.on_a_slope(65, 2560)]
    assert errors[1] < 0.06
    assert errors[1] < 0.55 * errors[0]


@pytest.mark.wide
def test_an_isotropic_overfilled_table_drains_to_its_roof():
    errors = [piles.table(n) for n in (24, 48)]
    assert errors[1] < 0.02
    assert errors[1] < 0.6 * errors[0]


@pytest.mark.slow
def test_in_one_dimension_isotropic_sand_is_that_of_four_neighbours():
    h = rough((1, 40), "float64")
    angles = np.linspace(0.3, 0.6, 40)[None]
    for angle in (ANGLE, angles):
        isotropic, four = (js.settle(js.make_scene(h.shape, DX, angle, n), h).height for n in ("isotropic", 4))
        assert np.abs(isotropic - four).max() < 1e-12


def test_isotropic_sand_sees_a_checkerboard():
    i, j = np.indices((12, 12))
    h = 0.02 * (-1.0) ** (i + j)
    scene = js.make_scene(h.shape, DX, ANGLE, "isotropic")
    assert float(js.steepest_slope(scene, h)) == pytest.approx(math.sqrt(2) * 4)
    js.check(js.settle(scene, h))


def test_the_stages_of_a_step_are_runge_kutta_legendres():
    """On y' = -y a step of s stages, each with its rate c (2 - 1/j) and momentum, gives the Legendre polynomial P_s(1 - c)."""
    plan = schedule(js.SuperTimeStepping(), limit=0.25, sweeps=64, group=8, elapsed=0.0)
    rates, momenta = (np.concatenate(x) for x in zip(*(RklStages(plan, 8)._stages(k, float) for k in range(8)), strict=True))
    ends = [*plan.starts[1:], 64]
    assert max(np.diff(plan.starts)) > 4
    for start, end, rate in zip(plan.starts, ends, plan.rates, strict=True):
        y, last = 1.0, 1.0
        for r, m in zip(rates[start:end], momenta[start:end], strict=True):
            y, last = y + m * (y - last) - r * y, y
        if end < 64:
            assert y == pytest.approx(np.polynomial.legendre.Legendre.basis(end - start)(1 - rate), abs=1e-6)
