"""The single stroke on a binary map: the tool stays down, and digs each cell that it comes to.

The rules are those of `jaxsand.plan`: a walk over the goal's cells that digs them all, by one cell north, east, south or
west.
"""

from dataclasses import dataclass, field

import jax
import jax.numpy as jnp

from jaxsand.envs import episode
from jaxsand.envs.episode import Action, Step
from jaxsand.envs.maps import STEPS, MapGoals, Walks
from jaxsand.envs.spaces import Box, Dict, Discrete


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class MapState:
    """The state of an episode on a binary map, row 0 on top.

    Attributes:
      dig: the cells to dig, booleans [H, W].
      dug: the cells dug so far, booleans [H, W].
      place: (row, column) of the tool.
      time: steps so far.

    Example:
      >>> import jax
      >>> import jaxsand as js
      >>> env, params = js.make("single-stroke")
      >>> obs, state = env.reset(jax.random.key(0), params)
      >>> int(state.dug.sum())
      1
    """

    dig: jax.Array
    dug: jax.Array
    place: jax.Array
    time: jax.Array


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class MapParams:
    """The parameters of `OnMap`; `jaxsand.make` makes them.

    Args:
      goals: what draws a map and its start.
      step_cost: is taken off the reward of every step.
      limit: steps after which an episode is truncated.

    Example:
      >>> import jaxsand as js
      >>> js.env.MapParams(limit=20).step_cost
      0.0
    """

    goals: MapGoals = field(default_factory=Walks)
    step_cost: jax.Array | float = 0.0
    limit: jax.Array | int = 100


@dataclass(frozen=True)
class OnMap:
    """An environment of one stroke over a binary map.

    Actions 0 to 3 move the tool north (one row up in the text), east, south and west, and dig the cell that it comes to. A
    step off the goal's cells, or off the map, is not legal: it changes nothing, but counts as a step; info["legal"] says so.

    With L the number of the goal's cells that are not dug, the reward is L_t - L_{t+1} - step_cost. An episode terminates
    when L is 0, and is truncated after `limit` steps. The start is dug when it begins.

    Observations are planes [H, W] of 0 and 1 (float32), row 0 on top: "goal", "current" (what is dug) and "pose" (where the
    tool stands).

    Args:
      shape: of the maps.

    Example:
      >>> import jax
      >>> import jaxsand as js
      >>> env, params = js.make("single-stroke", on=js.env.OnMap((5, 5)))
      >>> obs, state = env.reset(jax.random.key(0), params)
      >>> obs["pose"].shape
      (5, 5)
    """

    shape: tuple[int, int] = (7, 7)

    def reset(self, key: jax.Array, params: MapParams) -> tuple[dict[str, jax.Array], MapState]:
        """Begins an episode; returns its first observation and its state."""
        dig, start = params.goals.draw(key, self.shape)
        state = MapState(dig, _only(self.shape, start), start, jnp.zeros((), jnp.int32))
        return self.observe(state), state

    def step_env(
        self, key: jax.Array, state: MapState, action: Action, params: MapParams
    ) -> Step[dict[str, jax.Array], MapState]:
        """Takes one step, and does not begin a new episode after the last; nothing is drawn from the key.

        Returns:
          Observation, state, reward, terminated, truncated, info.
        """
        del key
        legal = self.legal(state, params)[action]
        place = jnp.where(legal, state.place + jnp.asarray(STEPS)[action], state.place)
        new = MapState(state.dig, state.dug | _only(self.shape, place), place, state.time + 1)
        before, after = self.left(state), self.left(new)
        reward = jnp.float32(before - after) - jnp.float32(params.step_cost)
        terminated = after == 0
        truncated = (new.time >= params.limit) & ~terminated
        return self.observe(new), new, reward, terminated, truncated, {"legal": legal}

    step = episode.step

    def legal(self, state: MapState, params: MapParams) -> jax.Array:
        """Which of north, east, south, west lead to a cell of the goal, [4]."""
        del params
        row, column = (state.place[None] + STEPS).T
        padded = jnp.pad(state.dig, 1)
        return padded[row + 1, column + 1]

    def left(self, state: MapState) -> jax.Array:
        """How many of the goal's cells are not dug."""
        return jnp.sum(state.dig & ~state.dug)

    def observe(self, state: MapState) -> dict[str, jax.Array]:
        """The observation of a state."""
        planes = {"goal": state.dig, "current": state.dug, "pose": _only(self.shape, state.place)}
        return {name: plane.astype(jnp.float32) for name, plane in planes.items()}

    def action_space(self, params: MapParams) -> Discrete:
        """The space of actions."""
        del params
        return Discrete(4)

    def observation_space(self, params: MapParams) -> Dict:
        """The space of observations."""
        del params
        return Dict({name: Box(0, 1, self.shape) for name in ("goal", "current", "pose")})


def _only(shape: tuple[int, int], place: jax.Array) -> jax.Array:
    """The map on which one cell is true."""
    rows, columns = shape
    down, across = (jnp.arange(n, dtype=place.dtype) for n in (rows, columns))
    return (down == place[0])[:, None] & (across == place[1])[None, :]
