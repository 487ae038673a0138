"""`jaxsand shape`: from a goal to the strokes that trench it, to the sand they leave."""

import argparse
import math
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

from jaxsand.cli.files import existing, folder, plausible, progress, read_text, write_json, written
from jaxsand.cli.printing import plain_name, read_cell, show

if TYPE_CHECKING:
    import numpy as np

    from jaxsand.goals.goal import Goal
    from jaxsand.planning.gradient import Optimised
    from jaxsand.planning.learned.stages import Planned
    from jaxsand.planning.pipeline import Layout, ShapeResult, Target
    from jaxsand.planning.search import SandPlan


def run_shape(options: argparse.Namespace) -> None:
    """Runs `jaxsand shape`."""
    options.method = options.method or _suited(options.goal)
    _check_options(options)
    tell = progress()
    started = time.perf_counter()
    tell("reading the goal")
    from jaxsand.planning.methods import by_policy, optimised, searched
    from jaxsand.planning.pipeline import shape
    from jaxsand.viz.render import save_animation, save_figure, shape_figure

    began = time.perf_counter()
    target = _target(options)
    surface = _surface(options, target)
    level = target.kind == "glyph" or options.method != "search"
    strokes = options.strokes or (len(target.paths) if target.kind == "glyph" else 6 if level else _STROKES)
    polish = _polish(options, strokes)
    out = folder(options.out or Path(f"shape-{plain_name(options.goal)}"))
    if options.method == "search":
        pushes = options.pushes or (1000 * strokes if level else _PUSHES)
        target = searched(target, surface, strokes, pushes, options.seed or 0, tell)
    if options.method == "optimise":
        target = optimised(target, surface, options.strokes, options.pushes or 4000, options.seed or 0, tell)
    if options.method == "policy":
        from jaxsand.planning.learned.stages import Stages

        target = by_policy(target, surface, strokes, Stages(options.lookahead or 0, polish), tell)
    planned = time.perf_counter() - began
    result = shape(target, surface, tell)
    tell("drawing")
    began = time.perf_counter()
    files = {name: out / name for name in ("result.json", "shape.png", "shape.gif")}
    with written(files["shape.png"]) as path:
        save_figure(lambda: shape_figure(result), path)
    with written(files["shape.gif"]) as path:
        save_animation(result, path)
    if target.method == "strokes":  # a glyph's goal is pushed first, by the same program
        planned -= result.seconds["compile"]
    ended = time.perf_counter()
    report = _report(result, ended - started, planned, ended - began, files)
    write_json(files["result.json"], report)
    tell("")
    if target.found and target.found.reason:
        print(f"warning: strokes: {target.found.reason}{_dug_alone(target)}", file=sys.stderr)
    if target.missed:
        print(f"warning: goal: {_left_out(target, options)}", file=sys.stderr)
    show(options, report, _summary)


def _report(result: "ShapeResult", total: float, planned: float, drawn: float, files: dict[str, Path]) -> dict[str, Any]:
    target, seconds = result.target, result.seconds
    return {
        "goal": target.name,
        "goal_kind": target.kind,
        "method": target.method,
        "strokes": [[round(v, 6) for v in stroke] for stroke in result.strokes],
        "paths": [[[round(float(v), 6) for v in point] for point in path] for path in target.paths],
        "lifted": result.lifted,
        "steps": result.steps,
        **(
            {name: getattr(target, name) for name in ("optimal", "lower_bound", "missed")} if target.method == "plan" else {}
        ),
        **({"search": _found(target.found) | _at_best(result) | {"reason": target.found.reason}} if target.found else {}),
        **result.figures,
        "seconds": total,
        "seconds_plan": planned + seconds["prepare"],
        "seconds_compile": seconds["compile"],
        "seconds_run": seconds["run"],
        "seconds_draw": drawn,
        "grid": {"shape": list(target.scene.grid.shape), "spacing": float(target.scene.grid.spacing)},
        "blade": {name: float(getattr(target.scene.tool, name)) for name in ("width", "thickness", "depth")},
        "files": [str(path) for path in files.values()],
    }


_ROWS = "heights in metres, first row at y = 0; with --first-row top, on top as in pictures and maps"
_OTHER_FILES = (".asc", ".bmp", ".csv", ".dem", ".gif", ".hgt", ".jpeg", ".jpg", ".npz", ".svg", ".tif", ".tiff")
_STROKES, _PUSHES = 24, 2000  # of a search for strokes that rise and sink, unless told otherwise
_REFINED = 4000  # pushes by --refine, unless told otherwise
_RESOLUTION = 6  # grid cells to a block's side, unless told otherwise
_SPACING = 0.01  # m, unless told otherwise
_FAR = 1e4  # m: as large as a cell may be
_DARK = 0.5  # of black: what a picture's free cells are darker than
_DEEP = 7.5  # mm: as deep as a blade goes unless told otherwise, into a goal that has heights

