"""Forces of the sand on a blade and on a wheel: an optional layer that reads a scene and never changes it.

Blade: the fundamental equation of earthmoving. A wedge of soil between the blade's face (rake a from the horizontal), the
level surface and a plane failure surface (angle b) slides up; its limit equilibrium gives the force
F = w (g d^2 N_g + c d N_c + c_a d N_ca + q d N_q), and the soil fails at the angle b of least F. Sources: Reece 1964
(doi:10.1243/PIME_CONF_1964_179_134_02), McKyes 1985, "Soil Cutting and Tillage". Sides of the wedge: after Perumpral,
Grisso & Desai 1983, "A soil-tool model based on limit equilibrium analysis", Trans. ASAE 26(4).

Wheel: the pressure-sinkage relation of Bekker 1956, "Theory of Land Locomotion", and the shear of Janosi & Hanamoto 1961,
integrated over the contact of a rigid wheel as in Wong & Reece 1967, J. Terramechanics 4.
Quasi-static. Everything takes scalars, under jit and vmap too; what is being traced is not checked."""

import math
from dataclasses import dataclass, fields
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from jaxsand.scene.grid import centres
from jaxsand.scene.scene import Scene, cast, concrete, fit
from jaxsand.scene.tools import Blade, Pose, coverage

Scalar = jax.Array | float
_TINY = float(np.finfo(np.float32).tiny)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Soil:
    """Strength of a soil (Mohr-Coulomb), its hold on a blade, and how it yields under a wheel (Bekker, Janosi-Hanamoto)."""

    unit_weight: Scalar  # g: density times gravity, N/m^3
    friction: Scalar  # phi: angle of internal friction, rad
    cohesion: Scalar  # c, Pa
    interface_friction: Scalar  # delta: angle of friction of the soil on the blade, rad
    adhesion: Scalar  # c_a: of the soil to the blade, Pa
    cohesive_modulus: Scalar  # k_c, N/m^(n+1)
    frictional_modulus: Scalar  # k_phi, N/m^(n+2)
    exponent: Scalar  # n, of the sinkage
    shear_displacement: Scalar  # K, over which shear builds up, m


WONG_DRY_SAND = Soil(15.7e3, math.radians(28), 1.04e3, math.radians(28) * 2 / 3, 0.0, 0.99e3, 1528.43e3, 1.1, 0.025)
"""Dry sand of Wong, "Theory of Ground Vehicles" (n, k_c, k_phi, c, phi); K of the loose sand in Project Chrono's demos.

Assumed, not from there: 1600 kg/m^3, two thirds of phi on the blade, no adhesion. The cohesion outweighs the rest in cuts of
centimetres; `dataclasses.replace(soil, cohesion=0.0)` leaves a clean dry sand."""

LETE_SAND = Soil(15.7e3, math.radians(31.1), 1.3e3, math.radians(31.1) * 2 / 3, 0.0, 102e3, 5301e3, 0.793, 0.012)
"""LETE sand (n, k_c, k_phi, c, phi, K) as in Project Chrono's demos of soft terrain; the rest assumed as above."""


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Cut:
    """A cut `depth` (m) deep by a blade of `width` (m) and `rake` (rad; pi/2 is upright) under a `surcharge` (Pa).

    `sides` counts the upright faces along which the wedge tears off: 0 in plane strain (a wide blade), 2 in the open.
    """

    depth: Scalar
    width: Scalar
    rake: Scalar = math.pi / 2
    surcharge: Scalar = 0.0
    sides: Scalar = 0.0


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class BladeForce:
    """Force of the soil on a blade, N: against its travel, and upward. A steep blade is lifted, a flat one drawn in."""

    draught: jax.Array
    lift: jax.Array


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class WheelForce:
    """Load carried (N), drawbar pull (N), torque (N m), compaction resistance (N): the pull is shear less resistance."""

    load: jax.Array
    pull: jax.Array
    torque: jax.Array
    resistance: jax.Array


def wedge_factors(soil: Soil, rake: Scalar, angle: Scalar) -> tuple[jax.Array, jax.Array, jax.Array, jax.Array]:
    """N_g, N_c, N_ca and N_q at a failure angle b, where S = sin(a + b + phi + delta) > 0 (McKyes 1985, multiplied out).

    N_q = (cot a + cot b) sin(b + phi) / S, N_g = N_q / 2, N_c = cos phi / (sin b S), N_ca = -cos(a + b + phi) / (sin a S).
    """
    slide = angle + jnp.asarray(soil.friction)
    total = jnp.sin(rake + slide + soil.interface_friction)
    top = (1 / jnp.tan(rake) + 1 / jnp.tan(angle)) * jnp.sin(slide) / total
    cut, held = jnp.cos(soil.friction) / jnp.sin(angle), -jnp.cos(rake + slide) / jnp.sin(rake)
    return top / 2, cut / total, held / total, top


