"""How an episode ends and the next one begins, for every environment."""

from typing import Any, Protocol, TypeVar

import jax
import jax.numpy as jnp

Obs = TypeVar("Obs")
State = TypeVar("State")
Params = TypeVar("Params")
Obs_co = TypeVar("Obs_co", covariant=True)
Params_contra = TypeVar("Params_contra", contravariant=True)

Action = jax.typing.ArrayLike
Step = tuple[Obs, State, jax.Array, jax.Array, jax.Array, dict[str, Any]]
"""Observation, state, reward, terminated, truncated, info."""


class Environment(Protocol[Obs_co, State, Params_contra]):
    """A kind of task, static and hashable.

    Everything that may vary from one environment to the next is in `params`, whose leaves may be vmapped. All methods are
    pure and work on one environment.
    """

    def reset(self, key: jax.Array, params: Params_contra) -> tuple[Obs_co, State]: ...

    def step_env(self, key: jax.Array, state: State, action: Action, params: Params_contra) -> Step[Obs_co, State]: ...


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
