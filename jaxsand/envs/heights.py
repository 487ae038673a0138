"""At what height a stroke's tool moves: at its own depth, or rising and sinking as an action says."""

import math
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np

from jaxsand.scene.grid import Grid


@dataclass(frozen=True)
class OwnDepth:
    """Tells `MultiStroke` that the blade moves at its own depth, the default: a stroke is x0, y0, x1, y1.

    Example:
      >>> import jaxsand as js
      >>> js.env.MultiStroke().heights
      OwnDepth()
    """

    size = 4  # numbers of a stroke

    def stroke(self, action: jax.Array, grid: Grid, depth: jax.typing.ArrayLike) -> jax.Array:
        """The stroke x0, y0, x1, y1 (m) of the numbers [4] of an action."""
        del depth
        return on_map(action.reshape(2, 2), grid).reshape(4)

    def action(self, stroke: jax.Array, grid: Grid, depth: jax.typing.ArrayLike) -> jax.Array:
        """The numbers [4] of an action of a stroke x0, y0, x1, y1 (m)."""
        del depth
        return off_map(stroke.reshape(2, 2), grid).reshape(4)

    def drawn(self, rng: np.random.Generator, plans: list[np.ndarray]) -> list[np.ndarray]:
        """Strokes [n, 4] of the unit square, as they are."""
        del rng
        return plans


@dataclass(frozen=True)
class Heights:
    """Tells an environment that the tool rises and sinks on its way: a stroke is x0, y0, z0, x1, y1, z1.

    z is the height of the tool's bottom. An action's -1 and 1 stand for two heights that the scene gives, as multiples of
    its tool's depth: by default from twice the depth below height 0 to one depth above it, where the tool passes over level
    sand and touches heaps alone.

    Args:
      lowest: the height of -1, as a multiple of the tool's depth.
      highest: the height of 1, likewise; above `lowest`.

    Raises:
      ValueError: for heights that are not finite, or not in this order.

    Example:
      >>> import jax.numpy as jnp
      >>> import numpy as np
      >>> import jaxsand as js
      >>> env, params = js.make("multi-stroke", goals=np.zeros((1, 32, 32)), heights=js.env.Heights())
      >>> [f"{z:.4f}" for z in env.stroke(jnp.array([-1.0, -1, -1, 1, 1, 1]), params)[2::3]]
      ['-0.0150', '0.0075']
    """

    lowest: float = -2.0
    highest: float = 1.0

    size = 6  # numbers of a stroke

    def __post_init__(self) -> None:
        known = all(isinstance(x, int | float) for x in (self.lowest, self.highest))
        if not known or not -math.inf < self.lowest < self.highest < math.inf:
            raise ValueError(f"heights: got {self}; give lowest < highest, as multiples of the tool's depth")

    def stroke(self, action: jax.Array, grid: Grid, depth: jax.typing.ArrayLike) -> jax.Array:
        """The stroke x0, y0, z0, x1, y1, z1 (m) of the numbers [6] of an action."""
        ends = action.reshape(2, 3)
        high = self.lowest + (ends[:, 2:] + 1) / 2 * (self.highest - self.lowest)
        return jnp.concatenate([on_map(ends[:, :2], grid), high * jnp.asarray(depth, action.dtype)], 1).reshape(6)

    def action(self, stroke: jax.Array, grid: Grid, depth: jax.typing.ArrayLike) -> jax.Array:
        """The numbers [6] of an action of a stroke x0, y0, z0, x1, y1, z1 (m)."""
        ends = stroke.reshape(2, 3)
        share = (ends[:, 2:] / jnp.asarray(depth, stroke.dtype) - self.lowest) / (self.highest - self.lowest)
        return jnp.concatenate([off_map(ends[:, :2], grid), 2 * share - 1], 1).reshape(6)

    def drawn(self, rng: np.random.Generator, plans: list[np.ndarray]) -> list[np.ndarray]:
        """Strokes [n, 4] of the unit square, with heights [n, 6] from the lowest to 0, in multiples of the tool's depth."""
        high = max(self.lowest, min(self.highest, 0.0))
        return [np.insert(some, (2, 4), rng.uniform(self.lowest, high, (len(some), 2)), axis=1) for some in plans]


def on_map(points: jax.Array, grid: Grid) -> jax.Array:
    """Points [n, 2] = x, y (m), each given from -1 to 1, from the first to the last cell centre."""
    return (0.5 + (points + 1) / 2 * _steps(grid, points)) * jnp.asarray(grid.spacing, points.dtype)


def off_map(points: jax.Array, grid: Grid) -> jax.Array:
    """Points [n, 2] = x, y (m), as numbers from -1 to 1, from the first to the last cell centre."""
    return 2 * (points / jnp.asarray(grid.spacing, points.dtype) - 0.5) / _steps(grid, points) - 1


def _steps(grid: Grid, points: jax.Array) -> jax.Array:
    """The distance from the first to the last cell centre in spacings, for x and y: [1, 2]."""
    rows, columns = grid.shape
    return jnp.array([[columns - 1, rows - 1]], points.dtype)