def failure_angle(soil: Soil, cut: Cut) -> jax.Array:
    """The failure angle b of least force, in (0, pi - a - phi - delta), or NaN if that is empty; a constant to derivatives.
    Found on six nested grids of 33 angles, each between the neighbours of the best so far."""
    soil, cut = lax.stop_gradient((soil, cut))
    stop = math.pi - (jnp.asarray(cut.rake) + soil.friction + soil.interface_friction)

    def narrow(_: Any, span: jax.Array) -> jax.Array:
        grid = span[0] + (span[1] - span[0]) * jnp.linspace(0, 1, 33, dtype=stop.dtype)
        return lax.dynamic_slice(grid, [jnp.clip(jnp.argmin(_stress(soil, cut, grid)), 1, 31) - 1], [3])[::2]

    low, high = lax.fori_loop(0, 6, narrow, jnp.stack([1e-3 * stop, 0.999 * stop]))
    return jnp.where(stop > 0, (low + high) / 2, jnp.nan)


def cut_force(soil: Soil, cut: Cut) -> BladeForce:
    """Force on the blade: F at the angle a + delta, with the adhesion c_a d w / sin a along its face.

    First derivatives are exact: F is least over b, so dF/dp is the partial derivative at fixed b (envelope theorem). Second
    derivatives are not. NaN where no wedge can slide.
    """
    _check_soil(soil)
    _check("cut.width", cut.width, _TINY, np.inf, "give metres")
    for name in ("depth", "surcharge", "sides"):
        _check(f"cut.{name}", getattr(cut, name), 0, 2 if name == "sides" else np.inf, "give metres below the surface, Pa")
    held = sum(float(a) for a in map(concrete, (soil.friction, soil.interface_friction)) if a is not None)
    _check("cut.rake", cut.rake, _TINY, math.pi - held - 1e-6, "pi less both angles of friction locks the wedge")
    area = jnp.asarray(cut.depth) * cut.width
    force, stuck = area * _stress(soil, cut, failure_angle(soil, cut)), area * soil.adhesion
    out = cut.rake + soil.interface_friction
    return BladeForce(force * jnp.sin(out) + stuck / jnp.tan(cut.rake), stuck - force * jnp.cos(out))


def blade_force(scene: Scene, height: jax.typing.ArrayLike, pose: Pose, soil: Soil, level: Scalar = 0.0) -> BladeForce:
    """Force on the scene's blade, upright and lowered at `pose`, about to move ahead; its wedge has two sides.

    The sand is read over the blade's width in a strip one spacing long that starts one spacing ahead of the face: along the
    grid, no cell which the blade covers in part is read. The strip's mean of the sand between the blade's bottom and `level`
    (m), the height of undisturbed ground, is the depth of cut. What lies above both is a heap: the weight of its mean is the
    surcharge. A blade that moves only a heap has no cut and feels nothing; `level=jnp.inf` counts all sand as cut. Zero off
    the map. Differentiable in height, pose and soil, except at kinks of the depth and of the coverage.
    """
    scene, height = fit(scene, height)
    blade, dx = scene.tool, jnp.asarray(scene.grid.spacing)
    if not isinstance(blade, Blade):
        raise ValueError(f"tool: got {blade!r}; give the scene a Blade(width, thickness, depth)")
    soil, pose, level = cast((soil, pose, level), height.dtype)
    ahead = jnp.asarray(blade.thickness) / 2 + 1.5 * dx
    middle = Pose(pose.x + ahead * pose.cos, pose.y + ahead * pose.sin, pose.cos, pose.sin)
    share = coverage(Blade(blade.width, dx), middle, *centres(scene.grid, height.dtype), dx)
    share /= jnp.maximum(jnp.sum(share), _TINY)
    bottom = -jnp.asarray(blade.depth)
    depth = jnp.sum(share * jnp.maximum(jnp.minimum(height, level) - bottom, 0))
    heap = jnp.sum(share * jnp.maximum(height - jnp.maximum(level, bottom), 0))
    return cut_force(soil, Cut(depth, blade.width, surcharge=heap * soil.unit_weight, sides=2.0))


