"""How long things take: ways to do a job take turns, so that a busy moment hits all of them."""

import gc
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import jax
import numpy as np

from jaxsand.scene.progress import Tell, quiet


@dataclass(frozen=True)
class Timed:
    """Seconds of a way's first call, which compiles, and of the later ones; and what the first returned."""

    first: float
    later: tuple[float, ...]
    result: Any

    @property
    def best(self) -> float:
        """The shortest of the later calls (s)."""
        return min(self.later)

    @property
    def median(self) -> float:
        """The median of the later calls (s)."""
        return float(np.median(self.later))

    @property
    def compile_seconds(self) -> float:
        """What the first call took beyond the best."""
        return max(0.0, self.first - self.best)


def seconds_of(way: Callable[[], Any]) -> tuple[float, Any]:
    """Seconds of one call, until its arrays are ready, and what it returned."""
    gc.collect()
    began = time.perf_counter()
    result = jax.block_until_ready(way())
    return time.perf_counter() - began, result


def race(ways: Mapping[str, Callable[[], Any]], rounds: int = 3, tell: Tell = quiet) -> dict[str, Timed]:
    """Times every way once and then `rounds` times more, in turns; `tell` is told before every call.

    Example:
      >>> timed = race({"numpy": lambda: np.sort(x), "jax": lambda: jnp.sort(x)})
      >>> timed["jax"].best, timed["jax"].compile_seconds
    """
    first: dict[str, tuple[float, Any]] = {}
    later: dict[str, list[float]] = {name: [] for name in ways}
    for turn in range(rounds + 1):
        for name, way in ways.items():
            tell(f"{name}: {f'round {turn} of {rounds}' if turn else 'first call'}")
            seconds, result = seconds_of(way)
            if turn:
                later[name].append(seconds)
            else:
                first[name] = seconds, result
    return {name: Timed(first[name][0], tuple(later[name]), first[name][1]) for name in ways}


def timed(way: Callable[[], Any], rounds: int = 3) -> Timed:
    """A way without rivals: one call, and `rounds` more."""
    return race({"": way}, rounds)[""]
