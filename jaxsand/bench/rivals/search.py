"""What a search on real sand has to beat, at the same number of pushes: the binary plan, greedy, and random strokes.

All of them draw from the same proposals as the search, and are judged by the same replay.
"""

from itertools import product

import numpy as np

from jaxsand.planning.search.actions import Job, Path, Steps, corners, propose
from jaxsand.planning.search.binary import binary_hints, binary_paths, binary_strokes, blade_cells
from jaxsand.planning.search.rollouts import Effort, distance, pushed, replay
from jaxsand.planning.search.steps import follow_padded
from jaxsand.planning.search.steps import in_layers as steps_in_layers
from jaxsand.planning.search.strokes import in_layers

Tried = tuple[list[Path], Effort]


def binary(job: Job, budget: float, rng: np.random.Generator) -> Tried:
    """The binary plan, in as many strokes or legs as it needs, the best of several readings.

    They are: one path for each piece without lifting, or its straight runs one by one; blocks as wide as the blade (with
    `Steps`, its cells) at every offset from the map's edge; dug where at least half, or a quarter, is to be dug.
    """
    del budget, rng
    steps = job.actions if isinstance(job.actions, Steps) else Steps(blade_cells(job.scene))
    cells = 1 if steps is job.actions else steps.cell
    offsets = [(row, column) for row in range(cells) for column in range(cells)]
    readings: list[list[Path]] = [[]]
    for offset, part in product(offsets, (0.5, 0.25)):
        at = corners(job.scene, steps, offset)
        walks = binary_paths(job.scene, job.height, job.goal, steps, offset, part)
        readings.append([at[tuple(np.concatenate([w, w[-1:]]).T if len(w) == 1 else w.T)] for w in walks])
        if steps is not job.actions:
            runs = binary_strokes(job.scene, job.height, job.goal, offset, part)
            readings.append([run.reshape(2, 2) for run in runs])
    ends = [float(distance(_replayed(job, paths), job.goal)) for paths in readings]
    return readings[int(np.argmin(ends))], Effort(full=sum(len(path) - 1 for paths in readings for path in paths))


def greedy(job: Job, budget: float, rng: np.random.Generator) -> Tried:
    """At each stroke the best of equally many children, all pushed in full; ends where none brings the sand closer."""
    count = int(budget / job.strokes)
    height, left, paths, effort = job.height, float(distance(job.height, job.goal)), [], Effort()
    for _ in range(job.strokes):
        ways = propose(job.scene, job.actions, height, job.goal, count, rng)
        maps = pushed(job.scene, np.repeat(height[None], count, axis=0), ways)
        far = distance(maps, job.goal)
        best = int(far.argmin())
        effort += Effort(full=count, gain=left - float(far[best]))
        if far[best] >= left:
            break
        height, left = maps[best], float(far[best])
        paths.append(ways[best].reshape(2, 2))
    return paths, effort


def greedy_ranked(job: Job, budget: float, rng: np.random.Generator) -> Tried:
    """Greedy with half of its budget spent on rough pushes, which tell what to push in full."""
    return _of_layers(job, budget, 1, rng)


def layers(job: Job, budget: float, rng: np.random.Generator) -> Tried:
    """The layers of the search alone, at the whole budget; for what they are worth without the rest."""
    return _of_layers(job, budget, 8, rng)


def greedy_restarted(job: Job, budget: float, rng: np.random.Generator, times: int = 5) -> Tried:
    """The best of several greedy runs at a share of the budget each."""
    runs = [greedy(job, budget / times, rng) for _ in range(times)]
    ends = [float(distance(replay(job.scene, job.height, paths), job.goal)) for paths, _ in runs]
    return runs[int(np.argmin(ends))][0], sum((effort for _, effort in runs), Effort())


def shooting(job: Job, budget: float, rng: np.random.Generator) -> Tried:
    """The best of random plans, as far as it helps."""
    count = int(budget / job.strokes)
    maps, ends, ways = np.repeat(job.height[None], count, axis=0), [], []
    for _ in range(job.strokes):
        ways.append(propose(job.scene, job.actions, job.height, job.goal, count, rng))
        maps = pushed(job.scene, maps, ways[-1])
        ends.append(distance(maps, job.goal))
    length, best = np.unravel_index(int(np.argmin(ends)), (job.strokes, count))
    return [ways[k][best].reshape(2, 2) for k in range(length + 1)], Effort(full=count * job.strokes)


def greedy_steps(job: Job, budget: float, rng: np.random.Generator) -> Tried:
    """Greedy from as many starts, drawn at random, as the budget allows: at each leg the best of four."""
    at = corners(job.scene, job.actions)
    starts = np.stack([a.ravel() for a in np.indices(at.shape[:2])], axis=1)
    starts = rng.permutation(starts)[: max(1, int(budget / (4 * job.strokes)))]
    found: list[tuple[float, np.ndarray]] = []
    effort = Effort()
    for start in starts:
        some, more = steps_in_layers(job, start[None], np.zeros((0, 2), int), 1)
        found, effort = found + some, effort + more
    best = sorted(found, key=lambda pair: pair[0])[:12]
    return _best_followed(job, [path for _, path in best]), effort


def random_walks(job: Job, budget: float, rng: np.random.Generator) -> Tried:
    """The best of random walks from random starts, as far as it helps; none turns back at once."""
    at = corners(job.scene, job.actions)
    moves = np.array([(1, 0), (0, 1), (-1, 0), (0, -1)])
    walks = []
    for _ in range(max(1, int(budget / job.strokes))):
        walk = [rng.integers(0, at.shape[:2])]
        last = np.zeros(2, int)
        while len(walk) <= job.strokes:
            move = moves[rng.integers(4)]
            place = walk[-1] + move
            if np.all((place >= 0) & (place < at.shape[:2])) and np.any(move != -last):
                walk.append(place)
                last = move
        walks.append(np.array(walk))
    return _best_followed(job, walks), Effort(full=len(walks) * job.strokes)


def _of_layers(job: Job, budget: float, width: int, rng: np.random.Generator) -> Tried:
    nodes, effort = in_layers(job, binary_hints(job), budget, width, rng)
    paths = [stroke.reshape(2, 2) for stroke in nodes.plans[0]]
    ends = [float(distance(replay(job.scene, job.height, paths[:n]), job.goal)) for n in range(len(paths) + 1)]
    return paths[: int(np.argmin(ends))], effort


def _best_followed(job: Job, walks: list[np.ndarray]) -> list[Path]:
    at = corners(job.scene, job.actions)
    ends = [distance(follow_padded(job.scene, job.height, at[tuple(walk.T)], job.strokes), job.goal) for walk in walks]
    return [at[tuple(walks[int(np.argmin(ends))].T)]]


def _replayed(job: Job, paths: list[Path]) -> np.ndarray:
    """`replay` by few programs: paths are filled up to a multiple of 16 points."""
    height = job.height
    for path in paths:
        height = follow_padded(job.scene, height, path, 1 if len(path) == 2 else -(-len(path) // 16) * 16)
    return height
