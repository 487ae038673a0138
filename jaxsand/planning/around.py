"""What plans leave that differ in a few strokes from one that has been pushed.

A stroke changes the sand near it, and sees no more of it. So where a stroke of the known plan meets the sand that it met
there, it leaves what it left there, and need not be pushed again: strokes before the first that differs, and later ones
that lie elsewhere. Of 24 strokes over a whole map that is most of them.

That holds to what settling leaves: each push lets the whole map settle to within a tolerance, so that far away, too, it may
even out slopes that strokes before it have left a little above repose. On cells of 1 cm maps differed by 1.4e-5 m at most,
and losses by 7e-5 of themselves.
"""

import math
from collections import deque
from collections.abc import Iterator

import numpy as np
from scipy.ndimage import binary_dilation

from jaxsand.goals.outlines import near
from jaxsand.planning.stroke_loss import SandLoss
from jaxsand.scene.scene import Scene, blade_of

_BESIDE = 2  # cells beside what a stroke changed, or swept, that it may have looked at
_ALL_AROUND = np.ones((3, 3), bool)


class Around:
    """A plan that has been pushed, and what plans like it cost.

    Args:
      sand: the loss, its start, and its goal.
      plan: [N, 4] or [N, 6] (m).
      maps: the maps [N + 1, H, W] (m) from the start to the end, if they are known; None pushes the plan.

    Attributes:
      plan: the same.
      maps: the same; NaN from an outcome on that is not clean.
      calls: strokes pushed so far, N of them for the plan itself if it was pushed.
    """

    def __init__(self, sand: SandLoss, plan: np.ndarray, maps: np.ndarray | None = None) -> None:
        self.plan, self._sand, self.calls = plan, sand, 0
        if maps is None:
            maps, self.calls = sand.start[None].astype(np.float32), len(plan)
            for stroke in plan:
                maps = np.concatenate([maps, sand.after(maps[-1:], stroke[None])[1]])
        self.maps = maps
        ends = plan.reshape(len(plan), 2, plan.shape[1] // 2)[..., :2].reshape(-1, 1, 4)
        swept = [near(one, _reach(sand.scene), sand.scene.grid) for one in ends]
        seen = [changed | under for changed, under in zip(maps[1:] != maps[:-1], swept, strict=True)]
        self._seen = [binary_dilation(one, _ALL_AROUND, _BESIDE) for one in seen]

    @property
    def losses(self) -> np.ndarray:
        """The losses [N + 1] of the start and after each stroke."""
        return self._sand.costs(self.maps)

    @property
    def touched(self) -> np.ndarray:
        """How many strokes, itself and later ones, lie where they may see what each stroke changes, [N]."""
        seen = np.array(self._seen, np.float32).reshape(len(self.plan), math.prod(self.maps.shape[1:]))
        return np.triu(seen @ seen.T > 0).sum(1)

    def most(self, plans: np.ndarray) -> np.ndarray:
        """How many strokes of each of the plans [P, K, n] are pushed at most, [P]: those from the first on that differs."""
        if np.isnan(self.maps).any():  # equal to nothing, so that all are pushed
            return np.full(len(plans), plans.shape[1])
        count = min(plans.shape[1], len(self.plan))
        alike = (plans[:, :count] == self.plan[:count]).all(2)
        return plans.shape[1] - np.logical_and.accumulate(alike, axis=1).sum(1)

    def varied(self, plans: np.ndarray) -> np.ndarray:
        """The losses [P] of plans [P, K, n] (m)."""
        return self._sand.costs(self.left(plans))

    def left(self, plans: np.ndarray) -> np.ndarray:
        """The maps [P, H, W] that plans [P, K, n] (m) leave, to within what settling leaves."""
        return deque(self.along(plans), maxlen=1)[0]

    def along(self, plans: np.ndarray) -> Iterator[np.ndarray]:
        """The maps [P, H, W] before each stroke of plans [P, K, n] (m), and at the end; each is for reading only."""
        maps = np.repeat(self.maps[:1], len(plans), axis=0)
        yield maps
        for k in range(plans.shape[1]):
            maps, new = maps.copy(), np.ones(len(plans), bool)
            for m, stroke in enumerate(self.plan):
                same = (new & (plans[:, k] == stroke).all(1)).nonzero()[0][:, None]
                if not len(same):
                    continue
                rows, columns = self._seen[m].nonzero()
                known = same[(maps[same, rows, columns] == self.maps[m, rows, columns]).all(1)]
                maps[known, rows, columns] = self.maps[m + 1, rows, columns]
                new[known] = False
            if new.any():
                maps[new] = self._sand.after(maps[new], plans[new, k])[1]
                self.calls += int(new.sum())
            yield maps


def _reach(scene: Scene) -> float:
    """How far (m) from its way the blade may cover sand."""
    blade = blade_of(scene)
    return math.hypot(float(blade.width) / 2, float(blade.thickness))
