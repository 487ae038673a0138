"""How fast: jaxsand side by side with the same algorithm in plain numpy and in a plain C loop, in one run.

Every time is the best of several runs; rivals take turns, so that a busy moment hits all of them. Compile time is the first
call less a later one.
"""

import math
import platform
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxsand.bench import (
    analysis,
    calibration,
    complexity,
    envs,
    expansions,
    gradients,
    piles,
    pushes,
    ramps,
    sand,
    speed,
    stability,
    tasks,
    tools,
    trenches,
    work_precision,
)
from jaxsand.bench import strokes as strokebench
from jaxsand.bench.letters import bench_letters
from jaxsand.bench.rivals.plain import compile_c, settle_numpy
from jaxsand.bench.tables import Row, as_table
from jaxsand.bench.timing import race
from jaxsand.goals.usual import usual_scene
from jaxsand.interaction.simulate import act
from jaxsand.relaxation.batching import cores, processors
from jaxsand.relaxation.schemes import Relaxation, SuperTimeStepping
from jaxsand.relaxation.settling import Settled, settle, settle_batch
from jaxsand.relaxation.stopping import Sweeps, UntilStill
from jaxsand.scene.progress import Tell, quiet
from jaxsand.scene.scene import Scene

_CELLS = 32
_SPACING = 0.01
_ANGLE = math.radians(29)
_NUMPY = "numpy, one map at a time"
_C = "C loop, one core"


