"""The closed form of a wheel's trench, and what sand in one dimension makes of the same cut."""

import math
from functools import cache
from itertools import pairwise

import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import jaxsand as js
from jaxsand.terramechanics.wheel_trench import Pass, Profile, cell_means, closed_form, relaxed, unsettled

from ..conftest import ANGLE, MU

pytestmark = pytest.mark.long

TRENCHES = [(beta, sinkage) for sinkage in (5, 15, 25) for beta in (0, 22.5, 45, 67.5, 90)]
# Pavlov & Johnson's formulas and the relaxation of sections sampled every 0.5 mm (mm): depth, depth, left and right peak.
TABLE = {
    (0, 5): (5, 5, 6.8, 6.8),
    (22.5, 5): (5, 5, 7.7, 7.7),
    (45, 5): (5, 5, 7.8, 7.8),
    (67.5, 5): (5, 5, 7.8, 6.6),
    (90, 5): (5, 5, 5.7, 5.7),
    (0, 15): (13.40, 14.15, 10.0, 10.0),
    (22.5, 15): (15, 15, 12.5, 12.5),
    (45, 15): (15, 15, 13.6, 13.6),
    (67.5, 15): (15, 15, 15.9, 10.0),
    (90, 15): (15, 15, 11.3, 11.3),
    (0, 25): (16.64, 16.64, 11.6, 11.6),
    (22.5, 25): (22.79, 21.71, 15.2, 15.2),
    (45, 25): (24.95, 24.11, 17.7, 16.5),
    (67.5, 25): (24.75, 24.24, 21.5, 11.5),
    (90, 25): (21.23, 21.28, 15.0, 15.0),
}
# Where grousers take from one pile, from both, and all there is; a cut of a hair and one as deep as the axle.
GROUSED = [
    Pass(math.radians(beta), sinkage, spin=spin)
    for beta in (0, 9, 22.5, 67.5, 90)
    for sinkage in (0.005, 0.035)
    for spin in (0.5, 3, 100)
    if (beta, spin) != (67.5, 100)
]
# Without a closed form: the right pile gone, and a pointed bottom below the cut's floor whose flat one has no width.
REFUSED = [Pass(math.radians(67.5), 0.025, spin=100), Pass(math.radians(16.5), 0.0195), Pass(math.radians(54), 0.0245)]
EDGES = [Pass(math.radians(beta), sinkage) for beta in (0, 30, 90) for sinkage in (1e-6, 0.048)]


def run(trench, **parts):
    return Pass(math.radians(trench[0]), trench[1] * 1e-3, **parts)


RUNS = [run(trench) for trench in TRENCHES]


@cache
def exact(spacing):
    """The relaxed sections of the table's trenches."""
    return dict(zip(TRENCHES, relaxed(RUNS, spacing), strict=True))


def apart(a, b):
    """The largest distance of two profiles."""
    x = np.union1d(a.x, b.x)
    return np.abs(a(x) - b(x)).max()


def steepest(profile):
    wide = np.diff(profile.x) > 1e-9 * np.ptp(profile.x)
    return np.abs(np.diff(profile.z)[wide] / np.diff(profile.x)[wide]).max()


@pytest.mark.parametrize("trench", [trench for trench in TRENCHES if trench != (0, 15)])
def test_depths_are_those_of_the_source(trench):
    assert closed_form(run(trench)).deepest * 1e3 == pytest.approx(TABLE[trench][0], abs=0.05)


def test_where_the_source_does_not_keep_the_sand_the_formula_does():
    """Its 13.40 mm at 15 mm and 0 degrees cannot be: with those toes and faces at repose, only T (sqrt 2 - 1) keeps it."""
    one = run((0, 15))
    profile = closed_form(one)
    toe = math.sqrt(2 * MU * 0.015 * 0.05 / 2) + 0.025 * MU
    assert profile.deepest == pytest.approx(toe * (math.sqrt(2) - 1), rel=1e-12)
    assert profile.toes == pytest.approx((-toe / MU, toe / MU), rel=1e-12)
    assert profile.deepest * 1e3 == pytest.approx(14.19, abs=0.005)

    def area(depth):
        peak = (toe - depth) / 2
        x = np.array([-toe, -toe + peak, 0, toe - peak, toe]) / MU
        return Profile(x, np.array([0, peak, -depth, peak, 0])).area()

    cut = sum(one.piles())
    assert abs(area(profile.deepest)) < 1e-12 * cut
    assert area(13.40e-3) > 0.05 * cut


