"""Which cells walls shade from a blade's sand."""

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from jaxsand.scene.boundaries import Walls
from jaxsand.scene.footprint import Pose
from jaxsand.scene.scene import Scene

_BENDS = 2


def within_reach(scene: Scene, cover: jax.Array, sand: jax.Array) -> jax.Array:
    """The cells with `sand` that sand can reach from a blade's footprint `cover`, 0 to 1, continuous in `cover`.

    Sand moves along rows and columns, around a few bends, and past no solid cell.
    """
    if not isinstance(scene.walls, Walls):
        return sand
    seen = lax.stop_gradient(jnp.minimum(2 * cover, 1) * sand)
    for _ in range(_BENDS):
        across, up = _along(seen, sand, 1), _along(seen, sand, 0)
        seen = jnp.maximum(_along(across, sand, 0), _along(up, sand, 1))
    return seen


def _along(seen: jax.Array, sand: jax.Array, axis: int) -> jax.Array:
    """The largest value along each row or column, between the nearest cells without sand."""

    def join(a: tuple[jax.Array, jax.Array], b: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        return jnp.maximum(b[0], b[1] * a[0]), a[1] * b[1]

    forth, _ = lax.associative_scan(join, (seen, sand), axis=axis)
    back, _ = lax.associative_scan(join, (seen, sand), reverse=True, axis=axis)
    return jnp.maximum(forth, back)


def spot(pose: Pose, s: jax.Array, n: jax.Array) -> tuple[jax.Array, jax.Array]:
    """The map coordinates x and y of points that lie s ahead of a pose and n to its left (m)."""
    return pose.x + s * pose.cos - n * pose.sin, pose.y + s * pose.sin + n * pose.cos


def inside(size: tuple[jax.Array, jax.Array], x: jax.Array, y: jax.Array) -> jax.Array:
    """The distance (m) of points from the nearest edge of a map of lengths `size`; negative outside."""
    return jnp.minimum(jnp.minimum(x, size[0] - x), jnp.minimum(y, size[1] - y))


def on_line(
    scene: Scene, pose: Pose, place: jax.Array, across: jax.Array, dx: jax.Array, weights: np.ndarray | None = None
) -> jax.Array:
    """The part of lines across a heading that lies on the map, one line at each `place` [n] along it.

    It is the mean, or the weighted sum, over the points `across` [m] of each line.
    """
    rows, columns = scene.grid.shape
    x, y = spot(pose, place[:, None], jnp.asarray(across, place.dtype)[None])
    away = inside((columns * dx, rows * dx), x, y)
    on = jnp.clip(away / dx + 0.5, 0, 1)
    return jnp.mean(on, axis=1) if weights is None else on @ jnp.asarray(weights, on.dtype)


def between(field: jax.Array, column: jax.Array, row: jax.Array) -> jax.Array:
    """A field interpolated bilinearly between cell centres; beyond the map it has the value of the nearest cell."""
    rows, columns = field.shape
    row, column = jnp.clip(row, 0, rows - 1), jnp.clip(column, 0, columns - 1)
    i, j = jnp.floor(row).astype(jnp.int32), jnp.floor(column).astype(jnp.int32)
    up, on = jnp.minimum(i + 1, rows - 1), jnp.minimum(j + 1, columns - 1)
    y, x = row - i.astype(row.dtype), column - j.astype(column.dtype)
    low = field[i, j] * (1 - x) + field[i, on] * x
    return low * (1 - y) + (field[up, j] * (1 - x) + field[up, on] * x) * y
