"""Parameters found again: from maps with noise, from a wheel's sections, and what is said where the data do not tell."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxsand as js
from jaxsand.bench.calibration import bench_calibrate, bench_cone, cone
from jaxsand.terramechanics._least_squares import Range, climb, conclude, spread
from jaxsand.terramechanics.calibration import _grouped
from jaxsand.terramechanics.wheel_trench import Pass, closed_form, relaxed

SHAPE, DX, NOISE = (32, 32), 0.01, 6e-4
STROKE = np.array([0.08, 0.12, 0.24, 0.2], np.float32)
LEVEL = np.zeros(SHAPE, np.float32)
Y, X = (np.indices(SHAPE) + 0.5) * DX
PILLAR = np.where(np.hypot(X - 0.16, Y - 0.16) < 0.06, 0.06, 0).astype(np.float32)
ANGLE = ("repose_angle",)


def sand(degrees, tool=None):
    return js.make_scene(SHAPE, DX, math.radians(degrees), tool=tool)


def noise(seed):
    return np.random.default_rng(seed).normal(0, NOISE, SHAPE).astype(np.float32)


def collapsed(degrees, before=PILLAR):
    return np.asarray(js.settle(sand(degrees), before).height)


def off(found, degrees):
    return math.degrees(found.values["repose_angle"]) - degrees


@pytest.mark.wide
@pytest.mark.long
@pytest.mark.parametrize("seeds", [range(0, 24, 5), pytest.param(range(24), marks=pytest.mark.slow)], ids=len)
def test_one_noisy_collapse_tells_the_angle_and_how_well(seeds):
    """Within 0.2 degrees for angles from 20 to 40, and from wrong guesses; errors over standard errors spread by 1."""
    pulls = []
    for seed in seeds:
        true, guess = 20 + seed * 20 / 23, 15 + (seed * 7 % 31)
        found = js.calibrate(sand(guess), js.Trial(PILLAR, collapsed(true) + noise(seed)), free=ANGLE)
        assert not found.verdict
        assert abs(off(found, true)) < 0.2
        assert found.noise == pytest.approx(NOISE, rel=0.1)
        pulls.append(off(found, true) / math.degrees(found.noise_errors["repose_angle"]))
    if len(seeds) == 24:  # enough to tell
        assert 0.7 < np.std(pulls) < 1.35
        assert abs(np.mean(pulls)) < 0.65  # three of its standard deviations


@pytest.mark.slow
def test_the_bench_finds_errors_as_large_as_stated():
    """The rms over six angles of what has standard normal errors lies in 0.4 to 1.7 in 99 of 100 cases."""
    for row in bench_calibrate(seeds=6):
        assert 0.4 < row["rms_error_deg"] / row["standard_error_deg"] < 1.7
        assert row["rms_error_deg"] <= row["worst_error_deg"]


def check_cones(rows):
    """The cone's angle lies within two stated errors, where two of the noise's reach it nowhere; so does the sand's own."""
    assert [row["neighbours"] for row in rows] == [4, 8, "isotropic"]
    for row, angle in zip(rows, (24.3, 27.9, 30.0), strict=True):
        assert row["angle_deg"] == pytest.approx(angle, abs=0.15)  # what is off: the grid, not the noise
        assert row["noise_error_deg"] < 0.2
        assert row["covered_by_noise"] == 0
        assert row["covered"] >= 0.95
        assert row["sand_covered"] >= 0.95
        assert row["sand_deg"] == pytest.approx(29, abs=0.15)
        assert row["sand_error_deg"] < 0.3


@pytest.mark.slow
@pytest.mark.long
def test_the_exact_cones_angle_lies_within_two_stated_errors(monkeypatch):
    """In all of 20 trials but one; `jaxsand bench calibrate` has a hundred."""
    monkeypatch.setattr("jaxsand.bench.calibration._seconds", lambda *_: 0.0)  # no clock is asked
    check_cones(bench_cone(seeds=20))


def ridge(degrees, half, height):
    """A block's exact end in one dimension, as means over cells, and the block."""
    mu, parts = math.tan(math.radians(degrees)), 64
    x = np.abs((np.arange(32 * parts) + 0.5) / parts * DX - 0.16)
    toe = half + height / 2 / mu if height <= 2 * mu * half else math.sqrt(2 * half * height / mu)
    rows = (np.where(x < half, height, 0), np.clip(mu * (toe - x), 0, height))
    return (np.tile(row.reshape(32, parts).mean(1), (32, 1)).astype(np.float32) for row in rows)


