"""Measured sections: reading scans, aligning them, and what comparing with them is worth."""

import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from jaxsand.terramechanics import scans
from jaxsand.terramechanics.wheel_trench import Pass, closed_form

from ..conftest import MU

FIXTURE = Path(__file__).parent / "synthetic_scans.csv"
MM = 1e-3
NOISE = 0.6  # mm


def section(depth: float, left: float, right: float, floor: float = 0.0) -> Callable[[np.ndarray], np.ndarray]:
    """A trench with a level floor (none: a V) between two berms, all slopes at 29 degrees (m)."""
    x, z = [0.0], [-depth]
    for way, berm in ((-1, left), (1, right)):
        crest = floor / 2 + (depth + berm) / MU
        more = [way * floor / 2, way * crest, way * (crest + berm / MU)]
        x, z = x + more, [*z, -depth, berm, 0.0]
    order = np.argsort(x, kind="stable")
    return lambda at: np.interp(at, np.array(x)[order], np.array(z)[order], 0.0, 0.0)


def sections() -> dict[tuple[float, float], Callable[[np.ndarray], np.ndarray]]:
    """The closed form's trenches of a wheel. One is missing."""
    return {
        (beta, sinkage): closed_form(Pass(math.radians(beta), sinkage * MM))
        for beta in (0.0, 22.5, 45.0, 67.5, 90.0)
        for sinkage in (5.0, 15.0, 25.0)
        if (beta, sinkage) != (67.5, 15.0)
    }


def one_scan(reference, rng, pose=(0.0, 0.0, 0.0), noise=NOISE, points=350, half=130.0, spike=0.01) -> np.ndarray:
    """Points x, z (mm) in the scanner's frame; pose: shift, lift (mm), tilt (degrees). Heights may be nan."""
    spacing = 2 * half / points
    x = (np.arange(points) + 0.5 + rng.uniform(-0.3, 0.3, points)) * spacing - half
    z = reference(x * MM) / MM + noise * rng.standard_normal(points)
    z = z + (rng.random(points) < spike) * rng.uniform(-20, 20, points)
    shift, lift, tilt = pose[0], pose[1], math.radians(pose[2])
    u = shift + x * math.cos(tilt) - z * math.sin(tilt)
    v = lift + x * math.sin(tilt) + z * math.cos(tilt)
    v[rng.random(points) < 0.01 * (spike > 0)] = np.nan
    return np.stack([u, v], 1)[np.argsort(u)]


def synthetic_scans(references: dict[tuple[float, float], Callable[[np.ndarray], np.ndarray]], seed: int) -> str:
    """A file of two scans a trench with noise, spikes, drop-outs and the scanner's own pose."""
    rng = np.random.default_rng(seed)
    lines = ["# SYNTHETIC: made by tests/terramechanics/test_scans.py, measured by nobody", ",".join(scans.COLUMNS)]
    for (beta, sinkage), reference in references.items():
        for number in (1, 2):
            pose = rng.uniform(-20, 20), rng.uniform(-3, 3), rng.uniform(-1, 1)
            points = one_scan(reference, rng, pose, points=int(rng.integers(300, 401)))
            lines += [f"{beta:g},{sinkage:g},{number},{x:.2f},{z:.2f}" for x, z in points]
    return "\n".join(lines) + "\n"


def as_scan(points: np.ndarray, number: int = 1) -> scans.Scan:
    x, z = points[np.isfinite(points[:, 1])].T * MM
    return scans.Scan(number, x, z)


def a_pose(rng) -> tuple[float, float, float]:
    return rng.uniform(-20, 20), rng.uniform(-3, 3), rng.uniform(-1, 1)


def in_mm(pose: np.ndarray) -> np.ndarray:
    """Shift, lift in mm, tilt in degrees."""
    return np.array([pose[0] / MM, pose[1] / MM, math.degrees(pose[2])])


def true_section(reference) -> scans.Measured:
    """What an exact scanner would measure."""
    return scans.measured_profile(
        [as_scan(one_scan(reference, np.random.default_rng(0), noise=0, spike=0, points=2000))], reference
    )


