"""Planning on real sand: every child is a height map that the simulator rolled out."""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from jaxsand.goals import metrics as task
from jaxsand.planning.search.actions import Actions, Job, Lattice, Path, Steps, longest_stroke
from jaxsand.planning.search.binary import binary_hints, binary_paths
from jaxsand.planning.search.reach import blade_size, least_distance
from jaxsand.planning.search.rollouts import Effort, distance, replay
from jaxsand.planning.search.steps import search_steps
from jaxsand.planning.search.strokes import search_strokes
from jaxsand.relaxation.settling import steepest_slope
from jaxsand.relaxation.stopping import check_whole
from jaxsand.scene.scene import Scene, as_array, fit


@dataclass(frozen=True)
class SandPlan:
    """Paths for the tool, which is lifted in between, and what they leave.

    `height` [H, W] is what `follow` makes of them one after the other; `before` and `after` are the l2 distances from the
    goal (m). `lower_bound` is proven (see `reach`): no plan of as many strokes gets closer; `estimate` is what is left if
    every stroke gains as much as the best one of all that were tried, which is measured and no proof. `gap` is what lies
    between the plan and its bound.
    """

    paths: tuple[Path, ...]
    height: np.ndarray
    before: float
    after: float
    lower_bound: float
    estimate: float
    effort: Effort

    @property
    def gap(self) -> float:
        """after - lower_bound (m)."""
        return self.after - self.lower_bound

    @property
    def reduction(self) -> float:
        """1 - after / before; 0 where there was nothing to gain."""
        return 1 - self.after / self.before if self.before else 0.0

    @property
    def strokes(self) -> np.ndarray:
        """Every stroke or leg as x0, y0, x1, y1 (m), in order: [n, 4]."""
        return np.array([[*a, *b] for path in self.paths for a, b in pairwise(path)]).reshape(-1, 4)


def plan_sand(
    scene: Scene,
    height: np.ndarray,
    goal: np.ndarray,
    *,
    strokes: int = 4,
    actions: Actions | None = None,
    budget: int = 4000,
    seed: int = 0,
) -> SandPlan:
    """At most so many strokes that bring a map [H, W] (m) at rest close to a goal [H, W], by search on real sand.

    Layers of best-first search in which a node is a height map (with `Steps`, and the tool's place), its children are
    rolled out hundreds at once, and nodes that look alike are one; strokes of a `Lattice` (the default) are then varied one
    at a time. Strokes from the binary plan (`plan`, on blocks as wide as the blade) are among the children.
    `budget` counts full pushes, rough ones at `rollouts.CHEAP` each; equal seeds give equal plans.

    Raises:
      ValueError: for a scene without a blade, maps that do not fit it or are not at rest, or options out of range.
      OutcomeError: if the sand does not come to rest.
    """
    actions = Lattice() if actions is None else actions
    height, goal = _checked(scene, height, goal)
    _check_options(scene, actions, strokes, budget, seed)
    job = Job(scene, height, goal, strokes, actions)
    before = float(distance(height, goal))
    paths, effort = _search(job, budget, np.random.default_rng(seed)) if before > 0 else ([], Effort())
    after = replay(scene, height, paths)
    left = float(distance(after, goal))
    if left > before:  # what the search saw is not what `follow` does
        paths, after, left = [], height, before
    bound = least_distance(scene, height, goal, strokes, longest_stroke(scene, actions))
    estimate = max(0.0, before - strokes * effort.gain)
    return SandPlan(tuple(paths), after, before, left, bound, estimate, effort)


def _search(job: Job, budget: float, rng: np.random.Generator) -> tuple[list[Path], Effort]:
    if isinstance(job.actions, Steps):
        walks = binary_paths(job.scene, job.height, job.goal, job.actions)
        return search_steps(job, walks[0] if walks else np.zeros((0, 2), int), budget, rng)
    return search_strokes(job, binary_hints(job), budget, rng)


def _checked(scene: Scene, height: np.ndarray, goal: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    blade_size(scene)
    height = np.asarray(fit(scene, as_array("height", np.asarray(height), np.float32))[1])
    goal = np.asarray(goal, float)
    task.fits(scene, goal)
    if not np.isfinite(height).all():
        raise ValueError(f"height: got {int(np.sum(~np.isfinite(height)))} cells that are not finite; fill them first")
    slope, mu = float(steepest_slope(scene, height)), np.tan(np.asarray(scene.material.repose_angle, float))
    if slope > np.max(mu) + 2e-3:
        raise ValueError(f"height: got a slope of {slope:.3g}, steeper than repose ({np.max(mu):.3g}); settle it first")
    return height, goal


def _check_options(scene: Scene, actions: Actions, strokes: int, budget: int, seed: int) -> None:
    check_whole("strokes", strokes, 1)
    check_whole("budget", budget, 1)
    check_whole("seed", seed, 0)
    if isinstance(actions, Lattice):
        largest = max(scene.grid.shape) - 1
        if not 0 < actions.pitch <= largest:
            raise ValueError(f"actions.pitch: got {actions.pitch!r}; give spacings, above 0 and at most {largest}")
        if not actions.pitch <= max(actions.shortest, actions.pitch) <= min(actions.longest, largest):
            raise ValueError(
                f"actions.longest: got {actions.longest!r} with shortest {actions.shortest!r} and pitch {actions.pitch!r}; "
                f"give spacings with pitch and shortest at most longest, and at most {largest}"
            )
    elif isinstance(actions, Steps):
        check_whole("actions.cell", actions.cell, 1)
        check_whole("actions.margin", actions.margin, 0)
        if min(scene.grid.shape) - 2 * actions.margin < 2 * actions.cell:
            raise ValueError(
                f"actions.cell: got {actions.cell} with margin {actions.margin} on {list(scene.grid.shape)} cells, "
                "fewer than two steps; give a smaller one"
            )
    else:
        raise ValueError(f"actions: got {actions!r}; give Lattice(pitch, shortest, longest) or Steps(cell, margin)")
