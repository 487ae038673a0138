"""Pictures show sand and tools the right way up and the right way round."""

from types import SimpleNamespace

import numpy as np
import pytest
from PIL import Image

import jaxsand as js
from jaxsand.viz.render import _outline, lit, save_animation


def brightness(height):
    return lit(np.asarray(height, float), 0.01)[..., :3].mean()


def test_the_lamp_stands_in_the_north_west():
    y, x = np.indices((6, 6)) * 0.003
    level = brightness(np.zeros((6, 6)))
    assert brightness(x) > level > brightness(-x)  # a slope that rises to the east faces west
    assert brightness(-y) > level > brightness(y)
    assert brightness(x - y) == pytest.approx(brightness((x - y).T[::-1, ::-1]))


@pytest.mark.parametrize("shape", [(1, 4), (4, 1)])
def test_a_map_of_one_row_or_column_is_lit(shape):
    assert lit(np.zeros(shape), 0.01).shape == (*shape, 4)


def test_a_tools_outline_lies_along_its_heading():
    result = SimpleNamespace(target=SimpleNamespace(footprint=np.array([0.01, 0.04])))
    angle = np.radians(30)
    ahead, left = np.array([np.cos(angle), np.sin(angle)]), np.array([-np.sin(angle), np.cos(angle)])
    corners = _outline(result, np.array([0.1, 0.2, *ahead])) - [0.1, 0.2]
    assert sorted((corners @ ahead).tolist()) == pytest.approx([-0.005, -0.005, 0.005, 0.005])
    assert sorted((corners @ left).tolist()) == pytest.approx([-0.02, -0.02, 0.02, 0.02])


def test_an_animation_has_its_frames_and_the_tool_where_it_stands(tmp_path):
    scene = js.make_scene((10, 20), 0.01)
    tools = np.array([[0.05, 0.02, 1.0, 0.0], [np.nan] * 4])
    result = SimpleNamespace(
        target=SimpleNamespace(scene=scene, footprint=np.array([0.02, 0.02])), frames=np.zeros((2, 10, 20)), tools=tools
    )
    save_animation(result, tmp_path / "a.gif", width=200)
    with Image.open(tmp_path / "a.gif") as picture:
        assert picture.size == (200, 100)
        assert picture.n_frames == 2
        shown = np.asarray(picture.convert("L"), float)
        rows, columns = np.nonzero(shown < 0.7 * shown.max())
        assert (rows.mean(), columns.mean()) == pytest.approx((80, 50), abs=2)  # low on the left: row 0 is at the top
        picture.seek(1)
        after = np.asarray(picture.convert("L"), float)
    assert after.min() > 0.9 * after.max()
