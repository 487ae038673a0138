"""Environments for reinforcement learning: an agent sees a goal and the sand, and its actions move the tool.

They follow the protocol of gymnax 1.x: an environment is a static object, the state of an episode is apart from the
parameters, and the leaves of both may be vmapped; see `episode.Environment`.
"""

from collections.abc import Collection, Iterable, Mapping
from dataclasses import fields, replace
from typing import Any, Literal, TypeVar, overload

import jax
import jax.numpy as jnp

from jaxsand.envs.checks import (
    check_heights,
    check_kinds,
    check_limit,
    check_measure,
    check_ready_goals,
    check_scene,
    check_zones,
)
from jaxsand.envs.digs import RandomDigs, dug
from jaxsand.envs.excavate import Excavate, ExcavateParams, ExcavateState
from jaxsand.envs.heights import Heights, OwnDepth
from jaxsand.envs.library import Goals, Level, RandomStrokes, Rough, Starts, library
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
    Weighted,
    WithBerms,
)
from jaxsand.envs.onmap import MapParams, MapState, OnMap
from jaxsand.envs.onsand import OnSand, SandParams, SandState
from jaxsand.envs.pushing import ByLength, Together
from jaxsand.envs.spaces import Box, Dict, Discrete
from jaxsand.envs.wrappers import GymnaxEnv, GymnaxParams, Logged, LoggedState
from jaxsand.envs.zones import ClippedBy, NoZones, RefusedBy
from jaxsand.goals.usual import usual_scene
from jaxsand.interaction.blade_stepped import with_near
from jaxsand.interaction.bucket import bucket_of
from jaxsand.interaction.stepped import SteppedPush
from jaxsand.relaxation.stopping import check_whole
from jaxsand.scene.scene import Scene, blade_of, make_scene
from jaxsand.scene.tools import Blade, Bucket
from jaxsand.scene.validation import short
from jaxsand.scene.window import Whole, Window

__all__ = [
    "Box",
    "ByLength",
    "ClippedBy",
    "Dict",
    "Discrete",
    "Excavate",
    "ExcavateParams",
    "ExcavateState",
    "GymnaxEnv",
    "GymnaxParams",
    "Heights",
    "Level",
    "LevelGoals",
    "Logged",
    "LoggedState",
    "MapParams",
    "MapPool",
    "MapState",
    "MultiStroke",
    "NoStop",
    "NoZones",
    "OnMap",
    "OnSand",
    "OnlyDug",
    "OwnDepth",
    "RandomDigs",
    "RandomStrokes",
    "RefusedBy",
    "Rough",
    "RoughGoals",
    "SandParams",
    "SandState",
    "Stop",
    "StrokeParams",
    "StrokeState",
    "Together",
    "Walks",
    "Weighted",
    "WithBerms",
    "library",
    "make",
    "map_pool",
    "pool_of",
]

_WINDOW, _BUCKET_WINDOW = (12, 12), (16, 16)
_BUCKET = Bucket(width=0.04, length=0.04, capacity=4e-5)
_CREEP = 5e-3  # spacings: what a heap that settled by the default tolerance still creeps while the bucket moves by one


@overload
def make(name: Literal["single-stroke"], *, on: OnSand, **options: Any) -> tuple[OnSand, SandParams]: ...


@overload
def make(name: Literal["single-stroke"], *, on: OnMap | None = None, **options: Any) -> tuple[OnMap, MapParams]: ...


@overload
def make(name: Literal["multi-stroke"], **options: Any) -> tuple[MultiStroke, StrokeParams]: ...


@overload
def make(name: Literal["excavate"], **options: Any) -> tuple[Excavate, ExcavateParams]: ...


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
      name: "single-stroke", a walk of the tool over the cells of a binary map; "multi-stroke", straight pushes from
        anywhere to anywhere; or "excavate", digs of a bucket that scoops here and dumps there.
      **options: for "single-stroke": `on`, `OnMap()` (a binary map, the default) or `OnSand()` (the simulator); `goals`, a
        `Walks()` or a `MapPool` (see `map_pool`, `pool_of`); `step_cost`; `limit`, steps after which an episode is
        truncated; and, with `OnSand()`, the `scene`. For "multi-stroke": the fields of `MultiStroke`; `goals`, a
        `RandomStrokes()`, glyphs {name: strokes [n, 4] of the unit square}, a map [H, W] or maps [G, H, W] (m), such as
        `jaxsand.task.resample` makes of a picture or a terrain (with `measure=OnlyDug()` where they hold no berms), with NaN
        in free cells, or a `jaxsand.Goal` of such, whose weights are numbers, one map [H, W] or maps [G, H, W], and by whose
        distance rewards are then measured; `starts`, a `Level()`, `Rough(relief)`, or sand at rest, a map [H, W] or one for
        each goal [G, H, W] (m); `seed`, for both; `scene`, by default 32 x 32 cells of 0.01 m with the
        default blade, and a window of 12 x 12 cells that is computed around the blade while it is down; `limit`, strokes
        after which an episode is truncated; `zones`, where the blade may not be: `ClippedBy(cells)` or `RefusedBy(cells)`.
        For "excavate": the fields of `Excavate`, and `goals` (also a `RandomDigs()`, the default), `starts`, `seed`, `scene`
        (by default with a bucket 0.04 m wide that holds 4e-5 m^3), `limit` and `zones`, as for "multi-stroke"; strokes are
        pushed by a blade as wide as the bucket.

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
    match name if isinstance(name, str) else "":
        case "single-stroke":
            return _single(**options)
        case "multi-stroke":
            return _multi(**options)
        case "excavate":
            return _excavate(**options)
    raise ValueError(f"name: got {short(name)}; give single-stroke, multi-stroke or excavate")


