"""Forces of the sand on a tool along its path: `follow`, and what the tool feels on the way.

Each leg is cut into equal sub-steps. After each the sand ahead of a blade or a bucket's edge is read, as it stands then, and
gives the force by the fundamental equation of earthmoving (cutting.py), with the ground as it was found for the undisturbed
level and all above it for a heap. A wheel's force is given by its sinkage below the ground as it was found (bearing.py).
Nothing of this acts back on the tool or the sand.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import jax
import jax.numpy as jnp
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from jaxsand.interaction import substeps as parts
from jaxsand.interaction.bucket import scoop_frames
from jaxsand.interaction.ground import ground_of
from jaxsand.interaction.load import Load
from jaxsand.interaction.simulate import Path, Shaped, as_path, follow, follow_frames
from jaxsand.interaction.stepped import SteppedPush
from jaxsand.relaxation.schemes import Scheme
from jaxsand.relaxation.stopping import Stop, check_whole
from jaxsand.scene.bearing import wheel_force
from jaxsand.scene.boundaries import Base
from jaxsand.scene.footprint import Pose
from jaxsand.scene.scene import Scene, cast, check_scene, fit
from jaxsand.scene.soil import WONG_DRY_SAND, Soil, check_soil
from jaxsand.scene.tools import Blade, Bucket, Wheel, slip_of, soil_of, square, sunk
from jaxsand.terramechanics.cutting import cut_ahead, cut_force

Felt = tuple[jax.Array, jax.Array, jax.Array]  # force (N) and moment (N m), [3] each, and work for each metre (N)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class ForceTrace:
    """What a tool feels along a path, after each of m sub-steps. Of a batch, every field has the batch axis in front.

    Attributes:
      length: of the sub-steps (m), [m].
      pose: the tool's at the end of each sub-step, [m] each.
      force: of the sand on the tool (N), [m, 3]: along x, along y, and up.
      moment: of that force (N m), [m, 3]: about the middle of a blade's bottom or a bucket's edge, or a wheel's axle.
      work: done on the sand in each sub-step (J), [m]; the energy of a path is its sum.

    Example:
      >>> import jax
      >>> import jax.numpy as jnp
      >>> import jaxsand as js
      >>> scene = js.make_scene((8, 8), 0.01, tool=js.Wheel(radius=0.03, width=0.02, load=2.0, slip=0.2))
      >>> path = jnp.array([[0.02, 0.04], [0.06, 0.04]])
      >>> feel = jax.jit(lambda path: js.forces.follow_forces(scene, jnp.zeros((8, 8)), path, substeps=4)[1])
      >>> trace = feel(path)  # the map is not asked for, and not computed
      >>> trace.force.shape, round(float(trace.force[0, 2]), 3)
      ((4, 3), 2.0)
      >>> bool(jnp.allclose(trace.power(0.5), trace.work / 0.01 * 0.5))
      True
    """

    length: Float[Array, "*batch m"]
    pose: Pose
    force: Float[Array, "*batch m 3"]
    moment: Float[Array, "*batch m 3"]
    work: Float[Array, "*batch m"]

    def power(self, speed: Float[ArrayLike, ""]) -> Float[Array, "*batch m"]:
        """The mean power (W) in each sub-step at a speed (m/s): work / length * speed, 0 in sub-steps of no length."""
        moves = self.length > 0
        return jnp.where(moves, self.work / jnp.where(moves, self.length, 1), 0) * speed


def follow_forces(
    scene: Scene,
    height: Float[ArrayLike, "H W"],
    path: Path,
    soil: Soil | None = None,
    *,
    substeps: int = 16,
    load: Load | None = None,
    push: SteppedPush | None = None,
    scheme: Scheme | None = None,
    stop: Stop | None = None,
) -> tuple[Shaped, ForceTrace]:
    """`follow`, or `scoop` with a bucket, and the forces on the tool on its way.

    A blade or a bucket's edge feels the `cut_force` of the `cut_ahead`: sand below the ground as it was found is cut, and
    sand above it is a heap that weighs on what is cut. The force acts on the face's middle, a third of the cut's depth above
    the bottom. Its work is draught times way. What a bucket holds has no weight here.

    A wheel feels the `wheel_force` at its sinkage below the ground as it was found: its own under a load. Pull and load act
    in the wheel's plane, the torque about its axle; a force along the axle is left out. Its work on the sand is
    torque times turning less pull times way, which is without bound as the slip goes to 1. It is NaN where the wheel stands
    deeper than its axle, and feels nothing off the map.

    The work of a sub-step is the mean of what is felt at its ends, times its length: of second order in that where the force
    is smooth. A turn in place costs nothing. The map is that of a path with as many legs as there are sub-steps, whose
    heights are kept: m maps. A blade or an edge cuts no floor (`Base`), and feels none. Differentiable like `follow`, in the
    soil too.

    Args:
      scene: the scene, with a `Blade` that stands square to its way, a `Wheel` or a `Bucket`.
      height: height map [H, W] (m).
      path: as of `follow`, or `scoop`.
      soil: the soil's strength; None for a dry sand, `WONG_DRY_SAND`. A wheel under a load has its own.
      substeps: number of sub-steps in each leg; static.
      load: of a bucket, as of `scoop`.
      push: `SteppedPush`, as of `step`.
      scheme: as of `settle`.
      stop: as of `settle`.

    Returns:
      The result of `follow` or `scoop`, and the forces after each of the m = substeps (n - 1) sub-steps.

    Raises:
      ValueError: an argument has the wrong shape or is out of range, the tool is another, or a wheel rolls on a `Base`.

    Source: cutting.py and bearing.py say whose equations these are.

    Example:
      A heap grows ahead of a blade, and so does the force.

      >>> import jax.numpy as jnp
      >>> import jaxsand as js
      >>> scene = js.make_scene((8, 16), 0.01, tool=js.Blade(width=0.04, depth=0.01))
      >>> path = jnp.array([[0.03, 0.04], [0.1, 0.04]])
      >>> shaped, trace = js.forces.follow_forces(scene, jnp.zeros((8, 16)), path, substeps=4)
      >>> draught = -trace.force[:, 0]
      >>> bool(draught[-1] > draught[0] > 0), trace.work.shape
      (True, (4,))
    """
    check_scene(scene)
    check_whole("substeps", substeps, 1)
    if push is not None and not isinstance(push, SteppedPush):
        raise ValueError(f"push: got {type(push).__name__}; forces along a path are of a SteppedPush(substep, sweeps)")
    tool = scene.tool
    if isinstance(tool, Blade):
        square(tool)
    elif not isinstance(tool, Wheel | Bucket):
        raise ValueError(f"scene.tool: got {type(tool).__name__}; give the scene a Blade, a Wheel or a Bucket")
    if isinstance(tool, Wheel) and isinstance(scene.base, Base):
        raise ValueError("scene.base: got a Base under a wheel, whose forces on a floor are not known; give Deep()")
    if soil is not None:
        if not isinstance(soil, Soil):
            raise ValueError(f"soil: got {type(soil).__name__}; give a js.forces.Soil, or None for a dry sand")
        check_soil(soil)
    if load is not None and not isinstance(tool, Bucket):
        raise ValueError(f"load: got one for a {type(tool).__name__}; only a Bucket has one")
    if isinstance(tool, Wheel) and tool.load is not None and soil is not None:
        raise ValueError("soil: got one for a wheel under a load, which has its own; give Wheel(load=, soil=) and soil=None")
    fitted, height = fit(scene, height)
    points = parts.cut(as_path(path, height.dtype), substeps)
    soil = cast(WONG_DRY_SAND if soil is None else soil, height.dtype)
    if isinstance(tool, Wheel):
        shaped = follow(scene, height, path, push=push, scheme=scheme, stop=stop)
        return shaped, _of_wheel(fitted, height, points, soil)
    shaped, frames = (
        scoop_frames(scene, height, points, load, push=push, scheme=scheme, stop=stop)
        if isinstance(tool, Bucket)
        else follow_frames(scene, height, points, push=push, scheme=scheme, stop=stop)
    )
    return shaped, _of_blade(fitted, height, points, soil, frames)


@jax.jit
def _of_blade(scene: Scene, height: jax.Array, points: jax.Array, soil: Soil, frames: jax.Array) -> ForceTrace:
    """The forces on a blade, or a bucket's edge, that found `height` and left `frames` [m, H, W] after its sub-steps."""
    tool = scene.tool
    assert isinstance(tool, Blade | Bucket)
    blade = tool if isinstance(tool, Blade) else Blade(tool.width, scene.grid.spacing, tool.depth)
    sand = ground_of(scene, height).sand > 0
    depths = -points[:, 2] if points.shape[1] == 3 else jnp.full_like(points[:, 0], blade.depth)

    def felt(pose: Pose, depth: jax.Array, height_now: jax.Array) -> Felt:
        here = replace(scene, tool=replace(blade, depth=depth))
        cut = cut_ahead(here, jnp.where(sand, height_now, -jnp.inf), pose, soil, jnp.where(sand, height, 0))
        force = cut_force(soil, cut)
        tilt = -force.draught * cut.depth / 3 - force.lift * blade.thickness / 2
        along = jnp.stack([-force.draught * pose.cos, -force.draught * pose.sin, force.lift])
        return along, tilt * jnp.stack([-pose.sin, pose.cos, jnp.zeros_like(tilt)]), force.draught

    maps = jnp.concatenate([height[None], frames])
    return _trace(points, felt, (depths, maps))


