"""Where the sand moves: a part of the map that alone is computed."""

from dataclasses import dataclass, field
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class AsNeeded:
    """Where a blade's sand moves, as far as the blade's size tells (the default).

    A stepped push of a blade computes a window around it, and a larger one, up to the whole map, where sand reaches its
    edge. Inside of `jit`, `grad` or `vmap`, where what happens is not known beforehand, the window is half as wide again,
    and the outcome says WINDOW_EDGE if it was too small; give `Window(size)` or `Whole()` then. All else is computed
    everywhere.
    """


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Whole:
    """Everywhere."""


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Window:
    """In a block of `size` cells (rows, columns): as part of a scene one that follows the tool, given to `settle` one around
    what is too steep (see there).

    Under a tool the map must be still when the tool comes down: no slope above repose by more than `tolerance`. If that does
    not hold, or an outermost cell of the block (where its edge is not the map's) moves by more than `tolerance` spacings
    while the tool advances by a spacing, the outcome says WINDOW_EDGE: the result may then differ from that of `Whole`.
    With tolerance 0 and no such outcome the two are equal up to the rounding of single operations.
    """

    size: tuple[int, int] = field(metadata={"static": True})
    tolerance: jax.Array | float = 1e-3
    near: int | None = field(default=None, metadata={"static": True})
    """How many cells across all lies that the tool covers or touches; the simulator looks where the tool's size is known."""


Origin = list[jax.Array]


def origin(window: Window, shape: tuple[int, int], centre: tuple[jax.Array, jax.Array]) -> Origin:
    """First row and column of the block around `centre` (row, column), moved to lie on the map."""
    return [
        jnp.clip(jnp.floor(c).astype(jnp.int32) - n // 2, 0, m - n)
        for c, n, m in zip(centre, window.size, shape, strict=True)
    ]


def cut(window: Window, shape: tuple[int, int], start: Origin, tree: Any) -> Any:
    """The block of every map in a tree: [H, W], [1, W], [H, 1], or with a halo [H + 2, W + 2]. Scalars stay."""

    def one(a: jax.Array) -> jax.Array:
        if a.ndim < 2:
            return a
        first = [jnp.zeros_like(o) if m == 1 else o for o, m in zip(start, a.shape, strict=True)]
        sizes = [1 if m == 1 else m - n + w for m, n, w in zip(a.shape, shape, window.size, strict=True)]
        return lax.dynamic_slice(a, first, sizes)

    return jax.tree.map(one, tree)


def paste(start: Origin, tree: Any, blocks: Any) -> Any:
    """The maps of a tree with their blocks replaced."""
    return jax.tree.map(lambda a, b: lax.dynamic_update_slice(a, b, start), tree, blocks)


def near_edge(window: Window, shape: tuple[int, int], start: Origin) -> jax.Array:
    """Which cells of the block lie within two cells of its edge where that is not the map's."""
    near = []
    for o, n, m in zip(start, window.size, shape, strict=True):
        i = jnp.arange(n)
        near.append(((i < 2) & (o > 0)) | ((i >= n - 2) & (o + n < m)))
    return near[0][:, None] | near[1][None, :]


def edge_movement(
    window: Window, shape: tuple[int, int], start: Origin, old: jax.Array, new: jax.Array, cover: jax.Array
) -> jax.Array:
    """The largest change of height within two cells of the block's edge where that is not the map's; infinite if the tool
    covers a part of it."""
    change = jnp.where(new == old, 0, jnp.abs(new - old))
    change = jnp.where(jnp.isnan(new), 0, jnp.where(cover > 0, jnp.inf, change))
    return lax.stop_gradient(jnp.max(jnp.where(near_edge(window, shape, start), change, 0)))
