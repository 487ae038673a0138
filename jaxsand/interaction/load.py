"""What a bucket holds: a number, or a small height map that keeps to repose and spills over the bucket's walls.

The map is settled like any other: on a floor (the bucket's), with an edge that drains over a rim (its walls). What runs off
lands on the bed beside the bucket. How much there is in all is known by two floats, and the map only tells how it lies.
"""

import math
from dataclasses import dataclass, replace

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.typing import DTypeLike
from jaxtyping import Array, Float

from jaxsand.interaction.pouring import point_weights, poured
from jaxsand.relaxation.ghost_cells import ExactSum
from jaxsand.relaxation.schemes import SuperTimeStepping
from jaxsand.relaxation.settling import run_off
from jaxsand.relaxation.stopping import UntilStill
from jaxsand.scene.boundaries import Base, Draining
from jaxsand.scene.footprint import Pose
from jaxsand.scene.grid import Grid
from jaxsand.scene.material import Material
from jaxsand.scene.scene import Scene, as_array, cast
from jaxsand.scene.tools import Bucket
from jaxsand.scene.validation import concrete


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Load:
    """What a bucket holds: the volume is (high + low) dx^2, as `load_volume` says in m^3.

    Two floats hold it, so that no sand is lost to rounding, however often the bucket is filled and emptied.

    Attributes:
        high: sum of heights of cells (m), as one float has it.
        low: what that leaves out (m).

    Example:
        >>> import jax.numpy as jnp
        >>> import jaxsand as js
        >>> scene = js.make_scene((16, 16), 0.01, tool=js.Bucket(width=0.04, length=0.03, capacity=2e-5))
        >>> scooped = js.scoop(scene, jnp.zeros((16, 16)), jnp.array([[0.04, 0.08, -0.01], [0.08, 0.08, -0.01]]))
        >>> print(f"{js.load_volume(scene, scooped.load):.2e}")
        1.60e-05
    """

    high: Float[Array, "*batch"]
    low: Float[Array, "*batch"]


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Heaped(Load):
    """What a bucket with walls holds, and how it lies there.

    Attributes:
        high: sum of heights of cells (m), as one float has it.
        low: what that leaves out (m).
        surface: thickness of the sand in the bucket's cells [m, n] (m): row 0 at its edge, columns from right to left as it
            looks ahead.

    Example:
        >>> import jax.numpy as jnp
        >>> import jaxsand as js
        >>> deep = js.Bucket(width=0.04, length=0.03, capacity=1e-4, walls=0.01)
        >>> scene = js.make_scene((16, 16), 0.01, tool=deep)
        >>> scooped = js.scoop(scene, jnp.zeros((16, 16)), jnp.array([[0.02, 0.08, -0.02], [0.08, 0.08, -0.02]]))
        >>> heap = scooped.load.surface  # it stands above the walls; what would not stay has spilled
        >>> heap.shape, bool(heap.max() > 0.01), bool(js.load_volume(scene, scooped.load) < 0.04 * 0.06 * 0.02)
        ((3, 4), True, True)
    """

    surface: Float[Array, "*batch m n"]


def as_load(load: Load | None, dtype: DTypeLike | None) -> Load:
    """The load in a dtype, or its own, rounded no more than two floats are; ValueError, with the field, if it is none."""
    if load is None:
        return Load(jnp.zeros((), dtype), jnp.zeros((), dtype))
    if not isinstance(load, Load):
        raise ValueError(f"load: got {type(load).__name__}; give the .load of what scoop or dump returned, or None")
    high, low = as_array("load.high", load.high), as_array("load.low", load.low)
    dtype = dtype or high.dtype
    rounded = high.astype(dtype)
    rest = (high - rounded.astype(high.dtype) + low.astype(high.dtype)).astype(dtype)
    if isinstance(load, Heaped):
        return Heaped(rounded, rest, as_array("load.surface", load.surface).astype(dtype))
    return Load(rounded, rest)


def one_load(load: Load | None, dtype: DTypeLike, inside: Scene | None) -> Load:
    """`as_load` of a single map, as the bucket holds it; its sum must be finite and 0 or more, unless it is being traced."""
    held = as_load(load, dtype)
    for name, part in (("load.high", held.high), ("load.low", held.low)):
        if part.ndim:
            raise ValueError(f"{name}: got shape {list(part.shape)}; give the load of one map, and use jax.vmap for many")
    known = concrete(held.high)
    if known is not None and not (np.isfinite(known) and known >= 0):
        raise ValueError(f"load.high: got {known}; it must be finite and 0 or more: give the .load of what scoop returned")
    if inside is None:
        return Load(held.high, held.low)
    shape = inside.grid.shape
    surface = held.surface if isinstance(held, Heaped) else jnp.full(shape, (held.high + held.low) / math.prod(shape))
    if surface.shape != shape:
        raise ValueError(f"load.surface: got shape {list(surface.shape)}; of this bucket it is {list(shape)}")
    return Heaped(held.high, held.low, surface)


