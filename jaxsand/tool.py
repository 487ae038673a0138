"""Tools: their geometry, and how much of each cell they cover."""

from dataclasses import dataclass

import jax
import jax.numpy as jnp


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class NoTool:
    """Nothing touches the sand (neutral)."""


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Blade:
    """A flat blade pushed perpendicular to itself, its bottom edge at height -depth (m) while it is lowered.

    `width` (m) lies across the direction of travel, `thickness` (m) along it. `depth` is measured from height 0, not
    from the sand: a blade of negative depth passes above a level map.
    """

    width: jax.Array | float = 0.02
    thickness: jax.Array | float = 0.015
    depth: jax.Array | float = 0.0075


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Pose:
    """Where a tool stands: its centre (m) and the unit vector (cos, sin) of its heading."""

    x: jax.Array
    y: jax.Array
    cos: jax.Array
    sin: jax.Array


def local(pose: Pose, x: jax.Array, y: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Coordinates in the tool's frame (m): along its heading and across it, to the left."""
    px, py = x - pose.x, y - pose.y
    return px * pose.cos + py * pose.sin, py * pose.cos - px * pose.sin


def coverage(
    blade: Blade, pose: Pose, x: jax.Array, y: jax.Array, spacing: jax.Array, ahead: jax.Array | float = 0.0
) -> jax.Array:
    """The share of each cell, 0 to 1, that the blade covers while it moves `ahead` (m) from `pose`.

    The product of two intervals, along and across, each smoothed over one spacing; exact for headings along the grid, a
    first-order approximation otherwise. Continuous and piecewise linear in pose, width, thickness and `ahead`.
    """
    along, across = local(pose, x, y)
    half = jnp.asarray(blade.thickness) / 2
    side = jnp.asarray(blade.width) / 2
    return _interval(along, -half, half + ahead, spacing) * _interval(across, -side, side, spacing)


def _interval(s: jax.Array, start: jax.Array, stop: jax.Array, spacing: jax.Array) -> jax.Array:
    """The share of [s - dx/2, s + dx/2] that lies in [start, stop]."""
    return jnp.clip((s - start) / spacing + 0.5, 0.0, 1.0) - jnp.clip((s - stop) / spacing + 0.5, 0.0, 1.0)
