"""A blade's whole leg in closed form: its swath is taken up and set down as berms, as a heap ahead, and behind the start.

The balance of heap and berms, H = sqrt(w d mu), and what walls and edges change: notebooks/site/theory/closed-forms.md
("A blade's swath"). The heap is in _mound.py, what runs off over a draining edge in _overflow.py. Every amount is a whole
number of quanta and what the cuts leave over goes to one cell, so that volume is kept as well as floats allow.
"""

import math
from dataclasses import dataclass, field, replace

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from jaxsand.autodiff.while_loop import Tree
from jaxsand.interaction._blade import LEAST_SIZE
from jaxsand.interaction._displacement import Site, contact, settle_around, take, whole
from jaxsand.interaction._mound import Lean, heights, held, lean, reach_of, unbounded
from jaxsand.interaction._overflow import RimAhead, nothing_beyond
from jaxsand.interaction._path import Pushed, Record, State, along_legs, corners, over_the_map
from jaxsand.interaction._shade import on_line, within_reach
from jaxsand.interaction._slices import POINTS, WEIGHTS, hat, in_slices, of_slices, to_slice, wedge
from jaxsand.relaxation.ghost_cells import ExactSum, lose, total
from jaxsand.relaxation.stopping import check_rate, check_whole
from jaxsand.scene.boundaries import Walls
from jaxsand.scene.footprint import Pose, coverage, local
from jaxsand.scene.scene import Scene, deep
from jaxsand.scene.tools import Blade, NoTool, square
from jaxsand.scene.window import Whole

# Shapes, fitted to SteppedPush.fine() with blades of 2 to 16 cells; lengths are shares of the reach r, or cells.
_LAG = 1.23  # the heap holds more than that for its outflow: it is lower at its ends
_COARSE = 2.1  # times dx / r: and more on coarse cells
_SLIP = 1.3  # times (r / w)^2: less when it runs round the blade's ends into a deep trench
_FALL = 0.39  # how steeply it falls from its middle to open ends, over mu
_AHEAD = 0.29  # cells: how far ahead of the blade it begins between open ends
_GAP, _GAP_CELLS = 0.096, 0.35  # where the berms' crests lie outside of the blade's ends
_NEAR = 0.48  # how far the berms reach from there
_INTO, _DEEP = 0.78, 0.3  # 1 - exp(-_INTO - _DEEP (r / w)^3) of the berms has slid back into the trench behind the blade
_DEEPEST = 3.5  # r / w: beyond it, where a millionth stays outside, that share does not fall any more
_INNER = 0.93  # how far it is strewn
_BACK = 0.67  # of the sand under the blade when it is lowered: what leaves behind it and to its sides
_FAR = 50.0  # times the blade's thickness: no sand comes from farther back sooner than from there
_ACROSS = (np.arange(16) - 7.5) / 8
ROOM = 0.25  # with less room than this part of a profile's own, sand is held back


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class SwathPush:
    """A blade's whole leg at once, in closed form: trench, berms and heap. A fast approximation of `SteppedPush`.

    The sand of the trench is set down as two berms at repose and a heap ahead of the blade, whose volume V follows from
    dV/ds = q - a V / l along the stroke, with q the sand taken up per length, a the open share of the flanks and l a length
    of the order of the blade's width; blade_closed_form.py derives it.

    It is exact in a channel that the blade fills. In the open, the settled map differs from that of `SteppedPush.fine()` by
    (sum |h - h_ref| / sum |h_ref|, 8 strokes each, blades of 6 by 3 cells):

    | depth / width | 1/15 | 1/4 | 1/3 | 1/2 | 1 |
    |---|---|---|---|---|---|
    | strokes 3.3 widths long | 28% | 22% | 25% | 40% | 73% |
    | as long as the blade is thick | | 19% | | 28% | |
    | of no length | | 23% | | 22% | |

    and by 42% for a blade 1.5 cells thick; 27% for the default blade on cells of 1 cm. It computes the whole map, whatever
    the scene's window. Reverse mode needs memory in proportion to the cells of the map times those along its diagonal.

    Attributes:
        sweeps: number of sweeps of the sand around the blade after each leg but the last; static.
        rate: rate of these, as of `Relaxation`.

    Example:
        >>> import jax.numpy as jnp
        >>> import jaxsand as js
        >>> scene = js.make_scene((8, 8), 0.01, tool=js.Blade())
        >>> pushed = js.act(scene, jnp.zeros((8, 8)), jnp.array([0.02, 0.04, 0.06, 0.04]), push=js.SwathPush())
        >>> bool(pushed.height[4, 4] < 0)
        True
    """

    sweeps: int = field(default=8, metadata={"static": True})
    rate: Float[Array, ""] | float = 0.125

    def check(self, scene: Scene) -> None:
        """Raises ValueError if the scene's tool is no blade, or a number is out of range; see `PushRule`."""
        if not isinstance(scene.tool, NoTool | Blade):
            raise ValueError(
                f"push: got SwathPush for a {type(scene.tool).__name__}; SwathPush() is for a Blade, SteppedPush() for both"
            )
        if isinstance(scene.tool, Blade):
            square(scene.tool)
        deep(scene, "SwathPush")
        check_whole("push.sweeps", self.sweeps, 0)
        check_rate(scene, "push.rate", self.rate)

    def along(self, scene: Scene, height: jax.Array, path: jax.Array, record: Record | None = None) -> tuple[Pushed, Tree]:
        """Moves the scene's blade along the path; see `PushRule`."""
        return push_swath(scene, height, path, self, record)


