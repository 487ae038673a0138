"""The frame of a tool: a block of the map, mirrored so that the tool heads between +x and the diagonal.

Mirrors and a swap of the axes turn any heading into the first octant, where a step ahead leads to one of two neighbours. A
block is read from the map in that frame, cell by cell, and written back the same way. Its cells off the map hold no sand.

Maps are [H, W] or, for a batch, [H, W, B], and a value for each map is a scalar or [B]: arithmetic broadcasts from the
right, and the maps of a batch lie in the lanes of the vector unit. Flat maps [cells] hold the cells row by row.
"""

from dataclasses import dataclass, field

import jax
import jax.numpy as jnp
import numpy as np

from jaxsand.scene.footprint import Pose


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Frame:
    """A tool's view of a map of `shape` cells: mirrored along x or y, then with x and y swapped, each or not.

    `pose` is the tool's pose in this frame, in spacings.
    """

    pose: Pose
    flip_x: jax.Array
    flip_y: jax.Array
    swap: jax.Array
    shape: tuple[int, int] = field(metadata={"static": True})

    def mirrors(self, angle: jax.Array) -> jax.Array:
        """An angle, counter-clockwise on the map, as this frame has it."""
        return jnp.where(self.flip_x ^ self.flip_y ^ self.swap, -angle, angle)

    def extent(self) -> tuple[jax.Array, jax.Array]:
        """The numbers of columns and rows of the map in this frame."""
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
    """0, 1, ... along an axis of a map, shaped to broadcast against `like`, a value for each map."""
    shape = (1, count) if axis else (count, 1)
    return jnp.arange(count, dtype=like.dtype).reshape(*shape, *(1,) * like.ndim)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Places:
    """Where the cells of a block lie on the map, [m, m] or [m, m, B] each.

    Attributes:
        index: place in the flat map; beyond its end for cells off the map.
        inside: whether the cell lies on the map.
        row, column: row and column on the map.
    """

    index: jax.Array
    inside: jax.Array
    row: jax.Array
    column: jax.Array


def places(frame: Frame, size: int, first: tuple[jax.Array, jax.Array]) -> Places:
    """The places of the block of `size` x `size` cells whose first cell (column, row) in the frame is `first`."""
    rows, columns = frame.shape
    a = first[0] + numbers(size, 1, first[0])
    b = first[1] + numbers(size, 0, first[1])
    column, row = jnp.where(frame.swap, b, a), jnp.where(frame.swap, a, b)
    column, row = jnp.where(frame.flip_x, columns - 1 - column, column), jnp.where(frame.flip_y, rows - 1 - row, row)
    inside = (row >= 0) & (row < rows) & (column >= 0) & (column < columns)
    spare = rows * columns + numbers(size, 0, first[0]) * size + numbers(size, 1, first[0])
    return Places(jnp.where(inside, row * columns + column, spare), inside, row, column)


def cut(where: Places, flat: jax.Array, void: float = jnp.nan) -> jax.Array:
    """The block of a flat map [cells], with the value `void` off the map."""
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
    """Maps of fluxes after their block has moved by 0 or 1 cells across and up; 0 over links that are new in the block."""

    def one(x: jax.Array) -> jax.Array:
        x = jnp.where(by[0] > 0, jnp.concatenate([x[:, 1:], jnp.zeros_like(x[:, :1])], 1), x)
        return jnp.where(by[1] > 0, jnp.concatenate([x[1:], jnp.zeros_like(x[:1])], 0), x)

    return bounded(tuple(one(x) for x in maps))


def bounded(maps: tuple[jax.Array, ...]) -> tuple[jax.Array, ...]:
    """Maps of fluxes with 0 over the links that lead out of their block, over which what moves would be lost."""
    size = min(x.shape[0] for x in maps)

    def one(x: jax.Array) -> jax.Array:
        keep = np.ones(x.shape[:2])
        for axis in (0, 1):
            if x.shape[axis] > size:
                np.swapaxes(keep, 0, axis)[[0, -1]] = 0
        return x * jnp.asarray(keep, x.dtype).reshape(*x.shape[:2], *(1,) * (x.ndim - 2)) if not keep.all() else x

    return tuple(one(x) for x in maps)


def shifted_back(maps: tuple[jax.Array, ...], by: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, ...]:
    """The transpose of `shifted`."""
    maps = bounded(maps)

    def one(x: jax.Array) -> jax.Array:
        x = jnp.where(by[0] > 0, jnp.concatenate([jnp.zeros_like(x[:, :1]), x[:, :-1]], 1), x)
        return jnp.where(by[1] > 0, jnp.concatenate([jnp.zeros_like(x[:1]), x[:-1]], 0), x)

    return tuple(one(x) for x in maps)
