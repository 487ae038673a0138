"""A mound of sand at repose that leans on a blade's face.

At the distance r from the face, the mound is mu (R - r) high, with mu = tan(angle of repose) and R its reach. It is a wedge
across the blade with a quarter of a cone at each end. On an unbounded map its volume is w mu R^2 / 2 + (pi / 6) mu R^3, w
the blade's width. Beside walls there are no cones, and V = w mu R^2 / 2: a right triangle of peak sqrt(2 mu V / w) and
length sqrt(2 V / (mu w)). In every case R is chosen such that the cells with sand hold the volume V.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass

import jax
import jax.numpy as jnp

from jaxsand.relaxation.ghost_cells import total

Holds = Callable[[jax.Array], tuple[jax.Array, jax.Array]]
_STEPS = 2  # Newton steps; few suffice, since the volume is a convex function of the reach
_FARTHEST = 64.0  # the largest reach, over that on an unbounded map and a cell


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Lean:
    """Where a mound may lie: the distance `far` of each cell from the face (m), and the usable `share` of the cell."""

    far: jax.Array
    share: jax.Array


def lean(u: jax.Array, m: jax.Array, dx: jax.Array, sand: jax.Array) -> Lean:
    """The room ahead of a face, for cells that lie u ahead of it and m beyond its ends (m)."""
    first, last = jnp.maximum(u - dx / 2, 0), jnp.maximum(u + dx / 2, 0)
    return Lean(distance((first + last) / 2, beyond(m, dx)), (last - first) / dx * sand)


def beyond(m: jax.Array, dx: jax.Array) -> jax.Array:
    """The mean of max(m, 0) over a spacing around m."""
    return jnp.clip(m + dx / 2, 0, dx) ** 2 / (2 * dx) + jnp.maximum(m - dx / 2, 0)


def distance(a: jax.Array, b: jax.Array) -> jax.Array:
    """sqrt(a^2 + b^2), with a derivative at 0."""
    square = a * a + b * b
    return jnp.where(square > 0, jnp.sqrt(jnp.where(square > 0, square, jnp.finfo(square.dtype).tiny)), 0)


def heights(where: Lean, reach: jax.Array, dx: jax.Array) -> jax.Array:
    """The mound's mean height over each cell, divided by mu (m); exact straight ahead of the face."""
    part, above = _parts(where, reach, dx)
    return part**2 / (2 * dx) + where.share * above


def unbounded(volume: jax.Array, width: jax.Array, open_: jax.Array, dx: jax.Array) -> jax.Array:
    """The reach of a mound on an unbounded map, with the share `open_` of the cones at its ends (m).

    `volume` is the sum of its heights over cells, divided by mu (m).
    """
    wanted, width = jnp.maximum(volume, 0) * dx * dx, jnp.maximum(width, dx)
    reach = jnp.sqrt(2 * wanted / width + (dx / 16) ** 2)
    for _ in range(3):
        held = (width / 2 + math.pi / 6 * open_ * reach) * reach**2
        reach = reach - (held - wanted) / ((width + math.pi / 2 * open_ * reach) * reach)
    return jnp.maximum(reach, dx / 16)


def held(where: Lean, reach: jax.Array, dx: jax.Array) -> tuple[jax.Array, jax.Array]:
    """The sum of a mound's heights over cells, divided by mu, and its derivative by the reach."""
    part, above = _parts(where, reach, dx)
    return total(part**2 / (2 * dx) + where.share * above), total(part) / dx


def _parts(where: Lean, reach: jax.Array, dx: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Of each cell, how much of its length the mound reaches into, and how high the mound is at its far end over mu (m)."""
    z, b = reach - where.far, where.share * dx / 2
    start, end = z + b, z - b
    return jnp.where(end > 0, 2 * b, jnp.where(start > 0, start, 0)), jnp.where(end > 0, end, 0)


def reach_of(volume: jax.Array, start: jax.Array, holds: Holds, dx: jax.Array) -> jax.Array:
    """The reach R at which the volume holds(R)[0] is `volume`, by Newton's method from `start`; holds(R)[1] is the slope.

    Volumes are sums of heights over cells, divided by mu (m).
    """
    most = _FARTHEST * (start + dx)
    reach = start
    for _ in range(_STEPS):
        there, slope = holds(reach)
        reach = jnp.clip(reach + (volume - there) / jnp.maximum(slope, 1e-3), 0, most)
    return reach
