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

from jaxsand.interaction._displacement import Job
from jaxsand.scene.tools import Pose

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
    """

    height: jax.Array
    sand: jax.Array

    def ahead(self, job: Job, pose: Pose, length: jax.Array) -> tuple[jax.Array, Relief]:
        """The level (m) at the start of a leg of the job's wheel, and how it goes on along `length` (m)."""
        count = math.ceil(math.hypot(*self.height.shape)) + 2
        dx = job.bed.spacing
        stride = jnp.maximum(length / (count - 1), dx)
        level = self.level(job, pose, stride * jnp.arange(count, dtype=dx.dtype))
        return level[0], Relief(level - level[0], stride / dx)

    def level(self, job: Job, pose: Pose, by: jax.Array) -> jax.Array:
        """The mean level (m) over the width of the job's wheel, at distances `by` [K] (m) ahead of a pose."""
        dx, slip = job.bed.spacing, jnp.asarray(job.tool.slip_angle)
        aside = (((jnp.arange(_ACROSS, dtype=dx.dtype) + 0.5) / _ACROSS - 0.5) * job.tool.width)[None]
        s, n = by[:, None] + aside * jnp.sin(slip), aside * jnp.cos(slip)
        x, y = pose.x + s * pose.cos - n * pose.sin, pose.y + s * pose.sin + n * pose.cos
        ends = [_ends(at / dx - 0.5, cells) for at, cells in zip((y, x), self.height.shape, strict=True)]
        total = parts = jnp.zeros_like(x)
        for row, of_row in ends[0]:
            for column, of_column in ends[1]:
                weight = of_row * of_column * self.sand[row, column]
                parts = parts + weight
                total = total + weight * self.height[row, column]
        whole = jnp.sum(parts, axis=1)
        return jnp.sum(total, axis=1) / jnp.where(whole > 0, whole, 1)


def ground_of(marked: jax.Array) -> Ground:
    """The ground of a map [H, W] (m) that is NaN where there is no sand."""
    bare = jnp.isnan(marked)
    return Ground(jnp.where(bare, 0, marked), jnp.where(bare, 0, 1).astype(marked.dtype))


def _ends(at: jax.Array, cells: int) -> list[tuple[jax.Array, jax.Array]]:
    """The two cells between whose centres a point lies, counted in cells, and their shares."""
    at = jnp.clip(at, 0, cells - 1)
    first = jnp.floor(lax.stop_gradient(at))
    part = at - first
    low = first.astype(jnp.int32)
    return [(low, 1 - part), (jnp.minimum(low + 1, cells - 1), part)]