_BY = {
    "strokes": ("search", "optimise", "policy"),
    "pushes": ("search", "optimise", "policy"),
    "seed": ("search", "optimise"),
    "lookahead": ("policy",),
    "refine": ("policy",),
    "free": ("search", "optimise", "policy"),
}


def _suited(goal: str) -> str:
    """The method where none is told: the shortest stroke over a map, a search for a goal that has heights."""
    return "search" if goal == "terrain" or Path(goal).suffix.lower() in (".png", ".npy", ".json") else "plan"


def _check_options(options: argparse.Namespace) -> None:
    for option, methods in _BY.items():
        if getattr(options, option) not in (None, False) and options.method not in methods:
            *others, last = methods
            some = f"{', '.join(others)} or {last}" if others else last
            raise ValueError(f"{option}: has an effect with --method {some} only; leave it out")
    for option in ("no_data", "first_row"):
        if getattr(options, option) is not None and ".npy" not in {
            Path(file).suffix.lower() for file in (options.goal, options.surface)
        }:
            raise ValueError(f"{option.replace('_', '-')}: has an effect on .npy files only; leave it out")
    if options.free is not None and Path(options.goal).suffix.lower() != ".npy":
        raise ValueError("free: has an effect on a goal in a .npy file only; leave it out")
    if options.method == "policy" and options.pushes and not options.refine:
        raise ValueError("pushes: has an effect on the policy with --refine only; add that, or leave it out")


def _polish(options: argparse.Namespace, strokes: int) -> int:
    """The pushes that are left to --refine of those allowed; those that the policy may take before come first."""
    if not options.refine or options.pushes is None:
        return _REFINED if options.refine else 0
    from jaxsand.planning.learned.beam_search import most_calls

    before, allowed = most_calls(strokes, options.lookahead or 0), int(options.pushes)
    if allowed <= before:
        raise ValueError(
            f"pushes: got {allowed}, and the policy may take {before} for {strokes} strokes before --refine; give more, "
            "or leave --refine out"
        )
    return allowed - before


def _found(found: "SandPlan | Optimised | Planned") -> dict[str, Any]:
    """l2 distances in m; `rollouts` counts rough pushes and gradients by what they cost."""
    from jaxsand.planning.gradient import Optimised
    from jaxsand.planning.learned.stages import Planned

    if isinstance(found, Planned):
        return {"before": found.before**0.5, "after": found.after**0.5, "rollouts": found.calls}
    if isinstance(found, Optimised):
        far = [float(loss) ** 0.5 for loss in found.losses]
        return {"before": far[0], "after": far[-1], "rollouts": int(found.spent), "found_after": int(found.calls[-1])}
    return {
        "before": found.before,
        "after": found.after,
        "lower_bound": found.lower_bound,
        "gap": found.gap,
        "estimate": found.estimate,
        "rollouts": found.effort.cost,
        "full_pushes": found.effort.full,
        "rough_pushes": found.effort.rough,
    }


def _at_best(result: "ShapeResult") -> dict[str, Any]:
    """What l2 distance repose and volume leave at least, whatever the strokes (m)."""
    from jaxsand.goals.feasible import at_best

    known = getattr(result.target.found, "at_best", None)
    return {"at_best": (known or at_best(result.target.scene, result.before, result.target.goal)).distance_bound}


def _summary(report: dict[str, Any]) -> str:
    how = f"{report['steps']} strokes"
    if report["method"] == "plan":
        proof = "proven shortest" if report["optimal"] else f"at least {report['lower_bound']} are needed"
        if report["missed"]:
            proof = f"over a part of the goal: {report['missed']} of its dug cells are left out"
        how = f"{report['steps']} steps ({proof})"
    if "search" in report:
        how += f" found in {report['search']['rollouts']:.0f} pushes"
    return "\n".join(
        (
            f"{report['goal']} ({report['goal_kind']}): {how}",
            f"IoU {report['iou']:.3f}, l2 reduction {report['l2_reduction']:.3f} "
            f"(with berms {report['l2_reduction_with_berms']:.3f})",
            *_distances(report.get("search")),
            f"volume error {report['volume_error']:.1e}, steepest slope {report['max_slope_deg']:.2f} deg",
            f"compile {report['seconds_compile']:.2f} s, run {report['seconds_run']:.2f} s, "
            f"plan {report['seconds_plan']:.2f} s, draw {report['seconds_draw']:.2f} s",
            *report["files"],
        )
    )


