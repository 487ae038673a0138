"""Files of every kind that the package reads, spoilt."""

import io
import json
import struct
import zipfile
import zlib
from collections.abc import Callable
from functools import cache
from pathlib import Path

import numpy as np

import jaxsand as js

from .spoil import Rng, array, as_json, pick, spoilt, spoilt_bytes, spoilt_words

Reader = Callable[[Path], object]
Maker = Callable[[Rng], bytes]

SCENE = js.make_scene((12, 12), 0.02)
PIT = {"kind": "rectangle", "centre": [0.12, 0.12], "size": [0.12, 0.08], "height": -0.004}
DRAWING = {
    "shapes": [
        PIT,
        {
            "kind": "polygon",
            "points": [[0, 0], [0.1, 0], [0.1, 0.2]],
            "holes": [[[0.01, 0], [0.02, 0], [0, 0.1]]],
            "free": True,
        },
        {"kind": "disc", "centre": [0.1, 0.1], "radius": 0.05, "inner": 0.01, "height": 0.01, "above": 2.0},
        {"kind": "path", "points": [[0.01, 0.02], [0.2, 0.1]], "width": 0.04, "height": -0.01},
        {"kind": "text", "text": "S", "corner": [0.05, 0.05], "size": 0.1, "width": 0.03, "height": -0.01},
        {"kind": "ramp", "points": [[0.05, 0.05], [0.2, 0.1]], "width": 0.05, "from": 0.0, "to": -0.01},
    ],
    "outside": {"height": 0, "above": 0.5},
    "repose": False,
    "grid": {"shape": [12, 12], "spacing": 0.02},
}
GLYPHS = {"L": [[0.2, 0.9, 0.2, 0.1], [0.2, 0.1, 0.8, 0.1]], "I": [[0.5, 0, 0.5, 1]]}
CONFIG: dict[str, object] = {
    "name": "hindsight",
    "seed": 3,
    "versions": {"jax": "1"},
}
METRICS = [
    {"kind": "train", "chunk": 1, "seconds": 0.5, "steps": 64},
    {"kind": "validate", "chunk": 1, "seconds": 1.0, "score": 0.5},
]
ASC = "ncols 3\nnrows 2\nxllcorner 0\nyllcenter 0.5\ncellsize 0.5\nNODATA_value -1\n0.25 -1 0\n1 2 3\n"
MAP = "# a map\n#..\n#S.\n###\n"


def npy(rng: Rng, some: np.ndarray) -> bytes:
    """An array as `numpy.save` writes it."""
    file = io.BytesIO()
    np.save(file, some)
    return file.getvalue()


def npz(rng: Rng, members: dict[str, bytes]) -> bytes:
    """A zip of members, packed in one of several ways."""
    file = io.BytesIO()
    way = pick(rng, (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED, zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA))
    with zipfile.ZipFile(file, "w", way) as packed:
        for name, data in members.items():
            packed.writestr(name, data)
    return file.getvalue()


def archive(rng: Rng, good: dict[str, np.ndarray]) -> bytes:
    """An .npz of which some members were replaced, spoilt, left out or renamed, and perhaps the file too."""
    members = {f"{name}.npy": npy(rng, some) for name, some in good.items()}
    for _ in range(rng.integers(0, 3)):
        name = pick(rng, sorted(members))
        kind = int(rng.integers(5))
        if kind < 2:
            members[name] = npy(rng, array(rng))
        elif kind == 2:
            members[name] = spoilt_bytes(rng, members[name])
        elif kind == 3 and len(members) > 1:
            del members[name]
        else:
            members[pick(rng, ("../../x.npy", "/etc/x.npy", "x", "elevation", "a.npy"))] = members[name]
    packed = npz(rng, members)
    return spoilt_bytes(rng, packed) if rng.random() < 0.4 else packed


def text_array(rng: Rng, thing: object) -> np.ndarray:
    """JSON, sometimes spoilt, as an array of one text."""
    return np.array((as_json(rng, thing) if rng.random() < 0.5 else json.dumps(thing).encode()).decode(errors="replace"))


