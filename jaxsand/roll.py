"""What a wheel does to the sand: it is lowered, turned and moved at its sinkage, and the sand settles around it.

A wheel is a rim over each cell, at a height of its own (tool.py), with room below where it hangs above the sand. What comes
to lie above the rim as the wheel moves leaves it ahead: off the rim, or off the flank that leads, along that face's normal,
turned towards the wheel's way by the angle of repose at most, which is the friction of a rough face. Sand under the wheel is
handed on by up to four cells in a sub-step, until there is room; what is on its way, one or two percent of all that is
displaced, waits under the wheel. Grousers take some of what the rim displaces to behind the wheel.

Derivatives by the height, the sinkage and, at oblique angles, the width are of use; those by the stroke's place and the slip
angle, and by the width of a wheel that runs along its plane, are those of a map that is rough on the scale of a cell's share
along its flanks: take finite differences over a cell, or `SplitPush`.

Source: arXiv:1908.02745, "Tool Interaction", where sand leaves in the direction of travel; at slip angles below the angle of
repose and above its complement the two agree.
"""

import math
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp

from jaxsand.bed import Lost
from jaxsand.displace import Hanging, Job, Shares, contact, outwards, pass_on, settle_around, shares, spread, whole
from jaxsand.flux import NARROW
from jaxsand.legs import Pushed, State, along_legs, in_window, over_the_map
from jaxsand.loop import Plain, repeat_until
from jaxsand.push import SteppedPush
from jaxsand.scene import Scene
from jaxsand.swath import complete
from jaxsand.sweep import Flow
from jaxsand.tool import Pose, Smooth, carried_area, half_chord, interval, local, rim, wheel_frame

_PASSES = 4  # how many cells sand under the wheel moves on in a sub-step
_TOUCH = 0.25  # of a spacing below the rim, sand does not feel it


def roll_along(
    scene: Scene, height: jax.Array, path: jax.Array, push: SteppedPush, record: Callable[[jax.Array], Any] | None = None
) -> tuple[Pushed, Any]:
    """Lowers the wheel at path[0], moves it along the legs of `path` [n, 2] (m) and lifts it; see `along_legs`."""

    def leg(job: Job, pose: Pose, length: jax.Array, before: Pose | None, state: State) -> State:
        state = _lower(scene, push, job, pose, before, state)
        start, length = over_the_map(scene, job, pose, length)
        bound = math.ceil((4 * math.hypot(*scene.grid.shape) + 3) / push.substep)
        params = (scene, job, start, length)
        return repeat_until(partial(arrived, push), Plain(partial(_advance, push)), bound, params, state)[0]

    return along_legs(scene, height, path, push.rate, leg, record)


def step_ahead(
    substep: float, job: Job, start: Pose, length: jax.Array, k: jax.Array
) -> tuple[Pose, Pose, jax.Array, jax.Array]:
    """The poses before and after sub-step k of a leg, the way between (m), and which part of a whole sub-step that is."""
    whole = substep * job.bed.spacing
    begin = k.astype(whole.dtype) * whole
    ahead = jnp.minimum(whole, length - begin)
    pose = Pose(start.x + begin * start.cos, start.y + begin * start.sin, start.cos, start.sin)
    return pose, Pose(pose.x + ahead * pose.cos, pose.y + ahead * pose.sin, pose.cos, pose.sin), ahead, ahead / whole


def arrived(push: SteppedPush, params: Any, k: jax.Array, _: Any) -> jax.Array:
    _, job, _, length = params
    return k.astype(length.dtype) * push.substep * job.bed.spacing >= length


def _advance(push: SteppedPush, params: Any, k: jax.Array, state: State) -> State:
    """One sub-step: what comes to lie above the rim leaves ahead, and the sand settles around the wheel."""
    scene, job, start, length = params
    pose, end, ahead, part = step_ahead(push.substep, job, start, length, k)

    def move(job: Job, h: jax.Array, lost: Lost) -> tuple[jax.Array, Lost, jax.Array]:
        now = _over(job, end)
        h, carried = _take(job, h, _over(job, pose), now)
        h, carried = _carry_back(job, end, ahead, h, carried)
        share = _leaving(job, end)
        for _ in range(_PASSES):
            h, lost, carried = pass_on(job, share, now, h, lost, carried)
        return *_settle(job, push.sweeps, now, part, h + carried, lost), now.cover

    return in_window(scene, job, pose, state, move)


def _lower(scene: Scene, push: SteppedPush, job: Job, pose: Pose, before: Pose | None, state: State) -> State:
    """Lowers the wheel at `pose`, or turns it there from the pose `before`: what it displaces leaves radially."""

    def move(job: Job, h: jax.Array, lost: Lost) -> tuple[jax.Array, Lost, jax.Array]:
        now = _over(job, pose)
        old = _over(job, before) if before else Hanging(jnp.zeros_like(now.cover), now.bottom)
        h, carried = _take(job, h, old, now)
        h, lost = spread(job, _radial(job, pose), now, h, lost, carried)
        sweeps = math.ceil(push.sweeps / push.substep)
        return *_settle(job, sweeps, now, jnp.ones_like(job.bed.spacing), h, lost), now.cover

    return in_window(scene, job, pose, state, move)


