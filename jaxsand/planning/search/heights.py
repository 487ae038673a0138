"""The search over strokes with heights: the tool rises or sinks on its way, and so cuts and fills along a slope.

Three plans compete (drafts.py): rows over all that is to be shaped, strokes along the plan of least work, and strokes that
are each the best of those tried on the sand that those before it left. The best is then varied, one stroke at a time. What
a stroke will leave is foreseen (foresight.py), so that only the most promising of many are pushed.
"""

from dataclasses import replace

import numpy as np

from jaxsand.planning.search.actions import Job, Path
from jaxsand.planning.search.drafts import Ended, best_coverage, least_work, nothing, one_by_one, promising
from jaxsand.planning.search.foresight import foreseen, roughly_far
from jaxsand.planning.search.proposals import around, propose_heights
from jaxsand.planning.search.rollouts import Effort, distance
from jaxsand.planning.search.strokes import finish
from jaxsand.scene.tools import Blade

_SHARES = ((best_coverage, 0.1), (least_work, 0.15))  # of the budget at most
_ONE_BY_ONE = 0.35  # of the budget is for strokes one after the other; the rest varies the best plan
_VARIANTS = 255  # of a stroke that are foreseen at a time
_TRIED = 3  # of those are pushed


def search_heights(
    job: Job, budget: float, rng: np.random.Generator, first: Ended | None = None
) -> tuple[list[Path], Effort]:
    """The best strokes with heights found for a job, at a cost of at most `budget` full pushes; `first` is known before."""
    plans, effort = [nothing(job) if first is None else first], Effort()
    for draft, share in _SHARES:
        found, more = draft(job, share * budget)
        plans.append(found)
        effort += more
    room = budget - effort.cost
    found, more = one_by_one(job, max(_ONE_BY_ONE * budget, min(room, job.strokes)), rng)
    plan, _ = min([*plans, found], key=lambda one: one[1])
    effort += more
    plan, more = _varied(job, plan, budget - effort.cost, rng)
    return [stroke.reshape(2, 3) for stroke in plan], effort + more


def with_the_best(job: Job, tools: tuple[Blade, ...], budget: float, rng: np.random.Generator) -> tuple[Job, Ended, Effort]:
    """The job with the blade whose first plan, one stroke after another, leaves the sand closest to the goal, and that plan.

    It is the job as it was, and no plan, where the budget allows none.
    """
    best, first, effort = job, nothing(job), Effort()
    for tool in tools:
        with_it = replace(job, scene=replace(job.scene, tool=tool))
        plan, more = one_by_one(with_it, budget / len(tools), rng)
        effort += more
        if plan[1] < first[1]:
            best, first = with_it, plan
    return best, first, effort


def _varied(job: Job, plan: np.ndarray, budget: float, rng: np.random.Generator) -> tuple[np.ndarray, Effort]:
    """Varies the strokes of a plan [n, 6] one at a time, and adds some where there may be more; a variant is judged by what
    the whole plan leaves.

    Strokes at the end that do not help are left out at last. All costs at most `budget` full pushes.
    """
    if budget < 2 * len(plan):  # the plan itself, and one variant of its first stroke
        return plan, Effort()
    way = finish(job.scene, plan[None], 0, job.height[None])[:, 0]
    effort, left = Effort(full=len(plan)), float(distance(way[-1], job.goal))
    while True:
        count = len(plan)
        k = int(rng.integers(min(count + 1, job.strokes)))
        rest = max(count - k, 1)
        some = min(_TRIED, int((budget - effort.cost) / rest))
        if some < 1:
            break
        if k == count:
            new = promising(job, way[-1], some, rng)
            tried = np.concatenate([np.repeat(plan[None], len(new), axis=0), new[:, None]], axis=1)
        else:
            tried = _hopeful(job, plan, k, way, some, rng)
        maps = finish(job.scene, tried, k, way[k][None])
        ends = distance(maps[-1], job.goal)
        effort += Effort(full=len(tried) * rest)
        best = int(ends.argmin())
        if ends[best] < left:
            left, plan, way = float(ends[best]), tried[best], np.concatenate([way[:k], maps[:, best]])
    return plan[: int(distance(way, job.goal).argmin())], effort


def _hopeful(job: Job, plan: np.ndarray, k: int, way: np.ndarray, count: int, rng: np.random.Generator) -> np.ndarray:
    """Variants [count, n, 6] of a plan [n, 6] that differ in stroke k: those of many that are foreseen to end best.

    Half of these lie around the stroke, at distances of all sizes, a quarter farther away, and a quarter are drawn anew.
    What is foreseen of a variant is corrected by how far that is off for the plan itself, whose maps `way` [n + 1, H, W]
    are known.
    """
    near, far = _VARIANTS // 2, _VARIANTS // 4
    tried = np.repeat(plan[None], _VARIANTS + 1, axis=0)
    tried[1:, k] = np.concatenate(
        [
            around(job, way[-1], plan[k : k + 1], near, float(np.exp(rng.uniform(-3, 0))), rng),
            around(job, way[-1], plan[k : k + 1], far, 1.0, rng),
            propose_heights(job, way[k], _VARIANTS - near - far, rng),
        ]
    )
    maps = way[k]
    for j in range(k, len(plan)):
        maps = foreseen(job.scene, maps, tried[:, j])
    ends = roughly_far(job.goal, way[-1] + (maps[1:] - maps[0]))
    return tried[1:][np.argsort(ends, kind="stable")[:count]]
