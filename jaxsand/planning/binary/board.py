"""A map as a graph: its cells to dig, who is whose neighbour, and the blocks it falls into at its cut cells."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike
from scipy.ndimage import label
from scipy.sparse import csr_array
from scipy.sparse.csgraph import shortest_path

from jaxsand.scene.masked import DIG, unmasked
from jaxsand.scene.validation import short

MOVES = {"N": (-1, 0), "E": (0, 1), "S": (1, 0), "W": (0, -1)}
Cell = tuple[int, int]
_DEAREST = 10**6


@dataclass(frozen=True)
class Board:
    """A map as a graph.

    Attributes:
      shape: of the map.
      cells: (row, column) of the cells to dig, row 0 on top; elsewhere a cell is its index here.
      near: the neighbours of each cell.
    """

    shape: tuple[int, int]
    cells: tuple[Cell, ...]
    near: tuple[tuple[int, ...], ...]

    @cached_property
    def colour(self) -> tuple[int, ...]:
        """0 or 1 for each cell, as on a chessboard: every step goes to the other colour."""
        return tuple((r + c) % 2 for r, c in self.cells)

    @cached_property
    def masks(self) -> tuple[int, int]:
        """The cells of each colour as bits of a whole number."""
        dark = sum(1 << i for i, own in enumerate(self.colour) if own)
        return (1 << len(self.cells)) - 1 & ~dark, dark

    @cached_property
    def steps(self) -> list[list[int]]:
        """The fewest steps between any two cells."""
        n = len(self.cells)
        edges = np.array([(i, j) for i, nears in enumerate(self.near) for j in nears]).reshape(-1, 2)
        graph = csr_array((np.ones(len(edges)), (edges[:, 0], edges[:, 1])), shape=(n, n))
        return shortest_path(graph, unweighted=True).astype(int).tolist()


@dataclass(frozen=True)
class Problem:
    """A walk to find: it digs every cell of a board, begins at one of `starts`, and ends at `end` if that is given.

    Its cost is one for each step, and `turn_cost` for each change of heading (a reversal is one).
    """

    board: Board
    starts: tuple[int, ...]
    end: int | None = None
    turn_cost: float = 0


def make_problem(dig: ArrayLike, start: ArrayLike | None = None, end: Cell | None = None, turn_cost: float = 0) -> Problem:
    """Checks a user's map, start, end and turn cost, and makes the problem of them.

    Args:
      dig: booleans [rows, columns].
      start: (row, column) of a cell, several of them, or None for any.
      end: (row, column) of a cell, or None for any.
      turn_cost: what a change of heading costs, in steps.

    Raises:
      ValueError: for a map that is empty or falls into pieces (it names them), a start or end that is not a cell to dig, or
        a cost below 0.
    """
    dig = unmasked("map", dig, DIG)
    try:
        dig = np.asarray(dig)
    except ValueError:
        raise ValueError("map: got rows of different lengths; give booleans [rows, columns]") from None
    if dig.ndim != 2 or dig.dtype != bool:
        raise ValueError(f"map: got {dig.dtype} of shape {list(dig.shape)}; give booleans [rows, columns]")
    pieces = connected_pieces(dig)
    if not pieces:
        raise ValueError("map: got no cell to dig; mark at least one with #")
    if len(pieces) > 1:
        firsts = ", ".join(f"({r}, {c})" for r, c in (min(p) for p in pieces[:6]))
        raise ValueError(
            f"map: got {len(pieces)} pieces, with cells {firsts}{', ...' if len(pieces) > 6 else ''}; "
            "one stroke cannot dig them: join them, or plan each by itself"
        )
    cells = sorted(pieces[0])
    at = {cell: i for i, cell in enumerate(cells)}
    near = tuple(tuple(at[r + dr, c + dc] for dr, dc in MOVES.values() if (r + dr, c + dc) in at) for r, c in cells)
    if not (isinstance(turn_cost, (int, float, np.number)) and 0 <= turn_cost <= _DEAREST):
        raise ValueError(f"turn_cost: got {short(turn_cost)}; give what a change of heading costs in steps, 0 to {_DEAREST}")
    chosen = range(len(cells)) if start is None else [_index(at, "start", one) for one in _several("start", start)]
    goal = None
    if end is not None:
        ends = _several("end", end)
        if len(ends) > 1:
            raise ValueError(f"end: got {short(end)}; give (row, column) of one cell to dig")
        goal = _index(at, "end", ends[0])
    return Problem(Board(dig.shape, tuple(cells), near), tuple(dict.fromkeys(chosen)), goal, float(turn_cost))


def _several(field: str, start: ArrayLike) -> list[Cell]:
    """A user's cell or cells as a list."""
    cells = unmasked(field, start, "give (row, column) of a cell to dig")
    try:
        given = np.asarray(cells)
    except (TypeError, ValueError, OverflowError):
        given = np.empty(0)
    if given.ndim not in (1, 2) or given.shape[-1] != 2 or not given.size or given.dtype.kind not in "iu":
        raise ValueError(f"{field}: got {short(start)}; give (row, column) of a cell to dig")
    return [tuple(cell) for cell in given.reshape(-1, 2).tolist()]


