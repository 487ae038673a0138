"""How the actor-critic acts: it draws strokes, keeps those of the highest value, and climbs its slope."""

from dataclasses import dataclass
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

from jaxsand.goals.usual import SHAPE
from jaxsand.planning.learned.network import Params, Scores, best_of, symmetric
from jaxsand.planning.learned.policy import in_batches
from jaxsand.scene.scene import Scene, blade_of
from train.actor_critic.network import HIGH, LOW, StrokeCritic, climbed, drawn, valued

_DRAWN, _ANYWHERE = 48, 32  # strokes that are valued: by the actor's likelihoods, and uniform on the map
_CLIMBING = 6  # of them go up the slope of their value
_SIZES = (1, 8, 64)  # of batches, so that a few programs serve all


@dataclass(frozen=True)
class Chooses:
    """A network and its parameters as a policy, which sees square maps in all eight views."""

    net: StrokeCritic
    params: Params

    def propose(self, scene: Scene, goal: np.ndarray, current: np.ndarray, count: int = 1) -> tuple[np.ndarray, np.ndarray]:
        """Proposes the next strokes of the highest values for a batch of goals.

        Args:
          scene: grid, sand and blade.
          goal, current: maps [B, H, W] (m).
          count: how many strokes for each, no two alike.

        Returns:
          The strokes [B, count, 4] (m), best first, and their values [B, count].

        Raises:
          ValueError: for a scene of another size than the training's, or without a blade.
        """
        if scene.grid.shape != SHAPE:
            raise ValueError(f"scene.grid.shape: got {scene.grid.shape}; this policy only knows {SHAPE}")
        depth = float(blade_of(scene).depth)
        goal, current = (np.asarray(x, np.float32) / depth for x in (goal, current))
        read = partial(_read, self.net, count, self.params)
        strokes, values = in_batches(read, goal, current, _SIZES)
        return strokes.astype(float) * float(scene.grid.spacing), values


@partial(jax.jit, static_argnames=("net", "count"))
def _read(net: StrokeCritic, count: int, params: Params, goal: jax.Array, current: jax.Array) -> tuple[jax.Array, jax.Array]:
    """The `count` best strokes [B, count, 4] (cells) and their values [B, count]."""
    return best(net, params, symmetric(net, params, goal, current), jax.random.key(0), count)[:2]


def best(
    net: StrokeCritic, params: Params, scores: Scores, key: jax.Array, count: int
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """The `count` best strokes [B, count, 4] (cells), their values [B, count], and the strokes drawn [B, 48, 4]."""
    draw, spray = jax.random.split(key)
    own = drawn(draw, scores, _DRAWN)
    anywhere = jax.random.uniform(spray, (_ANYWHERE, 4), own.dtype, LOW, HIGH)
    tried = jnp.concatenate([own, jnp.broadcast_to(anywhere[None], (len(own), _ANYWHERE, 4))], 1)
    value = valued(net, params, scores)
    strokes, _ = best_of(tried, value(tried), max(_CLIMBING, count))
    return *best_of(*climbed(value, strokes), count), own
