"""Steps, neighbours and ghost cells of maps [m, n] or [m, n, B], as linear functions whose transposes are written out.

JAX transposes a slice into a pad, which XLA computes many times slower on a CPU than the concatenation used here. The
functions differentiate in both modes. They cannot be vmapped: the last axis is the batch.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
from jax import lax
from jax.custom_derivatives import linear_call
from jaxtyping import Array, Float

from jaxsand.relaxation.flux import Fluxes, ends, received
from jaxsand.relaxation.ghost_cells import at, halo
from jaxsand.scene.grid import Neighbours, links

Map = Float[Array, "m n ..."]  # a map, or one for each map of a batch in the last axis
Ghosted = Float[Array, "m+2 n+2 ..."]  # with ghost cells
X = TypeVar("X")
Y = TypeVar("Y")
_SMALL = 24  # rows up to which a sum is written out


def _linear(forth: Callable[[X], Y], back: Callable[[Y], X], x: X) -> Y:
    """The linear function `forth` of x, whose transpose is `back`."""
    return linear_call(lambda _, x: forth(x), lambda _, y: back(y), (), x)


def steps(neighbours: Neighbours, s: Map) -> Fluxes:
    """The step over every link, from its first cell to its second; the height beyond the map is 0."""
    return _linear(partial(_steps, neighbours), lambda y: -received(neighbours, y), s)


def rises(neighbours: Neighbours, u: Ghosted) -> Fluxes:
    """The step over every link of a map with ghost cells, which get no cotangents."""
    return _linear(partial(_rises, neighbours), lambda y: halo(-received(neighbours, y), 0.0), u)


def net(neighbours: Neighbours, flux: Fluxes) -> Map:
    """What each cell receives over its links, less what it gives; fluxes are positive towards a link's first cell."""
    return _linear(lambda f: received(neighbours, f), lambda y: tuple(-d for d in _steps(neighbours, y)), tuple(flux))


def seen(u: Ghosted, di: int, dj: int) -> Map:
    """The value di rows and dj columns further, at most one, for each inner cell of a map with ghost cells."""
    return _linear(lambda u: at(u, di, dj), lambda y: _placed(y, (1 + di, 1 - di), (1 + dj, 1 - dj)), u)


def inner(u: Ghosted) -> Map:
    """A map without its ghost cells."""
    return _linear(at, lambda y: halo(y, 0.0), u)


def outer(x: Map) -> Ghosted:
    """A map with ghost cells of 0."""
    return _linear(lambda x: halo(x, 0.0), at, x)


def window(x: Map, row: int, column: int, rows: int, columns: int) -> Float[Array, "rows columns ..."]:
    """The part of a map of `rows` x `columns` cells that begins at (row, column)."""
    if (rows, columns) == x.shape[:2]:
        return x

    def back(y: jax.Array) -> jax.Array:
        nothing = jnp.zeros((*x.shape[:2], *y.shape[2:]), y.dtype)
        return lax.dynamic_update_slice(nothing, y, (row, column, *(0,) * (y.ndim - 2)))

    return _linear(lambda x: x[row : row + rows, column : column + columns], back, x)


def put(whole: Map, x: Float[Array, "rows columns ..."], first: int) -> Map:
    """A map with the part x written into it, `first` rows and columns from its first cell."""
    if x.shape == whole.shape:
        return x
    return lax.dynamic_update_slice(whole, x, (first, first, *(0,) * (x.ndim - 2)))


def both_ends(neighbours: Neighbours, u: Ghosted) -> tuple[tuple[jax.Array, jax.Array], ...]:
    """The values in the first and the second cell of every link of a map with ghost cells."""
    return _linear(partial(_both_ends, neighbours), partial(_from_both_ends, neighbours), u)


def spread(x: Float[Array, "..."], like: Map) -> Map:
    """A value for each map, [] or [B], repeated in every cell of maps shaped `like`; its transpose is `total`."""
    return _linear(lambda x: jnp.broadcast_to(x, like.shape), total, jnp.broadcast_to(x, like.shape[2:]))


def total(y: Map) -> Float[Array, "..."]:
    """The sum over the cells of each map.

    For small maps it is written out: XLA computes other sums by calls of a library, which cost more than the sum.
    """
    if y.ndim == 2 or y.shape[0] > _SMALL:
        return jnp.sum(y, axis=(0, 1))
    rows = sum(y[i] for i in range(1, y.shape[0])) + y[0]
    return sum(rows[j] for j in range(1, rows.shape[0])) + rows[0]


def _steps(neighbours: Neighbours, s: jax.Array) -> Fluxes:
    return _rises(neighbours, halo(s, 0.0))


def _rises(neighbours: Neighbours, u: jax.Array) -> Fluxes:
    return tuple(there - here for here, there in _both_ends(neighbours, u))


def _both_ends(neighbours: Neighbours, u: jax.Array) -> tuple[tuple[jax.Array, jax.Array], ...]:
    return tuple(ends(u, di, dj) for di, dj, _ in links(neighbours))


def _from_both_ends(neighbours: Neighbours, y: tuple[tuple[jax.Array, jax.Array], ...]) -> jax.Array:
    total: Any = 0.0
    for (di, dj, _), (here, there) in zip(links(neighbours), y, strict=True):
        if di == 0:
            total = total + _placed(here, (1, 1), (0, 1)) + _placed(there, (1, 1), (1, 0))
        elif dj == 0:
            total = total + _placed(here, (0, 1), (1, 1)) + _placed(there, (1, 0), (1, 1))
        elif dj > 0:
            total = total + _placed(here, (0, 1), (0, 1)) + _placed(there, (1, 0), (1, 0))
        else:
            total = total + _placed(here, (0, 1), (1, 0)) + _placed(there, (1, 0), (0, 1))
    return total


def _placed(x: jax.Array, rows: tuple[int, int], columns: tuple[int, int]) -> jax.Array:
    """The map with rows and columns of zeros around it: numbers (before, after) of each."""
    top, bottom = (jnp.zeros((n, *x.shape[1:]), x.dtype) for n in rows)
    x = lax.concatenate([top, x, bottom], 0)
    left, right = (jnp.zeros((x.shape[0], n, *x.shape[2:]), x.dtype) for n in columns)
    return lax.optimization_barrier(lax.concatenate([left, x, right], 1))
