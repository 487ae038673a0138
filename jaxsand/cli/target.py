"""What `jaxsand shape` is asked to make: the goal, with the scene that it is made in, and the sand to start from."""

import argparse
import math
from pathlib import Path
from typing import TYPE_CHECKING

from jaxsand.cli.files import existing, plausible, read_text
from jaxsand.cli.printing import read_cell

if TYPE_CHECKING:
    import numpy as np

    from jaxsand.goals.goal import Goal
    from jaxsand.planning.targets import Layout, Target

RESOLUTION = 6
"""Grid cells to a block's side, unless told otherwise."""

_ROWS = "heights in metres, first row at y = 0; with --first-row top, on top as in pictures and maps"
_OTHER_FILES = (".asc", ".bmp", ".csv", ".dem", ".gif", ".hgt", ".jpeg", ".jpg", ".npz", ".svg", ".tif", ".tiff")
_SPACING = 0.01  # m, unless told otherwise
_FAR = 1e4  # m: as large as a cell may be
_DARK = 0.5  # of black: what a picture's free cells are darker than
_DEEP = 7.5  # mm: as deep as a blade goes unless told otherwise, into a goal that has heights


def read_target(options: argparse.Namespace) -> "Target":
    """The goal of `jaxsand shape`, in its scene; with strokes only where they need no search."""
    from jaxsand.goals import letters
    from jaxsand.planning import pipeline, targets

    name, method = options.goal, options.method
    path = Path(name)
    suffix = path.suffix.lower()
    is_file = suffix in (".txt", ".png", ".npy", ".json")
    if not name.strip():
        raise ValueError("goal: got an empty name; give a letter, a .txt, .png, .npy or .json file, or terrain")
    if suffix and not is_file and (suffix in _OTHER_FILES or path.is_file()):
        raise ValueError(f"goal: got {name!r}, and {suffix} is not read; give a .txt, .png, .npy or .json file ({_ROWS})")
    if method == "strokes" and (is_file or name == "terrain"):
        raise ValueError(f"method: 'strokes' pushes a glyph's own strokes, {name} has none; use --method plan")
    if method != "plan" and not (is_file or name == "terrain"):
        for option in ("start", "depth_mm", "spacing", "resolution", "cells"):
            if getattr(options, option) is not None:
                raise ValueError(f"{option.replace('_', '-')}: has no effect on a glyph's own strokes; leave it out")
        letter = name.upper() if len(name) == 1 and name.isascii() and name.isalpha() else ""
        return pipeline.glyph_target(letters.letter_strokes(letter) if letter else letters.text_strokes(name), name)
    if (is_file and suffix != ".txt") or name == "terrain":
        return _surface_target(options)
    if method != "plan":
        raise _drawn(options)
    start = read_cell(options.start)
    if is_file:
        dig, own = letters.read_text_map(read_text(path), str(path))
    elif len(name) == 1:
        dig, own = letters.letter_map(name.upper() if name.isascii() else name)
    else:
        raise ValueError(
            f"goal: got {name!r}; give a letter A to Z, a .txt, .png, .npy or .json file, or terrain, "
            "or push any text by its own strokes with --method strokes"
        )
    return targets.map_target(dig, start if options.start else own, path.stem if is_file else name.upper(), _layout(options))


