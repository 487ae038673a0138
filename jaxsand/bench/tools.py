"""Every tool: what a stroke and its gradient cost beside the level blade's, and how right the gradient is."""

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxsand.bench.gradient_checks import GradientCase, against_differences, inputs, of_float32, program, sloped
from jaxsand.bench.kept import append_row, known_rows
from jaxsand.bench.tables import Row
from jaxsand.bench.timing import race
from jaxsand.scene.boundaries import Base
from jaxsand.scene.progress import Tell, quiet
from jaxsand.scene.scene import cast
from jaxsand.scene.tools import Blade, Bucket, Wheel

LEVEL = GradientCase(True)
"""A blade at one height, to which the others' costs are told."""

TOOLS = (
    LEVEL,
    GradientCase(True, rises=True),
    GradientCase(True, tool=Blade(yaw=0.5)),
    GradientCase(True, tool=Blade(plates=0.03)),
    GradientCase(True, tool=Wheel(0.04, 0.03, 0.01)),
    GradientCase(True, tool=Wheel(0.04, 0.03, 0.01), rises=True),
    GradientCase(True, tool=Bucket(0.04, 0.04, 4e-4), rises=True),
    GradientCase(True, tool=Blade(depth=0.015), base=Base(-0.01)),
)
"""Each tool, and what it can do; blades and wheels at one height, and rising or sinking."""

_TRIES = 16  # random points for each smooth one that is wanted, at most
_AT_ONCE = 64  # points


def bench_tools(
    tell: Tell = quiet,
    points: int = 64,
    cases: tuple[GradientCase, ...] = TOOLS,
    cells: int = 32,
    batch: int = 16,
    rounds: int = 5,
    out: Path | None = None,
) -> dict[str, list[Row]]:
    """Costs of strokes on `batch` maps of `cells` a side, and errors of gradients at `points` smooth points a tool.

    A row of errors is written to `out`/tools.jsonl as it comes, and one that is there already is not computed again.

    Raises:
      ValueError: for a file there that holds other rows, or cannot be written.
    """
    path = out / "tools.jsonl" if out else None
    known = known_rows(path, {"name", "points", "cells"}) if path else []
    return {
        "tool_cost": costs_of_tools(tell, cases, cells, batch, rounds),
        "gradient_of_tools": right_at(tell, cases, points, min(cells, 24), path, known),
    }


def costs_of_tools(tell: Tell, cases: tuple[GradientCase, ...], cells: int, batch: int, rounds: int) -> list[Row]:
    """Milliseconds a stroke, with settling (best of a few, in turns), in one `vmap` in float32; `times_level` and
    `gradient_times_level` are over those of the first case. A bucket's are of a scoop and a dump.

    The cases' strokes are the same random ones; where a tool rises or sinks it is at most 12 mm deep.
    """
    ways: dict[str, Callable[[], Any]] = {}
    for case in cases:
        tell(f"compiling: {case.name}")
        x, run = cast(inputs(case, cells, batch), jnp.float32), program(case, cells)
        ways[case.name] = partial(_compiled_for(run, x), *x)
        ways[_gradient(case)] = partial(_compiled_for(sloped(run), x), *x)
    timed = race(ways, rounds, tell)
    first = cases[0]
    rows = []
    for case in cases:
        forward, both = timed[case.name].best, timed[_gradient(case)].best
        rows.append(
            {
                "name": case.name,
                "stroke_ms": 1e3 * forward / batch,
                "with_gradient_ms": 1e3 * both / batch,
                "gradient_over_forward": both / forward,
                "times_level": forward / timed[first.name].best,
                "gradient_times_level": both / timed[_gradient(first)].best,
            }
        )
    return rows


def _gradient(case: GradientCase) -> str:
    return f"{case.name}, gradient"


def _compiled_for(run: Callable[..., Any], x: Any) -> Callable[..., Any]:
    """The program of a batch."""
    return jax.jit(jax.vmap(run)).lower(*x).compile()


def right_at(
    tell: Tell,
    cases: tuple[GradientCase, ...],
    points: int,
    cells: int,
    path: Path | None = None,
    known: Sequence[Row] = (),
) -> list[Row]:
    """Errors over the gradient's norm at points that are smooth by every input (see gradient_checks.py), found among random
    ones: of float64 by each input against central differences, and of float32 against float64 at the first 64 points.

    `tried` points were drawn to find `smooth` of them: at least `points`, unless 16 times as many were drawn in vain. Rows
    that are not among the `known` ones are added to the file at `path`.
    """
    there = {(row["name"], row["points"], row["cells"]): row for row in known}
    rows = list[Row]()
    for case in cases:
        row = there.get((case.name, points, cells))
        if row is None:
            row = {"name": case.name, "points": points, "cells": cells} | _errors(tell, case, points, cells)
            if path:
                append_row(path, row)
        rows.append(row)
    return rows


def _errors(tell: Tell, case: GradientCase, points: int, cells: int) -> Row:
    """How right one tool's gradient is."""
    errors, tried = list[np.ndarray](), 0
    while (found := sum(one.shape[1] for one in errors)) < points and tried < _TRIES * points:
        tell(f"gradients: {case.name}, {found} of {points} points")
        error, smooth = against_differences(case, _AT_ONCE, seed=7 * tried, cells=cells)
        errors.append(error[:, smooth.all(0)])
        tried += _AT_ONCE
    error, single = np.concatenate(errors, axis=1), of_float32(case, _AT_ONCE, cells=cells)
    largest = error.max(axis=1, initial=0)
    return {
        "tried": tried,
        "smooth": error.shape[1],
        **{f"largest_by_{name}": float(largest[k]) for k, name in enumerate(("height", "stroke", "angle"))},
        "float64_median": float(np.median(error)) if error.size else None,
        "float32_median": float(np.median(single)),
        "float32_largest": float(single.max()),
    }
