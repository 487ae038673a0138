"""The cut of a blade and the sinkage of a wheel read off a scene, and a wheel's forces."""

import math
from dataclasses import replace
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import quad
from scipy.special import beta

import jaxsand as js
from jaxsand.terramechanics.forces import (
    LETE_SAND,
    WONG_DRY_SAND,
    Cut,
    bekker_resistance,
    bekker_sinkage,
    blade_force,
    wheel_force,
)

from .test_forces import AT, CLEAN, run

RAD = math.radians

DX = 0.005
BLADE = js.Blade(width=0.06, thickness=0.015, depth=0.0075)
SCENE = js.make_scene((64, 64), DX, tool=BLADE)


ahead = jax.jit(blade_force)


def same(a, b, rtol=1e-10):
    np.testing.assert_allclose([a.draught, a.lift], [b.draught, b.lift], rtol=rtol)


@pytest.mark.parametrize("angle", [0, 0.3, math.pi / 2, 2.5])
def test_level_sand_is_cut_at_the_blade_depth(angle):
    pose = replace(AT, cos=jnp.cos(angle), sin=jnp.sin(angle))
    same(ahead(SCENE, np.zeros((64, 64)), pose, CLEAN), run(CLEAN, Cut(0.0075, 0.06, sides=2.0)))


def test_heap_is_surcharge_and_trench_is_no_depth():
    heap = run(CLEAN, Cut(0.0075, 0.06, surcharge=0.002 * CLEAN.unit_weight, sides=2.0))
    same(ahead(SCENE, np.full((64, 64), 0.002), AT, CLEAN), heap)
    same(
        ahead(SCENE, np.full((64, 64), 0.052), AT, CLEAN, 0.05),
        run(CLEAN, Cut(0.0575, 0.06, surcharge=0.002 * CLEAN.unit_weight, sides=2.0)),
    )
    same(ahead(SCENE, np.full((64, 64), 0.002), AT, CLEAN, jnp.inf), run(CLEAN, Cut(0.0095, 0.06, sides=2.0)))
    same(ahead(SCENE, np.full((64, 64), -0.003), AT, CLEAN), run(CLEAN, Cut(0.0045, 0.06, sides=2.0)))
    for bare in (
        ahead(SCENE, np.full((64, 64), -0.01), AT, CLEAN),
        ahead(SCENE, np.zeros((64, 64)), replace(AT, x=AT.x + 9), CLEAN),
    ):
        assert bare.draught == 0


def test_only_the_sand_ahead_counts():
    """Columns of the strip: one spacing ahead of the face at x = 0.1675, so all of it in 0.1725 to 0.1775."""
    got = jax.grad(lambda h: ahead(SCENE, h, AT, CLEAN).draught)(jnp.full((64, 64), -0.001))
    rows, columns = np.nonzero(np.asarray(got))
    assert set(columns) == {34, 35}
    assert set(rows) == set(range(26, 38))


def test_pushing_raises_the_force():
    """A heap grows ahead of a pushed blade."""
    scene = js.make_scene((64, 96), DX, tool=BLADE)
    flat = np.zeros((64, 96))
    pushed = js.act(scene, flat, (0.1, 0.16, 0.33, 0.16)).height
    at = replace(AT, x=AT.x + 0.17)
    assert ahead(scene, pushed, at, CLEAN).draught > 1.5 * ahead(scene, flat, at, CLEAN).draught


def test_blade_force_in_batches_of_float32():
    heights = jnp.linspace(-0.004, 0.004, 3, dtype="float32")[:, None, None] + jnp.zeros((1, 64, 64), "float32")
    got = jax.vmap(lambda h: ahead(SCENE, h, AT, CLEAN).draught)(heights)
    assert got.dtype == "float32"
    np.testing.assert_allclose(got, [ahead(SCENE, h, AT, CLEAN).draught for h in heights], rtol=1e-5)
    assert np.all(np.diff(got) > 0)


# The wheel

WHEEL = (WONG_DRY_SAND, 0.25, 0.15)


@pytest.mark.parametrize("z", [1e-4, 0.02, 0.1, 0.25])
@pytest.mark.parametrize("s", [WONG_DRY_SAND, LETE_SAND], ids=["dry", "lete"])
def test_resistance_is_the_work_of_the_rut(s, z):
    """Exact, as r sin t dt = -dz: R = b k z^(n+1) / (n+1) at any sinkage and slip (Bekker 1956)."""
    np.testing.assert_allclose(wheel_force(s, 0.25, 0.15, z, 0.2).resistance, bekker_resistance(s, 0.15, z), rtol=1e-8)


