"""First plans of strokes with heights: coverage paths, the plan of least work, and one stroke after another."""

import numpy as np

from jaxsand.planning.search.actions import Job
from jaxsand.planning.search.coverage import READINGS, coverage
from jaxsand.planning.search.foresight import foreseen, roughly_far
from jaxsand.planning.search.proposals import around, propose_heights, within
from jaxsand.planning.search.rollouts import Effort, distance, pushed
from jaxsand.planning.search.strokes import finish
from jaxsand.planning.search.transport import heaviest

MOST_TRIED = 8
"""Strokes that are pushed of many at most: of 256, the eight that were foreseen best held one of the three best of all."""

_DRAWN = 512  # strokes of which the most promising are foreseen further
_ROUNDS = 3  # of strokes around those
_NEAR = 256  # strokes in each
_KEPT = 32  # of them, for the next round
_APART = 0.3  # spacings by which the strokes that are tried differ in one place at least, or five times that in height

Ended = tuple[np.ndarray, float]
"""A plan [k, 6] (m) of at most as many strokes as the job allows, and how far from the goal it leaves the sand (m)."""


def nothing(job: Job) -> Ended:
    """No strokes."""
    return np.zeros((0, 6)), float(distance(job.height, job.goal))


def least_work(job: Job, budget: float) -> tuple[Ended, Effort]:
    """Strokes along the plan of least work, made anew on the sand that each leaves, and none of them tried before."""
    maps, plan, effort = [job.height], np.zeros((0, 6)), Effort()
    for _ in range(min(job.strokes, int(budget))):
        stroke = within(job, heaviest(job.scene, job.goal, maps[-1]))
        if not len(stroke):
            break
        after, effort = pushed(job.scene, maps[-1][None], stroke)[0], effort + Effort(full=1)
        if np.isnan(after).any():
            break
        maps.append(after)
        plan = np.concatenate([plan, stroke])
    ends = distance(np.stack(maps), job.goal)
    return (plan[: int(ends.argmin())], float(ends.min())), effort + Effort(gain=_gain(ends))


def best_coverage(job: Job, budget: float) -> tuple[Ended, Effort]:
    """The best coverage path of as many readings as the budget allows, cut off where more rows do not help.

    The readings that are foreseen to leave the sand closest to the goal are pushed first.
    """
    plans = [within(job, coverage(job.scene, job.goal, job.height, reading)[: job.strokes]) for reading in READINGS]
    best, effort = nothing(job), Effort()
    for plan in (plans[k] for k in np.argsort(_hoped(job, plans), kind="stable")):
        if effort.cost + len(plan) > budget:
            break
        ends = distance(finish(job.scene, plan[None], 0, job.height[None])[:, 0], job.goal)
        effort += Effort(full=len(plan), gain=_gain(ends))
        if ends.min() < best[1]:
            best = (plan[: int(ends.argmin())], float(ends.min()))
    return best, effort


def one_by_one(job: Job, budget: float, rng: np.random.Generator) -> tuple[Ended, Effort]:
    """A plan in which each stroke is the best of those tried on the sand before it.

    Of many strokes those are tried that are foreseen to leave the sand closest to the goal. Where none of them brings it
    closer, others are tried in place of the next stroke.
    """
    here, (plan, left), effort = job.height, nothing(job), Effort()
    for k in range(job.strokes):
        count = min(int((budget - effort.cost) / (job.strokes - k)), MOST_TRIED)
        if count < 1:
            continue
        tried = promising(job, here, count, rng)
        maps = pushed(job.scene, np.repeat(here[None], len(tried), axis=0), tried)
        ends = distance(maps, job.goal)
        best = int(ends.argmin())
        effort += Effort(full=len(tried), gain=max(0.0, left - float(ends[best])))
        if ends[best] < left:
            here, left, plan = maps[best], float(ends[best]), np.concatenate([plan, tried[best][None]])
    return (plan, left), effort


def promising(job: Job, here: np.ndarray, count: int, rng: np.random.Generator) -> np.ndarray:
    """The strokes [n, 6] (m), n at most `count`, that are foreseen to bring a map [H, W] closest to the goal.

    They are the best of strokes drawn anew, one of them from the plan of least work, and of rounds of strokes around the
    best of those, ever closer; no two are alike.
    """
    first = within(job, heaviest(job.scene, job.goal, here))
    some = np.concatenate([first, propose_heights(job, here, _DRAWN - len(first), rng)])
    far = roughly_far(job.goal, foreseen(job.scene, here, some))
    for turn in range(_ROUNDS):
        order = np.argsort(far, kind="stable")[:_KEPT]
        near = around(job, here, some[order], _NEAR, 0.5**turn, rng)
        some = np.concatenate([some[order], near])
        far = np.concatenate([far[order], roughly_far(job.goal, foreseen(job.scene, here, near))])
    spacing, kept = float(job.scene.grid.spacing), list[int]()
    for i in np.argsort(far, kind="stable"):
        apart = np.abs(some[kept] - some[i]) / spacing * [1, 1, 0.2, 1, 1, 0.2]
        if (apart.max(axis=1) > _APART).all():
            kept.append(int(i))
        if len(kept) == count:
            break
    return some[kept]


def _hoped(job: Job, plans: list[np.ndarray]) -> np.ndarray:
    """How close to the goal (m) each plan is foreseen to bring the sand on its way."""
    maps = np.repeat(job.height[None], len(plans), axis=0)
    least = distance(maps, job.goal)
    for k in range(max(map(len, plans))):
        some = [i for i, plan in enumerate(plans) if len(plan) > k]
        maps[some] = foreseen(job.scene, maps[some], np.stack([plans[i][k] for i in some]))
        least = np.minimum(least, distance(maps, job.goal))
    return least


def _gain(ends: np.ndarray) -> float:
    """The largest step (m) towards the goal among distances [n, ...] after each stroke; 0 if there is none."""
    steps = (ends[:-1] - ends[1:])[np.isfinite(ends[1:]) & np.isfinite(ends[:-1])]
    return max(0.0, float(steps.max(initial=0.0)))