def _surface_target(options: argparse.Namespace) -> "Target":
    """The goal that a picture, heights, a drawing or the terrain is; with strokes only where the method is to plan them."""
    from jaxsand.goals import letters, surfaces
    from jaxsand.goals.goal import Goal
    from jaxsand.planning import targets

    name, path, planned = options.goal, Path(options.goal), options.method == "plan"
    if options.start:
        raise ValueError(f"start: {name} is no map of # and .; leave --start out")
    if path.suffix.lower() == ".png":
        if options.method in ("optimise", "policy"):
            raise _drawn(options)
        layout = _layout(options)
        heights = targets.image_goal(letters.read_image(existing(path)), layout, _cells(options))
        if planned:
            return targets.height_target(heights, "image", path.stem, layout)
        return targets.height_goal(Goal(heights, above=(heights < 0) * 1.0), "image", path.stem, layout)
    if path.suffix.lower() == ".json":
        return _drawing_target(path, options)
    if name == "terrain":
        layout = _layout(options, _DEEP)
        heights = surfaces.terrain_surface((_cells(options), _cells(options)), 4 * layout.depth)
        heights -= 0 if planned else heights.mean()  # what is dug is heaped
    else:
        heights = _goal_heights(path, options)
        layout = _layout(options, _DEEP if planned else _deep_enough(heights, options.method))
    make = targets.height_target if planned else targets.height_goal
    return make(heights, "terrain" if name == "terrain" else "heights", path.stem, layout)


def _drawing_target(path: Path, options: argparse.Namespace) -> "Target":
    """The goal that a drawing is, on the grid that it gives; with strokes only where the method is to plan them."""
    from dataclasses import replace

    import numpy as np

    from jaxsand.goals.drawing import SHEET, as_drawing
    from jaxsand.planning import targets
    from jaxsand.scene.scene import make_scene

    drawing = as_drawing(existing(path))
    if drawing.grid is None:
        raise ValueError(f"grid: is missing in {path}; give {SHEET.what}")
    if options.spacing is not None:
        raise ValueError(f"spacing: {path} gives its own; leave --spacing out")
    goal = drawing.on(make_scene(drawing.grid.shape, drawing.grid.spacing))
    planned = options.method == "plan"
    depth = _DEEP if planned else _deep_enough(np.asarray(goal.height), options.method)
    layout = replace(_layout(options, depth), spacing=drawing.grid.spacing)
    if planned:
        return targets.height_target(_planned(goal), "drawing", path.stem, layout)
    return targets.height_goal(goal, "drawing", path.stem, layout)


def _planned(goal: "Goal") -> "np.ndarray":
    """A drawing's heights for the binary plan, which compares what is dug: it can tell neither weights nor free cells."""
    import numpy as np

    heights = np.asarray(goal.height)
    heaps = (np.asarray(goal.above) == 0) & (heights >= 0)  # may lie where nothing is to be dug
    if np.isnan(heights).any() or not np.all((np.asarray(goal.below) == 1) & ((np.asarray(goal.above) == 1) | heaps)):
        raise ValueError(
            "method: 'plan' knows no free cells, and no weights but that heaps may lie where nothing is to be dug; "
            "use --method search or optimise"
        )
    return heights


def _goal_heights(path: Path, options: argparse.Namespace) -> "np.ndarray":
    """A goal's heights, NaN where it is free: where the file has none or holds the value for no data, or by --free."""
    import numpy as np

    if options.method == "plan":
        return _heights(path, "goal", options, "; or use --method search or optimise, to which they are free")
    heights = _read_heights(path, options).astype(float)
    if options.free is None:
        return heights
    mask = _free(Path(options.free), heights.shape)
    if options.first_row == "top" and Path(options.free).suffix.lower() == ".npy":
        mask = mask[::-1]
    return np.where(mask, np.nan, heights)


def _free(path: Path, shape: tuple[int, ...]) -> "np.ndarray":
    """The free cells of a mask: the dark ones of a picture, or those of a .npy that are not 0, its rows as they come."""
    import numpy as np

    from jaxsand.goals.letters import read_image

    if path.suffix.lower() == ".png":
        mask = read_image(existing(path)) < -_DARK
    elif path.suffix.lower() == ".npy":
        existing(path)
        try:
            mask = np.load(path, allow_pickle=False)
        except (OSError, ValueError, EOFError):
            raise ValueError(f"free: {path} cannot be read as a .npy array; save one with numpy.save") from None
        if mask.dtype.kind not in "biuf":
            raise ValueError(f"free: got dtype {mask.dtype} in {path}; save booleans")
        mask = mask != 0
    else:
        raise ValueError(f"free: got {str(path)!r}; give a .png (dark is free) or a .npy of booleans")
    if mask.shape != shape:
        raise ValueError(f"free: got shape {list(mask.shape)}, the goal has {list(shape)}; make them equal")
    return mask


