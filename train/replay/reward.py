"""What the learners of strokes are rewarded for."""

from typing import TypeVar

import jax
import numpy as np

Maps = TypeVar("Maps", jax.Array, np.ndarray)
_UNIT = 5.0  # squared depths of the blade over cells: a stroke that is due gains about 3 of it


def far(goal: Maps, height: Maps) -> Maps:
    """The squared distance [...] of maps [..., H, W] in units of the blade's depth, divided by 5.

    What a stroke takes off it is its reward. Strokes that lie apart then gain together what each would gain alone, and the
    rewards of an episode sum up to the squared distance that it gained.
    """
    return ((goal - height) ** 2).sum((-2, -1)) / _UNIT