def test_peaks_of_symmetric_trenches_follow_from_the_toes():
    for trench in ((0, 15), (0, 25), (90, 25)):
        profile = closed_form(run(trench))
        total = profile.toes[1] * MU
        assert profile.peaks == pytest.approx((total * (1 - math.sqrt(0.5)),) * 2, rel=1e-9)


@pytest.mark.wide
@pytest.mark.parametrize("trench", TRENCHES)
def test_relaxed_sections_are_those_of_the_table(trench):
    """The table's are of sampled sections, these of mean ones: a bit apart where a peak or a bottom is sharp."""
    profile = exact(5e-4)[trench]
    got = np.array([profile.deepest, *profile.peaks]) * 1e3
    assert got == pytest.approx(np.array(TABLE[trench][1:]), abs=0.15)


def test_relaxing_sampled_sections_gives_the_table():
    places = np.arange(-200, 201) * 5e-4
    sampled = []
    for trench in TRENCHES[-4:]:
        one = run(trench)
        out = np.clip((np.abs(places) - one.rim / 2) / one.flank, 0, 1)
        left, right = (np.sqrt(2 * MU * area) for area in one.piles())
        pile = np.where(places < 0, left, right) - (np.abs(places) - one.swept / 2) * MU
        sampled.append(np.where(out < 1, -one.sinkage * (1 - out**2), np.maximum(pile, 0)))
    scene = js.make_scene((1, places.size), 5e-4, ANGLE, 4)
    scheme, stop = js.SuperTimeStepping(0.05, 1 / 64), js.UntilStill(1e-6, bound=100_000)
    heights = js.settle_batch(scene, jnp.asarray(sampled)[:, None], scheme=scheme, stop=stop).height
    depths = -np.asarray(heights).min((1, 2)) * 1e3
    assert depths == pytest.approx([TABLE[trench][1] for trench in TRENCHES[-4:]], abs=0.01)


@pytest.mark.wide
def test_relaxed_sections_converge_with_the_spacing():
    coarse, middle, fine = (exact(spacing) for spacing in (1e-3, 5e-4, 2.5e-4))
    steps = [max(apart(a[trench], b[trench]) for trench in TRENCHES) for a, b in ((coarse, middle), (middle, fine))]
    assert steps[0] < MU * 1e-3
    assert steps[1] < 0.7 * steps[0]


@pytest.mark.parametrize("spacing", [1e-3, 5e-4, pytest.param(2.5e-4, marks=pytest.mark.wide)])
@pytest.mark.parametrize("trench", [(0, 5), (0, 15), (0, 25), (90, 25)])
def test_symmetric_trenches_relax_to_the_closed_form(trench, spacing):
    one, got = closed_form(run(trench)), exact(spacing)[trench]
    assert np.abs(got(got.x) - one(got.x)).max() < MU * spacing / 2
    assert apart(got, Profile(-got.x[::-1], got.z[::-1])) < 1e-12


def test_relaxed_sand_lies_at_repose_and_within_its_toes():
    for one, (trench, profile) in zip(RUNS, exact(5e-4).items(), strict=True):
        assert steepest(profile) < MU + 2e-6
        assert profile.deepest <= trench[1] * 1e-3 + 1e-9
        assert np.abs(np.subtract(profile.toes, closed_form(one).toes)).max() < 2e-3


@pytest.mark.wide
def test_areas_are_kept():
    for one in [*RUNS, *GROUSED, *EDGES]:
        for profile in (closed_form(one), unsettled(one)):
            assert abs(profile.area()) <= 1e-9 * sum(one.piles()) + 1e-18
    some = GROUSED + REFUSED
    for runs, profiles in ((RUNS, exact(1e-3).values()), (RUNS, exact(5e-4).values()), (some, relaxed(some, 1e-3))):
        for one, profile in zip(runs, profiles, strict=True):
            assert abs(profile.area()) <= 1e-9 * sum(one.piles()) + 1e-18


