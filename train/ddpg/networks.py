"""The networks of DDPG: an actor and a critic that read observations as one vector, or as maps."""

from dataclasses import dataclass

import jax
import jax.numpy as jnp
from flax import linen as nn

from train.replay.her import Observation

_SMALL = nn.initializers.variance_scaling(1e-3, "fan_in", "uniform")  # of last layers: actions and values begin near 0


class _Flat(nn.Module):
    """Reads all leaves of an observation, and `more` [B, M], as one vector."""

    widths: tuple[int, ...]

    @nn.compact
    def __call__(self, observation: Observation, *more: jax.Array) -> jax.Array:
        parts = [leaf.reshape(leaf.shape[0], -1) for leaf in jax.tree.leaves(observation)]
        return _dense(jnp.concatenate([*parts, *more], -1), self.widths)


class _Maps(nn.Module):
    """Reads both maps and their difference, by blocks of 4 x 4 cells and then coarser; `more` [B, M] joins afterwards."""

    channels: tuple[int, ...]
    widths: tuple[int, ...]

    @nn.compact
    def __call__(self, observation: Observation, *more: jax.Array) -> jax.Array:
        goal, current = observation["goal"], observation["current"]
        x = nn.Conv(self.channels[0], (4, 4), (4, 4))(jnp.stack([goal, current, goal - current], -1))
        for channels in self.channels[1:]:
            x = nn.relu(nn.Conv(channels, (3, 3))(nn.relu(x)))
            x = nn.Conv(channels, (2, 2), (2, 2))(x)
        x = nn.relu(x).reshape(len(goal), -1)
        return _dense(jnp.concatenate([x, *more], -1), self.widths)


def _dense(x: jax.Array, widths: tuple[int, ...]) -> jax.Array:
    for width in widths:
        x = nn.relu(nn.Dense(width)(x))
    return x


@dataclass(frozen=True)
class Flat:
    """Fully connected layers on all leaves of an observation."""

    widths: tuple[int, ...] = (64, 64)

    def module(self) -> nn.Module:
        """The layers."""
        return _Flat(self.widths)


@dataclass(frozen=True)
class Maps:
    """Convolutions on maps, then fully connected layers.

    The maps' sides are multiples of 4 x 2^(n - 1), with n the number of `channels`.
    """

    channels: tuple[int, ...] = (32, 64)
    widths: tuple[int, ...] = (256, 128)

    def module(self) -> nn.Module:
        """The layers."""
        return _Maps(self.channels, self.widths)


Sight = Flat | Maps


class Actor(nn.Module):
    """The actor: its actions [B, A], -1 to 1, and the numbers whose tanh they are."""

    look: nn.Module
    size: int

    @nn.compact
    def __call__(self, observation: Observation) -> tuple[jax.Array, jax.Array]:
        raw = nn.Dense(self.size, kernel_init=_SMALL)(self.look(observation))
        return jnp.tanh(raw), raw


class Critic(nn.Module):
    """The critic: the values [B] of actions [B, A]."""

    look: nn.Module

    @nn.compact
    def __call__(self, observation: Observation, action: jax.Array) -> jax.Array:
        return nn.Dense(1, kernel_init=_SMALL)(self.look(observation, action))[:, 0]
