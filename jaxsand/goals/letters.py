"""Reads goals and surfaces: letters, text maps, images, height maps, terrain. Host side, numpy only."""

import json
import math
import string
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from jaxsand.goals.untrusted import MOST_CELLS, read_array
from jaxsand.goals.writing import reason
from jaxsand.scene.masked import POINTS, gaps, unmasked

if TYPE_CHECKING:
    from PIL.Image import Image

Cell = tuple[int, int]

_PICTURES = ("PNG", "JPEG", "TIFF", "BMP", "GIF")  # which run no other program to be read, as EPS does
_SIGNS = 100  # of a text


def letter_strokes(letter: str) -> np.ndarray:
    """The strokes [n, 4] = x0, y0, x1, y1 of a capital letter in the unit square, x to the right, y up."""
    table = _stroke_letters()
    if letter not in table:
        raise ValueError(f"letter: got {letter!r}; give one of {string.ascii_uppercase}")
    return np.array(table[letter], float)


def stroke_list(field: str, name: object, strokes: object, low: float = -math.inf, high: float = math.inf) -> np.ndarray:
    """Checks the strokes of a glyph that a user gave, and returns them as an array [n, 4].

    Raises:
      ValueError: names the field, the glyph and the stroke, unless there is at least one stroke, all of finite numbers from
        `low` to `high`.
    """
    strokes = unmasked(field, strokes, POINTS)
    try:
        found = np.array(strokes)
    except (TypeError, ValueError, OverflowError):
        found = np.empty(0)
    if found.ndim != 2 or found.shape[1] != 4 or not len(found) or found.dtype.kind not in "iuf":
        raise ValueError(f"{field}: {name!r:.60} has no list of strokes; give numbers [[x0, y0, x1, y1], ...], y up")
    found = found.astype(float)
    for number, stroke in enumerate(found, 1):
        if not (np.isfinite(stroke) & (stroke >= low) & (stroke <= high)).all():
            numbers = "finite numbers" if math.isinf(low) else f"numbers from {low:g} to {high:g}"
            raise ValueError(f"{field}: {name!r:.60} has {stroke.tolist()} as stroke {number}; give {numbers}")
    return found


def letter_map(letter: str) -> tuple[np.ndarray, Cell]:
    """The 7 x 7 binary map of a capital letter (row 0 on top), and the cell (row, column) where its single stroke starts.

    A, S, T and R are the maps that best explain the counts published in arXiv:1908.02745.
    """
    table = _map_letters()
    if letter not in table:
        raise ValueError(f"letter: got {letter!r}; give one of {string.ascii_uppercase}")
    dig, start = table[letter]
    return dig.copy(), start


def read_text_map(text: str, name: str = "map") -> tuple[np.ndarray, Cell | None]:
    """Reads a map of `#` (dig) and `.`, one row a line, top row first; `S` marks a cell to dig in which the stroke starts.

    Empty lines are skipped, and so are comments, which start with `# `.
    """
    lines = [line.rstrip() for line in text.splitlines()]
    lines = [line for line in lines if line.strip() and not line.startswith("# ")]
    if not lines:
        raise ValueError(f"{name}: got no rows; give rows of # (dig) and .")
    for number, line in enumerate(lines, 1):
        wrong = sorted(set(line) - set("#.S"))
        if wrong:
            raise ValueError(f"{name}: got {wrong[0]!r} in row {number}; rows may hold only #, . and S")
        if len(line) != len(lines[0]):
            raise ValueError(
                f"{name}: got {len(line)} cells in row {number}, {len(lines[0])} in row 1; make rows equally long"
            )
    cells = np.array([list(line) for line in lines])
    starts = [(int(r), int(c)) for r, c in np.argwhere(cells == "S")]
    if len(starts) > 1:
        raise ValueError(f"{name}: got {len(starts)} starts; mark at most one cell with S")
    dig = cells != "."
    if not dig.any():
        raise ValueError(f"{name}: got no cell to dig; mark at least one with #")
    return dig, starts[0] if starts else None


