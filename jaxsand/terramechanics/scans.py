"""Measured sections: laser scans across a trench, brought into the frame of a reference section. Host side, numpy only.

A reference is a function that gives heights (m) at x (m, an array), 0 beyond its toes. It is not used to judge the
measurement: spikes are told by neighbouring points, lift and tilt by the level sand, so that a wrong reference stays
visible.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

Reference = Callable[[np.ndarray], np.ndarray]
COLUMNS = ("beta_deg", "sinkage_mm", "scan", "x_mm", "z_mm")
_GIVE = f"give a CSV file of scans, whose first line names the columns {', '.join(COLUMNS)}"
STEP, GAP, MARGIN = 0.0005, 0.005, 0.01  # m: between samples; wider ones are left out; on either side of the toes
_SMALL = (np.nan, np.nan, 1.196, 1.495, 1.363, 1.206, 1.2, 1.14, 1.129, 1.107)  # MAD of n (Croux & Rousseeuw 1992)


@dataclass(frozen=True)
class Scan:
    """One pass of the scanner.

    Attributes:
      number: of the scan.
      x: places across the trench (m), rising.
      z: heights (m) at x.
      dropouts: how many points had no height and were left out.
    """

    number: int
    x: np.ndarray
    z: np.ndarray
    dropouts: int = 0


@dataclass(frozen=True)
class Measured:
    """A trench's measured section: the median of its aligned scans.

    Attributes:
      x: places (m), every `STEP`.
      z: median height (m) at x, NaN in gaps.
      spread: the noise (m) of one resampled scan at x, from the median absolute deviation; NaN for fewer than two scans.
      scans: how many there are.
      rejected: how many points of all scans were left out as spikes.
      shift, lift, tilt: the pose of each scan (m, m, rad), see `align`.
    """

    x: np.ndarray
    z: np.ndarray
    spread: np.ndarray
    scans: int
    rejected: int
    shift: np.ndarray
    lift: np.ndarray
    tilt: np.ndarray


def read_scans(path: str | Path, no_data: float | None = None) -> dict[tuple[float, float], list[Scan]]:
    """Reads all scans of a CSV file.

    The header names the columns: those of `COLUMNS` in any order, and others, which are ignored. Fields are separated by
    commas, or by semicolons or tabs (a comma is then a decimal point). Lines that start with # are comments. A height that
    is empty, nan or `no_data` (mm) is a drop-out.

    Returns:
      Lists of scans by trench (beta_deg, sinkage_mm), rising.

    Raises:
      ValueError: if the file cannot be read; names the file, the line, the column, what is wrong and what to give.
    """
    table, scans = _table(path, no_data), dict[tuple[float, float], list[Scan]]()
    for beta, sinkage, number in np.unique(table[:, :3], axis=0).tolist():
        rows = table[(table[:, :3] == (beta, sinkage, number)).all(1)]
        x, z, line = rows[np.isfinite(rows[:, 4]), 3:].T
        name = f"scan {number:g} of beta {beta:g}, sinkage {sinkage:g} (from line {rows[:, 5].min():.0f})"
        if x.size < 20:
            raise ValueError(f"measured: {path}: {name} has {x.size} points with a height; give at least 20")
        for i in np.flatnonzero(np.diff(x) == 0)[:1]:
            twice = f"x_mm {x[i]:g} in lines {line[i]:.0f}, {line[i + 1]:.0f}"
            raise ValueError(f"measured: {path}: {name} has {twice}; give it once")
        scans.setdefault((beta, sinkage), []).append(Scan(int(number), x / 1000, z / 1000, len(rows) - x.size))
    return scans


def mirrored(scan: Scan) -> Scan:
    """The scan with x reversed, for scans from the other side. `align` never tries it: a mirror image may fit by chance."""
    return replace(scan, x=-scan.x[::-1], z=scan.z[::-1])


def toes(reference: Reference) -> tuple[float, float]:
    """The outermost x (m, to 0.1 mm, within +-0.5 m) where the reference is more than 0.1 mm off level."""
    x = np.arange(-5000, 5001) * 1e-4
    off = x[np.abs(reference(x)) > 1e-4]
    if not off.size:
        raise ValueError("reference: is level within 0.5 m of its origin; give the section of a trench")
    return float(off[0]), float(off[-1])


def align(scan: Scan, reference: Reference) -> tuple[Scan, np.ndarray, int]:
    """Moves a scan into the frame of a reference section.

    The pose has the least pseudo-Huber misfit (1 mm). The search starts from the best of all shifts 1 mm apart that put the
    reference's middle within the scan. Sand beyond the toes, widened by `MARGIN`, weighs 100 times the section's, so that it
    determines lift and tilt, and the section the shift.

    Returns:
      The scan in the reference's frame; the x and z (m) of the reference's origin in the scanner's frame and the tilt (rad)
      there, [3]; and how many points were left out as spikes: those off the median of nine neighbours by 1.5 mm and by 4.5
      standard deviations of such differences.

    Raises:
      ValueError: if the scan is tilted by more than 10 degrees.
    """
    from scipy.optimize import least_squares

    off = np.abs(scan.z - np.median(np.lib.stride_tricks.sliding_window_view(np.pad(scan.z, 4, "reflect"), 9), axis=1))
    spikes = off > max(0.0015, 4.5 * 1.4826 * float(np.median(off)))
    x, z = scan.x[~spikes], scan.z[~spikes]
    left, right = toes(reference)

    def weight(u: np.ndarray) -> np.ndarray:
        return np.where((u < left - MARGIN) | (u > right + MARGIN), 1.0, 0.01)

    def turned(pose: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        u, v, c, s = x - pose[0], z - pose[1], math.cos(pose[2]), math.sin(pose[2])
        return c * u + s * v, c * v - s * u

    def misfits(pose: np.ndarray, weights: np.ndarray) -> np.ndarray:
        u, v = turned(pose)
        off = (v - reference(u)) * 1e3
        return off * np.sqrt(2 * weights / (1 + np.hypot(1, off)))

    shifts = np.arange(x[0], x[-1], 0.001) - (left + right) / 2
    u = x - shifts[:, None]
    w, off = weight(u), z - reference(u.ravel()).reshape(u.shape)
    a, b = (np.average(what, 1, w, keepdims=True) for what in (u, off))
    slope = np.sum(w * (u - a) * off, 1, keepdims=True) / np.sum(w * (u - a) ** 2, 1, keepdims=True)
    best = np.hypot(1, (off - b - slope * (u - a)) * 1e3).sum(1).argmin()
    pose = np.array([shifts[best], (b - slope * a)[best, 0], math.atan(slope[best, 0])])
    for _ in range(3):
        pose = least_squares(misfits, pose, x_scale=(1e-3, 1e-3, 1e-2), args=(weight(x - pose[0]),)).x
    if abs(pose[2]) > math.radians(10):
        raise ValueError(f"measured: scan {scan.number} is tilted by more than 10 degrees; level it, or check its units")
    x, z = np.array(sorted(zip(*turned(pose), strict=True))).T
    return replace(scan, x=x, z=z), pose, int(spikes.sum())


def resample(x: np.ndarray, z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Heights at the multiples of `STEP` within rising x (m).

    The points nearest to each multiple are averaged, in x as well as z, and joined by straight lines.

    Returns:
      The places [n] and the heights [n] (m), NaN within gaps wider than `GAP`.
    """
    _, sample, count = np.unique(np.round(x / STEP), return_inverse=True, return_counts=True)
    x, z = np.bincount(sample, x) / count, np.bincount(sample, z) / count
    grid = _samples(x[0], x[-1])
    after = np.clip(np.searchsorted(x, grid), 1, len(x) - 1)
    return grid, np.where(x[after] - x[after - 1] > GAP, np.nan, np.interp(grid, x, z))


