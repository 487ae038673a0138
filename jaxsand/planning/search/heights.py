"""The search over strokes with heights: the tool rises or sinks on its way, and so cuts and fills along a slope.

Three plans compete (drafts.py): rows over all that is to be shaped, strokes along the plan of least work, and strokes that
are each the best of those tried on the sand that those before it left. The best is then varied, one stroke at a time. What
a stroke will leave is foreseen (foresight.py), so that only the most promising of many are pushed. Where the budget allows
enough steps, all strokes at once then follow the gradient through the sand.
"""

from dataclasses import dataclass, replace

import numpy as np

from jaxsand.planning.around import Around
from jaxsand.planning.gradient.account import Account
from jaxsand.planning.gradient.moves import Plans, adam
from jaxsand.planning.search.actions import Job, Path
from jaxsand.planning.search.drafts import (
    MOST_TRIED,
    Ended,
    best_coverage,
    least_work,
    nothing,
    one_by_one,
    promising,
)
from jaxsand.planning.search.foresight import foreseen, roughly_far
from jaxsand.planning.search.proposals import around, propose_heights, within
from jaxsand.planning.search.rollouts import Effort, distance
from jaxsand.planning.search.strokes import finish
from jaxsand.planning.stroke_loss import GRADIENT, SandLoss
from jaxsand.scene.tools import Blade

_SHARES = ((best_coverage, 0.1), (least_work, 0.15))  # of the budget but for gradients, at most
_ONE_BY_ONE = 0.35  # of that is for strokes one after the other; the rest varies the best plan
_VARIANTS = 255  # of a stroke that are foreseen at a time
_WORK = 24  # pushes for variants of a stroke, all strokes after it counted
_FEWEST = 2  # variants that are pushed
_DOWNHILL = 0.6  # of the budget is for gradients,
_PAYS, _STEPS = 1000, 6  # which are left out with fewer pushes, or for fewer steps
_TURN = 10  # steps, after which strokes are varied again
_SIZE, _MOMENTUM = 0.1, 0.5  # of the steps, in spacings at first, and how much of the last ones they keep


@dataclass(frozen=True)
class PushedPlan:
    """A plan that was pushed.

    Attributes:
      plan: strokes [n, 6] (m).
      way: the maps [n + 1, H, W] (m) before each and at the end.
      left: how far from the goal it leaves the sand (m).
    """

    plan: np.ndarray
    way: np.ndarray
    left: float


@dataclass(frozen=True)
class AllowedLoss(SandLoss):
    """What plans of a job cost, whose strokes stay as the job allows when they are moved."""

    job: Job

    def inside(self, plans: np.ndarray) -> np.ndarray:
        """Plans [..., 6] with every stroke moved onto the map, and of a length and heights that are allowed."""
        return within(self.job, plans.reshape(-1, 6)).reshape(plans.shape)


def search_heights(
    job: Job, budget: float, rng: np.random.Generator, first: Ended | None = None
) -> tuple[list[Path], Effort]:
    """The best strokes with heights found for a job, at a cost of at most `budget` full pushes; `first` is known before."""
    plans, effort = [nothing(job) if first is None else first], Effort()
    gradient = (1 + GRADIENT) * job.strokes
    steps = int(_DOWNHILL * budget / gradient)
    steps = 0 if budget < _PAYS or steps < _STEPS else steps
    turns = max(1, steps // _TURN)
    some = budget - steps * gradient  # for all else
    for draft, share in _SHARES:
        found, more = draft(job, share * some)
        plans.append(found)
        effort += more
    found, more = one_by_one(job, max(_ONE_BY_ONE * some, min(some - effort.cost, job.strokes)), rng)
    plan, _ = min([*plans, found], key=lambda one: one[1])
    effort += more
    if budget - effort.cost < 2 * len(plan):  # the plan itself, and one variant of its first stroke
        return [stroke.reshape(2, 3) for stroke in plan], effort
    known, effort = _pushed(job, plan), effort + Effort(full=len(plan))
    for turn in range(turns):
        known, more = _varied(job, known, (some - effort.cost) / (turns - turn) if steps else budget - effort.cost, rng)
        effort += more
        if steps and len(known.plan):
            many = steps * job.strokes // (turns * len(known.plan))
            known, more = _downhill(job, known, many, _SIZE / 2 ** (turn / 2))
            effort, some = effort + more, some + more.cost
    if steps:
        known, more = _varied(job, known, budget - effort.cost, rng)
        effort += more
    plan = known.plan[: int(distance(known.way, job.goal).argmin())]  # strokes at the end that do not help are left out
    return [stroke.reshape(2, 3) for stroke in plan], effort


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


def _pushed(job: Job, plan: np.ndarray) -> PushedPlan:
    way = finish(job.scene, plan[None], 0, job.height[None])[:, 0]
    return PushedPlan(plan, way, float(distance(way[-1], job.goal)))


def _downhill(job: Job, known: PushedPlan, steps: int, size: float) -> tuple[PushedPlan, Effort]:
    """Moves all strokes of a plan at once along the gradient, in steps of `size` spacings at first."""
    count = len(known.plan)
    account = Account(AllowedLoss(job.scene, job.height, job.goal, job), steps * count * (1 + GRADIENT))
    start = Plans(known.plan[None], np.array([known.left**job.goal.power]))
    found = adam(account, start, steps - 1, size * float(job.scene.grid.spacing), momentum=_MOMENTUM).strokes[0]
    effort = Effort(full=account.calls)
    if (found == known.plan).all():
        return known, effort
    return _pushed(job, found), effort + Effort(full=count)


def _varied(job: Job, known: PushedPlan, budget: float, rng: np.random.Generator) -> tuple[PushedPlan, Effort]:
    """Varies the strokes of a plan one at a time, and adds some where there may be more; a variant is judged by what the
    whole plan leaves.

    A variant of a stroke costs the later ones that see what it changes, so strokes that few others see are chosen more
    often, and more variants of them are pushed. All costs at most `budget` full pushes.
    """
    effort, sand = Effort(), SandLoss(job.scene, job.height, job.goal)
    near = Around(sand, known.plan, known.way)
    while (room := int(budget - effort.cost)) > 0:
        plan, way, count = known.plan, known.way, len(known.plan)
        last = count < job.strokes
        rest = np.concatenate([count - np.arange(count), [1] * last])  # what a variant may cost, and what it is likely to
        cost = np.concatenate([near.touched, [1] * last])
        chance = (rest <= room) / np.sqrt(cost)
        k = int(rng.choice(len(rest), p=chance / chance.sum()))
        some = min(int(np.clip(_WORK / cost[k], _FEWEST, MOST_TRIED)), room // int(rest[k]))
        if k == count:
            new = promising(job, way[-1], some, rng)
            tried = np.concatenate([np.repeat(plan[None], len(new), axis=0), new[:, None]], axis=1)
        else:
            tried = _hopeful(job, plan, k, way, some, rng)
        before = near.calls
        maps = np.stack(list(near.along(tried)))
        effort += Effort(full=max(near.calls - before, 1))  # where no variant differs, too, so that this ends
        ends = distance(maps[-1], job.goal)
        best = int(ends.argmin())
        if ends[best] < known.left:
            known = PushedPlan(tried[best], maps[:, best], float(ends[best]))
            near = Around(sand, known.plan, known.way)
    return known, effort


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