def test_the_fixture_is_what_its_maker_writes():
    text = synthetic_scans(sections(), seed=1)
    assert FIXTURE.read_text(encoding="utf-8") == text
    assert "SYNTHETIC" in text.split("\n")[0]
    assert len(text) < 300_000


def test_the_fixture_is_read_and_compares_well_with_its_own_sections():
    table, known = scans.read_scans(FIXTURE), sections()
    assert list(table) == sorted(known)
    assert (67.5, 15.0) not in table
    for key, some in table.items():
        assert [s.number for s in some] == [1, 2]
        assert all(280 <= s.x.size + s.dropouts <= 400 and np.all(np.diff(s.x) > 0) for s in some)
        misfit = scans.compare(scans.measured_profile(some, known[key]), known[key])
        assert misfit["mean"] < 0.4 * MM
        assert misfit["median"] < 0.35 * MM
        assert misfit["depth"] < 0.8 * MM
        assert misfit["covered"] > 0.95
        assert not misfit["partly"]
    assert sum(s.dropouts for some in table.values() for s in some) > 30


def test_the_pose_is_exact_without_noise():
    rng = np.random.default_rng(2)
    for reference in sections().values():
        pose = a_pose(rng)
        aligned, found, rejected = scans.align(as_scan(one_scan(reference, rng, pose, noise=0, spike=0)), reference)
        assert in_mm(found) == pytest.approx(pose, abs=1e-6)
        assert aligned.z == pytest.approx(reference(aligned.x), abs=1e-9)
        assert not rejected


def test_the_scanner_may_start_anywhere():
    rng = np.random.default_rng(3)
    reference = section(15 * MM, 2 * MM, 8 * MM)
    for shift in (-900.0, -130.0, 130.0, 700.0):
        points = one_scan(reference, rng, (shift, 50.0, 3.0))
        assert in_mm(scans.align(as_scan(points), reference)[1]) == pytest.approx((shift, 50, 3), abs=0.5)


@pytest.mark.parametrize("deeper", [1.0, 0.6, 1.4])
def test_noise_spikes_and_a_wrong_reference_leave_the_pose_within_bounds(deeper):
    rng = np.random.default_rng(4)
    off: dict[float, list] = {5.0: [], 15.0: [], 25.0: []}
    for (_, sinkage), reference in 4 * list(sections().items()):
        pose = a_pose(rng)
        points = one_scan(reference, rng, pose, points=int(rng.integers(300, 401)))
        found = scans.align(as_scan(points), lambda x, z=reference: deeper * z(x))[1]
        off[sinkage].append(in_mm(found) - pose)
    for sinkage, some in off.items():
        assert np.all(np.abs(some).max(0) < (1.0 if sinkage == 5 or deeper != 1 else 0.5, 0.3, 0.15))
        assert np.all(np.abs(np.mean(some, axis=0)) < (0.15, 0.05, 0.03))


def test_a_wrong_reference_is_not_flattered():
    reference = section(20 * MM, 6 * MM, 6 * MM, 10 * MM)
    rng = np.random.default_rng(5)
    wrong = section(14 * MM, 6 * MM, 6 * MM, 10 * MM)
    some = [as_scan(one_scan(reference, rng, a_pose(rng))) for _ in range(4)]
    misfit = scans.compare(scans.measured_profile(some, wrong), wrong)
    assert misfit["depth"] == pytest.approx(6 * MM, abs=0.5 * MM)
    assert misfit["covered"] > 0.95


def test_spikes_do_not_move_the_result():
    rng = np.random.default_rng(6)
    reference = section(15 * MM, 4 * MM, 6 * MM)
    points = one_scan(reference, rng, (7.0, 1.0, 0.5), spike=0)
    spiky = points.copy()
    at = np.arange(0, len(points), 40)
    spiky[at, 1] += np.where(at % 80, 20, -20)
    clean, moved = (scans.align(as_scan(p), reference) for p in (points, spiky))
    assert in_mm(moved[1]) == pytest.approx(in_mm(clean[1]), abs=0.03)
    assert at.size <= moved[2] <= clean[2] + at.size
    alone = points.copy()
    alone[100, 1] += 1000
    high = points.copy()
    high[100, 1] += 5
    one, other = (scans.measured_profile([as_scan(p)], reference) for p in (alone, high))
    assert np.array_equal(one.z, other.z)
    assert one.rejected == other.rejected > 0


