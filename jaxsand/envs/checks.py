"""Checks of what `make` is given, before anything is computed from it."""

from collections.abc import Mapping
from dataclasses import fields
from typing import Any, get_args

import jax
import numpy as np

from jaxsand.envs.maps import MapGoals
from jaxsand.envs.multi import LevelGoals, NoStop, OnlyDug, RoughGoals, Stop, WithBerms
from jaxsand.envs.onmap import OnMap
from jaxsand.envs.onsand import OnSand
from jaxsand.envs.pushing import Batching, Push
from jaxsand.goals.metrics import finite
from jaxsand.relaxation.stopping import Stop as StopRule
from jaxsand.scene.scene import Scene, blade_of
from jaxsand.scene.validation import concrete

_KINDS: dict[str, Any] = {
    "on": OnMap | OnSand,
    "push": Push,
    "stop": NoStop | Stop,
    "measure": WithBerms | OnlyDug,
    "batching": Batching,
    "settle": StopRule | None,
    "goals": MapGoals,
}


def check_kinds(options: Mapping[str, object]) -> None:
    """Raises ValueError for an option whose value is of the wrong type."""
    for name, value in options.items():
        kind = _KINDS.get(name)
        if kind is not None and not isinstance(value, kind):
            kinds = ", ".join("None" if k is type(None) else f"{k.__name__}(...)" for k in get_args(kind))
            raise ValueError(f"{name}: got {value!r:.60}; give one of {kinds}")


def check_limit(options: Mapping[str, object]) -> None:
    """Raises ValueError for a limit below one; a traced limit is not checked."""
    if "limit" in options:
        limit = concrete(options["limit"])
        if limit is not None and not np.all(limit >= 1):
            raise ValueError(f"limit: got {options['limit']!r}; give 1 step or more to an episode")


def check_scene(scene: object) -> None:
    """Raises ValueError unless it is a scene whose tool is a blade."""
    if not isinstance(scene, Scene):
        raise ValueError(f"scene: got {scene!r:.60}; give make_scene(..., tool=Blade())")
    blade_of(scene)


def check_ready_goals(scene: Scene, goals: LevelGoals | RoughGoals, starts: object) -> None:
    """Raises ValueError for goals that are not of the scene's shape or not finite, or with `starts` beside goals that have
    their own.
    """
    if goals.goals.shape[-2:] != scene.grid.shape:
        raise ValueError(f"goals: got maps of {list(goals.goals.shape[-2:])}, the scene has {list(scene.grid.shape)} cells")
    for field in fields(goals):
        maps = getattr(goals, field.name)
        if not isinstance(maps, jax.core.Tracer):
            finite(maps, field.name)
    if starts is not None:
        raise ValueError(f"starts: got {starts!r} beside goals that are ready; leave it out, or give strokes as goals")
