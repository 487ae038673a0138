"""The wheel's trenches: simulated over slip angles and sinkages, and compared with what is known of them.

The experiment of arXiv:1908.02745, section IV: a wheel is towed across level sand, and the section of its trench half-way is
compared with the closed form, with the exact relaxation (wheel_trench.py), and with a user's scans (scans.py).
"""

import math
import time
from collections.abc import Iterable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxsand.interaction.outcome import check
from jaxsand.interaction.rule import PushRule
from jaxsand.interaction.simulate import step
from jaxsand.interaction.stepped import SteppedPush
from jaxsand.interaction.wheel_closed_form import SplitPush
from jaxsand.relaxation.batching import cores
from jaxsand.scene.progress import Tell, quiet
from jaxsand.scene.scene import make_scene
from jaxsand.scene.tools import Wheel
from jaxsand.scene.window import Window
from jaxsand.terramechanics.scans import Scan, compare, measured_profile
from jaxsand.terramechanics.wheel_trench import Pass, Profile, closed_form, relaxed

Figures = dict[str, Any]  # what was found of one case, by name

Trench = tuple[float, float]  # slip angle (degrees), sinkage (mm)
ANGLES = (0.0, 22.5, 45.0, 67.5, 90.0)
SINKAGES = (5.0, 15.0, 25.0)
TRENCHES: tuple[Trench, ...] = tuple((beta, sinkage) for sinkage in SINKAGES for beta in ANGLES)
RULES: dict[str, PushRule] = {"own": SteppedPush(), "split": SplitPush()}
FIGURES = ("mean_abs_mm", "median_abs_mm", "depth_error_mm")
# arXiv:1908.02745: its simulator over 14 trenches, against the closed form and against LIDAR scans (mm).
PAPER = {
    "closed-form": dict(zip(FIGURES, (1.1, 0.4, 0.6), strict=True)),
    "measured": dict(zip(FIGURES, (2.2, 1.7, 0.9), strict=True)),
    "closed-form mean by angle": dict(zip(ANGLES, (0.5, 1.6, 1.7, 1.2, 0.4), strict=True)),
    "closed-form mean by sinkage": dict(zip(SINKAGES, (0.4, 0.6, 2.2), strict=True)),
}
_WIDE, _BEFORE, _LENGTH, _AFTER = 0.32, 0.1, 1.0, 0.14  # m: across the way; along it
_AROUND = 0.28  # m of the way that are computed at a time
_SHOWN = 2e-3  # m between the cells of a map that is kept
_APART = 0.05  # m between the sections that tell how steady the trench is


@dataclass(frozen=True)
class Rut:
    """The trench of one simulated pass.

    Attributes:
      profile: the section half-way.
      unsteady: the mean distance (m) between that section and the one 5 cm before it.
      seconds: how long the simulation took.
      height: the sand that it left (m), row 0 at y = 0: at every cell, or at one every 2 mm where those are finer.
      spacing: of the cells of `height` (m).
    """

    profile: Profile
    unsteady: float
    seconds: float
    height: np.ndarray
    spacing: float


