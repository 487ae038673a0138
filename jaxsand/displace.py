"""Where sand goes that a tool displaces.

Whenever the share of a cell that the tool covers grows from a to b, the share (b - a) / (1 - a) of its sand above the
tool's bottom has to leave. It goes to neighbouring cells, to the one or two of the eight that lie in its direction, shared
as the direction divides the angle between them; it comes to rest in their open share and moves on in the rest. Sand that
has nowhere to go, at a wall or a closed edge, stays in its column until the tool leaves it; over a draining edge it is
lost. Every amount is a whole number of quanta (see bed.py), so that volume is kept as well as floats allow.
"""

from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp

from jaxsand.around import Beside
from jaxsand.bed import Bed, Lost, at, halo, lose, truncate
from jaxsand.flux import stand
from jaxsand.loop import Plain, repeat, repeat_until, split
from jaxsand.sweep import Flow
from jaxsand.tool import Pose

EIGHT = tuple((di, dj) for di in (-1, 0, 1) for dj in (-1, 0, 1) if di or dj)
Shares = list[jax.Array]


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Job:
    """What every part of a push needs: the bed, the cell centres (m), the tool, its bottom's height (m), how sand flows."""

    bed: Bed
    x: jax.Array  # [1, W]
    y: jax.Array  # [H, 1]
    tool: Any  # a Blade or a Wheel
    bottom: jax.Array  # [], or [H, W] where it is not flat
    flow: Flow


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Hanging:
    """A tool over the share `cover` of each cell, its bottom at height `bottom` [H, W] (m): there is room below it."""

    cover: jax.Array
    bottom: jax.Array

    def rest(self, h: jax.Array, received: jax.Array) -> jax.Array:
        below = jnp.minimum(received, jnp.where(h < self.bottom, self.bottom - h, 0))
        return (1 - self.cover) * received + self.cover * below


