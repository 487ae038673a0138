"""Height maps to files and back: every digit that a format promises, rows the right way up, holes where they were."""

import struct
import zipfile

import numpy as np
import pytest
from PIL import Image
from PIL.PngImagePlugin import PngInfo

import jaxsand as js
from jaxsand.goals.writing import written

RNG = np.random.default_rng(0)
HEIGHT = RNG.normal(0, 0.01, (5, 7))
HOLES = np.where(RNG.random(HEIGHT.shape) < 0.2, np.nan, HEIGHT)
MAP = js.HeightMap(HOLES, 0.02, (1.5, -2.0))


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("suffix", [".asc", ".npz", ".npy"])
def test_all_digits_come_back(tmp_path, suffix, dtype):
    path = tmp_path / f"map{suffix}"
    js.write_map(path, js.HeightMap(HOLES.astype(dtype), MAP.spacing, MAP.corner))
    found = js.read_map(path, **({"spacing": 0.02} if suffix == ".npy" else {}))
    assert np.array_equal(found.height.astype(dtype), HOLES.astype(dtype), equal_nan=True)
    assert found.spacing == 0.02
    if suffix != ".npy":
        assert found.corner == pytest.approx(MAP.corner)


@pytest.mark.parametrize("height", [HOLES, np.full((2, 3), 0.25), np.full((2, 3), np.nan), np.eye(3) * 1e6])
def test_a_picture_keeps_half_a_step(tmp_path, height):
    js.write_map(tmp_path / "map.png", js.HeightMap(height, 0.02, (1.5, -2.0)))
    found = js.read_map(tmp_path / "map.png")
    step = (np.nanmax(height) - np.nanmin(height)) / 65534 if np.isfinite(height).any() else 0
    assert np.array_equal(np.isnan(found.height), np.isnan(height))
    assert np.all(np.isnan(height) | (np.abs(found.height - height) <= 0.500001 * step))
    assert (found.spacing, found.corner) == (0.02, (1.5, -2.0))


def test_the_first_row_lies_where_the_format_says(tmp_path):
    """A heap at y = 0: in the last line of an .asc, at the bottom of a picture, first in the others."""
    heap = np.zeros((3, 2))
    heap[0, 1] = 1.0
    for suffix in (".asc", ".png", ".npz", ".hfield"):
        js.write_map(tmp_path / f"heap{suffix}", heap, spacing=1.0)
    lines = (tmp_path / "heap.asc").read_text().splitlines()
    assert lines[:6] == ["ncols 2", "nrows 3", "xllcorner 0.0", "yllcorner 0.0", "cellsize 1.0", "NODATA_value -9999"]
    assert lines[6:] == ["0.0 0.0", "0.0 0.0", "0.0 1.0"]
    with Image.open(tmp_path / "heap.png") as image:
        assert np.asarray(image).tolist() == [[1, 1], [1, 1], [1, 65535]]
    assert np.load(tmp_path / "heap.npz")["elevation"][0, 1] == 1
    assert np.load(tmp_path / "heap.npz")["position"].tolist() == [1.0, 1.5]
    numbers = (tmp_path / "heap.hfield").read_bytes()
    assert struct.unpack("<ii6f", numbers) == (3, 2, 0, 1, 0, 0, 0, 0)


def test_grids_of_others_are_read(tmp_path):
    """Centres in place of corners, capitals, lines broken anywhere, a no-data value of their own or the usual one."""
    path = tmp_path / "grid.asc"
    path.write_text("NCOLS 2\nNROWS 2\nXLLCENTER 10.5\nYLLCENTER 0.5\nCELLSIZE 1\nNODATA_value -1\n1 2 3\n-1\n")
    found = js.read_map(path)
    assert np.array_equal(found.height, [[3, np.nan], [1, 2]], equal_nan=True)
    assert found.corner == (10.0, 0.0)
    path.write_text("ncols 1\nnrows 2\nxllcorner 0\nyllcorner 0\ncellsize 1\n-9999\nnan\n")
    assert np.isnan(js.read_map(path).height).all()


def read_ply(path):
    head, _, body = path.read_bytes().partition(b"end_header\n")
    vertices, faces = (int(line.split()[-1]) for line in head.decode().splitlines() if line.startswith("element"))
    points = np.frombuffer(body, "<f4", 3 * vertices).reshape(-1, 3)
    return points, np.frombuffer(body[12 * vertices :], [("count", "u1"), ("corners", "<i4", 3)], faces)


