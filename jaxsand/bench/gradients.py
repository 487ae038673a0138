"""What gradients cost and how right they are: by height, stroke and angle of repose, beside the forward run."""

import math
import time
from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxsand.bench.gradient_checks import (
    SPACING,
    GradientCase,
    Inputs,
    against_differences,
    differentiated,
    inputs,
    of_float32,
    program,
    relative,
    sloped,
)
from jaxsand.bench.tables import Row
from jaxsand.bench.timing import race
from jaxsand.interaction.stepped import SteppedPush
from jaxsand.planning.stroke_loss import GRADIENT, sand_loss
from jaxsand.relaxation.stopping import Stop, Sweeps, UntilStill
from jaxsand.scene.progress import Tell, quiet
from jaxsand.scene.scene import cast, make_scene
from jaxsand.scene.tools import Blade
from jaxsand.scene.window import Window

STOPS: tuple[Stop, ...] = (*(UntilStill(t) for t in (0.1, 0.03, 0.01, 1e-3, 1e-4)), *(Sweeps(n) for n in (16, 64, 256)))
_ROUNDS = 3
_CACHED = 16 * 32 * 32  # cells
CASES = (
    *(GradientCase(pushes, neighbours) for pushes in (False, True) for neighbours in (4, 8, "isotropic")),
    *(GradientCase(pushes, window=Window((16, 16))) for pushes in (False, True)),
    GradientCase(False, stop=Sweeps(1000)),
)