def push_swath(
    scene: Scene, height: Float[Array, "H W"], path: Float[Array, "n 2"], push: SwathPush, record: Record | None = None
) -> tuple[Pushed, Tree]:
    """Lowers the blade at path[0], moves it along the legs of `path` [n, 2] (m) and lifts it; see `along_legs`."""
    scene = replace(scene, window=Whole())

    def leg(site: Site, pose: Pose, length: jax.Array, before: Pose | None, state: State) -> State:
        h, lost = state.height, state.lost
        if before is None:
            old = jnp.zeros_like(h)
        else:
            old = coverage(site.tool, before, site.x, site.y, site.bed.spacing)
            flow = replace(site.flow, rate=site.flow.rate * contact(site, old, h))
            h, lost = settle_around(site, flow, push.sweeps, old, h, lost)
        h, lost = _sweep_out(scene, site, pose, length, old, before is None, h, lost)
        return replace(state, height=h, lost=lost)

    return along_legs(scene, height, path, push.rate, leg, record)


def _sweep_out(  # noqa: PLR0915
    scene: Scene,
    site: Site,
    pose: Pose,
    length: jax.Array,
    old: jax.Array,
    lowered: bool,
    h: jax.Array,
    lost: ExactSum | None,
) -> tuple[jax.Array, ExactSum | None]:
    """One leg: takes up the sand in the way and sets it down."""
    dx, tool = site.bed.spacing, site.tool
    half, side = (jnp.maximum(jnp.asarray(size) / 2, LEAST_SIZE * dx) for size in (tool.thickness, tool.width))
    first_pose, under = pose, coverage(tool, pose, site.x, site.y, dx)
    _, pose, length = over_the_map(scene, site, pose, length)
    cover = coverage(tool, pose, site.x, site.y, dx, length)
    sand = jnp.where(jnp.isnan(h), 0.0, 1.0).astype(h.dtype)
    h, taken = take(site, h, old, jnp.maximum(cover, old))
    taken = jnp.where(sand > 0, taken, 0)  # heights of whole cells throughout
    first = taken * (under / jnp.where(cover > 0, cover, 1)) if lowered else jnp.zeros_like(taken)
    s, n = local(pose, site.x, site.y)
    end, off = half + length, jnp.abs(n) - side

    # Slices of the stroke, of a spacing or more each; a cell belongs to two of them.
    least, _ = corners(scene, site, pose)
    origin = jnp.maximum(-half, least)
    count = math.ceil(math.hypot(*scene.grid.shape) / 4) + 2
    slices = jnp.arange(count, dtype=h.dtype)
    thick = jnp.maximum(dx, (end - origin) / (count - 1))
    place = origin + slices * thick
    at = (s - origin) / thick
    seen = within_reach(scene, jnp.maximum(cover, under), sand)

    swept = cover * sand
    area = jnp.sum(swept)
    depth = jnp.maximum(jnp.sum(taken) / jnp.where(area > 0, area, 1), dx / 1000)
    mu = typical_drop(site, (cover + 1e-6 * under) * sand) / dx
    if isinstance(scene.walls, Walls):
        widths = in_slices(at, count, swept) * (dx * dx / thick)
    else:
        along = to_slice((end - place) / thick) - to_slice((-half - place) / thick)
        widths = 2 * side * along * on_line(scene, pose, place, side * jnp.asarray(_ACROSS, h.dtype), dx)
    width = jnp.maximum(jnp.sum(widths**2) / jnp.where(jnp.sum(widths) > 0, jnp.sum(widths), 1), dx)
    reach = jnp.sqrt(2 * side * depth / mu)

    rim = None
    if site.bed.rim is not None:
        ground = jnp.sum(swept * jnp.where(sand > 0, h + taken, 0)) / jnp.where(area > 0, area, 1)
        rim = RimAhead.of(scene, site, ground, sand, seen)

    # The berms, left and right; where they find room.
    outer = jnp.exp(-_INTO - _DEEP * jnp.minimum(reach / (2 * side), _DEEPEST) ** 3)
    into = 1 - outer
    near, inner = jnp.maximum(_NEAR * reach * jnp.sqrt(outer), dx / 2), _INNER * reach + dx / 2
    part = jnp.minimum(side / inner, 1)  # how much of that there is from either end to the middle
    left = jnp.clip(n / dx + 0.5, 0, 1)
    outside = wedge(off - _GAP * reach - _GAP_CELLS * dx, near, dx) * outer * seen
    inside = wedge(-off, inner, dx) * (into / (part * (2 - part))) * seen
    if isinstance(scene.walls, Walls):
        profiles = (left * outside, (1 - left) * outside, left * inside, (1 - left) * inside)
        rooms = jnp.stack([in_slices(at, count, x) for x in profiles]) * (dx / thick)
    else:
        points = jnp.asarray(POINTS, h.dtype)
        farther, nearer = side + _GAP * reach + _GAP_CELLS * dx + near * points, side - jnp.minimum(inner, side) * points
        rooms = jnp.stack([on_line(scene, pose, place, x, dx, WEIGHTS) for x in (farther, -farther, nearer, -nearer)])
        rooms = rooms * jnp.stack([outer, outer, into, into])[:, None]
    beyond = jnp.zeros_like(rooms[:2])
    if rim is not None:
        beyond = rim.berms(pose, place, side, reach, mu * reach, dx) * outer
    open_ = jnp.minimum((rooms[:2] + beyond) / (ROOM * outer), 1)
    flanks = jnp.sum(open_, axis=0) / 2
    there_end = hat(jnp.clip((end - origin) / thick, 0, count - 1)[None, None], slices)[:, 0]
    if rim is not None:
        rim = replace(rim, flanks=open_ @ there_end)

    # What the blade covers before it moves is taken up as it moves off, but for what it left behind and beside it.
    ring, back = jnp.zeros_like(h), jnp.zeros_like(depth)
    if lowered:
        there = hat(jnp.clip(-origin / thick, 0, count - 1)[None, None], slices)[:, 0]
        back = _BACK + (0.5 - _BACK) * (1 - jnp.max(open_ @ there))
        ring, back = _ring(first_pose, site, under, seen, jnp.sum(first), back, mu)
    onward = taken - first * back
    ahead = in_slices(at, count, onward)
    ahead = ahead.at[-1].add(jnp.sum(onward * jnp.clip(at - (count - 1), 0, 1)))  # what sticks out of the last slice
    before = jnp.where(place < half, ahead, 0)
    early = jnp.sum(before) + jnp.sum(onward * jnp.clip(-at, 0, 1))
    ahead = ahead - before + early * hat(jnp.clip((half - origin) / thick, 0, count - 1)[None, None], slices)[:, 0]

    # The heap's balance, slice by slice.
    step = jnp.clip(place + thick / 2, half, end) - jnp.clip(place - thick / 2, half, end)
    lag = _LAG * (width / 2 + math.pi / 6 * reach * flanks) * (1 + _COARSE * dx / reach)
    lag = lag / (1 + _SLIP * (reach / (2 * side)) ** 2)
    share = -jnp.expm1(-flanks * step / lag)
    heaped, left_there = _heap_balance(ahead, share)

    # Setting it down.
    room = rooms[:2] + rooms[2:] + beyond
    density = (left_there / jnp.where(flanks > 0, 2 * flanks, 1))[None] * open_ / jnp.where(room > 0, room, 1)
    put = of_slices(at, left, density * (dx / thick)) * (outside + inside)
    wanted, there = jnp.sum(density * (room - beyond)), total(put)
    scale = wanted / jnp.where(wanted > 0, jnp.maximum(there, wanted / 2), 1)
    heap, kept, gone = _heap(site, pose, end, heaped, h, seen, open_ @ there_end, width, mu, rim)
    put, kept = put * scale + ring + heap, kept + jnp.maximum(wanted - 2 * there, 0)
    last = taken * jnp.exp(jnp.clip((s - end) / (2 * half), -_FAR, 0))
    put = whole(site, put + last * (kept / jnp.where(kept > 0, jnp.sum(last), 1)))
    if lost is not None:
        every = jnp.sum(taken)
        gone = gone + jnp.sum(density * beyond)
        over = whole(site, taken * (gone / jnp.where(every > 0, every, 1)))
        lost, taken = lose(site.flow.quantum, lost, over), taken - over
    return h + complete(site, taken, put), lost


