"""The steps of a wheel's leg: it is lowered, turns in place, and moves ahead. Each is a step of a loop of while_loop.py."""

import math
from dataclasses import dataclass, replace

import jax
import jax.numpy as jnp
from jax import lax

from jaxsand.autodiff.while_loop import Plain, repeat_until
from jaxsand.interaction import _wheel as wheel
from jaxsand.interaction._advance import LegStep
from jaxsand.interaction._block import Block, Moving, View, pose_ahead, rotated
from jaxsand.interaction._displacement import Carried, none_carried
from jaxsand.interaction._frame import Frame, frame_of, shifted
from jaxsand.interaction._wheel import Placed, Track
from jaxsand.interaction.resting import bring_to_rest
from jaxsand.relaxation.flux import Fluxes
from jaxsand.relaxation.ghost_cells import at, truncate
from jaxsand.scene.footprint import Pose


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class AtRest:
    """Sand that was brought to rest in a block (quanta): heights, fluxes, and what each cell lost over a rim, or None."""

    height: jax.Array
    flux: Fluxes
    lost: jax.Array | None


@dataclass(frozen=True)
class Touchdown(LegStep[Track]):
    """The step in which the wheel comes down: the sand that it covers moves outwards, cell by cell, until it has left."""

    tape: int = 1

    def __call__(self, track: Track, k: jax.Array, sand: Moving) -> Moving:
        way, frame = track.way, frame_of(self.block.shape, track.way.start)
        first = self.block.corner(frame.pose.x, frame.pose.y)
        view, old = self.block.view(way, frame, first, sand.height)
        here = wheel.placed(self.block, track, frame, first, view)
        taken = truncate(here.cover * jnp.maximum(old - here.rim, 0)) * at(view.holds)
        gone = None if view.beyond is None else jnp.zeros_like(old)
        onward = Plain(_Onward(self.block), 16)
        params = (track, view, wheel.radial(track, frame, here), here)
        state, _ = repeat_until(none_carried, onward, 2 * self.block.size, params, Carried(old - taken, gone, taken))
        gone, new = state.lost, state.height + state.carried
        edge = jnp.maximum(sand.edge, self.block.touched(way, frame, first, old, new, here.cover))
        lost = self.block.lose(way, view, sand.lost, gone)
        return Moving(self.block.back(way, view, sand.height, new), lost, sand.flux, edge)


@dataclass(frozen=True)
class _Onward:
    """The step in which sand under the wheel moves on by one cell."""

    block: Block

    def __call__(self, params: tuple[Track, View, wheel.Shares, Placed], k: jax.Array, state: Carried) -> Carried:
        track, view, shares, here = params
        return wheel.handed_on(self.block, track, view, shares, here, state)


@dataclass(frozen=True)
class _Moved(LegStep[Track]):
    """A step in which the wheel moves, and `sweeps` proximal steps after each sub-step bring the sand to rest around it."""

    substep: float = 0.125
    sweeps: int = 4

    def moved(
        self,
        track: Track,
        view: View,
        shares: wheel.Shares,
        now: Placed,
        part: jax.Array,
        h: jax.Array,
        flux: Fluxes,
        taken: jax.Array,
    ) -> AtRest:
        """The sand after what was taken up has left the wheel's new place `now`, and was brought to rest around it."""
        h, gone = wheel.displaced(self.block, track, view, shares, now, h - taken, taken)
        beside, among = wheel.sand_beside(self.block, track, view, now, h)
        guess = self.block.guess(beside.gates, among * part, flux)
        h, new = bring_to_rest(beside, track.way.rate * among * part, self.sweeps, h, guess)
        return AtRest(h, self.kept(part, new, flux), None if gone is None else gone + new[-1])


