"""What a wheel does to the sand in a block around it: it clears what it newly covers, and parts what it stands between.

A wheel is a rim over each cell, at a height b of its own (tools.py), with room below where it hangs above the sand. Where it
covers the share a of a cell, the cell's sand above b lies in the open share 1 - a. What comes to lie above the rim as the
wheel moves leaves it along the normal of the face that displaces it, the rim or the flank that leads; off the rim also
towards the nearer flank. Sand under the wheel is handed on, cell by cell, until there is room beside it or below the rim.
Grousers take some of what is displaced to behind the wheel.

The wheel is a wall as far as sand touches it. Sand that lies lower than the rim is as free as if there were no wheel; within
a quarter of a spacing below it the wheel begins to be felt. The planes through the axle and across it, as wide as the wheel,
cut every link whose ends lie on their two sides, as far as both ends touch: where one does not, sand passes under the rim.
"""

from dataclasses import dataclass, replace

import jax
import jax.numpy as jnp
from jax import lax

from jaxsand.interaction import _blade as blade
from jaxsand.interaction._block import Block, First, View, Way
from jaxsand.interaction._frame import Frame
from jaxsand.interaction.resting import Sand
from jaxsand.interaction.stencil import both_ends, inner, outer, seen, spread
from jaxsand.relaxation.flux import NARROW, Fluxes
from jaxsand.relaxation.ghost_cells import at, truncate
from jaxsand.scene.grid import Neighbours

_TOUCH = 0.25  # of a spacing below the rim, sand does not feel it
_PASSES = 4  # how many cells sand under the wheel moves on in a sub-step
_SLIVER = 0.002  # in an open share below this sand stands no higher than it would in this one
_ASIDE = 0.5  # how far to its side sand leaves the rim at its edges, to a unit ahead
_LEAST = 1e-4
_FOUR = ((0, 1), (0, -1), (1, 0), (-1, 0))
Shares = tuple[jax.Array, ...]  # of the four straight neighbours, in a halo


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Track:
    """A leg of a wheel: the way of its lowest point, as that of a blade as thick as the wheel's chord at level sand; its
    radius (spacings); its slip angle; and what its grousers carry to a spacing of the way (m, as the height of a cell), None
    for a smooth rim."""

    way: Way
    radius: jax.Array
    slip: jax.Array
    carried: jax.Array | None

    def seen(self, frame: Frame) -> jax.Array:
        """The slip angle in a frame, which may mirror the map."""
        return jnp.where(frame.flip_x ^ frame.flip_y ^ frame.swap, -self.slip, self.slip)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Stand:
    """A wheel in a block, [m, m]: how far along its plane and along its axle cells lie (spacings), the share of each that it
    covers along either, and the rim's height (quanta)."""

    along: jax.Array
    aside: jax.Array
    lengthwise: jax.Array
    crosswise: jax.Array
    rim: jax.Array

    @property
    def cover(self) -> jax.Array:
        return self.lengthwise * self.crosswise


def stand(block: Block, track: Track, frame: Frame, first: First) -> Stand:
    """The wheel at the frame's pose: its rim stands r - sqrt(r^2 - a^2) above its lowest point at the distance a from the
    axle; coverage as for a blade."""
    s, n = (inner(x) for x in block.coordinates(frame, first))
    way, slip = track.way, spread(track.seen(frame), s)
    cos, sin = jnp.cos(slip), jnp.sin(slip)
    a, c = s * cos - n * sin, s * sin + n * cos
    r, side = spread(track.radius, s), spread(way.side, s)
    square = jnp.where(jnp.abs(a) < 0.999 * r, r * r - a * a, 0.002 * r * r)
    rim = (r - jnp.sqrt(square)) * spread(way.spacing / way.quantum, s) + spread(way.bottom / way.quantum, s)
    return lax.optimization_barrier(Stand(a, c, blade.share(a, -r, r), blade.share(c, -side, side), rim))


def cleared(track: Track, old: Stand, new: Stand, h: jax.Array) -> jax.Array:
    """The sand that has to leave the cells of a block as the wheel moves, in whole quanta.

    Sand above the rim stood beside the wheel, in the open share of its cell, of which the wheel now sweeps a part. What is
    still inside of the wheel leaves as well, in cells that it all but fills and which nothing flows into.
    """
    r, side = spread(track.radius, h), spread(track.way.side, h)
    swept = _swept(old.along, new.along, r) * _swept(old.aside, new.aside, side)
    above = jnp.maximum(h - jnp.maximum(old.rim, new.rim), 0)
    below = jnp.maximum(jnp.minimum(h, old.rim) - new.rim, 0)
    part = jnp.maximum(swept - old.cover, 0) / jnp.maximum(1 - old.cover, NARROW)
    inside = jnp.clip(1 - (1 - swept) / NARROW, 0, 1)
    return truncate(new.cover * below + jnp.clip(jnp.maximum(part, inside), 0, 1) * above)


