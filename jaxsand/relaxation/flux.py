"""The flux of sand over every link that is steeper than repose: gradient steps on a convex function of the heights.

The functions, for 4 and 8 neighbours and for isotropic sand, and what follows from them: notebooks/site/theory/settling.md.
Fluxes are kept as one map for each direction of links, so that cell j loses the very number that cell i gains. Links to the
edge count too: the maps are [H, W + 1] along x, [H + 1, W] along y, and [H + 1, W + 1] on diagonals.
"""

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from jaxsand.relaxation.ghost_cells import Bed, Rim, at, grain, halo
from jaxsand.scene.grid import Link, Neighbours, links

Fluxes = tuple[jax.Array, ...]
THIN = 1e-4  # spacings: sand on a floor that is thinner counts as none
NARROW = 0.05  # the smallest open share that is divided by: a cell still less open counts as if it were as open as this


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class WholeCells:
    """No tool stands in the sand, and every cell is whole."""


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class ToolInSand:
    """A tool that stands in the sand; see `tool_in_sand`.

    Where a cell of mean height h above the tool's bottom b is partly covered, its sand stands in the open share, at the
    height h + stretch (h - b) with stretch = cover / open. A link is as open as the less open of its two cells, which keeps
    a sweep stable for any footprint.

    Attributes:
        open: the open share of each cell, with ghost cells.
        stretch: how much higher sand stands for the tool; less than cover / open where the open share is below `NARROW`.
        bottom: height of the tool's bottom (m).
    """

    open: Float[Array, "H+2 W+2"]
    stretch: Float[Array, "H W"]
    bottom: Float[Array, ""]

    def surface(self, height: Float[Array, "H W"]) -> Float[Array, "H W"]:
        """The height at which the sand of each cell stands in its open share (m)."""
        return height + self.stretch * jnp.where(height > self.bottom, height - self.bottom, 0)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class PartialCells:
    """Cells of which only the share `open` can hold sand; maps then hold volume per cell area."""

    open: Float[Array, "H+2 W+2"]

    def surface(self, volume: Float[Array, "H W"]) -> Float[Array, "H W"]:
        """The height at which the sand of each cell stands in its open share (m)."""
        share = at(self.open)
        return volume / jnp.where(share > 0, share, 1)


Cells = WholeCells | PartialCells


def tool_in_sand(cover: Float[Array, "H W"], bottom: Float[Array, ""]) -> ToolInSand:
    """A tool with its bottom at height `bottom` (m) whose footprint is `cover`, the share of each cell that it covers."""
    free = 1 - cover
    return ToolInSand(halo(free, 0.0), cover / jnp.maximum(free, NARROW), bottom)


def fluxes(bed: Bed, cells: Cells, u: Float[Array, "H+2 W+2"]) -> Fluxes:
    """The flux over every link of a map with ghost cells at rate 1 (m), positive towards the link's first cell.

    The map holds heights or, in `PartialCells`, volumes per cell area. Where the edge drains, a last map [H, W] holds what
    each cell loses over the rim.
    """
    s, gate = (u, None) if isinstance(cells, WholeCells) else (halo(cells.surface(at(u))), cells.open)
    return flows(bed, gate, s)


def flows(bed: Bed, gate: Float[Array, "H+2 W+2"] | None, s: Float[Array, "H+2 W+2"]) -> Fluxes:
    """`fluxes` of the surface `s` (m); `gate` is the open share of each cell, None where all are whole."""
    flow = _isotropic(bed, gate, s) if bed.neighbours == "isotropic" else _pairwise(bed, gate, s)
    if bed.rim is not None:
        out = _over(bed, bed.rim, at(s)) * _draining_sides(bed.rim)
        flow = (*flow, out if gate is None else out * at(gate))
    return flow


def gained(bed: Bed, flow: Fluxes) -> Float[Array, "H W"]:
    """What each cell gains from the fluxes over its links, less what it loses over the rim."""
    net = received(bed.neighbours, flow)
    return net if bed.rim is None else net - flow[-1]


def received(neighbours: Neighbours, flow: Fluxes) -> Float[Array, "H W ..."]:
    """What each cell receives over its links, less what it gives."""
    net = jnp.zeros((), flow[0].dtype)
    for first, second in of_cells(neighbours, flow):
        net = net + (first - second)
    return net


