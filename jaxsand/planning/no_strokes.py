"""Why a search found no stroke."""

import numpy as np

from jaxsand.goals.goal import Goal
from jaxsand.scene.boundaries import Closed, Walls
from jaxsand.scene.scene import Scene

_EVEN = 0.1  # of all that is to change: with less sand missing, the volume is not what is in the way


def why_no_strokes(scene: Scene, start: np.ndarray, goal: Goal) -> str:
    """One line that says why no stroke was found, and what to do.

    Args:
      scene: grid, edge and walls.
      start: the map [H, W] (m) before.
      goal: what is wanted.
    """
    change = -goal.off(np.asarray(start, float))
    if isinstance(scene.walls, Walls):
        change = np.where(np.asarray(scene.walls.solid), 0, change)
    if not change.any():
        return "the sand lies as the goal has it already, where that counts; nothing is to be done"
    everywhere = bool(np.all(np.asarray(goal.above) > 0) and np.all(np.asarray(goal.below) > 0))
    which = "over the whole map, where berms count" if everywhere else "where its height counts"
    reason = f"no stroke that was tried brings the sand nearer to the goal, {which}"
    more = float(change.sum()) * float(scene.grid.spacing) ** 2
    if isinstance(scene.edge, Closed) and everywhere and abs(change.sum()) > _EVEN * np.abs(change).sum():
        which, equal = ("more", "trenches that give what its heaps take") if more > 0 else ("less", "berms of what it digs")
        return (
            f"{reason}: the goal has {abs(more):.2g} m^3 {which} sand than the map, and strokes keep the sand; "
            f"give a goal of equal volume, with {equal}"
        )
    return f"{reason}; allow more strokes or pushes, or give the tool another size or depth"
