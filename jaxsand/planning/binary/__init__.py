"""Planning a single stroke: the shortest walk that digs every cell of a binary map and no other.

The tool moves by one cell north, east, south or west and digs the cell that it comes to. A cell dug by mistake cannot be
mended, so the walk stays on the goal's cells (arXiv:1908.02745, "Single Stroke").
"""

from dataclasses import replace
from typing import Literal, get_args

import numpy as np
from numpy.typing import ArrayLike

from jaxsand.planning.binary.anytime import anytime, nearest_first, simple_bound
from jaxsand.planning.binary.astar import LARGEST, astar
from jaxsand.planning.binary.board import Board, Cell, Problem, connected_pieces, make_problem
from jaxsand.planning.binary.exact import exact
from jaxsand.planning.binary.paper import ALPHA, paper
from jaxsand.planning.binary.plans import Plan, WalkFound, as_plan
from jaxsand.scene.validation import short

__all__ = ["Board", "Cell", "Engine", "Plan", "Problem", "connected_pieces", "make_problem", "plan"]

Engine = Literal["auto", "paper", "astar", "exact", "anytime", "frontier"]
_WIDTH = 16_384
_UNLIMITED = 1 << 60
_FAR = 1e18  # above every weight, bound and number of seconds
_MOST = 1 << 27


def plan(
    dig: ArrayLike,
    start: ArrayLike | None = None,
    *,
    end: Cell | None = None,
    turn_cost: float = 0,
    engine: Engine = "auto",
    weight: float | None = None,
    bound: int | None = None,
    seconds: float | None = None,
) -> Plan:
    """Finds the shortest walk that digs every cell of a binary map and no other.

    The tool moves by one cell north, east, south or west. Cells count (row, column), row 0 on top; north goes up in the
    text, which is +y on the sand.

    Args:
      dig: booleans [rows, columns], true where to dig; the true cells must hang together over their sides.
      start: (row, column) of the first cell, or several to choose from; None lets the planner choose.
      end: (row, column) of the last cell; None lets the planner choose.
      turn_cost: what a change of heading costs, in steps; a reversal is one change.
      engine: "auto" proves the best walk with the sweeps of "exact", or with A* where turns cost, as far as `bound` allows.
        "exact" goes on until the walk is proven. "astar" is A* with a proven bound and dead ends pruned. "paper" is the
        search of arXiv:1908.02745. "anytime" improves a first walk until `seconds` are over. "frontier" is A* by whole
        layers on JAX's device, for one start.
      weight: by how much A* and the paper's search overrate what is left; 1 if None. More is greedier and proves less; the
        paper's alpha is 7.2 / weight.
      bound: expansions after which a search gives up; for "exact" and "auto", how many states are kept at a time.
      seconds: after which "anytime" stops, about; 10 if None. "auto" and "exact" with `seconds` are "anytime".

    Returns:
      A `Plan`. Where a search gives up without a walk, the walk goes to the nearest cell first, and `optimal` is false
      unless its cost meets the lower bound.

    Raises:
      ValueError: for a map that is empty or falls into pieces (it names them), a start or an end that is not a cell to dig,
        or an option that the engine does not have.

    Source: arXiv:1908.02745, section "Single Stroke", for the problem and the engine "paper".

    Example:
      >>> import numpy as np
      >>> import jaxsand as js
      >>> tee = np.array([[True, True, True], [False, True, False]])
      >>> found = js.plan(tee, start=(0, 0))
      >>> found.path, found.steps, found.optimal
      ('EEWS', 4, True)
    """
    problem = make_problem(dig, start, end, turn_cost)
    _check(problem, engine, weight, bound, seconds)
    if seconds is not None:
        engine = "anytime"
    if engine == "auto":
        engine = "exact"
        if turn_cost:
            engine = "astar" if len(problem.board.cells) <= LARGEST else "anytime"
        bound = bound or (200_000 if turn_cost else _WIDTH)
    simple = simple_bound(problem)
    if engine == "exact":
        first = nearest_first(problem)
        if len(first) - 1 == simple:
            return as_plan(problem, WalkFound(first, simple, 0, 0), engine)
    match engine:
        case "paper":
            found = paper(problem, ALPHA / (weight or 1), int(bound or 2_000_000))
        case "astar":
            found = astar(problem, int(bound or 200_000), weight or 1)
        case "exact":
            found = exact(problem, int(bound or _UNLIMITED))
        case "frontier":
            found = _layered(problem, bound)
        case "anytime":
            found = anytime(problem, 10 if seconds is None else seconds)
    lower = max(found.lower_bound, simple)
    walk = found.walk if found.walk is not None else nearest_first(problem)
    return as_plan(problem, replace(found, walk=walk, lower_bound=lower), engine)


def _layered(problem: Problem, bound: int | None) -> WalkFound:
    """The engine "frontier", imported only when it is used."""
    from jaxsand.planning.binary.frontier import layered, two_colours
    from jaxsand.planning.binary.graph import MOST_CELLS, goal_only

    if len(problem.board.cells) > MOST_CELLS:
        raise ValueError(f"map: got {len(problem.board.cells)} cells, too many for frontier ({MOST_CELLS}); use anytime")
    dig = np.zeros(problem.board.shape, bool)
    dig[tuple(np.array(problem.board.cells).T)] = True
    found = layered(
        goal_only(dig, problem.board.cells[problem.starts[0]]), two_colours, limit=min(int(bound or 1 << 27), 1 << 27)
    )
    return WalkFound(list(found.walk) if found.walk else None, found.lower_bound, found.expanded, found.opened)


def _check(problem: Problem, engine: str, weight: float | None, bound: int | None, seconds: float | None) -> None:
    """Raises ValueError for an option that is wrong, or that the engine does not have."""
    engines = get_args(Engine)
    if not isinstance(engine, str) or engine not in engines:
        raise ValueError(f"engine: got {short(engine)}; give one of {', '.join(engines)}")
    for field, value, users in (
        ("weight", weight, ("paper", "astar")),
        ("bound", bound, ("auto", "paper", "astar", "exact", "frontier")),
        ("seconds", seconds, ("auto", "exact", "anytime")),
    ):
        if value is None:
            continue
        if engine not in users:
            raise ValueError(
                f"{field}: has no effect with engine {short(engine)}; leave it out, or use {' or '.join(users)}"
            )
        if not (isinstance(value, (int, float, np.number)) and 0 < value <= _FAR):
            raise ValueError(f"{field}: got {short(value)}; give a number above 0 and at most {_FAR:g}")
    if bound is not None and int(bound) != bound:
        raise ValueError(f"bound: got {bound}; give a whole number")
    if bound is not None and seconds is not None:
        raise ValueError("bound: has no effect with seconds; leave one of them out")
    if engine == "frontier" and (len(problem.starts) > 1 or problem.end is not None):
        raise ValueError("start: 'frontier' needs one start and no end; give (row, column), or use another engine")
    if problem.turn_cost and engine in ("paper", "exact", "frontier"):
        raise ValueError(f"turn_cost: {short(engine)} does not know turns; use astar, anytime or auto")
    if engine == "astar" and len(problem.board.cells) > LARGEST:
        raise ValueError(f"map: got {len(problem.board.cells)} cells, too many for astar ({LARGEST}); use exact or anytime")
