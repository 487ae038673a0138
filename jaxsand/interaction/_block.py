"""A leg of a blade in a block of the map around it: what goes with it, and how the block is fetched and set back."""

from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax

from jaxsand.interaction import _blade as blade
from jaxsand.interaction._frame import Frame, Places, cut, numbers, paste, places
from jaxsand.interaction.resting import Sand, where_open
from jaxsand.interaction.stencil import both_ends, inner, put, spread, window
from jaxsand.relaxation.flux import Fluxes
from jaxsand.relaxation.ghost_cells import Lost, at, halo, lose, nearest
from jaxsand.scene.grid import Neighbours
from jaxsand.scene.tools import Pose

SPARE = 1  # cells: the margin of a block in which sand must not move, for then none beyond would have
_CELLS = 8_192  # of all maps that are pushed together: what a sub-step needs of them stays in a core's cache


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


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Stand:
    """How open links and cells are, and how much higher sand stands in them for it."""

    gates: Fluxes
    open: jax.Array
    stretch: jax.Array


First = tuple[jax.Array, jax.Array]


@dataclass(frozen=True)
class Block:
    """Which part of a map [H, W] is computed: a block of `size` squared that follows the blade, or one that holds it all.

    All that the blade covers or touches lies in a part of the block, `near` squared, around where the blade is.
    """

    shape: tuple[int, int]
    size: int
    near: int
    follows: bool
    neighbours: Neighbours
    drains: bool

    @property
    def before(self) -> int:
        """How many rows and columns of the block lie before the part that is near."""
        return (self.size - self.near) // 2

    def corner(self, x: jax.Array, y: jax.Array) -> First:
        """The first cell of the block around (x, y), across and up; the block may hang over the map."""
        if not self.follows:
            zero = jnp.zeros_like(x).astype(jnp.int32)
            return zero, zero
        behind = self.before + self.near // 2
        begin = [jnp.floor(lax.stop_gradient(centre)).astype(jnp.int32) - behind for centre in (x, y)]
        return begin[0], begin[1]

    def ahead(self, frame: Frame, length: jax.Array, step: jax.Array, stride: float) -> tuple[First, First]:
        """Where the block begins around the middle of a step of `stride` spacings along a leg, and by how much that has
        moved since the step before.

        The two places are computed as one array. As two expressions a compiler may join products and sums in one and not in
        the other, and what is the new place now is the old one a step later: where a middle is on the border of two cells,
        once in a hundred thousand strokes, the block would have been elsewhere than remembered.
        """
        steps = jnp.maximum(jnp.stack([step - 1, step]), 0).astype(length.dtype)
        ways = jnp.minimum((steps.reshape(2, *(1,) * length.ndim) + 0.5) * stride, length)
        pose, ways = jax.tree.map(lax.stop_gradient, (frame.pose, ways))
        x, y = lax.optimization_barrier(self.corner(pose.x + ways * pose.cos, pose.y + ways * pose.sin))
        return (x[1], y[1]), (x[1] - x[0], y[1] - y[0])

    def coordinates(self, frame: Frame, first: First) -> tuple[jax.Array, jax.Array]:
        """How far ahead of a pose, and to its left, the cells that are near it, and a halo, lie (spacings)."""
        size = self.near + 2
        like = jnp.zeros((size, size, *frame.pose.x.shape), frame.pose.x.dtype)
        pose = jax.tree.map(lambda x: spread(x, like), frame.pose)
        x = numbers(size, 1, frame.pose.x) + (first[0].astype(like.dtype) + (self.before - 0.5)) - pose.x
        y = numbers(size, 0, frame.pose.x) + (first[1].astype(like.dtype) + (self.before - 0.5)) - pose.y
        return x * pose.cos + y * pose.sin, y * pose.cos - x * pose.sin

    def part(self, x: jax.Array) -> jax.Array:
        """The part of a map that is near the blade; of one with halo, with a halo; of links, the links of its cells."""
        rows, columns = (self.near + n - self.size for n in x.shape[:2])
        return window(x, self.before, self.before, rows, columns)

    def put(self, whole: jax.Array, part: jax.Array) -> jax.Array:
        """A map with the part replaced that is near the blade."""
        return put(whole, part, self.before)

    @property
    def together(self) -> int:
        """How many maps to push at a time."""
        return max(16, _CELLS // self.size**2 // 16 * 16) if jax.default_backend() == "cpu" else 1 << 30

    def view(self, way: Way, frame: Frame, first: First, flat: jax.Array) -> tuple[View, jax.Array]:
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

    def touched(self, way: Way, frame: Frame, first: First, old: jax.Array, new: jax.Array, cover: jax.Array) -> jax.Array:
        """How far sand moved (spacings) in the outermost cells of a block where its edge is not the map's; infinite where
        the blade covers a part of it, `cover` of what is near."""
        if not self.follows:
            return jnp.zeros_like(way.length)
        near: Any = False
        for axis, begin, cells in zip((1, 0), first, frame.extent(), strict=True):
            i = numbers(self.size, axis, begin)
            near = near | ((i < SPARE) & (begin > 0)) | ((i >= self.size - SPARE) & (begin + self.size < cells))
        covered = self.put(jnp.zeros_like(old), cover) > 0
        change = jnp.where(covered, jnp.inf, jnp.abs(new - old) * (way.quantum / way.spacing))
        return lax.stop_gradient(jnp.max(jnp.where(near, change, 0), axis=(0, 1)))

    def clear(self, view: View) -> Stand:
        """How sand stands in the block where no blade is."""
        gates = tuple(here * there for here, there in both_ends(self.neighbours, view.holds))
        return Stand(gates, at(view.holds), jnp.zeros_like(at(view.holds)))

    def around(self, view: View, reach: blade.Reach) -> Stand:
        """How sand stands near a blade."""
        free, gates = blade.gates(self.neighbours, reach, self.part(view.holds))
        free = inner(free)
        return Stand(gates, free, (1 - free) / jnp.maximum(free, blade.SLIVER) * at(self.part(view.holds)))

    def sand(self, way: Way, view: View, clear: Stand, near: Stand) -> Sand:
        """The sand of the block around a blade, `near` which it stands as told."""
        stand = jax.tree.map(self.put, clear, near)
        rim = None if way.level is None else way.level / way.quantum
        bottom = way.bottom / way.quantum
        return Sand(stand.gates, stand.open, stand.stretch, bottom, view.drop, view.sides, rim, self.neighbours)

    def guess(self, gates: Fluxes, part: jax.Array, flux: Fluxes) -> Fluxes:
        """A part of the last fluxes, as far as links are open, `gates` of those near the tool; none of what ran off over a
        rim, which would not come back."""
        links = tuple(nearest(f * part) for f in flux[: len(flux) - int(self.drains)])
        there = where_open(self.neighbours, gates, tuple(self.part(f) for f in links))
        over = (jnp.zeros_like(f) for f in flux[len(links) :])
        return (*(self.put(f, g) for f, g in zip(links, there, strict=True)), *over)

    def over(self, way: Way, view: View, h: jax.Array) -> tuple[jax.Array, jax.Array] | None:
        """What lies beyond a rim near the blade, and which part of the sand above its bottom stands above the rim."""
        if view.beyond is None or way.level is None:
            return None
        bottom, level = way.bottom / way.quantum, way.level / way.quantum
        height = jnp.maximum(h - bottom, 0)
        return self.part(view.beyond), jnp.clip((h - level) / jnp.where(height > 0, height, 1), 0, 1)

    def displaced(
        self, way: Way, view: View, shares: blade.Shares, h: jax.Array, taken: jax.Array
    ) -> tuple[jax.Array, jax.Array | None]:
        """The heights after what was taken up near the blade was handed on by one cell, and what was lost."""
        there, holds = self.part(h), self.part(view.holds)
        taken = taken * at(holds)
        over = self.over(way, view, there)
        kept, got, lost = blade.handed_on(shares, holds, taken, None if over is None else (over[0], over[1] * taken))
        lost = None if lost is None else self.put(jnp.zeros_like(h), lost)
        return self.put(h, there - taken + kept + got), lost

    def contact(self, way: Way, view: View, cover: jax.Array, h: jax.Array) -> jax.Array:
        """1 while the blade is among the sand, falling to 0 where it covers no cell or hangs a spacing above all it covers.

        Keeps a tool that touches nothing from moving sand that is still only to a tolerance.
        """
        spacing, bottom = way.spacing / way.quantum, way.bottom / way.quantum
        near = jnp.clip(1 + jnp.maximum(self.part(h) - bottom, -spacing) / spacing, 0, 1) * at(self.part(view.holds))
        return jnp.minimum(1, 2 * jnp.max(jnp.max(near * cover, axis=0), axis=0))


def pose_ahead(frame: Frame, by: jax.Array) -> Pose:
    pose = frame.pose
    return Pose(pose.x + by * pose.cos, pose.y + by * pose.sin, pose.cos, pose.sin)
