"""Sand on a floor: what settles, what slides off, what stays bare."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxsand as js

from ..conftest import ANGLE, MU, rough

pytestmark = pytest.mark.usefixtures("both_ways")

DX = 0.01
N = 20


ROCK = rough(1, 0.25)
HEAP = np.pad(np.full((8, 8), 0.04), ((6, N - 14), (5, N - 13)))


def on(base, neighbours=8, **options):
    return js.make_scene((N, N), DX, ANGLE, neighbours, base=js.Base(base), **options)


@pytest.mark.parametrize(
    ("neighbours", "scheme"), [(8, None), (4, js.Pairwise()), ("isotropic", None), (8, js.Relaxation()), (4, None)]
)
def test_laws(neighbours, scheme, dtype):
    """Volume, stillness, no sand below the floor, no new peak; and what stands still stays."""
    rock = ROCK.astype(dtype)
    before = rock + HEAP.astype(dtype)
    scene = on(rock, neighbours)
    out = js.settle(scene, before, scheme=scheme)
    js.check(out)
    after = np.asarray(out.height)
    assert np.all(after >= rock)
    assert abs(np.sum(after.astype(float) - before)) < 1e-7 * HEAP.sum()
    assert after.max() <= max(before.max(), rock.max())
    assert js.steepest_slope(scene, after) < MU + 1.1e-3
    assert np.abs(after - before).max() > 0.5 * HEAP.max()  # something happened
    again = js.settle(scene, after, scheme=scheme)
    assert int(again.sweeps) == 0
    assert np.array_equal(again.height, after)


@pytest.mark.wide
@pytest.mark.parametrize("neighbours", [4, 8, "isotropic"])
def test_bare_rock_is_still_however_steep(neighbours):
    cliffs = 0.3 * np.random.default_rng(2).random((N, N))
    out = js.settle(on(cliffs, neighbours), cliffs)
    assert int(out.sweeps) == 0
    assert int(out.outcome) == 0
    assert np.array_equal(out.height, cliffs)
    assert float(js.steepest_slope(on(cliffs, neighbours), cliffs)) == 0


@pytest.mark.parametrize("neighbours", [8, "isotropic"])
def test_a_dry_patch_stays_dry(neighbours):
    """Upon a hill of rock beyond the reach of sand nothing ever lies."""
    hill = np.where(np.arange(N)[None, :] > 10, 0.2, 0.0) * np.ones((N, 1))
    out = np.asarray(js.settle(on(hill, neighbours), hill + np.pad(np.full((6, 4), 0.05), ((7, 7), (3, 13)))).height)
    assert np.array_equal(out[:, 11:], hill[:, 11:])
    assert out.max() == 0.2


@pytest.mark.wide
@pytest.mark.parametrize(("cells", "most"), [(40, 0.045), (80, 0.025)])
def test_a_wedge_at_the_foot_of_a_slope(cells, most):
    """Rock of slope S, steeper than repose: sand V on it, a unit of width, slides to its foot.

    There it leans on the rock, at the height c = sqrt(2 V / (1/mu + 1/(S - mu))) above the foot, at repose to both sides.
    """
    dx, steep = 0.8 / cells, 1.2
    x = (np.arange(cells) + 0.5) * dx - 0.4  # from the foot, rock to the right
    rock = np.maximum(steep * x, 0)
    sand = np.where((x > 0.1) & (x < 0.2), 0.05, 0.0)
    scene = js.make_scene((1, cells), dx, ANGLE, 4, base=js.Base(rock[None]))
    out = js.settle(scene, (rock + sand)[None])
    js.check(out)
    crest = np.sqrt(2 * sand.sum() * dx / (1 / MU + 1 / (steep - MU)))
    exact = np.maximum(rock, np.where(x < 0, np.maximum(crest + MU * x, 0), crest + MU * x))
    assert np.abs(np.asarray(out.height)[0] - exact).sum() < most * sand.sum()


@pytest.mark.wide
@pytest.mark.parametrize("neighbours", [4, 8, "isotropic"])
def test_a_floor_that_is_far_away_changes_nothing(neighbours):
    heap = HEAP + rough(3, 0.01)
    far, deep = (js.make_scene((N, N), DX, ANGLE, neighbours, base=base) for base in (js.Base(-0.03), None))
    one, other = js.settle(far, heap), js.settle(deep, heap)
    assert int(one.sweeps) == int(other.sweeps)
    assert np.abs(one.height - other.height).max() < 1e-12


def test_a_floor_drains():
    """Of a floor above the rim, and steeper than repose towards it, everything runs off."""
    roof = 0.02 + 0.7 * DX * np.minimum(np.arange(N), np.arange(N)[::-1])[:, None] * np.ones((1, N))
    out = js.settle(on(roof, edge=js.Draining(0.0)), roof + HEAP)
    js.check(out)
    assert float(out.drained) == pytest.approx(DX**2 * HEAP.sum(), rel=1e-3)
    assert np.all(np.asarray(out.height) >= roof)
    assert np.asarray(out.height - roof).max() < 1e-4 * DX


@pytest.mark.wide
def test_a_batch_and_a_window_are_the_whole():
    scene = on(ROCK)
    maps = np.stack([ROCK + HEAP, ROCK + 2 * HEAP, ROCK])
    batch = js.settle_batch(scene, maps)
    for k, one in enumerate(maps):
        assert np.abs(np.asarray(batch.height)[k] - js.settle(scene, one).height).max() < 1e-12
    mapped = jax.vmap(lambda base, h: js.settle(on(base), h).height)(
        jnp.stack([ROCK, ROCK + 0.01]), jnp.stack([maps[0]] * 2)
    )
    assert np.abs(mapped[0] - batch.height[0]).max() < 1e-12
    flat = on(0.0)
    part = js.settle(flat, HEAP / 4, window=js.Window((18, 18)))
    js.check(part)
    assert np.abs(part.height - js.settle(flat, HEAP / 4).height).max() < 1e-9


@pytest.mark.parametrize("neighbours", [8, pytest.param("isotropic", marks=pytest.mark.slow)])
def test_derivatives(neighbours):
    """By sand, floor and angle, with a number of sweeps in which thin sand slides off."""
    rng = np.random.default_rng(7)
    weights = rng.normal(size=(N, N))
    sand = np.where(HEAP > 0, 0.01 + 0.03 * rng.random((N, N)), 0)

    def of(x):
        scene = js.make_scene((N, N), DX, x["angle"], neighbours, base=js.Base(x["base"]))
        return jnp.sum(weights * js.settle(scene, x["base"] + x["sand"], stop=js.Sweeps(32)).height)

    at = {"sand": sand, "base": ROCK, "angle": ANGLE}
    slope, value = jax.jit(jax.grad(of))(at), jax.jit(of)
    for name, along in {"sand": (sand > 0) * rng.normal(size=(N, N)), "base": HEAP, "angle": 1.0}.items():
        step = 1e-9 if name == "sand" else 1e-8
        ends = [float(value({**at, name: at[name] + k * step * along})) for k in (-1, 1)]
        expected = (ends[1] - ends[0]) / (2 * step)
        assert float(np.sum(np.asarray(slope[name]) * along)) == pytest.approx(expected, rel=1e-4, abs=1e-5)


def test_one_deep_cell_changes_nothing_elsewhere():
    """In float32, where a scale of that depth would be coarser than sand."""
    spike = np.zeros((N, N), "float32")
    spike[10, 10] = 0.1
    hole = np.full((N, N), -0.01)
    hole[0, 0] = -1e6
    deep, flat = (np.asarray(js.settle(on(base), spike).height) for base in (hole, -0.01))
    assert np.abs(deep - flat).max() < 1e-7
    pit = js.remove(on(-1e6), 0 * spike, [0.1, 0.1], 1e-5)
    js.check(pit)
    assert DX**2 * np.sum(np.asarray(pit.height, float)) == pytest.approx(-1e-5, rel=1e-5)


def test_a_traced_floor_of_nan_is_an_outcome():
    outcome = jax.jit(lambda base: js.settle(on(base), HEAP).outcome)(np.nan)
    assert js.Outcome.NOT_FINITE in js.Outcome(int(outcome))


def test_a_map_below_its_floor_is_an_outcome():
    out = js.settle(on(0.0), np.full((N, N), -0.01))
    assert js.Outcome(int(out.outcome)) == js.Outcome.BELOW_BASE
    with pytest.raises(js.OutcomeError, match="below the scene's base"):
        js.check(out)


@pytest.mark.parametrize(
    ("make", "match"),
    [
        (lambda: on(np.zeros((3, 3))), r"base.height: got shape \[3, 3\]"),
        (lambda: on(np.nan), "base.height: got a number that is not finite"),
        (lambda: js.make_scene((N, N), DX, base=0.0), r"base: got 0.0; give Deep\(\) or Base"),
        (lambda: js.settle(on(0.0), HEAP, scheme=js.Multilevel()), "Multilevel on a Base"),
    ],
)
def test_bad_floors_are_refused(make, match):
    with pytest.raises(ValueError, match=match):
        make()
