"""The block of the map around a tool: how it is read and written back, and how the sand in it stands."""

from dataclasses import dataclass, replace

import jax
import jax.numpy as jnp
from jax import lax

from jaxsand.interaction import _blade as blade
from jaxsand.interaction._frame import Frame, Places, cut, numbers, paste, places
from jaxsand.interaction.ground import Relief
from jaxsand.interaction.resting import Sand, where_open
from jaxsand.interaction.stencil import both_ends, inner, put, spread, window
from jaxsand.relaxation.flux import Fluxes
from jaxsand.relaxation.ghost_cells import ExactSum, at, halo, lose, nearest
from jaxsand.scene.footprint import Pose
from jaxsand.scene.grid import Neighbours

SPARE = 1  # width of a block's margin in cells: if no sand moves in it, none would have moved beyond
_CELLS = 8_192  # cells of all maps that are pushed together, whose sub-step then works in a core's cache


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Way:
    """A leg of a blade: horizontal lengths in spacings, heights in m. Values are scalars, or [B] each for a batch.

    Attributes:
        start: the blade's pose at the start.
        length: length of the leg.
        half: half of the blade's thickness.
        side: half of the blade's width.
        bottom: height of the blade's bottom at the start; a map of the inner part if cells differ.
        rise: what the bottom rises by in each spacing of the leg (m), or None if it stays at one height.
        spacing: the grid's spacing (m).
        quantum: quantum of heights.
        drop: largest stable step, a scalar or a flat map [cells].
        level: height of a draining rim, or None.
        rate: rate of the proximal steps.
        angle: angle by which the blade turns in place before the leg (rad).
        yaw: angle from the direction of travel to the blade's normal (rad), or None if it stands square to its way.
        room: sum of heights that the tool's bucket can take up from the path's start on (quanta), or None if it has none.
        base: height of the floor under the sand, a flat map [cells] (m), or None if there is none.
        plates: how far plates reach ahead of the blade's face, or None if it has none.
        relief: how the ground rises and falls that the bottom follows, or None.
    """

    start: Pose
    length: jax.Array
    half: jax.Array
    side: jax.Array
    bottom: jax.Array
    spacing: jax.Array
    quantum: jax.Array
    drop: jax.Array
    level: jax.Array | None
    rate: jax.Array
    angle: jax.Array
    rise: jax.Array | None
    room: jax.Array | None = None
    yaw: jax.Array | None = None
    base: jax.Array | None = None
    plates: jax.Array | None = None
    relief: Relief | None = None

    def at(self, by: jax.Array) -> "Way":
        """The leg as it is when the blade has moved by a length (spacings): with its bottom at the height there."""
        if self.relief is not None:
            return replace(self, bottom=self.bottom + self.relief.at(by))
        return self if self.rise is None else replace(self, bottom=self.bottom + by * self.rise)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Moving:
    """The state of a leg.

    Attributes:
        height: flat map [cells] of heights (m), NaN where there is no sand.
        lost: account of what drained, flat maps; see `ghost_cells.lose`.
        flux: fluxes of the last sub-step in the block around the blade (quanta).
        edge: largest change of height at the block's edge so far (spacings).
        scooped: account (quanta) of what a bucket took up so far, or None for other tools.
    """

    height: jax.Array
    lost: ExactSum | None
    flux: Fluxes
    edge: jax.Array
    scooped: ExactSum | None = None


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class View:
    """A block of the map, [m, m], apart from its heights.

    Attributes:
        where: where its cells lie on the map.
        holds: 1 for cells with sand, else 0; with ghost cells.
        drop: largest stable step (quanta).
        sides: number of sides over which each cell drains, or None where the edge is closed.
        beyond: 1 for cells beyond a rim, with ghost cells, or None where the edge is closed.
        base: height of the floor under the sand (whole quanta, rounded up), or None if there is none.
    """

    where: Places
    holds: jax.Array
    drop: jax.Array
    sides: jax.Array | None
    beyond: jax.Array | None
    base: jax.Array | None = None


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Openness:
    """How sand stands around a tool: the open share of links (`gates`) and of cells (`open`), and how much higher sand
    stands in partly covered cells (`stretch`); see resting.py."""

    gates: Fluxes
    open: jax.Array
    stretch: jax.Array


First = tuple[jax.Array, jax.Array]


