"""The bench of gradients, on a tiny case."""

import json
import math
import re

import pytest

from jaxsand.__main__ import main
from jaxsand.bench import gradients as gradbench
from jaxsand.bench.gradient_checks import GradientCase
from jaxsand.bench.report import table
from jaxsand.relaxation.stopping import Sweeps, UntilStill

SMALL = (GradientCase(False),)


@pytest.fixture(scope="module")
def report():
    cost, error = gradbench.costs(print, SMALL, ((12, 4),), 1), gradbench.accuracy(print, SMALL, 4, 12)
    return {"gradient_cost": cost, "gradient_error": error}


def check_numbers(report):
    for rows in report.values():
        assert rows
        for row in rows:
            assert all(isinstance(v, str) or math.isfinite(v) for v in row.values()), row


@pytest.mark.wide
def test_the_figures_make_sense(report):
    check_numbers(report)
    (cost,) = report["gradient_cost"]
    assert cost["bytes_per_cell"] > 0
    assert cost["bytes_per_cell_and_sweep_allowed"] < cost["bytes_per_cell_and_sweep"]
    (error,) = report["gradient_error"]
    assert error["smooth"] > 0.5
    assert max(error[f"largest_by_{name}"] for name in ("height", "stroke", "angle")) < 1e-4
    assert error["float32_median"] < 1e-2


@pytest.mark.slow
def test_the_whole_bench():
    stops = (UntilStill(0.1), Sweeps(16))
    report = gradbench.bench_grad(print, None, SMALL, stops, (2,), 12, 4, 1)
    assert list(report) == [
        "gradient_cost",
        "gradient_of_plans",
        "gradient_stopped_early",
        "gradient_error",
    ]
    check_numbers(report)
    assert [row["stop"] for row in report["gradient_stopped_early"]] == ["tolerance 0.1", "16 sweeps"]


@pytest.mark.wide
def test_the_command_prints_them(report, monkeypatch, capsys, tmp_path):
    larger = []
    monkeypatch.setattr(gradbench, "bench_grad", lambda tell, batch: larger.append(batch) or report)
    assert main(["bench", "grad", "--json", "--out", str(tmp_path)]) == 0
    printed = json.loads(capsys.readouterr().out)
    assert set(report) < set(printed)
    assert printed["command"] == f"jaxsand bench grad --json --out {tmp_path}"
    assert re.fullmatch(r"\d{4}-\d\d-\d\d", printed["date"])
    assert printed["commit"] is None or re.fullmatch(r"[0-9a-f]{7,}(-dirty)?", printed["commit"])
    assert (tmp_path / "bench-grad.json").is_file()
    assert main(["bench", "grad", "--batch", "1024"]) == 0
    assert larger == [None, 1024]
    assert "gradient error" in table(printed)
