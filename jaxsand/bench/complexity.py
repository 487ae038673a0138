"""What planning a single stroke costs: nodes and time against the map, its back-tracks and the heuristic's weight.

The counterpart of "order of complexity" in arXiv:1908.02745, and the maps that the planner is measured on.
"""

import string
import time
from functools import partial

import numpy as np

from jaxsand.bench.tables import Row
from jaxsand.bench.timing import seconds_of, timed
from jaxsand.goals import letters as goals
from jaxsand.planning.binary import Cell, Engine, Plan, plan
from jaxsand.planning.binary.paper import ALPHA
from jaxsand.scene.progress import Tell

PUBLISHED = {
    ("A", 7.2): (18_532, 23),
    ("S", 7.2): (788_492, 27),
    ("T", 7.2): (23_864, 18),
    ("R", 7.2): (28_096, 25),
    ("S", 3.0): (63_568, 27),
    ("T", 3.0): (820, 21),
}
"""The paper's letters and alphas: nodes opened, steps."""
Map = tuple[np.ndarray, Cell | None]


def planning(tell: Tell) -> dict[str, list[Row]]:
    """All tables."""
    return {
        "paper_counts": rows_of_paper(tell),
        "plan_letters": rows_of_letters(tell),
        "plan_by_alpha": rows_of_alpha(tell),
        "plan_by_size": rows_of_size(tell),
        "plan_large": rows_of_hard(tell),
    }


def stretched(letter: str, times: int) -> Map:
    """A letter's map with every step made `times` as long, still one cell wide."""
    dig, start = goals.letter_map(letter)
    rows, columns = dig.shape
    big = np.zeros(((rows - 1) * times + 1, (columns - 1) * times + 1), bool)
    for r, c in np.argwhere(dig):
        for dr, dc in ((0, 1), (1, 0)):
            if r + dr < rows and c + dc < columns and dig[r + dr, c + dc]:
                big[r * times : (r + dr) * times + 1, c * times : (c + dc) * times + 1] = True
    return big, (start[0] * times, start[1] * times)


def thickened(letter: str, width: int) -> Map:
    """A letter's map with strokes `width` cells wide, started in the middle of its start cell."""
    dig, start = goals.letter_map(letter)
    return np.kron(dig, np.ones((width, width), bool)), (
        start[0] * width + width // 2,
        start[1] * width + width // 2,
    )


