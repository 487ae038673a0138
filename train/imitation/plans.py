"""Random plans of strokes on the square in which glyphs lie; the learners' goals are made of them."""

import numpy as np

from jaxsand.goals.metrics import GLYPH_SQUARE

MOST = 8
"""The most strokes of a plan."""

_COUNTS = np.array([0.06, 0.16, 0.22, 0.22, 0.14, 0.10, 0.06, 0.04])
_SHORTEST = 0.15  # of the square
_TRIES = 16
_MOVED = 0.5  # of the plans
_SCALES = (0.6, 1.1)
_EDGE = 0.01  # m, from the map's border to a moved square


def random_plans(rng: np.random.Generator, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Draws plans.

    A stroke starts anywhere, or at an end of an earlier stroke, or on its way. It ends at such a place too, or straight
    across or along from its start.

    Returns:
      Strokes [P, MOST, 4] = x0, y0, x1, y1 (m), and how many of them [P] count in each plan.
    """
    numbers = 1 + rng.choice(MOST, count, p=_COUNTS / _COUNTS.sum())
    strokes = np.zeros((count, MOST, 4))
    for k in range(MOST):
        strokes[:, k] = _one_more(rng, strokes[:, :k])
    low, high = GLYPH_SQUARE
    margin = 0.04 * (high - low)
    return low - margin + strokes * (high - low + 2 * margin), numbers


def anywhere(rng: np.random.Generator, plans: np.ndarray) -> np.ndarray:
    """The plans, half of them made smaller or a little larger and moved to a random place on the map."""
    low, high = GLYPH_SQUARE
    shape = (len(plans), 1, 1)
    scale = rng.uniform(*_SCALES, shape)
    free = low + high - 2 * _EDGE - scale * (high - low)
    corner = _EDGE + np.maximum(free, 0) * rng.random((len(plans), 1, 2))
    moved = (plans - low) * scale + np.tile(corner, 2)
    return np.where(rng.random(shape) < _MOVED, moved, plans)


def _one_more(rng: np.random.Generator, earlier: np.ndarray) -> np.ndarray:
    """A stroke [P, 4] of the unit square for each plan: the first of a few that is long enough."""
    count = len(earlier)
    a, b = _point(rng, earlier, (_TRIES, count)), _point(rng, earlier, (_TRIES, count))
    straight = rng.random((_TRIES, count)) < 0.35
    axis = rng.integers(2, size=(_TRIES, count))
    for i in (0, 1):
        b[..., i] = np.where(straight & (axis == i), a[..., i], b[..., i])
    enough = np.hypot(*np.moveaxis(b - a, -1, 0)) >= _SHORTEST
    first = np.argmax(enough, axis=0)
    rows = np.arange(count)
    return np.concatenate([a[first, rows], b[first, rows]], axis=-1)


def _point(rng: np.random.Generator, earlier: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """Random points [T, P, 2]: anywhere, or at an end of an earlier stroke, or on its way."""
    anywhere = rng.random((*shape, 2))
    if not earlier.shape[1]:
        return anywhere
    which = rng.integers(earlier.shape[1], size=shape)
    stroke = earlier[np.arange(shape[1]), which]
    end = rng.random(shape)
    part = np.where(rng.random(shape) < 0.6, np.round(end), end)[..., None]
    there = stroke[..., :2] * (1 - part) + stroke[..., 2:] * part
    return np.where(rng.random(shape)[..., None] < 0.45, there, anywhere)
