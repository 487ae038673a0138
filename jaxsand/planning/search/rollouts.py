"""Simulates the children of a search on real sand, many at once."""

from dataclasses import dataclass

import numpy as np

from jaxsand.goals.goal import Goal
from jaxsand.interaction.batched import act_batch, step_batch
from jaxsand.interaction.blade_closed_form import SwathPush
from jaxsand.interaction.outcome import check
from jaxsand.interaction.simulate import Shaped, follow
from jaxsand.planning.search.actions import Path
from jaxsand.planning.side_by_side import in_one_batch
from jaxsand.relaxation.settling import Settled, settle_batch
from jaxsand.relaxation.stopping import Sweeps
from jaxsand.scene.scene import Scene

CHEAP = 1 / 12
"""The cost of a rough push in full pushes, as `jaxsand bench sand` measures it."""


@dataclass(frozen=True)
class Effort:
    """What a search cost.

    Attributes:
      full: full pushes.
      rough: rough pushes.
      gain: the largest step of a full push towards the goal (m).
    """

    full: int = 0
    rough: int = 0
    gain: float = 0.0

    @property
    def cost(self) -> float:
        """The cost in full pushes; a rough one counts as `CHEAP`."""
        return self.full + CHEAP * self.rough

    def __add__(self, other: "Effort") -> "Effort":
        return Effort(self.full + other.full, self.rough + other.rough, max(self.gain, other.gain))


def distance(maps: np.ndarray, goal: Goal) -> np.ndarray:
    """The distance (m) of maps [..., H, W] from the goal; infinite for a map that is not finite."""
    far = goal.distance(np.asarray(maps, float))
    return np.where(np.isnan(far), np.inf, far)


def pushed(scene: Scene, maps: np.ndarray, strokes: np.ndarray) -> np.ndarray:
    """The maps [n, H, W] (m) after one stroke [n, 4] or [n, 6] (m) on each of `maps` [n, H, W]; NaN where an outcome is not
    clean.

    Raises:
      OutcomeError: if no outcome of the batch is clean.
    """
    return _clean(in_one_batch(step_batch, scene, *_single(maps, strokes)))


def replay(scene: Scene, height: np.ndarray, paths: list[Path] | tuple[Path, ...]) -> np.ndarray:
    """The map [H, W] (m) after the paths, one after the other; the tool is lowered and lifted for each."""
    height = np.asarray(height, np.float32)
    for path in paths:
        shaped = follow(scene, height, np.asarray(path, np.float32))
        check(shaped)
        height = np.asarray(shaped.height)
    return height


def roughly_pushed(scene: Scene, maps: np.ndarray, strokes: np.ndarray) -> np.ndarray:
    """Like `pushed`, in closed form and with 8 sweeps of settling: good enough to rank strokes, not to judge them."""
    return np.asarray(in_one_batch(_roughly, scene, *_single(maps, strokes)).height)


def walked(scene: Scene, maps: np.ndarray, legs: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """One more leg [n, 4] (m) on each of the maps [n, H, W] with the tool down.

    Returns:
      The maps with the tool still down, and the maps with the tool lifted and the sand settled. The tool comes down again at
      the start of each leg, where it had stood; `follow` of the whole path settles a little less.
    """
    down = np.asarray(in_one_batch(act_batch, scene, *_single(maps, legs)).height)
    return down, _clean(in_one_batch(settle_batch, scene, down))


def distinct(marks: list[bytes], parent: np.ndarray, order: np.ndarray, count: int, most: int) -> list[int]:
    """The first `count` nodes in the given order, at most `most` of one parent, and no two with the same mark."""
    kept: list[int] = []
    seen: set[bytes] = set()
    children = dict.fromkeys(parent.tolist(), 0)
    for i in order.tolist():
        if len(kept) < count and marks[i] not in seen and children[int(parent[i])] < most:
            seen.add(marks[i])
            children[int(parent[i])] += 1
            kept.append(i)
    return kept


def marks(maps: np.ndarray, grain: float) -> list[bytes]:
    """A label for each of maps [n, H, W]: means over blocks of 2 x 2 cells, rounded to multiples of `grain` (m)."""
    whole = np.pad(maps, [(0, 0), *((0, n % 2) for n in maps.shape[1:])], mode="edge")
    rows, columns = whole.shape[1:]
    blocks = whole.reshape(len(maps), rows // 2, 2, columns // 2, 2).mean((2, 4))
    rounded = np.round(np.where(np.isfinite(blocks), blocks, 0) / grain).astype(np.int32)
    return [one.tobytes() for one in rounded]


def _roughly(scene: Scene, maps: np.ndarray, strokes: np.ndarray) -> Shaped:
    return step_batch(scene, maps, strokes, push=SwathPush(), stop=Sweeps(8))


def _clean(result: Settled) -> np.ndarray:
    """The maps of a batch, NaN where the outcome is not clean."""
    good = np.asarray(result.outcome) == 0
    if not good.any():
        check(result)
    return np.where(good[:, None, None], np.asarray(result.height), np.nan)


def _single(maps: np.ndarray, strokes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return np.asarray(maps, np.float32), np.asarray(strokes, np.float32)