def _swept(old: jax.Array, new: jax.Array, half: jax.Array) -> jax.Array:
    """The share of a cell that an interval of half the length `half` covers at any time on its way."""
    near, far = jnp.minimum(old, new), jnp.maximum(old, new)
    return jnp.clip(far + half + 0.5, 0, 1) - jnp.clip(near - half + 0.5, 0, 1)


def leaving(track: Track, frame: Frame, wheel: Stand) -> Shares:
    """The shares for the directions in which sand leaves the rim and, within two spacings of it, the leading flank.

    In the wheel's plane and along its axle, u from -1 at one flank to 1 at the other, beta the slip angle: off the rim
    (1, u / 2), off the flank (0, 1); where a face hardly leads, below 30 degrees of the wheel's way, turned to that.
    """
    slip = track.seen(frame)
    cos, sin = jnp.cos(slip), jnp.sin(slip)
    hardly = [1 - jnp.clip(2 * x, 0, 1) for x in (cos, jnp.abs(sin))]
    leads = jnp.clip(wheel.aside * jnp.sign(slip) - track.way.side + 2.5, 0, 1)
    aside = jnp.clip(wheel.aside / track.way.side, -1, 1) * (_ASIDE * cos) + sin * hardly[0]
    a, c = cos + leads * (cos * hardly[1] - cos), aside + leads * (sin - aside)
    p, q = _on_the_map(track, frame, a, c)
    return _shares(p, q, jnp.ones_like(p))


def turning(track: Track, frame: Frame, wheel: Stand, way: jax.Array) -> Shares:
    """The shares for a turn in place, counter-clockwise where `way` is 1: along the axle, to where the wheel moves."""
    forward = jnp.clip(wheel.along, -1, 1) * way
    p, q = _on_the_map(track, frame, jnp.zeros_like(forward), forward)
    return _shares(p, q, jnp.abs(forward))


def radial(track: Track, frame: Frame, wheel: Stand) -> Shares:
    """The shares for directions away from the wheel's centre, in the proportions of its chord and width; shorter within a
    cell of that."""
    along, across = wheel.along / track.way.half**2, wheel.aside / track.way.side**2
    p, q = _on_the_map(track, frame, along, across)
    far = jnp.maximum(jnp.abs(wheel.along), jnp.abs(wheel.aside))
    return _shares(p, q, jnp.minimum(far, 1))


def _shares(p: jax.Array, q: jax.Array, size: jax.Array) -> Shares:
    """The shares for directions across and up the frame, as |p| to |q|; of a `size` below 1 the rest goes all ways alike."""
    length = jnp.abs(p) + jnp.abs(q)
    scale = size / jnp.where(length > 0, length, 1)
    p, q = p * scale, q * scale
    rest = (1 - jnp.abs(p) - jnp.abs(q)) / 4
    parts = (jnp.maximum(p, 0), jnp.maximum(-p, 0), jnp.maximum(q, 0), jnp.maximum(-q, 0))
    return lax.optimization_barrier(tuple(outer(part + rest) for part in parts))


def _on_the_map(track: Track, frame: Frame, a: jax.Array, c: jax.Array) -> tuple[jax.Array, jax.Array]:
    """A direction in the wheel's plane and along its axle, as one across and up the frame."""
    slip = track.seen(frame)
    s, n = a * jnp.cos(slip) + c * jnp.sin(slip), c * jnp.cos(slip) - a * jnp.sin(slip)
    return s * frame.pose.cos - n * frame.pose.sin, s * frame.pose.sin + n * frame.pose.cos


def handed_on(
    block: Block,
    track: Track,
    view: View,
    shares: Shares,
    wheel: Stand,
    state: tuple[jax.Array, jax.Array | None, jax.Array],
) -> tuple[jax.Array, jax.Array | None, jax.Array]:
    """Heights, what was lost, and what is carried (quanta), handed on by one cell: it comes to rest in the open share of
    cells and where there is room below the rim."""
    h, gone, carried = state
    over = block.over(_under(track.way, wheel), view, h + carried)
    kept, got, around = carried, jnp.zeros_like(h), outer(carried)
    for (di, dj), part in zip(_FOUR, shares, strict=True):
        here = inner(part)
        kept = kept - truncate(here * carried) * at(view.holds, di, dj)
        got = got + truncate(seen(part, -di, -dj) * seen(around, -di, -dj))
        if over is not None and gone is not None:
            lost = truncate(here * (over[1] * carried)) * at(over[0], di, dj)
            kept, gone = kept - lost, gone + lost
    got = got * at(view.holds)
    below = jnp.minimum(got, jnp.maximum(wheel.rim - h, 0))
    rest = truncate((1 - wheel.cover) * got + wheel.cover * below)
    return lax.optimization_barrier((h + rest + kept, gone, got - rest))


