"""What a search for earth-moving strokes has to beat: coverage paths, random strokes, and plans of least work.

Each takes a job and a budget of pushes, and returns strokes [n, 6] = x0, y0, z0, x1, y1, z1 (m) with the distance that they
leave, and the pushes it tried.
"""

import numpy as np

from jaxsand.planning.search.actions import Job
from jaxsand.planning.search.drafts import Ended, best_coverage, least_work
from jaxsand.planning.search.proposals import propose_heights
from jaxsand.planning.search.rollouts import Effort, distance, pushed

Found = tuple[Ended, Effort]


def coverage_paths(job: Job, budget: float, rng: np.random.Generator) -> Found:
    """The best of 36 coverage paths, or of as many as the budget allows; see `coverage`."""
    del rng
    return best_coverage(job, budget)


def random_strokes(job: Job, budget: float, rng: np.random.Generator) -> Found:
    """Random strokes between places that count: the best plan of as many as the budget allows."""
    strokes = min(job.strokes, int(budget))
    count = int(budget / strokes)
    ways = [propose_heights(job, job.height, count, rng) for _ in range(strokes)]
    maps = np.repeat(job.height[None], count, axis=0)
    for way in ways:
        maps = pushed(job.scene, maps, way)
    ends = distance(maps, job.goal)
    return (np.stack(ways)[:, int(ends.argmin())], float(ends.min())), Effort(full=count * strokes)


def transported(job: Job, budget: float, rng: np.random.Generator) -> Found:
    """Strokes along the plan of least work, made anew on the sand that each leaves; see `least_work`."""
    del rng
    return least_work(job, budget)
