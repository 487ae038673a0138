"""From a policy to a plan: the policy alone, or with look-ahead, then with gradients. Both of these can be left out."""

from dataclasses import dataclass

import numpy as np

from jaxsand.planning.gradient import optimise_strokes
from jaxsand.planning.learned.beam_search import Proposes, look_ahead, one_after_the_other
from jaxsand.planning.no_strokes import why_no_strokes
from jaxsand.planning.stroke_loss import SandLoss
from jaxsand.scene.progress import Tell, quiet


@dataclass(frozen=True)
class Stages:
    """What follows the policy.

    Attributes:
      width: plans in the beam that looks ahead with the simulator; 0 leaves look-ahead out.
      polish: calls of the simulator that gradients may spend on the plan; 0 leaves them out.
    """

    width: int = 0
    polish: int = 0


@dataclass(frozen=True)
class Planned:
    """A plan by the policy.

    Attributes:
      strokes: [N, 4] (m).
      before: what the start costs by the goal: the squared distance (m^2), if all cells count alike.
      after: the same after the strokes.
      calls: how often the simulator was called.
      reason: why there are no strokes, and what to do; None where there are some.
    """

    strokes: np.ndarray
    before: float
    after: float
    calls: int
    reason: str | None = None


def plan_by_policy(
    policy: Proposes,
    sand: SandLoss,
    strokes: int,
    stages: Stages = Stages(),
    tell: Tell = quiet,
) -> Planned:
    """Plans at most `strokes` strokes towards the goal.

    The policy alone makes all of them, whatever comes of it; with look-ahead a plan ends where nothing brings the sand
    closer. Gradients start from that plan, and their plan is taken if it ends closer.
    """
    before = sand.loss_of(sand.start)
    if stages.width:
        found = look_ahead(policy, sand, strokes, stages.width, tell)
        plan, after, calls = found.strokes, float(found.losses[-1]), found.calls
    else:
        plans, maps = one_after_the_other(policy, sand.scene, sand.start[None], sand.target[None], strokes)
        plan, after, calls = plans[0], sand.loss_of(maps[-1, 0]), strokes
    if stages.polish and len(plan):
        tell("gradients")
        polished = optimise_strokes(
            sand.scene, sand.goal, start=sand.start, guess=plan, budget=stages.polish, smoothing=None, tell=tell
        )
        calls += polished.spent
        if polished.losses[-1] < after:
            plan, after = polished.strokes, float(polished.losses[-1])
    reason = None if len(plan) else why_no_strokes(sand.scene, sand.start, sand.goal)
    return Planned(plan, before, after, calls, reason)
