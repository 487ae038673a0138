"""Figures of sand: what they draw, in which units, of which map."""

import numpy as np
import pytest

import jaxsand as js

HEIGHT = np.where(np.arange(12) < 6, 0.0, -0.004) * np.ones((10, 1))


def titled(figure, title):
    return next(axes for axes in figure.axes if axes.get_title(loc="left").startswith(title))


def test_a_map_is_drawn_in_millimetres_with_its_cut():
    figure = js.plot(np.stack([0 * HEIGHT, HEIGHT]), spacing=0.02)
    (image,) = titled(figure, "height").images
    assert np.allclose(image.get_array(), 1e3 * HEIGHT)
    assert image.get_extent() == pytest.approx([0, 0.24, 0, 0.2])
    assert image.origin == "lower"
    (curve,) = titled(figure, "along").lines
    assert np.allclose(curve.get_xdata(), (np.arange(12) + 0.5) * 0.02)
    assert np.allclose(curve.get_ydata(), 1e3 * HEIGHT[5])


def test_a_goal_adds_the_difference():
    goal = np.where(np.arange(10)[:, None] < 3, np.nan, -0.001) * np.ones(12)
    for figure in (js.plot(HEIGHT, spacing=0.02, goal=goal), js.plot(js.Panel(HEIGHT, 0.02, "a step", goal))):
        shown = np.ma.filled(titled(figure, "height - goal").images[0].get_array(), np.nan)
        assert np.allclose(shown, 1e3 * (HEIGHT - goal), equal_nan=True)
        assert [line.get_label() for line in titled(figure, "along").lines] == ["sand", "goal"]


@pytest.mark.parametrize("height", [np.zeros((1, 1)), np.full((3, 4), np.nan), np.eye(3) * 1e6])
def test_extreme_maps_are_drawn(height, tmp_path):
    js.plot(height, spacing=1e-3).savefig(tmp_path / "map.svg")
    assert (tmp_path / "map.svg").stat().st_size > 1000


def test_a_map_needs_its_spacing():
    for options in ({}, {"goal": HEIGHT}):
        with pytest.raises(ValueError, match="^spacing: is missing"):
            js.plot(HEIGHT, **options)
