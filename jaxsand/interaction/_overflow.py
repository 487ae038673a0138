"""The part of a blade's berms and heap that runs off over a draining edge.

At the distance r from the rim, sand can stand mu r higher than the rim, mu = tan(angle of repose). Sand that a blade would
set down above that, or beyond the edge, runs off. In front of a rim that is higher than the sand, sand piles up as before a
wall until it is as high as the rim.
"""

from dataclasses import dataclass

import jax
import jax.numpy as jnp

from jaxsand.interaction._displacement import Site
from jaxsand.interaction._mound import Holds, distance
from jaxsand.interaction._shade import between, inside, spot
from jaxsand.scene.footprint import Pose
from jaxsand.scene.scene import Scene


@dataclass(frozen=True)
class RimAhead:
    """A draining edge, as a blade's leg meets it.

    Attributes:
        size: the map's lengths along x and y (m).
        level: height of the rim (m).
        ground: mean height of the sand in the blade's way (m).
        flanks: how open the blade's two flanks are at the end of the leg, 0 to 1.
        away: number of cells from each cell to the edge, along rows or columns without walls.
        seen: cells to which sand can come from the blade; see `within_reach`.
    """

    size: tuple[jax.Array, jax.Array]
    level: jax.Array
    ground: jax.Array
    flanks: jax.Array
    away: jax.Array
    seen: jax.Array

    @classmethod
    def of(cls, scene: Scene, site: Site, ground: jax.Array, sand: jax.Array, seen: jax.Array) -> "RimAhead":
        """The rim of a scene that drains, before the leg."""
        assert site.bed.rim is not None
        dx, (rows, columns) = site.bed.spacing, scene.grid.shape
        return cls((columns * dx, rows * dx), site.bed.rim.level, ground, jnp.ones(2, sand.dtype), _from_edge(sand), seen)

    def outside(self, pose: Pose, s: jax.Array, n: jax.Array, seen: jax.Array, dx: jax.Array) -> jax.Array:
        """1 at points beyond the edge, smoothed over a spacing, if the cells on this side are `seen`.

        The points lie s ahead of the pose and n to its left (m).
        """
        x, y = spot(pose, s, n)
        free = between(seen, x / dx - 0.5, y / dx - 0.5)
        return jnp.clip(0.5 - inside(self.size, x, y) / dx, 0, 1) * jnp.clip(2 * free - 1, 0, 1)

    def berms(
        self, pose: Pose, place: jax.Array, side: jax.Array, reach: jax.Array, peak: jax.Array, dx: jax.Array
    ) -> jax.Array:
        """The share of the left and the right berm, [2, n], that runs off at each `place` along the leg.

        Of a berm that is `peak` high, the part above the rim runs off.
        """
        off = side + reach / 3
        out = jnp.stack([self.outside(pose, place, n, self.seen, dx) for n in (off, -off)])
        under = jnp.stack([self.outside(pose, place, n, self.seen, dx) for n in (-side, 0 * side, side)])
        return out * (1 - jnp.min(under, axis=0))[None] * jnp.clip(1 - (self.level - self.ground) / peak, 0, 1)

    def beyond(
        self, pose: Pose, end: jax.Array, side: jax.Array, farthest: jax.Array, mu: jax.Array, dx: jax.Array
    ) -> Holds:
        """A function from a mound's reach to the volume that would lie beyond the edge and above the rim, and its slope.

        Volumes are sums of heights over cells, divided by mu.
        """
        ahead, across = (jnp.arange(8, dtype=end.dtype) + 0.5) / 8, (jnp.arange(16, dtype=end.dtype) - 7.5) / 8
        u, n = (farthest * ahead)[:, None], ((side + farthest) * across)[None, :]
        away = distance(u, jnp.maximum(jnp.abs(n) - side, 0))
        weight = self.outside(pose, end + u, n, self.seen, dx) * (farthest * (side + farthest) / (64 * dx * dx))
        weight = weight * jnp.where(jnp.abs(n) <= side, 1, jnp.where(n > 0, self.flanks[0], self.flanks[1]))
        gap = jnp.maximum(self.level - self.ground, 0) / mu

        def holds(reach: jax.Array) -> tuple[jax.Array, jax.Array]:
            above = reach - away - gap
            return jnp.sum(weight * jnp.maximum(above, 0)), jnp.sum(jnp.where(above > 0, weight, 0))

        return holds

    def room(self, site: Site, h: jax.Array, mu: jax.Array) -> jax.Array:
        """How much higher than h sand can stand (m): at the distance r from the rim, up to mu r above the rim."""
        return jnp.maximum(self.level + mu * self.away * site.bed.spacing - jnp.where(jnp.isnan(h), 0, h), 0)


def _from_edge(sand: jax.Array) -> jax.Array:
    """The distance of each cell to the edge in cells, along rows or columns that hold sand all the way."""
    away = jnp.full_like(sand, sum(sand.shape))
    for axis in (0, 1):
        for way in (sand, jnp.flip(sand, axis)):
            cells = jnp.where(jnp.cumprod(way, axis) > 0, jnp.cumsum(jnp.ones_like(way), axis) - 0.5, sum(sand.shape))
            away = jnp.minimum(away, cells if way is sand else jnp.flip(cells, axis))
    return away


def nothing_beyond(reach: jax.Array) -> tuple[jax.Array, jax.Array]:
    """The `Holds` of a closed edge: nothing runs off."""
    return jnp.zeros_like(reach), jnp.zeros_like(reach)
