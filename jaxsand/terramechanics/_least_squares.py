"""Least squares with error bars: minimise the squared misfit from several starts, then judge the best result.

The cost sum r(x)^2 of residuals r (m) is minimised by Gauss-Newton steps (J^T J + damping D) dx = -J^T r, D the diagonal of
J^T J (Levenberg 1944, Marquardt 1963, doi:10.1137/0111030). Every parameter is scaled by its range, so that x runs from 0 to
1, and x is kept in there. An error bar has two parts. The noise's covariance is sigma^2 (J^T J)^-1, which for white noise of
standard deviation sigma holds to first order and is also the Cramer-Rao bound. The grid's covariance is d d^T + e e^T, where
d is the distance from the fit to the fit on an infinitely fine grid, and e the uncertainty of d (_limit.py): this error is
the same in every repetition of an experiment, and acts on all parameters together.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from enum import IntFlag
from typing import Generic, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from jaxsand.scene.validation import short
from jaxsand.terramechanics._limit import Reference, seek_limit

Model = TypeVar("Model")
Free = Sequence[str] | Mapping[str, tuple[float, float]]
"""The names of the free parameters, or their ranges (low, high) by name."""

_LOOKS = 40
_NEAR = 1e-4  # of sigma^2: what a step that is not worth taking promises, 0.01 standard errors
_FINE = 1e-5  # of a range: a step that is none
_SPARE = 20  # numbers from which noise is known to about a sixth
_IDLE = 12.0  # 1 / variance of a parameter of which no more is known than its range


class Verdict(IntFlag):
    """What a calibration says about its own result: flags that may be combined, 0 when nothing is wrong.

    Attributes:
      NOT_CONVERGED: the best start was still moving after the last step.
      NOT_TOLD: the data do not determine some parameter, or some mixture of several; `Calibration.untold` names them.
      AT_LIMIT: an estimate lies at an end of its range: widen the range, or doubt the model.
      AMBIGUOUS: another start fits as well, within two standard deviations, at a place more than five standard errors away.
      POOR_FIT: the residual is larger than the given noise explains, by five standard deviations: doubt the model, or the
        noise.
      UNCLEAN: the simulator's outcome is not clean at the estimate (see `jaxsand.check`), or a section's model has no
        profile next to it.
      FEW_DATA: the noise was estimated from fewer than 20 numbers more than are free, so that the errors may be far off:
        give `noise`.
      GRID_UNKNOWN: the grid's part of the errors was not asked for or could not be found: `grid_errors` and `sand` are NaN,
        and `errors` hold the noise's part alone.

    Example:
      >>> import jaxsand as js
      >>> verdict = js.Verdict.AT_LIMIT | js.Verdict.POOR_FIT
      >>> js.Verdict.AT_LIMIT in verdict
      True
      >>> bool(js.Verdict(0))
      False
    """

    NOT_CONVERGED = 1
    NOT_TOLD = 2
    AT_LIMIT = 4
    AMBIGUOUS = 8
    POOR_FIT = 16
    UNCLEAN = 32
    FEW_DATA = 64
    GRID_UNKNOWN = 128


@dataclass(frozen=True)
class Calibration(Generic[Model]):
    """The parameters that a calibration found, with error bars and a verdict; `calibrate` and `calibrate_sections` return
    it.

    Lengths are in metres, angles in radians. The values belong to the model on its own grid: with them it explains the
    data best. The errors say how far the values may be from those of the real sand, errors^2 = noise_errors^2 +
    grid_errors^2.

    Attributes:
      values: estimates by parameter name.
      errors: standard errors of `values` by name; infinite for parameters in `untold`. Where the grid's part is unknown
        they hold the noise's part alone.
      noise_errors: the part of `errors` that white noise in the data causes.
      grid_errors: the part of `errors` that the model's grid causes; NaN where unknown.
      sand: the estimates without the grid's error, extrapolated from two grids; NaN where unknown.
      sand_errors: standard errors of `sand`: the noise's part, and half of what was extrapolated; NaN where unknown.
      covariance: [P, P] covariance of the values, parameters in the order of `values`.
      noise_covariance: [P, P] the noise's part of `covariance`.
      untold: names of the parameters that the data do not determine.
      residual: root mean square misfit (m).
      noise: the standard deviation (m) of the data's noise on which the errors rest, given or estimated.
      calls: how many times the model was run.
      verdict: what is wrong with the result; `Verdict(0)` if nothing.
      model: the model with the values put in: a `Scene`, or a tuple of wheel passes.
      converged: whether the best start had come to rest.

    Example:
      >>> import math
      >>> import numpy as np
      >>> import jaxsand as js
      >>> run = js.trench.Pass(slip_angle=math.radians(45), sinkage=0.015)
      >>> x = np.linspace(-0.1, 0.1, 101)
      >>> section = js.Section(run, x, js.trench.closed_form(run)(x))
      >>> found = js.calibrate_sections(section, free=["sinkage"], starts=1, noise=1e-4, model=js.trench.closed_form)
      >>> round(found.values["sinkage"], 6), found.converged, found.untold
      (0.015, True, ())
    """

    values: dict[str, float]
    errors: dict[str, float]
    noise_errors: dict[str, float]
    grid_errors: dict[str, float]
    sand: dict[str, float]
    sand_errors: dict[str, float]
    covariance: np.ndarray
    noise_covariance: np.ndarray
    untold: tuple[str, ...]
    residual: float
    noise: float
    calls: int
    verdict: Verdict
    model: Model

    @property
    def converged(self) -> bool:
        """Whether the best start had come to rest."""
        return Verdict.NOT_CONVERGED not in self.verdict


@dataclass(frozen=True)
class Range:
    """A free parameter: its name, the ends of its range, and the guess at which the first start begins."""

    name: str
    low: float
    high: float
    guess: float

    def __post_init__(self) -> None:
        if not (math.isfinite(self.low) and math.isfinite(self.high) and self.low < self.high):
            raise ValueError(f"free: got {short(self.low)} to {short(self.high)} for {self.name}; give a finite (low, high)")


def as_ranges(free: Free) -> dict[str, tuple[float, float] | None]:
    """Maps each free name to its range, or to None where the user gave none."""
    ranges: dict[str, tuple[float, float] | None] = (
        dict(free) if isinstance(free, Mapping) else dict.fromkeys([free] if isinstance(free, str) else free)
    )
    if not ranges:
        raise ValueError("free: got no names; free at least one parameter")
    for name, ends in ranges.items():
        if ends is not None and (np.shape(ends) != (2,) or np.asarray(ends).dtype.kind not in "iuf"):
            raise ValueError(f"free: got {short(ends)} for {name}; give (low, high)")
    return ranges


def check_noise(noise: float | None) -> None:
    """Raises ValueError unless the noise is None or a positive number."""
    if noise is not None and not (isinstance(noise, int | float | np.number) and 0 < noise < math.inf):
        raise ValueError(f"noise: got {short(noise)}; give its sigma in metres, such as 6e-4, or None to estimate it")


def spread(ranges: list[Range], starts: int) -> np.ndarray:
    """The starting points [starts, P] in units of the ranges: the guess, then points spread evenly over the middle 3/4.

    Source: the additive recurrence of Roberts (2018), with the powers of the root of g^(P + 1) = g + 1.
    """
    g = 2.0
    for _ in range(50):
        g = (1 + g) ** (1 / (len(ranges) + 1))
    steps = g ** -np.arange(1.0, len(ranges) + 1)
    even = (0.5 + steps * np.arange(1, starts)[:, None]) % 1
    first = np.clip([[(r.guess - r.low) / (r.high - r.low) for r in ranges]], 0, 1)
    return np.concatenate([first, 0.125 + 0.75 * even])


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Look:
    """The residuals at one place: `x` [P], `residual` [n], `jacobian` [n, P], and whether the model's outcome was clean."""

    x: jax.Array
    residual: jax.Array
    jacobian: jax.Array
    clean: jax.Array


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class _Search:
    """A search from one start: where it looks next, the best place so far, its damping, whether it is done, its looks."""

    trial: jax.Array
    kept: Look
    damping: jax.Array
    done: jax.Array
    looks: jax.Array


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class SearchEnds:
    """Where the searches from S starts ended.

    Attributes:
      x: places [S, P], in units of the ranges.
      cost: sum of squared residuals [S].
      jacobian: [S, n, P].
      clean: whether the model's outcome was clean [S].
      done: whether the search converged [S].
      looks: how often it evaluated the residuals [S].
    """

    x: jax.Array | np.ndarray
    cost: jax.Array | np.ndarray
    jacobian: jax.Array | np.ndarray
    clean: jax.Array | np.ndarray
    done: jax.Array | np.ndarray
    looks: jax.Array | np.ndarray


