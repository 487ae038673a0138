"""A wheel in a block of sand: displacement from the cells that it newly covers, and links that it closes.

Over each cell the wheel's rim stands at a height b of its own (`rim`); sand can lie below it. Where the wheel covers the
share a of a cell, the cell's sand above b lies in the open share 1 - a. Sand that comes to lie above the rim as the wheel
moves is displaced along the normal of the face that moves it, the rim or the leading flank; sand off the rim also moves
towards the nearer flank. Sand under the wheel moves on, cell by cell, until there is room beside the wheel or below the rim.
Grousers carry some of it to behind the wheel.

The wheel also closes links where sand touches it. It has no effect on sand more than a quarter of a spacing below the rim.
Two planes, along and across the axle, as wide as the wheel, cut every link whose ends lie on their two sides, as far as sand
touches the wheel at both ends. Where it does not, sand passes under the rim.
"""

from dataclasses import dataclass, replace

import jax
import jax.numpy as jnp
from jax import lax

from jaxsand.interaction import _blade as blade
from jaxsand.interaction._block import Block, First, View, Way
from jaxsand.interaction._displacement import Carried
from jaxsand.interaction._frame import Frame
from jaxsand.interaction.resting import Sand
from jaxsand.interaction.stencil import inner, outer, seen, spread
from jaxsand.relaxation.flux import NARROW, Fluxes
from jaxsand.relaxation.ghost_cells import at, truncate
from jaxsand.scene.grid import Neighbours

_TOUCH = 0.25  # spacings below the rim at which the wheel begins to touch sand
_PASSES = 4  # cells by which sand under the wheel moves on in a sub-step
_SLIVER = 0.002  # the smallest open share that is divided by: in a narrower one sand stands as high as in this
_ASIDE = 0.5  # sideways part of the displacement at the rim's two edges, over the part ahead
_FOUR = ((0, 1), (0, -1), (1, 0), (-1, 0))
Shares = tuple[jax.Array, ...]  # of the four straight neighbours, with ghost cells


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Track:
    """A leg of a wheel.

    Attributes:
        way: the leg of a blade as thick as the wheel's chord at level sand, with its bottom at the wheel's lowest point.
        radius: the wheel's radius (spacings).
        slip: the wheel's slip angle (rad).
        carried: what grousers carry for each spacing of the leg (m, as the height of one cell), or None without grousers.
    """

    way: Way
    radius: jax.Array
    slip: jax.Array
    carried: jax.Array | None

    def at(self, by: jax.Array) -> "Track":
        """The leg as it is when the wheel has moved by a length (spacings)."""
        level = self.way.rise is None and self.way.relief is None
        return self if level else replace(self, way=self.way.at(by))

    @property
    def length(self) -> jax.Array:
        """Length of the leg (spacings)."""
        return self.way.length

    @property
    def angle(self) -> jax.Array:
        """Angle by which the wheel turns in place before the leg (rad)."""
        return self.way.angle

    def seen(self, frame: Frame) -> jax.Array:
        """The slip angle in a frame, where a mirror changes its sign."""
        return frame.mirrors(self.slip)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Placed:
    """A wheel in a block, maps [m, m].

    Attributes:
        along, aside: distance of each cell from the wheel's centre along its plane and along its axle (spacings).
        lengthwise, crosswise: share of each cell that the wheel covers in these two directions.
        rim: height of the rim (quanta).
    """

    along: jax.Array
    aside: jax.Array
    lengthwise: jax.Array
    crosswise: jax.Array
    rim: jax.Array

    @property
    def cover(self) -> jax.Array:
        """The footprint: the share of each cell that the wheel covers."""
        return self.lengthwise * self.crosswise


def placed(block: Block, track: Track, frame: Frame, first: First, view: View) -> Placed:
    """The wheel at the frame's pose, with its rim no lower than the floor under the sand.

    At the distance a from the axle its rim stands r - sqrt(r^2 - a^2) above its lowest point. The footprint is smoothed like
    a blade's.
    """
    s, n = (inner(x) for x in block.coordinates(frame, first))
    way, slip = track.way, spread(track.seen(frame), s)
    cos, sin = jnp.cos(slip), jnp.sin(slip)
    a, c = s * cos - n * sin, s * sin + n * cos
    r, side = spread(track.radius, s), spread(way.side, s)
    square = jnp.where(jnp.abs(a) < 0.999 * r, r * r - a * a, 0.002 * r * r)
    rim = (r - jnp.sqrt(square)) * spread(way.spacing / way.quantum, s) + spread(way.bottom / way.quantum, s)
    rim = block.above(view, rim)
    return lax.optimization_barrier(Placed(a, c, blade.share(a, -r, r), blade.share(c, -side, side), rim))