def added(load: Load, account: ExactSum, sign: float) -> Load:
    """The load with an account added or taken away, without rounding beyond that of the second float.

    A map that tells how it lies is raised or lowered in proportion, or, where there was nothing, evenly.
    """
    high, rest = _two_sum(load.high, sign * account.high)
    high, low = _two_sum(high, load.low + sign * account.low + rest)
    if not isinstance(load, Heaped):
        return Load(high, low)
    return Heaped(high, low, _holding(load.surface, high + low))


def _holding(surface: jax.Array, whole: jax.Array) -> jax.Array:
    """The surface, raised or lowered such that its cells hold `whole` (m): lowered in proportion, raised evenly."""
    there = jnp.sum(surface)
    less = surface * (whole / jnp.where(there > 0, there, 1))
    return jnp.where(whole < there, less, surface + (whole - there) / surface.size)


def _two_sum(a: jax.Array, b: jax.Array) -> tuple[jax.Array, jax.Array]:
    """a + b as a float, and what rounding left of it (Knuth's two-sum)."""
    whole = lax.optimization_barrier(a + b)
    other = lax.optimization_barrier(whole - a)
    return whole, lax.stop_gradient((a - lax.optimization_barrier(whole - other)) + (b - other))


def inside_of(scene: Scene, bucket: Bucket) -> Scene | None:
    """The scene of the sand in a bucket with walls, in whole cells of the bed's size; None without walls."""
    if bucket.walls is None:
        return None
    sizes = [concrete(x) for x in (bucket.length, bucket.width, scene.grid.spacing)]
    if any(x is None or x.ndim for x in sizes):
        raise ValueError("tool.walls: got walls and a size that is being traced; give the bucket and the grid as numbers")
    length, width, dx = (float(x) for x in sizes if x is not None)
    shape = tuple(max(1, round(size / dx)) for size in (length, width))
    angle = jnp.mean(jnp.asarray(scene.material.repose_angle))
    grid = Grid(scene.grid.spacing, (shape[0], shape[1]), scene.grid.neighbours)
    return Scene(grid, Material(angle), edge=Draining(jnp.asarray(bucket.walls)), base=Base(0.0))


def spilled(scene: Scene, inside: Scene, pose: Pose, height: jax.Array, load: Load) -> tuple[jax.Array, Load, jax.Array]:
    """The bed and the load after what does not stay in the bucket has run over its walls, and bits of `Outcome`.

    It lands half a cell outside of the wall that it ran over. The bucket lies behind its edge, which is at the pose.
    """
    assert isinstance(load, Heaped)
    inside = cast(inside, height.dtype)
    surface, lost = run_off(inside, load.surface, SuperTimeStepping(), cast(UntilStill(), height.dtype))
    rows, columns = inside.grid.shape
    row, column = np.indices((rows, columns))
    walls = {
        (1, 0): row == 0,
        (-1, 0): row == rows - 1,
        (0, -1): column == 0,
        (0, 1): column == columns - 1,
    }
    share = lost / np.maximum(sum(wall.astype(int) for wall in walls.values()), 1)
    along, aside, amount = [], [], []
    for (ahead, left), wall in walls.items():
        along.append((-row - 0.5 + ahead)[wall])
        aside.append((column + 0.5 - columns / 2 + left)[wall])
        amount.append(share[wall])
    s, n = (jnp.asarray(np.concatenate(x), height.dtype) * scene.grid.spacing for x in (along, aside))
    points = jnp.stack([pose.x + s * pose.cos - n * pose.sin, pose.y + s * pose.sin + n * pose.cos], 1)
    amounts = jnp.concatenate(amount)
    weights = jnp.tensordot(amounts, jax.vmap(lambda point: point_weights(scene, point))(points), 1)
    whole = jnp.sum(amounts)
    after, account, missed = poured(scene, height, weights, whole, ExactSum(jnp.zeros_like(whole), whole))
    return after.whole, added(replace(load, surface=surface), account, -1), missed
