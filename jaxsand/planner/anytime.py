"""A walk at once, a better one with time, and how far it can be from the best."""

import time
from collections.abc import Callable

from jaxsand.planner.astar import LARGEST, astar
from jaxsand.planner.board import Board, Problem
from jaxsand.planner.exact import Blocks, exact
from jaxsand.planner.plans import Found, walk_cost
from jaxsand.planner.sweepline import OutOfTime

_WIDTHS = (0, 64, 512, 4096, 32_768, 262_144)
_WEIGHTS = (4.0, 2.0, 1.5, 1.2, 1.0)


def anytime(problem: Problem, seconds: float) -> Found:
    """Nearest cell first, then wider and wider searches until one is proven best or the time is over.

    Where turns cost nothing these are sweeps with more and more states (exact.py); where they do, A* with lower and lower
    weights as well. The lower bound is the best that any of them proved.
    """
    stop = time.monotonic() + seconds

    def tick() -> None:
        if time.monotonic() > stop:
            raise OutOfTime

    best = nearest_first(problem)
    lower = float(simple_bound(problem))
    expanded = opened = 0
    blocks = Blocks(problem.board)
    tries: list[Callable[[], Found]] = [lambda width=w: exact(problem, width, tick, blocks) for w in _WIDTHS]  # type: ignore[misc]
    if problem.turn_cost and len(problem.board.cells) <= LARGEST:
        tries[3:] = [lambda weight=w: astar(problem, 10**9, weight, tick) for w in _WEIGHTS]  # type: ignore[misc]
    try:
        for search in tries:
            tick()
            found = search()
            expanded, opened = expanded + found.expanded, opened + found.opened
            lower = max(lower, found.lower_bound)
            if found.walk and walk_cost(problem, found.walk) < walk_cost(problem, best):
                best = found.walk
            if walk_cost(problem, best) <= lower:
                break
    except OutOfTime:
        expanded += blocks.states if not expanded else 0
    return Found(best, lower, expanded, opened)


def simple_bound(problem: Problem) -> int:
    """Every step digs at most one cell, and goes to the other colour of the chessboard."""
    board = problem.board
    dark = sum(board.colour)
    counts = (len(board.cells) - dark, dark)

    def at_least(start: int) -> int:
        same, other = counts[board.colour[start]] - 1, counts[1 - board.colour[start]]
        return max(2 * other - 1, 2 * same, 0)

    return min(at_least(s) for s in problem.starts)


def nearest_first(problem: Problem) -> list[int]:
    """A walk that always goes on to the nearest cell to dig, into the smaller piece of what is left where several are as
    near, and at last to the end."""
    board = problem.board
    walk = [problem.starts[0]]
    left = set(range(len(board.cells))) - {walk[0]}
    while left:
        beside = [j for j in board.near[walk[-1]] if j in left]
        way = [_into_the_smaller(board, beside, left)] if beside else _way(board, walk[-1], left)
        left.difference_update(way)
        walk += way
    if problem.end is not None and walk[-1] != problem.end:
        walk += _way(board, walk[-1], {problem.end})
    return walk


def _into_the_smaller(board: Board, beside: list[int], left: set[int]) -> int:
    """Of neighbours to dig the one in the smallest piece, then with the fewest neighbours; pieces count as far as 200."""
    size: dict[int, int] = {}
    for j in beside:
        if j in size:
            continue
        others = set(beside) - {j}
        piece, queue = {j}, [j]
        for here in queue:
            more = [i for i in board.near[here] if i in left and i not in piece]
            piece.update(more)
            queue += more
            others -= piece
            if not others or len(queue) > 200:
                break
        size |= dict.fromkeys([i for i in beside if i in piece], len(queue))
    return min(beside, key=lambda j: (size[j], sum(i in left for i in board.near[j])))


def _way(board: Board, start: int, targets: set[int]) -> list[int]:
    """The shortest way to the nearest target, without the start; breadth first."""
    came = {start: start}
    queue = [start]
    for here in queue:
        if here in targets:
            way = [here]
            while came[way[-1]] != start:
                way.append(came[way[-1]])
            return way[::-1]
        for j in board.near[here]:
            if j not in came:
                came[j] = here
                queue.append(j)
    raise AssertionError("the board is connected")
