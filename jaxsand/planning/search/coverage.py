"""Coverage paths: rows over all that is to be shaped, as on a field."""

import math
from itertools import product

import numpy as np
from scipy.ndimage import label

from jaxsand.goals.goal import Goal
from jaxsand.planning.search.reach import blade_size
from jaxsand.scene.scene import Scene

Reading = tuple[float, int, bool, bool]
"""Distance of the rows in blade's widths; number of layers; whether rows run along y; whether they begin at the far side."""

READINGS: tuple[Reading, ...] = tuple(product((0.75, 0.5, 1.0), (1, 2, 3), (False, True), (False, True)))


def coverage(scene: Scene, goal: Goal, height: np.ndarray, reading: Reading) -> np.ndarray:
    """Rows [n, 6] (m) over the bounding box of each piece to be shaped, there and back, in layers, each row as high as the
    goal is where it passes.

    Args:
      scene: grid, and a blade as wide as a row.
      goal: what is wanted.
      height: the map [H, W] (m).
      reading: how the rows lie.
    """
    apart, layers, along_y, far = reading
    off = goal.off(np.asarray(height, float))
    spacing, wide = float(scene.grid.spacing), blade_size(scene)[0]
    pieces, count = label(off != 0)
    found = []
    for piece, layer in product(range(1, count + 1), range(1, layers + 1)):
        inside, sand, change = (x.T if along_y else x for x in (pieces == piece, height, off))
        rows, columns = (np.flatnonzero(inside.any(axis)) for axis in (1, 0))
        low, high = rows[0] * spacing, (rows[-1] + 1) * spacing
        lines = max(1, math.ceil((high - low - wide) / (apart * wide) + 1 - 1e-9))
        middle = (low + high) / 2
        middles = np.linspace(min(low + wide / 2, middle), max(high - wide / 2, middle), lines)
        for k, y in enumerate(middles[::-1] if far else middles):
            near = inside & (abs((np.arange(len(inside)) + 0.5) * spacing - y) <= wide / 2)[:, None]
            some = near if near.any() else inside
            z = float((sand - change * layer / layers)[some].mean())
            ends = [columns[0] * spacing, (columns[-1] + 1) * spacing]
            row = [[x, y, z] for x in (ends if k % 2 == 0 else ends[::-1])]
            found.append([[b, a, c] for a, b, c in row] if along_y else row)
    return np.array(found).reshape(-1, 6)
