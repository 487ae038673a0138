"""From a policy to a plan: by itself, or looking ahead with the simulator, then by gradients; each stage can be left out."""

from dataclasses import dataclass

import numpy as np

from jaxsand.planning.gradient import optimise_strokes
from jaxsand.planning.learned.beam_search import Proposes, look_ahead, one_after_the_other
from jaxsand.planning.stroke_loss import SandLoss
from jaxsand.scene.progress import Tell, quiet


@dataclass(frozen=True)
class Stages:
    """What follows the policy: a beam of so many plans that are tried on the sand, its `width` (0: none), the best of
    which is put right, and gradients at a cost of `polish` calls of the simulator (0: none)."""

    width: int = 0
    polish: int = 0


@dataclass(frozen=True)
class Planned:
    """A plan `strokes` [N, 4] (m), the squared distances `before` and `after` (m^2), and the simulator's `calls`."""

    strokes: np.ndarray
    before: float
    after: float
    calls: int


def plan_by_policy(
    policy: Proposes,
    sand: SandLoss,
    strokes: int,
    stages: Stages = Stages(),
    tell: Tell = quiet,
) -> Planned:
    """At most so many strokes towards the goal.

    The policy alone makes them all, whatever comes of it; with look-ahead a plan ends where nothing brings the sand closer.
    Gradients start from that plan, and theirs is taken if it ends closer.
    """
    before = sand.loss_of(sand.start)
    if stages.width:
        found = look_ahead(policy, sand, strokes, stages.width, tell)
        plan, after, calls = found.strokes, float(found.losses[-1]), found.calls
    else:
        plans, maps = one_after_the_other(policy, sand.scene, sand.start[None], sand.goal[None], strokes)
        plan, after, calls = plans[0], sand.loss_of(maps[-1, 0]), strokes
    if stages.polish and len(plan):
        tell("gradients")
        polished = optimise_strokes(
            sand.scene, sand.goal, start=sand.start, guess=plan, budget=stages.polish, smoothing=None, tell=tell
        )
        calls += polished.spent
        if polished.losses[-1] < after:
            plan, after = polished.strokes, float(polished.losses[-1])
    return Planned(plan, before, after, calls)
