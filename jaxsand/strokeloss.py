"""How far plans of strokes end from a goal: many at once, through the simulator, and counted.

A vmapped push takes as long as the longest of its strokes, so strokes are sorted by length and pushed in groups of like
length, each core taking the next group, longest first. While the blade is down only a window around it is computed; what
touches the window's edge is pushed again on the whole map. `Whole` and windows give the same maps up to rounding (1e-7 m).
"""

from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import cache
from typing import Any, Protocol

import jax
import numpy as np

from jaxsand.batch import cores, wide_vectors
from jaxsand.rules import Outcome
from jaxsand.scene import Scene
from jaxsand.sim import step, step_batch
from jaxsand.task import fits
from jaxsand.window import Whole, Window

GRADIENT = 4
"""Calls that going back through one stroke costs, as `jaxsand bench grad` measures it, rounded up."""

_SIZES = (8, 16, 32, 64)  # of a group, on a CPU: a few, so that a scene compiles a few programs
_PULLED = 16  # the most that are pulled back together, on a CPU: their tapes stay in a core's cache
_WINDOW = (16, 16)


Weigh = Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]
"""A loss of differences [P, H, W] (m): its values [P], and its gradient [P, H, W]."""


@dataclass(frozen=True)
class Best:
    """The best plan [N, 4] (m) after so many calls, and its loss (m^2)."""

    calls: int
    loss: float
    strokes: np.ndarray


