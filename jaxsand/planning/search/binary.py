"""The binary plan of a height map: where to dig and where not, as if the sand stayed where it is put."""

from itertools import pairwise

import numpy as np

from jaxsand.goals.goal import Goal
from jaxsand.planning.binary import connected_pieces, plan
from jaxsand.planning.search.actions import Job, Steps, corners, longest_stroke
from jaxsand.planning.search.reach import blade_size
from jaxsand.scene.scene import Scene

_HINTS = 24


def binary_paths(
    scene: Scene, height: np.ndarray, goal: Goal, steps: Steps, offset: tuple[int, int] = (0, 0), part: float = 0.5
) -> list[np.ndarray]:
    """The walks of the binary plan, one over each connected piece to dig.

    A block of cells is dug where the goal lies below the map by more than `part` of the deepest cut, which is the blade's
    depth or more.

    Returns:
      For each piece the rows and columns [n, 2] of `corners(scene, steps, offset)` that the walk passes.
    """
    rows, columns = corners(scene, steps, offset).shape[:2]
    top, left = (steps.margin + o for o in offset)
    surplus = goal.off(np.asarray(height, float))[top : top + rows * steps.cell, left : left + columns * steps.cell]
    blocks = surplus.reshape(rows, steps.cell, columns, steps.cell).mean((1, 3))
    deepest = max(blade_size(scene)[2], float(surplus.max()))
    dig = np.flipud(blocks > part * deepest)
    walks = []
    for piece in connected_pieces(dig):
        some = np.zeros_like(dig)
        some[tuple(np.array(sorted(piece)).T)] = True
        cells = np.array(plan(some, seconds=10).cells)
        walks.append(np.stack([rows - 1 - cells[:, 0], cells[:, 1]], axis=1))
    return walks


def straight_runs(walk: np.ndarray) -> list[tuple[int, int]]:
    """The first and the last index of each straight run of a walk [n, 2]."""
    turns = [0, *(np.flatnonzero(np.any(np.diff(walk, 2, axis=0), axis=1)) + 1).tolist(), len(walk) - 1]
    return [(a, b) for a, b in pairwise(turns) if b > a]


def binary_strokes(
    scene: Scene, height: np.ndarray, goal: Goal, offset: tuple[int, int] = (0, 0), part: float = 0.5
) -> np.ndarray:
    """The straight runs of the binary plan, on blocks as wide as the blade: [n, 4] (m), in order."""
    steps = Steps(blade_cells(scene))
    at = corners(scene, steps, offset)
    walks = binary_paths(scene, height, goal, steps, offset, part)
    runs = [[*at[tuple(walk[a])], *at[tuple(walk[b])]] for walk in walks for a, b in straight_runs(walk)]
    return np.array(runs).reshape(-1, 4)


def binary_hints(job: Job) -> np.ndarray:
    """The longest strokes [n, 4] (m) that the binary plan suggests, with its blocks at every offset."""
    cells = range(blade_cells(job.scene))
    found = [binary_strokes(job.scene, job.height, job.goal, (row, column)) for row in cells for column in cells]
    runs = np.unique(np.concatenate(found), axis=0)
    length = np.hypot(*(runs[:, 2:] - runs[:, :2]).T)
    order = np.argsort(-length, kind="stable")
    return runs[order[length[order] <= longest_stroke(job.scene, job.actions)]][:_HINTS]


def blade_cells(scene: Scene) -> int:
    """The blade's width in whole grid cells."""
    return max(1, min(round(blade_size(scene)[0] / float(scene.grid.spacing)), *scene.grid.shape))
