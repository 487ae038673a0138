"""Sand over a floor: no cell gives more than it holds.

In a sweep cell i gives the sum O_i of the fluxes that leave it. If it holds less, T_i, every one of them is multiplied by
T_i / O_i. So the sand never comes to lie below the floor, and since what a link moves is still one number, volume is kept.
"""

from collections.abc import Sequence
from itertools import accumulate

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from jaxsand.relaxation.flux import Fluxes, ends
from jaxsand.relaxation.ghost_cells import halo, truncate
from jaxsand.scene.grid import Neighbours, links

_LESS = 1 - 2.0**-20  # so that the rounded products of shares and fluxes never sum to more than there is


def held(height: Float[Array, "H W ..."], base: Float[Array, "H W ..."], quantum: Float[Array, "..."]) -> jax.Array:
    """The whole quanta of sand that each cell can give, 0 where there is no sand; up to two less than there are."""
    return jnp.where(height > base, jnp.maximum(truncate((height - base) / quantum - 1), 0), 0)


def no_more_than(neighbours: Neighbours, there: Float[Array, "H W ..."], moved: Sequence[jax.Array]) -> Fluxes:
    """The fluxes over links, and over a rim if there are, reduced so that none of the cells gives more than is `there`.

    All are whole quanta; fluxes over links are positive towards the link's first cell.
    """
    moved = _stored(moved)
    given = sum(moved[len(links(neighbours)) :], jnp.zeros_like(there))
    for (di, dj, _), f in zip(links(neighbours), moved, strict=False):
        rows, columns = f.shape[:2]
        first, second = f[:, max(dj, 0) : columns + min(dj, 0)], f[:, max(-dj, 0) : columns - max(dj, 0)]
        first, second = first[di:], second[: rows - di]
        given = given + (jnp.where(second > 0, second, 0) - jnp.where(first < 0, first, 0))
    short = given > there
    share = jnp.where(short, there / jnp.where(short, given, 1) * _LESS, 1)
    around, out = halo(share, 1.0), []
    for (di, dj, _), f in zip(links(neighbours), moved, strict=False):
        here, beyond = ends(around, di, dj)
        out.append(truncate(f * jnp.where(f > 0, beyond, here)))
    return (*out, *(truncate(f * share) for f in moved[len(out) :]))


def _stored(maps: Sequence[jax.Array]) -> list[jax.Array]:
    """The same maps, computed once and stored as one array; XLA would else compute them anew for each neighbour."""
    most = max(x.shape[1] for x in maps)

    def wide(x: jax.Array) -> jax.Array:
        return lax.concatenate([x, jnp.zeros((x.shape[0], most - x.shape[1], *x.shape[2:]), x.dtype)], 1)

    whole = lax.optimization_barrier(lax.concatenate([wide(x) for x in maps], 0))
    stops = accumulate(x.shape[0] for x in maps)
    return [whole[stop - x.shape[0] : stop, : x.shape[1]] for stop, x in zip(stops, maps, strict=True)]