def simulate(trench: Trench, spacing: float, push: PushRule) -> Rut:
    """Tows the paper's wheel one metre over level sand on cells of `spacing` (m), and takes the section half-way.

    The wheel runs along the middle of a row of cells. The sand is computed in a window that follows the wheel, and settles
    everywhere at the end.

    Raises:
      OutcomeError: if the sand does not come to rest.
    """
    shape = round(_WIDE / spacing) // 2 * 2 + 1, round((_BEFORE + _LENGTH + _AFTER) / spacing)
    window = Window((shape[0], min(round(_AROUND / spacing), shape[1])), math.inf)
    wheel = Wheel(sinkage=trench[1] * 1e-3, slip_angle=math.radians(trench[0]))
    scene = make_scene(shape, spacing, tool=wheel, window=window)
    middle = shape[0] * spacing / 2
    stroke = np.array([_BEFORE, middle, _BEFORE + _LENGTH, middle])
    began = time.perf_counter()
    shaped = jax.block_until_ready(step(scene, jnp.zeros(shape, jnp.float32), stroke, push=push))
    seconds = time.perf_counter() - began
    check(shaped)
    # Left of the way, where y is larger, is the section's left.
    across = (np.arange(shape[0]) - shape[0] // 2) * spacing

    def section(along: float) -> Profile:
        return Profile(across, np.asarray(shaped.height, float)[::-1, int(along / spacing)])

    half, earlier = section(_BEFORE + _LENGTH / 2), section(_BEFORE + _LENGTH / 2 - _APART)
    every = max(1, round(_SHOWN / spacing))
    kept = np.asarray(shaped.height)[::every, ::every]
    return Rut(half, float(np.abs(half.z - earlier.z).mean()), seconds, kept, every * spacing)


def simulate_all(trenches: Iterable[Trench], spacing: float, push: PushRule, tell: Tell = quiet) -> dict[Trench, Rut]:
    """Calls `simulate` for every trench, on all cores."""
    trenches = list(trenches)

    def one(trench: Trench) -> Rut:
        tell(f"wheel at {trench[0]:g} degrees, {trench[1]:g} mm, spacing {spacing * 1e3:g} mm")
        return simulate(trench, spacing, push)

    first = one(trenches[0])  # compiles
    with ThreadPoolExecutor(cores()) as pool:
        return {trenches[0]: first} | dict(zip(trenches[1:], pool.map(one, trenches[1:]), strict=True))


def distances(profile: Profile, reference: Profile) -> np.ndarray:
    """The distances (mm) between two profiles every 0.5 mm, between the reference's toes widened by 10 mm."""
    x = np.arange(reference.toes[0] - 0.01, reference.toes[1] + 0.01, 5e-4)
    return np.abs(profile(x) - reference(x)) * 1e3


def errors(profile: Profile, reference: Profile) -> dict[str, float]:
    """The mean and the median of the `distances`, and the difference of the deepest points (mm)."""
    apart = distances(profile, reference)
    figures = float(apart.mean()), float(np.median(apart)), abs(profile.deepest - reference.deepest) * 1e3
    return dict(zip(FIGURES, figures, strict=True))


def references(trenches: Iterable[Trench]) -> dict[str, dict[Trench, Profile]]:
    """The closed form and the exact relaxation of every trench."""
    trenches = list(trenches)
    runs = [Pass(math.radians(beta), sinkage * 1e-3) for beta, sinkage in trenches]
    return {
        "closed-form": {trench: closed_form(run) for trench, run in zip(trenches, runs, strict=True)},
        "exact": dict(zip(trenches, relaxed(runs), strict=True)),
    }


def compare_with_scans(
    ruts: dict[Trench, Rut], scans: dict[Trench, list[Scan]]
) -> tuple[list[Figures], dict[Trench, Profile]]:
    """Compares simulated trenches with scans of them.

    Returns:
      A row of figures for every trench that was scanned, and the measured sections in the frame of the simulated ones.
    """
    rows, sections = [], {}
    for trench, some in scans.items():
        profile = ruts[trench].profile
        settled = Profile(profile.x, np.where(np.abs(profile.z) > 1e-5, profile.z, 0))
        measured = measured_profile(some, settled)
        against = compare(measured, settled)
        figures = {name: against[key] * 1e3 for name, key in zip(FIGURES, ("mean", "median", "depth"), strict=True)}
        shown = {"scans": measured.scans, "spikes": measured.rejected, "covered": against["covered"]}
        rows.append({**_named(trench), "reference": "measured", **figures, **shown})
        known = np.isfinite(measured.z)
        sections[trench] = Profile(measured.x[known], measured.z[known])
    return rows, sections


def check_scans(scans: dict[Trench, list[Scan]]) -> None:
    """Raises ValueError for scans of a trench that the experiment cannot simulate."""
    for beta, sinkage in scans:
        if not (0 <= beta <= 90 and 1 <= sinkage <= 30):
            raise ValueError(
                f"measured: got a trench of beta {beta:g} degrees, sinkage {sinkage:g} mm; give 0 to 90 degrees and "
                "sinkages of 1 to 30 mm"
            )


def experiment(
    spacing: float = 2e-3,
    rules: Iterable[str] = tuple(RULES),
    scans: dict[Trench, list[Scan]] | None = None,
    tell: Tell = quiet,
) -> tuple[Figures, dict[str, dict[Trench, Profile]], dict[str, dict[Trench, Rut]]]:
    """Simulates all fifteen trenches with each rule, and compares them.

    Args:
      spacing: of the cells (m).
      rules: names from `RULES`.
      scans: measured scans by trench, if any.
      tell: is called with a line of progress.

    Returns:
      The table: `rows`, and their means in `summary`, `by_beta_deg` and `by_sinkage_mm`; and the profiles by their source,
        which is a rule or a reference. Scans are aligned with the sections of each rule: `measured` has those aligned with
        the first rule's, `measured-split` those aligned with a second one's. Last, the ruts of each rule.
    """
    known = references(TRENCHES)
    profiles: dict[str, dict[Trench, Profile]] = dict(known)
    made: dict[str, dict[Trench, Rut]] = {}
    rows: list[Figures] = []
    scans = scans or {}
    for rule in rules:
        ruts = made[rule] = simulate_all(dict.fromkeys([*TRENCHES, *scans]), spacing, RULES[rule], tell)
        profiles[rule] = {trench: rut.profile for trench, rut in ruts.items()}
        for name, of in known.items():
            for trench, reference in of.items():
                rut = ruts[trench]
                figures = errors(rut.profile, reference)
                cost = {"unsteady_mm": rut.unsteady * 1e3, "seconds": rut.seconds}
                rows.append({**_named(trench), "rule": rule, "reference": name, **figures, **cost})
        if scans:
            more, laid = compare_with_scans(ruts, scans)
            profiles["measured" if "measured" not in profiles else f"measured-{rule}"] = laid
            rows += [{"rule": rule, **row} for row in more]
    baseline = [
        {**_named(t), "rule": "exact", "reference": "closed-form", **errors(p, known["closed-form"][t])}
        for t, p in known["exact"].items()
    ]
    means = partial(_means, rows + baseline)
    report = {
        "spacing_mm": spacing * 1e3,
        "rows": rows,
        "summary": means(),
        "by_beta_deg": {f"{beta:g}": means(beta_deg=beta) for beta in ANGLES},
        "by_sinkage_mm": {f"{sinkage:g}": means(sinkage_mm=sinkage) for sinkage in SINKAGES},
        "paper": PAPER,
        "not_scanned": [list(trench) for trench in TRENCHES if trench not in scans] if scans else [],
    }
    return report, profiles, made


def _named(trench: Trench) -> dict[str, float]:
    return {"beta_deg": trench[0], "sinkage_mm": trench[1]}


def _means(rows: list[Figures], **of: float) -> dict[str, dict[str, dict[str, float]]]:
    """The figures averaged over the rows that have the given values: {rule: {reference: figures}}."""
    some = [row for row in rows if all(row[key] == value for key, value in of.items())]
    table: dict[str, dict[str, dict[str, float]]] = {}
    for rule, reference in dict.fromkeys((row["rule"], row["reference"]) for row in some):
        alike = [row for row in some if (row["rule"], row["reference"]) == (rule, reference)]
        known = {name: [row[name] for row in alike if math.isfinite(row[name])] for name in FIGURES}
        means = {name: float(np.mean(values)) if values else math.nan for name, values in known.items()}
        table.setdefault(rule, {})[reference] = means
    return table
