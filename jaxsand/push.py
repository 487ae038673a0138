"""What a tool does to the sand: it is lowered, turned and moved, and the sand settles around it.

A blade stands in the sand as a prism over its footprint, from its bottom up. Where it covers the share a of a cell, that
cell's sand above the bottom lies in the open share 1 - a. What the blade newly covers when it is lowered or turned leaves
radially: away from its centre in the blade's own proportions, along the gradient of (s / thickness)^2 + (n / width)^2 with
s along and n across the blade. What it newly covers when it moves leaves in the direction of travel (see displace.py).

Source: arXiv:1908.02745, "Tool Interaction"; shares of a cell in place of whole ones make the result continuous in the
stroke.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax

from jaxsand.displace import Job, pass_on, radial, shares, spread, take
from jaxsand.grid import centres
from jaxsand.loop import repeat_until
from jaxsand.scene import Scene
from jaxsand.settling import Outcome
from jaxsand.sweep import (
    Flow,
    Lost,
    at,
    halo,
    largest,
    mark,
    nothing_lost,
    prepare,
    quantum,
    sound,
    spoiled,
    stand,
    sweep,
    unmark,
    volume_lost,
    worst_excess,
)
from jaxsand.tool import NoTool, Pose, coverage, local
from jaxsand.window import Window, cut, edge_movement, origin, paste


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class SteppedPush:
    """The blade advances by `substep` spacings at a time; after each the sand around it gets `sweeps` sweeps.

    The last, shorter sub-step of a leg settles in proportion to its length, so that the result is continuous in the stroke.
    Shorter sub-steps and more sweeps approach a push so slow that the sand is always at rest; `jaxsand bench push` tells how
    closely, and at what cost.
    """

    substep: float = field(default=0.5, metadata={"static": True})
    sweeps: int = field(default=8, metadata={"static": True})
    rate: jax.Array | float = 0.125


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Pushed:
    """A map [H, W] (m) after the tool was lifted and before it settles, the `outcome` (bits of `Outcome`), the volume that
    `drained` over the map's edge (m^3), and the tool's last `pose`."""

    height: jax.Array
    outcome: jax.Array
    drained: jax.Array
    pose: Pose


_State = tuple[jax.Array, Lost, jax.Array]  # height, height lost over the rim, movement at the window's edge


def push_along(
    scene: Scene, height: jax.Array, path: jax.Array, push: SteppedPush, record: Callable[[jax.Array], Any] | None = None
) -> tuple[Pushed, Any]:
    """Lowers the tool at path[0], moves it along the legs of `path` [n, 2] (m) and lifts it.

    Also returns what `record(height)` gave after each leg, stacked. Without a tool the map stays as it is.
    """
    # Beyond this the floats cannot tell on which side of the map a point lies.
    farthest = scene.grid.spacing * 2.0 ** (jnp.finfo(path.dtype).nmant + 8)
    usable = jnp.all(jnp.abs(path) < farthest)
    for leaf in jax.tree.leaves(scene.tool):
        usable = usable & jnp.all(jnp.isfinite(leaf))
    path = jnp.where(usable, path, 0)
    if isinstance(scene.tool, NoTool):
        still = Pose(path[-1, 0], path[-1, 1], jnp.ones_like(path[0, 0]), jnp.zeros_like(path[0, 0]))
        legs = path.shape[0] - 1
        frames = jax.tree.map(lambda f: jnp.broadcast_to(f, (legs, *f.shape)), record(height)) if record else ()
        return Pushed(height, _outcome(jnp.zeros((), bool), ~usable), jnp.zeros_like(path[0, 0]), still), frames
    bed = prepare(scene)
    intact, broken = mark(scene, height)
    # Of a path or a tool that is not finite nothing is used; the blade hangs above everything.
    tool = jax.tree.map(lambda leaf: jnp.where(usable, leaf, bed.spacing), scene.tool)
    bottom = jnp.where(usable, -jnp.asarray(scene.tool.depth), jnp.inf)
    scale = 4 * (largest(intact) + jnp.where(usable, jnp.abs(bottom), 0))
    flow = Flow(jnp.asarray(push.rate), quantum(scale))
    job = Job(bed, *centres(scene.grid, height.dtype), tool, bottom, flow)
    lost = nothing_lost(scene, height)
    moved = jnp.zeros_like(bottom)
    if isinstance(scene.window, Window):
        moved = lax.stop_gradient(worst_excess(bed, halo(intact)))
    state = (intact, lost, moved)

    pose, length = _heading(path[0], path[1], None)
    state = _lower(scene, push, job, pose, None, state)
    state = _leg(scene, push, job, pose, length, state)
    frames = [record(unmark(state[0], height))] if record else []

    def later_leg(carry: Any, ends: Any) -> tuple[Any, Any]:
        before, state = carry
        pose, length = _heading(ends[0], ends[1], before)
        state = _lower(scene, push, job, pose, _turned(pose, before), state)
        state = _leg(scene, push, job, pose, length, state)
        return (pose, state), record(unmark(state[0], height)) if record else ()

    if path.shape[0] > 2:
        (pose, state), rest = lax.scan(later_leg, (pose, state), (path[1:-1], path[2:]))
        if record:
            frames = jax.tree.map(lambda first, more: jnp.concatenate([first[None], more]), frames[0], rest)
    elif record:
        frames = jax.tree.map(lambda first: first[None], frames[0])
    marked, lost, moved = state
    edge = jnp.zeros((), bool)
    if isinstance(scene.window, Window):
        edge = moved > scene.window.tolerance
    drained = volume_lost(bed, lost)
    end = Pose(path[-1, 0], path[-1, 1], pose.cos, pose.sin)
    broken = broken | spoiled(intact, marked) | ~sound(bed) | ~usable
    return Pushed(unmark(marked, height), _outcome(edge, broken), drained, end), frames


def _outcome(window_edge: jax.Array, not_finite: jax.Array) -> jax.Array:
    return (Outcome.WINDOW_EDGE * window_edge + Outcome.NOT_FINITE * not_finite).astype(jnp.int32)


def _heading(start: jax.Array, stop: jax.Array, before: Pose | None) -> tuple[Pose, jax.Array]:
    """The pose at the start of a leg and the leg's length. A leg of no length keeps the heading; the first one faces +x."""
    run = stop - start
    size = lax.stop_gradient(jnp.max(jnp.abs(run)))  # squares of far strokes would overflow
    moving = size > 0
    part = jnp.where(moving, run / jnp.where(moving, size, 1), 1)
    length = jnp.where(moving, size * jnp.sqrt(jnp.sum(part**2)), 0)
    unit = run / jnp.where(moving, length, 1)
    cos, sin = (before.cos, before.sin) if before else (jnp.ones_like(length), jnp.zeros_like(length))
    return Pose(start[0], start[1], jnp.where(moving, unit[0], cos), jnp.where(moving, unit[1], sin)), length


