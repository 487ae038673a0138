"""Measures of how near a map is to its goal, and goals as height maps.

Lengths are in metres. A cell counts as dug when it is lower than half the trench depth. A goal drawn as a binary map holds
no berms, so it is compared on min(h, 0), on what is dug, as arXiv:1908.02745 does; results give the measure with berms too.
"""

import math

import jax
import jax.numpy as jnp
import numpy as np

from jaxsand.scene.masked import gaps, unmasked
from jaxsand.scene.scene import Scene

_Map = jax.Array | np.ndarray
"""Heights [..., H, W] (m)."""

GLYPH_SQUARE = (0.035, 0.285)
"""Where a glyph's unit square lies on the 32 x 32 map of 0.01 m cells, in x and y (m)."""


def dug(height: jax.typing.ArrayLike, depth: jax.typing.ArrayLike) -> jax.Array:
    """Which cells are dug: h < -depth / 2.

    Args:
      height: [..., H, W] (m), level sand at 0.
      depth: of a trench (m).

    Returns:
      Booleans [..., H, W].

    Example:
      >>> import jax.numpy as jnp
      >>> import jaxsand as js
      >>> js.task.dug(jnp.array([0.0, -0.004]), depth=0.006).tolist()
      [False, True]
    """
    return jnp.asarray(height) < -jnp.asarray(depth) / 2


def iou(goal: jax.typing.ArrayLike, height: jax.typing.ArrayLike, depth: jax.typing.ArrayLike) -> jax.Array:
    """The intersection over union of the dug cells of two maps.

    Args:
      goal: [..., H, W] (m), level sand at 0.
      height: [..., H, W] (m).
      depth: of a trench (m); see `dug`.

    Returns:
      [...], 0 to 1; 1 where neither map has a dug cell.

    Example:
      >>> import jax.numpy as jnp
      >>> import jaxsand as js
      >>> goal, height = jnp.array([[0.0, -0.006]]), jnp.array([[-0.006, -0.006]])
      >>> float(js.task.iou(goal, height, depth=0.006))
      0.5
    """
    a, b = dug(goal, depth), dug(height, depth)
    both = jnp.sum(a & b, axis=(-2, -1))
    either = jnp.sum(a | b, axis=(-2, -1))
    return jnp.where(either == 0, 1.0, both / jnp.maximum(either, 1))


def l2(goal: _Map, height: _Map) -> jax.Array:
    """The l2 distance of two maps, sqrt(sum (goal - h)^2).

    Args:
      goal: [..., H, W] (m).
      height: [..., H, W] (m).

    Returns:
      [...] (m). Differentiable where it is not 0.

    Example:
      >>> import jax.numpy as jnp
      >>> import jaxsand as js
      >>> float(js.task.l2(jnp.zeros((2, 2)), jnp.ones((2, 2))))
      2.0
    """
    square = jnp.sum((goal - height) ** 2, axis=(-2, -1))
    return jnp.where(square > 0, jnp.sqrt(jnp.where(square > 0, square, 1)), 0)


def l2_reduction(goal: _Map, before: _Map, after: _Map) -> jax.Array:
    """The share of the distance to the goal that is gone, 1 - l2 after / l2 before.

    Args:
      goal: [..., H, W] (m).
      before: [..., H, W] (m).
      after: [..., H, W] (m).

    Returns:
      [...]: 1 at the goal, 0 where nothing was gained, below 0 where it got worse, -inf where `before` was the goal.

    Source: arXiv:1908.02745.

    Example:
      >>> import jax.numpy as jnp
      >>> import jaxsand as js
      >>> goal = jnp.full((2, 2), -1.0)
      >>> float(js.task.l2_reduction(goal, jnp.zeros((2, 2)), goal / 2))
      0.5
    """
    start, end = l2(goal, before), l2(goal, after)
    return jnp.where(start > 0, 1 - end / jnp.where(start > 0, start, 1), jnp.where(end > 0, -jnp.inf, 1.0))


def below(height: _Map) -> jax.Array:
    """What is dug of a map, min(h, 0).

    Args:
      height: [...] (m), level sand at 0.

    Returns:
      [...] (m).

    Example:
      >>> import jax.numpy as jnp
      >>> import jaxsand as js
      >>> js.task.below(jnp.array([2.0, -1.0])).tolist()
      [0.0, -1.0]
    """
    return jnp.minimum(height, 0)


def volume_error(before: jax.typing.ArrayLike, after: jax.typing.ArrayLike) -> float:
    """How much sand was lost or won, as a share of what moved: |V1 - V0| / (dx^2 max(sum |h0|, sum |h1 - h0|)).

    Args:
      before: h0 [H, W] (m).
      after: h1 [H, W] (m).

    Returns:
      A number, 0 when both sums are 0. Computed in float64 on the host.

    Example:
      >>> import jaxsand as js
      >>> js.task.volume_error([[0.0, 0.0]], [[0.5, -0.25]])
      0.3333333333333333
    """
    h0, h1 = (np.asarray(unmasked(name, h), np.float64) for name, h in (("before", before), ("after", after)))
    moved = max(math.fsum(np.abs(h0).ravel()), math.fsum(np.abs(h1 - h0).ravel()))
    return abs(math.fsum([*h1.ravel(), *-h0.ravel()])) / moved if moved else 0.0


