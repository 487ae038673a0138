"""Goals as drawings: which cells a shape covers, how high it is, what it weighs, and what is said of mistakes."""

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import jaxsand as js
from jaxsand.goals import outlines
from jaxsand.goals.drawing import as_drawing
from jaxsand.goals.surfaces import places
from jaxsand.planning.pipeline import _figures
from jaxsand.planning.targets import Layout, height_goal
from jaxsand.scene.grid import Grid

SCENE = js.make_scene((12, 16), 0.01)
DISC = {"kind": "disc", "centre": [0.08, 0.06], "radius": 0.03, "height": -0.01}
SQUARE = {"kind": "rectangle", "centre": [0.05, 0.05], "size": [0.04, 0.04], "height": 0.01}
STAR = [[0.01, 0.02], [0.15, 0.03], [0.1, 0.06], [0.13, 0.11], [0.07, 0.08], [0.02, 0.115], [0.05, 0.06]]
HOLE = [[0.06, 0.05], [0.08, 0.055], [0.07, 0.07]]

KINDS = {
    "rectangle": {"centre": [0.08, 0.06], "size": [0.08, 0.03], "turned_deg": 30, "height": 1},
    "polygon": {"points": STAR, "height": 1},
    "polygon with a hole": {"points": STAR, "holes": [HOLE], "height": 1},
    "disc": {"centre": [0.08, 0.06], "radius": 0.041, "height": 1},
    "ring": {"centre": [0.08, 0.06], "radius": 0.041, "inner": 0.017, "height": 1},
    "path": {"points": [[0.03, 0.03], [0.11, 0.08]], "width": 0.023, "height": 1},
    "ramp": {"points": [[0.03, 0.03], [0.11, 0.08]], "width": 0.03, "from": 1, "to": 1},
    "text": {"text": "I", "corner": [0.03, 0.02], "size": 0.08, "width": 0.015, "height": 1},
}
KIND = {"polygon with a hole": "polygon", "ring": "disc"}


def drawn(*shapes, scene=SCENE, **others):
    return js.read_drawing({"shapes": list(shapes), **others}, scene)


def finer(cells):
    """The same map with so many times as many cells a side."""
    return js.make_scene((12 * cells, 16 * cells), 0.01 / cells)


def polygon_area(points):
    x, y = np.array(points).T
    return abs(np.dot(x, np.roll(y, -1)) - np.dot(y, np.roll(x, -1))) / 2


LENGTH = math.dist([0.03, 0.03], [0.11, 0.08])
AREAS = {
    "rectangle": 0.08 * 0.03,
    "polygon": polygon_area(STAR),
    "polygon with a hole": polygon_area(STAR) - polygon_area(HOLE),
    "disc": math.pi * 0.041**2,
    "ring": math.pi * (0.041**2 - 0.017**2),
    "path": LENGTH * 0.023 + math.pi * 0.0115**2,
    "ramp": LENGTH * 0.03,
    "text": 0.08 * 0.015 + math.pi * 0.0075**2,
}


@pytest.mark.parametrize("name", KINDS)
def test_areas_converge_at_first_order(name):
    """Cells err on the outline alone: by less than a third of its length, times their spacing."""
    for cells in (1, 4, 16):
        spacing = 0.01 / cells
        found = float(np.sum(drawn({"kind": KIND.get(name, name), **KINDS[name]}, scene=finer(cells)).height)) * spacing**2
        assert abs(found - AREAS[name]) < 0.07 * spacing
    assert found == pytest.approx(AREAS[name], rel=0.005)


def test_cells_of_rectangles_and_discs():
    goal = drawn(SQUARE)
    assert np.array_equal(np.argwhere(goal.height), [(i, j) for i in range(3, 7) for j in range(3, 7)])
    x, y = places((12, 16), 0.01)
    disc = drawn(DISC).height
    assert np.array_equal(disc < 0, np.hypot(x - 0.08, y - 0.06) < 0.03)
    inner = drawn({**DISC, "inner": 0.02}).height
    assert np.array_equal(inner < 0, (disc < 0) & (np.hypot(x - 0.08, y - 0.06) >= 0.02))