def of_cells(neighbours: Neighbours, flow: Sequence[jax.Array]) -> Iterator[tuple[jax.Array, jax.Array]]:
    """Yields, for each direction, two maps [H, W]: the flux over the link in which the cell comes first, and over the one in
    which it comes second.
    """
    for (di, dj, _), f in zip(links(neighbours), flow, strict=False):
        rows, columns = f.shape[:2]
        first, second = f[:, max(dj, 0) : columns + min(dj, 0)], f[:, max(-dj, 0) : columns - max(dj, 0)]
        yield first[di:], second[: rows - di]


def fluxes_zero(bed: Bed, u: Float[Array, "H+2 W+2"]) -> Fluxes:
    """Fluxes of 0 for a map with ghost cells."""
    maps = [jnp.zeros_like(ends(u, di, dj)[0]) for di, dj, _ in links(bed.neighbours)]
    return (*maps, jnp.zeros_like(at(u))) if bed.rim is not None else tuple(maps)


def worst_excess(bed: Bed, u: Float[Array, "H+2 W+2"], cells: Cells | None = None) -> Float[Array, ""]:
    """The largest slope in excess of repose (a tangent) of a map with ghost cells; 0 where none exceeds it.

    In partial cells an excess counts only as far as it drives sand, so that it is 0 where nothing flows.
    """
    gate = None
    if isinstance(cells, PartialCells):
        u, gate = halo(cells.surface(at(u))), cells.open
    worst = _highest(_excesses(bed, gate, u))
    if bed.rim is not None:
        drains = _draining_sides(bed.rim) > 0
        if bed.base is not None:
            drains = drains & (at(_wet(bed, u)) > 0)
        worst = jnp.maximum(worst, jnp.max(jnp.where(drains, 2 * _over(bed, bed.rim, at(u)), 0)))
    return worst / bed.spacing


