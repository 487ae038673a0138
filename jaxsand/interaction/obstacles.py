"""How far a tool can go before its footprint meets cells that it may not enter; exact for every stroke.

The footprint is a rectangle that moves along its heading, a cell a square. Two such figures overlap where their shadows do
on each of four axes, the map's and the rectangle's. The shadows on one axis overlap along an interval of the way, so the
rectangle and the cell do along the intersection of four.
"""

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxsand.interaction._path import heading
from jaxsand.scene.footprint import local
from jaxsand.scene.grid import Grid, centres
from jaxsand.scene.tools import Number

_LEVEL = 1e-6  # the sine of an angle below which a way is parallel to an axis


def free_way(
    cells: Bool[Array, "H W"],
    grid: Grid,
    start: Float[Array, "2"],
    stop: Float[Array, "2"],
    width: Number,
    thickness: Number,
) -> tuple[Bool[Array, ""], Float[Array, ""]]:
    """Whether a straight stroke meets a cell, and the share of its way, 0 to 1, that is free before it does.

    Args:
        cells: booleans [H, W], true where the tool may not be.
        grid: spacing and shape of the map.
        start: where the middle of the tool starts, x, y (m).
        stop: where it would end; a stroke of no length faces +x.
        width: extent of the tool across its way (m).
        thickness: extent along its way (m), half of it ahead of the middle.

    Returns:
        Whether it meets one, and the share: 0 where the tool starts on a cell, 1 where it meets none. Touching is not
        meeting. Differentiable in the start, the stop and the tool, but where another cell becomes the first that is met.
    """
    pose, length = heading(start, stop, None)
    x, y = centres(grid, start.dtype)
    half = jnp.asarray(grid.spacing, start.dtype) / 2
    cos, sin = jnp.abs(pose.cos), jnp.abs(pose.sin)
    ahead, aside = (jnp.asarray(size, start.dtype) / 2 for size in (thickness, width))
    along, across = local(pose, x, y)
    square = half * (cos + sin)
    axes = (
        (x - pose.x, pose.cos, half + ahead * cos + aside * sin),
        (y - pose.y, pose.sin, half + ahead * sin + aside * cos),
        (along, jnp.ones_like(cos), square + ahead),
        (across, jnp.zeros_like(cos), square + aside),
    )
    enter, leave = jnp.full_like(along, -jnp.inf), jnp.full_like(along, jnp.inf)
    for apart, speed, reach in axes:
        moves = jnp.abs(speed) > _LEVEL
        rate = jnp.where(moves, speed, 1)
        middle, spread = apart / rate, reach / jnp.abs(rate)
        always = jnp.where(jnp.abs(apart) < reach, jnp.inf, -jnp.inf)  # an empty interval where they never overlap
        enter = jnp.maximum(enter, jnp.where(moves, middle - spread, -always))
        leave = jnp.minimum(leave, jnp.where(moves, middle + spread, always))
    met = cells & (enter < leave) & (leave > 0) & (enter < length)
    way = jnp.min(jnp.min(jnp.where(met, jnp.maximum(enter, 0), length), axis=0))
    meets = jnp.any(met)
    return meets, jnp.where(meets, way / jnp.where(length > 0, length, 1), 1)
