"""What a stroke will leave, foreseen without a push: good enough to choose which of many strokes to try.

The blade takes along the sand above its bottom, and fills with it what lies below. The rest it loses over both sides, as
e^(-s/l) with the way s, to berms at the angle of repose; what it still carries at the end stays in front of it as a heap.
The trench's walls slide to repose about their own edges. Nothing else flows, and what would go over the map's edge is not
kept. Of 256 random strokes on six tasks, the order by what is foreseen agrees with the true one by 0.83 to 0.96 (rank
correlation).
"""

from functools import cache

import jax
import jax.numpy as jnp
import numpy as np

from jaxsand.goals.goal import Goal
from jaxsand.scene.scene import Scene, blade_of

_PARTS = 48  # of a stroke's way
_LANES = 5  # across the blade, on which the sand ahead is looked at
_LOST = 3.0  # blade's widths on which a share of 1 - 1/e of what is carried is lost over both sides
_TOGETHER = 256  # strokes at a time


def foreseen(scene: Scene, maps: np.ndarray, strokes: np.ndarray) -> np.ndarray:
    """Roughly the maps [n, H, W] (m) that strokes [n, 6] (m) leave on maps [n, H, W], or all on one map [H, W]."""
    blade, spacing = blade_of(scene), float(scene.grid.spacing)
    repose = float(np.tan(np.max(np.asarray(scene.material.repose_angle))))
    sand = jnp.array([spacing, float(blade.width), float(blade.thickness), repose], jnp.float32)
    many, one = len(strokes), np.ndim(maps) == 2
    strokes = np.concatenate([strokes, np.repeat(strokes[-1:], -many % _TOGETHER, axis=0)]).astype(np.float32)
    found, program = [np.zeros((0, *maps.shape[-2:]), np.float32)], _program(one)
    for k in range(0, many, _TOGETHER):
        some = np.asarray(maps if one else maps[k : k + _TOGETHER], np.float32)
        if not one:
            some = np.concatenate([some, np.repeat(some[-1:], _TOGETHER - len(some), axis=0)])
        found.append(np.asarray(program(some, strokes[k : k + _TOGETHER], sand)))
    return np.concatenate(found)[:many]


def roughly_far(goal: Goal, maps: np.ndarray) -> np.ndarray:
    """How far (m) foreseen maps [n, H, W] are from the goal, [n]: in float32, which is ten times as fast as `distance`."""
    return np.asarray(_distances(goal, np.asarray(maps, np.float32)), float)


@jax.jit
def _distances(goal: Goal, maps: jax.Array) -> jax.Array:
    return goal.distance(maps)


@cache
def _program(one: bool) -> "jax.stages.Wrapped":
    return jax.jit(jax.vmap(_left_by, in_axes=(None if one else 0, 0, None)))


def _left_by(height: jax.Array, stroke: jax.Array, sand: jax.Array) -> jax.Array:
    """The map [H, W] after a stroke [6]; `sand` holds the spacing, the blade's width and thickness, and tan(repose)."""
    spacing, width, thick, repose = sand
    rows, columns = height.shape
    start, run = stroke[:2], stroke[3:5] - stroke[:2]
    length = jnp.sqrt((run**2).sum() + 1e-18)
    ahead = run / length
    left = jnp.stack([-ahead[1], ahead[0]])
    part = (length + thick) / _PARTS
    way = (jnp.arange(_PARTS) + 0.5) * part - thick / 2
    bottom = stroke[2] + (stroke[5] - stroke[2]) * jnp.clip(way / length, 0, 1)

    def at(across: jax.Array) -> tuple[jax.Array, jax.Array]:
        column, row = (
            jnp.round((start[i] + way[:, None] * ahead[i] + across[None] * left[i]) / spacing - 0.5).astype(int)
            for i in (0, 1)
        )
        inside = (row >= 0) & (row < rows) & (column >= 0) & (column < columns)
        return height[jnp.clip(row, 0, rows - 1), jnp.clip(column, 0, columns - 1)], inside

    level, inside = at(((jnp.arange(_LANES) + 0.5) / _LANES - 0.5) * width)
    cell = part * width / _LANES
    taken = (jnp.maximum(level - bottom[:, None], 0) * inside).sum(1) * cell
    lacking = (jnp.maximum(bottom[:, None] - level, 0) * inside).sum(1) * cell

    def on(load: jax.Array, here: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, tuple[jax.Array, jax.Array]]:
        load = load + here[0]
        given = jnp.minimum(load, here[1])
        rest = load - given
        kept = rest * jnp.exp(-part / (_LOST * width))
        return kept, (_over(given, here[1]), (rest - kept) / part / 2)

    load, (filled, lost) = jax.lax.scan(on, jnp.zeros_like(part), (taken, lacking), unroll=8)
    walls = jnp.maximum(at(jnp.array([-0.5, 0.5]) * (width + spacing))[0] - bottom[:, None], 0)

    x, y = (jnp.arange(columns)[None] + 0.5) * spacing - start[0], (jnp.arange(rows)[:, None] + 0.5) * spacing - start[1]
    along, across = x * ahead[0] + y * ahead[1], x * left[0] + y * left[1]
    beside = jnp.abs(across) - width / 2
    k = jnp.clip(jnp.floor((along + thick / 2) / part).astype(int), 0, _PARTS - 1)
    covered = jnp.clip(jnp.minimum(along + thick / 2, length + thick / 2 - along) / spacing + 0.5, 0, 1)
    within = jnp.clip(0.5 - beside / spacing, 0, 1)
    floor, share, right_wall, left_wall, berm = jnp.moveaxis(
        jnp.stack([bottom, filled, walls[:, 0], walls[:, 1], _root(2 * lost * repose)], axis=1)[k], -1, 0
    )
    wall = jnp.where(across > 0, left_wall, right_wall)
    slope = floor + wall / 2 + repose * beside
    slid = (wall > 0) & (abs(beside) < wall / 2 / repose)
    inner = jnp.minimum(height, floor) + jnp.maximum(floor - height, 0) * share
    inner = jnp.where(slid, jnp.maximum(inner, slope), inner)
    outer = jnp.where(slid, jnp.minimum(height, slope), height)
    outer += jnp.maximum(berm - repose * jnp.maximum(beside, 0), 0)
    beyond = along - length - thick / 2
    heap = jnp.maximum(_root(2 * load / width * repose) - repose * beyond, 0) * within * (beyond > 0)
    return height + covered * (within * (inner - height) + (1 - within) * (outer - height)) + heap


def _over(a: jax.Array, b: jax.Array) -> jax.Array:
    """a / b; 0 where b is 0."""
    return jnp.where(b > 0, a / jnp.where(b > 0, b, 1), 0)


def _root(x: jax.Array) -> jax.Array:
    """The square root of what is 0 or more, with the derivative 0 at 0."""
    return jnp.where(x > 0, jnp.sqrt(jnp.where(x > 0, x, 1)), 0)
