"""The search over paths with the tool down, in layers of maps; each node also has the place where the tool stands."""

from dataclasses import replace

import jax
import numpy as np

from jaxsand.interaction.simulate import follow
from jaxsand.planning.search.actions import Job, Path, corners
from jaxsand.planning.search.rollouts import Effort, distance, distinct, marks, walked
from jaxsand.relaxation.stopping import Outcome
from jaxsand.scene.scene import Scene

_MOVES = np.array([(1, 0), (0, 1), (-1, 0), (0, -1)])
_GRAIN = 1 / 50  # of the largest height to change: what maps are told apart by
_JUDGED = 12  # paths that are followed in full at the end
Places = np.ndarray  # [n, 2]: row and column of corners


def search_steps(job: Job, hint: Places, budget: float, rng: np.random.Generator) -> tuple[list[Path], Effort]:
    """The best path found for a job, at a cost of at most `budget` full pushes of one leg each.

    The path `hint` (rows and columns of corners [n, 2]) is kept in every layer as far as it goes, and judged with the
    others. Each leg takes four children, and a leg of the path that is judged at last: where the budget is too little for
    that, paths are shorter, and where it is too little for one leg, the hint alone is judged.

    Returns:
      One path [n, 2] (m), or none if no path brings the sand closer; and what the search cost.
    """
    del rng  # nothing is drawn
    at = corners(job.scene, job.actions)
    legs, judged = min(job.strokes, int(budget / 5)), 1
    found, effort = list[tuple[float, Places]](), Effort()
    if legs:
        judged = min(_JUDGED, int(budget / legs) - 4)
        width = int((budget - judged * legs) / (4 * legs))
        found, effort = in_layers(replace(job, strokes=legs), _starts(job, at, width), hint, width)
    paths = [hint[: (legs or min(job.strokes, int(budget))) + 1]] if len(hint) > 1 else []
    paths += [path for _, path in sorted(found, key=lambda pair: pair[0])[: judged - len(paths)]]
    followed = [follow_padded(job.scene, job.height, at[tuple(path.T)], job.strokes) for path in paths]
    best = int(np.argmin(distance(np.stack([job.height, *followed]), job.goal)))
    legs = sum(len(path) - 1 for path in paths)
    return [at[tuple(paths[best - 1].T)]] if best else [], effort + Effort(full=legs)


def in_layers(job: Job, starts: Places, hint: Places, width: int) -> tuple[list[tuple[float, Places]], Effort]:
    """Searches best-first in layers: the paths of layer k have k legs.

    A node is the map with the tool down and the tool's place, and it is ranked by its map with the tool lifted. Of the
    children of a layer the `width` best are kept whose lifted maps or places differ. For why order by distance is A*'s order
    see `strokes.in_layers`.

    Args:
      job: what to search for.
      starts: rows and columns [n, 2] of the corners to begin at.
      hint: a path whose beginning is kept in every layer.
      width: nodes of a layer.

    Returns:
      The best paths of each layer, with how far from the goal they leave the sand (m); and what the search cost.
    """
    at = corners(job.scene, job.actions)
    grain = _GRAIN * np.abs(job.goal.off(job.height)).max()
    down, paths = np.repeat(job.height[None], len(starts), axis=0), starts[:, None]
    far = distance(down, job.goal)
    found: list[tuple[float, Places]] = []
    effort = Effort()
    for _ in range(job.strokes):
        parent = np.repeat(np.arange(len(paths)), 4)
        place = paths[parent, -1] + np.tile(_MOVES, (len(paths), 1))
        on = np.all((place >= 0) & (place < at.shape[:2]), axis=1)
        parent, place = parent[on], place[on]
        if not len(place):
            break
        legs = np.concatenate([at[tuple(paths[parent, -1].T)], at[tuple(place.T)]], axis=1)
        after, lifted = walked(job.scene, down[parent], legs)
        ends = distance(lifted, job.goal)
        effort += Effort(full=len(legs), gain=float(np.max(far[parent] - ends)))
        longer = np.concatenate([paths[parent], place[:, None]], axis=1)
        order = np.argsort(np.where(_follows(longer, hint), -np.inf, ends), kind="stable")
        names = [mark + spot.tobytes() for mark, spot in zip(marks(lifted, grain), place, strict=True)]
        kept = distinct(names, parent, order, width, 4)
        down, paths, far = after[kept], longer[kept], ends[kept]
        found += [(float(far[i]), paths[i]) for i in np.argsort(far, kind="stable")[:_JUDGED]]
    return found, effort


def follow_padded(scene: Scene, height: np.ndarray, path: Path, legs: int) -> np.ndarray:
    """The map [H, W] that `follow` makes of a path of up to `legs` legs, all by one program; NaN where the outcome is not
    clean.
    """
    path = np.concatenate([path, np.repeat(path[-1:], legs + 1 - len(path), axis=0)])
    shaped = jax.block_until_ready(follow(scene, np.asarray(height, np.float32), path.astype(np.float32)))
    return np.asarray(shaped.height) if int(shaped.outcome) == Outcome(0) else np.full(height.shape, np.nan)


def _starts(job: Job, at: np.ndarray, count: int) -> Places:
    """The `count` corners with the most surplus sand around them, or the first corner if there is none."""
    half = job.actions.cell // 2
    rows, columns = np.floor(at[..., ::-1] / float(job.scene.grid.spacing)).astype(int).reshape(-1, 2).T
    surplus = np.pad(np.maximum(job.goal.off(job.height), 0).astype(float), half)
    window = 2 * half + 1
    nearby = np.array([surplus[r : r + window, c : c + window].sum() for r, c in zip(rows, columns, strict=True)])
    best = [i for i in np.argsort(-nearby, kind="stable")[:count] if nearby[i] > 0] or [0]
    return np.stack(np.unravel_index(best, at.shape[:2]), axis=1)


def _follows(paths: Places, hint: Places) -> np.ndarray:
    """Which of the paths [n, k, 2] begin as the hint does."""
    k = paths.shape[1]
    return np.all(paths == hint[None, :k], axis=(1, 2)) if k <= len(hint) else np.zeros(len(paths), bool)
