"""Forces on a blade and a wheel, against exact theory, an independent worked example, and their own limits."""

import math
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxsand as js
from jaxsand.terramechanics.forces import (
    LETE_SAND,
    WONG_DRY_SAND,
    Cut,
    blade_force,
    cut_force,
    failure_angle,
    wedge_factors,
    wheel_force,
)

RAD = math.radians
CLEAN = replace(WONG_DRY_SAND, cohesion=0.0)
STICKY = replace(WONG_DRY_SAND, cohesion=3e3, adhesion=1e3)
run, angle_of = jax.jit(cut_force), jax.jit(failure_angle)
AT = js.Pose(*(jnp.asarray(x) for x in (0.16, 0.16, 1.0, 0.0)))
CUT = Cut(depth=0.1, width=0.3, rake=RAD(70), surcharge=500.0, sides=2.0)


def soil(phi, delta=0.0, cohesion=0.0, adhesion=0.0, unit_weight=16e3):
    sand = replace(CLEAN, friction=RAD(phi), interface_friction=RAD(delta), cohesion=cohesion)
    return replace(sand, adhesion=adhesion, unit_weight=unit_weight)


def force(s, cut):
    """The least F itself, from the parts of the force on the blade."""
    f, held = run(s, cut), s.adhesion * cut.depth * cut.width
    return math.hypot(f.draught - held / math.tan(cut.rake), f.lift - held)


# Exact theory


@pytest.mark.parametrize("phi", [1e-4, 5, 15, 28, 37, 44.99])
def test_smooth_upright_blade_is_rankine(phi):
    """Rankine 1857: P = Kp g d^2 / 2 + 2 c d sqrt(Kp) + q d Kp, on the plane at 45 deg - phi / 2."""
    kp = math.tan(math.pi / 4 + RAD(phi) / 2) ** 2
    s, cut = soil(phi, cohesion=2e3), Cut(0.4, 1.5, surcharge=3e3)
    f = run(s, cut)
    expected = 1.5 * (kp * 16e3 * 0.4**2 / 2 + 2 * 2e3 * 0.4 * math.sqrt(kp) + 3e3 * 0.4 * kp)
    np.testing.assert_allclose(f.draught, expected, rtol=1e-12)
    assert abs(f.lift) < 1e-9 * f.draught
    np.testing.assert_allclose(angle_of(s, cut), math.pi / 4 - RAD(phi) / 2, rtol=1e-5)
    np.testing.assert_allclose(wedge_factors(s, math.pi / 2, math.pi / 4 - RAD(phi) / 2)[0], kp / 2, rtol=1e-12)


@pytest.mark.parametrize("rake", [40, 60, 90, 105])
@pytest.mark.parametrize(("phi", "delta"), [(20, 5), (30, 15), (30, 30), (38, 10), (44, 29)])
def test_rough_raked_blade_is_coulomb(phi, delta, rake):
    """Coulomb 1776, passive, level surface, as textbooks give it (wall at the angle a from the horizontal):
    Kp = sin^2(a - phi) / (sin^2 a sin(a + delta) (1 - sqrt(sin(phi + delta) sin phi / (sin(a + delta) sin a)))^2)."""
    a, p, d = RAD(rake), RAD(phi), RAD(delta)
    root = math.sqrt(math.sin(p + d) * math.sin(p) / (math.sin(a + d) * math.sin(a)))
    kp = math.sin(a - p) ** 2 / (math.sin(a) ** 2 * math.sin(a + d) * (1 - root) ** 2)
    np.testing.assert_allclose(force(soil(phi, delta), Cut(0.3, 1.0, a)), kp * 16e3 * 0.3**2 / 2, rtol=1e-10)
    if phi == delta and rake == 90:
        np.testing.assert_allclose(kp, math.cos(p) / (1 - math.sqrt(2) * math.sin(p)) ** 2, rtol=1e-12)


def equilibrium(s, cut, b):
    """The wedge's equilibrium in numbers: unknown F at delta to the blade's normal and R at phi to the failure surface's."""
    a, phi, d = cut.rake, s.friction, cut.depth
    top = d * (1 / np.tan(a) + 1 / np.tan(b))
    k0 = 1 - np.sin(phi)
    side = cut.sides * d * top / 2 * (s.cohesion + k0 * (s.unit_weight * d / 3 + cut.surcharge) * np.tan(phi))
    down_plane = s.cohesion * d / np.sin(b) * cut.width + side
    down_face = s.adhesion * d / np.sin(a) * cut.width
    load = (s.unit_weight * d * top / 2 + cut.surcharge * top) * cut.width
    directions = [
        [np.sin(a + s.interface_friction), -np.sin(b + phi)],
        [np.cos(a + s.interface_friction), np.cos(b + phi)],
    ]
    known = [
        down_plane * np.cos(b) - down_face * np.cos(a),
        down_plane * np.sin(b) + down_face * np.sin(a) + load,
    ]
    f = np.linalg.solve(directions, known)[0]
    blade = np.array([f * np.sin(a + s.interface_friction), f * np.cos(a + s.interface_friction)])
    return f, blade + down_face * np.array([np.cos(a), -np.sin(a)])


