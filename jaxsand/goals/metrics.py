"""What a result is measured by, and goals as height maps.

Lengths in metres. A cell counts as dug when it is lower than half the trench depth. A goal drawn as a binary map holds no
berms, so it is compared on min(h, 0), on what is dug, as arXiv:1908.02745 does; the figure with berms is given beside it.
"""

import math

import jax
import jax.numpy as jnp
import numpy as np

from jaxsand.scene.scene import Scene

GLYPH_SQUARE = (0.035, 0.285)
"""Where a glyph's unit square lies on the 32 x 32 map of 0.01 m cells, in x and y (m)."""


def dug(height: jax.typing.ArrayLike, depth: jax.typing.ArrayLike) -> jax.Array:
    """Which cells are dug: h < -depth / 2."""
    return jnp.asarray(height) < -jnp.asarray(depth) / 2


def iou(goal: jax.typing.ArrayLike, height: jax.typing.ArrayLike, depth: jax.typing.ArrayLike) -> jax.Array:
    """Intersection over union of the dug cells of two maps, over the last two axes; 1 where neither has any."""
    a, b = dug(goal, depth), dug(height, depth)
    both = jnp.sum(a & b, axis=(-2, -1))
    either = jnp.sum(a | b, axis=(-2, -1))
    return jnp.where(either == 0, 1.0, both / jnp.maximum(either, 1))


def l2(goal: jax.Array, height: jax.Array) -> jax.Array:
    """The l2 distance of two maps, sqrt(sum (goal - h)^2) (m), over the last two axes. Differentiable where it is not 0."""
    square = jnp.sum((goal - height) ** 2, axis=(-2, -1))
    return jnp.where(square > 0, jnp.sqrt(jnp.where(square > 0, square, 1)), 0)


def l2_reduction(goal: jax.Array, before: jax.Array, after: jax.Array) -> jax.Array:
    """1 - l2 after / l2 before: 1 at the goal, 0 where nothing was gained, below 0 where it got worse."""
    start, end = l2(goal, before), l2(goal, after)
    return jnp.where(start > 0, 1 - end / jnp.where(start > 0, start, 1), jnp.where(end > 0, -jnp.inf, 1.0))


def below(height: jax.Array) -> jax.Array:
    """Only what is dug: min(h, 0)."""
    return jnp.minimum(height, 0)


def volume_error(before: jax.typing.ArrayLike, after: jax.typing.ArrayLike) -> float:
    """|V1 - V0| / (dx^2 max(sum |h0|, sum |h1 - h0|)), and 0 when both sums are 0; in float64 on the host."""
    h0, h1 = np.asarray(before, np.float64), np.asarray(after, np.float64)
    moved = max(math.fsum(np.abs(h0).ravel()), math.fsum(np.abs(h1 - h0).ravel()))
    return abs(math.fsum([*h1.ravel(), *-h0.ravel()])) / moved if moved else 0.0


def map_goal(dig: np.ndarray, cell: int, margin: int, depth: float) -> np.ndarray:
    """A binary map in text order (row 0 on top) as a height map: each cell `cell` grid cells wide, -depth where it is to be
    dug and 0 elsewhere, with `margin` grid cells of level sand around."""
    block = np.kron(np.flipud(dig).astype(float), np.ones((cell, cell)))
    return np.pad(-depth * block, margin)


def cell_centre(cells: np.ndarray, rows: int, cell: int, margin: int, spacing: float) -> np.ndarray:
    """Where the centres of map cells (row, column; row 0 on top) lie: [n, 2] of x, y (m); see `map_goal`."""
    cells = np.asarray(cells, float)
    x = (margin + (cells[:, 1] + 0.5) * cell) * spacing
    y = (margin + (rows - cells[:, 0] - 0.5) * cell) * spacing
    return np.stack([x, y], 1)


def place(strokes: np.ndarray, square: tuple[float, float] = GLYPH_SQUARE) -> np.ndarray:
    """Strokes [n, 4] of the unit square in the square [low, high] of the map (m)."""
    low, high = square
    return low + np.asarray(strokes, float) * (high - low)


def resample(image: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """A map of another shape over the same field: the mean over each new cell where cells grow larger, bilinear where they
    grow smaller. Rows and columns are scaled apart."""
    for axis in (0, 1):
        image = np.moveaxis(_resample_rows(np.moveaxis(image, axis, 0), shape[axis]), 0, axis)
    return image


def _resample_rows(image: np.ndarray, rows: int) -> np.ndarray:
    old = image.shape[0]
    if rows == old:
        return image
    if rows < old:
        # Means between the new edges, from the running integral.
        integral = np.concatenate([np.zeros_like(image[:1]), np.cumsum(image, axis=0)])
        edges = np.linspace(0, old, rows + 1)
        low = np.minimum(edges.astype(int), old - 1)
        values = integral[low] + (edges - low).reshape(-1, *[1] * (image.ndim - 1)) * image[low]
        return np.diff(values, axis=0) * rows / old
    centres = np.clip((np.arange(rows) + 0.5) * old / rows - 0.5, 0, old - 1)
    low = np.minimum(centres.astype(int), max(old - 2, 0))
    part = (centres - low).reshape(-1, *[1] * (image.ndim - 1))
    return image[low] * (1 - part) + image[np.minimum(low + 1, old - 1)] * part


def fits(scene: Scene, goal: np.ndarray, name: str = "goal") -> None:
    """Raises ValueError unless a goal, or what goes by that name, has the scene's shape and is finite."""
    if goal.shape != scene.grid.shape:
        raise ValueError(
            f"{name}: got shape {list(goal.shape)}, the scene has {list(scene.grid.shape)}; "
            "make the scene as large, or use task.resample"
        )
    finite(goal, name)


def finite(goal: np.ndarray, name: str = "goal") -> None:
    """Raises ValueError unless every cell is finite."""
    if not np.all(np.isfinite(goal)):
        raise ValueError(f"{name}: got {int(np.sum(~np.isfinite(goal)))} cells that are not finite; fill them first")
