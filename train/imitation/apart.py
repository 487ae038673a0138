"""Goals of random strokes set apart, by which policies are validated. No letter is among them."""

from functools import cache

import numpy as np

from jaxsand.goals.metrics import iou
from jaxsand.goals.success import right, strokes_right
from jaxsand.goals.usual import usual_scene
from jaxsand.planning.learned.beam_search import Proposes, one_after_the_other
from jaxsand.scene.scene import Scene, blade_of
from train.imitation.lessons import way
from train.imitation.plans import MOST, random_plans
from train.imitation.sand import starts

_SEED = 1_000_003  # of the goals
_TRIALS = 64  # goals


def judged_apart(policy: Proposes) -> dict[str, float]:
    """Judges a policy alone on the goals set apart, with as many strokes as made each of them.

    Returns:
      The share of goals that is `right`, the share of `strokes` that are, the `iou`, and the mean of the three, `score`.
    """
    scene, strokes, numbers, goals = _set_apart()
    depth = float(blade_of(scene).depth)
    plans, maps = one_after_the_other(policy, scene, np.zeros_like(goals), goals, MOST)
    rows = [(strokes[k, :n], plans[k, :n], maps[n, k], goals[k]) for k, n in enumerate(numbers)]
    good = float(np.mean([right(goal, after, depth) for _, _, after, goal in rows]))
    made = sum(strokes_right(a, b) for a, b, _, _ in rows) / float(numbers.sum())
    same = float(np.mean([iou(goal, after, depth) for _, _, after, goal in rows]))
    return {"score": (good + made + same) / 3, "right": good, "strokes": made, "iou": same}


@cache
def _set_apart() -> tuple[Scene, np.ndarray, np.ndarray, np.ndarray]:
    """The scene, the strokes and their numbers, and the goals that they make of level sand."""
    scene, rng = usual_scene(), np.random.default_rng(_SEED)
    strokes, numbers = random_plans(rng, _TRIALS)
    return scene, strokes, numbers, way(scene, starts(scene, rng, _TRIALS, 0.0), strokes, numbers)[0]