@pytest.mark.parametrize(
    "s", [CLEAN, STICKY, soil(44, 29, 100.0), soil(2, 1, 5e3, 5e3)], ids=["clean", "sticky", "steep", "clay"]
)
@pytest.mark.parametrize("rake", [25, 70, 90, 100])
@pytest.mark.parametrize("sides", [0.0, 1.0, 2.0])
def test_wedge_is_in_equilibrium_at_the_least_force(s, rake, sides):
    """The force is what the 2 x 2 system of the wedge gives, side faces included, and no failure angle gives less."""
    cut = replace(CUT, rake=RAD(rake), sides=sides)
    b = float(angle_of(s, cut))
    _, (draught, up) = equilibrium(s, cut, b)
    got = run(s, cut)
    np.testing.assert_allclose([got.draught, -got.lift], [draught, up], rtol=1e-9)
    stop = math.pi - cut.rake - s.friction - s.interface_friction
    every = [equilibrium(s, cut, x)[0] for x in np.linspace(0.002, 0.998, 2000) * stop]
    assert equilibrium(s, cut, b)[0] <= min(every) * (1 + 1e-12)


# An independent worked example (no measurement): github.com/fsantibanezleal/PitStudio, theory of loading and terramechanics,
# "Worked example 2": phi 35 deg, delta 20 deg, depth 0.5 m, width 1 m, 1800 kg/m^3; rake, b, N_gamma, F, H, V in deg and kN.
WORKED = [
    (30, 35.6, 1.71, 7.6, 5.8, 4.9),
    (45, 32.8, 1.61, 7.1, 6.4, 3.0),
    (60, 28.1, 1.82, 8.0, 7.9, 1.4),
    (75, 22.4, 2.45, 10.8, 10.8, -0.9),
    (90, 16.2, 4.16, 18.4, 17.3, -6.3),
]


@pytest.mark.parametrize(("rake", "b", "n", "f", "h", "v"), WORKED)
def test_worked_example(rake, b, n, f, h, v):
    s, cut = soil(35, 20, unit_weight=1800 * 9.81), Cut(0.5, 1.0, RAD(rake))
    got, angle = run(s, cut), angle_of(s, cut)
    np.testing.assert_allclose(np.degrees(angle), b, atol=0.051)
    np.testing.assert_allclose(wedge_factors(s, cut.rake, angle)[0], n, atol=0.0051)
    np.testing.assert_allclose([force(s, cut) / 1e3, got.draught / 1e3, -got.lift / 1e3], [f, h, v], atol=0.051)


def test_worked_example_with_cohesion():
    """The same source at rake 60 deg with c = 10 kPa, c_a = 5 kPa: b = 28.2 deg, F = 25.1 kN."""
    s, cut = soil(35, 20, 10e3, 5e3, 1800 * 9.81), Cut(0.5, 1.0, RAD(60))
    np.testing.assert_allclose(np.degrees(angle_of(s, cut)), 28.2, atol=0.051)
    np.testing.assert_allclose(force(s, cut) / 1e3, 25.1, atol=0.051)


def test_presets_hold_the_tabled_values():
    """Wong, Theory of Ground Vehicles (dry sand) and Project Chrono's demos of soft terrain (LETE sand)."""
    d, lete = WONG_DRY_SAND, LETE_SAND
    assert (d.exponent, d.cohesive_modulus, d.frictional_modulus, d.cohesion) == (1.1, 990.0, 1528430.0, 1040.0)
    assert (lete.exponent, lete.cohesive_modulus, lete.frictional_modulus, lete.cohesion) == (0.793, 102e3, 5301e3, 1300.0)
    np.testing.assert_allclose(np.degrees([d.friction, lete.friction]), [28, 31.1])


# Properties of the cut


def test_frictionless_weight_is_a_fluid():
    """phi = 0: every failure plane carries the hydrostatic thrust."""
    np.testing.assert_allclose(run(soil(0), Cut(0.2, 1.0)).draught, 16e3 * 0.2**2 / 2, rtol=1e-12)


def test_wide_blades_need_no_sides():
    wide = [float(run(CLEAN, replace(CUT, width=w)).draught / w) for w in (0.1, 1.0, 10.0, 1e4)]
    plane = float(run(CLEAN, replace(CUT, sides=0.0, width=1.0)).draught)
    assert wide == sorted(wide, reverse=True)
    np.testing.assert_allclose(wide[-1], plane, rtol=1e-4)


@pytest.mark.parametrize("name", ["depth", "width", "surcharge", "sides"])
def test_more_of_a_cut_takes_more_force(name):
    more = [float(run(CLEAN, replace(CUT, **{name: getattr(CUT, name) * k})).draught) for k in (0.2, 0.5, 0.9, 1.0)]
    assert more == sorted(more)
    assert len(set(more)) == 4


