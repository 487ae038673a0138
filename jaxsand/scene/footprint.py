"""Where a tool stands, and the share of each cell that it covers there."""

from dataclasses import dataclass

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxsand.scene.tools import Blade, Number, Scalar, Wheel


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Pose:
    """Where a tool stands and which way it heads.

    Attributes:
        x, y: the tool's centre (m), scalars.
        cos, sin: the unit vector of its heading, scalars; (1, 0) is +x, the direction of growing column numbers.

    Example:
        >>> import jax.numpy as jnp
        >>> import jaxsand as js
        >>> scene = js.make_scene((8, 8), 0.01, tool=js.Blade())
        >>> pose = js.step(scene, jnp.zeros((8, 8)), jnp.array([0.02, 0.04, 0.06, 0.04])).pose
        >>> print(f"{pose.x:.2f} {pose.y:.2f} {pose.cos:.2f} {pose.sin:.2f}")
        0.06 0.04 1.00 0.00
    """

    x: Float[Array, "*batch"]
    y: Float[Array, "*batch"]
    cos: Float[Array, "*batch"]
    sin: Float[Array, "*batch"]


def local(pose: Pose, x: Float[Array, "..."], y: Float[Array, "..."]) -> tuple[Float[Array, "..."], Float[Array, "..."]]:
    """The coordinates of points (x, y) in the tool's frame (m): along its heading, and across it to the left."""
    px, py = x - pose.x, y - pose.y
    return px * pose.cos + py * pose.sin, py * pose.cos - px * pose.sin


def coverage(
    blade: Blade, pose: Pose, x: Float[Array, "1 W"], y: Float[Array, "H 1"], spacing: Scalar, ahead: Number = 0.0
) -> Float[Array, "H W"]:
    """The blade's footprint: the share of each cell, 0 to 1, that it covers while it moves ahead by `ahead` (m) from `pose`.

    It is the product of two intervals, along and across, each smoothed over one spacing: exact for headings along the grid,
    a first-order approximation otherwise. Continuous and piecewise linear in pose, width, thickness and `ahead`.
    """
    along, across = local(pose, x, y)
    half = jnp.asarray(blade.thickness) / 2
    side = jnp.asarray(blade.width) / 2
    return interval(along, -half, half + ahead, spacing) * interval(across, -side, side, spacing)


def interval(s: Float[Array, "..."], start: Scalar, stop: Scalar, spacing: Scalar) -> Float[Array, "..."]:
    """The share of [s - dx/2, s + dx/2] that lies in [start, stop], dx the spacing."""
    return jnp.clip((s - start) / spacing + 0.5, 0.0, 1.0) - jnp.clip((s - stop) / spacing + 0.5, 0.0, 1.0)


def wheel_frame(
    wheel: Wheel, pose: Pose, x: Float[Array, "..."], y: Float[Array, "..."]
) -> tuple[Float[Array, "..."], Float[Array, "..."]]:
    """The coordinates of points (x, y) in the wheel's frame (m): along its plane, and along its axle to the left."""
    along, across = local(pose, x, y)
    cos, sin = jnp.cos(wheel.slip_angle), jnp.sin(wheel.slip_angle)
    return along * cos - across * sin, along * sin + across * cos


def rim(
    wheel: Wheel, pose: Pose, x: Float[Array, "1 W"], y: Float[Array, "H 1"], spacing: Scalar
) -> tuple[Float[Array, "H W"], Float[Array, "H W"]]:
    """The wheel's footprint, the share of each cell below the wheel, 0 to 1, and the height of its rim over the cell (m).

    The lower half of the rim stands at -sinkage + r - sqrt(r^2 - a^2) at the distance a from the axle along the wheel's
    plane. The footprint is smoothed as that of `coverage`.
    """
    a, c = wheel_frame(wheel, pose, x, y)
    r, side = jnp.asarray(wheel.radius), jnp.asarray(wheel.width) / 2
    cover = interval(a, -r, r, spacing) * interval(c, -side, side, spacing)
    inside = jnp.abs(a) < 0.999 * r
    square = jnp.where(inside, r * r - a * a, 0.002 * r * r)
    return cover, r - wheel.sinkage - jnp.sqrt(square)
