"""Height maps to and from the files of other tools.

In memory row 0 of a map is at y = 0, and NaN says that nothing is known. Each format has its own order of rows and its own
sign for cells without data; `read_map` and `write_map` say which.
"""

import json
import math
import os
import reprlib
import struct
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from jaxsand.goals.letters import picture
from jaxsand.goals.untrusted import read_array, read_arrays
from jaxsand.goals.writing import reason, written
from jaxsand.scene.masked import gaps
from jaxsand.scene.validation import finite, positive, short

_NO_DATA = -9999.0  # in .asc files that are written
_LAYER = "elevation"
_CHUNK = "jaxsand"  # the text of a PNG that holds spacing, lowest height and step
_TOLD = ("spacing", "lowest", "step", "x", "y")  # what it holds
_FAR = 1e12  # m: what a map, its spacing and its corner stay within, so that formats of float32 hold them
_MOST = 2**28  # cells of a map that is read
_HEAD = 20  # lines of an .asc file's header
_AGAIN = "write it anew with write_map, or check that its suffix says what it is"


@dataclass(frozen=True)
class HeightMap:
    """A map and where it lies.

    Attributes:
      height: [H, W] (m), row 0 at the lowest y, NaN where nothing is known.
      spacing: of the grid (m).
      corner: x and y (m) of the corner of cell [0, 0].

    Example:
      >>> import numpy as np
      >>> import jaxsand as js
      >>> js.HeightMap(np.zeros((4, 6)), 0.01).height.shape
      (4, 6)
    """

    height: np.ndarray
    spacing: float
    corner: tuple[float, float] = (0.0, 0.0)

    def __post_init__(self) -> None:
        try:
            height = np.asarray(gaps(self.height))
        except (TypeError, ValueError) as error:
            raise ValueError(f"height: got no array ({reason(error)}); give a map [H, W] in metres") from None
        if height.ndim != 2 or not height.size or height.dtype.kind not in "fiu":
            raise ValueError(f"height: got {height.dtype} of shape {list(height.shape)}; give a map [H, W] in metres")
        if np.isinf(height).any():
            raise ValueError("height: got cells that are infinite; give NaN where nothing is known")
        if float(np.abs(height).max(initial=0, where=~np.isnan(height))) > _FAR:
            raise ValueError(f"height: got cells more than {_FAR:g} m from 0; give metres, and NaN where nothing is known")
        positive("spacing", self.spacing, "give metres")
        try:
            x, y = self.corner
        except (TypeError, ValueError):
            raise ValueError(f"corner: got {short(self.corner)}; give x and y in metres") from None
        for number in (x, y):
            finite("corner", number, "give x and y in metres")
        spacing, corner = float(self.spacing), (float(x), float(y))
        if max(spacing, *map(abs, corner)) > _FAR:
            raise ValueError(f"spacing: got {spacing:g} with corner {corner}; give metres, at most {_FAR:g}")
        object.__setattr__(self, "spacing", spacing)
        object.__setattr__(self, "corner", corner)
        object.__setattr__(self, "height", height if height.dtype.kind == "f" else height.astype(np.float64))


def read_map(path: str | Path, *, spacing: float | None = None) -> HeightMap:
    """Reads a height map.

    | suffix | rows in the file | without data | spacing |
    |---|---|---|---|
    | `.asc` (ESRI ASCII grid) | the highest y first | its NODATA_value, else -9999 | its own, in metres |
    | `.npz` (layer `elevation`) | the lowest y first | NaN | its own, `resolution` |
    | `.npy` | the lowest y first | NaN | must be given |
    | `.png` (16 bits, as `write_map` writes it) | the highest y first | 0 | its own |

    Args:
      path: the file.
      spacing: of the grid (m); for a `.npy` alone.

    Returns:
      The `HeightMap`: float64 from text and pictures, else as it was saved.

    Raises:
      ValueError: for a file that cannot be read so, holds pickles, or would unpack to more than 2^26 cells and its own size;
        for a spacing that is missing or has no effect.

    Example:
      >>> import tempfile
      >>> from pathlib import Path
      >>> import jaxsand as js
      >>> path = Path(tempfile.mkdtemp()) / "land.asc"
      >>> _ = path.write_text("ncols 2\\nnrows 1\\nxllcorner 0\\nyllcorner 0\\ncellsize 0.5\\n0.25 -9999\\n")
      >>> js.read_map(path).height
      array([[0.25,  nan]])
    """
    path = _path(path)
    readers: dict[str, Callable[[Path], HeightMap]] = {".asc": _read_asc, ".npz": _read_npz, ".png": _read_png}
    suffix = path.suffix.lower()
    if suffix != ".npy" and suffix not in readers:
        raise ValueError(f"{path}: {suffix or 'no suffix'} is not read; give a .asc, .npy, .npz or .png file")
    if (suffix == ".npy") != (spacing is not None):
        raise ValueError(f"spacing: {'is missing' if spacing is None else f'{suffix} files have their own'}; see read_map")
    try:
        if not path.exists():
            raise FileNotFoundError
        if suffix == ".npy" and spacing is not None:
            return HeightMap(read_array(path), spacing)
        return readers[suffix](path)
    except FileNotFoundError:
        raise ValueError(f"{path}: no such file; check the name") from None
    except (OSError, ValueError, KeyError) as error:
        said = f"{error.args[0]} is missing" if isinstance(error, KeyError) else reason(error)
        raise ValueError(f"{path}: cannot be read as a height map: {said}; {_AGAIN}") from None


