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
from functools import partial
from typing import TYPE_CHECKING

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxsand.autodiff.while_loop import Tree
from jaxsand.interaction._block import Block
from jaxsand.interaction._displacement import Site
from jaxsand.interaction._leg import LegSteps, Params, chunk, moved, way_of
from jaxsand.interaction._path import Pushed, Record, State, along_legs
from jaxsand.interaction._rolling import Roll, Touchdown, WheelTurn
from jaxsand.interaction._wheel import Track
from jaxsand.interaction.ground import Ground, ground_of
from jaxsand.relaxation.stopping import Outcome
from jaxsand.scene.footprint import Pose
from jaxsand.scene.scene import Scene
from jaxsand.scene.tools import Smooth, Wheel, carried_area, half_chord, sunk
from jaxsand.scene.window import Window

if TYPE_CHECKING:
    from jaxsand.interaction.stepped import SteppedPush


def roll_along(
    scene: Scene, height: Float[Array, "H W"], path: Float[Array, "n _"], push: "SteppedPush", record: Record | None = None
) -> tuple[Pushed, Tree]:
    """Lowers the wheel at path[0], moves it along the legs of `path` (m) and lifts it; see `along_legs`."""
    wheel = scene.tool
    assert isinstance(wheel, Wheel)
    if wheel.load is None:
        leg = partial(_leg, scene, push, path.shape[0] > 2, _track)
        return along_legs(scene, height, path, push.rate, leg, record, rises=True)
    if path.shape[1] == 3:
        raise ValueError(
            "path: got heights, but a wheel under a load stands where the soil carries it; give x and y alone, or load=None"
        )
    wheel, heavy = sunk(wheel)
    track = partial(_track_over, ground_of(scene, height))
    leg = partial(_leg, scene, push, path.shape[0] > 2, track)
    pushed, frames = along_legs(replace(scene, tool=wheel), height, path, push.rate, leg, record)
    return replace(pushed, outcome=jnp.where(heavy, jnp.int32(Outcome.NOT_CARRIED), pushed.outcome)), frames


def _leg(
    scene: Scene,
    push: "SteppedPush",
    keeps: bool,
    track: Params,
    site: Site,
    pose: Pose,
    length: jax.Array,
    before: Pose | None,
    state: State,
) -> State:
    """Lowers the wheel, or turns it from the pose before, and moves it ahead by `length` (m); see `moved`."""
    shape, substep, sweeps = scene.grid.shape, push.substep, push.sweeps
    size = max(shape)
    if isinstance(scene.window, Window):
        size = min(size, max(scene.window.size))
    block = Block(shape, size, size, size < max(shape), scene.grid.neighbours, site.bed.rim is not None)
    steps = LegSteps(
        Touchdown(block),
        WheelTurn(block, substep=substep, sweeps=sweeps, keeps=keeps),
        Roll(block, substep=substep, sweeps=sweeps, chunk=chunk(substep), lowered=before is None, keeps=keeps),
        4 * math.hypot(*shape) + 3,  # make_scene holds radius and width below the map's diagonal
    )
    return moved(scene, site, steps, track, pose, length, before, state)


def _track(site: Site, pose: Pose, length: jax.Array, angle: jax.Array) -> Track:
    """A leg of the wheel in spacings; `angle` is the turn in place before it (rad)."""
    dx, wheel = site.bed.spacing, site.tool
    deepest = wheel.sinkage if site.rise is None else -jnp.minimum(site.bottom, site.bottom + length * site.rise)
    way = way_of(site, pose, length, angle, half_chord(wheel.radius, deepest) / dx, jnp.asarray(wheel.width) / dx / 2)
    carried = None if isinstance(wheel.grousers, Smooth) else carried_area(wheel, wheel.grousers) / dx
    return Track(way, jnp.asarray(wheel.radius) / dx, jnp.asarray(wheel.slip_angle), carried)


def _track_over(ground: Ground, site: Site, pose: Pose, length: jax.Array, angle: jax.Array) -> Track:
    """A leg of a wheel that follows the ground at its sinkage."""
    level, relief = ground.ahead(site.tool, pose, length)
    track = _track(replace(site, bottom=site.bottom + level), pose, length, angle)
    return replace(track, way=replace(track.way, relief=relief))
