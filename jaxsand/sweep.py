"""One sweep of settling: sand flows over every link that is steeper than repose.

With heights h, spacing dx, mu = tan(angle of repose) and a link of length d = l dx, the flow into cell i from cell j is

    q_ij = rate / l * excess(h_j - h_i, mu d),       excess(s, m) = s - clip(s, -m, m),

which is Eq. 1-2 of arXiv:1908.02745 with flow rate k = rate dx^2. It is computed from the two heights alone, so that cell j
loses the very number that cell i gains, and it is cut to a whole number of quanta. A quantum is a power of two so chosen
that sums of quanta are exact in the floats at hand: volume is conserved to the last bit where the heights are whole quanta
themselves, and no rounding builds up where they are not. The derivative ignores the cut.

A cell without sand (solid, beyond the edge, not finite) holds NaN while sweeping: every comparison with it is false, so
nothing flows. Maps are kept in a halo of one such cell on each side.
"""

from dataclasses import dataclass, field

import jax
import jax.numpy as jnp
from jax import lax

from jaxsand.grid import Neighbours, links
from jaxsand.scene import Scene
from jaxsand.walls import Draining, Walls

Lost = tuple[jax.Array, jax.Array] | None
NARROW = 0.05  # in an open share below this sand stands no higher than it would in this one


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Bed:
    """What a sweep needs of a scene; its maps can be cut to a window."""

    spacing: jax.Array  # m, []
    drop: jax.Array  # the largest stable step between straight neighbours, mu dx: [] or [H, W]
    rim: "Rim | None"
    neighbours: Neighbours = field(metadata={"static": True})


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Rim:
    """A draining edge: `beyond` [H + 2, W + 2] is 1 in the map's halo and 0 inside; the rim stands at `level` (m)."""

    beyond: jax.Array
    level: jax.Array


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Flow:
    """How far a sweep goes: the share of the excess that crosses a straight link, and the quantum it is cut to (m)."""

    rate: jax.Array
    quantum: jax.Array


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Around:
    """A tool standing in the sand; see `stand`.

    A cell of mean height h above the tool's bottom b holds that sand in its open share, where it stands at
    h + stretch (h - b), stretch = cover / open (in a sliver less, so that the flow out of it ends as it closes). A link is
    as open as the less open of its two cells, which keeps a sweep stable for any cover.
    """

    open: jax.Array  # [H + 2, W + 2]
    stretch: jax.Array  # [H, W]
    bottom: jax.Array  # m, []

    def surface(self, height: jax.Array) -> jax.Array:
        return height + self.stretch * jnp.where(height > self.bottom, height - self.bottom, 0)


def stand(cover: jax.Array, bottom: jax.Array) -> Around:
    """A tool with its bottom at height `bottom` (m) that covers the share `cover` [H, W] of each cell."""
    free = 1 - cover
    return Around(halo(free, 0.0), cover / jnp.maximum(free, NARROW), bottom)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Nothing:
    """No tool stands in the sand (neutral)."""


def prepare(scene: Scene) -> Bed:
    """The scene's bed; the scene's floats have the height's dtype already."""
    dx = jnp.asarray(scene.grid.spacing)
    drop = jnp.tan(jnp.asarray(scene.material.repose_angle)) * dx
    rim = None
    if isinstance(scene.edge, Draining):
        rim = Rim(halo(jnp.zeros(scene.grid.shape, dx.dtype), 1.0), jnp.asarray(scene.edge.level))
    return Bed(dx, drop, rim, scene.grid.neighbours)


def mark(scene: Scene, height: jax.Array) -> tuple[jax.Array, jax.Array]:
    """The height with NaN in the cells that hold no sand, and whether a cell that should hold some is not finite."""
    finite = jnp.isfinite(height)
    if isinstance(scene.walls, Walls):
        sand = finite & ~scene.walls.solid
        return jnp.where(sand, height, jnp.nan), jnp.any(~finite & ~scene.walls.solid)
    return jnp.where(finite, height, jnp.nan), ~jnp.all(finite)


def spoiled(before: jax.Array, after: jax.Array) -> jax.Array:
    """Whether a marked map lost a cell on the way, or overflowed."""
    return jnp.any((jnp.isnan(after) != jnp.isnan(before)) | jnp.isinf(after))


def sound(bed: Bed) -> jax.Array:
    """Whether spacing and angles are usable numbers; what is traced escapes `make_scene`."""
    return jnp.all(jnp.isfinite(bed.drop) & (bed.drop >= 0)) & (bed.spacing > 0)


def unmark(height: jax.Array, original: jax.Array) -> jax.Array:
    """The height with the original values in the cells that hold no sand."""
    return jnp.where(jnp.isnan(height), original, height)


def quantum(scale: jax.Array) -> jax.Array:
    """The power of two of which heights up to `scale` hold at most 2^(p - 1), p the significand's bits."""
    info = jnp.finfo(scale.dtype)
    scale = jnp.maximum(lax.stop_gradient(scale), float(info.tiny) * 2.0**info.nmant)
    _, exponent = jnp.frexp(scale)
    return jnp.ldexp(jnp.ones_like(scale), exponent - info.nmant)


def largest(height: jax.Array) -> jax.Array:
    """The largest |height| where there is sand."""
    return jnp.max(jnp.where(jnp.isnan(height), 0, jnp.abs(height)))


