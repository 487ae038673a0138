"""How soil carries a rigid wheel: load, pull and torque at a sinkage, and the sinkage under a load.

The pressure-sinkage relation of Bekker 1956, "Theory of Land Locomotion", and the shear of Janosi & Hanamoto 1961 are
integrated over the contact of a rigid wheel as in Wong & Reece 1967, J. Terramechanics 4. Quasi-static, on level ground. All
functions take scalars and work under jit, grad and vmap; traced values are not checked.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from jaxsand.scene.soil import TINY, Scalar, Soil, check_number, check_soil
from jaxsand.scene.validation import concrete

_NODES = 40  # of the Gauss quadrature over the contact
_LEAST = 1e-8  # of the radius: a sinkage below which load and sinkage are taken as proportional
_STEPS = 16  # of Newton's method, which takes 4 or 5 from where it starts


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class WheelForce:
    """The forces of the soil on a driven wheel.

    Attributes:
      load: carried (N).
      pull: drawbar pull (N), the shear thrust less the resistance.
      torque: on the axle (N m).
      resistance: compaction resistance (N).

    Example:
      >>> import jaxsand as js
      >>> force = js.forces.wheel_force(js.forces.WONG_DRY_SAND, 0.048, 0.05, sinkage=0.01, slip=0.2)
      >>> bool(force.load > force.resistance > 0)
      True
    """

    load: jax.Array
    pull: jax.Array
    torque: jax.Array
    resistance: jax.Array


def wheel_force(soil: Soil, radius: Scalar, width: Scalar, sinkage: Scalar, slip: Scalar) -> WheelForce:
    """The forces of the soil on a driven rigid wheel at a given sinkage and slip.

    The contact runs from the entry angle t_1 = acos(1 - z / r) to the lowest point, t = 0. At the angle t,
    p = (k_c / b + k_phi)(r (cos t - cos t_1))^n and tau = (c + p tan phi)(1 - e^(-j / K)), with the shear displacement
    j = r (t_1 - t - (1 - slip)(sin t_1 - sin t)). Load and pull are the integrals over t of r b (p cos t + tau sin t) and of
    r b (tau cos t - p sin t), the torque is that of r^2 b tau.

    Args:
      soil: the soil's strength.
      radius: r (m).
      width: b (m).
      sinkage: z (m), 0 to r.
      slip: 1 - speed / (r times rate), 0 to 1.

    Returns:
      A `WheelForce` (N, torque in N m), 0 at sinkage 0. Differentiable in all arguments.

    Raises:
      ValueError: for a value out of range.

    Source: Bekker 1956, "Theory of Land Locomotion"; Janosi & Hanamoto 1961; Wong & Reece 1967, J. Terramechanics 4.

    Example:
      >>> import jaxsand as js
      >>> soil = js.forces.WONG_DRY_SAND
      >>> slipping = js.forces.wheel_force(soil, radius=0.048, width=0.05, sinkage=0.01, slip=0.5)
      >>> gripping = js.forces.wheel_force(soil, radius=0.048, width=0.05, sinkage=0.01, slip=0.1)
      >>> bool(slipping.pull > gripping.pull)
      True
    """
    check_soil(soil)
    check_number("radius", radius, TINY, np.inf, "give metres")
    check_number("width", width, TINY, np.inf, "give metres")
    check_number("sinkage", sinkage, 0, np.inf if concrete(radius) is None else radius, "give metres, at most the radius")
    check_number("slip", slip, 0, 1, "give 1 - speed / (radius * rate) of a driven wheel")
    touches = jnp.asarray(sinkage) > 0
    entry = 2 * jnp.arcsin(jnp.sqrt(jnp.where(touches, sinkage, radius) / (2 * jnp.asarray(radius))))
    nodes, weights = (jnp.asarray(a, entry.dtype) for a in np.polynomial.legendre.leggauss(_NODES))
    root = (1 + nodes) / 2  # t = t_1 (1 - root^2) smooths p^n at the entry
    t, dt = entry * (1 - root**2), entry * root * weights
    below = 2 * radius * jnp.sin((entry + t) / 2) * jnp.sin((entry - t) / 2)
    pressure = (soil.cohesive_modulus / width + soil.frictional_modulus) * below**soil.exponent
    slid = radius * (entry - t - (1 - slip) * (jnp.sin(entry) - jnp.sin(t))) / soil.shear_displacement
    shear = (soil.cohesion + pressure * jnp.tan(soil.friction)) * -jnp.expm1(-slid)
    parts = jnp.stack([pressure * jnp.cos(t), pressure * jnp.sin(t), shear * jnp.cos(t), shear * jnp.sin(t), shear])
    normal, resistance, thrust, held, turned = jnp.where(touches, radius * width * (parts @ dt), 0)
    return WheelForce(normal + held, thrust - resistance, radius * turned, resistance)


def wheel_sinkage(soil: Soil, radius: Scalar, width: Scalar, load: Scalar, slip: Scalar = 0.0) -> jax.Array:
    """The sinkage at which the soil carries a load: the z at which `wheel_force(soil, radius, width, z, slip).load` = W.

    The load grows with the sinkage and is nearly a power of it, so that Newton's method on the logarithms, held between two
    bounds, converges from everywhere. Below a hundred-millionth of the radius the sinkage is proportional to the load, and
    0 under none.

    Args:
      soil: the soil's strength.
      radius: r (m).
      width: b (m).
      load: W (N), 0 or more.
      slip: 1 - speed / (r times rate), 0 to 1.

    Returns:
      The sinkage z (m), 0 to r; NaN if the soil does not carry the load before the wheel stands in it up to its axle.
      Differentiable in all arguments, by the implicit function theorem.

    Raises:
      ValueError: for a value out of range.

    Source: Wong & Reece 1967, J. Terramechanics 4: the balance of vertical forces.

    Example:
      >>> import jaxsand as js
      >>> sinkage = js.forces.wheel_sinkage(js.forces.WONG_DRY_SAND, radius=0.048, width=0.05, load=10.0, slip=0.2)
      >>> force = js.forces.wheel_force(js.forces.WONG_DRY_SAND, 0.048, 0.05, sinkage, slip=0.2)
      >>> round(float(force.load), 3)
      10.0
    """
    check_soil(soil)
    for name, value in (("radius", radius), ("width", width)):
        check_number(name, value, TINY, np.inf, "give metres")
    check_number("load", load, 0, np.inf, "give newtons")
    check_number("slip", slip, 0, 1, "give 1 - speed / (radius * rate) of a driven wheel")
    radius, load = jnp.asarray(radius), jnp.asarray(load)
    dtype = jnp.result_type(float, *jax.tree.leaves((soil, radius, width, load, slip)))
    radius, load = radius.astype(dtype), load.astype(dtype)

    def carried(depth: jax.Array) -> jax.Array:
        """The load at the sinkage r e^depth."""
        return wheel_force(soil, radius, width, radius * jnp.exp(depth), slip).load

    low, high = jnp.log(jnp.asarray(_LEAST, dtype)), jnp.zeros((), dtype)
    least, most = carried(low), carried(high)
    heavy, light = load > most, load < least
    aim = jnp.log(jnp.where(heavy | light | ~(load > 0), jnp.sqrt(least * most), load))
    depth = lax.custom_root(
        lambda depth: jnp.log(carried(depth)) - aim,
        jnp.log(jnp.asarray(0.1, dtype)),
        partial(_newton, low, high),
        lambda slope, y: y / slope(jnp.ones_like(y)),
    )
    sinkage = radius * jnp.where(light, _LEAST * load / least, jnp.exp(depth))
    return jnp.where(load <= most, sinkage, jnp.nan)


def _newton(low: jax.Array, high: jax.Array, f: Callable[[jax.Array], jax.Array], start: jax.Array) -> jax.Array:
    """The root of a growing function by Newton's method, which halves the bracket where a step would lead out of it."""

    def step(_: int, state: tuple[jax.Array, jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array, jax.Array]:
        x, low, high = state
        value, slope = jax.jvp(f, (x,), (jnp.ones_like(x),))
        low, high = jnp.where(value < 0, x, low), jnp.where(value > 0, x, high)
        ahead = x - value / slope
        return jnp.where((ahead >= low) & (ahead <= high), ahead, (low + high) / 2), low, high

    return lax.fori_loop(0, _STEPS, step, (start, low, high))[0]


def bekker_sinkage(soil: Soil, radius: Scalar, width: Scalar, load: Scalar) -> jax.Array:
    """The sinkage of a rigid wheel under a load, without shear.

    z = (3 W / (b (3 - n) k sqrt(D)))^(2 / (2 n + 1)) with k = k_c / b + k_phi and D = 2 r, for z small beside D. The factor
    (3 - n) / 3 is an approximation, exact for n = 1.

    Args:
      soil: the soil's strength.
      radius: r (m).
      width: b (m).
      load: W (N).

    Returns:
      The sinkage z (m). Differentiable.

    Source: Bekker 1956, "Theory of Land Locomotion".

    Example:
      >>> import jaxsand as js
      >>> round(float(js.forces.bekker_sinkage(js.forces.WONG_DRY_SAND, radius=0.048, width=0.05, load=10.0)), 4)
      0.0103
    """
    modulus = soil.cohesive_modulus + width * soil.frictional_modulus
    return (3 * jnp.asarray(load) / ((3 - soil.exponent) * modulus * jnp.sqrt(2 * radius))) ** (2 / (2 * soil.exponent + 1))


def bekker_resistance(soil: Soil, width: Scalar, sinkage: Scalar) -> jax.Array:
    """The compaction resistance of a wheel: the work of pressing a rut one metre long.

    R = b k z^(n + 1) / (n + 1) with k = k_c / b + k_phi.

    Args:
      soil: the soil's strength.
      width: b (m).
      sinkage: z (m).

    Returns:
      R (N). Differentiable.

    Source: Bekker 1956, "Theory of Land Locomotion".

    Example:
      >>> import jaxsand as js
      >>> round(float(js.forces.bekker_resistance(js.forces.WONG_DRY_SAND, width=0.05, sinkage=0.01)), 2)
      2.33
    """
    modulus = soil.cohesive_modulus + width * soil.frictional_modulus
    return modulus * jnp.asarray(sinkage) ** (soil.exponent + 1) / (soil.exponent + 1)
