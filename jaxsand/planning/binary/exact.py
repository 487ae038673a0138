"""The shortest walk over a map, proven: blocks are solved one by one, each by a sweep, and joined along the tree of blocks.

The walk is a connected multigraph in which only its two ends have odd degree (Euler 1736). In each block it is closed, or
open from the block's gate to where the walk goes on or ends, or, where both ends lie in or below the block, open between two
of its cells (bound.py says why blocks do not interfere). So three figures are computed per block, from the leaves of the
tree up: the cheapest closed walk; what it saves if one end lies in or below the block; what it saves if both do. The tree
hangs from the start, or, where any start will do, from any cell.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from itertools import combinations
from typing import TypeAlias

from jaxsand.planning.binary.board import Board, GraphBlock, Hanging, Problem, blocks_of, hang
from jaxsand.planning.binary.plans import WalkFound
from jaxsand.planning.binary.relaxed import FAR, rest_of
from jaxsand.planning.binary.sweepline import LineStep, LineSweep, OutOfTime, Tour, WalkEnds, steps_of

_Key = tuple[int, int, bool, int, tuple[tuple[int, int], ...]]


class _NothingFound(Exception):  # noqa: N818 - means that `width` was too small
    pass


@dataclass
class Blocks:
    """A board's blocks, and the sweeps over them that are known already.

    Attributes:
      board: the graph.
      blocks: its blocks.
      sweeps: the steps of the sweep over a block, by the number of its first edge.
      known: the tours found, by block and ends.
      states: how many states all searches expanded.
    """

    board: Board
    blocks: list[GraphBlock] = field(init=False)
    sweeps: dict[int, list[LineStep]] = field(default_factory=dict)
    known: dict[_Key, Tour] = field(default_factory=dict)
    states: int = 0

    def __post_init__(self) -> None:
        self.blocks = blocks_of(self.board.near)

    def tour(self, block: GraphBlock, ends: WalkEnds, width: int, tick: Callable[[], None]) -> Tour:
        """The cheapest walk over a block with these ends; uses what former calls proved. With a width of 0 only its lower
        bound.
        """
        number = block.edges[0][0] * len(self.board.cells) + block.edges[0][1]
        key = (number, ends.gate, ends.from_gate, ends.count, tuple(sorted(ends.gains.items())) if ends.count else ())
        old = self.known.get(key)
        if width and old and old.cost == old.lower_bound:
            return old
        if number not in self.sweeps:
            self.sweeps[number] = steps_of(block, self.board.cells)
        steps = self.sweeps[number]
        if not width and old:
            return Tour((), old.lower_bound, old.lower_bound, 0)
        sweep = LineSweep(block, steps, ends, rest_of(steps, ends, self.board.colour, tick))
        if not width:
            return Tour((), sweep.least, sweep.least, 0)
        try:
            new = sweep.search(width, tick, old)
        except OutOfTime:
            times, cost = (old.times, old.cost) if old else ((), FAR)
            self.known[key] = Tour(times, cost, sweep.proven, 0)
            raise
        self.states += new.states
        self.known[key] = new
        if new.cost == FAR:
            raise _NothingFound
        return new


@dataclass(frozen=True)
class _Swap:
    """How often the edges of a block are taken."""

    edges: tuple[tuple[int, int], ...]
    times: tuple[int, ...]


_Swaps: TypeAlias = "_Swap | tuple[_Swaps, ...]"


@dataclass(frozen=True)
class _Saving:
    """What open walks save over closed ones if one end of the walk, or both, lie at a cell or in blocks below it.

    Attributes:
      value: the steps saved.
      swaps: the tours that replace closed ones, `_Swap`s in nested pairs.
    """

    value: int
    swaps: _Swaps = ()

    def __add__(self, other: "_Saving") -> "_Saving":
        return _Saving(self.value + other.value, (self.swaps, other.swaps))


@dataclass(frozen=True)
class _Solved:
    """A block with all below it.

    Attributes:
      closed: its closed tour.
      cost: of that tour.
      one, two: what one end and both ends in or below the block save; None where that is impossible.
      slack: how far the costs may be above the true ones.
    """

    closed: _Swap
    cost: int
    one: _Saving | None
    two: _Saving | None
    slack: int


def exact(problem: Problem, width: int, tick: Callable[[], None] = lambda: None, blocks: Blocks | None = None) -> WalkFound:
    """The shortest walk over a board, where turns cost nothing.

    Args:
      problem: board, starts and end.
      width: how many states of a sweep are kept at a time (see sweepline.py); with 0 no walk is sought, and the lower bound
        is that of every block without connection (relaxed.py).
      tick: is called now and then, and may raise `OutOfTime`.
      blocks: keeps what is known from one call to the next.
    """
    blocks = blocks or Blocks(problem.board)
    n, before = len(problem.board.cells), blocks.states
    everywhere = frozenset(range(n))
    if problem.end is not None:
        walk, lower = _hung_from(problem.end, blocks, frozenset(problem.starts), 1, width, tick)
        walk = walk[::-1] if walk else None
    elif len(problem.starts) == n:
        walk, lower = _hung_from(0, blocks, everywhere, 2, width, tick)
    else:
        tries = [_hung_from(s, blocks, everywhere, 1, width, tick) for s in problem.starts]
        walk = min((w for w, _ in tries if w), key=len, default=None)
        lower = min(low for _, low in tries)
    states = blocks.states - before
    return WalkFound(walk, lower, states, states)


def _hung_from(
    root: int, blocks: Blocks, allowed: frozenset[int], ends: int, width: int, tick: Callable[[], None]
) -> tuple[list[int] | None, int]:
    """The walk from `root` with its other end, or from anywhere with both ends, in `allowed`; and a lower bound.

    `ends` is 1 or 2: how many ends are free.
    """
    least = len(blocks.board.cells) - 1
    parts: list[_Solved] = []
    hung = hang(blocks.blocks, root)
    try:
        for hanging in hung:
            tick()
            parts.append(_part(blocks, hanging, parts, allowed, ends, width, tick))
    except _NothingFound:
        return None, _hung_from(root, blocks, allowed, ends, 0, tick)[1]
    at_root = [part for part, hanging in zip(parts, hung, strict=True) if hanging.gate == root]
    one, two = _at(root, at_root, allowed)
    saving = two if ends == 2 else one
    if saving is None:
        saving = _Saving(0)  # a map of one cell
    lower = max(least, sum(part.cost - part.slack for part in parts) - saving.value)
    if not width:
        return None, lower
    times: dict[tuple[int, int], int] = {}
    for swap in [*(part.closed for part in parts), *_flat(saving.swaps)]:
        times.update(zip(swap.edges, swap.times, strict=True))
    return trail(times, root), lower


def _at(cell: int, below: list[_Solved], allowed: frozenset[int]) -> tuple[_Saving | None, _Saving | None]:
    """What one end and both ends at a cell, or in the blocks below it, save at best."""
    singles = [_Saving(0)] if cell in allowed else []
    singles += [part.one for part in below if part.one]
    doubles = [a + b for a, b in combinations(singles, 2)] + [part.two for part in below if part.two]
    return _best(singles), _best(doubles)


def _best(savings: list[_Saving]) -> _Saving | None:
    return max(savings, key=lambda s: s.value, default=None)


def _part(
    blocks: Blocks,
    hanging: Hanging,
    parts: list[_Solved],
    allowed: frozenset[int],
    count: int,
    width: int,
    tick: Callable[[], None],
) -> _Solved:
    """The figures of a block from those of the blocks below it."""
    block, gate = hanging.block, hanging.gate
    children = dict(hanging.below)
    at = {v: _at(v, [parts[k] for k in children.get(v, ())], allowed) for v in block.cells if v != gate}
    twos = [two for _, two in at.values() if two]
    if block.bridge:
        one = next(iter(at.values()))[0]
        opened = _Saving(1 + one.value, (_Swap(block.edges, (1,)), one.swaps)) if one else None
        return _Solved(_Swap(block.edges, (2,)), 2, opened, _best(twos), 0)
    gains = {v: one.value for v, (one, _) in at.items() if one}
    closed = blocks.tour(block, WalkEnds(gate, False, 0, {}), width, tick)
    slack = 0

    def save(ends: WalkEnds) -> _Saving:
        nonlocal slack
        tour = blocks.tour(block, ends, width, tick)
        slack = max(slack, tour.cost - tour.lower_bound)
        saving = _Saving(closed.cost - tour.cost, _Swap(block.edges, tour.times))
        for v in _odd(block, tour.times) - {gate}:
            below = at[v][0]
            assert below is not None
            saving = _Saving(saving.value, (saving.swaps, below.swaps))
        return saving

    opened = save(WalkEnds(gate, True, 1, gains)) if gains else None
    if count == 2 and len(gains) > 1:
        twos.append(save(WalkEnds(gate, False, 2, gains)))
    slack = max(slack, closed.cost - closed.lower_bound)
    return _Solved(_Swap(block.edges, closed.times), closed.cost, opened, _best(twos), slack)


def _odd(block: GraphBlock, times: tuple[int, ...]) -> set[int]:
    """The cells whose degree in a tour is odd."""
    odd: set[int] = set()
    for (a, b), often in zip(block.edges, times, strict=False):
        if often % 2:
            odd ^= {a, b}
    return odd


def _flat(swaps: _Swaps) -> list[_Swap]:
    """The `_Swap`s in nested pairs, as one list."""
    found: list[_Swap] = []
    stack = [swaps]
    while stack:
        one = stack.pop()
        if isinstance(one, _Swap):
            found.append(one)
        else:
            stack.extend(one)
    return found


def trail(times: dict[tuple[int, int], int], start: int) -> list[int]:
    """A walk that takes every edge as often as `times` says (Hierholzer 1873), from an odd cell if there is one."""
    near: dict[int, list[int]] = {start: []}
    left: dict[tuple[int, int], int] = {}
    degree: dict[int, int] = {}
    for (a, b), often in times.items():
        for v, u in ((a, b), (b, a)):
            if often:
                near.setdefault(v, []).append(u)
            degree[v] = degree.get(v, 0) + often
            left[v, u] = often
    odd = [v for v, d in degree.items() if d % 2]
    stack, walk = [start if not odd or start in odd else odd[0]], []
    while stack:
        v = stack[-1]
        while near[v] and not left[v, near[v][-1]]:
            near[v].pop()
        if near[v]:
            u = near[v][-1]
            left[v, u] -= 1
            left[u, v] -= 1
            stack.append(u)
        else:
            walk.append(stack.pop())
    return walk[::-1]
