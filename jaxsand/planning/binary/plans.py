"""A plan: a walk over the cells of a map, and what is proven of it."""

from dataclasses import dataclass
from itertools import pairwise

from jaxsand.planning.binary.board import MOVES, Board, Cell, Problem

_NAMES = {move: name for name, move in MOVES.items()}


@dataclass(frozen=True)
class Plan:
    """A walk over the cells of a binary map; `plan` returns it.

    Attributes:
      path: the steps as letters N, E, S, W; N is up in the text.
      cells: (row, column) of the cells passed, row 0 on top, the start included.
      steps: how many steps there are.
      cost: the steps, and what the turns cost.
      optimal: whether the walk is proven to cost least.
      lower_bound: no walk costs less.
      expanded: how many states the search took up.
      opened: how many children it looked at.
      engine: the name of the search.
      start: the first of the cells.
      gap: how far the cost can be above the least, as a share of the lower bound; 0 where the walk is proven.

    Example:
      >>> import numpy as np
      >>> import jaxsand as js
      >>> found = js.plan(np.array([[True, True]]), start=(0, 0))
      >>> found.path, found.cells, found.gap
      ('E', ((0, 0), (0, 1)), 0.0)
    """

    path: str
    cells: tuple[Cell, ...]
    steps: int
    cost: float
    optimal: bool
    lower_bound: float
    expanded: int
    opened: int
    engine: str

    @property
    def start(self) -> Cell:
        """The first cell."""
        return self.cells[0]

    @property
    def gap(self) -> float:
        """How far the cost can be above the least, as a share of the lower bound."""
        return (self.cost - self.lower_bound) / self.lower_bound if self.lower_bound else 0.0


@dataclass(frozen=True)
class WalkFound:
    """What an engine found: a walk over the board's cells (None if it gave up), and what it proved."""

    walk: list[int] | None
    lower_bound: float
    expanded: int
    opened: int


def as_plan(problem: Problem, found: WalkFound, engine: str) -> Plan:
    """The plan of a walk that an engine found."""
    assert found.walk is not None
    cells = tuple(problem.board.cells[i] for i in found.walk)
    path = "".join(_NAMES[b[0] - a[0], b[1] - a[1]] for a, b in pairwise(cells))
    cost = walk_cost(problem, found.walk)
    lower = min(found.lower_bound, cost)
    lower = int(lower) if lower == int(lower) else lower
    return Plan(path, cells, len(path), cost, lower >= cost, lower, found.expanded, found.opened, engine)


def walk_cost(problem: Problem, walk: list[int]) -> float:
    """The steps of a walk, and what its changes of heading cost."""
    steps = len(walk) - 1
    if not problem.turn_cost:
        return steps
    headings = [heading(problem.board, a, b) for a, b in pairwise(walk)]
    return steps + problem.turn_cost * sum(a != b for a, b in pairwise(headings))


def heading(board: Board, a: int, b: int) -> Cell:
    """The row and column that the step from a to b goes on."""
    (r, c), (s, d) = board.cells[a], board.cells[b]
    return s - r, d - c
