"""Plans of least work: sand goes from where there is too much to where it is wanted, or may lie, by ways as short as can be.

After the earth-moving plans by optimal transport of arXiv:2303.17047.
"""

import numpy as np
from scipy import sparse
from scipy.optimize import linprog
from scipy.spatial.distance import cdist

from jaxsand.goals.goal import Goal
from jaxsand.planning.search.reach import blade_size
from jaxsand.scene.scene import Scene

_BLOCKS = 64  # of surplus or of need at most, between which sand is transported


def heaviest(scene: Scene, goal: Goal, height: np.ndarray) -> np.ndarray:
    """The stroke [k, 6] (m), k at most 1, with the heaviest flow of the plan of least work on a map [H, W] (m).

    It begins a blade's width behind the flow, at the goal's height, and ends where the sand is wanted, or may lie.
    """
    sources, sinks, amounts = flows(goal, height)
    if not len(amounts):
        return np.zeros((0, 6))
    k = int(np.argmax(amounts))
    spacing, wide = float(scene.grid.spacing), blade_size(scene)[0]
    wanted = np.where(goal.free, height, np.nan_to_num(goal.height))
    a, b = ((place[k][::-1] + 0.5) * spacing for place in (sources, sinks))
    way = (b - a) / np.hypot(*(b - a)) if np.any(b != a) else np.array([1.0, 0.0])
    z = [float(wanted[tuple(np.round(place[k]).astype(int))]) for place in (sources, sinks)]
    high = np.array(scene.grid.shape[::-1]) * spacing
    ends = [np.clip(end, 0, high) for end in (a - wide * way, b + wide / 2 * way)]
    return np.array([[*ends[0], z[0], *ends[1], z[1]]])


def flows(goal: Goal, height: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The plan of least work on a map [H, W] (m): places [n, 2] (row, column; cells) from where and to where sand goes, and
    how much (a sum of heights, m).

    It is the optimal transport from what is too high to what is too low, in blocks of a few cells: the sum of amount times
    distance is least. What is left over goes to the nearest cell where a heap may lie, or into a hole that may be filled;
    what is lacking comes from the nearest that is free, or a heap that may go. Where there is none, it stays as it is.
    """
    off, apart = goal.off(np.asarray(height, float)), goal.apart(np.asarray(height, float))
    had, much = _blocks(np.maximum(off, 0))
    wanted, little = _blocks(np.maximum(-off, 0))
    room = np.argwhere(((np.asarray(goal.above) == 0) | (apart < 0)) & (off == 0))
    lent = np.argwhere(goal.free | ((apart > 0) & (off == 0)))
    dear = 10.0 * sum(off.shape)
    work = np.full((len(had) + 1, len(wanted) + 1), dear)
    work[:-1, :-1] = cdist(had, wanted)
    work[-1, -1] = 0
    out, back = (cdist(a, b) if len(b) else np.zeros((len(a), 0)) for a, b in ((had, room), (wanted, lent)))
    if len(room):
        work[:-1, -1] = out.min(1)
    if len(lent):
        work[-1, :-1] = back.min(1)
    whole = max(float(much.sum() + little.sum()), 1e-30)
    much, little = np.append(much, little.sum()) / whole, np.append(little, much.sum()) / whole
    m, n = work.shape
    sums = sparse.vstack([sparse.kron(sparse.eye(m), np.ones((1, n))), sparse.kron(np.ones((1, m)), sparse.eye(n))])
    both = np.concatenate([much, little])  # the last sum follows from the others
    solved = linprog(work.ravel(), A_eq=sums.tocsr()[:-1], b_eq=both[:-1], method="highs")
    amount = whole * np.asarray(solved.x).reshape(m, n)
    amount[-1, -1] = 0
    a, b = np.nonzero((amount > 1e-9 * whole) & (work < dear))
    sources = np.array([had[i] if i < m - 1 else lent[back[j].argmin()] for i, j in zip(a, b, strict=True)])
    sinks = np.array([wanted[j] if j < n - 1 else room[out[i].argmin()] for i, j in zip(a, b, strict=True)])
    return sources.reshape(-1, 2), sinks.reshape(-1, 2), amount[a, b]


def _blocks(amount: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Places [n, 2] (row, column; cells) and sums of an amount [H, W] in square blocks, at most `_BLOCKS` that are not 0."""
    size, places = 1, np.indices(amount.shape)
    while True:
        of = [np.arange(0, n, size) for n in amount.shape]
        whole, *moments = (
            np.add.reduceat(np.add.reduceat(x, of[0], axis=0), of[1], axis=1) for x in (amount, *(places * amount))
        )
        if np.count_nonzero(whole > 0) <= _BLOCKS:
            some = whole > 0
            return np.stack([m[some] / whole[some] for m in moments], axis=1), whole[some]
        size += 1
