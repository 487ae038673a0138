"""The search over strokes with heights: the tool rises or sinks on its way, and so cuts and fills along a slope.

Three plans compete: rows over all that is to be shaped (coverage.py), strokes along the plan of least work (transport.py),
and strokes that are each the best of many on the sand that those before it left. Both ends of these have heights, drawn from
what the goal wants there and from the sand that lies there. The strokes of the best plan are then varied one at a time.
"""

import numpy as np
from scipy.ndimage import map_coordinates

from jaxsand.planning.search.actions import Job, Path, longest_stroke, shares
from jaxsand.planning.search.coverage import READINGS, coverage
from jaxsand.planning.search.rollouts import Effort, distance, pushed
from jaxsand.planning.search.strokes import finish
from jaxsand.planning.search.transport import heaviest

_ROUNDS = 4  # of trials for a stroke: the first are drawn anew, the others lie around the best
_KEPT = 8  # of a stroke's trials, for others around them
_AROUND = np.array([3.0, 3.0, 0.5, 3.0, 3.0, 0.5])  # how far these lie: in spacings, heights in the size of what is to do
_COVERAGE = 0.2  # of the budget at most is for coverage paths
_GREEDY = 0.7  # of what these leave is for the strokes one after the other; the rest varies the best plan
_VARIANTS = 16  # of a stroke at a time
_LEAST_WORK = 0.1  # of the budget at most is for a plan of least work
_PLACES = 17  # on a stroke's way at which the goal is looked at

Ended = tuple[np.ndarray, float]
"""A plan [k, 6] (m) of at most as many strokes as the job allows, and how far from the goal it leaves the sand (m)."""


def search_heights(job: Job, budget: float, rng: np.random.Generator) -> tuple[list[Path], Effort]:
    """The best strokes with heights found for a job, at a cost of at most `budget` full pushes.

    The best of three plans is varied: a coverage path, a plan of least work, and strokes that are each the best of many.
    """
    plans, effort = list[Ended](), Effort()
    for make, share in ((best_coverage, _COVERAGE), (least_work, _LEAST_WORK)):
        found, more = make(job, share * budget)
        plans.append(found)
        effort += more
    room = budget - effort.cost
    found, more = one_by_one(job, max(_GREEDY * room, min(room, job.strokes)), rng)
    plan, _ = min([*plans, found], key=lambda one: one[1])
    effort += more
    if len(plan):
        plan, more = _varied(job, plan, budget - effort.cost, rng)
        effort += more
    return [stroke.reshape(2, 3) for stroke in plan], effort


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
    """The best coverage path of as many readings as the budget allows, cut off where more rows do not help."""
    plans, cost = list[np.ndarray](), 0
    for reading in READINGS:
        plan = within(job, coverage(job.scene, job.goal, job.height, reading)[: job.strokes])
        if cost + len(plan) > budget:
            break
        plans.append(plan)
        cost += len(plan)
    if not cost:
        return (np.zeros((0, 6)), float(distance(job.height, job.goal))), Effort()
    maps = np.repeat(job.height[None], len(plans), axis=0)
    ends = [distance(maps, job.goal)]
    for k in range(max(map(len, plans))):
        some = [i for i, plan in enumerate(plans) if len(plan) > k]
        maps[some] = pushed(job.scene, maps[some], np.stack([plans[i][k] for i in some]))
        ends.append(distance(maps, job.goal))
    rows, best = np.unravel_index(int(np.argmin(ends)), (len(ends), len(plans)))
    return (plans[best][:rows], float(np.min(ends))), Effort(full=cost, gain=_gain(np.stack(ends)))


def _gain(ends: np.ndarray) -> float:
    """The largest step (m) towards the goal among distances [n, ...] after each stroke; 0 if there is none."""
    steps = (ends[:-1] - ends[1:])[np.isfinite(ends[1:]) & np.isfinite(ends[:-1])]
    return max(0.0, float(steps.max(initial=0.0)))