def halo(x: jax.Array, value: float = jnp.nan) -> jax.Array:
    """The map with one more cell on each side, stored.

    By concatenation, which XLA vectorises on CPUs, and behind a barrier, lest it be computed anew for every neighbour.
    """
    row = jnp.full((1, x.shape[1]), value, x.dtype)
    x = lax.concatenate([row, x, row], 0)
    column = jnp.full((x.shape[0], 1), value, x.dtype)
    return lax.optimization_barrier(lax.concatenate([column, x, column], 1))


def at(u: jax.Array, di: int = 0, dj: int = 0) -> jax.Array:
    """What each inner cell of a map with halo sees (di, dj) cells further."""
    rows, columns = u.shape[0] - 2, u.shape[1] - 2
    return u[1 + di : 1 + di + rows, 1 + dj : 1 + dj + columns]


def sweep(bed: Bed, flow: Flow, around: Around | Nothing, u: jax.Array, lost: Lost) -> tuple[jax.Array, Lost]:
    """One sweep of a map with halo [H + 2, W + 2].

    `lost` gathers the height that left each cell over a draining rim (see `lose`); None where nothing drains.
    """
    s, gate = u, None
    if isinstance(around, Around):
        s, gate = halo(around.surface(at(u))), around.open
    net = jnp.zeros_like(at(u))
    for di, dj, length in links(bed.neighbours):
        for sign in (1, -1):
            d = at(s, sign * di, sign * dj) - at(s)
            m = _yield(bed, sign * di, sign * dj, length)
            e = jnp.where(d > m, d - m, 0) + jnp.where(d < -m, d + m, 0)
            e = e * (flow.rate / length / flow.quantum)
            if gate is not None:
                e = e * jnp.minimum(at(gate), at(gate, sign * di, sign * dj))
            net = net + truncate(e)
    if bed.rim is not None and lost is not None:
        e = _over(bed, bed.rim, at(s)) * _draining_sides(bed.rim) * (flow.rate / flow.quantum)
        if gate is not None:
            e = e * at(gate)
        out = truncate(e)
        net, lost = net - out, lose(flow, lost, out * flow.quantum)
    return halo(at(u) + net * flow.quantum), lost


def lose(flow: Flow, lost: tuple[jax.Array, jax.Array], amount: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Adds whole quanta [H, W] to what was lost: (low, high), whose sum is exact far beyond the reach of one float."""
    low, high = lost
    low = low + amount
    coarse = flow.quantum * 4096
    carry = truncate(low / coarse) * coarse
    return low - carry, high + carry


def nothing_lost(scene: Scene, height: jax.Array) -> Lost:
    """The start of the account of `lose`, if the scene drains."""
    return (jnp.zeros_like(height), jnp.zeros_like(height)) if isinstance(scene.edge, Draining) else None


def volume_lost(bed: Bed, lost: Lost) -> jax.Array:
    """The volume that drained (m^3)."""
    if lost is None:
        return jnp.zeros_like(bed.spacing)
    return (jnp.sum(lost[1]) + jnp.sum(lost[0])) * bed.spacing**2


def worst_excess(bed: Bed, u: jax.Array) -> jax.Array:
    """The largest slope in excess of repose (a tangent) of a map with halo; 0 when it is still."""
    worst = jnp.zeros_like(at(u))
    for di, dj, length in links(bed.neighbours):
        e = (jnp.abs(at(u, di, dj) - at(u)) - _yield(bed, di, dj, length)) / length
        worst = jnp.where(e > worst, e, worst)  # not jnp.maximum: NaN means no link
    if bed.rim is not None:
        worst = jnp.maximum(worst, 2 * _over(bed, bed.rim, at(u)) * (_draining_sides(bed.rim) > 0))
    return jnp.max(jnp.max(worst, axis=0)) / bed.spacing


def steepest(bed: Bed, u: jax.Array) -> jax.Array:
    """The steepest slope between neighbours (a tangent) of a map with halo."""
    slope = jnp.zeros_like(at(u))
    for di, dj, length in links(bed.neighbours):
        s = jnp.abs(at(u, di, dj) - at(u)) / length
        slope = jnp.where(s > slope, s, slope)
    return jnp.max(slope) / bed.spacing


def _yield(bed: Bed, di: int, dj: int, length: float) -> jax.Array:
    """The largest stable step along every inner cell's link towards (di, dj)."""
    if not bed.drop.ndim:
        return bed.drop * length
    drop = halo(bed.drop, 0.0)
    return (at(drop) + at(drop, di, dj)) * (length / 2)


def _draining_sides(rim: Rim) -> jax.Array:
    """How many sides of each cell drain, 0 to 4."""
    beyond = rim.beyond
    return at(beyond, 1, 0) + at(beyond, -1, 0) + at(beyond, 0, 1) + at(beyond, 0, -1)


def _over(bed: Bed, rim: Rim, h: jax.Array) -> jax.Array:
    """Height in excess of repose against the rim, half a spacing away."""
    top = rim.level + bed.drop / 2
    return jnp.where(h > top, h - top, 0)


@jax.custom_jvp
def truncate(x: jax.Array) -> jax.Array:
    """Towards zero to a whole number; its derivative is taken to be that of the identity.

    Reverse mode forgets such a rule after the first derivative: loops that use it must refuse a second one (loop.py does).
    """
    return jnp.trunc(x)


truncate.defjvps(lambda tangent, _, x: tangent)