def _single(
    on: OnMap | OnSand | None = None, scene: Scene | None = None, **params: Any
) -> tuple[OnMap, MapParams] | tuple[OnSand, SandParams]:
    """The single stroke with the given options."""
    env = OnMap() if on is None else on
    ours = [f.name for f in fields(MapParams)]
    _known("single-stroke", params, ("on", "scene", *ours), ours)
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
    starts: Starts | None = None,
    scene: Scene | None = None,
    seed: int = 0,
    **options: Any,
) -> tuple[MultiStroke, StrokeParams]:
    """Many strokes with the given options."""
    env, params = _of_kind("multi-stroke", MultiStroke, options, seed)
    if scene is None:
        window = Window(_WINDOW) if isinstance(env.push, SteppedPush) else Whole()
        scene = usual_scene(window=window)
    check_scene(scene)
    check_heights(env, blade_of(scene))
    zones = params.get("zones", NoZones())
    check_zones(scene, zones)
    scene = with_near(scene)
    if isinstance(goals, LevelGoals | RoughGoals):
        check_ready_goals(scene, goals, starts)
        pool: LevelGoals | RoughGoals = jax.tree.map(jnp.asarray, goals)
    else:
        begin = Level() if starts is None else starts
        pool = library(env, scene, RandomStrokes() if goals is None else goals, begin, seed, zones)
    check_measure(env, pool)
    return env, StrokeParams(scene, pool, **params)


def _excavate(
    goals: RandomDigs | Goals | LevelGoals | RoughGoals | None = None,
    starts: Starts | None = None,
    scene: Scene | None = None,
    seed: int = 0,
    **options: Any,
) -> tuple[Excavate, ExcavateParams]:
    """Excavation with the given options."""
    env, params = _of_kind("excavate", Excavate, options, seed)
    if scene is None:
        scene = usual_scene(tool=_BUCKET, window=Window(_BUCKET_WINDOW, _CREEP))
    check_scene(scene, bucket_of)
    check_heights(env, bucket_of(scene))
    zones = params.get("zones", NoZones())
    check_zones(scene, zones)
    bucket, dx = bucket_of(scene), scene.grid.spacing
    scene = replace(scene, window=with_near(replace(scene, tool=Blade(bucket.width, dx, bucket.depth))).window)
    begin = Level() if starts is None else starts
    if isinstance(goals, LevelGoals | RoughGoals):
        check_ready_goals(scene, goals, starts)
        pool: LevelGoals | RoughGoals = jax.tree.map(jnp.asarray, goals)
    elif goals is None or isinstance(goals, RandomDigs):
        pool = dug(env, scene, RandomDigs() if goals is None else goals, begin, seed, zones)
    else:
        blade = Blade(bucket.width, jnp.maximum(Blade().thickness, dx), bucket.depth)
        pusher = MultiStroke(env.push, batching=env.batching, settle=env.settle)
        pool = library(pusher, with_near(replace(scene, tool=blade)), goals, begin, seed, zones)
    check_measure(env, pool)
    return env, ExcavateParams(scene, pool, **params)


Env = TypeVar("Env", MultiStroke, Excavate)


def _of_kind(name: str, kind: type[Env], options: Mapping[str, Any], seed: int) -> tuple[Env, dict[str, Any]]:
    """An environment with those of the options that are its fields, and the others, which are its parameters'."""
    own: list[str] = sorted(f.name for f in fields(kind))
    chosen = {key: value for key, value in options.items() if key in own}
    params = {key: value for key, value in options.items() if key not in own}
    check_kinds(chosen)
    _known(name, params, ("goals", "starts", "seed", "scene", "limit", "zones", *own), ("limit", "zones"))
    check_kinds(params)
    check_limit(params)
    check_whole("seed", seed, 0)
    return kind(**chosen), params


def _known(name: str, options: Mapping[str, object], allowed: Iterable[str], here: Collection[str]) -> None:
    """Raises ValueError for an option that is not in `here`, naming all that the environment's kind allows."""
    for option in options:
        if option not in here:
            raise ValueError(f"{option}: no option of {name}; give some of {', '.join(allowed)}, or see help(jaxsand.make)")
