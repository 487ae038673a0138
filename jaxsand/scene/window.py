"""Windows: the part of the map that is computed, where sand moves."""

from dataclasses import dataclass, field
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class AsNeeded:
    """The simulator chooses a window from the blade's size, and enlarges it as needed; the default of `make_scene`.

    A `SteppedPush` of a `Blade` computes only a window around the blade; on very wide maps the settling after it, too, is
    computed in a window. If sand reaches a window's edge, all is computed again with a window twice as wide, and in the end
    on the whole map. Inside `jit`, `grad` and `vmap`, where no
    second try is possible, the window is half as wide again to begin with, and the outcome says WINDOW_EDGE if it was too
    small: give `Window(size)` or `Whole()` then. Every other computation uses the whole map.

    Example:
        >>> import jaxsand as js
        >>> js.make_scene((8, 8), 0.01).window
        AsNeeded()
    """


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Whole:
    """The whole map is computed.

    Example:
        >>> import jaxsand as js
        >>> js.make_scene((8, 8), 0.01, window=js.Whole()).window
        Whole()
    """


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Window:
    """Only a block of the map is computed: in a scene, one that follows the tool; in `settle`, one around what is too steep.

    The map outside the block must be still: before the tool comes down, no slope may exceed repose by more than
    `tolerance`. The outcome says WINDOW_EDGE if one does, or if an outermost cell of the block (where the block's edge is
    not the map's) moves by more than `tolerance` spacings while the tool advances by one spacing. The result may then
    differ from that of `Whole`. With tolerance 0 and no such outcome, both are equal up to rounding.

    Attributes:
        size: rows and columns of the block, at most those of the map; static.
        tolerance: slope above repose, and movement in spacings, that count as still.
        near: number of cells across the part of the block that the tool can touch, or None; static. The simulator sets it.

    Example:
        >>> import jaxsand as js
        >>> scene = js.make_scene((64, 64), 0.01, tool=js.Blade(), window=js.Window((24, 24)))
        >>> scene.window.size
        (24, 24)
    """

    size: tuple[int, int] = field(metadata={"static": True})
    tolerance: Float[Array, ""] | float = 1e-3
    near: int | None = field(default=None, metadata={"static": True})


Origin = list[Int[Array, ""]]


def origin(window: Window, shape: tuple[int, int], centre: tuple[Float[Array, ""], Float[Array, ""]]) -> Origin:
    """The first row and column of the block around `centre` (row, column), shifted so that the block lies on the map."""
    return [
        jnp.clip(jnp.floor(c).astype(jnp.int32) - n // 2, 0, m - n)
        for c, n, m in zip(centre, window.size, shape, strict=True)
    ]


def cut(window: Window, shape: tuple[int, int], start: Origin, tree: Any) -> Any:
    """The block of every map in a tree: of [H, W], [1, W], [H, 1], or with ghost cells [H + 2, W + 2]. Scalars stay."""

    def one(a: jax.Array) -> jax.Array:
        if a.ndim < 2:
            return a
        first = [jnp.zeros_like(o) if m == 1 else o for o, m in zip(start, a.shape, strict=True)]
        sizes = [1 if m == 1 else m - n + w for m, n, w in zip(a.shape, shape, window.size, strict=True)]
        return lax.dynamic_slice(a, first, sizes)

    return jax.tree.map(one, tree)


def paste(start: Origin, tree: Any, blocks: Any) -> Any:
    """The tree with the block of each of its maps replaced by the one in `blocks`."""
    return jax.tree.map(lambda a, b: lax.dynamic_update_slice(a, b, start), tree, blocks)


def near_edge(window: Window, shape: tuple[int, int], start: Origin) -> Bool[Array, "h w"]:
    """Which cells of the block lie within two cells of those of its edges that are not the map's."""
    near = []
    for o, n, m in zip(start, window.size, shape, strict=True):
        i = jnp.arange(n)
        near.append(((i < 2) & (o > 0)) | ((i >= n - 2) & (o + n < m)))
    return near[0][:, None] | near[1][None, :]


def edge_movement(
    window: Window,
    shape: tuple[int, int],
    start: Origin,
    old: Float[Array, "h w"],
    new: Float[Array, "h w"],
    cover: Float[Array, "h w"],
) -> Float[Array, ""]:
    """The largest change of height (m) in the cells of `near_edge`; infinite if the tool covers one of them."""
    change = jnp.where(new == old, 0, jnp.abs(new - old))
    change = jnp.where(jnp.isnan(new), 0, jnp.where(cover > 0, jnp.inf, change))
    return lax.stop_gradient(jnp.max(jnp.where(near_edge(window, shape, start), change, 0)))
