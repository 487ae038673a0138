"""How an episode ends and the next one begins, for every environment."""

from typing import Any, Protocol, TypeVar

import jax
import jax.numpy as jnp

from jaxsand.envs.spaces import Box

Obs = TypeVar("Obs")
State = TypeVar("State")
Params = TypeVar("Params")
Obs_co = TypeVar("Obs_co", covariant=True)
State_contra = TypeVar("State_contra", contravariant=True)
Params_contra = TypeVar("Params_contra", contravariant=True)

Action = jax.typing.ArrayLike
Step = tuple[Obs, State, jax.Array, jax.Array, jax.Array, dict[str, Any]]
"""Observation, state, reward, terminated, truncated, info."""


class HasTime(Protocol):
    """The state of an episode that counts its actions."""

    @property
    def time(self) -> jax.Array:
        """Actions so far."""


class HasLimit(Protocol):
    """The parameters of an environment whose episodes are truncated after `limit` actions."""

    @property
    def limit(self) -> jax.Array | int:
        """Actions after which an episode is truncated."""


Timed = TypeVar("Timed", bound=HasTime)
Limited = TypeVar("Limited", bound=HasLimit)


class Environment(Protocol[Obs_co, State, Params_contra]):
    """A kind of task, static and hashable.

    Everything that may vary from one environment to the next is in `params`, whose leaves may be vmapped. All methods are
    pure and work on one environment.
    """

    def reset(self, key: jax.Array, params: Params_contra) -> tuple[Obs_co, State]:
        """Begins an episode; returns its first observation and its state."""

    def step_env(self, key: jax.Array, state: State, action: Action, params: Params_contra) -> Step[Obs_co, State]:
        """Takes one action, and does not begin a new episode after the last."""


class Shapes(Protocol[State_contra, Params_contra]):
    """An environment whose reward is by how much an action brings the sand nearer to the goal."""

    @property
    def size(self) -> int:
        """How many numbers an action has."""

    def distance(self, state: State_contra, params: Params_contra) -> jax.Array:
        """How far the sand is from the goal."""

    def observe(self, state: State_contra, params: Params_contra) -> dict[str, jax.Array]:
        """The observation of a state."""


def checked(env: Shapes[Any, Any], action: Action, dtype: jax.typing.DTypeLike) -> jax.Array:
    """An action as an array; raises ValueError unless it holds as many numbers as the environment takes."""
    action = jnp.asarray(action, dtype)
    if action.shape != (env.size,):
        raise ValueError(f"action: got shape {list(action.shape)}; give {env.size} numbers")
    return action


def concluded(
    env: Shapes[Timed, Limited],
    before: Timed,
    after: Timed,
    terminated: jax.Array,
    params: Limited,
    info: dict[str, jax.Array],
) -> Step[dict[str, jax.Array], Timed]:
    """What `step_env` returns once the state after an action is known."""
    reward = env.distance(before, params) - env.distance(after, params)
    truncated = (after.time >= params.limit) & ~terminated
    return env.observe(after, params), after, reward, terminated, truncated, info


def action_space(env: Shapes[Any, Params], params: Params) -> Box:
    """The space of actions: numbers from -1 to 1."""
    del params
    return Box(-1, 1, (env.size,))


def step(
    env: Environment[Obs, State, Params], key: jax.Array, state: State, action: Action, params: Params
) -> Step[Obs, State]:
    """Calls `step_env`, and begins a new episode where that ended the old one.

    Returns:
      What `step_env` returns, with the first observation and state of the new episode where one begins. `info` also holds
      "final_observation", the last one of the old episode (the same as the observation where none ended), "terminated" and
      "truncated".
    """
    own, fresh = jax.random.split(key)
    obs, state, reward, terminated, truncated, info = env.step_env(own, state, action, params)
    first = env.reset(fresh, params)
    over = terminated | truncated
    info = info | {"final_observation": obs, "terminated": terminated, "truncated": truncated}
    obs, state = jax.tree.map(lambda new, old: jnp.where(over, new, old), first, (obs, state))
    return obs, state, reward, terminated, truncated, info
