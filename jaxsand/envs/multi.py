"""Many strokes: each action is a straight push from anywhere to anywhere on the map, after which the sand settles."""

from dataclasses import dataclass, field
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np

from jaxsand.envs import episode
from jaxsand.envs.episode import Action, Step
from jaxsand.envs.heights import Heights, OwnDepth
from jaxsand.envs.pushing import Batching, ByLength, Push, pushing
from jaxsand.envs.spaces import Dict
from jaxsand.envs.weights import Wanted, chosen, heights, shown, shown_spaces
from jaxsand.envs.zones import NoZones, Told, Zones, kept
from jaxsand.goals.goal import Goal, Power
from jaxsand.interaction.stepped import SteppedPush
from jaxsand.relaxation.stopping import Stop as StopRule
from jaxsand.scene.scene import Scene, blade_of
from jaxsand.scene.validation import short

Tree = TypeVar("Tree")
Map = Any
"""Heights [..., H, W] (m), numpy's or JAX's."""


@dataclass(frozen=True)
class NoStop:
    """Tells an environment that an episode ends only when it is truncated, the default.

    Example:
      >>> import jaxsand as js
      >>> js.env.MultiStroke().stop
      NoStop()
    """

    more = 0  # numbers of an action besides those of what it does

    def over(self, action: jax.Array, before: Tree, after: Tree) -> tuple[Tree, jax.Array]:
        """What an action leaves, and whether it ended the episode."""
        del action, before
        return after, jnp.zeros((), bool)


@dataclass(frozen=True)
class Stop:
    """Tells an environment that actions have one number more, which ends the episode in place of a push when it is above 0.

    Example:
      >>> import numpy as np
      >>> import jaxsand as js
      >>> env, params = js.make("multi-stroke", goals=np.zeros((1, 32, 32)), stop=js.env.Stop())
      >>> env.action_space(params).shape
      (5,)
    """

    more = 1  # numbers of an action besides those of what it does

    def over(self, action: jax.Array, before: Tree, after: Tree) -> tuple[Tree, jax.Array]:
        """What an action leaves, and whether it ended the episode."""
        stop = action[-1] > 0
        return jax.tree.map(lambda old, new: jnp.where(stop, old, new), before, after), stop


@dataclass(frozen=True)
class WithBerms:
    """Tells an environment to compare maps as they are, the default: for goals that strokes made, or that say what matters.

    Example:
      >>> import numpy as np
      >>> import jaxsand as js
      >>> float(js.env.WithBerms().distance(np.zeros((1, 1)), np.full((1, 1), 2.0)))
      2.0
    """

    def distance(self, goal: Map | Goal, height: Map) -> Map:
        """The distance [...] (m) of maps [..., H, W] from goals [..., H, W]: a `Goal`'s own, or l2 from plain maps."""
        return (goal if isinstance(goal, Goal) else Goal(goal)).distance(height)


@dataclass(frozen=True)
class OnlyDug:
    """Tells an environment to compare what is dug, min(h, 0): for goals that are drawn without berms.

    Example:
      >>> import numpy as np
      >>> import jaxsand as js
      >>> float(js.env.OnlyDug().distance(np.zeros((1, 1)), np.full((1, 1), 2.0)))
      0.0
    """

    def distance(self, goal: Map, height: Map) -> Map:
        """The l2 distance [...] (m) of what is dug of maps [..., H, W] and goals [..., H, W]."""
        return Goal(goal * (goal < 0)).distance(height * (height < 0))


@dataclass(frozen=True)
class Weighted:
    """Tells an environment what it costs where sand stands above or below a goal; see `jaxsand.Goal`.

    Args:
      above: the weight of sand above the goal, 0 or more; with 0, heaps may lie anywhere.
      below: the weight of sand below the goal, 0 or more.
      power: 2 or 1.

    Example:
      >>> import numpy as np
      >>> import jaxsand as js
      >>> measure = js.env.Weighted(above=0.0)
      >>> [float(measure.distance(np.zeros((1, 1)), np.full((1, 1), h))) for h in (2.0, -2.0)]
      [0.0, 2.0]
    """

    above: float = 1.0
    below: float = 1.0
    power: Power = 2

    def __post_init__(self) -> None:
        for name in ("above", "below"):
            value = getattr(self, name)
            if not (isinstance(value, int | float | np.number) and 0 <= value < np.inf):
                raise ValueError(f"measure.{name}: got {short(value)}; give a weight of 0 or more")
        if not self.above and not self.below:
            raise ValueError("measure: got weights of 0 above and below, which count nothing; give one above 0")
        if self.power not in (1, 2):
            raise ValueError(f"measure.power: got {short(self.power)}; give 1 or 2")

    def distance(self, goal: Map, height: Map) -> Map:
        """The distance [...] (m) of maps [..., H, W] from goals [..., H, W]."""
        return Goal(goal, self.above, self.below, self.power).distance(height)


