"""How many maps a DQN digs by one walk, and in how many steps compared with the fewest.

A walk is greedy: it takes the legal step of the highest value, without a search or a model. A walk that has taken `MOST`
steps for each cell, such as one that goes round in circles, is given up, and its map is not solved. Walks start where the
map says, and the fewest steps are the planner's from there, proven. Look-ahead is a beam of plans that uses the environment
as a model.
"""

import time
from collections.abc import Mapping
from functools import partial
from string import ascii_uppercase
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from jaxsand.envs.maps import STEPS, MapPool, map_pool
from jaxsand.envs.onmap import MapParams, MapState, OnMap
from jaxsand.goals import letters
from jaxsand.planning.binary import Cell, plan
from jaxsand.scene.progress import Tell, quiet
from train.dqn.networks import Greedy, best, of

if TYPE_CHECKING:
    from train.dqn.learner import Dqn, Walking

MOST = 3
"""A walk is given up after so many steps for each cell."""

_Carry = tuple[dict[str, jax.Array], MapState, jax.Array, jax.Array]  # observations, states, steps taken, the step's number
_Beam = tuple[jax.Array, jax.Array, jax.Array, jax.Array, jax.Array]  # dug, places, alive, steps taken, the step's number


def evaluate(
    learner: "Dqn",
    state: "Walking",
    maps: Mapping[str, tuple[np.ndarray, Cell | None]] | None = None,
    width: int = 0,
    tell: Tell = quiet,
) -> dict[str, Any]:
    """How many maps are `solved`, and how many in the fewest steps (`optimal`).

    Args:
      learner: the DQN.
      state: its state.
      maps: by name the cells [H, W] to dig and a start, or None for the planner's; without maps the 26 letters with theirs.
      width: of the beam of plans that looks ahead; 0 walks greedily.
      tell: is called with a line of progress.

    Raises:
      ValueError: for maps of another shape than the learner's, or as `jaxsand.env.map_pool` does.
    """
    began = time.perf_counter()
    maps = maps or {letter: letters.letter_map(letter) for letter in ascii_uppercase}
    env: Any = learner.task.env
    shape = env.shape
    for name, (dig, _) in maps.items():
        if np.shape(dig) != shape:
            raise ValueError(f"maps: {name!r} has shape {list(np.shape(dig))}; give maps of {list(shape)} cells")
    tell("the fewest steps")
    digs, starts = zip(*maps.values(), strict=True)
    pool = map_pool(digs, starts)
    few = fewest(pool)
    tell("walking")
    policy = learner.policy(state)
    steps = beams(policy, pool, width) if width else walks(policy, pool)
    rows = {
        name: {"solved": bool(taken), "steps": int(taken) or None, "fewest": int(least)}
        for name, taken, least in zip(maps, steps, few, strict=True)
    }
    return {
        "solved": int(np.sum(steps > 0)),
        "optimal": int(np.sum(steps == few)),
        "total": len(rows),
        "maps": rows,
        "seconds": time.perf_counter() - began,
    }


def fewest(pool: MapPool) -> np.ndarray:
    """The fewest steps [G] of the maps, by the planner."""
    starts = [(int(row), int(column)) for row, column in np.asarray(pool.starts)]
    plans = [plan(dig, start, engine="exact") for dig, start in zip(np.asarray(pool.dig), starts, strict=True)]
    return np.array([one.steps for one in plans])


def walks(policy: Greedy, pool: MapPool) -> np.ndarray:
    """The steps [G] of greedy walks on a pool's maps; 0 where a map is not solved."""
    return np.asarray(_walks(policy, pool))


def beams(policy: Greedy, pool: MapPool, width: int) -> np.ndarray:
    """The steps [G] of the shortest plan found by a beam search; 0 where a map is not solved.

    Of all steps from `width` plans, `width` different ones go on whose rewards so far plus value of what is left are
    highest.
    """
    return np.asarray(_beams(policy, pool, width))


@jax.jit
def _walks(policy: Greedy, pool: MapPool) -> jax.Array:
    (rows, columns), key = pool.dig.shape[1:], jax.random.key(0)
    env = OnMap((rows, columns))
    seen, states = jax.vmap(lambda dig, at: env.reset(key, MapParams(MapPool(dig[None], at[None]))))(pool.dig, pool.starts)
    most = MOST * jnp.sum(pool.dig, axis=(1, 2))

    def going(carry: _Carry) -> jax.Array:
        _, _, steps, number = carry
        return jnp.any((steps == 0) & (number < most))

    def one(carry: _Carry) -> _Carry:
        seen, states, steps, number = carry
        action = policy.act(seen, jax.vmap(env.legal, (0, None))(states, MapParams()))
        seen, states, _, over, _, _ = jax.vmap(env.step_env, (None, 0, 0, None))(key, states, action, MapParams())
        return seen, states, jnp.where((steps == 0) & over & (number < most), number + 1, steps), number + 1

    return lax.while_loop(going, one, (seen, states, jnp.zeros(len(most), jnp.int32), jnp.int32(0)))[2]


@partial(jax.jit, static_argnames="width")
def _beams(policy: Greedy, pool: MapPool, width: int) -> jax.Array:
    shape = pool.dig.shape[1:]
    cells = np.stack(np.unravel_index(np.arange(shape[0] * shape[1]), shape), axis=-1)
    there = cells[:, None] + STEPS[None]
    on_map = ((there >= 0) & (there < np.array(shape))).all(-1)
    to = jnp.asarray(np.where(on_map, there[..., 0] * shape[1] + there[..., 1], 0), jnp.int32)  # cell [C], step [4] -> cell
    on = jnp.asarray(on_map)

    def value(dig: jax.Array, dug: jax.Array, place: jax.Array) -> jax.Array:
        planes = {"goal": jnp.broadcast_to(dig[None], dug.shape), "current": dug, "pose": jax.nn.one_hot(place, dig.size)}
        values = policy.values({name: x.reshape(-1, *shape) for name, x in planes.items()})
        return of(values, best(values, dig[to[place]] & on[place]))

    def one(dig: jax.Array, start: jax.Array) -> jax.Array:
        first = start[0] * shape[1] + start[1]
        dug = jax.nn.one_hot(jnp.full(width, first), dig.size, dtype=bool)
        most = MOST * jnp.sum(dig)

        def going(carry: _Beam) -> jax.Array:
            _, _, _, steps, number = carry
            return (steps == 0) & (number < most)

        def step(carry: _Beam) -> _Beam:
            dug, place, alive, _, number = carry
            new = to[place].ravel()
            legal = (alive[:, None] & on[place]).ravel() & dig[new]
            after = jnp.repeat(dug, 4, axis=0) | jax.nn.one_hot(new, dig.size, dtype=bool)
            marks = after.astype(jnp.float32)
            count = jnp.sum(marks, axis=1)
            differ = count[:, None] + count[None, :] - 2 * marks @ marks.T
            same = (differ == 0) & (new[:, None] == new[None, :]) & legal[None, :]
            legal &= ~jnp.any(jnp.tril(same, -1), axis=1)
            over = jnp.any(legal & jnp.all(after | ~dig[None], axis=1))
            scores, chosen = lax.top_k(jnp.where(legal, count + value(dig, after, new), -jnp.inf), width)
            return after[chosen], new[chosen], jnp.isfinite(scores), jnp.where(over, number + 1, 0), number + 1

        carry = (dug, jnp.full(width, first), jnp.arange(width) == 0, jnp.int32(0), jnp.int32(0))
        return lax.while_loop(going, step, carry)[3]

    return jax.vmap(one)(pool.dig.reshape(len(pool.dig), -1), pool.starts)
