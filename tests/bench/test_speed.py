"""The history of speed: what is told of a run, when, and of which machine; and that a run gets its figures."""

import json
from functools import partial

import jax
import numpy as np
import pytest

from jaxsand.bench import speed
from jaxsand.bench.speed import HISTORY, LETTER, bench_speed, history, reference, slower, with_history
from jaxsand.planning.binary import plan
from jaxsand.viz.history import history_figure

STEADY = [{"push": {"ratio": 1.0 + 0.01 * k}} for k in range(10)]


def test_ratios_are_those_of_the_best_times(monkeypatch):
    calls, small = {"fast": 0, "slow": 0}, partial(reference, sweeps=1000, cells=64)

    def job(name, work):
        def run():
            calls[name] += 1
            return small(sweeps=work)

        return run

    monkeypatch.setattr(speed, "reference", small)
    monkeypatch.setattr(speed, "jobs", lambda: {"fast": job("fast", 100), "slow": job("slow", 4000)})
    rows = {row["name"]: row for row in bench_speed(rounds=2)}
    assert calls == {"fast": 3, "slow": 3}
    assert rows["fast"]["ratio"] < 1 < rows["slow"]["ratio"]
    assert rows["fast"]["compile_ratio"] is None  # it does not compile
    assert rows["slow"]["seconds"] / rows["slow"]["ratio"] == pytest.approx(rows["fast"]["seconds"] / rows["fast"]["ratio"])


def test_a_letter_is_planned():
    assert plan(LETTER).optimal


@pytest.mark.parametrize("figures", [5, {"push": 3}, {"push": {"ratio": None}}, {"push": {"ratio": "1"}}])
def test_what_is_no_run_is_refused(figures, tmp_path):
    (tmp_path / HISTORY).write_text(json.dumps({"machine": "one", "commit": None, "figures": figures}) + "\n")
    with pytest.raises(ValueError, match=r"out: run 1 of .* has no figures; take it out"):
        history(tmp_path)


def test_the_reference_keeps_what_diffuses():
    assert reference().sum() == pytest.approx(1, rel=1e-5)
    assert 0 < reference().max() < 0.1


@pytest.mark.parametrize(
    ("before", "now", "told"),
    [
        (STEADY, 1.3, 0),  # less than 30% above the median
        (STEADY, 1.5, 1),
        (STEADY[:2], 9.0, 0),  # too few to know
        ([{"push": {"ratio": r}} for r in (1.0, 2.0, 1.0, 2.0)], 2.9, 0),  # within three spreads
        ([{"push": {"ratio": r}} for r in (1.0, 2.0, 1.0, 2.0)], 3.1, 1),
        ([{"push": {"ratio": 9.0}}] * 5 + STEADY, 1.5, 1),  # only the last ten count
        ([{"settle": {"ratio": 1.0}}] * 9, 9.0, 0),  # a new job
    ],
)
def test_slower_is_what_is_slower_by_a_third_and_by_three_spreads(before, now, told):
    assert len(slower(before, {"push": {"ratio": now}})) == told


def test_runs_are_kept_and_compared_with_those_of_the_same_machine(tmp_path):
    def run(machine, ratio):
        row = {"name": "push", "ratio": ratio, "compile_ratio": 5.0, "seconds": 1.0, "compile_seconds": 5.0}
        return with_history([row], {"machine": machine, "commit": "abc", "date": "2026-01-01"}, tmp_path)

    assert [run("one", 1.0) for _ in range(3)] == [[], [], []]
    assert run("another", 9.0) == []
    assert run("one", 2.0) == ["push: ratio 2 is 2.0 times the 1 of the last 3 runs"]
    assert [kept["figures"]["push"]["ratio"] for kept in history(tmp_path)] == [1, 1, 1, 9, 2]
    lines = [line.get_ydata() for line in history_figure(history(tmp_path)).axes[0].lines]
    np.testing.assert_array_equal(lines, [[1, 1, 1, 2]])
    (tmp_path / HISTORY).write_text(json.dumps({"machine": "one"}) + "\n")
    with pytest.raises(ValueError, match="line 1 of .* is no row of this bench"):
        run("one", 1.0)


@pytest.mark.slow
def test_jobs_run_and_those_that_compile_say_so(monkeypatch):
    """Of all jobs two; CI runs the whole bench."""
    few = {name: job for name, job in speed.jobs().items() if name in ("settle 512 maps", "plan a letter")}
    monkeypatch.setattr(speed, "jobs", lambda: few)
    jax.clear_caches()  # earlier tests of this process may have settled alike
    rows = bench_speed(rounds=1)
    assert {row["name"] for row in rows} == set(few)
    assert all(row["ratio"] > 0 for row in rows)
    assert [row["name"] for row in rows if row["compile_ratio"] is None] == ["plan a letter"]
