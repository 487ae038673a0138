"""Hindsight experience replay: a step is learned from again as if the result of its episode had been the goal.

Andrychowicz et al. 2017 (arXiv:1707.01495), strategies "final" and "future"; `exchanged` is akin to their "random". It only
needs observations that are dictionaries with a `goal` and, of the same kind, the `current` state of what the goal is about.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import jax
import jax.numpy as jnp

Observation = jax.Array | dict[str, jax.Array]
"""A vector [B, N], or a dictionary of maps [B, H, W], one of them the "goal" and one "current"."""

Judge = Callable[[jax.Array, jax.Array, jax.Array], tuple[jax.Array, jax.Array]]
"""From `current` before a step and after it, and a goal, to the reward and whether the episode terminates."""


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Steps:
    """Consecutive steps of one environment, every leaf [T, ...].

    Attributes:
      observation: before the step.
      action: what was done.
      reward: of the step.
      terminated: whether the episode terminated with the step.
      after: the observation after the step, never that of the next episode.
      ended: whether the episode terminated or was truncated with the step.
    """

    observation: Any
    action: jax.Array
    reward: jax.Array
    terminated: jax.Array
    after: Any
    ended: jax.Array


@dataclass(frozen=True)
class Own:
    """No hindsight: every step keeps its goal."""

    copies = 0

    def outcome(self, key: jax.Array, last: jax.Array) -> jax.Array:
        """The steps [T] whose results become the goals; not used."""
        return last


@dataclass(frozen=True)
class Final:
    """The goal in hindsight is the result of the episode."""

    copies = 1

    def outcome(self, key: jax.Array, last: jax.Array) -> jax.Array:
        """For steps [T] whose episodes' last steps are `last` [T], the steps [T] whose results become the goals."""
        return last


@dataclass(frozen=True)
class Future:
    """The goal in hindsight is the result of this or a later step of the episode, with equal chances; `copies` to one own
    goal.
    """

    copies: int = 4

    def outcome(self, key: jax.Array, last: jax.Array) -> jax.Array:
        """For steps [T] whose episodes' last steps are `last` [T], the steps [T] whose results become the goals."""
        return jax.random.randint(key, last.shape, jnp.arange(len(last)), last + 1)


Strategy = Own | Final | Future


def last_steps(ended: jax.Array) -> jax.Array:
    """The index [T] of the last step of each step's episode; the row's last step where the episode goes on beyond it."""
    count = len(ended)
    here = jnp.where(ended, jnp.arange(count), count - 1)
    return jax.lax.cummin(here, reverse=True)


def relabel(key: jax.Array, steps: Steps, strategy: Strategy, judge: Judge) -> Steps:
    """The same steps [T] with goals in hindsight, and with the reward and the end that `judge` gives for these.

    `ended` is unchanged, since the episode did end there. For a batch of rows use jax.vmap; for more copies, other keys.

    Raises:
      ValueError: for observations without a goal.
    """
    _check_goals(steps, "strategy", "by Own()")
    which = strategy.outcome(key, last_steps(steps.ended))
    return _towards(jax.tree.map(lambda x: x[which], steps.after["current"]), steps, judge)


def mixed(key: jax.Array, steps: Steps, strategy: Strategy, judge: Judge) -> Steps:
    """The same steps [T], of which one in 1 + `copies`, chosen at random, keeps its goal, and the others are relabelled."""
    if not strategy.copies:
        return steps
    choose, draw = jax.random.split(key)
    keeps = jax.random.uniform(choose, steps.ended.shape) * (1 + strategy.copies) < 1
    return chosen(keeps, steps, relabel(draw, steps, strategy, judge))


def exchanged(key: jax.Array, steps: Steps, share: float, judge: Judge) -> Steps:
    """The same steps [B], of which a share, chosen at random, has the goal of the step before it in place of its own.

    Hindsight alone shows to every goal in it the very action that reached it. A critic then need not look at the action: it
    can tell by the goal. Where goals are exchanged it sees the same goals with actions that miss them.

    Raises:
      ValueError: for observations without a goal.
    """
    if not share:
        return steps
    _check_goals(steps, "exchange", "and with exchange=0")
    others = _towards(jax.tree.map(lambda x: jnp.roll(x, 1, 0), steps.after["goal"]), steps, judge)
    return chosen(jax.random.uniform(key, steps.ended.shape) < share, others, steps)


def _towards(goal: Any, steps: Steps, judge: Judge) -> Steps:
    """The same steps with other goals, and with the reward and the end that `judge` gives for these."""
    reward, terminated = jax.vmap(judge)(steps.observation["current"], steps.after["current"], goal)
    return replace(
        steps,
        observation=steps.observation | {"goal": goal},
        reward=reward.astype(steps.reward.dtype),
        terminated=terminated,
        after=steps.after | {"goal": goal},
    )


def _check_goals(steps: Steps, field: str, remedy: str) -> None:
    if not isinstance(steps.after, dict) or not {"goal", "current"} <= steps.after.keys():
        raise ValueError(f"{field}: these observations hold no goal and current; learn without hindsight, {remedy}")


def chosen(which: jax.Array, one: Steps, other: Steps) -> Steps:
    """Along the first axis, the steps of `one` where `which` [N] is true, else those of `other`."""
    return jax.tree.map(lambda a, b: jnp.where(which.reshape(-1, *(1,) * (a.ndim - 1)), a, b), one, other)