def test_a_mirror_image_is_only_taken_when_asked_for():
    rng = np.random.default_rng(7)
    reference = section(15 * MM, 2 * MM, 9 * MM)
    scan = as_scan(one_scan(lambda x: reference(-x), rng, spike=0))
    wrong, right = (scans.compare(scans.measured_profile([s], reference), reference) for s in (scan, scans.mirrored(scan)))
    assert right["mean"] < 0.6 * MM < 1.2 * MM < wrong["mean"]
    twice = scans.mirrored(scans.mirrored(scan))
    assert np.array_equal(twice.x, scan.x)
    assert np.array_equal(twice.z, scan.z)


def test_resampling_is_exact_for_lines_and_leaves_gaps_out():
    rng = np.random.default_rng(8)
    x = np.sort(rng.uniform(-0.1, 0.1, 900))
    grid, z = scans.resample(x, 0.3 * x + 0.01)
    assert np.all(np.isfinite(z))
    assert z == pytest.approx(0.3 * grid + 0.01, abs=1e-15)
    assert grid == pytest.approx(np.round(grid / scans.STEP) * scans.STEP, abs=1e-15)
    assert x[0] <= grid[0] < x[0] + 2 * scans.STEP
    for width, missing in ((4.5 * MM, False), (5.5 * MM, True)):
        x = np.concatenate([np.arange(50) * 0.25 * MM, 49 * 0.25 * MM + width + np.arange(50) * 0.25 * MM])
        grid, z = scans.resample(x, 0.3 * x)
        inside = (grid > 13 * MM) & (grid < 12.5 * MM + width - 0.5 * MM)
        assert np.all(np.isnan(z[inside]) == missing)
        assert np.all(np.isfinite(z[grid < 12 * MM]))


def test_the_spread_is_the_noise():
    rng = np.random.default_rng(9)
    reference = section(15 * MM, 6 * MM, 6 * MM, 20 * MM)
    for count in (2, 3, 12):
        some = [as_scan(one_scan(reference, rng, a_pose(rng), spike=0, points=400)) for _ in range(count)]
        m = scans.measured_profile(some, reference)
        # Between two points, a straight line averages their noise: over a spacing, to sqrt(2/3) of it.
        assert np.nanmean(m.spread) == pytest.approx(math.sqrt(2 / 3) * NOISE * MM, rel=0.1)
        assert m.scans == m.shift.size == m.lift.size == m.tilt.size == count
    alone = scans.measured_profile(some[:1], reference)
    assert np.all(np.isnan(alone.spread))


def test_the_median_covers_what_any_scan_covers():
    reference = section(15 * MM, 6 * MM, 6 * MM)
    rng = np.random.default_rng(10)
    left, right = (as_scan(one_scan(reference, rng, noise=0, spike=0)) for _ in range(2))
    left, right = (scans.Scan(1, s.x[at], s.z[at]) for s, at in ((left, left.x < 0.08), (right, right.x > -0.08)))
    m = scans.measured_profile([left, right], reference)
    assert np.all(np.isfinite(m.z))
    assert np.all(np.isfinite(m.spread[np.abs(m.x) < 0.079]))
    assert np.all(np.isnan(m.spread[np.abs(m.x) > 0.081]))


@pytest.mark.wide
@pytest.mark.parametrize(
    ("count", "low", "high", "most"), [(1, -0.5, -0.1, 1.5), (2, -0.35, -0.05, 0.9), (12, -0.2, 0.05, 0.4)]
)
def test_noise_makes_a_trench_seem_deeper_by_so_much(count, low, high, most):
    rng = np.random.default_rng(11)
    off = []
    for reference in sections().values():
        m = scans.measured_profile([as_scan(one_scan(reference, rng, a_pose(rng))) for _ in range(count)], reference)
        off.append(np.nanmin(scans.smoothed(m.z)) - np.nanmin(scans.smoothed(reference(m.x))))
    assert low < np.mean(off) / MM < high
    assert np.abs(off).max() < most * MM


