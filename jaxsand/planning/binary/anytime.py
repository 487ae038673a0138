"""A walk at once, a shorter one with time, and a lower bound of the shortest."""

import contextlib
import time
from collections.abc import Callable
from functools import partial

from jaxsand.planning.binary.astar import LARGEST, astar
from jaxsand.planning.binary.board import Board, Problem
from jaxsand.planning.binary.exact import Blocks, exact
from jaxsand.planning.binary.improve import improved
from jaxsand.planning.binary.plans import WalkFound, walk_cost
from jaxsand.planning.binary.sweepline import OutOfTime

_WIDTHS = (0, 1000, 16_384, 262_144)
_WEIGHTS = (4.0, 2.0, 1.5, 1.2, 1.0)
_LOOPY = 64  # cells of a block; smaller ones are proven before anything else pays
_SPARE = 0.1  # of the time for making the first walk shorter


def anytime(problem: Problem, seconds: float) -> WalkFound:
    """Makes a greedy walk shorter, then searches wider and wider until a walk is proven best or the time is over.

    Where turns cost nothing the searches are sweeps with more and more states (exact.py); where they do, A* with lower and
    lower weights follows. The lower bound is the best that any of them proved, also by one that was stopped.
    """
    began = time.monotonic()

    def until(part: float) -> Callable[[], None]:
        def tick() -> None:
            if time.monotonic() > began + part * seconds:
                raise OutOfTime

        return tick

    tick = until(1)
    best = nearest_first(problem, until(_SPARE / 2))
    lower = float(simple_bound(problem))
    expanded = opened = 0
    blocks = Blocks(problem.board)
    tries: list[Callable[[], WalkFound]] = [partial(exact, problem, width, tick, blocks) for width in _WIDTHS]
    if problem.turn_cost:
        del tries[2:]
        if len(problem.board.cells) <= LARGEST:
            tries += [partial(astar, problem, 10**9, weight, tick) for weight in _WEIGHTS]
    elif len(problem.board.cells) <= LARGEST and any(len(block.cells) > _LOOPY for block in blocks.blocks):
        tries.insert(1, lambda: WalkFound(improved(problem, best, until(_SPARE)), 0, 0, 0))
    for search in tries:
        if walk_cost(problem, best) <= lower:
            break
        try:
            found = search()
        except OutOfTime:
            continue
        expanded, opened = expanded + found.expanded, opened + found.opened
        lower = max(lower, found.lower_bound)
        if found.walk and walk_cost(problem, found.walk) < walk_cost(problem, best):
            best = found.walk
    # What the last search had proven when it was stopped.
    if walk_cost(problem, best) > lower and blocks.known:
        with contextlib.suppress(OutOfTime):
            lower = max(lower, exact(problem, 0, until(1.2), blocks).lower_bound)
    return WalkFound(best, lower, max(expanded, blocks.states), opened)


def simple_bound(problem: Problem) -> int:
    """A lower bound of the steps: each digs at most one cell, and changes the colour of the chessboard."""
    board = problem.board
    dark = sum(board.colour)
    counts = (len(board.cells) - dark, dark)

    def at_least(start: int) -> int:
        same, other = counts[board.colour[start]] - 1, counts[1 - board.colour[start]]
        return max(2 * other - 1, 2 * same, 0)

    return min(at_least(s) for s in problem.starts)


def nearest_first(problem: Problem, tick: Callable[[], None] = lambda: None) -> list[int]:
    """A walk that always goes to the nearest cell to dig, and at last to the end.

    Of several cells as near it takes the one in the smallest piece of what is left. Once `tick` raises, it takes any of
    them.
    """
    board = problem.board
    walk = [problem.starts[0]]
    left = set(range(len(board.cells))) - {walk[0]}
    hurry = False
    while left:
        beside = [j for j in board.near[walk[-1]] if j in left]
        try:
            if not hurry:
                tick()
        except OutOfTime:
            hurry = True
        if not beside:
            way = _way(board, walk[-1], left)
        elif hurry:
            way = beside[:1]
        else:
            way = [_into_the_smaller(board, beside, left)]
        left.difference_update(way)
        walk += way
    if problem.end is not None and walk[-1] != problem.end:
        walk += _way(board, walk[-1], {problem.end})
    return walk


def _into_the_smaller(board: Board, beside: list[int], left: set[int]) -> int:
    """The neighbour in the smallest piece of the cells left; among equals that with the fewest neighbours.

    Pieces are measured up to 200 cells.
    """
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
    """The shortest way to the nearest target, without the start."""
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
