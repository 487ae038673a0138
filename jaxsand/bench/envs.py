"""How many steps a second the environments make: in a batch, and as Gymnasium's users make them, one by one.

Actions are random, over the whole map of 32 x 32 cells where they are strokes or digs; episodes are so short that new ones
begin all the time.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import AxisType, NamedSharding
from jax.sharding import PartitionSpec as P

from jaxsand.bench.tables import Row
from jaxsand.bench.timing import race, timed
from jaxsand.envs import Heights, LevelGoals, OnSand, Together, Walks, make, pool_of
from jaxsand.interaction.blade_closed_form import SwathPush
from jaxsand.interaction.stepped import SteppedPush
from jaxsand.planning.stroke_loss import pushed
from jaxsand.relaxation.batching import wide_vectors
from jaxsand.relaxation.stopping import Sweeps, UntilStill
from jaxsand.scene.progress import Tell, quiet
from jaxsand.scene.window import AsNeeded, Whole

KINDS = "full push", "push with heights", "dig", "fast push", "walk on a map", "walk on sand"
_FULL, _RISING, _DIG, _FAST, _MAP, _SAND = KINDS
_VMAP, _SHARED, _LOOP = "vmap", ", a share to each device", "Gymnasium, one by one"
_QUICK = {"sub-step 1/4, 2 sweeps": SteppedPush(1 / 4, 2), "sub-step 1/8, 2 sweeps": SteppedPush(1 / 8, 2)}  # see bench push
_LOOSE = {"0.01 above repose": UntilStill(1e-2), "8 sweeps": Sweeps(8)}  # a push may be settled less well
_ROUNDS = 3
_STEPS = 3  # of a batch to a round
_ALONE = 32  # steps to a round of what makes them one by one
_COMPARED = 256  # pushes that an error is the mean of
_SHARE = 8  # of the batch: a walk on sand has four times the cells


@dataclass(frozen=True)
class Contender:
    """A way to make steps of a kind; `call` makes `steps` of them, in batches of `batch`."""

    kind: str
    name: str
    batch: int
    steps: int
    call: Callable[[], Any]


def bench_env(batch: int = 1024, tell: Tell = quiet, kinds: tuple[str, ...] = KINDS) -> list[Row]:
    """Steps a second of each way, the best of a few rounds in turns, and how many times those of Gymnasium's single
    environment of its kind that is. Compile time is the first call less a later one; `reset_us` what a reset costs in a
    batch (microseconds); `error_percent` how far pushes that are settled less well end from those that are still."""
    ways, made, errors = [], {}, {}
    for kind in kinds:
        made[kind], options = _made(kind)
        many = max(1, batch // _SHARE) if kind == _SAND else batch
        ways += _by_device(kind, _VMAP, made[kind], many)
        if kind == _FULL:
            env, params = made[kind]
            scene = replace(params.scene, window=Whole())
            ways.append(_vmapped(kind, "on the whole map", (env, replace(params, scene=scene)), batch))
            ways.append(_vmapped(kind, "not sorted by length", (replace(env, batching=Together()), params), batch))
            ways.append(_without(kind, replace(scene, window=AsNeeded()), batch))
            for name, push in _QUICK.items():
                ways += _by_device(kind, name, (replace(env, push=push), params), batch)
        if kind == _FAST:
            env, params = made[kind]
            for name, stop in _LOOSE.items():
                loose = replace(env, settle=stop)
                ways += _by_device(kind, name, (loose, params), many)
                errors[name] = errors[name + _SHARED] = 100 * _error(loose, env, params)
        ways += _gymnasium(kind, options)
    rows = _raced(ways, tell)
    alone = {row["kind"]: row["steps_per_second"] for row in rows if row["name"] == _LOOP}
    for row in rows:
        if row["kind"] in alone:
            row["times_gymnasium"] = row["steps_per_second"] / alone[row["kind"]]
        if row["name"] in errors:
            row["error_percent"] = errors[row["name"]]
        if row["name"] == _VMAP:
            row["reset_us"] = 1e6 * _reset_seconds(*made[row["kind"]], batch)
    return rows


def _made(kind: str) -> tuple[tuple[Any, Any], Row]:
    """The environment of a kind with its parameters, and the options that make it."""
    level = LevelGoals(jnp.zeros((1, 32, 32), jnp.float32))
    if kind in (_FULL, _RISING, _DIG, _FAST):
        more: Row = {_RISING: {"heights": Heights()}, _FAST: {"push": SwathPush()}}
        options = {"goals": level} | more.get(kind, {})
        return make("excavate" if kind == _DIG else "multi-stroke", **options), options
    options = {"goals": pool_of(Walks(), jax.random.key(0), 256)} | ({"on": OnSand()} if kind == _SAND else {})
    return make("single-stroke", **options), options


def _by_device(kind: str, name: str, made: tuple[Any, Any], batch: int) -> list[Contender]:
    """On one device, and on all, where there are more."""
    devices = jax.local_device_count()
    shared = [_vmapped(kind, name + _SHARED, made, batch, devices)] if devices > 1 else []
    return [_vmapped(kind, name, made, batch), *shared]


def _vmapped(kind: str, name: str, made: tuple[Any, Any], batch: int, devices: int = 1) -> Contender:
    """A few steps of a whole batch in one program, which draws the actions too; on several devices each has its share."""
    env, params = made
    space = env.action_space(params)
    batch = -(-batch // devices) * devices

    def some(state: Any, key: jax.Array, params: Any) -> Any:
        def one(state: Any, key: jax.Array) -> Any:
            own, draws = (jax.random.split(k, batch // devices) for k in jax.random.split(key))
            _, state, reward, *_ = jax.vmap(env.step, (0, 0, 0, None))(own, state, jax.vmap(space.sample)(draws), params)
            return state, reward

        return jax.lax.scan(one, state, jax.random.split(key[0], _STEPS))

    if devices > 1:
        mesh = jax.make_mesh((devices,), ("maps",), axis_types=(AxisType.Auto,))
        share = (P("maps"), P("maps"), P())
        some = jax.shard_map(some, mesh=mesh, in_specs=share, out_specs=(P("maps"), P(None, "maps")), check_vma=False)
    program = jax.jit(some, compiler_options=wide_vectors())
    _, state = jax.vmap(env.reset, (0, None))(jax.random.split(jax.random.key(1), batch), params)
    keys = jax.random.split(jax.random.key(2), devices)
    if devices > 1:
        state, keys = jax.device_put((state, keys), NamedSharding(mesh, P("maps")))
    return Contender(kind, name, batch, batch * _STEPS, lambda: program(state, keys, params))


def _without(kind: str, scene: Any, batch: int) -> Contender:
    """The simulator alone, as the searches call it: what is left for an environment to lose."""
    low, high = 0.5 * scene.grid.spacing, (np.array(scene.grid.shape[::-1] * 2) - 0.5) * scene.grid.spacing
    strokes = np.random.default_rng(0).uniform(low, high, (batch, 4))
    level = np.zeros((batch, *scene.grid.shape), np.float32)
    return Contender(kind, "no environment", batch, batch, lambda: pushed(scene, level, strokes))


def _error(loose: Any, env: Any, params: Any) -> float:
    """How far random pushes of one environment end from another's: mean distance over mean height."""
    keys = jax.random.split(jax.random.key(4), _COMPARED)
    _, state = jax.vmap(env.reset, (0, None))(keys, params)
    actions = jax.vmap(env.action_space(params).sample)(keys)
    ends = [jax.jit(jax.vmap(e.step_env, (0, 0, 0, None)))(keys, state, actions, params)[1].height for e in (loose, env)]
    return float(jnp.abs(ends[0] - ends[1]).mean() / jnp.abs(ends[1]).mean())