def test_the_measure_is_exact_for_known_differences():
    reference = section(15 * MM, 6 * MM, 6 * MM)
    m = true_section(reference)
    same = scans.compare(m, reference)
    assert same["mean"] < 0.01 * MM
    assert same["depth"] < 0.03 * MM
    assert same["covered"] == 1
    lifted = scans.Measured(m.x, m.z + 2 * MM, m.spread, 1, 0, m.shift, m.lift, m.tilt)
    for name in ("mean", "median", "depth"):
        assert scans.compare(lifted, reference)[name] == pytest.approx(2 * MM, abs=0.03 * MM)


def test_a_trench_that_was_partly_measured_is_flagged():
    reference = section(15 * MM, 6 * MM, 6 * MM)
    left, right = scans.toes(reference)
    assert (left, right) == pytest.approx((-27 * MM / MU, 27 * MM / MU), abs=0.3 * MM)
    m = true_section(reference)
    for share, partly in ((0.85, False), (0.75, True), (0.4, True), (0.0, True)):
        edge = left - scans.MARGIN + share * (right - left + 2 * scans.MARGIN)
        cut = scans.Measured(m.x, np.where(m.x < edge, m.z, np.nan), m.spread, 1, 0, m.shift, m.lift, m.tilt)
        misfit = scans.compare(cut, reference)
        assert misfit["partly"] == partly
        assert misfit["covered"] == pytest.approx(share, abs=0.01)
        assert math.isnan(misfit["depth"]) == (share < 0.5)
        assert math.isnan(misfit["mean"]) == (share == 0)


HEADER = ",".join(scans.COLUMNS)
ROWS = [f"22.5,5,1,{x},{-x / 10}" for x in range(25)]


def written(folder: Path, lines: list[str], end: str = "\n") -> Path:
    path = folder / "scans.csv"
    path.write_bytes(end.join(lines).encode("utf-8"))
    return path


@pytest.mark.parametrize(
    ("lines", "end"),
    [
        ([HEADER, *ROWS], "\n"),
        ([HEADER, *ROWS, ""], "\r\n"),
        (["\ufeff# a comment, °", "", HEADER, "# more", *ROWS[:9], ",,,,", *ROWS[9:], "  "], "\r\n"),
        ([HEADER.replace(",", ";"), *(r.replace(",", ";").replace(".", ",") for r in ROWS)], "\n"),
        ([HEADER.replace(",", "\t"), *(r.replace(",", "\t") for r in ROWS)], "\n"),
        ([HEADER, *reversed(ROWS)], "\n"),
        (["\ufeff" + HEADER.upper(), *(f"{r} " for r in ROWS)], "\r\n"),
        (["note," + ",".join(reversed(scans.COLUMNS)), *("good," + ",".join(reversed(r.split(","))) for r in ROWS)], "\n"),
        (['"' + HEADER.replace(",", '","') + '"', *ROWS, "22.5,5,1,-1,nan", "22.5,5,1,99,"], "\n"),
    ],
)
def test_reading_ways_to_write_the_same(tmp_path, lines, end):
    table = scans.read_scans(written(tmp_path, lines, end))
    assert list(table) == [(22.5, 5.0)]
    (scan,) = table[22.5, 5.0]
    assert scan.number == 1
    assert scan.x == pytest.approx(np.arange(25) * MM)
    assert scan.z == pytest.approx(-np.arange(25) * MM / 10)
    assert scan.dropouts == (2 if "nan" in lines[-2] else 0)


