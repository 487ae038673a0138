"""Targets for action values: rows of steps become items, and items become targets."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp

from jaxsand.envs.onmap import MapParams
from train.dqn.networks import best, of
from train.dqn.tasks import Task
from train.replay.her import Observation, Steps, last_steps

Values = Callable[[Observation], jax.Array]
"""Observations [B, ...] to the values of their actions [B, A]."""


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Items:
    """Items to learn an action value from.

    Attributes:
      observation: what was seen.
      action: what was done.
      total: the discounted sum of the rewards of this and the following steps of the item.
      after: the observation after them.
      discount: how much the value of `after` counts; 0 where the episode terminated.
    """

    observation: Any
    action: jax.Array
    total: jax.Array
    after: Any
    discount: jax.Array


def items_of(steps: Steps, reach: int, gamma: float) -> Items:
    """Items [T] of a row of steps [T]: each of `reach` steps, or up to where the episode or the row ends.

    total_t = sum of gamma^k r_(t+k) for t + k up to the last step s, and discount_t = gamma^(s - t + 1).
    """
    time = jnp.arange(len(steps.ended))
    last = jnp.minimum(last_steps(steps.ended | steps.terminated), time + reach - 1)
    ahead = time[None, :] - time[:, None]
    weights = jnp.where((ahead >= 0) & (time[None, :] <= last[:, None]), gamma ** jnp.maximum(ahead, 0), 0)
    total = weights.astype(steps.reward.dtype) @ steps.reward
    discount = (gamma ** (last - time + 1)).astype(steps.reward.dtype)
    after = jax.tree.map(lambda x: x[last], steps.after)
    return Items(steps.observation, steps.action, total, after, jnp.where(steps.terminated[last], 0, discount))


@dataclass(frozen=True)
class Sampled:
    """Double DQN: the target is total + discount x the target network's value of the online network's best action
    afterwards.

    Only the action that was taken has a target. Source: van Hasselt et al. 2016, arXiv:1509.06461. A reach of several
    steps is not corrected for what the policy would have done, as in Rainbow.
    """

    def targets(
        self, task: Task, world: MapParams | None, gamma: float, items: Items, online: Values, slow: Values
    ) -> tuple[jax.Array, jax.Array]:
        """Targets [B, A] and their weights [B, A], which sum to 1 in a row.

        Args:
          task: the environment and its legal actions.
          world: the environment's parameters.
          gamma: discount.
          items: [B].
          online, slow: action values by the online network and by the target network.
        """
        legal = jax.vmap(task.legal)(items.after)
        ahead = of(slow(items.after), best(online(items.after), legal))
        taken = jax.nn.one_hot(items.action, task.actions, dtype=ahead.dtype)
        return (items.total + items.discount * ahead)[:, None] * taken, taken


@dataclass(frozen=True)
class Every:
    """Value iteration with the environment as a model: for each legal action, reward + gamma x the best value of what
    follows.

    The value is the target network's. A walk that terminated within an item's reach is a lower bound for the action that
    it began with, where nothing is left to chance (He et al. 2017, arXiv:1611.01606). There is room for `branches`
    actions of an item on average; actions beyond that, at the batch's end, have no target.
    """

    branches: int = 2

    def targets(
        self, task: Task, world: MapParams | None, gamma: float, items: Items, online: Values, slow: Values
    ) -> tuple[jax.Array, jax.Array]:
        """Targets [B, A] and their weights [B, A], which sum to 1 in a row, or to 0 without room; see `Sampled.targets`."""
        legal = jax.vmap(task.legal)(items.observation)
        batch, actions = legal.shape
        (which,) = jnp.nonzero(legal.ravel(), size=self.branches * batch, fill_value=legal.size)
        row, action = jnp.divmod(jnp.minimum(which, legal.size - 1), actions)

        def model(observation: Any, action: jax.Array) -> tuple[Any, jax.Array, jax.Array]:
            env: Any = task.env
            step = env.step_env(jax.random.key(0), task.state(observation), action, world)
            return task.packed(step[0]), step[2], step[3]

        after, reward, terminated = jax.vmap(model)(jax.tree.map(lambda x: x[row], items.observation), action)
        values = slow(after)
        values = of(values, best(values, jax.vmap(task.legal)(after)))
        found = reward + gamma * jnp.where(terminated, 0, values)
        targets = jnp.full(legal.size, jnp.nan, found.dtype).at[which].set(found, mode="drop").reshape(legal.shape)
        known = ~jnp.isnan(targets)
        walked = jnp.where(items.discount == 0, items.total, -jnp.inf)[:, None]
        taken = jax.nn.one_hot(items.action, actions, dtype=bool)
        targets = jnp.where(taken, jnp.maximum(targets, walked), targets)
        weights = known / jnp.maximum(jnp.sum(known, axis=1, keepdims=True), 1)
        return jnp.where(known, targets, 0), weights.astype(found.dtype)


Backup = Sampled | Every
