"""Slices across a stroke: sums of a map over each slice, and values of slices at each cell.

A slice weighs cells by a hat function, 1 in its middle and 0 from the middle of the next slice on, so that a cell belongs to
the two slices next to it. Positions `at` along the stroke are counted in slices.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

_CHUNK = 16  # slices at a time
POINTS, WEIGHTS = np.array([0.155051, 0.644949]), np.array([0.636083, 0.363917])  # of a wedge on [0, 1], by Gauss


def in_slices(at: jax.Array, count: int, amount: jax.Array) -> jax.Array:
    """The part of an amount [H, W] that belongs to each slice, [count]; XLA vectorises it and stores no weights."""
    slices = jnp.arange(count, dtype=at.dtype)[:, None, None]
    return jnp.sum(jnp.sum(jnp.maximum(1 - jnp.abs(at[None] - slices), 0) * amount[None], axis=1), axis=1)


def of_slices(at: jax.Array, left: jax.Array, values: jax.Array) -> jax.Array:
    """The values [2, n] of the slices' left and right sides at each cell, mixed by the share of the cell on the left."""
    many = -(-values.shape[1] // _CHUNK)
    values = jnp.concatenate([values, jnp.zeros((2, many * _CHUNK - values.shape[1]), values.dtype)], axis=1)

    def more(total: jax.Array, chunk: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, None]:
        first, (on_left, on_right) = chunk
        for k in range(_CHUNK):
            blend = on_right[k] + (on_left[k] - on_right[k]) * left
            total = total + blend * jnp.maximum(1 - jnp.abs(at - (first + k)), 0)
        return total, None

    chunks = (jnp.arange(many, dtype=at.dtype) * _CHUNK, values.reshape(2, many, _CHUNK).swapaxes(0, 1))
    return lax.scan(more, jnp.zeros_like(at), chunks)[0]


def hat(at: jax.Array, slices: jax.Array) -> jax.Array:
    """The weights of places in each slice, [k, ...]."""
    return jnp.maximum(1 - jnp.abs(at - slices[:, None]), 0)


def to_slice(x: jax.Array) -> jax.Array:
    """The integral of the hat function from -1 to x."""
    x = jnp.clip(x, -1, 1)
    return 0.5 + x - x * jnp.abs(x) / 2


def wedge(u: jax.Array, reach: jax.Array, dx: jax.Array) -> jax.Array:
    """The integral over a spacing around u of a wedge on [0, reach] that falls to 0 and has the area 1."""

    def area(u: jax.Array) -> jax.Array:
        part = jnp.clip(u / reach, 0, 1)
        return part * (2 - part)

    return area(u + dx / 2) - area(u - dx / 2)
