"""The command line as a user meets it: files, JSON, exit codes, and one line for every mistake."""

import json
import os
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from PIL import Image

from jaxsand.__main__ import main
from jaxsand.goals.metrics import volume_error
from jaxsand.planning.search.rollouts import Effort
from tests import conftest
from tests.cli.conftest import DRAWINGS, SHEET

HURRY = " ".join(f"--{name}={str(value).lower()}" for name, value in conftest.HURRY.items())


def run(*arguments, environment=None, **options):
    environment = os.environ | {"PYTHONWARNINGS": "error", "XLA_FLAGS": HURRY} | (environment or {})
    return subprocess.run(
        [sys.executable, "-m", "jaxsand", *arguments],
        capture_output=True,
        text=True,
        check=False,
        env=environment,
        **options,
    )


def test_shape_writes_its_report_and_pictures(here):
    done = run("shape", "l.txt", "--out", "out", "--json", "--html", "--live", "--resolution", "5", cwd=here)
    assert done.returncode == 0, done.stderr
    assert done.stderr == ""
    report = json.loads(done.stdout)
    assert json.loads((here / "out" / "result.json").read_text()) == report
    assert report["goal"] == "l"
    assert (report["goal_kind"], report["method"], report["lifted"]) == ("map", "plan", False)
    assert report["steps"] == len(report["strokes"]) == 4
    for name in ("iou", "l2_reduction", "l2_reduction_with_berms", "volume_error", "max_slope_deg", "seconds"):
        assert isinstance(report[name], float), name
    assert report["iou"] > 0.7
    assert report["volume_error"] <= 1e-6
    names = ["result.json", "shape.gif", "shape.html", "shape.png"]
    assert sorted(Path(f).name for f in report["files"]) == sorted(p.name for p in (here / "out").iterdir()) == names
    assert "l: 4 steps" in (here / "out" / "shape.html").read_text()
    with Image.open(here / "out" / "shape.png") as picture:
        assert min(picture.size) > 800
    with Image.open(here / "out" / "shape.gif") as film:
        assert film.n_frames == 6


def test_settle_keeps_dtype_and_volume(here):
    for dtype in (np.float32, np.float64):
        heights = np.eye(12, dtype=dtype) * dtype(0.05)
        np.save(here / "in.npy", heights)
        done = run("settle", "in.npy", "--out-file", "out.npy", "--json", cwd=here)
        assert done.returncode == 0, done.stderr
        report = json.loads(done.stdout)
        settled = np.load(here / "out.npy")
        assert settled.dtype == dtype
        assert report["outcome"] == "clean"
        assert report["sweeps"] > 0
        assert report["residual"] <= 1e-3
        assert report["volume_error"] == volume_error(heights, settled) <= 1e-6


def test_settle_says_when_the_map_is_not_still(here, capsys):
    assert main(["settle", "pile.npy", "--out-file", "out.npy", "--bound", "8", "--json"]) == 0
    out, err = capsys.readouterr()
    assert json.loads(out)["outcome"] == "not_still"
    assert "not still" in err


