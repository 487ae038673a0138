"""First guesses, at the cost of one call: strokes whose prints, taken from one stroke in the simulator, add up to the goal.

A print is what one stroke leaves of level sand, moved, turned and lengthened in its middle. Prints of strokes between the
cells to be dug are matched to what the goal still lacks, one after the other, keeping several plans at a time; then all
strokes of a plan are moved by Adam on the sum of their prints, first on blurred maps, then on sharper ones.
"""

from dataclasses import dataclass
from functools import cache, partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax.scipy.ndimage import map_coordinates
from scipy.ndimage import gaussian_filter

_POINTS = 48  # cells between which strokes are tried
_PLANS = 16  # that matching keeps
_CHILDREN = 6  # of one plan among them
_BLURS = (1.5, 0.75, 0.0)  # standard deviations in cells
_ITERATIONS = 60  # of Adam for each blur
_STEP = 0.15  # of Adam, in cells


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Print:
    """What a stroke along x leaves of level sand: `height` [H, W] (m), its first point and its length in cells."""

    height: jax.Array
    start: jax.Array  # column and row of the first point; cell centres are whole numbers
    length: jax.Array


def prints(mark: Print, strokes: jax.Array, shape: tuple[int, int]) -> jax.Array:
    """What strokes [..., 4] (in cells, cell centres at whole numbers and a half) leave of level sand: [..., H, W]."""
    ahead = (1,) * (strokes.ndim - 1)
    x, y = jnp.arange(shape[1]).reshape(*ahead, 1, -1) + 0.5, jnp.arange(shape[0]).reshape(*ahead, -1, 1) + 0.5
    x0, y0, x1, y1 = (strokes[..., k, None, None] for k in range(4))
    dx, dy = x1 - x0, y1 - y0
    length = jnp.sqrt(dx * dx + dy * dy + 1e-12)
    cos, sin = dx / length, dy / length
    s, n = (x - x0) * cos + (y - y0) * sin, (y - y0) * cos - (x - x0) * sin
    middle = jnp.minimum(length, mark.length) / 2
    s = jnp.where(s < middle, s, jnp.maximum(s - (length - mark.length), middle))
    where = [mark.start[1] + n, mark.start[0] + s]
    return map_coordinates(mark.height, where, order=1, mode="constant", cval=0.0)


def guesses(mark: Print, change: np.ndarray, strokes: int, rng: np.random.Generator) -> np.ndarray:
    """Plans [P, N, 4] (cells) whose prints add up to `change` [H, W] (m), the closest first."""
    plans = _matched(mark, change, strokes, rng)
    for blur in _BLURS:
        plans, far = _moved(mark, plans, jnp.asarray(_blurred(change, blur)), blur)
    order = np.argsort(np.asarray(far), kind="stable")
    return np.asarray(plans, float)[order]


def _blurred(change: np.ndarray, blur: float) -> np.ndarray:
    return gaussian_filter(change, blur) if blur else change


def _matched(mark: Print, change: np.ndarray, strokes: int, rng: np.random.Generator) -> jax.Array:
    ways = _ways(change, rng)
    shape = change.shape
    each = np.asarray(_prints(mark, jnp.asarray(ways), shape), np.float32).reshape(len(ways), -1)
    own = (each**2).sum(1)
    left = change.astype(np.float32).reshape(1, -1)
    plans = np.zeros((1, 0), int)
    for _ in range(strokes):
        change_of = own - 2 * left @ each.T  # of the squared distance, [plans, ways]
        best = np.argsort(change_of, axis=1)[:, : 8 * _CHILDREN]
        children = []
        for plan, row in enumerate(best):
            kept: list[int] = []
            for way in row:  # of like ways only the best
                if all(np.abs(ways[way] - ways[k]).max() > 2 for k in kept):
                    kept.append(way)
                if len(kept) == (_PLANS if len(best) == 1 else _CHILDREN):
                    break
            children += [(plan, way) for way in kept]
        parent, way = np.array(children).T
        after = left[parent] - each[way]
        far = (after**2).sum(1)
        order = np.argsort(far, kind="stable")
        plans = np.concatenate([plans[parent], way[:, None]], axis=1)
        _, first = np.unique(np.sort(plans[order], axis=1), axis=0, return_index=True)
        kept_ones = order[np.sort(first)][:_PLANS]
        plans, left = plans[kept_ones], after[kept_ones]
    return jnp.asarray(ways[plans], jnp.float32)


def _ways(change: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Strokes [n, 4] (cells) between some of the cells to be dug."""
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
def _adam() -> Any:
    return optax.adam(_STEP)


@partial(jax.jit, static_argnames="blur")
def _moved(mark: Print, plans: jax.Array, change: jax.Array, blur: float) -> tuple[jax.Array, jax.Array]:
    taps = np.exp(-0.5 * (np.arange(-6, 7) / max(blur, 1e-3)) ** 2)
    kernel = jnp.asarray(taps / taps.sum(), jnp.float32)

    def smooth(h: jax.Array) -> jax.Array:
        if not blur:
            return h
        for axis in (0, 1):
            h = jnp.apply_along_axis(lambda row: jnp.convolve(row, kernel, mode="same"), axis, h)
        return h

    def far(plan: jax.Array) -> jax.Array:
        return jnp.sum((smooth(jnp.sum(prints(mark, plan, (change.shape[0], change.shape[1])), axis=0)) - change) ** 2) * 1e4

    def step(carry: Any, _: Any) -> tuple[Any, None]:
        plans, state = carry
        update, state = _adam().update(jax.vmap(jax.grad(far))(plans), state)
        return (optax.apply_updates(plans, update), state), None

    (plans, _), _ = jax.lax.scan(step, (plans, _adam().init(plans)), None, length=_ITERATIONS)
    return plans, jax.vmap(far)(plans)