def write_map(path: str | Path, height: HeightMap | np.ndarray, *, spacing: float | None = None) -> None:
    """Writes a height map, or a mesh of it.

    | suffix | for | what is kept |
    |---|---|---|
    | `.asc` | GIS (ESRI ASCII grid, -9999 without data, highest y first) | all digits |
    | `.npz` | numpy; layer and fields are named as in ROS grid_map | all |
    | `.npy` | numpy | the heights alone |
    | `.png` | pictures of 16 bits, 0 without data; spacing, lowest height and step in its text | 1/65,534 of the range |
    | `.ply` | meshes: a vertex at each cell's centre; cells without data are left out | float32 |
    | `.stl` | 3-D printing: a closed body, with a base a tenth of its longer side below the lowest sand; no gaps | float32 |
    | `.hfield` | MuJoCo's binary height field (`hfield_size` gives its size); no gaps | float32 |

    Args:
      path: the file; its suffix says the format.
      height: a map [H, W] (m), row 0 at the lowest y, NaN where nothing is known, or a `HeightMap`.
      spacing: of the grid (m); for a map that is no `HeightMap`.

    Raises:
      ValueError: for another suffix, gaps where a format has none, a file that cannot be written (what was there stays),
        and as of `HeightMap`.

    Example:
      >>> import tempfile
      >>> from pathlib import Path
      >>> import numpy as np
      >>> import jaxsand as js
      >>> path = Path(tempfile.mkdtemp()) / "sand.asc"
      >>> js.write_map(path, np.array([[0.0, 0.1]]), spacing=0.01)
      >>> path.read_text().splitlines()[-1]
      '0.0 0.1'
    """
    path = _path(path)
    one = _as_map(height, spacing)
    writers: dict[str, Callable[[HeightMap], bytes]] = {
        ".asc": _asc,
        ".npz": _npz,
        ".npy": _npy,
        ".png": _png,
        ".ply": _ply,
        ".stl": _stl,
        ".hfield": _hfield,
    }
    suffix = path.suffix.lower()
    if suffix not in writers:
        raise ValueError(f"{path}: {suffix or 'no suffix'} is not written; give one of {', '.join(writers)}")
    if suffix in (".stl", ".hfield") and np.isnan(one.height).any():
        raise ValueError(f"height: got cells without data, which {suffix} files cannot have; fill them, or write a .ply")
    data = writers[suffix](one)
    with written(path, "path") as beside:
        beside.write_bytes(data)


def hfield_size(height: HeightMap | np.ndarray, *, spacing: float | None = None) -> tuple[float, float, float, float]:
    """The `size` of MuJoCo's `<hfield>` for a map that `write_map` wrote as `.hfield`.

    MuJoCo scales heights to 0 to 1 and places them by half the extent in x and y between the outermost centres, by the range
    of heights, and by a base below the lowest. The geom's z is the lowest height.

    Args:
      height: as of `write_map`.
      spacing: as of `write_map`.

    Returns:
      radius_x, radius_y, elevation_z, base_z (m).

    Raises:
      ValueError: as of `write_map`.

    Example:
      >>> import numpy as np
      >>> import jaxsand as js
      >>> [round(v, 6) for v in js.hfield_size(np.array([[0.0, 0.1], [0.0, 0.3]]), spacing=0.02)]
      [0.01, 0.01, 0.3, 0.002]
    """
    one = _as_map(height, spacing)
    rows, columns = one.height.shape
    high = float(np.ptp(one.height)) or 1e-6  # a level map has no range to scale
    return (columns - 1) * one.spacing / 2, (rows - 1) * one.spacing / 2, high, _base(one)


