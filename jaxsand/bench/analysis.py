"""The analysis of arXiv:1908.02745 once more: sweeps against flow rate and resolution, and what looking only where sand
moves could save."""

import math
import os
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxsand.bench.rivals.plain import settle_numpy
from jaxsand.bench.tables import Row
from jaxsand.bench.timing import seconds_of, timed
from jaxsand.bench.work_precision import COLUMN, RIDGE, distance, trench
from jaxsand.relaxation.flux import WholeCells
from jaxsand.relaxation.ghost_cells import at, halo, largest, prepare, quantum
from jaxsand.relaxation.schemes import Relaxation
from jaxsand.relaxation.settling import relax, settle, settle_batch
from jaxsand.relaxation.stopping import UntilStill
from jaxsand.relaxation.sweep import Flow, Swept, sweep
from jaxsand.scene.progress import Tell, quiet
from jaxsand.scene.scene import Scene, make_scene

_ANGLE = math.radians(29)
_BOUND = 4000
_RATES = (0.04, 0.06, 0.08, 0.1, 0.125, 1 / 6.83, 0.16, 0.18, 0.2, 1 / 4.83, 0.22, 0.25)


def sweeps_against_rate(n: int = 32) -> list[Row]:
    """Sweeps to stillness (slope tolerance 1e-2) of the paper's sweep at flow rates k = rate dx^2 (dx in one dimension), in
    float64 and beyond the stable range too: None where it never comes to rest."""
    rows = []
    with jax.enable_x64(True):
        for dimensions, height, rates in (
            (1, 8 * RIDGE.heights(n), np.append(np.linspace(0.05, 0.55, 11), [0.6, 0.7, 0.8])),
            (
                2,
                4 * COLUMN.heights(n),
                np.array(_RATES),
            ),
        ):
            scene = make_scene((height.shape[0], height.shape[1]), 1.0, _ANGLE)
            h = jnp.asarray(height, jnp.float64)
            run = jax.jit(lambda rate, h=h, scene=scene: relax(scene, h, Relaxation(rate), UntilStill(1e-2, _BOUND, 1)))
            for rate in rates:
                settled = run(jnp.float64(rate))
                still = int(settled.outcome) == 0
                rows.append(
                    {"dimensions": dimensions, "rate": float(rate), "sweeps": int(settled.sweeps) if still else None}
                )
    return rows


def sweeps_against_resolution(sides: tuple[int, ...] = (32, 64, 96, 128, 160)) -> list[Row]:
    """Sweeps of the paper's sweep at k = dx^2 / 8 for one trench on ever finer grids, for several tolerances."""
    rows = []
    for n in sides:
        scene, h = make_scene((n, n), 1.0, _ANGLE), jnp.asarray(trench(n), jnp.float32)
        row: Row = {"cells": n}
        for tolerance in (0.1, 0.03, 0.01, 1e-3):
            settled = settle(scene, h, scheme=Relaxation(), stop=UntilStill(tolerance, interval=1))
            row[f"tolerance {tolerance:g}"] = int(settled.sweeps)
        rows.append(row)
    return rows


def activity(n: int = 160, sweeps: int = 1000) -> Row:
    """Cells that a sweep of the trench would have to visit: all, those in the box around what moves, those that move."""
    scene = make_scene((n, n), 1.0, _ANGLE)
    bed, h = prepare(scene), jnp.asarray(trench(n), jnp.float32)
    flow = Flow(jnp.float32(0.125), quantum(largest(h)))

    def one(u: jax.Array, _: Any) -> tuple[jax.Array, tuple[jax.Array, jax.Array]]:
        after = sweep(bed, flow, WholeCells(), Swept(u, None)).height
        moved = jnp.abs(at(after) - at(u)) > 1e-3 * bed.drop
        sides = [jnp.any(moved, axis=axis) for axis in (0, 1)]
        spans = [jnp.max(jnp.where(s, jnp.arange(n), -1)) - jnp.min(jnp.where(s, jnp.arange(n), n)) + 3 for s in sides]
        box = jnp.where(jnp.any(moved), spans[0] * spans[1], 0)
        return after, (box, jnp.sum(moved))

    _, (boxes, cells) = jax.lax.scan(one, halo(h), None, length=sweeps)
    busy = int(np.sum(np.asarray(cells) > 0))
    return {
        "cells": n,
        "sweeps": busy,
        "box_share": float(np.asarray(boxes, float)[:busy].mean() / n**2),
        "moving_share": float(np.asarray(cells, float)[:busy].mean() / n**2),
    }


