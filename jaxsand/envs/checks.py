"""Checks of what `make` is given, before anything is computed from it."""

from collections.abc import Callable, Mapping
from dataclasses import fields
from typing import Any, get_args

import jax
import numpy as np

from jaxsand.envs.excavate import Excavate
from jaxsand.envs.heights import Heights, OwnDepth
from jaxsand.envs.maps import MapGoals
from jaxsand.envs.multi import LevelGoals, Measure, MultiStroke, NoStop, RoughGoals, Stop, WithBerms
from jaxsand.envs.onmap import OnMap
from jaxsand.envs.onsand import OnSand
from jaxsand.envs.pushing import Batching, Push
from jaxsand.envs.weights import heights
from jaxsand.envs.zones import NoZones, Zones
from jaxsand.goals.goal import Goal
from jaxsand.goals.metrics import finite
from jaxsand.interaction.stepped import SteppedPush
from jaxsand.relaxation.stopping import Stop as StopRule
from jaxsand.scene.masked import unmasked
from jaxsand.scene.scene import Scene, blade_of
from jaxsand.scene.tools import Blade, Bucket
from jaxsand.scene.validation import concrete, short

_KINDS: dict[str, Any] = {
    "on": OnMap | OnSand,
    "push": Push,
    "stop": NoStop | Stop,
    "measure": Measure,
    "batching": Batching,
    "settle": StopRule | None,
    "heights": OwnDepth | Heights,
    "zones": Zones,
    "goals": MapGoals,
}


def check_kinds(options: Mapping[str, object]) -> None:
    """Raises ValueError for an option whose value is of the wrong type."""
    for name, value in options.items():
        kind = _KINDS.get(name)
        if kind is not None and not isinstance(value, kind):
            kinds = ", ".join("None" if k is type(None) else f"{k.__name__}(...)" for k in get_args(kind))
            raise ValueError(f"{name}: got {short(value):.60}; give one of {kinds}")


def check_limit(options: Mapping[str, object]) -> None:
    """Raises ValueError for a limit below one; a traced limit is not checked."""
    if "limit" in options:
        limit = concrete(options["limit"])
        if limit is not None and not np.all(limit >= 1):
            raise ValueError(f"limit: got {short(options['limit'])}; give 1 step or more to an episode")


def check_scene(scene: object, tool_of: Callable[[Scene], Blade | Bucket] = blade_of) -> None:
    """Raises ValueError unless it is a scene with the right tool, by default a blade."""
    if not isinstance(scene, Scene):
        tool = "Blade()" if tool_of is blade_of else "Bucket(width, length, capacity)"
        raise ValueError(f"scene: got {short(scene):.60}; give make_scene(..., tool={tool})")
    tool_of(scene)


def check_ready_goals(scene: Scene, goals: LevelGoals | RoughGoals, starts: object) -> None:
    """Raises ValueError for goals that are not of the scene's shape or not finite, for weights that are neither numbers nor
    maps like theirs, or with `starts` beside goals that have their own.
    """
    maps = heights(goals.goals)
    if maps.shape[-2:] != scene.grid.shape:
        raise ValueError(f"goals: got maps of {list(maps.shape[-2:])}, the scene has {list(scene.grid.shape)} cells")
    for name, some in {**{f.name: getattr(goals, f.name) for f in fields(goals)}, "goals": maps}.items():
        if not isinstance(some, jax.core.Tracer):
            finite(some, name)
    if isinstance(goals.goals, Goal):
        _check_ready_weights(goals.goals, maps.shape)
    if starts is not None:
        raise ValueError(f"starts: got {short(starts)} beside goals that are ready; leave it out, or give strokes as goals")


def _check_ready_weights(goal: Goal, shape: tuple[int, ...]) -> None:
    """Raises ValueError for weights that are neither numbers nor maps of a shape, or below 0; traced ones pass."""
    sides = {side: np.shape(getattr(goal, side)) for side in ("above", "below")}
    if set(sides.values()) not in ({()}, {shape}):
        got = " and ".join(f"{side} of shape {list(some)}" for side, some in sides.items())
        raise ValueError(f"goals: got {got}; give two numbers, or two arrays of shape {list(shape)}")
    for side in sides:
        weights = concrete(getattr(goal, side))
        if weights is not None and not np.all(np.isfinite(weights) & (weights >= 0)):
            raise ValueError(f"goals.{side}: got a weight that is below 0 or not finite; give weights of 0 or more")


def check_measure(env: MultiStroke | Excavate, goals: LevelGoals | RoughGoals) -> None:
    """Raises ValueError for a measure beside goals that measure by themselves."""
    if isinstance(goals.goals, Goal) and not isinstance(env.measure, WithBerms):
        raise ValueError(
            f"measure: got {env.measure} beside goals with weights or free cells, which say themselves what matters; "
            "leave it out, and give the weights as goals=Goal(maps, above, below, power)"
        )


def check_heights(env: MultiStroke | Excavate, tool: Blade | Bucket) -> None:
    """Raises ValueError unless the push can change the tool's height, and its depth is one to measure heights in."""
    depth = concrete(tool.depth)
    if depth is not None and not np.all(depth > 0):
        raise ValueError(
            f"scene.tool.depth: got {depth} m; give a depth above 0, the unit of observations, rewards and Heights()"
        )
    if isinstance(env.heights, OwnDepth):
        if isinstance(env, MultiStroke):
            return
        raise ValueError(f"heights: got {env.heights}; a bucket scoops between heights: give Heights(lowest, highest)")
    if not isinstance(env.push, SteppedPush):
        raise ValueError(
            f"push: got {short(env.push)}, which keeps its tool at one depth; give SteppedPush() with Heights()"
        )


def check_zones(scene: Scene, zones: Zones) -> None:
    """Raises ValueError for zones that are not booleans of the scene's shape; traced ones are not checked."""
    if isinstance(zones, NoZones):
        return
    if not hasattr(zones.cells, "dtype"):
        raise ValueError("zones.cells: got no array; give an array of booleans, such as np.array(cells)")
    cells = concrete(unmasked("zones.cells", zones.cells, "say of each whether the tool may be there: cells.filled(True)"))
    if cells is not None and (cells.dtype != bool or cells.shape != scene.grid.shape):
        raise ValueError(
            f"zones.cells: got {cells.dtype} of shape {list(cells.shape)}; give booleans of shape {list(scene.grid.shape)}"
        )
