"""The cheapest walk over one block, proven, by dynamic programming along a sweep over its cells.

A walk over a block is a connected multigraph on its edges, each taken 0, 1 or 2 times (three are never better than one),
that touches every cell; only the walk's ends have odd degree. Cells are passed one by one. Of the part passed, only this
matters for the rest: for each cell of the frontier (passed, with neighbours still to come) whether its degree is odd and
which others it is connected with, and how many ends have been spent. Of two partial walks with the same such state the
cheaper is kept. This is the frontier method (Simpath, Knuth 2008; Cook and Seymour's tour merging 2003).

The search is deepened: a state stays while its cost and a lower bound of the rest, which ignores connections (relaxed.py),
are at most F. F grows from the bound of the whole by as little as can be until a walk is found, which is then shortest. With
more than `width` states the best are kept: a walk found then has its cost, and what was proven before stays proven.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from jaxsand.planning.binary.board import Cell, GraphBlock
from jaxsand.planning.binary.order import sweep_order
from jaxsand.planning.binary.relaxed import ALONE, EVEN, FAR, ODD, Rest

Gains = dict[int, int]


_FEW = 1000


class OutOfTime(Exception):  # noqa: N818 - not an error
    """The time allowed has passed."""


@dataclass(frozen=True)
class LineStep:
    """One step of a sweep, which passes one cell.

    Attributes:
      cell: the cell.
      slot: its place in the states.
      edges: its edges to cells passed before, as (slot, number of the edge).
      leaving: the cells (slot, cell) that have no neighbours to come after this step.
      live: the slots of the frontier afterwards.
    """

    cell: int
    slot: int
    edges: tuple[tuple[int, int], ...]
    leaving: tuple[tuple[int, int], ...]
    live: tuple[int, ...]  # the frontier afterwards


@dataclass(frozen=True)
class WalkEnds:
    """Where a walk over a block may end.

    Attributes:
      gate: a cell.
      from_gate: whether the walk ends there.
      count: how many other ends it has.
      gains: the cells where these may lie, and what each takes off the cost.
    """

    gate: int
    from_gate: bool
    count: int
    gains: Gains

    def leave(self, cell: int) -> tuple[bool, int | None]:
        """Whether a cell's degree may be even, and what it takes off the cost as an end (None: it may not be odd)."""
        if cell == self.gate:
            return not self.from_gate, (0 if self.from_gate else None)
        return True, (self.gains.get(cell) if self.count else None)


@dataclass(frozen=True)
class Tour:
    """The cheapest walk found over a block.

    Attributes:
      times: how often it takes each edge.
      cost: its steps less the gains of its ends; `FAR` if none was found.
      lower_bound: no walk costs less.
      states: how many states were expanded.
    """

    times: tuple[int, ...]
    cost: int
    lower_bound: int
    states: int


def steps_of(block: GraphBlock, places: Sequence[Cell]) -> list[LineStep]:
    """The steps of a sweep over a block."""
    order = sweep_order(block, places)
    meets: dict[int, list[tuple[int, int]]] = {v: [] for v in block.cells}
    for k, (a, b) in enumerate(block.edges):
        meets[a].append((b, k))
        meets[b].append((a, k))
    missing = {v: len(m) for v, m in meets.items()}
    slot: dict[int, int] = {}
    free: list[int] = []
    steps = []
    for v in order:
        own = free.pop() if free else len(slot)
        edges = tuple((slot[u], k) for u, k in meets[v] if u in slot)
        slot[v] = own
        missing[v] -= len(edges)
        passed = [u for u, _ in meets[v] if u in slot]
        for u in passed:
            missing[u] -= 1
        leaving = tuple((slot[u], u) for u in (*passed, v) if not missing[u])
        for s, u in leaving:
            del slot[u]
            free.append(s)
        steps.append(LineStep(v, own, edges, leaving, tuple(sorted(slot.values()))))
    return steps


@dataclass
class _States:
    """Partial walks [n].

    Attributes:
      hang: [slots, n] the lowest slot among those connected with each slot.
      odd: [slots, n] whether the degree is odd.
      spent: [n] ends spent.
      cost: [n].
      origin: [n] the state of the last step that each came from.
      choice: [n] how often it takes the step's edges, as digits of base 3.
    """

    hang: np.ndarray
    odd: np.ndarray
    spent: np.ndarray
    cost: np.ndarray
    origin: np.ndarray
    choice: np.ndarray

    def take(self, which: np.ndarray) -> "_States":
        return _States(
            self.hang[:, which],
            self.odd[:, which],
            self.spent[which],
            self.cost[which],
            self.origin[which],
            self.choice[which],
        )