def test_every_branch_is_among_these():
    pointed = [closed_form(one).deepest < one.floor() - 1e-6 for one in GROUSED]
    parted = [one.parted for one in GROUSED]
    assert {(False, False), (False, True), (True, False), (True, True)} == set(zip(pointed, parted, strict=True))
    assert any(min(one.piles()) == 0 for one in GROUSED)


def test_grousers_fill_the_trench():
    for beta in (0, 22.5, 67.5, 90):
        depths = [closed_form(run((beta, 15), spin=spin)).deepest for spin in (0, 1, 4, 8)]
        floors = [run((beta, 15), spin=spin).floor() for spin in (0, 1, 4, 8)]
        assert np.all(np.diff(floors) < 0)
        assert np.all(np.diff(depths) <= 1e-12)
        assert depths[-1] < depths[0]
    assert run((0, 15), spin=2).carried == pytest.approx(2 * 0.05 * 0.005 * 0.1)
    assert run((0, 15), spin=1e9).carried == pytest.approx(0.015 * 0.05)  # no more than there is


PASSES = st.builds(
    lambda slip, part, radius, width, angle, spin: Pass(slip, part * radius, radius, width, angle, spin),
    st.floats(0, math.pi / 2),
    st.floats(0, 1),
    st.floats(1e-3, 10),
    st.floats(1e-3, 10),
    st.floats(1e-3, math.pi / 2 - 1e-3),
    st.floats(0, 20),
)


@pytest.mark.wide
@settings(max_examples=1000, deadline=None, derandomize=True, database=None)
@given(PASSES)
def test_a_closed_form_is_sound_or_refused(one):
    try:
        profile = closed_form(one)
    except ValueError as error:
        message = str(error)
        assert message.startswith("slip_angle: got ")
        assert f"{math.degrees(one.slip_angle):.4g} degrees at a sinkage of" in message
        assert message.endswith("use relaxed instead")
        return
    scale = 1e-9 * max(np.ptp(profile.z), np.ptp(profile.x) * one.slope) + 1e-12
    assert np.all(np.isfinite([*profile.x, *profile.z]))
    assert np.all(np.diff(profile.x) >= -scale / one.slope)
    assert profile.toes[0] <= 0 <= profile.toes[1]
    assert profile.z[1] >= -1e-12
    assert profile.z[-2] >= -1e-12
    assert profile.deepest <= one.floor() + scale
    assert np.all(np.abs(np.diff(profile.z)) <= one.slope * np.diff(profile.x) + scale)
    assert abs(profile.area()) <= 1e-9 * (sum(one.piles()) + np.ptp(profile.x) * scale)


def test_few_passes_are_refused():
    """Of any wheel in any sand; of the wheel and the sand of the source hardly any."""
    rng = np.random.default_rng(0)
    wild = [
        Pass(*v[:1] * math.pi / 2, v[1] * (r := 10 ** (2 * v[2] - 2)), r, 10 ** (2 * v[3] - 2), 0.05 + 1.4 * v[4])
        for v in rng.uniform(size=(2000, 5))
    ]
    usual = [run(trench) for trench in zip(rng.uniform(0, 90, 2000), rng.uniform(0, 48, 2000), strict=True)]

    def share(runs):
        refused = 0
        for one in runs:
            try:
                closed_form(one)
            except ValueError:
                refused += 1
        return refused / len(runs)

    assert 0 < share(wild) < 0.02
    assert 0 < share(usual) < 0.03


@pytest.mark.parametrize("one", REFUSED)
def test_where_there_is_no_closed_form_it_says_so(one):
    with pytest.raises(ValueError, match=r"slip_angle: got .* degrees at a sinkage of .* mm, .*; use relaxed instead"):
        closed_form(one)


def both_sides(radians, **parts):
    """Hairs below and above a slip angle: the two passes and how far apart their closed forms are (m)."""
    pair = [Pass(radians + hair, 0.025, **parts) for hair in (-1e-9, 1e-9)]
    return pair, apart(*map(closed_form, pair))


