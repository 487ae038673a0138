"""Look-ahead with the simulator as a model: a policy's proposals are pushed, the best plans go on, and the closest of all is
refined.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Protocol

import numpy as np

from jaxsand.planning.around import Around
from jaxsand.planning.stroke_loss import SandLoss, pushed
from jaxsand.scene.progress import Tell, quiet
from jaxsand.scene.scene import Scene

_ASIDE = (0.25, 0.1)  # cells: how far `put_right` moves each number of a plan, in its first and in its second round


class Proposes(Protocol):
    """A policy that proposes strokes, such as `policy.Policy`."""

    def propose(self, scene: Scene, goal: np.ndarray, current: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
        """For maps [B, H, W] (m), strokes [B, count, 4] (m), likeliest first, and the logarithms of their likelihoods."""


class Nearby(Protocol):
    """A plan that has been pushed, such as `Around`."""

    calls: int

    def varied(self, plans: np.ndarray) -> np.ndarray:
        """The losses [P] of plans [P, N, 4] (m) that are like it."""


@dataclass(frozen=True)
class Ahead:
    """A plan found by looking ahead.

    Attributes:
      strokes: [N, 4] (m).
      losses: [N + 1] costs by the goal, of the start and after each stroke.
      calls: how often the simulator was called.
    """

    strokes: np.ndarray
    losses: np.ndarray
    calls: int


def one_after_the_other(
    policy: Proposes, scene: Scene, start: np.ndarray, goal: np.ndarray, strokes: int
) -> tuple[np.ndarray, np.ndarray]:
    """Lets the policy act alone on many goals at once: its likeliest stroke is pushed, `strokes` times.

    Args:
      policy: proposes strokes.
      scene: grid, sand and blade.
      start, goal: maps [B, H, W] (m).
      strokes: how many each plan has.

    Returns:
      The plans [B, strokes, 4] (m), and the maps [strokes + 1, B, H, W] (m) before them and after each stroke. A map is NaN
      from the stroke on whose outcome is not clean.
    """
    maps, plans = [start.astype(np.float32)], []
    for _ in range(strokes):
        plans.append(policy.propose(scene, goal, np.nan_to_num(maps[-1]), 1)[0][:, 0])
        maps.append(pushed(scene, maps[-1], plans[-1]))
    return np.stack(plans, 1), np.stack(maps)


def look_ahead(policy: Proposes, sand: SandLoss, strokes: int, width: int = 8, tell: Tell = quiet) -> Ahead:
    """Searches for a plan of up to `strokes` strokes with a beam of `width` plans.

    For each plan of the beam the policy proposes `width` strokes, which are pushed; the `width` closest plans whose maps
    differ form the next beam. The closest of all plans, of any length up to `strokes`, is refined by `put_right`; the plan
    is empty if no stroke brings the sand closer. Takes at most `most_calls` calls of the simulator.
    """
    start = sand.start.astype(np.float32)
    maps, plans, losses = start[None], np.zeros((1, 0, 4)), np.array([sand.loss_of(start)])
    plan, least, calls = plans[0], losses[0], 0
    for k in range(strokes):
        tell(f"stroke {k + 1} of {strokes}, {calls} pushes tried")
        proposed = policy.propose(sand.scene, sand.nearest(maps), maps, width)[0]
        parent = np.repeat(np.arange(len(maps)), proposed.shape[1])
        new = proposed.reshape(-1, 4)
        far, after = sand.after(maps[parent], new)
        calls += len(new)
        kept = _different(far, after, width)
        if not kept:
            break
        plans = np.concatenate([plans[parent[kept]], new[kept, None]], 1)
        maps, losses = after[kept], far[kept]
        if losses[0] < least:
            plan, least = plans[0], losses[0]
    tell(f"putting {len(plan)} strokes right, {calls} pushes tried")
    plan, tried = put_right(partial(Around, sand), sand.scene, plan, least)
    return Ahead(plan, Around(sand, plan).losses, calls + tried + len(plan))


def most_calls(strokes: int, width: int) -> int:
    """How often a plan of up to `strokes` strokes calls the simulator at most, by `look_ahead` or, of width 0, by the policy
    alone.

    N strokes take N calls; to look ahead takes N width^2 for the beam and 8 N^2 + 14 N for `put_right` besides.
    """
    return strokes + (strokes * width**2 + 8 * strokes**2 + 14 * strokes if width else 0)


def put_right(push: Callable[[np.ndarray], Nearby], scene: Scene, plan: np.ndarray, loss: float) -> tuple[np.ndarray, int]:
    """Refines a plan: moves its end points a little, to a plan that ends at least as close to the goal.

    A network sees where a stroke belongs to a tenth of a cell; the simulator tells more. There are two rounds, with s = 1/4
    and 1/10 of a cell. Each of the plan's 4 N numbers alone is moved by s up and down, which gives the losses f(s) and
    f(-s). Then all numbers are moved at once to the minima of the parabolas through these losses,

        s (f(-s) - f(s)) / (2 (f(s) - 2 f(0) + f(-s)))   in each number, at most s,

    and, as another plan, half as far. Each round takes the closest of all these plans. Strokes stay on the map: near its
    edge the moves are shorter, and the parabolas only approximate.

    Args:
      push: pushes a plan, to tell the losses of plans like it.
      scene: grid and sand.
      plan: [N, 4] (m).
      loss: of the plan (m^2), finite.

    Returns:
      The refined plan [N, 4] (m), and the calls of the simulator, at most 8 N^2 + 14 N.
    """
    if not len(plan):
        return plan, 0
    dx, (rows, columns) = float(scene.grid.spacing), scene.grid.shape
    low, high = 0.5 * dx, (np.array([columns, rows] * 2) - 0.5) * dx
    n, calls = len(plan), 0
    moves = np.concatenate([np.eye(4 * n), -np.eye(4 * n)]).reshape(-1, n, 4)
    for aside in _ASIDE:
        near = push(plan)
        moved = np.clip(plan + aside * dx * moves, low, high)
        far = near.varied(moved)
        step = _downhill(loss, *np.split(far, 2)).reshape(n, 4)
        both = np.clip(plan + aside * dx * np.stack([step, step / 2]), low, high)
        every, losses = np.concatenate([plan[None], moved, both]), np.concatenate([[loss], far, near.varied(both)])
        plan, loss = every[losses.argmin()], losses.min()
        calls += near.calls
    return plan, calls


def _downhill(here: float, up: np.ndarray, down: np.ndarray) -> np.ndarray:
    """The places, -1 to 1, of the minima of parabolas through the losses `down` at -1, `here` at 0 and `up` at 1.

    Where a parabola has no minimum, the lower side is taken, or 0 if neither is lower.
    """
    bend = up - 2 * here + down
    curved = np.isfinite(bend) & (bend > 0)
    least = np.where(curved, down, 0) - np.where(curved, up, 0)
    least = least / (2 * np.where(curved, bend, 1))
    side = np.where(up < down, 1.0, -1.0) * (np.minimum(up, down) < here)
    return np.clip(np.where(curved, least, side), -1, 1)


def _different(far: np.ndarray, maps: np.ndarray, most: int) -> list[int]:
    """Indices of up to `most` maps, closest to the goal first, without infinite losses `far`.

    Each is farther from those before it than a third of its own distance from the goal.
    """
    kept: list[int] = []
    for i in np.argsort(far, kind="stable"):
        if not np.isfinite(far[i]):
            break
        if all(((maps[i] - maps[k]) ** 2).sum() > 0.1 * far[i] for k in kept):
            kept.append(int(i))
        if len(kept) == most:
            break
    return kept
