"""How far plans of strokes end from a goal, for many plans at once.

A plan is an array [N, 4] of strokes x0, y0, x1, y1 (m), or [N, 6] of strokes x0, y0, z0, x1, y1, z1 (m), as of `step`.
Every stroke that is pushed counts as one call of the simulator.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike

from jaxsand.goals.goal import Goal, as_goal
from jaxsand.goals.metrics import fits
from jaxsand.interaction.batched import step_batch, value_and_grad_batch
from jaxsand.planning.side_by_side import in_one_batch
from jaxsand.scene.scene import Scene

GRADIENT = 4
"""The cost of the gradient through one stroke in calls, as `jaxsand bench grad` measures it, rounded up."""


Weigh = Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]
"""From the residuals of a goal [P, H, W] to a loss of them [P] and its gradient by them [P, H, W]."""


@dataclass(frozen=True)
class Best:
    """The best plan so far.

    Attributes:
      calls: how many calls of the simulator it took to find it.
      loss: its cost, which is the squared distance (m^2) from a goal of squares.
      strokes: [N, 4] (m).
    """

    calls: int
    loss: float
    strokes: np.ndarray


class Evaluate(Protocol):
    """What a search may ask of the sand; every stroke of every candidate counts as one call."""

    @property
    def start(self) -> np.ndarray:
        """The map before the first stroke."""

    def __call__(self, candidates: np.ndarray) -> np.ndarray:
        """The losses [P] of plans [P, N, 4] (m)."""

    def after(self, maps: np.ndarray, strokes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The losses [P] and the maps after one more stroke [P, 4] (m) on each of `maps` [P, ...]."""


@dataclass(frozen=True)
class SandLoss:
    """What a plan's result costs by the goal: the squared l2 distance (m^2), if all cells count alike; infinite where an
    outcome is not clean.

    Args:
      scene: grid, sand and blade.
      start: the map [H, W] (m) before the first stroke, at rest.
      goal: what is wanted, as `as_goal` makes it; `sand_loss` takes a user's.
    """

    scene: Scene
    start: np.ndarray
    goal: Goal

    def __call__(self, candidates: np.ndarray) -> np.ndarray:
        """The losses [P] of plans [P, N, 4] (m)."""
        return self.costs(self.maps(candidates))

    def after(self, maps: np.ndarray, strokes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The losses [P] and the maps [P, H, W] after one more stroke [P, 4] (m) on each of `maps` [P, H, W]."""
        maps = pushed(self.scene, maps, strokes)
        return self.costs(maps), maps

    def maps(self, candidates: np.ndarray) -> np.ndarray:
        """The maps [P, H, W] that plans [P, N, 4] leave; NaN where an outcome is not clean."""
        maps = np.repeat(self.start[None].astype(np.float32), len(candidates), axis=0)
        for k in range(candidates.shape[1]):
            maps = pushed(self.scene, maps, candidates[:, k])
        return maps

    def gradient(self, candidates: np.ndarray, weigh: Weigh) -> tuple[np.ndarray, np.ndarray]:
        """The values and the gradients of a loss of plans.

        The gradient is taken backwards stroke by stroke, from maps that are kept on the way.

        Args:
          candidates: plans [P, N, 4] (m).
          weigh: from the goal's residuals of the maps [P, H, W] to the loss [P] and its gradient by them [P, H, W].

        Returns:
          The loss [P], infinite where an outcome is not clean, and its gradient [P, N, 4] by the plans, NaN there.
        """
        maps = [np.repeat(self.start[None].astype(np.float32), len(candidates), axis=0)]
        for k in range(candidates.shape[1]):
            maps.append(pushed(self.scene, maps[-1], candidates[:, k]))
        residual, rate = self.goal.residual(maps[-1].astype(float))
        value, back = weigh(residual)
        back = back * rate
        out = np.zeros(candidates.shape)
        for k in reversed(range(candidates.shape[1])):
            back, out[:, k] = _pulled(self.scene, maps[k], candidates[:, k], back)
        return np.where(np.isnan(value), np.inf, value), out

    @property
    def bounds(self) -> np.ndarray:
        """The lowest and the highest x0, y0, x1, y1 (m) that a stroke may have, those of cells' centres: [2, 4]."""
        rows, columns = self.scene.grid.shape
        spacing = float(self.scene.grid.spacing)
        high = np.array([columns, rows, columns, rows]) * spacing - spacing / 2
        return np.stack([np.full(4, spacing / 2), high])

    @property
    def target(self) -> np.ndarray:
        """The map [H, W] (m) nearest to the start that costs nothing."""
        return self.nearest(self.start)

    def nearest(self, height: np.ndarray) -> np.ndarray:
        """The map [H, W] (m) nearest to a map that costs nothing."""
        return np.asarray(height - self.goal.off(height.astype(float)), np.float32)

    def inside(self, plans: np.ndarray) -> np.ndarray:
        """Plans [..., 4] or [..., 6] with every stroke moved onto the map; heights stay as they are."""
        low, high = self.bounds
        if plans.shape[-1] == 4:
            return np.clip(plans, low, high)
        free = np.full((2, 1), np.inf) * [[-1], [1]]
        low, high = np.concatenate([self.bounds[:, :2], free, self.bounds[:, 2:], free], axis=1)
        return np.clip(plans, low, high)

    def loss_of(self, height: np.ndarray) -> float:
        """The cost of a map [H, W] (m)."""
        return float(self.costs(height))

    def costs(self, maps: np.ndarray) -> np.ndarray:
        """The costs of maps [..., H, W] (m); infinite for a map that is not finite."""
        cost = self.goal.cost(maps.astype(float))
        return np.where(np.isnan(cost), np.inf, cost)


def sand_loss(scene: Scene, start: np.ndarray, goal: Goal | ArrayLike) -> SandLoss:
    """What plans that begin on the map `start` [H, W] (m), at rest, cost by a goal.

    Raises:
      ValueError: if the start or the goal does not fit the scene.
    """
    fits(scene, start, "start")
    return SandLoss(scene, start, as_goal(scene, goal))


def pushed(scene: Scene, maps: np.ndarray, strokes: np.ndarray) -> np.ndarray:
    """The maps [P, H, W] (m) after one stroke [P, 4] (m) on each of the maps [P, H, W] (m); NaN where an outcome is not
    clean.
    """
    maps = np.asarray(maps, np.float32)
    if not len(maps):
        return maps
    shaped = in_one_batch(step_batch, scene, maps, np.asarray(strokes, np.float32))
    return np.where((np.asarray(shaped.outcome) == 0)[:, None, None], np.asarray(shaped.height), np.nan)


def _pulled(scene: Scene, maps: np.ndarray, strokes: np.ndarray, back: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The cotangents of maps [P, H, W] and strokes [P, 4], from the cotangents of the maps that the strokes leave."""
    maps, strokes, back = (np.asarray(x, np.float32) for x in (maps, strokes, np.nan_to_num(back)))
    of_maps, of_strokes = in_one_batch(_cotangents, scene, maps, strokes, back)
    return np.asarray(of_maps), np.asarray(of_strokes)


def _cotangents(scene: Scene, maps: np.ndarray, strokes: np.ndarray, back: np.ndarray) -> tuple[jax.Array, jax.Array]:
    return value_and_grad_batch(scene, jnp.vdot, maps, strokes, back)[1]
