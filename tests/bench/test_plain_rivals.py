"""The plain rivals of the benchmark give the same answers as the library; the benchmark runs."""

import math

import numpy as np
import pytest

import jaxsand as js
from jaxsand.bench import report as benchmark
from jaxsand.bench.rivals.plain import compile_c, settle_numpy

from ..conftest import ANGLE, MU

DX = 0.01


def rough(n, shape=(20, 24)):
    return np.random.default_rng(0).uniform(-0.03, 0.03, (n, *shape)).astype(np.float32)


def test_numpy_equals_jaxsand():
    for h in rough(3):
        got, sweeps = settle_numpy(h, DX, MU)
        want = js.settle(js.make_scene(h.shape, DX, ANGLE), h, scheme=js.Relaxation())
        assert sweeps == int(want.sweeps)
        assert np.abs(got - want.height).max() < 1e-6


def test_c_equals_jaxsand():
    settle_c = compile_c()
    if settle_c is None:
        assert compile_c() is None  # no compiler: said so, and the benchmark goes without
        return
    maps = rough(5)
    want = js.settle_batch(js.make_scene((20, 24), DX, ANGLE), maps, scheme=js.Relaxation())
    got = maps.copy()
    sweeps = settle_c(got, DX, MU)
    assert np.array_equal(sweeps, want.sweeps)
    assert np.abs(got - want.height).max() < 1e-6
    fixed = maps.copy()
    assert list(settle_c(fixed, DX, MU, tolerance=-1.0, bound=16)) == [16] * 5
    assert (
        np.abs(
            fixed
            - js.settle_batch(js.make_scene((20, 24), DX, ANGLE), maps, scheme=js.Relaxation(), stop=js.Sweeps(16)).height
        ).max()
        < 1e-6
    )
    with pytest.raises(ValueError, match="maps: got float64"):
        settle_c(maps.astype(float), DX, MU)


@pytest.mark.slow
def test_the_benchmark_of_settling_reports_rates_that_fit_together():
    check_rates(benchmark.bench("settle", batch=2, grids=0))


def check_rates(report):
    cells = math.prod(report["map"])
    for row in report["settle"]:
        assert row["maps_per_second"] == pytest.approx(1e9 / (row["ns_per_cell_sweep"] * row["sweeps"] * cells), rel=0.01)
        assert row["compile_seconds"] >= 0
        assert row["times_numpy"] > 0
        assert 0 < row["error"] < 0.2
    text = benchmark.table(report)
    assert all(row["name"] in text for row in report["settle"])
