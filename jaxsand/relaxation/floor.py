"""Sand over a floor: no cell gives more than it holds.

In a sweep cell i gives the sum O_i of the fluxes that leave it. If it holds less, T_i, every one of them is multiplied by
T_i / O_i. So the sand never comes to lie below the floor, and since what a link moves is still one number, volume is kept.
"""

from collections.abc import Sequence

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxsand.relaxation.flux import Fluxes, ends, of_cells
from jaxsand.relaxation.ghost_cells import halo, stored, truncate
from jaxsand.scene.grid import Neighbours, links

_LESS = 1 - 2.0**-20  # so that the rounded products of shares and fluxes never sum to more than there is


def held(height: Float[Array, "H W ..."], base: Float[Array, "H W ..."], quantum: Float[Array, "..."]) -> jax.Array:
    """The whole quanta of sand that each cell can give, 0 where there is no sand; up to two less than there are."""
    return jnp.where(height > base, jnp.maximum(truncate((height - base) / quantum - 1), 0), 0)


def no_more_than(neighbours: Neighbours, there: Float[Array, "H W ..."], moved: Sequence[jax.Array]) -> Fluxes:
    """The fluxes over links, and over a rim if there are, reduced so that none of the cells gives more than is `there`.

    All are whole quanta; fluxes over links are positive towards the link's first cell.
    """
    moved = stored(moved)
    given = sum(moved[len(links(neighbours)) :], jnp.zeros_like(there))
    for first, second in of_cells(neighbours, moved):
        given = given + (jnp.where(second > 0, second, 0) - jnp.where(first < 0, first, 0))
    short = given > there
    share = jnp.where(short, there / jnp.where(short, given, 1) * _LESS, 1)
    shares, out = halo(share, 1.0), []
    for (di, dj, _), f in zip(links(neighbours), moved, strict=False):
        here, beyond = ends(shares, di, dj)
        out.append(truncate(f * jnp.where(f > 0, beyond, here)))
    return (*out, *(truncate(f * share) for f in moved[len(out) :]))
