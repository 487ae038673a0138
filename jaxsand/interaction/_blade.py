"""A blade in a block of sand: displacement from the cells that it newly covers, and links that it closes.

A blade stands in the sand as a prism over its footprint, from its bottom up. Where it covers the share a of a cell, the
cell's sand above the bottom lies in the open share 1 - a. Whenever a grows to b, the share (b - a) / (1 - a) of that sand
has to leave. It moves one cell on along the normal of the face, to the one or two of the eight neighbours that lie there,
divided between them by angle. Where no cell is there (a wall, a closed edge, a rim above the sand), it stays in its cell,
inside the blade, and flows off when the blade has gone.

A blade also closes links. Its middle plane, as wide as the blade, cuts every link whose ends lie on its two sides. A blade
is at least a cell thick, so that a cell through whose centre the plane passes is covered to the plane's own share. Hence no
link between front and rear is ever open, and the open shares of the others are continuous in the pose.
"""

from dataclasses import dataclass

import jax
import jax.numpy as jnp
from jax import lax

from jaxsand.interaction._displacement import EIGHT, shares
from jaxsand.interaction.stencil import both_ends, inner, outer, seen, spread, total
from jaxsand.relaxation.flux import Fluxes
from jaxsand.relaxation.ghost_cells import ExactSum, at, counted, truncate
from jaxsand.scene.grid import Neighbours

LEAST_SIZE = 2.0**-10  # spacings: a traced blade may have no width, or no thickness
_LEAST = 1e-4
SLIVER = 0.02  # the smallest open share that is divided by: in a narrower one sand stands as high as in this
_SINKS = 0.02  # the slope from which on a blade counts as sinking in full
_LEAVES = 0.125  # spacings that the blade moves until sand inside it has left
Shares = dict[tuple[int, int], jax.Array]


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Reach:
    """The footprints of a blade that moves; all are maps of a block with ghost cells.

    Attributes:
        before: share of each cell that the blade covers before it moves.
        swept: share that it covers at any time on the way.
        after: share that it covers afterwards.
        beside: share that lies between the blade's two ends, afterwards.
        along: distance of each cell from the blade's middle plane afterwards, positive ahead (spacings).
        gone: distance by which the blade moves at each cell (spacings).
        plates: of a blade with plates, how far outside the plates' middles each cell lies, afterwards (spacings), and the
            share of it that lies between the plates' two ends.
    """

    before: jax.Array
    swept: jax.Array
    after: jax.Array
    beside: jax.Array
    along: jax.Array
    gone: jax.Array
    plates: tuple[jax.Array, jax.Array] | None = None


def share(s: jax.Array, start: jax.Array, stop: jax.Array) -> jax.Array:
    """The share of [s - 1/2, s + 1/2] that lies in [start, stop]."""
    return _to(s - start) - _to(s - stop)


def _to(s: jax.Array) -> jax.Array:
    return jnp.clip(s + 0.5, 0, 1)


def straight(along: jax.Array, beside: jax.Array, half: jax.Array, ahead: jax.Array) -> Reach:
    """The footprints of a blade that moves straight ahead, by `ahead` (spacings).

    `along` is how far each cell lies ahead of the blade's middle plane before it moves, and `half` half of the blade's
    thickness (spacings); `beside` is the share of each cell that lies between the blade's two ends, by its distance across.
    A footprint is the product of two intervals, along and across, each smoothed over one spacing: exact for headings along
    the grid, a first-order approximation otherwise. It is continuous and piecewise linear.
    """
    rear, front, front_after = _to(along + half), _to(along - half), _to(along - half - ahead)
    after = _to(along + half - ahead) - front_after
    gone = jnp.broadcast_to(ahead, along.shape)
    return Reach(beside * (rear - front), beside * (rear - front_after), beside * after, beside, along - ahead, gone)


