"""How fast: jaxsand side by side with the same algorithm in plain numpy and in a plain C loop, in one run.

Every time is the best of several runs; rivals take turns, so that a busy moment hits all of them. Compile time is the first
call less a later one.
"""

import math
import os
import platform
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxsand.plain import compile_c, settle_numpy
from jaxsand.scene import Scene, make_scene
from jaxsand.settling import Sweeps, settle, settle_batch
from jaxsand.sim import act, step, step_batch
from jaxsand.tool import Blade
from jaxsand.window import Window

Tell = Callable[[str], None]
_CELLS = 32
_SPACING = 0.01
_ANGLE = math.radians(29)
_ROUNDS = 5


def bench(what: str, batch: int = 4096, tell: Tell = lambda _: None) -> dict[str, Any]:
    """The figures for `what`: settle, push or all, on maps of 32 x 32 cells."""
    report: dict[str, Any] = {"machine": _machine(), "batch": batch, "map": [_CELLS, _CELLS]}
    if what in ("settle", "all"):
        report["settle"] = bench_settle(batch, tell)
    if what in ("push", "all"):
        report["push"] = bench_push(max(1, batch // 4), tell)
    return report


def bench_settle(batch: int, tell: Tell = lambda _: None, sample: int = 16, fixed: int = 64) -> list[dict[str, Any]]:
    """Settling maps in which a random push has just ended."""
    scene, heights = _pushed(batch)
    host = np.asarray(heights)
    cores = _cores()
    mu = math.tan(_ANGLE)
    rows: list[dict[str, Any]] = []
    device = jax.default_backend()
    ways: dict[str, tuple[Callable[[], Any], int, int]] = {  # the call, its maps, its cores
        f"settle_batch, {device}": (lambda: settle_batch(scene, heights).sweeps, batch, cores),
        f"vmap(settle), {device}": (lambda: vmapped(heights), batch, cores),
        f"settle_batch, {fixed} sweeps": (lambda: settle_batch(scene, heights, stop=Sweeps(fixed)).sweeps, batch, cores),
        "numpy, one map at a time": (lambda: np.array([settle_numpy(h, _SPACING, mu)[1] for h in host[:sample]]), sample, 1),
    }
    vmapped = jax.jit(jax.vmap(lambda h: settle(scene, h).sweeps))
    settle_c = compile_c()
    if settle_c is not None:
        c: Callable = settle_c

        def threads(n: int, **rule: Any) -> np.ndarray:
            parts = np.array_split(host.copy(), n)
            with ThreadPoolExecutor(n) as pool:
                return np.concatenate(list(pool.map(lambda part: c(part, _SPACING, mu, **rule), parts)))

        ways["C loop, one core"] = (lambda: threads(1), batch, 1)
        ways[f"C loop, {fixed} sweeps"] = (lambda: threads(1, tolerance=-1.0, bound=fixed), batch, 1)
        if cores > 1:
            ways[f"C loop, {cores} cores"] = (lambda: threads(cores), batch, cores)
    for name, (seconds, first, sweeps) in _race({n: w[0] for n, w in ways.items()}, tell).items():
        maps, used = ways[name][1:]
        work = float(np.sum(np.broadcast_to(sweeps, (maps,)))) * _CELLS**2
        rows.append(
            {
                "name": name,
                "maps_per_second": maps / seconds,
                "ns_per_cell_sweep": seconds / work * 1e9,
                "core_ns_per_cell_sweep": seconds * used / work * 1e9,
                "sweeps": float(np.mean(sweeps)),
                "seconds": seconds,
                "compile_seconds": max(0.0, first - seconds),
            }
        )
    _compare(rows, "numpy, one map at a time", "maps_per_second", "times_numpy")
    _compare(rows, "C loop, one core", "core_ns_per_cell_sweep", "speed_per_core_against_c", inverse=True)
    return rows


def bench_push(batch: int, tell: Tell = lambda _: None) -> list[dict[str, Any]]:
    """Random pushes of the default blade on level sand, with and without settling afterwards."""
    scene = make_scene((_CELLS, _CELLS), _SPACING, _ANGLE, tool=Blade())
    near = make_scene((_CELLS, _CELLS), _SPACING, _ANGLE, tool=Blade(), window=Window((16, 16)))
    level, strokes = jnp.zeros((batch, _CELLS, _CELLS), jnp.float32), _strokes(batch)
    act_all = jax.jit(jax.vmap(lambda s: act(scene, level[0], s).height))
    one = jax.jit(lambda s: step(scene, level[0], s).height)
    ways = {
        "step_batch": (lambda: step_batch(scene, level, strokes).height, batch),
        "step_batch, window 16 x 16": (lambda: step_batch(near, level, strokes).height, batch),
        "vmap(act), not settled": (lambda: act_all(strokes), batch),
        "step, one map at a time": (lambda: [one(s).block_until_ready() for s in strokes[:16]], 16),
    }
    rows = []
    for name, (seconds, first, _) in _race({n: w[0] for n, w in ways.items()}, tell).items():
        maps = ways[name][1]
        rows.append(
            {
                "name": name,
                "pushes_per_second": maps / seconds,
                "seconds": seconds,
                "compile_seconds": max(0.0, first - seconds),
            }
        )
    return rows


def table(report: dict[str, Any]) -> str:
    """The report as text."""
    lines = [f"{report['machine']}; {report['batch']} maps of {_CELLS} x {_CELLS}, float32"]
    for what in ("settle", "push"):
        rows = report.get(what)
        if not rows:
            continue
        names = [n for n in dict.fromkeys(n for row in rows for n in row) if n != "name"]
        lines.append("")
        lines.append(f"{what:28s}" + "".join(f"{n.replace('_', ' '):>26s}" for n in names))
        lines += [f"{row['name']:28s}" + "".join(f"{row.get(n, math.nan):26.4g}" for n in names) for row in rows]
    return "\n".join(lines)


def _race(ways: dict[str, Callable[[], Any]], tell: Tell) -> dict[str, tuple[float, float, Any]]:
    """Best time, first time and result of each way, in turns."""
    first, best, result = {}, dict.fromkeys(ways, math.inf), {}
    for name, way in ways.items():
        tell(f"first call: {name}")
        began = time.perf_counter()
        result[name] = jax.block_until_ready(way())
        first[name] = time.perf_counter() - began
    for turn in range(_ROUNDS):
        for name, way in ways.items():
            tell(f"round {turn + 1} of {_ROUNDS}: {name}")
            began = time.perf_counter()
            jax.block_until_ready(way())
            best[name] = min(best[name], time.perf_counter() - began)
    return {name: (best[name], first[name], np.asarray(result[name])) for name in ways}


def _compare(rows: list[dict[str, Any]], rival: str, figure: str, name: str, *, inverse: bool = False) -> None:
    """Adds to every row how many times better its figure is than the rival's."""
    base = next((row[figure] for row in rows if row["name"] == rival), None)
    if base is not None:
        for row in rows:
            row[name] = base / row[figure] if inverse else row[figure] / base


def _pushed(batch: int) -> tuple[Scene, jax.Array]:
    scene = make_scene((_CELLS, _CELLS), _SPACING, _ANGLE, tool=Blade())
    level = jnp.zeros((_CELLS, _CELLS), jnp.float32)
    pushed = jax.jit(lambda s: jax.lax.map(lambda one: act(scene, level, one).height, s, batch_size=64))(_strokes(batch))
    return make_scene((_CELLS, _CELLS), _SPACING, _ANGLE), jax.block_until_ready(pushed)


def _strokes(batch: int) -> jax.Array:
    """Random strokes between points of the middle four fifths of the map (m)."""
    side = _CELLS * _SPACING
    return jax.random.uniform(jax.random.key(0), (batch, 4), jnp.float32, minval=0.1 * side, maxval=0.9 * side)


def _cores() -> int:
    if jax.default_backend() != "cpu":
        return 1
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _machine() -> str:
    """The processor and the versions that the figures hold for."""
    name = platform.processor() or platform.machine()
    try:
        with open("/proc/cpuinfo", encoding="utf-8") as file:
            name = next(line.partition(":")[2].strip() for line in file if line.startswith("model name"))
    except (OSError, StopIteration):
        pass
    device = jax.devices()[0].device_kind
    return f"{name}, {os.cpu_count()} cores, device {device}, jax {jax.__version__}, Python {platform.python_version()}"
