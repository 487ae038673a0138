"""The network of the actor-critic: a U-Net sees both maps, and a small network that looks along strokes values them.

A critic that gets a stroke as four numbers hardly learns what they mean. This one reads the U-Net's features along the
stroke and beside it, so that a stroke's value changes with what it would cross, and so does the value's slope. The same
U-Net's scores of cells are the actor: they say where strokes start and, given that, where they end.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from flax import linen as nn

from jaxsand.goals.usual import SHAPE
from jaxsand.planning.learned.network import Eye, Params, Scores, ends, in_views, seen_on_lines, spread

Value = Callable[[jax.Array], jax.Array]
"""From strokes [B, P, 4] (cells) to their values [B, P]."""

LOW, HIGH = 0.5, SHAPE[0] - 0.5
"""The least and the largest number of a stroke (cells), those of the outermost cells' centres."""

_STEPS = (0.6, 0.5, 0.4, 0.3, 0.2, 0.15, 0.1, 0.1)  # cells, up the slope of the value
_LENGTH = 10.0  # cells: lengths of strokes are shown to the network in this unit


class StrokeCritic(nn.Module):
    """The U-Net, and the critic that looks along strokes.

    Maps are [B, H, W] in units of the blade's depth, strokes in cells, as those of `StrokeNet`.
    """

    widths: tuple[int, int, int] = (32, 64, 96)
    blocks: tuple[int, int, int] = (1, 2, 2)
    features: int = 16
    sights: int = 12

    def setup(self) -> None:
        """Makes the layers."""
        self.eye = Eye(self.widths, self.blocks, self.features, self.sights)
        self.layers = [nn.Dense(128), nn.Dense(64), nn.Dense(1)]

    def __call__(self, goal: jax.Array, current: jax.Array, strokes: jax.Array) -> tuple[Scores, jax.Array]:
        scores = self.eye(goal, current)
        return scores, self.value(scores, strokes)

    def look(self, goal: jax.Array, current: jax.Array) -> Scores:
        """The scores of the U-Net alone."""
        return self.eye(goal, current)

    def value(self, scores: Scores, strokes: jax.Array) -> jax.Array:
        """The values [B, P] of strokes [B, P, 4], averaged over all views of the scores."""
        every = in_views(scores, strokes)
        way = every[..., 2:] - every[..., :2]
        length = jnp.sqrt(jnp.sum(way**2, -1, keepdims=True) + 1e-6) / _LENGTH
        off = jnp.sqrt(jnp.mean(scores.sight[..., -1] ** 2, (2, 3)) + 1e-6)
        off = jnp.broadcast_to(off[:, :, None, None], length.shape)
        x = jnp.concatenate([seen_on_lines(scores.sight, every), length, off], -1)
        for layer in self.layers[:-1]:
            x = nn.relu(layer(x))
        return self.layers[-1](x)[..., 0].mean(1)


def drawn(key: jax.Array, scores: Scores, count: int) -> jax.Array:
    """Draws strokes [B, count, 4] (cells) by the likelihoods of start cells, and of end cells given those.

    Within their cells, ends are uniform. Cells are drawn by the inverse of the cumulated likelihoods.
    """
    batch, (rows, columns) = len(scores.start), scores.start.shape[1:]
    chance = jax.random.uniform(key, (batch, count, 6), scores.start.dtype)
    start = _inverse(jnp.exp(scores.start).reshape(batch, 1, -1), chance[..., 0])
    query = jnp.take_along_axis(scores.query.reshape(batch, rows * columns, -1), start[..., None], 1)
    share = jax.nn.softmax(jnp.einsum("bpk,bck->bpc", query, scores.key.reshape(batch, rows * columns, -1)), -1)
    cells = jnp.stack([start, _inverse(share, chance[..., 1])], -1)
    places = jnp.stack([cells % columns, cells // columns], -1) + chance[..., 2:].reshape(batch, count, 2, 2)
    return jnp.clip(places.reshape(batch, count, 4), LOW, HIGH)


def _inverse(share: jax.Array, chance: jax.Array) -> jax.Array:
    """The cells [B, P] at which the cumulated shares [B, P or 1, C] reach a chance [B, P]."""
    reached = jnp.cumsum(share, -1)
    below = jnp.sum(reached < chance[..., None] * reached[..., -1:], -1)
    return jnp.minimum(below, share.shape[-1] - 1)


def log_likelihood(scores: Scores, strokes: jax.Array) -> jax.Array:
    """The log-likelihoods [B, P] of strokes [B, P, 4] (cells), interpolated between cells."""
    shape = (scores.start.shape[1], scores.start.shape[2])
    start = jnp.einsum("bpij,bij->bp", spread(strokes[..., :2], shape), scores.start)
    return start + jnp.sum(spread(strokes[..., 2:], shape) * ends(scores, strokes[..., :2]), (2, 3))


def climbed(value: Value, strokes: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Strokes [B, P, 4] (cells) after a few steps up the slope of their value, and their values [B, P].

    A step has a fixed length, and is taken where the value grows by it.
    """
    slope = jax.grad(lambda strokes: jnp.sum(value(strokes)))

    def step(now: tuple[jax.Array, jax.Array], length: jax.Array) -> tuple[tuple[jax.Array, jax.Array], None]:
        strokes, values = now
        up = slope(strokes)
        up = up / (jnp.sqrt(jnp.sum(up**2, -1, keepdims=True)) + 1e-6)
        moved = jnp.clip(strokes + length * up, LOW, HIGH)
        new = value(moved)
        return (jnp.where((new > values)[..., None], moved, strokes), jnp.maximum(new, values)), None

    return jax.lax.scan(step, (strokes, value(strokes)), jnp.array(_STEPS, strokes.dtype))[0]


def looked(net: StrokeCritic, params: Params, goal: jax.Array, current: jax.Array) -> Scores:
    """What the U-Net says of maps [B, H, W] in units of the blade's depth, in a single view."""
    scores: Any = net.apply(params, goal, current, method="look")
    return scores


def valued(net: StrokeCritic, params: Params, scores: Scores) -> Value:
    """The critic as a function of strokes on maps of which the U-Net said `scores`."""

    def value(strokes: jax.Array) -> jax.Array:
        values: Any = net.apply(params, scores, strokes, method="value")
        return values

    return value
