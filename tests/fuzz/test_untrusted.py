"""Files that others made: no pickle is run, no small file fills the memory, and nothing is written beside them."""

import io
import json
import os
import struct
import time
import zipfile
import zlib
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import jaxsand as js
from jaxsand.cli.printing import plain_name
from jaxsand.goals import untrusted
from jaxsand.goals.letters import read_heights, read_image, text_strokes
from jaxsand.planning.learned.policy import load_policy
from train.curves import curve
from train.evaluation.glyphs import read_glyphs
from train.runs import checkpoints
from train.runs.runs import learner_of

SCENE = js.make_scene((12, 12), 0.02)
DEEP = "[" * 100_000
LONG = 20 * 2**20  # bytes: more than is read of JSON


class Payload:
    """Makes a file where it is unpickled."""

    def __reduce__(self):
        return os.mkdir, ("unpickled",)


@pytest.fixture(autouse=True)
def here(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return tmp_path


def refused(read, path, message):
    before = sorted(Path.cwd().rglob("*"))
    began = time.perf_counter()
    with pytest.raises(ValueError, match=message) as caught:
        read(path)
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) < 1000
    assert time.perf_counter() - began < 5
    assert sorted(Path.cwd().rglob("*")) == before


def state(path):
    return checkpoints.load(path, {"x": np.zeros(3)})


def npy(path):
    return js.read_map(path, spacing=0.1)


def drawing(path):
    return js.read_drawing(path, SCENE)


@pytest.mark.parametrize(
    ("read", "member"),
    [
        (js.read_map, "elevation"),
        (js.read_map, "resolution"),
        (load_policy, "about"),
        (load_policy, "w"),
        (state, "about"),
        (state, "state/x"),
        (checkpoints.where, "about"),
    ],
)
def test_no_pickle_in_an_npz_is_run(here, read, member):
    good = {"elevation": np.zeros((2, 2)), "resolution": np.array(0.1), "about": np.array("{}")}
    np.savez(here / "x.npz", **(good | {member: np.array([Payload()], object)}))
    refused(read, here / "x.npz", "cannot (be )?read")


@pytest.mark.parametrize("read", [npy, read_heights], ids=lambda f: f.__name__)
def test_no_pickle_in_an_npy_is_run(here, read):
    np.save(here / "x.npy", np.array([[Payload()]], object))
    refused(read, here / "x.npy", "cannot be read")


@pytest.mark.parametrize("read", [js.read_map, load_policy, state], ids=lambda f: f.__name__)
def test_a_bare_pickle_is_not_run(here, read):
    import pickle

    (here / "x.npz").write_bytes(pickle.dumps(Payload()))
    refused(read, here / "x.npz", "cannot (be )?read")


def packed(path, **arrays):
    """An .npz, compressed."""
    np.savez_compressed(path, **arrays)


def claims(path, size):
    """Has the list of an .npz claim that all that is packed is so large."""
    data = bytearray(path.read_bytes())
    at = data.find(b"PK\x01\x02")
    while at >= 0:
        data[at + 24 : at + 28] = struct.pack("<I", size)
        at = data.find(b"PK\x01\x02", at + 4)
    path.write_bytes(bytes(data))


@pytest.mark.parametrize("read", [js.read_map, load_policy, state, checkpoints.where], ids=lambda f: f.__name__)
def test_what_would_unpack_to_gigabytes_is_not_unpacked(here, read):
    packed(here / "x.npz", elevation=np.zeros((4, 4)), resolution=0.1, about="{}")
    claims(here / "x.npz", 2**31)
    refused(read, here / "x.npz", "would unpack to [0-9]+ MiB, and at most 512 are read")


def test_the_bound_is_on_what_is_unpacked_and_larger_for_a_larger_file(here, monkeypatch):
    monkeypatch.setattr(untrusted, "MOST_CELLS", 1000)
    packed(here / "zeros.npz", elevation=np.zeros((64, 64)), resolution=0.1)
    refused(js.read_map, here / "zeros.npz", "would unpack to")
    np.savez(here / "whole.npz", elevation=np.zeros((64, 64)), resolution=0.1)
    assert js.read_map(here / "whole.npz").height.shape == (64, 64)


def test_an_array_that_claims_to_be_larger_than_its_member_is_refused(here):
    file = io.BytesIO()
    np.save(file, np.zeros((4, 4)))
    lies = file.getvalue().replace(b"(4, 4), }" + b" " * 6, b"(2048, 4096), }")
    assert lies != file.getvalue()
    with zipfile.ZipFile(here / "x.npz", "w") as archive:
        archive.writestr("elevation.npy", lies)
        archive.writestr("resolution.npy", lies)
    refused(js.read_map, here / "x.npz", "cannot be read")
    (here / "x.npy").write_bytes(lies)
    refused(npy, here / "x.npy", "cannot be read")


def test_names_that_lead_elsewhere_lead_nowhere(here):
    inner = here / "a" / "b"
    inner.mkdir(parents=True)
    os.chdir(inner)
    arrays = {
        "../../x": np.zeros(2),
        str(here / "y"): np.zeros(2),
        "elevation": np.zeros((2, 2)),
        "resolution": np.array(0.1),
    }
    with zipfile.ZipFile("x.npz", "w") as archive:
        for name, array in arrays.items():
            file = io.BytesIO()
            np.save(file, array)
            archive.writestr(f"{name}.npy", file.getvalue())
    before = sorted(here.rglob("*"))
    assert js.read_map("x.npz").height.shape == (2, 2)
    with pytest.raises(ValueError, match="policy: "):
        load_policy(Path("x.npz"))
    assert sorted(here.rglob("*")) == before


