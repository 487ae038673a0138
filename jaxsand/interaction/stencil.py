"""Neighbours on maps [m, n] or [m, n, B], as linear maps with transposes of their own.

JAX transposes a slice into a pad, which XLA computes many times slower on a CPU than the concatenation that builds a halo.
These functions differentiate in both modes; they cannot be vmapped, since a batch is the last axis here.
"""

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax
from jax.custom_derivatives import linear_call

from jaxsand.relaxation.flux import Fluxes, ends, received
from jaxsand.relaxation.ghost_cells import at, halo
from jaxsand.scene.grid import Neighbours, links

_SMALL = 24  # rows


def _linear(forth: Callable[..., Any], back: Callable[..., Any], x: Any) -> Any:
    return linear_call(lambda _, x: forth(x), lambda _, y: back(y), (), x)


def steps(neighbours: Neighbours, s: jax.Array) -> Fluxes:
    """The rise over every link, from its first cell to its second; beyond the map is height 0."""
    return _linear(partial(_steps, neighbours), lambda y: -received(neighbours, y), s)


def rises(neighbours: Neighbours, u: jax.Array) -> Fluxes:
    """`steps` of a map with halo; transposed it leaves the halo alone."""
    return _linear(partial(_rises, neighbours), lambda y: halo(-received(neighbours, y), 0.0), u)


def net(neighbours: Neighbours, flux: Fluxes) -> jax.Array:
    """What each cell receives over links, whose flux goes to the first cell, less what it gives."""
    return _linear(lambda f: received(neighbours, f), lambda y: tuple(-d for d in _steps(neighbours, y)), tuple(flux))


def seen(u: jax.Array, di: int, dj: int) -> jax.Array:
    """What each inner cell of a map with halo sees (di, dj) cells further, at most one."""
    return _linear(lambda u: at(u, di, dj), lambda y: _placed(y, (1 + di, 1 - di), (1 + dj, 1 - dj)), u)


def inner(u: jax.Array) -> jax.Array:
    """A map without its halo."""
    return _linear(at, lambda y: halo(y, 0.0), u)


def outer(x: jax.Array) -> jax.Array:
    """A map in a halo of zeros."""
    return _linear(lambda x: halo(x, 0.0), at, x)


def window(x: jax.Array, row: int, column: int, rows: int, columns: int) -> jax.Array:
    """The part of a map that begins with a row and a column."""
    if (rows, columns) == x.shape[:2]:
        return x

    def back(y: jax.Array) -> jax.Array:
        nothing = jnp.zeros((*x.shape[:2], *y.shape[2:]), y.dtype)
        return lax.dynamic_update_slice(nothing, y, (row, column, *(0,) * (y.ndim - 2)))

    return _linear(lambda x: x[row : row + rows, column : column + columns], back, x)


def put(whole: jax.Array, x: jax.Array, first: int) -> jax.Array:
    """A map with a part of it replaced that begins `first` rows and columns inside."""
    if x.shape == whole.shape:
        return x
    return lax.dynamic_update_slice(whole, x, (first, first, *(0,) * (x.ndim - 2)))


def both_ends(neighbours: Neighbours, u: jax.Array) -> tuple[tuple[jax.Array, jax.Array], ...]:
    """The first and the second cell of every link, of a map with halo."""
    return _linear(partial(_both_ends, neighbours), partial(_from_both_ends, neighbours), u)


def spread(x: jax.Array, like: jax.Array) -> jax.Array:
    """What belongs to one map, [] or [B], in every cell of a map like that; transposed it is `total`."""
    return _linear(lambda x: jnp.broadcast_to(x, like.shape), total, jnp.broadcast_to(x, like.shape[2:]))


def total(y: jax.Array) -> jax.Array:
    """The sum over the cells of each map.

    In a window it is written out: XLA hands sums and products of matrices to a library whose calls cost more than the sum.
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
    """The map with so many rows and columns of zeros before and after it."""
    top, bottom = (jnp.zeros((n, *x.shape[1:]), x.dtype) for n in rows)
    x = lax.concatenate([top, x, bottom], 0)
    left, right = (jnp.zeros((x.shape[0], n, *x.shape[2:]), x.dtype) for n in columns)
    return lax.optimization_barrier(lax.concatenate([left, x, right], 1))
