"""Goals of the single stroke: binary maps, row 0 on top, with the cell where the tool starts."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from jaxsand.planning.binary import Cell, make_problem, plan
from jaxsand.planning.binary.board import MOVES
from jaxsand.scene.masked import DIG, unmasked

STEPS = np.array([*MOVES.values()], np.int32)
"""The changes of row and column by a step north, east, south and west, [4, 2]."""


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class MapPool:
    """Binary maps with their starts; an episode draws one of them. `map_pool` and `pool_of` make pools.

    Args:
      dig: booleans [G, H, W], true where to dig, row 0 on top.
      starts: (row, column) of the first cell, [G, 2].

    Example:
      >>> import jax
      >>> import numpy as np
      >>> import jaxsand as js
      >>> pool = js.env.map_pool([np.ones((2, 2), bool)])
      >>> dig, start = pool.draw(jax.random.key(0), (2, 2))
      >>> int(dig.sum())
      4
    """

    dig: jax.Array
    starts: jax.Array

    def draw(self, key: jax.Array, shape: tuple[int, int]) -> tuple[jax.Array, jax.Array]:
        """Draws a map [H, W] and its start [2]."""
        if self.dig.shape[-2:] != shape:
            raise ValueError(f"goals.dig: got maps of {list(self.dig.shape[-2:])} cells; the environment has {list(shape)}")
        i = jax.random.randint(key, (), 0, self.dig.shape[0])
        return self.dig[i], self.starts[i]


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Walks:
    """A new random walk for every episode: its cells are to be dug, and the tool starts where the walk did.

    The walk goes straight on with a given probability, else turns left or right, and back only from a dead end. A vmapped
    `step` draws a walk at every step, whether or not an episode ends; `pool_of` draws many beforehand.

    Args:
      shortest, longest: steps of the walk.
      straight: the probability to go straight on.

    Example:
      >>> import jax
      >>> import jaxsand as js
      >>> dig, start = js.env.Walks(shortest=3, longest=3).draw(jax.random.key(0), (7, 7))
      >>> bool(dig[start[0], start[1]])
      True
    """

    shortest: jax.Array | int = 6
    longest: jax.Array | int = 30
    straight: jax.Array | float = 0.75

    def draw(self, key: jax.Array, shape: tuple[int, int]) -> tuple[jax.Array, jax.Array]:
        """Draws a map [H, W] and its start [2]."""
        number, begin, walk = jax.random.split(key, 3)
        steps = jax.random.randint(number, (), self.shortest, jnp.asarray(self.longest) + 1)
        start = jax.random.randint(begin, (2,), 0, jnp.asarray(shape), jnp.int32)
        turns = jnp.array([self.straight, (1 - self.straight) / 2, 1e-6, (1 - self.straight) / 2], jnp.float32)

        def one(k: jax.Array, carry: tuple[jax.Array, jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array, jax.Array]:
            dig, place, heading = carry
            there = place[None] + STEPS
            on = jnp.all((there >= 0) & (there < jnp.asarray(shape, jnp.int32)[None]), axis=1)
            odds = jnp.where(on, jnp.log(jnp.roll(turns, heading)), -jnp.inf)
            heading = jax.random.categorical(jax.random.fold_in(walk, k), odds)
            place = there[heading]
            return dig.at[place[0], place[1]].set(True), place, heading

        dig = jnp.zeros(shape, bool).at[start[0], start[1]].set(True)
        heading = jax.random.randint(jax.random.fold_in(begin, 0), (), 0, 4)
        return lax.fori_loop(0, steps, one, (dig, start, heading))[0], start


MapGoals = MapPool | Walks


@partial(jax.jit, static_argnames=("count", "shape"))
def pool_of(goals: MapGoals, key: jax.Array, count: int, shape: tuple[int, int] = (7, 7)) -> MapPool:
    """Draws many maps beforehand, so that a reset, which picks one of them, costs next to nothing.

    Args:
      goals: what draws the maps, such as `Walks()`.
      key: a JAX key.
      count: how many maps.
      shape: of a map.

    Returns:
      A `MapPool`.

    Example:
      >>> import jax
      >>> import jaxsand as js
      >>> js.env.pool_of(js.env.Walks(), jax.random.key(0), count=5).dig.shape
      (5, 7, 7)
    """
    return MapPool(*jax.vmap(lambda k: goals.draw(k, shape))(jax.random.split(key, count)))


def map_pool(maps: Sequence[np.ndarray] | np.ndarray, starts: Sequence[Cell | None] | None = None) -> MapPool:
    """Makes a pool of given binary maps.

    Args:
      maps: booleans [H, W], all of one shape, true where to dig, row 0 on top.
      starts: (row, column) of the first cell of each map; where it is None, or without starts, the planner chooses it.

    Returns:
      A `MapPool`.

    Raises:
      ValueError: for maps of different shapes, one that is empty or falls into pieces, or a start that is not to be dug.

    Example:
      >>> import numpy as np
      >>> import jaxsand as js
      >>> js.env.map_pool([np.ones((2, 3), bool)], starts=[(0, 1)]).starts.tolist()
      [[0, 1]]
    """
    maps = [np.asarray(unmasked("maps", dig, DIG), bool) for dig in maps]
    if not maps or len({dig.shape for dig in maps}) > 1:
        raise ValueError(f"maps: got shapes {[list(dig.shape) for dig in maps][:4]}; give one or more maps of one shape")
    starts = [None] * len(maps) if starts is None else starts
    if len(starts) != len(maps):
        raise ValueError(f"starts: got {len(starts)} for {len(maps)} maps; give one for each, or none")
    found = []
    for dig, start in zip(maps, starts, strict=True):
        make_problem(dig, start)
        found.append(plan(dig).cells[0] if start is None else start)
    return MapPool(jnp.asarray(np.stack(maps)), jnp.asarray(np.array(found, np.int32)))
