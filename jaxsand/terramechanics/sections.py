"""The angle of repose, and a wheel's pass, from sections across its trench; see _least_squares.py. Host side.

The model of a section is a profile of wheel_trench.py laid where the scan was taken: z(x) = lift + tilt x + profile(x -
shift). Derivatives are central differences.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
from scipy.optimize import least_squares

from jaxsand.relaxation.stopping import check_whole
from jaxsand.terramechanics._least_squares import Calibration, Range, as_ranges, check_noise, conclude, spread
from jaxsand.terramechanics.wheel_trench import Pass, Profile, relaxing

_SHARED = ("repose_angle", "radius", "width")
_PLACE = {"shift": 0.005, "lift": 0.003, "tilt": 0.05}  # m, m, rad: either way
_MOST = {"slip_angle": math.pi / 2, "repose_angle": math.radians(85)}
_STEP = 1e-3  # of a range: to either side, for derivatives
_OFF = 1.0  # m: the misfit where the model has no profile


@dataclass(frozen=True)
class Section:
    """Heights `z` (m, NaN where not seen) at places `x` (m) across the trench of a `run`, of which the pass tells what is
    known and a guess of what is free."""

    run: Pass
    x: np.ndarray
    z: np.ndarray

    def __post_init__(self) -> None:
        if np.ndim(self.x) != 1 or np.shape(self.x) != np.shape(self.z):
            raise ValueError(f"x, z: got shapes {np.shape(self.x)} and {np.shape(self.z)}; give two rows of equal length")
        if not np.isfinite(self.x).all():
            raise ValueError("x: got a NaN or an infinity; leave such points out")


def calibrate_sections(
    sections: Section | Sequence[Section],
    *,
    free: Sequence[str] | Mapping[str, tuple[float, float]] = ("repose_angle", "sinkage"),
    noise: float | None = None,
    starts: int = 4,
    model: Callable[[Pass], Profile] | None = None,
) -> Calibration[tuple[Pass, ...]]:
    """The sand and the passes with which a model of the wheel's trench best explains sections of it.

    Args:
      sections: one or several, of one sand and one wheel.
      free: fields of `Pass`, and "shift", "lift" (m), "tilt" (rad) of a section; or these with their ranges (low, high).
        The angle of repose and the wheel's radius and width are shared; others are found for each section, and named
        sinkage[0], sinkage[1] where there are several. By default 10 to 50 degrees for the angle of repose, 5 mm, 3 mm and
        0.05 either way for shift, lift and tilt, and a third to three times the guess for others.
      noise: sigma (m) of white noise in z; by default it is estimated from the residual.
      starts: how many.
      model: makes a profile of a pass, or raises ValueError where it has none; by default the exact relaxation on cells of
        1 mm, `trench.relaxing()`. `trench.closed_form` is a hundred times as fast, and another profile where the wheel is
        deep in the sand and slips.

    The standard errors hold white noise in z and, of the exact relaxation, the error of its cells, found from cells of half
    the size. A `model` that you give is taken to have no grid. What the model leaves out of a trench is not in the errors.
    Next to where a model has no profile they are worth nothing, and the verdict says UNCLEAN.

    Raises:
      ValueError: names the field, the value and the remedy; a bad fit raises nothing, its `verdict` says so.
    """
    some = [sections] if isinstance(sections, Section) else list(sections)
    if not some:
        raise ValueError("sections: got none; give at least one Section(run, x, z)")
    check_whole("starts", starts, 1)
    check_noise(noise)
    ranges, keys = _ranges(some, free)
    low, high = np.array([r.low for r in ranges]), np.array([r.high for r in ranges])
    seen = [np.isfinite(section.z) for section in some]
    count = int(sum(one.sum() for one in seen))
    if count <= len(ranges):
        raise ValueError(f"sections: got {count} seen points for {len(ranges)} free parameters; give more, or free fewer")
    profile = relaxing() if model is None else model
    halved = relaxing(spacing=5e-4) if model is None else model
    calls = 0

    def residuals(x: np.ndarray, profile: Callable[[Pass], Profile] = profile) -> np.ndarray:
        nonlocal calls
        values, misfits = low + (x - 1) * (high - low), []
        for k, (section, sees) in enumerate(zip(some, seen, strict=True)):
            calls += 1
            run, place = _placed(section.run, k, keys, values)
            x, z = section.x[sees], section.z[sees]
            try:
                misfits.append(place["lift"] + place["tilt"] * x + profile(run)(x - place["shift"]) - z)
            except ValueError:
                misfits.append(np.full(z.shape, _OFF))
        return np.concatenate(misfits)

    # From 1 to 2, so that steps of differences are alike: wider than what a stop rule's tolerance makes of a profile.
    begin = 1 + np.clip(spread(ranges, starts), 0.01, 0.99)
    ends = [least_squares(residuals, x, "3-point", bounds=(1, 2), diff_step=_STEP, xtol=1e-6, ftol=1e-8) for x in begin]

    def reference(x: np.ndarray) -> tuple[np.ndarray, np.ndarray, bool]:
        fine = residuals(1 + x, halved)
        return fine, fine - residuals(1 + x), True

    def passes(values: np.ndarray) -> tuple[Pass, ...]:
        return tuple(_placed(section.run, k, keys, values)[0] for k, section in enumerate(some))

    return conclude(
        ranges,
        np.array([end.x - 1 for end in ends]),
        np.array([2 * end.cost for end in ends]),
        np.array([end.jac for end in ends]),
        np.array([np.abs(end.jac).max() < 1 for end in ends]),  # m to a range: else the model ends next to the estimate
        np.array([end.status > 0 for end in ends]),
        count,
        noise,
        calls,
        passes,
        reference,
    )


def _placed(run: Pass, k: int, keys: list[tuple[str, int]], values: np.ndarray) -> tuple[Pass, dict[str, float]]:
    """The pass of section k with these values, and where the section lies."""
    own = {name: float(value) for (name, of), value in zip(keys, values, strict=True) if of in (-1, k)}
    place = {name: own.pop(name, 0.0) for name in _PLACE}
    return replace(run, **own), place


def _ranges(sections: list[Section], free: Any) -> tuple[list[Range], list[tuple[str, int]]]:
    """A range for every parameter, and its name and section (-1: all of them)."""
    known = [field.name for field in fields(Pass)]
    asked = as_ranges(free)
    if unknown := set(asked) - {*known, *_PLACE}:
        raise ValueError(f"free: got {sorted(unknown)}; choose from {[*known, *_PLACE]}")
    ranges, keys = [], []
    for name, ends in asked.items():
        for k in [-1] if name in _SHARED else range(len(sections)):
            run = sections[max(k, 0)].run
            full = name if k < 0 or len(sections) == 1 else f"{name}[{k}]"
            ranges.append(_range(run, name, full, ends))
            keys.append((name, k))
    return ranges, keys


def _range(run: Pass, name: str, full: str, ends: tuple[float, float] | None) -> Range:
    guess = 0.0 if name in _PLACE else float(getattr(run, name))
    most = _MOST.get(name, run.radius if name == "sinkage" else math.inf)
    if ends is None and name == "repose_angle":
        ends = math.radians(10), math.radians(50)
    elif ends is None and name in _PLACE:
        ends = -_PLACE[name], _PLACE[name]
    elif ends is None:
        if not guess > 0:
            raise ValueError(f"free: got a guess of {guess!r} for {full}; give its range, as in {{{name!r}: (low, high)}}")
        ends = guess / 3, min(3 * guess, most)
    if name not in _PLACE and not 0 <= ends[0] < ends[1] <= most:
        raise ValueError(f"free: got {ends[0]!r} to {ends[1]!r} for {full}; give (low, high) from 0 to {most:g}")
    return Range(full, *ends, guess)