def measured_profile(scans: Sequence[Scan], reference: Reference) -> Measured:
    """Aligns each of a trench's scans with the reference, and takes the median section."""
    if not scans:
        raise ValueError("measured: got no scans of a trench; give at least one")
    aligned, poses, rejected = zip(*(align(scan, reference) for scan in scans), strict=True)
    x = _samples(min(scan.x[0] for scan in aligned), max(scan.x[-1] for scan in aligned))
    z = np.ma.masked_invalid([np.interp(x, *resample(scan.x, scan.z), np.nan, np.nan) for scan in aligned])
    middle = np.ma.median(z, axis=0)
    small = np.array([*_SMALL, *(n / (n - 0.8) for n in range(10, len(scans) + 1))])[z.count(0)]
    spread = 1.4826 * small * np.ma.filled(np.ma.median(np.abs(z - middle), axis=0), np.nan)
    return Measured(x, np.ma.filled(middle, np.nan), spread, len(scans), sum(rejected), *np.array(poses).T)


def smoothed(z: np.ndarray) -> np.ndarray:
    """The running median over 3 mm (7 samples) of heights every `STEP`; NaN where one of them is unknown."""
    return np.median(np.lib.stride_tricks.sliding_window_view(np.pad(z, 3, constant_values=np.nan), 7), axis=1)


