"""How well noisy height maps tell the angle of repose: of simulated sand, beside the least error that any estimator
can have, and of a cone that is known exactly, beside the error that is stated."""

import math
from functools import partial

import jax
import numpy as np

from jaxsand.bench.tables import Row
from jaxsand.bench.timing import seconds_of
from jaxsand.goals.usual import SHAPE, SPACING
from jaxsand.interaction.blade_closed_form import SwathPush
from jaxsand.interaction.rule import PushRule
from jaxsand.interaction.simulate import step
from jaxsand.relaxation.settling import settle
from jaxsand.scene.grid import Neighbours, places
from jaxsand.scene.progress import Tell, quiet
from jaxsand.scene.scene import Scene, make_scene
from jaxsand.scene.tools import Blade
from jaxsand.terramechanics.calibration import Trial, calibrate
from jaxsand.terramechanics.finer import OneGrid, TwoGrids

NOISE = 6e-4
"""Standard deviation (m) of the white noise in the heights after."""

_STROKE = np.array([0.08, 0.12, 0.24, 0.2], np.float32)
_LEVEL = np.zeros(SHAPE, np.float32)
_ANGLES = (20.0, 40.0)  # degrees, between which every seed has its own
_EXACT = 29.0  # degrees: the cone's angle
_PARTS = 16  # of a cell's side, for means over cells
_FREE = ("repose_angle",)


def bench_calibrate(tell: Tell = quiet, seeds: int = 50) -> list[Row]:
    """For three experiments in the simulator's own sand: the rms and the largest error of the angle of repose, and the rms
    of the noise's standard errors (at the optimum the Cramer-Rao bound), in degrees, over so many angles and noises.
    Strokes are swaths: the fast push."""
    x, y = places(SHAPE, SPACING)
    column = np.where(np.hypot(x - 0.16, y - 0.16) < 0.06, 0.06, 0).astype(np.float32)
    experiments: dict[str, tuple[Blade | None, np.ndarray]] = {
        "a column collapses": (None, column),
        "one stroke of the default blade": (Blade(), _LEVEL),
        "one stroke of a blade 60 mm wide, 20 mm deep": (Blade(0.06, 0.015, 0.02), _LEVEL),
    }
    angles, rows = np.linspace(*_ANGLES, seeds), []
    for name, (tool, before) in experiments.items():
        found = []
        for seed, angle in enumerate(angles):
            tell(f"{name}: {seed + 1} of {seeds}")
            found.append(_found(_sand(angle, tool), _sand(30.0, tool), before, seed))
        off, error = np.array(found).T - np.stack([angles, np.zeros(seeds)])
        rows.append(
            {
                "experiment": name,
                "seeds": seeds,
                "rms_error_deg": float(np.sqrt(np.mean(off**2))),
                "worst_error_deg": float(np.abs(off).max()),
                "standard_error_deg": float(np.sqrt(np.mean(error**2))),
            }
        )
    return rows


def bench_cone(tell: Tell = quiet, seeds: int = 100) -> list[Row]:
    """For every neighbourhood, over so many noises on the exact cone of 29 degrees: the mean angle that best explains it,
    and the mean of the noise's, the grid's and the whole stated standard error (degrees); in which share of the trials the
    cone's angle lies within two of the noise's, and within two of the whole; the same of `sand`, the estimate without the
    grid's error; and the median seconds of a call with the grid's part and without, compiled before."""
    before, after = cone(_EXACT)
    trials = [
        Trial(before, after + np.random.default_rng(seed).normal(0, NOISE, SHAPE).astype(np.float32))
        for seed in range(seeds)
    ]
    neighbourhoods: tuple[Neighbours, ...] = (4, 8, "isotropic")
    rows = []
    for neighbours in neighbourhoods:
        tell(f"cone, {neighbours} neighbours")
        scene = make_scene(SHAPE, SPACING, math.radians(26), neighbours)
        found = [_told(scene, trial) for trial in trials]
        value, noise, grid, error, sand, sand_error = np.degrees(found).T
        rows.append(
            {
                "neighbours": neighbours,
                "seeds": seeds,
                "angle_deg": float(value.mean()),
                "noise_error_deg": float(noise.mean()),
                "grid_error_deg": float(grid.mean()),
                "error_deg": float(error.mean()),
                "covered_by_noise": float(np.mean(np.abs(value - _EXACT) <= 2 * noise)),
                "covered": float(np.mean(np.abs(value - _EXACT) <= 2 * error)),
                "sand_deg": float(sand.mean()),
                "sand_rms_error_deg": float(np.sqrt(np.mean((sand - _EXACT) ** 2))),
                "sand_error_deg": float(sand_error.mean()),
                "sand_covered": float(np.mean(np.abs(sand - _EXACT) <= 2 * sand_error)),
                "seconds": _seconds(scene, trials[:6], TwoGrids()),
                "seconds_one_grid": _seconds(scene, trials[:6], OneGrid()),
            }
        )
    return rows


def cone(degrees: float, radius: float = 0.06, height: float = 0.06) -> tuple[np.ndarray, np.ndarray]:
    """A cylinder, and the cone to which it collapses, as means over cells (m): the toe lies at (3 R^2 H / mu)^(1/3)."""
    mu = math.tan(math.radians(degrees))
    toe = (3 * radius**2 * height / mu) ** (1 / 3)
    n = SHAPE[0] * _PARTS
    place = ((np.arange(n) + 0.5) / n - 0.5) * SHAPE[0] * SPACING
    away = np.hypot(place[:, None], place[None, :])
    maps = (np.where(away < radius, height, 0), np.maximum(mu * (toe - away), 0))
    before, after = (m.reshape(SHAPE[0], _PARTS, SHAPE[1], _PARTS).mean((1, 3)).astype(np.float32) for m in maps)
    return before, after


def _told(scene: Scene, trial: Trial) -> list[float]:
    """Of one noisy cone: the angle; its error by noise, by the grid, and whole; the sand's angle, and its error (rad)."""
    found = calibrate(scene, trial, free=_FREE)
    parts = (found.values, found.noise_errors, found.grid_errors, found.errors, found.sand, found.sand_errors)
    return [part["repose_angle"] for part in parts]


def _seconds(scene: Scene, trials: list[Trial], grid: TwoGrids | OneGrid) -> float:
    """The median time of a call, the first one left out."""
    times = [seconds_of(partial(calibrate, scene, trial, free=_FREE, grid=grid))[0] for trial in trials]
    return float(np.median(times[1:] or times))


def _found(true: Scene, guess: Scene, before: np.ndarray, seed: int) -> tuple[float, float]:
    """The angle of repose found, and the noise's part of its standard error, in degrees."""
    stroke, push = (_STROKE, SwathPush()) if isinstance(true.tool, Blade) else (None, None)
    after = np.asarray(_after(true, before, stroke, push)) + np.random.default_rng(seed).normal(0, NOISE, SHAPE)
    trial = Trial(before, after.astype(np.float32), stroke)
    found = calibrate(guess, trial, free=_FREE, noise=NOISE, starts=3, push=push, grid=OneGrid())
    return math.degrees(found.values["repose_angle"]), math.degrees(found.noise_errors["repose_angle"])


def _after(scene: Scene, before: np.ndarray, stroke: np.ndarray | None, push: PushRule | None) -> jax.Array:
    return settle(scene, before).height if stroke is None else step(scene, before, stroke, push=push).height


def _sand(degrees: float, tool: Blade | None) -> Scene:
    return make_scene(SHAPE, SPACING, math.radians(degrees), tool=tool)