def one_by_one(job: Job, budget: float, rng: np.random.Generator) -> tuple[Ended, Effort]:
    """A plan in which each stroke is the best of those tried on the sand before it.

    A quarter of a stroke's trials are drawn anew, one of them from the plan of least work, and each further quarter lies
    around the best of all before, ever closer. Where none of them brings the sand closer to the goal, others are tried in
    place of the next stroke.
    """
    here, left = job.height, float(distance(job.height, job.goal))
    plan, effort = np.zeros((0, 6)), Effort()
    for k in range(job.strokes):
        share = int((budget - effort.cost) / (job.strokes - k))
        rounds = min(_ROUNDS, share)
        kept, far, best = np.zeros((0, 6)), np.zeros(0), None
        for turn in range(rounds):
            count = share // rounds + (turn < share % rounds)
            tried = around(job, here, kept, count, 0.5**turn, rng) if turn else _anew(job, here, count, rng)
            maps = pushed(job.scene, np.repeat(here[None], count, axis=0), tried)
            ends = distance(maps, job.goal)
            effort += Effort(full=count, gain=max(0.0, left - float(ends.min())))
            if best is None or ends.min() < far.min():
                best = maps[int(ends.argmin())]
            kept, far = np.concatenate([kept, tried]), np.concatenate([far, ends])
            order = np.argsort(far, kind="stable")[:_KEPT]
            kept, far = kept[order], far[order]
        if best is not None and far[0] < left:
            here, left, plan = best, float(far[0]), np.concatenate([plan, kept[:1]])
    return (plan, left), effort


def _anew(job: Job, here: np.ndarray, count: int, rng: np.random.Generator) -> np.ndarray:
    """Strokes [count, 6] (m) to try on a map: that of the plan of least work, and random ones."""
    first = within(job, heaviest(job.scene, job.goal, here))
    return np.concatenate([first, propose_heights(job, here, count - len(first), rng)])


def propose_heights(job: Job, height: np.ndarray, count: int, rng: np.random.Generator) -> np.ndarray:
    """Draws random strokes [count, 6] (m) that may bring `height` [H, W] closer to the job's goal.

    A quarter each run from where sand can be had to where it is wanted, from there to anywhere that counts, between places
    that count, and between any. Sand can be had where it lies above the goal, costly or not, and where the goal is free. The
    first are as high as the goal at their ends, or as the sand where the goal is free, and half of them start lower. The
    others follow the straight line that fits the goal best along their way. Two thirds are then moved a little up or down.
    """
    spacing = float(job.scene.grid.spacing)
    todo, free, goal = job.goal.off(height), job.goal.free, np.asarray(job.goal.height)
    anywhere, none = np.full(todo.size, 1 / todo.size), np.zeros(todo.size)
    counts = shares(~free.ravel() * 1.0, anywhere)
    wanted = shares(-todo.ravel(), counts)
    had = shares(
        shares(job.goal.apart(np.asarray(height, float)).ravel(), none) + 0.5 * shares(free.ravel() * 1.0, none), anywhere
    )
    many = count // 4 + 1
    pairs = ((had, wanted), (had, counts), (counts, counts), (anywhere, anywhere))
    cells = np.stack([[rng.choice(todo.size, many, p=share) for share in pair] for pair in pairs], axis=1)
    rows, columns = np.unravel_index(cells.reshape(2, -1), todo.shape)
    ends = np.stack([columns, rows], axis=-1) + rng.normal(0, 2, (2, 4 * many, 2))  # in cells, cell centres whole numbers
    ends = np.clip(ends, 0, np.array(todo.shape[::-1]) - 1)
    size = _size(todo)
    z, z[:, :many] = _along(goal, height, ends), _at(np.where(free, height, goal), ends[:, :many])
    z[0, :many] -= np.where(rng.random(many) < 0.5, rng.exponential(size, many), 0)
    z += rng.normal(0, 0.1 * size, z.shape) * (rng.random(4 * many) < 2 / 3)
    places = (ends + 0.5) * spacing
    drawn = np.concatenate([places[0], z[0, :, None], places[1], z[1, :, None]], axis=1)
    return within(job, rng.permutation(drawn)[:count])


def around(
    job: Job, height: np.ndarray, strokes: np.ndarray, count: int, scale: float, rng: np.random.Generator
) -> np.ndarray:
    """Strokes [count, 6] (m) near some of `strokes` [n, 6] (m): most of their numbers are moved at random.

    They are moved about `scale` times 3 spacings, their heights half of what is to do on the map `height` [H, W].
    """
    units = np.full(6, float(job.scene.grid.spacing))
    units[[2, 5]] = _size(job.goal.off(height))
    size = scale * _AROUND * units * np.exp(rng.normal(0, 0.7, (count, 1)))
    moved = np.where(rng.random((count, 6)) < 0.7, rng.normal(size=(count, 6)) * size, 0)
    return within(job, strokes[rng.integers(0, len(strokes), count)] + moved)