@pytest.mark.parametrize(
    ("lines", "message"),
    [
        ([], "measured: FILE is empty; give a CSV file of scans, whose first line names the columns beta_deg, .* z_mm"),
        ([HEADER.replace("z_mm", "z"), *ROWS], "measured: FILE: no columns z_mm in line 1, the header; give"),
        (["A walk on the beach", "and back"], "measured: FILE: no columns beta_deg in line 1, the header; give a CSV"),
        ([HEADER, *ROWS, "22.5,5,1,30,deep"], "measured: z_mm is 'deep' in line 27 of FILE; give degrees, or millimetres"),
        (["#", HEADER + ",scan", *ROWS], "measured: FILE: 2 columns scan in line 2, the header; give"),
        (["", HEADER], "measured: no rows below line 2 of FILE; give one for each point"),
        ([HEADER, *ROWS, "22.5,5,1,x,0"], "measured: x_mm is 'x' in line 27 of FILE; give degrees, or millimetres"),
        ([HEADER, *ROWS, "22.5,5,1,nan,0"], "measured: x_mm is 'nan' in line 27 of FILE; give"),
        ([HEADER, *ROWS, "22.5,5,1,30,-9999"], "measured: z_mm is '-9999' in line 27 of FILE; give .* nan for drop-outs"),
        ([HEADER, *ROWS, "22.5,5,1,30,inf"], "measured: z_mm is 'inf' in line 27 of FILE; give"),
        ([HEADER, *ROWS, ",5,1,30,0"], "measured: beta_deg is '' in line 27 of FILE; give"),
        ([HEADER, *ROWS, "22.5,5,1.5,30,0"], "measured: scan is '1.5' in line 27 of FILE; give a whole number"),
        ([HEADER, *ROWS, "22.5,5,1,30"], "measured: FILE: 4 fields in line 27, 5 in the header; give as many"),
        (
            [HEADER, *ROWS, "22.5,5,1,3.0,1"],
            "measured: FILE: scan 1 of beta 22.5, sinkage 5 .* has x_mm 3 in lines 5, 27; give it once",
        ),
        (
            [HEADER, *ROWS, "22.5,5,2,3.0,1"],
            "measured: FILE: scan 2 of .* .from line 27. has 1 points with a height; give at least 20",
        ),
        ([HEADER, *(r[: r.rindex(",") + 1] for r in ROWS)], "measured: FILE: scan 1 of .* has 0 points with a height; give"),
    ],
)
def test_mistakes_in_a_file_are_told_with_their_line(tmp_path, lines, message):
    file = written(tmp_path, lines)
    with pytest.raises(ValueError, match=message.replace("FILE", str(file))) as told:
        scans.read_scans(file)
    assert "\n" not in str(told.value)


def test_mistakes_of_other_kinds_are_told(tmp_path):
    for path in (tmp_path, tmp_path / "none.csv"):
        with pytest.raises(ValueError, match="measured: cannot read .*; give a CSV file of scans"):
            scans.read_scans(path)
    picture = tmp_path / "picture.csv"
    picture.write_bytes(bytes(range(256)))
    with pytest.raises(
        ValueError, match="measured: .*picture.csv is no text in UTF-8; give a CSV file of scans, whose first"
    ):
        scans.read_scans(picture)
    with pytest.raises(ValueError, match="measured: got no scans"):
        scans.measured_profile([], section(0.01, 0, 0))
    with pytest.raises(ValueError, match="reference: is level"):
        scans.toes(np.zeros_like)
    steep = scans.Scan(3, np.arange(100) * MM, np.arange(100) * MM)
    with pytest.raises(ValueError, match="measured: scan 3 is tilted by more than 10 degrees; level it"):
        scans.align(steep, section(5 * MM, 0, 0))


def test_heights_without_data_are_drop_outs(tmp_path):
    rows = [f"0,5,1,{k},{-9999 if k in (3, 7) else 0}" for k in range(25)]
    (tmp_path / "scans.csv").write_text("\n".join([",".join(scans.COLUMNS), *rows]))
    (scan,) = scans.read_scans(tmp_path / "scans.csv", -9999)[0, 5]
    assert (scan.dropouts, scan.x.size) == (2, 23)
    assert not scan.z.any()
    with pytest.raises(ValueError, match="z_mm is '-9999' in line 5 of"):
        scans.read_scans(tmp_path / "scans.csv")