@pytest.mark.parametrize(
    "name", ["../../x", "../../x.json", "/etc/x.png", "..", ".", "a/b", "a\\b", "\0", "~", "x" * 300, "-", "a\nb"]
)
def test_a_goal_s_name_makes_a_folder_s_name_without_ways(name):
    made = f"shape-{plain_name(name)}"
    assert Path(made).name == made
    assert len(made) <= 46
    assert not set(made) - set("abcdefghijklmnopqrstuvwxyz-")


def png(width, height, rows=b""):
    """A PNG of one bit a pixel that says how large it is."""

    def chunk(kind, data):
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    head = chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, 1, 0, 0, 0, 0))
    return b"\x89PNG\r\n\x1a\n" + head + chunk(b"IDAT", zlib.compress(rows)) + chunk(b"IEND", b"")


@pytest.mark.parametrize("read", [js.read_map, read_image], ids=lambda f: f.__name__)
def test_a_picture_of_a_hundred_thousand_by_as_many_is_not_read(here, read):
    (here / "x.png").write_bytes(png(100_000, 100_000))
    refused(read, here / "x.png", "cannot be read as a .* pixels")
    (here / "x.png").write_bytes(png(8193, 8192, bytes(1025 * 8192)))  # all of it is there: 8 KB
    assert (here / "x.png").stat().st_size < 20_000
    refused(read, here / "x.png", "8193 x 8192 pixels, and at most 67108864 are read")


def test_the_text_of_a_picture_is_bounded(here):
    notes = b"jaxsand\0\0" + zlib.compress(b" " * 100 * 2**20, 1)
    data = png(2, 2, bytes(4))
    (here / "x.png").write_bytes(
        data[:33]
        + struct.pack(">I", len(notes))
        + b"zTXt"
        + notes
        + struct.pack(">I", zlib.crc32(b"zTXt" + notes))
        + data[33:]
    )
    refused(js.read_map, here / "x.png", "cannot be read")


def test_what_needs_another_program_to_be_read_is_no_picture(here):
    Image.new("L", (4, 4)).save(here / "x.eps")
    (here / "x.eps").rename(here / "x.png")
    refused(read_image, here / "x.png", "cannot be read as a picture")


def run_of(text):
    folder = Path("run")
    folder.mkdir()
    (folder / "config.json").write_text(text)
    (folder / "metrics.jsonl").write_text(text + "\n")
    return folder


@pytest.mark.parametrize("text", [DEEP, '{"a":' * 100_000, f'{{"a": {DEEP}'])
def test_what_is_nested_a_hundred_thousand_deep_is_refused(here, text):
    (here / "x.json").write_text(text)
    refused(drawing, here / "x.json", "nested too deep")
    refused(read_glyphs, here / "x.json", "nested too deep")
    folder = run_of(text)
    refused(learner_of, folder, "nested too deep")
    refused(curve, folder, "run: cannot read")
    np.savez(here / "x.npz", about=np.array(text))
    refused(load_policy, here / "x.npz", "policy: cannot read")
    refused(state, here / "x.npz", "run: cannot read")


@pytest.mark.parametrize("read", [drawing, read_glyphs, lambda path: learner_of(path.parent)])
def test_json_of_many_megabytes_is_not_parsed(here, read):
    (here / "config.json").write_bytes(b"[" + b"0," * (LONG // 2) + b"0]")
    refused(read, here / "config.json", "more than 16 MiB")


def test_a_key_twice_among_many_is_found_at_once(here):
    (here / "x.json").write_text("{" + ", ".join(f'"{k}": 0' for k in [*range(200_000), 199_999]) + "}")
    refused(drawing, here / "x.json", "'199999' is given twice")


@pytest.mark.parametrize("count", [1001, pytest.param(1_000_000, marks=pytest.mark.slow)])
def test_a_glyph_of_a_million_strokes_is_refused(here, count):
    (here / "x.json").write_text(json.dumps({"A": [[0, 0, 0, 1]] * count}).replace(" ", ""))
    refused(read_glyphs, here / "x.json", f"'A' has {count} strokes; give at most 1000")


def test_a_file_of_too_many_glyphs_and_a_text_that_is_too_long_are_refused(here):
    (here / "x.json").write_text(json.dumps({str(k): [[0, 0, 0, 1]] for k in range(1001)}))
    refused(read_glyphs, here / "x.json", "got 1001 of them in .*; give at most 1000")
    with pytest.raises(ValueError, match="text: got 101 signs; give at most 100"):
        text_strokes("I" * 101)


def test_a_header_of_a_hundred_thousand_lines_is_refused_at_once(here):
    (here / "x.asc").write_text("ncols 2\n" * 100_000)
    refused(js.read_map, here / "x.asc", "cannot be read as a height map: nrows is missing")


NET = {"widths": [2, 2, 2], "blocks": [0, 0, 0], "features": 2, "sights": 1}


@pytest.mark.parametrize(
    "fields",
    [
        {**NET, "blocks": [10**9] * 3},
        {**NET, "widths": [10**9] * 3},
        {**NET, "widths": [2, 2]},
        {**NET, "widths": "abc"},
        {**NET, "features": 0},
        {**NET, "features": True},
        {**NET, "sights": 1.5},
        {},
        None,
        [],
    ],
)
def test_a_policy_that_claims_a_boundless_network_is_refused(here, fields):
    np.savez(here / "x.npz", about=np.array(json.dumps({"net": fields})), w=np.zeros(3, np.float16))
    refused(load_policy, here / "x.npz", "holds no parameters of this version's network")