def test_a_mesh_has_a_vertex_at_each_known_cell(tmp_path):
    js.write_map(tmp_path / "map.ply", MAP)
    points, faces = read_ply(tmp_path / "map.ply")
    i, j = np.nonzero(np.isfinite(HOLES))
    wanted = np.stack([1.5 + (j + 0.5) * 0.02, -2.0 + (i + 0.5) * 0.02, HOLES[i, j]], 1)
    assert np.allclose(points, wanted, atol=1e-6)
    assert np.all(faces["count"] == 3)
    whole = sum(
        2 * bool(np.isfinite(HOLES[a : a + 2, b : b + 2]).all())
        + (np.isfinite(HOLES[a : a + 2, b : b + 2]).sum() == 3 and bool(np.isnan(HOLES[[a, a + 1], [b + 1, b]]).any()))
        for a in range(4)
        for b in range(6)
    )
    assert len(faces) == whole
    a, b, c = (points[faces["corners"][:, k]] for k in range(3))
    assert np.all(np.cross(b - a, c - a)[:, 2] > 0)


def test_a_printed_body_is_closed_and_holds_the_sand(tmp_path):
    """Each edge belongs to two triangles, once each way; the volume is that below the triangles, base included."""
    js.write_map(tmp_path / "map.stl", HEIGHT, spacing=0.02)
    data = (tmp_path / "map.stl").read_bytes()
    body = np.frombuffer(data[84:], [("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("spare", "<u2")])
    assert struct.unpack("<I", data[80:84]) == (len(body),)
    edges = [
        (tuple(one[k]), tuple(one[(k + 1) % 3]))
        for one in body["corners"].tolist()
        for k in range(3)
        for one in [list(map(tuple, one))]
    ]
    assert len(set(edges)) == len(edges)
    assert {(b, a) for a, b in edges} == set(edges)
    corners = body["corners"].astype(float)
    inside = np.einsum("ni,ni->n", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])).sum() / 6
    four = np.stack([HEIGHT[:-1, :-1], HEIGHT[:-1, 1:], HEIGHT[1:, 1:], HEIGHT[1:, :-1]])
    above = (four[[0, 1, 2]].mean(0) + four[[0, 2, 3]].mean(0)) / 2 - (HEIGHT.min() - 0.1 * 7 * 0.02)
    assert inside == pytest.approx(above.sum() * 0.02**2, rel=1e-5)


@pytest.mark.parametrize(
    ("act", "message"),
    [
        (lambda f: js.read_map(f / "none.asc"), r"none.asc: no such file"),
        (lambda f: js.read_map(f / "map.tif"), r"map.tif: .tif is not read; give a .asc"),
        (lambda f: js.read_map(f / "map.npy"), "^spacing: is missing"),
        (lambda f: js.read_map(f / "none.asc", spacing=1.0), "^spacing: .asc files have their own"),
        (lambda f: js.read_map(f / "bad.asc"), "bad.asc: cannot be read as a height map: nrows is missing"),
        (lambda f: js.read_map(f / "short.asc"), "it holds 1 heights for 2 rows and 2 columns"),
        (lambda f: js.read_map(f / "huge.asc"), "it has 1000000 rows"),
        (lambda f: js.read_map(f / "plain.png"), "jaxsand is missing"),
        (lambda f: js.read_map(f / "bad.npz"), "bad.npz: cannot be read as a height map"),
        (lambda f: js.write_map(f / "map.tif", HEIGHT, spacing=1.0), ".tif is not written; give one of .asc"),
        (lambda f: js.write_map(f / "map.asc", HEIGHT), "^spacing: is missing"),
        (lambda f: js.write_map(f / "map.asc", MAP, spacing=1.0), "^spacing: a HeightMap has its own"),
        (lambda f: js.write_map(f / "map.stl", MAP), "^height: got cells without data, which .stl"),
        (lambda f: js.write_map(f / "map.stl", HEIGHT[:1], spacing=1.0), "^height: got 1 x 7 cells"),
        (lambda f: js.write_map(f / "map.asc", HEIGHT * 0 - 9999, spacing=1.0), "^height: got -9999"),
        (lambda f: js.write_map(f / "map.asc", HEIGHT[0], spacing=1.0), r"^height: got float64 of shape \[7\]"),
        (lambda f: js.HeightMap(HEIGHT, 0.0), "^spacing: got 0.0"),
        (lambda f: js.HeightMap(HEIGHT + np.inf, 1.0), "^height: got cells that are infinite"),
        (lambda f: js.HeightMap(HEIGHT, 1.0, (np.nan, 0.0)), "^corner: got"),
        (lambda f: js.HeightMap(HEIGHT, "wide"), "^spacing: got 'wide'"),
        (lambda f: js.HeightMap(HEIGHT, 10**400), "^spacing: got 1000"),
        (lambda f: js.HeightMap(HEIGHT, 1.0, 3.0), "^corner: got 3.0; give x and y"),
        (lambda f: js.HeightMap(HEIGHT, 1.0, (1.0, 2.0, 3.0)), "^corner: got"),
        (lambda f: js.HeightMap(HEIGHT, 1.0, ([1.0, 2.0], [3.0])), "^corner: got"),
        (lambda f: js.HeightMap([[1.0], [2.0, 3.0]], 1.0), "^height: got no array"),
        (lambda f: js.HeightMap(HEIGHT + 1e300, 1.0), "^height: got cells more than 1e\\+12 m from 0"),
        (lambda f: js.write_map(np.zeros(3), HEIGHT, spacing=1.0), "^path: got an array of shape"),
        (lambda f: js.read_map(f / ("x" * 300 + ".asc")), "cannot be read as a height map: File name too long"),
        (lambda f: js.read_map(f / "endless.asc"), "cannot be read as a height map: nrows is inf"),
    ],
)
def test_mistakes_are_named(tmp_path, act, message):
    (tmp_path / "bad.asc").write_text("ncols 2\nxllcorner 0\n")
    (tmp_path / "short.asc").write_text("ncols 2\nnrows 2\nxllcorner 0\nyllcorner 0\ncellsize 1\n1\n")
    (tmp_path / "huge.asc").write_text("ncols 1000000\nnrows 1000000\nxllcorner 0\nyllcorner 0\ncellsize 1\n1\n")
    (tmp_path / "endless.asc").write_text("ncols 2\nnrows inf\nxllcorner 0\nyllcorner 0\ncellsize 1\n1\n")
    (tmp_path / "bad.npz").write_bytes(b"PK\x03\x04rubbish")
    Image.new("L", (3, 2)).save(tmp_path / "plain.png")
    before = sorted(tmp_path.iterdir())
    with pytest.raises(ValueError, match=message):
        act(tmp_path)
    assert sorted(tmp_path.iterdir()) == before


GRID = {"elevation": HEIGHT, "resolution": 0.1, "position": np.zeros(2)}


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"resolution": np.ones(2)}, "resolution is no number"),
        ({"resolution": "x"}, "resolution is no number"),
        ({"resolution": 1j}, "resolution is no number"),
        ({"position": np.ones(3)}, "position is no list of 2 numbers"),
        ({"position": 1.0}, "position is no list of 2 numbers"),
        ({"elevation": HEIGHT[0]}, r"elevation has shape \[7\]"),
        ({"elevation": 1.0}, r"elevation has shape \[\]"),
        ({"elevation": np.array([["a"]])}, "height: got <U1 of shape"),
    ],
)
def test_an_npz_that_is_no_height_map_is_named(tmp_path, change, message):
    np.savez(tmp_path / "x.npz", **(GRID | change))
    with pytest.raises(ValueError, match=f"x.npz: cannot be read as a height map: .*{message}"):
        js.read_map(tmp_path / "x.npz")