def cleared(track: Track, old: Placed, new: Placed, h: jax.Array) -> jax.Array:
    """The sand that has to leave the cells of a block as the wheel moves from `old` to `new`, in whole quanta.

    Sand above the rim stood in the open share of its cell, a part of which the wheel now sweeps. Sand that is still inside
    the wheel leaves as well, from cells that the wheel almost fills.
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


def leaving(track: Track, frame: Frame, wheel: Placed) -> Shares:
    """The shares of the four neighbours for displacement by a wheel that moves ahead.

    As components (along the wheel's plane, along its axle), with u from -1 at one flank to 1 at the other, sand leaves the
    rim along (1, u / 2), and within two spacings of the leading flank along (0, 1). Where a face is within 30 degrees of
    the direction of travel, sand is turned towards that direction.
    """
    slip = track.seen(frame)
    cos, sin = jnp.cos(slip), jnp.sin(slip)
    hardly = [1 - jnp.clip(2 * x, 0, 1) for x in (cos, jnp.abs(sin))]
    leads = jnp.clip(wheel.aside * jnp.sign(slip) - track.way.side + 2.5, 0, 1)
    aside = jnp.clip(wheel.aside / track.way.side, -1, 1) * (_ASIDE * cos) + sin * hardly[0]
    a, c = cos + leads * (cos * hardly[1] - cos), aside + leads * (sin - aside)
    p, q = _on_the_map(track, frame, a, c)
    return _shares(p, q, jnp.ones_like(p))


def turning(track: Track, frame: Frame, wheel: Placed, way: jax.Array) -> Shares:
    """The shares of the four neighbours for a turn in place, counter-clockwise where `way` is 1: along the axle."""
    forward = jnp.clip(wheel.along, -1, 1) * way
    p, q = _on_the_map(track, frame, jnp.zeros_like(forward), forward)
    return _shares(p, q, jnp.abs(forward))


def radial(track: Track, frame: Frame, wheel: Placed) -> Shares:
    """The shares of the four neighbours for displacement away from the wheel's centre, as the wheel is lowered.

    The direction is the gradient of (along / chord)^2 + (aside / width)^2; within a cell of the centre it has less weight.
    """
    along, across = wheel.along / track.way.half**2, wheel.aside / track.way.side**2
    p, q = _on_the_map(track, frame, along, across)
    far = jnp.maximum(jnp.abs(wheel.along), jnp.abs(wheel.aside))
    return _shares(p, q, jnp.minimum(far, 1))


def _shares(p: jax.Array, q: jax.Array, size: jax.Array) -> Shares:
    """The shares of the four neighbours for a direction (p, q) along the frame's x and y, in the proportion |p| : |q|.

    Where `size` is below 1, the rest is divided equally.
    """
    length = jnp.abs(p) + jnp.abs(q)
    scale = size / jnp.where(length > 0, length, 1)
    p, q = p * scale, q * scale
    rest = (1 - jnp.abs(p) - jnp.abs(q)) / 4
    parts = (jnp.maximum(p, 0), jnp.maximum(-p, 0), jnp.maximum(q, 0), jnp.maximum(-q, 0))
    return lax.optimization_barrier(tuple(outer(part + rest) for part in parts))


def _on_the_map(track: Track, frame: Frame, a: jax.Array, c: jax.Array) -> tuple[jax.Array, jax.Array]:
    """A direction (along the wheel's plane, along its axle) as components along the frame's x and y."""
    slip = track.seen(frame)
    s, n = a * jnp.cos(slip) + c * jnp.sin(slip), c * jnp.cos(slip) - a * jnp.sin(slip)
    return s * frame.pose.cos - n * frame.pose.sin, s * frame.pose.sin + n * frame.pose.cos


def handed_on(
    block: Block,
    track: Track,
    view: View,
    shares: Shares,
    wheel: Placed,
    state: Carried,
) -> Carried:
    """Moves the carried sand by one cell, where it stays in the open share of cells and as far as there is room below the
    rim."""
    h, gone, carried = state.height, state.lost, state.carried
    over = block.over(_under(track.way, wheel), view, h + carried)
    kept, got, there = carried, jnp.zeros_like(h), outer(carried)
    for (di, dj), part in zip(_FOUR, shares, strict=True):
        here = inner(part)
        kept = kept - truncate(here * carried) * at(view.holds, di, dj)
        got = got + truncate(seen(part, -di, -dj) * seen(there, -di, -dj))
        if over is not None and gone is not None:
            lost = truncate(here * (over[1] * carried)) * at(over[0], di, dj)
            kept, gone = kept - lost, gone + lost
    got = got * at(view.holds)
    below = jnp.minimum(got, jnp.maximum(wheel.rim - h, 0))
    rest = truncate((1 - wheel.cover) * got + wheel.cover * below)
    return lax.optimization_barrier(Carried(h + rest + kept, gone, got - rest))


def displaced(
    block: Block, track: Track, view: View, shares: Shares, wheel: Placed, h: jax.Array, taken: jax.Array
) -> tuple[jax.Array, jax.Array | None]:
    """The heights after the sand `taken` moved on by up to `_PASSES` cells, and what each cell lost over a rim (quanta).

    Sand that has found no room by then stays where it is.
    """
    gone = None if view.beyond is None else jnp.zeros_like(h)

    def once(_: jax.Array, state: Carried) -> Carried:
        return handed_on(block, track, view, shares, wheel, state)

    state = lax.fori_loop(0, _PASSES, once, Carried(h, gone, taken))
    return state.height + state.carried, state.lost


def sand_beside(block: Block, track: Track, view: View, wheel: Placed, h: jax.Array) -> tuple[Sand, jax.Array]:
    """The sand of the block around the wheel, and how much the wheel is in contact with it, 0 to 1."""
    way = track.way
    touch = _touch(track, wheel, h)
    free, gates = _gates(block.neighbours, wheel, touch, view.holds)
    stretch = lax.optimization_barrier((1 - free) / jnp.maximum(free, _SLIVER))
    level = None if way.level is None else way.level / way.quantum
    sand = Sand(gates, free, stretch, wheel.rim, view.drop, view.sides, level, block.neighbours, view.base)
    return sand, block.contact(_under(way, wheel), view, wheel.cover, h)


def _touch(track: Track, wheel: Placed, h: jax.Array) -> jax.Array:
    """How much sand touches the wheel in each cell: 1 at the rim and above, 0 from `_TOUCH` spacings below it."""
    reach = spread(_TOUCH * track.way.spacing / track.way.quantum, h)
    return jnp.clip(1 + jnp.maximum(h - wheel.rim, -reach) / reach, 0, 1)


def _under(way: Way, wheel: Placed) -> Way:
    """The leg of a tool whose bottom is the wheel's rim."""
    return replace(way, bottom=wheel.rim * way.quantum)


def _gates(neighbours: Neighbours, wheel: Placed, touch: jax.Array, holds: jax.Array) -> tuple[jax.Array, Fluxes]:
    """The open share of each cell and of each link; `holds` is 1 where a cell can hold sand, with ghost cells.

    A link is as open as the narrower of its two cells, times 2 / (1 + narrower / wider). Where one of the wheel's planes
    cuts the link, the narrower counts at most as what the plane leaves open.
    """
    free = (1 - jnp.minimum(wheel.cover / (1 - NARROW), 1) * touch) * at(holds)
    walls = [
        (wheel.aside, wheel.lengthwise * touch),  # across which the flanks part sand
        (wheel.along, wheel.crosswise * touch),  # and the rim
    ]
    planes = [(outer(way), outer(wall)) for way, wall in walls]
    return free, lax.optimization_barrier(blade.narrowed(neighbours, outer(free), planes))


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
    """The heights and the sand taken up, after grousers set a part of that down in the cut behind the wheel.

    They set it down over a quarter of the chord's length.
    """
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
    """The rounding error of the sum of `put` against that of `taken` (quanta), on the highest cell of `put`."""
    # The counts fit their integers or wrap around; their sum is right, since what is left over is small.
    whole = jnp.round(lax.stop_gradient(taken - put)).astype(jnp.int64 if put.dtype == jnp.float64 else jnp.int32)
    cells = put.reshape(-1, *put.shape[2:])
    number = jnp.arange(cells.shape[0]).reshape(-1, *(1,) * (cells.ndim - 1))
    here = number == jnp.argmax(cells, axis=0)
    return jnp.where(here, jnp.sum(whole, axis=(0, 1)).astype(put.dtype), 0).reshape(put.shape)
