"""Whether something has become slower: a few jobs timed in turns with a fixed loop in NumPy, and told as ratios to it.

A machine that is busy, or another one, makes the loop slower too. So ratios of one kind of machine may be compared from
commit to commit, where seconds may not.
"""

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxsand.bench.kept import append_row, known_rows
from jaxsand.bench.tables import Row
from jaxsand.bench.timing import race
from jaxsand.envs import make
from jaxsand.goals.surfaces import rough_surface
from jaxsand.goals.usual import usual_scene
from jaxsand.interaction.batched import step_batch, value_and_grad_batch
from jaxsand.planning.binary import plan
from jaxsand.relaxation.settling import settle_batch
from jaxsand.scene.progress import Tell, quiet

HISTORY = "speed.jsonl"
"""The file of all runs, a line each: commit, date, machine, and the figures."""

LETTER = np.array([[cell == "#" for cell in row] for row in ("#####", "#....", "#####", "....#", "#####")])
"""What is planned."""

_REFERENCE = "reference"
_FIGURES = ("ratio", "compile_ratio")
_LAST = 10  # runs that a new one is compared with
_FEWEST = 3  # with fewer nothing is told
_SLOWER, _SPREADS = 1.3, 3.0  # times the median, and standard deviations above it, from which on it is told
_LOOSE = 0.05  # of the median: what the spread is taken for at least
_COMPILES = 10.0  # times the reference loop: a first call that takes less beyond the others does not compile


def bench_speed(tell: Tell = quiet, rounds: int = 5) -> list[Row]:
    """The best time of each job, and what its first call took beyond that, over the best time of the reference loop.

    Returns:
      Rows `name`, `ratio` and `compile_ratio`, which is None for what does not compile, and `seconds` and `compile_seconds`
      to look at.
    """
    timed = race({_REFERENCE: reference, **jobs()}, rounds, tell)
    unit = timed[_REFERENCE].best
    return [
        {
            "name": name,
            "ratio": one.best / unit,
            "compile_ratio": one.compile_seconds / unit if one.compile_seconds > _COMPILES * unit else None,
            "seconds": one.best,
            "compile_seconds": one.compile_seconds,
        }
        for name, one in timed.items()
        if name != _REFERENCE
    ]


def reference(sweeps: int = 100, cells: int = 256) -> np.ndarray:
    """The loop that all else is measured by: so many sweeps of diffusion over a map, in NumPy, which runs on one core."""
    h = np.zeros((cells, cells), np.float32)
    h[cells // 2, cells // 2] = 1
    for _ in range(sweeps):
        flux = np.diff(h, axis=0) / 8, np.diff(h, axis=1) / 8
        h[:-1] += flux[0]
        h[1:] -= flux[0]
        h[:, :-1] += flux[1]
        h[:, 1:] -= flux[1]
    return h


def jobs() -> dict[str, Callable[[], Any]]:
    """What users wait for, each small enough to take a second at most."""
    scene, random = usual_scene(), np.random.default_rng(0)
    level = np.zeros((64, 32, 32), np.float32)
    rough = rough_surface(random, (512, 32, 32), 0.05, 3).astype(np.float32)
    strokes = random.uniform(0.03, 0.29, (64, 4)).astype(np.float32)
    env, params = make("multi-stroke")
    keys = jax.random.split(jax.random.key(0), 64)
    _, states = jax.jit(jax.vmap(env.reset, in_axes=(0, None)))(keys, params)
    actions = jnp.asarray(random.uniform(-1, 1, (64, 4)), jnp.float32)
    stepped = jax.jit(jax.vmap(env.step, in_axes=(0, 0, 0, None)))
    return {
        "settle 512 maps": partial(settle_batch, usual_scene(tool=None), rough),
        "64 pushes": partial(step_batch, scene, level, strokes),
        "16 gradients of a push": partial(value_and_grad_batch, scene, _square, level[:16], strokes[:16]),
        "64 steps of an environment": partial(stepped, keys, states, actions, params),
        "plan a letter": partial(plan, LETTER),
    }


def with_history(rows: list[Row], origin: Mapping[str, Any], out: Path) -> list[str]:
    """Adds a run to the history in a folder, and says what has become slower.

    Args:
      rows: as `bench_speed` returns them.
      origin: where they come from: its `machine`, `commit` and `date` are kept.
      out: the folder.

    Raises:
      ValueError: if the file cannot be written, or holds what is no run.
    """
    before = history(out)
    figures = {row["name"]: {key: row[key] for key in _FIGURES if row[key] is not None} for row in rows}
    append_row(out / HISTORY, {**{key: origin.get(key) for key in ("commit", "date", "machine")}, "figures": figures})
    return slower([run["figures"] for run in before if run["machine"] == origin.get("machine")], figures)


def history(out: Path) -> list[Row]:
    """All runs that a folder knows, the oldest first.

    Raises:
      ValueError: if the file holds what is no run.
    """
    runs = known_rows(out / HISTORY, {"commit", "machine", "figures"})
    for number, run in enumerate(runs, 1):
        jobs = run["figures"].values() if isinstance(run["figures"], dict) else [None]
        if not all(isinstance(job, dict) and all(isinstance(v, int | float) for v in job.values()) for job in jobs):
            raise ValueError(f"out: run {number} of {out / HISTORY} has no figures; take it out, or give another folder")
    return runs


def slower(before: Sequence[Mapping[str, Any]], now: Mapping[str, Mapping[str, float]]) -> list[str]:
    """What is slower now than in the last runs before: by 30% of their median, and by three times their spread.

    Example:
      >>> slower([{"push": {"ratio": 1.0}}] * 3, {"push": {"ratio": 2.0}})
      ['push: ratio 2 is 2.0 times the 1 of the last 3 runs']
    """
    told = []
    for name, figures in now.items():
        for figure, value in figures.items():
            known = [run[name][figure] for run in before if figure in run.get(name, {})][-_LAST:]
            if len(known) < _FEWEST:
                continue
            usual = max(float(np.median(known)), 1e-9)
            spread = max(float(np.std(known)), _LOOSE * usual)
            if value > max(_SLOWER * usual, usual + _SPREADS * spread):
                times = f"{value / usual:.1f} times the {usual:.3g} of the last {len(known)} runs"
                told.append(f"{name}: {figure} {value:.3g} is {times}")
    return told


def _square(height: jax.Array) -> jax.Array:
    return jnp.sum(height**2)
