"""How soil carries a wheel: against exact integrals, Bekker's closed forms, and central differences."""

import math
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import quad
from scipy.special import beta

from jaxsand.scene import bearing
from jaxsand.scene.bearing import bekker_resistance, bekker_sinkage, wheel_force, wheel_sinkage
from jaxsand.scene.soil import LETE_SAND, WONG_DRY_SAND

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


@pytest.mark.wide
def test_order_of_the_quadrature(monkeypatch):
    """In sqrt(1 - t / t_1) the pressure's power at the entry is mild: of order seven in the number of nodes, for n = 0.8."""

    def load(nodes):
        monkeypatch.setattr(bearing, "_NODES", nodes)
        return float(wheel_force(LETE_SAND, 0.25, 0.15, 0.04, 0.2).load)

    exact = load(200)
    errors = [abs(load(nodes) / exact - 1) for nodes in (4, 8, 16)]
    assert errors[2] < 1e-8
    assert np.log2(errors[0] / errors[1]) > 6
    assert np.log2(errors[1] / errors[2]) > 6


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


# The sinkage under a load

sinkage = jax.jit(wheel_sinkage)
force = jax.jit(wheel_force)


@pytest.mark.parametrize("s", [WONG_DRY_SAND, LETE_SAND], ids=["dry", "lete"])
def test_sinkage_carries_the_load_and_grows_with_it(s):
    top = float(force(s, 0.25, 0.15, 0.25, 0.2).load)
    loads = [*(np.logspace(-9, -1, 9) * top), 0.999 * top, top]
    found = [float(sinkage(s, 0.25, 0.15, load, 0.2)) for load in loads]
    assert np.all(np.diff(found) > 0)
    assert 0 < found[0] < 1e-6
    assert found[-1] == pytest.approx(0.25, rel=1e-12)
    for load, z in zip(loads, found, strict=True):
        np.testing.assert_allclose(force(s, 0.25, 0.15, z, 0.2).load, load, rtol=1e-12)


def test_no_load_does_not_sink_and_too_much_is_not_carried():
    assert float(sinkage(*WHEEL, 0.0, 0.2)) == 0
    faint = [float(sinkage(*WHEEL, load, 0.2)) for load in (1e-16, 1e-13, 1e-10, 1e-7)]
    assert np.all(np.diff([0, *faint]) > 0)
    assert faint[-1] < 1e-6
    top = float(force(*WHEEL, 0.25, 0.2).load)
    assert np.isnan(sinkage(*WHEEL, 1.001 * top, 0.2))
    slopes = jax.jit(jax.vmap(jax.grad(lambda load: wheel_sinkage(*WHEEL, load, 0.2))))(jnp.array([0.0, 1e-16, 1e9]))
    assert np.all(np.isfinite(slopes))


@pytest.mark.parametrize("n", [0.793, 1.0, 1.1])
def test_shallow_sinkage_is_bekkers(n):
    """His closed form leaves out shear, takes z << r, and 1 - n / 3 for half of a beta function (see test_shallow_load)."""
    s, load = replace(WONG_DRY_SAND, exponent=n, cohesion=0.0, friction=0.0), 1e-3
    ratio = (1 - n / 3) / (beta(0.5, n + 1) / 2)
    z = bekker_sinkage(s, 0.25, 0.15, load) * ratio ** (2 / (2 * n + 1))
    np.testing.assert_allclose(sinkage(s, 0.25, 0.15, load, 0.0), z, rtol=1e-4)


@pytest.mark.wide
def test_sinkage_by_all_that_it_depends_on():
    def z(v):
        soil = replace(WONG_DRY_SAND, **dict(zip(names, v[4:], strict=True)))
        return wheel_sinkage(soil, *v[:4])

    names = ("friction", "cohesion", "cohesive_modulus", "frictional_modulus", "exponent", "shear_displacement")
    v = np.array([0.25, 0.15, 300.0, 0.2, *(getattr(WONG_DRY_SAND, name) for name in names)])
    got, value = jax.jit(jax.grad(z))(v), jax.jit(jax.vmap(z))
    steps = 1e-5 * np.diag(v)
    np.testing.assert_allclose(got, (value(v + steps) - value(v - steps)) / (2e-5 * v), rtol=1e-6)


def test_sinkage_in_float32():
    with jax.enable_x64(False):
        loads = np.array([1e-3, 10.0, 600.0], "float32")
        got = jax.jit(jax.vmap(lambda load: wheel_sinkage(*WHEEL, load, 0.2)))(loads)
        assert got.dtype == "float32"
    np.testing.assert_allclose(got, [sinkage(*WHEEL, float(load), 0.2) for load in loads], rtol=1e-5)


@pytest.mark.parametrize("bad", [{"load": -1.0}, {"load": np.nan}, {"slip": 1.5}, {"width": 0.0}])
def test_bad_numbers_are_named(bad):
    with pytest.raises(ValueError, match=f"^{next(iter(bad))}: got"):
        wheel_sinkage(WONG_DRY_SAND, **{"radius": 0.25, "width": 0.15, "load": 10.0, "slip": 0.2} | bad)
