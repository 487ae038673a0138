"""How an actor and its critic act: alone, or as a policy that proposes strokes to a look-ahead with the simulator."""

from dataclasses import dataclass
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax

from jaxsand.envs.multi import LevelGoals, MultiStroke, StrokeParams
from jaxsand.goals.usual import SHAPE
from jaxsand.scene.scene import Scene, blade_of
from train.ddpg.networks import Actor, Critic
from train.replay.her import Observation

_TRIED = 16  # actions for each one that is asked for
_SEED = 0  # of how they differ from the actor's, the same at every look


@dataclass(frozen=True)
class Acts:
    """An actor and a critic with their parameters.

    Attributes:
      actor, critic: the networks.
      of_actor, of_critic: their parameters.
      noise: where more than one stroke is asked for, the actor's own action and others around it, with normal noise of this
        standard deviation, are ranked by the critic.
    """

    actor: Actor
    critic: Critic
    of_actor: optax.Params
    of_critic: optax.Params
    noise: float

    def act(self, observation: Observation) -> jax.Array:
        """The actor's actions [B, A] for observations [B, ...]."""
        return _act(self.actor, self.of_actor, observation)

    def propose(self, scene: Scene, goal: np.ndarray, current: np.ndarray, count: int = 1) -> tuple[np.ndarray, np.ndarray]:
        """Proposes the best next strokes for a batch of goals.

        Args:
          scene: grid, sand and blade.
          goal, current: maps [B, H, W] (m).
          count: how many strokes for each.

        Returns:
          The strokes [B, count, 4] (m), best first, and the critic's values of them [B, count].

        Raises:
          ValueError: for a scene of another size than the training's, or without a blade.
        """
        if scene.grid.shape != SHAPE:
            raise ValueError(f"scene.grid.shape: got {scene.grid.shape}; this policy only knows {SHAPE}")
        depth = float(blade_of(scene).depth)
        maps = {name: jnp.asarray(x, jnp.float32) / depth for name, x in (("goal", goal), ("current", current))}
        tried = 1 if count == 1 else _TRIED * count
        off = self.noise * np.random.default_rng(_SEED).standard_normal((tried, 4)).astype(np.float32)
        off[0] = 0
        actions, values = _best(self.actor, self.critic, count, self.of_actor, self.of_critic, maps, off)
        env, params = MultiStroke(), StrokeParams(scene, LevelGoals(maps["goal"]))
        strokes = jax.vmap(jax.vmap(lambda action: env.stroke(action, params)))(actions)
        return np.asarray(strokes, float), np.asarray(values)


@partial(jax.jit, static_argnames="actor")
def _act(actor: Actor, of_actor: optax.Params, observation: Observation) -> jax.Array:
    made: Any = actor.apply(of_actor, observation)
    return made[0]


@partial(jax.jit, static_argnames=("actor", "critic", "count"))
def _best(
    actor: Actor,
    critic: Critic,
    count: int,
    of_actor: optax.Params,
    of_critic: optax.Params,
    maps: dict[str, jax.Array],
    off: jax.Array,
) -> tuple[jax.Array, jax.Array]:
    """The best actions [B, count, 4] among the actor's own moved by `off` [N, 4], and their values [B, count]."""
    actions = jnp.clip(_act(actor, of_actor, maps)[:, None] + off[None], -1, 1)

    def value(some: jax.Array) -> jax.Array:
        made: Any = critic.apply(of_critic, maps, some)
        return made

    values, which = jax.lax.top_k(jax.vmap(value, 1, 1)(actions), count)
    return jnp.take_along_axis(actions, which[..., None], 1), values
