"""What the sand is made of."""

import math
from dataclasses import dataclass

import jax
from jaxtyping import Array, Float


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Material:
    """A dry granular material, described by its angle of repose.

    Sand at rest is nowhere steeper than tan(repose_angle). Between two cells of different angles, the mean of their
    tangents is the limit. `make_scene` builds a material and checks it.

    Attributes:
        repose_angle: angle of repose (rad), above 0 and below pi/2: a scalar, or one angle per cell [H, W].

    Example:
        >>> import math
        >>> import jaxsand as js
        >>> round(math.degrees(js.DRY_SAND.repose_angle), 6)
        29.0
        >>> js.make_scene((8, 8), 0.01, repose_angle=math.radians(35)).material == js.Material(math.radians(35))
        True
    """

    repose_angle: Float[Array, "H W"] | Float[Array, ""] | float


DRY_SAND = Material(math.radians(29.0))
"""The dry sand of Kim, Pavlov & Johnson (arXiv:1908.02745), whose angle of repose is 29 degrees."""