def boxed(reach: Reach, across: jax.Array, half: jax.Array, side: jax.Array, plates: jax.Array, ahead: jax.Array) -> Reach:
    """The footprints of a blade with plates at its ends, a cell thick, that reach `plates` ahead of its face (spacings).

    `reach` are the footprints of the same blade without plates, which moved straight ahead by `ahead` (spacings). `across`
    is how far each cell lies to the left of the blade's middle, `half` half of its thickness, and `side` half of its width,
    so that the plates lie from `side` to `side + 1` on both sides (all in spacings).
    """
    beside = share(across, side, side + 1) + share(across, -side - 1, -side)
    rear, front = _to(reach.along + ahead + half), _to(reach.along + ahead - half - plates)
    front_after = _to(reach.along - half - plates)
    long = _to(reach.along + half) - front_after
    return Reach(
        reach.before + beside * (rear - front),
        reach.swept + beside * (rear - front_after),
        reach.after + beside * long,
        share(across, -side - 1, side + 1),
        reach.along,
        reach.gone,
        (jnp.abs(across) - side - 0.5, long),
    )


def slanted(
    old: tuple[jax.Array, jax.Array], new: tuple[jax.Array, jax.Array], half: jax.Array, side: jax.Array, ahead: jax.Array
) -> Reach:
    """The footprints of a blade at an angle to its way, by the cells' coordinates along and across it before and after."""
    beside, beside_after = share(old[1], -side, side), share(new[1], -side, side)
    after = beside_after * share(new[0], -half, half)
    swept = jnp.maximum(beside * share(old[0], -half, half + old[0] - new[0]), after)
    return Reach(beside * share(old[0], -half, half), swept, after, beside_after, new[0], ahead)


def turned(
    old: tuple[jax.Array, jax.Array], new: tuple[jax.Array, jax.Array], half: jax.Array, side: jax.Array, angle: jax.Array
) -> Reach:
    """The footprints of a blade that turns in place by a small `angle` (rad).

    The coordinates (along, across) of the cells in the blade's frame change from `old` to `new`.
    """
    ahead, way = jnp.abs(old[1] * angle), facing(old[1], angle)
    beside, beside_after = share(old[1], -side, side), share(new[1], -side, side)
    after = beside_after * share(new[0], -half, half)
    swept = jnp.maximum(beside * share(way * old[0], -half, half + ahead), after)
    return Reach(beside * share(old[0], -half, half), swept, after, beside_after, new[0], ahead)


def facing(across: jax.Array, angle: jax.Array) -> jax.Array:
    """The side to which a turn moves the blade at a cell beside its centre: 1 ahead, -1 back."""
    return jnp.where(across * angle > 0, -1.0, 1.0).astype(across.dtype)


def cleared(reach: Reach, h: jax.Array, bottom: jax.Array, behind: jax.Array | None = None) -> jax.Array:
    """The sand that has to leave the cells of a block, in whole quanta.

    Ahead of the middle plane, sand that is still inside the blade leaves as well, from cells that the blade almost fills. It
    leaves over a fixed distance: sand flows back into such cells, and emptying them in each sub-step would pump. Behind the
    plane the share `behind` of that leaves, if any.
    """
    before, swept, along = inner(reach.before), inner(reach.swept), inner(reach.along)
    grown = swept > before
    part = jnp.where(grown, (swept - before) / jnp.where(grown, 1 - before, 1), 0)
    inside = jnp.clip(1 - (1 - swept) / SLIVER, 0, 1)
    inside = jnp.where(along > 0, inside, 0 if behind is None else behind * inside)
    inside = inside * jnp.minimum(inner(reach.gone) / _LEAVES, 1)
    return truncate(jnp.maximum(part, inside) * jnp.maximum(h - bottom, 0))


def behind_the_front(reach: Reach, half: jax.Array) -> jax.Array:
    """How far the middle of what the blade covers of each cell lies behind its front, afterwards (spacings)."""
    along = inner(reach.along)
    return half - (jnp.clip(along - 0.5, -half, half) + jnp.clip(along + 0.5, -half, half)) / 2


def cleared_beneath(reach: Reach, h: jax.Array, old: jax.Array, new: jax.Array, rise: jax.Array) -> jax.Array:
    """`cleared` for a blade whose bottom over each cell rises or sinks from `old` to `new`, at the slope `rise` of its way.

    A bottom that sinks covers sand below itself, which leaves as well. It may be several cells from the front, so sand in
    cells that the blade almost fills leaves behind the middle plane too.
    """
    beneath = truncate(inner(reach.before) * jnp.maximum(jnp.minimum(h, old) - new, 0))
    return beneath + cleared(reach, h - beneath, new, jnp.clip(-rise / _SINKS, 0, 1))