@pytest.mark.wide
@pytest.mark.long
@pytest.mark.parametrize("neighbours", [pytest.param(4, marks=pytest.mark.slow), 8])
def test_ridges_and_slots_have_small_error_bars_that_hold_the_exact_angle(neighbours):
    """One dimension: neighbourhoods agree, and what is left is where a toe and a crest lie in their cells."""
    scene, errors = js.make_scene(SHAPE, DX, math.radians(26), neighbours), []
    rng, covered = np.random.default_rng(1), 0
    for k in range(20):
        degrees, half, height = rng.uniform(22, 38), rng.integers(3, 8) * DX, rng.uniform(0.02, 0.05)
        before, after = ((-1) ** k * h for h in ridge(degrees, half, height))
        found = js.calibrate(scene, js.Trial(before, after + noise(k)), free=ANGLE, noise=NOISE)
        assert not found.verdict
        error = math.degrees(found.errors["repose_angle"])
        covered += abs(off(found, degrees)) <= 2 * error
        errors.append(error)
    assert covered >= 19
    assert np.median(errors) < 0.6


@pytest.mark.wide
@pytest.mark.long
def test_the_grids_error_is_told_through_gaps():
    """Half of the cone unseen: the same error of the grid."""
    before, after = cone(29.0)
    scene, half = js.make_scene(SHAPE, DX, 0.45), after + noise(0)
    half[:, :16] = np.nan
    whole, gaps = (js.calibrate(scene, js.Trial(before, a), free=ANGLE, noise=NOISE) for a in (after + noise(0), half))
    assert gaps.grid_errors["repose_angle"] == pytest.approx(whole.grid_errors["repose_angle"], rel=0.2)
    assert abs(math.degrees(gaps.sand["repose_angle"]) - 29) <= 2 * math.degrees(gaps.sand_errors["repose_angle"])
    assert gaps.errors["repose_angle"] == pytest.approx(
        math.hypot(gaps.noise_errors["repose_angle"], gaps.grid_errors["repose_angle"])
    )
    assert gaps.covariance[0, 0] == pytest.approx(gaps.errors["repose_angle"] ** 2)


@pytest.mark.wide
@pytest.mark.long
def test_an_error_that_is_not_known_is_no_number():
    """Left out, or with the sand's own angle beyond the range: the verdict says so, and the rest is the noise's."""
    before, after = cone(29.0)
    trial, scene = js.Trial(before, after + noise(0)), js.make_scene(SHAPE, DX, 0.45)
    narrow = {"repose_angle": (math.radians(26), math.radians(28.5))}
    for found in (
        js.calibrate(scene, trial, free=ANGLE, grid=js.OneGrid()),
        js.calibrate(scene, trial, free=narrow),
    ):
        assert found.verdict == js.Verdict.GRID_UNKNOWN
        assert found.noise_errors["repose_angle"] > 0
        assert found.errors == found.noise_errors
        for part in (found.grid_errors, found.sand, found.sand_errors):
            assert math.isnan(part["repose_angle"])


def pushed_by(push):
    return np.asarray(js.step(sand(31, js.Blade()), LEVEL, STROKE, push=push).height)


@pytest.mark.wide
@pytest.mark.parametrize(
    "push", [js.SwathPush(), pytest.param(js.SteppedPush(), marks=[pytest.mark.slow, pytest.mark.long])]
)
def test_a_push_tells_the_angle_and_the_blade(push):
    """To rounding, from lengths off by half."""
    guess = sand(16, js.Blade(0.03, 0.015, 0.00375))
    found = js.calibrate(guess, js.Trial(LEVEL, pushed_by(push), STROKE), push=push, grid=js.OneGrid())
    assert found.verdict == js.Verdict.GRID_UNKNOWN
    assert abs(off(found, 31)) < 0.01
    assert found.values["width"] == pytest.approx(0.02, rel=1e-4)
    assert found.model.tool.depth == pytest.approx(0.0075, rel=1e-4)


