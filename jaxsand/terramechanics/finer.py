"""A scene and its maps on a finer grid, and averages back on the coarse one.

Neighbourhoods of 4 and 8 cells have an error that no refinement takes away: a pile grown at a point becomes 1.162 and 1.036
times as high as the exact cone. Only isotropic sand converges to the cone (flux.py), to first order in the spacing.
"""

from dataclasses import dataclass, replace

import jax
import jax.numpy as jnp
import numpy as np

from jaxsand.scene.boundaries import Base, Walls
from jaxsand.scene.grid import Grid
from jaxsand.scene.scene import Scene
from jaxsand.scene.window import Window


@dataclass(frozen=True)
class TwoGrids:
    """Tells `calibrate` to find the grid's error, from isotropic sand on the scene's grid and on one three times as fine.

    Example:
      >>> import jaxsand as js
      >>> js.TwoGrids()
      TwoGrids()
    """


@dataclass(frozen=True)
class OneGrid:
    """Tells `calibrate` to leave the grid's error unknown: it runs faster, and its errors hold the noise's part alone.

    Example:
      >>> import numpy as np
      >>> import jaxsand as js
      >>> trial = js.Trial(np.zeros((8, 8)), np.zeros((8, 8)))
      >>> js.calibrate(js.make_scene((8, 8), 0.01), trial, free=["repose_angle"], grid=js.OneGrid())  # doctest: +SKIP

    The last line is not run by the tests: compiling takes 5 s and more.
    """


def isotropic(scene: Scene) -> Scene:
    """The scene with isotropic sand in place of 4 or 8 neighbours."""
    return replace(scene, grid=replace(scene.grid, neighbours="isotropic"))


def finer(scene: Scene, times: int) -> Scene:
    """The scene on a grid `times` as fine.

    Each new cell takes the angle of repose, and the wall, of the cell it lies in. A floor that is a map is interpolated, as
    `resolve` does with sand.
    """
    rows, columns = scene.grid.shape
    grid = Grid(scene.grid.spacing / times, (times * rows, times * columns), scene.grid.neighbours)
    material, walls, window, base = scene.material, scene.walls, scene.window, scene.base
    if np.ndim(material.repose_angle):
        material = replace(material, repose_angle=divide(material.repose_angle, times))
    if isinstance(walls, Walls):
        walls = Walls(divide(walls.solid, times))
    if isinstance(base, Base) and np.ndim(base.height):
        base = Base(_planes(scene, jnp.asarray(base.height), times))
    if isinstance(window, Window):
        window = Window((times * window.size[0], times * window.size[1]), window.tolerance * times)
    return replace(scene, grid=grid, material=material, walls=walls, window=window, base=base)


def divide(cells: jax.typing.ArrayLike, times: int) -> jax.Array:
    """Repeats every cell of a map [H, W] `times` along both axes: [times H, times W]."""
    return jnp.repeat(jnp.repeat(jnp.asarray(cells), times, axis=0), times, axis=1)


def resolve(scene: Scene, height: jax.Array, times: int) -> jax.Array:
    """Interpolates a map [H, W] of the scene on a grid `times` as fine, [times H, times W], keeping the mean of every cell.

    Within a cell the map is a plane through its mean. Its slope along x and along y is the smaller of the differences to the
    two neighbours, or 0 where these differ in sign (van Leer 1979, doi:10.1016/0021-9991(79)90145-1, with the minmod
    limiter). So steps stay sharp, and a flank at repose does not become a staircase. A slope is 0 too along an axis on which
    the cell has a solid neighbour, or the map's edge beside it.

    On a floor (`Base`), where that plane would cut the floor of `finer`, the thickness of the sand is a plane instead, and
    nowhere below 0.
    """
    fine = _planes(scene, height, times)
    if not isinstance(scene.base, Base):
        return fine
    floor = jnp.broadcast_to(jnp.asarray(scene.base.height, height.dtype), height.shape)
    fine_floor = _planes(scene, floor, times)
    on_floor = fine_floor + _planes(scene, height - floor, times)
    return jnp.where(divide(means((fine < fine_floor).astype(height.dtype), height.shape) > 0, times), on_floor, fine)


def _planes(scene: Scene, cells: jax.Array, times: int) -> jax.Array:
    """A map [H, W] as a plane in each cell, at the cells [times H, times W] of a grid `times` as fine."""
    rows, columns = cells.shape
    known = jnp.where(scene.walls.solid, jnp.nan, cells) if isinstance(scene.walls, Walls) else cells
    off = jnp.asarray((np.arange(times) + 0.5) / times - 0.5, cells.dtype)
    along_y = divide(_slope(known, 0), times) * jnp.tile(off, rows)[:, None]
    along_x = divide(_slope(known, 1), times) * jnp.tile(off, columns)[None, :]
    return divide(cells, times) + along_y + along_x


def _slope(height: jax.Array, axis: int) -> jax.Array:
    """The smaller of the differences to both neighbours along an axis, 0 where they differ in sign."""
    first, last = jnp.take(height, jnp.asarray([0]), axis), jnp.take(height, jnp.asarray([-1]), axis)
    back, ahead = jnp.diff(height, axis=axis, prepend=first), jnp.diff(height, axis=axis, append=last)
    return jnp.where(back * ahead > 0, jnp.where(jnp.abs(back) < jnp.abs(ahead), back, ahead), 0)


def means(height: jax.Array, shape: tuple[int, ...]) -> jax.Array:
    """Averages maps [..., k H, k W] over the cells of a grid of `shape` (H, W)."""
    rows, columns = shape
    parts = height.reshape(*height.shape[:-2], rows, height.shape[-2] // rows, columns, height.shape[-1] // columns)
    return parts.mean((-3, -1))