@dataclass(frozen=True)
class Block:
    """The part of a map that is computed, of `size` x `size` cells.

    Attributes:
        shape: rows and columns of the map.
        size: cells along a side of the block.
        near: cells along a side of the inner part that holds all that the blade covers or touches.
        follows: whether the block follows the blade; else it holds the whole map.
        neighbours: 4, 8 or "isotropic".
        drains: whether the map's edge drains.
    """

    shape: tuple[int, int]
    size: int
    near: int
    follows: bool
    neighbours: Neighbours
    drains: bool

    @property
    def before(self) -> int:
        """The number of rows and columns of the block before its inner part."""
        return (self.size - self.near) // 2

    def corner(self, x: jax.Array, y: jax.Array) -> First:
        """The column and row of the first cell of the block around (x, y); it may lie off the map."""
        if not self.follows:
            zero = jnp.zeros_like(x).astype(jnp.int32)
            return zero, zero
        behind = self.before + self.near // 2
        begin = [jnp.floor(lax.stop_gradient(centre)).astype(jnp.int32) - behind for centre in (x, y)]
        return begin[0], begin[1]

    def ahead(self, frame: Frame, length: jax.Array, step: jax.Array, stride: float) -> tuple[First, First]:
        """The first cell of the block around the middle of a step of `stride` spacings, and its change since the last step.

        Both places are computed as one array. In two expressions a compiler may round differently, and then, once in a
        hundred thousand strokes, the new place of one step would not be the old place of the next.
        """
        steps = jnp.maximum(jnp.stack([step - 1, step]), 0).astype(length.dtype)
        ways = jnp.minimum((steps.reshape(2, *(1,) * length.ndim) + 0.5) * stride, length)
        pose, ways = jax.tree.map(lax.stop_gradient, (frame.pose, ways))
        x, y = lax.optimization_barrier(self.corner(pose.x + ways * pose.cos, pose.y + ways * pose.sin))
        return (x[1], y[1]), (x[1] - x[0], y[1] - y[0])

    def coordinates(self, frame: Frame, first: First) -> tuple[jax.Array, jax.Array]:
        """How far ahead of a pose, and to its left, the inner part's cells and ghost cells lie (spacings)."""
        size = self.near + 2
        like = jnp.zeros((size, size, *frame.pose.x.shape), frame.pose.x.dtype)
        pose = jax.tree.map(lambda x: spread(x, like), frame.pose)
        x = numbers(size, 1, frame.pose.x) + (first[0].astype(like.dtype) + (self.before - 0.5)) - pose.x
        y = numbers(size, 0, frame.pose.x) + (first[1].astype(like.dtype) + (self.before - 0.5)) - pose.y
        return x * pose.cos + y * pose.sin, y * pose.cos - x * pose.sin

    def part(self, x: jax.Array) -> jax.Array:
        """The inner part of a map of the block: with ghost cells if the map has them, and of fluxes those of its cells."""
        rows, columns = (self.near + n - self.size for n in x.shape[:2])
        return window(x, self.before, self.before, rows, columns)

    def put(self, whole: jax.Array, part: jax.Array) -> jax.Array:
        """A map of the block with its inner part replaced."""
        return put(whole, part, self.before)

    @property
    def together(self) -> int:
        """The number of maps of a batch that are pushed at a time."""
        return max(16, _CELLS // self.size**2 // 16 * 16) if jax.default_backend() == "cpu" else 1 << 30

    def view(self, way: Way, frame: Frame, first: First, flat: jax.Array) -> tuple[View, jax.Array]:
        """The block whose first cell is `first`, and its heights (quanta, 0 where there is no sand)."""
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
        base = None
        if way.base is not None:
            base = cut(where, way.base, 0.0) / way.quantum
            base = base + lax.stop_gradient(jnp.ceil(base) + 1 - base)
        holds = halo(jnp.where(solid, 0.0, 1.0).astype(h.dtype), 0.0)
        view = View(where, holds, drop / way.quantum, sides, beyond, base)
        return view, jnp.where(solid, 0, h)

    def back(self, way: Way, view: View, flat: jax.Array, h: jax.Array) -> jax.Array:
        """The flat map (m) with the block's heights (quanta) written back."""
        return paste(view.where, flat, jnp.where(at(view.holds) > 0, h * way.quantum, jnp.nan))

    def above(self, view: View, bottom: jax.Array) -> jax.Array:
        """The bottom of a tool over each cell of the inner part (quanta), which cuts no floor: `bottom`, or the floor."""
        return bottom if view.base is None else jnp.maximum(bottom, self.part(view.base))

    def lose(self, way: Way, view: View, lost: ExactSum | None, amount: jax.Array | None) -> ExactSum | None:
        """The account of losses after the block lost an amount (quanta)."""
        if lost is None or amount is None:
            return lost
        block = ExactSum(cut(view.where, lost.low, 0.0), cut(view.where, lost.high, 0.0))
        block = lose(way.quantum, block, amount * way.quantum)
        return ExactSum(paste(view.where, lost.low, block.low), paste(view.where, lost.high, block.high))

    def touched(self, way: Way, frame: Frame, first: First, old: jax.Array, new: jax.Array, cover: jax.Array) -> jax.Array:
        """The largest change of height (spacings) in the block's outermost cells, along edges that are not the map's.

        It is infinite if the blade's footprint `cover`, a map of the inner part, covers one of them.
        """
        if not self.follows:
            return jnp.zeros_like(way.length)
        near: jax.Array | bool = False
        for axis, begin, cells in zip((1, 0), first, frame.extent(), strict=True):
            i = numbers(self.size, axis, begin)
            near = near | ((i < SPARE) & (begin > 0)) | ((i >= self.size - SPARE) & (begin + self.size < cells))
        covered = self.put(jnp.zeros_like(old), cover) > 0
        change = jnp.where(covered, jnp.inf, jnp.abs(new - old) * (way.quantum / way.spacing))
        return lax.stop_gradient(jnp.max(jnp.where(near, change, 0), axis=(0, 1)))

    def clear(self, view: View) -> Openness:
        """How sand stands in the block where no blade is."""
        gates = tuple(here * there for here, there in both_ends(self.neighbours, view.holds))
        return Openness(gates, at(view.holds), jnp.zeros_like(at(view.holds)))

    def beside(self, view: View, reach: blade.Reach) -> Openness:
        """How sand stands in the inner part, around a blade."""
        free, gates = blade.gates(self.neighbours, reach, self.part(view.holds))
        free = inner(free)
        return Openness(gates, free, (1 - free) / jnp.maximum(free, blade.SLIVER) * at(self.part(view.holds)))

    def sand(self, way: Way, view: View, clear: Openness, near: Openness) -> Sand:
        """The sand of the block: `clear` gives how it stands without a blade, and `near` how in the inner part."""
        stand = jax.tree.map(self.put, clear, near)
        rim = None if way.level is None else way.level / way.quantum
        bottom = way.bottom / way.quantum
        if bottom.ndim == near.open.ndim:
            bottom = self.put(jnp.zeros_like(stand.open), bottom)
        return Sand(stand.gates, stand.open, stand.stretch, bottom, view.drop, view.sides, rim, self.neighbours, view.base)

    def guess(self, gates: Fluxes, part: jax.Array, flux: Fluxes) -> Fluxes:
        """The fluxes from which a sub-step starts: the share `part` of the last ones, less over links that are closing.

        `gates` are the open shares of links in the inner part. The loss over a rim starts at 0, since it cannot come back.
        """
        links = tuple(nearest(f * part) for f in flux[: len(flux) - int(self.drains)])
        there = where_open(self.neighbours, gates, tuple(self.part(f) for f in links))
        over = (jnp.zeros_like(f) for f in flux[len(links) :])
        return (*(self.put(f, g) for f, g in zip(links, there, strict=True)), *over)

    def over(self, way: Way, view: View, h: jax.Array) -> tuple[jax.Array, jax.Array] | None:
        """The inner part's cells beyond a rim, and the share of sand above the tool's bottom that is above the rim too."""
        if view.beyond is None or way.level is None:
            return None
        bottom, level = way.bottom / way.quantum, way.level / way.quantum
        height = jnp.maximum(h - bottom, 0)
        return self.part(view.beyond), jnp.clip((h - level) / jnp.where(height > 0, height, 1), 0, 1)

    def displaced(
        self, way: Way, view: View, shares: blade.Shares, h: jax.Array, taken: jax.Array
    ) -> tuple[jax.Array, jax.Array | None]:
        """The heights after the sand `taken` from the inner part moved one cell on, and what each cell lost over a rim."""
        there, holds = self.part(h), self.part(view.holds)
        taken = taken * at(holds)
        over = self.over(way, view, there)
        kept, got, lost = blade.handed_on(shares, holds, taken, None if over is None else (over[0], over[1] * taken))
        lost = None if lost is None else self.put(jnp.zeros_like(h), lost)
        return self.put(h, there - taken + kept + got), lost

    def contact(self, way: Way, view: View, cover: jax.Array, h: jax.Array) -> jax.Array:
        """How much the blade is in contact with sand: 1 in it, falling to 0 a spacing above it or where it covers no cell.

        Rates are multiplied by it, so that a tool that touches nothing moves no sand that is still only to a tolerance.
        """
        spacing, bottom = way.spacing / way.quantum, way.bottom / way.quantum
        near = jnp.clip(1 + jnp.maximum(self.part(h) - bottom, -spacing) / spacing, 0, 1) * at(self.part(view.holds))
        return jnp.minimum(1, 2 * jnp.max(jnp.max(near * cover, axis=0), axis=0))


def normal_of(way: Way, pose: Pose) -> Pose:
    """The pose, on the map, with the heading of the blade's normal."""
    return pose if way.yaw is None else rotated(pose, way.yaw)


def rotated(pose: Pose, angle: jax.Array) -> Pose:
    """The pose turned in place by an angle (rad), counter-clockwise."""
    cos, sin = jnp.cos(angle), jnp.sin(angle)
    return Pose(pose.x, pose.y, pose.cos * cos - pose.sin * sin, pose.sin * cos + pose.cos * sin)


def pose_ahead(frame: Frame, by: jax.Array) -> Pose:
    """The frame's pose moved ahead by a length (spacings)."""
    pose = frame.pose
    return Pose(pose.x + by * pose.cos, pose.y + by * pose.sin, pose.cos, pose.sin)
