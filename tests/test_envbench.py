"""The bench of the environments, at a small size."""

from jaxsand.benchmark import table
from jaxsand.envbench import bench_env


def test_every_way_has_a_rate_and_is_set_against_gymnasium():
    rows = bench_env(4)
    kinds = {"full push", "fast push", "walk on a map", "walk on sand"}
    assert {row["kind"] for row in rows} == kinds
    for row in rows:
        assert row["steps_per_second"] > 0
        assert row["compile_seconds"] >= 0
        assert row["times_gymnasium"] > 0
        assert (row["times_gymnasium"] == 1) == (row["batch"] == 1)
    for kind in kinds:
        assert sum(row["batch"] == 1 for row in rows if row["kind"] == kind) == 1
    resets = [row["reset_us"] for row in rows if "reset_us" in row]
    assert len(resets) == 3
    assert min(resets) > 0
    shown = table({"machine": "", "batch": 4, "env": rows}).splitlines()
    assert any(line.startswith("walk on sand Gymnasium, one by one") for line in shown)