def _distances(search: dict[str, Any] | None) -> list[str]:
    """How near the strokes of a search come, and how near sand can come at best."""
    if search is None:
        return []
    before, after, best = (1e3 * search[name] for name in ("before", "after", "at_best"))
    return [f"l2 distance {before:.2f} mm before, {after:.2f} mm after; at best, by repose and volume alone, {best:.2f} mm"]


def _target(options: argparse.Namespace) -> "Target":
    from jaxsand.goals import letters
    from jaxsand.planning import pipeline

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
    return pipeline.map_target(
        dig, start if options.start else own, path.stem if is_file else name.upper(), _layout(options)
    )


def _surface_target(options: argparse.Namespace) -> "Target":
    """The goal that a picture, heights, a drawing or the terrain is; with strokes only where the method is to plan them."""
    from jaxsand.goals import letters, surfaces
    from jaxsand.goals.goal import Goal
    from jaxsand.planning import pipeline

    name, path, planned = options.goal, Path(options.goal), options.method == "plan"
    if options.start:
        raise ValueError(f"start: {name} is no map of # and .; leave --start out")
    if path.suffix.lower() == ".png":
        if options.method in ("optimise", "policy"):
            raise _drawn(options)
        layout = _layout(options)
        heights = pipeline.image_goal(letters.read_image(existing(path)), layout, _cells(options))
        if planned:
            return pipeline.height_target(heights, "image", path.stem, layout)
        return pipeline.height_goal(Goal(heights, above=(heights < 0) * 1.0), "image", path.stem, layout)
    if path.suffix.lower() == ".json":
        return _drawing_target(path, options)
    if name == "terrain":
        layout = _layout(options, _DEEP)
        heights = surfaces.terrain_surface((_cells(options), _cells(options)), 4 * layout.depth)
        heights -= 0 if planned else heights.mean()  # what is dug is heaped
    else:
        heights = _goal_heights(path, options)
        layout = _layout(options, _DEEP if planned else _deep_enough(heights, options.method))
    make = pipeline.height_target if planned else pipeline.height_goal
    return make(heights, "terrain" if name == "terrain" else "heights", path.stem, layout)


def _drawing_target(path: Path, options: argparse.Namespace) -> "Target":
    """The goal that a drawing is, on the grid that it gives; with strokes only where the method is to plan them."""
    from dataclasses import replace

    import numpy as np

    from jaxsand.goals.drawing import SHEET, as_drawing
    from jaxsand.planning import pipeline
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
        return pipeline.height_target(_planned(goal), "drawing", path.stem, layout)
    return pipeline.height_goal(goal, "drawing", path.stem, layout)


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


def _left_out(target: "Target", options: argparse.Namespace) -> str:
    """What a plan over blocks leaves out of a goal, and what to do about it."""
    from jaxsand.goals.metrics import dug

    finer = " smaller --resolution" if (options.resolution or _RESOLUTION) > 1 else " finer goal"
    other = "search" if target.kind == "image" else "search or optimise"
    return (
        f"{target.missed} of {int(dug(target.goal, target.depth).sum())} dug cells are left out, since the blocks of cells "
        f"that they lie in are not dug deep enough in the mean; give a{finer}, or use --method {other}"
    )


def _dug_alone(target: "Target") -> str:
    """What else to do about a goal that only digs."""
    import numpy as np

    digs = (
        target.weighted is None
        and not (target.goal > 0).any()
        and not np.isnan(target.goal).any()
        and bool((target.goal < 0).any())
    )
    return ", or use --method plan, which compares only what is dug" if digs else ""


def _deep_enough(heights: "np.ndarray", method: str) -> float:
    """The depth (mm) of a blade that digs a goal and no deeper: one that only levels and heaps scrapes at height 0."""
    depth = -1e3 * float(min(0.0, *heights[heights < 0].ravel(), 0.0))
    return _DEEP if method == "policy" and not depth else min(depth, _DEEP)


def _layout(options: argparse.Namespace, depth_mm: float = 3.0) -> "Layout":
    from jaxsand.planning.pipeline import Layout

    depth = depth_mm if options.depth_mm is None else options.depth_mm
    spacing = _SPACING if options.spacing is None else options.spacing
    resolution = options.resolution or _RESOLUTION
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


def _surface(options: argparse.Namespace, target: "Target") -> "np.ndarray | None":
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
