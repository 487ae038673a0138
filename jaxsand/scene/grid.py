"""The grid: where the cells lie and which of them are neighbours."""

import math
from dataclasses import dataclass, field
from typing import Literal

import jax
import jax.numpy as jnp

Neighbours = Literal[4, 8, "isotropic"]
Link = tuple[int, int, float]

_STRAIGHT = ((0, 1, 1.0), (1, 0, 1.0))
_DIAGONAL = ((1, 1, math.sqrt(2.0)), (1, -1, math.sqrt(2.0)))
_LINKS = {4: _STRAIGHT, 8: _STRAIGHT + _DIAGONAL, "isotropic": _STRAIGHT}


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Grid:
    """A rectangular grid of square cells, row 0 at y = 0: cell [i, j] is centred at ((j + 1/2) dx, (i + 1/2) dx)."""

    spacing: jax.Array | float  # m, []
    shape: tuple[int, int] = field(metadata={"static": True})  # rows, columns
    neighbours: Neighbours = field(default=8, metadata={"static": True})


def links(neighbours: Neighbours) -> tuple[Link, ...]:
    """Half of the links over which a cell exchanges sand: (rows, columns, length in spacings). The others are their
    negatives."""
    return _LINKS[neighbours]


def centres(grid: Grid, dtype: jax.typing.DTypeLike) -> tuple[jax.Array, jax.Array]:
    """Cell centres in m: x [1, W] and y [H, 1], to be broadcast."""
    rows, columns = grid.shape
    dx = jnp.asarray(grid.spacing, dtype)
    x = (jnp.arange(columns, dtype=dtype) + 0.5) * dx
    y = (jnp.arange(rows, dtype=dtype) + 0.5) * dx
    return x[None, :], y[:, None]
