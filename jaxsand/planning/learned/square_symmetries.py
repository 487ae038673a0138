"""The eight turns and mirrors of square maps, and of strokes on them."""

import jax
import jax.numpy as jnp


def turned(maps: jax.Array, way: int, rows: int = 1) -> jax.Array:
    """Square maps, with `rows` the axis of their rows, before that of their columns, in one of eight ways: bit 1 turns rows
    round and bit 2 columns, then bit 0 swaps them."""
    maps = jnp.flip(maps, [axis + rows - 1 for axis in (1, 2) if way >> axis & 1])
    return maps.swapaxes(rows, rows + 1) if way & 1 else maps


def turned_back(maps: jax.Array, way: int, rows: int = 1) -> jax.Array:
    """What `turned` turned; of maps that were not, another of the eight views, in which bit 0 swaps first."""
    maps = maps.swapaxes(rows, rows + 1) if way & 1 else maps
    return jnp.flip(maps, [axis + rows - 1 for axis in (1, 2) if way >> axis & 1])


def turned_strokes(strokes: jax.Array, way: int, side: float) -> jax.Array:
    """Strokes [..., 4] (cells) on square maps of so many cells a side, turned as `turned` turns the maps."""
    x, y = strokes[..., ::2], strokes[..., 1::2]
    x, y = side - x if way >> 2 & 1 else x, side - y if way >> 1 & 1 else y
    x, y = (y, x) if way & 1 else (x, y)
    return jnp.stack([x[..., 0], y[..., 0], x[..., 1], y[..., 1]], -1)


def turned_strokes_back(strokes: jax.Array, way: int, side: float) -> jax.Array:
    """What `turned_strokes` turned."""
    swapped = strokes[..., jnp.array([1, 0, 3, 2])] if way & 1 else strokes
    return turned_strokes(swapped, way & ~1, side)
