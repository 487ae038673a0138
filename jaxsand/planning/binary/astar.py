"""A*: the state is the tool's cell (with its heading, where turns cost) and the set of cells left to dig.

A cell dug by mistake cannot be mended, so whatever leaves the cells to dig is a dead end and is never opened.
"""

import heapq
import math
from collections.abc import Callable

from jaxsand.planning.binary.board import Problem
from jaxsand.planning.binary.bound import block_bound
from jaxsand.planning.binary.plans import WalkFound, heading

LARGEST = 3000
"""The most cells of a map for A*: its bound needs a table of the steps between any two."""
_State = tuple[int, int, int]  # cell, cells left as bits, the cell before (-1 where turns cost nothing)


def astar(problem: Problem, bound: int = 200_000, weight: float = 1.0, tick: Callable[[], None] = lambda: None) -> WalkFound:
    """The walk of least cost by A*: best first by f = g + weight h, with the admissible h of `block_bound`.

    Among equal f the deepest states come first, then an order by the cells left. A state that is reached by a shorter way is
    opened again. With weight 1 the first walk found is a shortest one. Whenever the search stops, no walk costs less than
    the least g + h of the open states.

    Args:
      problem: board, starts, end and cost of turns.
      bound: expansions after which it gives up.
      weight: of h; more is greedier.
      tick: is called at every expansion, and may raise to stop the search.
    """
    board = problem.board
    h = block_bound(board, problem.end)
    everything = (1 << len(board.cells)) - 1
    parent: dict[_State, _State | None] = {}
    cost: dict[_State, float] = {}
    heap: list[tuple[float, float, int, int, int, float]] = []  # f, -g, -left, cell, the cell before, g + h
    for s in problem.starts:
        state = (s, everything & ~(1 << s), -1)
        parent[state], cost[state] = None, 0
        tick()
        rest = h(s, state[1])
        heapq.heappush(heap, (weight * rest, 0, -state[1], s, -1, rest))
    done: dict[_State, float] = {}
    expanded = opened = 0
    turn = problem.turn_cost
    while heap:
        _, minus_g, minus_left, cell, before, least = heapq.heappop(heap)
        left, g = -minus_left, -minus_g
        state = (cell, left, before)
        if done.get(state, math.inf) <= g:
            continue
        if not left and problem.end in (None, cell):
            lower = g if weight <= 1 else min(g, *(entry[-1] for entry in heap), math.inf)
            return WalkFound(_trace(parent, state), lower, expanded, opened)
        if expanded == bound:
            return WalkFound(None, min(least, *(entry[-1] for entry in heap), math.inf), expanded, opened)
        done[state] = g
        tick()
        expanded += 1
        opened += len(board.near[cell])
        for j in board.near[cell]:
            further = left & ~(1 << j)
            ahead = g + 1
            if turn and before >= 0 and heading(board, before, cell) != heading(board, cell, j):
                ahead += turn
            child = (j, further, cell if turn else -1)
            if ahead < cost.get(child, math.inf):
                cost[child], parent[child] = ahead, state
                rest = h(j, further)
                heapq.heappush(heap, (ahead + weight * rest, -ahead, -further, *child[::2], ahead + rest))
    raise AssertionError("a connected map has a walk")


def _trace(parent: dict[_State, _State | None], state: _State | None) -> list[int]:
    walk = []
    while state is not None:
        walk.append(state[0])
        state = parent[state]
    return walk[::-1]
