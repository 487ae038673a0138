"""The search on real sand against its rivals at equal numbers of pushes, and in batches against one push at a time."""

import time
from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import numpy as np

from jaxsand.bench.rivals import search
from jaxsand.bench.tables import Row
from jaxsand.bench.timing import race
from jaxsand.goals.goal import as_goal
from jaxsand.interaction.simulate import step
from jaxsand.planning.search import plan_sand
from jaxsand.planning.search.actions import Job, Lattice, Steps, propose
from jaxsand.planning.search.rollouts import distance, pushed, replay, roughly_pushed
from jaxsand.planning.search.tasks import SAND_TASKS, SandTask, sand_task
from jaxsand.scene.progress import Tell, quiet

_STROKES: dict[str, Callable[..., Any]] = {
    "binary plan": search.binary,
    "greedy": search.greedy,
    "greedy, ranked": search.greedy_ranked,
    "greedy, restarted": search.greedy_restarted,
    "random shooting": search.shooting,
    "layers alone": search.layers,
}
_STEPS: dict[str, Callable[..., Any]] = {
    "binary plan": search.binary,
    "greedy": search.greedy_steps,
    "random shooting": search.random_walks,
}
_SEARCH, _ALONE = "search", "layers alone"


def bench_sand(tell: Tell = quiet, per_stroke: int = 1000, names: tuple[str, ...] = (), seed: int = 0) -> list[Row]:
    """Every method on every task, at `per_stroke` full pushes to each stroke or leg that a plan may have.

    Distances are l2 in mm, of what `follow` makes of the plan. `closer` says by how much closer to the goal the search ends
    than the best of its rivals, 1 - after / their after. `gap` is the distance left less the proven bound.
    """
    rows = []
    for name in names or tuple(SAND_TASKS):
        rows += _on_task(sand_task(name), tell, per_stroke, seed)
    return rows


def children_per_second(batch: int = 256, alone: int = 32, seed: int = 0) -> list[Row]:
    """Children of one node: in batches, in full and roughly, and by the same push one at a time in a Python loop."""
    chosen = sand_task("crossing")
    scene, level = chosen.scene, chosen.height
    goal = as_goal(scene, chosen.goal)
    ways = propose(scene, Lattice(), level, goal, batch, np.random.default_rng(seed)).astype(np.float32)
    maps = np.repeat(level[None], batch, axis=0)
    one = jax.jit(partial(step, scene))

    def in_turn() -> None:
        for way in ways[:alone]:
            jax.block_until_ready(one(level, way).height)

    runs = {
        "one at a time": (in_turn, alone),
        "batch": (lambda: pushed(scene, maps, ways), batch),
        "batch, rough": (lambda: roughly_pushed(scene, maps, ways), batch),
    }
    timed = race({name: run for name, (run, _) in runs.items()})
    rate = {name: count / timed[name].best for name, (_, count) in runs.items()}
    base, full = rate["one at a time"], rate["batch"]
    return [
        {"name": name, "children_per_second": value, "times_one_at_a_time": value / base, "cost": full / value}
        for name, value in rate.items()
    ]


def _on_task(chosen: SandTask, tell: Tell, per_stroke: int, seed: int) -> list[Row]:
    scene, height, goal = chosen.scene, chosen.height, as_goal(chosen.scene, chosen.goal)
    job, budget = Job(scene, height, goal, chosen.strokes, chosen.actions), per_stroke * chosen.strokes
    before = float(distance(height, goal))
    tell(f"{chosen.name}: {_SEARCH}")
    began = time.perf_counter()
    found = plan_sand(scene, height, goal, strokes=chosen.strokes, actions=chosen.actions, budget=budget, seed=seed)
    ends = {_SEARCH: (found.paths, found.effort, found.after, time.perf_counter() - began)}
    for name, rival in (_STEPS if isinstance(chosen.actions, Steps) else _STROKES).items():
        tell(f"{chosen.name}: {name}")
        began = time.perf_counter()
        paths, effort = rival(job, budget, np.random.default_rng(seed))
        after = float(distance(replay(scene, height, paths), goal))
        ends[name] = (paths, effort, after, time.perf_counter() - began)
    best = min(before, *(after for name, (_, _, after, _) in ends.items() if name not in (_SEARCH, _ALONE)))
    return [
        {
            "task": chosen.name,
            "method": name,
            "strokes": sum(len(path) - 1 for path in paths),
            "before": before * 1e3,
            "after": after * 1e3,
            "reduction": 1 - after / before,
            "closer": (1 - found.after / best if best else 0.0) if name == _SEARCH else None,
            "lower_bound": found.lower_bound * 1e3,
            "estimate": found.estimate * 1e3,
            "gap": (after - found.lower_bound) * 1e3,
            "rollouts": effort.cost,
            "full": effort.full,
            "rough": effort.rough,
            "seconds": seconds,
        }
        for name, (paths, effort, after, seconds) in ends.items()
    ]
