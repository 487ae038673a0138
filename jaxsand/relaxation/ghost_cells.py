"""The bed: a height map made ready for sweeping, and the arithmetic that keeps its volume.

A cell without sand (solid, beyond the edge, not finite) holds NaN while sweeping: every comparison with it is false, so
nothing flows. Maps are kept in a halo of one such cell on each side. Every flux is cut to a whole number of quanta. A
quantum is a power of two so chosen that sums of quanta are exact in the floats at hand: volume is conserved to the last bit
where the heights are whole quanta themselves, and no rounding builds up where they are not. The derivative ignores the cut.
"""

from dataclasses import dataclass, field

import jax
import jax.numpy as jnp
from jax import lax

from jaxsand.scene.boundaries import Draining, Walls
from jaxsand.scene.grid import Neighbours
from jaxsand.scene.scene import Scene

Lost = tuple[jax.Array, jax.Array] | None


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Bed:
    """What a sweep needs of a scene; its maps can be cut to a window."""

    spacing: jax.Array  # m, []
    drop: jax.Array  # the largest stable step between straight neighbours, mu dx: [] or [H, W]
    rim: "Rim | None"
    elsewhere: jax.Array  # the largest |height| outside a block of a map, or the depth below 0 of a rim (m), []
    neighbours: Neighbours = field(metadata={"static": True})


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Rim:
    """A draining edge: `beyond` [H + 2, W + 2] is 1 in the map's halo and 0 inside; the rim stands at `level` (m)."""

    beyond: jax.Array
    level: jax.Array


def prepare(scene: Scene) -> Bed:
    """The scene's bed; the scene's floats have the height's dtype already."""
    dx = jnp.asarray(scene.grid.spacing)
    drop = jnp.tan(jnp.asarray(scene.material.repose_angle)) * dx
    rim = rim_of(scene.grid.shape, jnp.asarray(scene.edge.level)) if isinstance(scene.edge, Draining) else None
    deep = jnp.zeros_like(dx)
    if rim is not None:  # sand comes to lie as deep as the rim
        level = lax.stop_gradient(rim.level)
        deep = jnp.where((level < 0) & jnp.isfinite(level), -level, 0).astype(dx.dtype)
    return Bed(dx, drop, rim, deep, scene.grid.neighbours)


def rim_of(shape: tuple[int, ...], level: jax.Array) -> Rim:
    """The rim of a map of this shape."""
    return Rim(halo(jnp.zeros(shape, level.dtype), 1.0), level)


def mark(scene: Scene, height: jax.Array) -> tuple[jax.Array, jax.Array]:
    """The height with NaN in the cells that hold no sand, and whether a cell that should hold some is not finite."""
    finite = jnp.isfinite(height)
    if isinstance(scene.walls, Walls):
        sand = finite & ~scene.walls.solid
        return jnp.where(sand, height, jnp.nan), jnp.any(~finite & ~scene.walls.solid)
    return jnp.where(finite, height, jnp.nan), ~jnp.all(finite)


def unmark(height: jax.Array, original: jax.Array) -> jax.Array:
    """The height with the original values in the cells that hold no sand."""
    return jnp.where(jnp.isnan(height), original, height)


def spoiled(before: jax.Array, after: jax.Array) -> jax.Array:
    """Whether a marked map lost a cell on the way, or overflowed."""
    return jnp.any((jnp.isnan(after) != jnp.isnan(before)) | jnp.isinf(after))


def sound(bed: Bed) -> jax.Array:
    """Whether spacing and angles are usable numbers; what is traced escapes `make_scene`."""
    return jnp.all(jnp.isfinite(bed.drop) & (bed.drop >= 0)) & (bed.spacing > 0)


def largest(height: jax.Array) -> jax.Array:
    """The largest |height| where there is sand."""
    size = jnp.abs(height)
    return jnp.max(jnp.max(jnp.where(size > 0, size, 0), axis=0))  # rows first: XLA vectorises that


def quantum(scale: jax.Array) -> jax.Array:
    """The power of two of which heights up to `scale` hold at most 2^(p - 1), p the significand's bits."""
    info = jnp.finfo(scale.dtype)
    scale = jnp.maximum(lax.stop_gradient(scale), float(info.tiny) * 2.0**info.nmant)
    _, exponent = jnp.frexp(scale)
    return jnp.ldexp(jnp.ones_like(scale), exponent - info.nmant)


def grain(bed: Bed, u: jax.Array) -> jax.Array:
    """The quantum for a map with halo."""
    return quantum(jnp.maximum(largest(u), bed.elsewhere))


@jax.custom_jvp
def truncate(x: jax.Array) -> jax.Array:
    """Towards zero to a whole number; its derivative is taken to be that of the identity.

    Reverse mode forgets such a rule after the first derivative: loops that use it must refuse a second one
    (while_loop.py does).
    """
    return jnp.trunc(x)


truncate.defjvps(lambda tangent, _, x: tangent)


@jax.custom_jvp
def nearest(x: jax.Array) -> jax.Array:
    """The nearest whole number, one instruction where `truncate` takes several; its derivative is the identity's too."""
    return lax.round(x, lax.RoundingMethod.TO_NEAREST_EVEN)


nearest.defjvps(lambda tangent, _, x: tangent)


def lose(quantum: jax.Array, lost: tuple[jax.Array, jax.Array], amount: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Adds whole quanta [H, W] to what was lost: (low, high), whose sum is exact far beyond the reach of one float."""
    low, high = lost
    low = low + amount
    coarse = quantum * 4096
    carry = truncate(low / coarse) * coarse
    return low - carry, high + carry


def nothing_lost(bed: Bed, height: jax.Array) -> Lost:
    """The start of the account of `lose`, if the bed drains."""
    return None if bed.rim is None else (jnp.zeros_like(height), jnp.zeros_like(height))


def volume_lost(bed: Bed, lost: Lost) -> jax.Array:
    """The volume that drained (m^3)."""
    if lost is None:
        return jnp.zeros_like(bed.spacing)
    return (jnp.sum(lost[1]) + jnp.sum(lost[0])) * bed.spacing**2


def halo(x: jax.Array, value: float = jnp.nan) -> jax.Array:
    """The map with one more cell on each side, stored.

    By concatenation, which XLA vectorises on CPUs, and behind a barrier, lest it be computed anew for every neighbour.
    """
    row = jnp.full((1, *x.shape[1:]), value, x.dtype)
    x = lax.concatenate([row, x, row], 0)
    column = jnp.full((x.shape[0], 1, *x.shape[2:]), value, x.dtype)
    return lax.optimization_barrier(lax.concatenate([column, x, column], 1))


def at(u: jax.Array, di: int = 0, dj: int = 0) -> jax.Array:
    """What each inner cell of a map with halo sees (di, dj) cells further."""
    rows, columns = u.shape[0] - 2, u.shape[1] - 2
    return u[1 + di : 1 + di + rows, 1 + dj : 1 + dj + columns]