@jax.jit
def _of_wheel(scene: Scene, height: jax.Array, points: jax.Array, soil: Soil) -> ForceTrace:
    """The forces on a wheel that found the ground of `height`."""
    wheel = scene.tool
    assert isinstance(wheel, Wheel)
    ground, slip, dx = ground_of(scene, height), jnp.asarray(slip_of(wheel), height.dtype), scene.grid.spacing
    rows, columns = scene.grid.shape
    fixed = wheel.load is None
    rolled, soil = (wheel, soil) if fixed else (sunk(wheel)[0], cast(soil_of(wheel), height.dtype))
    bottoms = points[:, 2] if points.shape[1] == 3 else jnp.full_like(points[:, 0], -rolled.sinkage)

    def felt(pose: Pose, bottom: jax.Array) -> Felt:
        deep = jnp.asarray(rolled.sinkage)
        if fixed:
            deep = jnp.maximum(ground.level(wheel, pose, jnp.zeros_like(bottom)[None])[0] - bottom, 0)
        there = (pose.x >= 0) & (pose.x <= columns * dx) & (pose.y >= 0) & (pose.y <= rows * dx)
        sound = deep <= wheel.radius
        force = wheel_force(soil, wheel.radius, wheel.width, jnp.where(there & sound, deep, 0), slip)
        force = jax.tree.map(lambda f: jnp.where(sound | ~there, f, jnp.nan), force)
        cos, sin = jnp.cos(wheel.slip_angle), jnp.sin(wheel.slip_angle)
        ahead = pose.cos * cos + pose.sin * sin, pose.sin * cos - pose.cos * sin  # the wheel's plane
        along = jnp.stack([force.pull * ahead[0], force.pull * ahead[1], force.load])
        moment = -force.torque * jnp.stack([-ahead[1], ahead[0], jnp.zeros_like(cos)])
        return along, moment, (force.torque / (wheel.radius * (1 - slip)) - force.pull) * cos

    return _trace(points, felt, (bottoms,))


def _trace(points: jax.Array, felt: Callable[..., Felt], at: tuple[jax.Array, ...]) -> ForceTrace:
    """The trace of `felt(pose, *values)`, where `at` has values at each of the points."""
    begin, length = parts.poses(points)
    end = replace(begin, x=points[1:, 0], y=points[1:, 1])
    _, _, before = jax.vmap(felt)(begin, *(values[:-1] for values in at))
    force, moment, after = jax.vmap(felt)(end, *(values[1:] for values in at))
    return ForceTrace(length, end, force, moment, (before + after) / 2 * length)
