"""Environments for reinforcement learning: an agent sees a goal and the sand, and its actions move the tool.

They follow the protocol of gymnax 1.x: an environment is a static object, the state of an episode is apart from the
parameters, and the leaves of both may be vmapped; see `episode.Environment`.
"""

from collections.abc import Iterable, Mapping
from dataclasses import Field, fields
from typing import Any, Literal, overload

from jaxsand.envs.checks import check_kinds, check_limit, check_ready_goals, check_scene
from jaxsand.envs.library import Goals, Level, RandomStrokes, Rough, library
from jaxsand.envs.maps import MapPool, Walks, map_pool, pool_of
from jaxsand.envs.multi import (
    LevelGoals,
    MultiStroke,
    NoStop,
    OnlyDug,
    RoughGoals,
    Stop,
    StrokeParams,
    StrokeState,
    WithBerms,
)
from jaxsand.envs.onmap import MapParams, MapState, OnMap
from jaxsand.envs.onsand import OnSand, SandParams, SandState
from jaxsand.envs.pushing import ByLength, Together
from jaxsand.envs.spaces import Box, Dict, Discrete
from jaxsand.goals.usual import usual_scene
from jaxsand.interaction.blade_stepped import with_near
from jaxsand.interaction.stepped import SteppedPush
from jaxsand.relaxation.stopping import check_whole
from jaxsand.scene.scene import Scene, make_scene
from jaxsand.scene.window import Whole, Window

__all__ = [
    "Box",
    "ByLength",
    "Dict",
    "Discrete",
    "Level",
    "LevelGoals",
    "MapParams",
    "MapPool",
    "MapState",
    "MultiStroke",
    "NoStop",
    "OnMap",
    "OnSand",
    "OnlyDug",
    "RandomStrokes",
    "Rough",
    "RoughGoals",
    "SandParams",
    "SandState",
    "Stop",
    "StrokeParams",
    "StrokeState",
    "Together",
    "Walks",
    "WithBerms",
    "library",
    "make",
    "map_pool",
    "pool_of",
]

_WINDOW = (12, 12)


@overload
def make(name: Literal["single-stroke"], *, on: OnSand, **options: Any) -> tuple[OnSand, SandParams]: ...


@overload
def make(name: Literal["single-stroke"], *, on: OnMap | None = None, **options: Any) -> tuple[OnMap, MapParams]: ...


@overload
def make(name: Literal["multi-stroke"], **options: Any) -> tuple[MultiStroke, StrokeParams]: ...


@overload
def make(name: str, **options: Any) -> tuple[Any, Any]: ...


def make(name: str, **options: Any) -> tuple[Any, Any]:
    """Makes an environment and its parameters, after the protocol of gymnax 1.x.

        obs, state = env.reset(key, params)
        obs, state, reward, terminated, truncated, info = env.step(key, state, action, params)

    `step` begins a new episode where one ended: the observation is then the new one's, and info["final_observation"] the
    last of the old one. `step_env` does not begin anew. Both work on one environment; use `jax.vmap` for many, over params
    too.

    Args:
      name: "single-stroke", a walk of the tool over the cells of a binary map, or "multi-stroke", straight pushes from
        anywhere to anywhere.
      **options: for "single-stroke": `on`, `OnMap()` (a binary map, the default) or `OnSand()` (the simulator); `goals`, a
        `Walks()` or a `MapPool` (see `map_pool`, `pool_of`); `step_cost`; `limit`, steps after which an episode is
        truncated; and, with `OnSand()`, the `scene`. For "multi-stroke": the fields of `MultiStroke`; `goals`, a
        `RandomStrokes()`, glyphs {name: strokes [n, 4] of the unit square}, or maps [G, H, W] (m), such as
        `jaxsand.task.resample` makes of a picture or a terrain (with `measure=OnlyDug()` where they hold no berms);
        `starts`, a `Level()` or `Rough(relief)`; `seed`, for both; `scene`, by default 32 x 32 cells of 0.01 m with the
        default blade, and a window of 12 x 12 cells that is computed around the blade while it is down; `limit`, strokes
        after which an episode is truncated.

    Returns:
      The environment, static and hashable, and its parameters, a pytree.

    Raises:
      ValueError: for a name or an option that does not exist, or a value that is out of range.

    Example:
      >>> import jax
      >>> import jaxsand as js
      >>> env, params = js.make("single-stroke", limit=20)
      >>> obs, state = env.reset(jax.random.key(0), params)
      >>> obs["goal"].shape, obs["goal"].dtype
      ((7, 7), dtype('float32'))
      >>> east = 1
      >>> obs, state, reward, terminated, truncated, info = env.step(jax.random.key(1), state, east, params)
      >>> int(state.time)
      1
    """
    match name:
        case "single-stroke":
            return _single(**options)
        case "multi-stroke":
            return _multi(**options)
    raise ValueError(f"name: got {name!r}; give single-stroke or multi-stroke")


def _single(
    on: OnMap | OnSand | None = None, scene: Scene | None = None, **params: Any
) -> tuple[OnMap, MapParams] | tuple[OnSand, SandParams]:
    """The single stroke with the given options."""
    env = OnMap() if on is None else on
    _known("single-stroke", params, fields(MapParams))
    check_kinds({"on": env, **params})
    check_limit(params)
    if isinstance(env, OnMap):
        if scene is not None:
            raise ValueError("scene: has no effect on a binary map; leave it out, or give on=OnSand()")
        return env, MapParams(**params)
    layout = env.layout
    rows, columns = (n * layout.cell + 2 * layout.margin for n in env.shape)
    scene = make_scene((rows, columns), layout.spacing, tool=layout.blade) if scene is None else scene
    check_scene(scene)
    if scene.grid.shape != (rows, columns):
        raise ValueError(
            f"scene: got {list(scene.grid.shape)} cells, the layout takes [{rows}, {columns}]; make it as large"
        )
    return env, SandParams(scene, **params)


def _multi(
    goals: Goals | LevelGoals | RoughGoals | None = None,
    starts: Level | Rough | None = None,
    scene: Scene | None = None,
    seed: int = 0,
    **options: Any,
) -> tuple[MultiStroke, StrokeParams]:
    """Many strokes with the given options."""
    own = {f.name for f in fields(MultiStroke)}
    chosen = {key: value for key, value in options.items() if key in own}
    check_kinds(chosen)
    env = MultiStroke(**chosen)
    params = {key: value for key, value in options.items() if key not in own}
    _known("multi-stroke", params, (f for f in fields(StrokeParams) if f.name == "limit"))
    check_limit(params)
    check_whole("seed", seed, 0)
    if scene is None:
        window = Window(_WINDOW) if isinstance(env.push, SteppedPush) else Whole()
        scene = usual_scene(window=window)
    check_scene(scene)
    scene = with_near(scene)
    if isinstance(goals, LevelGoals | RoughGoals):
        check_ready_goals(scene, goals, starts)
    else:
        goals = library(env, scene, RandomStrokes() if goals is None else goals, Level() if starts is None else starts, seed)
    return env, StrokeParams(scene, goals, **params)


def _known(name: str, options: Mapping[str, object], some: Iterable[Field[Any]]) -> None:
    """Raises ValueError for an option that is none of the fields in `some`."""
    names = [f.name for f in some]
    for option in options:
        if option not in names:
            raise ValueError(f"{option}: no option of {name}; give some of {', '.join(names)}, or see help(jaxsand.make)")
