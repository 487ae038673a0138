"""The grid: where the cells lie and which of them are neighbours."""

import math
from dataclasses import dataclass, field
from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

Neighbours = Literal[4, 8, "isotropic"]
Link = tuple[int, int, float]

_STRAIGHT = ((0, 1, 1.0), (1, 0, 1.0))
_DIAGONAL = ((1, 1, math.sqrt(2.0)), (1, -1, math.sqrt(2.0)))
_LINKS = {4: _STRAIGHT, 8: _STRAIGHT + _DIAGONAL, "isotropic": _STRAIGHT}


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Grid:
    """A rectangular grid of square cells; row 0 lies at y = 0.

    Cell [i, j] is centred at x = (j + 1/2) dx, y = (i + 1/2) dx, dx the spacing. `make_scene` builds a grid and checks it.

    Attributes:
        spacing: distance dx of neighbouring cell centres (m), a scalar.
        shape: number of rows and of columns; static.
        neighbours: between which cells the angle of repose holds; static. 4: along rows and columns. 8: also along
            diagonals, sqrt(2) dx apart. "isotropic": for the length of the gradient, in whichever direction it points.

    Example:
        >>> import jaxsand as js
        >>> js.make_scene((8, 16), 0.01).grid
        Grid(spacing=0.01, shape=(8, 16), neighbours=8)
    """

    spacing: Float[Array, ""] | float
    shape: tuple[int, int] = field(metadata={"static": True})
    neighbours: Neighbours = field(default=8, metadata={"static": True})


def links(neighbours: Neighbours) -> tuple[Link, ...]:
    """The links over which a cell exchanges sand, as (rows, columns, length in spacings); one of each opposite pair."""
    return _LINKS[neighbours]


def centres(grid: Grid, dtype: jax.typing.DTypeLike) -> tuple[Float[Array, "1 W"], Float[Array, "H 1"]]:
    """The coordinates x and y of the cell centres (m), which broadcast to [H, W]."""
    rows, columns = grid.shape
    dx = jnp.asarray(grid.spacing, dtype)
    x = (jnp.arange(columns, dtype=dtype) + 0.5) * dx
    y = (jnp.arange(rows, dtype=dtype) + 0.5) * dx
    return x[None, :], y[:, None]


def places(shape: tuple[int, int], spacing: float) -> tuple[np.ndarray, np.ndarray]:
    """Where the cells of a map lie: their x and their y, each [H, W] (m), in float64 on the host; see `centres`."""
    x, y = np.meshgrid((np.arange(shape[1]) + 0.5) * spacing, (np.arange(shape[0]) + 0.5) * spacing)
    return x, y
