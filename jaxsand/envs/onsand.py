"""The single stroke on real sand: each step of the walk is a push of one map cell, with the blade down."""

from dataclasses import dataclass, field
from typing import Any

import jax
import jax.numpy as jnp

from jaxsand.envs import episode
from jaxsand.envs.episode import Step
from jaxsand.envs.maps import MapGoals, Walks
from jaxsand.envs.onmap import MapParams, MapState, OnMap
from jaxsand.envs.spaces import Box, Dict, Discrete
from jaxsand.goals import metrics as task
from jaxsand.interaction.blade_stepped import SteppedPush
from jaxsand.interaction.simulate import act
from jaxsand.planning.pipeline import Layout
from jaxsand.scene.scene import Scene, blade_of
from jaxsand.scene.tools import Pose, coverage


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class SandState:
    """The walk so far, and the `height` map [H, W] (m) with the blade down, as it is before the blade is lifted."""

    walk: MapState
    height: jax.Array


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class SandParams:
    """The `scene`, whose tool is a Blade; the rest as in `MapParams`."""

    scene: Scene
    goals: MapGoals = field(default_factory=Walks)
    step_cost: jax.Array | float = 0.0
    limit: jax.Array | int = 100

    @property
    def walk(self) -> MapParams:
        return MapParams(self.goals, self.step_cost, self.limit)


@dataclass(frozen=True)
class OnSand:
    """The actions, the rules and the end of `OnMap`, on a map of sand that its cells are laid out on (see `Layout`).

    With L the l2 distance on what is dug, sqrt(sum (min(goal, 0) - min(h, 0))^2), in units of the blade's depth, the reward
    is L_t - L_{t+1} - step_cost. A step that is not legal pushes nothing.

    Observations are maps of the sand's shape, row 0 at the bottom (float32): "goal" and "current" in units of the blade's
    depth, and "pose", the share of each cell that the blade covers.

    The blade comes down anew at the start of each leg, where it had stood; `follow` of the whole path settles a little less.
    The start is dug by the first leg.
    """

    shape: tuple[int, int] = (7, 7)
    layout: Layout = field(default_factory=Layout)
    push: SteppedPush = field(default_factory=SteppedPush)

    def reset(self, key: jax.Array, params: SandParams) -> tuple[dict[str, jax.Array], SandState]:
        walk = self._walk.reset(key, params.walk)[1]
        state = SandState(walk, jnp.zeros(params.scene.grid.shape, jnp.float32))
        return self.observe(state, params), state

    def step_env(self, key: jax.Array, state: SandState, action: Any, params: SandParams) -> Step:
        """One step, without a new episode after the last; nothing is drawn from the key."""
        _, walk, _, terminated, truncated, info = self._walk.step_env(key, state.walk, action, params.walk)
        leg = jnp.concatenate([self.at(state.walk.place, params), self.at(walk.place, params)])
        pushed = act(params.scene, state.height, leg.astype(state.height.dtype), push=self.push)
        clean = info["legal"] & jnp.all(jnp.isfinite(pushed.height))
        new = SandState(walk, jnp.where(clean, pushed.height, state.height))
        reward = self.distance(state, params) - self.distance(new, params) - jnp.float32(params.step_cost)
        return self.observe(new, params), new, reward, terminated, truncated, info | {"outcome": pushed.outcome}

    step = episode.step

    def legal(self, state: SandState, params: SandParams) -> jax.Array:
        """Which of N, E, S, W lead to a cell of the goal [4]."""
        return self._walk.legal(state.walk, params.walk)

    def distance(self, state: SandState, params: SandParams) -> jax.Array:
        """L: the l2 distance on what is dug, in units of the blade's depth (float32)."""
        far = task.l2(self.goal(state.walk, params), task.below(state.height))
        return (far / blade_of(params.scene).depth).astype(jnp.float32)

    def goal(self, walk: MapState, params: SandParams) -> jax.Array:
        """The goal as a height map [H, W] (m): the blade's depth under each cell to dig."""
        block = jnp.repeat(jnp.repeat(jnp.flipud(walk.dig), self.layout.cell, 0), self.layout.cell, 1)
        return jnp.pad(jnp.where(block, -jnp.float32(blade_of(params.scene).depth), 0), self.layout.margin)

    def at(self, place: jax.Array, params: SandParams) -> jax.Array:
        """Where the centre of a map cell (row, column; row 0 on top) lies: x, y (m)."""
        dx = jnp.float32(params.scene.grid.spacing)
        up = jnp.stack([place[1], self.shape[0] - 1 - place[0]])
        return (self.layout.margin + (up.astype(jnp.float32) + 0.5) * self.layout.cell) * dx

    def observe(self, state: SandState, params: SandParams) -> dict[str, jax.Array]:
        blade, dx = blade_of(params.scene), jnp.float32(params.scene.grid.spacing)
        rows, columns = params.scene.grid.shape
        x, y = ((jnp.arange(n, dtype=jnp.float32) + 0.5) * dx for n in (columns, rows))
        here = self.at(state.walk.place, params)
        pose = Pose(here[0], here[1], jnp.ones_like(here[0]), jnp.zeros_like(here[0]))
        cover = coverage(blade, pose, jnp.broadcast_to(x[None], (rows, columns)), y[:, None], dx)
        maps = {"goal": self.goal(state.walk, params) / blade.depth, "current": state.height / blade.depth, "pose": cover}
        return {name: plane.astype(jnp.float32) for name, plane in maps.items()}

    def action_space(self, params: SandParams) -> Discrete:
        del params
        return Discrete(4)

    def observation_space(self, params: SandParams) -> Dict:
        shape = params.scene.grid.shape
        maps = {"goal": Box(-1, 0, shape), "current": Box(-jnp.inf, jnp.inf, shape), "pose": Box(0, 1, shape)}
        return Dict(maps)

    @property
    def _walk(self) -> OnMap:
        return OnMap(self.shape)