def _index(at: dict[Cell, int], field: str, cell: Cell) -> int:
    """The number of a cell; raises ValueError if it is not to be dug."""
    if cell not in at:
        raise ValueError(f"{field}: got {cell}; give (row, column) of a cell to dig, such as {next(iter(at))}")
    return at[cell]


def connected_pieces(dig: np.ndarray) -> list[set[Cell]]:
    """The connected sets of true cells (over their sides), largest first."""
    labels, count = label(dig)
    where = np.argwhere(labels)
    pieces: list[set[Cell]] = [set() for _ in range(count)]
    for (r, c), piece in zip(where.tolist(), labels[labels > 0].tolist(), strict=True):
        pieces[piece - 1].add((r, c))
    return sorted(pieces, key=lambda p: (-len(p), min(p)))


@dataclass(frozen=True)
class GraphBlock:
    """A block of the graph: a largest part that stays connected when any one cell is removed, or a bridge (two cells)."""

    cells: tuple[int, ...]
    edges: tuple[tuple[int, int], ...]

    @property
    def bridge(self) -> bool:
        """Whether the block is two cells and the edge between them."""
        return len(self.edges) == 1


def blocks_of(near: tuple[tuple[int, ...], ...]) -> list[GraphBlock]:
    """The blocks (2-connected components and bridges) of a connected graph; Hopcroft and Tarjan 1973, without recursion."""
    found: list[GraphBlock] = []
    depth, low = [-1] * len(near), [0] * len(near)
    edges: list[tuple[int, int]] = []
    depth[0] = 0
    stack = [(0, -1, 0, iter(near[0]))]
    while stack:
        v, parent, cut, rest = stack[-1]
        for u in rest:
            if depth[u] < 0:
                depth[u] = low[u] = depth[v] + 1
                stack.append((u, v, len(edges), iter(near[u])))
                edges.append((v, u))
                break
            if u != parent and depth[u] < depth[v]:
                edges.append((v, u))
                low[v] = min(low[v], depth[u])
        else:
            stack.pop()
            if parent < 0:
                break
            low[parent] = min(low[parent], low[v])
            if low[v] >= depth[parent]:
                own = edges[cut:]
                del edges[cut:]
                found.append(GraphBlock(tuple(sorted({x for e in own for x in e})), tuple(own)))
    return found


@dataclass(frozen=True)
class Hanging:
    """A block in the tree of blocks that hangs from a root.

    Attributes:
      block: the block.
      gate: its cell towards the root.
      below: for each cell with blocks below it, the cell and the places of these blocks in the list of `hang`.
    """

    block: GraphBlock
    gate: int
    below: tuple[tuple[int, tuple[int, ...]], ...]


def hang(blocks: list[GraphBlock], root: int) -> list[Hanging]:
    """The tree of blocks hung from a cell, children before parents."""
    of: dict[int, list[int]] = {}
    for b, block in enumerate(blocks):
        for v in block.cells:
            of.setdefault(v, []).append(b)
    order: list[tuple[int, int]] = []
    seen = set()
    queue = [root]
    for gate in queue:
        for b in of.get(gate, []):
            if b not in seen:
                seen.add(b)
                order.append((b, gate))
                queue.extend(v for v in blocks[b].cells if v != gate)
    order.reverse()
    place = {b: k for k, (b, _) in enumerate(order)}
    hung: list[Hanging] = []
    for b, gate in order:
        block = blocks[b]
        below = tuple((v, tuple(place[o] for o in of[v] if o != b)) for v in block.cells if v != gate and len(of[v]) > 1)
        hung.append(Hanging(block, gate, below))
    return hung
