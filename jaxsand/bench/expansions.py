"""States that A* expands a second: whole layers at once (planner/frontier.py) beside a plain heap, in one run."""

import heapq
from functools import partial

import jax
import numpy as np

from jaxsand.bench.tables import Row
from jaxsand.bench.timing import timed
from jaxsand.goals.letters import letter_map
from jaxsand.planning.binary.frontier import Bound, layered, misdug, two_colours
from jaxsand.planning.binary.graph import Graph, goal_only, with_margin
from jaxsand.scene.progress import Tell


def rows_of_expansions(tell: Tell, repeats: int = 5) -> list[Row]:
    """The paper's letters with a margin, and wide maps over their goal cells only: medians of some runs each.

    The heap runs the same bound, first in first out among equals.
    """
    bar = np.ones((3, 12), bool)
    blob = np.ones((5, 6), bool)
    blob[1, 1] = blob[3, 4] = False
    problems: list[tuple[str, Graph, Bound]] = [
        (f"{letter} with a margin", with_margin(*letter_map(letter)), misdug) for letter in "SATR"
    ]
    problems += [
        ("bar of 3 x 12", goal_only(bar, (0, 5)), two_colours),
        ("blob of 5 x 6", goal_only(blob, (0, 2)), two_colours),
    ]
    rows = []
    for name, graph, bound in problems:
        tell(f"whole layers and a heap: {name}")
        layers = timed(partial(layered, graph, bound), repeats)
        heap = heap_misdug if bound is misdug else heap_two_colours
        queue = timed(partial(heap, graph), 3)
        seconds, heap_seconds, found, (steps, expanded) = layers.median, queue.median, layers.result, queue.result
        if found.steps != steps:
            raise RuntimeError(f"{name}: {found.steps} steps by layers, {steps} by the heap")
        rows.append(
            {
                "name": name,
                "steps": steps,
                "expanded": found.expanded,
                "ms": seconds * 1e3,
                "per_second": found.expanded / seconds,
                "heap_expanded": expanded,
                "heap_ms": heap_seconds * 1e3,
                "heap_per_second": expanded / heap_seconds,
                "times_the_rate": found.expanded / seconds * heap_seconds / expanded,
                "times_as_fast": heap_seconds / seconds,
                "compile_seconds": layers.compile_seconds,
            }
        )
    return rows


def heap_misdug(graph: Graph) -> tuple[int, int]:
    """A* with a heap, first in first out among equal f, closed at expansion: the steps and the states expanded."""
    goal = _bits(graph.goal)
    near = [[(j, 1 << j) for j in row if j >= 0] for row in np.asarray(graph.near).tolist()]
    start = int(graph.start)
    queue = [((goal ^ (1 << start)).bit_count(), 0, 0, start, 1 << start)]
    closed: set[tuple[int, int]] = set()
    order = 0
    while True:
        _, _, g, cell, dug = heapq.heappop(queue)
        if (cell, dug) in closed:
            continue
        if dug == goal:
            return g, len(closed)
        closed.add((cell, dug))
        g += 1
        for j, bit in near[cell]:
            order += 1
            child = dug | bit
            heapq.heappush(queue, (g + (child ^ goal).bit_count(), order, g, j, child))


def heap_two_colours(graph: Graph) -> tuple[int, int]:
    """The same with the bound by colours, over goal cells only."""
    goal, odd = _bits(graph.goal), _bits(graph.odd)
    near = [[(j, ~(1 << j)) for j in row if j >= 0] for row in np.asarray(graph.near).tolist()]
    colours = [(odd & goal, ~odd & goal) if odd >> i & 1 else (~odd & goal, odd & goal) for i in range(len(near))]
    start = int(graph.start)
    queue = [(0, 0, 0, start, goal & ~(1 << start))]
    closed: set[tuple[int, int]] = set()
    order = 0
    while True:
        _, _, g, cell, left = heapq.heappop(queue)
        if (cell, left) in closed:
            continue
        if not left:
            return g, len(closed)
        closed.add((cell, left))
        g += 1
        for j, others in near[cell]:
            order += 1
            rest = left & others
            same, other = colours[j]
            h = max(2 * (rest & other).bit_count() - 1, 2 * (rest & same).bit_count())
            heapq.heappush(queue, (g + h, order, g, j, rest))


def _bits(words: np.ndarray | jax.Array) -> int:
    return sum(int(word) << (32 * i) for i, word in enumerate(words))
