"""One leg of a tool that moves in sub-steps, blades and wheels alike: it is lowered or turns in place, then moves ahead."""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, Protocol

import jax
import jax.numpy as jnp

from jaxsand.autodiff.while_loop import Step, Tree, repeat, repeat_until
from jaxsand.interaction._advance import LegStep
from jaxsand.interaction._block import Block, Moving, Way
from jaxsand.interaction._displacement import Site
from jaxsand.interaction._frame import Frame, frame_of
from jaxsand.interaction._kept import Kept, Laid, lay, seen
from jaxsand.interaction._path import State, over_the_map, turn_between
from jaxsand.interaction.resting import no_flux
from jaxsand.relaxation.flux import Fluxes
from jaxsand.scene.footprint import Pose
from jaxsand.scene.scene import Scene
from jaxsand.scene.tools import Blade, reach


class Repeated(Step, Protocol):
    """A step that is repeated until it is done."""

    @property
    def block(self) -> Block:
        """The block of cells in which the step works."""

    @property
    def substep(self) -> float:
        """How far a sub-step leads (spacings)."""

    @property
    def keeps(self) -> bool:
        """Whether fluxes are kept for a later leg."""

    def done(self, params: Any, k: jax.Array, sand: Moving, /) -> jax.Array:
        """Whether the step has been repeated often enough before step k."""


@dataclass(frozen=True)
class _Complete:
    """`done` of a step; equal for equal steps, as bound methods are not."""

    step: Repeated

    def __call__(self, params: Any, k: jax.Array, sand: Moving) -> jax.Array:
        return self.step.done(params, k, sand)


@dataclass(frozen=True)
class LegSteps:
    """What a tool does on a leg.

    Attributes:
        lower: the step in which the tool comes down.
        turn: a sub-step of a turn in place.
        ahead: the sub-steps ahead within a spacing.
        bound: largest length of a leg (spacings).
    """

    lower: LegStep[Any]
    turn: Repeated
    ahead: Repeated
    bound: float


Params = Callable[[Site, Pose, jax.Array, jax.Array], Tree]  # of a pose, the length of a leg (m), the angle before it (rad)


def chunk(substep: float) -> int:
    """The number of sub-steps within a spacing."""
    return max(1, int(1 / substep))


def moved(
    scene: Scene,
    site: Site,
    steps: LegSteps,
    params: Params,
    pose: Pose,
    length: jax.Array,
    before: Pose | None,
    state: State,
) -> State:
    """Lowers the tool, or turns it from the pose before, and moves it ahead by `length` (m), skipping parts off the map."""
    shape, dx, block, substep = scene.grid.shape, site.bed.spacing, steps.ahead.block, steps.ahead.substep
    kept = state.kept
    none = no_flux(block.neighbours, block.drains, jnp.zeros((block.size, block.size), state.height.dtype))
    flat, gone = jax.tree.map(lambda x: x.reshape(-1), (state.height, state.lost))
    sand = Moving(flat, gone, none, state.moved, state.scooped)
    zero = jnp.zeros_like(length)
    nowhere = Laid(none, jnp.int32(0), jnp.int32(0))
    if before is None:
        sand = repeat(steps.lower, 1, params(site, pose, zero, zero), sand)
        kept = Kept(nowhere, nowhere, zero, zero)
    else:
        assert isinstance(kept, Kept)
        sand, kept = _turned(site, steps, params, shape, pose, before, kept, sand)
    there, start, onmap = over_the_map(scene, site, pose, length)
    stride = chunk(substep) * substep
    bound = math.ceil(steps.bound / stride) + 1
    frame = frame_of(shape, _in_spacings(start, dx))

    def first(step: jax.Array) -> tuple[jax.Array, jax.Array]:
        return block.ahead(frame, onmap / dx, step, stride)[0]

    flux = none
    if before is not None:
        alike = jnp.clip(before.cos * pose.cos + before.sin * pose.sin, 0, 1)
        flux = _times(alike, seen(block, frame, first(jnp.int32(0)), kept.ahead))
    sand, count = repeat_until(
        _Complete(steps.ahead), steps.ahead, bound, params(there, start, onmap, zero), replace(sand, flux=flux)
    )
    if steps.ahead.keeps:
        last = count - 1 - int(before is None)
        kept = replace(kept, ahead=lay(block, frame, first(last), sand.flux), since=kept.since + length / dx)
    h, lost = jax.tree.map(lambda x: x.reshape(shape), (sand.height, sand.lost))
    return State(h, lost, sand.edge, kept, sand.scooped)


def _turned(
    site: Site, steps: LegSteps, params: Params, shape: tuple[int, int], pose: Pose, before: Pose, kept: Kept, sand: Moving
) -> tuple[Moving, Kept]:
    """Turns the tool in place from the pose before, which is at the leg's start already (see `along_legs`)."""
    dx, block, no = site.bed.spacing, steps.turn.block, jnp.zeros((), bool)
    angle = turn_between(before, pose)
    frame = Frame(_in_spacings(before, dx), no, no, no, shape)
    first = block.corner(frame.pose.x, frame.pose.y)
    sense = jnp.sign(angle)
    alike = jnp.where(sense * kept.sense < 0, 0, jnp.clip(1 - kept.since * dx / reach(site.tool), 0, 1))
    flux = _times(alike, seen(block, frame, first, kept.turned))
    turn = params(site, before, jnp.zeros_like(angle), angle)
    bound = math.ceil(math.pi * math.hypot(*shape) / steps.turn.substep) + 1
    sand, _ = repeat_until(_Complete(steps.turn), steps.turn, bound, turn, replace(sand, flux=flux))
    turns = sense != 0
    return sand, replace(
        kept,
        turned=lay(block, frame, first, sand.flux),
        sense=jnp.where(turns, sense, kept.sense),
        since=jnp.where(turns, 0, kept.since),
    )


def way_of(site: Site, pose: Pose, length: jax.Array, angle: jax.Array, half: jax.Array, side: jax.Array) -> Way:
    """A leg in spacings, of a tool that reaches by `half` ahead and by `side` aside (spacings); see `Way`."""
    dx, drop, rim = site.bed.spacing, site.bed.drop, site.bed.rim
    yaw, plates = (site.tool.yaw, site.tool.plates) if isinstance(site.tool, Blade) else (None, None)
    return Way(
        _in_spacings(pose, dx),
        length / dx,
        half,
        side,
        site.bottom,
        dx,
        site.flow.quantum,
        drop.reshape(-1) if drop.ndim else drop,
        None if rim is None else rim.level,
        site.flow.rate,
        angle,
        None if site.rise is None else site.rise * dx,
        None if site.room is None else site.room / site.flow.quantum,
        None if yaw is None else jnp.asarray(yaw),
        None if site.bed.base is None else site.bed.base.reshape(-1),
        None if plates is None else plates / dx,
    )


def _times(factor: jax.Array, flux: Fluxes) -> Fluxes:
    return tuple(factor * f for f in flux)


def _in_spacings(pose: Pose, dx: jax.Array) -> Pose:
    return Pose(pose.x / dx, pose.y / dx, pose.cos, pose.sin)
