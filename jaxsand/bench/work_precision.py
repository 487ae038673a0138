"""Work-precision: the error of settling against its run time, on stiff scenes and on scenes with exact solutions.

The error of a map is its largest distance from a reference over the largest change of height in the reference. References:
the limit of small steps in float64 on the same grid (super-time-stepping with growth 1/20 from steps of 1/64; on the
smallest grid beside the paper's sweep at rate 1/64, to tell how good it is), the same on a grid twice as fine (averaged over
its cells), and the exact solution where there is one.
"""

import math
import time
from collections.abc import Callable
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np

from jaxsand.bench.tables import Row
from jaxsand.relaxation.schemes import Multilevel, Pairwise, Relaxation, Scheme, SuperTimeStepping
from jaxsand.relaxation.settling import settle
from jaxsand.relaxation.stopping import UntilStill
from jaxsand.scene.boundaries import Draining
from jaxsand.scene.grid import Neighbours
from jaxsand.scene.progress import Tell, quiet
from jaxsand.scene.scene import Scene, make_scene

MU = math.tan(math.radians(29))
_PAPER = "paper's sweep, k = dx^2/8"
SCHEMES: dict[str, Scheme] = {
    _PAPER: Relaxation(),
    "relaxation 1/6.83": Relaxation(1 / 6.83),
    "pairwise": Pairwise(),
    "super-time-stepping": SuperTimeStepping(),
    "super-time-stepping, growth 0.8": SuperTimeStepping(0.8),
    "multilevel": Multilevel(),
}
_TOLERANCES = (0.1, 0.03, 0.01, 3e-3, 1e-3)
_BOUND = 400_000


@dataclass(frozen=True)
class Collapse:
    """Sand of one spacing to a cell: `heights(n)` on n cells a side (or in a row), its angle, and the exact end if known."""

    name: str
    heights: Callable[[int], np.ndarray]
    sides: tuple[int, ...]
    degrees: float = 29.0
    exact: Callable[[int], np.ndarray] | None = None
    neighbours: Neighbours = 8
    edge: Draining | None = None

    def scene(self, n: int) -> Scene:
        """The scene on n cells a side."""
        shape = self.heights(n).shape
        return make_scene((shape[0], shape[1]), 1.0, math.radians(self.degrees), self.neighbours, edge=self.edge)


def _grid(n: int) -> tuple[np.ndarray, np.ndarray]:
    y, x = np.indices((n, n)) + 0.5
    return x - n / 2, y - n / 2


def _disc(share: float) -> Callable[[int], np.ndarray]:
    return lambda n: np.where(np.hypot(*_grid(n)) < n / 8, n * share, 0.0)


def trench(n: int) -> np.ndarray:
    """A trench with steep sides, half as long as the map, n / 16 wide and deep, its sand in berms beside it, at 22.5 deg."""
    x, y = _grid(n)
    a = math.radians(22.5)
    along, across = x * math.cos(a) + y * math.sin(a), np.abs(y * math.cos(a) - x * math.sin(a))
    dug = (np.abs(along) < n / 4) & (across < n / 32)
    berm = (np.abs(along) < n / 4) & (across >= n / 32) & (across < n / 16)
    return np.where(dug, -n / 16, np.where(berm, n / 16 * dug.sum() / berm.sum(), 0.0))


def _ridge(n: int) -> np.ndarray:
    x = np.arange(n) + 0.5 - n / 2
    return np.where(np.abs(x) < n / 16, n / 5, 0.0)[None]


def _ridge_settled(n: int) -> np.ndarray:
    x = np.arange(n) + 0.5 - n / 2
    return np.maximum(math.sqrt(2 * (n / 16) * (n / 5) * MU) - MU * np.abs(x), 0)[None]


def roof(n: int) -> np.ndarray:
    """An overfilled table that has drained: mu times the distance to the edge."""
    x = np.arange(n) + 0.5
    near = np.minimum(x, n - x)
    return MU * np.minimum(near[:, None], near[None, :])


COLUMN = Collapse("column of N/2 cells", _disc(1 / 2), (80, 160, 320))
STIFF = (
    COLUMN,
    Collapse("trench across", trench, (128, 256, 512)),
    Collapse("5 degrees", _disc(1 / 8), (80, 160, 320), 5.0),
)
TABLE = Collapse("overfilled table", lambda n: np.full((n, n), n / 2), (32, 64, 128), exact=roof, edge=Draining())
ISOTROPIC = Collapse("column, isotropic", _disc(1 / 2), (40, 80, 160), neighbours="isotropic")
RIDGE = Collapse("ridge, one dimension", _ridge, (64, 128, 256), exact=_ridge_settled)
ALL = (*STIFF, ISOTROPIC, TABLE, RIDGE)