def picture(rng: Rng) -> bytes:
    """A PNG of some mode, and perhaps with spoilt notes of its heights."""
    from PIL import Image
    from PIL.PngImagePlugin import PngInfo

    mode = pick(rng, ("L", "RGB", "RGBA", "1", "P", "I;16", "LA"))
    image = Image.new(mode, (int(rng.integers(1, 9)), int(rng.integers(1, 9))), pick(rng, (0, 1)))
    notes = PngInfo()
    told = {"spacing": 0.01, "lowest": 0.0, "step": 1e-5, "x": 0.0, "y": 0.0}
    notes.add_text("jaxsand", json.dumps(spoilt(rng, told) if rng.random() < 0.7 else told), zip=bool(rng.integers(2)))
    file = io.BytesIO()
    image.save(file, "PNG", pnginfo=notes)
    data = file.getvalue()
    return chunks(rng, data) if rng.random() < 0.3 else spoilt_bytes(rng, data) if rng.random() < 0.4 else data


def chunks(rng: Rng, png: bytes) -> bytes:
    """A PNG with one chunk spoilt, and its checksum right again."""
    parts, at = [], 8
    while at < len(png):
        (long,) = struct.unpack(">I", png[at : at + 4])
        parts.append([png[at + 4 : at + 8], png[at + 8 : at + 8 + long]])
        at += 12 + long
    part = pick(rng, parts)
    part[1] = spoilt_bytes(rng, part[1])
    if part[0] == b"IHDR" and len(part[1]) >= 8 and rng.random() < 0.5:
        part[1] = struct.pack(">II", *(int(n) for n in rng.integers(0, 2**31, 2))) + part[1][8:]
    packed = (struct.pack(">I", len(b)) + a + b + struct.pack(">I", zlib.crc32(a + b)) for a, b in parts)
    return png[:8] + b"".join(packed)


def elevations(rng: Rng) -> bytes:
    """An .npz of a height map."""
    some = {"elevation": np.zeros((3, 4)), "resolution": np.array(0.1), "length": np.zeros(2), "position": np.zeros(2)}
    return archive(rng, some)


def state(rng: Rng) -> bytes:
    """A checkpoint of a small run."""
    at = text_array(rng, {"chunk": 3, "seconds": 1.0, "score": 0.5, "rows": 0})
    return archive(rng, {"about": at, "state/x": np.zeros(3), "state/n": np.int64(1)})


@cache
def policy_members() -> dict[str, np.ndarray]:
    """The arrays of a tiny network that `load_policy` takes."""
    import tempfile

    import jax

    from jaxsand.planning.learned.network import StrokeNet
    from jaxsand.planning.learned.policy import SIDE, Policy, save_policy

    net = StrokeNet((2, 2, 2), (0, 0, 0), 2, 1)
    maps = np.zeros((1, SIDE, SIDE), np.float32)
    params = jax.jit(net.init)(jax.random.key(0), maps, maps, np.zeros((1, 1, 4), np.float32))
    with tempfile.TemporaryDirectory() as folder:
        save_policy(Policy(net, params), Path(folder) / "p.npz")
        with np.load(Path(folder) / "p.npz") as data:
            return dict(data)


def policy(rng: Rng) -> bytes:
    """A policy, of which something is spoilt."""
    members = policy_members()
    about = text_array(rng, json.loads(str(members["about"]))) if rng.random() < 0.7 else members["about"]
    return archive(rng, members | {"about": about})


def rows(rng: Rng) -> bytes:
    """The metrics of a run, or the rows of a bench."""
    lines = [json.dumps(row).encode() if rng.random() < 0.5 else as_json(rng, row) for row in METRICS * 2]
    return b"\n".join(lines) + b"\n"


def scans(rng: Rng) -> bytes:
    """A CSV of scans."""
    lines = [f"45,10,1,{x},{0.1 * x}" for x in range(20)]
    return spoilt_words(rng, "beta_deg,sinkage_mm,scan,x_mm,z_mm\n" + "\n".join(lines).replace(",", pick(rng, ",; ")))


