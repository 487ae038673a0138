"""float64 is switched on for the laws and orders; what runs in float32 says so. Shapes never promote by accident."""

import math
from collections.abc import Callable, Iterator, Sequence

import jax
import numpy as np
import pytest

jax.config.update("jax_enable_x64", True)
jax.config.update("jax_numpy_rank_promotion", "raise")

ANGLE = math.radians(29)
MU = math.tan(ANGLE)


@pytest.fixture(autouse=True, scope="module")
def _programs() -> Iterator[None]:
    """Compiled programs are dropped file by file: all of them at once exceed what a process may map."""
    yield
    jax.clear_caches()


def turned(stroke: Sequence[float], side: float) -> list[tuple[Callable, tuple[float, ...]]]:
    """Mirrors and quarter turns of a square map, each with what it makes of a stroke."""
    x0, y0, x1, y1 = stroke
    return [
        (np.fliplr, (side - x0, y0, side - x1, y1)),
        (np.flipud, (x0, side - y0, x1, side - y1)),
        (np.transpose, (y0, x0, y1, x1)),
        (np.rot90, (y0, side - x0, y1, side - x1)),
    ]


@pytest.fixture(params=["float32", pytest.param("float64", marks=pytest.mark.slow)])
def dtype(request: pytest.FixtureRequest) -> str:
    return request.param


def half_turn(parts):
    """A path that turns by half a turn in so many parts, all but in place, at (0.16, 0.16)."""
    headings = math.pi * np.arange(parts + 1) / parts
    return 0.16 + 1e-5 * np.concatenate([np.zeros((1, 2)), np.cumsum(np.c_[np.cos(headings), np.sin(headings)], 0)])
