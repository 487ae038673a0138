"""The ground that a wheel under a load follows: the mean level of the sand over its width, as the push found it.

The level is read at points a spacing apart along a leg, by bilinear interpolation at 16 points across the wheel, and is
linear between them: of second order in the spacing. Off the map the ground is that of the map's edge; cells without sand do
not count.
"""

import math
from dataclasses import dataclass

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from jaxsand.relaxation.ghost_cells import mark
from jaxsand.scene.footprint import Pose
from jaxsand.scene.scene import Scene
from jaxsand.scene.tools import Wheel

_ACROSS = 16


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Relief:
    """How the ground along a leg rises and falls from its level at the start.

    Attributes:
        rise: at points along the leg [K] (m), or [K, B] of a batch.
        stride: distance of these points (spacings).
    """

    rise: jax.Array
    stride: jax.Array

    def at(self, by: jax.Array) -> jax.Array:
        """The rise (m) at a distance (spacings) from the start."""
        count = self.rise.shape[0]
        number = jnp.arange(count, dtype=by.dtype).reshape(count, *(1,) * by.ndim)
        near = jnp.clip(1 - jnp.abs(by / self.stride - number), 0, 1)
        return jnp.sum(near * self.rise, axis=0)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Ground:
    """A map as a push found it, [H, W].

    Attributes:
        height: of the sand (m), 0 where there is none.
        sand: 1 for cells with sand, else 0.
        spacing: of the grid (m).
    """

    height: jax.Array
    sand: jax.Array
    spacing: jax.Array

    def ahead(self, wheel: Wheel, pose: Pose, length: jax.Array) -> tuple[jax.Array, Relief]:
        """The level (m) at the start of a wheel's leg, and how it goes on along `length` (m)."""
        count = math.ceil(math.hypot(*self.height.shape)) + 2
        stride = jnp.maximum(length / (count - 1), self.spacing)
        level = self.level(wheel, pose, stride * jnp.arange(count, dtype=self.height.dtype))
        return level[0], Relief(level - level[0], stride / self.spacing)

    def level(self, wheel: Wheel, pose: Pose, by: jax.Array) -> jax.Array:
        """The mean level (m) over the wheel's width, at distances `by` [K] (m) ahead of a pose."""
        slip = jnp.asarray(wheel.slip_angle)
        aside = (((jnp.arange(_ACROSS, dtype=self.height.dtype) + 0.5) / _ACROSS - 0.5) * wheel.width)[None]
        s, n = by[:, None] + aside * jnp.sin(slip), aside * jnp.cos(slip)
        x, y = pose.x + s * pose.cos - n * pose.sin, pose.y + s * pose.sin + n * pose.cos
        ends = [_ends(at / self.spacing - 0.5, cells) for at, cells in zip((y, x), self.height.shape, strict=True)]
        total = parts = jnp.zeros_like(x)
        for row, of_row in ends[0]:
            for column, of_column in ends[1]:
                weight = of_row * of_column * self.sand[row, column]
                parts = parts + weight
                total = total + weight * self.height[row, column]
        whole = jnp.sum(parts, axis=1)
        return jnp.sum(total, axis=1) / jnp.where(whole > 0, whole, 1)


def ground_of(scene: Scene, height: Float[Array, "H W"]) -> Ground:
    """The ground of a scene's map (m)."""
    marked, _ = mark(scene, height)
    bare = jnp.isnan(marked)
    return Ground(jnp.where(bare, 0, marked), jnp.where(bare, 0, 1).astype(height.dtype), jnp.asarray(scene.grid.spacing))


def _ends(at: jax.Array, cells: int) -> list[tuple[jax.Array, jax.Array]]:
    """The two cells between whose centres a point lies, counted in cells, and their shares."""
    at = jnp.clip(at, 0, cells - 1)
    first = jnp.floor(lax.stop_gradient(at))
    part = at - first
    low = first.astype(jnp.int32)
    return [(low, 1 - part), (jnp.minimum(low + 1, cells - 1), part)]