def compare(measured: Measured, reference: Reference) -> dict[str, float]:
    """How far a measured section is from the reference, between the reference's toes widened by `MARGIN`.

    The deepest points compared are those of both sections after `smoothed`: this treats the rounding of a pointed bottom
    alike in both. Noise still lowers the measured minimum: 0.6 mm of it deepen two scans of a flat floor by 0.3 mm.

    Returns:
      `mean` and `median` of |difference| (m), `depth`, the difference of the deepest points (m; NaN where the section was
      not measured at the reference's), `covered`, the share that was measured, and `partly`, whether that is below 80%.
    """
    left, right = toes(reference)
    x = _samples(left - MARGIN, right + MARGIN)
    z, true = np.interp(x, measured.x, measured.z, np.nan, np.nan), reference(x)
    seen, deep, off = smoothed(z), smoothed(true), np.abs(z - true)[np.isfinite(z)]
    mean, median = (float(off.mean()), float(np.median(off))) if off.size else (math.nan, math.nan)
    depth = abs(float(np.nanmin(seen) - np.nanmin(deep))) if np.isfinite(seen[np.nanargmin(deep)]) else math.nan
    covered = off.size / x.size
    return {"mean": mean, "median": median, "depth": depth, "covered": covered, "partly": covered < 0.8}


def _samples(left: float, right: float) -> np.ndarray:
    return np.arange(math.ceil(left / STEP - 1e-9), math.floor(right / STEP + 1e-9) + 1) * STEP


def _table(path: str | Path, no_data: float | None) -> np.ndarray:
    """Rows of `COLUMNS` and the line's number, x rising."""
    try:
        text = Path(path).read_text(encoding="utf-8-sig", errors="replace")
    except OSError as error:
        raise ValueError(f"measured: cannot read {path} ({error.strerror}); {_GIVE}") from None
    if "\0" in text:
        raise ValueError(f"measured: {path} is no text in UTF-8; {_GIVE}")
    lines = [(i, s) for i, s in enumerate(text.split("\n"), 1) if s.strip(' \t,;"') and not s.lstrip(' "').startswith("#")]
    if not lines:
        raise ValueError(f"measured: {path} is empty; {_GIVE}")
    head, header = lines[0]
    sign = next((s for s in ";\t" if s in header), ",")
    names = [name.strip(' "').lower() for name in header.split(sign)]
    for name in COLUMNS:
        if (many := names.count(name)) != 1:
            raise ValueError(f"measured: {path}: {many or 'no'} columns {name} in line {head}, the header; {_GIVE}")
    rows = []
    for line, text in lines[1:]:
        fields = [field.strip(' "').replace(",", ".") for field in text.split(sign)]
        if len(fields) != len(names):
            counts = f"{len(fields)} fields in line {line}, {len(names)} in the header"
            raise ValueError(f"measured: {path}: {counts}; give as many")
        rows.append(
            [_number(fields[names.index(name)], name, f"line {line} of {path}", no_data) for name in COLUMNS] + [line]
        )
    if not rows:
        raise ValueError(f"measured: no rows below line {head} of {path}; give one for each point of a scan")
    return np.array(sorted(rows, key=lambda row: row[3]))


def _number(text: str, name: str, where: str, no_data: float | None) -> float:
    try:
        value = float(text or "nan")
    except ValueError:
        value = math.inf
    if name == "z_mm" and value == no_data:
        return math.nan
    if not (abs(value) <= 1000 or (math.isnan(value) and name == "z_mm")) or (name == "scan" and value % 1):
        remedy = "a whole number" if name == "scan" else "degrees, or millimetres up to 1000 and nan for drop-outs"
        raise ValueError(f"measured: {name} is {text!r:.60} in {where}; give {remedy}")
    return value
