"""One sub-step of a blade, and its derivative by hand where sand flows in pairs and nothing drains.

With covers b before, w swept and a after, the sub-step takes c = s r from the cells, s = (w - b) / (1 - b) and
r = h - bottom where that is positive; hands it on twice and settles what that gives. With T what neighbours receive and K
what leaves, G = T - K, all of them linear,

    h3 = h + G c + G (w T c).

Backwards, with lambda the cotangent of h3 (which around.py gives), mu = G' lambda and nu = T' (w mu),

    of c: mu + nu,        of w: mu T c,        of h: lambda + s (mu + nu) where h > bottom,

and of the shares that T depends on the derivative of the same two terms. All covers are intervals in the coordinates along
and across of one pose, so that seven sums tell what reaches the blade's pose and size. The grid gets no cotangent.
"""

from dataclasses import dataclass, replace
from typing import Any

import jax
import jax.numpy as jnp

from jaxsand import adjoint, around, window
from jaxsand.adjoint import total
from jaxsand.bed import Lost, at, halo
from jaxsand.displace import EIGHT, Job, Shares, contact, pass_on, settle_around, shares, take
from jaxsand.flux import NARROW, stand
from jaxsand.legs import State, in_window
from jaxsand.loop import Plain, split
from jaxsand.sweep import Flow
from jaxsand.tool import Pose, coverage, interval, local
from jaxsand.window import Window

_LESS = -1e-3  # spacings: a hair less than what was covered, lest a rounded pose leave a hair of sand in the blade


def step_ahead(
    substep: float, job: Job, start: Pose, length: jax.Array, k: jax.Array
) -> tuple[Pose, Pose, jax.Array, jax.Array]:
    """The poses before and after sub-step k of a leg, the way between (m), and which part of a whole sub-step that is."""
    whole = substep * job.bed.spacing
    begin = k * whole
    ahead = jnp.minimum(whole, length - begin)
    pose = Pose(start.x + begin * start.cos, start.y + begin * start.sin, start.cos, start.sin)
    return pose, Pose(pose.x + ahead * pose.cos, pose.y + ahead * pose.sin, pose.cos, pose.sin), ahead, ahead / whole


