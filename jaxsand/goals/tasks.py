"""Earth-moving tasks: from a key to a scene, sand at rest, and a goal that says what matters.

task = js.tasks.make_task("ramp", key=3)
found = js.plan_sand(task.scene, task.start, task.goal, strokes=task.strokes, actions=js.Rising())
js.tasks.figures(task, found.height)
"""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from jaxsand.goals.goal import Goal
from jaxsand.goals.metrics import iou
from jaxsand.goals.outlines import inside
from jaxsand.goals.surfaces import places, rested, rough_surface, terrain_surface
from jaxsand.relaxation.stopping import check_whole
from jaxsand.scene.scene import Scene, make_scene
from jaxsand.scene.tools import Blade
from jaxsand.scene.validation import short

_CHANGED = 0.1  # of the largest change that is asked for: what counts as changed, and as done

Map = np.ndarray


@dataclass(frozen=True)
class Task:
    """A piece of earth to shape.

    Attributes:
        name: of its kind.
        scene: grid, sand, and a blade that suits it.
        start: the map [H, W] (m) before, at rest.
        goal: what is wanted, and what matters.
        cells: which cells are to be shaped, booleans [H, W]; elsewhere sand may have any height, or heaps may lie.
        strokes: how many strokes are meant to be enough.

    Example:
        >>> import jaxsand as js
        >>> task = js.tasks.make_task("box-trench", key=0)
        >>> task.start.shape, bool(task.goal.cost(task.start) > 0)
        ((32, 32), True)
    """

    name: str
    scene: Scene
    start: Map
    goal: Goal
    cells: Map
    strokes: int


def make_task(name: str, key: int = 0) -> Task:
    """The task of a kind that a key, a whole number, stands for; the same key makes the same task.

    Args:
        name: one of `TASKS`.
        key: 0 or more; each makes another instance.

    Returns:
        The task: its scene, start, goal, the cells to be shaped, and how many strokes it allows.

    Raises:
        ValueError: for a name that does not exist, or a key below 0.

    Example:
        >>> import jaxsand as js
        >>> task = js.tasks.make_task("ramp", key=7)
        >>> task.scene.grid.shape, task.strokes
        ((16, 32), 24)
    """
    if not isinstance(name, str) or name not in TASKS:
        raise ValueError(f"name: got {short(name)}; give one of {', '.join(TASKS)}")
    check_whole("key", key, 0)
    return TASKS[name](np.random.default_rng(key))


def figures(task: Task, height: Map) -> dict[str, float | None]:
    """How near a result comes to a task's goal, by the measures of several fields.

    Over the cells to be shaped: `mean_mm`, the mean |h - g|; `before_mm`, the same before; `changed`, the share that
    changed by more than a tenth of the largest change asked for. Elsewhere, where holes matter: `dug_outside_mm`, the mean
    of what is lower than the goal. As Terra has them (leggedrobotics/terra-baselines), of the cells to be dug: `coverage`,
    the share at or below the goal, and `completion`, whether all are, with a tenth of the largest change to spare. And
    `iou`, of what is lower than the start by half the largest change; these three are None where nothing is to be dug.
    `distance` is by the goal's own cost (m), and `reduction` the share of it that is gone.

    Args:
        task: the task.
        height: the map [H, W] (m) that came of it.

    Returns:
        The measures by name; lengths in mm but for `distance`, shares from 0 to 1.

    Raises:
        ValueError: for a map of another shape.

    Example:
        >>> import jaxsand as js
        >>> task = js.tasks.make_task("box-trench", key=0)
        >>> found = js.tasks.figures(task, task.start)
        >>> found["mean_mm"] == found["before_mm"], found["coverage"], found["reduction"]
        (True, 0.0, 0.0)
    """
    height, start = np.asarray(height, float), np.asarray(task.start, float)
    if height.shape != start.shape:
        raise ValueError(f"height: got shape {list(height.shape)}, the task has {list(start.shape)}; give one map [H, W]")
    wanted = np.where(np.isnan(task.goal.height), start, task.goal.height)
    asked = np.where(task.cells, wanted - start, 0)
    largest = float(np.abs(asked).max())
    dig = asked < -_CHANGED * largest
    deep = height <= wanted + _CHANGED * largest
    others = ~task.cells & ~task.goal.free & (np.asarray(task.goal.below) > 0)
    before, after = (float(task.goal.distance(h)) for h in (start, height))
    return {
        "mean_mm": 1e3 * float(np.abs(height - wanted)[task.cells].mean()),
        "before_mm": 1e3 * float(np.abs(asked)[task.cells].mean()),
        "dug_outside_mm": 1e3 * float(np.maximum(wanted - height, 0)[others].mean()) if others.any() else 0.0,
        "changed": float((np.abs(height - start)[task.cells] > _CHANGED * largest).mean()),
        "coverage": float(deep[dig].mean()) if dig.any() else None,
        "completion": float(deep[dig].all()) if dig.any() else None,
        "iou": float(iou(asked, np.where(task.cells, height - start, 0), largest)) if dig.any() else None,
        "distance": after,
        "reduction": 1 - after / before if before else 0.0,
    }


