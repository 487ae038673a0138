"""How many steps a second the environments make: in a batch, and as Gymnasium's users make them, one by one.

Actions are random, over the whole map of 32 x 32 cells where they are strokes; episodes are so short that new ones begin all
the time.
"""

import math
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxsand.batch import wide_vectors
from jaxsand.env import LevelGoals, OnSand, Together, Walks, make, pool_of
from jaxsand.strokeloss import pushed
from jaxsand.swath import SwathPush
from jaxsand.window import Whole

Tell = Callable[[str], None]
Row = dict[str, Any]
_VMAP = "vmap"
_ROUNDS = 3
_STEPS = 3  # of a batch to a round
_ALONE = 32  # steps to a round of what makes them one by one
_SHARE = 8  # of the batch: a walk on sand has four times the cells


@dataclass(frozen=True)
class Contender:
    """A way to make steps of a kind; `call` makes `steps` of them, in batches of `batch`."""

    kind: str
    name: str
    batch: int
    steps: int
    call: Callable[[], Any]


def bench_env(batch: int = 1024, tell: Tell = lambda _: None) -> list[Row]:
    """Steps a second of each way, the best of a few rounds in turns, and how many times those of Gymnasium's single
    environment of its kind that is. Compile time is the first call less a later one; `reset_us` what a reset costs in a
    batch (microseconds)."""
    goals = LevelGoals(jnp.zeros((1, 32, 32), jnp.float32))
    full = make("multi-stroke", goals=goals)
    scene = replace(full[1].scene, window=Whole())
    whole = full[0], replace(full[1], scene=scene)
    together = replace(full[0], batching=Together()), full[1]
    fast = make("multi-stroke", goals=goals, push=SwathPush())
    walks = pool_of(Walks(), jax.random.key(0), 256)
    on_map = make("single-stroke", goals=walks)
    on_sand = make("single-stroke", on=OnSand(), goals=walks)
    ways = [
        _vmapped("full push", _VMAP, full, batch),
        _vmapped("full push", "on the whole map", whole, batch),
        _vmapped("full push", "not sorted by length", together, batch),
        _without("full push", scene, batch),
        _vmapped("fast push", _VMAP, fast, batch),
        _vmapped("walk on a map", _VMAP, on_map, batch),
        _vmapped("walk on sand", _VMAP, on_sand, max(1, batch // _SHARE)),
        _gymnasium("full push", "MultiStrokeEnv", {"goals": goals}),
        _gymnasium("fast push", "MultiStrokeEnv", {"goals": goals, "push": SwathPush()}),
        _gymnasium("walk on a map", "SingleStrokeEnv", {"goals": walks}),
        _gymnasium("walk on sand", "SingleStrokeEnv", {"goals": walks, "on": OnSand()}),
    ]
    rows = _raced([way for way in ways if way is not None], tell)
    resets = {"full push": full, "walk on a map": on_map, "walk on sand": on_sand}
    alone = {row["kind"]: row["steps_per_second"] for row in rows if row["batch"] == 1}
    for row in rows:
        if row["kind"] in alone:
            row["times_gymnasium"] = row["steps_per_second"] / alone[row["kind"]]
        if row["kind"] in resets and row["name"] == _VMAP:
            tell(f"resets: {row['kind']}")
            row["reset_us"] = 1e6 * _reset_seconds(*resets[row["kind"]], batch)
    return rows


def _vmapped(kind: str, name: str, made: tuple[Any, Any], batch: int) -> Contender:
    """A few steps of a whole batch in one program, which draws the actions too."""
    env, params = made
    space = env.action_space(params)

    def some(state: Any, key: jax.Array, params: Any) -> Any:
        def one(state: Any, key: jax.Array) -> Any:
            own, draws = (jax.random.split(k, batch) for k in jax.random.split(key))
            _, state, reward, *_ = jax.vmap(env.step, (0, 0, 0, None))(own, state, jax.vmap(space.sample)(draws), params)
            return state, reward

        return jax.lax.scan(one, state, jax.random.split(key, _STEPS))

    program = jax.jit(some, compiler_options=wide_vectors())
    _, state = jax.vmap(env.reset, (0, None))(jax.random.split(jax.random.key(1), batch), params)
    return Contender(kind, name, batch, batch * _STEPS, lambda: program(state, jax.random.key(2), params))


def _without(kind: str, scene: Any, batch: int) -> Contender:
    """The simulator alone, as the searches call it: what is left for an environment to lose."""
    low, high = 0.5 * scene.grid.spacing, (np.array(scene.grid.shape[::-1] * 2) - 0.5) * scene.grid.spacing
    strokes = np.random.default_rng(0).uniform(low, high, (batch, 4))
    level = np.zeros((batch, *scene.grid.shape), np.float32)
    return Contender(kind, "no environment", batch, batch, lambda: pushed(scene, level, strokes))


def _gymnasium(kind: str, name: str, options: dict[str, Any]) -> Contender | None:
    """A single environment, step by step, as an agent's loop has it; None without Gymnasium."""
    try:
        from jaxsand import gym
    except ImportError:
        return None
    env = getattr(gym, name)(**options)
    env.action_space.seed(0)
    env.reset(seed=0)

    def loop() -> None:
        for _ in range(_ALONE):
            _, _, terminated, truncated, _ = env.step(env.action_space.sample())
            if terminated or truncated:
                env.reset()

    return Contender(kind, "Gymnasium, one by one", 1, _ALONE, loop)


def _raced(ways: list[Contender], tell: Tell) -> list[Row]:
    first: dict[Contender, float] = {}
    best = dict.fromkeys(ways, math.inf)
    for k in range(_ROUNDS + 1):
        for way in ways:
            tell(f"{way.kind}, {way.name}: {f'round {k} of {_ROUNDS}' if k else 'first call'}")
            began = time.perf_counter()
            jax.block_until_ready(way.call())
            seconds = time.perf_counter() - began
            if k:
                best[way] = min(best[way], seconds)
            else:
                first[way] = seconds
    return [
        {
            "kind": way.kind,
            "name": way.name,
            "batch": way.batch,
            "steps_per_second": way.steps / best[way],
            "seconds": best[way],
            "compile_seconds": max(0.0, first[way] - best[way]),
        }
        for way in ways
    ]


def _reset_seconds(env: Any, params: Any, batch: int) -> float:
    """Of one environment in a batch."""
    reset = jax.jit(jax.vmap(env.reset, (0, None)))
    keys, best = jax.random.split(jax.random.key(3), batch), math.inf
    for _ in range(_ROUNDS + 1):
        began = time.perf_counter()
        jax.block_until_ready(reset(keys, params))
        best = min(best, time.perf_counter() - began)
    return best / batch
