"""What a search for earth-moving strokes has to beat: coverage paths, random strokes, and plans of least work.

Each takes a job and a budget of pushes, and returns strokes [n, 6] = x0, y0, z0, x1, y1, z1 (m) and the pushes it tried.
"""

import numpy as np

from jaxsand.planning.search.actions import Job
from jaxsand.planning.search.heights import best_coverage, propose_heights
from jaxsand.planning.search.rollouts import Effort, distance, pushed
from jaxsand.planning.search.transport import heaviest

Found = tuple[np.ndarray, Effort]


def coverage_paths(job: Job, budget: float, rng: np.random.Generator) -> Found:
    """The best of 36 coverage paths, or of as many as the budget allows; see `coverage`."""
    del rng
    return best_coverage(job, budget)


def random_strokes(job: Job, budget: float, rng: np.random.Generator) -> Found:
    """Random strokes between places that count: the best plan of as many as the budget allows."""
    count = max(1, int(budget / job.strokes))
    ways = [propose_heights(job, job.height, count, rng) for _ in range(job.strokes)]
    maps = np.repeat(job.height[None], count, axis=0)
    for way in ways:
        maps = pushed(job.scene, maps, way)
    return np.stack(ways)[:, int(distance(maps, job.goal).argmin())], Effort(full=count * job.strokes)


def least_work(job: Job, budget: float, rng: np.random.Generator) -> Found:
    """Strokes along the plan of least work, made anew on the sand that each stroke leaves; none is tried before."""
    del rng
    maps, plan = [job.height], np.zeros((0, 6))
    for _ in range(min(job.strokes, int(budget))):
        stroke = heaviest(job.scene, job.goal, maps[-1])
        after = pushed(job.scene, maps[-1][None], stroke)[0] if len(stroke) else np.full_like(job.height, np.nan)
        if np.isnan(after).any():
            break
        maps.append(after)
        plan = np.concatenate([plan, stroke])
    return plan[: int(distance(np.stack(maps), job.goal).argmin())], Effort(full=len(plan))
