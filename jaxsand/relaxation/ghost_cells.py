"""Height maps with ghost cells, and the arithmetic that conserves their volume.

While sweeping, a cell without sand (solid, beyond the edge, not finite) holds NaN. Every comparison with NaN is false, so
that nothing flows there. Each map has one ghost cell of this kind on each side. Every flux is cut to a multiple of a
quantum, a power of two such that sums of quanta are exact in the height's dtype. So volume is conserved to the last bit
where heights are multiples of the quantum, and rounding errors do not build up where they are not. Derivatives ignore the
cut.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import accumulate

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

from jaxsand.scene.boundaries import Base, Draining, Walls
from jaxsand.scene.grid import Neighbours
from jaxsand.scene.scene import Scene


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class ExactSum:
    """An account of many small amounts: two floats, or maps of them, whose sum is exact far beyond the range of one."""

    low: jax.Array
    high: jax.Array

    @property
    def value(self) -> jax.Array:
        """The sum as one float, rounded."""
        return self.low + self.high


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Bed:
    """What a sweep needs of a scene; its maps can be cut to a window.

    Attributes:
        spacing: distance of neighbouring cell centres dx (m).
        drop: largest stable step between straight neighbours, tan(angle of repose) dx (m).
        rim: the draining edge, or None where the edge is closed.
        base: height of the floor under the sand (m), or None for a bed without one.
        elsewhere: largest |height| outside the block of the map that is swept, or the depth of the rim below 0 (m).
        neighbours: 4, 8 or "isotropic".
    """

    spacing: Float[Array, ""]
    drop: Float[Array, ""] | Float[Array, "H W"]
    rim: "Rim | None"
    base: Float[Array, "H W"] | None
    elsewhere: Float[Array, ""]
    neighbours: Neighbours = field(metadata={"static": True})

    @property
    def by_links(self) -> bool:
        """Whether the derivative of a sweep follows from which links are active: sand flows in pairs, and nothing else."""
        return self.neighbours != "isotropic" and self.rim is None and self.base is None


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Rim:
    """A draining edge: `beyond` is 1 in the ghost cells and 0 elsewhere; the rim stands at the height `level` (m)."""

    beyond: Float[Array, "H+2 W+2"]
    level: Float[Array, ""]


def prepare(scene: Scene) -> Bed:
    """The bed of a scene whose numbers were cast to the height's dtype; see `fit`."""
    dx = jnp.asarray(scene.grid.spacing)
    drop = jnp.tan(jnp.asarray(scene.material.repose_angle)) * dx
    rim = rim_of(scene.grid.shape, jnp.asarray(scene.edge.level)) if isinstance(scene.edge, Draining) else None
    deep = jnp.zeros_like(dx)
    if rim is not None:  # sand comes to lie as deep as the rim
        level = lax.stop_gradient(rim.level)
        deep = jnp.where((level < 0) & jnp.isfinite(level), -level, 0).astype(dx.dtype)
    base = None
    if isinstance(scene.base, Base):
        base = jnp.broadcast_to(jnp.asarray(scene.base.height), scene.grid.shape)
    return Bed(dx, drop, rim, base, deep, scene.grid.neighbours)


def rim_of(shape: tuple[int, ...], level: Float[Array, ""]) -> Rim:
    """The rim of a map of this shape, all of whose edges drain."""
    return Rim(halo(jnp.zeros(shape, level.dtype), 1.0), level)


def mark(scene: Scene, height: Float[Array, "H W"]) -> tuple[Float[Array, "H W"], Bool[Array, ""]]:
    """The height with NaN in the cells that hold no sand, and whether a cell that is not solid is not finite."""
    finite = jnp.isfinite(height)
    if isinstance(scene.walls, Walls):
        sand = finite & ~scene.walls.solid
        return jnp.where(sand, height, jnp.nan), jnp.any(~finite & ~scene.walls.solid)
    return jnp.where(finite, height, jnp.nan), ~jnp.all(finite)


def unmark(height: Float[Array, "H W"], original: Float[Array, "H W"]) -> Float[Array, "H W"]:
    """The height with the original values in place of NaN, in the cells that hold no sand."""
    return jnp.where(jnp.isnan(height), original, height)


def spoiled(before: Float[Array, "H W"], after: Float[Array, "H W"]) -> Bool[Array, ""]:
    """Whether a computation made NaN of a cell with sand, or an infinity; both maps are marked."""
    return jnp.any((jnp.isnan(after) != jnp.isnan(before)) | jnp.isinf(after))


def below_base(bed: Bed, height: Float[Array, "H W"]) -> Bool[Array, ""]:
    """Whether a marked map lies below the floor somewhere, by more than rounding."""
    if bed.base is None:
        return jnp.zeros((), bool)
    return jnp.any(height < bed.base - 1e-6 * bed.spacing)


def sound(bed: Bed) -> Bool[Array, ""]:
    """Whether spacing, angles and floor are in range; checks traced values, which `make_scene` cannot."""
    good = jnp.all(jnp.isfinite(bed.drop) & (bed.drop >= 0)) & (bed.spacing > 0)
    return good if bed.base is None else good & ~jnp.any(jnp.isnan(bed.base))


def largest(height: Float[Array, "..."]) -> Float[Array, ""]:
    """The largest |height| of cells with sand (m)."""
    size = jnp.abs(height)
    return jnp.max(jnp.max(jnp.where(size > 0, size, 0), axis=0))  # rows first: XLA vectorises that


