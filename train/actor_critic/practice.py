"""What the actor-critic practises: goals that random strokes leave, and two ways to each of them."""

from collections.abc import Callable
from dataclasses import dataclass

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


@dataclass(frozen=True)
class _Way:
    """States on the way of episodes, each with the stroke that was gone on with (`taken`, [N, 4]) and what `choose` gave."""

    goal: np.ndarray
    current: np.ndarray
    taken: np.ndarray
    left: np.ndarray
    best: np.ndarray
    drawn: np.ndarray


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
    current, taken = before[number, which], strokes[which, number] / SPACING
    plan = _Way(goal[which], current, taken, numbers[which] - number - 1, *choose(goal[which], current))
    both = _joined([plan, _own_way(scene, rng, goal, numbers, choose)])
    others = [_near(rng, both.taken) for _ in range(_AROUND)]
    others += [both.best, _near(rng, both.best), rng.uniform(LOW, HIGH, both.best.shape)]
    every = np.concatenate([np.stack([both.taken, *others], 1), both.drawn[:, : tries - _FEWEST]], 1).astype(np.float32)
    after = _after(scene, both.current, every)
    return Tries(both.goal, both.current, every, after, both.left), 2 * int(numbers.sum()) + every[..., 0].size


def _own_way(scene: Scene, rng: np.random.Generator, goal: np.ndarray, numbers: np.ndarray, choose: Choose) -> _Way:
    """The states on the way of what `choose` values most, in each episode as many as `numbers` [P] says."""
    parts, episodes, current = [], [], np.zeros_like(goal)
    for k in range(int(numbers.max(initial=1))):
        here = np.flatnonzero(numbers > k)
        best, drawn = choose(goal[here], current[here])
        taken = np.where(rng.random((len(here), 1)) < _NOISY, _near(rng, best), best)
        parts.append(_Way(goal[here], current[here], taken, numbers[here] - k - 1, best, drawn))
        episodes.append(here)
        current[here] = _after(scene, current[here], taken[:, None])[:, 0]
    joined, order = _joined(parts), np.argsort(np.concatenate(episodes), kind="stable")
    return _Way(*(part[order] for part in vars(joined).values()))


def _joined(ways: list[_Way]) -> _Way:
    return _Way(*(np.concatenate(parts) for parts in zip(*(vars(one).values() for one in ways), strict=True)))


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
