"""A blade moves ahead, by sub-steps; a step of a loop (while_loop.py) is several of them, within a spacing.

The sub-steps ahead are differentiated in their block alone: from the block before a step its sub-steps are made again, and
each is differentiated by JAX but for the sand's coming to rest, whose derivative resting.py writes out.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Generic, Protocol, TypeVar

import jax
import jax.numpy as jnp
from jax import lax

from jaxsand.autodiff.while_loop import Plain, split
from jaxsand.interaction import _blade as blade
from jaxsand.interaction._block import Block, First, Moving, Openness, View, Way, rotated
from jaxsand.interaction._frame import Frame, cut, frame_of, paste, places, shifted, shifted_back
from jaxsand.interaction._resting_adjoint import Rested, blank, rest_taped, rest_vjp
from jaxsand.interaction.resting import Links, Sand, bring_to_rest
from jaxsand.interaction.stencil import inner, spread
from jaxsand.relaxation.flux import Fluxes
from jaxsand.relaxation.ghost_cells import ExactSum, at, halo

Rest = Callable[[Sand, jax.Array, int, jax.Array, Fluxes], tuple[jax.Array, Fluxes]]


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class InBlock:
    """The sand of a block: heights and fluxes (quanta), and how it stood last."""

    height: jax.Array
    flux: Fluxes
    openness: Openness


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Disturbed:
    """Sand that is yet to come to rest: how it stands near the blade and in the block, the blade's bottom (quanta; a number
    or a map near the blade), at which rate sand flows, its heights, a guess of what flows, and which share of a whole
    sub-step this one is."""

    near: Openness
    bottom: jax.Array
    sand: Sand
    rate: jax.Array
    height: jax.Array
    guess: Fluxes
    part: jax.Array

    def openness(self) -> Openness:
        """What the next sub-step needs to know of how the tool stands here."""
        return Openness(self.sand.gates, self.sand.open, self.sand.stretch)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class SubStep:
    """What a blade does in a sub-step: the leg, with the bottom where the blade is now; its footprints; whether it moves, or
    has just come down; which share of a whole sub-step this one is; and what leaves the cells near the blade (quanta)."""

    way: Way
    reach: blade.Reach
    moving: jax.Array
    part: jax.Array
    taken: jax.Array


class LegParams(Protocol):
    """What a step of a leg depends on."""

    @property
    def length(self) -> jax.Array:
        """Length of the leg (spacings)."""

    @property
    def angle(self) -> jax.Array:
        """Angle by which the tool turns in place before the leg (rad)."""


L = TypeVar("L", bound=LegParams)
Floats = tuple[jax.Array, ...]  # the floating-point leaves of a leg, or cotangents of them
BlockSand = tuple[jax.Array, Fluxes]  # heights and fluxes of a block
StepRecord = Moving | BlockSand  # the sand before a step, or that of its block


@dataclass(frozen=True)
class LegStep(Generic[L]):
    """A step of a loop that computes a batch in the last axis; see while_loop.py."""

    block: Block
    tape: int = 32
    keeps: bool = False  # whether fluxes are kept for a later leg
    trailing = True

    @property
    def together(self) -> int:
        """How many maps of a batch are computed at a time."""
        return self.block.together

    def kept(self, part: jax.Array, flux: Fluxes, before: Fluxes) -> Fluxes:
        """The fluxes to start from after a sub-step that is the share `part` of a whole one, whose fluxes are `flux`."""
        return tuple(f + (1 - part) * b for f, b in zip(flux, before, strict=True)) if self.keeps else flux

    def work(self, leg: L) -> jax.Array:
        """How far the step leads: what its number of repetitions grows with."""
        return leg.length + jnp.abs(leg.angle)

    def __call__(self, leg: L, k: jax.Array, sand: Moving, /) -> Moving:
        raise NotImplementedError

    def recorded(self, leg: L, k: jax.Array, sand: Moving, /) -> tuple[Moving, StepRecord]:
        """The sand after step k, and the sand before it as the record."""
        return self(leg, k, sand), sand

    def jvp(self, leg: L, k: jax.Array, record: StepRecord, dleg: Floats, dsand: Moving, /) -> Moving:
        """The jvp, by JAX."""
        return Plain(self).jvp(leg, k, record, dleg, dsand)

    def vjp(self, leg: L, k: jax.Array, record: StepRecord, cotangent: Moving, /) -> tuple[Floats, Moving]:
        """The vjp, by JAX."""
        return Plain(self).vjp(leg, k, record, cotangent)


@dataclass(frozen=True)
class Advance(LegStep[Way]):
    """So many sub-steps ahead, `chunk` of them within a spacing, in a block around where they lead.

    If the blade has just come down, the first step lets the sand come to rest around it.
    """

    substep: float = 0.125
    sweeps: int = 4
    chunk: int = 8
    lowered: bool = False
    rest: Rest = bring_to_rest

    def done(self, way: Way, k: jax.Array, _: Moving) -> jax.Array:
        """Whether the leg is complete before step k."""
        gone = (k - int(self.lowered)).astype(way.length.dtype) * (self.chunk * self.substep)
        return (k >= int(self.lowered)) & jnp.all(gone >= way.length)

    def __call__(self, way: Way, k: jax.Array, sand: Moving) -> Moving:
        return self.recorded(way, k, sand)[0]

    def recorded(self, way: Way, k: jax.Array, sand: Moving) -> tuple[Moving, StepRecord]:
        """The sand after step k, and what its derivative needs."""
        frame = frame_of(self.block.shape, way.start)
        first, by = self.block_of(way, frame, k)
        view, old = self.block.view(way, frame, first, sand.height)
        flux = shifted(sand.flux, by) if self.block.follows else sand.flux
        cover, rate = self.felt(way, k, first, view, old)
        gone = jnp.zeros_like(old) if self.block.drains else None

        def substep(
            i: jax.Array, carry: tuple[InBlock, jax.Array | None, ExactSum | None]
        ) -> tuple[InBlock, jax.Array | None, ExactSum | None]:
            state, gone, scooped = carry
            h = state.height
            cut = self.cut(way, k, first, view, i, self.block.part(h))
            taken = cut.taken
            if way.room is not None:
                into, scooped = blade.scooped(way.room, scooped, taken * at(self.block.part(view.holds)))
                h, taken = self.block.put(h, self.block.part(h) - into), taken - into
            disturbed, lost = self.displaced(cut, rate, view, replace(state, height=h), taken)
            h, new = self.rest(disturbed.sand, disturbed.rate, self.sweeps, disturbed.height, disturbed.guess)
            if gone is not None and lost is not None:
                gone = gone + lost + new[-1]
            return InBlock(h, self.kept(disturbed.part, new, state.flux), disturbed.openness()), gone, scooped

        state = InBlock(old, flux, self.block.clear(view))
        state, gone, scooped = lax.fori_loop(0, self.chunk, substep, (state, gone, sand.scooped))
        edge = jnp.maximum(sand.edge, self.block.touched(way, frame, first, old, state.height, cover))
        lost = self.block.lose(way, view, sand.lost, gone)
        out = Moving(self.block.back(way, view, sand.height, state.height), lost, state.flux, edge, scooped)
        by_jax = self.block.drains or way.room is not None or way.base is not None
        if by_jax or way.drop.ndim == sand.height.ndim:
            return out, sand
        return out, (jnp.where(at(view.holds) > 0, old, jnp.nan), flux)

    def block_of(self, way: Way, frame: Frame, k: jax.Array) -> tuple[First, First]:
        """Where the block of step k begins, and by how much that has moved."""
        return self.block.ahead(frame, way.length, k - int(self.lowered), self.chunk * self.substep)

    def felt(self, way: Way, k: jax.Array, first: First, view: View, h: jax.Array) -> tuple[jax.Array, jax.Array]:
        """The share of each cell that the blade covers at any time in step k, and the rate at which sand flows then."""
        gone = jnp.maximum(k - int(self.lowered), 0).astype(way.length.dtype)
        begin = jnp.minimum(gone * (self.chunk * self.substep), way.length)
        ahead = jnp.where(k >= int(self.lowered), jnp.minimum(way.length - begin, self.chunk * self.substep), 0)
        cover = inner(self.reach(way, first, begin, ahead).swept)
        lowest = way if way.rise is None else way.at(jnp.where(way.rise < 0, begin + ahead, begin))
        return cover, way.rate * self.block.contact(lowest, view, cover, h)

    def disturbed(
        self, way: Way, rate: jax.Array, k: jax.Array, first: First, view: View, i: jax.Array, state: InBlock
    ) -> tuple[Disturbed, jax.Array | None]:
        """Sub-step i of step k up to when the sand comes to rest, and what was lost."""
        cut = self.cut(way, k, first, view, i, self.block.part(state.height))
        return self.displaced(cut, rate, view, state, cut.taken)

    def cut(self, way: Way, k: jax.Array, first: First, view: View, i: jax.Array, near: jax.Array) -> SubStep:
        """What the blade cuts in sub-step i of step k from the heights `near` it."""
        moving = k >= int(self.lowered)
        begin = jnp.where(moving, (k - int(self.lowered)) * self.chunk + i, 0).astype(way.length.dtype) * self.substep
        begin = jnp.minimum(begin, way.length)
        ahead = jnp.where(moving, jnp.minimum(way.length - begin, self.substep), 0)
        reach = self.reach(way, first, begin, ahead)
        if way.rise is None and view.base is None:
            taken = blade.cleared(reach, near, spread(way.bottom / way.quantum, near))
        else:
            taken, bottom = self.beneath(way, reach, view, near, begin, ahead)
            way = replace(way, bottom=bottom * spread(way.quantum, near))
        return SubStep(way, reach, moving, jnp.where(moving, ahead / self.substep, 1), jnp.where(ahead > 0, taken, 0))

    def reach(self, way: Way, first: First, begin: jax.Array, ahead: jax.Array) -> blade.Reach:
        """The blade's footprints as it moves ahead from `begin` (spacings)."""
        frame = frame_of(self.block.shape, way.start)
        if way.yaw is None:
            along, across = self.block.coordinates(frame, first)
            side, half = spread(way.side, across), spread(way.half, along)
            beside = lax.optimization_barrier(blade.share(across, -side, side))
            reach = blade.straight(along - spread(begin, along), beside, half, spread(ahead, along))
            if way.plates is None:
                return reach
            return blade.boxed(reach, across, half, side, spread(way.plates, along), spread(ahead, along))
        yaw = frame.mirrors(way.yaw)
        frame = replace(frame, pose=rotated(frame.pose, yaw))
        along, across = self.block.coordinates(frame, first)
        further = spread(ahead, along)
        cos, sin, half, side = (spread(x, along) for x in (jnp.cos(yaw), jnp.sin(yaw), way.half, way.side))
        old = (along - spread(begin, along) * cos, across + spread(begin, along) * sin)
        new = lax.optimization_barrier((old[0] - further * cos, old[1] + further * sin))
        return blade.slanted(old, new, half, side, further)

    def beneath(
        self, way: Way, reach: blade.Reach, view: View, near: jax.Array, begin: jax.Array, ahead: jax.Array
    ) -> tuple[jax.Array, jax.Array]:
        """What a blade with another bottom over each cell takes up, and that bottom afterwards (quanta)."""
        new = self.block.above(view, self.bottom(way, reach, begin + ahead))
        if way.rise is None or way.room is not None:
            return blade.cleared(reach, near, new), new
        old = self.block.above(view, self.bottom(way, reach, begin))
        return blade.cleared_beneath(reach, near, old, new, spread(way.rise / way.spacing, near)), new

    def displaced(
        self, cut: SubStep, rate: jax.Array, view: View, state: InBlock, taken: jax.Array
    ) -> tuple[Disturbed, jax.Array | None]:
        """The sand after `taken` of what was cut has left to the front, yet to come to rest, and what was lost."""
        h, flux, clear = state.height, state.flux, state.openness
        way, frame = cut.way, frame_of(self.block.shape, cut.way.start)
        pose = frame.pose
        room = self.block.part(view.holds if view.beyond is None else view.holds + view.beyond)
        cos, sin = spread(pose.cos, taken), spread(pose.sin, taken)
        if way.yaw is None:
            shares = blade.onward(cos, sin, room)
        else:
            repose = jnp.arctan(self.block.part(jnp.broadcast_to(view.drop, h.shape)) * (way.quantum / way.spacing))
            shares = blade.slid(cos, sin, spread(frame.mirrors(way.yaw), taken), repose)
        h, lost = self.block.displaced(way, view, shares, h, taken)
        near = self.block.beside(view, cut.reach)
        sand = self.block.sand(way, view, clear, near)
        guess = self.block.guess(near.gates, jnp.where(cut.moving, cut.part, 0), flux)
        return Disturbed(near, way.bottom / way.quantum, sand, rate * cut.part, h, guess, cut.part), lost

    def bottom(self, way: Way, reach: blade.Reach, by: jax.Array) -> jax.Array:
        """The blade's bottom over each cell near it (quanta), when it has moved by a length (spacings).

        A bottom that rises is in each cell where the blade's front left it. A bucket's edge is thin: it leaves each cell at
        the height of the path there.
        """
        if way.rise is None:
            return spread(way.bottom / way.quantum, inner(reach.along))
        behind = blade.behind_the_front(reach, spread(way.half, inner(reach.along)))
        if way.yaw is not None:
            behind = behind / jnp.cos(way.yaw)
        if way.room is not None:
            return (way.bottom + (by + way.half - behind) * way.rise) / way.quantum
        past = jnp.where(way.rise > 0, jnp.minimum(behind, by), 0)
        return (way.bottom + (by - past) * way.rise) / way.quantum

    def jvp(self, way: Way, k: jax.Array, record: StepRecord, dway: Floats, dsand: Moving) -> Moving:
        """The jvp: of the step made again in its block."""
        if isinstance(record, Moving):
            return super().jvp(way, k, record, dway, dsand)
        inside = _Inside(self, way, k, record)
        block = cut(inside.where, dsand.height, 0.0) / way.quantum
        flux = shifted(dsand.flux, inside.by) if self.block.follows else dsand.flux

        def whole(floats: Floats, h: jax.Array, flux: Fluxes) -> tuple[jax.Array, Fluxes]:
            rate = inside.rate(floats, h)
            return lax.fori_loop(0, self.chunk, lambda i, state: inside.substep(floats, rate, i, *state), (h, flux))

        _, (block, flux) = jax.jvp(whole, (inside.floats, *inside.state), (dway, block, flux))
        height = paste(inside.where, dsand.height, block * at(inside.holds) * way.quantum)
        return Moving(height, None, flux, dsand.edge)

    def vjp(self, way: Way, k: jax.Array, record: StepRecord, cotangent: Moving) -> tuple[Floats, Moving]:
        """The vjp: of the step made again in its block."""
        if isinstance(record, Moving):
            return super().vjp(way, k, record, cotangent)
        inside = _Inside(self, way, k, record)
        gain = cut(inside.where, cotangent.height, 0.0) * way.quantum
        of_floats, dh, dflux = inside.vjp((gain, cotangent.flux))
        height = paste(inside.where, cotangent.height, dh * at(inside.holds) / way.quantum)
        dflux = shifted_back(dflux, inside.by) if self.block.follows else dflux
        return of_floats, Moving(height, None, dflux, cotangent.edge)


