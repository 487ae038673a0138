"""What bounds the sand: solid cells inside the map, and the map's edge."""

from dataclasses import dataclass

import jax


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Open:
    """No cell is solid (neutral)."""


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Walls:
    """Cells where `solid` [H, W] is true hold no sand and let none through; their height is left as it is."""

    solid: jax.Array


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Closed:
    """A wall stands along the map's edge: no sand leaves (neutral)."""


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Draining:
    """Sand runs off over the map's edge, whose rim stands at height `level` (m), half a spacing beyond the outer cells."""

    level: jax.Array | float = 0.0
