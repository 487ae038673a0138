"""The eight turns and mirrors of square maps, and of strokes on them."""

import jax
import jax.numpy as jnp


def turned(maps: jax.Array, way: int, rows: int = 1) -> jax.Array:
    """Square maps flipped and transposed in one of eight ways.

    Bit 1 of `way` flips the rows, bit 2 flips the columns, and then bit 0 swaps rows and columns. `rows` is the axis of the
    rows; that of the columns follows it.
    """
    maps = jnp.flip(maps, [axis + rows - 1 for axis in (1, 2) if way >> axis & 1])
    return maps.swapaxes(rows, rows + 1) if way & 1 else maps


def turned_back(maps: jax.Array, way: int, rows: int = 1) -> jax.Array:
    """The inverse of `turned` for the same `way`: it undoes first the swap, then the flips."""
    maps = maps.swapaxes(rows, rows + 1) if way & 1 else maps
    return jnp.flip(maps, [axis + rows - 1 for axis in (1, 2) if way >> axis & 1])


def turned_strokes(strokes: jax.Array, way: int, side: float) -> jax.Array:
    """Strokes [..., 4] (cells) on square maps of `side` cells, transformed as `turned` transforms the maps."""
    x, y = strokes[..., ::2], strokes[..., 1::2]
    x, y = side - x if way >> 2 & 1 else x, side - y if way >> 1 & 1 else y
    x, y = (y, x) if way & 1 else (x, y)
    return jnp.stack([x[..., 0], y[..., 0], x[..., 1], y[..., 1]], -1)


def turned_strokes_back(strokes: jax.Array, way: int, side: float) -> jax.Array:
    """The inverse of `turned_strokes` for the same `way`."""
    swapped = strokes[..., jnp.array([1, 0, 3, 2])] if way & 1 else strokes
    return turned_strokes(swapped, way & ~1, side)
