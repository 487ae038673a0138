"""Calls from Python with arguments of which one or two are odd."""

import datetime
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np

import jaxsand as js
from jaxsand import envs

from .spoil import NUMBERS, WORDS, Rng, array, pick

N = 8
LEVEL = np.zeros((N, N), np.float32)
SAND = js.make_scene((N, N), 0.01, tool=js.Blade())
SOLID = np.eye(N, dtype=bool)
MASKED = np.ma.masked_array(LEVEL, SOLID)
QUICK = {"stop": js.Sweeps(2), "push": js.SteppedPush(1.0, 1)}
STROKE = (0.02, 0.02, 0.05, 0.05)
MAP = np.ones((3, 3), bool)


def odd(rng: Rng) -> Any:
    """Anything that someone may give by mistake."""
    far = 10.0 ** float(rng.integers(-3, 37))
    makers: tuple[Callable[[], Any], ...] = (
        lambda: pick(rng, NUMBERS),
        lambda: pick(rng, NUMBERS),
        lambda: pick(rng, WORDS),
        lambda: pick(rng, (None, True, False, [], (), {}, object(), 1j, {"a": 1}, [[1, 2], [3]], datetime.date(2020, 1, 1))),
        lambda: pick(rng, (MASKED, np.ma.masked, jnp.zeros(3), np.float16(2), np.int64(-1), jnp.float32(jnp.nan))),
        lambda: pick(
            rng, (js.Blade, js.Blade(), js.NoTool(), js.Walls(SOLID), js.Whole(), js.Sweeps(2), SAND, js.Deep(), int)
        ),
        lambda: array(rng),
        lambda: field(rng),
        lambda: (rng.normal(size=pick(rng, ((4,), (6,), (2, 3), (N, N)))) * far).astype(np.float32),
    )
    return pick(rng, makers)()


def field(rng: Rng) -> Any:
    """Part of a scene with an odd field."""
    bad = pick(rng, (*NUMBERS, *WORDS, None, array(rng), [], True))
    return pick(
        rng,
        (
            lambda: js.Blade(bad),
            lambda: js.Blade(0.02, bad),
            lambda: js.Blade(depth=bad),
            lambda: js.Blade(yaw=bad),
            lambda: js.Blade(plates=bad),
            lambda: js.Wheel(bad),
            lambda: js.Wheel(sinkage=bad),
            lambda: js.Wheel(load=bad),
            lambda: js.Wheel(grousers=bad),
            lambda: js.Wheel(grousers=js.Grousers(bad)),
            lambda: js.Bucket(bad, 0.02, 1e-5),
            lambda: js.Bucket(0.02, 0.02, bad),
            lambda: js.Bucket(0.02, 0.02, 1e-5, walls=bad),
            lambda: js.Walls(bad),
            lambda: js.Base(bad),
            lambda: js.Draining(bad),
            lambda: js.Window(bad),
            lambda: js.Window((4, 4), bad),
            lambda: js.Window((bad, 4)),
            lambda: js.SteppedPush(bad),
            lambda: js.SteppedPush(1.0, bad),
            lambda: js.SteppedPush(rate=bad),
            lambda: js.Sweeps(bad),
            lambda: js.UntilStill(bad),
            lambda: js.UntilStill(bound=bad),
            lambda: js.Relaxation(bad),
            lambda: js.SuperTimeStepping(bad),
            lambda: js.Goal(bad),
            lambda: js.Goal(LEVEL, bad),
            lambda: js.Goal(LEVEL, 1.0, bad),
            lambda: js.Load(bad, 0.0),
        ),
    )()


def scene(rng: Rng) -> dict[str, Any]:
    """Arguments of `make_scene`."""
    tools = (None, js.Blade(), js.Wheel(), js.Bucket(0.02, 0.02, 1e-5))
    return {
        "shape": (N, N),
        "spacing": 0.01,
        "repose_angle": 0.5,
        "neighbours": pick(rng, (4, 8, "isotropic")),
        "tool": pick(rng, tools),
        "walls": pick(rng, (None, js.Walls(SOLID))),
        "edge": pick(rng, (None, js.Draining(-0.1))),
        "window": pick(rng, (None, js.Whole(), js.Window((4, 4)))),
        "base": pick(rng, (None, js.Base(-0.1))),
    }