def _path(path: str | Path) -> Path:
    if not isinstance(path, str | os.PathLike):
        raise ValueError(f"path: got {short(path)}; give the name of a file")
    return Path(path)


def _as_map(height: HeightMap | np.ndarray, spacing: float | None) -> HeightMap:
    if isinstance(height, HeightMap):
        if spacing is not None:
            raise ValueError("spacing: a HeightMap has its own; leave it out")
        return height
    if spacing is None:
        raise ValueError("spacing: is missing; give the grid's, in metres")
    return HeightMap(height, spacing)


def _base(one: HeightMap) -> float:
    """How far below the lowest sand a body goes on (m)."""
    return 0.1 * one.spacing * max(one.height.shape) / 2


def _read_asc(path: Path) -> HeightMap:
    lines = path.read_text(encoding="ascii").splitlines()
    head: dict[str, float] = {}
    for line in lines[:_HEAD]:
        words = line.split()
        if not words or not words[0][0].isalpha() or words[0].lower() in ("nan", "inf"):
            break
        head[words[0].lower()] = float(words[1]) if len(words) == 2 else math.nan
    lines = lines[len(head) :]
    shape, spacing = (_cells(head, "nrows"), _cells(head, "ncols")), head["cellsize"]
    if min(shape) < 1 or shape[0] * shape[1] > _MOST:
        raise ValueError(f"it has {shape[0]} rows and {shape[1]} columns")
    values = np.array(" ".join(lines).split(), float)
    if values.size != shape[0] * shape[1]:
        raise ValueError(f"it holds {values.size} heights for {shape[0]} rows and {shape[1]} columns")
    values = np.where(values == head.get("nodata_value", _NO_DATA), np.nan, values).reshape(shape)
    corner = [
        head[f"{axis}llcenter"] - spacing / 2 if f"{axis}llcenter" in head else head[f"{axis}llcorner"] for axis in "xy"
    ]
    return HeightMap(values[::-1].copy(), spacing, (corner[0], corner[1]))


def _cells(head: dict[str, float], name: str) -> int:
    """The number of rows or columns in a header."""
    if not (0 <= head[name] <= _MOST and head[name] % 1 == 0):
        raise ValueError(f"{name} is {head[name]:g}")
    return int(head[name])


def _asc(one: HeightMap) -> bytes:
    rows, columns = one.height.shape
    if (one.height == _NO_DATA).any():
        raise ValueError(f"height: got {_NO_DATA:g}, which stands for no data in .asc files")
    head = {"ncols": columns, "nrows": rows, "xllcorner": one.corner[0], "yllcorner": one.corner[1], "cellsize": one.spacing}
    lines = [f"{name} {value}" for name, value in head.items()] + [f"NODATA_value {_NO_DATA:g}"]
    lines += [" ".join(f"{_NO_DATA:g}" if np.isnan(v) else str(v) for v in row) for row in one.height[::-1]]
    return ("\n".join(lines) + "\n").encode("ascii")


def _read_npz(path: Path) -> HeightMap:
    data = read_arrays(path, (_LAYER, "resolution", "position"))
    height, spacing = data[_LAYER], float(_numbers(data, "resolution", 1)[0])
    x, y = _numbers(data, "position", 2) if "position" in data else np.zeros(2)
    if height.ndim != 2:
        raise ValueError(f"{_LAYER} has shape {list(height.shape)}")
    rows, columns = height.shape
    return HeightMap(height, spacing, (float(x) - spacing * columns / 2, float(y) - spacing * rows / 2))


def _numbers(data: dict[str, np.ndarray], name: str, count: int) -> np.ndarray:
    """So many numbers of a file that has to hold just them."""
    if data[name].size != count or data[name].dtype.kind not in "iuf":
        raise ValueError(f"{name} is no {'number' if count == 1 else f'list of {count} numbers'}")
    return data[name].ravel().astype(float)


def _npz(one: HeightMap) -> bytes:
    lengths = one.spacing * np.array(one.height.shape[::-1])
    return _saved(
        np.savez,
        **{_LAYER: one.height, "resolution": one.spacing, "length": lengths, "position": np.array(one.corner) + lengths / 2},
    )


def _npy(one: HeightMap) -> bytes:
    return _saved(np.save, arr=one.height)


def _saved(save: Callable[..., Any], **arrays: Any) -> bytes:
    from io import BytesIO

    file = BytesIO()
    save(file, **arrays)
    return file.getvalue()


