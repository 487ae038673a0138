"""Planning a single stroke: the shortest walk that digs every cell of a binary map and no other.

The tool moves by one cell north, east, south or west and digs the cell it comes to. A cell dug by mistake cannot be mended,
so the walk stays on the goal's cells (arXiv:1908.02745, "Single Stroke"). A state is the tool's cell and the
set of dug cells.
"""

import heapq
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np

_MOVES = {"N": (-1, 0), "E": (0, 1), "S": (1, 0), "W": (0, -1)}
Cell = tuple[int, int]


@dataclass(frozen=True)
class Plan:
    """A walk over the cells of a map.

    `path` spells the steps (N, E, S, W; N is up in the text), `cells` lists the cells passed (row, column; row 0 on top),
    the start included. `steps` is proven shortest when `optimal`; no walk is shorter than `lower_bound`. `expanded` counts
    the states the search took up, `opened` the children it looked at.
    """

    path: str
    cells: tuple[Cell, ...]
    steps: int
    optimal: bool
    lower_bound: int
    expanded: int
    opened: int

    @property
    def start(self) -> Cell:
        return self.cells[0]


def plan(dig: Any, start: Cell | None = None, *, bound: int = 200_000) -> Plan:
    """The shortest walk over the true cells of `dig` [rows, columns], from `start` or from wherever is best.

    A* with the admissible heuristic (cells to dig) + (steps to the nearest of them) - 1: every step digs at most one cell,
    and none before the nearest is reached. After `bound` expansions it settles for a walk that always goes on to the nearest
    cell to dig; `optimal` is then false unless the lower bound was met.

    Raises:
      ValueError: for a map that is empty or falls into pieces (it names them), or a start that is not a cell to dig.
    """
    dig = np.asarray(dig)
    if dig.ndim != 2 or dig.dtype != bool:
        raise ValueError(f"map: got {dig.dtype} of shape {list(dig.shape)}; give booleans [rows, columns]")
    cells = [(int(r), int(c)) for r, c in np.argwhere(dig)]
    if not cells:
        raise ValueError("map: got no cell to dig; mark at least one with #")
    pieces = connected_pieces(dig)
    if len(pieces) > 1:
        firsts = ", ".join(f"({r}, {c})" for r, c in (min(p) for p in pieces[:6]))
        raise ValueError(
            f"map: got {len(pieces)} pieces, with cells {firsts}{', ...' if len(pieces) > 6 else ''}; "
            "one stroke cannot dig them: join them, or plan each by itself"
        )
    if start is not None and tuple(start) not in cells:
        raise ValueError(f"start: got {tuple(start)}; give (row, column) of a cell to dig, such as {cells[0]}")
    steps_between = _distances(cells)
    starts = [cells.index((int(start[0]), int(start[1])))] if start is not None else list(range(len(cells)))
    walk, lower, expanded, opened = _search(steps_between, starts, bound)
    if walk is None:
        walk = min((_nearest_first(steps_between, s) for s in starts), key=len)
    visited = tuple(cells[i] for i in walk)
    names = {move: name for name, move in _MOVES.items()}
    path = "".join(names[b[0] - a[0], b[1] - a[1]] for a, b in pairwise(visited))
    lower = max(lower, len(cells) - 1)
    return Plan(path, visited, len(path), lower == len(path), lower, expanded, opened)


def connected_pieces(dig: np.ndarray) -> list[set[Cell]]:
    """The sets of true cells that hang together over their sides, largest first."""
    left = {(int(r), int(c)) for r, c in np.argwhere(dig)}
    pieces = []
    while left:
        queue = [left.pop()]
        piece = set(queue)
        while queue:
            r, c = queue.pop()
            near = {(r + dr, c + dc) for dr, dc in _MOVES.values()} & left
            left -= near
            piece |= near
            queue.extend(near)
        pieces.append(piece)
    return sorted(pieces, key=lambda p: (-len(p), min(p)))


def _distances(cells: list[Cell]) -> np.ndarray:
    """Steps between any two cells of a connected map, breadth first from each: [n, n]."""
    at = {cell: i for i, cell in enumerate(cells)}
    near = [[at[r + dr, c + dc] for dr, dc in _MOVES.values() if (r + dr, c + dc) in at] for r, c in cells]
    steps = np.full((len(cells), len(cells)), -1)
    for source in range(len(cells)):
        steps[source, source] = 0
        queue = [source]
        for i in queue:
            for j in near[i]:
                if steps[source, j] < 0:
                    steps[source, j] = steps[source, i] + 1
                    queue.append(j)
    return steps


def _search(steps: np.ndarray, starts: list[int], bound: int) -> tuple[list[int] | None, int, int, int]:
    """A*: the walk, or None after `bound` expansions; a lower bound on its length; states expanded and opened."""
    n = len(steps)
    near = [np.flatnonzero(row == 1).tolist() for row in steps]
    # For every cell, the others by distance as bit masks, to find the nearest cell to dig at once.
    rings = [
        [(int(d), sum(1 << int(j) for j in np.flatnonzero(row == d))) for d in range(1, row.max() + 1)] for row in steps
    ]
    everything = (1 << n) - 1

    def estimate(cell: int, left: int) -> int:
        if not left:
            return 0
        return left.bit_count() + next(d for d, ring in rings[cell] if ring & left) - 1

    parent: dict[tuple[int, int], tuple[int, int] | None] = {}
    cost: dict[tuple[int, int], int] = {}
    heap: list[tuple[int, int, int, int]] = []
    for s in starts:
        left = everything & ~(1 << s)
        parent[s, left], cost[s, left] = None, 0
        heapq.heappush(heap, (estimate(s, left), 0, s, left))
    closed: set[tuple[int, int]] = set()
    expanded = opened = 0
    lower = heap[0][0]
    while True:  # a connected map has a walk
        f, minus_g, cell, left = heapq.heappop(heap)
        lower = max(lower, f)
        if (cell, left) in closed:
            continue
        if not left:
            return _trace(parent, (cell, left)), lower, expanded, opened
        if expanded == bound:
            return None, lower, expanded, opened
        closed.add((cell, left))
        expanded += 1
        opened += len(near[cell])
        for j in near[cell]:
            child = (j, left & ~(1 << j))
            g = 1 - minus_g
            if g < cost.get(child, g + 1):
                cost[child], parent[child] = g, (cell, left)
                heapq.heappush(heap, (g + estimate(*child), -g, *child))


def _trace(parent: dict[tuple[int, int], tuple[int, int] | None], state: tuple[int, int] | None) -> list[int]:
    walk = []
    while state is not None:
        walk.append(state[0])
        state = parent[state]
    return walk[::-1]


def _nearest_first(steps: np.ndarray, start: int) -> list[int]:
    walk, left = [start], set(range(len(steps))) - {start}
    while left:
        target = min(left, key=lambda j: (steps[walk[-1], j], j))
        while walk[-1] != target:
            here = walk[-1]
            walk.append(
                int(next(j for j in np.flatnonzero(steps[here] == 1) if steps[j, target] == steps[here, target] - 1))
            )
            left.discard(walk[-1])
    return walk
