"""A ramp and a landing pad: what strokes at one depth leave of them, strokes with a depth each, and strokes that rise."""

import time
from dataclasses import dataclass

import numpy as np

from jaxsand.bench.tables import Row
from jaxsand.goals.goal import Goal
from jaxsand.goals.surfaces import rested, rough_surface
from jaxsand.planning.gradient import optimise_strokes
from jaxsand.planning.search import plan_sand
from jaxsand.planning.search.actions import Actions, Flat, Rising
from jaxsand.planning.stroke_loss import GRADIENT
from jaxsand.scene.grid import places
from jaxsand.scene.progress import Tell, quiet
from jaxsand.scene.scene import Scene, make_scene
from jaxsand.scene.tools import Blade
from jaxsand.viz.side import Side

_SHAPE, _SPACING = (16, 32), 0.02
_START, _END, _SIDES = 0.18, 0.48, (0.08, 0.24)  # of the ramp and the pad (m)
_RISE = 0.06
KINDS = ("one depth", "a depth each", "rising")


@dataclass(frozen=True)
class Work:
    """A piece of earth to shape.

    Attributes:
      name: for tables.
      scene: grid, sand and a blade 100 mm wide and 30 mm thick.
      height: the map [H, W] (m) before, at rest.
      goal: [H, W] (m), NaN outside of what is to be shaped.
      depth: depth of the blade below height 0 (m) for strokes at one depth.
      trial: mean errors (mm) of a first trial by `KINDS`, with 24 strokes; None where it tried none.
    """

    name: str
    scene: Scene
    height: np.ndarray
    goal: np.ndarray
    depth: float
    trial: dict[str, float]

    def error(self, height: np.ndarray) -> float:
        """The mean |height - goal| (mm) where the goal counts."""
        goal = Goal(self.goal, power=1)
        return float(1e3 * goal.cost(np.asarray(height, float)) / np.isfinite(self.goal).sum())


def ramp(name: str, level: float, depth: float, trial: dict[str, float]) -> Work:
    """A ramp 0.3 m long and 0.16 m wide that climbs 60 mm, from sand at `level` (m) over its foot, which lies at 0."""
    x, inside = _ground()
    slope = _RISE * (x - _START) / (_END - _START) - level
    return Work(name, _scene(), np.zeros(_SHAPE, np.float32), np.where(inside, slope, np.nan), depth, trial)


def pad() -> Work:
    """A level square of the ramp's size in rough ground of 40 mm relief, at the ground's mean height there."""
    _, inside = _ground()
    height = rested(_scene(), rough_surface(np.random.default_rng(5), _SHAPE, 0.04, 1.0))
    level = float(height[inside].mean())
    return Work("pad", _scene(), height, np.where(inside, level, np.nan), -level, {})


def works() -> tuple[Work, ...]:
    """All of them."""
    return (
        ramp("ramp, from half its height", _RISE / 2, 0.015, {"one depth": 4.8, "a depth each": 1.9, "rising": 0.33}),
        ramp("ramp, from its foot", 0.0, 0.015, {"one depth": 22.0, "a depth each": 7.7, "rising": 7.2}),
        pad(),
    )


def bench_ramps(
    tell: Tell = quiet,
    some: tuple[Work, ...] | None = None,
    strokes: int = 24,
    per_stroke: int = 200,
    steps: int = 30,
    seed: int = 0,
) -> dict[str, list[Row]]:
    """Each kind of strokes on each piece of earth: by search, and rising ones then by gradients.

    Errors are means of |height - goal| in mm, where the goal counts. A search has `per_stroke` pushes to each stroke, and
    gradients what `steps` of them cost. `trial_mm` is what a first trial reached, on an older push and with a search of its
    own.

    Returns:
      The rows, as `ramp`; and as `ramp_maps` what rising strokes leave of each piece, lists [H, W] (m), to be drawn.
    """
    rows, maps = [], []
    for work in works() if some is None else some:
        for kind in KINDS:
            tell(f"{work.name}: {kind}")
            row, height = _row(work, kind, (strokes, per_stroke, steps), seed, tell)
            rows.append(row)
        maps.append({"task": work.name, "after": height.tolist()})
    return {"ramp": rows, "ramp_maps": maps}


def shown(maps: list[Row]) -> list[Side]:
    """Each piece of earth that `bench_ramps` tells of, with its maps along the way up its middle."""
    known = {work.name: work for work in works()}
    y = sum(_SIDES) / 2
    found = []
    for one in maps:
        work = known[one["task"]]
        some = {"before": work.height, "after": np.array(one["after"]), "goal": work.goal}
        middle = np.nanmin(work.goal), np.nanmax(work.goal)
        rise = (middle[1] - middle[0]) / (_END - _START - _SPACING)
        ends = ((x, y, float(np.nanmean(work.goal)) + rise * (x - (_START + _END) / 2)) for x in (_START, _END))
        found.append(Side(work.name, work.scene, some, np.array([*ends])))
    return found


def _row(work: Work, kind: str, size: tuple[int, int, int], seed: int, tell: Tell) -> tuple[Row, np.ndarray]:
    """The row of one kind of strokes, with so many strokes, pushes for each, and steps of gradients; and what they leave."""
    kinds: dict[str, Actions] = {
        "one depth": Flat(lowest=-work.depth, highest=-work.depth),
        "a depth each": Flat(),
        "rising": Rising(),
    }
    strokes, per_stroke, steps = size
    began = time.perf_counter()
    found = plan_sand(
        work.scene, work.height, work.goal, strokes=strokes, actions=kinds[kind], budget=per_stroke * strokes, seed=seed
    )
    row = {
        "task": work.name,
        "strokes_are": kind,
        "strokes": len(found.paths),
        "before_mm": work.error(work.height),
        "search_mm": work.error(found.height),
        "gradients_mm": None,
        "trial_mm": work.trial.get(kind),
        "pushes": found.effort.cost,
        "calls_of_gradients": None,
        "seconds": time.perf_counter() - began,
    }
    if kind != "rising" or not found.paths or not steps:
        return row, found.height
    budget = len(found.paths) * (1 + (1 + GRADIENT) * steps)
    refined = optimise_strokes(
        work.scene, work.goal, start=work.height, guess=found.strokes, budget=budget, key=seed, tell=tell
    )
    more = {"gradients_mm": work.error(refined.height), "calls_of_gradients": refined.spent}
    return row | more | {"seconds": time.perf_counter() - began}, refined.height


def _scene() -> Scene:
    return make_scene(_SHAPE, _SPACING, tool=Blade(width=0.1, thickness=0.03, depth=0.0))


def _ground() -> tuple[np.ndarray, np.ndarray]:
    """Where cells lie along x (m), and which of them are shaped: both [H, W]."""
    x, y = places(_SHAPE, _SPACING)
    return x, (x > _START) & (x < _END) & (y > _SIDES[0]) & (y < _SIDES[1])