def _gymnasium(kind: str, options: Row) -> list[Contender]:
    """A single environment, step by step, as an agent's loop has it; nothing without Gymnasium."""
    try:
        from jaxsand.envs.gymnasium import ExcavateEnv, MultiStrokeEnv, SingleStrokeEnv
    except ImportError:
        return []
    entries: Row = {_DIG: ExcavateEnv, _MAP: SingleStrokeEnv, _SAND: SingleStrokeEnv}
    env = entries.get(kind, MultiStrokeEnv)(**options)
    env.action_space.seed(0)
    env.reset(seed=0)

    def loop() -> None:
        for _ in range(_ALONE):
            _, _, terminated, truncated, _ = env.step(env.action_space.sample())
            if terminated or truncated:
                env.reset()

    return [Contender(kind, _LOOP, 1, _ALONE, loop)]


def _raced(ways: list[Contender], tell: Tell) -> list[Row]:
    times = race({f"{way.kind}, {way.name}": way.call for way in ways}, _ROUNDS, tell)
    return [
        {
            "kind": way.kind,
            "name": way.name,
            "batch": way.batch,
            "steps_per_second": way.steps / took.best,
            "seconds": took.best,
            "compile_seconds": took.compile_seconds,
        }
        for way, took in zip(ways, times.values(), strict=True)
    ]


def _reset_seconds(env: Any, params: Any, batch: int) -> float:
    """Of one environment in a batch."""
    reset = jax.jit(jax.vmap(env.reset, (0, None)))
    keys = jax.random.split(jax.random.key(3), batch)
    return timed(partial(reset, keys, params), _ROUNDS).best / batch