def test_shapes_that_share_an_edge_neither_overlap_nor_leave_a_gap():
    """Even where edges run through cells' centres: of a turned grid of triangles each centre lies in one."""
    grid, corners = Grid(0.01, (12, 16)), np.random.default_rng(0).integers(-2, 20, (200, 2)) * 0.005
    middle, top = np.array([0.085, 0.055]), np.array([0.085, 0.155])  # the first is the centre of a cell
    for a, b in zip(corners[::2], corners[1::2], strict=True):
        parts = [outlines.inside(np.array([middle, *ends]), grid) for ends in ((a, b), (b, top), (top, a))]
        whole = outlines.inside(np.array([a, b, top]), grid)
        assert np.array_equal(np.sum(parts, axis=0) % 2 == 1, whole)
    tiles = [
        outlines.inside(outlines.strip(np.array([[x, y], [x + 0.04, y]]), 0.03), grid)
        for x in (0.005, 0.045, 0.085)
        for y in (0.02, 0.05, 0.08)
    ]
    assert np.max(np.sum(tiles, axis=0)) == 1
    assert np.sum(tiles) == 12 * 9


def test_a_polygon_is_what_rays_and_matplotlib_say():
    from matplotlib.path import Path as Outline

    rng = np.random.default_rng(1)
    for corners in (3, 4, 7, 40):
        points = rng.uniform(-0.05, 0.2, (corners, 2))
        if corners > 4:  # matplotlib counts windings, which differ where sides cross
            angles = np.sort(rng.uniform(0, 2 * math.pi, corners))
            points = 0.06 + rng.uniform(0.02, 0.09, corners)[:, None] * np.stack([np.cos(angles), np.sin(angles)], 1)
        elif corners == 4:
            points = points[[0, 1, 2]]
        x, y = places((12, 16), 0.01)
        expected = Outline(points).contains_points(np.stack([x.ravel(), y.ravel()], 1)).reshape(x.shape)
        assert np.array_equal(outlines.inside(points, Grid(0.01, (12, 16))), expected)


def test_a_ramp_is_exact_at_the_cells_centres():
    start, end = np.array([0.03, 0.02]), np.array([0.13, 0.09])
    goal = drawn(
        {"kind": "ramp", "points": [start.tolist(), end.tolist()], "width": 0.04, "from": 0.01, "to": -0.02}, outside="free"
    )
    x, y = places((12, 16), 0.01)
    share = ((x - 0.03) * 0.1 + (y - 0.02) * 0.07) / (0.1**2 + 0.07**2)
    across = ((y - 0.02) * 0.1 - (x - 0.03) * 0.07) / math.hypot(0.1, 0.07)
    cells = (share > 0) & (share < 1) & (abs(across) < 0.02)
    assert np.array_equal(cells, ~np.isnan(goal.height))
    np.testing.assert_allclose(goal.height[cells], (0.01 - 0.03 * share)[cells], atol=1e-15)


def test_text_is_in_the_strokes_of_letters():
    goal = drawn({"kind": "text", "text": "L", "corner": [0.03, 0.02], "size": 0.08, "width": 0.02, "height": -1})
    assert goal.height[5, 3] == goal.height[2, 5] == -1  # its stem on the left, and its foot below
    assert goal.height[8, 8] == 0
    words = drawn({"kind": "text", "text": "to", "corner": [0.03, 0.02], "size": 0.06, "width": 0.01, "height": -1})
    assert 10 < -words.height.sum() < 60


def test_later_shapes_lie_over_earlier_ones():
    light = {**DISC, "above": 0.5, "below": 2}
    goal, other = drawn(light, SQUARE), drawn(SQUARE, light)
    both = (drawn(DISC).height != 0) & (drawn(SQUARE).height != 0)
    assert both.any()
    assert np.all(goal.height[both] == 0.01)
    assert np.all(goal.above[both] == 1)
    assert np.all(goal.below[both] == 1)
    assert np.all(other.height[both] == -0.01)
    assert np.all(other.above[both] == 0.5)
    assert np.all(other.below[both] == 2)


@pytest.mark.parametrize(
    ("outside", "height", "above", "below"),
    [
        ("free", np.nan, 0, 0),
        ("heaps", 0, 0, 1),
        ({}, 0, 1, 1),
        ({"height": 0.02, "above": 3}, 0.02, 3, 1),
        ({"height": 0.02, "above": 0, "below": 0}, np.nan, 0, 0),
    ],
)
def test_outside(outside, height, above, below):
    goal = drawn(DISC, outside=outside)
    cells = drawn(DISC).height == 0
    np.testing.assert_array_equal(goal.height[cells], height)
    assert np.all(goal.above[cells] == above)
    assert np.all(goal.below[cells] == below)
    assert np.all(goal.height[~cells] == -0.01)
    assert np.all(goal.above[~cells] == 1)