@pytest.mark.parametrize("name", ["unit_weight", "friction", "cohesion", "interface_friction", "adhesion"])
def test_stronger_soil_takes_more_force(name):
    more = [float(run(replace(STICKY, **{name: getattr(STICKY, name) * k}), CUT).draught) for k in (0.2, 0.5, 0.9, 1.0)]
    assert more == sorted(more)
    assert len(set(more)) == 4


def test_blade_is_lifted_or_drawn_in():
    assert run(CLEAN, replace(CUT, rake=RAD(90))).lift > 0
    assert run(CLEAN, replace(CUT, rake=RAD(30))).lift < 0


def test_force_scales_with_the_cube_of_length():
    big = replace(CUT, depth=3 * CUT.depth, width=3 * CUT.width, surcharge=3 * CUT.surcharge)
    np.testing.assert_allclose(run(CLEAN, big).draught, 27 * run(CLEAN, CUT).draught, rtol=1e-10)


def leaves(s, cut):
    return jnp.array(
        [s.unit_weight, s.friction, s.cohesion, s.interface_friction, s.adhesion, cut.depth, cut.width, cut.rake]
    )


def draught(v):
    s = replace(STICKY, unit_weight=v[0], friction=v[1], cohesion=v[2], interface_friction=v[3], adhesion=v[4])
    return cut_force(s, replace(CUT, depth=v[5], width=v[6], rake=v[7])).draught


def test_gradients_of_the_cut():
    """Envelope theorem: with the failure angle held, yet equal to finite differences that find it anew."""
    v = leaves(STICKY, CUT)
    got, value = jax.jit(jax.grad(draught))(v), jax.jit(draught)
    for i, step in enumerate(np.asarray(v) * 1e-5):
        e = np.zeros(len(v))
        e[i] = step
        np.testing.assert_allclose(got[i], (value(v + e) - value(v - e)) / (2 * step), rtol=1e-6)


def test_vmap_is_the_loop():
    v = np.asarray(leaves(STICKY, CUT)) * np.linspace(0.8, 1.2, 5)[:, None]
    value = jax.jit(draught)
    np.testing.assert_allclose(jax.jit(jax.vmap(draught))(v), [value(row) for row in v], rtol=1e-12)


def test_nothing_to_cut():
    """No depth, no force, and finite derivatives."""
    zero = replace(CUT, depth=0.0)
    assert run(CLEAN, zero).draught == 0
    assert np.all(np.isfinite(jax.tree.leaves(jax.jit(jax.grad(lambda s, c: cut_force(s, c).draught, (0, 1)))(CLEAN, zero))))


def test_locked_wedges_are_nan_when_traced():
    assert np.isnan(jax.jit(lambda rake: cut_force(CLEAN, replace(CUT, rake=rake)).draught)(RAD(150)))


def test_float32_stays():
    s, cut = jax.tree.map(lambda x: jnp.asarray(x, "float32"), (STICKY, CUT))
    f = run(s, cut)
    assert f.draught.dtype == "float32"
    np.testing.assert_allclose(f.draught, run(STICKY, CUT).draught, rtol=1e-5)


BAD = {
    "negative depth": (lambda: cut_force(CLEAN, replace(CUT, depth=-0.1)), r"cut\.depth: got -0.1; .*at least 0.*metres"),
    "no width": (lambda: cut_force(CLEAN, replace(CUT, width=0.0)), r"cut\.width: got 0.0; .*above 0"),
    "three sides": (lambda: cut_force(CLEAN, replace(CUT, sides=3)), r"cut\.sides: got 3; .*at most 2"),
    "rake in degrees": (lambda: cut_force(CLEAN, replace(CUT, rake=60)), r"cut\.rake: got 60; .*locks the wedge"),
    "many depths": (lambda: cut_force(CLEAN, replace(CUT, depth=jnp.ones(3))), r"cut\.depth: .*one finite number"),
    "friction in degrees": (
        lambda: cut_force(replace(CLEAN, friction=28.0), CUT),
        r"soil\.friction: got 28.0; .*math\.radians",
    ),
    "negative cohesion": (lambda: cut_force(replace(CLEAN, cohesion=-1.0), CUT), r"soil\.cohesion: got -1.0; .*at least 0"),
    "weightless numbers": (lambda: cut_force(replace(CLEAN, unit_weight=np.nan), CUT), r"soil\.unit_weight: got nan"),
    "no exponent": (
        lambda: wheel_force(replace(CLEAN, exponent=0), 0.2, 0.1, 0.01, 0.1),
        r"soil\.exponent: got 0; .*above 0",
    ),
    "drowned wheel": (lambda: wheel_force(CLEAN, 0.2, 0.1, 0.3, 0.1), "sinkage: got 0.3; .*at most 0.2.*radius"),
    "skidding wheel": (lambda: wheel_force(CLEAN, 0.2, 0.1, 0.01, -0.1), "slip: got -0.1; .*driven wheel"),
    "no blade": (lambda: blade_force(js.make_scene((4, 4), 0.01), np.zeros((4, 4)), AT, CLEAN), "tool: got NoTool.*Blade"),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_input(case):
    call, message = BAD[case]
    with pytest.raises(ValueError, match=message):
        call()