def _level(rng: np.random.Generator) -> Task:
    """Rough ground of 20 mm relief, to be levelled everywhere."""
    scene = _scene((32, 32), 0.01, Blade(width=0.08, thickness=0.02, depth=0.0))
    start = rested(scene, rough_surface(rng, scene.grid.shape, 0.02, 1.6))
    everywhere = np.ones(scene.grid.shape, bool)
    return Task("level", scene, start, Goal(np.full(scene.grid.shape, start.mean())), everywhere, 24)


def _pad(rng: np.random.Generator) -> Task:
    """A level place of 0.28 x 0.16 m in rough ground of 40 mm relief, at the ground's mean height there."""
    scene = _scene((16, 32), 0.02, Blade(width=0.1, thickness=0.03, depth=0.0))
    start = rested(scene, rough_surface(rng, scene.grid.shape, 0.04, 1.0))
    x, y = _places(scene)
    cells = (abs(x - 0.32) < 0.15) & (abs(y - 0.16) < 0.08)
    return _where(scene, "pad", start, np.full(start.shape, start[cells].mean()), cells, 24)


def _ramp(rng: np.random.Generator) -> Task:
    """A ramp 0.28 m long and 0.16 m wide that climbs 40 to 60 mm in 0.3 m either way, from sand at half its height."""
    scene = _scene((16, 32), 0.02, Blade(width=0.1, thickness=0.03, depth=0.0))
    x, y = _places(scene)
    cells = (abs(x - 0.32) < 0.15) & (abs(y - 0.16) < 0.08)
    rise = rng.uniform(0.04, 0.06) * rng.choice([-1, 1])
    return _where(scene, "ramp", np.zeros(cells.shape, np.float32), rise * (x - 0.32) / 0.3, cells, 24)


def _v_trench(rng: np.random.Generator) -> Task:
    """A trench whose sides fall at 15 to 25 degrees, 10 to 15 mm deep, at any heading; heaps may lie beside it."""
    scene = _scene((32, 32), 0.01, Blade(width=0.04, thickness=0.015, depth=0.0))
    along, across = _turned(scene, rng)
    slope = math.tan(rng.uniform(math.radians(15), math.radians(25)))
    depth = np.where(abs(along) < 0.1, rng.uniform(0.01, 0.015), 0)
    return _dig(scene, "v-trench", -np.maximum(depth - slope * abs(across), 0), 8)


def _box_trench(rng: np.random.Generator) -> Task:
    """A trench with a flat floor 20 to 40 mm wide and 10 to 15 mm deep, its walls at rest; heaps may lie beside it."""
    scene = _scene((32, 32), 0.01, Blade(width=0.04, thickness=0.015, depth=0.0))
    along, across = _turned(scene, rng)
    inside = (abs(along) < 0.1) & (abs(across) < rng.uniform(0.01, 0.02))
    return _dig(scene, "box-trench", np.where(inside, -rng.uniform(0.01, 0.015), 0), 8)


def _pit_and_heap(rng: np.random.Generator) -> Task:
    """A pit, and beside it a heap of what was in it."""
    scene = _scene((32, 32), 0.01, Blade(width=0.06, thickness=0.015, depth=0.0))
    along, across = _turned(scene, rng)
    radius, depth = rng.uniform(0.035, 0.05), rng.uniform(0.01, 0.02)
    pit, heap = (np.hypot(along - side * 0.07, across) < radius for side in (-1, 1))
    shape = np.where(pit, -depth, 0) + np.where(heap, depth * pit.sum() / max(heap.sum(), 1), 0)
    wanted = rested(scene, shape)
    cells = abs(wanted) > 1e-4
    return Task("pit-and-heap", scene, _flat(scene), Goal(wanted), cells, 12)


