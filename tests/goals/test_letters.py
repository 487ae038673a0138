"""Goals from real input, and what results are measured by."""

import string

import numpy as np
import pytest
from PIL import Image

from jaxsand.goals import letters, metrics, surfaces


def test_letters():
    for letter in string.ascii_uppercase:
        strokes = letters.letter_strokes(letter)
        assert strokes.shape[1] == 4
        assert np.all((strokes >= 0) & (strokes <= 1))
        dig, start = letters.letter_map(letter)
        assert dig.shape == (7, 7)
        assert dig[start]
    assert letters.letter_map("T")[0][0].all()
    assert len(letters.letter_strokes("A")) == 3
    for letter in ("a", "?", "AB", ""):
        with pytest.raises(ValueError, match="letter: got"):
            letters.letter_strokes(letter)
        with pytest.raises(ValueError, match="letter: got"):
            letters.letter_map(letter)


def test_text_in_single_strokes():
    assert np.ptp(letters.text_strokes("LONG")[:, [0, 2]]) > 2
    assert np.ptp(letters.text_strokes("LONG")[:, [1, 3]]) == pytest.approx(1)
    strokes = letters.text_strokes("L")
    assert np.all((strokes >= -1e-9) & (strokes <= 1 + 1e-9))
    # The foot of the L is its longest level stroke, and lies at the bottom.
    level = strokes[np.abs(strokes[:, 1] - strokes[:, 3]) < 1e-9]
    foot = level[np.argmax(np.abs(level[:, 0] - level[:, 2]))]
    assert foot[1] == pytest.approx(strokes[:, [1, 3]].min())
    with pytest.raises(ValueError, match="text: got ' ', which has no strokes"):
        letters.text_strokes(" ")


def test_text_maps():
    dig, start = letters.read_text_map("# a comment\n.#\n##\n\nS.\n")
    assert np.array_equal(dig, [[False, True], [True, True], [True, False]])
    assert start == (2, 0)
    for text, message in (
        ("", "no rows"),
        ("#x\n", "got 'x' in row 1"),
        ("##\n#\n", "got 1 cells in row 2, 2 in row 1"),
        ("..\n..", "no cell to dig"),
        ("SS", "got 2 starts"),
    ):
        with pytest.raises(ValueError, match=f"map: .*{message}"):
            letters.read_text_map(text)


def test_pictures(tmp_path):
    grey = np.full((4, 6), 255, np.uint8)
    grey[0, 0] = 0
    Image.fromarray(grey).save(tmp_path / "a.png")
    read = letters.read_image(tmp_path / "a.png")
    assert read.shape == (4, 6)
    assert read[3, 0] == -1  # the top left of the picture is the last row of the map
    assert read.sum() == -1
    Image.fromarray(np.zeros((2, 2, 4), np.uint8)).save(tmp_path / "clear.png")
    assert np.array_equal(letters.read_image(tmp_path / "clear.png"), np.zeros((2, 2)))
    (tmp_path / "b.png").write_text("no picture")
    with pytest.raises(ValueError, match="cannot be read as a picture"):
        letters.read_image(tmp_path / "b.png")


def test_transparency_counts_as_white_whatever_the_bits(tmp_path):
    shades = np.array([[0, 128, 255], [255, 128, 0]])
    for bits, values in ((8, shades.astype(np.uint8)), (16, (shades * 257).astype(np.uint16))):
        Image.fromarray(values).save(tmp_path / "whole.png")
        Image.fromarray(values).save(tmp_path / "clear.png", transparency=int(values[0, 1]))
        with Image.open(tmp_path / "clear.png") as image:
            assert (image.info["transparency"], image.mode.startswith("I")) == (int(values[0, 1]), bits == 16)
        whole, clear = (letters.read_image(tmp_path / name) for name in ("whole.png", "clear.png"))
        assert whole == pytest.approx(np.array([[0, -127 / 255, -1], [-1, -127 / 255, 0]]))
        assert clear == pytest.approx(np.where(np.abs(whole + 127 / 255) < 1e-6, 0, whole))


def test_numbers_that_are_no_shades_are_refused_whatever_their_name(tmp_path):
    for number, values in enumerate((np.zeros((2, 2), np.float32), np.zeros((2, 2), np.int32))):
        Image.fromarray(values).save(tmp_path / f"{number}.png", format="TIFF")
        with pytest.raises(ValueError, match="png: got a TIFF of numbers"):
            letters.read_image(tmp_path / f"{number}.png")
    Image.new("L", (2, 2), 0).save(tmp_path / "shades.png", format="TIFF")
    assert np.array_equal(letters.read_image(tmp_path / "shades.png"), np.full((2, 2), -1))