def _over(job: Job, pose: Pose) -> Hanging:
    """The wheel at a pose; one that is not usable hangs above everything."""
    cover, bottom = rim(job.tool, pose, job.x, job.y, job.bed.spacing)
    return Hanging(cover, jnp.where(job.bottom < jnp.inf, bottom, jnp.inf))


def _take(job: Job, h: jax.Array, old: Hanging, new: Hanging) -> tuple[jax.Array, jax.Array]:
    """The height left and the height that has to leave as the wheel moves.

    Sand above the old rim stood beside the wheel, in the open share of its cell, of which the wheel now covers a part; what
    is still inside of the wheel, in cells without such a share, leaves as well.
    """
    above = jnp.where(h > old.bottom, h - old.bottom, 0)
    below = jnp.where(h > new.bottom, jnp.maximum(jnp.minimum(h, old.bottom) - new.bottom, 0), 0)
    part = jnp.maximum(new.cover - old.cover, 0) / jnp.maximum(1 - old.cover, NARROW)
    inside = jnp.clip(1 - (1 - new.cover) / NARROW, 0, 1)
    taken = whole(job, new.cover * below + jnp.maximum(part, inside) * above)
    return h - taken, taken


def _settle(job: Job, sweeps: int, wheel: Hanging, part: jax.Array, h: jax.Array, lost: Lost) -> tuple[jax.Array, Lost]:
    """Sweeps the sand around the wheel, which keeps it from flowing where it touches it."""
    job = replace(job, bottom=wheel.bottom)
    above, reach = jnp.where(jnp.isnan(h), -jnp.inf, h) - wheel.bottom, _TOUCH * job.bed.spacing
    touch = jnp.clip(1 + jnp.maximum(above, -reach) / reach, 0, 1)
    flow = Flow(job.flow.rate * (contact(job, wheel.cover, h) * part), job.flow.quantum)
    return settle_around(job, flow, sweeps, wheel.cover * touch, h, lost)


def _leaving(job: Job, pose: Pose) -> Shares:
    """The shares for the directions in which sand leaves the rim and, within two spacings of it, the leading flank."""
    slip, side = job.tool.slip_angle, jnp.sign(job.tool.slip_angle)
    friction = jnp.arctan(job.bed.drop / job.bed.spacing)
    rest = math.pi / 2 - jnp.abs(slip)  # a face that hardly leads hardly turns sand
    off_rim = -side * jnp.maximum(jnp.abs(slip) - friction, 0) * jnp.clip(rest / friction, 0, 1)
    off_flank = side * jnp.maximum(rest - friction, 0) * jnp.minimum(jnp.abs(slip) / friction, 1)
    _, c = wheel_frame(job.tool, pose, job.x, job.y)
    leads = jnp.clip((c * side - job.tool.width / 2) / job.bed.spacing + 2.5, 0, 1)
    turn = off_rim + leads * (off_flank - off_rim)
    p = pose.cos * jnp.cos(turn) - pose.sin * jnp.sin(turn)
    q = pose.sin * jnp.cos(turn) + pose.cos * jnp.sin(turn)
    straight = jnp.maximum(jnp.abs(p), jnp.abs(q))
    return shares(p / straight, q / straight)


def _carry_back(job: Job, pose: Pose, ahead: jax.Array, h: jax.Array, carried: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Grousers leave a part of what is displaced in the cut behind the wheel, over a quarter of its chord's length."""
    dx, wheel = job.bed.spacing, job.tool
    if isinstance(wheel.grousers, Smooth):
        return h, carried
    asked = carried_area(wheel, wheel.grousers) * ahead / dx**2
    chord, slip = half_chord(wheel), jnp.abs(wheel.slip_angle)
    s, n = local(pose, job.x, job.y)
    end = -chord * jnp.cos(slip) - wheel.width / 2 * jnp.sin(slip)
    side = (wheel.width * jnp.cos(slip) + chord * jnp.sin(slip)) / 2
    behind = interval(s, end - jnp.maximum(chord / 2, dx), end, dx) * interval(n, -side, side, dx)
    behind = jnp.where(jnp.isnan(h), 0, behind)
    room, total = jnp.sum(behind), jnp.sum(carried)
    part = jnp.where(room > 0, jnp.minimum(asked / jnp.where(total > 0, total, 1), 1), 0)
    back = whole(job, carried * part)
    put = whole(job, jnp.sum(back) * behind / jnp.where(room > 0, room, 1))
    return h + complete(job, back, put), carried - back


def _radial(job: Job, pose: Pose) -> Shares:
    """The shares for directions away from the wheel's centre, in the proportions of its chord and width."""
    wheel = job.tool
    a, c = wheel_frame(wheel, pose, job.x, job.y)
    along, across = a / half_chord(wheel) ** 2, 4 * c / wheel.width**2
    cos = pose.cos * jnp.cos(wheel.slip_angle) + pose.sin * jnp.sin(wheel.slip_angle)
    sin = pose.sin * jnp.cos(wheel.slip_angle) - pose.cos * jnp.sin(wheel.slip_angle)
    return outwards(job, pose, along * cos - across * sin, along * sin + across * cos)