@dataclass
class LineSweep:
    """A block ready to be swept, for walks with given ends."""

    block: GraphBlock
    steps: list[LineStep]
    ends: WalkEnds
    rest: Rest
    least: int = field(init=False)
    proven: int = field(init=False)

    def __post_init__(self) -> None:
        none = np.zeros((0, 1), np.uint8)
        self.least = self.proven = int(self.rest.bound(0, none, np.zeros(1, np.uint8))[0])

    def search(self, width: int, tick: Callable[[], None], old: Tour | None = None) -> Tour:
        """Deepens the search until a walk is found, from the bound of the whole or from what an `old` search proved.

        At each depth few states are tried first: if they find a walk, it is shortest, and if none was left out, there is
        none. `proven` holds what is proven so far, also if `tick` raises.
        """
        limit = self.proven = max(self.least, old.lower_bound if old else self.least)
        most = 2 * len(self.block.edges)  # every edge twice
        states, certain = 0, True
        while limit <= most and not (old and old.cost <= limit):
            few = min(_FEW, width)
            found = self._pass(limit, few, tick)
            while found.times is None and not found.complete and few < width:
                states += found.states
                few = min(8 * few, width)
                found = self._pass(limit, few, tick)
            states += found.states
            if found.times is not None:
                return Tour(found.times, found.cost, self.proven, states)
            certain = certain and found.complete
            if certain:
                limit = self.proven = found.next
            else:
                limit = max(limit + 1, min(2 * limit - self.proven + 2, most))
        return Tour(old.times if old else (), old.cost if old else FAR, self.proven, states)

    def _pass(self, limit: int, width: int, tick: Callable[[], None]) -> "_Pass":
        """One sweep with states up to the cost `limit`, of which `width` are kept."""
        slots = 1 + max(step.slot for step in self.steps)
        small = np.uint8 if slots < 255 else np.uint16
        state = _States(
            np.full((slots, 1), np.iinfo(small).max, small),
            np.zeros((slots, 1), bool),
            np.zeros(1, np.uint8),
            np.zeros(1, np.int32),
            np.zeros(1, np.int64),
            np.zeros(1, np.uint8),
        )
        history = []
        expanded, complete, following = 0, True, FAR
        for k, step in enumerate(self.steps):
            tick()
            expanded += len(state.cost)
            state = _advance(state, step, self.ends, last=k + 1 == len(self.steps))
            live = list(step.live)
            over = state.cost + self.rest.bound(k + 1, _kinds(state, live), state.spent)
            keep = np.flatnonzero(over <= limit)
            beyond = over[over > limit]
            if beyond.size:
                following = min(following, int(beyond.min()))
            state, over = state.take(keep), over[keep]
            unique = _cheapest(state, live)
            if len(unique) > width:
                # By the bound and, since it takes two off wherever the walk falls apart, more for each part yet to be
                # joined; among equals by a fixed scatter, so that the states kept are of many kinds.
                parts = np.sum(state.hang[live][:, unique] == np.array(live)[:, None], axis=0)
                scatter = (unique * 2654435761) % (1 << 32)
                unique = np.sort(unique[np.lexsort((scatter, over[unique] + 4 * parts))[:width]])
                complete = False
            state = state.take(unique)
            history.append((state.origin.astype(np.int32), state.choice.astype(np.uint8)))
            if not len(state.cost):
                return _Pass(None, FAR, expanded, complete, following)
        done = int(state.cost.argmin())
        times = np.zeros(len(self.block.edges), np.uint8)
        at = done
        for step, (origin, choice) in zip(self.steps[::-1], history[::-1], strict=True):
            code = int(choice[at])
            for _, edge in reversed(step.edges):
                code, times[edge] = divmod(code, 3)
            at = int(origin[at])
        return _Pass(tuple(times.tolist()), int(state.cost[done]), expanded, complete, following)


@dataclass(frozen=True)
class _Pass:
    """What one sweep found.

    Attributes:
      times: how often the walk takes each edge; None without a walk.
      cost: of the walk.
      states: how many states were expanded.
      complete: whether no state was left out for want of room.
      next: the least cost above the limit that was seen.
    """

    times: tuple[int, ...] | None
    cost: int
    states: int
    complete: bool
    next: int