@pytest.mark.wide
def test_a_noisy_push_tells_them_within_four_standard_errors():
    """By the quicker rule of the two; the search and the estimate of errors do not know which."""
    near, push = sand(29, js.Blade(0.021, 0.015, 0.0072)), js.SwathPush()
    found = js.calibrate(near, js.Trial(LEVEL, pushed_by(push) + noise(1), STROKE), push=push, grid=js.OneGrid())
    assert found.verdict == js.Verdict.GRID_UNKNOWN
    true = (math.radians(31), 0.02, 0.0075)
    for value, error, known in zip(found.values.values(), found.noise_errors.values(), true, strict=True):
        assert abs(value - known) < 4 * error
    # A single default stroke moves too little sand for 0.2 degrees: the bound itself is up to a degree.
    assert 0.3 < math.degrees(found.noise_errors["repose_angle"]) < 1.2


@pytest.mark.slow
def test_the_grids_error_of_a_push_is_told():
    """A blade of six cells tells how far two grids put angle and depth off: more than the noise does, less than half."""
    blade = js.Blade(0.06, 0.02, 0.02)
    pushed = np.asarray(js.step(sand(31, blade), LEVEL, STROKE, push=js.SwathPush()).height)
    trial, free = js.Trial(LEVEL, pushed + noise(1), STROKE), ("repose_angle", "depth")
    found = js.calibrate(sand(26, blade), trial, free=free, noise=NOISE, push=js.SwathPush())
    assert not found.verdict
    for name in free:
        assert 0 < found.noise_errors[name] < found.grid_errors[name] < found.errors[name] < found.values[name] / 2


def test_the_errors_are_the_cramer_rao_bound():
    """sigma over the length of the derivative, of the cells that were seen."""
    after = collapsed(29).copy()
    after[:, 20:] = np.nan
    found = js.calibrate(sand(25), js.Trial(PILLAR, after), free=ANGLE, noise=NOISE)
    slope = (collapsed(29.25) - collapsed(28.75))[:, :20] / math.radians(0.5)
    assert found.noise_errors["repose_angle"] == pytest.approx(NOISE / np.linalg.norm(slope), rel=0.02)
    assert abs(off(found, 29)) < 0.01


@pytest.mark.slow
def test_regions_have_angles_of_their_own_and_level_sand_tells_none():
    """A pillar in each of two regions; in the third no sand slides."""
    labels = np.digitize(X, [0.12, 0.24])
    pillars = np.where(np.minimum(np.hypot(X - 0.06, Y - 0.16), np.hypot(X - 0.18, Y - 0.16)) < 0.03, 0.03, 0)
    angles = np.radians([24.0, 36.0, 30.0])
    after = np.asarray(js.settle(js.make_scene(SHAPE, DX, angles[labels]), pillars.astype(np.float32)).height)
    found = js.calibrate(sand(29), js.Trial(pillars.astype(np.float32), after + noise(2)), free=ANGLE, regions=labels)
    for k in (0, 1):
        name = f"repose_angle[{k}]"
        assert abs(found.values[name] - angles[k]) < 4 * found.noise_errors[name] < math.radians(1.5)
    assert found.verdict == js.Verdict.NOT_TOLD
    assert found.untold == ("repose_angle[2]",)
    assert found.errors["repose_angle[2]"] == math.inf
    assert found.model.material.repose_angle.shape == SHAPE


@pytest.mark.slow
def test_what_the_data_do_not_tell_is_said():
    guess = sand(25, js.Blade())
    found = js.calibrate(guess, js.Trial(PILLAR, collapsed(29) + noise(3)), free=("depth", "repose_angle"))
    assert found.verdict == js.Verdict.NOT_TOLD
    assert found.untold == ("depth",)
    assert list(found.values) == ["repose_angle", "depth"]
    assert abs(off(found, 29)) < 0.2
    assert found.covariance[1, 1] == math.inf


def test_a_wrong_model_is_said():
    """A pillar a tenth higher than it is said to be; and a range that does not hold the truth."""
    trial = js.Trial(PILLAR, collapsed(29, PILLAR * 1.1) + noise(4))
    assert js.Verdict.POOR_FIT in js.calibrate(sand(25), trial, free=ANGLE, noise=NOISE).verdict
    narrow = {"repose_angle": (math.radians(15), math.radians(25))}
    found = js.calibrate(sand(25), js.Trial(PILLAR, collapsed(29) + noise(5)), free=narrow)
    assert js.Verdict.AT_LIMIT in found.verdict
    assert math.degrees(found.values["repose_angle"]) == pytest.approx(25, abs=1e-3)