def climb(
    residuals: Callable[[jax.Array], tuple[jax.Array, jax.Array]],
    starts: jax.Array,
    size: int,
    seen: jax.Array,
    noise: jax.Array,
) -> SearchEnds:
    """Minimises the squared residuals from every start [S, P], in units of the ranges.

    Args:
      residuals: maps one x [P] to the residuals r [size] and whether the model's outcome was clean.
      starts: where to begin, [S, P].
      size: how many residuals there are.
      seen: how many of them are data; the others are 0.
      noise: standard deviation of the data (m), or NaN to take it from the residuals.

    Returns:
      Where the searches ended. A search has converged where a step promises less than 1e-4 sigma^2, or where steps gain
      nothing however short, as at a kink.
    """

    def look(x: jax.Array) -> Look:
        def twice(x: jax.Array) -> tuple[jax.Array, tuple[jax.Array, jax.Array]]:
            r, clean = residuals(x)
            return r, (r, clean)

        jacobian, (r, clean) = jax.jacfwd(twice, has_aux=True)(x)
        return Look(x, r, jacobian, clean)

    def advance(state: _Search) -> _Search:
        new, old = look(state.trial), state.kept
        # The sum is exact where the difference of the costs would be rounded off.
        gain = jnp.sum((old.residual - new.residual) * (old.residual + new.residual))
        better = (state.looks == 0) | (gain > 0)
        kept = jax.tree.map(lambda a, b: jnp.where(better, a, b), new, old)
        x, r, jacobian = kept.x, kept.residual, kept.jacobian
        damping = jnp.clip(jnp.where(better, state.damping / 8, state.damping * 8), 1e-5, 1e8)
        slope, curve = jacobian.T @ r, jacobian.T @ jacobian
        held = ((x <= 0) & (slope > 0)) | ((x >= 1) & (slope < 0))
        slope = jnp.where(held, 0, slope)
        curve = jnp.where(held[:, None] | held[None, :], 0, curve)
        scale = jnp.diag(curve)
        floor = jnp.maximum(1e-6 * jnp.max(scale), jnp.finfo(x.dtype).tiny)
        step = -jnp.linalg.solve(curve + jnp.diag(damping * scale + floor), slope)
        trial = jnp.clip(x + step, 0, 1)
        sigma2 = jnp.where(jnp.isnan(noise), jnp.sum(r * r) / (seen - x.size), noise**2)
        near = (-jnp.sum(slope * step) < _NEAR * sigma2) & (damping < 1)
        done = near | (jnp.max(jnp.abs(trial - x)) < _FINE)
        after = _Search(trial, kept, damping, done, state.looks + 1)
        return jax.tree.map(lambda a, b: jnp.where(state.done, a, b), state, after)

    def goes_on(state: _Search) -> jax.Array:
        return jnp.any(~state.done & (state.looks < _LOOKS))

    many, free = starts.shape
    r, jacobian = jnp.zeros((many, size), starts.dtype), jnp.zeros((many, size, free), starts.dtype)
    no = jnp.zeros(many, bool)
    damping, looks = jnp.full(many, 0.1, starts.dtype), jnp.zeros(many, jnp.int32)
    begin = _Search(starts, Look(starts, r, jacobian, no), damping, no, looks)
    end = lax.while_loop(goes_on, jax.vmap(advance), begin)
    at = end.kept
    return SearchEnds(at.x, jnp.sum(at.residual * at.residual, axis=1), at.jacobian, at.clean, end.done, end.looks)


