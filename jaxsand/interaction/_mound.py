"""A mound of sand at repose that leans on a blade's face.

At the distance r from the face it is mu (R - r) high, mu = tan(angle of repose) and R its reach: a wedge across the blade
and a quarter of a cone at each end. Over level sand without bounds its volume is w mu R^2 / 2 + (pi / 6) mu R^3, w the
blade's width; beside walls there are no cones, and V = w mu R^2 / 2 is the right triangle of peak sqrt(2 mu V / w) and toe
sqrt(2 V / (mu w)). Whatever bounds the sand, R is such that the cells that hold sand hold V.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass

import jax
import jax.numpy as jnp

Holds = Callable[[jax.Array], tuple[jax.Array, jax.Array]]
_STEPS = 2  # of Newton's: the volume is a convex function of the reach
_FARTHEST = 64.0  # times the reach without bounds, in a cell and less


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Lean:
    """Where a mound may lie: the distance `far` of cells from the face (m), and the part `share` of each that counts."""

    far: jax.Array
    share: jax.Array


def lean(u: jax.Array, m: jax.Array, dx: jax.Array, sand: jax.Array) -> Lean:
    """Ahead of a face, from u, how far ahead of it cells lie, and m, how far beyond its ends (m)."""
    first, last = jnp.maximum(u - dx / 2, 0), jnp.maximum(u + dx / 2, 0)
    return Lean(distance((first + last) / 2, beyond(m, dx)), (last - first) / dx * sand)


def beyond(m: jax.Array, dx: jax.Array) -> jax.Array:
    """The mean of max(m, 0) over a spacing."""
    return jnp.clip(m + dx / 2, 0, dx) ** 2 / (2 * dx) + jnp.maximum(m - dx / 2, 0)


def distance(a: jax.Array, b: jax.Array) -> jax.Array:
    """sqrt(a^2 + b^2), with a derivative at 0."""
    square = a * a + b * b
    return jnp.where(square > 0, jnp.sqrt(jnp.where(square > 0, square, 1)), 0)


def heights(where: Lean, reach: jax.Array, dx: jax.Array) -> jax.Array:
    """The mound's mean heights over cells, over mu; exact straight ahead of the face."""
    part, above = _parts(where, reach, dx)
    return part**2 / (2 * dx) + where.share * above


def unbounded(volume: jax.Array, width: jax.Array, open_: jax.Array, dx: jax.Array) -> jax.Array:
    """A mound's reach where nothing is in its way, the share `open_` of its ends apart; `volume` is the sum of its heights,
    over mu (m)."""
    wanted, width = jnp.maximum(volume, 0) * dx * dx, jnp.maximum(width, dx)
    reach = jnp.sqrt(2 * wanted / width + (dx / 16) ** 2)
    for _ in range(3):
        held = (width / 2 + math.pi / 6 * open_ * reach) * reach**2
        reach = reach - (held - wanted) / ((width + math.pi / 2 * open_ * reach) * reach)
    return jnp.maximum(reach, dx / 16)


def held(where: Lean, reach: jax.Array, dx: jax.Array) -> tuple[jax.Array, jax.Array]:
    """The sum of a mound's heights, over mu, and its derivative by the reach."""
    part, above = _parts(where, reach, dx)
    return _sum(part**2 / (2 * dx) + where.share * above), _sum(part) / dx


def _parts(where: Lean, reach: jax.Array, dx: jax.Array) -> tuple[jax.Array, jax.Array]:
    """How much of each cell's length the mound's top passes over its start, and how high it is above its end."""
    z, b = reach - where.far, where.share * dx / 2
    start, end = z + b, z - b
    return jnp.where(end > 0, 2 * b, jnp.where(start > 0, start, 0)), jnp.where(end > 0, end, 0)


def _sum(x: jax.Array) -> jax.Array:
    return jnp.sum(jnp.sum(x, axis=0))  # rows first: XLA vectorises that


def reach_of(volume: jax.Array, start: jax.Array, holds: Holds, dx: jax.Array) -> jax.Array:
    """The reach R at which holds(R), with its derivative, is `volume` (sums of heights, over mu): Newton's method."""
    most = _FARTHEST * (start + dx)
    reach = start
    for _ in range(_STEPS):
        there, slope = holds(reach)
        reach = jnp.clip(reach + (volume - there) / jnp.maximum(slope, 1e-3), 0, most)
    return reach
