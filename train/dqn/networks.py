"""Networks of action values: their features, their dueling outputs, and how a value is encoded."""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
import optax

from train.replay.her import Observation


@dataclass(frozen=True)
class Mean:
    """Encodes a value as one number; the loss is Huber's."""

    @property
    def count(self) -> int:
        """Outputs for one value."""
        return 1

    def value(self, raw: jax.Array) -> jax.Array:
        """Values [...] of outputs [..., 1]."""
        return raw[..., 0]

    def loss(self, raw: jax.Array, target: jax.Array) -> jax.Array:
        """Losses [...] of outputs [..., 1] for targets [...]."""
        return optax.losses.huber_loss(raw[..., 0], target)


@dataclass(frozen=True)
class Bins:
    """Encodes a value as the mean of a distribution over `count` numbers from `low` to `high`, which no value can leave.

    The loss is the cross-entropy with a target that is divided between the two nearest numbers (Farebrother et al. 2024,
    arXiv:2403.03950, "two-hot").
    """

    low: float = -31.0
    high: float = 0.0
    count: int = 32

    def value(self, raw: jax.Array) -> jax.Array:
        """Values [...] of outputs [..., count]."""
        return jax.nn.softmax(raw) @ jnp.linspace(self.low, self.high, self.count, dtype=raw.dtype)

    def loss(self, raw: jax.Array, target: jax.Array) -> jax.Array:
        """Losses [...] of outputs [..., count] for targets [...]."""
        at = (jnp.clip(target, self.low, self.high) - self.low) / (self.high - self.low) * (self.count - 1)
        which = jnp.arange(self.count, dtype=at.dtype).reshape((1,) * at.ndim + (-1,))
        share = jnp.maximum(0, 1 - jnp.abs(at[..., None] - which))
        return -jnp.sum(share * jax.nn.log_softmax(raw), axis=-1)


Head = Mean | Bins


def dueling(state: jax.Array, advantage: jax.Array) -> jax.Array:
    """Joins the outputs of a state [..., K] with its actions' advantages [..., A, K], less their mean over actions.

    Wang et al. 2016, arXiv:1511.06581, equation 9; for distributions as in Rainbow, arXiv:1710.02298.
    """
    return state[..., None, :] + advantage - jnp.mean(advantage, axis=-2, keepdims=True)


class QNet(nn.Module):
    """Features, residual layers of `width`, and the dueling outputs [B, A, K].

    `look` makes features [B, F] of an observation's leaves [B, ...].
    """

    look: Callable[[Any], jax.Array]
    actions: int
    head: Head
    width: int
    blocks: int

    @nn.compact
    def __call__(self, observation: Observation) -> jax.Array:
        x = nn.relu(nn.Dense(self.width)(self.look(observation)))
        for _ in range(self.blocks):
            y = nn.relu(nn.Dense(self.width)(nn.LayerNorm()(x)))
            x = x + nn.Dense(self.width, kernel_init=nn.initializers.zeros)(y)
        x = nn.relu(nn.LayerNorm()(x))
        outputs = nn.Dense((1 + self.actions) * self.head.count)(x).reshape(len(x), 1 + self.actions, self.head.count)
        return dueling(outputs[:, 0], outputs[:, 1:])


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Greedy:
    """A network with its parameters; it acts by the legal action of the highest value."""

    net: QNet = field(metadata={"static": True})
    params: optax.Params

    def values(self, observation: Observation) -> jax.Array:
        """Action values [B, A] of observations [B, ...]."""
        raw: Any = self.net.apply(self.params, observation)
        return self.net.head.value(raw)

    def act(self, observation: Observation, legal: jax.Array) -> jax.Array:
        """The legal action [B] of the highest value; `legal` is [B, A]."""
        return best(self.values(observation), legal)


def best(values: jax.Array, legal: jax.Array) -> jax.Array:
    """The legal action [B] of the highest value [B, A]."""
    return jnp.argmax(jnp.where(legal, values, -jnp.inf), axis=-1)


def of(values: jax.Array, action: jax.Array) -> jax.Array:
    """The values [B] of the actions [B] in a table of values [B, A]."""
    return jnp.take_along_axis(values, action[:, None], axis=1)[:, 0]


def flat(observation: Observation) -> jax.Array:
    """All leaves of an observation side by side, [B, F]."""
    leaves = jax.tree.leaves(observation)
    return jnp.concatenate([jnp.asarray(x, jnp.float32).reshape(len(x), -1) for x in leaves], axis=1)


def around(observation: dict[str, jax.Array]) -> jax.Array:
    """The goal's cells still to dig, and those dug, as seen from the tool: [B, 2 (2 H - 1) (2 W - 1)], the tool in the
    middle.
    """
    goal, dug, pose = (observation[name].astype(jnp.float32) for name in ("goal", "current", "pose"))
    batch, rows, columns = goal.shape
    place = jnp.argmax(pose.reshape(batch, -1), axis=1)
    planes = jnp.stack([goal * (1 - dug), goal * dug], axis=1)
    padded = jnp.pad(planes, ((0, 0), (0, 0), (rows - 1, rows - 1), (columns - 1, columns - 1)))

    def window(maps: jax.Array, at: jax.Array) -> jax.Array:
        corner = (jnp.zeros_like(at), at // columns, at % columns)
        return jax.lax.dynamic_slice(maps, corner, (2, 2 * rows - 1, 2 * columns - 1))

    return jax.vmap(window)(padded, place).reshape(batch, -1)
