"""How much a stroke can change a map at most, and so how close to a goal a number of strokes can come.

No stroke lowers a map at rest by more than A, summed over its cells, nor raises it by more. The proof, and the least
distance that follows from it: notebooks/site/theory/planning.md ("How much a stroke can do"). Valid for 4 and 8
neighbours, in exact arithmetic, for sand that settles by small steps to tolerance 0.
"""

import math

import numpy as np

from jaxsand.goals.goal import Goal, Power
from jaxsand.scene.boundaries import Closed
from jaxsand.scene.grid import places
from jaxsand.scene.scene import Scene
from jaxsand.scene.tools import Blade, square


def least_distance(scene: Scene, height: np.ndarray, goal: Goal, strokes: int, longest: float) -> float:
    """A proven lower bound (m) of the distance from `goal` after at most `strokes` strokes.

    It is the least distance of any map that the strokes could leave if each moved as much sand as `most_lowered` allows, to
    where it helps most, and never less than `volume_distance`. In isotropic sand, where `most_lowered` is not proven, it is
    `volume_distance` alone.

    Args:
      scene: grid, sand and blade.
      height: the map [H, W] (m) to begin from, at rest.
      goal: what is wanted.
      strokes: how many strokes may be made.
      longest: the longest stroke allowed (m).

    Raises:
      ValueError: for a scene without a blade.
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
    """The distance (m) to the goal that remains however the sand is moved, since there is more of it than the goal has, or
    less.

    That difference in volume has to lie somewhere: it is spread where it costs least. The distance is 0 where sand drains
    off the map, where a cell is free, and where some cell takes the difference at no cost.
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
    rectangle's diagonal) (pi / 128) off one of these, so the distance to the cells that it covers is shortened by delta.
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
    """The excess [H, W] (m) that is left when as much as possible is taken away, where it costs most.

    Args:
      excess: how far each cell is from the goal, 0 or more (m).
      weight: what it costs: sum weight excess^power.
      at_most: how much may be taken from each cell (m).
      amount: how much may be taken in all, a sum of heights (m).
      power: 1 or 2.
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
    """By how much each cell's weight times excess is above a level, as a height (m), but `at_most` at most.

    `each` is 1 over the cell's weight, inf for a weight of 0, from which nothing is taken.
    """
    return np.clip(excess - np.where(np.isinf(each), np.inf, level * each), 0, at_most)