def _read_png(path: Path) -> HeightMap:
    with picture(path) as image:
        told = json.loads(getattr(image, "text", {}).get(_CHUNK, "null"))
        numbers = np.asarray(image, np.int64)[::-1]
    if told is None:
        raise KeyError(_CHUNK)
    for name in _TOLD:
        value = told.get(name) if isinstance(told, dict) else None
        if not isinstance(value, int | float) or not abs(value) <= _FAR:
            raise ValueError(f"its text {_CHUNK} has {reprlib.repr(value)} as {name}")
    spacing, lowest, step, x, y = (float(told[name]) for name in _TOLD)
    return HeightMap(np.where(numbers == 0, np.nan, lowest + (numbers - 1) * step), spacing, (x, y))


def _png(one: HeightMap) -> bytes:
    from io import BytesIO

    from PIL import Image
    from PIL.PngImagePlugin import PngInfo

    height, known = one.height.astype(float), np.isfinite(one.height)
    lowest, highest = (float(f(height[known])) for f in (np.min, np.max)) if known.any() else (0.0, 0.0)
    step = (highest - lowest) / 65534
    numbers = np.where(known, np.round((np.where(known, height, lowest) - lowest) / (step or 1.0)) + 1, 0).astype(np.uint16)
    text = PngInfo()
    told = {"spacing": one.spacing, "lowest": lowest, "step": step, "x": one.corner[0], "y": one.corner[1]}
    text.add_text(_CHUNK, json.dumps(told))
    file = BytesIO()
    Image.fromarray(np.ascontiguousarray(numbers[::-1])).save(file, "PNG", pnginfo=text)
    return file.getvalue()


def _vertices(one: HeightMap) -> np.ndarray:
    """x, y, z (m) at the centre of each cell, row by row [H W, 3]."""
    i, j = np.indices(one.height.shape)
    x, y = one.corner[0] + (j + 0.5) * one.spacing, one.corner[1] + (i + 0.5) * one.spacing
    return np.stack([x, y, one.height.astype(float)], axis=-1).reshape(-1, 3)


def _triangles(shape: tuple[int, ...]) -> np.ndarray:
    """Two triangles [.., 3] for each four neighbouring cells, seen from above anticlockwise."""
    cells = np.arange(shape[0] * shape[1]).reshape(shape)
    a, b, c, d = cells[:-1, :-1].ravel(), cells[:-1, 1:].ravel(), cells[1:, 1:].ravel(), cells[1:, :-1].ravel()
    return np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])


def _ply(one: HeightMap) -> bytes:
    points, faces = _vertices(one), _triangles(one.height.shape)
    known = np.isfinite(points[:, 2])
    faces, number = faces[known[faces].all(axis=1)], np.cumsum(known) - 1
    head = (
        f"ply\nformat binary_little_endian 1.0\ncomment metres\nelement vertex {int(known.sum())}\n"
        "property float x\nproperty float y\nproperty float z\n"
        f"element face {len(faces)}\nproperty list uchar int vertex_indices\nend_header\n"
    )
    corners = np.empty(len(faces), [("count", "u1"), ("corners", "<i4", 3)])
    corners["count"], corners["corners"] = 3, number[faces]
    return head.encode("ascii") + points[known].astype("<f4").tobytes() + corners.tobytes()


def _stl(one: HeightMap) -> bytes:
    rows, columns = one.height.shape
    if min(rows, columns) < 2:
        raise ValueError(f"height: got {rows} x {columns} cells, which make no body; give 2 x 2 or more")
    top, faces = _vertices(one), _triangles(one.height.shape)
    bottom = np.concatenate([top[:, :2], np.full((len(top), 1), top[:, 2].min() - 2 * _base(one))], axis=1)
    cells = np.arange(len(top)).reshape(rows, columns)
    rim = np.concatenate([cells[0, :-1], cells[:-1, -1], cells[-1, :0:-1], cells[:0:-1, 0]])  # anticlockwise
    after, below = np.roll(rim, -1), len(top)
    sides = [np.stack([rim, rim + below, after + below], 1), np.stack([rim, after + below, after], 1)]
    corners = np.concatenate([top, bottom])[np.concatenate([faces, faces[:, ::-1] + below, *sides])]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    body = np.zeros(len(corners), [("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("spare", "<u2")])
    body["normal"], body["corners"] = normals, corners
    return b"height map, metres".ljust(80) + struct.pack("<I", len(body)) + body.tobytes()


def _hfield(one: HeightMap) -> bytes:
    return struct.pack("<ii", *one.height.shape) + one.height.astype("<f4").tobytes()