def test_nothing_jumps_where_flank_and_rim_cut_alike():
    even = math.atan2(3 * 0.05, 4 * math.sqrt(2 * 0.048 * 0.025 - 0.025**2))  # 2 A = h p
    pair, jump = both_sides(even)
    assert [one.parted for one in pair] == [False, True]
    assert np.allclose(pair[0].piles(), pair[1].piles(), rtol=1e-7)
    assert jump < 1e-9


def test_profiles_jump_ten_degrees_from_the_ends():
    """The source's own: at 10 degrees where the sand of the two sides parts, at 80 how much lies on each side."""
    pair, jump = both_sides(math.radians(10))
    assert np.allclose(pair[0].piles(), pair[1].piles(), rtol=1e-7)
    assert jump == pytest.approx(15.05e-3, abs=1e-5)
    pair, jump = both_sides(math.radians(80))
    assert [one.parted for one in pair] == [True, False]
    assert pair[0].piles()[0] > 6 * pair[0].piles()[1]
    assert pair[1].piles()[0] == pair[1].piles()[1]
    assert jump == pytest.approx(14.27e-3, abs=1e-5)
    pair, _ = both_sides(math.radians(10), width=0.008)
    assert [one.parted for one in pair] == [False, True]
    assert np.ptp(pair[1].piles()) > 0.1 * sum(pair[1].piles())


def test_a_profile_is_straight_between_its_points_and_level_beyond():
    one = Profile(np.array([-1.0, 0.0, 2.0]), np.array([0.0, -2.0, 4.0]))
    assert np.array_equal(one(np.array([-9, -1, -0.5, 0, 1, 2, 2.1])), [0, 0, -1, -2, 1, 4, 0])
    assert one.toes == (-1, 2)
    assert (one.deepest, one.peaks, one.area()) == (2, (0, 4), 1)


def test_cell_means_are_exact_for_straight_pieces_and_jumps():
    one = Profile(np.array([-1.0, -1, 0, 0, 0, 1.5]), np.array([0.0, 2, 1, -5, -1, -1]))
    got = cell_means(one, np.array([-3.0, -2, -1.5, -0.5, 0.5, 1, 4]))
    assert np.allclose(got, [0, 0, 0.5 * 1.75, 0.5 * 1.25 - 0.5, -1, -0.5 / 3], atol=1e-15)
    rng = np.random.default_rng(0)
    for run_ in (*RUNS, *GROUSED):
        for profile in (closed_form(run_), unsettled(run_)):
            edges = np.concatenate([[-0.5], np.sort(rng.uniform(-0.2, 0.2, 40)), [0.5]])
            assert abs(np.sum(cell_means(profile, edges) * np.diff(edges)) - profile.area()) < 1e-17
            fine = np.linspace(-0.2, 0.2, 40)
            mean = [np.mean(profile(np.linspace(a, b, 801)[:-1] + (b - a) / 1600)) for a, b in pairwise(fine)]
            assert np.allclose(cell_means(profile, fine), mean, atol=5e-5)


def test_no_sinkage_is_no_trench():
    one = Pass(0.5, 0.0, spin=1.0)
    assert (one.piles(), one.floor(), one.carried) == ((0, 0), 0, 0)
    assert not np.any(closed_form(one).z)
    assert not np.any(relaxed([one], 1e-3)[0].z)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("slip_angle", -0.1),
        ("slip_angle", 1.6),
        ("slip_angle", math.nan),
        ("sinkage", -1e-9),
        ("sinkage", 0.049),
        ("radius", 0.0),
        ("radius", math.inf),
        ("width", -0.05),
        ("width", math.nan),
        ("repose_angle", 0.0),
        ("repose_angle", math.pi / 2),
        ("spin", -1.0),
        ("spin", math.inf),
        ("grouser_height", -1e-3),
        ("grouser_fill", math.nan),
    ],
)
def test_a_bad_pass_names_the_field(name, value):
    with pytest.raises(ValueError, match=rf"^{name}: got {value!r}; give "):
        Pass(**{"slip_angle": 0.5, "sinkage": 0.015, name: value})


def test_relaxed_asks_for_passes_of_one_angle():
    with pytest.raises(ValueError, match="runs: got repose angles"):
        relaxed([])
    with pytest.raises(ValueError, match="all of one angle"):
        relaxed([Pass(0.0, 0.01), Pass(0.0, 0.01, repose_angle=0.6)])
