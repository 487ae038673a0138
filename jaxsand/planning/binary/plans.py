"""A plan: a walk over the cells of a map, and what is proven of it."""

from dataclasses import dataclass
from itertools import pairwise

from jaxsand.planning.binary.board import MOVES, Board, Cell, Problem

_NAMES = {move: name for name, move in MOVES.items()}


@dataclass(frozen=True)
class Plan:
    """A walk over the cells of a map.

    `path` spells the steps (N, E, S, W; N is up in the text), `cells` lists the cells passed (row, column; row 0 on top),
    the start included. `cost` is the number of `steps` and what the turns cost. No walk costs less than `lower_bound`, and
    the plan is proven best when `optimal`. `expanded` counts the states that the search took up, `opened` the children it
    looked at, `engine` names the search.
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
        return self.cells[0]

    @property
    def gap(self) -> float:
        """How far the cost can be from the best, as a share of the lower bound."""
        return (self.cost - self.lower_bound) / self.lower_bound if self.lower_bound else 0.0


@dataclass(frozen=True)
class Found:
    """What an engine found: a walk over cell numbers (None if it gave up), and what it proved."""

    walk: list[int] | None
    lower_bound: float
    expanded: int
    opened: int


def as_plan(problem: Problem, found: Found, engine: str) -> Plan:
    assert found.walk is not None
    cells = tuple(problem.board.cells[i] for i in found.walk)
    path = "".join(_NAMES[b[0] - a[0], b[1] - a[1]] for a, b in pairwise(cells))
    cost = walk_cost(problem, found.walk)
    lower = min(found.lower_bound, cost)
    lower = int(lower) if lower == int(lower) else lower
    return Plan(path, cells, len(path), cost, lower >= cost, lower, found.expanded, found.opened, engine)


def walk_cost(problem: Problem, walk: list[int]) -> float:
    """Steps, and what the changes of heading cost."""
    steps = len(walk) - 1
    if not problem.turn_cost:
        return steps
    headings = [heading(problem.board, a, b) for a, b in pairwise(walk)]
    return steps + problem.turn_cost * sum(a != b for a, b in pairwise(headings))


def heading(board: Board, a: int, b: int) -> Cell:
    (r, c), (s, d) = board.cells[a], board.cells[b]
    return s - r, d - c
