"""The children of a search on real sand, evaluated by rolling out the simulator, many at once."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from jaxsand.interaction.batched import act_batch, step_batch
from jaxsand.interaction.blade_closed_form import SwathPush
from jaxsand.interaction.simulate import check, follow
from jaxsand.planning.search.actions import Path
from jaxsand.relaxation.settling import settle_batch
from jaxsand.relaxation.stopping import Sweeps
from jaxsand.scene.scene import Scene

CHEAP = 1 / 12
"""What a rough push counts for, in full ones; `jaxsand bench sand` measures it."""


@dataclass(frozen=True)
class Effort:
    """Simulator calls: `full` and `rough` pushes; `gain` is the largest step towards the goal of any full one, in l2 (m)."""

    full: int = 0
    rough: int = 0
    gain: float = 0.0

    @property
    def cost(self) -> float:
        """In full pushes."""
        return self.full + CHEAP * self.rough

    def __add__(self, other: "Effort") -> "Effort":
        return Effort(self.full + other.full, self.rough + other.rough, max(self.gain, other.gain))


def distance(maps: np.ndarray, goal: np.ndarray) -> np.ndarray:
    """The l2 distance (m) of maps [..., H, W] from the goal; infinite for a map that is not finite."""
    square = ((np.asarray(maps, float) - goal) ** 2).sum((-2, -1))
    return np.where(np.isnan(square), np.inf, np.sqrt(square))


def pushed(scene: Scene, maps: np.ndarray, strokes: np.ndarray) -> np.ndarray:
    """What one stroke [n, 4] each makes of maps [n, H, W]; NaN where the outcome is not clean.

    Raises:
      OutcomeError: if none of a batch is clean.
    """
    return _clean(step_batch(scene, *_single(maps, strokes)))


def replay(scene: Scene, height: np.ndarray, paths: list[Path] | tuple[Path, ...]) -> np.ndarray:
    """The map [H, W] after paths one after the other, each from where the tool is lowered to where it is lifted."""
    height = np.asarray(height, np.float32)
    for path in paths:
        shaped = follow(scene, height, np.asarray(path, np.float32))
        check(shaped)
        height = np.asarray(shaped.height)
    return height


def roughly_pushed(scene: Scene, maps: np.ndarray, strokes: np.ndarray) -> np.ndarray:
    """`pushed` in closed form and with 8 sweeps of settling: to rank by, not to judge by."""
    return np.asarray(step_batch(scene, *_single(maps, strokes), push=SwathPush(), stop=Sweeps(8)).height)


def walked(scene: Scene, maps: np.ndarray, legs: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Maps [n, H, W] with the tool down after one more leg [n, 4] each, and the same with the tool lifted and settled.

    The tool comes down again at the start of a leg, where it had stood; `follow` of the whole path settles a little less.
    """
    down = act_batch(scene, *_single(maps, legs)).height
    return np.asarray(down), _clean(settle_batch(scene, down))


def distinct(marks: list[bytes], parent: np.ndarray, order: np.ndarray, count: int, most: int) -> list[int]:
    """The first `count` nodes in the given order of which no two bear the same mark, and no more than `most` of a parent."""
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
    """What maps [n, H, W] are told apart by: means over blocks of 2 x 2 cells, rounded to multiples of `grain` (m)."""
    rows, columns = (n // 2 * 2 for n in maps.shape[1:])
    blocks = maps[:, :rows, :columns].reshape(len(maps), rows // 2, 2, columns // 2, 2).mean((2, 4))
    rounded = np.round(np.where(np.isfinite(blocks), blocks, 0) / grain).astype(np.int32)
    return [one.tobytes() for one in rounded]


def _clean(result: Any) -> np.ndarray:
    good = np.asarray(result.outcome) == 0
    if not good.any():
        check(result)
    return np.where(good[:, None, None], np.asarray(result.height), np.nan)


def _single(maps: np.ndarray, strokes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return np.asarray(maps, np.float32), np.asarray(strokes, np.float32)
