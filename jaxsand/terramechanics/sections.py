"""Estimates the angle of repose, and a wheel's pass, from sections across its trench; see _least_squares.py. Host side.

The model of a section is a profile of wheel_trench.py, moved to where the scan was taken:
z(x) = lift + tilt x + profile(x - shift). Derivatives are central differences.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace

import numpy as np
from scipy.optimize import least_squares

from jaxsand.relaxation.stopping import check_whole
from jaxsand.scene.masked import gaps
from jaxsand.terramechanics._least_squares import (
    Calibration,
    Free,
    Range,
    SearchEnds,
    as_ranges,
    check_noise,
    conclude,
    spread,
)
from jaxsand.terramechanics.wheel_trench import Pass, Profile, relaxing

_SHARED = ("repose_angle", "radius", "width")
_PLACE = {"shift": 0.005, "lift": 0.003, "tilt": 0.05}  # m, m, rad: either way
_MOST = {"slip_angle": math.pi / 2, "repose_angle": math.radians(85)}
_STEP = 1e-3  # of a range: to either side, for derivatives
_OFF = 1.0  # m: the misfit where the model has no profile


@dataclass(frozen=True)
class Section:
    """A measured section across a wheel's trench, for `calibrate_sections`.

    Args:
      run: the wheel's pass: what is known of it, and a guess of what is free.
      x: places across the trench [n] (m), 0 at the middle of the cut, positive to the right of the wheel's way; finite.
      z: heights [n] (m) above the level sand; NaN or masked where not seen.

    Raises:
      ValueError: if x and z differ in shape, or x is not finite.

    Example:
      >>> import numpy as np
      >>> import jaxsand as js
      >>> run = js.trench.Pass(slip_angle=0.0, sinkage=0.01)
      >>> x = np.linspace(-0.1, 0.1, 101)
      >>> section = js.Section(run, x, js.trench.closed_form(run)(x))
      >>> section.z.shape
      (101,)
    """

    run: Pass
    x: np.ndarray
    z: np.ndarray

    def __post_init__(self) -> None:
        if np.ndim(self.x) != 1 or np.shape(self.x) != np.shape(self.z):
            raise ValueError(f"x, z: got shapes {np.shape(self.x)} and {np.shape(self.z)}; give two rows of equal length")
        if not np.isfinite(gaps(self.x)).all():
            raise ValueError("x: got a NaN or an infinity; leave such points out")
        object.__setattr__(self, "z", np.asarray(gaps(self.z)))


def calibrate_sections(
    sections: Section | Sequence[Section],
    *,
    free: Free = ("repose_angle", "sinkage"),
    noise: float | None = None,
    starts: int = 4,
    model: Callable[[Pass], Profile] | None = None,
) -> Calibration[tuple[Pass, ...]]:
    """Finds the sand and the wheel's passes with which a model of the trench best explains sections across it.

    Minimises sum (lift + tilt x + profile(x - shift) - z)^2 over the seen points of all sections.

    Args:
      sections: one or several, of one sand and one wheel.
      free: names of fields of `jaxsand.trench.Pass`, and "shift", "lift" (m), "tilt" (rad) of a section; or a mapping of
        these to their ranges (low, high), which the estimates never leave. The angle of repose and the wheel's radius and
        width are shared by all sections. Others are found for each section, and are named sinkage[0], sinkage[1] where there
        are several. By default the range is 10 to 50 degrees for the angle of repose; 5 mm, 3 mm and 0.05 either way for
        shift, lift and tilt; and a third to three times the guess for others.
      noise: standard deviation (m) of the white noise in z; None estimates it from the residual.
      starts: how many searches are made; those after the first begin at places spread over the ranges.
      model: makes a profile of a pass, or raises ValueError where there is none. None stands for the exact relaxation on
        cells of 1 mm, `jaxsand.trench.relaxing()`. `jaxsand.trench.closed_form` is a hundred times as fast, but gives
        another profile where the wheel is deep in the sand and slips.

    Returns:
      A `Calibration`: `values` and their standard `errors` by name, the `verdict`, and the passes with the values put in as
      `model`. The errors hold white noise in z and, for the exact relaxation, the error of its cells, found from cells of
      half the size; a `model` that you give is taken to have no grid. They do not hold what the model leaves out of a
      trench. Next to where a model has no profile they are worth nothing, and the verdict says UNCLEAN. A bad fit raises
      nothing.

    Raises:
      ValueError: names the argument, its value and the remedy.

    Source: Levenberg 1944; Marquardt 1963, doi:10.1137/0111030.

    Example:
      >>> import math
      >>> import numpy as np
      >>> import jaxsand as js
      >>> run = js.trench.Pass(slip_angle=math.radians(45), sinkage=0.015)
      >>> guess = js.trench.Pass(slip_angle=math.radians(45), sinkage=0.012)
      >>> x = np.linspace(-0.1, 0.1, 101)
      >>> section = js.Section(guess, x, js.trench.closed_form(run)(x))
      >>> found = js.calibrate_sections(section, free=["sinkage"], starts=1, noise=1e-4, model=js.trench.closed_form)
      >>> round(found.values["sinkage"], 6)
      0.015
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

    found = SearchEnds(
        x=np.array([end.x - 1 for end in ends]),
        cost=np.array([2 * end.cost for end in ends]),
        jacobian=np.array([end.jac for end in ends]),
        clean=np.array([np.abs(end.jac).max() < 1 for end in ends]),  # m to a range: else the model ends next to it
        done=np.array([end.status > 0 for end in ends]),
        looks=np.array([end.nfev for end in ends]),
    )
    return conclude(ranges, found, count, noise, calls, passes, reference)


def _placed(run: Pass, k: int, keys: list[tuple[str, int]], values: np.ndarray) -> tuple[Pass, dict[str, float]]:
    """Section k's pass with the given values put in, and its shift, lift and tilt."""
    own = {name: float(value) for (name, of), value in zip(keys, values, strict=True) if of in (-1, k)}
    place = {name: own.pop(name, 0.0) for name in _PLACE}
    return replace(run, **own), place


def _ranges(sections: list[Section], free: Free) -> tuple[list[Range], list[tuple[str, int]]]:
    """A range for every parameter, and its name and section (-1 where all sections share it)."""
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