class Evaluate(Protocol):
    """What a search may ask. Every stroke of every candidate is one call."""

    @property
    def start(self) -> np.ndarray:
        """The map before the first stroke."""

    def __call__(self, candidates: np.ndarray) -> np.ndarray:
        """The losses [P] of plans [P, N, 4] (m)."""

    def after(self, maps: np.ndarray, strokes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The losses [P] and the maps after one more stroke [P, 4] (m) on each of `maps` [P, ...]."""


@dataclass(frozen=True)
class SandLoss:
    """The squared l2 distance (m^2) from `goal` [H, W] (m) of what strokes leave of `start` [H, W] (m), which is at rest.

    Infinite where the simulator says that its outcome is not clean.
    """

    scene: Scene
    start: np.ndarray
    goal: np.ndarray

    def __post_init__(self) -> None:
        fits(self.scene, self.start, "start")
        fits(self.scene, self.goal)

    def __call__(self, candidates: np.ndarray) -> np.ndarray:
        return self._loss(self.maps(candidates))

    def after(self, maps: np.ndarray, strokes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        maps = pushed(self.scene, maps, strokes)
        return self._loss(maps), maps

    def maps(self, candidates: np.ndarray) -> np.ndarray:
        """The maps [P, H, W] that plans [P, N, 4] leave; NaN where an outcome is not clean."""
        maps = np.repeat(self.start[None].astype(np.float32), len(candidates), axis=0)
        for k in range(candidates.shape[1]):
            maps = pushed(self.scene, maps, candidates[:, k])
        return maps

    def gradient(self, candidates: np.ndarray, weigh: Weigh) -> tuple[np.ndarray, np.ndarray]:
        """`weigh(maps - goal)` [P] of plans [P, N, 4] and its gradient by them; infinite, or NaN, where not clean.

        `weigh` also gives its own gradient by the difference. Backwards, stroke by stroke, as the maps on the way are kept.
        """
        maps = [np.repeat(self.start[None].astype(np.float32), len(candidates), axis=0)]
        for k in range(candidates.shape[1]):
            maps.append(pushed(self.scene, maps[-1], candidates[:, k]))
        value, back = weigh(maps[-1].astype(float) - self.goal)
        out = np.zeros(candidates.shape)
        for k in reversed(range(candidates.shape[1])):
            back, out[:, k] = _pulled(self.scene, maps[k], candidates[:, k], back)
        return np.where(np.isnan(value), np.inf, value), out

    @property
    def bounds(self) -> np.ndarray:
        """The lowest and the highest x0, y0, x1, y1 (m) of strokes from cell centre to cell centre of the map: [2, 4]."""
        rows, columns = self.scene.grid.shape
        high = np.array([columns - 1, rows - 1, columns - 1, rows - 1]) * float(self.scene.grid.spacing)
        return np.stack([np.zeros(4), high])

    def loss_of(self, height: np.ndarray) -> float:
        """The squared distance (m^2) of a map [H, W] (m) from the goal."""
        return float(self._loss(height))

    def _loss(self, maps: np.ndarray) -> np.ndarray:
        square = ((maps.astype(float) - self.goal) ** 2).sum((-2, -1))
        return np.where(np.isnan(square), np.inf, square)


def pushed(scene: Scene, maps: np.ndarray, strokes: np.ndarray) -> np.ndarray:
    """What one stroke [P, 4] (m) each leaves of maps [P, H, W] (m) at rest; NaN where the outcome is not clean."""
    maps, strokes = np.asarray(maps, np.float32), np.asarray(strokes, np.float32)
    if not _windowed(scene):
        return _by_length(scene, maps, strokes)[0]
    after, outcome = _by_length(replace(scene, window=Window(_WINDOW)), maps, strokes)
    again = np.flatnonzero(outcome & Outcome.WINDOW_EDGE)
    if again.size:
        after[again] = _by_length(scene, maps[again], strokes[again])[0]
    return after


def _by_length(scene: Scene, maps: np.ndarray, strokes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The maps after one stroke each, and their outcomes."""
    after, outcomes = np.empty_like(maps), np.zeros(len(maps), int)

    def one(group: np.ndarray, who: np.ndarray) -> tuple[Any, Any]:
        shaped = step_batch(scene, maps[who], strokes[who], chunk=len(who))
        return shaped.height, shaped.outcome

    for group, (height, outcome) in _grouped(strokes, _SIZES[-1], one):
        after[group], outcomes[group] = height, outcome
    after[(outcomes & ~Outcome.WINDOW_EDGE) != 0] = np.nan
    if isinstance(scene.window, Whole):
        after[outcomes != 0] = np.nan
    return after, outcomes


def _pulled(scene: Scene, maps: np.ndarray, strokes: np.ndarray, back: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The cotangents of maps [P, H, W] and strokes [P, 4] from those of what the strokes leave."""
    scene = replace(scene, window=Window(_WINDOW)) if _windowed(scene) else scene
    maps, strokes, back = (np.asarray(x, np.float32) for x in (maps, strokes, np.nan_to_num(back)))
    of_maps, of_strokes = np.empty_like(maps), np.empty_like(strokes)

    def one(group: np.ndarray, who: np.ndarray) -> tuple[Any, Any]:
        return _pull_program()(scene, maps[who], strokes[who], back[who])

    for group, (m, s) in _grouped(strokes, _PULLED, one):
        of_maps[group], of_strokes[group] = m, s
    return of_maps, of_strokes


@cache
def _pull_program() -> Any:
    def pull(scene: Scene, height: jax.Array, stroke: jax.Array, back: jax.Array) -> Any:
        return jax.vjp(lambda h, s: step(scene, h, s).height, height, stroke)[1](back)

    return jax.jit(jax.vmap(pull, in_axes=(None, 0, 0, 0)), compiler_options=wide_vectors())


def _grouped(strokes: np.ndarray, most: int, one: Callable) -> Iterator[tuple[np.ndarray, tuple]]:
    """What `one(group, padded group)` gives for groups of strokes of like length, as long as the group."""
    order = np.argsort(np.hypot(*(strokes[:, 2:] - strokes[:, :2]).T), kind="stable")[::-1]
    size = _size(len(order), most)
    groups = [order[i : i + size] for i in range(0, len(order), size)]

    def part(group: np.ndarray) -> tuple:
        out = one(group, np.concatenate([group, np.repeat(group[-1:], size - len(group))]))
        return tuple(np.asarray(x)[: len(group)] for x in out)

    with ThreadPoolExecutor(cores()) as pool:
        yield from zip(groups, pool.map(part, groups), strict=True)


def _windowed(scene: Scene) -> bool:
    """Whether a window around the blade saves work."""
    return isinstance(scene.window, Whole) and all(n >= m for n, m in zip(scene.grid.shape, _WINDOW, strict=True))


def _size(count: int, most: int) -> int:
    if jax.default_backend() != "cpu":
        return 1 << max(0, count - 1).bit_length()
    return next(size for size in _SIZES if size * cores() >= count or size == most)
