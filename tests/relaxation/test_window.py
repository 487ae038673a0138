"""A window gives what settling everywhere gives, or says that it may not.

The two are the same operations on the same numbers, but compiled apart, and the compiler may contract a product and a sum
into one rounding here and not there. So "the same" is to a few units in the last place.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxsand as js
from jaxsand.goals.metrics import volume_error

from ..conftest import ANGLE

SHAPE = (72, 80)
ROUNDING = 3e-16
DX = 0.01
AS_USERS_COMPILE = [pytest.mark.slow, pytest.mark.compiled]


def sand(window=None, shape=SHAPE):
    return js.make_scene(shape, DX, ANGLE, tool=js.Blade(0.02, 0.015, 0.0075), window=window)


@pytest.mark.wide
@pytest.mark.parametrize(
    ("shape", "sizes"),
    [
        ((44, 48), ((6, 6), (30, 30))),
        pytest.param(SHAPE, ((6, 6), (28, 28), (56, 56), (72, 80)), marks=AS_USERS_COMPILE),
    ],
)
def test_equal_or_flagged(shape, sizes):
    rows, columns = (n * DX for n in shape)
    ends = np.random.default_rng(0).uniform(0.1, [columns - 0.1, rows - 0.12] * 2, (12, 4))
    strokes, level = jnp.asarray(ends), jnp.zeros(shape)
    whole = jax.vmap(lambda s: js.act(sand(js.Whole(), shape), level, s).height)(strokes)
    exact = {}
    for size in sizes:
        window = js.Window(size, tolerance=0.0)
        out = jax.vmap(lambda s, w=window: js.act(sand(w, shape), level, s))(strokes)
        same = [bool(np.abs(a - b).max() < ROUNDING) for a, b in zip(out.height, whole, strict=True)]
        flagged = [bool(o & js.Outcome.WINDOW_EDGE) for o in out.outcome]
        assert all(s or f for s, f in zip(same, flagged, strict=True))
        exact[size] = (sum(same), sum(flagged))
    assert exact[6, 6][1] >= 11  # too small: said
    assert exact[6, 6][0] < 6
    for size in {(30, 30), (56, 56), (72, 80)} & exact.keys():  # large enough: the same maps
        assert exact[size] == (12, 0)


@pytest.mark.wide
@pytest.mark.parametrize("many", [4, pytest.param(8, marks=AS_USERS_COMPILE)])
def test_the_default_tolerance_keeps_the_difference_small(many):
    strokes = jnp.asarray(np.random.default_rng(1).uniform([0.1, 0.1, 0.1, 0.1], [0.7, 0.6, 0.7, 0.6], (8, 4)))[:many]
    whole = jax.vmap(lambda s: js.step(sand(js.Whole()), jnp.zeros(SHAPE), s).height)(strokes)
    out = jax.vmap(lambda s: js.step(sand(js.Window((36, 36))), jnp.zeros(SHAPE), s))(strokes)
    clean = np.asarray(out.outcome) == 0
    assert clean.any()
    assert np.abs(np.asarray(out.height) - np.asarray(whole))[clean].max() < 0.01 * 0.0075


def test_an_unsettled_map_is_flagged():
    rough = np.random.default_rng(2).uniform(-0.05, 0.05, SHAPE)
    out = js.act(sand(js.Window((56, 56))), rough, (0.3, 0.3, 0.5, 0.4))
    assert int(out.outcome) == js.Outcome.WINDOW_EDGE
    with pytest.raises(js.OutcomeError, match="enlarge Window"):
        js.check(out)


@pytest.mark.wide
def test_a_window_at_the_map_edge_with_everything_in_it():
    """Windows cut walls, angles and draining edges as well."""
    solid = np.zeros(SHAPE, bool)
    solid[30:34, 40:44] = True
    angle = np.full(SHAPE, ANGLE)
    angle[:, 40:] = 0.6
    parts = {"walls": js.Walls(solid), "edge": js.Draining(0.0)}
    stroke = (0.05, 0.05, 0.5, 0.3)

    def run(window):
        scene = js.make_scene(SHAPE, DX, angle, tool=js.Blade(), window=window, **parts)
        return js.act(scene, np.zeros(SHAPE), stroke)

    whole, window = run(js.Whole()), run(js.Window((60, 60), tolerance=0.0))
    assert int(window.outcome) == 0
    assert np.abs(whole.height - window.height).max() < ROUNDING
    assert float(whole.drained) == pytest.approx(float(window.drained), rel=1e-9, abs=1e-15)


@pytest.mark.slow
def test_one_row_and_one_column():
    for shape, stroke in (
        ((1, 40), (0.1, 0.005, 0.3, 0.005)),
        ((40, 1), (0.005, 0.1, 0.005, 0.3)),
        ((1, 1), (0, 0, 0.01, 0.01)),
    ):
        for window in (None, js.Window((min(shape[0], 30), min(shape[1], 30)))):
            scene = js.make_scene(shape, DX, ANGLE, tool=js.Blade(0.02, 0.01, 0.005), window=window)
            out = js.step(scene, np.zeros(shape), stroke)
            assert np.all(np.isfinite(out.height))
            assert abs(float(out.height.sum())) < 1e-12


def heaps(many=24):
    """Columns of sand of all sizes, somewhere on level sand."""
    rng = np.random.default_rng(5)
    h = np.zeros((many, *SHAPE), "float32")
    for one in h:
        i, j, a, b = rng.integers(15, 45), rng.integers(15, 50), *rng.integers(2, 9, 2)
        one[i : i + a, j : j + b] = rng.uniform(0.01, 0.12)
    return h


@pytest.mark.usefixtures("both_ways")
@pytest.mark.parametrize(
    ("scheme", "neighbours"),
    [
        (js.Relaxation(), 8),
        pytest.param(js.Relaxation(), "isotropic", marks=pytest.mark.slow),
        pytest.param(js.SuperTimeStepping(), 4, marks=pytest.mark.wide),
        pytest.param(js.SuperTimeStepping(), 8, marks=pytest.mark.slow),
    ],
)
def test_settling_in_a_window_is_equal_or_flagged(scheme, neighbours):
    walls = js.Walls(jnp.zeros(SHAPE, bool).at[30, 10:60].set(True))
    scene = js.make_scene(SHAPE, DX, ANGLE, neighbours, walls=walls)
    h = heaps()
    whole = js.settle_batch(scene, h, scheme=scheme)
    clean = []
    for size in ((12, 12), (26, 26), (40, 40)):
        out = js.settle_batch(scene, h, scheme=scheme, window=js.Window(size, tolerance=0.0))
        change = np.abs(np.asarray(out.height) - whole.height).max((1, 2))
        same = change <= (1e-6 if neighbours == "isotropic" else 0)  # rounding of square roots, on heights of 0.1
        flagged = np.asarray(out.outcome) != 0
        assert np.all(same | flagged)
        assert np.array_equal(out.sweeps[~flagged], whole.sweeps[~flagged])
        assert max(volume_error(a, b) for a, b in zip(h, out.height, strict=True)) <= 1e-6
        clean.append(int(np.sum(~flagged)))
    assert clean[0] < 6
    assert clean[2] == 24


@pytest.mark.slow
def test_a_window_in_a_window_drains_and_has_gradients():
    scene = js.make_scene(SHAPE, DX, ANGLE, edge=js.Draining(0.0))
    h = np.zeros(SHAPE)
    h[2:8, 3:9] = 0.06
    window = js.Window((30, 30), 0.0)
    whole, out = js.settle(scene, h), js.settle(scene, h, window=window)
    assert np.array_equal(whole.height, out.height)
    assert float(whole.drained) == float(out.drained) > 0

    def spread(scale, window):
        return jnp.sum(js.settle(scene, scale * h, window=window).height ** 2)

    assert np.isclose(*(jax.grad(spread)(1.0, w) for w in (None, window)), rtol=1e-12)


def test_sand_outside_that_is_still_only_to_a_tolerance_is_flagged():
    scene = js.make_scene(SHAPE, DX, ANGLE)
    rough = np.random.default_rng(4).uniform(-0.05, 0.05, SHAPE)
    disturbed = js.settle(scene, rough).height.at[30:34, 30:34].add(0.06)
    strict, loose = (js.settle(scene, disturbed, window=js.Window((48, 48), t)) for t in (0.0, 1.1e-3))
    assert int(strict.outcome) & js.Outcome.WINDOW_EDGE
    assert not int(loose.outcome)
    assert np.abs(np.asarray(loose.height) - js.settle(scene, disturbed).height).max() < 1e-3 * DX


def test_two_heaps_far_apart_are_flagged():
    h = np.zeros(SHAPE)
    h[5:8, 5:8] = h[60:63, 70:73] = 0.1
    out = js.settle(sand(), h, window=js.Window((30, 30)))
    assert int(out.outcome) & js.Outcome.NOT_STILL
    with pytest.raises(ValueError, match="window"):
        js.settle(sand(), h, window=js.Window((30, 30)), scheme=js.Multilevel())
    with pytest.raises(ValueError, match="window.size"):
        js.settle(sand(), h, window=js.Window((300, 30)))
