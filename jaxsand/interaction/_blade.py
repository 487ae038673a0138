"""What a blade does to the sand in a block around it: it clears what it newly covers, and keeps what is ahead of it there.

A blade stands in the sand as a prism over its footprint, from its bottom up. Where it covers the share a of a cell, that
cell's sand above the bottom lies in the open share 1 - a. Whenever a grows to b, the share (b - a) / (1 - a) of that sand
has to leave. It goes one cell on along the face's normal, to the one or two of the eight neighbours that lie there, shared
as the normal divides the angle between them; where no cell is there (a wall, a closed edge, a rim above the sand) it stays
in its column, inside the blade, and flows off when the blade has gone.

A blade is a wall. Its middle plane, as wide as it is, cuts every link whose ends lie on its two sides; a cell through whose
centre the plane passes is covered to the plane's own share, since a blade is at least a cell thick. So no link between front
and rear is ever open, and how open the others are is continuous in the pose.
"""

from dataclasses import dataclass

import jax
import jax.numpy as jnp
from jax import lax

from jaxsand.interaction._displacement import EIGHT, shares
from jaxsand.interaction.stencil import both_ends, inner, outer, seen
from jaxsand.relaxation.flux import Fluxes
from jaxsand.relaxation.ghost_cells import at, truncate
from jaxsand.scene.grid import Neighbours

_LEAST = 1e-4
SLIVER = 0.02  # in an open share below this sand stands no higher than it would in this one
_LEAVES = 0.125  # spacings: sand inside of the blade has left once it has moved so far
Shares = dict[tuple[int, int], jax.Array]


@dataclass(frozen=True)
class Reach:
    """Which share of each cell a blade covers before and after it moves, and at any time on the way; the share of each
    that lies between its ends, `beside`; and `along`, how far ahead of its middle plane the cell is afterwards. All in a
    block's halo, and so is how far it moves, `gone` (spacings)."""

    before: jax.Array
    swept: jax.Array
    after: jax.Array
    beside: jax.Array
    along: jax.Array
    gone: jax.Array


def share(s: jax.Array, start: jax.Array, stop: jax.Array) -> jax.Array:
    """The share of [s - 1/2, s + 1/2] that lies in [start, stop]."""
    return _to(s - start) - _to(s - stop)


def _to(s: jax.Array) -> jax.Array:
    return jnp.clip(s + 0.5, 0, 1)


def straight(along: jax.Array, beside: jax.Array, half: jax.Array, ahead: jax.Array) -> Reach:
    """A blade of half the thickness `half` (spacings) that moves ahead.

    What it covers is the product of two intervals, along and across, each smoothed over one spacing: exact for headings
    along the grid, a first-order approximation otherwise; continuous and piecewise linear.
    """
    rear, front, front_after = _to(along + half), _to(along - half), _to(along - half - ahead)
    after = _to(along + half - ahead) - front_after
    gone = jnp.broadcast_to(ahead, along.shape)
    return Reach(beside * (rear - front), beside * (rear - front_after), beside * after, beside, along - ahead, gone)


def turned(
    old: tuple[jax.Array, jax.Array], new: tuple[jax.Array, jax.Array], half: jax.Array, side: jax.Array, angle: jax.Array
) -> Reach:
    """A blade that turns in place by a small `angle`, from coordinates (along, across) `old` of the cells to `new`."""
    ahead, way = jnp.abs(old[1] * angle), facing(old[1], angle)
    beside, beside_after = share(old[1], -side, side), share(new[1], -side, side)
    after = beside_after * share(new[0], -half, half)
    swept = jnp.maximum(beside * share(way * old[0], -half, half + ahead), after)
    return Reach(beside * share(old[0], -half, half), swept, after, beside_after, new[0], ahead)


def facing(across: jax.Array, angle: jax.Array) -> jax.Array:
    """To which side a cell beside the centre is pushed by a turn: 1 ahead, -1 back."""
    return jnp.where(across * angle > 0, -1.0, 1.0).astype(across.dtype)


