"""The steps of a blade's leg: it is lowered, and it moves ahead. Each is a step of a loop (loop.py).

The sub-steps ahead are pulled back in their block alone: from the block before a step its sub-steps are made again, and
each is differentiated by JAX but for the sand's coming to rest, whose derivative resting.py writes out.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax

from jaxsand import blade
from jaxsand.bed import at, truncate
from jaxsand.block import Block, Moving, View, Way, contact, coordinates, pose_ahead
from jaxsand.flux import Fluxes
from jaxsand.frame import Frame, corner, cut, frame_of, paste, places, shifted, shifted_back
from jaxsand.loop import Plain, repeat_until, split
from jaxsand.resting import Sand, bring_to_rest, bring_to_rest_and_back, moved_on
from jaxsand.stencil import inner, spread

Rest = Callable[[Sand, jax.Array, int, jax.Array, Fluxes], tuple[jax.Array, Fluxes]]


@dataclass(frozen=True)
class Step:
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
class Lower(Step):
    """The blade comes down: what it covers leaves radially, until all of it rests."""

    tape: int = 1

    def __call__(self, way: Way, k: jax.Array, sand: Moving) -> Moving:
        frame = frame_of(self.block.shape, way.start)
        pose, first = frame.pose, corner(frame, self.block.size, frame.pose.x, frame.pose.y)
        view, old = self.block.view(way, frame, first, sand.height)
        along, across = coordinates(self.block.size, frame, first)
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
class Advance(Step):
    """So many sub-steps ahead, `chunk` of them within a spacing, in a block around where they lead.

    If the blade has just come down, the first step lets the sand come to rest around it.
    """

    substep: float = 0.125
    sweeps: int = 4
    chunk: int = 8
    lowered: bool = False
    rest: Rest = bring_to_rest

    def arrived(self, way: Way, k: jax.Array, _: Any) -> jax.Array:
        gone = (k - int(self.lowered)).astype(way.length.dtype) * (self.chunk * self.substep)
        return (k >= int(self.lowered)) & jnp.all(gone >= way.length)

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
            middle = (jnp.maximum(j - int(self.lowered), 0).astype(way.length.dtype) + 0.5) * (self.chunk * self.substep)
            pose = pose_ahead(frame, jnp.minimum(middle, way.length))
            begins.append(corner(frame, self.block.size, pose.x, pose.y))
        old, new = begins
        return new, (new[0] - old[0], new[1] - old[1])

    def felt(
        self, way: Way, k: jax.Array, first: tuple[jax.Array, jax.Array], view: View, h: jax.Array
    ) -> tuple[jax.Array, jax.Array]:
        """The share of each cell that the blade covers at any time in step k, and the rate at which sand flows then."""
        along, across = coordinates(self.block.size, frame_of(self.block.shape, way.start), first)
        gone = jnp.maximum(k - int(self.lowered), 0).astype(way.length.dtype)
        begin = jnp.minimum(gone * (self.chunk * self.substep), way.length)
        ahead = jnp.where(k >= int(self.lowered), jnp.minimum(way.length - begin, self.chunk * self.substep), 0)
        beside = blade.share(across, -way.side, way.side)
        cover = inner(blade.straight(along - begin, beside, way.half, ahead).swept)
        return cover, way.rate * contact(way, view, cover, h)

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
        pose, (along, across) = frame.pose, coordinates(self.block.size, frame, first)
        side = spread(way.side, across)
        beside = lax.optimization_barrier(blade.share(across, -side, side))
        moving = k >= int(self.lowered)
        begin = jnp.where(moving, (k - int(self.lowered)) * self.chunk + i, 0).astype(way.length.dtype) * self.substep
        begin = jnp.minimum(begin, way.length)
        ahead = jnp.where(moving, jnp.minimum(way.length - begin, self.substep), 0)
        part = jnp.where(moving, ahead / self.substep, 1)
        half, further = spread(way.half, along), spread(ahead, along)
        reach = blade.straight(along - spread(begin, along), beside, half, further)
        taken = jnp.where(ahead > 0, blade.cleared(reach, h, spread(way.bottom / way.quantum, h)), 0)
        room = view.holds if view.beyond is None else view.holds + view.beyond
        shares = blade.onward(spread(pose.cos, h), spread(pose.sin, h), room)
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
    """Step k of `Advance` in its block alone, as a function of all that it depends on; nothing drains, and one angle."""

    def __init__(self, advance: Advance, way: Way, k: jax.Array, record: tuple[jax.Array, jax.Array, Fluxes]) -> None:
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