def _advance(state: _States, step: LineStep, ends: WalkEnds, *, last: bool) -> _States:
    """The states after one cell is passed in every possible way."""
    n = len(state.cost)
    state = replace(state, hang=state.hang.copy(), odd=state.odd.copy(), origin=np.arange(n), choice=np.zeros(n, np.uint8))
    state.hang[step.slot] = step.slot
    state.odd[step.slot] = False
    for slot, _ in step.edges:
        apart = np.flatnonzero(state.hang[slot] != state.hang[step.slot])
        once, twice = state.take(np.arange(len(state.cost))), state.take(apart)
        once.odd[[slot, step.slot]] ^= True
        for taken, times in ((once, 1), (twice, 2)):
            a, b = taken.hang[slot], taken.hang[step.slot]
            taken.hang = np.where(taken.hang == np.maximum(a, b), np.minimum(a, b), taken.hang)
            taken.cost += times
        parts = (state, once, twice)
        choice = [3 * part.choice + times for times, part in enumerate(parts)]
        state = _States(
            np.concatenate([p.hang for p in parts], 1),
            np.concatenate([p.odd for p in parts], 1),
            np.concatenate([p.spent for p in parts]),
            np.concatenate([p.cost for p in parts]),
            np.concatenate([p.origin for p in parts]),
            np.concatenate(choice),
        )
    for place, (slot, cell) in enumerate(step.leaving):
        state = _leave(state, slot, cell, ends, last=last and place + 1 == len(step.leaving))
    return state.take(np.flatnonzero(state.spent == ends.count)) if last else state


def _leave(state: _States, slot: int, cell: int, ends: WalkEnds, *, last: bool) -> _States:
    """The states after a cell has left the frontier, which needs a neighbour that it is connected with and an allowed
    degree.
    """
    even, gain = ends.leave(cell)
    odd = state.odd[slot]
    others = state.hang == state.hang[slot]
    others[slot] = False
    allowed = np.where(odd, gain is not None, even)
    if not last:
        allowed &= others.any(0)
    if cell != ends.gate:
        allowed &= ~odd | (state.spent < ends.count)
    state.hang = np.where(others & (state.hang[slot] == slot), others.argmax(0).astype(state.hang.dtype), state.hang)
    state.hang[slot] = np.iinfo(state.hang.dtype).max
    if cell != ends.gate and gain is not None:
        state.spent = state.spent + odd.astype(np.uint8)
        state.cost = state.cost - np.where(odd, gain, 0).astype(np.int32)
    return state.take(np.flatnonzero(allowed))


def _kinds(state: _States, live: list[int]) -> np.ndarray:
    """Alone, even or odd, for each live slot: [live, n]."""
    hang = state.hang[live]
    shared = np.zeros(hang.shape, bool)
    for i in range(len(live)):
        for j in range(i):
            same = hang[i] == hang[j]
            shared[i] |= same
            shared[j] |= same
    return np.where(state.odd[live], ODD, np.where(shared, EVEN, ALONE))


def _cheapest(state: _States, live: list[int]) -> np.ndarray:
    """Which of the states [n] to keep: the cheapest of equal ones."""
    if len(state.cost) < 2:
        return np.arange(len(state.cost))
    bits = len(state.hang).bit_length() + 1
    room = 62 // bits
    words = [state.spent.astype(np.uint64)]
    for i, slot in enumerate(live):
        if i and i % room == 0:
            words.append(np.zeros(len(state.cost), np.uint64))
        words[-1] = words[-1] << np.uint64(bits) | (state.hang[slot].astype(np.uint64) << np.uint64(1)) | state.odd[slot]
    order = np.argsort(words[0]) if len(words) == 1 else np.lexsort(words)
    new = np.ones(len(order), bool)
    new[1:] = np.any([w[order[1:]] != w[order[:-1]] for w in words], axis=0)
    group = np.cumsum(new) - 1
    cost = state.cost[order]
    least = np.flatnonzero(cost == np.minimum.reduceat(cost, np.flatnonzero(new))[group])
    first = np.ones(len(least), bool)
    first[1:] = group[least[1:]] != group[least[:-1]]
    return order[least[first]]