@dataclass(frozen=True)
class Advance:
    """The blade clears what it newly covers to the front, and the sand settles around it; `params` are the scene, the job,
    the pose where the leg starts and the leg's length."""

    substep: float
    sweeps: int
    tape: int = 64

    def __call__(self, params: Any, k: jax.Array, state: State) -> State:
        scene, job, start, length = params
        pose, end, ahead, part = step_ahead(self.substep, job, start, length, k)

        def move(job: Job, h: jax.Array, lost: Lost) -> tuple[jax.Array, Lost, jax.Array]:
            before, swept, after = _covers(job, pose, end, ahead)
            among = contact(job, swept, h)
            h, carried = take(job, h, before, swept)
            for _ in range(2):
                h, lost, carried = pass_on(job, _straight(pose.cos, pose.sin), 1 - swept, h, lost, carried)
            flow = Flow(job.flow.rate * (among * part), job.flow.quantum)
            h, lost = settle_around(job, flow, self.sweeps, after, h + carried, lost)
            return h, lost, swept

        return in_window(scene, job, pose, state, move)

    def recorded(self, params: Any, k: jax.Array, state: State) -> tuple[State, State]:
        return self(params, k, state), state

    def push(self, params: Any, k: jax.Array, record: State, dparams: Any, dstate: State) -> State:
        return Plain(self).push(params, k, record, dparams, dstate)

    def pull(self, params: Any, k: jax.Array, record: State, cotangent: State) -> tuple[Any, State]:
        scene, job, start, length = params
        if not around.by_hand(job.bed) or not self.sweeps:
            return Plain(self).pull(params, k, record, cotangent)
        way, onto_way = jax.vjp(lambda start, length: step_ahead(self.substep, job, start, length, k), start, length)
        h, gain = record[0], cotangent[0]
        if not isinstance(scene.window, Window):
            found, back = self._pull_move(job, way, h, gain)
        else:
            shape, dx = scene.grid.shape, job.bed.spacing
            corner = window.origin(scene.window, shape, (way[0].y / dx, way[0].x / dx))
            block, old, new = window.cut(scene.window, shape, corner, (job, h, gain))
            found, part = self._pull_move(block, way, old, new)
            back = window.paste(corner, gain, part)
            if job.bed.drop.ndim:
                found = replace(found, drop=window.paste(corner, jnp.zeros_like(job.bed.drop), found.drop))
        dstart, dlength = onto_way((found.pose, jax.tree.map(jnp.zeros_like, way[1]), found.ahead, found.part))
        dscene, djob, _, _ = jax.tree.map(jnp.zeros_like, params)
        djob = replace(
            djob,
            bed=replace(djob.bed, drop=found.drop),
            tool=replace(djob.tool, width=found.width, thickness=found.thickness),
            bottom=found.bottom,
            flow=replace(djob.flow, rate=found.rate),
        )
        return split((dscene, djob, dstart, dlength))[0], (back, None, cotangent[2])

    def _pull_move(self, job: Job, way: Any, h: jax.Array, gain: jax.Array) -> tuple["_Found", jax.Array]:
        """The cotangents of all that a sub-step depends on, and of the height before it."""
        pose, end, ahead, part = way
        before, swept, after = _covers(job, pose, end, ahead)
        share, turned = jax.jvp(_straight, (pose.cos, pose.sin), (-pose.sin, pose.cos))
        among = contact(job, swept, h)
        left, first = take(job, h, before, swept)
        passed, _, second = pass_on(job, share, 1 - swept, left, None, first)
        passed, _, last = pass_on(job, share, 1 - swept, passed, None, second)
        flow = Flow(job.flow.rate * (among * part), job.flow.quantum)
        tool = stand(after, job.bottom)
        tape = around.surfaces(job.bed, flow, tool, self.sweeps, passed + last)
        of = around.pull(job.bed, flow, tool, tape, gain)

        # The sand that was handed on.
        holds = jnp.where(jnp.isnan(h), 0.0, 1.0).astype(h.dtype)
        room, there = halo(holds, 0.0), halo(holds * of.height, 0.0)
        mu = at(halo(_stencil(share, there) - of.height * _stencil(share, room), 0.0))
        onward = halo(holds * swept * mu, 0.0)
        received = _stencil(share[::-1], halo(first, 0.0)) * holds
        of_taken = mu + _stencil(share, onward)
        turn = total(
            (first + second) * (_stencil(turned, there) - of.height * _stencil(turned, room))
            + first * _stencil(turned, onward)
        )

        # The sand that was taken up.
        grown = swept > before
        free = jnp.where(grown, 1 - before, 1)
        part_taken = jnp.where(grown, (swept - before) / free, 0)
        high = h > job.bottom
        of_share = jnp.where(grown & high, of_taken * (h - job.bottom), 0) / free
        raised = jnp.where(high, of_taken * part_taken, 0)
        of_swept = mu * received + of_share
        of_before = -of_share * jnp.where(grown, (1 - swept) / free, 0)
        of_after = -of.open + of.stretch * _stretching(after)

        # How far the blade is among the sand.
        of_among = of.rate * job.flow.rate * part
        near_swept, near_height = _pull_contact(job, swept, h, of_among)
        bottom = of.bottom - total(raised + near_height)
        back = of.height + raised + near_height

        dpose, size = _pull_covers(job, pose, ahead, (of_before, of_swept + near_swept, of_after))
        dpose = replace(dpose, cos=dpose.cos - turn * pose.sin, sin=dpose.sin + turn * pose.cos)
        width, thickness, dahead = size
        rate = of.rate * (among * part)
        found = _Found(dpose, dahead, of.rate * job.flow.rate * among, width, thickness, bottom, rate, of.drop)
        return found, back


@dataclass(frozen=True)
class _Found:
    """Cotangents of a sub-step's pose, way and part of a whole one, of the blade, and of how sand flows."""

    pose: Pose
    ahead: jax.Array
    part: jax.Array
    width: jax.Array
    thickness: jax.Array
    bottom: jax.Array
    rate: jax.Array
    drop: jax.Array


def _straight(cos: jax.Array, sin: jax.Array) -> Shares:
    """The shares for the direction of travel."""
    longest = jnp.maximum(jnp.abs(cos), jnp.abs(sin))
    return shares(cos / longest, sin / longest)


