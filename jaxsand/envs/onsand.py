"""The single stroke on real sand: each step of the walk pushes the blade on by one map cell."""

from dataclasses import dataclass, field

import jax
import jax.numpy as jnp

from jaxsand.envs import episode
from jaxsand.envs.episode import Action, Step
from jaxsand.envs.maps import MapGoals, Walks
from jaxsand.envs.onmap import MapParams, MapState, OnMap
from jaxsand.envs.spaces import Box, Dict, Discrete
from jaxsand.goals import metrics
from jaxsand.interaction.simulate import act
from jaxsand.interaction.stepped import SteppedPush
from jaxsand.planning.targets import Layout
from jaxsand.scene.footprint import Pose, coverage
from jaxsand.scene.grid import centres
from jaxsand.scene.scene import Scene, blade_of


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class SandState:
    """The state of an episode of one stroke on sand.

    Attributes:
      walk: the state of the walk, as on a binary map.
      height: the sand [H, W] (m) with the blade down, before it is lifted.

    Example:
      >>> import jax
      >>> import jaxsand as js
      >>> env, params = js.make("single-stroke", on=js.env.OnSand((2, 2)))
      >>> obs, state = env.reset(jax.random.key(0), params)
      >>> state.height.shape
      (32, 32)
    """

    walk: MapState
    height: jax.Array


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class SandParams:
    """The parameters of `OnSand`; `jaxsand.make` makes them.

    Args:
      scene: grid, sand and a `Blade`.
      goals: what draws a binary map and its start.
      step_cost: is taken off the reward of every step.
      limit: steps after which an episode is truncated.

    Example:
      >>> import jaxsand as js
      >>> env, params = js.make("single-stroke", on=js.env.OnSand((2, 2)), limit=9)
      >>> params.limit
      9
    """

    scene: Scene
    goals: MapGoals = field(default_factory=Walks)
    step_cost: jax.Array | float = 0.0
    limit: jax.Array | int = 100

    @property
    def walk(self) -> MapParams:
        """The parameters of the walk on the binary map."""
        return MapParams(self.goals, self.step_cost, self.limit)


@dataclass(frozen=True)
class OnSand:
    """An environment of one stroke on sand, over the cells of a binary map that is laid out on it.

    Actions, rules and the end of an episode are those of `OnMap`; a step that is not legal pushes nothing. With
    L = sqrt(sum (min(goal, 0) - min(h, 0))^2), in units of the blade's depth, the reward is L_t - L_{t+1} - step_cost.

    Observations are maps of the sand's shape, row 0 at y = 0 (float32): "goal" and "current" in units of the blade's depth,
    and "pose", the share of each cell that the blade covers.

    The blade comes down anew at the start of each step, where it had stood, so the sand settles a little more than in one
    `follow` of the whole path. The first step digs the start.

    Args:
      shape: of the binary map.
      layout: how its cells lie on the sand.
      push: how the blade pushes.

    Example:
      >>> import jax
      >>> import jaxsand as js
      >>> env, params = js.make("single-stroke", on=js.env.OnSand((2, 2)))
      >>> obs, state = env.reset(jax.random.key(0), params)
      >>> obs["pose"].shape
      (32, 32)
    """

    shape: tuple[int, int] = (7, 7)
    layout: Layout = field(default_factory=Layout)
    push: SteppedPush = field(default_factory=SteppedPush)

    def reset(self, key: jax.Array, params: SandParams) -> tuple[dict[str, jax.Array], SandState]:
        """Begins an episode; returns its first observation and its state."""
        walk = self._walk.reset(key, params.walk)[1]
        state = SandState(walk, jnp.zeros(params.scene.grid.shape, jnp.float32))
        return self.observe(state, params), state

    def step_env(
        self, key: jax.Array, state: SandState, action: Action, params: SandParams
    ) -> Step[dict[str, jax.Array], SandState]:
        """Takes one step, and does not begin a new episode after the last; nothing is drawn from the key.

        Returns:
          Observation, state, reward, terminated, truncated, info.
        """
        _, walk, _, terminated, truncated, info = self._walk.step_env(key, state.walk, action, params.walk)
        leg = jnp.concatenate([self.at(state.walk.place, params), self.at(walk.place, params)])
        pushed = act(params.scene, state.height, leg.astype(state.height.dtype), push=self.push)
        clean = info["legal"] & jnp.all(jnp.isfinite(pushed.height))
        new = SandState(walk, jnp.where(clean, pushed.height, state.height))
        reward = self.distance(state, params) - self.distance(new, params) - jnp.float32(params.step_cost)
        return self.observe(new, params), new, reward, terminated, truncated, info | {"outcome": pushed.outcome}

    step = episode.step

    def legal(self, state: SandState, params: SandParams) -> jax.Array:
        """Which of north, east, south, west lead to a cell of the goal, [4]."""
        return self._walk.legal(state.walk, params.walk)

    def distance(self, state: SandState, params: SandParams) -> jax.Array:
        """L: the l2 distance on what is dug, in units of the blade's depth (float32)."""
        far = metrics.l2(self.goal(state.walk, params), metrics.below(state.height))
        return (far / blade_of(params.scene).depth).astype(jnp.float32)

    def goal(self, walk: MapState, params: SandParams) -> jax.Array:
        """The goal as a height map [H, W] (m): minus the blade's depth in each cell to dig, 0 elsewhere."""
        block = jnp.repeat(jnp.repeat(jnp.flipud(walk.dig), self.layout.cell, 0), self.layout.cell, 1)
        return jnp.pad(jnp.where(block, -jnp.float32(blade_of(params.scene).depth), 0), self.layout.margin)

    def at(self, place: jax.Array, params: SandParams) -> jax.Array:
        """The centre x, y (m) of a map cell (row, column), row 0 on top."""
        dx = jnp.float32(params.scene.grid.spacing)
        up = jnp.stack([place[1], self.shape[0] - 1 - place[0]])
        return (self.layout.margin + (up.astype(jnp.float32) + 0.5) * self.layout.cell) * dx

    def observe(self, state: SandState, params: SandParams) -> dict[str, jax.Array]:
        """The observation of a state."""
        blade, dx = blade_of(params.scene), jnp.float32(params.scene.grid.spacing)
        x, y = centres(params.scene.grid, jnp.float32)
        here = self.at(state.walk.place, params)
        pose = Pose(here[0], here[1], jnp.ones_like(here[0]), jnp.zeros_like(here[0]))
        cover = coverage(blade, pose, jnp.broadcast_to(x, params.scene.grid.shape), y, dx)
        maps = {"goal": self.goal(state.walk, params) / blade.depth, "current": state.height / blade.depth, "pose": cover}
        return {name: plane.astype(jnp.float32) for name, plane in maps.items()}

    def action_space(self, params: SandParams) -> Discrete:
        """The space of actions."""
        del params
        return Discrete(4)

    def observation_space(self, params: SandParams) -> Dict:
        """The space of observations."""
        shape = params.scene.grid.shape
        maps = {"goal": Box(-1, 0, shape), "current": Box(-jnp.inf, jnp.inf, shape), "pose": Box(0, 1, shape)}
        return Dict(maps)

    @property
    def _walk(self) -> OnMap:
        return OnMap(self.shape)
