"""How much a stroke can change a map at most, and so how close to a goal a number of strokes can come.

Settling is the gradient flow of a convex function of the heights, so it brings no two maps farther apart in l2. With rates
in the stable range it also keeps the order of maps (if h <= h' everywhere, this stays so) and their volume, so it brings no
two farther apart in l1. The argument uses the order. Let h be a map at rest, S the cells that the blade covers in some
strokes, -d the height of its bottom and mu = tan(angle of repose). Then

    u(x) = min(h(x), -d + mu dist(x, S))

is at rest too, since neither part is steeper than mu. Whatever these strokes do, the map stays above u: the blade takes only
what lies above -d in the cells it covers, sand set down raises the map, and settling, with a blade in the way or without,
keeps it above u, which does not move. So n strokes that cover S_1, ..., S_n lower the map by no more than

    sum (h - h')+  <=  sum max_k (h - u_k)  <=  n A,    A = max over strokes of sum (h - u)

and, as sand is conserved, raise it by no more. The largest A over all strokes is found on a lattice of placements of a
rectangle as long as the longest stroke, widened by as much as a placement in between may lie off (see `most_lowered`).
Valid for 4 and 8 neighbours, in exact arithmetic, for sand that settles by small steps to tolerance 0.
"""

import math

import numpy as np

from jaxsand.goals.goal import Goal, Power
from jaxsand.scene.boundaries import Closed
from jaxsand.scene.grid import places
from jaxsand.scene.scene import Scene
from jaxsand.scene.tools import Blade, square


def least_distance(scene: Scene, height: np.ndarray, goal: Goal, strokes: int, longest: float) -> float:
    """A proven lower bound (m) of the distance from `goal` after at most `strokes` strokes from `height`, which is at rest.

    It is the solution of

        min distance(h + v)   with   sum v-  <=  n A,   sum v+  <=  n A,   v-  <=  (h + d)+,

    which for squares cuts surplus and lack off at one level of weight times height each. Where the cost says so, a cell has
    neither. The distance is also at least `volume_distance`; for isotropic sand, whose A is not proven, only that is used.

    Args:
      scene: grid, sand and blade.
      height: the map [H, W] (m).
      goal: what is wanted.
      strokes: n.
      longest: the longest stroke allowed (m).
    """
    surplus, uneven = goal.off(np.asarray(height, float)), volume_distance(scene, height, goal)
    if scene.grid.neighbours == "isotropic":
        return uneven
    amount = strokes * most_lowered(scene, height, longest)
    above = np.maximum(np.asarray(height, float) + blade_size(scene)[2], 0)
    cost = 0.0
    for excess, most, side in ((surplus, above, goal.above), (-surplus, np.inf, goal.below)):
        weight = np.asarray(side)
        left = _cut_off(np.maximum(excess, 0), weight, most, amount, goal.power)
        cost += float((weight * left**goal.power).sum())
    return max(uneven, cost ** (1 / goal.power))


def volume_distance(scene: Scene, height: np.ndarray, goal: Goal) -> float:
    """The distance (m) that is left however the sand is moved, because the goal has more sand than the map, or less.

    The least of sum w_i x_i^p with sum x_i = V is V^2 / sum (1 / w_i) or, with p = 1, V min w_i. For weights of 1 and p = 2
    that is the l2 distance of the mean heights. It is 0 where sand drains, where a cell is free, or where what there is too
    much or too little of costs nothing somewhere.
    """
    if not isinstance(scene.edge, Closed) or goal.free.any():
        return 0.0
    more = float((np.asarray(height, float) - goal.height).sum())
    weight = np.asarray(goal.above if more > 0 else goal.below)
    if not (weight > 0).all():
        return 0.0
    return abs(more) * float(weight.min() if goal.power == 1 else 1 / math.sqrt((1 / weight).sum()))


def most_lowered(scene: Scene, height: np.ndarray, longest: float) -> float:
    """A: by how much one stroke of at most `longest` (m) can lower a map at rest, summed over the cells (m).

    Every stroke lies within a rectangle of the full length about the stroke's middle. Rectangles are tried with the middle
    on a lattice of half a spacing and with 64 headings. Any other lies at most delta = sqrt(2) dx / 4 + (half the
    rectangle's diagonal) (pi / 128) off one of these, so the distance to S is shortened by delta.
    """
    width, thickness, depth = blade_size(scene)
    dx = float(scene.grid.spacing)
    mu = float(np.min(np.tan(np.asarray(scene.material.repose_angle, float))))
    above = np.asarray(height, float) + depth
    rows, columns = above.shape
    long, wide = (longest + thickness + dx) / 2, (width + dx) / 2  # the blade's share of a cell fades over a spacing
    headings, pitch = 64, dx / 2
    delta = pitch / math.sqrt(2) + math.hypot(long, wide) * math.pi / (2 * headings)
    x, y = places((rows, columns), dx)
    middles_x, middles_y = np.arange(0, columns * dx + pitch / 2, pitch), np.arange(0, rows * dx + pitch / 2, pitch)
    most = 0.0
    for heading in np.arange(headings) * math.pi / headings:
        cos, sin = math.cos(heading), math.sin(heading)
        for my in middles_y:
            px, py = x[0] - middles_x[:, None, None], y[:, :1] - my
            beyond = np.maximum(np.abs(px * cos + py * sin) - long, 0)
            aside = np.maximum(np.abs(py * cos - px * sin) - wide, 0)
            rise = mu * np.maximum(np.sqrt(beyond**2 + aside**2) - delta, 0)
            most = max(most, float(np.maximum(above - rise, 0).sum((1, 2)).max()))
    return most


def blade_size(scene: Scene) -> tuple[float, float, float]:
    """The blade's width, thickness and depth (m); raises ValueError where the scene has none."""
    blade = scene.tool
    if not isinstance(blade, Blade):
        raise ValueError(f"scene.tool: got {type(blade).__name__}, which moves no sand; give make_scene(..., tool=Blade())")
    square(blade)
    return float(blade.width), float(blade.thickness), float(blade.depth)


def _cut_off(excess: np.ndarray, weight: np.ndarray, at_most: np.ndarray | float, amount: float, power: Power) -> np.ndarray:
    """What is left of `excess`, at the least sum weight left^power, when `amount` in all and at most `at_most` of each cell
    may be taken away.
    """
    taken = np.minimum(excess, at_most)
    if taken.sum() <= amount:
        return excess - taken
    if power == 1:  # from the heaviest cells first
        order = np.argsort(-weight, axis=None, kind="stable")
        before = np.cumsum(taken.ravel()[order]) - taken.ravel()[order]
        some = np.zeros(excess.size)
        some[order] = np.clip(amount - before, 0, taken.ravel()[order])
        return excess - some.reshape(excess.shape)
    each = np.where(weight > 0, 1 / np.where(weight > 0, weight, 1), np.inf)
    low, high = 0.0, float((weight * excess).max())
    for _ in range(60):
        level = (low + high) / 2
        low, high = (level, high) if _above(excess, level, each, at_most).sum() > amount else (low, level)
    return excess - _above(excess, low, each, at_most)


def _above(excess: np.ndarray, level: float, each: np.ndarray, at_most: np.ndarray | float) -> np.ndarray:
    """What lies above a level of weight times height, of weights 1 / `each`, and at most `at_most`."""
    return np.clip(excess - np.where(np.isinf(each), np.inf, level * each), 0, at_most)
