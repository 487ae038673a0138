"""A path in sub-steps: legs cut into equal parts, and the tool's pose on each."""

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from jaxsand.interaction._path import heading
from jaxsand.scene.footprint import Pose


def cut(path: Float[Array, "n k"], count: int) -> Float[Array, "m k"]:
    """The path with each leg in `count` equal legs."""
    part = (jnp.arange(count, dtype=path.dtype) / count).reshape(1, count, 1)
    points = path[:-1, None] + part * (path[1:] - path[:-1])[:, None]
    return jnp.concatenate([points.reshape(-1, path.shape[1]), path[-1:]])


def poses(path: Float[Array, "n k"]) -> tuple[Pose, Float[Array, " n-1"]]:
    """The poses at the start of the legs, with the headings in which a tool follows them, and the legs' lengths (m)."""
    first, length = heading(path[0, :2], path[1, :2], None)

    def later(before: Pose, ends: tuple[jax.Array, jax.Array]) -> tuple[Pose, tuple[Pose, jax.Array]]:
        pose, length = heading(*ends, before)
        return pose, (pose, length)

    _, rest = lax.scan(later, first, (path[1:-1, :2], path[2:, :2]))
    return jax.tree.map(lambda one, more: jnp.concatenate([one[None], more]), (first, length), rest)