@pytest.mark.parametrize("n", [0.5, 0.793, 1.0, 1.1, 2.0])
def test_shallow_load(n):
    """Without shear and for z << r, W = b k sqrt(2 r) z^(n + 1/2) B(1/2, n + 1) / 2 exactly; Bekker puts 1 - n / 3 for the half
    of the beta function: exact for n = 1, and 2 percent off at n = 1/2."""
    s, z = replace(WONG_DRY_SAND, exponent=n, cohesion=0.0, friction=0.0), 1e-7
    load = float(wheel_force(s, 0.25, 0.15, z, 0.0).load)
    k = 0.99e3 / 0.15 + 1528.43e3
    half = beta(0.5, n + 1) / 2
    np.testing.assert_allclose(load, 0.15 * k * math.sqrt(0.5) * z ** (n + 0.5) * half, rtol=1e-6)
    np.testing.assert_allclose(bekker_sinkage(s, 0.25, 0.15, load), z * (half / (1 - n / 3)) ** (2 / (2 * n + 1)), rtol=1e-6)
    if n == 1:
        np.testing.assert_allclose(half, 1 - n / 3, rtol=1e-12)


def test_bekker_resistance_from_load():
    """Bekker's closed form in the load is that in the sinkage, with his sinkage put in."""
    s, r, b, w = WONG_DRY_SAND, 0.25, 0.15, 800.0
    n, k = s.exponent, s.cohesive_modulus / b + s.frictional_modulus
    closed = (3 * w / math.sqrt(2 * r)) ** ((2 * n + 2) / (2 * n + 1))
    closed /= (3 - n) ** ((2 * n + 2) / (2 * n + 1)) * (n + 1) * b ** (1 / (2 * n + 1)) * k ** (1 / (2 * n + 1))
    np.testing.assert_allclose(bekker_resistance(s, b, bekker_sinkage(s, r, b, w)), closed, rtol=1e-12)


@pytest.mark.parametrize("slip", [0.0, 0.2, 1.0])
@pytest.mark.parametrize("s", [WONG_DRY_SAND, LETE_SAND], ids=["dry", "lete"])
def test_quadrature(s, slip):
    """The integrals by scipy's adaptive quadrature."""
    r, b, z = 0.25, 0.15, 0.04
    entry = math.acos(1 - z / r)

    def p(t):
        return (s.cohesive_modulus / b + s.frictional_modulus) * max(r * (math.cos(t) - math.cos(entry)), 0) ** s.exponent

    def tau(t):
        j = r * (entry - t - (1 - slip) * (math.sin(entry) - math.sin(t)))
        return (s.cohesion + p(t) * math.tan(s.friction)) * (1 - math.exp(-j / s.shear_displacement))

    def over(f):
        return r * b * quad(f, 0, entry, epsabs=1e-9, epsrel=1e-9)[0]

    got = wheel_force(s, r, b, z, slip)
    np.testing.assert_allclose(got.load, over(lambda t: p(t) * math.cos(t) + tau(t) * math.sin(t)), rtol=1e-7)
    np.testing.assert_allclose(got.pull, over(lambda t: tau(t) * math.cos(t) - p(t) * math.sin(t)), rtol=1e-7)
    np.testing.assert_allclose(got.torque, r * over(tau), rtol=1e-7)


def test_slip_gives_pull_and_torque():
    forces = [wheel_force(*WHEEL, 0.03, i) for i in (0.0, 0.1, 0.3, 0.6, 1.0)]
    for name in ("pull", "torque"):
        assert np.all(np.diff([float(getattr(f, name)) for f in forces]) > 0)
    assert np.ptp([float(f.resistance) for f in forces]) == 0


def test_full_shear_is_mohr_coulomb():
    """K to 0: the thrust is c times the contact's length plus tan phi times what p carries."""
    s, r, b, z = replace(WONG_DRY_SAND, shear_displacement=1e-12), 0.25, 0.15, 0.03
    got, bare = wheel_force(s, r, b, z, 1.0), wheel_force(replace(s, friction=0.0, cohesion=0.0), r, b, z, 1.0)
    contact = r * math.sin(math.acos(1 - z / r)) * b
    np.testing.assert_allclose(got.pull + got.resistance, s.cohesion * contact + math.tan(s.friction) * bare.load, rtol=1e-9)


def test_wheel_gradients_and_batches():
    def pull(v):
        return wheel_force(WONG_DRY_SAND, v[0], v[1], v[2], v[3]).pull

    v = jnp.array([0.25, 0.15, 0.03, 0.2])
    got, value = jax.jit(jax.grad(pull))(v), jax.jit(pull)
    for i in range(4):
        e = np.zeros(4)
        e[i] = 1e-6
        np.testing.assert_allclose(got[i], (value(v + e) - value(v - e)) / 2e-6, rtol=1e-6)
    many = np.asarray(v) * np.linspace(0.5, 1.5, 3)[:, None]
    np.testing.assert_allclose(jax.jit(jax.vmap(pull))(many), [value(row) for row in many], rtol=1e-12)


def test_wheel_on_the_surface():
    zero = wheel_force(*WHEEL, 0.0, 0.2)
    assert [float(x) for x in jax.tree.leaves(zero)] == [0, 0, 0, 0]
    assert np.all(np.isfinite(jax.jit(jax.grad(lambda z: wheel_force(*WHEEL, z, 0.2).load))(0.0)))


def test_costs_nothing_when_absent():
    """Nothing in the package imports the layer."""
    root = Path(js.__file__).parent
    assert not [p for p in root.rglob("*.py") if p.name != "forces.py" and "jaxsand.forces" in p.read_text()]