def wheel_force(soil: Soil, radius: Scalar, width: Scalar, sinkage: Scalar, slip: Scalar) -> WheelForce:
    """Forces on a driven rigid wheel, 0 <= slip <= 1, sunk by `sinkage` (m): contact from t_1 = acos(1 - z / r) to 0.

    At the angle t from the lowest point: p = (k_c / b + k_phi)(r (cos t - cos t_1))^n, tau = (c + p tan phi)(1 - e^(-j / K))
    after the shear displacement j = r (t_1 - t - (1 - slip)(sin t_1 - sin t)). Load and pull are the integrals over t of
    r b (p cos t + tau sin t) and r b (tau cos t - p sin t), the torque that of r^2 b tau. Differentiable; 0 at sinkage 0.
    """
    _check_soil(soil)
    _check("radius", radius, _TINY, np.inf, "give metres")
    _check("width", width, _TINY, np.inf, "give metres")
    _check("sinkage", sinkage, 0, np.inf if concrete(radius) is None else radius, "give metres, at most the radius")
    _check("slip", slip, 0, 1, "give 1 - speed / (radius * rate) of a driven wheel")
    touches = jnp.asarray(sinkage) > 0
    entry = 2 * jnp.arcsin(jnp.sqrt(jnp.where(touches, sinkage, radius) / (2 * jnp.asarray(radius))))
    nodes, weights = (jnp.asarray(a, entry.dtype) for a in np.polynomial.legendre.leggauss(40))
    root = (1 + nodes) / 2  # t = t_1 (1 - root^2) smooths p^n at the entry
    t, dt = entry * (1 - root**2), entry * root * weights
    below = 2 * radius * jnp.sin((entry + t) / 2) * jnp.sin((entry - t) / 2)
    pressure = (soil.cohesive_modulus / width + soil.frictional_modulus) * below**soil.exponent
    slid = radius * (entry - t - (1 - slip) * (jnp.sin(entry) - jnp.sin(t))) / soil.shear_displacement
    shear = (soil.cohesion + pressure * jnp.tan(soil.friction)) * -jnp.expm1(-slid)
    parts = jnp.stack([pressure * jnp.cos(t), pressure * jnp.sin(t), shear * jnp.cos(t), shear * jnp.sin(t), shear])
    normal, resistance, thrust, held, turned = jnp.where(touches, radius * width * (parts @ dt), 0)
    return WheelForce(normal + held, thrust - resistance, radius * turned, resistance)


def bekker_sinkage(soil: Soil, radius: Scalar, width: Scalar, load: Scalar) -> jax.Array:
    """Sinkage (m) under a load W (N) without shear, small beside D = 2 r: (3 W / (b (3 - n) k sqrt(D)))^(2 / (2 n + 1)) with
    k = k_c / b + k_phi (Bekker 1956). The factor (3 - n) / 3 is an approximation, exact for n = 1."""
    modulus = soil.cohesive_modulus + width * soil.frictional_modulus
    return (3 * jnp.asarray(load) / ((3 - soil.exponent) * modulus * jnp.sqrt(2 * radius))) ** (2 / (2 * soil.exponent + 1))


def bekker_resistance(soil: Soil, width: Scalar, sinkage: Scalar) -> jax.Array:
    """Compaction resistance (N), the work of pressing a metre of rut: b k z^(n+1) / (n + 1) (Bekker 1956)."""
    modulus = soil.cohesive_modulus + width * soil.frictional_modulus
    return modulus * jnp.asarray(sinkage) ** (soil.exponent + 1) / (soil.exponent + 1)


def _stress(soil: Soil, cut: Cut, angle: jax.Array) -> jax.Array:
    """F / (w d), Pa. Each side, of area A = d^2 (cot a + cot b) / 2, resists sliding with A (c + K_0 (g d / 3 + q) tan phi):
    the mean pressure at rest, with K_0 = 1 - sin phi (Jaky 1944). It acts as cohesion on the failure surface does."""
    weight, cohesion, adhesion, surcharge = wedge_factors(soil, cut.rake, angle)
    mean = soil.unit_weight * cut.depth / 3 + cut.surcharge
    shear = soil.cohesion + (1 - jnp.sin(soil.friction)) * mean * jnp.tan(soil.friction)
    area = cut.depth / cut.width * (1 / jnp.tan(cut.rake) + 1 / jnp.tan(angle)) / 2
    plane = soil.unit_weight * cut.depth * weight + soil.adhesion * adhesion + cut.surcharge * surcharge
    return plane + (soil.cohesion + cut.sides * area * shear * jnp.sin(angle)) * cohesion


def _check_soil(soil: Soil) -> None:
    for name in (field.name for field in fields(soil)):
        low = _TINY if name in ("exponent", "shear_displacement") else 0
        high = {"friction": 1.57, "interface_friction": 1.57, "exponent": 3}.get(name, np.inf)
        _check(f"soil.{name}", getattr(soil, name), low, high, "give SI units; for degrees use math.radians(30)")


def _check(name: str, value: Any, low: float, high: Any, remedy: str) -> None:
    array = concrete(value)
    if array is not None and not (array.ndim == 0 and np.isfinite(array) and low <= array <= high):
        least = "above" if low else "of at least"
        raise ValueError(f"{name}: got {value!r}; give one finite number {least} 0, at most {high}: {remedy}")