class _Inside:
    """Step k of `Advance` in its block alone, as a function of all that it depends on; nothing drains, and one angle."""

    def __init__(self, advance: Advance, way: Way, k: jax.Array, record: tuple[jax.Array, Fluxes]) -> None:
        self.advance, self.k = advance, k
        height, flux = record
        solid = jnp.isnan(height)
        self.holds = halo(jnp.where(solid, 0.0, 1.0).astype(height.dtype), 0.0)
        self.state = (jnp.where(solid, 0, height), flux)
        frame = frame_of(advance.block.shape, way.start)
        self.first, self.by = advance.block_of(way, frame, k)
        self.where = places(frame, advance.block.size, self.first)
        self.floats, self.merge = split(way)

    def _view(self, way: Way) -> View:
        return View(self.where, self.holds, way.drop / way.quantum, None, None)

    def rate(self, floats: Floats, h: jax.Array) -> jax.Array:
        way = self.merge(floats)
        return self.advance.felt(way, self.k, self.first, self._view(way), h)[1]

    def disturbed(self, i: jax.Array, floats: Floats, rate: jax.Array, h: jax.Array, flux: Fluxes) -> Disturbed:
        way = self.merge(floats)
        view = self._view(way)
        state = InBlock(h, flux, self.advance.block.clear(view))
        return self.advance.disturbed(way, rate, self.k, self.first, view, i, state)[0]

    def substep(self, floats: Floats, rate: jax.Array, i: jax.Array, h: jax.Array, flux: Fluxes) -> tuple[jax.Array, Fluxes]:
        disturbed = self.disturbed(i, floats, rate, h, flux)
        h, new = bring_to_rest(disturbed.sand, disturbed.rate, self.advance.sweeps, disturbed.height, disturbed.guess)
        return h, self.advance.kept(disturbed.part, new, flux)

    def vjp(self, cotangent: BlockSand) -> tuple[Floats, jax.Array, Fluxes]:
        """The cotangents of the floats, the heights and the fluxes: from the last sub-step backwards, made again."""
        chunk, sweeps, floats = self.advance.chunk, self.advance.sweeps, self.floats
        rate, to_rate = jax.vjp(self.rate, floats, self.state[0])

        def again(i: jax.Array, carry: tuple[BlockSand, BlockSand]) -> tuple[BlockSand, BlockSand]:
            state, tape = carry
            tape = jax.tree.map(lambda t, x: lax.dynamic_update_index_in_dim(t, x, i, 0), tape, state)
            return self.substep(floats, rate, i, *state), tape

        tape = jax.tree.map(lambda x: jnp.zeros((chunk, *x.shape), x.dtype), self.state)
        _, tape = lax.fori_loop(0, chunk, again, (self.state, tape))

        def fetched(i: jax.Array) -> BlockSand:
            return jax.tree.map(lambda t: lax.dynamic_index_in_dim(t, i, 0, keepdims=False), tape)

        def back(j: jax.Array, carry: Any) -> Any:
            state, of_floats, of_rate, of_state, steps = carry
            i = chunk - 1 - j
            if self.advance.block.neighbours == "isotropic":
                vjp = jax.vjp(lambda *x: self.substep(x[0], x[1], i, *x[2:]), floats, rate, *state)[1]
                df, dr, *of_state = vjp(of_state)
            else:
                (depends, carried), vjp, sand = jax.vjp(partial(self._depends, i), floats, rate, *state, has_aux=True)
                model = Links(sand, depends.rate)
                steps = rest_taped(model, sweeps, depends.height, depends.guess, steps)
                rested = rest_vjp(model, sweeps, self.advance.block.part, steps, of_state)
                df, dr, *of_state = vjp((rested, of_state[1] if carried else ()))
            return fetched(i - 1), jax.tree.map(jnp.add, of_floats, df), of_rate + dr, tuple(of_state), steps

        none = jax.tree.map(jnp.zeros_like, (floats, rate))
        carry = (fetched(jnp.int32(chunk - 1)), *none, cotangent, blank(sweeps, *self.state))
        _, of_floats, of_rate, (dh, dflux), _ = lax.fori_loop(0, chunk, back, carry)
        df, more = to_rate(of_rate)
        return jax.tree.map(jnp.add, of_floats, df), dh + more, dflux

    def _depends(
        self, i: jax.Array, floats: Floats, rate: jax.Array, h: jax.Array, flux: Fluxes
    ) -> tuple[tuple[Rested, Fluxes], Sand]:
        """What the sand's coming to rest depends on, the fluxes that are kept beside its own, and the sand."""
        disturbed = self.disturbed(i, floats, rate, h, flux)
        near, sand = disturbed.near, disturbed.sand
        rested = Rested(
            near.gates, near.stretch, disturbed.bottom, sand.drop, disturbed.rate, disturbed.height, disturbed.guess
        )
        return (rested, tuple((1 - disturbed.part) * f for f in flux) if self.advance.keeps else ()), sand
