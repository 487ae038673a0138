"""Where a fit would end on an infinitely fine grid, from two grids of a reference model that converges to first order.

The data d were fitted by a model on its own grid, which gave x0 with the Jacobian J; let W = (J^T J)^-1 J^T. The reference
model predicts m_coarse on one grid and m_fine on a grid r times as fine. Its limit is m_fine + b, where
b = (m_fine - m_coarse) / (r - 1) (Richardson 1911, doi:10.1098/rsta.1911.0009). The fit in the limit is the x at which
W (m_fine + b - d) = 0. Since the data enter with the same weights W as at x0, their noise hardly counts in x - x0. The steps
dx = -W (m_fine + b - d) find x without derivatives of the reference; where a step turns back, the next ones are halved.

Half of the extrapolated part, W b, is taken as its uncertainty. Where a kink (a toe, a crest) lies in the middle of a cell
or on its edge, two grids may agree by chance: so W b is also computed a little to either side, and the largest counts.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

Reference = Callable[[np.ndarray], tuple[np.ndarray, np.ndarray, bool]]
"""From x to the misfits m_fine - d (m), what the limit adds to them, b, and whether both outcomes were clean."""

_LOOKS = 12
_NEAR = 0.5  # of its own error: a step after which the fit has arrived
_ASIDE = 0.04  # of the ranges: by how much kinks are moved


@dataclass(frozen=True)
class Limit:
    """The fit on an infinitely fine grid, `x` [P], and the uncertainty of `x`, `doubt` [P], both in units of the ranges."""

    x: np.ndarray
    doubt: np.ndarray


def seek_limit(
    start: np.ndarray, way: np.ndarray, noise: np.ndarray, told: np.ndarray, reference: Reference
) -> Limit | None:
    """Finds the fit on an infinitely fine grid, or None.

    Args:
      start: the fit on the model's own grid, [P], in units of the ranges.
      way: W = (J^T J)^-1 J^T, [P, n].
      noise: the standard errors that the data's noise causes, [P].
      told: which parameters the data determine, [P] bool; the others stay where they are.
      reference: evaluates the reference model on both grids.

    Returns:
      The limit; None where the reference's outcome is not clean, a parameter leaves its range, or no limit is found.
    """

    def look(x: np.ndarray) -> tuple[np.ndarray, np.ndarray, bool]:
        fine, beyond, clean = reference(x)
        step = np.where(told, -way @ (fine + beyond), 0)
        return step, np.where(told, np.abs(way @ beyond) / 2, 0), clean and bool(np.isfinite(step).all())

    x, last, stride = start, np.zeros_like(start), 1.0
    for _ in range(_LOOKS):
        step, doubt, clean = look(x)
        stride = stride / 2 if last @ step < 0 else stride
        x, last = x + stride * step, step
        if not clean or np.any((x <= 0) | (x >= 1), where=told):
            return None
        if np.all(np.abs(step) <= _NEAR * np.hypot(noise, doubt), where=told):
            sides = [look(np.where(told, np.clip(x + aside, 0, 1), x)) for aside in (-_ASIDE, _ASIDE)]
            doubt = np.max([doubt, *(side[1] for side in sides)], axis=0)
            return Limit(x, np.hypot(doubt, step)) if all(side[2] for side in sides) else None
    return None
