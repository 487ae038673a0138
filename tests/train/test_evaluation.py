"""Judging learners by glyphs: with a policy that knows the answers, and one that knows one stroke of each."""

import json
from dataclasses import dataclass, replace
from io import BytesIO

import numpy as np
import pytest

from jaxsand.bench.stroke_goals import letters
from jaxsand.planning.learned.stages import Stages
from train.curves import curve, curves_figure, main
from train.evaluation.glyphs import SETS, read_glyphs
from train.evaluation.scores import evaluate, judged, page, picture, replayed


@pytest.fixture(scope="module")
def glyphs():
    return letters("LT")


@dataclass(frozen=True)
class Knows:
    """The strokes of the glyph that has this goal: each on the sand that those before it left, or the first again and again."""

    glyphs: list
    forgets: bool = False

    def propose(self, scene, goal, current, count):
        out = []
        for wanted, height in zip(goal, current, strict=True):
            strokes = next(g.strokes for g in self.glyphs if np.allclose(g.goal, wanted))
            done = 0 if self.forgets or not height.any() else 1
            out.append(np.repeat(strokes[done : done + 1], count, 0))
        return np.array(out), np.zeros((len(goal), count))


@pytest.mark.wide
def test_a_policy_that_knows_the_strokes_gets_all_right(glyphs):
    report = evaluate(Knows(glyphs), glyphs, Stages())
    assert {key: report[key] for key in ("right", "strict", "total", "stroke_right")} == {
        "right": 2,
        "strict": 2,
        "total": 2,
        "stroke_right": 2,
    }
    for glyph in glyphs:
        row = report["glyphs"][glyph.name]
        assert row["strokes_right"] == row["strokes"] == len(row["pushes"]) == 2
        assert row["iou"] > 0.99
        np.testing.assert_allclose(row["pushes"], glyph.strokes, atol=1e-6)
    json.dumps(report)
    assert picture(glyphs, report, replayed(glyphs, report)).axes
    odd = replace(glyphs[0], name=r"$\frac$")  # no formula, but what a user called it
    of_odd = {"glyphs": {odd.name: report["glyphs"][glyphs[0].name]}}
    drawn = picture([odd], of_odd, replayed([odd], of_odd))
    drawn.savefig(BytesIO())
    assert drawn.axes[0].get_title().startswith(odd.name)


@pytest.mark.wide
def test_one_stroke_again_and_again_is_one_right_stroke(glyphs):
    report = evaluate(Knows(glyphs, forgets=True), glyphs, Stages())
    assert (report["right"], report["strict"], report["stroke_right"]) == (0, 0, 2)
    assert all(row["strokes_right"] == 1 for row in report["glyphs"].values())


def test_no_push_changes_nothing(glyphs):
    row = judged(glyphs[0], np.zeros((0, 4)))
    assert (row["iou"], row["l2_reduction"], row["right"], row["pushes"]) == (0, 0, False, [])


def test_a_page_shows_each_glyph_after_each_push_beside_its_goal(glyphs):
    glyph = glyphs[0]
    row = judged(glyph, glyph.strokes)
    report = {"glyphs": {glyph.name: row}, "right": 1, "total": 1}
    shown = page([glyph], report, replayed([glyph], report))
    (panel,) = shown.panels
    assert (shown.title, panel.title, panel.spacing) == ("1 of 1 right", "L*: IoU 1.000", 0.01)
    assert panel.heights.shape == (len(glyph.strokes) + 1, *glyph.goal.shape)
    np.testing.assert_array_equal(panel.heights[0], glyph.start)
    np.testing.assert_allclose(panel.heights[-1], panel.goal, atol=1e-6)
    np.testing.assert_allclose(np.reshape(panel.paths, (-1, 4)), glyph.strokes, atol=1e-6)


def test_a_glyph_file_is_read_as_letters_are(tmp_path):
    path = tmp_path / "glyphs.json"
    path.write_text(json.dumps({"bar": [[0.1, 0.5, 0.9, 0.5]]}))
    (glyph,) = read_glyphs(path)
    assert glyph.name == "bar"
    np.testing.assert_allclose(glyph.strokes, [[0.06, 0.16, 0.26, 0.16]])
    assert glyph.goal.min() < -0.005


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("no json", "cannot read"),
        ("{}", "got no glyph"),
        ("[1]", "got no glyph"),
        ('{"A": []}', "'A' has no list of strokes"),
        ('{"A": [[0, 0, 1]]}', "'A' has no list of strokes"),
        ('{"A": [[0, 0, 1, 1], [0, 0, 1, 2]]}', r"'A' has \[0.0, 0.0, 1.0, 2.0\] as stroke 2; give numbers from 0 to 1"),
        ('{"A": [["0", "0", "1", "1"]]}', "'A' has no list of strokes"),
        ('{"A": [[true, false, true, true]]}', "'A' has no list of strokes"),
        ('{"A": {"B": 1}}', "'A' has no list of strokes"),
        ('{"A": [[0, 0, 1, 1]], "A": [[0, 0, 1, 1]]}', "'A' is given twice"),
        (r'{"b\ud800": [[0, 0, 1, 1]]}', "got the name .*; give each glyph a name .* that can be printed"),
        ('{"A": [[0, 0, 1, "x"]]}', "'A' has no list of strokes"),
        ('{"A": [[1' + 400 * "0" + ", 0, 1, 1]]}", "'A' has no list of strokes"),
        (100_000 * "[", "cannot read"),
    ],
)
def test_a_bad_glyph_file_is_refused(tmp_path, content, message):
    path = tmp_path / "glyphs.json"
    path.write_text(content)
    with pytest.raises(ValueError, match=f"glyphs: .*{message}"):
        read_glyphs(path)


@pytest.mark.slow
@pytest.mark.parametrize("name", SETS)
def test_every_set_s_own_strokes_make_its_goals(name):
    for glyph in SETS[name]()[:26]:
        row = judged(glyph, glyph.strokes)
        assert row["strict"], glyph.name
        assert row["strokes_right"] == row["strokes"]


def test_curves_count_what_was_simulated_up_to_each_validation(tmp_path, capsys):
    run = tmp_path / "run"
    run.mkdir()
    assert main([str(run), "--out", str(tmp_path / "c.png")]) == 2
    assert "error: " in capsys.readouterr().err
    assert main([str(run), "--out", str(tmp_path / "c.xyz")]) == 2
    assert "ends in .png" in capsys.readouterr().err
    rows = [{"kind": "train", "seconds": 30 * k, "pushes": 10.0} for k in (1, 2)]
    rows.append({"kind": "validate", "seconds": 60, "score": 0.5})
    (run / "metrics.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows) + '{"kind": "tra')
    points = curve(run)
    assert (points["minutes"][0], points["simulated"][0], points["score"][0]) == (1, 20, 0.5)
    assert len(curves_figure({"run": points}).axes) == 2
    assert main([str(run), "--out", str(tmp_path / "c.png")]) == 0
    assert (tmp_path / "c.png").stat().st_size > 1000
    (run / "metrics.jsonl").write_text('{"kind": "train", "seconds": 3}\n')
    assert main([str(run), "--out", str(tmp_path / "c.png")]) == 2
    assert "error: run: cannot read " in capsys.readouterr().err