def _ring(
    pose: Pose, site: Site, under: jax.Array, sand: jax.Array, first: jax.Array, back: jax.Array, mu: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """The sand [H, W] that leaves behind and beside a blade as it is lowered, and its share of all that lay there."""
    dx, tool = site.bed.spacing, site.tool
    half, side = jnp.asarray(tool.thickness) / 2, jnp.asarray(tool.width) / 2
    s, n = local(pose, site.x, site.y)
    behind = lean(-half - s, jnp.abs(n) - side, dx, sand)
    where = Lean(behind.far, (1 - under) * jnp.clip((half - s) / dx + 0.5, 0, 1) * sand)
    start = unbounded(back * first / mu, jnp.asarray(tool.width), jnp.ones_like(mu), dx)
    room, _ = held(where, start, dx)
    left = ROOM * back * first
    back = back * jnp.minimum(room * mu / jnp.where(left > 0, left, 1), 1)
    reach = reach_of(back * first / mu, start, lambda r: held(where, r, dx), dx)
    shape = heights(where, reach, dx)
    total = jnp.sum(shape)
    return shape * (back * first / jnp.where(total > 0, total, 1)), back


def _heap(
    site: Site,
    pose: Pose,
    end: jax.Array,
    volume: jax.Array,
    h: jax.Array,
    sand: jax.Array,
    open_: jax.Array,
    width: jax.Array,
    mu: jax.Array,
    rim: RimAhead | None,
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """The heap ahead of the blade [H, W], the part of `volume` that finds no room there, and the part that runs off."""
    dx, side = site.bed.spacing, jnp.asarray(site.tool.width) / 2
    s, n = local(pose, site.x, site.y)
    where = lean(s - end - _AHEAD * dx * jnp.maximum(open_[0], open_[1]), jnp.abs(n) - side, dx, sand)
    falls = open_[0] * jnp.clip(n, 0, side) + open_[1] * jnp.clip(-n, 0, side)
    where = Lean(where.far + _FALL * falls, where.share)
    start = unbounded(volume / mu, width, (open_[0] + open_[1]) / 2, dx)
    beyond = nothing_beyond if rim is None else rim.beyond(pose, end, side, start, mu, dx)

    def holds(reach: jax.Array) -> tuple[jax.Array, jax.Array]:
        (here, slope), (there, slope_there) = held(where, reach, dx), beyond(reach)
        return here + there, slope + slope_there

    placed = volume * jnp.minimum(holds(start)[0] * mu / jnp.where(volume > 0, ROOM * volume, 1), 1)
    reach = reach_of(placed / mu, start, holds, dx)
    gone = jnp.minimum(beyond(reach)[0] * mu, placed)
    heap = heights(where, reach, dx)
    total = jnp.sum(heap)
    heap = heap * ((placed - gone) / jnp.where(total > 0, total, 1))
    if rim is not None:
        stays = jnp.minimum(heap, rim.room(site, h, mu))
        heap, gone = stays, gone + jnp.sum(heap - stays)
    return heap, volume - placed, gone


def typical_drop(site: Site, weight: Float[Array, "H W"]) -> Float[Array, ""]:
    """The largest stable step between neighbours (m): the bed's, or its weighted mean where it differs from cell to cell."""
    drop = site.bed.drop
    if not drop.ndim:
        return drop
    total = jnp.sum(weight)
    return jnp.where(total > 0, jnp.sum(weight * drop) / jnp.where(total > 0, total, 1), jnp.max(drop))


def complete(site: Site, taken: Float[Array, "H W"], put: Float[Array, "H W"]) -> Float[Array, "H W"]:
    """`put` with the rounding error of its sum added to its highest cell, so that it adds up to `taken` exactly."""
    # The counts fit their integers or wrap around; their sum is right, since what is left over is small.
    quanta = jnp.round(lax.stop_gradient(taken - put) / site.flow.quantum)
    rest = jnp.sum(quanta.astype(jnp.int64 if put.dtype == jnp.float64 else jnp.int32)).astype(put.dtype)
    # Its column, then its row: XLA vectorises the largest of each column, but not an argmax over the map.
    shown = lax.stop_gradient(put)
    column = jnp.argmax(jnp.max(shown, axis=0))
    row = jnp.argmax(shown[:, column])
    here = (jnp.arange(put.shape[0])[:, None] == row) & (jnp.arange(put.shape[1])[None, :] == column)
    return put + jnp.where(here, rest * site.flow.quantum, 0)


def _heap_balance(gains: jax.Array, shares: jax.Array) -> tuple[jax.Array, jax.Array]:
    """The heap's volume after all slices, and what it leaves in each.

    In each slice the heap gains `gains`, and leaves the part `shares` of its volume.
    """

    def pass_by(volume: jax.Array, slice_: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        gain, share = slice_
        left = (volume + gain / 2) * share
        return volume + gain - left, left

    return lax.scan(pass_by, jnp.zeros_like(gains[0]), (gains, shares))
