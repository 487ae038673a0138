"""Lowers a blade: the sand that it covers is displaced radially."""

from dataclasses import dataclass
from typing import TypeAlias

import jax
import jax.numpy as jnp

from jaxsand.autodiff.while_loop import Plain, repeat_until
from jaxsand.interaction import _blade as blade
from jaxsand.interaction._advance import LegStep
from jaxsand.interaction._block import Moving, Way, normal_of
from jaxsand.interaction._displacement import Carried, none_carried
from jaxsand.interaction._frame import frame_of
from jaxsand.interaction.stencil import inner
from jaxsand.relaxation.ghost_cells import at, truncate

Params: TypeAlias = tuple[blade.Shares, jax.Array, jax.Array, tuple[jax.Array, jax.Array] | None]


@dataclass(frozen=True)
class Lower(LegStep[Way]):
    """The step in which the blade comes down: the sand that it covers moves outwards, cell by cell, until it has left."""

    tape: int = 1

    def __call__(self, way: Way, k: jax.Array, sand: Moving) -> Moving:
        frame = frame_of(self.block.shape, normal_of(way, way.start))
        pose, first = frame.pose, self.block.corner(frame.pose.x, frame.pose.y)
        view, whole = self.block.view(way, frame, first, sand.height)
        holds, old = self.block.part(view.holds), self.block.part(whole)
        along, across = self.block.coordinates(frame, first)
        beside = blade.share(across, -way.side, way.side)
        reach = blade.straight(along, beside, way.half, jnp.zeros_like(way.length))
        if way.plates is not None:
            reach = blade.boxed(reach, across, way.half, way.side, way.plates, jnp.zeros_like(way.length))
        cover = inner(reach.after)
        along, across = inner(along), inner(across)
        bottom = self.block.above(view, way.bottom / way.quantum)
        taken = truncate(cover * jnp.maximum(old - bottom, 0)) * at(holds)
        half, side = jnp.maximum(way.half, blade.LEAST_SIZE), jnp.maximum(way.side, blade.LEAST_SIZE)
        s, n = along / (4 * half**2), across / (4 * side**2)
        p, q = s * pose.cos - n * pose.sin, s * pose.sin + n * pose.cos
        size = jnp.maximum(jnp.abs(p), jnp.abs(q))
        x, y = along * pose.cos - across * pose.sin, along * pose.sin + across * pose.cos
        scale = jnp.minimum(jnp.maximum(jnp.abs(x), jnp.abs(y)), 1) / jnp.where(size > 0, size, 1)
        scale = jnp.where(size > 0, scale, 0)
        shares = blade.any_way(p * scale, q * scale)
        over = self.block.over(way, view, old)
        gone = None if over is None else jnp.zeros_like(old)
        params = (shares, holds, cover, over)
        into, scooped = blade.scooped(way.room, sand.scooped, taken)
        state = Carried(old - taken, gone, taken - into)
        state, _ = repeat_until(none_carried, Plain(_spread, 16), 2 * self.block.near, params, state)
        gone, new = state.lost, self.block.put(whole, state.height + state.carried)
        edge = jnp.maximum(sand.edge, self.block.touched(way, frame, first, whole, new, cover))
        lost = self.block.lose(way, view, sand.lost, None if gone is None else self.block.put(jnp.zeros_like(whole), gone))
        return Moving(self.block.back(way, view, sand.height, new), lost, sand.flux, edge, scooped)


def _spread(params: Params, k: jax.Array, state: Carried) -> Carried:
    """Moves the carried sand by one cell: it stays in the open share of cells, and is carried on in the covered share."""
    shares, holds, cover, over = params
    free = None if over is None else (over[0], over[1] * state.carried)
    kept, got, lost = blade.handed_on(shares, holds, state.carried, free)
    rest = truncate((1 - cover) * got)
    h = state.height + rest + kept
    return Carried(h, None if state.lost is None or lost is None else state.lost + lost, got - rest)