@dataclass(frozen=True)
class WheelTurn(_Moved):
    """A sub-step of a turn in place, which moves the wheel's corners by `substep` spacings."""

    def done(self, track: Track, k: jax.Array, _: Moving) -> jax.Array:
        """Whether the turn is complete before step k."""
        return jnp.all(k.astype(track.way.angle.dtype) * self._part(track) >= jnp.abs(track.way.angle))

    def _part(self, track: Track) -> jax.Array:
        """The angle of a sub-step (rad)."""
        far = jnp.minimum(jnp.hypot(track.radius, track.way.side), math.hypot(*self.block.shape))
        return self.substep / far

    def __call__(self, track: Track, k: jax.Array, sand: Moving) -> Moving:
        way, whole = track.way, self._part(track)
        begin = k.astype(whole.dtype) * whole
        ahead = jnp.clip(jnp.abs(way.angle) - begin, 0, whole)
        sign = jnp.where(way.angle < 0, -1.0, 1.0).astype(begin.dtype)
        no = jnp.zeros((), bool)
        frame = Frame(rotated(way.start, sign * begin), no, no, no, self.block.shape)
        after = replace(frame, pose=rotated(way.start, sign * (begin + ahead)))
        first = self.block.corner(frame.pose.x, frame.pose.y)
        view, old = self.block.view(way, frame, first, sand.height)
        before, now = (wheel.placed(self.block, track, f, first, view) for f in (frame, after))
        taken = jnp.where(ahead > 0, wheel.cleared(track, before, now, old), 0) * at(view.holds)
        shares = wheel.turning(track, frame, before, sign)
        state = self.moved(track, view, shares, now, ahead / whole, old, sand.flux, taken)
        cover = jnp.maximum(before.cover, now.cover)
        edge = jnp.maximum(sand.edge, self.block.touched(way, frame, first, old, state.height, cover))
        height = self.block.back(way, view, sand.height, state.height)
        return Moving(height, self.block.lose(way, view, sand.lost, state.lost), state.flux, edge)


@dataclass(frozen=True)
class Roll(_Moved):
    """`chunk` sub-steps ahead, over a spacing at most, in one block.

    If the wheel has just been lowered, the first step only brings the sand to rest around it.
    """

    chunk: int = 8
    lowered: bool = False

    def done(self, track: Track, k: jax.Array, _: Moving) -> jax.Array:
        """Whether the leg is complete before step k."""
        steps = (k - int(self.lowered)).astype(track.way.length.dtype)
        return (k >= int(self.lowered)) & jnp.all(steps * (self.chunk * self.substep) >= track.way.length)

    def __call__(self, track: Track, k: jax.Array, sand: Moving) -> Moving:
        way, block = track.way, self.block
        frame = frame_of(block.shape, way.start)
        first, by = block.ahead(frame, way.length, k - int(self.lowered), self.chunk * self.substep)
        view, old = block.view(way, frame, first, sand.height)
        flux = shifted(sand.flux, by) if block.follows else sand.flux
        gone = None if view.beyond is None else jnp.zeros_like(old)

        def substep(i: jax.Array, state: AtRest) -> AtRest:
            h, flux, gone = state.height, state.flux, state.lost
            (begin, end), ahead = self._ends(track, k, i)
            before, now = (wheel.placed(block, track.at(by), _at(frame, by), first, view) for by in (begin, end))
            taken = jnp.where(ahead > 0, wheel.cleared(track, before, now, h), 0) * at(view.holds)
            h, left = wheel.carried_back(block, track, _at(frame, end), first, view, ahead, h, taken)
            h = h - taken + left
            still = k < int(self.lowered)
            part = jnp.where(still, 1, ahead / self.substep)
            flux = tuple(jnp.where(still, 0, f) for f in flux)
            shares = wheel.leaving(track, frame, now)
            state = self.moved(track.at(end), view, shares, now, part, h, flux, left)
            return replace(state, lost=gone if gone is None or state.lost is None else gone + state.lost)

        state = lax.fori_loop(0, self.chunk, substep, AtRest(old, flux, gone))
        ends = self._ends(track, k, jnp.int32(0))[0][0], self._ends(track, k, jnp.int32(self.chunk - 1))[0][1]
        cover = jnp.maximum(*(wheel.placed(block, track, _at(frame, by), first, view).cover for by in ends))
        edge = jnp.maximum(sand.edge, block.touched(way, frame, first, old, state.height, cover))
        height = block.back(way, view, sand.height, state.height)
        return Moving(height, block.lose(way, view, sand.lost, state.lost), state.flux, edge)

    def _ends(self, track: Track, k: jax.Array, i: jax.Array) -> tuple[tuple[jax.Array, jax.Array], jax.Array]:
        """How far ahead the wheel is before and after sub-step i of step k, and the distance between them (spacings)."""
        length, moving = track.way.length, k >= int(self.lowered)
        steps = jnp.where(moving, (k - int(self.lowered)) * self.chunk + i, 0).astype(length.dtype)
        begin = jnp.minimum(steps * self.substep, length)
        ahead = jnp.where(moving, jnp.minimum(length - begin, self.substep), 0)
        return (begin, begin + ahead), ahead


def _at(frame: Frame, by: jax.Array) -> Frame:
    """The frame with its pose moved ahead by a length (spacings)."""
    pose: Pose = pose_ahead(frame, by)
    return replace(frame, pose=pose)
