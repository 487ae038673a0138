"""The part of a map around a tool, seen so that the tool heads between +x and the diagonal.

Mirrors and a swap of the axes take any heading into the first octant, where a step ahead leads to one of two neighbours. A
block is fetched from the map in that frame, cell by cell, and set back the same way; what of it lies off the map is void.

Maps here are [H, W] or, for a batch, [H, W, B], and what belongs to one map is a number or [B]: arithmetic broadcasts from
the right, and a batch is computed with its maps in the lanes of the vector unit. In flat maps the cells are one axis, by
rows.
"""

from dataclasses import dataclass, field
from typing import Any

import jax
import jax.numpy as jnp

from jaxsand.scene.tools import Pose

Block = Any


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Frame:
    """A tool's view of a map of `shape` cells: mirrored along x, along y, and with x and y swapped, each or not; lengths
    are in spacings."""

    pose: Pose  # in this frame
    flip_x: jax.Array
    flip_y: jax.Array
    swap: jax.Array
    shape: tuple[int, int] = field(metadata={"static": True})

    def extent(self) -> tuple[jax.Array, jax.Array]:
        """How many cells the map has across and up, seen from here."""
        rows, columns = self.shape
        return jnp.where(self.swap, rows, columns), jnp.where(self.swap, columns, rows)


def frame_of(shape: tuple[int, int], pose: Pose) -> Frame:
    """The frame in which a pose (in spacings) heads into the first octant."""
    rows, columns = shape
    flip_x, flip_y = pose.cos < 0, pose.sin < 0
    x, y = jnp.where(flip_x, columns - pose.x, pose.x), jnp.where(flip_y, rows - pose.y, pose.y)
    cos, sin = jnp.where(flip_x, -pose.cos, pose.cos), jnp.where(flip_y, -pose.sin, pose.sin)
    swap = sin > cos
    seen = Pose(jnp.where(swap, y, x), jnp.where(swap, x, y), jnp.where(swap, sin, cos), jnp.where(swap, cos, sin))
    return Frame(seen, flip_x, flip_y, swap, shape)


def numbers(count: int, axis: int, like: jax.Array) -> jax.Array:
    """0, 1, ... along an axis of a map, to be broadcast against what belongs to one map."""
    shape = (1, count) if axis else (count, 1)
    return jnp.arange(count, dtype=like.dtype).reshape(*shape, *(1,) * like.ndim)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Places:
    """Where the cells of a block lie: their place in a flat map, and whether they lie on the map at all."""

    index: jax.Array  # [m, m]
    inside: jax.Array  # [m, m]
    row: jax.Array
    column: jax.Array


def places(frame: Frame, size: int, first: tuple[jax.Array, jax.Array]) -> Places:
    """The places of the block of `size` squared that begins at `first`; those off the map lie beyond its last cell."""
    rows, columns = frame.shape
    a = first[0] + numbers(size, 1, first[0])
    b = first[1] + numbers(size, 0, first[1])
    column, row = jnp.where(frame.swap, b, a), jnp.where(frame.swap, a, b)
    column, row = jnp.where(frame.flip_x, columns - 1 - column, column), jnp.where(frame.flip_y, rows - 1 - row, row)
    inside = (row >= 0) & (row < rows) & (column >= 0) & (column < columns)
    spare = rows * columns + numbers(size, 0, first[0]) * size + numbers(size, 1, first[0])
    return Places(jnp.where(inside, row * columns + column, spare), inside, row, column)


def cut(where: Places, flat: jax.Array, void: float = jnp.nan) -> jax.Array:
    """The block of a flat map [cells], with `void` off the map."""
    index = where.index.reshape(-1, *where.index.shape[2:])
    block = jnp.take_along_axis(flat, index, axis=0, mode="fill", fill_value=void)
    return block.reshape(where.index.shape)


def paste(where: Places, flat: jax.Array, block: jax.Array) -> jax.Array:
    """The flat map with its block replaced."""
    index = where.index.reshape(-1, *where.index.shape[2:])
    block = block.reshape(index.shape)
    if flat.ndim == 1:
        return flat.at[index].set(block, mode="drop", unique_indices=True)
    lane = jnp.arange(flat.shape[1])
    return flat.at[index, lane].set(block, mode="drop", unique_indices=True)


def shifted(maps: tuple[jax.Array, ...], by: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, ...]:
    """What maps of links hold after their block has moved on by 0 or 1 cells across and up; 0 where nothing was known."""

    def one(x: jax.Array) -> jax.Array:
        x = jnp.where(by[0] > 0, jnp.concatenate([x[:, 1:], jnp.zeros_like(x[:, :1])], 1), x)
        return jnp.where(by[1] > 0, jnp.concatenate([x[1:], jnp.zeros_like(x[:1])], 0), x)

    return tuple(one(x) for x in maps)


def shifted_back(maps: tuple[jax.Array, ...], by: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, ...]:
    """The transpose of `shifted`."""

    def one(x: jax.Array) -> jax.Array:
        x = jnp.where(by[0] > 0, jnp.concatenate([jnp.zeros_like(x[:, :1]), x[:, :-1]], 1), x)
        return jnp.where(by[1] > 0, jnp.concatenate([jnp.zeros_like(x[:1]), x[:-1]], 0), x)

    return tuple(one(x) for x in maps)
