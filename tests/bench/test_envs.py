"""The bench of the environments, at a small size."""

import os
import subprocess
import sys

import pytest

from jaxsand.bench import envs
from jaxsand.bench.envs import bench_env
from jaxsand.bench.report import table

ON_SAND = "full push", "push with heights", "dig", "fast push", "walk on sand"


@pytest.mark.slow
def test_a_device_for_each_core_has_its_row():
    code = """
from jaxsand.bench import envs
from jaxsand.bench.envs import bench_env
print(*(f"{row['name']};{row['batch']};{row['steps_per_second'] > 0}" for row in bench_env(7, kinds=("walk on a map",))), sep="\\n")
"""
    done = subprocess.run(
        [sys.executable, "-c", code],
        env=os.environ | {"JAX_NUM_CPU_DEVICES": "2"},
        capture_output=True,
        text=True,
        check=True,
    )
    assert done.stdout.splitlines() == [
        "vmap;7;True",
        "vmap, a share to each device;8;True",
        "Gymnasium, one by one;1;True",
    ]


@pytest.mark.wide
@pytest.mark.parametrize("kinds", [("walk on a map",), pytest.param(ON_SAND, marks=pytest.mark.slow)])
def test_every_way_has_a_rate_and_is_set_against_gymnasium(kinds, monkeypatch):
    for name, few in (("_ROUNDS", 1), ("_STEPS", 1), ("_ALONE", 2), ("_COMPARED", 32)):
        monkeypatch.setattr(envs, name, few)
    rows = bench_env(8, kinds=kinds)
    assert [row["kind"] for row in rows if row["name"] == "vmap"] == list(kinds)
    for row in rows:
        assert row["steps_per_second"] > 0
        assert row["compile_seconds"] >= 0
        assert row["times_gymnasium"] > 0
        assert (row["times_gymnasium"] == 1) == (row["name"] == "Gymnasium, one by one")
        assert (row.get("reset_us", 0) > 0) == (row["name"] == "vmap")
        assert ("error_percent" in row) == ("repose" in row["name"] or row["name"].startswith("8 sweeps"))
        assert 0 < row.get("error_percent", 0.1) < 5
    assert len(rows) == 2 * len(kinds) + 5 * ("full push" in kinds) + 2 * ("fast push" in kinds)
    shown = table({"machine": "", "batch": 8, "env": rows}).splitlines()
    assert any(line.startswith(f"{kinds[-1]} Gymnasium, one by one") for line in shown)