def _turned(pose: Pose, before: Pose) -> Pose:
    """The pose that the blade had at this place before it turned."""
    return Pose(pose.x, pose.y, before.cos, before.sin)


def _leg(scene: Scene, push: SteppedPush, job: Job, pose: Pose, length: jax.Array, state: _State) -> _State:
    """Moves the blade ahead by `length`, as far as that touches the map, in sub-steps."""
    rows, columns = scene.grid.shape
    dx = job.bed.spacing
    along = [local(pose, x * dx, y * dx)[0] for x in (0, columns) for y in (0, rows)]
    reach = job.tool.thickness / 2 + dx
    first = jnp.clip(jnp.minimum(jnp.minimum(*along[:2]), jnp.minimum(*along[2:])) - reach, 0, length)
    last = jnp.clip(jnp.maximum(jnp.maximum(*along[:2]), jnp.maximum(*along[2:])) + reach, first, length)
    start = Pose(pose.x + first * pose.cos, pose.y + first * pose.sin, pose.cos, pose.sin)
    # make_scene holds the thickness below the map's diagonal, so twice the diagonal is enough.
    bound = math.ceil((2 * math.hypot(rows, columns) + 3) / push.substep)
    params = (scene, job, start, last - first)
    state, _ = repeat_until(partial(_arrived, push), partial(_advance, push), bound, params, state)
    return state


def _arrived(push: SteppedPush, params: Any, k: jax.Array, _: Any) -> jax.Array:
    _, job, _, length = params
    return k * push.substep * job.bed.spacing >= length


