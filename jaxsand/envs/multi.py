"""Many strokes: each action is a straight push from anywhere to anywhere on the map, after which the sand settles."""

from dataclasses import dataclass, field
from typing import Any

import jax
import jax.numpy as jnp

from jaxsand.envs import episode
from jaxsand.envs.episode import Step
from jaxsand.envs.pushing import Batching, ByLength, Push
from jaxsand.envs.spaces import Box, Dict
from jaxsand.goals import metrics as task
from jaxsand.interaction.blade_stepped import SteppedPush
from jaxsand.relaxation.stopping import Stop as StopRule
from jaxsand.scene.scene import Scene, blade_of


@dataclass(frozen=True)
class NoStop:
    """An episode goes on until it is truncated (neutral)."""

    size = 4

    def over(self, action: jax.Array, before: jax.Array, after: jax.Array) -> tuple[jax.Array, jax.Array]:
        """The map after an action, and whether that ended the episode."""
        del action, before
        return after, jnp.zeros((), bool)


@dataclass(frozen=True)
class Stop:
    """A fifth number above 0 ends the episode (terminated) in place of a push."""

    size = 5

    def over(self, action: jax.Array, before: jax.Array, after: jax.Array) -> tuple[jax.Array, jax.Array]:
        """The map after an action, and whether that ended the episode."""
        stop = action[4] > 0
        return jnp.where(stop, before, after), stop


@dataclass(frozen=True)
class WithBerms:
    """Maps are compared as they are (neutral): for goals that strokes made."""

    def seen(self, height: jax.Array) -> jax.Array:
        return height


@dataclass(frozen=True)
class OnlyDug:
    """Maps are compared on what is dug, min(h, 0): for goals that are drawn, which hold no berms."""

    def seen(self, height: jax.Array) -> jax.Array:
        return task.below(height)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class LevelGoals:
    """Goal maps `goals` [G, H, W] (m) for level sand; an episode takes any of them. See `library`."""

    goals: jax.Array

    def draw(self, key: jax.Array) -> tuple[jax.Array, jax.Array]:
        """A map to start from and a goal [H, W] (m)."""
        goal = self.goals[jax.random.randint(key, (), 0, self.goals.shape[0])]
        return jnp.zeros_like(goal), goal


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class RoughGoals:
    """Goal maps `goals` [G, H, W] (m), each with the map at rest that it starts from; an episode takes any of them."""

    goals: jax.Array
    starts: jax.Array

    def draw(self, key: jax.Array) -> tuple[jax.Array, jax.Array]:
        """A map to start from and a goal [H, W] (m)."""
        i = jax.random.randint(key, (), 0, self.goals.shape[0])
        return self.starts[i], self.goals[i]


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class StrokeState:
    """The `goal` and the `height` map [H, W] (m), and strokes so far."""

    goal: jax.Array
    height: jax.Array
    time: jax.Array


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class StrokeParams:
    """The `scene`, whose tool is a Blade, where `goals` come from, and after how many strokes an episode is truncated."""

    scene: Scene
    goals: LevelGoals | RoughGoals
    limit: jax.Array | int = 6


@dataclass(frozen=True)
class MultiStroke:
    """An action holds x0, y0, x1, y1, each -1 to 1 from the first to the last cell centre of the map; numbers beyond that
    push from off the map.

    With L the l2 distance of goal and map, sqrt(sum (goal - h)^2), in units of the blade's depth, the reward is
    L_t - L_{t+1}. An episode ends with its last stroke (truncated at `limit`), or when a `Stop` asks for it (terminated).

    Observations are the maps "goal" and "current" [H, W], in units of the blade's depth (float32). `info` holds the
    simulator's "outcome"; a push that leaves no finite map leaves the map as it was.

    `push` is the full push or the fast one, `SwathPush()`; `settle` its stop rule, by default until still.

    A reward is differentiable once, in forward and reverse mode, in the action, the state's maps and the scene's floats (not
    where the map is the goal to the last bit, nor in the fifth number of a `Stop`), whatever the batching.
    """

    push: Push = field(default_factory=SteppedPush)
    stop: NoStop | Stop = field(default_factory=NoStop)
    measure: WithBerms | OnlyDug = field(default_factory=WithBerms)
    batching: Batching = field(default_factory=ByLength)
    settle: StopRule | None = None

    def reset(self, key: jax.Array, params: StrokeParams) -> tuple[dict[str, jax.Array], StrokeState]:
        start, goal = params.goals.draw(key)
        state = StrokeState(goal, start, jnp.zeros((), jnp.int32))
        return self.observe(state, params), state

    def step_env(self, key: jax.Array, state: StrokeState, action: Any, params: StrokeParams) -> Step:
        """One stroke, without a new episode after the last; nothing is drawn from the key."""
        del key
        action = jnp.asarray(action, state.height.dtype)
        if action.shape != (self.stop.size,):
            raise ValueError(f"action: got shape {list(action.shape)}; give {self.stop.size} numbers")
        push = self.batching.pushing(self.push, self.settle)
        after, outcome = push(params.scene, state.height, self.stroke(action, params))
        after = jnp.where(jnp.all(jnp.isfinite(after)), after, state.height)
        after, terminated = self.stop.over(action, state.height, after)
        new = StrokeState(state.goal, after, state.time + 1)
        reward = self.distance(state, params) - self.distance(new, params)
        truncated = (new.time >= params.limit) & ~terminated
        return self.observe(new, params), new, reward, terminated, truncated, {"outcome": outcome}

    step = episode.step

    def distance(self, state: StrokeState, params: StrokeParams) -> jax.Array:
        """L: the l2 distance of goal and map in units of the blade's depth (float32)."""
        far = task.l2(self.measure.seen(state.goal), self.measure.seen(state.height))
        return (far / blade_of(params.scene).depth).astype(jnp.float32)

    def stroke(self, action: jax.Array, params: StrokeParams) -> jax.Array:
        """The stroke x0, y0, x1, y1 (m) of an action [4] or longer."""
        cells, spacing = _cells(params).astype(action.dtype), jnp.asarray(params.scene.grid.spacing, action.dtype)
        return (0.5 + (action[:4] + 1) / 2 * cells) * spacing

    def action(self, stroke: jax.typing.ArrayLike, params: StrokeParams) -> jax.Array:
        """The action of a stroke x0, y0, x1, y1 (m); with a `Stop`, one that goes on."""
        stroke = jnp.asarray(stroke)
        steps = stroke / jnp.asarray(params.scene.grid.spacing, stroke.dtype) - 0.5
        return jnp.concatenate(
            [2 * steps / _cells(params).astype(steps.dtype) - 1, -jnp.ones(self.stop.size - 4, steps.dtype)]
        )

    def observe(self, state: StrokeState, params: StrokeParams) -> dict[str, jax.Array]:
        maps = {"goal": state.goal, "current": state.height}
        return {name: (x / blade_of(params.scene).depth).astype(jnp.float32) for name, x in maps.items()}

    def action_space(self, params: StrokeParams) -> Box:
        del params
        return Box(-1, 1, (self.stop.size,))

    def observation_space(self, params: StrokeParams) -> Dict:
        return Dict({name: Box(-jnp.inf, jnp.inf, params.scene.grid.shape) for name in ("goal", "current")})


def _cells(params: StrokeParams) -> jax.Array:
    """Cells between the first and the last centre, for x0, y0, x1, y1."""
    rows, columns = params.scene.grid.shape
    return jnp.array([columns - 1, rows - 1, columns - 1, rows - 1])