def _stencil(share: Shares, x: jax.Array) -> jax.Array:
    """The neighbours of every cell of a map with halo, each times its share."""
    return sum((s * at(x, di, dj) for (di, dj), s in zip(EIGHT, share, strict=True)), jnp.zeros((), x.dtype))


def _covers(job: Job, pose: Pose, end: Pose, ahead: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
    """The share of each cell that the blade covers before it moves, while it moves, and after it."""
    dx = job.bed.spacing
    before = coverage(job.tool, pose, job.x, job.y, dx, _LESS * dx)
    return before, coverage(job.tool, pose, job.x, job.y, dx, ahead), coverage(job.tool, end, job.x, job.y, dx)


def _pull_covers(job: Job, pose: Pose, ahead: jax.Array, cotangents: tuple) -> tuple[Pose, tuple]:
    """The cotangents of the pose, and of the blade's width and thickness and the way ahead, from those of the covers."""
    dx = job.bed.spacing

    along, across = local(pose, job.x, job.y)
    half, side = job.tool.thickness / 2, job.tool.width / 2
    begin, less, ahead_end, moved = (-half, half + _LESS * dx, half + ahead, ahead - half)

    def rising(s: jax.Array, edge: jax.Array) -> jax.Array:
        part = (s - edge) / dx + 0.5
        return jnp.where((part > 0) & (part < 1), 1 / dx, 0)

    of_before, of_swept, of_after = adjoint.stored(list(cotangents))
    beside = interval(across, -side, side, dx)
    covered = (
        of_before * interval(along, begin, less, dx)
        + of_swept * interval(along, begin, ahead_end, dx)
        + of_after * interval(along, moved, ahead_end, dx)
    )
    # One map for each edge of the intervals: how much more they would cover if that edge moved outwards.
    edges = adjoint.stored(
        [
            (of_before + of_swept) * beside * rising(along, begin),
            of_before * beside * rising(along, less),
            (of_swept + of_after) * beside * rising(along, ahead_end),
            of_after * beside * rising(along, moved),
            covered * rising(across, -side),
            covered * rising(across, side),
        ]
    )
    rear, less_front, front, moved_rear, right, left = [jnp.sum(e, axis=0) for e in edges]
    py = job.y - pose.y
    ay = jnp.sum((edges[0] + edges[3] - edges[1] - edges[2]) * py, axis=0)
    cy = jnp.sum((edges[4] - edges[5]) * py, axis=0)
    a, c, px = rear + moved_rear - less_front - front, right - left, job.x[0] - pose.x
    dpose = Pose(
        jnp.sum(c * pose.sin - a * pose.cos),
        jnp.sum(-a * pose.sin - c * pose.cos),
        jnp.sum(a * px + cy),
        jnp.sum(ay - c * px),
    )
    thickness = jnp.sum(rear + moved_rear + less_front + front) / 2
    return dpose, (jnp.sum(right + left) / 2, thickness, jnp.sum(front - moved_rear))


def _stretching(cover: jax.Array) -> jax.Array:
    """The derivative of `stand`'s stretch by the cover."""
    free = 1 - cover
    room = jnp.maximum(free, NARROW)
    return 1 / room + jnp.where(free > NARROW, cover / (room * room), 0)


def _pull_contact(job: Job, cover: jax.Array, h: jax.Array, cotangent: jax.Array) -> tuple[jax.Array, jax.Array]:
    """The cotangents of the cover and of the height from that of `contact`, shared by cells that are equally deep in."""
    nearer = 1 + (h - job.bottom) / job.bed.spacing
    near = jnp.where(jnp.isnan(h), 0, jnp.clip(nearer, 0, 1))
    depth = near * cover
    most = jnp.max(jnp.max(depth, axis=0))
    deepest = jnp.where(depth == most, 1.0, 0.0).astype(h.dtype)
    scale = jnp.where(2 * most < 1, 2 * cotangent, 0) / total(deepest)
    rising = jnp.where((nearer > 0) & (nearer < 1), cover / job.bed.spacing, 0)
    return scale * deepest * near, scale * deepest * rising
