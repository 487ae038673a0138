"""How an episode ends and the next one begins, for every environment."""

from typing import Any, Protocol

import jax
import jax.numpy as jnp

Step = tuple[Any, Any, jax.Array, jax.Array, jax.Array, dict[str, Any]]
"""Observation, state, reward, terminated, truncated, info."""


class Environment(Protocol):
    """A kind of task, static and hashable.

    Everything that may vary from one environment to the next is in `params`, whose leaves may be vmapped. All methods are
    pure and work on one environment.
    """

    def reset(self, key: jax.Array, params: Any) -> tuple[Any, Any]: ...

    def step_env(self, key: jax.Array, state: Any, action: Any, params: Any) -> Step: ...


def step(env: Environment, key: jax.Array, state: Any, action: Any, params: Any) -> Step:
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
