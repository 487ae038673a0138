"""Tools: their geometry, and how much of each cell they cover."""

import math
from dataclasses import dataclass, field

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
class Smooth:
    """A rim without grousers, or a wheel that is towed without turning (neutral)."""


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Grousers:
    """Bars across a wheel's rim, `height` (m) high, that carry sand to behind the wheel.

    What they carry comes to lie in the cut behind the wheel: to a metre of travel spin * width * height * fill (m^3), as far
    as that much is displaced. `fill` is the share of the space between them that sand takes up, `spin` the rim's speed over
    the wheel's: 1 / (1 - i) for a wheel driven at the slip ratio i.
    """

    height: jax.Array | float = 0.005
    fill: jax.Array | float = 0.1
    spin: jax.Array | float = 1.0


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Wheel:
    """A wheel towed or driven at a fixed sinkage, its plane at an angle to its way.

    `radius`, `width` and `sinkage` in m; the lowest point of the rim is at height -sinkage. `slip_angle` (rad) turns from
    the wheel's plane to its way, counter-clockwise: at pi/2 the wheel is dragged sideways, to its left. The defaults are
    those of arXiv:1908.02745.
    """

    radius: jax.Array | float = 0.048
    width: jax.Array | float = 0.05
    sinkage: jax.Array | float = 0.015
    slip_angle: jax.Array | float = 0.0
    grousers: Smooth | Grousers = field(default_factory=Smooth)


def lowest(tool: Blade | Wheel) -> jax.Array:
    """The height of the tool's lowest point (m)."""
    return -jnp.asarray(tool.sinkage if isinstance(tool, Wheel) else tool.depth)


def usable(tool: NoTool | Blade | Wheel) -> jax.Array:
    """Whether the tool's numbers are finite and, for a wheel, make one; what is traced escapes `make_scene`."""
    good = jnp.ones((), bool)
    for leaf in jax.tree.leaves(tool):
        good = good & jnp.all(jnp.isfinite(leaf))
    if isinstance(tool, Wheel):
        good = good & (tool.sinkage >= 0) & (tool.sinkage <= tool.radius)
        good = good & (jnp.abs(tool.slip_angle) <= math.pi / 2 * (1 + 1e-6))
    return good


def half_chord(wheel: Wheel) -> jax.Array:
    """Half of the wheel's chord at level sand, s = sqrt(h (2 r - h)) (m); at least a thousandth of the radius."""
    r = jnp.asarray(wheel.radius)
    return jnp.sqrt(jnp.maximum(wheel.sinkage * (2 * r - wheel.sinkage), 1e-6 * r * r))


def carried_area(wheel: Wheel, grousers: Grousers) -> jax.Array:
    """What the grousers of a wheel carry to behind it to a unit of travel (m^2)."""
    return jnp.asarray(grousers.spin * wheel.width * grousers.height * grousers.fill)


def extent(tool: Blade | Wheel) -> jax.Array:
    """How high or low the tool can bring sand (m), in order of magnitude; sets the precision of a push."""
    return jnp.asarray(tool.radius) if isinstance(tool, Wheel) else jnp.abs(jnp.asarray(tool.depth))


def reach(tool: Blade | Wheel) -> jax.Array:
    """How far from its centre the tool reaches along its way (m), at most."""
    if isinstance(tool, Wheel):
        return jnp.hypot(tool.radius, jnp.asarray(tool.width) / 2)
    return jnp.asarray(tool.thickness) / 2


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
    return interval(along, -half, half + ahead, spacing) * interval(across, -side, side, spacing)


def interval(s: jax.Array, start: jax.Array, stop: jax.Array, spacing: jax.Array) -> jax.Array:
    """The share of [s - dx/2, s + dx/2] that lies in [start, stop]."""
    return jnp.clip((s - start) / spacing + 0.5, 0.0, 1.0) - jnp.clip((s - stop) / spacing + 0.5, 0.0, 1.0)


def wheel_frame(wheel: Wheel, pose: Pose, x: jax.Array, y: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Coordinates in the wheel's frame (m): along its plane and along its axle, to the left."""
    along, across = local(pose, x, y)
    cos, sin = jnp.cos(wheel.slip_angle), jnp.sin(wheel.slip_angle)
    return along * cos - across * sin, along * sin + across * cos


def rim(wheel: Wheel, pose: Pose, x: jax.Array, y: jax.Array, spacing: jax.Array) -> tuple[jax.Array, jax.Array]:
    """The share of each cell, 0 to 1, that the wheel stands or hangs over, and the height of its rim there (m).

    The rim's lower half, -sinkage + r - sqrt(r^2 - a^2) at the distance a from the axle; coverage as for a blade.
    """
    a, c = wheel_frame(wheel, pose, x, y)
    r, side = jnp.asarray(wheel.radius), jnp.asarray(wheel.width) / 2
    cover = interval(a, -r, r, spacing) * interval(c, -side, side, spacing)
    inside = jnp.abs(a) < 0.999 * r
    square = jnp.where(inside, r * r - a * a, 0.002 * r * r)
    return cover, r - wheel.sinkage - jnp.sqrt(square)