def bench(
    what: str,
    batch: int | None = None,
    tell: Tell = quiet,
    grids: int = 3,
    seed: int = 0,
    **options: Any,
) -> Row:
    """The figures for `what`: settle, push, plan, or all of these; env, grad, calibrate, sand, strokes, trench,
    stability, letters, ramp, tasks, tools, or speed.

    Speed is measured on maps of 32 x 32 cells; error against run time on `grids` grids of every scene (0 leaves it out).
    `batch` is 4096, for env 1024, for grad 64, for tools 16, unless given. `options` are those of
    `strokebench.bench_strokes`, of `tasks.bench_tasks`, or of `tools.bench_tools`.
    """
    larger, batch = batch, batch or {"grad": 64, "env": 1024, "tools": 16}.get(what, 4096)
    report: Row = {"machine": _machine(), "batch": batch, "map": [_CELLS, _CELLS]}
    if what in ("settle", "all"):
        report["settle"] = bench_settle(batch, tell)
        report["chunks"] = analysis.chunks(*_pushed(batch), tell)
        report["peer"] = analysis.peer(max(1, batch // 16), tell)
        if grids:
            report["reference"] = work_precision.reference_check(tell)
            report["work_precision"] = work_precision.work_precision(work_precision.ALL, tell, grids)
            report["time_to_1_percent"] = work_precision.time_to(report["work_precision"])
            report["growth"] = work_precision.growth(report["time_to_1_percent"])
            report["sweeps_by_rate"] = analysis.sweeps_against_rate()
            report["sweeps_by_resolution"] = analysis.sweeps_against_resolution()
            report["activity"] = [analysis.activity()]
            report["piles"] = piles.piles(tell, grids + 1)
    if what in ("push", "all"):
        report["push"] = pushes.push_speed(max(1, batch // 4), tell)
        if grids:
            report["push_precision"] = pushes.push_precision(max(1, batch // 256), tell)
            report["push_heaps"] = pushes.heaps(tell=tell) + pushes.heaps((10, 5, 2.5), tell=tell, neighbours="isotropic")
            report["push_in_parts"] = pushes.in_parts(tell)
            report["push_by_spacing"] = pushes.push_against_spacing(tell)
            report["push_by_heading"] = pushes.push_by_heading(tell)
            report["push_continuity"] = pushes.push_continuity(tell=tell)
            report["push_long_path"] = pushes.long_path(tell=tell)
    if what in ("plan", "all"):
        report |= complexity.planning(tell)
        report["expansions"] = expansions.rows_of_expansions(tell)
    if what == "grad":
        report |= gradients.bench_grad(tell, larger)
    if what == "sand":
        report["children"] = sand.children_per_second()
        report["sand"] = sand.bench_sand(tell, seed=seed)
    if what == "calibrate":
        report["calibrate"] = calibration.bench_calibrate(tell)
        report["calibrate_cone"] = calibration.bench_cone(tell)
    if what == "trench":
        report["trench_by_spacing"] = trenches.against_spacing(tell, grids + 1)
        report["trench_settles"] = trenches.settling(tell)
    others: dict[str, Callable[[], Row]] = {
        "env": lambda: {"env": envs.bench_env(batch, tell)},
        "stability": lambda: {"stability": stability.stability(tell=tell)},
        "speed": lambda: {"speed": speed.bench_speed(tell)},
        "letters": lambda: {"letters": bench_letters(tell)},
        "ramp": lambda: ramps.bench_ramps(tell, seed=seed),
        "tasks": lambda: tasks.bench_tasks(tell, seed=seed, **options),
        "tools": lambda: tools.bench_tools(tell, batch=batch, **options),
        "strokes": lambda: strokebench.bench_strokes(tell, **options),
    }
    return report | others[what]() if what in others else report


@dataclass(frozen=True)
class Settler:
    """One way to do the job: `call` returns the sweeps of each of its `maps` (or None) and some of the maps it made."""

    call: Callable[[], tuple[Any, Any]]
    maps: int
    cores: int = 1


def bench_settle(batch: int, tell: Tell = quiet, sample: int = 16, fixed: int = 64) -> list[Row]:
    """Settling maps in which a random push has just ended.

    `error` is the largest distance, over the first maps, of the settled map from the limit of small steps (float64, rate
    1/64, tolerance 1e-6), divided by the largest change of height. numpy and C run the paper's sweep at rate 1/8.
    """
    scene, heights = _pushed(batch)
    host = np.asarray(heights)
    sample = min(sample, batch)
    count = cores()
    mu = math.tan(_ANGLE)
    vmapped = jax.jit(jax.vmap(partial(settle, scene)))

    def ours(settled: Settled) -> tuple[Any, Any]:
        return settled.sweeps, settled.height[:sample]

    def plain() -> tuple[Any, Any]:
        maps, sweeps = zip(*(settle_numpy(h, _SPACING, mu) for h in host[:sample]), strict=True)
        return np.array(sweeps), np.stack(maps)

    ways = {
        "settle_batch": Settler(lambda: ours(settle_batch(scene, heights)), batch, count),
        "settle_batch, tolerance 1e-2": Settler(
            lambda: ours(settle_batch(scene, heights, stop=UntilStill(1e-2))), batch, count
        ),
        "settle_batch, growth 0.8": Settler(
            lambda: ours(settle_batch(scene, heights, scheme=SuperTimeStepping(0.8))), batch, count
        ),
        "settle_batch, growth 0.8, first 1/16": Settler(
            lambda: ours(settle_batch(scene, heights, scheme=SuperTimeStepping(0.8, 1 / 16))), batch, count
        ),
        "settle_batch, paper's sweep": Settler(
            lambda: ours(settle_batch(scene, heights, scheme=Relaxation())), batch, count
        ),
        f"settle_batch, {fixed} of the paper's sweeps": Settler(
            lambda: ours(settle_batch(scene, heights, scheme=Relaxation(), stop=Sweeps(fixed))), batch, count
        ),
        "vmap(settle)": Settler(lambda: ours(vmapped(heights)), batch, count),
        _NUMPY: Settler(plain, sample),
    }
    settle_c = compile_c()
    if settle_c is not None:
        c: Callable[..., Any] = settle_c

        def threads(n: int, **rule: Any) -> tuple[Any, Any]:
            parts = np.array_split(host.copy(), n)
            with ThreadPoolExecutor(n) as pool:
                sweeps = np.concatenate(list(pool.map(lambda part: c(part, _SPACING, mu, **rule), parts)))
            return sweeps, np.concatenate(parts)[:sample]

        ways[_C] = Settler(lambda: threads(1), batch)
        ways[f"C loop, {fixed} sweeps"] = Settler(lambda: threads(1, tolerance=-1.0, bound=fixed), batch)
        if count > 1:
            ways[f"C loop, {count} cores"] = Settler(lambda: threads(count), batch, count)
    small = partial(settle_numpy, rate=1 / 64, tolerance=1e-6)
    limit = np.stack([small(h.astype(float), _SPACING, mu)[0] for h in host[:sample]])
    largest = np.abs(limit - host[:sample]).max()
    rows = []
    for name, timed in race({name: way.call for name, way in ways.items()}, tell=tell).items():
        way, seconds, (sweeps, maps) = ways[name], timed.best, timed.result
        work = float(np.sum(np.broadcast_to(sweeps, (way.maps,)))) * _CELLS**2
        rows.append(
            {
                "name": name,
                "error": float(np.abs(np.asarray(maps, float) - limit).max() / largest),
                "maps_per_second": way.maps / seconds,
                "ns_per_cell_sweep": seconds / work * 1e9,
                "core_ns_per_cell_sweep": seconds * way.cores / work * 1e9,
                "sweeps": float(np.mean(sweeps)),
                "seconds": seconds,
                "compile_seconds": timed.compile_seconds,
            }
        )
    _compare(rows, _NUMPY, "maps_per_second", "times_numpy")
    _compare(rows, _C, "core_ns_per_cell_sweep", "speed_per_core_against_c", inverse=True)
    return rows


def table(report: Row) -> str:
    """The report as text."""
    lines = [report["machine"], f"{report['batch']} maps of {_CELLS} x {_CELLS}, float32"]
    for what, rows in report.items():
        if (
            isinstance(rows, list)
            and rows
            and what not in ("map", "work_precision", "strokes_curves", "ramp_maps", "tasks_maps")
        ):
            lines += ["", *as_table(rows, what.replace("_", " "))]
    return "\n".join(lines)


def _compare(rows: list[Row], rival: str, figure: str, name: str, *, inverse: bool = False) -> None:
    """Adds to every row how many times better its figure is than the rival's."""
    base = next((row[figure] for row in rows if row["name"] == rival), None)
    if base is not None:
        for row in rows:
            row[name] = base / row[figure] if inverse else row[figure] / base


def _pushed(batch: int) -> tuple[Scene, jax.Array]:
    scene = usual_scene()
    level = jnp.zeros((_CELLS, _CELLS), jnp.float32)
    pushed = jax.jit(lambda s: jax.lax.map(lambda one: act(scene, level, one).height, s, batch_size=64))(
        pushes.random_strokes(batch)
    )
    return usual_scene(tool=None), jax.block_until_ready(pushed)


def _machine() -> str:
    """The processor, how many of its cores were to be used, and the versions that the figures hold for."""
    name = platform.processor() or platform.machine()
    try:
        with open("/proc/cpuinfo", encoding="utf-8") as file:
            name = next(line.partition(":")[2].strip() for line in file if line.startswith("model name"))
    except (OSError, StopIteration):
        pass
    device = jax.devices()[0].device_kind
    count = processors()
    used = f"{count} core{'s' * (count > 1)}"
    return f"{name}, {used}, device {device}, jax {jax.__version__}, Python {platform.python_version()}"
