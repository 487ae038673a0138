"""Whether a result counts as a glyph drawn right."""

import jax.numpy as jnp
import numpy as np
from scipy.ndimage import maximum_filter
from scipy.optimize import linear_sum_assignment

from jaxsand.goals.metrics import GLYPH_SQUARE, dug, iou, l2

_NEAR = 0.9  # of the dug cells of either map lie beside a dug cell of the other
_CLOSE = 0.12  # of a glyph's size between ends of strokes that count as the same


def right(goal: np.ndarray, height: np.ndarray, depth: float) -> bool:
    """Whether at least 90% of the dug cells of each map [H, W] (m) lie within one cell (8 neighbours) of a dug cell of the
    other.

    A cell is dug when it is lower than half the trench depth (m).
    """
    a, b = np.asarray(dug(goal, depth)), np.asarray(dug(height, depth))
    return _beside(a, b) >= _NEAR and _beside(b, a) >= _NEAR


def strict(goal: np.ndarray, start: np.ndarray, height: np.ndarray, depth: float) -> bool:
    """Whether the dug cells' intersection over union is at least 0.8 and the squared distance fell by at least 90%.

    `goal`, `start` and `height` are maps [H, W] (m): the goal, the sand before and the sand after; `depth` is a trench's
    (m).
    """
    far, left = (float(l2(jnp.asarray(goal), jnp.asarray(h))) ** 2 for h in (start, height))
    return float(iou(goal, height, depth)) >= 0.8 and left <= 0.1 * far


def strokes_right(strokes: np.ndarray, pushes: np.ndarray, size: float = GLYPH_SQUARE[1] - GLYPH_SQUARE[0]) -> int:
    """How many of a glyph's strokes [N, 4] (m) were made by one of the pushes [M, 4] (m).

    A push makes a stroke if both its ends lie within 12% of the glyph's `size` (m) of the stroke's, in either direction.
    Each push counts for one stroke.
    """
    strokes, pushes = (np.asarray(x, float).reshape(-1, 1, 2, 2) for x in (strokes, pushes))
    pushes = pushes[:, 0][None]
    ways = [np.linalg.norm(strokes - p, axis=-1).max(-1) for p in (pushes, pushes[:, :, ::-1])]
    same = np.minimum(*ways) <= _CLOSE * size
    return int(same[linear_sum_assignment(same, maximize=True)].sum())


def _beside(a: np.ndarray, b: np.ndarray) -> float:
    """The share of the true cells of `a` that lie within one cell of a true cell of `b`; 1 where `a` has none."""
    return float((a & maximum_filter(b, 3)).sum() / a.sum()) if a.any() else 1.0