Measure = WithBerms | OnlyDug | Weighted


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class LevelGoals:
    """Goals for level sand at height 0; an episode draws one of them. `library` makes them.

    Args:
      goals: maps [G, H, W] (m), or a `jaxsand.Goal` of such whose weights are numbers or maps [G, H, W].

    Example:
      >>> import jax
      >>> import jax.numpy as jnp
      >>> import jaxsand as js
      >>> start, goal = js.env.LevelGoals(jnp.ones((3, 8, 8))).draw(jax.random.key(0))
      >>> float(start.max()), float(goal.min())
      (0.0, 1.0)
    """

    goals: Wanted

    def draw(self, key: jax.Array) -> tuple[jax.Array, Wanted]:
        """Draws a map to start from and a goal, both [H, W] (m)."""
        goal = chosen(self.goals, jax.random.randint(key, (), 0, heights(self.goals).shape[0]))
        return jnp.zeros_like(heights(goal)), goal


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class RoughGoals:
    """Goals, each with the surface that it starts from; an episode draws one of them. `library` makes them.

    Args:
      goals: maps [G, H, W] (m), or a `jaxsand.Goal` of such whose weights are numbers or maps [G, H, W].
      starts: maps [G, H, W] (m), at rest.

    Example:
      >>> import jax
      >>> import jax.numpy as jnp
      >>> import jaxsand as js
      >>> start, goal = js.env.RoughGoals(jnp.ones((3, 8, 8)), jnp.zeros((3, 8, 8))).draw(jax.random.key(0))
      >>> float(start.max()), float(goal.min())
      (0.0, 1.0)
    """

    goals: Wanted
    starts: jax.Array

    def draw(self, key: jax.Array) -> tuple[jax.Array, Wanted]:
        """Draws a map to start from and a goal, both [H, W] (m)."""
        i = jax.random.randint(key, (), 0, heights(self.goals).shape[0])
        return self.starts[i], chosen(self.goals, i)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class StrokeState:
    """The state of an episode of many strokes.

    Attributes:
      goal: [H, W] (m), or a `jaxsand.Goal` of it and its weights.
      height: the sand as it lies, [H, W] (m).
      time: strokes so far.

    Example:
      >>> import jax.numpy as jnp
      >>> import jaxsand as js
      >>> state = js.env.StrokeState(jnp.zeros((8, 8)), jnp.zeros((8, 8)), jnp.int32(0))
      >>> int(state.time)
      0
    """

    goal: Wanted
    height: jax.Array
    time: jax.Array


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class StrokeParams:
    """The parameters of `MultiStroke`; `jaxsand.make` makes them.

    Args:
      scene: grid, sand and a `Blade`.
      goals: what an episode draws its goal and its start from.
      limit: strokes after which an episode is truncated.
      zones: where the blade may not be: `NoZones()`, `ClippedBy(cells)` or `RefusedBy(cells)`.

    Example:
      >>> import numpy as np
      >>> import jaxsand as js
      >>> env, params = js.make("multi-stroke", goals=np.zeros((1, 32, 32)), limit=3)
      >>> params.limit
      3
    """

    scene: Scene
    goals: LevelGoals | RoughGoals
    limit: jax.Array | int = 6
    zones: Zones = field(default_factory=NoZones)