def fitted(residuals, ranges, starts=6, count=50, sigma=None, clean=True):
    """The climb and its conclusion on residuals of x in units of the ranges."""
    begin, given = jnp.asarray(spread(ranges, starts)), jnp.asarray(math.nan if sigma is None else sigma)
    ends = jax.jit(lambda x: climb(lambda x: (residuals(x), jnp.asarray(clean)), x, count, jnp.asarray(count), given))(begin)
    own = jax.jit(residuals)
    return conclude(
        ranges, ends, count, sigma, int(ends.looks.sum()), lambda values: values, lambda x: (own(x), 0 * own(x), True)
    )


def test_a_linear_fit_is_that_of_the_normal_equations():
    rng = np.random.default_rng(0)
    a, y = rng.normal(size=(50, 3)), rng.normal(size=50)
    ranges = [Range(name, -5.0, 3.0, 0.5) for name in "abc"]
    found = fitted(lambda x: a @ (x * 8 - 5) - y, ranges)
    best, cost, *_ = np.linalg.lstsq(a, y, rcond=None)
    assert list(found.values.values()) == pytest.approx(best, abs=1e-3)
    assert found.covariance == pytest.approx(cost[0] / 47 * np.linalg.inv(a.T @ a), rel=1e-6)
    assert found.converged


@pytest.mark.wide
def test_mixtures_and_rivals_are_said():
    """Only the sum of two is told; and two wells of equal depth."""
    rng = np.random.default_rng(1)
    two, error = [Range(name, 0.0, 1.0, 0.3) for name in "ab"], 0.01 * rng.normal(size=50)
    assert fitted(lambda x: x[0] + x[1] - 1 + error, two).untold == ("a", "b")
    rivals = fitted(lambda x: 4 * (x[0] - 0.2) * (x[0] - 0.8) + error, two[:1])
    assert rivals.verdict == js.Verdict.AMBIGUOUS
    assert fitted(lambda x: x[0] - 0.5 + error, two[:1], clean=False).verdict == js.Verdict.UNCLEAN
    few = fitted(lambda x: x[0] - 0.5 + error[:20], two[:1], count=20)
    assert few.verdict == js.Verdict.FEW_DATA


def section(run, profile, seed, guess):
    x = np.arange(-0.12, 0.12, 5e-4)
    z = profile(x) + np.random.default_rng(seed).normal(0, NOISE, x.shape)
    z[100:110] = np.nan
    return js.Section(Pass(run.slip_angle, run.sinkage * guess, repose_angle=math.radians(20)), x, z)


@pytest.mark.wide
def test_sections_of_a_trench_tell_the_angle_and_the_sinkage():
    """The closed form found again by itself, one angle for all slip angles; shift and lift of the scanner with it."""
    runs = [Pass(math.radians(beta), 0.015, repose_angle=math.radians(33)) for beta in (0, 22.5, 45, 67.5, 90)]
    some = [section(run, closed_form(run), k, 0.6 + 0.2 * k) for k, run in enumerate(runs)]
    found = js.calibrate_sections(some, noise=NOISE, model=closed_form)
    assert found.verdict == 0
    assert abs(off(found, 33)) < min(0.1, 4 * math.degrees(found.errors["repose_angle"]))
    for k in range(5):
        assert abs(found.values[f"sinkage[{k}]"] - 0.015) < 4 * found.errors[f"sinkage[{k}]"] < 5e-4
        assert found.model[k].sinkage == found.values[f"sinkage[{k}]"]
    moved = js.Section(some[2].run, some[2].x + 0.002, some[2].z - 0.001)
    placed = js.calibrate_sections(moved, free=("repose_angle", "sinkage", "shift", "lift"), model=closed_form)
    assert abs(off(placed, 33)) < 0.3
    assert placed.values["shift"] == pytest.approx(0.002, abs=4e-4)
    assert placed.values["lift"] == pytest.approx(-0.001, abs=2e-4)


@pytest.mark.wide
def test_a_deep_trench_is_the_exact_relaxations():
    """At 25 mm and 45 degrees the closed form is another profile, and is told so."""
    run = Pass(math.radians(45), 0.025)
    deep = section(run, relaxed([run])[0], 7, 0.7)
    found = js.calibrate_sections(deep, noise=NOISE, starts=2)
    assert found.verdict == 0
    assert abs(off(found, 29)) < 0.2
    assert found.values["sinkage"] == pytest.approx(0.025, abs=4e-4)
    assert js.Verdict.POOR_FIT in js.calibrate_sections(deep, noise=NOISE, model=closed_form).verdict


