"""A lower bound of what the rest of a sweep costs, found by ignoring which cells are connected.

For each cell of the frontier only this is kept: alone (it has no edge yet, so it still needs one), even, or odd. The
cheapest way to give every cell left an edge and the degree it must have, from each such state, is a dynamic programme
backwards along the sweep. Every true walk is one of those ways, so this is a lower bound, and exact but for connection.
Where the frontier is too wide for its table, the bound counts degrees: each edge has one end of each colour, so the degrees
still missing on either colour are a lower bound.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from jaxsand.planning.binary.sweepline import LineStep, WalkEnds

ALONE, EVEN, ODD = 0, 1, 2
FAR = 1 << 28
_WIDEST = 10  # cells of a frontier
_ENTRIES = 1 << 26  # in all tables; four bytes each
_JOINED, _FLIPPED = np.array([EVEN, EVEN, ODD]), np.array([ODD, ODD, EVEN])


@dataclass(frozen=True)
class Tables:
    """The bound as tables: for step k the costs of the rest by [ends spent, state of each live slot...], flat."""

    costs: list[np.ndarray]

    def bound(self, k: int, kinds: np.ndarray, spent: np.ndarray) -> np.ndarray:
        """The bound [n] for states before step k.

        `kinds` [live, n] are alone, even or odd in the order of the live slots; `spent` [n] counts the ends spent.
        """
        place = spent.astype(np.int64)
        for row in kinds:
            place = 3 * place + row
        return self.costs[k][place]


@dataclass(frozen=True)
class Degrees:
    """The bound by degrees.

    Attributes:
      to_come: before each step, the degrees that the cells to come need, by colour.
      colours: before each step, the colours of the live slots.
      gates: before each step, which of the live slots is a gate that must be odd.
      count: ends of the walk.
      most: the most that an end may take off the cost.
    """

    to_come: list[tuple[int, int]]
    colours: list[np.ndarray]
    gates: list[np.ndarray]
    count: int
    most: int

    def bound(self, k: int, kinds: np.ndarray, spent: np.ndarray) -> np.ndarray:
        """The bound [n] for states before step k; see `Tables.bound`."""
        missing = np.where(self.gates[k][:, None], np.array([1, 1, 0])[kinds], np.array([2, 0, 1])[kinds])
        dark = self.colours[k][:, None] == 1
        a = self.to_come[k][0] + np.where(dark, 0, missing).sum(0)
        b = self.to_come[k][1] + np.where(dark, missing, 0).sum(0)
        left = self.count - spent.astype(np.int64)
        # Each end to come takes one off the colour it lies on: best shared out so that the larger is least.
        share = np.clip((a - b + left + 1) // 2, 0, left)
        return np.maximum(np.maximum(a - share, b - (left - share)) - left * self.most, 0 - left * self.most)


Rest = Tables | Degrees


def rest_of(steps: Sequence["LineStep"], ends: "WalkEnds", colour: Sequence[int], tick: Callable[[], None]) -> Rest:
    """The bound for a sweep: tables where they are small enough, else degrees."""
    live = [len(step.live) for step in steps]
    entries = sum(3**n for n in live) * (ends.count + 1) if max(live) <= _WIDEST else _ENTRIES + 1
    return _tables(steps, ends, tick) if entries <= _ENTRIES else _degrees(steps, ends, colour)


def _tables(steps: Sequence["LineStep"], ends: "WalkEnds", tick: Callable[[], None]) -> Tables:
    """The tables, from the last step backwards."""
    rest: np.ndarray = np.full(ends.count + 1, FAR, np.int32)
    rest[ends.count] = 0
    costs = [rest]
    axes: list[int] = []  # the slot of each axis after the first
    for step in reversed(steps):
        tick()
        for slot, cell in reversed(step.leaving):
            even, gain = ends.leave(cell)
            last = np.full_like(rest, FAR)
            if gain is not None and cell == ends.gate:
                last = rest
            elif gain is not None:
                last[:-1] = rest[1:] - gain
            rest = np.stack([np.full_like(rest, FAR), rest if even else np.full_like(rest, FAR), last], axis=-1)
            axes.append(slot)
        for slot, _ in reversed(step.edges):
            x, y = 1 + axes.index(step.slot), 1 + axes.index(slot)
            twice = rest.take(_JOINED, x).take(_JOINED, y) + 2
            once = rest.take(_FLIPPED, x).take(_FLIPPED, y) + 1
            rest = np.minimum(np.minimum(rest, twice), np.minimum(once, FAR))
        at = axes.index(step.slot)
        rest = rest.take(ALONE, 1 + at)
        del axes[at]
        order = np.argsort(axes)
        rest = rest.transpose(0, *(1 + order))
        axes.sort()
        costs.append(np.ascontiguousarray(rest))
    return Tables([c.reshape(-1) for c in costs[::-1]])


def _degrees(steps: Sequence["LineStep"], ends: "WalkEnds", colour: Sequence[int]) -> Degrees:
    cells: dict[int, int] = {}
    colours, gates = [np.zeros(0, int)], [np.zeros(0, bool)]
    for step in steps:
        cells[step.slot] = step.cell
        colours.append(np.array([colour[cells[s]] for s in step.live], int))
        gates.append(np.array([ends.from_gate and cells[s] == ends.gate for s in step.live], bool))
    to_come = [(0, 0)]
    for step in reversed(steps):
        a, b = to_come[-1]
        need = 1 if step.cell == ends.gate and ends.from_gate else 2
        to_come.append((a + need, b) if colour[step.cell] == 0 else (a, b + need))
    most = max(ends.gains.values(), default=0) if ends.count else 0
    return Degrees(to_come[::-1], colours, gates, ends.count, max(most, 0))
