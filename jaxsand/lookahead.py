"""Looking ahead with the simulator as a model: what a policy proposes is tried on the sand, and the best plans go on."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from jaxsand.scene import Scene
from jaxsand.strokeloss import SandLoss, pushed


class Proposes(Protocol):
    """Such as `policy.Policy`."""

    def propose(self, scene: Scene, goal: np.ndarray, current: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]: ...


@dataclass(frozen=True)
class Ahead:
    """The plan `strokes` [N, 4] (m), the squared distances `losses` [N + 1] (m^2) of the start and after each stroke, and
    the `calls` of the simulator that it took."""

    strokes: np.ndarray
    losses: np.ndarray
    calls: int


def one_after_the_other(
    policy: Proposes, scene: Scene, start: np.ndarray, goal: np.ndarray, strokes: int
) -> tuple[np.ndarray, np.ndarray]:
    """The policy alone, for many goals [B, H, W] (m) at once: its likeliest stroke on the sand as it is then, so many times,
    whatever comes of it. Gives the plans [B, strokes, 4] (m), and the maps before them and after each stroke
    [strokes + 1, B, H, W] (m), NaN once an outcome is not clean."""
    maps, plans = [start.astype(np.float32)], []
    for _ in range(strokes):
        plans.append(policy.propose(scene, goal, np.nan_to_num(maps[-1]), 1)[0][:, 0])
        maps.append(pushed(scene, maps[-1], plans[-1]))
    return np.stack(plans, 1), np.stack(maps)


def look_ahead(
    policy: Proposes, sand: SandLoss, strokes: int, width: int = 8, tell: Callable[[str], None] = lambda _: None
) -> Ahead:
    """A beam search: `width` proposals for each of as many plans are pushed, and the `width` closest plans go on whose maps
    differ. Of all plans up to `strokes` long the closest is given: none if no stroke brings the sand closer.

    At most strokes x width^2 calls of the simulator.
    """
    start = sand.start.astype(np.float32)
    maps, plans, losses = start[None], np.zeros((1, 0, 4)), np.array([[sand.loss_of(start)]])
    best, calls = Ahead(plans[0], losses[0], 0), 0
    for k in range(strokes):
        tell(f"stroke {k + 1} of {strokes}, {calls} pushes tried")
        proposed = policy.propose(sand.scene, np.repeat(sand.goal[None], len(maps), 0), maps, width)[0]
        parent = np.repeat(np.arange(len(maps)), proposed.shape[1])
        new = proposed.reshape(-1, 4)
        far, after = sand.after(maps[parent], new)
        calls += len(new)
        kept = _different(far, after, width)
        if not kept:
            break
        plans = np.concatenate([plans[parent[kept]], new[kept, None]], 1)
        losses = np.concatenate([losses[parent[kept]], far[kept, None]], 1)
        maps = after[kept]
        if losses[0, -1] < best.losses[-1]:
            best = Ahead(plans[0], losses[0], calls)
    return Ahead(best.strokes, best.losses, calls)


def _different(far: np.ndarray, maps: np.ndarray, most: int) -> list[int]:
    """The closest, none of which is within a third of its own distance of one before it."""
    kept: list[int] = []
    for i in np.argsort(far, kind="stable"):
        if not np.isfinite(far[i]):
            break
        if all(((maps[i] - maps[k]) ** 2).sum() > 0.1 * far[i] for k in kept):
            kept.append(int(i))
        if len(kept) == most:
            break
    return kept