def read_surface(options: argparse.Namespace, target: "Target") -> "np.ndarray | None":
    """The sand [H, W] (m) to start from; None stands for level sand."""
    from jaxsand.goals import surfaces

    if options.surface == "level":
        return None
    if options.surface == "terrain":
        if not (math.isfinite(options.relief_mm) and options.relief_mm >= 0):
            raise ValueError(f"relief-mm: got {options.relief_mm}; give the terrain's height range, 0 or more")
        return surfaces.terrain_surface(target.scene.grid.shape, options.relief_mm / 1e3)
    path = Path(options.surface)
    if path.suffix.lower() != ".npy":
        raise ValueError(f"surface: got {options.surface!r}; give level, terrain or a .npy file ({_ROWS})")
    heights = _heights(path, "surface", options)
    if heights.shape != target.scene.grid.shape:
        raise ValueError(
            f"surface: got shape {list(heights.shape)}, the scene has {list(target.scene.grid.shape)}; make them equal"
        )
    return heights


def _heights(path: Path, field: str, options: argparse.Namespace, remedy: str = "") -> "np.ndarray":
    """A height map without gaps, first row at y = 0; `remedy` is what else to do about gaps."""
    from jaxsand.goals.metrics import finite

    heights = _read_heights(path, options)
    try:
        finite(heights, field)
    except ValueError as error:
        raise ValueError(f"{error}{remedy}") from None
    return heights


def _read_heights(path: Path, options: argparse.Namespace) -> "np.ndarray":
    """A height map, NaN where the file holds the value for no data, first row at y = 0."""
    from jaxsand.goals.letters import read_heights

    heights = read_heights(existing(path), options.no_data)
    spacing = _SPACING if options.spacing is None else options.spacing
    if spacing > 0:
        plausible(heights, spacing * max(heights.shape), str(path))
    return heights[::-1] if options.first_row == "top" else heights


def _drawn(options: argparse.Namespace) -> ValueError:
    other = "plan or search" if Path(options.goal).suffix.lower() == ".png" else "plan"
    return ValueError(
        f"method: {options.method!r} compares berms too, which {options.goal} has none of; use --method {other}"
    )


def _deep_enough(heights: "np.ndarray", method: str) -> float:
    """The depth (mm) of a blade that digs a goal and no deeper: one that only levels and heaps scrapes at height 0."""
    depth = -1e3 * float(min(0.0, *heights[heights < 0].ravel(), 0.0))
    return _DEEP if method == "policy" and not depth else min(depth, _DEEP)


def _layout(options: argparse.Namespace, depth_mm: float = 3.0) -> "Layout":
    from jaxsand.planning.targets import Layout

    depth = depth_mm if options.depth_mm is None else options.depth_mm
    spacing = _SPACING if options.spacing is None else options.spacing
    resolution = options.resolution or RESOLUTION
    scrapes = options.method in ("search", "optimise") and depth == 0
    if spacing > _FAR:
        raise ValueError(f"spacing: got {spacing}; give metres, at most {_FAR:g}")
    for field, value in (("spacing", spacing), *(() if scrapes else (("depth-mm", depth),))):
        if not (math.isfinite(value) and value > 0):
            raise ValueError(f"{field}: got {value}; give a positive number")
    for field, value, most in (("resolution", resolution, 64), ("cells", _cells(options), 1024)):
        if not 1 <= value <= most:
            raise ValueError(f"{field}: got {value}; give a number of grid cells from 1 to {most}")
    margin = math.ceil(5 * resolution / 3)
    return Layout(cell=resolution, spacing=spacing, depth=depth / 1e3, margin=margin)


def _cells(options: argparse.Namespace) -> int:
    cells: int = options.cells or 48
    return cells
