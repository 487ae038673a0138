"""The eight turns and mirrors of a map, and a policy that averages over all of them.

The shortest walk over a mirrored map is the mirrored walk. So the mean of a network's values over all eight views is as
right as each, while its mistakes, which differ from view to view, weigh less.
"""

from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxsand.envs.maps import STEPS
from jaxsand.planning.learned.square_symmetries import turned_back as turned
from train.dqn.networks import Greedy

VIEWS = range(8)
"""The bits of a view: bit 0 swaps rows and columns, then bit 1 flips the rows and bit 2 the columns."""


def turned_steps(view: int) -> np.ndarray:
    """For each of the steps N, E, S, W, [4], which step it is in another view."""
    steps = STEPS[:, ::-1] if view & 1 else STEPS
    steps = steps * np.array([-1 if view >> axis & 1 else 1 for axis in (1, 2)])
    return np.argmax((steps[:, None] == STEPS[None]).all(-1), axis=1)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Symmetric(Greedy):
    """A network whose values are averaged over all views of square maps."""

    def values(self, observation: Any) -> jax.Array:
        """Action values [B, 4] of planes [B, H, H]."""
        total = jnp.zeros((), jnp.float32)
        for view in VIEWS:
            seen = {name: turned(planes, view) for name, planes in observation.items()}
            total = total + super().values(seen)[:, turned_steps(view)]
        return total / len(VIEWS)
