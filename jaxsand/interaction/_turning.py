"""Turns a blade in place, by sub-steps of an angle: the sand that it sweeps is displaced along its faces' normals."""

import math
from dataclasses import dataclass, replace

import jax
import jax.numpy as jnp

from jaxsand.interaction import _blade as blade
from jaxsand.interaction._advance import LegStep, Rest
from jaxsand.interaction._block import Moving, Way, normal_of, rotated
from jaxsand.interaction._frame import Frame
from jaxsand.interaction.resting import bring_to_rest
from jaxsand.interaction.stencil import inner
from jaxsand.relaxation.ghost_cells import at


@dataclass(frozen=True)
class BladeTurn(LegStep[Way]):
    """A sub-step of a turn in place, which moves the blade's corners by `substep` spacings."""

    substep: float = 0.125
    sweeps: int = 4
    rest: Rest = bring_to_rest

    def done(self, way: Way, k: jax.Array, _: Moving) -> jax.Array:
        """Whether the turn is complete before step k."""
        return jnp.all(k.astype(way.angle.dtype) * self._part(way) >= jnp.abs(way.angle))

    def _part(self, way: Way) -> jax.Array:
        """The angle of a sub-step (rad)."""
        far = jnp.minimum(jnp.hypot(way.half, way.side), math.hypot(*self.block.shape))
        return self.substep / far

    def __call__(self, way: Way, k: jax.Array, sand: Moving) -> Moving:
        whole = self._part(way)
        begin = k.astype(whole.dtype) * whole
        ahead = jnp.clip(jnp.abs(way.angle) - begin, 0, whole)
        part = ahead / whole
        sign = jnp.where(way.angle < 0, -1.0, 1.0).astype(begin.dtype)
        no = jnp.zeros((), bool)
        start = normal_of(way, way.start)
        frame = Frame(rotated(start, sign * begin), no, no, no, self.block.shape)
        after = replace(frame, pose=rotated(start, sign * (begin + ahead)))
        pose, first = frame.pose, self.block.corner(frame.pose.x, frame.pose.y)
        view, old = self.block.view(way, frame, first, sand.height)
        now, then = self.block.coordinates(frame, first), self.block.coordinates(after, first)
        reach = blade.turned(now, then, way.half, way.side, sign * ahead)
        among = self.block.contact(way, view, inner(reach.swept), old)
        bottom = self.block.above(view, way.bottom / way.quantum)
        taken = jnp.where(ahead > 0, blade.cleared(reach, self.block.part(old), bottom), 0)
        face = blade.facing(at(now[1]), sign * ahead) / jnp.maximum(jnp.abs(pose.cos), jnp.abs(pose.sin))
        h, lost = self.block.displaced(way, view, blade.any_way(face * pose.cos, face * pose.sin), old, taken)
        near = self.block.beside(view, reach)
        beside = self.block.sand(replace(way, bottom=bottom * way.quantum), view, self.block.clear(view), near)
        guess = self.block.guess(near.gates, part, sand.flux)
        new, flux = self.rest(beside, way.rate * among * part, self.sweeps, h, guess)
        gone = None if lost is None else lost + flux[-1]
        flux = self.kept(part, flux, sand.flux)
        edge = jnp.maximum(sand.edge, self.block.touched(way, frame, first, old, new, at(reach.swept)))
        account = self.block.lose(way, view, sand.lost, gone)
        return Moving(self.block.back(way, view, sand.height, new), account, flux, edge, sand.scooped)
