"""Excavation: each action scoops sand here and dumps it there, with a bucket that keeps what it does not pour."""

from dataclasses import dataclass, field
from functools import cache

import jax
import jax.numpy as jnp

from jaxsand.envs import episode
from jaxsand.envs.episode import Action, Step
from jaxsand.envs.heights import Heights, off_map, on_map
from jaxsand.envs.multi import LevelGoals, Measure, NoStop, RoughGoals, Stop, WithBerms
from jaxsand.envs.pushing import Batching, ByLength, Pushing
from jaxsand.envs.spaces import Box, Dict
from jaxsand.envs.weights import Wanted, shown, shown_spaces
from jaxsand.envs.zones import NoZones, Told, Zones, kept
from jaxsand.interaction.bucket import bucket_of, dump, scoop
from jaxsand.interaction.load import Load, as_load
from jaxsand.interaction.stepped import SteppedPush
from jaxsand.relaxation.stopping import Stop as StopRule
from jaxsand.scene.scene import Scene

SIZE = 9  # numbers of a dig: x0, y0, z0, x1, y1, z1 of the scoop, x, y of the dump, and the share that is poured
Bed = tuple[jax.Array, Load]
"""The map [H, W] (m), and what the bucket holds."""


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class ExcavateState:
    """The state of an episode of excavation.

    Attributes:
      goal: [H, W] (m), or a `jaxsand.Goal` of it and its weights.
      height: the sand as it lies, [H, W] (m).
      load: what the bucket holds; see `Load`.
      time: actions so far.

    Example:
      >>> import jax
      >>> import numpy as np
      >>> import jaxsand as js
      >>> env, params = js.make("excavate", goals=np.zeros((1, 32, 32)))
      >>> obs, state = env.reset(jax.random.key(0), params)
      >>> float(js.load_volume(params.scene, state.load))
      0.0
    """

    goal: Wanted
    height: jax.Array
    load: Load
    time: jax.Array


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class ExcavateParams:
    """The parameters of `Excavate`; `jaxsand.make` makes them.

    Args:
      scene: grid, sand and a `Bucket`.
      goals: what an episode draws its goal and its start from.
      limit: actions after which an episode is truncated.
      zones: where the bucket's edge may not be, and no sand be poured: `NoZones()`, `ClippedBy(cells)` or
        `RefusedBy(cells)`.

    Example:
      >>> import numpy as np
      >>> import jaxsand as js
      >>> env, params = js.make("excavate", goals=np.zeros((1, 32, 32)), limit=3)
      >>> params.limit
      3
    """

    scene: Scene
    goals: LevelGoals | RoughGoals
    limit: jax.Array | int = 6
    zones: Zones = field(default_factory=NoZones)


