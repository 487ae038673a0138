"""The page that shows sand in a browser: what it holds, read as the page reads it."""

import base64
import json
import re
import shutil
import subprocess
import zlib

import numpy as np
import pytest

import jaxsand as js

SPACING = 0.01
RNG = np.random.default_rng(3)


def told(page):
    """What a page is told, from its text."""
    (text,) = re.findall(r'<script type="application/json" id="data">(.*?)</script>', page.html(), re.DOTALL)
    return json.loads(text)


def maps_of(panel):
    """A panel's maps [F, H, W] (m), with its goal last, NaN where there is none."""
    size = panel["maps"] * panel["shape"][0] * panel["shape"][1]
    low, high = np.frombuffer(zlib.decompress(base64.b64decode(panel["data"])), np.uint8).reshape(2, size).astype(np.uint16)
    numbers = np.cumsum((low | (high << 8)).reshape(panel["maps"], *panel["shape"]), axis=0, dtype=np.uint16)
    whole = numbers.view(np.int16).astype(float)
    return np.where(whole == -32768, np.nan, panel["low"] + (whole + 32767) * panel["step"])


def test_heights_come_back_to_half_a_step():
    """Of 65,535 steps between the lowest and the highest, holes and free cells included."""
    frames, goal = RNG.normal(0, 0.01, (5, 9, 7)), RNG.normal(0, 0.02, (9, 7))
    frames[:, 2, 3], goal[4, :2] = np.nan, np.nan
    (panel,) = told(js.view(js.Panel(frames, SPACING, goal=goal)))["panels"]
    found, wanted = maps_of(panel), np.concatenate([frames, goal[None]])
    assert np.array_equal(np.isnan(found), np.isnan(wanted))
    assert panel["step"] == pytest.approx((np.nanmax(wanted) - np.nanmin(wanted)) / 65534)
    assert np.nanmax(np.abs(found - wanted)) <= 0.5000001 * panel["step"]


@pytest.mark.parametrize("height", [np.zeros((1, 1)), np.full((3, 4), 7.0), np.full((2, 2), np.nan), np.eye(3) * 1e30])
def test_extreme_maps(height):
    (panel,) = told(js.view(height, spacing=1e-6))["panels"]
    assert np.allclose(maps_of(panel)[0], height, rtol=1e-4, equal_nan=True)


def test_a_page_of_noise_stays_small():
    """100 maps of 64 x 64 under 2 MB, even such as cannot be packed."""
    page = js.view(RNG.normal(size=(100, 64, 64)), spacing=SPACING)
    assert 1e6 < len(page.html()) < 2e6


def test_long_films_are_thinned_with_their_poses():
    frames = np.arange(250.0)[:, None, None] * np.ones((250, 4, 4))
    poses = np.stack([np.arange(250.0), *np.zeros((4, 250))], axis=1)
    poses[0] = np.nan
    (panel,) = told(js.view(js.Panel(frames, SPACING, poses=poses)))["panels"]
    assert panel["maps"] == len(panel["poses"]) == 100
    assert panel["poses"][0] is None
    shown = maps_of(panel)[:, 0, 0]
    assert [pose[0] for pose in panel["poses"][1:]] == pytest.approx(shown[1:].round(), abs=1e-6)
    assert shown[[0, -1]] == pytest.approx([0, 249])


def test_several_are_shown_by_one_scale():
    page = js.view(np.eye(4) * 0.01, -np.eye(6) * 0.03, spacing=SPACING, title="two")
    data = told(page)
    assert [panel["title"] for panel in data["panels"]] == ["map 1", "map 2"]
    assert (data["title"], data["span"]) == ("two", pytest.approx(0.03))