def chunks(scene: Scene, heights: jax.Array, tell: Tell = quiet) -> list[Row]:
    """Maps a second of `settle_batch` by the size of a chunk, called from one thread and from one for each core, and with a
    tall column in one map of every 256 (`with_slow`; `sweeps` is then the largest number of sweeps, and the mean)."""
    high, wide = heights.shape[1:]
    middle = jnp.s_[high // 2 - 3 : high // 2 + 3, wide // 2 - 3 : wide // 2 + 3]
    slow = heights.at[(slice(None, None, 256), *middle)].add(100 * scene.grid.spacing)
    rows: list[Row] = []
    for chunk in (8, 32, 64, 128, 256):
        tell(f"chunks of {chunk}")
        many = len(heights)

        def rate(maps: jax.Array, chunk: int = chunk) -> float:
            return len(maps) / timed(partial(settle_batch, scene, maps, chunk=chunk), 5).best

        row = {"name": f"chunks of {chunk}", "maps_per_second": rate(heights), "with_slow": rate(slow)}
        with _one_core():
            row["one_thread"] = rate(heights)
        rows.append(row)
    sweeps = settle_batch(scene, slow).sweeps
    for row in rows:
        row |= {"largest_sweeps": int(sweeps.max()), "mean_sweeps": float(sweeps.sum()) / many}
    return rows


@contextmanager
def _one_core() -> Iterator[None]:
    """Batches see one core; where a process cannot say where it runs, nothing changes."""
    if not hasattr(os, "sched_setaffinity"):
        yield
        return
    here = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {min(here)})
    try:
        yield
    finally:
        os.sched_setaffinity(0, here)


def peer(batch: int = 256, tell: Tell = quiet) -> list[Row]:
    """60 x 30 cells of 10 mm, a block of 20 x 10 cells and 40 mm, 30 degrees: the case on which an open-source sand-shaping
    gym reports 671 iterations and 0.33 s in numpy."""
    tell("the peer's case")
    scene = make_scene((60, 30), 0.01, math.radians(30))
    h = np.zeros((60, 30), np.float32)
    h[20:40, 10:20] = 0.04
    with jax.enable_x64(True):
        exact = settle(scene, jnp.asarray(h, jnp.float64), scheme=Relaxation(1 / 64), stop=UntilStill(1e-6, 400_000, 64))
        end = np.asarray(exact.height)
    seconds, (plain, sweeps) = seconds_of(partial(settle_numpy, h, 0.01, math.tan(math.radians(30))))
    rows: list[Row] = [
        {"name": "numpy, paper's sweep", "sweeps": sweeps, "seconds": seconds, "error": distance(plain, end, h)}
    ]
    maps = jnp.broadcast_to(jnp.asarray(h), (batch, 60, 30))
    for name, scheme in (("settle_batch, paper's sweep", Relaxation()), ("settle_batch", None)):
        took = timed(partial(settle_batch, scene, maps, scheme=scheme), 5)
        settled = took.result
        rows.append(
            {
                "name": name,
                "sweeps": int(settled.sweeps[0]),
                "seconds": took.best / batch,
                "error": distance(np.asarray(settled.height[0], float), end, h),
            }
        )
    for row in rows:
        row["times_numpy"] = seconds / row["seconds"]
        row["times_reported"] = 0.33 / row["seconds"]
    return rows