def grown(side: int, cells: int, loops: float, seed: int) -> Map:
    """A random tree of `cells` cells on a square map, grown cell by cell, and a share `loops` of as many cells that close
    loops; started wherever is best."""
    rng = np.random.default_rng(seed)
    dig = np.zeros((side + 2, side + 2), bool)
    inside = dig[1:-1, 1:-1]
    dig[side // 2 + 1, side // 2 + 1] = True

    def near() -> np.ndarray:
        whole: np.ndarray = dig.astype(int)
        return whole[:-2, 1:-1] + whole[2:, 1:-1] + whole[1:-1, :-2] + whole[1:-1, 2:]

    while inside.sum() < cells:
        free = np.argwhere(~inside & (near() == 1))
        if not len(free):
            break
        inside[tuple(free[rng.integers(len(free))])] = True
    closing = np.argwhere(~inside & (near() > 1))
    inside[tuple(rng.permutation(closing)[: round(loops * inside.sum())].T)] = True
    return inside.copy(), None


def comb(teeth: int, cells: int = 28) -> Map:
    """A bar of which every other cell bears a tooth, a cell long: each tooth but the last is a back-track. All have as many
    cells."""
    length = cells - teeth
    dig = np.zeros((2, length), bool)
    dig[1] = True
    dig[0, 1 : 2 * teeth : 2] = True
    return dig, (1, 0)


def rows_of_letters(tell: Tell) -> list[Row]:
    """Every letter by `astar` and by `exact` (best of three runs): steps, proofs, expansions, milliseconds."""
    rows = []
    for letter in string.ascii_uppercase:
        tell(f"letter {letter}")
        dig, start = goals.letter_map(letter)
        found, ms = _timed(dig, start, "astar")
        proven, exact_ms = _timed(dig, start, "exact")
        free, free_ms = _timed(dig, None, "exact")
        rows.append(
            {
                "name": letter,
                "steps": found.steps,
                "proven": found.optimal and proven.optimal and found.steps == proven.steps,
                "expanded": found.expanded,
                "astar_ms": ms,
                "exact_ms": exact_ms,
                "steps_from_anywhere": free.steps,
                "anywhere_ms": free_ms,
            }
        )
    return rows


def rows_of_paper(tell: Tell) -> list[Row]:
    """The paper's counts, as published and as its search gives them here, and what `astar` expands instead."""
    rows = []
    for (letter, alpha), (nodes, steps) in PUBLISHED.items():
        tell(f"the paper's search: {letter}, alpha {alpha}")
        dig, start = goals.letter_map(letter)
        seconds, found = seconds_of(partial(plan, dig, start, engine="paper", weight=ALPHA / alpha))
        ours, ms = _timed(dig, start, "astar")
        rows.append(
            {
                "name": letter,
                "alpha": alpha,
                "published_nodes": nodes,
                "nodes": found.opened,
                "ratio": found.opened / nodes,
                "published_steps": steps,
                "steps": found.steps,
                "ms": seconds * 1e3,
                "best_steps": ours.steps,
                "astar_expanded": ours.expanded,
                "astar_ms": ms,
                "times_fewer_nodes": nodes / (4 * ours.expanded),
            }
        )
    return rows


def rows_of_alpha(tell: Tell) -> list[Row]:
    """The paper's search at falling alpha: nodes against steps in excess of the fewest."""
    rows = []
    for letter in "ASTR":
        dig, start = goals.letter_map(letter)
        best = plan(dig, start).steps
        for alpha in (7.2, 6.0, 5.0, 4.0, 3.0, 2.0, 1.0):
            tell(f"alpha {alpha}: {letter}")
            found = plan(dig, start, engine="paper", weight=ALPHA / alpha)
            rows.append({"name": letter, "alpha": alpha, "nodes": found.opened, "steps_in_excess": found.steps - best})
    return rows


def rows_of_size(tell: Tell, bound: int = 300_000) -> list[Row]:
    """Nodes and time against the number of back-tracks (combs of 28 cells) and against the map's size (stretched letters);
    a search that gave up after `bound` expansions has no count."""
    maps = [(f"comb, {teeth} teeth", teeth, comb(teeth)) for teeth in range(1, 8)]
    maps += [(f"{letter}, {times} x", times, stretched(letter, times)) for letter in "TA" for times in (1, 2, 3, 5)]
    rows = []
    for name, x, (dig, start) in maps:
        tell(name)
        row: Row = {"name": name, "x": x, "cells": int(dig.sum()), "steps": None}
        for engine in ("paper", "astar", "exact"):
            began = time.perf_counter()
            found = plan(dig, start, engine=engine, bound=None if engine == "exact" else bound)
            gave_up = engine == "paper" and found.expanded >= bound
            row[f"{engine}_expanded"] = None if gave_up else found.expanded
            row[f"{engine}_ms"] = None if gave_up else (time.perf_counter() - began) * 1e3
            row["steps"] = found.steps if found.optimal else row["steps"]
        rows.append(row)
    return rows


def rows_of_hard(tell: Tell, seconds: float = 10.0) -> list[Row]:
    """Larger maps within some seconds each: cells, steps, gap, seconds; sets of maps by their worst member."""
    letters = string.ascii_uppercase
    sets: dict[str, list[Map]] = {
        "letters on 31 x 31, one cell wide": [stretched(letter, 5) for letter in letters],
        "letters, three cells wide": [thickened(letter, 3) for letter in letters],
        "random trees on 32 x 32": [grown(32, 460, 0.0, seed) for seed in range(5)],
        "random loopy maps on 32 x 32": [grown(32, 460, 0.1, seed) for seed in range(5)],
        "filled squares, 2 to 16": [(np.ones((n, n), bool), (0, 0)) for n in range(2, 17)],
        "filled squares, from beside the corner": [(np.ones((n, n), bool), (0, 1)) for n in range(2, 17)],
    }
    rows = []
    for name, maps in sets.items():
        found, times = [], []
        for k, (dig, start) in enumerate(maps, 1):
            tell(f"{name}: {k} of {len(maps)}")
            began = time.perf_counter()
            found.append(plan(dig, start, engine="anytime", seconds=seconds))
            times.append(time.perf_counter() - began)
        rows.append(
            {
                "name": name,
                "maps": len(maps),
                "most_cells": max(int(dig.sum()) for dig, _ in maps),
                "proven": sum(f.optimal for f in found),
                "worst_gap": max(f.gap for f in found),
                "mean_seconds": sum(times) / len(times),
                "worst_seconds": max(times),
            }
        )
    return rows


def _timed(dig: np.ndarray, start: Cell | None, engine: Engine) -> tuple[Plan, float]:
    took = timed(partial(plan, dig, start, engine=engine), 2)
    return took.result, 1e3 * min(took.first, took.best)
