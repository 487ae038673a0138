"""How well one noisy pair of height maps tells the angle of repose, beside the least error that any estimator could have."""

import math
from collections.abc import Callable
from typing import Any

import numpy as np

from jaxsand.calibration import Trial, calibrate
from jaxsand.scene import Scene, make_scene
from jaxsand.settling import settle
from jaxsand.sim import Push, step
from jaxsand.swath import SwathPush
from jaxsand.tool import Blade

NOISE = 6e-4
"""Standard deviation (m) of the white noise in the heights after."""

_SHAPE, _SPACING = (32, 32), 0.01
_STROKE = np.array([0.08, 0.12, 0.24, 0.2], np.float32)
_LEVEL = np.zeros(_SHAPE, np.float32)
_ANGLES = (20.0, 40.0)  # degrees, between which every seed has its own


def bench_calibrate(tell: Callable[[str], None] = lambda _: None, seeds: int = 50) -> list[dict[str, Any]]:
    """For three experiments: the rms and the largest error of the angle of repose, and the rms of its standard errors
    (at the optimum the Cramer-Rao bound), in degrees, over so many angles and noises. Strokes are swaths: the fast push."""
    y, x = (np.indices(_SHAPE) + 0.5) * _SPACING
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


def _found(true: Scene, guess: Scene, before: np.ndarray, seed: int) -> tuple[float, float]:
    """The angle of repose found, and its standard error, in degrees."""
    stroke, push = (_STROKE, SwathPush()) if isinstance(true.tool, Blade) else (None, None)
    after = np.asarray(_after(true, before, stroke, push)) + np.random.default_rng(seed).normal(0, NOISE, _SHAPE)
    trial = Trial(before, after.astype(np.float32), stroke)
    found = calibrate(guess, trial, free=("repose_angle",), noise=NOISE, starts=3, push=push)
    return math.degrees(found.values["repose_angle"]), math.degrees(found.errors["repose_angle"])


def _after(scene: Scene, before: np.ndarray, stroke: np.ndarray | None, push: Push | None) -> Any:
    return settle(scene, before).height if stroke is None else step(scene, before, stroke, push=push).height


def _sand(degrees: float, tool: Blade | None) -> Scene:
    return make_scene(_SHAPE, _SPACING, math.radians(degrees), tool=tool)