def _ring(rng: np.random.Generator) -> Task:
    """A berm around a circle, 8 to 12 mm high; its sand may be taken from anywhere."""
    scene = _scene((32, 32), 0.01, Blade(width=0.05, thickness=0.015, depth=0.0))
    x, y = _places(scene)
    away = abs(np.hypot(x - 0.16, y - 0.16) - rng.uniform(0.06, 0.08))
    wanted = np.maximum(rng.uniform(0.008, 0.012) - math.tan(math.radians(20)) * away, 0)
    return _where(scene, "ring", _flat(scene), wanted, wanted > 0, 24)


def _spread(rng: np.random.Generator) -> Task:
    """A truck's heap, to be spread evenly over the bed."""
    scene = _scene((32, 32), 0.01, Blade(width=0.08, thickness=0.02, depth=0.0))
    x, y = _places(scene)
    centre, radius = rng.uniform(0.1, 0.22, 2), rng.uniform(0.05, 0.07)
    heap = rng.uniform(0.02, 0.03) * (np.hypot(x - centre[0], y - centre[1]) < radius)
    start = rested(scene, heap)
    return Task("spread", scene, start, Goal(np.full(start.shape, start.mean())), np.ones(start.shape, bool), 24)


def _profile(rng: np.random.Generator) -> Task:
    """Rough ground to be cut and filled to waves along a road 0.16 m wide."""
    scene = _scene((16, 32), 0.02, Blade(width=0.1, thickness=0.03, depth=0.0))
    start = rested(scene, rough_surface(rng, scene.grid.shape, 0.02, 1.5))
    x, y = _places(scene)
    wave = 0.015 * np.sin(2 * math.pi * (x / rng.uniform(0.3, 0.5) + rng.random()))
    cells = (abs(x - 0.32) < 0.25) & (abs(y - 0.16) < 0.08)
    return _where(scene, "profile", start, wave - wave[cells].mean() + start[cells].mean(), cells, 36)


def _foundation(rng: np.random.Generator) -> Task:
    """The outline of a house as a trench 8 to 12 mm deep; heaps may lie outside of it, but nothing may lie within."""
    scene = _scene((40, 40), 0.01, Blade(width=0.03, thickness=0.015, depth=0.0))
    x, y = _places(scene)
    long, wide = rng.uniform(0.1, 0.13), rng.uniform(0.07, 0.1)
    outside = np.maximum(abs(x - 0.2) - long, abs(y - 0.2) - wide)
    wanted = rested(scene, np.where(abs(outside) < 0.012, -rng.uniform(0.008, 0.012), 0))
    cells = abs(wanted) > 1e-4
    return Task("foundation", scene, _flat(scene), Goal(wanted, above=(cells | (outside < 0)) * 1.0), cells, 16)


def _relief(rng: np.random.Generator) -> Task:
    """A relief of 20 mm on 64 x 64 cells, a patch of real terrain, from level sand."""
    scene = _scene((64, 64), 0.01, Blade(width=0.06, thickness=0.015, depth=0.0))
    land = terrain_surface((128, 128), 1.0)
    row, column = rng.integers(0, 64, 2)
    patch = land[row : row + 64, column : column + 64]
    wanted = rested(scene, 0.02 * (patch - patch.min()) / np.ptp(patch))
    return Task("relief", scene, _flat(scene), Goal(wanted - wanted.mean()), np.ones(wanted.shape, bool), 100)


def _rectangle(rng: np.random.Generator) -> Task:
    """A rectangle 40 to 60 mm wide and 5 to 20 mm deep, after Kreis et al. 2025, at rest; heaps may lie around it."""
    width, length = rng.uniform(0.04, 0.06), rng.uniform(0.06, 0.2)
    return _at_rest(rng, "rectangle", [(_oblong(length, width), rng.uniform(0.005, 0.02))])


def _corner(rng: np.random.Generator) -> Task:
    """An L with legs of 60 to 100 mm, 30 to 50 mm thick and 5 to 20 mm deep, after Kreis et al. 2025, at rest."""
    return _at_rest(rng, "L", [(_l_shape(rng), rng.uniform(0.005, 0.02))])


def _polygon(rng: np.random.Generator) -> Task:
    """A polygon 75 to 100 mm wide and 10 to 30 mm deep, with one or two smaller, deeper ones, after Kreis et al. 2025."""
    outline, depth = _round(rng), rng.uniform(0.01, 0.03)
    steps = [(outline, depth)]
    for _ in range(rng.integers(1, 3)):
        outline, depth = outline * rng.uniform(0.7, 0.9), depth + rng.uniform(0.002, 0.005)
        steps.append((outline, depth))
    return _at_rest(rng, "polygon", steps)


