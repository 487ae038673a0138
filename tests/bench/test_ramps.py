"""The bench of ramps and pads, on a small ramp."""

import json

import numpy as np
import pytest
from PIL import Image

import jaxsand as js
from jaxsand.__main__ import main
from jaxsand.bench import ramps
from jaxsand.bench.ramps import Work, bench_ramps, pad, ramp

SHAPE = (12, 20)
SCENE = js.make_scene(SHAPE, 0.02, tool=js.Blade(width=0.1, thickness=0.03, depth=0.0))
LEVEL = np.zeros(SHAPE, np.float32)
X, Y = np.meshgrid((np.arange(20) + 0.5) * 0.02, (np.arange(12) + 0.5) * 0.02)
RAMP = np.where((X > 0.08) & (X < 0.3) & (Y > 0.06) & (Y < 0.16), 0.2 * (X - 0.19), np.nan)


@pytest.mark.slow
@pytest.mark.long
def test_the_bench_tells_errors_of_what_is_built():
    """Of a ramp from its foot the mean error is half its rise at first, from half its height a quarter, but for the odd row."""
    assert ramp("", 0.03, 0.0, {}).error(np.zeros((16, 32))) == pytest.approx(15 - 1 / 15)
    assert ramp("", 0.0, 0.0, {}).error(np.zeros((16, 32))) == pytest.approx(30)
    report = bench_ramps(some=(Work("small", SCENE, LEVEL, RAMP, 0.0, {"rising": 1.0}),), strokes=2, per_stroke=40, steps=0)
    rows = report["ramp"]
    assert np.shape(report["ramp_maps"][0]["after"]) == SHAPE
    assert [row["strokes_are"] for row in rows] == ["one depth", "a depth each", "rising"]
    assert rows[2]["search_mm"] < rows[1]["search_mm"] < rows[0]["search_mm"] == rows[0]["before_mm"]
    assert rows[2]["trial_mm"] == 1.0


def test_a_pad_is_scraped_at_its_own_height():
    """The pad holds as much sand as before, and lies where the blade of the one depth stands."""
    work = pad()
    inside = np.isfinite(work.goal)
    assert np.unique(work.goal[inside]).tolist() == [-work.depth]
    assert float(np.mean(work.height[inside])) == pytest.approx(-work.depth)
    assert work.error(work.height) > 3


def test_the_command_writes_its_report_and_side_views(monkeypatch, tmp_path, capsys):
    maps = [{"task": "ramp, from its foot", "after": np.zeros((16, 32)).tolist()}]
    rows = [{"task": "ramp, from its foot", "search_mm": 1.0}]
    seeds = []
    monkeypatch.setattr(ramps, "bench_ramps", lambda tell, seed: seeds.append(seed) or {"ramp": rows, "ramp_maps": maps})
    assert main(["bench", "ramp", "--seed", "3", "--out", str(tmp_path)]) == 0
    printed = capsys.readouterr().out
    assert "search mm" in printed
    assert "after" not in printed  # maps are drawn and not told
    assert seeds == [3]
    assert json.loads((tmp_path / "bench-ramp.json").read_text())["ramp"] == rows
    with Image.open(tmp_path / "bench-ramp.png") as picture:
        assert picture.size[0] > 900