def take(job: Job, h: jax.Array, before: jax.Array, cover: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Takes up the sand that has to leave as the cover grows: the height left and the height taken."""
    grown = cover > before
    share = jnp.where(grown, (cover - before) / jnp.where(grown, 1 - before, 1), 0)
    taken = whole(job, share * jnp.where(h > job.bottom, h - job.bottom, 0))
    return h - taken, taken


def pass_on(
    job: Job, share: Shares, free: jax.Array | Hanging, h: jax.Array, lost: Lost, carried: jax.Array
) -> tuple[jax.Array, Lost, jax.Array]:
    """Hands `carried` [H, W] on by one cell, the shares for the eight neighbours given; it rests where cells are `free`, or
    where there is room below a tool."""
    cut = job.flow.quantum
    room = halo(jnp.where(jnp.isnan(h), 0.0, 1.0).astype(h.dtype), 0.0)
    if job.bed.rim is not None:
        room = room + job.bed.rim.beyond
    source = halo(carried / cut, 0.0)  # from here on in quanta
    here = at(source)
    received, kept = jnp.zeros_like(h), here
    for (di, dj), s in zip(EIGHT, share, strict=True):
        given = truncate(s * here) * at(room, di, dj)
        kept = kept - given
        s_there = at(halo(s, 0.0), -di, -dj) if s.ndim else s
        received = received + truncate(s_there * at(source, -di, -dj))
        if job.bed.rim is not None and lost is not None:
            lost = lose(cut, lost, given * cut * at(job.bed.rim.beyond, di, dj))
    received = received * at(room)
    rest = truncate(free.rest(h, received * cut) / cut if isinstance(free, Hanging) else free * received)
    return h + (rest + kept) * cut, lost, (received - rest) * cut


def shares(p: jax.Array, q: jax.Array) -> Shares:
    """Shares of the eight neighbours for a direction (p along columns, q along rows) of largest component 1 or less.

    Bilinear; the part that would stay in place goes to the four straight neighbours alike.
    """
    columns = {-1: jnp.maximum(-p, 0), 0: 1 - jnp.abs(p), 1: jnp.maximum(p, 0)}
    rows = {-1: jnp.maximum(-q, 0), 0: 1 - jnp.abs(q), 1: jnp.maximum(q, 0)}
    stay = rows[0] * columns[0] / 4
    return [rows[di] * columns[dj] + (stay if di == 0 or dj == 0 else 0) for di, dj in EIGHT]


def outwards(job: Job, pose: Pose, p: jax.Array, q: jax.Array) -> Shares:
    """The shares for a field of directions (p along columns, q along rows) of any length; shorter within a cell of the
    tool's centre."""
    size = jnp.maximum(jnp.abs(p), jnp.abs(q))
    cells = jnp.maximum(jnp.abs(job.x - pose.x), jnp.abs(job.y - pose.y)) / job.bed.spacing
    scale = jnp.where(size > 0, jnp.minimum(cells, 1) / jnp.where(size > 0, size, 1), 0)
    return shares(p * scale, q * scale)


def spread(
    job: Job, share: Shares, free: jax.Array | Hanging, h: jax.Array, lost: Lost, carried: jax.Array
) -> tuple[jax.Array, Lost]:
    """Hands `carried` on until all of it rests."""
    rows, columns = h.shape
    params = (job, share, free)
    (h, lost, carried), _ = repeat_until(_at_rest, Onward(), rows + columns, params, (h, lost, carried))
    return h + carried, lost


def contact(job: Job, cover: jax.Array, h: jax.Array) -> jax.Array:
    """1 while the blade is among the sand, falling to 0 where it covers no cell or hangs a spacing above all it covers.

    Keeps a tool that touches nothing from moving sand that is still only to a tolerance.
    """
    above = jnp.where(jnp.isnan(h), -jnp.inf, h) - job.bottom
    near = jnp.clip(1 + jnp.maximum(above, -job.bed.spacing) / job.bed.spacing, 0, 1)
    return jnp.minimum(1, 2 * jnp.max(jnp.max(near * cover, axis=0)))


def settle_around(job: Job, flow: Flow, sweeps: int, cover: jax.Array, h: jax.Array, lost: Lost) -> tuple[jax.Array, Lost]:
    """Sweeps the sand around a blade that covers the share `cover` of each cell."""
    return repeat(Beside(sweeps), 1, (job.bed, flow, stand(cover, job.bottom)), (h, lost))


def _at_rest(params: Any, _: jax.Array, state: Any) -> jax.Array:
    return ~jnp.any(state[2] > 0)


@dataclass(frozen=True)
class Onward:
    """Sand handed on by one cell as a step of a loop; `params` are the job, the shares [H, W] and what is free.

    With c what is carried, r what cells receive and f what of it rests there, lambda and kappa the cotangents of the height
    and of what is carried on, and rho = f lambda + (1 - f) kappa where there is room, backwards: (lambda - kappa) r for f,
    c (rho there - lambda here) for the share s of a neighbour with room, and lambda + the sum of s (the same) for c.
    """

    tape: int = 16

    def __call__(self, params: Any, k: jax.Array, state: Any) -> Any:
        return pass_on(*params, *state)

    def recorded(self, params: Any, k: jax.Array, state: Any) -> tuple[Any, Any]:
        return self(params, k, state), state

    def push(self, params: Any, k: jax.Array, record: Any, dparams: Any, dstate: Any) -> Any:
        return Plain(self).push(params, k, record, dparams, dstate)

    def pull(self, params: Any, k: jax.Array, record: Any, cotangent: Any) -> tuple[Any, Any]:
        job, share, free = params
        if job.bed.rim is not None or isinstance(free, Hanging) or not share[0].ndim:
            return Plain(self).pull(params, k, record, cotangent)
        (h, _, carried), (gain, _, onward) = record, cotangent
        holds = jnp.where(jnp.isnan(h), 0.0, 1.0).astype(h.dtype)
        room, there = halo(holds, 0.0), halo(holds * (free * gain + (1 - free) * onward), 0.0)
        received, of_carried, of_share = jnp.zeros_like(h), gain, []
        for (di, dj), s in zip(EIGHT, share, strict=True):
            more = at(there, di, dj) - gain * at(room, di, dj)
            received = received + at(halo(s * carried, 0.0), -di, -dj)
            of_carried = of_carried + s * more
            of_share.append(carried * more)
        of_free = received * holds * (gain - onward)
        floats = split((jax.tree.map(jnp.zeros_like, job), of_share, of_free))[0]
        return floats, (gain, None, of_carried)


def whole(job: Job, amount: jax.Array) -> jax.Array:
    """Cut to whole quanta."""
    return truncate(amount / job.flow.quantum) * job.flow.quantum