def within(job: Job, strokes: np.ndarray) -> np.ndarray:
    """Strokes [n, 6] (m) with both ends moved onto the map, and of lengths and heights that are allowed."""
    spacing = float(job.scene.grid.spacing)
    low, high = spacing / 2, (np.array(job.scene.grid.shape[::-1]) - 0.5) * spacing
    start, end = np.clip(strokes[:, :2], low, high), np.clip(strokes[:, 3:5], low, high)
    run = end - start
    length = np.hypot(*run.T)[:, None]
    run = np.where(length > 0, run, [1.0, 0.0]) / np.where(length > 0, length, 1)
    length = np.clip(length, job.actions.shortest * spacing, longest_stroke(job.scene, job.actions))
    heights = job.actions.allowed(strokes[:, [2, 5]])
    ends = [np.clip(start + sign * run * length, low, high) for sign in (1, -1)]
    far = [np.hypot(*(end - start).T)[:, None] for end in ends]
    fits = (far[0] >= np.minimum(length, far[1]) * (1 - 1e-9)) | (far[0] >= job.actions.shortest * spacing)
    end = np.where(fits, ends[0], ends[1])  # where the map ends too soon, the other way
    return np.concatenate([start, heights[:, :1], end, heights[:, 1:]], axis=1)


def _varied(job: Job, plan: np.ndarray, budget: float, rng: np.random.Generator) -> tuple[np.ndarray, Effort]:
    """Varies the strokes of a plan [n, 6] one at a time; a variant is judged by what the whole plan leaves.

    Strokes at the end that do not help are left out at last. All costs at most `budget` full pushes.
    """
    count, effort = len(plan), Effort()
    if budget < 2 * count:  # the plan itself, and one variant of its first stroke
        return plan, effort
    way = finish(job.scene, plan[None], 0, job.height[None])[:, 0]
    effort, left = Effort(full=count), distance(way[-1], job.goal)
    while True:
        k = int(rng.integers(count))
        some = min(_VARIANTS, int((budget - effort.cost) / (count - k)))
        if some < 1:
            break
        tried = np.repeat(plan[None], some, axis=0)
        tried[:, k] = around(job, way[-1], plan[k : k + 1], some, float(np.exp(rng.uniform(-3, 0))), rng)
        maps = finish(job.scene, tried, k, way[k][None])
        ends = distance(maps[-1], job.goal)
        effort += Effort(full=some * (count - k))
        best = int(ends.argmin())
        if ends[best] < left:
            left, plan, way = ends[best], tried[best], np.concatenate([way[:k], maps[:, best]])
    return plan[: int(distance(way, job.goal).argmin())], effort


def _along(goal: np.ndarray, height: np.ndarray, ends: np.ndarray) -> np.ndarray:
    """Heights [2, n] (m) at the ends [2, n, 2] (cells) of strokes, on the line that fits the goal best on the way between.

    Where a stroke meets fewer than two places that count, they are the sand's.
    """
    share = np.linspace(0, 1, _PLACES)[:, None]
    found = _at(goal, ends[0] + share[..., None] * (ends[1] - ends[0]))
    counts = np.isfinite(found)
    many = np.maximum(counts.sum(0), 1)
    middle, level = (np.where(counts, x, 0).sum(0) / many for x in (share, found))
    apart = np.where(counts, share - middle, 0)
    spread = (apart**2).sum(0)
    slope = (apart * np.where(counts, found - level, 0)).sum(0) / np.where(spread > 0, spread, 1)
    line = level + np.array([[0.0], [1.0]] - middle) * slope
    return np.where(spread > 0, line, _at(height, ends))


def _at(surface: np.ndarray, places: np.ndarray) -> np.ndarray:
    """A surface [H, W] at places [..., 2] (cells: column, row), interpolated; NaN beside cells that are NaN."""
    return map_coordinates(surface, np.moveaxis(places[..., ::-1], -1, 0), order=1, mode="nearest")


def _size(todo: np.ndarray) -> float:
    """The root mean square (m) of what is to do, where there is something."""
    return float(np.sqrt((todo**2).sum() / max(np.count_nonzero(todo), 1)))