def test_a_free_shape_costs_nothing_and_covers_what_lies_beneath():
    goal = drawn(DISC, {"kind": "rectangle", "centre": [0.08, 0.06], "size": [0.02, 0.16], "free": True})
    assert np.array_equal(np.isnan(goal.height), goal.free)
    assert np.array_equal(goal.free, np.broadcast_to((np.arange(16) >= 7) & (np.arange(16) < 9), (12, 16)))
    assert goal.height[6, 6] == -0.01


def test_rest_leaves_no_slope_over_repose():
    deep = {**DISC, "height": -0.02}
    still, steep = drawn(deep, repose=True), drawn(deep)
    assert float(js.steepest_slope(SCENE, steep.height)) > 1
    assert (
        float(js.steepest_slope(SCENE, np.asarray(still.height, np.float32)))
        <= math.tan(float(SCENE.material.repose_angle)) * 1.002
    )
    assert np.sum(still.height) == pytest.approx(np.sum(steep.height), rel=1e-5)
    low = {**DISC, "height": -0.001}
    np.testing.assert_array_equal(drawn(low, repose=True).height, np.float32(drawn(low).height))


@pytest.mark.parametrize("outside", ["heaps", "free"])
def test_what_rest_moves_counts_as_its_shape_does(outside):
    deep = {**DISC, "height": -0.02, "above": 2}
    still, level = drawn(deep, outside=outside, repose=True), drawn(deep, repose=True).height
    moved = abs(level) > 1e-4
    assert moved.sum() > 1.2 * (drawn(deep).height < 0).sum()
    np.testing.assert_array_equal(still.height[moved], level[moved])
    assert np.all(still.above[moved] == 2)
    assert np.all(still.below[moved] == 1)
    assert np.all(still.above[~moved] == 0)


def test_a_drawing_is_in_metres_on_any_grid_as_large():
    grid = {"shape": [12, 16], "spacing": 0.01}
    coarse, fine = (drawn(SQUARE, grid=grid, scene=finer(cells)).height for cells in (1, 3))
    np.testing.assert_array_equal(np.kron(coarse, np.ones((3, 3))), fine)
    with pytest.raises(
        ValueError, match=r"grid: is for a map of 0.16 x 0.12 m, the scene has 0.16 x 0.16 m; make them equal"
    ):
        drawn(SQUARE, grid=grid, scene=js.make_scene((16, 16), 0.01))


def test_files_hold_what_dictionaries_do(tmp_path):
    file = tmp_path / "pit.json"
    file.write_text(json.dumps({"shapes": [DISC], "outside": "heaps"}))
    for path in (file, str(file)):
        goal = js.read_drawing(path, SCENE)
        np.testing.assert_array_equal(goal.height, drawn(DISC).height)
        assert goal.above.sum() == (goal.height < 0).sum()


def test_a_drawing_is_a_target_with_its_weights():
    """Results are measured by the weights that were sought."""
    goal = drawn(DISC, outside="heaps")
    target = height_goal(goal, "drawing", "pit", Layout(depth=0.01))
    assert target.wanted is target.weighted
    level, spoil = np.zeros((12, 16)), np.where(goal.height < 0, -0.01, 0.002)
    figures = _figures(target, level, spoil)
    plain = height_goal(drawn(DISC), "drawing", "pit", Layout(depth=0.01))
    assert plain.weighted is None
    assert plain.wanted is plain.goal
    assert figures["l2_reduction"] == _figures(plain, level, spoil)["l2_reduction"] == 1  # it only digs: heaps do not count
    whole = [_figures(replace(one, method="search", drawn=False), level, spoil) for one in (target, plain)]
    assert whole[0]["l2_reduction"] == 1
    assert whole[1]["l2_reduction"] == whole[1]["l2_reduction_with_berms"] == whole[0]["l2_reduction_with_berms"] < 0.9
    free = height_goal(drawn(DISC, outside="free"), "drawing", "pit", Layout(depth=0.01))
    assert free.weighted is None


def changed(**fields):
    """A drawing of one disc with other fields; those that are None are left out."""
    return {"shapes": [{key: value for key, value in {**DISC, **fields}.items() if value is not None}]}


def other(kind, **fields):
    return {"shapes": [{"kind": kind, "height": 0, **fields}]}


NEST = 0
for _ in range(500):
    NEST = [NEST]

