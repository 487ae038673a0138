"""Plans as waypoints: in order, lifted in between, and read back as they were written."""

import csv
import json

import numpy as np
import pytest

import jaxsand as js
from jaxsand.planning.waypoints import waypoints, write_waypoints

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
