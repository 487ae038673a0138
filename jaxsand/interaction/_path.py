"""Moves a tool along a path of straight legs, with any rule for what it does to the sand on each."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import jax
import jax.numpy as jnp
from jax import lax
from jax.typing import DTypeLike
from jaxtyping import Array, Float, Int

from jaxsand.autodiff.while_loop import Tree
from jaxsand.interaction._displacement import Site
from jaxsand.relaxation.flux import worst_excess
from jaxsand.relaxation.ghost_cells import (
    ExactSum,
    below_base,
    halo,
    largest,
    mark,
    nothing_lost,
    prepare,
    quantum,
    sound,
    spoiled,
    unmark,
    volume_lost,
)
from jaxsand.relaxation.stopping import Outcome, said
from jaxsand.relaxation.sweep import Flow
from jaxsand.scene.footprint import Pose, local
from jaxsand.scene.grid import centres
from jaxsand.scene.scene import Scene
from jaxsand.scene.tools import Blade, NoTool, Wheel, extent, lowest, reach
from jaxsand.scene.tools import usable as makes_sense
from jaxsand.scene.window import Window


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Pushed:
    """A map after the tool was lifted and before it settles. Of a batch, every field has the batch axis in front.

    Attributes:
        height: height map [H, W] (m).
        outcome: bits of `Outcome`; 0 when all went well. See `check`.
        drained: volume that ran off over a draining edge during the push (m^3).
        pose: where the tool was lifted, and its heading.

    Example:
        >>> import jax.numpy as jnp
        >>> import jaxsand as js
        >>> scene = js.make_scene((8, 8), 0.01, tool=js.Blade())
        >>> pushed = js.act(scene, jnp.zeros((8, 8)), jnp.array([0.02, 0.04, 0.06, 0.04]))
        >>> int(pushed.outcome), float(pushed.drained)
        (0, 0.0)
    """

    height: Float[Array, "*batch H W"]
    outcome: Int[Array, "*batch"]
    drained: Float[Array, "*batch"]
    pose: Pose


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class State:
    """What a leg is handed and hands on.

    Attributes:
        height: the map [H, W] (m), NaN where there is no sand.
        lost: account of what drained; see `ghost_cells.lose`.
        moved: largest change of height at the window's edge so far (spacings).
        kept: what the rule keeps from leg to leg; () before the first.
        scooped: account (quanta) of what a bucket took up, as of `ghost_cells.counted`; None for other tools.
    """

    height: jax.Array
    lost: ExactSum | None
    moved: jax.Array
    kept: Tree
    scooped: ExactSum | None


Leg = Callable[[Site, Pose, jax.Array, Pose | None, State], State]
Record = Callable[[jax.Array], Tree]  # what to note of the height [H, W] (m) after each leg


def along_legs(
    scene: Scene,
    height: jax.Array,
    path: jax.Array,
    rate: jax.Array | float,
    leg: Leg,
    record: Record | None = None,
    *,
    rises: bool = False,
) -> tuple[Pushed, Tree]:
    """Lowers the tool at path[0], moves it along the legs of `path` (m) and lifts it; see `travelled`.

    Returns the map after the path, and what `record(height)` returned after each leg, stacked.
    """
    pushed, frames, _ = travelled(scene, height, path, rate, leg, record, rises=rises)
    return pushed, frames


def travelled(
    scene: Scene,
    height: jax.Array,
    path: jax.Array,
    rate: jax.Array | float,
    leg: Leg,
    record: Record | None = None,
    *,
    rises: bool = False,
    room: jax.Array | None = None,
) -> tuple[Pushed, Tree, ExactSum | None]:
    """Lowers the tool at path[0], moves it along the legs of `path` (m) and lifts it.

    `leg(site, pose, length, before, state)` moves the tool from `pose` by `length` (m). `before` is the tool's pose at the
    end of the last leg, or None if the tool is yet to be lowered. Without a tool the map stays as it is.

    The path is [n, 2], at the tool's own depth, or [n, 3] with heights of the tool's lowest point, if `rises` says that the
    leg heeds `site.rise`. A leg straight up or down leaves the map as it is, and the outcome says NOT_FINITE. A bucket can
    take up a sum of heights of `room` (m).

    Returns the map after the path, what `record(height)` returned after each leg, stacked, and the sum of heights (m) that a
    bucket took up, as an account.
    """
    if path.shape[1] == 3 and not rises:
        raise ValueError(
            "path: got heights, but this push keeps its tool at one depth; give SteppedPush(), or x and y alone"
        )
    usable = jnp.all(jnp.abs(path) < farthest(scene, path.dtype)) & makes_sense(scene.tool) & ~jnp.any(upright(path))
    path = jnp.where(usable, path, 0)
    path, heights = path[:, :2], path[:, 2:]
    if isinstance(scene.tool, NoTool):
        return *_untouched(height, path, usable, record), None
    if not isinstance(scene.tool, Blade | Wheel):  # a bucket's edge moves as a blade
        raise TypeError(f"scene.tool: got {type(scene.tool).__name__}; legs are of a Blade or a Wheel")
    bed = prepare(scene)
    intact, broken = mark(scene, height)
    # Of a path or a tool that is not usable nothing is used; the blade hangs above everything.
    tool = jax.tree.map(lambda leaf: jnp.where(usable, leaf, bed.spacing), scene.tool)
    deep = extent(scene.tool, heights)
    scale = 4 * (jnp.maximum(largest(intact), bed.elsewhere) + jnp.where(usable, deep, 0))
    scale = jnp.maximum(scale, bed.spacing * 2.0 ** -jnp.finfo(scale.dtype).nmant)  # a spacing is a number of quanta
    flow = Flow(jnp.asarray(rate), quantum(scale))
    site = Site(
        bed, *centres(scene.grid, height.dtype), tool, jnp.where(usable, lowest(scene.tool), jnp.inf), None, flow, room
    )
    lost = nothing_lost(bed, height)
    moved = jnp.zeros_like(site.bottom)
    if isinstance(scene.window, Window):
        moved = lax.stop_gradient(worst_excess(bed, halo(intact)))
    zero = jnp.zeros_like(site.bottom)
    state = State(intact, lost, moved, (), None if room is None else ExactSum(zero, zero))

    def at_height(start: jax.Array, stop: jax.Array, length: jax.Array) -> Site:
        if not start.size:
            return site
        rise = (stop[0] - start[0]) / jnp.where(length > 0, length, 1)
        return replace(site, bottom=jnp.where(usable, start[0], jnp.inf), rise=rise)

    pose, length = heading(path[0], path[1], None)
    state = leg(at_height(heights[0], heights[1], length), pose, length, None, state)
    frames = [record(unmark(state.height, height))] if record else []

    def later_leg(carry: tuple[Pose, State], points: tuple[jax.Array, ...]) -> tuple[tuple[Pose, State], Tree]:
        before, state = carry
        pose, length = heading(points[0], points[1], before)
        site = at_height(points[2], points[3], length)
        state = leg(site, pose, length, Pose(pose.x, pose.y, before.cos, before.sin), state)
        return (pose, state), record(unmark(state.height, height)) if record else ()

    if path.shape[0] > 2:
        (pose, state), rest = lax.scan(later_leg, (pose, state), (path[1:-1], path[2:], heights[1:-1], heights[2:]))
        if record:
            frames = jax.tree.map(lambda first, more: jnp.concatenate([first[None], more]), frames[0], rest)
    elif record:
        frames = jax.tree.map(lambda first: first[None], frames[0])
    marked, lost, moved = state.height, state.lost, state.moved
    edge = jnp.zeros((), bool)
    if isinstance(scene.window, Window):
        edge = moved > scene.window.tolerance
    drained = volume_lost(bed, lost)
    end = Pose(path[-1, 0], path[-1, 1], pose.cos, pose.sin)
    broken = broken | spoiled(intact, marked) | ~sound(bed) | ~usable
    outcome = _outcome(edge, broken) | said(Outcome.BELOW_BASE, below_base(bed, intact))
    scooped = jax.tree.map(lambda count: count * flow.quantum, state.scooped)
    return Pushed(unmark(marked, height), outcome, drained, end), frames, scooped


def farthest(scene: Scene, dtype: DTypeLike) -> jax.Array:
    """The distance (m) from which on floats cannot tell on which side of the map a point lies."""
    return jnp.asarray(scene.grid.spacing * 2.0 ** (jnp.finfo(dtype).nmant + 8))


def _untouched(height: jax.Array, path: jax.Array, usable: jax.Array, record: Record | None) -> tuple[Pushed, Tree]:
    """What `along_legs` returns where there is no tool."""
    still = Pose(path[-1, 0], path[-1, 1], jnp.ones_like(path[0, 0]), jnp.zeros_like(path[0, 0]))
    legs = path.shape[0] - 1
    frames = jax.tree.map(lambda f: jnp.broadcast_to(f, (legs, *f.shape)), record(height)) if record else ()
    return Pushed(height, _outcome(jnp.zeros((), bool), ~usable), jnp.zeros_like(path[0, 0]), still), frames


def upright(path: jax.Array) -> jax.Array:
    """Which legs of a path [n, 2] or [n, 3] lead straight up or down."""
    return jnp.all(path[1:, :2] == path[:-1, :2], axis=1) & jnp.any(path[1:, 2:] != path[:-1, 2:], axis=1)


def over_the_map(scene: Scene, site: Site, pose: Pose, length: jax.Array) -> tuple[Site, Pose, jax.Array]:
    """The part of a leg on which the tool can touch the map: the site and the pose where it starts, and its length (m)."""
    dx = site.bed.spacing
    along = corners(scene, site, pose)
    far = reach(site.tool) + dx
    first = jnp.clip(along[0] - far, 0, length)
    last = jnp.clip(along[1] + far, first, length)
    start = Pose(pose.x + first * pose.cos, pose.y + first * pose.sin, pose.cos, pose.sin)
    return site if site.rise is None else replace(site, bottom=site.bottom + first * site.rise), start, last - first


def turn_between(before: Pose, after: Pose) -> jax.Array:
    """The smaller angle from one heading to another, counter-clockwise; a reversal is half a turn to the left."""
    sin = before.cos * after.sin - before.sin * after.cos
    cos = before.cos * after.cos + before.sin * after.sin
    same = (sin == 0) & (cos > 0)
    return jnp.where(same, 0, jnp.arctan2(jnp.where(same, 0, sin), jnp.where(same, 1, cos)))


def corners(scene: Scene, site: Site, pose: Pose) -> tuple[jax.Array, jax.Array]:
    """The least and the largest distance of the map's corners along a heading, from the pose (m)."""
    rows, columns = scene.grid.shape
    dx = site.bed.spacing
    along = [local(pose, x * dx, y * dx)[0] for x in (0, columns) for y in (0, rows)]
    least = jnp.minimum(jnp.minimum(*along[:2]), jnp.minimum(*along[2:]))
    return least, jnp.maximum(jnp.maximum(*along[:2]), jnp.maximum(*along[2:]))


def _outcome(window_edge: jax.Array, not_finite: jax.Array) -> jax.Array:
    return said(Outcome.WINDOW_EDGE, window_edge) | said(Outcome.NOT_FINITE, not_finite)


def heading(start: jax.Array, stop: jax.Array, before: Pose | None) -> tuple[Pose, jax.Array]:
    """The pose at the start of a leg, and the leg's length (m). A leg of no length keeps the heading; the first faces +x."""
    run = stop - start
    size = lax.stop_gradient(jnp.max(jnp.abs(run)))  # squares of far strokes would overflow
    moving = size > 0
    part = jnp.where(moving, run / jnp.where(moving, size, 1), 1)
    length = jnp.where(moving, size * jnp.sqrt(jnp.sum(part**2)), 0)
    unit = run / jnp.where(moving, length, 1)
    cos, sin = (before.cos, before.sin) if before else (jnp.ones_like(length), jnp.zeros_like(length))
    return Pose(start[0], start[1], jnp.where(moving, unit[0], cos), jnp.where(moving, unit[1], sin)), length