def total(x: Float[Array, "H W"]) -> Float[Array, ""]:
    """The sum of a map; the rows come first because XLA vectorises that."""
    return jnp.sum(jnp.sum(x, axis=0))


def quantum(scale: Float[Array, ""]) -> Float[Array, ""]:
    """The least power of two of which heights up to `scale` hold at most 2^(p - 1), p the number of significand bits."""
    info = jnp.finfo(scale.dtype)
    scale = jnp.maximum(lax.stop_gradient(scale), float(info.tiny) * 2.0**info.nmant)
    _, exponent = jnp.frexp(scale)
    return jnp.ldexp(jnp.ones_like(scale), exponent - info.nmant)


def grain(bed: Bed, u: Float[Array, "H+2 W+2"]) -> Float[Array, ""]:
    """The quantum for a map with ghost cells (m)."""
    return quantum(jnp.maximum(largest(u), bed.elsewhere))


@jax.custom_jvp
def truncate(x: jax.Array) -> jax.Array:
    """The whole number next to x towards zero; its derivative is that of the identity.

    JAX forgets this rule when a derivative in reverse mode is differentiated again, so that loops that use it must refuse
    second derivatives, as while_loop.py does.
    """
    return jnp.trunc(x)


truncate.defjvps(lambda tangent, _, x: tangent)


@jax.custom_jvp
def nearest(x: jax.Array) -> jax.Array:
    """The nearest whole number; its derivative is that of the identity. Faster than `truncate`."""
    return lax.round(x, lax.RoundingMethod.TO_NEAREST_EVEN)


nearest.defjvps(lambda tangent, _, x: tangent)


def lose(quantum: jax.Array, lost: ExactSum, amount: jax.Array) -> ExactSum:
    """Adds an amount [H, W], in whole quanta, to the account `lost` of what drained from each cell."""
    low = lost.low + amount
    coarse = quantum * 4096
    carry = truncate(low / coarse) * coarse
    return ExactSum(low - carry, lost.high + carry)


def counted(account: ExactSum, amount: Float[Array, "m n ..."]) -> ExactSum:
    """Adds the sum of a map of whole quanta to an account, in quanta.

    The cells are summed as whole numbers in digits of 11 bits, rows first, so that no sum overflows on maps of up to 2^18
    columns. The account is exact up to 2^46 quanta in float32. The derivative is that of the sum of floats.
    """
    total = jnp.sum(jnp.sum(amount, axis=0), axis=0)
    exact = lax.stop_gradient(amount)
    whole = jnp.int64 if amount.dtype == jnp.float64 else jnp.int32
    coarse = jnp.trunc(exact / 2048)
    second, first = (jnp.sum(x.astype(whole), axis=1) for x in (coarse, exact - 2048 * coarse))
    second, first = second + (first >> 11), first & 2047
    third, second, first = (jnp.sum(x, axis=0) for x in (second >> 11, second & 2047, first))
    second, first = second + (first >> 11), first & 2047
    third, second = third + (second >> 11), second & 2047
    low = account.low + (second * 2048 + first).astype(account.low.dtype) + (total - lax.stop_gradient(total))
    carry = lax.stop_gradient(jnp.floor(low / 2**22))
    return ExactSum(low - 2**22 * carry, account.high + 2**22 * (third.astype(low.dtype) + carry))


def nothing_lost(bed: Bed, height: jax.Array) -> ExactSum | None:
    """The account of `lose` before anything drained; None if the edge is closed."""
    return None if bed.rim is None else ExactSum(jnp.zeros_like(height), jnp.zeros_like(height))


def volume_lost(bed: Bed, lost: ExactSum | None) -> Float[Array, ""]:
    """The volume that drained (m^3)."""
    if lost is None:
        return jnp.zeros_like(bed.spacing)
    return (jnp.sum(lost.high) + jnp.sum(lost.low)) * bed.spacing**2


def halo(x: Float[Array, "H W ..."], value: float = jnp.nan) -> Float[Array, "H+2 W+2 ..."]:
    """The map with one ghost cell of the given value on each side.

    It is built by concatenation, which XLA vectorises on CPUs, and behind a barrier, so that it is stored and not computed
    anew for every neighbour.
    """
    row = jnp.full((1, *x.shape[1:]), value, x.dtype)
    x = lax.concatenate([row, x, row], 0)
    column = jnp.full((x.shape[0], 1, *x.shape[2:]), value, x.dtype)
    return lax.optimization_barrier(lax.concatenate([column, x, column], 1))


def at(u: Float[Array, "H+2 W+2 ..."], di: int = 0, dj: int = 0) -> Float[Array, "H W ..."]:
    """The value di rows and dj columns further, for each inner cell of a map with ghost cells; (0, 0) drops the ghosts."""
    rows, columns = u.shape[0] - 2, u.shape[1] - 2
    return u[1 + di : 1 + di + rows, 1 + dj : 1 + dj + columns]


def stored(maps: Sequence[jax.Array]) -> list[jax.Array]:
    """The same maps, computed once and stored as one array; XLA would else compute them anew wherever they are used."""
    most = max(x.shape[1] for x in maps)

    def wide(x: jax.Array) -> jax.Array:
        more = most - x.shape[1]
        return lax.concatenate([x, jnp.zeros((x.shape[0], more, *x.shape[2:]), x.dtype)], 1) if more else x

    whole = lax.optimization_barrier(lax.concatenate([wide(x) for x in maps], 0))
    stops = accumulate(x.shape[0] for x in maps)
    return [whole[stop - x.shape[0] : stop, : x.shape[1]] for stop, x in zip(stops, maps, strict=True)]