def config(rng: Rng) -> bytes:
    """The configuration of a run."""
    from train.imitation.hindsight import Hindsight
    from train.replay.her import Future
    from train.runs.checkpoints import described

    own = described(Hindsight() if rng.random() < 0.7 else Future(3))
    good = CONFIG | {"learner": own}
    return as_json(rng, good) if rng.random() < 0.3 else as_json(rng, good | {"learner": spoilt(rng, own)})


def drawn(path: Path) -> object:
    """The goal that a drawing is, on the scene and on its own grid."""
    from jaxsand.goals.drawing import as_drawing

    as_drawing(path)
    return js.read_drawing(path, SCENE)


def of_a_run(read: Callable[[Path], object], name: str) -> Reader:
    """A reader of a run's folder that holds the file alone."""

    def run(path: Path) -> object:
        folder = path.with_suffix(".run")
        folder.mkdir(exist_ok=True)
        path.replace(folder / name)
        return read(folder)

    return run


def loaded_state(path: Path) -> object:
    """A checkpoint as that of a small learner."""
    from train.runs import checkpoints

    checkpoints.where(path)
    return checkpoints.load(path, {"x": np.zeros(3), "n": np.int64(0)})


def learner(folder: Path) -> object:
    """The learner and the seed of a run."""
    from train.runs import runs

    runs.seed_of(folder)
    return runs.learner_of(folder)


def curve(folder: Path) -> object:
    """The learning curve of a run."""
    from train.curves import curve as read

    return read(folder)


def glyphs(path: Path) -> object:
    """The strokes of each glyph in a file."""
    from train.evaluation.glyphs import read_strokes

    return read_strokes(path)


def text_map(path: Path) -> object:
    """A map of # and ., as a command reads it."""
    from jaxsand.cli.files import read_text
    from jaxsand.goals.letters import read_text_map

    return read_text_map(read_text(path), path.name)


def image(path: Path) -> object:
    """A picture as a goal."""
    from jaxsand.goals.letters import read_image

    return read_image(path)


def heights(path: Path) -> object:
    """A .npy map, with a value for no data."""
    from jaxsand.goals.letters import read_heights

    return read_heights(path, -9999)


def measured(path: Path) -> object:
    """The scans of a CSV file."""
    from jaxsand.terramechanics.scans import read_scans

    return read_scans(path, -9999)


def one_policy(path: Path) -> object:
    """A policy and the notes about it."""
    from jaxsand.planning.learned.policy import about_policy, load_policy

    load_policy(path)
    return about_policy(path)


def kept(path: Path) -> object:
    """The rows of a bench, to go on from."""
    from jaxsand.bench.kept import known_rows

    return known_rows(path, {"kind", "chunk"})


FILES: dict[str, tuple[str, Maker, Reader]] = {
    "asc": (".asc", lambda rng: spoilt_words(rng, ASC), js.read_map),
    "npz": (".npz", elevations, js.read_map),
    "npy": (".npy", lambda rng: spoilt_bytes(rng, npy(rng, array(rng))), lambda path: js.read_map(path, spacing=0.1)),
    "npy-array": (".npy", lambda rng: npy(rng, array(rng)), lambda path: js.read_map(path, spacing=0.1)),
    "png": (".png", picture, js.read_map),
    "drawing": (".json", lambda rng: as_json(rng, DRAWING), drawn),
    "shape": (".json", lambda rng: as_json(rng, DRAWING | {"shapes": [pick(rng, DRAWING["shapes"])]}), drawn),
    "glyphs": (".json", lambda rng: as_json(rng, GLYPHS), glyphs),
    "text-map": (".txt", lambda rng: spoilt_words(rng, MAP), text_map),
    "picture": (".png", picture, image),
    "heights": (".npy", lambda rng: spoilt_bytes(rng, npy(rng, array(rng))), heights),
    "scans": (".csv", scans, measured),
    "checkpoint": (".npz", state, loaded_state),
    "config": (".json", config, of_a_run(learner, "config.json")),
    "metrics": (".jsonl", rows, of_a_run(curve, "metrics.jsonl")),
    "kept": (".jsonl", rows, kept),
    "policy": (".npz", policy, one_policy),
}
"""By name: the suffix of the file, what makes one, and what reads it."""