def middle(bed: Bed, u: Float[Array, "H+2 W+2"], tolerance: Float[Array, ""]) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Row and column of the middle of the box around all slopes that exceed repose by more than the tolerance (a tangent).

    They are in cells from the map's corner, so that cell (i, j) spans i to i + 1 and j to j + 1.
    """
    moving: Any = False
    for e in _excesses(bed, None, u):
        moving = moving | (e > tolerance * bed.spacing)
    bounds = []
    for axis in (1, 0):
        n = moving.shape[1 - axis]
        busy = jnp.any(moving, axis=axis)
        first, last = jnp.min(jnp.where(busy, jnp.arange(n), n)), jnp.max(jnp.where(busy, jnp.arange(n), 0))
        bounds.append((first + last + 1).astype(u.dtype) / 2)
    return bounds[0], bounds[1]


def steepest(bed: Bed, u: Float[Array, "H+2 W+2"]) -> Float[Array, ""]:
    """The steepest slope (a tangent) of a map's sand, as the bed's neighbourhood measures slopes; not of bare floor."""
    return _highest(slope for slope, _ in _slopes(bed, u)) / bed.spacing


def _highest(maps: Iterable[jax.Array]) -> jax.Array:
    """The largest value in any of the maps, at least 0; NaN marks a missing link and is ignored."""
    worst: jax.Array | float = 0.0
    for e in maps:
        worst = jnp.where(e > worst, e, worst)
    return jnp.max(jnp.max(worst, axis=0))  # rows first: XLA vectorises that


def ends(u: Float[Array, "H+2 W+2 ..."], di: int, dj: int) -> tuple[Float[Array, "..."], Float[Array, "..."]]:
    """The values in the first and in the second cell of every link of a map with ghost cells.

    The second cell lies di rows and dj columns from the first; both maps have the shape of the fluxes in that direction.
    """
    if di == 0:
        return u[1:-1, :-1], u[1:-1, 1:]
    if dj == 0:
        return u[:-1, 1:-1], u[1:, 1:-1]
    return (u[:-1, :-1], u[1:, 1:]) if dj > 0 else (u[:-1, 1:], u[1:, :-1])


def _pairwise(bed: Bed, gate: jax.Array | None, s: jax.Array) -> Fluxes:
    return tuple(link_flux(bed, gate, s, link) for link in links(bed.neighbours))


def link_flux(bed: Bed, gate: jax.Array | None, s: jax.Array, link: Link) -> jax.Array:
    """The flux excess / l over every link in one direction (m)."""
    di, dj, length = link
    here, there = ends(s, di, dj)
    d, m = there - here, _yield(bed, link)
    e = jnp.where(d > m, d - m, 0) + jnp.where(d < -m, d + m, 0)
    if length != 1:
        e = e * (1 / length)
    return e if gate is None else e * jnp.minimum(*ends(gate, di, dj))


def _slopes(bed: Bed, u: jax.Array) -> Iterator[tuple[jax.Array, jax.Array]]:
    """Slopes [H, W] and the largest stable ones, both times the spacing (m); for each direction of links, or gradient."""
    if bed.neighbours != "isotropic":
        wet = None if bed.base is None else _wet(bed, u)
        for link in links(bed.neighbours):
            di, dj, length = link
            level = bed.drop
            if level.ndim:
                level = (level + at(halo(level, 0.0), di, dj)) / 2
            d = at(u, di, dj) - at(u)
            if wet is not None:
                d = jnp.where(d > 0, at(wet, di, dj), at(wet)) * d
            yield jnp.abs(d) * (1 / length), level
        return
    x, y = _steps(bed, u)
    for gx, gy, m in _gradients(bed, x / bed.spacing, y / bed.spacing):
        yield jnp.sqrt(gx * gx + gy * gy) * bed.spacing, m * bed.spacing


def _excesses(bed: Bed, gate: jax.Array | None, u: jax.Array) -> Iterator[jax.Array]:
    """Slopes less the largest stable ones, times the spacing (m); in partial cells no more than the flux that they drive."""
    if gate is None:
        yield from (slope - level for slope, level in _slopes(bed, u))
    elif bed.neighbours != "isotropic":
        for (slope, level), (di, dj, _) in zip(_slopes(bed, u), links(bed.neighbours), strict=True):
            yield (slope - level) * jnp.minimum(at(gate), at(gate, di, dj))
    else:
        x, y = _steps(bed, u)
        for (gx, gy, m), (ox, oy) in zip(_gradients(bed, x / bed.spacing, y / bed.spacing), _arms(gate), strict=True):
            along_x = jnp.abs(gx) * ox * share_beyond(gx * gx + oy * gy * gy, m)
            along_y = jnp.abs(gy) * oy * share_beyond(ox * gx * gx + gy * gy, m)
            e = jnp.sqrt(gx * gx + gy * gy) - m  # in whole cells at most sqrt(2) times the larger
            yield jnp.minimum(e, math.sqrt(2) * jnp.maximum(along_x, along_y)) * bed.spacing


def _arms(gate: jax.Array) -> list[tuple[jax.Array, jax.Array]]:
    """The open shares [H, W] of the two links of each of the four gradients, in the order of `_gradients`."""
    x, y = (jnp.minimum(*ends(gate, di, dj)) for di, dj, _ in links(4))
    return [(_west_east(x)[i], _south_north(y)[j]) for i in (0, 1) for j in (0, 1)]


def _isotropic(bed: Bed, gate: jax.Array | None, s: jax.Array) -> Fluxes:
    """The fluxes of isotropic sand over the straight links."""
    x, y = _steps(bed, s)
    weights = []
    if gate is None:
        for gx, gy, m in _gradients(bed, x / bed.spacing, y / bed.spacing):
            w = share_beyond(gx * gx + gy * gy, m)
            weights.append((w, w))
        opening = None
    else:  # in the gradient of one link the other link counts as far as it is open
        opening = tuple(jnp.minimum(*ends(gate, di, dj)) for di, dj, _ in links(4))
        for (gx, gy, m), (ox, oy) in zip(_gradients(bed, x / bed.spacing, y / bed.spacing), _arms(gate), strict=True):
            weights.append((share_beyond(gx * gx + oy * gy * gy, m), share_beyond(ox * gx * gx + gy * gy, m)))
    # In the order of `_gradients`: in the gradient west-north, `wn` weights the west link and `nw` the north one.
    (ws, sw), (wn, nw), (es, se), (en, ne) = weights
    west, east, south, north = lax.optimization_barrier((ws + wn, es + en, sw + se, nw + ne))
    column, row = jnp.zeros_like(west[:, :1]), jnp.zeros_like(west[:1])
    over_x = x * ((lax.concatenate([column, east], 1) + lax.concatenate([west, column], 1)) / 4)
    over_y = y * ((lax.concatenate([row, north], 0) + lax.concatenate([south, row], 0)) / 4)
    return (over_x, over_y) if opening is None else (over_x * opening[0], over_y * opening[1])


def share_beyond(square: jax.Array, m: jax.Array) -> jax.Array:
    """The share of a vector g that lies beyond the length m, max(1 - m / |g|, 0) for |g|^2 = square.

    A compiler may compute `square` anew for each use and round it differently. So where one use says that it is above m^2
    and another that it is not, the share must still be about 0: the length that is divided by is never below m.
    """
    least = m * m
    short = jnp.where(least > 0, least, 1)  # not 0: a derivative divides by it, and what comes out must be finite
    size = jnp.sqrt(jnp.where(square > least, square, short))
    return jnp.where(square > least, 1 - m / size, 0)


def _wet(bed: Bed, u: jax.Array) -> jax.Array:
    """1 in the cells of a map with ghost cells that hold sand on the floor, else 0; it is not called without one.

    Slopes count only where their upper end holds sand.
    """
    assert bed.base is not None
    thin = jnp.maximum(THIN * bed.spacing, 8 * grain(bed, u))
    return halo(jnp.where(at(u) - bed.base > thin, 1.0, 0.0).astype(u.dtype), 0.0)


def _steps(bed: Bed, u: jax.Array) -> tuple[jax.Array, jax.Array]:
    """The steps over the links along x [H, W + 1] and y [H + 1, W] (m); 0 where one end holds no sand.

    A link whose upper end is bare floor carries none, as if a wall stood there.
    """
    steps, wet = [], None if bed.base is None else _wet(bed, u)
    for di, dj, _ in links(4):
        here, there = ends(u, di, dj)
        d = there - here
        if wet is not None:
            low, high = ends(wet, di, dj)
            d = jnp.where(d > 0, high, low) * d
        steps.append(jnp.where(jnp.isnan(d), 0, d))
    return steps[0], steps[1]


def _west_east(x: jax.Array) -> tuple[jax.Array, jax.Array]:
    """What the map x [H, W + 1] of links holds for the link to the west and for that to the east of each cell, [H, W]."""
    return x[:, :-1], x[:, 1:]


def _south_north(y: jax.Array) -> tuple[jax.Array, jax.Array]:
    """What the map y [H + 1, W] of links holds for the link to the south and for that to the north of each cell, [H, W]."""
    return y[:-1], y[1:]


def _gradients(bed: Bed, x: jax.Array, y: jax.Array) -> Iterator[tuple[jax.Array, jax.Array, jax.Array]]:
    """The four one-sided gradients (gx, gy) of every cell and the largest stable length of each, as maps [H, W] of tangents.

    Their order is west-south, west-north, east-south, east-north. x and y are the slopes over the links, with the shapes of
    `_steps`.
    """
    mu = bed.drop / bed.spacing
    if mu.ndim:
        hx, hy = (jnp.add(*ends(halo(mu), di, dj)) / 2 for di, dj, _ in links(4))
    for i in (0, 1):
        for j in (0, 1):
            if mu.ndim:  # the mean of its two links, or the one there is
                mx, my = _west_east(hx)[i], _south_north(hy)[j]
                m = (jnp.where(jnp.isnan(mx), my, mx) + jnp.where(jnp.isnan(my), mx, my)) / 2
                m = jnp.where(jnp.isnan(m), 1, m)  # neither: no sand slides, whatever it is
            else:
                m = mu
            yield _west_east(x)[i], _south_north(y)[j], m


def _yield(bed: Bed, link: Link) -> jax.Array:
    """The largest stable step over every link in one direction (m)."""
    di, dj, length = link
    if not bed.drop.ndim:
        return bed.drop * length
    here, there = ends(halo(bed.drop, 0.0), di, dj)
    return (here + there) * (length / 2)


def _draining_sides(rim: Rim) -> jax.Array:
    """The number of sides over which each cell drains, 0 to 4."""
    beyond = rim.beyond
    return at(beyond, 1, 0) + at(beyond, -1, 0) + at(beyond, 0, 1) + at(beyond, 0, -1)


def _over(bed: Bed, rim: Rim, h: jax.Array) -> jax.Array:
    """The height in excess of repose against the rim, which is half a spacing away (m)."""
    top = rim.level + bed.drop / 2
    return jnp.where(h > top, h - top, 0)
