"""The strength of soils, for forces on tools and for wheels under load."""

import math
from dataclasses import dataclass, fields

import jax
import numpy as np

from jaxsand.scene.validation import concrete, short

Scalar = jax.Array | float
TINY = float(np.finfo(np.float32).tiny)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Soil:
    """The strength of a soil (Mohr-Coulomb), its hold on a blade, and how it yields under a wheel (Bekker, Janosi-Hanamoto).

    Args:
      unit_weight: g, density times gravity (N/m^3).
      friction: phi, angle of internal friction (rad).
      cohesion: c (Pa).
      interface_friction: delta, angle of friction of the soil on the blade (rad).
      adhesion: c_a, of the soil to the blade (Pa).
      cohesive_modulus: k_c of Bekker's pressure-sinkage relation (N/m^(n+1)).
      frictional_modulus: k_phi of the same relation (N/m^(n+2)).
      exponent: n, of the sinkage in the same relation.
      shear_displacement: K, the length over which shear stress builds up (m).

    Example:
      >>> import jaxsand as js
      >>> import dataclasses
      >>> clean = dataclasses.replace(js.forces.WONG_DRY_SAND, cohesion=0.0)
      >>> clean.cohesion
      0.0
    """

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


def check_soil(soil: Soil) -> None:
    """Raises ValueError for a soil with a number out of range."""
    for name in (field.name for field in fields(soil)):
        low = TINY if name in ("exponent", "shear_displacement") else 0
        high = {"friction": 1.57, "interface_friction": 1.57, "exponent": 3}.get(name, np.inf)
        check_number(f"soil.{name}", getattr(soil, name), low, high, "give SI units; for degrees use math.radians(30)")


def check_number(name: str, value: Scalar, low: float, high: Scalar, remedy: str) -> None:
    """Raises ValueError unless it is one finite number from `low` to `high`; what is being traced passes."""
    array = concrete(value)
    if array is not None and not (array.ndim == 0 and np.isfinite(array) and low <= array <= high):
        least = "above" if low else "of at least"
        raise ValueError(f"{name}: got {short(value)}; give one finite number {least} 0, at most {high}: {remedy}")
