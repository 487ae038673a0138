"""Plans as waypoints: in order, lifted in between, and read back as they were written."""

import csv
import json

import numpy as np
import pytest

import jaxsand as js
from jaxsand.planning.waypoints import in_steps, waypoints, write_waypoints

SCENE = js.make_scene((8, 8), 0.01, tool=js.Blade(depth=0.005))
FLAT, RISING = np.array([[0.02, 0.04], [0.06, 0.04]]), np.array([[0.02, 0.02, -0.01], [0.06, 0.02, 0.0], [0.06, 0.06, 0.01]])
CLEAR = 0.03


def test_the_tool_is_lifted_from_path_to_path_and_keeps_its_heights():
    places = waypoints(SCENE, [FLAT, RISING], CLEAR)
    assert places[:, 3].tolist() == [1, 0, 0, 1, 1, 0, 0, 0, 1]
    np.testing.assert_array_equal(places[places[:, 3] == 1, 2], CLEAR)
    np.testing.assert_array_equal(places[1:3, :3], [[0.02, 0.04, -0.005], [0.06, 0.04, -0.005]])
    np.testing.assert_array_equal(places[5:8, :3], RISING)
    np.testing.assert_array_equal(places[[0, 3, 4, 8], :2], [FLAT[0], FLAT[-1], RISING[0, :2], RISING[-1, :2]])
    assert waypoints(SCENE, [], CLEAR).shape == (0, 4)


@pytest.mark.parametrize("kind", ["csv", "json"])
def test_files_hold_every_digit(tmp_path, kind):
    places, file = waypoints(SCENE, [FLAT / 3, RISING / 7], CLEAR), tmp_path / f"plan.{kind}"
    write_waypoints(file, places)
    with file.open(newline="") as text:
        rows = json.load(text) if kind == "json" else list(csv.DictReader(text))
    read = [[float(row[name]) for name in ("x", "y", "z", "lifted")] for row in rows]
    np.testing.assert_array_equal(read, places)


@pytest.mark.parametrize("longest", [0.007, 0.04, 1.0])
def test_steps_are_the_fewest_that_are_short_enough_and_lie_on_the_way(longest):
    places = waypoints(SCENE, [FLAT, RISING], CLEAR)
    cut = in_steps(places, longest)
    np.testing.assert_array_equal([row for row in cut if (row == places).all(1).any()], places)
    lengths, legs = (np.linalg.norm(np.diff(points[:, :3], axis=0), axis=1) for points in (cut, places))
    assert lengths.max() <= longest * (1 + 1e-9)
    assert lengths.sum() == pytest.approx(legs.sum())
    assert len(lengths) == np.maximum(1, np.ceil(legs / longest - 1e-9)).sum()


def test_steps_through_the_air_are_lifted_and_those_on_the_way_down_are_not():
    cut = in_steps(waypoints(SCENE, [FLAT[:1], FLAT[1:]], CLEAR), 0.02)
    assert cut[:, 3].tolist() == [1, 0, 0, 0, 1, 1, 1, 0, 0, 0, 1]


def test_a_robot_may_have_a_longest_step_along_each_axis():
    places = np.array([[0.0, 0, 0.05, 1], [0.04, 0.04, 0.01, 0], [0.04, 0.04, 0.01, 0]])
    assert len(in_steps(places, [0.04, 0.04, 0.04])) == 3
    assert len(in_steps(places, 0.04)) == 4
    assert len(in_steps(places, [0.04, 0.04, 0.01])) == 6
    np.testing.assert_array_equal(in_steps(places[:1], 0.04), places[:1])
    assert in_steps(np.zeros((0, 4)), 0.04).shape == (0, 4)


def test_what_cannot_be_cut_is_refused():
    for places in (np.zeros(4), np.zeros((2, 3)), np.full((2, 4), np.nan)):
        with pytest.raises(ValueError, match="places: got shape"):
            in_steps(places, 0.04)
    for longest in (0.0, -0.01, np.nan, [0.04, 0.04], [0.04, 0.0, 0.04]):
        with pytest.raises(ValueError, match="longest: got"):
            in_steps(np.zeros((2, 4)), longest)


def test_what_cannot_be_replayed_is_refused(tmp_path):
    with pytest.raises(ValueError, match=r"clear: got 0.0; give a height of at least 0.01"):
        waypoints(SCENE, [RISING], 0.0)
    for path in (np.zeros(4), np.zeros((2, 4)), np.zeros((0, 2)), np.full((2, 3), np.nan)):
        with pytest.raises(ValueError, match="paths: got one of shape"):
            waypoints(SCENE, [path], CLEAR)
    with pytest.raises(ValueError, match="clear: got inf"):
        waypoints(SCENE, [FLAT], np.inf)
    with pytest.raises(ValueError, match=r"scene.tool: got Wheel, which has no depth; give paths \[n, 3\]"):
        waypoints(js.make_scene((8, 8), 0.01, tool=js.Wheel(0.03, 0.02, 0.01)), [FLAT], CLEAR)
    with pytest.raises(ValueError, match=r"file: got .*plan.txt'; give a name that ends in \.csv or \.json"):
        write_waypoints(tmp_path / "plan.txt", np.zeros((1, 4)))
