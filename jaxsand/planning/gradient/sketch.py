"""First guesses at the cost of one call: copies of one simulated stroke's mark are put together to make the goal.

The mark of a stroke is the map that it leaves on level sand. A copy can be moved, turned, and lengthened in its middle.
Copies are laid one after the other: where a mark is below 0, the sand is cut down to it, and where it is above, it is added.

The goal's cells to dig are joined by candidate strokes. These are matched to the goal one after the other, keeping several
plans at a time. Then all strokes of a plan are moved by Adam, first on blurred maps, then on sharper ones, and put in the
order that comes closest to the goal.
"""

from dataclasses import dataclass
from functools import cache, partial

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax.scipy.ndimage import map_coordinates

_POINTS = 48  # cells between which strokes are tried
_PLANS = 16  # that matching keeps
_CHILDREN = 6  # of one plan among them
_BLURS = (1.5, 0.75, 0.0)  # standard deviations in cells
_ITERATIONS = 60  # of Adam for each blur
_STEP = 0.15  # of Adam, in cells
_TOGETHER = 8  # plans of more than one are filled up to so many with strokes off the map, so that they share a program
_NOWHERE = np.array([-1e3, -1e3, -1e3 + 1, -1e3], np.float32)
_SCALE = 1e4  # squared metres to about 1


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Print:
    """The mark of a simulated stroke along x on level sand.

    Attributes:
      height: [H, W] (m).
      start: column and row of the stroke's first point; cell centres are whole numbers.
      length: of the stroke, in cells.
    """

    height: jax.Array
    start: jax.Array  # column and row of the first point; cell centres are whole numbers
    length: jax.Array


def prints(mark: Print, strokes: jax.Array, shape: tuple[int, int]) -> jax.Array:
    """The marks [..., H, W] (m) of strokes [..., 4] (in cells, cell centres at whole numbers and a half) on level sand."""
    ones = (1,) * (strokes.ndim - 1)
    x = (jnp.arange(shape[1], dtype=strokes.dtype) + 0.5).reshape(*ones, 1, shape[1])
    y = (jnp.arange(shape[0], dtype=strokes.dtype) + 0.5).reshape(*ones, shape[0], 1)
    x0, y0, x1, y1 = (strokes[..., k, None, None] for k in range(4))
    dx, dy = x1 - x0, y1 - y0
    length = jnp.sqrt(dx * dx + dy * dy + 1e-12)
    cos, sin = dx / length, dy / length
    s, n = (x - x0) * cos + (y - y0) * sin, (y - y0) * cos - (x - x0) * sin
    middle = jnp.minimum(length, mark.length) / 2
    s = jnp.where(s < middle, s, jnp.maximum(s - (length - mark.length), middle))
    where = [mark.start[1] + n, mark.start[0] + s]
    return map_coordinates(mark.height, where, order=1, mode="constant", cval=0.0)


def printed(mark: Print, strokes: jax.Array, start: jax.Array) -> jax.Array:
    """The map [H, W] (m) after the marks of strokes [N, 4] (cells) are laid one after the other on `start` [H, W]."""
    each = prints(mark, strokes, (start.shape[0], start.shape[1]))
    return jax.lax.scan(lambda h, one: (_laid(h, one), None), start, each)[0]


def _laid(height: jax.Array, one: jax.Array) -> jax.Array:
    """Lays a mark on a map: cuts the sand down to the mark where that is below 0, and adds it elsewhere."""
    return jnp.where(one < 0, jnp.minimum(height, one), height + one)


