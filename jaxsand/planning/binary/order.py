"""The order in which a sweep passes a block's cells, chosen so that few are half done at a time."""

from collections.abc import Sequence

import numpy as np

from jaxsand.planning.binary.board import Cell, GraphBlock


def sweep_order(block: GraphBlock, places: Sequence[Cell]) -> list[int]:
    """An order of the block's cells with a small frontier (cells passed that still have neighbours to come).

    It is the best of sweeps along rows, columns and both diagonals, and of greedy growth from the far corners.
    """
    near: dict[int, list[int]] = {v: [] for v in block.cells}
    for a, b in block.edges:
        near[a].append(b)
        near[b].append(a)
    at = np.array([places[v] for v in block.cells])
    keys = (at[:, 0], at[:, 1], at.sum(1), at[:, 0] - at[:, 1])
    orders = [[block.cells[k] for k in np.lexsort((at[:, 1], at[:, 0], key))] for key in keys]
    if len(block.cells) <= 2000:
        orders += [_grow(near, corner) for corner in dict.fromkeys(o[k] for o in orders for k in (0, -1))]
    return min(orders, key=lambda order: _burden(near, order))


def _burden(near: dict[int, list[int]], order: list[int]) -> float:
    """About what a sweep costs: the states triple with every cell of the frontier."""
    missing = {v: len(nears) for v, nears in near.items()}
    frontier: set[int] = set()
    total = 0.0
    for v in order:
        frontier.add(v)
        total += 3.0 ** min(len(frontier), 300)
        for u in near[v]:
            missing[u] -= 1
        frontier -= {u for u in (v, *near[v]) if not missing[u]}
    return total


def _grow(near: dict[int, list[int]], first: int) -> list[int]:
    """Grows an order from a cell: next comes the neighbour that leaves the smallest frontier, among equals the one waiting
    longest.
    """
    missing = {v: len(nears) for v, nears in near.items()}
    order, waiting = [], {first: None}
    done = set()
    while waiting:
        # A cell completes those passed neighbours that miss only it, and itself if all its neighbours are passed.
        v = min(waiting, key=lambda v: (missing[v] > 0) - sum(u in done and missing[u] == 1 for u in near[v]))
        del waiting[v]
        done.add(v)
        order.append(v)
        for u in near[v]:
            missing[u] -= 1
            if u not in done:
                waiting.setdefault(u)
    return order
