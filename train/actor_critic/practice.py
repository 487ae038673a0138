"""What the actor-critic practises: goals that random strokes leave, and two ways to each of them."""

from collections.abc import Callable

import numpy as np

from jaxsand.goals.usual import SPACING
from jaxsand.planning.stroke_loss import pushed
from jaxsand.scene.scene import Scene, blade_of
from train.actor_critic.memory import Tries
from train.actor_critic.network import HIGH, LOW
from train.imitation.lessons import way
from train.imitation.plans import MOST, anywhere, random_plans

Choose = Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]
"""From goals and current maps [N, H, W] in units of the blade's depth to the strokes [N, 4] (cells) that are valued most,
and others [N, C, 4] that the actor draws."""

_NOISY = 0.4  # of the strokes of its own way
_NEAR = (-0.7, 0.5)  # logarithms to base 10 of the least and the largest standard deviation (cells) of noise
_AROUND = 2  # tries around the stroke that an episode goes on with
_FEWEST = _AROUND + 4  # tries from a state: that stroke, those around it, the best and one around it, and one anywhere


def practise(scene: Scene, rng: np.random.Generator, plans: int, tries: int, choose: Choose) -> tuple[Tries, int]:
    """Practises on goals that random plans of strokes leave of level sand.

    There are two episodes for each goal: the plan's own strokes, and those that `choose` values most, 40% of them with
    noise. From every state on the way further strokes are tried.

    Args:
      scene: grid, sand and blade.
      rng: draws the plans, the noise and the strokes.
      plans: how many goals.
      tries: how many strokes are tried from each state, 6 or more.
      choose: chooses strokes.

    Returns:
      The tries, and how many strokes were pushed.

    Raises:
      ValueError: for fewer tries.
    """
    if tries < _FEWEST:
        raise ValueError(f"tries: got {tries}; give {_FEWEST} or more")
    strokes, numbers = random_plans(rng, plans)
    strokes, depth = anywhere(rng, strokes), float(blade_of(scene).depth)
    goal, before = way(scene, np.zeros((plans, *scene.grid.shape), np.float32), strokes, numbers)
    clean = np.isfinite(goal).all((1, 2))
    strokes, numbers, goal, before = strokes[clean], numbers[clean], goal[clean] / depth, before[:, clean] / depth
    which, number = np.nonzero(np.arange(MOST) < numbers[:, None])
    left = numbers[which] - number - 1

    def tried(goal: np.ndarray, current: np.ndarray, taken: np.ndarray | None, left: np.ndarray) -> Tries:
        best, drawn = choose(goal, current)
        if taken is None:
            taken = np.where(rng.random((len(best), 1)) < _NOISY, _near(rng, best), best)
        near = [_near(rng, taken) for _ in range(_AROUND)]
        one = rng.uniform(LOW, HIGH, best.shape)
        others = np.stack([taken, *near, best, _near(rng, best), one], 1)
        others = np.concatenate([others, drawn[:, : tries - _FEWEST]], 1).astype(np.float32)
        return Tries(goal, current, others, _after(scene, current, others), left)

    first = tried(goal[which], before[number, which], strokes[which, number] / SPACING, left)
    parts, current = [], np.zeros_like(goal)
    for k in range(int(numbers.max(initial=0))):
        here = np.flatnonzero(numbers > k)
        parts.append(tried(goal[here], current[here], None, numbers[here] - k - 1))
        current[here] = parts[-1].after[:, 0]
    order = np.argsort(np.concatenate([np.flatnonzero(numbers > k) for k in range(len(parts))]), kind="stable")
    every = [np.concatenate([getattr(part, name) for part in parts])[order] for name in vars(first)]
    both = Tries(*(np.concatenate([a, b]) for a, b in zip(vars(first).values(), every, strict=True)))
    return both, int(numbers.sum()) + both.strokes[..., 0].size


def _near(rng: np.random.Generator, strokes: np.ndarray) -> np.ndarray:
    """Strokes [N, 4] (cells) with normal noise, of another size for each."""
    size = 10 ** rng.uniform(*_NEAR, (len(strokes), 1))
    return np.clip(strokes + size * rng.standard_normal(strokes.shape), LOW, HIGH)


def _after(scene: Scene, current: np.ndarray, strokes: np.ndarray) -> np.ndarray:
    """What strokes [N, K, 4] (cells) leave of maps [N, H, W] in units of the blade's depth, [N, K, H, W].

    A stroke whose outcome is not clean leaves the map as it is, so that it gains nothing.
    """
    depth = float(blade_of(scene).depth)
    maps = np.repeat(current, strokes.shape[1], axis=0)
    after = pushed(scene, maps * depth, strokes.reshape(-1, 4) * SPACING) / depth
    clean = np.isfinite(after).all((1, 2), keepdims=True)
    return np.where(clean, after, maps).reshape(*strokes.shape[:2], *current.shape[1:])