def test_plan(here, capsys):
    assert main(["plan", "l.txt", "--start", "0,0", "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    assert (report["path"], report["steps"], report["optimal"], report["lower_bound"]) == ("SSEE", 4, True, 4)
    for letter in "Ss":
        assert main(["plan", letter]) == 0
        assert "steps: 27" in capsys.readouterr().out


def test_plan_by_every_engine(here, capsys):
    for engine in ("auto", "paper", "astar", "exact", "anytime"):
        assert main(["plan", "T", "--engine", engine, "--json"]) == 0
        report = json.loads(capsys.readouterr().out)
        assert (report["steps"], report["optimal"], report["gap"]) == (18, True, 0)
    assert main(["plan", "T", "--engine", "paper", "--weight", "2.4", "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    assert (report["steps"], report["opened"], report["optimal"], report["engine"]) == (21, 820, False, "paper")


def test_plan_with_an_end_turns_and_a_picture(here, capsys):
    assert main(["plan", "A", "--end", "0,1", "--turn-cost", "0.5", "--seconds", "5", "--out", "plans", "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    assert report["optimal"]
    assert report["cost"] > report["steps"] >= 29
    picture, data = (here / file for file in report["files"])
    with Image.open(picture) as image:
        assert image.size[0] > 200
    assert json.loads(data.read_text())["path"] == report["path"]


GOALS_WITHOUT_A_BINARY_PLAN = {"level": 0.0, "mound": 0.01, "shallow trench": -0.003}
AT_BEST = {"level": 0.0, "mound": 0.0304, "shallow trench": 0.003 * 32 / 12}  # by volume, and a mound's steep sides


@pytest.mark.wide
@pytest.mark.parametrize("method", ["search", "optimise"])
@pytest.mark.parametrize("name", GOALS_WITHOUT_A_BINARY_PLAN)
def test_no_binary_plan_is_asked_of_methods_that_use_none(here, capsys, monkeypatch, name, method):
    """The method gets the goal, on sand at rest, and a blade that digs no deeper; what it finds is compared whole."""
    from jaxsand.planning import methods, targets

    goal = np.zeros((12, 12))
    goal[4:8, 2:10] = GOALS_WITHOUT_A_BINARY_PLAN[name]
    np.save(here / "goal.npy", goal)
    np.save(here / "rough.npy", np.linspace(-0.005, 0.005, 144).reshape(12, 12))
    asked = []

    def plan_sand(scene, start, goal, **options):
        asked.append((scene, start, goal))
        return methods.SandPlan((), start, 1.0, 1.0, 0.0, 0.0, Effort(), "too little; give more")

    def optimise_strokes(scene, goal, start, **options):
        asked.append((scene, start, goal))
        return methods.Optimised(np.zeros((0, 4)), np.ones(1), np.zeros(1), 0, start, "too little; give more")

    def plan(*_, **__):
        raise AssertionError("a binary plan that nobody uses")

    monkeypatch.setattr(methods, "plan_sand", plan_sand)
    monkeypatch.setattr(methods, "optimise_strokes", optimise_strokes)
    monkeypatch.setattr(targets, "plan", plan)
    assert main(["shape", "goal.npy", "--surface", "rough.npy", "--method", method, "--out", "out", "--json"]) == 0
    out, err = capsys.readouterr()
    report = json.loads(out)
    digs = ", or use --method plan, which compares only what is dug" if name == "shallow trench" else ""
    assert err == f"warning: strokes: too little; give more{digs}\n"
    assert report["search"]["reason"] == "too little; give more"
    assert report["search"]["at_best"] == pytest.approx(AT_BEST[name], rel=0.01, abs=1e-6)
    ((scene, start, given),) = asked
    assert np.array_equal(given, goal)
    assert np.ptp(start) == pytest.approx(0.01, rel=0.1)
    assert float(scene.tool.depth) == report["blade"]["depth"] == max(0, -goal.min())
    assert (report["method"], report["strokes"], report["l2_reduction"]) == (method, [], 0)
    assert report["l2_reduction"] == report["l2_reduction_with_berms"]


@pytest.mark.parametrize("method", ["search", "optimise", "policy"])
@pytest.mark.parametrize("name", ["pit", "pad", "plain"])
def test_methods_get_a_drawing_with_its_weights(here, name, method):
    from jaxsand.cli.parser import _parser
    from jaxsand.cli.target import read_target
    from jaxsand.goals.drawing import read_drawing

    target = read_target(_parser().parse_args(["shape", f"{name}.json", "--method", method]))
    assert (target.kind, target.name) == ("drawing", name)
    assert (target.scene.grid.shape, float(target.scene.grid.spacing)) == ((12, 12), 0.02)
    assert float(target.scene.tool.depth) == 0.004
    drawn = read_drawing(DRAWINGS[name], target.scene)
    np.testing.assert_array_equal(target.goal, drawn.height)
    assert (target.goal == -0.004).sum() == 6 * 4
    if name == "pit":
        np.testing.assert_array_equal(target.wanted.above, drawn.above)
    else:
        assert target.wanted is target.goal


@pytest.mark.parametrize("name", ["pit", "plain"])
def test_a_drawing_is_planned(here, name):
    """Heaps may lie outside, as with every goal of the binary plan."""
    from jaxsand.cli.parser import _parser
    from jaxsand.cli.target import read_target

    target = read_target(
        _parser().parse_args(["shape", f"{name}.json", "--method", "plan", "--resolution", "3", "--depth-mm", "4"])
    )
    assert (target.kind, target.method, target.drawn, target.weighted) == ("drawing", "plan", True, None)
    assert len(target.paths) == 1
    assert np.all(abs(target.paths[0] - 0.12) < [0.06, 0.04])


def test_the_report_of_a_drawing(here, capsys, monkeypatch):
    from jaxsand.planning import methods

    def plan_sand(scene, start, goal, **options):
        assert goal.free.sum() == 0
        return methods.SandPlan((), start, 1.0, 1.0, 0.0, 0.0, Effort(), "too little; give more")

    monkeypatch.setattr(methods, "plan_sand", plan_sand)
    assert main(["shape", "pit.json", "--method", "search", "--json"]) == 0
    out, err = capsys.readouterr()
    report = json.loads(out)
    assert err == "warning: strokes: too little; give more\n"
    assert (report["goal"], report["goal_kind"], report["l2_reduction"]) == ("pit", "drawing", 0)
    assert report["grid"] == SHEET
    assert json.loads((here / "shape-pit" / "result.json").read_text()) == report


@pytest.mark.slow
def test_rough_sand_is_levelled(here, capsys):
    np.save(here / "level.npy", np.zeros((16, 16)))
    y, x = np.indices((16, 16)) * 1.0
    np.save(here / "rough.npy", 0.006 * np.sin(x / 2) * np.cos(y / 3))
    arguments = ["shape", "level.npy", "--surface", "rough.npy", "--method", "search", "--strokes", "2", "--pushes", "40"]
    assert main([*arguments, "--resolution", "3", "--out", "out", "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    assert report["l2_reduction"] == pytest.approx(1 - report["search"]["after"] / report["search"]["before"], abs=1e-3)
    assert report["l2_reduction"] > 0.05


@pytest.mark.slow
def test_search_on_real_sand(here, capsys):
    y, x = np.indices((16, 20)) * 1.0
    goal = 0.004 * np.sin(x / 3) * np.cos(y / 4)
    np.save(here / "waves.npy", goal)
    arguments = ["shape", "waves.npy", "--method", "search", "--strokes", "2", "--pushes", "40", "--resolution", "2"]
    assert main([*arguments, "--depth-mm", "2", "--seed", "0", "--out", "waves", "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    found = report["search"]
    assert (report["method"], report["lifted"]) == ("search", report["steps"] > 1)
    assert report["steps"] <= 2
    assert max(found["lower_bound"], found["at_best"]) <= found["after"] < found["before"]
    assert report["l2_reduction"] == pytest.approx(1 - found["after"] / found["before"], abs=1e-3)
    assert found["before"] == pytest.approx(np.linalg.norm(goal), rel=1e-5)
    assert 0 < found["full_pushes"] <= found["rollouts"]
    assert all((here / file).exists() for file in report["files"])


@pytest.mark.wide
def test_the_policy_trenches_a_letter(here, capsys):
    assert main(["shape", "U", "--method", "policy", "--out", "alone", "--json"]) == 0
    alone = json.loads(capsys.readouterr().out)
    assert (alone["method"], alone["goal_kind"], alone["steps"]) == ("policy", "glyph", 3)
    assert alone["search"]["rollouts"] == 3
    assert alone["iou"] > 0.8


def test_the_pushes_of_a_policy_count_those_before_the_gradients():
    from jaxsand.cli.parser import _parser
    from jaxsand.cli.shape import _polish

    def left(*arguments):
        return _polish(_parser().parse_args(["shape", "L", "--method", "policy", *arguments]), 3)

    assert left() == left("--lookahead", "2") == 0
    assert left("--refine") == 4000
    assert left("--refine", "--pushes", "100") == 97
    assert left("--refine", "--pushes", "1000", "--lookahead", "2") == 1000 - (3 * 4 + 8 * 3**2 + 14 * 3 + 3)
    with pytest.raises(ValueError, match="pushes: got 100, and the policy may take 129"):
        left("--refine", "--pushes", "100", "--lookahead", "2")


@pytest.mark.slow
def test_the_policy_looks_ahead(here, capsys):
    assert main(["shape", "T", "--method", "policy", "--out", "alone", "--json"]) == 0
    alone = json.loads(capsys.readouterr().out)
    assert main(["shape", "T", "--method", "policy", "--lookahead", "3", "--strokes", "4", "--out", "ahead", "--json"]) == 0
    ahead = json.loads(capsys.readouterr().out)
    assert ahead["search"]["after"] <= alone["search"]["after"] * (1 + 1e-5)
    assert ahead["l2_reduction"] == pytest.approx(1 - ahead["search"]["after"] / ahead["search"]["before"], abs=1e-3)
    assert ahead["iou"] > 0.8


@pytest.mark.slow
@pytest.mark.parametrize("mask", ["mask.npy", "mask.png"])
def test_free_cells_are_those_of_a_mask_or_of_no_number(here, capsys, mask):
    """A pit 4 mm deep, all around which is free: by NaN, by booleans, or by a picture whose first row is on top."""
    inside = np.zeros((12, 16), bool)
    inside[2:7, 4:12] = True
    np.save(here / "pit.npy", np.where(inside, -0.004, np.nan))
    np.save(here / "drawn.npy", np.where(inside, -0.004, 0))
    np.save(here / "mask.npy", ~inside)
    Image.fromarray(np.where(inside, 255, 0).astype(np.uint8)[::-1]).save(here / "mask.png")
    search = ["--method", "search", "--strokes", "2", "--pushes", "20", "--json", "--out", "out"]
    reports = []
    for goal in (["pit.npy"], ["drawn.npy", "--free", mask]):
        assert main(["shape", *goal, *search]) == 0
        reports.append(json.loads(capsys.readouterr().out))
    assert reports[0]["strokes"] == reports[1]["strokes"]
    assert reports[0]["search"]["before"] == pytest.approx(0.004 * inside.sum() ** 0.5)
    assert reports[0]["l2_reduction"] == pytest.approx(
        1 - reports[0]["search"]["after"] / reports[0]["search"]["before"], abs=1e-3
    )


@pytest.mark.wide
@pytest.mark.parametrize(
    "goal", ["dip.npy", "7", *(pytest.param(name, marks=pytest.mark.slow) for name in ("white-S.png", "terrain"))]
)
def test_other_goals(here, capsys, goal):
    from jaxsand.goals.letters import letter_map

    Image.fromarray(np.kron(np.where(letter_map("S")[0], 0, 255), np.ones((6, 6))).astype(np.uint8)).save(
        here / "white-S.png"
    )
    y, x = np.indices((30, 36))
    np.save(here / "dip.npy", np.where((np.abs(y - 15) < 6) & (np.abs(x - 18) < 12), -0.0075, 0))
    method = "strokes" if goal == "7" else "plan"
    assert main(["shape", goal, "--out", "out", "--json", "--method", method]) == 0
    report = json.loads(capsys.readouterr().out)
    assert (
        report["goal_kind"]
        == {"p": "image", "d": "heights", "t": "terrain", "7": "glyph"}[goal[0] if goal[0] in "dt7" else "p"]
    )
    assert report["iou"] > 0.3
    assert (here / "out" / "shape.gif").stat().st_size < 2e6


def test_help_does_not_import_jax():
    code = "import sys, jaxsand.__main__ as m\ntry: m.main(['--help'])\nexcept SystemExit: pass\nassert 'jax' not in sys.modules"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert "shape" in done.stdout


@pytest.mark.wide
def test_pictures_do_not_depend_on_the_users_matplotlib(tmp_path):
    (tmp_path / "matplotlibrc").write_text("text.usetex: True\nimage.origin: lower\n")
    (tmp_path / "map.txt").write_text("###\n#.#\n")
    of_the_user = {"MPLBACKEND": "module://none.here", "MATPLOTLIBRC": str(tmp_path / "matplotlibrc")}
    pictures = []
    for environment in ({}, of_the_user):
        done = run("plan", "map.txt", "--out", ".", cwd=tmp_path, environment=environment)
        assert done.returncode == 0, done.stderr
        pictures.append((tmp_path / "plan-map.png").read_bytes())
    assert pictures[0] == pictures[1]


def test_what_a_plan_leaves_out_is_told():
    """Nothing is proven shortest that leaves out a part of the goal; see `test_pipeline`."""
    from jaxsand.cli.shape import _left_out, _summary
    from jaxsand.planning import targets

    goal = np.zeros((48, 48))
    goal[6:12, 6:30] = goal[27:33, 6:30] = -0.0075
    target = targets.height_target(goal, "heights", "straddle", targets.Layout(depth=0.0075))
    told = _left_out(target, SimpleNamespace(resolution=None))
    assert told.startswith("144 of 288 dug cells are left out")
    assert "a smaller --resolution, or use --method search" in told
    figures = dict.fromkeys(
        ("iou", "l2_reduction", "l2_reduction_with_berms", "volume_error", "max_slope_deg"), 0.5
    ) | dict.fromkeys(("seconds_compile", "seconds_run", "seconds_plan", "seconds_draw"), 1.0)
    report = {"goal": "x", "goal_kind": "heights", "method": "plan", "steps": 3, "files": [], "optimal": target.optimal}
    said = _summary(report | figures | {"lower_bound": target.lower_bound, "missed": target.missed})
    assert "3 steps (over a part of the goal: 144 of its dug cells are left out)" in said
    assert "proven" not in said


def test_cells_without_data_are_solid_to_settling(here, capsys):
    heights = np.eye(12) * 0.05
    heights[:, 8] = -9999
    for dtype, no_data in ((np.float32, "-9999"), (np.float64, "nan")):
        np.save(here / "holes.npy", np.where(heights == -9999, float(no_data), heights).astype(dtype))
        arguments = ["settle", "holes.npy", "--out-file", "out.npy", "--json"]
        assert main([*arguments, f"--no-data={no_data}"]) == 0
        report = json.loads(capsys.readouterr().out)
        settled = np.load(here / "out.npy")
        assert (report["outcome"], settled.dtype) == ("clean", dtype)
        assert report["volume_error"] <= 1e-6
        assert np.array_equal(settled[:, 8], np.full(12, float(no_data)), equal_nan=True)
        assert settled[:, :8].sum() == pytest.approx(8 * 0.05, abs=1e-6)
        assert settled[:, 9:].sum() == pytest.approx(3 * 0.05, abs=1e-6)


def test_the_first_row_lies_where_help_says(here, capsys):
    from jaxsand.cli.parser import _parser
    from jaxsand.cli.target import read_target

    rows = np.zeros((24, 24))
    rows[:6] = -0.01
    np.save(here / "first.npy", rows)
    Image.fromarray(np.where(rows < 0, 0, 255).astype(np.uint8)).save(here / "first.png")
    on_top = {
        "first.png": True,
        "first.npy": False,
        "first.npy --first-row bottom": False,
        "first.npy --first-row top": True,
    }
    for arguments, expected in on_top.items():
        target = read_target(_parser().parse_args(["shape", *arguments.split()]))
        middle = len(target.goal) // 2
        assert (target.goal[:middle].sum() > target.goal[middle:].sum()) == expected
        assert all((path[:, 1] > middle * 0.01).all() == expected for path in target.paths)
    with pytest.raises(SystemExit):
        main(["shape", "--help"])
    said = " ".join(capsys.readouterr().out.split())
    assert ".png (dark is dug; first row on top)" in said
    assert ".npy height map in m (first row at the bottom" in said
