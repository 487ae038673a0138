"""What a blade does to the sand: it is lowered, turned and moved, and the sand around it is kept at rest.

The quasi-static limit is that of a tool so slow that the sand is always at rest. The blade advances by sub-steps of a fixed
part of a spacing; after each, what it newly covers has left along its face's normal (blade.py) and the sand is brought to
rest around it (resting.py). When it is lowered, what it covers leaves radially: away from its centre in the blade's own
proportions, along the gradient of (s / thickness)^2 + (n / width)^2 with s along and n across the blade. At a corner it
turns in place, by the smaller angle, in sub-steps of an angle; what it sweeps leaves along its faces. A reversal is half a
turn, to the left.

Source: arXiv:1908.02745, "Tool Interaction"; shares of a cell in place of whole ones make the result continuous in the
stroke.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax

from jaxsand import blade
from jaxsand.bed import Lost, at, halo, lose, truncate
from jaxsand.displace import Job
from jaxsand.flux import NARROW, Fluxes
from jaxsand.frame import Frame, Places, corner, cut, frame_of, numbers, paste, places, shifted, shifted_back
from jaxsand.grid import Neighbours
from jaxsand.legs import Pushed, State, along_legs, over_the_map
from jaxsand.loop import Plain, repeat, repeat_until, split
from jaxsand.resting import Sand, bring_to_rest, bring_to_rest_and_back, moved_on, no_flux
from jaxsand.scene import Scene
from jaxsand.stencil import inner, spread
from jaxsand.tool import Pose
from jaxsand.window import Window

Rest = Callable[[Sand, jax.Array, int, jax.Array, Fluxes], tuple[jax.Array, Fluxes]]
_CELLS = 16_384  # of all maps that are pushed together: what a sub-step needs of them stays in a core's cache


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class SteppedPush:
    """The blade advances by `substep` spacings at a time; after each the sand around it gets `sweeps` sweeps.

    The last, shorter sub-step of a leg counts in proportion to its length, so that the result is continuous in the stroke.
    As `substep` goes to 0 (and 1 / sweeps with it) the map converges to the quasi-static limit; `jaxsand bench push` tells
    how closely, and at what cost. `rate` is the share of an excess that a sweep moves over a straight link.
    """

    substep: float = field(default=0.125, metadata={"static": True})
    sweeps: int = field(default=4, metadata={"static": True})
    rate: jax.Array | float = 0.18

    @classmethod
    def fine(cls) -> "SteppedPush":
        """Closer to the limit, at about three times the cost."""
        return cls(1 / 16, 8)


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


def push_along(
    scene: Scene,
    height: jax.Array,
    path: jax.Array,
    push: SteppedPush,
    record: Callable[[jax.Array], Any] | None = None,
    rest: Rest = bring_to_rest,
) -> tuple[Pushed, Any]:
    """Lowers the tool at path[0], moves it along the legs of `path` [n, 2] (m) and lifts it; see `along_legs`.

    `rest` brings the sand to rest after each sub-step (`bring_to_rest` of resting.py).
    """

    def leg(job: Job, pose: Pose, length: jax.Array, before: Pose | None, state: State) -> State:
        return _leg(scene, push, rest, job, pose, length, before, state)

    return along_legs(scene, height, path, push.rate, leg, record)


def _leg(
    scene: Scene,
    push: SteppedPush,
    rest: Rest,
    job: Job,
    pose: Pose,
    length: jax.Array,
    before: Pose | None,
    state: State,
) -> State:
    """Lowers the blade, or turns it from the pose before, and moves it ahead by `length`, as far as that touches the map."""
    shape, dx, drains = scene.grid.shape, job.bed.spacing, job.bed.rim is not None
    size = max(scene.window.size) if isinstance(scene.window, Window) else max(shape)
    block = Block(shape, size, isinstance(scene.window, Window), scene.grid.neighbours, drains)
    h, lost, moved = state
    none = no_flux(block.neighbours, drains, jnp.zeros((size, size), h.dtype))
    flat, gone = jax.tree.map(lambda x: x.reshape(-1), (h, lost))
    sand = Moving(flat, gone, none, moved)

    def way(pose: Pose, length: jax.Array, angle: jax.Array) -> Way:
        drop = job.bed.drop
        return Way(
            Pose(pose.x / dx, pose.y / dx, pose.cos, pose.sin),
            length / dx,
            jnp.asarray(job.tool.thickness) / dx / 2,
            jnp.asarray(job.tool.width) / dx / 2,
            job.bottom,
            dx,
            job.flow.quantum,
            drop.reshape(-1) if drop.ndim else drop,
            job.bed.rim.level if job.bed.rim is not None else None,
            job.flow.rate,
            angle,
        )

    zero = jnp.zeros_like(length)
    if before is None:
        sand = repeat(_Lower(block), 1, way(pose, zero, zero), sand)
    else:
        sin = before.cos * pose.sin - before.sin * pose.cos
        cos = before.cos * pose.cos + before.sin * pose.sin
        same = (sin == 0) & (cos > 0)
        angle = jnp.where(same, 0, jnp.arctan2(jnp.where(same, 0, sin), jnp.where(same, 1, cos)))
        turn = way(Pose(pose.x, pose.y, before.cos, before.sin), zero, angle)
        bound = math.ceil(math.pi * math.hypot(*shape) / push.substep) + 1
        turning = _Turn(block, substep=push.substep, sweeps=push.sweeps, rest=rest)
        sand, _ = repeat_until(turning.turned, turning, bound, turn, sand)
    start, onmap = over_the_map(scene, job, pose, length)
    # make_scene holds the thickness below the map's diagonal, so twice the diagonal is enough.
    chunk = max(1, int(1 / push.substep))
    bound = math.ceil((2 * math.hypot(*shape) + 3) / (push.substep * chunk)) + 1
    lowered = before is None
    advance = _Advance(block, substep=push.substep, sweeps=push.sweeps, chunk=chunk, lowered=lowered, rest=rest)
    sand, _ = repeat_until(advance.arrived, advance, bound, way(start, onmap, zero), replace(sand, flux=none))
    h, lost = jax.tree.map(lambda x: x.reshape(shape), (sand.height, sand.lost))
    return h, lost, sand.edge


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


def _contact(way: Way, view: View, cover: jax.Array, h: jax.Array) -> jax.Array:
    """1 while the blade is among the sand, falling to 0 where it covers no cell or hangs a spacing above all it covers.

    Keeps a tool that touches nothing from moving sand that is still only to a tolerance.
    """
    spacing, bottom = way.spacing / way.quantum, way.bottom / way.quantum
    near = jnp.clip(1 + jnp.maximum(h - bottom, -spacing) / spacing, 0, 1) * at(view.holds)
    return jnp.minimum(1, 2 * jnp.max(jnp.max(near * cover, axis=0), axis=0))


def _coordinates(size: int, frame: Frame, first: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
    """How far ahead of a pose, and to its left, the cells of a block and its halo lie (spacings)."""
    like = jnp.zeros((size + 2, size + 2, *frame.pose.x.shape), frame.pose.x.dtype)
    pose = jax.tree.map(lambda x: spread(x, like), frame.pose)
    x = numbers(size + 2, 1, first[0]) + (first[0] - 0.5) - pose.x
    y = numbers(size + 2, 0, first[1]) + (first[1] - 0.5) - pose.y
    return x * pose.cos + y * pose.sin, y * pose.cos - x * pose.sin


def _ahead(frame: Frame, by: jax.Array) -> Pose:
    pose = frame.pose
    return Pose(pose.x + by * pose.cos, pose.y + by * pose.sin, pose.cos, pose.sin)


@dataclass(frozen=True)
class _Step:
    """A step of a loop that computes a batch in the last axis; see loop.py."""

    block: Block
    tape: int = 64
    trailing = True

    @property
    def together(self) -> int:
        return self.block.together

    def __call__(self, way: Way, k: jax.Array, sand: Moving) -> Moving:
        raise NotImplementedError

    def recorded(self, way: Way, k: jax.Array, sand: Moving) -> tuple[Moving, Any]:
        return self(way, k, sand), sand

    def push(self, way: Way, k: jax.Array, record: Any, dway: Any, dsand: Moving) -> Moving:
        return Plain(self).push(way, k, record, dway, dsand)

    def pull(self, way: Way, k: jax.Array, record: Any, cotangent: Moving) -> tuple[Any, Moving]:
        return Plain(self).pull(way, k, record, cotangent)


@dataclass(frozen=True)
class _Lower(_Step):
    """The blade comes down: what it covers leaves radially, until all of it rests."""

    tape: int = 1

    def __call__(self, way: Way, k: jax.Array, sand: Moving) -> Moving:
        frame = frame_of(self.block.shape, way.start)
        pose, first = frame.pose, corner(frame, self.block.size, frame.pose.x, frame.pose.y)
        view, old = self.block.view(way, frame, first, sand.height)
        along, across = _coordinates(self.block.size, frame, first)
        beside = blade.share(across, -way.side, way.side)
        cover = inner(blade.straight(along, beside, way.half, jnp.zeros_like(way.length)).after)
        along, across = inner(along), inner(across)
        taken = truncate(cover * jnp.maximum(old - way.bottom / way.quantum, 0)) * at(view.holds)
        s, n = along / (4 * way.half**2), across / (4 * way.side**2)
        p, q = s * pose.cos - n * pose.sin, s * pose.sin + n * pose.cos
        size = jnp.maximum(jnp.abs(p), jnp.abs(q))
        x, y = along * pose.cos - across * pose.sin, along * pose.sin + across * pose.cos
        scale = jnp.minimum(jnp.maximum(jnp.abs(x), jnp.abs(y)), 1) / jnp.where(size > 0, size, 1)
        scale = jnp.where(size > 0, scale, 0)
        shares = blade.any_way(p * scale, q * scale)
        over = self.block.over(way, view, old)
        gone = None if over is None else jnp.zeros_like(old)
        params = (shares, view.holds, cover, over)
        state = (old - taken, gone, taken)
        (new, gone, carried), _ = repeat_until(_at_rest, Plain(_spread, 16), 2 * self.block.size, params, state)
        new = new + carried
        edge = jnp.maximum(sand.edge, self.block.touched(way, frame, first, old, new, cover))
        lost = self.block.lose(way, view, sand.lost, gone)
        return Moving(self.block.back(way, view, sand.height, new), lost, sand.flux, edge)


def _spread(params: Any, k: jax.Array, state: Any) -> Any:
    """Sand handed on by one cell: it comes to rest in the open share of cells, and moves on in the rest."""
    shares, holds, cover, over = params
    h, gone, carried = state
    free = None if over is None else (over[0], over[1] * carried)
    kept, got, lost = blade.handed_on(shares, holds, carried, free)
    rest = truncate((1 - cover) * got)
    return h + rest + kept, None if gone is None else gone + lost, got - rest


def _at_rest(params: Any, k: jax.Array, state: Any) -> jax.Array:
    return ~jnp.any(state[2] > 0)


@dataclass(frozen=True)
class _Advance(_Step):
    """So many sub-steps ahead, `chunk` of them within a spacing, in a block around where they lead.

    If the blade has just come down, the first step lets the sand come to rest around it.
    """

    substep: float = 0.125
    sweeps: int = 4
    chunk: int = 8
    lowered: bool = False
    rest: Rest = bring_to_rest

    def arrived(self, way: Way, k: jax.Array, _: Any) -> jax.Array:
        return (k >= self.lowered) & jnp.all((k - self.lowered) * (self.chunk * self.substep) >= way.length)

    def __call__(self, way: Way, k: jax.Array, sand: Moving) -> Moving:
        return self.recorded(way, k, sand)[0]

    def recorded(self, way: Way, k: jax.Array, sand: Moving) -> tuple[Moving, Any]:
        frame = frame_of(self.block.shape, way.start)
        first, by = self.block_of(way, frame, k)
        view, old = self.block.view(way, frame, first, sand.height)
        flux = shifted(sand.flux, by) if self.block.follows else sand.flux
        cover, rate = self.felt(way, k, first, view, old)
        gone = jnp.zeros_like(old) if self.block.drains else None
        new, after, gone = lax.fori_loop(0, self.chunk, partial(self.substeps, way, rate, k, first, view), (old, flux, gone))
        edge = jnp.maximum(sand.edge, self.block.touched(way, frame, first, old, new, cover))
        lost = self.block.lose(way, view, sand.lost, gone)
        out = Moving(self.block.back(way, view, sand.height, new), lost, after, edge)
        if self.block.drains or way.drop.ndim == sand.height.ndim:
            return out, sand
        return out, (view.holds, old, flux)

    def block_of(
        self, way: Way, frame: Frame, k: jax.Array
    ) -> tuple[tuple[jax.Array, jax.Array], tuple[jax.Array, jax.Array]]:
        """Where the block of step k begins, and by how much that has moved."""
        begins = []
        for j in (jnp.maximum(k - 1, 0), k):
            middle = (jnp.maximum(j - self.lowered, 0) + 0.5) * (self.chunk * self.substep)
            pose = _ahead(frame, jnp.minimum(middle, way.length))
            begins.append(corner(frame, self.block.size, pose.x, pose.y))
        old, new = begins
        return new, (new[0] - old[0], new[1] - old[1])

    def felt(
        self, way: Way, k: jax.Array, first: tuple[jax.Array, jax.Array], view: View, h: jax.Array
    ) -> tuple[jax.Array, jax.Array]:
        """The share of each cell that the blade covers at any time in step k, and the rate at which sand flows then."""
        along, across = _coordinates(self.block.size, frame_of(self.block.shape, way.start), first)
        begin = jnp.minimum(jnp.maximum(k - self.lowered, 0) * (self.chunk * self.substep), way.length)
        ahead = jnp.where(k >= self.lowered, jnp.minimum(way.length - begin, self.chunk * self.substep), 0)
        beside = blade.share(across, -way.side, way.side)
        cover = inner(blade.straight(along - begin, beside, way.half, ahead).swept)
        return cover, way.rate * _contact(way, view, cover, h)

    def substeps(
        self,
        way: Way,
        rate: jax.Array,
        k: jax.Array,
        first: tuple[jax.Array, jax.Array],
        view: View,
        i: jax.Array,
        state: tuple[jax.Array, Fluxes, jax.Array | None],
        rest: Rest | None = None,
    ) -> tuple[jax.Array, Fluxes, jax.Array | None]:
        """Heights, fluxes and what was lost (quanta) after sub-step i of step k."""
        h, flux, gone = state
        frame = frame_of(self.block.shape, way.start)
        pose, (along, across) = frame.pose, _coordinates(self.block.size, frame, first)
        side = spread(way.side, across)
        beside = lax.optimization_barrier(blade.share(across, -side, side))
        moving = k >= self.lowered
        begin = jnp.where(moving, (k - self.lowered) * self.chunk + i, 0) * self.substep
        begin = jnp.minimum(begin, way.length)
        ahead = jnp.where(moving, jnp.minimum(way.length - begin, self.substep), 0)
        part = jnp.where(moving, ahead / self.substep, 1)
        half, further = spread(way.half, along), spread(ahead, along)
        reach = blade.straight(along - spread(begin, along), beside, half, further)
        taken = jnp.where(ahead > 0, blade.cleared(reach, h, spread(way.bottom / way.quantum, h)), 0)
        shares = {to: spread(part, h) for to, part in blade.onward(pose.cos, pose.sin).items()}
        h, lost = self.block.displaced(way, view, shares, h, taken)
        guess = tuple(f * jnp.where(moving, part, 0) for f in moved_on(flux, ahead * pose.cos, ahead * pose.sin))
        rest = self.rest if rest is None else rest
        h, flux = rest(self.block.sand(way, view, reach), rate * part, self.sweeps, h, guess)
        if gone is not None and lost is not None:
            gone = gone + lost + flux[-1]
        return h, flux, gone

    def push(self, way: Way, k: jax.Array, record: Any, dway: Any, dsand: Moving) -> Moving:
        if isinstance(record, Moving):
            return super().push(way, k, record, dway, dsand)
        inside = _Inside(self, way, k, record)
        block = cut(inside.where, dsand.height, 0.0) / way.quantum
        flux = shifted(dsand.flux, inside.by) if self.block.follows else dsand.flux

        def whole(floats: Any, *state: Any) -> Any:
            rate = inside.rate(floats, state[0])
            return lax.fori_loop(0, self.chunk, lambda i, state: inside.substep(floats, rate, i, *state), state)

        _, (block, flux) = jax.jvp(whole, (inside.floats, *inside.state), (dway, block, flux))
        height = paste(inside.where, dsand.height, block * at(inside.holds) * way.quantum)
        return Moving(height, None, flux, dsand.edge)

    def pull(self, way: Way, k: jax.Array, record: Any, cotangent: Moving) -> tuple[Any, Moving]:
        if isinstance(record, Moving):
            return super().pull(way, k, record, cotangent)
        inside = _Inside(self, way, k, record)
        floats = inside.floats
        rate, to_rate = jax.vjp(inside.rate, floats, inside.state[0])

        def again(i: jax.Array, carry: Any) -> Any:
            state, tape = carry
            tape = jax.tree.map(lambda t, x: lax.dynamic_update_index_in_dim(t, x, i, 0), tape, state)
            return inside.substep(floats, rate, i, *state), tape

        tape = jax.tree.map(lambda x: jnp.zeros((self.chunk, *x.shape), x.dtype), inside.state)
        _, tape = lax.fori_loop(0, self.chunk, again, (inside.state, tape))

        def fetched(i: jax.Array) -> Any:
            return jax.tree.map(lambda t: lax.dynamic_index_in_dim(t, i, 0, keepdims=False), tape)

        def back(j: jax.Array, carry: Any) -> Any:
            (h, f), of_floats, of_rate, of_state = carry
            i = self.chunk - 1 - j

            def step(floats: Any, rate: jax.Array, h: jax.Array, f: Fluxes) -> tuple[jax.Array, Fluxes]:
                return inside.substep(floats, rate, i, h, f, bring_to_rest_and_back)

            pulled = jax.vjp(step, floats, rate, h, f)[1]
            df, dr, *of_state = pulled(of_state)
            return fetched(i - 1), jax.tree.map(jnp.add, of_floats, df), of_rate + dr, tuple(of_state)

        gain = cut(inside.where, cotangent.height, 0.0) * way.quantum
        none = jax.tree.map(jnp.zeros_like, (floats, rate))
        carry = (fetched(jnp.int32(self.chunk - 1)), *none, (gain, cotangent.flux))
        _, of_floats, of_rate, (dh, dflux) = lax.fori_loop(0, self.chunk, back, carry)
        df, more = to_rate(of_rate)
        height = paste(inside.where, cotangent.height, (dh + more) * at(inside.holds) / way.quantum)
        dflux = shifted_back(dflux, inside.by) if self.block.follows else dflux
        return jax.tree.map(jnp.add, of_floats, df), Moving(height, None, dflux, cotangent.edge)


class _Inside:
    """Step k of `_Advance` in its block alone, as a function of all that it depends on; nothing drains, and one angle."""

    def __init__(self, advance: _Advance, way: Way, k: jax.Array, record: tuple[jax.Array, jax.Array, Fluxes]) -> None:
        self.advance, self.k = advance, k
        self.holds, *state = record
        self.state = tuple(state)
        frame = frame_of(advance.block.shape, way.start)
        self.first, self.by = advance.block_of(way, frame, k)
        self.where = places(frame, advance.block.size, self.first)
        self.floats, self.merge = split(way)

    def _view(self, way: Way) -> View:
        return View(self.where, self.holds, way.drop / way.quantum, None, None)

    def rate(self, floats: Any, h: jax.Array) -> jax.Array:
        way = self.merge(floats)
        return self.advance.felt(way, self.k, self.first, self._view(way), h)[1]

    def substep(
        self,
        floats: Any,
        rate: jax.Array,
        i: jax.Array,
        h: jax.Array,
        flux: Fluxes,
        rest: Rest | None = None,
    ) -> tuple[jax.Array, Fluxes]:
        way = self.merge(floats)
        return self.advance.substeps(way, rate, self.k, self.first, self._view(way), i, (h, flux, None), rest)[:2]


@dataclass(frozen=True)
class _Turn(_Step):
    """A part of a turn in place: the blade turns by as much as moves its corners by `substep` spacings."""

    substep: float = 0.125
    sweeps: int = 4
    rest: Rest = bring_to_rest

    def turned(self, way: Way, k: jax.Array, _: Any) -> jax.Array:
        return jnp.all(k * self._part(way) >= jnp.abs(way.angle))

    def _part(self, way: Way) -> jax.Array:
        far = jnp.minimum(jnp.hypot(way.half, way.side), math.hypot(*self.block.shape))
        return lax.stop_gradient(self.substep / far)

    def __call__(self, way: Way, k: jax.Array, sand: Moving) -> Moving:
        whole = self._part(way)
        begin = k * whole
        ahead = jnp.clip(jnp.abs(way.angle) - begin, 0, whole)
        part = ahead / whole
        sign = jnp.where(way.angle < 0, -1.0, 1.0).astype(begin.dtype)
        no = jnp.zeros((), bool)
        frame = Frame(_rotated(way.start, sign * begin), no, no, no, self.block.shape)
        after = replace(frame, pose=_rotated(way.start, sign * (begin + ahead)))
        pose, first = frame.pose, corner(frame, self.block.size, frame.pose.x, frame.pose.y)
        view, old = self.block.view(way, frame, first, sand.height)
        now, then = _coordinates(self.block.size, frame, first), _coordinates(self.block.size, after, first)
        reach = blade.turned(now, then, way.half, way.side, sign * ahead)
        near = _contact(way, view, inner(reach.swept), old)
        taken = jnp.where(ahead > 0, blade.cleared(reach, old, way.bottom / way.quantum), 0)
        face = blade.facing(at(now[1]), sign * ahead) / jnp.maximum(jnp.abs(pose.cos), jnp.abs(pose.sin))
        h, lost = self.block.displaced(way, view, blade.any_way(face * pose.cos, face * pose.sin), old, taken)
        guess = tuple(f * part for f in sand.flux)
        new, flux = self.rest(self.block.sand(way, view, reach), way.rate * near * part, self.sweeps, h, guess)
        gone = None if lost is None else lost + flux[-1]
        edge = jnp.maximum(sand.edge, self.block.touched(way, frame, first, old, new, at(reach.swept)))
        return Moving(self.block.back(way, view, sand.height, new), self.block.lose(way, view, sand.lost, gone), flux, edge)


def _rotated(pose: Pose, angle: jax.Array) -> Pose:
    cos, sin = jnp.cos(angle), jnp.sin(angle)
    return Pose(pose.x, pose.y, pose.cos * cos - pose.sin * sin, pose.sin * cos + pose.cos * sin)