BAD = {
    "no object": ([1, 2], r"drawing: got \[1, 2\]; give an object"),
    "nothing": ({}, r"shapes: is missing; give a list of shapes"),
    "no shapes": ({"shapes": []}, r"shapes: got 0 of them; give a list of shapes, from 1 to 1000"),
    "a million shapes": ({"shapes": [DISC] * 10**6}, "shapes: got 1000000 of them; give .* to 1000"),
    "shapes by name": ({"shapes": {"a": DISC}}, "shapes: got {'a'.*; give a list"),
    "a shape in words": ({"shapes": [DISC, "disc"]}, r"shapes\[1\]: got 'disc'; give an object .* rectangle, polygon, disc"),
    "unknown kind": (other("circle"), r"shapes\[0\].kind: got 'circle'; give one of rectangle"),
    "a kind of no kind": (other(["disc"]), r"shapes\[0\].kind: got \['disc'\]"),
    "no kind": ({"shapes": [{"height": 0}]}, r"shapes\[0\]: got .*; give an object .* with a kind"),
    "unknown key": (changed(hieght=1), r"shapes\[0\].hieght: is no field here; give some of kind, .*height"),
    "a long unknown key": (changed(**{"x" * 10**5: 1}), r"shapes\[0\].'xxx.*\.\.\..*': is no field here"),
    "unknown field of a drawing": ({"shapes": [DISC], "scale": 2}, "scale: is no field here; give some of shapes, outside"),
    "no radius": (changed(radius=None), r"shapes\[0\].radius: is missing; give a length in metres"),
    "no height": (changed(height=None), r"shapes\[0\].height: is missing; give metres .*, or free: true"),
    "free and a height": (changed(free=True), r"shapes\[0\].free: got true beside a height or weights"),
    "free and a weight": (changed(free=True, height=None, above=2), r"shapes\[0\].free: got true beside a height"),
    "free in words": (changed(free="yes"), r"shapes\[0\].free: got 'yes'; give true or false"),
    "height of nan": (changed(height=math.nan), r"shapes\[0\].height: got nan; give metres from -10000 to 10000"),
    "height in words": (changed(height="deep"), r"shapes\[0\].height: got 'deep'"),
    "height of true": (changed(height=True), r"shapes\[0\].height: got True"),
    "height of a list": (changed(height=[1]), r"shapes\[0\].height: got \[1\]"),
    "height beyond reason": (changed(height=10**400), r"shapes\[0\].height: got 1000"),
    "negative weight": (changed(above=-1), r"shapes\[0\].above: got -1; give a weight from 0 to 1e6"),
    "infinite weight": (changed(below=math.inf), r"shapes\[0\].below: got inf"),
    "radius of 0": (changed(radius=0), r"shapes\[0\].radius: got 0; give a length in metres, above 0"),
    "ring of no width": (changed(inner=0.03), r"shapes\[0\].inner: got 0.03, the radius is 0.03; give less"),
    "centre of three": (changed(centre=[1, 2, 3]), r"shapes\[0\].centre: got \[1, 2, 3\]; give x and y in metres"),
    "centre of nan": (changed(centre=[math.nan, 2]), r"shapes\[0\].centre\[0\]: got nan"),
    "centre of one number": (changed(centre=0.1), r"shapes\[0\].centre: got 0.1"),
    "polygon of two points": (other("polygon", points=STAR[:2]), r"shapes\[0\].points: got 2 of them; give the corners"),
    "polygon of a number": (other("polygon", points=3), r"shapes\[0\].points: got 3; give the corners"),
    "polygon of numbers": (other("polygon", points=[1, 2, 3]), r"shapes\[0\].points\[0\]: got 1; give x and y"),
    "polygon of one line": (other("polygon", points=[[0, 0], [0.1, 0.1], [0.05, 0.05]]), r"shapes\[0\]: covers no cell"),
    "too many corners": (other("polygon", points=[[0, 0]] * 10**5), r"shapes\[0\].points: got 100000 of them"),
    "hole of two points": (other("polygon", points=STAR, holes=[STAR[:2]]), r"shapes\[0\].holes\[0\]: got 2 of them"),
    "holes as one": (
        other("polygon", points=STAR, holes=STAR),
        r"shapes\[0\].holes\[0\]: got 2 of them; give the hole's corners",
    ),
    "a rectangle without a width": (other("rectangle", centre=[0, 0], size=[1, 0]), r"shapes\[0\].size\[1\]: got 0"),
    "turned too far": (
        other("rectangle", centre=[0, 0], size=[1, 1], turned_deg=1e9),
        r"shapes\[0\].turned_deg: got 1000000000",
    ),
    "path of one point": (other("path", points=[[0, 0]], width=1), r"shapes\[0\].points: got 1 of them; give two points"),
    "ramp with a height": (other("ramp", points=STAR[:2], width=1), r"shapes\[0\].height: is no field here; .*from, to"),
    "ramp of no length": (
        {"shapes": [{"kind": "ramp", "points": [[1, 1], [1, 1]], "width": 1, "from": 0, "to": 1}]},
        r"shapes\[0\].points: got \[1.0, 1.0\] twice",
    ),
    "text of nothing": (other("text", text=" ", corner=[0, 0], size=1, width=1), r"shapes\[0\].text: got ' '; give letters"),
    "text of no font": (
        other("text", text="éé", corner=[0, 0], size=1, width=1),
        r"shapes\[0\].text: got 'éé', which has no strokes",
    ),
    "a book": (other("text", text="a" * 10**6, corner=[0, 0], size=1, width=1), r"shapes\[0\].text: got 'aaa"),
    "a shape beside the map": (changed(centre=[1, 1]), r"shapes\[0\]: covers no cell's centre on a map of 0.16 x 0.12 m"),
    "a rectangle of no length": (other("rectangle", centre=[0.08, 0.06], size=[1e-300, 0.02]), r"shapes\[0\]: covers no"),
    "a shape between centres": (changed(centre=[0.08, 0.06], radius=0.002), r"shapes\[0\]: covers no cell"),
    "outside in other words": ({"shapes": [DISC], "outside": "level"}, 'outside: got \'level\'; give "free", "heaps"'),
    "outside of nan": ({"shapes": [DISC], "outside": {"height": math.nan}}, r"outside.height: got nan"),
    "outside of less than nothing": ({"shapes": [DISC], "outside": {"below": -2}}, r"outside.below: got -2"),
    "outside with a key": (
        {"shapes": [DISC], "outside": {"free": True}},
        r"outside.free: is no field here; give some of height",
    ),
    "repose of an angle": ({"shapes": [DISC], "repose": 0.5}, "repose: got 0.5; give true or false"),
    "a grid beyond reason": (
        {"shapes": [DISC], "grid": {"shape": [100000, 100000], "spacing": 0.01}},
        r"grid.shape\[0\]: got 100000; give a whole number of cells from 1 to 1024",
    ),
    "a grid of parts": ({"shapes": [DISC], "grid": {"shape": [1.5, 2], "spacing": 0.01}}, r"grid.shape\[0\]: got 1.5"),
    "a grid of no spacing": ({"shapes": [DISC], "grid": {"shape": [2, 2], "spacing": 0}}, r"grid.spacing: got 0; give"),
    "a grid of one number": ({"shapes": [DISC], "grid": 12}, r'grid: got 12; give {"shape": \[rows, columns\]'),
    "a grid without a shape": ({"shapes": [DISC], "grid": {"spacing": 1}}, r"grid.shape: is missing; give the numbers of"),
    "free everywhere": (
        {"shapes": [{**DISC, "height": 0, "above": 0, "below": 0}], "outside": "free"},
        "drawing: got NaN, free, in",
    ),
    "too deep a nest": (changed(height=NEST), r"shapes\[0\].height: got \[\[\["),
}


