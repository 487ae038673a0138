"""A leg of a blade in a block of the map around it: what goes with it, and how the block is fetched and set back."""

from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax

from jaxsand import blade
from jaxsand.bed import Lost, at, halo, lose
from jaxsand.flux import NARROW, Fluxes
from jaxsand.frame import Frame, Places, cut, numbers, paste, places
from jaxsand.grid import Neighbours
from jaxsand.resting import Sand
from jaxsand.stencil import inner, spread
from jaxsand.tool import Pose

_CELLS = 16_384  # of all maps that are pushed together: what a sub-step needs of them stays in a core's cache


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Way:
    """A leg of a blade on a map, lengths along the ground in spacings, heights in m; numbers, or [B] each for a batch."""

    start: Pose
    length: jax.Array
    half: jax.Array  # of the thickness
    side: jax.Array  # half of the width
    bottom: jax.Array
    spacing: jax.Array
    quantum: jax.Array
    drop: jax.Array  # [], or a flat map [cells]
    level: jax.Array | None  # of a rim
    rate: jax.Array
    angle: jax.Array  # by which the blade turned to get here


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Moving:
    """Sand on its way: flat maps [cells] of heights (m) and of what was lost, the last fluxes in the block around the blade
    (quanta), and how far sand moved at the block's edge (spacings)."""

    height: jax.Array
    lost: Lost
    flux: Fluxes
    edge: jax.Array


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class View:
    """A block of the map, [m, m]: where its cells lie; which hold sand (1 or 0, in a halo); the largest stable step
    (quanta); over how many sides a cell drains; and, in a halo, what lies beyond a rim. The last two are None where nothing
    drains."""

    where: Places
    holds: jax.Array
    drop: jax.Array
    sides: jax.Array | None
    beyond: jax.Array | None