@pytest.mark.parametrize("way", [zipfile.ZIP_LZMA, zipfile.ZIP_BZIP2])
def test_an_npz_packed_in_another_way_is_refused(tmp_path, way):
    with zipfile.ZipFile(tmp_path / "x.npz", "w", way) as archive:
        archive.writestr("elevation.npy", b"")
    with pytest.raises(ValueError, match="elevation.npy is packed in a way that numpy does not use"):
        js.read_map(tmp_path / "x.npz")


@pytest.mark.parametrize(
    "told", ["[]", "3", "{}", '{"spacing": "x"}', '{"spacing": 1e400}', '{"spacing": null}', "[" * 9999]
)
def test_a_picture_whose_notes_are_spoilt_is_named(tmp_path, told):
    notes = PngInfo()
    notes.add_text("jaxsand", told)
    Image.fromarray(np.ones((2, 3), np.uint16)).save(tmp_path / "x.png", pnginfo=notes)
    with pytest.raises(ValueError, match="x.png: cannot be read as a height map"):
        js.read_map(tmp_path / "x.png")


def test_a_npy_header_that_no_tokenizer_reads_is_named(tmp_path):
    np.save(tmp_path / "x.npy", HEIGHT)
    data = (tmp_path / "x.npy").read_bytes()
    (tmp_path / "x.npy").write_bytes(data.replace(b"}", b"(", 1))
    with pytest.raises(ValueError, match="x.npy: cannot be read as a height map"):
        js.read_map(tmp_path / "x.npy", spacing=0.1)


def test_what_could_not_be_written_leaves_what_was_there_and_nothing_else(tmp_path):
    (tmp_path / "a.txt").write_text("before")
    with pytest.raises(RuntimeError, match="in between"), written(tmp_path / "a.txt") as path:
        path.write_text("half")
        raise RuntimeError("in between")
    assert [(file.name, file.read_text()) for file in tmp_path.iterdir()] == [("a.txt", "before")]
