"""What the sand is made of."""

import math
from dataclasses import dataclass

import jax


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Material:
    """A dry granular material, known by its angle of repose (rad): a scalar, or one angle per cell [H, W].

    A link between two cells of different angles yields at the mean of their tangents.
    """

    repose_angle: jax.Array | float


DRY_SAND = Material(math.radians(29.0))
"""The sand of Kim, Pavlov & Johnson (arXiv:1908.02745), angle of repose 29 degrees."""
