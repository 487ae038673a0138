"""Plans strokes for a goal by trying them on simulated sand: by search, by gradients, or by the shipped policy."""

from collections.abc import Iterable
from dataclasses import replace

import numpy as np

from jaxsand.planning.gradient import Optimised, optimise_strokes
from jaxsand.planning.learned.policy import load_policy
from jaxsand.planning.learned.stages import Planned, Stages, plan_by_policy
from jaxsand.planning.pipeline import Target, at_rest
from jaxsand.planning.search import SandPlan, plan_sand
from jaxsand.planning.stroke_loss import sand_loss
from jaxsand.scene.progress import Tell


def searched(target: Target, before: np.ndarray | None, strokes: int, pushes: int, seed: int, tell: Tell) -> Target:
    """The target with at most `strokes` strokes from a search on real sand, which costs at most `pushes` pushes (see
    `plan_sand`).

    The distance counts all sand, berms too, even where the goal is nowhere above height 0.
    """
    start = at_rest(target.scene, before, tell)
    tell(f"searching {strokes} strokes in {pushes} pushes")
    found = plan_sand(target.scene, start, target.wanted, strokes=strokes, budget=pushes, seed=seed)
    return _by("search", target, found, found.paths)


def optimised(target: Target, before: np.ndarray | None, strokes: int | None, pushes: int, seed: int, tell: Tell) -> Target:
    """The target with `strokes` strokes (None: as many as pay) from gradients, which cost at most `pushes` pushes."""
    start = at_rest(target.scene, before, tell)
    tell("sketching")
    found = optimise_strokes(target.scene, target.wanted, strokes=strokes, key=seed, start=start, budget=pushes, tell=tell)
    return _by("optimise", target, found, found.strokes.reshape(-1, 2, 2))


def by_policy(target: Target, before: np.ndarray | None, strokes: int, stages: Stages, tell: Tell) -> Target:
    """The target with at most `strokes` strokes of the policy, improved by the stages that follow it."""
    sand = sand_loss(target.scene, at_rest(target.scene, before, tell), target.wanted)
    found = plan_by_policy(load_policy(), sand, strokes, stages, tell)
    return _by("policy", target, found, found.strokes.reshape(-1, 2, 2))


def _by(method: str, target: Target, found: SandPlan | Optimised | Planned, paths: Iterable[np.ndarray]) -> Target:
    """The target with the paths that a method found, compared as they were sought: with berms."""
    return replace(target, method=method, paths=tuple(paths), drawn=False, optimal=None, lower_bound=None, found=found)
