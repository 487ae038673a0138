"""Looking ahead with the simulator as a model: what a policy proposes is tried on the sand and put right there, and the best
plans go on."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from jaxsand.scene import Scene
from jaxsand.strokeloss import SandLoss, pushed

_ASIDE = (0.25, 0.1)  # cells: so far the numbers of a stroke are moved, to see what that does
_MOVES = np.concatenate([np.eye(4), -np.eye(4)])


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
    differ, after their last strokes were put right. Of all plans up to `strokes` long the closest is given: none if no
    stroke brings the sand closer.

    A network sees where a stroke is due to a tenth of a cell; the sand tells more. Each of a stroke's four numbers is moved
    by s up and down, s = 1/4 cell and then 1/10. With the losses f that these leave, the stroke goes to where parabolas
    through them are least,

        s (f(-s) - f(s)) / (2 (f(s) - 2 f(0) + f(-s)))   in each number, s at most,

    if that, or one of the moves, is better.

    At most strokes x width x (width + 18) calls of the simulator.
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
        parent = parent[kept]
        new, far, after = new[kept], far[kept], after[kept]
        for aside in _ASIDE:
            new, far, after = _put_right(sand, aside, maps[parent], new, far, after)
            calls += (len(_MOVES) + 1) * len(kept)
        plans = np.concatenate([plans[parent], new[:, None]], 1)
        losses = np.concatenate([losses[parent], far[:, None]], 1)
        maps, first = after, int(far.argmin())
        if far[first] < best.losses[-1]:
            best = Ahead(plans[first], losses[first], calls)
    return Ahead(best.strokes, best.losses, calls)


def _put_right(
    sand: SandLoss, aside: float, maps: np.ndarray, strokes: np.ndarray, far: np.ndarray, after: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Strokes [P, 4] (m) on maps [P, H, W] (m) that end at least as close, the losses [P] and the maps after them."""
    dx, (rows, columns) = float(sand.scene.grid.spacing), sand.scene.grid.shape
    within = 0.5 * dx, (np.array([columns, rows] * 2) - 0.5) * dx
    moved = np.clip(strokes[:, None] + aside * dx * _MOVES, *within)
    far_moved, after_moved = sand.after(np.repeat(maps, len(_MOVES), 0), moved.reshape(-1, 4))
    far_moved = far_moved.reshape(len(strokes), -1)
    up, down = far_moved[:, :4], far_moved[:, 4:]
    with np.errstate(divide="ignore", invalid="ignore"):
        least = np.clip((down - up) / (2 * (up - 2 * far[:, None] + down)), -1, 1)
    downhill = np.where(up < down, 1, -1) * (np.minimum(up, down) < far[:, None])
    curved = (up + down > 2 * far[:, None]) & np.isfinite(up + down)
    both = np.clip(strokes + aside * dx * np.where(curved, least, downhill), *within)
    far_both, after_both = sand.after(maps, both)
    every = np.concatenate([strokes[:, None], moved, both[:, None]], 1)
    fars = np.concatenate([far[:, None], far_moved, far_both[:, None]], 1)
    afters = np.concatenate([after[:, None], after_moved.reshape(*moved.shape[:2], rows, columns), after_both[:, None]], 1)
    one, which = np.arange(len(strokes)), fars.argmin(1)
    return every[one, which], fars[one, which], afters[one, which]


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
