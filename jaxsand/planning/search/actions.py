"""What a planner on real sand may do: strokes with the tool lifted in between, at the blade's depth or at heights of their
own, or steps with the tool down.
"""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from jaxsand.goals.goal import Goal
from jaxsand.scene.scene import Scene

Path = np.ndarray  # [n, 2]: x, y (m), or [n, 3]: x, y, z (m)


@dataclass(frozen=True)
class Lattice:
    """Tells `plan_sand` to use straight strokes, the tool lifted in between.

    Strokes are proposed with both ends on a lattice, and moved off it later where that brings the sand closer to the goal.

    Args:
      pitch: distance between the lattice's points, in grid spacings.
      shortest: the shortest stroke that is proposed, in grid spacings.
      longest: the longest stroke that is proposed or made, in grid spacings.

    Example:
      >>> import jaxsand as js
      >>> js.Lattice(pitch=2.0).longest
      inf
    """

    pitch: float = 1.0
    shortest: float = 2.0
    longest: float = math.inf


@dataclass(frozen=True)
class Steps:
    """Tells `plan_sand` to use one path with the tool down, in legs north, east, south or west.

    Corners are the centres of the blocks of `cell` x `cell` grid cells that fit on the map within the margin.

    Args:
      cell: length of a leg, in grid cells.
      margin: grid cells along the map's edge that the blocks keep clear of.

    Example:
      >>> import jaxsand as js
      >>> js.Steps(cell=3, margin=1)
      Steps(cell=3, margin=1)
    """

    cell: int = 6
    margin: int = 0


@dataclass(frozen=True)
class Rising:
    """Tells `plan_sand` to use straight strokes on which the tool may rise or sink, lifted in between.

    A stroke has the heights of the tool's bottom at its start and at its end, in place of the blade's own depth.

    Args:
      shortest: the shortest stroke that is proposed, in grid spacings; at the map's edges, which cut it off, it may be
        shorter.
      longest: the longest stroke that is made, in grid spacings.
      lowest: the least height that the tool's bottom may have (m).
      highest: the greatest height that it may have (m).

    Example:
      >>> import jaxsand as js
      >>> js.Rising(lowest=-0.02).highest
      inf
    """

    shortest: float = 2.0
    longest: float = math.inf
    lowest: float = -math.inf
    highest: float = math.inf

    def allowed(self, heights: np.ndarray) -> np.ndarray:
        """Heights that strokes may have: those given, brought within `lowest` and `highest`.

        Args:
          heights: of the tool's bottom at the start and the end of each stroke, [n, 2] (m).

        Returns:
          [n, 2] (m).
        """
        return np.clip(heights, self.lowest, self.highest)


@dataclass(frozen=True)
class Flat:
    """Tells `plan_sand` to use straight strokes, each at one height of its own, the tool lifted in between.

    With `lowest` equal to `highest`, all strokes are at that height.

    Args:
      shortest: the shortest stroke that is proposed, in grid spacings; at the map's edges, which cut it off, it may be
        shorter.
      longest: the longest stroke that is made, in grid spacings.
      lowest: the least height that the tool's bottom may have (m).
      highest: the greatest height that it may have (m).

    Example:
      >>> import jaxsand as js
      >>> js.Flat(lowest=-0.01, highest=-0.01).shortest
      2.0
    """

    shortest: float = 2.0
    longest: float = math.inf
    lowest: float = -math.inf
    highest: float = math.inf

    def allowed(self, heights: np.ndarray) -> np.ndarray:
        """Heights that strokes may have: at both ends the start's, brought within `lowest` and `highest`.

        Args:
          heights: of the tool's bottom at the start and the end of each stroke, [n, 2] (m).

        Returns:
          [n, 2] (m).
        """
        return np.clip(np.repeat(heights[:, :1], 2, axis=1), self.lowest, self.highest)


Actions = Lattice | Steps | Rising | Flat


@dataclass(frozen=True)
class Job:
    """A search to make.

    Attributes:
      scene: grid, sand and blade.
      height: the map [H, W] (m) to start from, at rest.
      goal: what is wanted, as `as_goal` makes it.
      strokes: the largest number of strokes or legs.
      actions: their kind.
    """

    scene: Scene
    height: np.ndarray
    goal: Goal
    strokes: int
    actions: Any


def longest_stroke(scene: Scene, actions: Actions) -> float:
    """The length of the longest stroke or leg that is allowed (m)."""
    spacing = float(scene.grid.spacing)
    if isinstance(actions, Steps):
        return actions.cell * spacing
    return min(actions.longest, math.hypot(*scene.grid.shape)) * spacing


