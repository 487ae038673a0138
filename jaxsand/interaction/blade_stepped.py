"""A blade's push in sub-steps: it is lowered, turned and moved, and the sand around it is kept at rest.

In the quasi-static limit a tool is so slow that the sand is always at rest. The blade advances by sub-steps of a fixed part
of a spacing. In each, the sand that it newly covers is displaced along the normal of its face (_blade.py), and the sand
around it is brought to rest (resting.py). When the blade is lowered, the sand that it covers is displaced along the gradient
of (s / thickness)^2 + (n / width)^2, with s along and n across the blade. At a corner the blade turns in place, by the
smaller angle, in sub-steps of an angle; the sand that it sweeps is displaced along the normals of its faces. A reversal is
half a turn, to the left. Where the bottom sinks on the way, the sand that comes to lie above it leaves to the front too;
under a bottom that rises, the floor is where the front left it (`Advance.floor`).

Source: arXiv:1908.02745, "Tool Interaction"; shares of a cell in place of whole ones make the result continuous in the
stroke.
"""

import math
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from jaxsand.autodiff.while_loop import Tree
from jaxsand.interaction._advance import Advance, Rest
from jaxsand.interaction._block import SPARE, Block, Way
from jaxsand.interaction._displacement import Site
from jaxsand.interaction._leg import LegSteps, chunk, moved, way_of
from jaxsand.interaction._lowering import Lower
from jaxsand.interaction._path import Pushed, Record, State, along_legs, heading, travelled, upright
from jaxsand.interaction._turning import BladeTurn
from jaxsand.interaction.resting import bring_to_rest
from jaxsand.relaxation.ghost_cells import ExactSum
from jaxsand.scene.footprint import Pose
from jaxsand.scene.scene import Scene
from jaxsand.scene.tools import Blade, Number
from jaxsand.scene.validation import concrete
from jaxsand.scene.window import AsNeeded, Window

if TYPE_CHECKING:
    from jaxsand.interaction.stepped import SteppedPush

Length = TypeVar("Length", float, jax.Array)


def push_along(
    scene: Scene,
    height: Float[Array, "H W"],
    path: Float[Array, "n _"],
    push: "SteppedPush",
    record: Record | None = None,
    rest: Rest = bring_to_rest,
) -> tuple[Pushed, Tree]:
    """Lowers the blade at path[0], moves it along the legs of `path` (m) and lifts it; see `along_legs`.

    `rest` is the function that brings the sand to rest after each sub-step.
    """

    leg = partial(_leg, scene, push, rest, path.shape[0] > 2)
    return along_legs(scene, height, path, push.rate, leg, record, rises=True)


def scoop_along(
    scene: Scene,
    height: Float[Array, "H W"],
    path: Float[Array, "n 3"],
    push: "SteppedPush",
    room: Float[Array, ""],
    record: Record | None = None,
) -> tuple[Pushed, Tree, ExactSum]:
    """Moves a bucket's edge along `path` (m); what it cuts goes into the bucket, up to a sum of heights of `room` (m).

    The scene's tool is a blade as wide as the edge, a cell thick at most. It is moved such that its rear starts at path[0]
    and its front ends at path[-1], so that what it cuts lies between the path's ends. First and last legs shorter than half
    a cell are cut a little beyond their ends. Every leg keeps some of its length, and thereby its heading.

    Returns the map, what `record` returned after each leg, and the account of the sum of heights (m) in the
    bucket.
    """
    runs = path[1:] - path[:-1]
    lengths = jax.vmap(lambda start, stop: heading(start, stop, None)[1])(path[:-1, :2], path[1:, :2])
    dx = scene.grid.spacing
    thick = jnp.clip(_KEEPS * jnp.sum(lengths), 1e-6 * dx, dx)
    ends = lengths[jnp.array([0, -1])]
    most = ends / 2 if path.shape[0] == 2 else ends
    parts = jnp.minimum(thick / 2, _KEEPS * most) / jnp.where(ends > 0, ends, 1)
    moved = path.at[0].add(parts[0] * runs[0]).at[-1].add(-parts[1] * runs[-1])
    path = jnp.where(jnp.any(upright(path)), jnp.nan, moved)
    scene = replace(scene, tool=replace(scene.tool, thickness=thick, depth=jnp.max(-path[:, 2])))
    leg = partial(_leg, scene, push, bring_to_rest, path.shape[0] > 2)
    pushed, frames, scooped = travelled(scene, height, path, push.rate, leg, record, rises=True, room=room)
    assert scooped is not None
    return pushed, frames, scooped


