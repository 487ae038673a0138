"""Planning on real sand: a search in which every child is a height map that the simulator made."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise

import numpy as np

from jaxsand.goals import metrics
from jaxsand.goals.feasible import AtBest, at_best
from jaxsand.goals.goal import Goal, as_goal
from jaxsand.planning.no_strokes import why_no_strokes
from jaxsand.planning.search.actions import Actions, Flat, Job, Lattice, Path, Rising, Steps, longest_stroke
from jaxsand.planning.search.binary import binary_hints, binary_paths
from jaxsand.planning.search.drafts import Ended, nothing
from jaxsand.planning.search.heights import search_heights, with_the_best
from jaxsand.planning.search.reach import blade_size, least_distance, volume_distance
from jaxsand.planning.search.rollouts import Effort, distance, replay
from jaxsand.planning.search.steps import search_steps
from jaxsand.planning.search.strokes import search_strokes
from jaxsand.planning.side_by_side import side_by_side
from jaxsand.relaxation.settling import check_at_rest
from jaxsand.relaxation.stopping import check_whole
from jaxsand.scene.scene import Scene, as_array, blade_of, fit
from jaxsand.scene.tools import Blade, square
from jaxsand.scene.validation import short

_CHOICE = 0.25  # of the budget is for first plans with each of several blades


@dataclass(frozen=True)
class SandPlan:
    """What `plan_sand` found.

    Attributes:
      paths: points [n, 2] = x, y (m) of each path, or [n, 3] = x, y, z (m) with `Rising` or `Flat`, in order; the tool is
        lifted between paths.
      height: the map [H, W] (m) that `follow` makes of the paths, one after the other.
      before: distance (m) of the start from the goal: sqrt(sum (h - goal)^2) over the cells that are not free, or what a
        `Goal` with weights says.
      after: distance (m) of `height` from the goal.
      lower_bound: proven: no plan of as many strokes as were allowed, however placed, comes closer than this (m). With
        heights of their own it is what volume and repose allow (see `at_best`).
      estimate: a guess (m) of what could be reached: what is left if every stroke gains as much as the best of all that were
        tried.
      effort: how many pushes were simulated in full, and how many roughly (see `plan_sand`).
      reason: why there are no paths, and what to do; None where there are some.
      tool: the blade, one of `tools` if there was a choice; None stands for the scene's.
      at_best: what repose and volume allow, as of `at_best`, with `Rising` or `Flat`; None where it was not asked.
      strokes: every stroke or leg [n, 4] = x0, y0, x1, y1 (m), or [n, 6] = x0, y0, z0, x1, y1, z1 (m) with heights, in
        order.
      gap: after - lower_bound (m).
      reduction: 1 - after / before; 0 where there was nothing to gain.

    Example:
      >>> import numpy as np
      >>> import jaxsand as js
      >>> scene = js.make_scene((16, 16), 0.01, tool=js.Blade())
      >>> found = js.plan_sand(scene, np.zeros((16, 16)), np.zeros((16, 16)), strokes=1)
      >>> found.strokes.shape, found.gap, found.reduction
      ((0, 4), 0.0, 0.0)
    """

    paths: tuple[Path, ...]
    height: np.ndarray
    before: float
    after: float
    lower_bound: float
    estimate: float
    effort: Effort
    reason: str | None = None
    tool: Blade | None = None
    at_best: AtBest | None = None

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
        """Every stroke or leg as x0, y0, x1, y1 (m) [n, 4], or with heights [n, 6], in order."""
        numbers = 2 * self.paths[0].shape[1] if self.paths else 4
        return np.array([[*a, *b] for path in self.paths for a, b in pairwise(path)]).reshape(-1, numbers)


def plan_sand(
    scene: Scene,
    height: np.ndarray,
    goal: Goal | np.ndarray,
    *,
    strokes: int = 4,
    actions: Actions | None = None,
    budget: int = 4000,
    seed: int = 0,
    tools: Sequence[Blade] = (),
) -> SandPlan:
    """Searches for strokes that bring a map close to a goal, by trying them on simulated sand.

    It is a beam search. The nodes of layer k are maps after k strokes (with `Steps`, maps with the tool in a place after k
    legs), and the closest go on; of nodes whose maps look alike only the closest does. With a `Lattice`, the straight runs
    of the binary plan (`plan`, on blocks as wide as the blade) are among the children, and the best plans' strokes are then
    varied one at a time. With `Steps`, the binary plan's walk over one piece of what is to dig is among the paths.

    With `Rising` or `Flat` three plans compete: a coverage path, strokes along the plan of least work (optimal transport),
    and strokes that are each the best of many on the sand before them. The best plan's strokes are then varied one at a
    time. What a stroke will leave is foreseen in closed form, and only the most promising are pushed. With a budget of 1,000
    or more that allows some steps, all strokes at once then follow the gradient through the sand, for three fifths of the
    pushes; the gradient by a stroke counts as five pushes. `optimise_strokes(guess=plan.strokes)` goes on from there.

    Args:
      scene: grid, sand and a `Blade`.
      height: the map [H, W] (m) to start from, at rest; `height[i, j]` is at x = (j + 1/2) dx, y = (i + 1/2) dx.
      goal: a map [H, W] (m), or a `Goal`, which says what matters. Cells that are NaN or masked are free: the sand there may
        have any height.
      strokes: the largest number of strokes, or of legs.
      actions: `Lattice()` for strokes with the tool lifted in between (the default), `Steps()` for one path with the tool
        down, `Rising()` for strokes on which the tool rises or sinks, `Flat()` for strokes with a height each.
      budget: how many full pushes the search may cost at most; a rough push (`SwathPush()`, 8 sweeps) counts as 1/12. With
        too few for what it does at each stroke, it tries fewer strokes, or none.
      seed: equal seeds give equal plans.
      tools: blades to choose from, with `Rising` or `Flat`; none leaves the scene's. A first plan is made with each, for a
        quarter of the budget in all, and the search goes on with the blade, and from the plan, that leaves the sand closest
        to the goal; with the first blade where there is too little budget for that.

    Returns:
      A `SandPlan`; where nothing brings the sand closer to the goal it has no paths, and `reason` says why.

    Raises:
      ValueError: for a scene without a blade, maps that do not fit it or are not at rest, or options out of range.
      OutcomeError: if the sand does not come to rest.

    Example:
      >>> import numpy as np
      >>> import jaxsand as js
      >>> scene = js.make_scene((16, 16), 0.01, tool=js.Blade())
      >>> js.plan_sand(scene, np.zeros((16, 16)), np.zeros((16, 16)), strokes=1).paths
      ()
      >>> goal = np.zeros((16, 16))
      >>> goal[8, 4:12] = -0.004
      >>> found = js.plan_sand(scene, np.zeros((16, 16)), goal, strokes=1, budget=8)  # doctest: +SKIP
      >>> found.after < found.before  # doctest: +SKIP
      True

    The last lines are not run by the tests: compiling takes 20 s.
    """
    actions = Lattice() if actions is None else actions
    height, wanted = _checked(scene, height), as_goal(scene, goal)
    _check_options(scene, actions, strokes, budget, seed)
    job, rng, effort = Job(scene, height, wanted, strokes, actions), np.random.default_rng(seed), Effort()
    before, paths, first = float(distance(height, wanted)), list[Path](), nothing(job)
    blades = _blades(scene, tools, actions)
    if blades:
        job = replace(job, scene=replace(scene, tool=blades[0]))
    if before > 0 and len(blades) > 1:
        job, first, effort = with_the_best(job, blades, _CHOICE * budget, rng)
    scene = job.scene
    if before > 0:
        paths, more = _search(job, first, int(budget - effort.cost), rng)
        effort += more
    after = replay(scene, height, paths)
    left = float(distance(after, wanted))
    if left > before:  # `follow` leaves slightly other maps than the search's own pushes
        paths, after, left = [], height, before
    if isinstance(actions, Rising | Flat):
        best = at_best(scene, height, wanted) if before else None
        bound = max(volume_distance(scene, height, wanted), best.distance_bound if best else 0.0)
    else:
        best = None
        bound = least_distance(scene, height, wanted, strokes, longest_stroke(scene, actions))
    estimate = min(left, max(bound, before - strokes * effort.gain))
    reason = None if paths else why_no_strokes(scene, height, wanted)
    return SandPlan(tuple(paths), after, before, left, bound, estimate, effort, reason, blade_of(scene), best)


def plan_sand_batch(
    scene: Scene,
    height: np.ndarray,
    goals: Sequence[Goal | np.ndarray],
    *,
    strokes: int = 4,
    actions: Actions | None = None,
    budget: int = 4000,
    seed: int = 0,
    tools: Sequence[Blade] = (),
) -> list[SandPlan]:
    """`plan_sand` for several goals at once, each with a plan of its own.

    The searches run side by side, and what they push at a time is pushed in one batch. With `Rising` or `Flat`, which push
    few maps at a time, that takes a third of the time of one after the other; with `Lattice` or `Steps` it gains little.

    Args:
      scene: the scene of all, as of `plan_sand`.
      height: the map [H, W] (m) that all start from, or one for each goal, [B, H, W].
      goals: B goals, each as of `plan_sand`.
      strokes: as of `plan_sand`, for each goal.
      actions: as of `plan_sand`.
      budget: as of `plan_sand`, for each goal.
      seed: of the first goal's search; the next has the next number.
      tools: as of `plan_sand`; each goal gets a blade of its own.

    Returns:
      B plans. The k-th is what `plan_sand` finds with `seed + k`, up to rounding, which may lead to another plan as good.

    Raises:
      ValueError: as of `plan_sand`, with the number of the goal or the height; or there is not one height for each goal.
      OutcomeError: as of `plan_sand`; no plan is returned then.

    Example:
      >>> import numpy as np
      >>> import jaxsand as js
      >>> scene, level = js.make_scene((16, 16), 0.01, tool=js.Blade()), np.zeros((16, 16))
      >>> [plan.paths for plan in js.plan_sand_batch(scene, level, [level, level], strokes=1)]
      [(), ()]
    """
    if isinstance(goals, Goal | str) or not isinstance(goals, Sequence | np.ndarray):
        raise ValueError(f"goals: got {type(goals).__name__}; give a list of goals, each a Goal or a map [H, W]")
    heights = np.asarray(as_array("height", height, np.float32))
    if heights.ndim == 2:
        heights = np.broadcast_to(heights, (len(goals), *heights.shape))
    if heights.ndim != 3 or len(heights) != len(goals):
        raise ValueError(f"height: got shape {list(heights.shape)}; give [H, W], or [{len(goals)}, H, W], one for each goal")
    _check_options(scene, Lattice() if actions is None else actions, strokes, budget, seed)
    for k, goal in enumerate(goals):
        try:
            _checked(scene, heights[k])
            as_goal(scene, goal)
        except ValueError as error:
            name, _, rest = str(error).partition(":")
            raise ValueError(f"{name}[{k}]:{rest}") from None

    def search(k: int) -> SandPlan:
        return plan_sand(
            scene, heights[k], goals[k], strokes=strokes, actions=actions, budget=budget, seed=seed + k, tools=tools
        )

    return side_by_side([partial(search, k) for k in range(len(goals))])


def _blades(scene: Scene, tools: Sequence[Blade], actions: Actions) -> tuple[Blade, ...]:
    """The blades to choose from; ValueError unless they are some that the scene might have, and go with the actions."""
    if isinstance(tools, Blade):
        raise ValueError("tools: got one Blade; give a list of blades, or none to use the scene's")
    if len(tools) and not isinstance(actions, Rising | Flat):
        raise ValueError(
            f"tools: got a choice with {type(actions).__name__}(); it goes with Rising() or Flat(), leave it out"
        )
    for k, tool in enumerate(tools):
        if not isinstance(tool, Blade):
            raise ValueError(f"tools[{k}]: got {type(tool).__name__}; give a Blade")
        try:
            tool.check(scene.grid)
            square(tool)
        except ValueError as error:
            raise ValueError(f"tools[{k}]: {error}") from None
    return tuple(tools)


def _search(job: Job, first: Ended, budget: float, rng: np.random.Generator) -> tuple[list[Path], Effort]:
    if isinstance(job.actions, Steps):
        walks = binary_paths(job.scene, job.height, job.goal, job.actions)
        return search_steps(job, walks[0] if walks else np.zeros((0, 2), int), budget, rng)
    if isinstance(job.actions, Rising | Flat):
        return search_heights(job, budget, rng, first)
    return search_strokes(job, binary_hints(job), budget, rng)


def _checked(scene: Scene, height: np.ndarray) -> np.ndarray:
    """The height (float32); raises ValueError unless it fits the scene and is at rest."""
    blade_size(scene)
    height = np.asarray(fit(scene, as_array("height", height, np.float32))[1])
    metrics.finite(height, "height")
    check_at_rest(scene, height)
    return height


def _check_options(scene: Scene, actions: Actions, strokes: int, budget: int, seed: int) -> None:
    check_whole("strokes", strokes, 1)
    check_whole("budget", budget, 1)
    check_whole("seed", seed, 0)
    if isinstance(actions, Lattice):
        largest = max(scene.grid.shape) - 1
        if not 0 < actions.pitch <= largest:
            raise ValueError(f"actions.pitch: got {short(actions.pitch)}; give spacings, above 0 and at most {largest}")
        if not actions.pitch <= max(actions.shortest, actions.pitch) <= min(actions.longest, largest):
            raise ValueError(
                f"actions.longest: got {short(actions.longest)} with shortest {short(actions.shortest)} and pitch "
                f"{short(actions.pitch)}; give spacings with pitch and shortest at most longest, and at most {largest}"
            )
    elif isinstance(actions, Rising | Flat):
        across = math.hypot(*(n - 1 for n in scene.grid.shape))
        for name in ("shortest", "longest", "lowest", "highest"):
            if not isinstance(getattr(actions, name), int | float):
                raise ValueError(f"actions.{name}: got {short(getattr(actions, name))}; give a number")
        if across < actions.shortest <= Rising.shortest:
            raise ValueError(
                f"height: got {list(scene.grid.shape)} cells, too few for a stroke of {actions.shortest:.4g} spacings; "
                "give a larger map"
            )
        if not 0 < actions.shortest <= min(actions.longest, across):
            raise ValueError(
                f"actions.shortest: got {short(actions.shortest)} with longest {short(actions.longest)}; "
                f"give spacings, above 0, at most longest, and at most {across:.4g}"
            )
        if not actions.lowest <= actions.highest or math.inf in (actions.lowest, -actions.highest):
            raise ValueError(
                f"actions.lowest: got {short(actions.lowest)} with highest {short(actions.highest)}; "
                "give heights in metres, at most highest"
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
        raise ValueError(f"actions: got {short(actions)}; give Lattice(), Steps(), Rising() or Flat()")
