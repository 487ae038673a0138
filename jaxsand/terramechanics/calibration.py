"""Estimates parameters of sand and tool from height maps before and after a push or a collapse.

_least_squares.py has the method.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike

from jaxsand.interaction.rule import PushRule
from jaxsand.interaction.simulate import check_push, rollout
from jaxsand.relaxation.schemes import Scheme
from jaxsand.relaxation.settling import settle
from jaxsand.relaxation.stopping import Stop, check_rule, check_whole
from jaxsand.scene.masked import POINTS, gaps, unmasked
from jaxsand.scene.material import Material
from jaxsand.scene.scene import Scene, as_array, fit
from jaxsand.scene.tools import NoTool
from jaxsand.scene.validation import concrete, short
from jaxsand.terramechanics._least_squares import (
    Calibration,
    Free,
    Range,
    SearchEnds,
    as_ranges,
    check_noise,
    climb,
    conclude,
    spread,
)
from jaxsand.terramechanics._limit import Reference
from jaxsand.terramechanics.finer import OneGrid, TwoGrids, divide, finer, isotropic, means, resolve

_REPOSE = "repose_angle"
_TWO = TwoGrids()
_FINER = 3  # how many times as fine; odd, so that the middle of each cell is the middle of a cell of the finer grid
_ANGLES = (math.radians(10), math.radians(50))
_Rules = tuple[PushRule | None, Scheme | None, Stop | None]
_Labels = np.ndarray | jax.Array | None


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class _Group:
    """Trials of equally many strokes: heights `before` and `after` [k, H, W] (m), and `strokes` [k, n, 4] (m).

    `seen` [k, H, W] is true where `after` is known; elsewhere `after` is 0.
    """

    before: jax.Array
    after: jax.Array
    seen: jax.Array
    strokes: jax.Array


@dataclass(frozen=True)
class Trial:
    """One experiment for `calibrate`: a height map before, the pushes made, and the height map after.

    Args:
      before: heights [H, W] (m); `height[i, j]` is the cell centred at x = (j + 1/2) dx, y = (i + 1/2) dx. Must be finite.
      after: heights [H, W] (m) at rest; NaN or masked in cells that were not seen.
      stroke: x0, y0, x1, y1 (m) of one push [4], or of pushes one after the other [n, 4]; None where the sand only settles.

    Example:
      >>> import numpy as np
      >>> import jaxsand as js
      >>> column = np.zeros((8, 8))
      >>> column[3:5, 3:5] = 0.02
      >>> trial = js.Trial(before=column, after=np.full((8, 8), 0.00125))
      >>> trial.stroke is None
      True
    """

    before: ArrayLike | jax.Array
    after: ArrayLike | jax.Array
    stroke: ArrayLike | jax.Array | None = None


def calibrate(
    scene: Scene,
    trials: Trial | Sequence[Trial],
    *,
    free: Free = (_REPOSE, "width", "depth"),
    regions: ArrayLike | jax.Array | None = None,
    noise: float | None = None,
    starts: int = 6,
    push: PushRule | None = None,
    scheme: Scheme | None = None,
    stop: Stop | None = None,
    grid: TwoGrids | OneGrid = _TWO,
) -> Calibration[Scene]:
    """Finds the parameters with which the simulator best explains what was seen.

    Minimises sum (h(x) - after)^2 over the seen cells of all trials, h(x) the simulated map for parameters x.

    Args:
      scene: what is known; what is free starts from the values in it.
      trials: one or several experiments, which share the parameters.
      free: "repose_angle" and names of fields of the tool; or a mapping of these to their ranges (low, high), which the
        estimates never leave. By default the range is 10 to 50 degrees for the angle of repose, and a third to three times
        the scene's value for others.
      regions: labels [H, W] from 0 to R - 1 of regions with an angle of repose each; the parameters are then called
        repose_angle[0], repose_angle[1], ...
      noise: standard deviation (m) of the white noise in `after`; None estimates it from the residual.
      starts: how many searches are made; those after the first begin at places spread over the ranges.
      push, scheme, stop: how the simulator pushes and settles, as in `jaxsand.step`.
      grid: `TwoGrids()` also finds the error that the scene's grid causes, by repeating the fit with isotropic sand on the
        scene's grid and on one three times as fine. `OneGrid()` leaves it unknown and takes less time.

    Returns:
      A `Calibration`: `values` and their standard `errors` by name, the `verdict`, and the scene with the values put in as
      `model`. `values` are those of the simulator on this grid and `sand` those of the real sand. The errors include white
      noise in `after` and the grid's error (of its spacing and of its neighbourhood). They do not include other errors of
      the model, such as its rule of pushing, nor noise in `before`. Data that do not determine a parameter, or that no
      parameters explain, raise nothing: the verdict says so.

    Raises:
      ValueError: names the argument, its value and the remedy.

    Computes in the dtype of the maps; float32 will do. To learn what an experiment could tell before it is made, give a
    simulated `after` and the noise: `noise_errors` are then the Cramer-Rao bound.

    Source: Levenberg 1944; Marquardt 1963, doi:10.1137/0111030; for the grid's error Richardson 1911,
    doi:10.1098/rsta.1911.0009.

    Example:
      >>> import math
      >>> import jax.numpy as jnp
      >>> import jaxsand as js
      >>> column = jnp.zeros((9, 9)).at[3:6, 3:6].set(0.03)
      >>> sand = js.make_scene((9, 9), 0.01, repose_angle=math.radians(30), neighbours=4)
      >>> guess = js.make_scene((9, 9), 0.01, repose_angle=math.radians(27), neighbours=4)
      >>> trial = js.Trial(column, js.settle(sand, column).height)
      >>> found = js.calibrate(guess, trial, free=["repose_angle"])  # doctest: +SKIP
      >>> round(math.degrees(found.values["repose_angle"]), 2)  # doctest: +SKIP
      30.0

    The last two lines are not run by the tests: compiling the model and its derivatives takes 10 s and more.
    """
    some = [trials] if isinstance(trials, Trial) else list(trials)
    check_whole("starts", starts, 1)
    check_noise(noise)
    check_rule(scene, scheme, stop)
    if push is not None:
        check_push(push)
    if not isinstance(grid, TwoGrids | OneGrid):
        raise ValueError(f"grid: got {short(grid)}; give TwoGrids() or OneGrid()")
    groups, seen = _grouped(scene, some)
    labels = _labels(scene, regions)
    ranges, names = _ranges(scene, free, 0 if labels is None else int(labels.max()) + 1)
    if seen <= len(ranges):
        raise ValueError(f"trials: got {seen} seen cells for {len(ranges)} free parameters; give more, or free fewer")
    dtype = groups[0].before.dtype
    box = jnp.asarray([[r.low for r in ranges], [r.high for r in ranges]], dtype)
    begin, sigma = jnp.asarray(spread(ranges, starts), dtype), jnp.asarray(math.nan if noise is None else noise, dtype)
    rules = (push, scheme, stop)
    ends = _climbs(scene, rules, labels, groups, box, begin, jnp.asarray(seen, dtype), sigma, names)

    def model(values: np.ndarray) -> Scene:
        return _with(scene, names, labels, jnp.asarray(values, dtype))

    calls = int(ends.looks.sum()) * len(some)
    reference = _reference(scene, push, labels, groups, box, names) if isinstance(grid, TwoGrids) else None
    return conclude(ranges, ends, seen, noise, calls, model, reference)


@partial(jax.jit, static_argnames="names")
def _climbs(
    scene: Scene,
    rules: _Rules,
    labels: _Labels,
    groups: list[_Group],
    box: jax.Array,
    begin: jax.Array,
    seen: jax.Array,
    noise: jax.Array,
    names: tuple[str, ...],
) -> SearchEnds:
    """Fits from every start `begin` [starts, P], in units of the ranges `box` [2, P] (their low ends, their high ends)."""

    def residuals(x: jax.Array) -> tuple[jax.Array, jax.Array]:
        there = _with(scene, names, labels, box[0] + x * (box[1] - box[0]))
        return _misfits(there, rules, groups)

    return climb(residuals, begin, sum(group.before.size for group in groups), seen, noise)


def _reference(
    scene: Scene, push: PushRule | None, labels: _Labels, groups: list[_Group], box: jax.Array, names: tuple[str, ...]
) -> Reference:
    """The reference model of _limit.py: isotropic sand on the scene's grid and on a finer one, pushed by the same rule.

    It settles by the default scheme and stop rule. Its `x` [P] is in units of the ranges `box` [2, P].
    """
    coarse = isotropic(scene)
    split = None if labels is None else divide(labels, _FINER)
    resolved = jax.vmap(lambda before: resolve(scene, before, _FINER))
    grids = (
        (coarse, labels, groups),
        (finer(coarse, _FINER), split, [replace(group, before=resolved(group.before)) for group in groups]),
    )

    def reference(x: np.ndarray) -> tuple[np.ndarray, np.ndarray, bool]:
        values = box[0] + jnp.asarray(x, box.dtype) * (box[1] - box[0])
        (on_coarse, coarse_clean), (on_fine, fine_clean) = (_misfits_at(*some, push, values, names) for some in grids)
        fine = np.asarray(on_fine, float)
        return fine, (fine - np.asarray(on_coarse, float)) / (_FINER - 1), bool(coarse_clean & fine_clean)

    return reference


@partial(jax.jit, static_argnames="names")
def _misfits_at(
    scene: Scene, labels: _Labels, groups: list[_Group], push: PushRule | None, values: jax.Array, names: tuple[str, ...]
) -> tuple[jax.Array, jax.Array]:
    """`_misfits` for values [P] of the free parameters."""
    return _misfits(_with(scene, names, labels, values), (push, None, None), groups)


def _misfits(scene: Scene, rules: _Rules, groups: list[_Group]) -> tuple[jax.Array, jax.Array]:
    """Simulated less seen heights (m) of all cells of all trials, 0 in unseen cells, and whether all outcomes are clean.

    A scene on a finer grid than the data's is averaged over the data's cells first.
    """
    misfits, outcomes = [], []
    for group in groups:
        height, outcome = _run(scene, rules, group.before, group.strokes)
        misfits.append(jnp.where(group.seen, means(height, group.seen[0].shape) - group.after, 0).ravel())
        outcomes.append(outcome)
    return jnp.concatenate(misfits), jnp.all(jnp.concatenate(outcomes) == 0)


def _run(scene: Scene, rules: _Rules, before: jax.Array, strokes: jax.Array) -> tuple[jax.Array, jax.Array]:
    """The maps [k, H, W] (m) after the pushes, and outcomes [k] that are 0 where every push was clean."""
    push, scheme, stop = rules

    def one(before: jax.Array, strokes: jax.Array) -> tuple[jax.Array, jax.Array]:
        if not strokes.shape[0]:
            settled = settle(scene, before, scheme=scheme, stop=stop)
            return settled.height, settled.outcome
        shaped = rollout(scene, before, strokes, push=push, scheme=scheme, stop=stop)
        return shaped.height[-1], jnp.max(shaped.outcome)

    return jax.vmap(one)(before, strokes)


def _with(scene: Scene, names: tuple[str, ...], labels: _Labels, values: jax.Array) -> Scene:
    """The scene with the given values of the free parameters; angles of repose, if any, come first in `values`."""
    fields_of_tool = [name for name in names if name != _REPOSE]
    angles = values[: values.size - len(fields_of_tool)]
    if angles.size:
        scene = replace(scene, material=Material(angles[0] if labels is None else angles[labels]))
    if fields_of_tool:
        scene = replace(scene, tool=replace(scene.tool, **dict(zip(fields_of_tool, values[angles.size :], strict=True))))
    return scene


def _grouped(scene: Scene, trials: list[Trial]) -> tuple[list[_Group], int]:
    """Stacks the trials that have equally many strokes, and counts the seen cells."""
    if not trials:
        raise ValueError("trials: got none; give at least one Trial(before, after, stroke)")
    for trial in trials:
        if not isinstance(trial, Trial):
            raise ValueError(f"trials: got {type(trial).__name__}; give Trial(before, after, stroke), or several")
    groups: dict[int, list[_Group]] = {}
    dtype = jnp.result_type(*(as_array("before", trial.before) for trial in trials))
    for trial in trials:
        try:
            before = fit(scene, as_array("before", trial.before, dtype))[1]
        except ValueError as error:
            raise ValueError(str(error).replace("height:", "before:", 1)) from None
        after = as_array("after", gaps(trial.after), dtype)
        strokes = jnp.zeros((0, 4), dtype) if trial.stroke is None else as_array("stroke", trial.stroke, dtype, POINTS)
        if strokes.shape != (4,) and (strokes.ndim != 2 or strokes.shape[1] != 4):
            raise ValueError(f"stroke: got shape {list(strokes.shape)}; give x0, y0, x1, y1, rows of these, or None")
        if strokes.size and isinstance(scene.tool, NoTool):
            raise ValueError("stroke: got one, but the scene has no tool; give the scene a Blade or a Wheel")
        for name, value in (("before", before), ("stroke", strokes)):
            if bad := int(np.sum(~np.isfinite(value))):
                raise ValueError(f"{name}: got {bad} numbers that are not finite; fill them (only `after` may have gaps)")
        if after.shape != before.shape:
            raise ValueError(f"after: got shape {list(after.shape)}; give one like before's, {list(before.shape)}")
        seen = jnp.isfinite(after)
        strokes = strokes.reshape(-1, 4)
        groups.setdefault(strokes.shape[0], []).append(_Group(before, jnp.where(seen, after, 0), seen, strokes))
    stacked = [jax.tree.map(lambda *parts: jnp.stack(parts), *some) for some in groups.values()]
    return stacked, sum(int(group.seen.sum()) for group in stacked)


def _labels(scene: Scene, regions: ArrayLike | jax.Array | None) -> np.ndarray | None:
    """The labels as int32; raises ValueError unless they fit the scene and leave no number out."""
    if regions is None:
        return None
    labels = np.asarray(unmasked("regions", regions, "give every cell a region, such as regions.filled(0)"))
    if labels.dtype.kind not in "iu" or labels.shape != scene.grid.shape:
        got = f"{labels.dtype} of shape {list(labels.shape)}"
        raise ValueError(f"regions: got {got}; give whole numbers of shape {list(scene.grid.shape)}")
    if set(np.unique(labels).tolist()) != set(range(int(labels.max()) + 1)):
        raise ValueError(f"regions: got labels {np.unique(labels).tolist()}; number the regions 0, 1, ... without gaps")
    return labels.astype(np.int32)


def _ranges(scene: Scene, free: Free, regions: int) -> tuple[list[Range], tuple[str, ...]]:
    """A range for every parameter, and the names that are free, the angle of repose first; with regions it has several."""
    asked = as_ranges(free)
    values = {field.name: concrete(getattr(scene.tool, field.name)) for field in fields(scene.tool)}
    tool = {name: float(value) for name, value in values.items() if value is not None and np.isfinite(value).all()}
    unknown = set(asked) - {_REPOSE, *tool}
    if unknown:
        raise ValueError(f"free: got {sorted(unknown)}; choose from {[_REPOSE, *tool]}")
    if regions and _REPOSE not in asked:
        raise ValueError("regions: got labels, but the angle of repose is not free; name it in free, or leave regions out")
    names = tuple(sorted(asked, key=lambda name: name != _REPOSE))
    ranges = []
    for name in names:
        if name == _REPOSE:
            guess = float(np.mean(np.asarray(scene.material.repose_angle)))
            low, high = asked[name] or _ANGLES
            if not 0 < low < high < math.pi / 2:
                raise ValueError(
                    f"free: got {short(low)} to {short(high)} for repose_angle; give rad above 0 and below pi/2"
                )
            many = [f"{name}[{k}]" for k in range(regions)] or [name]
            ranges += [Range(one, low, high, guess) for one in many]
        else:
            ranges.append(_range_of_tool(scene, name, tool[name], asked[name]))
    return ranges, names


def _range_of_tool(scene: Scene, name: str, guess: float, ends: tuple[float, float] | None) -> Range:
    """The range of a field of the tool: `ends`, or a third to three times the guess as far as the field allows."""
    least = float(scene.grid.spacing) if name in ("width", "thickness", "radius") else -math.inf
    most = {"slip_angle": math.pi / 2, "sinkage": float(getattr(scene.tool, "radius", math.inf))}.get(name, math.inf)
    if ends is None:
        if not guess > 0:
            raise ValueError(
                f"free: got a guess of {short(guess)} for {name}; give its range, as in {{{name!r}: (low, high)}}"
            )
        ends = max(guess / 3, least), min(3 * guess, most)
    if not least * (1 - 1e-6) <= ends[0] < ends[1] <= most:
        raise ValueError(
            f"free: got {short(ends[0])} to {short(ends[1])} for {name}; give (low, high) from {least:g} to {most:g}"
        )
    return Range(name, *ends, guess)