@dataclass(frozen=True)
class MultiStroke:
    """An environment of straight pushes: each action is a stroke, after which the sand settles.

    An action holds x0, y0, x1, y1, each from -1 to 1, from the first to the last cell centre of the map; numbers beyond that
    push from off the map. With `Heights()` it holds x0, y0, z0, x1, y1, z1, where z, the height of the blade's bottom, rises
    or sinks evenly on the way, from -1 to 1 between heights that the blade's depth gives. Observations are the maps "goal"
    and "current" [H, W] in units of the blade's depth, and where goals have weights that are maps, these as "above" and
    "below" (float32); free cells have weights of 0 and a goal of 0.

    With L the distance of map and goal by `measure`, sqrt(sum (goal - h)^2), or that of a `jaxsand.Goal` by its weights, in
    units of the blade's depth, the reward is L_t - L_{t+1}. An episode is truncated after `limit` strokes, and terminated
    when a `Stop` asks for it. `info` holds the simulator's "outcome", and with zones "clipped" and "went"; see `ClippedBy`.
    A push that leaves a map that is not finite, leads straight up or down, or may not be made, counts as a stroke and leaves
    the map as it was.

    The reward is differentiable once, in forward and reverse mode, in the action, the state's maps and the scene's floats
    (but not where the map equals the goal, nor in the number of a `Stop`), whatever the batching.

    Args:
      push: `SteppedPush()` (the full push, the default) or `SwathPush()` (fast).
      stop: `NoStop()` or `Stop()`.
      measure: `WithBerms()`, `OnlyDug()` or `Weighted(above, below)`.
      batching: `ByLength()` (for a CPU, the default) or `Together()` (for a GPU).
      settle: when settling stops; None means when the sand is still.
      heights: `OwnDepth()` (the default) or `Heights()`.

    Example:
      >>> import jax
      >>> import jax.numpy as jnp
      >>> import numpy as np
      >>> import jaxsand as js
      >>> env, params = js.make("multi-stroke", goals=np.zeros((1, 32, 32)))
      >>> obs, state = env.reset(jax.random.key(0), params)
      >>> obs["current"].shape
      (32, 32)
      >>> bool(jnp.allclose(env.stroke(-jnp.ones(4), params), 0.005))
      True
    """

    push: Push = field(default_factory=SteppedPush)
    stop: NoStop | Stop = field(default_factory=NoStop)
    measure: Measure = field(default_factory=WithBerms)
    batching: Batching = field(default_factory=ByLength)
    settle: StopRule | None = None
    heights: OwnDepth | Heights = field(default_factory=OwnDepth)

    @property
    def size(self) -> int:
        """How many numbers an action has."""
        return self.heights.size + self.stop.more

    def reset(self, key: jax.Array, params: StrokeParams) -> tuple[dict[str, jax.Array], StrokeState]:
        """Begins an episode; returns its first observation and its state."""
        start, goal = params.goals.draw(key)
        state = StrokeState(goal, start, jnp.zeros((), jnp.int32))
        return self.observe(state, params), state

    def step_env(
        self, key: jax.Array, state: StrokeState, action: Action, params: StrokeParams
    ) -> Step[dict[str, jax.Array], StrokeState]:
        """Makes one stroke, and does not begin a new episode after the last; nothing is drawn from the key.

        Returns:
          Observation, state, reward, terminated, truncated, info.
        """
        del key
        action = episode.checked(self, action, state.height.dtype)
        after, outcome, told = self.pushed(params.scene, state.height, self.stroke(action, params), params.zones)
        after, terminated = self.stop.over(action, state.height, after)
        new = StrokeState(state.goal, after, state.time + 1)
        return episode.concluded(self, state, new, terminated, params, {"outcome": outcome} | told)

    step = episode.step  # `step_env`, and the next episode begins where that ended one
    action_space = episode.action_space

    def pushed(self, scene: Scene, height: jax.Array, stroke: jax.Array, zones: Zones) -> tuple[jax.Array, jax.Array, Told]:
        """The map that a stroke [4] or [6] (m) leaves, its outcome, and what zones have to tell."""
        blade = blade_of(scene)
        way, told = zones.way(stroke, scene.grid, blade.width, blade.thickness)
        after, outcome = self.batching.batched(pushing(self.push, self.settle))(scene, height, way)
        after = jnp.where(jnp.all(jnp.isfinite(after)), after, height)
        after, outcome = kept(told, "went", (height, jnp.zeros_like(outcome)), (after, outcome))
        return after, outcome, told

    def distance(self, state: StrokeState, params: StrokeParams) -> jax.Array:
        """L, a scalar: the distance of goal and map as measured, in units of the blade's depth (float32)."""
        far = self.measure.distance(state.goal, state.height)
        return (far / blade_of(params.scene).depth).astype(jnp.float32)

    def stroke(self, action: jax.Array, params: StrokeParams) -> jax.Array:
        """The stroke (m) of an action, before zones: x0, y0, x1, y1 [4], or x0, y0, z0, x1, y1, z1 [6] with `Heights`."""
        return self.heights.stroke(action[: self.heights.size], params.scene.grid, blade_of(params.scene).depth)

    def action(self, stroke: jax.typing.ArrayLike, params: StrokeParams) -> jax.Array:
        """The action of a stroke [4] or [6] (m), as of `stroke`; with a `Stop` its last number is -1, which goes on."""
        stroke = jnp.asarray(stroke)
        numbers = self.heights.action(stroke, params.scene.grid, blade_of(params.scene).depth)
        return jnp.concatenate([numbers, -jnp.ones(self.stop.more, stroke.dtype)])

    def observe(self, state: StrokeState, params: StrokeParams) -> dict[str, jax.Array]:
        """The observation of a state: its maps in units of the blade's depth, and weights that are maps (float32)."""
        return shown(state.goal, state.height, blade_of(params.scene).depth)

    def observation_space(self, params: StrokeParams) -> Dict:
        """The space of observations."""
        return Dict(shown_spaces(params.goals.goals, params.scene.grid.shape))