def work_precision(problems: tuple[Collapse, ...], tell: Tell = quiet, sizes: int = 3) -> list[Row]:
    """A row for every problem, size, scheme and tolerance: errors, sweeps, seconds, and the compile time apart."""
    rows = []
    for problem in problems:
        for n in problem.sides[:sizes]:
            start = problem.heights(n)
            end = reference(problem, n)
            fine = reference(problem, 2 * n).reshape(start.shape[0], -1, n, 2).mean((1, 3)) / 2
            for name, scheme in SCHEMES.items():
                if isinstance(scheme, Multilevel) and 1 in start.shape:
                    continue
                if isinstance(scheme, Pairwise) and problem.neighbours == "isotropic":
                    continue
                tell(f"{problem.name}, {n} cells, {name}")
                for run in _runs(problem, n, scheme):
                    height = run.pop("height")
                    row = {"problem": problem.name, "cells": n, "scheme": name, **run}
                    row["error"] = distance(height, end, start)
                    row["error_fine"] = distance(height, fine, start)
                    row["error_exact"] = distance(height, problem.exact(n), start) if problem.exact else None
                    least = start.min() if problem.edge is None else min(start.min(), float(problem.edge.level))
                    row["overshoot"] = max(0.0, float(height.max() - start.max()), float(least - height.min()))
                    rows.append(row)
    return rows


def distance(height: np.ndarray, end: np.ndarray, start: np.ndarray) -> float:
    """The largest distance from the reference, over its largest change of height."""
    return float(np.abs(height - end).max() / np.abs(end - start).max())


def reference(problem: Collapse, n: int) -> np.ndarray:
    """The limit of small steps, in float64."""
    with jax.enable_x64(True):
        start = jnp.asarray(problem.heights(n), jnp.float64)
        stop = UntilStill(1e-5, bound=_BOUND)
        return np.asarray(settle(problem.scene(n), start, scheme=SuperTimeStepping(0.05, 1 / 64), stop=stop).height)


def reference_check(tell: Tell = quiet) -> list[Row]:
    """How far the reference lies from the paper's sweep at rate 1/64, on the smallest grid of every stiff problem."""
    rows = []
    for problem in STIFF:
        n = problem.sides[0]
        tell(f"reference of {problem.name}")
        start = problem.heights(n)
        with jax.enable_x64(True):
            stop = UntilStill(1e-5, bound=4 * _BOUND, interval=64)
            slow = settle(problem.scene(n), jnp.asarray(start), scheme=Relaxation(1 / 64), stop=stop)
            small = np.asarray(slow.height)
        rows.append({"problem": problem.name, "cells": n, "error": distance(reference(problem, n), small, start)})
    return rows


def _runs(problem: Collapse, n: int, scheme: Scheme) -> list[Row]:
    """One run for every tolerance, in float32."""
    scene, start = problem.scene(n), jnp.asarray(problem.heights(n), jnp.float32)
    program = jax.jit(lambda h, t: settle(scene, h, scheme=scheme, stop=UntilStill(t, bound=_BOUND)))
    began = time.perf_counter()
    compiled = program.lower(start, jnp.float32(1)).compile()
    compile_seconds = time.perf_counter() - began
    rows = []
    for tolerance in _TOLERANCES:
        best, spent, turns = math.inf, 0.0, 0
        while turns < 2 or (turns < 15 and spent < 0.3):
            began = time.perf_counter()
            settled = jax.block_until_ready(compiled(start, jnp.float32(tolerance)))
            seconds = time.perf_counter() - began
            best, spent, turns = min(best, seconds), spent + seconds, turns + 1
        rows.append(
            {
                "tolerance": tolerance,
                "sweeps": int(settled.sweeps),
                "outcome": int(settled.outcome),
                "seconds": best,
                "compile_seconds": compile_seconds,
                "height": np.asarray(settled.height, float),
            }
        )
    return rows


def time_to(rows: list[Row], error: float = 0.01) -> list[Row]:
    """For every problem, size and scheme the time to within the error, by the loosest tolerance from which on all are, and
    how that compares with the paper's sweep; None where the tightest is not."""
    found: dict[tuple[str, int, str], Row | None] = {}
    for row in sorted(rows, key=lambda row: -row["tolerance"]):
        key = (row["problem"], row["cells"], row["scheme"])
        best = found.setdefault(key, None)
        found[key] = (best or row) if row["error"] <= error else None
    table = []
    for (problem, n, scheme), best in found.items():
        base = found.get((problem, n, _PAPER))
        table.append(
            {
                "problem": problem,
                "cells": n,
                "scheme": scheme,
                "seconds": best and best["seconds"],
                "sweeps": best and best["sweeps"],
                "error": best and best["error"],
                "times_paper": base["seconds"] / best["seconds"] if best and base else None,
                "sweeps_paper": base["sweeps"] / best["sweeps"] if best and base else None,
            }
        )
    return table


def growth(table: list[Row]) -> list[Row]:
    """Fitted exponents of time and of sweeps times cells in the number of cells a side."""
    rows = []
    for problem, scheme in dict.fromkeys((row["problem"], row["scheme"]) for row in table):
        some = [r for r in table if (r["problem"], r["scheme"]) == (problem, scheme) and r["seconds"]]
        if len(some) < 2:
            continue
        n = np.log([r["cells"] for r in some])
        power = 1 if problem == RIDGE.name else 2
        rows.append(
            {
                "problem": problem,
                "scheme": scheme,
                "seconds_exponent": float(np.polyfit(n, np.log([r["seconds"] for r in some]), 1)[0]),
                "work_exponent": float(np.polyfit(n, np.log([r["sweeps"] for r in some]), 1)[0]) + power,
            }
        )
    return rows
