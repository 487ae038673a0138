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

from jaxsand.bed import at, halo
from jaxsand.flux import Fluxes, ends, received
from jaxsand.grid import Neighbours, links


def _linear(forth: Callable, back: Callable, x: Any) -> Any:
    return linear_call(lambda _, x: forth(x), lambda _, y: back(y), (), x)


def steps(neighbours: Neighbours, s: jax.Array) -> Fluxes:
    """The rise over every link, from its first cell to its second; beyond the map is height 0."""
    return _linear(partial(_steps, neighbours), lambda y: -received(neighbours, y), s)


def net(neighbours: Neighbours, flux: Fluxes) -> jax.Array:
    """What each cell receives over links, whose flux goes to the first cell, less what it gives."""
    return _linear(lambda f: received(neighbours, f), lambda y: tuple(-d for d in _steps(neighbours, y)), tuple(flux))


def neighbour(x: jax.Array, di: int, dj: int) -> jax.Array:
    """What each cell sees (di, dj) cells further, at most one; 0 beyond the map."""
    return _linear(lambda x: at(halo(x, 0.0), di, dj), lambda y: at(halo(y, 0.0), -di, -dj), x)


def sees(u: jax.Array, di: int, dj: int) -> jax.Array:
    """What each inner cell of a map with halo sees (di, dj) cells further, at most one."""
    return _linear(lambda u: at(u, di, dj), lambda y: _placed(y, (1 + di, 1 - di), (1 + dj, 1 - dj)), u)


def inner(u: jax.Array) -> jax.Array:
    """A map without its halo."""
    return _linear(at, lambda y: halo(y, 0.0), u)


def outer(x: jax.Array) -> jax.Array:
    """A map in a halo of zeros."""
    return _linear(lambda x: halo(x, 0.0), at, x)


def both_ends(neighbours: Neighbours, u: jax.Array) -> tuple[tuple[jax.Array, jax.Array], ...]:
    """The first and the second cell of every link, of a map with halo."""
    return _linear(partial(_both_ends, neighbours), partial(_from_both_ends, neighbours), u)


def spread(x: jax.Array, like: jax.Array) -> jax.Array:
    """What belongs to one map, [] or [B], in every cell of a map like that; transposed it is `total`."""
    return _linear(lambda x: jnp.broadcast_to(x, like.shape), total, jnp.broadcast_to(x, like.shape[2:]))


def total(y: jax.Array) -> jax.Array:
    """The sum over the cells of each map; as a product, since XLA sums over leading axes slowly on a CPU."""
    cells = y.reshape(-1, *y.shape[2:])
    if cells.ndim == 1:
        return jnp.sum(cells)
    return jnp.matmul(jnp.ones(cells.shape[0], y.dtype), cells, precision="highest")


def _steps(neighbours: Neighbours, s: jax.Array) -> Fluxes:
    u = halo(s, 0.0)
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
