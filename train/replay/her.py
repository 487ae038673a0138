"""Hindsight experience replay: a step is learned from once more as if what came of the episode had been its goal.

Andrychowicz et al. 2017 (arXiv:1707.01495), strategies "final" and "future". It only needs that an observation is a
dictionary with a `goal` and, of the same kind, what there is of it: `current`.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp

Judge = Callable[[jax.Array, jax.Array, jax.Array], tuple[jax.Array, jax.Array]]
"""From what there was before a step, what there is after it, and the goal, the reward and whether the episode terminates."""


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Steps:
    """Steps of one environment in a row, every leaf [T, ...]: the `observation` and the one `after`, which is never that of
    the next episode; the `action`, the `reward`, whether the episode was `terminated`, and whether it `ended` (terminated or
    truncated) with this step."""

    observation: Any
    action: jax.Array
    reward: jax.Array
    terminated: jax.Array
    after: Any
    ended: jax.Array


@dataclass(frozen=True)
class Own:
    """The neutral strategy: every step keeps its goal, and nothing is computed."""

    copies = 0

    def outcome(self, key: jax.Array, last: jax.Array) -> jax.Array:
        return last


@dataclass(frozen=True)
class Final:
    """The goal is what there was at the episode's end."""

    copies = 1

    def outcome(self, key: jax.Array, last: jax.Array) -> jax.Array:
        """The steps [T] whose outcomes become the goals of steps [T] whose episodes' `last` steps are given."""
        return last


@dataclass(frozen=True)
class Future:
    """The goal is what there was after this or a later step of the episode, each as likely; so many `copies` to a goal."""

    copies: int = 4

    def outcome(self, key: jax.Array, last: jax.Array) -> jax.Array:
        """The steps [T] whose outcomes become the goals of steps [T] whose episodes' `last` steps are given."""
        return jax.random.randint(key, last.shape, jnp.arange(len(last)), last + 1)


Strategy = Own | Final | Future


def last_steps(ended: jax.Array) -> jax.Array:
    """The index [T] of the last step of each step's episode; of one that goes on beyond the row, the row's last step."""
    count = len(ended)
    here = jnp.where(ended, jnp.arange(count), count - 1)
    return jax.lax.cummin(here, reverse=True)


def relabel(key: jax.Array, steps: Steps, strategy: Strategy, judge: Judge) -> Steps:
    """The same steps [T], each with a goal in hindsight, and with the reward and the end that `judge` gives for it.

    `ended` stays: the episode did not go on. For a batch of rows use jax.vmap; for more copies, other keys.

    Raises:
      ValueError: for observations without a goal.
    """
    if not isinstance(steps.after, dict) or not {"goal", "current"} <= steps.after.keys():
        raise ValueError("strategy: these observations hold no goal and current; learn without hindsight, by Own()")
    which = strategy.outcome(key, last_steps(steps.ended))
    goal = jax.tree.map(lambda x: x[which], steps.after["current"])
    reward, terminated = jax.vmap(judge)(steps.observation["current"], steps.after["current"], goal)
    return Steps(
        steps.observation | {"goal": goal},
        steps.action,
        reward.astype(steps.reward.dtype),
        terminated,
        steps.after | {"goal": goal},
        steps.ended,
    )


def mixed(key: jax.Array, steps: Steps, strategy: Strategy, judge: Judge) -> Steps:
    """The same steps [T], of which one in 1 + `copies`, chosen by chance, keeps its goal, and the others are relabelled."""
    if not strategy.copies:
        return steps
    choose, draw = jax.random.split(key)
    keeps = jax.random.uniform(choose, steps.ended.shape) * (1 + strategy.copies) < 1
    return chosen(keeps, steps, relabel(draw, steps, strategy, judge))


def chosen(which: jax.Array, one: Steps, other: Steps) -> Steps:
    """Along their first axis, those of `one` where `which` [N] is true, and those of the `other`."""
    return jax.tree.map(lambda a, b: jnp.where(which.reshape(-1, *(1,) * (a.ndim - 1)), a, b), one, other)