def read_image(path: str | Path) -> np.ndarray:
    """Reads a picture as a map from 0 (white) to -1 (black), row 0 at the bottom; what is transparent counts as white.

    Grey of 16 bits keeps them; numbers in other files than PNG, such as a TIFF's floats, are no shades and refused.
    """
    from PIL import Image

    try:
        with picture(Path(path), _PICTURES) as image:
            kind = f"{image.format} of numbers (mode {image.mode})"
            numbers = image.mode.startswith(("I", "F"))
            if numbers and image.format == "PNG":
                grey = np.asarray(image, float)  # 16 bits: a height map's usual depth
                return np.flipud(np.where(grey == image.info.get("transparency"), 0, grey / 65535 - 1))
            if not numbers:
                flat = Image.new("RGBA", image.size, "white")
                flat.alpha_composite(image.convert("RGBA"))
                return np.flipud(np.asarray(flat.convert("L"), float) / 255 - 1)
    except ValueError as error:
        raise ValueError(f"{path}: cannot be read as a picture ({error}); give a PNG file") from None
    raise ValueError(
        f"{path}: got a {kind}, which have no white or black; give a PNG, or save heights in metres with numpy.save as .npy"
    )


@contextmanager
def picture(path: Path, kinds: tuple[str, ...] = ("PNG",)) -> Iterator["Image"]:
    """Opens a picture of some kinds.

    Raises:
      ValueError: says in a few words why it cannot be read: it is spoilt, of another kind, or too large.
    """
    import warnings

    from PIL import Image

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error", Image.DecompressionBombWarning)
            image = Image.open(path, formats=kinds)
        with image:
            if image.width * image.height > MOST_CELLS:
                raise ValueError(f"{image.width} x {image.height} pixels, and at most {MOST_CELLS} are read")
            yield image
    except Exception as error:  # a spoilt picture may raise anything, while it is opened or read
        raise ValueError(reason(error)) from None


def read_heights(path: str | Path, no_data: float | None = None) -> np.ndarray:
    """Reads a height map [H, W] (m) from a .npy file; its row 0 is at y = 0, where a picture's row 0 is on top.

    Cells that hold the value `no_data` become NaN.
    """
    try:
        heights = read_array(Path(path))
    except ValueError as error:
        raise ValueError(f"{path}: cannot be read as a .npy array ({error}); save one with numpy.save") from None
    if heights.ndim != 2 or not heights.size:
        raise ValueError(f"{path}: got shape {list(heights.shape)}; give one height map [H, W] with at least one cell")
    if heights.dtype.kind not in "fiu":
        raise ValueError(f"{path}: got dtype {heights.dtype}; give heights in metres as floats")
    if heights.dtype.itemsize > 8:
        raise ValueError(f"{path}: got dtype {heights.dtype}; save float32 or float64")
    heights = heights.astype(heights.dtype.newbyteorder("="))
    return heights if no_data is None else gaps(np.ma.masked_array(heights, same(heights, no_data)))


def text_strokes(text: str) -> np.ndarray:
    """The strokes [n, 4] of any text, y up, in Hershey's single-stroke Roman font.

    A single character fills the unit square; a longer text is 1 high and starts at x = 0.

    Needs the extra `letters`: pip install 'jaxsand[letters]'.
    """
    try:
        from HersheyFonts import HersheyFonts
    except ImportError:
        raise ValueError(f"text: {text!r} needs the Hershey fonts; run pip install 'jaxsand[letters]'") from None
    if len(text) > _SIGNS:
        raise ValueError(f"text: got {len(text)} signs; give at most {_SIGNS}")
    font = HersheyFonts()
    font.load_default_font("rowmans")
    lines = np.array([[a[0], -a[1], b[0], -b[1]] for a, b in font.lines_for_text(text)], float)
    if not lines.size:
        raise ValueError(f"text: got {text!r}, which has no strokes; give letters, digits or signs")
    points = lines.reshape(-1, 2, 2)
    low = points.min((0, 1))
    size = points.max((0, 1)) - low
    if len(text.strip()) > 1:
        return ((points - low) / (size[1] or 1.0)).reshape(-1, 4)
    scale = size.max() or 1.0
    return ((points - low) / scale + (1 - size / scale) / 2).reshape(-1, 4)


@cache
def _stroke_letters() -> dict[str, list[list[float]]]:
    table: dict[str, list[list[float]]] = json.loads(_data("letters.json"))
    return table


@cache
def _map_letters() -> dict[str, tuple[np.ndarray, Cell]]:
    table = {}
    for block in _data("letter_maps.txt").split("\n\n")[1:]:
        head, _, rows = block.strip().partition("\n")
        letter, row, column = head.split()
        table[letter] = (read_text_map(rows)[0], (int(row), int(column)))
    return table


def _data(name: str) -> str:
    return resources.files("jaxsand").joinpath("data", name).read_text(encoding="utf-8")


def same(heights: np.ndarray, value: float) -> np.ndarray:
    """Which heights are a value, as far as their dtype can tell."""
    if math.isnan(value):
        return np.isnan(heights)
    with np.errstate(over="ignore"):
        return heights == (heights.dtype.type(value) if heights.dtype.kind == "f" else value)