def _vertical(rng: np.random.Generator) -> Task:
    """One of the shapes above as it is drawn, with vertical walls, which sand keeps only where they are low."""
    shape = (_l_shape, _round, lambda r: _oblong(r.uniform(0.06, 0.2), r.uniform(0.04, 0.06)))[rng.integers(3)](rng)
    return _at_rest(rng, "vertical", [(shape, rng.uniform(0.005, 0.02))], rest=False)


TASKS: dict[str, Callable[[np.random.Generator], Task]] = {
    "level": _level,
    "pad": _pad,
    "ramp": _ramp,
    "v-trench": _v_trench,
    "box-trench": _box_trench,
    "pit-and-heap": _pit_and_heap,
    "ring": _ring,
    "spread": _spread,
    "profile": _profile,
    "foundation": _foundation,
    "relief": _relief,
    "rectangle": _rectangle,
    "L": _corner,
    "polygon": _polygon,
    "vertical": _vertical,
}
"""What makes a task of each kind from a generator of random numbers."""


def _oblong(length: float, width: float) -> np.ndarray:
    """The corners [4, 2] (m) of a rectangle."""
    return np.array([[0, 0], [length, 0], [length, width], [0, width]])


def _l_shape(rng: np.random.Generator) -> np.ndarray:
    (a, b), wide = rng.uniform(0.06, 0.1, 2), rng.uniform(0.03, 0.05)
    return np.array([[0, 0], [a, 0], [a, wide], [wide, wide], [wide, b], [0, b]])


def _round(rng: np.random.Generator) -> np.ndarray:
    """A polygon of 4 to 15 corners around the origin, 75 to 100 mm wide."""
    angles = np.sort(rng.uniform(0, 2 * math.pi, rng.integers(4, 16)))
    corners = rng.uniform(0.7, 1, len(angles))[:, None] * np.stack([np.cos(angles), np.sin(angles)], 1)
    return corners * rng.uniform(0.075, 0.1) / np.ptp(corners, axis=0).max()


def _at_rest(rng: np.random.Generator, name: str, steps: list[tuple[np.ndarray, float]], rest: bool = True) -> Task:
    """Level sand on a bed of 60 x 30 cells, out of which shapes are to be dug, each corners [n, 2] and a depth (m)."""
    scene = make_scene((30, 60), 0.01, math.radians(30), tool=Blade(width=0.04, thickness=0.015, depth=0.0))
    outline = steps[0][0]
    room = np.array([0.6, 0.3]) - 0.06 - np.ptp(outline, axis=0)
    move = 0.03 - outline.min(0) + rng.random(2) * np.maximum(room, 0)
    shape = _flat(scene).astype(float)
    for corners, depth in steps:
        shape[inside(corners + move, scene.grid)] = -depth
    return _dig(scene, name, shape, 24, rest)


def _dig(scene: Scene, name: str, shape: Map, strokes: int, rest: bool = True) -> Task:
    """Level sand from which a shape is to be dug; elsewhere heaps may lie, but no holes."""
    wanted = rested(scene, shape) if rest else shape.astype(np.float32)
    cells = wanted < -1e-4
    return Task(name, scene, _flat(scene), Goal(wanted, above=cells * 1.0), cells, strokes)


def _where(scene: Scene, name: str, start: Map, wanted: Map, cells: Map, strokes: int) -> Task:
    """Some cells are to be shaped, and the others are free."""
    return Task(name, scene, start, Goal(np.where(cells, wanted, np.nan)), cells, strokes)


def _scene(shape: tuple[int, int], spacing: float, blade: Blade) -> Scene:
    return make_scene(shape, spacing, tool=blade)


def _flat(scene: Scene) -> Map:
    return np.zeros(scene.grid.shape, np.float32)


def _places(scene: Scene) -> tuple[Map, Map]:
    """Where cells lie, x and y [H, W] (m)."""
    return places(scene.grid.shape, float(scene.grid.spacing))


def _turned(scene: Scene, rng: np.random.Generator) -> tuple[Map, Map]:
    """Where cells lie along and across a random heading, from the middle of the map (m)."""
    x, y = _places(scene)
    angle, x, y = rng.uniform(0, math.pi), x - x.mean(), y - y.mean()
    return x * math.cos(angle) + y * math.sin(angle), y * math.cos(angle) - x * math.sin(angle)
