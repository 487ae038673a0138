"""Where a fit would end on an ever finer grid, from two grids of a reference that converges to first order.

The data r = m(x) - d are fitted by a model m of its own grid, at x0 with the Jacobian J, W = (J^T J)^-1 J^T. The reference's
heights on a coarse grid and on one twice as fine give those of its limit, 2 m_fine - m_coarse (Richardson 1911,
doi:10.1098/rsta.1911.0009), and the fit moves to x with W (2 m_fine - m_coarse - d) = 0: the data weigh there as they do at
x0, so that their noise hardly counts in x - x0. It is found by steps dx = -W (2 m_fine - m_coarse - d), which need no
derivative of the reference. What is extrapolated, W (m_fine - m_coarse), is trusted to its half.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

Reference = Callable[[np.ndarray], tuple[np.ndarray, np.ndarray, bool]]
"""The misfits (m) of the reference at x on its coarse grid and on its fine one, and whether both came out clean."""

_LOOKS = 10
_NEAR = 0.25  # of its own error: a step after which the fit has arrived


@dataclass(frozen=True)
class Limit:
    """Where the fit ends in the limit of fine grids, and what may be wrong of that (either way), in units of the ranges."""

    x: np.ndarray
    rest: np.ndarray


def seek_limit(
    start: np.ndarray, way: np.ndarray, noise: np.ndarray, told: np.ndarray, reference: Reference
) -> Limit | None:
    """The limit's fit, from `start` [P] by W = `way` [P, n]; `noise` [P] is the error that noise makes, `told` [P] which
    parameters the data tell. None where the reference is not clean, leaves the ranges (0 to 1), or is not found."""
    x = start
    for _ in range(_LOOKS):
        coarse, fine, clean = reference(x)
        rest, step = way @ (fine - coarse) / 2, -way @ (2 * fine - coarse)
        if not (clean and np.isfinite(step).all()):
            return None
        x = np.where(told, x + step, start)
        if np.any((x <= 0) | (x >= 1), where=told):
            return None
        if np.all(np.abs(step) <= _NEAR * np.hypot(noise, rest), where=told):
            return Limit(x, np.where(told, rest, 0))
    return None
