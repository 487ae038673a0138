"""Side views show the sand where it lies and the tool where it stands; a bucket's load is drawn as high as it is."""

import matplotlib.style
import numpy as np
import pytest
from matplotlib.patches import Polygon
from PIL import Image

import jaxsand as js
from jaxsand.viz.loads import draw_bucket, save_bucket_animation
from jaxsand.viz.side import Side, outline_across, outline_along, section, side_figure, sides_figure

X, Y = np.meshgrid((np.arange(30) + 0.5) * 0.01, (np.arange(20) + 0.5) * 0.01)
PLANE = 0.1 * X - 0.2 * Y + 0.01
BLADED = js.make_scene((20, 30), 0.01, tool=js.Blade(width=0.06, thickness=0.02, depth=0.004))
PATH = np.array([[0.06, 0.1, -0.02], [0.14, 0.1, 0.0], [0.14, 0.16, 0.01]])


@pytest.fixture(autouse=True)
def plain_style():
    with matplotlib.style.context("default"):
        yield


def lines(ax):
    return {line.get_label(): np.array(line.get_data()) for line in ax.lines}


def test_a_section_of_a_plane_is_the_plane_and_nothing_beyond_the_map():
    points = np.array([[0.033, 0.041], [0.2, 0.15], [0.29, 0.19], [0.301, 0.1], [0.1, -0.001]])
    found = section(PLANE, 0.01, points)
    np.testing.assert_allclose(found[:3], 0.1 * points[:3, 0] - 0.2 * points[:3, 1] + 0.01, atol=1e-12)
    assert np.isnan(found[3:]).all()


def test_profiles_along_and_across_a_path_in_millimetres():
    """Along x the plane rises by 0.1, then along y it falls by 0.2; to the left of a way along y lies smaller x."""
    along, across = side_figure(BLADED, {"sand": PLANE}, PATH).axes
    far, heights = lines(along)["sand"]
    np.testing.assert_allclose(np.interp([0.01, 0.07, 0.12], far, heights), [-3, 3, -4], atol=1e-6)
    far, bottom = lines(along)["the tool's bottom"]
    np.testing.assert_allclose(np.interp([0, 0.04, 0.08, 0.14], far, bottom), [-20, -10, 0, 10], atol=1e-9)
    left, heights = lines(across)["sand"]  # at half its length the path still runs along x
    slope = np.polyfit(left, heights, 1)[0]
    assert slope == pytest.approx(-200)
    up = np.array([[0.1, 0.05], [0.1, 0.15]])
    _, across = side_figure(BLADED, {"sand": PLANE}, up).axes
    assert np.polyfit(*lines(across)["sand"], 1)[0] == pytest.approx(-100)


def test_the_tool_stands_at_its_bottom_height_where_it_is():
    along, across = side_figure(BLADED, {"sand": PLANE}, PATH).axes
    first, last = (np.asarray(p.get_xy()) for p in along.patches if isinstance(p, Polygon))
    assert (first[:, 0].min(), first[:, 0].max(), first[:, 1].min()) == pytest.approx((-0.01, 0.01, -20))
    assert (last[:, 0].min(), last[:, 0].max(), last[:, 1].min()) == pytest.approx((0.13, 0.15, 10))
    (seen,) = (np.asarray(p.get_xy()) for p in across.patches if isinstance(p, Polygon))
    assert (seen[:, 0].min(), seen[:, 0].max()) == pytest.approx((-0.03, 0.03))
    flat, _ = side_figure(BLADED, {"sand": PLANE}, PATH[:, :2]).axes
    assert np.unique(lines(flat)["the tool's bottom"][1]).tolist() == [-4.0]  # the blade's own depth


@pytest.mark.parametrize(
    ("tool", "long", "wide"),
    [
        (js.Blade(width=0.06, thickness=0.02), 0.02, 0.06),
        (
            js.Blade(width=0.06, thickness=0.02, yaw=np.pi / 3),
            0.01 + 0.06 * np.sin(np.pi / 3),
            0.03 + 0.02 * np.sin(np.pi / 3),
        ),
        (js.Bucket(width=0.06, length=0.04, capacity=1e-4), 0.04, 0.06),
        (js.Wheel(radius=0.05, width=0.03), 0.1, 0.03),
        (js.Wheel(radius=0.05, width=0.03, slip_angle=np.pi / 2), 0.03, 0.1),
    ],
)
def test_outlines_are_as_long_and_as_wide_as_the_tool_and_stand_on_their_lowest_point(tool, long, wide):
    from_the_side, from_behind = outline_along(tool), outline_across(tool)
    assert np.ptp(from_the_side[:, 0]) == pytest.approx(long)
    assert np.ptp(from_behind[:, 0]) == pytest.approx(wide)
    assert from_the_side[:, 1].min() == from_behind[:, 1].min() == 0
    if isinstance(tool, js.Bucket):
        assert from_the_side[:, 0].max() == 0  # behind its edge


def test_a_scene_without_a_tool_and_several_at_once():
    plain = js.make_scene((20, 30), 0.01)
    figure = sides_figure([Side("one", plain, {"sand": PLANE}, PATH), Side("$two$", BLADED, {"sand": PLANE}, PATH)])
    assert [ax.get_title(loc="left") for ax in figure.axes[::2]] == ["one", "$two$"]
    assert "the tool's bottom" not in lines(figure.axes[0])


@pytest.mark.parametrize("path", [PATH[:1], PATH[:, :1], np.repeat(PATH[:1], 2, axis=0), PATH[None]])
def test_bad_paths(path):
    with pytest.raises(ValueError, match="path: got shape .*; give two points or more"):
        side_figure(BLADED, {"sand": PLANE}, path)


BUCKET = js.make_scene((10, 20), 0.01, tool=js.Bucket(width=0.04, length=0.02, capacity=2e-5))


@pytest.mark.parametrize("share", [0.0, 0.25, 1.0])
def test_the_bar_is_as_full_as_the_bucket(share):
    image = np.asarray(draw_bucket(BUCKET, np.zeros((10, 20)), share * 2e-5, np.full(4, np.nan), width=300), int)
    bar = image[32:-36, 300 + 40]
    full = np.abs(bar - (204, 168, 112)).sum(1) < 10
    assert full.mean() == pytest.approx(share, abs=0.03)
    assert np.all(full[len(full) - int(full.sum()) :])  # from below


def test_the_animation_shows_the_bucket_behind_its_edge(tmp_path):
    frames = [(np.zeros((10, 20)), 1e-5, np.array([0.1, 0.03, 0.0, 1.0])), (np.zeros((10, 20)), 0.0, np.full(4, np.nan))]
    save_bucket_animation(BUCKET, frames, tmp_path / "a.gif", width=200)
    with Image.open(tmp_path / "a.gif") as picture:
        assert (picture.n_frames, picture.size) == (2, (284, 120))
        shown = np.asarray(picture.convert("L"), float)[:100, :200]
    rows, columns = np.nonzero(shown < 110)
    assert (rows.mean(), columns.mean()) == pytest.approx((80, 100), abs=3)  # it heads up, and its body is below its edge


def test_bad_animations(tmp_path):
    with pytest.raises(ValueError, match="scene.tool: got Blade; give"):
        save_bucket_animation(BLADED, [], tmp_path / "a.gif")
    with pytest.raises(ValueError, match="frames: got none; give"):
        save_bucket_animation(BUCKET, [], tmp_path / "a.gif")
