"""A wheel's push in sub-steps: it is lowered, turned and moved at its sinkage, and the sand around it is kept at rest.

It proceeds as a blade's push does (blade_stepped.py): in each sub-step the sand that the wheel newly covers is displaced
(_wheel.py), and the sand around it is brought to rest (resting.py). When the wheel is lowered, sand is displaced along the
gradient of (along / chord)^2 + (aside / width)^2. At a corner it turns in place, by the smaller angle, in sub-steps of an
angle; the sand that it sweeps is displaced along its axle. Sand under the wheel moves on by up to four cells in a sub-step;
one or two percent of all that is displaced waits under the wheel.

Derivatives by the height, by the sinkage and, at oblique slip angles, by the width are useful. Derivatives by the stroke and
the slip angle, and by the width of a wheel that runs along its plane, are not: along the wheel's flanks the map depends on
the shares of single cells, so that it is rough on that scale. Take finite differences over a cell there, or `SplitPush`.

Source: arXiv:1908.02745, "Tool Interaction", where sand leaves in the direction of travel; at slip angles below the angle of
repose and above its complement the two agree.
"""

import math
from dataclasses import replace
from typing import TYPE_CHECKING

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxsand.autodiff.while_loop import Tree, repeat, repeat_until
from jaxsand.interaction._block import Block, Moving, Way
from jaxsand.interaction._displacement import Job
from jaxsand.interaction._path import Pushed, Record, State, along_legs, over_the_map, turn_between
from jaxsand.interaction._rolling import Roll, Touchdown, Turn
from jaxsand.interaction._wheel import Track
from jaxsand.interaction.resting import no_flux
from jaxsand.scene.scene import Scene
from jaxsand.scene.tools import Pose, Smooth, carried_area, half_chord
from jaxsand.scene.window import Window

if TYPE_CHECKING:
    from jaxsand.interaction.stepped import SteppedPush


def roll_along(
    scene: Scene, height: Float[Array, "H W"], path: Float[Array, "n 2"], push: "SteppedPush", record: Record | None = None
) -> tuple[Pushed, Tree]:
    """Lowers the wheel at path[0], moves it along the legs of `path` [n, 2] (m) and lifts it; see `along_legs`."""

    def leg(job: Job, pose: Pose, length: jax.Array, before: Pose | None, state: State) -> State:
        return _leg(scene, push, job, pose, length, before, state)

    return along_legs(scene, height, path, push.rate, leg, record)


def _leg(
    scene: Scene, push: "SteppedPush", job: Job, pose: Pose, length: jax.Array, before: Pose | None, state: State
) -> State:
    """Lowers the wheel, or turns it from the pose before, and moves it ahead by `length` (m), skipping parts off the map."""
    shape, drains = scene.grid.shape, job.bed.rim is not None
    size = max(shape)
    if isinstance(scene.window, Window):
        size = min(size, max(scene.window.size))
    block = Block(shape, size, size, size < max(shape), scene.grid.neighbours, drains)
    h, lost, moved = state
    none = no_flux(block.neighbours, drains, jnp.zeros((size, size), h.dtype))
    flat, gone = jax.tree.map(lambda x: x.reshape(-1), (h, lost))
    sand = Moving(flat, gone, none, moved)
    zero = jnp.zeros_like(length)
    if before is None:
        sand = repeat(Touchdown(block), 1, _track(job, pose, zero, zero), sand)
    else:
        angle = turn_between(before, pose)
        turn = Turn(block, substep=push.substep, sweeps=push.sweeps)
        bound = math.ceil(math.pi * math.hypot(*shape) / push.substep) + 1
        turned = _track(job, Pose(pose.x, pose.y, before.cos, before.sin), zero, angle)
        sand, _ = repeat_until(turn.turned, turn, bound, turned, sand)
    start, onmap = over_the_map(scene, job, pose, length)
    chunk = max(1, int(1 / push.substep))
    # make_scene holds radius and width below the map's diagonal, so four times that is enough.
    bound = math.ceil((4 * math.hypot(*shape) + 3) / (push.substep * chunk)) + 1
    roll = Roll(block, substep=push.substep, sweeps=push.sweeps, chunk=chunk, lowered=before is None)
    track = _track(job, start, onmap, zero)
    sand, _ = repeat_until(roll.arrived, roll, bound, track, replace(sand, flux=none))
    h, lost = jax.tree.map(lambda x: x.reshape(shape), (sand.height, sand.lost))
    return h, lost, sand.edge


def _track(job: Job, pose: Pose, length: jax.Array, angle: jax.Array) -> Track:
    """A leg of the wheel in spacings; `angle` is the turn in place before it (rad)."""
    dx, wheel, drop, rim = job.bed.spacing, job.tool, job.bed.drop, job.bed.rim
    chord = half_chord(wheel)
    way = Way(
        Pose(pose.x / dx, pose.y / dx, pose.cos, pose.sin),
        length / dx,
        chord / dx,
        jnp.asarray(wheel.width) / dx / 2,
        job.bottom,
        dx,
        job.flow.quantum,
        drop.reshape(-1) if drop.ndim else drop,
        None if rim is None else rim.level,
        job.flow.rate,
        angle,
    )
    carried = None if isinstance(wheel.grousers, Smooth) else carried_area(wheel, wheel.grousers) / dx
    return Track(way, jnp.asarray(wheel.radius) / dx, jnp.asarray(wheel.slip_angle), carried)