def test_the_page_needs_no_network_and_keeps_titles_as_text():
    title = '</script><b onload="x">&'
    page = js.view(js.Panel(np.zeros((3, 3)), SPACING, title))
    assert told(page)["panels"][0]["title"] == title
    text = page.html()
    assert text.count("<script") == text.count("</script>") == 2
    assert not re.search(r"https?:|src=|@import|url\(|fetch\(", text)
    assert page._repr_html_().startswith('<iframe srcdoc="&lt;!doctype html&gt;')


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: js.view(spacing=SPACING), "^shown: got nothing"),
        (lambda: js.view(np.zeros((3, 3))), "^spacing: is missing"),
        (lambda: js.view(np.zeros(3), spacing=SPACING), r"^heights: got float64 of shape \[3\]"),
        (lambda: js.view(np.zeros((0, 3)), spacing=SPACING), r"^heights: got float64 of shape \[0, 3\]"),
        (lambda: js.view(np.array([["a"]]), spacing=SPACING), "^heights: got <U1"),
        (lambda: js.view(np.zeros((3, 3)), spacing=0.0), "^spacing: got 0.0"),
        (lambda: js.view(np.full((3, 3), np.inf), spacing=1.0), "^heights: got cells that are infinite"),
        (lambda: js.Panel(np.zeros((3, 3)), 1.0, goal=np.zeros((2, 3))), r"^goal: got shape \[2, 3\]"),
        (lambda: js.Panel(np.zeros((3, 3)), 1.0, poses=np.zeros((1, 4))), r"^poses: got shape \[1, 4\]; give \[1, 5\]"),
        (lambda: js.view(np.zeros((5000, 5000)), spacing=1.0), "^shown: got 25000000 cells"),
    ],
)
def test_mistakes_are_named(make, message):
    with pytest.raises(ValueError, match=message):
        make()


@pytest.fixture(scope="module")
def filmed():
    scene = js.make_scene((16, 16), SPACING, tool=js.Blade())
    paths = [np.array([[0.04, 0.08, -0.004], [0.12, 0.08, 0.0]]), np.array([[0.08, 0.04, -0.003], [0.08, 0.12, -0.003]])]
    return scene, paths, js.film(scene, None, np.full((16, 16), -0.001), paths)


def test_a_film_ends_as_its_paths_do(filmed):
    scene, paths, result = filmed
    height = np.zeros((16, 16), np.float32)
    for path in paths:
        height = js.follow(scene, height, path.astype(np.float32)).height
    assert np.abs(result.after - np.asarray(height)).max() < 1e-4
    assert np.array_equal(result.frames[-1], result.after)
    assert result.steps == 2
    known = np.isfinite(result.bottoms)
    assert np.array_equal(known, np.isfinite(result.tools[:, 0]))
    first = known & (np.arange(len(known)) < len(known) // 2)
    assert result.bottoms[first] == pytest.approx(-0.004 + (result.tools[first, 0] - 0.04) / 0.08 * 0.004, abs=1e-6)


def test_a_film_is_shown_with_its_goal_paths_and_tool(filmed, tmp_path):
    _, paths, result = filmed
    result.to_html(tmp_path / "film.html")
    text = (tmp_path / "film.html").read_text(encoding="utf-8")
    assert text == js.view(result).html()
    (panel,) = told(js.view(result))["panels"]
    assert panel["has_goal"]
    assert np.allclose(panel["paths"], paths)
    assert panel["footprint"] == pytest.approx([0.02, 0.06], abs=0.1)
    assert len(panel["poses"]) == panel["maps"] - 1 == len(result.frames)


def test_paths_of_a_film_are_points():
    scene = js.make_scene((8, 8), SPACING, tool=js.Blade())
    for paths in ([np.zeros(4)], [np.zeros((1, 2))], [np.full((2, 2), np.nan)]):
        with pytest.raises(ValueError, match=r"^paths\[0\]: got shape .*; give two points or more"):
            js.film(scene, None, np.zeros((8, 8)), paths)


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("chromium") is None, reason="needs Chromium")
@pytest.mark.parametrize("hash_", ["", "#flat"])
def test_a_browser_draws_it(filmed, tmp_path, hash_):
    filmed[2].to_html(tmp_path / "film.html")
    options = ["--headless", "--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
    command = ["chromium", *options, "--virtual-time-budget=5000", "--dump-dom", f"file://{tmp_path}/film.html{hash_}"]
    dom = subprocess.run(command, capture_output=True, text=True, timeout=120, check=True).stdout
    assert int(re.search(r'data-drawn="(\d+)"', dom).group(1)) > 0
    assert "<figcaption>sand: 2 strokes, IoU" in dom