def conclude(
    ranges: list[Range],
    ends: SearchEnds,
    seen: int,
    noise: float | None,
    calls: int,
    model: Callable[[np.ndarray], Model],
    reference: Reference | None,
) -> Calibration[Model]:
    """Chooses the best of several searches and states its errors and its verdict.

    Args:
      ranges: the free parameters, P of them.
      ends: where the searches ended.
      seen: how many residuals are data.
      noise: standard deviation of the data (m), or None to take it from the residuals.
      calls: how many times the model was run.
      model: makes the model of values [P].
      reference: evaluates a model on two grids, to find the grid's part of the errors; None leaves it unknown.
    """
    costs = np.nan_to_num(np.asarray(ends.cost, float), nan=1e30, posinf=1e30)
    best = int(np.argmin(costs))
    x, cost, done = np.asarray(ends.x[best], float), float(costs[best]), np.asarray(ends.done)
    jacobian = np.nan_to_num(np.asarray(ends.jacobian[best], float))
    names, low, high = [r.name for r in ranges], np.array([r.low for r in ranges]), np.array([r.high for r in ranges])
    spare = seen - len(ranges)
    sigma = math.sqrt(cost / spare) if noise is None else noise
    verdict = Verdict(0) if done[best] else Verdict.NOT_CONVERGED
    information = jacobian.T @ jacobian / max(sigma**2, 1e-30)
    curves, ways = np.linalg.eigh(information)
    told = curves > max(_IDLE, 1e-7 * curves[-1])
    covariance = (ways[:, told] / curves[told]) @ ways[:, told].T * np.outer(high - low, high - low)
    hidden = np.any(ways[:, ~told] ** 2 > 0.01, axis=1)
    covariance[hidden, :] = covariance[:, hidden] = np.nan
    covariance[hidden, hidden] = np.inf
    if hidden.any():
        verdict |= Verdict.NOT_TOLD
    if np.any((np.abs(x - 0.5) > 0.499) & ~hidden):
        verdict |= Verdict.AT_LIMIT
    apart = np.sum(((np.asarray(ends.x) - x) @ (ways[:, told] * np.sqrt(curves[told]))) ** 2, axis=1)
    if np.any(done & (costs - cost < 4 * sigma**2) & (apart > 25)):
        verdict |= Verdict.AMBIGUOUS
    if noise is None and spare < _SPARE:
        verdict |= Verdict.FEW_DATA
    if noise is not None and cost / noise**2 > spare + 5 * math.sqrt(2 * spare):
        verdict |= Verdict.POOR_FIT
    values, scale = low + x * (high - low), high - low
    noise_errors = np.sqrt(np.diag(covariance))
    way = (ways[:, told] / curves[told]) @ ways[:, told].T @ jacobian.T / max(sigma**2, 1e-30)
    limit = None if reference is None else seek_limit(x, way, noise_errors / scale, ~hidden, reference)
    total = covariance.copy()
    if limit is None:
        verdict |= Verdict.GRID_UNKNOWN
        shift = rest = np.full(x.shape, np.nan)
    else:
        shift, rest = (limit.x - x) * scale, limit.doubt * scale
        total += np.outer(shift, shift) + np.outer(rest, rest)
    grid_errors = np.where(hidden, np.nan, np.hypot(shift, rest))
    total[hidden, hidden] = np.inf

    def named(numbers: np.ndarray) -> dict[str, float]:
        return dict(zip(names, numbers.tolist(), strict=True))

    return Calibration(
        values=named(values),
        errors=named(np.sqrt(np.diag(total))),
        noise_errors=named(noise_errors),
        grid_errors=named(grid_errors),
        sand=named(values + shift),
        sand_errors=named(np.hypot(noise_errors, rest)),
        covariance=total,
        noise_covariance=covariance,
        untold=tuple(name for name, yes in zip(names, hidden, strict=True) if yes),
        residual=math.sqrt(cost / seen),
        noise=sigma,
        calls=calls,
        verdict=verdict if ends.clean[best] else verdict | Verdict.UNCLEAN,
        model=model(values),
    )