def _leg(
    scene: Scene,
    push: "SteppedPush",
    rest: Rest,
    keeps: bool,
    site: Site,
    pose: Pose,
    length: jax.Array,
    before: Pose | None,
    state: State,
) -> State:
    """Lowers the blade, or turns it from the pose before, and moves it ahead by `length` (m); see `moved`."""
    shape, dx, substep = scene.grid.shape, site.bed.spacing, push.substep
    size = near = max(shape)
    if isinstance(scene.window, Window) and max(scene.window.size) < size:
        size = max(scene.window.size)
        near = min(size, scene.window.near or size)
    block = Block(shape, size, near, size < max(shape), scene.grid.neighbours, site.bed.rim is not None)
    if near < size:  # a traced blade may be larger than the one for which the window was made
        far = lax.stop_gradient(_far(*(size / dx for size in _body(site.tool, dx))))
        state = replace(state, moved=jnp.where(2 * jnp.floor(far) + 3 > near, jnp.inf, state.moved))

    def way(site: Site, pose: Pose, length: jax.Array, angle: jax.Array) -> Way:
        half, side = (jnp.asarray(extent) / dx / 2 for extent in (site.tool.thickness, site.tool.width))
        return way_of(site, pose, length, angle, half, side)

    steps = LegSteps(
        Lower(block),
        BladeTurn(block, substep=substep, sweeps=push.sweeps, rest=rest, keeps=keeps),
        Advance(
            block,
            substep=substep,
            sweeps=push.sweeps,
            chunk=chunk(substep),
            lowered=before is None,
            rest=rest,
            keeps=keeps,
        ),
        2 * math.hypot(*shape) + 3,  # make_scene holds the thickness below the map's diagonal
    )
    return moved(scene, site, steps, way, pose, length, before, state)


def with_near(scene: Scene) -> Scene:
    """The scene with its window's `near` set, if it has a window and the blade's size is known."""
    if not (isinstance(scene.window, Window) and isinstance(scene.tool, Blade)):
        return scene
    known = _known(*_body(scene.tool, scene.grid.spacing), scene.grid.spacing)
    if known is None:
        return scene
    width, thickness, dx = known
    far = _far(width / dx, thickness / dx)
    if not far < max(scene.grid.shape):
        return scene
    return replace(scene, window=replace(scene.window, near=2 * math.floor(far) + 3))


def _known(*leaves: ArrayLike) -> list[float] | None:
    """The values as numbers, or None if one of them is traced or an array for many scenes."""
    found = [concrete(x) for x in leaves]
    if any(x is None or x.ndim for x in found):
        return None
    return [float(x) for x in found if x is not None]


def _body(tool: Blade, spacing: Number) -> tuple[Number, Number]:
    """The width and the thickness (m) of the smallest blade without plates that covers this one."""
    if tool.plates is None:
        return tool.width, tool.thickness
    return tool.width + 2 * spacing, tool.thickness + 2 * tool.plates


def _far(width: Length, thickness: Length) -> Length:
    """The largest distance, in cells, from a block's middle to a cell that the blade covers.

    It allows for a footprint smoothed over a spacing, and for a block that stays put while the blade moves by a spacing.
    """
    return ((width + 1) ** 2 + (thickness + 1) ** 2) ** 0.5 / 2 + 1


_KEEPS = 0.98  # of its length a leg of a bucket's edge loses less than that to the edge's thickness
_TOLERANCE = 1e-3  # a window's tolerance: the slope above repose that settling leaves by default
_LEAST = 1.5  # a map's width over a window's, from which on the window saves work


def windows_for(scene: Scene, times: float = 1) -> Iterator[Scene]:
    """The scene with windows around its blade, each twice as wide as the one before, as long as that saves work.

    The first is `times` as wide as the blade and the heap that it pushes. The next is for sand that reaches its edge.
    """
    if not (isinstance(scene.window, AsNeeded) and isinstance(scene.tool, Blade)):
        return
    known = _known(*_body(scene.tool, scene.grid.spacing), scene.tool.depth, scene.grid.spacing)
    angle = concrete(scene.material.repose_angle)
    if angle is None or known is None:
        return
    width, thickness, depth, dx = known
    heap = math.sqrt(width * max(depth, dx / 2) / math.tan(float(np.min(angle))))
    spread = 2 if scene.grid.neighbours == "isotropic" else 0  # whose gradients reach farther
    cells = times * (math.hypot(width, thickness) + 3.3 * heap) / dx + 2 * SPARE + spread
    if not cells * _LEAST <= max(scene.grid.shape):
        return
    size = 2 * math.ceil(cells / 2)
    while size * _LEAST <= max(scene.grid.shape):
        rows, columns = scene.grid.shape
        window = Window((min(size, rows), min(size, columns)), jnp.asarray(_TOLERANCE, jnp.result_type(scene.grid.spacing)))
        yield with_near(replace(scene, window=window))
        size *= 2
