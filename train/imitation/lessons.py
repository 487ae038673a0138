"""Lessons for hindsight imitation: sand part of the way to a goal that strokes made, and which strokes are still to come."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from jaxsand.planning.stroke_loss import pushed
from jaxsand.scene.scene import Scene
from train.imitation.plans import MOST, anywhere, random_plans

Choose = Callable[[np.ndarray, np.ndarray], np.ndarray]
"""Strokes [B, 4] (m) for goals and current maps [B, H, W] (m)."""

_JITTER = 0.005  # standard deviation (m) of the ends of strokes made a little wrong
_ASTRAY = 0.05  # a stroke farther (m) than this from each that is due was none of them


@dataclass(frozen=True)
class Lessons:
    """A chunk's lessons.

    Attributes:
      goal, current: maps [S, H, W] (m).
      due: strokes [S, MOST, 4] (m).
      counts: [S, MOST] which of these are still to come.
      pushes: an upper bound of the pushes that were simulated.
    """

    goal: np.ndarray
    current: np.ndarray
    due: np.ndarray
    counts: np.ndarray
    pushes: int


def lessons(scene: Scene, rng: np.random.Generator, plans: int, start: np.ndarray, choose: Choose | None = None) -> Lessons:
    """Makes lessons from random plans, on two ways to each goal.

    The first way is the one that made the goal. The second has the strokes in another order and a little wrong; or, given
    `choose`, it has the strokes that `choose` picks.

    Args:
      scene: grid, sand and blade.
      rng: draws the plans.
      plans: how many, P.
      start: maps [P, H, W] (m) at rest before the first strokes.
      choose: picks strokes for goals and current maps.
    """
    strokes, numbers = random_plans(rng, plans)
    strokes = anywhere(rng, strokes)
    every = np.arange(plans)
    first = np.tile(np.arange(MOST), (plans, 1))
    goal, one = way(scene, start, strokes, numbers)
    if choose is None:
        order = first.copy()
        for plan in np.flatnonzero(rng.random(plans) < 0.5):
            order[plan, : numbers[plan]] = rng.permutation(numbers[plan])
        wrong = strokes + _JITTER * rng.standard_normal(strokes.shape) * (rng.random((plans, 1, 1)) < 0.7)
        _, two = way(scene, start, np.take_along_axis(wrong, order[..., None], 1), numbers)
    else:
        order, two = _own_way(scene, start, strokes, numbers, goal, choose)
    out = []
    for turns, maps in ((first, one), (order, two)):
        for k in range(1 if maps is two else 0, MOST):
            here = every[(numbers > k) & np.isfinite(maps[k]).all((1, 2)) & np.isfinite(goal).all((1, 2))]
            due = np.take_along_axis(strokes[here], turns[here][:, [*range(k, MOST), *range(k)], None], 1)
            out.append((goal[here], maps[k][here], due, np.arange(MOST) < numbers[here, None] - k))
    goals, maps, due, counts = (np.concatenate(parts) for parts in zip(*out, strict=True))
    return Lessons(goals, maps, due.astype(np.float32), counts, 2 * int(numbers.sum()))


def way(scene: Scene, start: np.ndarray, strokes: np.ndarray, numbers: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Pushes the strokes of plans [P, MOST, 4] (m), of which the first `numbers` [P] count.

    Returns:
      The maps [P, H, W] (m) that they leave, and the maps before each stroke [MOST, P, H, W].
    """
    maps, every = [start], np.arange(len(start))
    for k in range(MOST):
        here = every[numbers > k]
        after = maps[-1].copy()
        after[here] = pushed(scene, after[here], strokes[here, k])
        maps.append(after)
    return maps[-1], np.stack(maps[:-1])


def _own_way(
    scene: Scene, start: np.ndarray, strokes: np.ndarray, numbers: np.ndarray, goal: np.ndarray, choose: Choose
) -> tuple[np.ndarray, np.ndarray]:
    """Pushes the strokes that `choose` picks, and matches each with the nearest stroke of the plan that is still to come.

    Returns:
      The order [P, MOST] in which the plan's strokes were matched, and the maps before each push; NaN after a stroke that is
      near none of them.
    """
    maps, every = [start], np.arange(len(start))
    order = np.tile(np.arange(MOST), (len(start), 1))
    for k in range(MOST):
        after = np.full_like(start, np.nan)
        here = every[(numbers > k) & np.isfinite(maps[-1]).all((1, 2)) & np.isfinite(goal).all((1, 2))]
        if len(here):
            made = choose(goal[here], maps[-1][here])
            ways = np.take_along_axis(strokes[here], order[here][..., None], 1)
            off = np.minimum(*(np.abs(ways - turned[:, None]).max(-1) for turned in (made, made[:, [2, 3, 0, 1]])))
            off[(np.arange(MOST) < k) | (np.arange(MOST) >= numbers[here, None])] = np.inf
            best = off.argmin(1)
            order[here, k], order[here, best] = order[here, best], order[here, k]
            after[here] = pushed(scene, maps[-1][here], made)
            after[here[off.min(1) > _ASTRAY]] = np.nan
        maps.append(after)
    return order, np.stack(maps[:-1])
