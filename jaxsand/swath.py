"""A push in one go: what the blade's swath takes up is set down as berms, as a heap ahead, and behind the start.

The blade pushes a heap of height H before it. What sticks out of the heap's two flanks is left behind as berms, triangles
at repose of cross section H^2 / (2 mu) each, mu = tan(angle of repose). A blade of width w that cuts d deep is in balance
when they take what it cuts, w d:

    H = sqrt(w d mu),   r = H / mu,   V_h = w H^2 / (2 mu) + (pi / 6) H^3 / mu^2,   l = V_h / (w d) = w / 2 + (pi / 6) r

with r the berms' and the heap's reach and V_h the heap: a wedge across the blade and a quarter of a cone at each end. A
heap of volume V leaves V / l to a unit of length, so that along the stroke, with intake q(s),

    dV/ds = q(s) - V / l.

Where a berm finds no room (a wall, the map's edge) the sand stays in the heap; a heap without room goes back to where it was
taken from. Every amount is a whole number of quanta and what the cuts leave over goes to one cell, so that volume is kept as
well as floats allow.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax

from jaxsand.bed import Lost, lose
from jaxsand.displace import Job, contact, settle_around, take, whole
from jaxsand.legs import Pushed, State, along_legs, corners, over_the_map
from jaxsand.scene import Scene
from jaxsand.tool import Pose, coverage, local
from jaxsand.window import Whole

# Shapes, fitted to SteppedPush.fine() with blades of 2 to 6 cells; lengths are shares of the reach r.
_LAG = 1.56  # the heap carries on longer than l: it is not steady yet
_THROW = 1.48  # how far the heap reaches ahead
_FLARE = 0.51  # and beyond the blade's ends
_GAP = 0.12  # where the berms' crests lie outside of the blade's ends
_NEAR = 0.55  # how far the berms reach from there
_INTO = 0.6  # of the berms, times r / w: what has slid back into the trench behind the blade
_DOWN = 0.645  # how far from the blade's ends that lies
_INNER = 1.3  # how far it is strewn
_BEHIND = 0.256  # of the sand under the blade when it is lowered: what leaves behind it
_ASIDE = 0.307  # and to its sides
ROOM = 0.25  # with less room than this part of a profile's own, sand is held back


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class SwathPush:
    """Trench, berms and heap of a whole leg at once, in closed form; a fast approximation of `SteppedPush`.

    For blades that cut between an eighth of a cell and a third of their width deep: there the settled map lies 20 to 40%
    from the full push, in sum |h - h_ref| / sum |h_ref|; shallower and deeper ones lie farther. After each leg but the last
    the sand around the blade gets `sweeps` sweeps at `rate`. It works on the whole map, whatever the scene's window, and its
    memory grows with the cells times a quarter of those along the map's diagonal.
    """

    sweeps: int = field(default=8, metadata={"static": True})
    rate: jax.Array | float = 0.125


def push_swath(
    scene: Scene, height: jax.Array, path: jax.Array, push: SwathPush, record: Callable[[jax.Array], Any] | None = None
) -> tuple[Pushed, Any]:
    """Lowers the tool at path[0], moves it along the legs of `path` [n, 2] (m) and lifts it; see `along_legs`."""
    scene = replace(scene, window=Whole())

    def leg(job: Job, pose: Pose, length: jax.Array, before: Pose | None, state: State) -> State:
        h, lost, moved = state
        if before is None:
            old = jnp.zeros_like(h)
        else:
            old = coverage(job.tool, before, job.x, job.y, job.bed.spacing)
            flow = replace(job.flow, rate=job.flow.rate * contact(job, old, h))
            h, lost = settle_around(job, flow, push.sweeps, old, h, lost)
        return *_sweep_out(scene, job, pose, length, old, before is None, h, lost), moved

    return along_legs(scene, height, path, push.rate, leg, record)


def _sweep_out(  # noqa: PLR0915
    scene: Scene, job: Job, pose: Pose, length: jax.Array, old: jax.Array, lowered: bool, h: jax.Array, lost: Lost
) -> tuple[jax.Array, Lost]:
    """One leg: takes up the sand in the way and sets it down."""
    dx, tool = job.bed.spacing, job.tool
    half, side = jnp.asarray(tool.thickness) / 2, jnp.asarray(tool.width) / 2
    under = coverage(tool, pose, job.x, job.y, dx)
    pose, length = over_the_map(scene, job, pose, length)
    cover = coverage(tool, pose, job.x, job.y, dx, length)
    sand = jnp.where(jnp.isnan(h), 0.0, 1.0).astype(h.dtype)
    h, taken = take(job, h, old, jnp.maximum(cover, old))
    taken = jnp.where(sand > 0, taken, 0)  # heights of whole cells throughout
    first = taken * (under / jnp.where(cover > 0, cover, 1)) if lowered else jnp.zeros_like(taken)

    area = jnp.sum(cover * sand)
    depth = jnp.maximum(jnp.sum(taken) / jnp.where(area > 0, area, 1), dx / 1000)
    mu = typical_drop(job, (cover + 1e-6 * under) * sand) / dx
    reach = jnp.sqrt(tool.width * depth / mu)
    lag = _LAG * (side + math.pi / 6 * reach)
    near, reach = jnp.maximum(_NEAR * reach, dx / 2), jnp.maximum(reach, dx / 2)
    s, n = local(pose, job.x, job.y)
    end = half + length
    berm = _berms(n, side, near, reach, dx) * sand
    heap = wedge(s - end, _THROW * reach, dx) * _across(n, side, _FLARE * reach, dx) * sand
    back_reach = jnp.maximum(jnp.sqrt(tool.thickness * depth / mu), dx / 2)
    behind = wedge(-half - s, back_reach, dx) * _across(n, side, 0.0, dx) * sand
    heap_width = (2 * side + _FLARE * reach) / dx

    # Where the blade is lowered, some sand leaves behind it and to its sides.
    start, back_width = jnp.sum(first), 2 * side / dx
    back_room = jnp.sum(behind) / back_width
    back = _BEHIND * jnp.minimum(back_room / ROOM, 1)

    # Slices of the stroke, of a spacing or more each; a cell belongs to two of them.
    least, _ = corners(scene, job, pose)
    origin = jnp.maximum(-half, least)
    count = math.ceil(math.hypot(*scene.grid.shape) / 4) + 2
    slices = jnp.arange(count, dtype=h.dtype)
    thick = jnp.maximum(dx, (end - origin) / (count - 1))
    place = origin + slices * thick
    at = (s - origin) / thick
    hats = hat(at.reshape(1, -1), slices)
    room = hats @ berm.ravel() * (dx / thick)
    onward = taken - first * (back + _ASIDE)
    ahead = hats @ onward.ravel()
    ahead = ahead.at[-1].add(jnp.sum(onward * jnp.clip(at - (count - 1), 0, 1)))  # what sticks out of the last slice
    beyond, heap_beyond = _over_rim(scene, job, pose, place, side, reach, end)
    open_ = jnp.minimum((room + beyond) / ROOM, 1)
    along = jnp.clip(place + thick / 2, -half, half) - jnp.clip(place - thick / 2, -half, half)
    aside = _ASIDE * start * along / (2 * half)
    # What the blade covers before it moves is taken up as it moves off.
    before = jnp.where(place < half, ahead, 0)
    early = jnp.sum(before) + jnp.sum(onward * jnp.clip(-at, 0, 1)) + _ASIDE * start - jnp.sum(aside * open_)
    ahead = ahead - before + early * hat(jnp.clip((half - origin) / thick, 0, count - 1)[None, None], slices)[:, 0]

    # The heap's balance, slice by slice.
    step = jnp.clip(place + thick / 2, half, end) - jnp.clip(place - thick / 2, half, end)
    share = -jnp.expm1(-open_ * step / lag)

    heaped, left = _heap_balance(ahead, share)

    # Setting it down.
    left = left + aside * open_
    density = left / jnp.where(room + beyond > 0, room + beyond, 1)
    heap_room = jnp.sum(heap) / heap_width
    heap_density = heaped / jnp.maximum(heap_room + heap_beyond, ROOM)
    put = berm * (density * (dx / thick) @ hats).reshape(h.shape) + heap * (heap_density / heap_width)
    put = put + behind * (_BEHIND * start / back_width / jnp.maximum(back_room, ROOM))
    kept = heaped - heap_density * (heap_room + heap_beyond)
    last = taken * (jnp.exp((jnp.minimum(s, end) - end) / lag) + 1e-6)
    put = whole(job, put + last * (kept / jnp.where(kept > 0, jnp.sum(last), 1)))
    if lost is not None:
        every = jnp.sum(taken)
        gone = jnp.sum(density * beyond) + heap_density * heap_beyond
        over = whole(job, taken * (gone / jnp.where(every > 0, every, 1)))
        lost, taken = lose(job.flow.quantum, lost, over), taken - over
    return h + complete(job, taken, put), lost


def typical_drop(job: Job, weight: jax.Array) -> jax.Array:
    """The largest stable step, its mean by weight where it differs from cell to cell."""
    drop = job.bed.drop
    if not drop.ndim:
        return drop
    total = jnp.sum(weight)
    return jnp.where(total > 0, jnp.sum(weight * drop) / jnp.where(total > 0, total, 1), jnp.max(drop))


def _berms(n: jax.Array, side: jax.Array, near: jax.Array, reach: jax.Array, dx: jax.Array) -> jax.Array:
    """Both berms' profile across the stroke, with what has slid back into the trench."""
    into = jnp.minimum(_INTO * reach / (2 * side), 0.8)
    inner = jnp.minimum(_INNER * reach, side)
    outside = wedge(jnp.abs(n) - side - _GAP * reach, near, dx) * (1 - into) / 2
    return outside + wedge(jnp.abs(jnp.abs(n) - jnp.maximum(side - _DOWN * reach, 0)), inner, dx) * into / 2


