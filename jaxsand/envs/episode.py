"""How an episode ends and the next one begins, for every environment."""

from typing import Any, Protocol

import jax
import jax.numpy as jnp

Step = tuple[Any, Any, jax.Array, jax.Array, jax.Array, dict[str, Any]]
"""Observation, state, reward, terminated, truncated, info."""


class Environment(Protocol):
    """A kind of task, static and hashable; everything that may vary from one to the next is in `params`, whose leaves may be
    vmapped. All of it is pure and works on one environment."""

    def reset(self, key: jax.Array, params: Any) -> tuple[Any, Any]: ...

    def step_env(self, key: jax.Array, state: Any, action: Any, params: Any) -> Step: ...


def step(env: Environment, key: jax.Array, state: Any, action: Any, params: Any) -> Step:
    """`step_env`, and the first observation and state of a new episode where that ended the old one.

    `info` holds "final_observation", the last one of the old episode (where none ended, the same as the observation),
    "terminated" and "truncated".
    """
    own, fresh = jax.random.split(key)
    obs, state, reward, terminated, truncated, info = env.step_env(own, state, action, params)
    first = env.reset(fresh, params)
    over = terminated | truncated
    info = info | {"final_observation": obs, "terminated": terminated, "truncated": truncated}
    obs, state = jax.tree.map(lambda new, old: jnp.where(over, new, old), first, (obs, state))
    return obs, state, reward, terminated, truncated, info