def cleared(reach: Reach, h: jax.Array, bottom: jax.Array) -> jax.Array:
    """The sand that has to leave the cells of a block, in whole quanta; ahead of the middle plane also what is still inside
    of the blade, in cells that it all but fills, at a pace that does not depend on the number of sub-steps: sand flows into
    a sliver again, so that emptying it at once at each of them would pump."""
    before, swept, along = inner(reach.before), inner(reach.swept), inner(reach.along)
    grown = swept > before
    part = jnp.where(grown, (swept - before) / jnp.where(grown, 1 - before, 1), 0)
    inside = jnp.where(along > 0, jnp.clip(1 - (1 - swept) / SLIVER, 0, 1), 0)
    inside = inside * jnp.minimum(inner(reach.gone) / _LEAVES, 1)
    return truncate(jnp.maximum(part, inside) * jnp.maximum(h - bottom, 0))


def gates(neighbours: Neighbours, reach: Reach, holds: jax.Array) -> tuple[jax.Array, Fluxes]:
    """The open share of each cell, and how open each link is, with the blade where it stands in the end; `holds` is 1 where
    a cell can hold sand, in a halo.

    A link is as open as the narrower of its cells, times 2 / (1 + narrower / wider), and no more than the blade's middle
    plane leaves of it where that cuts it.
    """
    # In a halo of its own the cover is stored, lest XLA compute it anew for both ends of every link.
    free = (1 - outer(inner(reach.after))) * holds
    out = []
    of_links = (both_ends(neighbours, x) for x in (free, lax.stop_gradient(reach.along), reach.beside))
    for (here, there), (behind, before), beside in zip(*of_links, strict=True):
        low, high = jnp.minimum(here, there), jnp.maximum(here, there)
        cut = jnp.minimum(*beside)
        narrow = jnp.where(behind * before < 0, jnp.minimum(low, 1 - cut), low)
        out.append(narrow * (2 * high / jnp.maximum(low + high, _LEAST)))
    return free, lax.optimization_barrier(tuple(out))


def onward(cos: jax.Array, sin: jax.Array, room: jax.Array) -> Shares:
    """The shares of neighbours for a direction in the first octant, cos and sin of [m, m]: across, and across and up.

    `room` is 1 in a halo where sand can go. Where one of the two has none the other takes all; where neither has, sand
    slides up along what is in its way, the more the more the direction leads there.
    """
    ahead, aslant = (cos - sin) / cos, sin / cos
    here, there, up = at(room, 0, 1), at(room, 1, 1), at(room, 1, 0)
    both = ahead * here + aslant * there
    free = both > 0
    full = jnp.where(free, both, 1)
    return {
        (0, 1): jnp.where(free, ahead * here / full, 0),
        (1, 1): jnp.where(free, aslant * there / full, 0),
        (1, 0): jnp.where(free, 0, aslant * up),
    }


def any_way(p: jax.Array, q: jax.Array) -> Shares:
    """The shares of the eight neighbours for directions (p across, q up) of largest component 1 or less; see `shares`."""
    return dict(zip(EIGHT, shares(p, q), strict=True))


def handed_on(
    parts: Shares, holds: jax.Array, carried: jax.Array, over: tuple[jax.Array, jax.Array] | None
) -> tuple[jax.Array, jax.Array, jax.Array | None]:
    """What stays of `carried` quanta, what cells receive, and what is lost over a rim.

    `holds` is 1 where a cell can take some, in a halo. `over` tells where in the halo there is nothing but a rim, and how
    much of what is carried may pass over that; the rest stays.
    """
    kept, got, lost = carried, jnp.zeros_like(carried), None if over is None else jnp.zeros_like(carried)
    source = outer(carried)
    for (di, dj), part in parts.items():
        given = truncate(outer(part) * source)
        kept = kept - inner(given) * at(holds, di, dj)
        got = got + seen(given, -di, -dj)
        if over is not None and lost is not None:
            gone = truncate(part * over[1]) * at(over[0], di, dj)
            kept, lost = kept - gone, lost + gone
    return kept, got * at(holds), lost