def displaced(
    block: Block, track: Track, view: View, shares: Shares, wheel: Stand, h: jax.Array, taken: jax.Array
) -> tuple[jax.Array, jax.Array | None]:
    """The heights (quanta) once what was taken up was handed on by some cells, and what was lost; what is still on its way
    waits where it is."""
    gone = None if view.beyond is None else jnp.zeros_like(h)

    def once(
        _: jax.Array, state: tuple[jax.Array, jax.Array | None, jax.Array]
    ) -> tuple[jax.Array, jax.Array | None, jax.Array]:
        return handed_on(block, track, view, shares, wheel, state)

    h, gone, carried = lax.fori_loop(0, _PASSES, once, (h, gone, taken))
    return h + carried, gone


def around(block: Block, track: Track, view: View, wheel: Stand, h: jax.Array) -> tuple[Sand, jax.Array]:
    """The sand around the wheel, and how much the wheel is among it, 0 to 1."""
    way = track.way
    touch = _touch(track, wheel, h)
    free, gates = _gates(block.neighbours, wheel, touch, view.holds)
    stretch = lax.optimization_barrier((1 - free) / jnp.maximum(free, _SLIVER))
    level = None if way.level is None else way.level / way.quantum
    sand = Sand(gates, free, stretch, wheel.rim, view.drop, view.sides, level, block.neighbours)
    return sand, block.contact(_under(way, wheel), view, wheel.cover, h)


def _touch(track: Track, wheel: Stand, h: jax.Array) -> jax.Array:
    reach = spread(_TOUCH * track.way.spacing / track.way.quantum, h)
    return jnp.clip(1 + jnp.maximum(h - wheel.rim, -reach) / reach, 0, 1)


def _under(way: Way, wheel: Stand) -> Way:
    """The way of a tool whose bottom is the rim."""
    return replace(way, bottom=wheel.rim * way.quantum)


def _gates(neighbours: Neighbours, wheel: Stand, touch: jax.Array, holds: jax.Array) -> tuple[jax.Array, Fluxes]:
    """The open share of each cell, and how open each link is; `holds` is 1 where a cell can hold sand, in a halo.

    A link is as open as the narrower of its cells, times 2 / (1 + narrower / wider), and no more than the wheel's two planes
    leave of it where they cut it.
    """
    free = (1 - jnp.minimum(wheel.cover / (1 - NARROW), 1) * touch) * at(holds)
    walls = [
        (wheel.aside, wheel.lengthwise * touch),  # across which the flanks part sand
        (wheel.along, wheel.crosswise * touch),  # and the rim
    ]
    planes = [
        zip(both_ends(neighbours, outer(lax.stop_gradient(way))), both_ends(neighbours, outer(wall)), strict=True)
        for way, wall in walls
    ]
    out = []
    for (here, there), *cuts in zip(both_ends(neighbours, outer(free)), *planes, strict=True):
        low, high = jnp.minimum(here, there), jnp.maximum(here, there)
        narrow = low
        for (behind, before), (one, other) in cuts:
            narrow = jnp.where(behind * before < 0, jnp.minimum(narrow, 1 - jnp.minimum(one, other)), narrow)
        out.append(narrow * (2 * high / jnp.maximum(low + high, _LEAST)))
    return free, lax.optimization_barrier(tuple(out))


def carried_back(
    block: Block,
    track: Track,
    frame: Frame,
    first: First,
    view: View,
    ahead: jax.Array,
    h: jax.Array,
    taken: jax.Array,
) -> tuple[jax.Array, jax.Array]:
    """Grousers leave a part of what is taken up in the cut behind the wheel, over a quarter of its chord's length."""
    if track.carried is None:
        return h, taken
    slip, side = jnp.abs(track.slip), track.way.side
    s, n = (inner(x) for x in block.coordinates(frame, first))
    end = -track.way.half * jnp.cos(slip) - side * jnp.sin(slip)
    half = side * jnp.cos(slip) + track.way.half * jnp.sin(slip) / 2
    behind = blade.share(s, end - jnp.maximum(track.way.half / 2, 1), end) * blade.share(n, -half, half) * at(view.holds)
    room, total = jnp.sum(behind, axis=(0, 1)), jnp.sum(taken, axis=(0, 1))
    asked = track.carried * ahead / track.way.quantum
    part = jnp.where(room > 0, jnp.minimum(asked / jnp.where(total > 0, total, 1), 1), 0)
    back = truncate(taken * part)
    put = truncate(jnp.sum(back, axis=(0, 1)) * behind / jnp.where(room > 0, room, 1))
    return h + put + _left_over(back, put), taken - back


def _left_over(taken: jax.Array, put: jax.Array) -> jax.Array:
    """What rounding left of `taken` once `put` was put down (quanta), on the highest cell of that."""
    # The counts fit their integers or wrap around; their sum is right, since what is left over is small.
    whole = jnp.round(lax.stop_gradient(taken - put)).astype(jnp.int64 if put.dtype == jnp.float64 else jnp.int32)
    cells = put.reshape(-1, *put.shape[2:])
    number = jnp.arange(cells.shape[0]).reshape(-1, *(1,) * (cells.ndim - 1))
    here = number == jnp.argmax(cells, axis=0)
    return jnp.where(here, jnp.sum(whole, axis=(0, 1)).astype(put.dtype), 0).reshape(put.shape)
