"""What the actor-critic remembers, and learns from in hindsight: states, and what strokes tried from each of them left.

Every state keeps the strokes tried from it, so the U-Net, which is nearly all of the work, sees it once for all of them.
Rewards are computed when a state is drawn, for its own goal or for one in hindsight (Andrychowicz et al. 2017,
arXiv:1707.01495): the result of this or a later stroke of its episode, or of another stroke tried from it.
"""

from dataclasses import dataclass, fields

import jax
import numpy as np

from jaxsand.goals.usual import SHAPE
from train.replay.reward import far

_OWN, _TRIED = 0.4, 0.1  # shares of states that keep their goal, and whose goal is what a stroke tried from them left


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Tries:
    """Strokes tried on the way of episodes: from each of N states K strokes, of which the first was gone on with.

    Maps are in units of the blade's depth. The states of an episode follow one another.

    Attributes:
      goal, current: [N, H, W].
      strokes: [N, K, 4] (cells).
      after: [N, K, H, W] what each stroke left.
      left: [N] how many states of the same episode follow.
    """

    goal: np.ndarray
    current: np.ndarray
    strokes: np.ndarray
    after: np.ndarray
    left: np.ndarray


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Memory:
    """A ring of tries, maps in half precision, and how many were ever `added`."""

    ring: Tries
    added: np.ndarray


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Batch:
    """States to learn from, with goals in hindsight or their own.

    Attributes:
      goal, current: maps [B, H, W] in units of the blade's depth.
      strokes: [B, K, 4] (cells).
      reward: [B, K] of the strokes.
    """

    goal: np.ndarray
    current: np.ndarray
    strokes: np.ndarray
    reward: np.ndarray


def empty(capacity: int, tries: int) -> Memory:
    """A memory of `capacity` states with as many `tries` from each, none of them there yet."""
    maps = np.zeros((capacity, *SHAPE), np.float16)
    strokes, after = np.zeros((capacity, tries, 4), np.float32), np.zeros((capacity, tries, *SHAPE), np.float16)
    return Memory(Tries(maps, maps.copy(), strokes, after, np.zeros(capacity, np.int32)), np.array(0))


def remembered(memory: Memory, tries: Tries) -> Memory:
    """A memory with more tries, in place of the oldest."""
    capacity, new = len(memory.ring.left), len(tries.left)
    if new > capacity:
        raise ValueError(f"capacity: got {capacity}, but a chunk has {new} states; remember more, or make fewer plans")
    where = (int(memory.added) + np.arange(new)) % capacity
    kept = {}
    for field in fields(Tries):
        kept[field.name] = getattr(memory.ring, field.name).copy()
        kept[field.name][where] = getattr(tries, field.name)
    return Memory(Tries(**kept), memory.added + new)


def draw(memory: Memory, rng: np.random.Generator, count: int) -> Batch:
    """Draws states with equal chances, each with its own goal or one in hindsight."""
    ring, capacity = memory.ring, len(memory.ring.left)
    which = rng.integers(min(int(memory.added), capacity), size=count)
    # An episode's later states are newer, so that they are still there.
    future = ring.after[(which + rng.integers(ring.left[which] + 1)) % capacity, 0]
    tried = ring.after[which, rng.integers(ring.strokes.shape[1], size=count)]
    chance = rng.random((count, 1, 1))
    goal = np.where(chance < _OWN, ring.goal[which], np.where(chance < _OWN + _TRIED, tried, future)).astype(np.float32)
    current, after = ring.current[which].astype(np.float32), ring.after[which].astype(np.float32)
    return Batch(goal, current, ring.strokes[which], far(goal, current)[:, None] - far(goal[:, None], after))
