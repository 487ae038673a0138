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

from jaxsand.advance import Advance
from jaxsand.bed import Lost
from jaxsand.displace import Job, contact, radial, settle_around, spread, take
from jaxsand.legs import Pushed, State, along_legs, in_window, over_the_map
from jaxsand.loop import repeat_until
from jaxsand.scene import Scene
from jaxsand.sweep import Flow
from jaxsand.tool import Pose, coverage


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


def push_along(
    scene: Scene, height: jax.Array, path: jax.Array, push: SteppedPush, record: Callable[[jax.Array], Any] | None = None
) -> tuple[Pushed, Any]:
    """Lowers the tool at path[0], moves it along the legs of `path` [n, 2] (m) and lifts it; see `along_legs`."""

    def leg(job: Job, pose: Pose, length: jax.Array, before: Pose | None, state: State) -> State:
        return _leg(scene, push, job, pose, length, _lower(scene, push, job, pose, before, state))

    return along_legs(scene, height, path, push.rate, leg, record)


def _leg(scene: Scene, push: SteppedPush, job: Job, pose: Pose, length: jax.Array, state: State) -> State:
    """Moves the blade ahead by `length`, as far as that touches the map, in sub-steps."""
    start, length = over_the_map(scene, job, pose, length)
    # make_scene holds the thickness below the map's diagonal, so twice the diagonal is enough.
    bound = math.ceil((2 * math.hypot(*scene.grid.shape) + 3) / push.substep)
    params = (scene, job, start, length)
    state, _ = repeat_until(partial(arrived, push), Advance(push.substep, push.sweeps), bound, params, state)
    return state


def arrived(push: SteppedPush, params: Any, k: jax.Array, _: Any) -> jax.Array:
    _, job, _, length = params
    return k * push.substep * job.bed.spacing >= length


def _lower(scene: Scene, push: SteppedPush, job: Job, pose: Pose, before: Pose | None, state: State) -> State:
    """Lowers the blade at `pose`, or turns it there from the pose `before`: what it newly covers leaves radially."""

    def move(job: Job, h: jax.Array, lost: Lost) -> tuple[jax.Array, Lost, jax.Array]:
        cover = coverage(job.tool, pose, job.x, job.y, job.bed.spacing)
        old = coverage(job.tool, before, job.x, job.y, job.bed.spacing) if before else jnp.zeros_like(cover)
        among = contact(job, cover, h)
        h, carried = take(job, h, old, jnp.maximum(cover, old))
        h, lost = spread(job, radial(job, pose), 1 - cover, h, lost, carried)
        if before is None:  # as many sweeps as for one spacing of travel
            flow = Flow(job.flow.rate * among, job.flow.quantum)
            h, lost = settle_around(job, flow, math.ceil(push.sweeps / push.substep), cover, h, lost)
        return h, lost, cover

    return in_window(scene, job, pose, state, move)
