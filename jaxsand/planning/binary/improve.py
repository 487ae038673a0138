"""Makes a walk shorter step by step, without a proof: turns cycles over, moves ends, drops double edges."""

import contextlib
from collections.abc import Callable
from itertools import pairwise

from jaxsand.planning.binary.board import Board, Problem
from jaxsand.planning.binary.exact import trail
from jaxsand.planning.binary.sweepline import OutOfTime

Edge = tuple[int, int]


def improved(problem: Problem, walk: list[int], tick: Callable[[], None]) -> list[int]:
    """A walk over the same cells, no longer than `walk`, with the same ends unless the problem lets them move.

    The walk is a connected multigraph (see exact.py). To turn a cycle over is to take its edges once that were taken twice
    or not at all, and the others twice; like dropping an edge taken twice, this keeps the parity of every degree. To turn
    over the way from an end to another cell moves the end there. Both are done where the walk becomes shorter and stays
    connected, until no cycle of a breadth-first basis and no way to a dead end helps, or `tick` raises.
    """
    board = problem.board
    times: dict[Edge, int] = {}
    for edge in (_edge(a, b) for a, b in pairwise(walk)):
        times[edge] = times.get(edge, 0) + 1
    times = {edge: 2 - often % 2 for edge, often in times.items()}
    for edge in [e for e, often in times.items() if often == 2]:
        _drop(board, times, edge)
    ends = [walk[0], walk[-1]]
    movable = [0] * (len(problem.starts) == len(board.cells)) + [1] * (problem.end is None)
    with contextlib.suppress(OutOfTime):
        _turn(board, times, ends, movable, tick)
    return trail(times, ends[0])


def _turn(board: Board, times: dict[Edge, int], ends: list[int], movable: list[int], tick: Callable[[], None]) -> None:
    """Turns over cycles, and ways from the ends to dead ends, as long as that helps."""
    cycles = _cycles(board, ends[0])
    dead_ends = [v for v, nears in enumerate(board.near) if len(nears) == 1]
    shorter = True
    while shorter:
        shorter = False
        for which in movable:
            for target in dead_ends:
                tick()
                if _turned_over(board, times, _way(board, ends[which], target)):
                    ends[which], shorter = target, True
        for cycle in cycles:
            tick()
            shorter = _turned_over(board, times, cycle) or shorter


def _turned_over(board: Board, times: dict[Edge, int], edges: list[Edge]) -> bool:
    """Turns edges over and drops what can be dropped, if that makes the walk shorter; says whether it did."""
    turned = dict(times)
    for edge in edges:
        turned[edge] = 1 if times.get(edge, 0) in (0, 2) else 2
    for edge in edges:
        if turned[edge] == 2:
            _drop(board, turned, edge)
    if sum(turned.values()) >= sum(times.values()):
        return False
    times.update(turned)
    return True


def _edge(a: int, b: int) -> Edge:
    return min(a, b), max(a, b)


def _way(board: Board, start: int, target: int) -> list[Edge]:
    """The edges of a shortest way."""
    edges = []
    while start != target:
        ahead = min(board.near[start], key=lambda j: board.steps[j][target])
        edges.append(_edge(start, ahead))
        start = ahead
    return edges


def _drop(board: Board, times: dict[Edge, int], edge: Edge) -> None:
    """Drops an edge if its cells stay connected without it."""
    a, b = edge
    seen, queue = {a}, [a]
    for here in queue:
        for j in board.near[here]:
            there = _edge(here, j)
            if j not in seen and there != edge and times.get(there, 0):
                if j == b:
                    times[edge] = 0
                    return
                seen.add(j)
                queue.append(j)


def _cycles(board: Board, root: int) -> list[list[Edge]]:
    """The cycles that the edges outside a breadth-first tree close."""
    parent, depth, queue = {root: root}, {root: 0}, [root]
    for here in queue:
        for j in board.near[here]:
            if j not in parent:
                parent[j], depth[j] = here, depth[here] + 1
                queue.append(j)
    cycles = []
    for a, nears in enumerate(board.near):
        for b in nears:
            if a < b and parent[a] != b and parent[b] != a:
                u, v = a, b
                cycle = [(a, b)]
                while u != v:
                    if depth[u] < depth[v]:
                        u, v = v, u
                    cycle.append(_edge(u, parent[u]))
                    u = parent[u]
                cycles.append(cycle)
    return cycles
