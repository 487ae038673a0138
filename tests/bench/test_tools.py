"""The bench of tools, on settling alone: its loop over points, its ratios."""

import numpy as np
import pytest

from jaxsand.bench import tools
from jaxsand.bench.gradient_checks import GradientCase

SMALL = (GradientCase(False), GradientCase(False, 4))


def test_points_are_drawn_until_enough_are_smooth(monkeypatch):
    """Of each 64 points 16 are smooth by every input; the largest error is of these alone."""
    seeds = []

    def drawn(case, points, seed, cells):
        seeds.append(seed)
        smooth = np.zeros((3, points), bool)
        smooth[:, :16], smooth[0, 16:32] = True, True
        return np.where(smooth.all(0), 1e-9 * (1 + len(seeds)), 1.0) * np.ones((3, 1)), smooth

    monkeypatch.setattr(tools, "against_differences", drawn)
    monkeypatch.setattr(tools, "of_float32", lambda *_, **__: np.array([1e-5, 3e-5]))
    (row,) = tools.right_at(print, SMALL[:1], 40, 12)
    assert (row["tried"], row["smooth"]) == (192, 48)
    assert len(set(seeds)) == 3
    assert row["largest_by_stroke"] == pytest.approx(4e-9)
    assert row["float32_largest"] == 3e-5


def test_a_search_in_vain_ends(monkeypatch):
    monkeypatch.setattr(tools, "against_differences", lambda *_, **__: (np.ones((3, 64)), np.zeros((3, 64), bool)))
    monkeypatch.setattr(tools, "of_float32", lambda *_, **__: np.array([0.0]))
    (row,) = tools.right_at(print, SMALL[:1], 8, 12)
    assert (row["tried"], row["smooth"], row["float64_median"]) == (128, 0, None)


def test_a_run_that_was_cut_off_goes_on(monkeypatch, tmp_path):
    """Rows of as many points of the same tools are kept; what was cut off, and rows of other numbers, are computed."""
    drawn = []

    def errors(tell, case, points, cells):
        drawn.append((case.name, points))
        return {"tried": points}

    monkeypatch.setattr(tools, "_errors", errors)
    monkeypatch.setattr(tools, "costs_of_tools", lambda *_: [])
    first = tools.bench_tools(print, 8, SMALL[:1], out=tmp_path)["gradient_of_tools"]
    with (tmp_path / "tools.jsonl").open("a") as file:
        file.write('{"name": "settle, 4 n')
    both = tools.bench_tools(print, 8, SMALL, out=tmp_path)["gradient_of_tools"]
    assert [row["name"] for row in both] == [case.name for case in SMALL]
    assert both[0] == first[0]
    assert tools.bench_tools(print, 8, SMALL, out=tmp_path)["gradient_of_tools"] == both
    assert drawn == [(case.name, 8) for case in SMALL]
    assert tools.bench_tools(print, 9, SMALL[:1], out=tmp_path)["gradient_of_tools"][0]["points"] == 9
    (tmp_path / "tools.jsonl").write_text('{"task": "ramp"}')
    with pytest.raises(ValueError, match="out: line 1 of .* is no row of this bench"):
        tools.bench_tools(print, 8, SMALL, out=tmp_path)


@pytest.mark.wide
def test_costs_are_told_beside_the_first():
    rows = tools.costs_of_tools(print, SMALL, 12, 2, 1)
    assert [row["name"] for row in rows] == [case.name for case in SMALL]
    assert rows[0]["times_level"] == rows[0]["gradient_times_level"] == 1
    for row in rows:
        assert row["with_gradient_ms"] == pytest.approx(row["stroke_ms"] * row["gradient_over_forward"])
