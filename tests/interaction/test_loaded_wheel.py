"""A wheel under a load: it stands where the soil carries it, and follows the ground."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxsand as js
from jaxsand.goals.metrics import volume_error
from jaxsand.interaction.ground import ground_of

from ..conftest import ANGLE

DX = 0.01
SHAPE = (12, 20)
SIZE = {"radius": 0.03, "width": 0.03, "slip_angle": 0.2}
X = np.broadcast_to((np.arange(20) + 0.5) * DX, SHAPE)
PATH = np.array([[0.05, 0.06], [0.11, 0.06], [0.14, 0.08]])
LOAD, SLIP = 5.0, 0.2


def loaded(load=LOAD, **more):
    return js.make_scene(SHAPE, DX, ANGLE, tool=js.Wheel(**SIZE, load=load, slip=SLIP, **more))


@jax.jit
def rut(load, height, path=PATH):
    """What a wheel under a load leaves before the sand settles."""
    return js.SteppedPush().along(js.Scene(**(vars(loaded(load)) | {"window": js.Whole()})), height, path)[0]


@pytest.fixture(scope="module")
def sinkage():
    return float(js.forces.wheel_sinkage(js.forces.WONG_DRY_SAND, 0.03, 0.03, LOAD, SLIP))


@pytest.fixture(scope="module")
def at_heights(sinkage):
    """What a wheel that stands so deep leaves along a path with heights."""
    fixed = js.make_scene(SHAPE, DX, ANGLE, tool=js.Wheel(**SIZE, sinkage=sinkage), window=js.Whole())
    return jax.jit(lambda height, path: js.SteppedPush().along(fixed, height, path)[0].height)


def test_a_rut_is_that_of_the_solved_sinkage_below_the_ground(sinkage, at_heights):
    """On level ground and on a slope up from height 0, around a corner; and wherever height 0 is."""
    for slope in (0.0, 0.15):
        ground = slope * (X - PATH[0, 0])
        heights = slope * (PATH[:, 0] - PATH[0, 0]) - sinkage
        got = rut(LOAD, ground)
        assert int(got.outcome) == 0
        assert np.abs(got.height - at_heights(ground, np.column_stack([PATH, heights]))).max() < 1e-12
        assert np.abs(rut(LOAD, ground + 0.05).height - 0.05 - got.height).max() < 1e-12
        assert (got.height - ground).min() < -0.5 * sinkage
        assert volume_error(ground, got.height) < 1e-12


def test_a_heavier_wheel_leaves_a_deeper_rut_and_none_leaves_none():
    depths = [-float(rut(load, np.zeros(SHAPE)).height.min()) for load in (0.0, 1e-6, 1.0, 5.0, 15.0)]
    assert depths[0] == 0
    assert depths[1] < 1e-5
    assert np.all(np.diff(depths[1:]) > 1e-4)


def test_a_load_that_the_soil_does_not_carry_is_told_of():
    ground = 0.1 * X
    for load, outcome in ((1e4, js.Outcome.NOT_CARRIED), (-1.0, js.Outcome.NOT_FINITE), (np.nan, js.Outcome.NOT_FINITE)):
        out = rut(load, ground)
        assert int(out.outcome) == outcome
        assert np.array_equal(out.height, ground)
    with pytest.raises(js.OutcomeError, match="does not carry"):
        js.check(rut(1e4, ground))


@pytest.mark.parametrize(
    ("wheel", "named"),
    [
        ({"load": 0.0}, "load: got 0.0; it must be"),
        ({"load": 1e4}, "load: got 10000.0 N, but the soil carries 2.* N"),
        ({"load": 5.0, "soil": "sand"}, "soil: got 'sand'; give"),
        ({"load": 5.0, "slip": 1.2}, "slip: got 1.2; give"),
        ({"load": 5.0, "grousers": js.Grousers(spin=0.5)}, "grousers.spin: got 0.5 under a load"),
        ({"slip": 0.2}, "slip: got one for a wheel without a load"),
        ({"soil": js.forces.LETE_SAND}, "soil: got one for a wheel without a load"),
    ],
)
def test_what_makes_no_sense_is_named(wheel, named):
    with pytest.raises(ValueError, match=rf"^tool\.{named}"):
        js.make_scene(SHAPE, DX, tool=js.Wheel(radius=0.03, width=0.03, **wheel))


def test_paths_with_heights_and_closed_forms_are_refused():
    with pytest.raises(ValueError, match="^path: got heights, but a wheel under a load"):
        js.step(loaded(), np.zeros(SHAPE), [0.05, 0.06, 0.0, 0.11, 0.06, 0.0])
    with pytest.raises(ValueError, match="^push: got SplitPush for a wheel under a load"):
        js.step(loaded(), np.zeros(SHAPE), [0.05, 0.06, 0.11, 0.06], push=js.SplitPush())


def test_grousers_give_the_slip(sinkage):
    driven = js.Wheel(0.03, 0.03, grousers=js.Grousers(spin=1.25), load=LOAD)
    from jaxsand.scene.tools import sunk

    assert float(jax.jit(lambda wheel: sunk(wheel)[0].sinkage)(driven)) == pytest.approx(sinkage, rel=1e-12)
    assert len(jax.tree.leaves(js.Wheel())) == 4  # as of a wheel that knows of no loads


# The ground


@jax.jit
def level(height, pose, by, dx=DX, width=0.03, slip=0.0):
    ground = ground_of(js.make_scene(np.shape(height), dx), height)
    return ground.level(js.Wheel(width=width, slip_angle=slip), js.Pose(*pose), by)


def test_the_ground_of_a_plane_is_exact_and_ends_where_the_map_ends():
    y = np.arange(12)[:, None] * DX + DX / 2
    plane = 0.3 * X - 0.2 * y
    by = np.array([0.0, 0.013, 0.06])
    got = level(plane, (0.05, 0.05, 0.8, 0.6), by, slip=0.4)
    np.testing.assert_allclose(got, 0.3 * (0.05 + 0.8 * by) - 0.2 * (0.05 + 0.6 * by), rtol=1e-12)
    off = level(0.3 * X, (0.1, 0.06, 1.0, 0.0), np.array([0.2, 9.0]))
    np.testing.assert_allclose(off, 0.3 * (0.2 - DX / 2), rtol=1e-12)
    holes = np.where(X < 0.1, np.nan, 0.02)
    np.testing.assert_allclose(
        level(holes, (0.05, 0.06, 1.0, 0.0), np.array([0.0, 0.05, 0.08])), [0, 0.02, 0.02], atol=1e-15
    )


def test_the_ground_is_read_to_second_order():
    errors = []
    for n in (16, 32, 64):
        dx = 0.2 / n
        x = (np.arange(n) + 0.5) * dx
        by = np.linspace(0.01, 0.12, 97)
        wave = np.broadcast_to(0.01 * np.sin(40 * x), (n, n))
        errors.append(np.abs(level(wave, (0.03, 0.1, 1.0, 0.0), by, dx) - 0.01 * np.sin(40 * (0.03 + by))).max())
    assert np.log2(errors[0] / errors[1]) > 1.8
    assert np.log2(errors[1] / errors[2]) > 1.8


def test_the_ground_is_linear_in_the_map():
    rng = np.random.default_rng(1)
    height, way = jnp.asarray(rng.standard_normal((2, *SHAPE)))
    where = (0.05, 0.05, 0.8, 0.6), np.array([0.0, 0.013, 0.06])
    _, slope = jax.jvp(lambda h: level(h, *where), (height,), (way,))
    np.testing.assert_allclose(slope, level(height + way, *where) - level(height, *where), rtol=1e-9)


@pytest.mark.slow
def test_derivatives_by_load_and_ground():
    rng = np.random.default_rng(5)
    weights, way = rng.standard_normal((2, *SHAPE))
    ground = 0.15 * X + 1e-3 * rng.standard_normal(SHAPE)
    loss = jax.jit(lambda load, height: jnp.sum(weights * rut(load, height, PATH[:2]).height))
    by_load, by_ground = jax.jit(jax.grad(loss, (0, 1)))(LOAD, ground)
    assert by_load == pytest.approx(float(loss(LOAD + 1e-5, ground) - loss(LOAD - 1e-5, ground)) / 2e-5, rel=1e-6)
    difference = float(loss(LOAD, ground + 1e-8 * way) - loss(LOAD, ground - 1e-8 * way)) / 2e-8
    assert np.sum(by_ground * way) == pytest.approx(difference, rel=1e-6)
    loads = jnp.array([1.0, 5.0, 15.0])
    many = jax.jit(jax.vmap(lambda load: rut(load, ground).height))(loads)
    for load, height in zip(loads, many, strict=True):
        assert np.abs(height - rut(load, ground).height).max() < 1e-11