def complete(job: Job, taken: jax.Array, put: jax.Array) -> jax.Array:
    """What is put down, and on its highest cell what the cuts left over; adds up to what was taken, exactly."""
    # The counts fit their integers or wrap around; their sum is right, since what is left over is small.
    quanta = jnp.round(lax.stop_gradient(taken - put) / job.flow.quantum)
    rest = jnp.sum(quanta.astype(jnp.int64 if put.dtype == jnp.float64 else jnp.int32)).astype(put.dtype)
    here = jnp.arange(put.size) == jnp.argmax(put.ravel())
    return put + jnp.where(here, rest * job.flow.quantum, 0).reshape(put.shape)


def _heap_balance(gains: jax.Array, shares: jax.Array) -> tuple[jax.Array, jax.Array]:
    """The heap's volume at the end and what it leaves in each slice, of which it takes up `gains` and leaves `shares`."""

    def pass_by(volume: jax.Array, slice_: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        gain, share = slice_
        left = (volume + gain / 2) * share
        return volume + gain - left, left

    return lax.scan(pass_by, jnp.zeros_like(gains[0]), (gains, shares))


def _over_rim(
    scene: Scene, job: Job, pose: Pose, place: jax.Array, side: jax.Array, reach: jax.Array, end: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """The shares of the berms at `place` and of the heap that lie over a draining edge, smoothed over a spacing."""
    if job.bed.rim is None:
        return jnp.zeros_like(place), jnp.zeros_like(end)
    rows, columns = scene.grid.shape

    def out(s: jax.Array, n: jax.Array) -> jax.Array:
        x = (pose.x + s * pose.cos - n * pose.sin) / job.bed.spacing
        y = (pose.y + s * pose.sin + n * pose.cos) / job.bed.spacing
        far = jnp.maximum(jnp.maximum(-x, x - columns), jnp.maximum(-y, y - rows))
        return jnp.clip(far + 0.5, 0, 1)

    off = side + reach / 3
    heap = [out(end + _THROW * reach * a, side * b) for a in (0.1, 0.3, 0.6) for b in (-0.8, 0.0, 0.8)]
    return (out(place, off) + out(place, -off)) / 2, jnp.mean(jnp.stack(heap))


def hat(at: jax.Array, slices: jax.Array) -> jax.Array:
    """How much of a place belongs to each slice [k, ...]."""
    return jnp.maximum(1 - jnp.abs(at - slices[:, None]), 0)


def wedge(u: jax.Array, reach: jax.Array, dx: jax.Array) -> jax.Array:
    """The mean over a spacing around u of a wedge on [0, reach] that falls to 0; they add up to 1."""

    def area(u: jax.Array) -> jax.Array:
        part = jnp.clip(u / reach, 0, 1)
        return part * (2 - part)

    return area(u + dx / 2) - area(u - dx / 2)


def _across(n: jax.Array, side: jax.Array, flare: jax.Array | float, dx: jax.Array) -> jax.Array:
    """1 over the blade's width, falling to 0 over `flare` beyond its ends."""
    return jnp.clip((side + flare - jnp.abs(n)) / (flare + dx) + 0.5 * dx / (flare + dx), 0, 1)
