"""Tasks on real sand for which the binary model fails: berms count, order counts, or nothing is dug."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache

import numpy as np

from jaxsand.goals import metrics, surfaces
from jaxsand.goals.surfaces import rested, rough_surface
from jaxsand.goals.usual import SHAPE, SPACING, usual_scene
from jaxsand.planning.search.actions import Actions, Lattice, Steps
from jaxsand.planning.search.rollouts import replay
from jaxsand.scene.grid import places
from jaxsand.scene.scene import Scene
from jaxsand.scene.tools import Blade


@dataclass(frozen=True)
class SandTask:
    """A planning task.

    Attributes:
      name: for tables.
      scene: grid, sand and blade.
      height: the map [H, W] (m) to start from, at rest.
      goal: [H, W] (m), compared with berms.
      strokes: how many strokes or legs are allowed.
      actions: their kind.
    """

    name: str
    scene: Scene
    height: np.ndarray
    goal: np.ndarray
    strokes: int
    actions: Actions


@cache
def sand_task(name: str) -> SandTask:
    """The task of a name in `SAND_TASKS`, on 32 x 32 cells of 0.01 m."""
    if name not in SAND_TASKS:
        raise ValueError(f"task: got {name!r}; give one of {', '.join(SAND_TASKS)}")
    return SAND_TASKS[name]()


def _crossing() -> SandTask:
    """Three trenches that cross: each pushes its berm into those dug before."""
    return _drawn("crossing", [[0.06, 0.16, 0.26, 0.16], [0.16, 0.06, 0.16, 0.26], [0.08, 0.08, 0.24, 0.24]])


def _twin() -> SandTask:
    """Two trenches so close that the berm of the second falls into the first."""
    return _drawn("twin trenches", [[0.06, 0.14, 0.26, 0.14], [0.26, 0.175, 0.06, 0.175]])


def _zigzag() -> SandTask:
    """Three strokes of a zigzag and one across them."""
    strokes = [[0.06, 0.08, 0.26, 0.12], [0.26, 0.12, 0.06, 0.17], [0.06, 0.17, 0.26, 0.22], [0.16, 0.05, 0.16, 0.27]]
    return _drawn("zigzag", strokes)


def _frame() -> SandTask:
    """A closed square of four trenches, whose last stroke fills a corner of the first."""
    strokes = [[0.08, 0.08, 0.24, 0.08], [0.24, 0.08, 0.24, 0.24], [0.24, 0.24, 0.08, 0.24], [0.08, 0.24, 0.08, 0.08]]
    return _drawn("frame", strokes)


def _ridge() -> SandTask:
    """A trench at the foot of a ridge that is to stay, with its sand on the far side only; no strokes reach that goal."""
    scene = _scene(Blade())
    x, y = places(SHAPE, SPACING)
    ridge = rested(scene, 0.02 * ((np.abs(y - 0.19) < 0.015) & (np.abs(x - 0.16) < 0.11)))
    level = np.zeros(SHAPE, np.float32)
    trench = np.where(y < 0.145, replay(scene, level, [np.array([[0.06, 0.13], [0.26, 0.13]])]), 0)
    return SandTask("trench by a ridge", scene, ridge, ridge + trench - trench.mean(), 3, Lattice())


def _pit() -> SandTask:
    """A heap beside a pit of the same size, to be levelled with a blade that scrapes at height 0."""
    x, y = places(SHAPE, SPACING)
    pit = 0.03 * (np.hypot(x - 0.1, y - 0.16) < 0.04) - 0.03 * (np.hypot(x - 0.21, y - 0.16) < 0.04)
    return _levelling("pit from a heap", pit, 8)


def _rough() -> SandTask:
    """A rough surface to be levelled."""
    return _levelling("rough surface", rough_surface(np.random.default_rng(5), SHAPE, 0.022, 1.6), 12)


def _terrain() -> SandTask:
    """A patch of real terrain, of 3 cm relief, to be levelled."""
    land = metrics.resample(surfaces.terrain()[100:200, 100:200], SHAPE)
    return _levelling("terrain", 0.03 * (land - np.median(land)) / (land.max() - land.min()), 12)


def _stem() -> SandTask:
    """The letter T in one path, as it is written: along the bar, back to its middle, down the stem."""
    steps = Steps(cell=3, margin=1)
    side = 1.15 * steps.cell * SPACING
    scene = _scene(Blade(side, side, 0.003))
    places = [(8, c) for c in range(1, 9)] + [(8, c) for c in range(7, 4, -1)] + [(r, 5) for r in range(7, 0, -1)]
    path = (steps.margin + (np.array(places)[:, ::-1] + 0.5) * steps.cell) * SPACING
    level = np.zeros(SHAPE, np.float32)
    return SandTask("T in one path", scene, level, replay(scene, level, [path]), len(places) - 1, steps)


SAND_TASKS: dict[str, Callable[[], SandTask]] = {
    "crossing": _crossing,
    "twin": _twin,
    "zigzag": _zigzag,
    "frame": _frame,
    "ridge": _ridge,
    "pit": _pit,
    "rough": _rough,
    "terrain": _terrain,
    "stem": _stem,
}
"""Tasks by short name; `sand_task` builds one."""


def _drawn(name: str, strokes: list[list[float]]) -> SandTask:
    """A task whose goal is what the given strokes leave on level sand, with berms."""
    scene, level = _scene(Blade()), np.zeros(SHAPE, np.float32)
    goal = replay(scene, level, [np.array(stroke).reshape(2, 2) for stroke in strokes])
    return SandTask(name, scene, level, goal, len(strokes), Lattice())


def _levelling(name: str, height: np.ndarray, strokes: int) -> SandTask:
    """A task to level a surface, with a blade 4 cm wide that scrapes at height 0."""
    scene = _scene(Blade(width=0.04, thickness=0.015, depth=0.0))
    height = rested(scene, height)
    return SandTask(name, scene, height - height.mean(), np.zeros(SHAPE), strokes, Lattice())


def _scene(blade: Blade) -> Scene:
    return usual_scene(tool=blade)