def test_height_files(tmp_path):
    np.save(tmp_path / "h.npy", np.eye(3))
    assert np.array_equal(letters.read_heights(tmp_path / "h.npy"), np.eye(3))
    for name, array, message in (
        ("cube", np.zeros((2, 2, 2)), r"got shape \[2, 2, 2\]"),
        ("empty", np.zeros((0, 3)), r"got shape \[0, 3\]"),
        ("words", np.array([["a"]]), "got dtype <U1"),
        ("complex", np.zeros((2, 2), complex), "got dtype complex128"),
        ("objects", np.array([[None]]), "cannot be read as a .npy array"),
    ):
        np.save(tmp_path / f"{name}.npy", array)
        with pytest.raises(ValueError, match=message):
            letters.read_heights(tmp_path / f"{name}.npy")
    (tmp_path / "cut.npy").write_bytes((tmp_path / "h.npy").read_bytes()[:90])
    with pytest.raises(ValueError, match=r"cannot be read as a \.npy array"):
        letters.read_heights(tmp_path / "cut.npy")


def test_terrain():
    land = surfaces.terrain()
    assert land.shape == (344, 403)
    assert 200 < land.min() < land.max() < 1100


def test_resampling_keeps_means_and_planes():
    rng = np.random.default_rng(0)
    image = rng.random((24, 36))
    small = metrics.resample(image, (7, 9))
    assert small.shape == (7, 9)
    assert small.mean() == pytest.approx(image.mean(), rel=1e-12)
    assert np.allclose(metrics.resample(image, (12, 18)), image.reshape(12, 2, 18, 2).mean((1, 3)))
    plane = np.arange(10.0)[:, None] + np.zeros(5)
    large = metrics.resample(plane, (20, 5))
    assert np.allclose(np.diff(large[1:-1, 0]), 0.5)
    assert np.array_equal(metrics.resample(image, (24, 36)), image)
    assert metrics.resample(np.ones((1, 1)), (3, 4)).shape == (3, 4)


def test_measures():
    goal = np.zeros((4, 4))
    goal[:2] = -0.01
    half = np.where(np.arange(4) < 2, goal, 0.0)
    assert float(metrics.iou(goal, goal, 0.01)) == 1
    assert float(metrics.iou(goal, half, 0.01)) == 0.5
    assert float(metrics.iou(goal * 0, goal * 0, 0.01)) == 1
    assert float(metrics.l2_reduction(goal, goal * 0, goal)) == 1
    assert float(metrics.l2_reduction(goal, goal * 0, half)) == pytest.approx(1 - np.sqrt(0.5))
    assert float(metrics.l2_reduction(goal, goal * 0, goal * 0)) == 0
    assert float(metrics.l2_reduction(goal, goal, goal)) == 1
    assert metrics.volume_error(goal, goal) == 0
    assert metrics.volume_error(goal * 0, goal * 0) == 0
    assert metrics.volume_error(goal, half) == pytest.approx(0.5)
    berms = goal.copy()
    berms[3] = 0.02
    assert float(metrics.l2(goal, np.asarray(metrics.below(berms)))) == 0
    assert float(metrics.l2(goal, berms)) == pytest.approx(0.04)


def test_map_goals_are_the_right_way_up():
    dig, _ = letters.letter_map("L")
    goal = metrics.map_goal(dig, cell=3, margin=2, depth=0.01)
    assert goal.shape == (25, 25)
    assert goal[2 + 1, 2 + 3 * 5 + 1] == -0.01  # the foot, at the bottom: low y
    assert goal[-4, 2 + 3 * 5 + 1] == 0
    centre = metrics.cell_centre(np.array([(6, 1)]), 7, 3, 2, 0.1)
    assert np.allclose(centre, [[(2 + 4.5) * 0.1, (2 + 1.5) * 0.1]])
    assert np.allclose(metrics.place([[0, 0, 1, 1]]), [[0.035, 0.035, 0.285, 0.285]])
    with pytest.raises(ValueError, match=r"goal: got shape \[25, 25\], the scene has \[8, 8\]"):
        import jaxsand as js

        metrics.fits(js.make_scene((8, 8), 0.01), goal)


def refusal(path):
    try:
        assert letters.read_heights(path).ndim == 2
    except ValueError as error:
        return str(error)


def test_spoilt_heights_are_refused_in_one_line(tmp_path):
    np.save(tmp_path / "h.npy", np.eye(3))
    good, rng = (tmp_path / "h.npy").read_bytes(), np.random.default_rng(0)
    bad = tmp_path / "bad.npy"
    for _ in range(300):
        spoilt = bytearray(good)
        for place in rng.integers(0, 128, rng.integers(1, 4)):
            spoilt[place] = rng.integers(0, 256)
        bad.write_bytes(spoilt)
        message = refusal(bad)
        assert message is None or (message.startswith(str(bad)) and "\n" not in message)
    bad.write_bytes(b"ncols 3\nnrows 3\n")
    with pytest.raises(ValueError, match=r"cannot be read as a \.npy array \(it does not begin as one\); save one"):
        letters.read_heights(bad)