def bench_grad(
    tell: Tell = quiet,
    larger: int | None = None,
    cases: tuple[GradientCase, ...] = CASES,
    stops: tuple[Stop, ...] = STOPS,
    plans: tuple[int, ...] = (4, 16, 64),
    cells: int = 32,
    batch: int = 64,
    rounds: int = _ROUNDS,
) -> dict[str, list[Row]]:
    """Costs, errors, errors against run time when settling stops early, and what strokeloss.GRADIENT
    stands for, on `batch` maps of `cells` a side. With `larger`, costs also on so many of these, and on a 64th as many of
    160 x 160."""
    sizes = ((cells, batch),) + (((cells, larger), (160, max(1, larger // 64))) if larger else ())
    early = tuple(case for case in cases if case in (GradientCase(False), GradientCase(True)))
    return {
        "gradient_cost": costs(tell, cases, sizes, rounds),
        "gradient_of_plans": multiples(tell, plans, cells=cells, rounds=rounds),
        "gradient_stopped_early": stopped_early(tell, early, stops, cells, batch, rounds),
        "gradient_error": accuracy(tell, cases, batch, cells),
    }


def costs(
    tell: Tell, cases: tuple[GradientCase, ...], sizes: tuple[tuple[int, int], ...], rounds: int = _ROUNDS
) -> list[Row]:
    """Run times of the gradient and of the forward run (best of a few, in turns) for maps of so many cells a side, in
    batches of so many, float32, as many at a time as have 16,384 cells together, so that they stay in a core's cache. And
    the memory that the gradient needs beyond the forward run's, in bytes for each cell of the maps that run together, and
    for each of these and each of the sweeps that were taken (by the slowest map) or that the stop rule allows."""
    rows = []
    for cells, batch in sizes:
        together = min(batch, max(1, _CACHED // cells**2))
        for case in cases:
            tell(f"cost: {case.name}, {batch} maps of {cells} x {cells}")
            given = inputs(case, cells, batch)
            x = cast(given, jnp.float32)
            run = program(case, cells)
            forward, gradient = _compiled(_together(run, together), x), _compiled(_together(sloped(run), together), x)
            timed = race({"forward": partial(forward[0], *x), "gradient": partial(gradient[0], *x)}, rounds)
            taken, allowed = _sweeps(case, cells, given[1], int(jnp.max(forward[0](*x)[1])))
            more = (gradient[2] - forward[2]) / (together * cells**2)
            rows.append(
                {
                    "name": case.name,
                    "cells": cells,
                    "batch": batch,
                    "together": together,
                    "forward_seconds": timed["forward"].best,
                    "gradient_seconds": timed["gradient"].best,
                    "gradient_over_forward": timed["gradient"].best / timed["forward"].best,
                    "forward_compile_seconds": forward[1],
                    "gradient_compile_seconds": gradient[1],
                    "sweeps": taken,
                    "bytes_per_cell": more,
                    "bytes_per_cell_and_sweep": more / max(1, taken),
                    "bytes_per_cell_and_sweep_allowed": more / allowed,
                }
            )
    return rows


def _together(run: Callable[..., Any], count: int) -> Callable[..., Any]:
    """`run` of a batch, so many at a time."""
    return lambda *x: jax.lax.map(lambda one: run(*one), x, batch_size=count)


def _compiled(run: Callable[..., Any], x: Inputs) -> tuple[Any, float, int]:
    """The program, the seconds that compiling it took, and the bytes it holds for itself while it runs."""
    began = time.perf_counter()
    compiled = jax.jit(run).lower(*x).compile()
    return compiled, time.perf_counter() - began, getattr(compiled.memory_analysis(), "temp_size_in_bytes", 0)


def _sweeps(case: GradientCase, cells: int, strokes: np.ndarray, settling: int) -> tuple[int, int]:
    """Sweeps of the slowest map, and the largest number that the rules allow; those of a push included."""
    stop = UntilStill() if case.stop is None else case.stop
    taken, allowed = settling, stop.count if isinstance(stop, Sweeps) else stop.bound
    if case.pushes:
        push, longest = SteppedPush(), float(np.hypot(*(strokes[:, 2:] - strokes[:, :2]).T).max()) / SPACING
        lowering = math.ceil(push.sweeps / push.substep)
        taken += lowering + math.ceil(longest / push.substep) * push.sweeps
        allowed += lowering + math.ceil((2 * math.hypot(cells, cells) + 3) / push.substep) * push.sweeps
    return taken, allowed


def accuracy(tell: Tell, cases: tuple[GradientCase, ...], points: int, cells: int) -> list[Row]:
    """Errors over the gradient's norm: of float64 by each input against central differences where the points are smooth (see
    gradient_checks.py), of which `smooth` is the share, and of float32 against float64."""
    rows = []
    for case in cases:
        tell(f"error: {case.name}")
        error, smooth = against_differences(case, points, cells=cells)
        single = of_float32(case, points, cells=cells)
        row: Row = {"name": case.name, "points": points, "smooth": float(smooth.mean())}
        for k, name in enumerate(("height", "stroke", "angle")):
            row[f"largest_by_{name}"] = float(error[k][smooth[k]].max(initial=0))
        row["float64_median"] = float(np.median(error[smooth])) if smooth.any() else None
        row["float32_median"], row["float32_largest"] = float(np.median(single)), float(single.max())
        rows.append(row)
    return rows


def stopped_early(
    tell: Tell, cases: tuple[GradientCase, ...], stops: tuple[Stop, ...], cells: int, batch: int, rounds: int = _ROUNDS
) -> list[Row]:
    """Run times of the gradient in float32 when settling stops early, and its error over its norm, against that in float64
    with a tolerance of 1e-5."""
    rows = []
    for case in cases:
        given, run = inputs(case, cells, batch), program(case, cells)
        tell(f"stopped early: {case.name}, the limit")
        with jax.enable_x64(True):
            x = cast(given, jnp.float64)
            _, limit = _stopping(run, UntilStill(1e-5), x)[0]()
            limit = tuple(np.asarray(g) for g in limit)
        x = cast(given, jnp.float32)
        for stop in stops:
            name = f"{stop.count} sweeps" if isinstance(stop, Sweeps) else f"tolerance {stop.tolerance:g}"
            tell(f"stopped early: {case.name}, {name}")
            gradient, forward = _stopping(run, stop, x)
            (_, sweeps), found = gradient()
            timed = race({"forward": forward, "gradient": gradient}, rounds)
            error = relative(found, limit)
            rows.append(
                {
                    "name": case.name,
                    "stop": name,
                    "sweeps": float(np.mean(sweeps)),
                    "forward_seconds": timed["forward"].best,
                    "gradient_seconds": timed["gradient"].best,
                    "error_median": float(np.median(error)),
                    "error_largest": float(error.max()),
                }
            )
    return rows


def _stopping(run: Callable[..., Any], stop: Stop, x: Inputs) -> tuple[Callable[..., Any], Callable[..., Any]]:
    """The gradient and the forward run with a stop rule."""

    def stopped(height: Any, stroke: Any, angle: Any) -> Any:
        return run(height, stroke, angle, stop)

    gradient, forward = jax.jit(differentiated(stopped)), jax.jit(jax.vmap(stopped))
    return lambda: gradient(*x), lambda: forward(*x)


def multiples(tell: Tell, plans: tuple[int, ...], strokes: int = 3, cells: int = 32, rounds: int = _ROUNDS) -> list[Row]:
    """Times the way forward that the way back takes in `SandLoss.gradient`, for plans of random strokes on level sand; best
    of a few. `counted` is what a search is charged for it."""
    level = np.zeros((cells, cells), np.float32)
    loss = sand_loss(make_scene(level.shape, SPACING, tool=Blade()), level, level)
    rows = []
    for count in plans:
        tell(f"{count} plans of {strokes} strokes")
        some = np.random.default_rng(0).uniform(0.2, 0.8, (count, strokes, 4)) * cells * SPACING
        forward = backward = math.inf
        for turn in range(rounds + 1):
            middle = 0.0

            def weigh(difference: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
                nonlocal middle
                middle = time.perf_counter()
                return (difference**2).sum((-2, -1)), 2 * difference

            began = time.perf_counter()
            loss.gradient(some, weigh)
            ended = time.perf_counter()
            if turn:
                forward, backward = min(forward, middle - began), min(backward, ended - middle)
        rows.append(
            {
                "plans": count,
                "strokes": strokes,
                "forward_seconds": forward,
                "backward_seconds": backward,
                "backward_over_forward": backward / forward,
                "counted": GRADIENT,
            }
        )
    return rows
