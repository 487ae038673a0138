"""float64 is switched on for the laws and orders; what runs in float32 says so. Shapes never promote by accident."""

import gc
import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest

from jaxsand.relaxation import batching

jax.config.update("jax_enable_x64", True)
jax.config.update("jax_numpy_rank_promotion", "raise")
gc.set_threshold(100_000, 20, 20)  # tracing makes many objects, hardly any of them garbage

ANGLE = math.radians(29)
MU = math.tan(ANGLE)


def rough(seed: int, span: float, cells: int = 20) -> np.ndarray:
    """A smooth random surface of `cells` x `cells` from 0 to `span` (m)."""
    walk = np.cumsum(np.cumsum(np.random.default_rng(seed).normal(size=(cells, cells)), 0), 1)
    return span * (walk - walk.min()) / np.ptp(walk)


ROOM = 50_000  # of the 65,530 pieces of memory that Linux lets a process map, of which every program takes some
HURRY = {
    "xla_cpu_use_fusion_emitters": False,
    "xla_backend_optimization_level": 0,
    "xla_llvm_disable_expensive_passes": True,
    "xla_cpu_parallel_codegen_split_count": 1,
}
OLDER = {"xla_cpu_use_fusion_emitters": False}
WAYS = {"compiled": {}, "long": OLDER}
"""XLA's options by a test's marker. In a hurry programs are compiled six times as fast, and run two to four times as slowly; by
the older emitters alone they are compiled twice as fast, and run as fast, but for a few large derivatives and for what draws
many random numbers, which those take for ever to compile."""

GROUPS = batching.SIZES
ONE_SIZE = {min(GROUPS): 1.0}
"""In a hurry, maps are pushed in groups of one size, so that one program is compiled in place of three: the smallest, as so
compiled twice the maps take twice the time. What judges the groups themselves puts `GROUPS` back."""

KEPT_BY = "jax_pgle_profiling_runs"  # says nothing to a CPU, but is among what JAX keeps its programs by
_options: dict[str, Any] = {}


def _compile(way: dict[str, Any]) -> None:
    """From here on, programs are compiled so, and kept apart from others."""
    _options.clear()
    _options.update(way)
    jax.config.update(KEPT_BY, [HURRY, OLDER, {}].index(way))


def _hurry() -> None:
    """Lets `_options` govern how programs are compiled; where JAX has no such place any more, they are compiled as ever."""
    try:
        from jax._src import compiler

        usual = compiler.get_compile_options
    except (ImportError, AttributeError):
        return

    def with_options(*args: Any, **kwargs: Any) -> Any:
        options = usual(*args, **kwargs)
        options.env_option_overrides = [*options.env_option_overrides, *_options.items()]
        return options

    compiler.get_compile_options = with_options


_hurry()
_compile(HURRY)  # what modules compute when they are imported


def _way(item: pytest.Item) -> dict[str, Any]:
    return next((options for name, options in WAYS.items() if item.get_closest_marker(name)), HURRY)


def _hurried(item: pytest.Item) -> bool:
    """Whether this is the hurried one of two that are alike; where both are slow, and so compiled, the other is enough."""
    return hasattr(item, "callspec") and item.callspec.params.get("both_ways") == "hurried"


def pytest_configure(config: pytest.Config) -> None:
    """Workers take the files in their order, the long ones of `fuzz` early, not those of few tests last."""
    if hasattr(config.option, "loadscopereorder"):
        config.option.loadscopereorder = False


@pytest.fixture(scope="module", autouse=True)
def _little_to_look_through() -> None:
    """What earlier files left, compiled programs above all, is no garbage, and need not be looked through for it again."""
    gc.collect()
    gc.freeze()


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    items[:] = [item for item in items if not (_hurried(item) and item.get_closest_marker("slow"))]


def pytest_runtest_setup(item: pytest.Item) -> None:
    """Compiled programs are kept for later tests, apart for each way of compiling, and not without end."""
    maps = Path("/proc/self/maps")
    if maps.exists() and maps.read_bytes().count(b"\n") > ROOM:
        jax.clear_caches()
    way = _way(item)
    _compile(way)
    batching.SIZES = ONE_SIZE if way is HURRY else GROUPS


def turned(stroke: Sequence[float], side: float) -> list[tuple[Callable, tuple[float, ...]]]:
    """Mirrors and quarter turns of a square map, each with what it makes of a stroke."""
    x0, y0, x1, y1 = stroke
    return [
        (np.fliplr, (side - x0, y0, side - x1, y1)),
        (np.flipud, (x0, side - y0, x1, side - y1)),
        (np.transpose, (y0, x0, y1, x1)),
        (np.rot90, (y0, side - x0, y1, side - x1)),
    ]


def padded(path: Sequence[Any], points: int) -> np.ndarray:
    """The path with its end repeated, which changes nothing: paths of as many points are one program."""
    return np.concatenate([path, np.repeat(np.asarray(path)[-1:], points - len(path), axis=0)])


@pytest.fixture(params=["float32", pytest.param("float64", marks=pytest.mark.slow)])
def dtype(request: pytest.FixtureRequest) -> str:
    return request.param


@pytest.fixture(params=["hurried", pytest.param("compiled", marks=[pytest.mark.slow, pytest.mark.compiled])])
def both_ways(request: pytest.FixtureRequest) -> str:
    """By default a test runs in a hurry, and among the slow ones again, compiled as users do."""
    return request.param