@dataclass(frozen=True)
class Excavate:
    """An environment of digs: each action scoops sand along a way, and dumps some of what the bucket holds at a point.

    An action holds x0, y0, z0, x1, y1, z1 of the scoop, x, y of the dump, and the share that is poured, each from -1 to 1:
    x and y from the first to the last cell centre of the map, z, the height of the bucket's edge, between the `heights`, and
    the share of what the bucket holds after the scoop from 0 (nothing) to 1 (all of it). What is not poured stays in the
    bucket for the next action. A share above 1 pours all, and the outcome says NOT_POURED; one below 0 pours nothing, and
    the outcome says NOT_FINITE. Observations are the maps "goal" and "current" [H, W] in units of the bucket's depth, and
    "load", what the bucket holds as a share of its capacity (float32). Where goals have weights that are maps, these follow
    as "above" and "below"; free cells have weights of 0 and a goal of 0.

    With L = sqrt(sum (goal - h)^2), of the maps as `measure` sees them, or the distance of a `jaxsand.Goal` by its weights,
    and in units of the bucket's depth, the reward is L_t - L_{t+1}; what the bucket holds does not count. Bed and bucket
    together keep their volume. An episode is truncated after `limit` actions, and terminated when a `Stop` asks for it, in
    place of a dig. `info` holds the simulator's "outcome", and with zones "clipped", "went" and "poured": a scoop that may
    not be made leaves map and load as they were, and a bucket is not emptied where its sand would fall on a zone. A dig that
    leaves a map that is not finite leaves map and load as they were, too.

    The reward is differentiable once, in forward and reverse mode, in the action, the state's map and load, and the scene's
    floats, but where the bucket just becomes full or empty.

    Args:
      push: `SteppedPush()`: how finely the bucket's edge moves.
      stop: `NoStop()` or `Stop()`.
      measure: `WithBerms()`, `OnlyDug()` or `Weighted(above, below)`.
      batching: `ByLength()` (for a CPU, the default) or `Together()` (for a GPU).
      settle: when settling stops; None means when the sand is still.
      heights: the heights of the bucket's edge, as multiples of its depth.

    Example:
      >>> import jax
      >>> import jax.numpy as jnp
      >>> import numpy as np
      >>> import jaxsand as js
      >>> env, params = js.make("excavate", goals=np.zeros((1, 32, 32)))
      >>> obs, state = env.reset(jax.random.key(0), params)
      >>> dig = jnp.array([0.05, 0.08, 0.0, 0.12, 0.08, -0.015, 0.24, 0.24, 0.5])  # metres, and half of the load
      >>> obs, state, *_ = env.step_env(jax.random.key(1), state, env.action(dig, params), params)
      >>> f"{obs['load']:.2f}"  # 0.04 m wide, 0.07 m long, 0.0075 m deep in the mean; half of it is poured
      '0.27'
    """

    push: SteppedPush = field(default_factory=SteppedPush)
    stop: NoStop | Stop = field(default_factory=NoStop)
    measure: Measure = field(default_factory=WithBerms)
    batching: Batching = field(default_factory=ByLength)
    settle: StopRule | None = None
    heights: Heights = field(default_factory=Heights)

    @property
    def size(self) -> int:
        """How many numbers an action has."""
        return SIZE + self.stop.more

    def reset(self, key: jax.Array, params: ExcavateParams) -> tuple[dict[str, jax.Array], ExcavateState]:
        """Begins an episode with an empty bucket; returns its first observation and its state."""
        start, goal = params.goals.draw(key)
        state = ExcavateState(goal, start, as_load(None, start.dtype), jnp.zeros((), jnp.int32))
        return self.observe(state, params), state

    def step_env(
        self, key: jax.Array, state: ExcavateState, action: Action, params: ExcavateParams
    ) -> Step[dict[str, jax.Array], ExcavateState]:
        """Digs once, and does not begin a new episode after the last; nothing is drawn from the key.

        Returns:
          Observation, state, reward, terminated, truncated, info.
        """
        del key
        action = episode.checked(self, action, state.height.dtype)
        before = (state.height, state.load)
        after, outcome, told = self.digs(params.scene, before, self.dig(action, params), params.zones)
        (height, load), terminated = self.stop.over(action, before, after)
        new = ExcavateState(state.goal, height, load, state.time + 1)
        return episode.concluded(self, state, new, terminated, params, {"outcome": outcome} | told)

    step = episode.step  # `step_env`, and the next episode begins where that ended one
    action_space = episode.action_space

    def digs(self, scene: Scene, before: Bed, dig: jax.Array, zones: Zones) -> tuple[Bed, jax.Array, Told]:
        """The map and the load that a dig [9] leaves, its outcome, and what zones have to tell."""
        way, told = zones.way(dig[:6], scene.grid, bucket_of(scene).width, 0.0)  # what it cuts ends where its way does
        poured = zones.over(dig[6:8], scene.grid)
        dig = jnp.concatenate([way, dig[6:8], kept(poured, "poured", jnp.zeros_like(dig[8]), dig[8])[None]])
        after, outcome = self.batching.batched(_digging(self.push, self.settle))(scene, before, dig)
        sound = jnp.all(jnp.isfinite(after[0])) & jnp.isfinite(after[1].high + after[1].low)
        after = jax.tree.map(lambda old, new: jnp.where(sound, new, old), before, after)
        after, outcome = kept(told, "went", (before, jnp.zeros_like(outcome)), (after, outcome))
        if poured:
            told = told | poured | {"clipped": told["clipped"] | ~poured["poured"]}
        return after, outcome, told

    def distance(self, state: ExcavateState, params: ExcavateParams) -> jax.Array:
        """L, a scalar: the distance of goal and map as measured, in units of the bucket's depth (float32)."""
        far = self.measure.distance(state.goal, state.height)
        return (far / bucket_of(params.scene).depth).astype(jnp.float32)

    def dig(self, action: jax.Array, params: ExcavateParams) -> jax.Array:
        """The dig [9] of an action: x0, y0, z0, x1, y1, z1, x, y (m), and the share of the load that is poured."""
        grid = params.scene.grid
        way = self.heights.stroke(action[:6], grid, bucket_of(params.scene).depth)
        return jnp.concatenate([way, on_map(action[None, 6:8], grid)[0], (action[8:9] + 1) / 2])

    def action(self, dig: jax.typing.ArrayLike, params: ExcavateParams) -> jax.Array:
        """The action of a dig [9], as of `dig`; with a `Stop` its last number is -1, which goes on."""
        dig, grid = jnp.asarray(dig), params.scene.grid
        way = self.heights.action(dig[:6], grid, bucket_of(params.scene).depth)
        more = -jnp.ones(self.stop.more, dig.dtype)
        return jnp.concatenate([way, off_map(dig[None, 6:8], grid)[0], 2 * dig[8:9] - 1, more])

    def observe(self, state: ExcavateState, params: ExcavateParams) -> dict[str, jax.Array]:
        """The observation of a state: its maps in units of the bucket's depth, weights that are maps, and the load."""
        bucket, dx = bucket_of(params.scene), jnp.asarray(params.scene.grid.spacing, state.height.dtype)
        full = (state.load.high + state.load.low) * dx**2 / bucket.capacity
        load = jnp.clip(full, 0, 1)  # of a full bucket it may be a rounding error more
        return shown(state.goal, state.height, bucket.depth) | {"load": load.astype(jnp.float32)}

    def observation_space(self, params: ExcavateParams) -> Dict:
        """The space of observations."""
        return Dict(shown_spaces(params.goals.goals, params.scene.grid.shape) | {"load": Box(0, 1, ())})


@cache
def _digging(push: SteppedPush, stop: StopRule | None) -> Pushing:
    """The dig of one map: from a scene, map and load, and a dig [9], to the map and load that it leaves and its outcome."""

    @jax.jit  # so that the checks of numbers, which are for a caller's own, pass what an outcome tells of
    def one(scene: Scene, before: Bed, dig: jax.Array) -> tuple[Bed, jax.Array]:
        scooped = scoop(scene, before[0], dig[:6].reshape(2, 3), before[1], push=push, stop=stop)
        held = scooped.load.high + scooped.load.low
        amount = dig[8] * held * jnp.asarray(scene.grid.spacing, dig.dtype) ** 2
        poured = dump(scene, scooped.height, dig[None, 6:8], scooped.load, amount=amount, stop=stop)
        return (poured.height, poured.load), scooped.outcome | poured.outcome

    return one