def guesses(
    mark: Print, start: np.ndarray, goal: np.ndarray, strokes: int, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Plans whose marks turn `start` [H, W] (m) into nearly `goal` [H, W] (m).

    Returns:
      Plans [P, N, 4] (cells), closest first, and the shares [P] of the squared distance that they leave.
    """
    plans = _matched(mark, start, goal, strokes, rng)
    count = len(plans)
    places = 1 if strokes == 1 else -(-strokes // _TOGETHER) * _TOGETHER
    filled = np.broadcast_to(_NOWHERE, (_PLANS, places, 4)).copy()
    filled[:count, :strokes] = plans
    moved, maps = jnp.asarray(filled), (jnp.asarray(start, jnp.float32), jnp.asarray(goal, jnp.float32))
    for blur in _BLURS:
        moved = _moved(mark, moved, *maps, jnp.asarray(_bell(blur), jnp.float32))
        if not blur and strokes > 1:
            moved = _moved(mark, _reordered(mark, moved, strokes, *maps), *maps, jnp.asarray(_bell(blur), jnp.float32))
    left = np.asarray(_far(mark, moved, *maps), float)[:count] / max(float(_SCALE * ((goal - start) ** 2).sum()), 1e-30)
    order = np.argsort(left, kind="stable")
    return np.asarray(moved, float)[order, :strokes], left[order]


def _bell(blur: float) -> np.ndarray:
    """A Gaussian of 13 taps, of standard deviation `blur` cells."""
    bell = np.exp(-0.5 * (np.arange(-6, 7) / max(blur, 1e-3)) ** 2)
    return bell / bell.sum()


def _reordered(mark: Print, plans: jax.Array, strokes: int, start: jax.Array, goal: jax.Array) -> jax.Array:
    """Swaps two strokes of every plan, as long as that brings its marks closer to the goal."""
    orders = np.tile(np.arange(plans.shape[1]), (strokes * (strokes - 1) // 2 + 1, 1))
    orders[:-1, :strokes] = swaps(strokes)
    for _ in range(strokes):
        far = _far_in_orders(mark, plans, jnp.asarray(orders), start, goal)
        best = orders[np.argmin(np.asarray(far) + 1e-6 * np.arange(len(orders))[::-1], axis=1)]
        if (best == orders[-1]).all():
            break
        plans = jnp.take_along_axis(plans, jnp.asarray(best)[..., None], axis=1)
    return plans


def swaps(count: int) -> np.ndarray:
    """The orders [pairs, count] of `count` strokes in which two have changed places."""
    orders = [[*range(i), j, *range(i + 1, j), i, *range(j + 1, count)] for i in range(count) for j in range(i + 1, count)]
    return np.array(orders, int).reshape(-1, count)


def _matched(mark: Print, start: np.ndarray, goal: np.ndarray, strokes: int, rng: np.random.Generator) -> np.ndarray:
    """Plans [P, N, 4] (cells) built stroke by stroke from candidates between the cells to dig, several plans at a time."""
    ways = _ways(goal - start, rng)
    filled = np.broadcast_to(_NOWHERE, (_POINTS * (_POINTS - 1), 4)).astype(np.float32)
    filled[: len(ways)] = ways
    each = _prints(mark, jnp.asarray(filled), goal.shape)
    maps, plans = np.asarray(start, np.float32)[None], np.zeros((1, 0), int)
    for _ in range(strokes):
        padded = np.concatenate([maps, np.repeat(maps[-1:], _PLANS - len(maps), axis=0)])
        far = np.asarray(_far_after(jnp.asarray(padded), each, jnp.asarray(goal, jnp.float32)))[: len(maps), : len(ways)]
        children = []
        for plan, row in enumerate(far):
            kept: list[int] = []
            for way in np.argsort(row)[: 8 * _CHILDREN]:  # of like ways only the best
                if all(np.abs(ways[way] - ways[k]).max() > 2 for k in kept):
                    kept.append(int(way))
                if len(kept) == (_PLANS if len(far) == 1 else _CHILDREN):
                    break
            children += [(plan, way) for way in kept]
        parent, way = np.array(children).T
        order = np.argsort(far[parent, way], kind="stable")
        plans = np.concatenate([plans[parent], way[:, None]], axis=1)
        _, first = np.unique(np.sort(plans[order], axis=1), axis=0, return_index=True)
        kept_ones = order[np.sort(first)][:_PLANS]
        plans = plans[kept_ones]
        maps = np.asarray(_laid(jnp.asarray(maps[parent[kept_ones]]), each[way[kept_ones]]))
    return ways[plans]


def _ways(change: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Candidate strokes [n, 4] (cells): all that join up to 48 well spread cells of those to dig."""
    depth = -min(float(change.min()), 0.0)
    rows, columns = np.nonzero(change < -depth / 4)
    if not len(rows):
        rows, columns = np.nonzero(np.ones_like(change))
    points = np.stack([columns, rows], 1) + 0.5
    chosen = [int(np.argmin(change[rows, columns]))]
    far = np.full(len(points), np.inf)
    while len(chosen) < min(_POINTS, len(points)):  # each farthest from those before it
        far = np.minimum(far, np.abs(points - points[chosen[-1]]).max(1) + 0.1 * rng.random(len(points)))
        chosen.append(int(np.argmax(far)))
    some = points[chosen]
    a, b = np.nonzero(~np.eye(len(some), dtype=bool)) if len(some) > 1 else (np.zeros(1, int), np.zeros(1, int))
    return np.concatenate([some[a], some[b]], axis=1).astype(np.float32)


@partial(jax.jit, static_argnames="shape")
def _prints(mark: Print, strokes: jax.Array, shape: tuple[int, int]) -> jax.Array:
    return jax.lax.map(lambda s: prints(mark, s, shape), strokes, batch_size=64)


@cache
def _adam() -> optax.GradientTransformation:
    return optax.adam(_STEP)


@jax.jit
def _far_after(maps: jax.Array, each: jax.Array, goal: jax.Array) -> jax.Array:
    """The squared distances [P, W] from the goal of maps [P, H, W] after each of W marks."""
    return jax.lax.map(lambda h: jnp.sum((_laid(h[None], each) - goal[None]) ** 2, axis=(1, 2)), maps)


def _off(mark: Print, plan: jax.Array, start: jax.Array, goal: jax.Array) -> jax.Array:
    """The map that a plan's marks make, less the goal."""
    return printed(mark, plan, start) - goal


@jax.jit
def _far(mark: Print, plans: jax.Array, start: jax.Array, goal: jax.Array) -> jax.Array:
    """The squared distances [P] (scaled) of what the plans' marks make from the goal."""
    return jax.vmap(lambda plan: jnp.sum(_off(mark, plan, start, goal) ** 2) * _SCALE)(plans)


@jax.jit
def _far_in_orders(mark: Print, plans: jax.Array, orders: jax.Array, start: jax.Array, goal: jax.Array) -> jax.Array:
    """The squared distances [P, O] (scaled) of plans whose strokes are put in the orders [O, N]."""
    return jax.lax.map(lambda plan: _far(mark, plan[orders], start, goal), plans)


@jax.jit
def _moved(mark: Print, plans: jax.Array, start: jax.Array, goal: jax.Array, taps: jax.Array) -> jax.Array:
    """The plans after Adam has moved their strokes, on maps smoothed with the filter `taps`."""

    def smooth(h: jax.Array) -> jax.Array:
        for axis in (0, 1):
            h = jnp.apply_along_axis(lambda row: jnp.convolve(row, taps, mode="same"), axis, h)
        return h

    def far(plan: jax.Array) -> jax.Array:
        return jnp.sum(smooth(_off(mark, plan, start, goal)) ** 2) * _SCALE

    def step(carry: tuple[jax.Array, optax.OptState], _: None) -> tuple[tuple[jax.Array, optax.OptState], None]:
        plans, state = carry
        update, state = _adam().update(jax.vmap(jax.grad(far))(plans), state)
        return (optax.apply_updates(plans, update), state), None

    return jax.lax.scan(step, (plans, _adam().init(plans)), None, length=_ITERATIONS)[0][0]
