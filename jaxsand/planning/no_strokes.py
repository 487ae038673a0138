"""Why a search by the l2 distance of whole maps found no stroke."""

import numpy as np

from jaxsand.goals.metrics import still_to_do
from jaxsand.scene.boundaries import Closed, Walls
from jaxsand.scene.scene import Scene

_EVEN = 0.1  # of all that is to change: with less sand missing, the volume is not what is in the way


def why_no_strokes(scene: Scene, start: np.ndarray, goal: np.ndarray) -> str:
    """One line that says why no stroke was found, and what to do.

    Args:
      scene: grid, edge and walls.
      start: the map [H, W] (m) before.
      goal: [H, W] (m), NaN where it is free.
    """
    change = -still_to_do(start, goal)
    if isinstance(scene.walls, Walls):
        change = np.where(np.asarray(scene.walls.solid), 0, change)
    if not change.any():
        return "the sand lies as the goal has it already; nothing is to be done"
    reason = "no stroke that was tried brings the sand nearer to the goal, in l2 over the whole map, where berms count"
    more = float(change.sum()) * float(scene.grid.spacing) ** 2
    if isinstance(scene.edge, Closed) and not np.isnan(goal).any() and abs(change.sum()) > _EVEN * np.abs(change).sum():
        which, equal = ("more", "trenches that give what its heaps take") if more > 0 else ("less", "berms of what it digs")
        return (
            f"{reason}: the goal has {abs(more):.2g} m^3 {which} sand than the map, and strokes keep the sand; "
            f"give a goal of equal volume, with {equal}"
        )
    return f"{reason}; allow more strokes or pushes, or give the tool another size or depth"