TRIAL = js.Trial(LEVEL, LEVEL, STROKE)
BLADE = sand(29, js.Blade())
SCAN = js.Section(Pass(0.0, 0.01), np.arange(30.0), np.zeros(30))
REFUSED = {
    "no trials": (lambda: js.calibrate(BLADE, []), "trials: got none"),
    "no tool": (lambda: js.calibrate(sand(29), TRIAL, free=ANGLE), "stroke: got one, but the scene has no tool"),
    "a stroke of three": (lambda: js.calibrate(BLADE, js.Trial(LEVEL, LEVEL, [0, 0, 1])), r"stroke: got shape \[3\]"),
    "another shape": (lambda: js.calibrate(BLADE, js.Trial(LEVEL, LEVEL[1:])), r"after: got shape \[31, 32\]"),
    "gaps before": (lambda: js.calibrate(BLADE, js.Trial(LEVEL * np.nan, LEVEL)), "before: got 1024 numbers"),
    "nothing seen": (lambda: js.calibrate(BLADE, js.Trial(LEVEL, LEVEL * np.nan)), "trials: got 0 seen cells for 3"),
    "a strange name": (lambda: js.calibrate(BLADE, TRIAL, free=("colour",)), r"free: got \['colour'\]; choose from"),
    "no names": (lambda: js.calibrate(BLADE, TRIAL, free=()), "free: got no names"),
    "a range upside down": (
        lambda: js.calibrate(BLADE, TRIAL, free={"width": (0.3, 0.2)}),
        "free: got 0.3 to 0.2 for width",
    ),
    "degrees": (lambda: js.calibrate(BLADE, TRIAL, free={"repose_angle": (10, 50)}), "give rad above 0"),
    "a blade above": (lambda: js.calibrate(sand(29, js.Blade(depth=-0.01)), TRIAL), "give its range"),
    "letters for a range": (lambda: js.calibrate(BLADE, TRIAL, free={"width": ("a", "b")}), r"free: got \('a', 'b'\)"),
    "a pair for a trial": (lambda: js.calibrate(BLADE, [(LEVEL, LEVEL)]), r"trials: got tuple; give Trial"),
    "a smaller map": (lambda: js.calibrate(BLADE, js.Trial(LEVEL[1:], LEVEL[1:])), r"before: got shape \[31, 32\]"),
    "a number for a push": (lambda: js.calibrate(BLADE, TRIAL, push=3), "push: got 3; give SteppedPush"),
    "a name for noise": (lambda: js.calibrate(BLADE, TRIAL, noise="a"), "noise: got 'a'"),
    "a silent noise": (lambda: js.calibrate(BLADE, TRIAL, noise=0.0), "noise: got 0.0"),
    "a number for a grid": (lambda: js.calibrate(BLADE, TRIAL, grid=2), r"grid: got 2; give TwoGrids"),
    "no starts": (lambda: js.calibrate(BLADE, TRIAL, starts=0), "starts: got 0"),
    "labels of floats": (lambda: js.calibrate(BLADE, TRIAL, regions=LEVEL), "regions: got float32"),
    "labels with gaps": (lambda: js.calibrate(BLADE, TRIAL, regions=2 * (X > 0.1)), "number the regions 0, 1"),
    "no sections": (lambda: js.calibrate_sections([]), "sections: got none"),
    "a strange field": (lambda: js.calibrate_sections(SCAN, free=("depth",)), r"free: got \['depth'\]"),
    "a slip of none": (lambda: js.calibrate_sections(SCAN, free=("slip_angle",)), "give its range"),
    "uneven rows": (lambda: js.Section(Pass(0.0, 0.01), np.arange(3.0), np.zeros(4)), "x, z: got shapes"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_refusals_name_field_value_and_remedy(case):
    call, message = REFUSED[case]
    with pytest.raises(ValueError, match=message):
        call()


def test_masked_cells_were_not_seen():
    raw = np.zeros((4, 4))
    raw[1, 2] = -9999
    for after in (np.ma.masked_equal(raw, -9999), np.where(raw == -9999, np.nan, raw)):
        (group,), seen = _grouped(js.make_scene((4, 4), 0.01), [js.Trial(np.zeros((4, 4)), after)])
        assert seen == 15
        assert np.array_equal(group.seen[0], raw == 0)
        assert not np.any(group.after)
