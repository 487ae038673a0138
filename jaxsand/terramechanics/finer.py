"""A scene and its maps on a finer grid, and back.

Neighbourhoods of 4 and 8 have an error that no refinement takes away: a pile grown at a point is x1.162 and x1.036 as high
as the cone. Only isotropic sand converges to it (flux.py), to first order in the spacing.
"""

from dataclasses import dataclass, replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxsand.scene.boundaries import Walls
from jaxsand.scene.grid import Grid
from jaxsand.scene.scene import Scene
from jaxsand.scene.window import Window


@dataclass(frozen=True)
class TwoGrids:
    """The grid's error is told from what isotropic sand does on the scene's grid and on one three times as fine."""


@dataclass(frozen=True)
class OneGrid:
    """The grid's error stays unknown: the verdict says so, and only the noise's part of the error bars is a number."""


def isotropic(scene: Scene) -> Scene:
    """The scene with isotropic sand."""
    return replace(scene, grid=replace(scene.grid, neighbours="isotropic"))


def finer(scene: Scene, times: int) -> Scene:
    """The scene on a grid so many times as fine, with the angle of repose of every cell, and solid where it is."""
    rows, columns = scene.grid.shape
    grid = Grid(scene.grid.spacing / times, (times * rows, times * columns), scene.grid.neighbours)
    material, walls, window = scene.material, scene.walls, scene.window
    if np.ndim(material.repose_angle):
        material = replace(material, repose_angle=divide(material.repose_angle, times))
    if isinstance(walls, Walls):
        walls = Walls(divide(walls.solid, times))
    if isinstance(window, Window):
        window = Window((times * window.size[0], times * window.size[1]), window.tolerance * times)
    return replace(scene, grid=grid, material=material, walls=walls, window=window)


def divide(cells: Any, times: int) -> jax.Array:
    """A map [H, W] with every cell divided into times^2: [times H, times W]."""
    return jnp.repeat(jnp.repeat(jnp.asarray(cells), times, axis=0), times, axis=1)


def resolve(scene: Scene, height: jax.Array, times: int) -> jax.Array:
    """A map [H, W] of the scene as means over the cells of a grid so many times as fine, [times H, times W].

    Each cell is a plane through its mean, along x and along y with the lesser of the differences to both sides, level where
    these have different signs (van Leer 1979, doi:10.1016/0021-9991(79)90145-1, with minmod): means are kept, steps stay
    sharp, and a flank at repose is no staircase. Next to solid cells and to the edge a cell is level.
    """
    rows, columns = height.shape
    sand = jnp.where(scene.walls.solid, jnp.nan, height) if isinstance(scene.walls, Walls) else height
    off = jnp.asarray((np.arange(times) + 0.5) / times - 0.5, height.dtype)
    along_y = divide(_slope(sand, 0), times) * jnp.tile(off, rows)[:, None]
    along_x = divide(_slope(sand, 1), times) * jnp.tile(off, columns)[None, :]
    return divide(height, times) + along_y + along_x


def _slope(height: jax.Array, axis: int) -> jax.Array:
    """The lesser of the differences to both sides, where they agree in sign."""
    first, last = jnp.take(height, jnp.asarray([0]), axis), jnp.take(height, jnp.asarray([-1]), axis)
    back, ahead = jnp.diff(height, axis=axis, prepend=first), jnp.diff(height, axis=axis, append=last)
    return jnp.where(back * ahead > 0, jnp.where(jnp.abs(back) < jnp.abs(ahead), back, ahead), 0)


def means(height: jax.Array, shape: tuple[int, ...]) -> jax.Array:
    """The means of maps [..., k H, k W] over the cells of a grid of `shape` (H, W)."""
    rows, columns = shape
    parts = height.reshape(*height.shape[:-2], rows, height.shape[-2] // rows, columns, height.shape[-1] // columns)
    return parts.mean((-3, -1))