def bucket(path: object = None) -> dict[str, Any]:
    """Arguments of `scoop` or `dump`."""
    tool = js.Bucket(0.03, 0.02, 1e-5)
    load = js.Load(jnp.float32(0.01), jnp.float32(0))
    return {"scene": js.make_scene((N, N), 0.01, tool=tool), "height": LEVEL, "path": path, "load": load}


def multi(rng: Rng) -> dict[str, Any]:
    """Arguments of `make` for strokes; their goals are ready, so that nothing is pushed."""
    goals = envs.LevelGoals(jnp.asarray(LEVEL)[None])
    ways = {
        "heights": envs.OwnDepth(),
        "zones": envs.NoZones(),
        "measure": envs.WithBerms(),
        "stop": envs.NoStop(),
        "limit": 3,
    }
    return {"name": "multi-stroke", "goals": goals, "scene": SAND, "seed": 0, "starts": None} | ways


def single(rng: Rng) -> dict[str, Any]:
    """Arguments of `make` for a walk over a map."""
    return {"name": "single-stroke", "on": envs.OnMap(), "limit": 5, "step_cost": 0.1, "goals": envs.map_pool([MAP])}


CALLS: dict[str, tuple[Callable[..., object], Callable[[Rng], dict[str, Any]]]] = {
    "make_scene": (js.make_scene, scene),
    "step": (js.step, lambda rng: {"scene": SAND, "height": LEVEL, "stroke": STROKE, **QUICK}),
    "follow": (js.follow, lambda rng: {"scene": SAND, "height": LEVEL, "path": [STROKE[:2], STROKE[2:]], **QUICK}),
    "settle": (js.settle, lambda rng: {"scene": SAND, "height": LEVEL, "stop": js.Sweeps(2), "scheme": js.Relaxation()}),
    "scoop": (js.scoop, lambda rng: bucket([STROKE[:2], STROKE[2:]]) | QUICK),
    "dump": (js.dump, lambda rng: bucket([STROKE[:2]]) | {"amount": 1e-6, "stop": js.Sweeps(2)}),
    "deposit": (js.deposit, lambda rng: {"scene": SAND, "height": LEVEL, "where": [0.04, 0.04], "volume": 1e-6}),
    "make": (js.make, lambda rng: pick(rng, (single, single, multi))(rng)),
    "plan": (
        js.plan,
        lambda rng: {"dig": MAP, "start": (0, 0), "end": None, "turn_cost": 0.0, "engine": "auto", "seconds": None},
    ),
    "map": (js.HeightMap, lambda rng: {"height": LEVEL, "spacing": 0.01, "corner": (0.0, 0.0)}),
    "write_map": (js.write_map, lambda rng: {"path": pick(rng, SUFFIXES), "height": LEVEL, "spacing": 0.01}),
    "volume": (js.volume, lambda rng: {"scene": SAND, "height": LEVEL}),
    "rollout": (js.rollout, lambda rng: {"scene": SAND, "height": LEVEL, "strokes": [STROKE], **QUICK}),
}
"""By name: what is called, and good arguments for it."""

SUFFIXES = tuple(f"x.{suffix}" for suffix in ("asc", "npz", "npy", "png", "ply", "stl", "hfield"))


def case(name: str, rng: Rng, folder: Path) -> Callable[[], object]:
    """A call with one or two arguments odd."""
    call, good = CALLS[name]
    given = good(rng)
    for _ in range(rng.integers(1, 3)):
        given[pick(rng, sorted(given.keys() - {"path"} if name == "write_map" else given))] = odd(rng)
    return lambda: call(**given)
