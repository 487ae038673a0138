"""What walls keep a blade's sand from."""

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from jaxsand.scene.boundaries import Walls
from jaxsand.scene.scene import Scene
from jaxsand.scene.tools import Pose

_BENDS = 2


def within_reach(scene: Scene, cover: jax.Array, sand: jax.Array) -> jax.Array:
    """The cells that hold `sand` [H, W] and to which some can come from what a blade covers (`cover`): along
    rows and columns, round a few bends, past no solid cell. 0 to 1, continuous in `cover`."""
    if not isinstance(scene.walls, Walls):
        return sand
    seen = lax.stop_gradient(jnp.minimum(2 * cover, 1) * sand)
    for _ in range(_BENDS):
        across, up = _along(seen, sand, 1), _along(seen, sand, 0)
        seen = jnp.maximum(_along(across, sand, 0), _along(up, sand, 1))
    return seen


def _along(seen: jax.Array, sand: jax.Array, axis: int) -> jax.Array:
    """The largest value along a row or column, up to the next cell without sand."""

    def join(a: tuple[jax.Array, jax.Array], b: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        return jnp.maximum(b[0], b[1] * a[0]), a[1] * b[1]

    forth, _ = lax.associative_scan(join, (seen, sand), axis=axis)
    back, _ = lax.associative_scan(join, (seen, sand), reverse=True, axis=axis)
    return jnp.maximum(forth, back)


def spot(pose: Pose, s: jax.Array, n: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Where on the map places lie that are s along a heading and n across it (m)."""
    return pose.x + s * pose.cos - n * pose.sin, pose.y + s * pose.sin + n * pose.cos


def inside(size: tuple[jax.Array, jax.Array], x: jax.Array, y: jax.Array) -> jax.Array:
    """How far places lie from the nearest edge of a map of a `size` (m), below 0 outside of it."""
    return jnp.minimum(jnp.minimum(x, size[0] - x), jnp.minimum(y, size[1] - y))


def on_line(
    scene: Scene, pose: Pose, place: jax.Array, across: jax.Array, dx: jax.Array, weights: np.ndarray | None = None
) -> jax.Array:
    """How much of lines across a heading, at `place` [n] along it, is on the map: a mean over the places `across` [m]."""
    rows, columns = scene.grid.shape
    x, y = spot(pose, place[:, None], jnp.asarray(across, place.dtype)[None])
    away = inside((columns * dx, rows * dx), x, y)
    on = jnp.clip(away / dx + 0.5, 0, 1)
    return jnp.mean(on, axis=1) if weights is None else on @ jnp.asarray(weights, on.dtype)


def between(field: jax.Array, column: jax.Array, row: jax.Array) -> jax.Array:
    """The field between the cell centres, bilinear; beyond the map that of its outer cells."""
    rows, columns = field.shape
    row, column = jnp.clip(row, 0, rows - 1), jnp.clip(column, 0, columns - 1)
    i, j = jnp.floor(row).astype(jnp.int32), jnp.floor(column).astype(jnp.int32)
    up, on = jnp.minimum(i + 1, rows - 1), jnp.minimum(j + 1, columns - 1)
    y, x = row - i.astype(row.dtype), column - j.astype(column.dtype)
    low = field[i, j] * (1 - x) + field[i, on] * x
    return low * (1 - y) + (field[up, j] * (1 - x) + field[up, on] * x) * y