def _advance(push: SteppedPush, params: Any, k: jax.Array, state: _State) -> _State:
    """One sub-step: the blade clears what it newly covers to the front, and the sand settles around it."""
    scene, job, start, length = params
    substep = push.substep * job.bed.spacing
    begin = k * substep
    ahead = jnp.minimum(substep, length - begin)
    pose = Pose(start.x + begin * start.cos, start.y + begin * start.sin, start.cos, start.sin)
    end = Pose(pose.x + ahead * pose.cos, pose.y + ahead * pose.sin, pose.cos, pose.sin)

    def move(job: Job, h: jax.Array, lost: Lost) -> tuple[jax.Array, Lost, jax.Array]:
        # A hair less than what was covered, lest a rounded pose leave a hair of sand in the blade.
        before = coverage(job.tool, pose, job.x, job.y, job.bed.spacing, -1e-3 * job.bed.spacing)
        swept = coverage(job.tool, pose, job.x, job.y, job.bed.spacing, ahead)
        contact = _contact(job, swept, h)
        h, carried = take(job, h, before, swept)
        straight = jnp.maximum(jnp.abs(pose.cos), jnp.abs(pose.sin))
        share = shares(pose.cos / straight, pose.sin / straight)
        for _ in range(2):
            h, lost, carried = pass_on(job, share, 1 - swept, h, lost, carried)
        after = coverage(job.tool, end, job.x, job.y, job.bed.spacing)
        flow = Flow(job.flow.rate * (contact * ahead / substep), job.flow.quantum)
        h, lost = _settle_around(job, flow, push.sweeps, after, h + carried, lost)
        return h, lost, swept

    return _in_window(scene, job, pose, state, move)


def _lower(scene: Scene, push: SteppedPush, job: Job, pose: Pose, before: Pose | None, state: _State) -> _State:
    """Lowers the blade at `pose`, or turns it there from the pose `before`: what it newly covers leaves radially."""

    def move(job: Job, h: jax.Array, lost: Lost) -> tuple[jax.Array, Lost, jax.Array]:
        cover = coverage(job.tool, pose, job.x, job.y, job.bed.spacing)
        old = coverage(job.tool, before, job.x, job.y, job.bed.spacing) if before else jnp.zeros_like(cover)
        contact = _contact(job, cover, h)
        h, carried = take(job, h, old, jnp.maximum(cover, old))
        h, lost = spread(job, radial(job, pose), 1 - cover, h, lost, carried)
        if before is None:  # as many sweeps as for one spacing of travel
            flow = Flow(job.flow.rate * contact, job.flow.quantum)
            h, lost = _settle_around(job, flow, math.ceil(push.sweeps / push.substep), cover, h, lost)
        return h, lost, cover

    return _in_window(scene, job, pose, state, move)


def _contact(job: Job, cover: jax.Array, h: jax.Array) -> jax.Array:
    """1 while the blade is among the sand, falling to 0 where it covers no cell or hangs a spacing above all it covers.

    Keeps a tool that touches nothing from moving sand that is still only to a tolerance.
    """
    near = jnp.clip(1 + (h - job.bottom) / job.bed.spacing, 0, 1)
    return jnp.minimum(1, 2 * jnp.max(jnp.where(jnp.isnan(h), 0, near) * cover))


def _settle_around(job: Job, flow: Flow, sweeps: int, cover: jax.Array, h: jax.Array, lost: Lost) -> tuple[jax.Array, Lost]:
    around = stand(cover, job.bottom)
    state = (halo(h), lost)
    h, lost = lax.fori_loop(0, sweeps, lambda _, s: sweep(job.bed, flow, around, *s), state)
    return at(h), lost


def _in_window(scene: Scene, job: Job, pose: Pose, state: _State, move: Callable) -> _State:
    """Applies `move` to the whole map, or to the block of it around the tool."""
    h, lost, moved = state
    if not isinstance(scene.window, Window):
        h, lost, _ = move(job, h, lost)
        return h, lost, moved
    window, shape, dx = scene.window, scene.grid.shape, job.bed.spacing
    start = origin(window, shape, (pose.y / dx, pose.x / dx))
    old, old_lost = cut(window, shape, start, (h, lost))
    new, new_lost, cover = move(cut(window, shape, start, job), old, old_lost)
    moved = jnp.maximum(moved, edge_movement(window, shape, start, old, new, cover) / dx)
    return paste(start, h, new), paste(start, lost, new_lost), moved
