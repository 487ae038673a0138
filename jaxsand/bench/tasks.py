"""Earth-moving tasks by several methods at equal numbers of pushes, with the measures of several fields."""

import time
from collections.abc import Callable
from itertools import pairwise

import numpy as np

from jaxsand.bench.rivals import earth
from jaxsand.bench.tables import Row
from jaxsand.goals.feasible import at_best
from jaxsand.goals.goal import as_goal
from jaxsand.goals.tasks import TASKS, Task, figures, make_task
from jaxsand.planning.gradient import optimise_strokes
from jaxsand.planning.search import plan_sand
from jaxsand.planning.search.actions import Job, Rising
from jaxsand.planning.search.rollouts import Effort
from jaxsand.planning.search.strokes import finish
from jaxsand.scene.progress import Tell, quiet

Method = Callable[[Job, float, np.random.Generator], earth.Found]

RIVALS: dict[str, Method] = {
    "random": earth.random_strokes,
    "coverage": earth.coverage_paths,
    "least work": earth.transported,
}
SEARCH, GRADIENTS = "plan_sand", "plan_sand and gradients"
METHODS = (*RIVALS, SEARCH, GRADIENTS)


def bench_tasks(
    tell: Tell = quiet,
    names: tuple[str, ...] = tuple(TASKS),
    methods: tuple[str, ...] = METHODS,
    instances: int = 1,
    pushes: int = 500,
    seed: int = 0,
) -> list[Row]:
    """A row for each task and method, with means over the instances (the worst is `worst_mm`); see `figures`.

    Every method may use as many strokes as the task allows, and simulate `pushes` pushes; a gradient counts as what it
    costs. `path_m` is the length of the strokes, and `moved` the volume (m^3) that they moved, summed over the strokes.
    `at_best_mm` is the mean |height - goal| of the map that is nearest by the goal's cost, of all that repose and volume
    allow, and `distance_at_best` (m) what no method's `distance` can be below (see `at_best`).

    Raises:
      ValueError: for a task or a method that does not exist.
    """
    for given, known in ((names, tuple(TASKS)), (methods, METHODS)):
        for name in given:
            if name not in known:
                raise ValueError(f"bench tasks: got {name!r}; give some of {', '.join(known)}")
    rows = []
    for name in names:
        for method in methods:
            tell(f"{name}: {method}")
            found = [_one(make_task(name, key), method, pushes, seed) for key in range(seed, seed + instances)]
            worst = {"worst_mm": max(one["mean_mm"] for one in found)}
            rows.append(
                {"task": name, "method": method, **{key: _mean([one[key] for one in found]) for key in found[0]}, **worst}
            )
    return rows


def _mean(values: list[float | None]) -> float | None:
    """The mean; None if one of the values is none."""
    known = [value for value in values if value is not None]
    return float(np.mean(known)) if len(known) == len(values) else None


def _one(task: Task, method: str, pushes: int, seed: int) -> Row:
    """The figures of a method on an instance of a task."""
    began = time.perf_counter()
    plan, effort = _planned(task, method, pushes, seed)
    seconds = time.perf_counter() - began
    best = at_best(task.scene, task.start, task.goal)
    maps = finish(task.scene, plan[None], 0, task.start[None])[:, 0]
    moved = sum(float(np.abs(b.astype(float) - a).sum()) / 2 for a, b in pairwise(maps))
    return {
        **figures(task, maps[-1]),
        "at_best_mm": figures(task, best.height)["mean_mm"],
        "distance_at_best": best.distance_bound,
        "strokes": float(len(plan)),
        "path_m": float(np.hypot(plan[:, 3] - plan[:, 0], plan[:, 4] - plan[:, 1]).sum()),
        "moved": moved * float(task.scene.grid.spacing) ** 2,
        "pushes": effort.cost,
        "seconds": seconds,
    }


def _planned(task: Task, method: str, pushes: int, seed: int) -> tuple[np.ndarray, Effort]:
    """The strokes [n, 6] (m) of a method, and what they cost."""
    if method in RIVALS:
        job = Job(task.scene, task.start, as_goal(task.scene, task.goal), task.strokes, Rising())
        (plan, _), effort = RIVALS[method](job, pushes, np.random.default_rng(seed))
        return plan, effort
    budget = pushes // 2 if method == GRADIENTS else pushes
    found = plan_sand(
        task.scene, task.start, task.goal, strokes=task.strokes, actions=Rising(), budget=max(1, budget), seed=seed
    )
    plan, effort = found.strokes.reshape(-1, 6), found.effort
    left = int(pushes - effort.cost)
    if method == GRADIENTS and len(plan) and left > 0:
        refined = optimise_strokes(task.scene, task.goal, start=task.start, guess=plan, budget=left, key=seed)
        return refined.strokes, effort + Effort(full=refined.spent)
    return plan, effort
