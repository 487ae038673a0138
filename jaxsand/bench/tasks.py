"""Earth-moving tasks by several methods at equal numbers of pushes, with the measures of several fields."""

import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise, product
from pathlib import Path

import numpy as np

from jaxsand.bench.kept import append_row, known_rows
from jaxsand.bench.rivals import earth
from jaxsand.bench.tables import Row
from jaxsand.goals.feasible import AtBest, at_best
from jaxsand.goals.goal import as_goal
from jaxsand.goals.tasks import TASKS, Task, figures, make_task
from jaxsand.planning.learned.policy import load_policy
from jaxsand.planning.learned.stages import Stages, plan_by_policy
from jaxsand.planning.search import plan_sand
from jaxsand.planning.search.actions import Job, Rising
from jaxsand.planning.search.rollouts import Effort
from jaxsand.planning.search.strokes import finish
from jaxsand.planning.side_by_side import side_by_side
from jaxsand.planning.stroke_loss import sand_loss
from jaxsand.scene.progress import Tell, quiet
from jaxsand.scene.scene import Scene, blade_of
from jaxsand.scene.tools import Blade

Method = Callable[[Job, float, np.random.Generator], earth.Found]

RIVALS: dict[str, Method] = {
    "random": earth.random_strokes,
    "coverage": earth.coverage_paths,
    "least work": earth.transported,
}
SEARCH, CHOICE, POLICY = "plan_sand", "plan_sand with four blades", "policy"
METHODS = (*RIVALS, SEARCH, CHOICE, POLICY)
WIDTHS = (0.75, 1.0, 1.5, 2.0)
"""Of the four blades, in those of the task's own."""

_CASE = ("task", "method", "key", "budget", "at_most")
"""What is told of a row: the instance by its key, which seeds the method too, the pushes, and the strokes allowed."""

_AT_ONCE = 32
"""Instances that are planned side by side at most."""

PUBLISHED: dict[str, float] = {"their policy": 3.4, "their coverage paths": 4.8, "their random actions": 7.2}
"""Mean errors (mm) that Kreis et al. 2025 (arXiv:2509.06469) published, by another tool in another simulator, on 400 goals
such as rectangle, L and polygon, of which their data set is not public."""


def bench_tasks(
    tell: Tell = quiet,
    names: tuple[str, ...] = tuple(TASKS),
    methods: tuple[str, ...] = METHODS,
    instances: int = 1,
    pushes: int = 500,
    strokes: int | None = None,
    seed: int = 0,
    out: Path | None = None,
) -> dict[str, list[Row]]:
    """Each method on each task: means over the instances, whose keys count up from `seed` (the worst is `worst_mm`); see
    `figures`.

    The instances of a task are planned side by side by each method. A row for each, with its plan and the map that it
    leaves, is written to `out`/tasks.jsonl as it comes, and what is there already is not computed again.

    Every method may use as many strokes as the task allows, but at most `strokes`, and simulate `pushes` pushes; a gradient
    counts as what it costs. The policy's strokes are as deep as the goal, and are not tried. `seconds` is the time of all
    instances over their number, `path_m` the length of the strokes, and `moved` the volume (m^3) that they moved, summed
    over the strokes. `at_best_mm` is the mean |height - goal| of the map that is nearest by the goal's cost, of all that
    repose and volume allow, and `distance_at_best` (m) what no method's `distance` can be below (see `at_best`).

    Returns:
      The rows, as `tasks`; and as `tasks_maps` what the best method leaves of the first instance of each task, with its name
      and key: lists [H, W] (m), to be drawn.

    Raises:
      ValueError: for a task or a method that does not exist.
    """
    for given, known in ((names, tuple(TASKS)), (methods, METHODS)):
        for name in given:
            if name not in known:
                raise ValueError(f"bench tasks: got {name!r}; give some of {', '.join(known)}")
    path = out / "tasks.jsonl" if out else None
    there = {_case(row): row for row in known_rows(path, {*_CASE, "plan", "after"})} if path else {}
    keys, total, found = range(seed, seed + instances), len(names) * len(methods) * instances, list[Row]()
    for name, method in product(names, methods):
        cases: list[Row] = [dict(zip(_CASE, (name, method, key, pushes, strokes), strict=True)) for key in keys]
        old = [there[_case(case)] for case in cases if _case(case) in there]
        found += old
        new = [case for case in cases if _case(case) not in there]
        for some in (new[k : k + _AT_ONCE] for k in range(0, len(new), _AT_ONCE)):
            tell(f"{len(found)} of {total} done; {name} by {method}, {len(some)} at once")
            found += _several(some, path, tell)
    rows, maps = list[Row](), list[Row]()
    for name, method in product(names, methods):
        some = [row for row in found if (row["task"], row["method"]) == (name, method)]
        means = {key: _mean([row[key] for row in some]) for key in some[0] if key not in (*_CASE, "plan", "after")}
        rows.append({"task": name, "method": method, **means, "worst_mm": max(row["mean_mm"] for row in some)})
    for name in names:
        first = min((row for row in found if (row["task"], row["key"]) == (name, seed)), key=lambda row: row["distance"])
        maps.append({key: first[key] for key in ("task", "key", "method", "after")})
    return {"tasks": rows, "tasks_maps": maps}


