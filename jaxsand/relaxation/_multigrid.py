"""Multigrid settling; see `Multilevel`.

On every grid a map holds volume per cell area, in whole quanta, so that volume is exact. Where the number of rows or columns
is odd, the last coarse cells contain sand in a part of their area only (`PartialCells`).
"""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from jaxsand.relaxation._integrate import still, sweep_loop
from jaxsand.relaxation.flux import Cells, PartialCells, WholeCells
from jaxsand.relaxation.ghost_cells import Bed, at, grain, halo, nothing_lost, rim_of, truncate
from jaxsand.relaxation.schemes import Multilevel, schedule
from jaxsand.relaxation.sweep import Limits, Swept


def descend(
    bed: Bed,
    cells: Cells,
    scheme: Multilevel,
    limit: float,
    tolerance: jax.Array,
    bound: int,
    interval: int,
    sand: Swept,
    level: int = 0,
) -> tuple[Swept, jax.Array]:
    """Settles on this grid and the coarser ones.

    Returns the sand, and the number of sweeps, where four of the next coarser grid count as one of this.
    """
    rows, columns = (n - 2 for n in sand.height.shape)
    early = schedule(scheme.steps(), limit, bound, interval, scheme.handover / 4 if level else 0.0)
    narrow = max(rows, columns) if 1 in (rows, columns) else min(rows, columns)
    if narrow < 2 * scheme.coarsest:
        return sweep_loop(bed, cells, early, tolerance, interval).run(bound // interval, sand)
    # Up to the first group past the handover that ends with the end of a step.
    ends = early.starts[(early.times >= scheme.handover) & (early.starts % interval == 0)]
    groups = int(ends[0]) // interval if ends.size else bound // interval
    sand, taken = sweep_loop(bed, cells, early, tolerance, interval).run(groups, sand)

    cut = grain(bed, sand.height)
    wide_bed, wide_cells, wide = _widen(bed, cells, cut, at(sand.height))
    begun = Swept(halo(wide), nothing_lost(wide_bed, wide))
    # To half the tolerance, or rounding on the finer grid would set the sand in motion everywhere.
    stiller = tolerance if level else tolerance / 2
    ended, more = descend(wide_bed, wide_cells, scheme, limit, stiller, bound, interval, begun, level + 1)
    early_end = still(bed, cells, Limits(tolerance, 2 / (scheme.safety * limit * bed.spacing)), sand.height)
    change = jnp.where(jnp.isnan(wide) | early_end, 0, at(ended.height) - wide)
    height, lost = halo(at(sand.height) + _spread(cells, cut, change, at(sand.height))), sand.lost
    if lost is not None and ended.lost is not None:
        lost = jax.tree.map(lambda g, x: g.at[::2, ::2].add(jnp.where(early_end, 0, 4 * x)), lost, ended.lost)
    late = schedule(scheme.steps(), limit, bound, interval, 0.0)
    sand, again = sweep_loop(bed, cells, late, tolerance, interval).run(bound // interval, Swept(height, lost))
    return sand, taken + again + jnp.where(early_end, 0, (more + 3) // 4)


def _widen(bed: Bed, cells: Cells, cut: jax.Array, volume: jax.Array) -> tuple[Bed, Cells, jax.Array]:
    """The bed, the cells and the volume [H/2, W/2] of the next coarser grid."""
    wide = _sum(_quarters(volume)) / 4  # NaN where any of the four is: no sand passes through a wall
    wide_cells: Cells = cells
    if isinstance(cells, PartialCells):
        wide_cells = PartialCells(halo(_sum(_quarters(at(cells.open))) / 4, 0.0))
    wide = truncate(wide / cut) * cut
    drop = bed.drop * 2
    if bed.drop.ndim:
        rows, columns = bed.drop.shape
        drop = _sum(_quarters(jnp.pad(bed.drop, ((0, rows % 2), (0, columns % 2)), mode="edge"))) / 2
    rim = None if bed.rim is None else rim_of(wide.shape, bed.rim.level)
    return replace(bed, spacing=bed.spacing * 2, drop=drop, rim=rim), wide_cells, wide


def _sum(parts: list[jax.Array]) -> jax.Array:
    return parts[0] + parts[1] + parts[2] + parts[3]


def _quarters(x: jax.Array) -> list[jax.Array]:
    """The four cells of each coarse cell, as four maps; 0 beyond an odd edge."""
    x = jnp.pad(x, ((0, x.shape[0] % 2), (0, x.shape[1] % 2)))
    return [x[i::2, j::2] for i in (0, 1) for j in (0, 1)]


def _inject(x: jax.Array, shape: tuple[int, ...]) -> jax.Array:
    """Every coarse cell's value in its four fine cells."""
    return jnp.repeat(jnp.repeat(x, 2, 0), 2, 1)[: shape[0], : shape[1]]


def _spread(cells: Cells, cut: jax.Array, change: jax.Array, volume: jax.Array) -> jax.Array:
    """A change on the coarse grid, interpolated to the fine grid; in whole quanta, and with the same volume.

    Linear where cells are whole; constant in each coarse cell elsewhere.
    """
    rows, columns = volume.shape
    whole_cell = ~jnp.isnan(volume)
    if isinstance(cells, WholeCells):
        fine = _inject(change, volume.shape)
    else:
        parts = _quarters(at(cells.open))
        total = _sum(parts)
        given = [truncate(4 * change * (p / total) / cut) * cut for p in parts]
        rest, found = 4 * change - _sum(given), jnp.zeros(total.shape, bool)
        fullest = jnp.max(jnp.stack(parts), axis=0)
        for k, p in enumerate(parts):  # what rounding left over goes to the first of the fullest
            chosen = (p == fullest) & ~found
            given[k] = given[k] + jnp.where(chosen, rest, 0)
            found = found | chosen
        fine = jnp.zeros((2 * total.shape[0], 2 * total.shape[1]), change.dtype)
        for k, g in enumerate(given):
            fine = fine.at[k // 2 :: 2, k % 2 :: 2].set(g)
        fine, whole_cell = fine[:rows, :columns], whole_cell & (at(cells.open) == 1)
    for axis in (0, 1):  # pairs across a coarse cell's border exchange a quarter of their difference
        a, b = (lax.slice_in_dim(fine, i, fine.shape[axis] - 1 + i, axis=axis) for i in (0, 1))
        ok = lax.slice_in_dim(whole_cell, 0, fine.shape[axis] - 1, axis=axis)
        ok = ok & lax.slice_in_dim(whole_cell, 1, fine.shape[axis], axis=axis)
        odd = np.arange(fine.shape[axis] - 1) % 2 == 1
        over = jnp.where(ok & (odd[:, None] if axis == 0 else odd[None, :]), truncate((b - a) / (4 * cut)) * cut, 0)
        nothing = jnp.zeros_like(lax.slice_in_dim(fine, 0, 1, axis=axis))
        fine = fine + lax.concatenate([over, nothing], axis) - lax.concatenate([nothing, over], axis)
    return fine


def start(scheme: Multilevel, marked: jax.Array) -> Cells:
    """The cells of the finest grid, whole if each cell of every grid consists of four finer ones."""
    rows, columns = marked.shape
    odd = 1 in marked.shape
    while min(rows, columns) >= 2 * scheme.coarsest:
        odd = odd or rows % 2 == 1 or columns % 2 == 1
        rows, columns = rows // 2, columns // 2
    return PartialCells(halo(jnp.ones_like(marked), 0.0)) if odd else WholeCells()