@dataclass(frozen=True)
class Block:
    """Which part of a map [H, W] is computed: a block of `size` squared that follows the blade, or one that holds it all."""

    shape: tuple[int, int]
    size: int
    follows: bool
    neighbours: Neighbours
    drains: bool

    @property
    def together(self) -> int:
        """How many maps to push at a time."""
        return max(16, _CELLS // self.size**2 // 16 * 16) if jax.default_backend() == "cpu" else 1 << 30

    def view(self, way: Way, frame: Frame, first: tuple[jax.Array, jax.Array], flat: jax.Array) -> tuple[View, jax.Array]:
        """The block that begins at `first`, and its heights (quanta)."""
        where = places(frame, self.size, first)
        h = cut(where, flat) / way.quantum
        solid = jnp.isnan(h)
        drop = cut(where, way.drop, 0.0) if way.drop.ndim == flat.ndim else way.drop
        sides = beyond = None
        if self.drains:
            rows, columns = self.shape
            edges = [where.row == 0, where.row == rows - 1, where.column == 0, where.column == columns - 1]
            sides = jnp.stack([jnp.where(e & where.inside, 1.0, 0.0) for e in edges]).sum(0).astype(h.dtype)
            beyond = halo(jnp.where(where.inside, 0.0, 1.0).astype(h.dtype), 1.0)
        view = View(where, halo(jnp.where(solid, 0.0, 1.0).astype(h.dtype), 0.0), drop / way.quantum, sides, beyond)
        return view, jnp.where(solid, 0, h)

    def back(self, way: Way, view: View, flat: jax.Array, h: jax.Array) -> jax.Array:
        """The flat map with the block's heights (quanta) put back."""
        return paste(view.where, flat, jnp.where(at(view.holds) > 0, h * way.quantum, jnp.nan))

    def lose(self, way: Way, view: View, lost: Lost, amount: jax.Array | None) -> Lost:
        """Adds what a block lost (quanta) to the account."""
        if lost is None or amount is None:
            return lost
        block = (cut(view.where, lost[0], 0.0), cut(view.where, lost[1], 0.0))
        low, high = lose(way.quantum, block, amount * way.quantum)
        return paste(view.where, lost[0], low), paste(view.where, lost[1], high)

    def touched(
        self, way: Way, frame: Frame, first: tuple[jax.Array, jax.Array], old: jax.Array, new: jax.Array, cover: jax.Array
    ) -> jax.Array:
        """How far sand moved (spacings) within two cells of the block's edge where that is not the map's; infinite where the
        blade covers a part of it."""
        if not self.follows:
            return jnp.zeros_like(way.length)
        near: Any = False
        for axis, begin, cells in zip((1, 0), first, frame.extent(), strict=True):
            i = numbers(self.size, axis, begin)
            near = near | ((i < 2) & (begin > 0)) | ((i >= self.size - 2) & (begin + self.size < cells))
        change = jnp.where(cover > 0, jnp.inf, jnp.abs(new - old) * (way.quantum / way.spacing))
        return lax.stop_gradient(jnp.max(jnp.where(near, change, 0), axis=(0, 1)))

    def sand(self, way: Way, view: View, reach: blade.Reach) -> Sand:
        rim = None if way.level is None else way.level / way.quantum
        bottom = way.bottom / way.quantum
        free, gates = blade.gates(self.neighbours, reach, view.holds)
        free = inner(free)
        stretch = lax.optimization_barrier((1 - free) / jnp.maximum(free, NARROW))
        return Sand(gates, free, stretch, bottom, view.drop, view.sides, rim, self.neighbours)

    def over(self, way: Way, view: View, h: jax.Array) -> tuple[jax.Array, jax.Array] | None:
        """What lies beyond a rim, and which part of the sand above the blade's bottom stands above the rim."""
        if view.beyond is None or way.level is None:
            return None
        bottom, level = way.bottom / way.quantum, way.level / way.quantum
        height = jnp.maximum(h - bottom, 0)
        return view.beyond, jnp.clip((h - level) / jnp.where(height > 0, height, 1), 0, 1)

    def displaced(
        self, way: Way, view: View, shares: blade.Shares, h: jax.Array, taken: jax.Array
    ) -> tuple[jax.Array, jax.Array | None]:
        """The heights after what was taken up was handed on by one cell, and what was lost."""
        taken = taken * at(view.holds)
        over = self.over(way, view, h)
        kept, got, lost = blade.handed_on(shares, view.holds, taken, None if over is None else (over[0], over[1] * taken))
        return lax.optimization_barrier(h - taken + kept + got), lost


def contact(way: Way, view: View, cover: jax.Array, h: jax.Array) -> jax.Array:
    """1 while the blade is among the sand, falling to 0 where it covers no cell or hangs a spacing above all it covers.

    Keeps a tool that touches nothing from moving sand that is still only to a tolerance.
    """
    spacing, bottom = way.spacing / way.quantum, way.bottom / way.quantum
    near = jnp.clip(1 + jnp.maximum(h - bottom, -spacing) / spacing, 0, 1) * at(view.holds)
    return jnp.minimum(1, 2 * jnp.max(jnp.max(near * cover, axis=0), axis=0))


def coordinates(size: int, frame: Frame, first: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
    """How far ahead of a pose, and to its left, the cells of a block and its halo lie (spacings)."""
    like = jnp.zeros((size + 2, size + 2, *frame.pose.x.shape), frame.pose.x.dtype)
    pose = jax.tree.map(lambda x: spread(x, like), frame.pose)
    x = numbers(size + 2, 1, frame.pose.x) + (first[0].astype(like.dtype) - 0.5) - pose.x
    y = numbers(size + 2, 0, frame.pose.x) + (first[1].astype(like.dtype) - 0.5) - pose.y
    return x * pose.cos + y * pose.sin, y * pose.cos - x * pose.sin


def pose_ahead(frame: Frame, by: jax.Array) -> Pose:
    pose = frame.pose
    return Pose(pose.x + by * pose.cos, pose.y + by * pose.sin, pose.cos, pose.sin)
