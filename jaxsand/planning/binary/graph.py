"""A map as arrays, for searches on a device: the neighbours of every cell, and sets of cells as bits."""

from dataclasses import dataclass
from functools import partial

import jax
import numpy as np

MOST_CELLS = 1 << 15


@partial(jax.tree_util.register_dataclass, data_fields=("near", "goal", "odd", "start"), meta_fields=())
@dataclass(frozen=True)
class Graph:
    """Cells in two colours; every step goes from one colour to the other. Cell i is bit i % 32 of word i // 32.

    Attributes:
      near: [cells, 4] int32, the neighbours of each cell, -1 for none.
      goal: [words] uint32, the cells to dig.
      odd: [words] uint32, the cells of one colour.
      start: the cell where the tool stands, which counts as dug.
    """

    near: np.ndarray | jax.Array
    goal: np.ndarray | jax.Array
    odd: np.ndarray | jax.Array
    start: np.integer | jax.Array


def grid_near(walkable: np.ndarray) -> np.ndarray:
    """The neighbours [cells, 4] (N, E, S, W; -1 for none) of the true cells of a map, numbered row by row."""
    number = np.full(np.add(walkable.shape, 2), -1, np.int32)
    number[1:-1, 1:-1][walkable] = np.arange(walkable.sum())
    sides = number[:-2, 1:-1], number[1:-1, 2:], number[2:, 1:-1], number[1:-1, :-2]
    return np.stack([side[walkable] for side in sides], axis=1)


def make_graph(near: np.ndarray, goal: np.ndarray, start: int) -> Graph:
    """A graph of the neighbours `near` [cells, 4], -1 for none, and the cells to dig, `goal` [cells].

    Raises:
      ValueError: for cells that cannot be coloured with two colours, or a goal that a walk from `start` cannot dig.
    """
    cells = len(near)
    if cells > MOST_CELLS:
        raise ValueError(f"near: got {cells} cells; give at most {MOST_CELLS}")
    colour = _colours(near, start, np.ones(cells, bool))
    if np.any((near >= 0) & (colour >= 0)[:, None] & (colour[near] == colour[:, None])):
        raise ValueError("near: got a cycle of odd length; give cells of a square grid")
    out_of_reach = np.flatnonzero(goal & (_colours(near, start, goal) < 0))
    if not goal[start] or len(out_of_reach):
        raise ValueError(f"goal: got cells {out_of_reach[:6]} out of reach of start {start} over goal cells; join them")
    padded = np.full((-(-cells // 32) * 32, 4), -1, np.int32)
    padded[:cells] = near
    return Graph(padded, _packed(goal), _packed(colour == 1), np.int32(start))


def _colours(near: np.ndarray, start: int, allowed: np.ndarray) -> np.ndarray:
    """The colour, 0 or 1, of every cell that can be reached over allowed cells; -1 of the others."""
    colour = np.full(len(near), -1)
    colour[start] = 0
    queue = [start]
    for i in queue:
        for j in near[i]:
            if j >= 0 and allowed[j] and colour[j] < 0:
                colour[j] = 1 - colour[i]
                queue.append(j)
    return colour


def _packed(mask: np.ndarray) -> np.ndarray:
    """Booleans [cells] as bits."""
    bits = np.zeros(-(-len(mask) // 32) * 32, bool)
    bits[: len(mask)] = mask
    return np.packbits(bits, bitorder="little").view("<u4").astype(np.uint32)


def with_margin(dig: np.ndarray, start: tuple[int, int], margin: int = 1) -> Graph:
    """The paper's graph: every cell of the map, and of a margin around it, may be dug."""
    wide = np.pad(dig, margin)
    where = (start[0] + margin) * wide.shape[1] + start[1] + margin
    return make_graph(grid_near(np.ones_like(wide)), wide.reshape(-1), where)


def goal_only(dig: np.ndarray, start: tuple[int, int]) -> Graph:
    """The graph of the cells to dig alone, numbered row by row; any other cell would be a dead end."""
    where = int(dig.reshape(-1)[: start[0] * dig.shape[1] + start[1]].sum())
    return make_graph(grid_near(dig), np.ones(dig.sum(), bool), where)
