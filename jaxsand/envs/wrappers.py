"""Environments as learners for gymnax expect them: observations as arrays, five values a step, returns that are told.

Those learners (rejax, PureJaxRL and their like) ask an environment for `default_params`, take observation, state, reward,
done and info from a step, and read the returns of episodes from info.
"""

from dataclasses import dataclass, field
from typing import Any

import jax
import jax.numpy as jnp

from jaxsand.envs.episode import Action
from jaxsand.envs.excavate import Excavate
from jaxsand.envs.multi import MultiStroke
from jaxsand.envs.onmap import OnMap
from jaxsand.envs.onsand import OnSand
from jaxsand.envs.spaces import Box, Discrete

FiveValues = tuple[jax.Array, Any, jax.Array, jax.Array, dict[str, Any]]
"""Observation, state, reward, done, info."""


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class GymnaxParams:
    """The parameters of a `GymnaxEnv`.

    Attributes:
      own: those of the environment that it wraps.
      max_steps_in_episode: actions after which an episode ends.

    Example:
      >>> import jaxsand as js
      >>> js.env.GymnaxEnv(*js.make("single-stroke")).default_params.max_steps_in_episode
      100
    """

    own: Any
    max_steps_in_episode: jax.Array | int


@dataclass(frozen=True)
class GymnaxEnv:
    """An environment with the interface of gymnax 0.0.x, which most learners in JAX are written for.

    An observation is one array (float32): a vector of all maps, by their names in the order of the alphabet and row by row,
    or with `stacked` maps [H, W, K] for convolutions. A step gives observation, state, reward, done and info, where done is
    terminated or truncated, and begins the next episode where one ended; `info` tells "terminated", "truncated" and
    "final_observation", the last of the episode that ended, as bootstrapping needs them. Actions beyond their space are cut
    to it. Spaces are gymnax's own where that is installed.

    It is hashable and static, whatever its parameters: two with equal `env` and `stacked` are equal.

    Args:
      env: as `jaxsand.make` gives it.
      params: its parameters, from the same call; those that `default_params` wraps.
      stacked: whether observations are maps [H, W, K].

    Example:
      >>> import jax
      >>> import numpy as np
      >>> import jaxsand as js
      >>> env = js.env.GymnaxEnv(*js.make("multi-stroke", goals=np.zeros((1, 32, 32))))
      >>> obs, state = env.reset(jax.random.key(0), env.default_params)
      >>> obs.shape, env.observation_space().shape, env.action_space().shape
      ((2048,), (2048,), (4,))
    """

    env: OnMap | OnSand | MultiStroke | Excavate
    params: Any = field(compare=False, repr=False)
    stacked: bool = False

    def __post_init__(self) -> None:
        shapes = {name: space.shape for name, space in self._spaces(self.params).items()}
        if self.stacked and len({*shapes.values()}) > 1:
            raise ValueError(f"stacked: got observations of shapes {shapes}, which are no maps of one shape; leave it out")

    @property
    def name(self) -> str:
        """The environment's kind."""
        return type(self.env).__name__

    @property
    def num_actions(self) -> int:
        """How many numbers an action has, or how many actions there are."""
        space = self.env.action_space(self.params)
        return space.n if isinstance(space, Discrete) else int(space.shape[0])

    @property
    def default_params(self) -> GymnaxParams:
        """The parameters that it was made with."""
        return GymnaxParams(self.params, self.params.limit)

    def reset(self, key: jax.Array, params: GymnaxParams | None = None) -> tuple[jax.Array, Any]:
        """Begins an episode; returns its first observation and its state."""
        obs, state = self.env.reset(key, self._own(params))
        return self._array(obs), state

    def step(self, key: jax.Array, state: Any, action: Action, params: GymnaxParams | None = None) -> FiveValues:
        """Takes one action, and begins the next episode where that ended one."""
        own = self._own(params)
        space, action = self.env.action_space(own), jnp.asarray(action)
        if isinstance(space, Box):
            action = jnp.clip(action, space.low, space.high)
        obs, state, reward, terminated, truncated, info = self.env.step(key, state, action, own)
        info = info | {"final_observation": self._array(info["final_observation"])}
        return self._array(obs), state, reward, terminated | truncated, info

    def observation_space(self, params: GymnaxParams | None = None) -> Any:
        """The space of observations."""
        spaces = self._spaces(self._own(params))
        low, high = min(one.low for one in spaces.values()), max(one.high for one in spaces.values())
        example = jax.eval_shape(self._array, {k: jax.ShapeDtypeStruct(v.shape, jnp.float32) for k, v in spaces.items()})
        return _gymnax(Box(low, high, example.shape))

    def action_space(self, params: GymnaxParams | None = None) -> Any:
        """The space of actions."""
        return _gymnax(self.env.action_space(self._own(params)))

    def _own(self, params: GymnaxParams | None) -> Any:
        return self.params if params is None else params.own

    def _spaces(self, own: Any) -> dict[str, Any]:
        return dict(self.env.observation_space(own).spaces)

    def _array(self, obs: dict[str, jax.Array]) -> jax.Array:
        parts = [jnp.asarray(obs[name], jnp.float32) for name in sorted(obs)]
        return jnp.stack(parts, axis=-1) if self.stacked else jnp.concatenate([part.ravel() for part in parts])