@pytest.mark.parametrize("name", BAD)
def test_mistakes_are_named(name):
    drawing, message = BAD[name]
    with pytest.raises(ValueError, match=f"^{message}") as caught:
        js.read_drawing(drawing, SCENE)
    assert len(str(caught.value)) < 400


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "Expecting value"),
        ("{'shapes': []}", "Expecting property name"),
        ('{"shapes": [], "shapes": []}', "'shapes' is given twice"),
        ("[" * 10**6, ""),
        ('{"shapes": ' + "1" * 5000 + "}", "Exceeds the limit"),
        (b"\xff\xfe\x00", "codec can't decode"),
        (b" " * (2**24 + 1), "more than 16 MiB"),
    ],
)
def test_files_that_hold_no_drawing(tmp_path, text, message):
    file = tmp_path / "bad.json"
    file.write_bytes(text.encode() if isinstance(text, str) else text)
    with pytest.raises(ValueError, match=f"bad.json: cannot be read as a drawing .*{message}.*give JSON"):
        as_drawing(file)
    with pytest.raises(ValueError, match="none.json: cannot be read as a drawing .*No such file"):
        as_drawing(Path(tmp_path / "none.json"))


def test_a_drawing_needs_a_scene():
    with pytest.raises(ValueError, match="scene: got int"):
        js.read_drawing({"shapes": [DISC]}, 3)
