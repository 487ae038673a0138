"""The paper's search: A* in which the tool may also dig wrong cells (arXiv:1908.02745, "Single Stroke").

What the paper leaves open is chosen so as to explain its counts: the start cell counts as dug; the tool may leave the map by
a margin of one cell; h = cells still to dig + cells wrongly dug, f = g + (7.2 / alpha) h, first in first out among equal f;
a state is closed when it is expanded, and never opened again; every expansion opens four nodes.
"""

import heapq
from fractions import Fraction

from jaxsand.planning.binary.board import MOVES, Problem
from jaxsand.planning.binary.plans import WalkFound

ALPHA = 7.2


def paper(problem: Problem, alpha: float = ALPHA, bound: int = 2_000_000) -> WalkFound:
    """The walk that the paper's A* finds; a lower `alpha` is greedier.

    At alpha 7.2 or above the walk is proven shortest: with a weight of at most 1, and as h changes by at most 1 in a step, f
    never falls along a path. The search gives up after `bound` expansions. The lower bound is 0 where it proves none.
    """
    board = problem.board
    rows, columns = (n + 2 for n in board.shape)
    place = {(r, c): r * columns + c for r in range(rows) for c in range(columns)}
    near = [[place[r + dr, c + dc] for dr, dc in MOVES.values() if (r + dr, c + dc) in place] for r, c in place]
    here = [place[r + 1, c + 1] for r, c in board.cells]
    back = {cell: i for i, cell in enumerate(here)}
    goal = sum(1 << cell for cell in here)
    # Whole numbers, so that equal f are equal: p times f for weight = q / p.
    weight = Fraction(ALPHA / alpha).limit_denominator(1000)
    p, q = weight.denominator, weight.numerator
    heap: list[tuple[int, int, int, int, int]] = []
    parent: dict[tuple[int, int], tuple[int, int]] = {}
    cost: dict[tuple[int, int], int] = {}
    count = 0
    for start in problem.starts:
        state = (here[start], 1 << here[start])
        cost[state] = 0
        heapq.heappush(heap, (q * (goal ^ state[1]).bit_count(), count, 0, *state))
        count += 1
    closed: set[tuple[int, int]] = set()
    expanded = 0
    lower = 0
    while heap:
        f, _, g, cell, dug = heapq.heappop(heap)
        state = (cell, dug)
        if state in closed:
            continue
        if q <= p:
            lower = max(lower, -(-f // p))
        if dug == goal and problem.end in (None, back[cell]):
            walk = [back[cell]]
            while state in parent:
                state = parent[state]
                walk.append(back[state[0]])
            return WalkFound(walk[::-1], lower, expanded, 4 * expanded)
        if expanded == bound:
            break
        closed.add(state)
        expanded += 1
        for j in near[cell]:
            child = (j, dug | 1 << j)
            if child not in closed and g + 1 < cost.get(child, g + 2):
                cost[child], parent[child] = g + 1, state
                count += 1
                heapq.heappush(heap, (p * (g + 1) + q * (goal ^ child[1]).bit_count(), count, g + 1, *child))
    return WalkFound(None, lower, expanded, 4 * expanded)
