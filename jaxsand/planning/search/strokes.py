"""The search over strokes with the tool lifted in between: layers of maps, then better strokes one by one."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from jaxsand.planning.search.actions import Job, Path, confined, moved, propose
from jaxsand.planning.search.rollouts import CHEAP, Effort, distance, distinct, marks, pushed, roughly_pushed
from jaxsand.scene.scene import Scene

_Push = Callable[[Scene, np.ndarray, np.ndarray], np.ndarray]  # what strokes [n, 4] make of maps [n, H, W]
_LAYERS = 0.25  # of the budget goes to the layers, half of it to rough pushes
_GRAIN = 1 / 20  # of the largest height to change: what maps are told apart by
_TRIED = 8  # variants of a plan, the best by rough pushes, are pushed in full
_WIDTH = 8  # nodes that a layer keeps
_CHILDREN = 2  # of one node among them
_PLANS = 12  # strokes in all plans that are improved at first; one plan at last
_FULL = 0.75  # of what is left of the budget goes to full pushes at most, where it is too little for a whole turn


@dataclass(frozen=True)
class Nodes:
    """The nodes of a layer, closest to the goal first.

    Attributes:
      maps: [n, H, W] (m), what the plans leave.
      plans: [n, k, 4] (m).
      distance: [n] (m), of the maps from the goal.
    """

    maps: np.ndarray
    plans: np.ndarray
    distance: np.ndarray


def search_strokes(job: Job, hints: np.ndarray, budget: float, rng: np.random.Generator) -> tuple[list[Path], Effort]:
    """The best strokes found for a job, at a cost of at most `budget` full pushes; the strokes `hints` [m, 4] are tried
    everywhere, the first of them where the budget does not allow all.
    """
    least = min(budget, 1.5 * job.strokes)  # a full push and six rough ones a layer
    nodes, effort = in_layers(job, hints, max(_LAYERS * budget, least), _WIDTH, rng)
    count = nodes.plans.shape[1]
    affordable = int((budget - effort.cost) / count) if count else 0
    if not affordable:
        return [stroke.reshape(2, 2) for stroke in nodes.plans[0]], effort
    plans = nodes.plans[: min(max(1, _PLANS // job.strokes), affordable)]
    plan, more = improved(job, plans, budget - effort.cost, rng)
    return [stroke.reshape(2, 2) for stroke in plan], effort + more


def in_layers(job: Job, hints: np.ndarray, budget: float, width: int, rng: np.random.Generator) -> tuple[Nodes, Effort]:
    """Searches best-first in layers: the nodes of layer k have taken k strokes.

    All children of a layer are pushed roughly, the best of them in full, and of these the `width` best that differ are kept.
    All layers cost at most `budget` full pushes. Where that is too little for every node to try all of `hints`, the closest
    nodes try the first of them, and where it is too little for a push in every layer, plans have fewer strokes.

    They are ordered by distance from the goal, which is A*'s order: in f = g + h, with h the distance over the most that one
    stroke can change, g is the same for a whole layer and the divisor for all nodes.
    """
    grain = _GRAIN * np.abs(job.goal.off(job.height)).max()
    nodes = Nodes(job.height[None], np.zeros((1, 0, 4)), distance(job.height[None], job.goal))
    exact = max(1, int(budget / job.strokes / 2))
    effort = Effort()
    for _ in range(job.strokes):
        ranked = _rough(min(exact, budget - effort.cost - exact))
        if ranked < 2:
            break
        trying = min(len(nodes.plans), max(1, ranked // (2 + len(hints))))
        some = hints[: ranked // trying - 2]
        share = ranked // trying - len(some)
        ways = np.concatenate(
            [[*propose(job.scene, job.actions, m, job.goal, share, rng), *some] for m in nodes.maps[:trying]]
        )
        parent = np.repeat(np.arange(trying), share + len(some))
        rough = distance(roughly_pushed(job.scene, nodes.maps[parent], ways), job.goal)
        best = np.argsort(rough, kind="stable")[:exact]
        parent, ways = parent[best], ways[best]
        maps = pushed(job.scene, nodes.maps[parent], ways)
        far = distance(maps, job.goal)
        effort += Effort(len(maps), len(rough), float(np.max(nodes.distance[parent] - far)))
        most = width if len(nodes.plans) == 1 else _CHILDREN
        kept = distinct(marks(maps, grain), parent, np.argsort(far, kind="stable"), width, most)
        nodes = Nodes(maps[kept], np.concatenate([nodes.plans[parent], ways[:, None]], axis=1)[kept], far[kept])
    return nodes, effort


def improved(job: Job, plans: np.ndarray, budget: float, rng: np.random.Generator) -> tuple[np.ndarray, Effort]:
    """Varies the strokes of plans [m, n, 4] one at a time, and returns the best plan.

    Variants of a stroke are ranked roughly: the map expected of a variant is the map that the plan leaves, plus the
    difference that rough pushes make between the two. The best variants are pushed in full. Plans that lag behind are given
    up on the way. Strokes at the end that do not help are left out at last. All that is pushed, the plans themselves once,
    costs at most `budget` full pushes; it must allow the plans.

    Returns:
      The plan [k, 4] (m), and what the search cost.
    """
    count = plans.shape[1]
    ways = [finish(job.scene, plan[None], 0, job.height[None])[:, 0] for plan in plans]
    plans, effort = plans.copy(), Effort(plans.size // 4)
    far = np.array([distance(way[-1], job.goal) for way in ways])
    turn = 0
    while effort.cost < budget:
        racing = np.argsort(far, kind="stable")[: max(1, round(len(plans) * (1 - 1.3 * effort.cost / budget)))]
        a, k = racing[turn % len(racing)], int(rng.integers(count))
        turn += 1
        anew = turn % (2 * count) == 0  # three times as dear as another turn
        tried = _far(job, plans[a], k, ways[a], rng) if anew else _near(job, plans[a], k, rng)
        room = (budget - effort.cost) / (count - k)  # how often all strokes from k on can be pushed in full
        full = min(_TRIED, int(_FULL * room))
        tried = tried[: max(0, _rough(room - full) - 1)]
        if not full or not len(tried):
            break
        rough = finish(job.scene, np.concatenate([plans[a][None], tried]), k, ways[a][k][None], roughly_pushed)[-1]
        hoped = distance(ways[a][-1] + (rough[1:] - rough[0]), job.goal)
        tried = tried[np.argsort(hoped, kind="stable")[:full]]
        after = finish(job.scene, tried, k, ways[a][k][None])
        ends = distance(after[-1], job.goal)
        steps = distance(after, job.goal)
        gain = float(np.nanmax(steps[:-1] - steps[1:]))
        effort += Effort(len(tried) * (count - k), len(rough) * (count - k), gain)
        best = int(ends.argmin())
        if ends[best] < far[a]:
            far[a], plans[a], ways[a] = ends[best], tried[best], np.concatenate([ways[a][:k], after[:, best]])
    best = int(far.argmin())
    return plans[best][: int(distance(ways[best], job.goal).argmin())], effort


def finish(scene: Scene, plans: np.ndarray, first: int, start: np.ndarray, push: _Push = pushed) -> np.ndarray:
    """Pushes the strokes of plans [m, n, 4] from stroke `first` on.

    Returns:
      The maps [n - first + 1, m, H, W] before each of these strokes and at the end; all begin from `start` [1, H, W].
    """
    maps = [np.repeat(start, len(plans), axis=0)]
    for k in range(first, plans.shape[1]):
        maps.append(push(scene, maps[-1], plans[:, k]))
    return np.stack(maps)


def _rough(cost: float) -> int:
    """The number of rough pushes that cost no more than `cost` full ones."""
    return int(cost / CHEAP + 1e-6)


def _near(job: Job, plan: np.ndarray, k: int, rng: np.random.Generator) -> np.ndarray:
    """Plans [31, n, 4] that differ from `plan` [n, 4] in stroke k: it is moved, reversed, or swapped with the next."""
    some = np.repeat(plan[None], 31, axis=0)
    some[:, k] = moved(job.scene, job.actions, some[:, k], rng)
    some[0, k] = plan[k][[2, 3, 0, 1]]
    if k + 1 < len(plan):
        some[1] = plan[[*range(k), k + 1, k, *range(k + 2, len(plan))]]
    return some


def _far(job: Job, plan: np.ndarray, k: int, way: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Plans [255, n, 4] in which stroke k of `plan` [n, 4] is replaced.

    A new stroke takes its place; or k is left out and a new one added at the end; or k is joined with the next, and a new
    one takes the place that is free. New strokes are proposed from the maps `way` on the plan's way, before k and at its
    end.
    """
    some = np.repeat(plan[None], 255, axis=0)
    early, late = (propose(job.scene, job.actions, m, job.goal, 128, rng) for m in (way[k], way[-1]))
    some[:128, k], some[128:, k] = early, late[:127]
    some[64:128] = np.concatenate([np.repeat(np.delete(plan, k, axis=0)[None], 64, axis=0), late[64:, None]], axis=1)
    if k + 1 < len(plan):
        joined = np.concatenate([plan[k, :2], plan[k + 1, 2:]])[None]
        some[192:, k + 1] = confined(job.scene, job.actions, joined)
    return some