def _gymnax(space: Box | Discrete) -> Any:
    """gymnax's own space, which learners look for by its type; ours where it is not installed."""
    try:
        from gymnax.environments import spaces
    except ImportError:
        return space
    if isinstance(space, Discrete):
        return spaces.Discrete(space.n)
    return spaces.Box(space.low, space.high, space.shape, space.dtype)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class LoggedState:
    """The state of a `Logged` environment.

    Attributes:
      env_state: of the environment that it wraps.
      returned: sum of rewards of the episode so far.
      length: actions of the episode so far.
      last_return: sum of rewards of the last episode that ended; 0 before.
      last_length: its actions.
      timestep: actions of all episodes.

    Example:
      >>> import jax
      >>> import jaxsand as js
      >>> env = js.env.Logged(js.env.GymnaxEnv(*js.make("single-stroke")))
      >>> int(env.reset(jax.random.key(0))[1].length)
      0
    """

    env_state: Any
    returned: jax.Array
    length: jax.Array
    last_return: jax.Array
    last_length: jax.Array
    timestep: jax.Array


@dataclass(frozen=True)
class Logged:
    """Tells the return and the length of the last episode that ended, in `info`.

    The names are those that learners after PureJaxRL read: "returned_episode_returns", "returned_episode_lengths",
    "returned_episode" (whether this action ended one) and "timestep". All else is the wrapped environment's.

    Args:
      env: a `GymnaxEnv`.

    Example:
      >>> import jax
      >>> import jaxsand as js
      >>> env = js.env.Logged(js.env.GymnaxEnv(*js.make("single-stroke")))
      >>> _, state = env.reset(jax.random.key(0))
      >>> info = env.step(jax.random.key(1), state, 0)[-1]
      >>> int(info["timestep"]), bool(info["returned_episode"])
      (1, False)
    """

    env: GymnaxEnv

    def __getattr__(self, name: str) -> Any:
        """What the wrapped environment has."""
        if name == "env":
            raise AttributeError(name)
        return getattr(self.env, name)

    def reset(self, key: jax.Array, params: GymnaxParams | None = None) -> tuple[jax.Array, LoggedState]:
        """Begins an episode; returns its first observation and its state."""
        obs, state = self.env.reset(key, params)
        zero, none = jnp.zeros((), jnp.float32), jnp.zeros((), jnp.int32)
        return obs, LoggedState(state, zero, none, zero, none, none)

    def step(self, key: jax.Array, state: LoggedState, action: Action, params: GymnaxParams | None = None) -> FiveValues:
        """Takes one action, and begins the next episode where that ended one."""
        obs, env_state, reward, done, info = self.env.step(key, state.env_state, action, params)
        returned, length = state.returned + reward, state.length + 1
        new = LoggedState(
            env_state,
            jnp.where(done, 0, returned),
            jnp.where(done, 0, length),
            jnp.where(done, returned, state.last_return),
            jnp.where(done, length, state.last_length),
            state.timestep + 1,
        )
        told = {
            "returned_episode_returns": new.last_return,
            "returned_episode_lengths": new.last_length,
            "returned_episode": done,
            "timestep": new.timestep,
        }
        return obs, new, reward, done, info | told