def shown(maps: list[Row]) -> list[tuple[str, Task, np.ndarray]]:
    """Of each task that `bench_tasks` keeps a map of: a title, the task, and the map [H, W] (m)."""
    found = []
    for one in maps:
        task, after = make_task(one["task"], one["key"]), np.array(one["after"])
        told = figures(task, after)
        title = f"{one['task']}: {told['before_mm']:.2g} to {told['mean_mm']:.2g} mm, {one['method']}"
        found.append((title, task, after))
    return found


def _mean(values: list[float | None]) -> float | None:
    """The mean; None if one of the values is none."""
    known = [value for value in values if value is not None]
    return float(np.mean(known)) if len(known) == len(values) else None


def _case(row: Row) -> tuple[object, ...]:
    """What tells a row from others."""
    return tuple(row[name] for name in _CASE)


@dataclass(frozen=True)
class MethodPlan:
    """What a method found for a task.

    Attributes:
      scene: the task's, with the blade of the plan.
      plan: strokes [n, 6] or [n, 4] (m).
      effort: what it cost.
      best: what sand can do at best, where the method knows.
    """

    scene: Scene
    plan: np.ndarray
    effort: Effort
    best: AtBest | None = None


def _several(cases: Sequence[Row], path: Path | None, tell: Tell) -> list[Row]:
    """The rows of some cases, planned side by side; each is told of, and written to the file at `path`, once it is there."""
    began, writing = time.perf_counter(), threading.Lock()

    def one(case: Row) -> Row:
        row = case | _one(case) | {"seconds": (time.perf_counter() - began) / len(cases)}
        with writing:
            tell(f"{row['task']} {row['key']} by {row['method']}: {row['before_mm']:.2g} to {row['mean_mm']:.2g} mm")
            if path:
                append_row(path, row)
        return row

    return side_by_side([partial(one, case) for case in cases])


def _one(case: Row) -> Row:
    """The figures of a method on an instance of a task, its plan, and the map [H, W] (m) that it leaves."""
    task = _at_most(make_task(case["task"], case["key"]), case["at_most"])
    found = _planned(task, case["method"], case["budget"], case["key"])
    plan, best = found.plan, found.best or at_best(task.scene, task.start, task.goal)
    maps = finish(found.scene, plan[None], 0, task.start[None])[:, 0]
    run = plan[:, plan.shape[1] // 2 :] - plan[:, : plan.shape[1] // 2]
    moved = sum(float(np.abs(b.astype(float) - a).sum()) / 2 for a, b in pairwise(maps))
    return {
        **figures(task, maps[-1]),
        "at_best_mm": figures(task, best.height)["mean_mm"],
        "distance_at_best": best.distance_bound,
        "strokes": float(len(plan)),
        "path_m": float(np.hypot(run[:, 0], run[:, 1]).sum()),
        "moved": moved * float(task.scene.grid.spacing) ** 2,
        "pushes": found.effort.cost,
        "blade_mm": 1e3 * float(blade_of(found.scene).width),
        "plan": np.round(plan, 6).tolist(),
        "after": np.round(maps[-1].astype(float), 6).tolist(),
    }


def _at_most(task: Task, strokes: int | None) -> Task:
    """The task with no more strokes than these."""
    return task if strokes is None else replace(task, strokes=min(strokes, task.strokes))


def _planned(task: Task, method: str, pushes: int, seed: int) -> MethodPlan:
    """What a method finds."""
    if method in RIVALS:
        job = Job(task.scene, task.start, as_goal(task.scene, task.goal), task.strokes, Rising())
        (plan, _), effort = RIVALS[method](job, pushes, np.random.default_rng(seed))
        return MethodPlan(task.scene, plan, effort)
    if method == POLICY:
        return _by_policy(task)
    blade = blade_of(task.scene)
    tools = [replace(blade, width=times * float(blade.width)) for times in WIDTHS] if method == CHOICE else []
    found = plan_sand(
        task.scene,
        task.start,
        task.goal,
        strokes=task.strokes,
        actions=Rising(),
        budget=pushes,
        seed=seed,
        tools=tools,
    )
    scene = replace(task.scene, tool=found.tool or blade)
    return MethodPlan(scene, found.strokes.reshape(-1, 6), found.effort, found.at_best)


def _by_policy(task: Task) -> MethodPlan:
    """The shipped policy's strokes, by a blade as deep as the goal lies below height 0, or of the usual depth."""
    depth = -float(np.nanmin(np.asarray(task.goal.height)))
    scene = replace(task.scene, tool=replace(blade_of(task.scene), depth=depth if depth > 0 else Blade().depth))
    found = plan_by_policy(load_policy(), sand_loss(scene, task.start, task.goal), task.strokes, Stages(0, 0), quiet)
    return MethodPlan(scene, found.strokes, Effort(full=found.calls))