def map_goal(dig: np.ndarray, cell: int, margin: int, depth: float) -> np.ndarray:
    """A binary map as a height map: -depth in the cells to dig, 0 elsewhere.

    Args:
      dig: booleans [rows, columns], in text order (row 0 on top).
      cell: grid cells to a side of a map cell.
      margin: grid cells of level sand around the map.
      depth: of the trench (m).

    Returns:
      [rows cell + 2 margin, columns cell + 2 margin] (m), row 0 at y = 0.

    Example:
      >>> import numpy as np
      >>> import jaxsand as js
      >>> js.task.map_goal(np.array([[True], [False]]), cell=1, margin=0, depth=0.01).tolist()
      [[-0.0], [-0.01]]
    """
    block = np.kron(np.flipud(dig).astype(float), np.ones((cell, cell)))
    return np.pad(-depth * block, margin)


def cell_centre(cells: np.ndarray, rows: int, cell: int, margin: int, spacing: float) -> np.ndarray:
    """Where the centres of map cells lie on the sand of `map_goal`.

    Args:
      cells: [n, 2] (row, column), row 0 on top.
      rows: of the map.
      cell: grid cells to a side of a map cell.
      margin: grid cells of level sand around the map.
      spacing: of the grid (m).

    Returns:
      [n, 2] of x, y (m).

    Example:
      >>> import numpy as np
      >>> import jaxsand as js
      >>> js.task.cell_centre(np.array([[1, 0]]), rows=2, cell=1, margin=0, spacing=0.01).tolist()
      [[0.005, 0.005]]
    """
    cells = np.asarray(cells, float)
    x = (margin + (cells[:, 1] + 0.5) * cell) * spacing
    y = (margin + (rows - cells[:, 0] - 0.5) * cell) * spacing
    return np.stack([x, y], 1)


def place(strokes: np.ndarray, square: tuple[float, float] = GLYPH_SQUARE) -> np.ndarray:
    """Strokes of the unit square in a square of the map.

    Args:
      strokes: [n, 4] = x0, y0, x1, y1, each 0 to 1, y up.
      square: its lowest and highest x and y (m).

    Returns:
      [n, 4] (m).

    Example:
      >>> import numpy as np
      >>> import jaxsand as js
      >>> js.task.place(np.array([[0.0, 0.0, 1.0, 0.5]]), square=(1.0, 3.0)).tolist()
      [[1.0, 1.0, 3.0, 2.0]]
    """
    low, high = square
    return low + np.asarray(strokes, float) * (high - low)


def resample(image: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """A map of the same area at another resolution.

    Where cells grow larger, each new cell has the mean over its area; where they grow smaller, heights are interpolated
    linearly. Rows and columns are scaled independently.

    Args:
      image: [H, W].
      shape: of the new map.

    Returns:
      The new map, of `shape`.

    Raises:
      ValueError: if a cell is not finite or masked; what is missing would spread.

    Example:
      >>> import numpy as np
      >>> import jaxsand as js
      >>> js.task.resample(np.array([[0.0, 2.0], [4.0, 6.0]]), (1, 1)).tolist()
      [[3.0]]
    """
    finite(image, "image")
    for axis in (0, 1):
        image = np.moveaxis(_resample_rows(np.moveaxis(image, axis, 0), shape[axis]), 0, axis)
    return image


def _resample_rows(image: np.ndarray, rows: int) -> np.ndarray:
    """A map [H, ...] with another number of rows, by means or by linear interpolation."""
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
    """Checks that a goal has the scene's shape and is finite.

    Args:
      scene: the scene.
      goal: [H, W] (m).
      name: of the goal, for the message.

    Returns:
      None.

    Raises:
      ValueError: if it has another shape, or a cell that is not finite.

    Example:
      >>> import numpy as np
      >>> import jaxsand as js
      >>> js.task.fits(js.make_scene((4, 4), 0.01), np.zeros((4, 4)))
    """
    if goal.shape != scene.grid.shape:
        raise ValueError(
            f"{name}: got shape {list(goal.shape)}, the scene has {list(scene.grid.shape)}; "
            "make the scene as large, or use task.resample"
        )
    finite(goal, name)


def fits_where_it_counts(scene: Scene, goal: np.ndarray, name: str = "goal") -> None:
    """Checks that a goal whose NaN cells are free has the scene's shape, and cells that count.

    Args:
      scene: the scene.
      goal: [H, W] (m), NaN where any height will do.
      name: of the goal, for the message.

    Returns:
      None.

    Raises:
      ValueError: if it has another shape, an infinite cell, or none that counts.

    Example:
      >>> import numpy as np
      >>> import jaxsand as js
      >>> goal = np.full((4, 4), np.nan)
      >>> goal[1, 1] = 0.0
      >>> js.task.fits_where_it_counts(js.make_scene((4, 4), 0.01), goal)
    """
    if np.isnan(goal).all():
        raise ValueError(f"{name}: got NaN, free, in every cell; give a height where it matters")
    fits(scene, np.where(np.isnan(goal), 0, goal), name)


def finite(goal: np.ndarray, name: str = "goal") -> None:
    """Checks that every cell of a goal is finite and none is masked.

    Args:
      goal: [H, W] (m).
      name: of the goal, for the message.

    Returns:
      None.

    Raises:
      ValueError: if a cell is not finite or masked; it says how many.

    Example:
      >>> import numpy as np
      >>> import jaxsand as js
      >>> js.task.finite(np.array([[np.nan]]))
      Traceback (most recent call last):
        ...
      ValueError: goal: got 1 cells that are not finite; fill them first, such as with the height of the sand around
    """
    if bad := int(np.sum(~np.isfinite(gaps(goal)))):
        raise ValueError(
            f"{name}: got {bad} cells that are not finite; fill them first, such as with the height of the sand around"
        )
