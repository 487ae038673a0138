"""The single stroke on a binary map: the tool stays down, and digs each cell that it comes to.

The rules are the planner's: a walk over the goal's cells that digs them all, by one cell north, east, south or west.
"""

from dataclasses import dataclass, field
from typing import Any

import jax
import jax.numpy as jnp

from jaxsand.envs import episode
from jaxsand.envs.episode import Step
from jaxsand.envs.maps import STEPS, MapGoals, Walks
from jaxsand.envs.spaces import Box, Dict, Discrete


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class MapState:
    """The cells to `dig` and those `dug` [H, W] (bool, row 0 on top), the tool's `place` (row, column), and steps so far."""

    dig: jax.Array
    dug: jax.Array
    place: jax.Array
    time: jax.Array


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class MapParams:
    """Where `goals` come from, what a step costs, and after how many steps an episode is truncated."""

    goals: MapGoals = field(default_factory=Walks)
    step_cost: jax.Array | float = 0.0
    limit: jax.Array | int = 100


@dataclass(frozen=True)
class OnMap:
    """Actions 0 to 3 are N (one row up in the text), E, S and W, and dig the cell that the tool comes to.

    A step off the goal's cells, or off the map, is not `legal`: it leaves everything as it is, and costs a step. With L the
    goal's cells that are not dug, the reward is L_t - L_{t+1} - step_cost. An episode ends (terminated) when L is 0; the
    start is dug when it begins.

    Observations are planes [H, W] of 0 and 1 (float32): "goal", "current" (what is dug) and "pose" (where the tool stands).
    """

    shape: tuple[int, int] = (7, 7)

    def reset(self, key: jax.Array, params: MapParams) -> tuple[dict[str, jax.Array], MapState]:
        dig, start = params.goals.draw(key, self.shape)
        state = MapState(dig, _only(self.shape, start), start, jnp.zeros((), jnp.int32))
        return self.observe(state), state

    def step_env(self, key: jax.Array, state: MapState, action: Any, params: MapParams) -> Step:
        """One step, without a new episode after the last; nothing is drawn from the key."""
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
        """Which of N, E, S, W lead to a cell of the goal [4]."""
        del params
        row, column = (state.place[None] + STEPS).T
        padded = jnp.pad(state.dig, 1)
        return padded[row + 1, column + 1]

    def left(self, state: MapState) -> jax.Array:
        """How many of the goal's cells are not dug."""
        return jnp.sum(state.dig & ~state.dug)

    def observe(self, state: MapState) -> dict[str, jax.Array]:
        planes = {"goal": state.dig, "current": state.dug, "pose": _only(self.shape, state.place)}
        return {name: plane.astype(jnp.float32) for name, plane in planes.items()}

    def action_space(self, params: MapParams) -> Discrete:
        del params
        return Discrete(4)

    def observation_space(self, params: MapParams) -> Dict:
        del params
        return Dict({name: Box(0, 1, self.shape) for name in ("goal", "current", "pose")})


def _only(shape: tuple[int, int], place: jax.Array) -> jax.Array:
    """The map on which one cell is true."""
    rows, columns = shape
    down, across = (jnp.arange(n, dtype=place.dtype) for n in (rows, columns))
    return (down == place[0])[:, None] & (across == place[1])[None, :]
