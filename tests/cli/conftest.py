"""The folder of files, good and bad, in which the commands are tried."""

import json

import numpy as np
import pytest
from PIL import Image

L_MAP = "#..\n#..\n###\n"
PIT = {"kind": "rectangle", "centre": [0.12, 0.12], "size": [0.12, 0.08], "height": -0.004}
SHEET = {"shape": [12, 12], "spacing": 0.02}
DRAWINGS = {
    "pit": {"shapes": [PIT], "grid": SHEET, "outside": "heaps"},
    "pad": {"shapes": [PIT], "grid": SHEET, "outside": "free"},
    "strict": {"shapes": [PIT], "grid": SHEET, "outside": {"above": 5}},
    "plain": {"shapes": [PIT], "grid": SHEET},
    "gridless": {"shapes": [PIT]},
    "corners": {"shapes": [PIT, {"kind": "polygon", "points": [[0, 0], [0.1, 0.1]], "height": 0}], "grid": SHEET},
    "huge": {"shapes": [PIT], "grid": {"shape": [100000, 100000], "spacing": 0.01}},
    "infinite": {"shapes": [{**PIT, "height": float("nan")}], "grid": SHEET},
}


@pytest.fixture
def here(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path.parent / "cache"))
    (tmp_path / "l.txt").write_text(L_MAP)
    (tmp_path / "empty.txt").write_text("")
    (tmp_path / "level.txt").write_text("...\n...\n")
    (tmp_path / "apart.txt").write_text("#.#\n")
    (tmp_path / "ragged.txt").write_text("##\n#\n")
    (tmp_path / "odd.txt").write_text("#x\n")
    (tmp_path / "twostarts.txt").write_text("SS\n")
    (tmp_path / "binary.txt").write_bytes(bytes(range(128, 256)))
    (tmp_path / "broken.png").write_bytes(b"\x89PNG\r\n\x1a\nrubbish")
    (tmp_path / "broken.npy").write_bytes(b"rubbish")
    (tmp_path / "a-file").write_text("")
    (tmp_path / "land.xyz").write_text("0 0 0")
    (tmp_path / "broken.json").write_text("{'shapes': ")
    for name, drawing in DRAWINGS.items():
        (tmp_path / f"{name}.json").write_text(json.dumps(drawing))
    np.save(tmp_path / "cube.npy", np.zeros((2, 2, 2)))
    np.save(tmp_path / "flat.npy", np.zeros((12, 12), np.float32))
    np.save(tmp_path / "dip.npy", np.full((12, 12), -0.01))
    np.save(tmp_path / "holes.npy", np.where(np.arange(12) == 8, -9999, np.zeros((12, 12), int)))
    np.save(tmp_path / "nan.npy", np.full((12, 12), np.nan))
    np.save(tmp_path / "small.npy", np.full((3, 3), -0.01))
    np.save(tmp_path / "raw.npy", np.where(np.arange(144).reshape(12, 12) == 7, -9999, -0.01))
    np.save(tmp_path / "words.npy", np.array([["a"]]))
    np.save(tmp_path / "pile.npy", np.eye(12, dtype=np.float32) * 0.05)
    Image.new("L", (30, 20), 255).save(tmp_path / "white.png")
    return tmp_path