def propose(
    scene: Scene, actions: Lattice, height: np.ndarray, goal: Goal, count: int, rng: np.random.Generator
) -> np.ndarray:
    """Draws random strokes [count, 4] (m) on the lattice that may bring `height` [H, W] closer to the goal.

    A quarter of the strokes each run from too much sand to too little, from too much to too much, from too much to anywhere,
    and from anywhere to anywhere.
    """
    spacing = float(scene.grid.spacing)
    points = _lattice(scene, actions)
    rows, columns = np.floor(points[:, ::-1] / spacing).astype(int).T
    surplus = _blurred(goal.off(height))[rows, columns]
    anywhere = np.full(len(points), 1 / len(points))
    much, little = shares(surplus, anywhere), shares(-surplus, anywhere)
    longest = longest_stroke(scene, actions) * (1 + 1e-9)
    found = np.zeros((0, 4))
    while len(found) < count:
        quarters = [
            np.concatenate([points[rng.choice(len(points), count // 2 + 4, p=share)] for share in pair], axis=1)
            for pair in ((much, little), (much, much), (much, anywhere), (anywhere, anywhere))
        ]
        drawn = rng.permutation(np.concatenate(quarters))
        length = np.hypot(*(drawn[:, 2:] - drawn[:, :2]).T)
        fitting = (length >= actions.shortest * spacing * (1 - 1e-9)) & (length <= longest) & (length > 0)
        found = np.concatenate([found, drawn[fitting]])
    return found[:count]


def moved(scene: Scene, actions: Lattice, strokes: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Moves strokes [n, 4] (m) at random, by about 0.05 to 3 spacings: by the start, the end, both alike, or both apart."""
    size = float(scene.grid.spacing) * np.exp(rng.uniform(np.log(0.05), np.log(3), (len(strokes), 1)))
    start, end = (rng.normal(size=(len(strokes), 2)) * size for _ in range(2))
    way = rng.integers(0, 4, (len(strokes), 1))
    end = np.where(way == 0, start, np.where(way == 1, 0, end))
    return confined(scene, actions, strokes + np.concatenate([np.where(way == 2, 0, start), end], axis=1))


def confined(scene: Scene, actions: Lattice, strokes: np.ndarray) -> np.ndarray:
    """Strokes [n, 4] (m) with both ends moved onto the map, and shortened to the allowed length."""
    spacing = float(scene.grid.spacing)
    rows, columns = scene.grid.shape
    low, high = spacing / 2, (np.array([columns, rows, columns, rows]) - 0.5) * spacing
    strokes = np.clip(strokes, low, high)
    run = strokes[:, 2:] - strokes[:, :2]
    length = np.hypot(*run.T)[:, None]
    longest = longest_stroke(scene, actions)
    run = run * np.where(length > longest, longest / np.where(length > 0, length, 1), 1)
    return np.concatenate([strokes[:, :2], strokes[:, :2] + run], axis=1)


def corners(scene: Scene, steps: Steps, offset: tuple[int, int] = (0, 0)) -> np.ndarray:
    """Where a path of steps may turn: [rows, columns, 2] of x, y (m), row 0 at y = 0; the blocks begin `offset` (row,
    column) later.
    """
    y, x = (
        (steps.margin + o + (np.arange((n - 2 * steps.margin - o) // steps.cell) + 0.5) * steps.cell)
        * float(scene.grid.spacing)
        for n, o in zip(scene.grid.shape, offset, strict=True)
    )
    return np.stack(np.meshgrid(x, y), axis=-1)


def _lattice(scene: Scene, actions: Lattice) -> np.ndarray:
    """The lattice's points [n, 2] = x, y (m)."""
    step = actions.pitch * float(scene.grid.spacing)
    rows, columns = (max(1, int(n / actions.pitch + 1e-9)) for n in scene.grid.shape)
    x, y = np.meshgrid((np.arange(columns) + 0.5) * step, (np.arange(rows) + 0.5) * step)
    return np.stack([x.ravel(), y.ravel()], axis=1)


def shares(amount: np.ndarray, otherwise: np.ndarray) -> np.ndarray:
    """Positive amounts as shares that sum to 1; `otherwise` where none is positive."""
    amount = np.maximum(amount, 0)
    return amount / amount.sum() if amount.sum() > 0 else otherwise


def _blurred(height: np.ndarray) -> np.ndarray:
    """Each cell averaged with its four neighbours, its own height counted twice."""
    p = np.pad(np.asarray(height, float), 1, mode="edge")
    return (2 * p[1:-1, 1:-1] + p[:-2, 1:-1] + p[2:, 1:-1] + p[1:-1, :-2] + p[1:-1, 2:]) / 6