def scooped(room: jax.Array | None, account: ExactSum | None, taken: jax.Array) -> tuple[jax.Array | float, ExactSum | None]:
    """What of the sand that is taken up goes into a bucket (quanta), and the bucket's account afterwards.

    `room` is what it could take up at first (quanta), None where there is no bucket. When it becomes full, it takes the same
    share from every cell.
    """
    if room is None or account is None:
        return 0.0, account
    wanted, left = total(taken), jnp.maximum(room - account.value, 0)
    full = wanted > left
    share = jnp.where(full, jnp.where(full, left, 0) / jnp.where(full, wanted, 1), 1)
    into = truncate(taken * spread(share, taken))
    return into, counted(account, into)


def gates(neighbours: Neighbours, reach: Reach, holds: jax.Array) -> tuple[jax.Array, Fluxes]:
    """The open share of each cell and of each link, after the blade has moved; `holds` is 1 for cells that can hold sand.

    A link is as open as the narrower of its two cells, times 2 / (1 + narrower / wider). Where the blade's middle plane cuts
    the link, the narrower counts at most as what the plane leaves open; so do the planes of plates. Maps of cells have
    ghost cells.
    """
    # New ghost cells store the footprint, which XLA would else compute anew for both ends of every link.
    free = (1 - outer(inner(reach.after))) * holds
    planes = [(reach.along, reach.beside), *(() if reach.plates is None else (reach.plates,))]
    return free, lax.optimization_barrier(narrowed(neighbours, free, planes))


def narrowed(neighbours: Neighbours, free: jax.Array, planes: list[tuple[jax.Array, jax.Array]]) -> Fluxes:
    """The open share of each link, from that of cells and from planes that cut links; all maps have ghost cells.

    A plane is known by the distance of each cell from it and by how much of the cell it closes.
    """
    out = []
    of_planes = [
        zip(both_ends(neighbours, lax.stop_gradient(way)), both_ends(neighbours, wide), strict=True) for way, wide in planes
    ]
    for (here, there), *cuts in zip(both_ends(neighbours, free), *of_planes, strict=True):
        low, high = jnp.minimum(here, there), jnp.maximum(here, there)
        narrow = low
        for (behind, before), wide in cuts:
            narrow = jnp.where(behind * before < 0, jnp.minimum(narrow, 1 - jnp.minimum(*wide)), narrow)
        out.append(narrow * (2 * high / jnp.maximum(low + high, _LEAST)))
    return tuple(out)


def onward(cos: jax.Array, sin: jax.Array, room: jax.Array) -> Shares:
    """The shares of the neighbours for displacement along (cos, sin), a direction between +x and the diagonal.

    They go to the neighbour along x and to the diagonal one. `room`, with ghost cells, is 1 where sand can go. Where one of
    the two has no room, the other takes all. Where neither has, sand slides along y, the more the closer the direction is to
    the diagonal.
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


def slid(cos: jax.Array, sin: jax.Array, yaw: jax.Array, repose: jax.Array) -> Shares:
    """The shares of the eight neighbours for displacement by a blade at an angle `yaw` to its way, which is (cos, sin).

    It is along the blade's normal, turned towards the way by the angle of repose at most.
    """
    angle = yaw - jnp.clip(yaw, -repose, repose)
    p, q = cos * jnp.cos(angle) - sin * jnp.sin(angle), sin * jnp.cos(angle) + cos * jnp.sin(angle)
    size = jnp.maximum(jnp.abs(p), jnp.abs(q))
    return any_way(p / size, q / size)


def any_way(p: jax.Array, q: jax.Array) -> Shares:
    """The shares of the eight neighbours for displacement along (p, q), |p| and |q| at most 1; see `shares`."""
    return dict(zip(EIGHT, shares(p, q), strict=True))


def handed_on(
    parts: Shares, holds: jax.Array, carried: jax.Array, over: tuple[jax.Array, jax.Array] | None
) -> tuple[jax.Array, jax.Array, jax.Array | None]:
    """Moves `carried` quanta to neighbours by the shares `parts`: what stays in each cell, what each receives, what is lost.

    `holds`, with ghost cells, is 1 where a cell can take sand. `over` is None where the edge is closed; else it holds the
    ghost cells beyond a rim, and how much of what each cell carries may pass over the rim. The rest stays.
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
