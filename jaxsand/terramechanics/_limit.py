"""Where a fit would end on an ever finer grid, from two grids of a reference that converges to first order.

The data d are fitted by a model of its own grid, at x0 with the Jacobian J, W = (J^T J)^-1 J^T. The reference's heights m on
a coarse grid and on one r times as fine tell its limit, m_fine + b with b = (m_fine - m_coarse) / (r - 1) (Richardson 1911,
doi:10.1098/rsta.1911.0009), and the fit moves to x with W (m_fine + b - d) = 0: the data weigh there as they do at x0, so
that their noise hardly counts in x - x0. It is found by steps dx = -W (m_fine + b - d), which need no derivative of the
reference; where a step turns back, the next are halved.

What is extrapolated, W b, is trusted to its half. Where a kink (a toe, a crest) comes to lie in the middle of a cell, or on
its edge, two grids may agree by luck: so W b is taken a little to either side too, and its largest counts.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

Reference = Callable[[np.ndarray], tuple[np.ndarray, np.ndarray, bool]]
"""At x: the reference's misfits m_fine - d (m), what its limit adds to them, b, and whether both grids came out clean."""

_LOOKS = 12
_NEAR = 0.5  # of its own error: a step after which the fit has arrived
_ASIDE = 0.04  # of the ranges: by how much kinks are moved


@dataclass(frozen=True)
class Limit:
    """Where the fit ends in the limit of fine grids, and what may be wrong of that (either way), in units of the ranges."""

    x: np.ndarray
    doubt: np.ndarray


def seek_limit(
    start: np.ndarray, way: np.ndarray, noise: np.ndarray, told: np.ndarray, reference: Reference
) -> Limit | None:
    """The limit's fit, from `start` [P] by W = `way` [P, n]; `noise` [P] is the error that noise makes, `told` [P] which
    parameters the data tell. None where the reference is not clean, leaves the ranges (0 to 1), or is not found."""

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
