"""`jaxsand shape`: from a goal to the strokes that trench it, to the sand they leave."""

import argparse
import math
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

from jaxsand.cli.files import existing, folder, progress, read_text, write_json, written
from jaxsand.cli.printing import plain_name, read_cell, show

if TYPE_CHECKING:
    import numpy as np

    from jaxsand.planning.gradient import Optimised
    from jaxsand.planning.learned.stages import Planned
    from jaxsand.planning.pipeline import Layout, ShapeResult, Target
    from jaxsand.planning.search import SandPlan


def run_shape(options: argparse.Namespace) -> None:
    _check_options(options)
    tell = progress()
    started = time.perf_counter()
    tell("reading the goal")
    from jaxsand.planning.methods import by_policy, optimised, searched
    from jaxsand.planning.pipeline import shape
    from jaxsand.viz.render import save_animation, save_figure, shape_figure

    began = time.perf_counter()
    looks = options.method in ("search", "optimise", "policy")
    target = _target(options)
    if looks and target.drawn:
        raise ValueError(
            f"method: {options.method!r} compares berms too, which {options.goal} has none of; use --method plan"
        )
    surface = _surface(options, target)
    out = folder(options.out or Path(f"shape-{plain_name(options.goal)}"))
    strokes = options.strokes or (len(target.paths) if target.kind == "glyph" else 6)
    if options.method == "search":
        target = searched(target, surface, strokes, options.pushes or 1000 * strokes, options.seed or 0, tell)
    if options.method == "optimise":
        target = optimised(target, surface, options.strokes, options.pushes or 4000, options.seed or 0, tell)
    if options.method == "policy":
        from jaxsand.planning.learned.stages import Stages

        polish = (options.pushes or 4000) if options.refine else 0
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
    show(options, report, _summary)


def _report(result: "ShapeResult", total: float, planned: float, drawn: float, files: dict[str, Path]) -> dict[str, Any]:
    target, seconds = result.target, result.seconds
    return {
        "goal": target.name,
        "goal_kind": target.kind,
        "method": target.method,
        "strokes": [[round(v, 6) for v in stroke] for stroke in result.strokes],
        "lifted": result.lifted,
        "steps": result.steps,
        **({"optimal": target.optimal, "lower_bound": target.lower_bound} if target.method == "plan" else {}),
        **({"search": _found(target.found)} if target.found else {}),
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


_BY = {
    "strokes": ("search", "optimise", "policy"),
    "pushes": ("search", "optimise", "policy"),
    "seed": ("search", "optimise"),
    "lookahead": ("policy",),
    "refine": ("policy",),
}


def _check_options(options: argparse.Namespace) -> None:
    for option, methods in _BY.items():
        if getattr(options, option) not in (None, False) and options.method not in methods:
            *others, last = methods
            some = f"{', '.join(others)} or {last}" if others else last
            raise ValueError(f"{option}: has an effect with --method {some} only; leave it out")
    if options.method == "policy" and options.pushes and not options.refine:
        raise ValueError("pushes: has an effect on the policy with --refine only; add that, or leave it out")


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


def _summary(report: dict[str, Any]) -> str:
    how = f"{report['steps']} strokes"
    if report["method"] == "plan":
        proof = "proven shortest" if report["optimal"] else f"at least {report['lower_bound']} are needed"
        how = f"{report['steps']} steps ({proof})"
    if "search" in report:
        how += f" found in {report['search']['rollouts']:.0f} pushes"
    return "\n".join(
        (
            f"{report['goal']} ({report['goal_kind']}): {how}",
            f"IoU {report['iou']:.3f}, l2 reduction {report['l2_reduction']:.3f} "
            f"(with berms {report['l2_reduction_with_berms']:.3f})",
            f"volume error {report['volume_error']:.1e}, steepest slope {report['max_slope_deg']:.2f} deg",
            f"compile {report['seconds_compile']:.2f} s, run {report['seconds_run']:.2f} s, "
            f"plan {report['seconds_plan']:.2f} s, draw {report['seconds_draw']:.2f} s",
            *report["files"],
        )
    )


def _target(options: argparse.Namespace) -> "Target":
    from jaxsand.goals import letters, surfaces
    from jaxsand.planning import pipeline

    name, method = options.goal, options.method
    path = Path(name)
    suffix = path.suffix.lower()
    is_file = suffix in (".txt", ".png", ".npy")
    if not name.strip():
        raise ValueError("goal: got an empty name; give a letter, a .txt, .png or .npy file, or terrain")
    if method == "strokes" and (is_file or name == "terrain"):
        raise ValueError(f"method: 'strokes' pushes a glyph's own strokes, {name} has none; use --method plan")
    if method != "plan" and not (is_file or name == "terrain"):
        for option in ("start", "depth_mm", "spacing", "resolution", "cells"):
            if getattr(options, option) is not None:
                raise ValueError(f"{option.replace('_', '-')}: has no effect on a glyph's own strokes; leave it out")
        letter = name.upper() if len(name) == 1 and name.isascii() and name.isalpha() else ""
        return pipeline.glyph_target(letters.letter_strokes(letter) if letter else letters.text_strokes(name), name)
    start = read_cell(options.start)
    if len(name) == 1:
        dig, own = letters.letter_map(name.upper() if name.isascii() else name)
        return pipeline.map_target(dig, start if options.start else own, name.upper(), _layout(options))
    if suffix == ".txt":
        dig, marked = letters.read_text_map(read_text(path), str(path))
        return pipeline.map_target(dig, start if options.start else marked, path.stem, _layout(options))
    if options.start:
        raise ValueError(f"start: {name} is no map of # and .; leave --start out")
    if suffix == ".png":
        return pipeline.image_target(letters.read_image(existing(path)), path.stem, _layout(options), _cells(options))
    if suffix == ".npy":
        return pipeline.height_target(letters.read_heights(existing(path)), "heights", path.stem, _layout(options, 7.5))
    if name == "terrain":
        layout = _layout(options, 7.5)
        land = surfaces.terrain_surface((_cells(options), _cells(options)), 4 * layout.depth)
        return pipeline.height_target(land, "terrain", name, layout)
    raise ValueError(
        f"goal: got {name!r}; give a letter A to Z, a .txt, .png or .npy file, or terrain, "
        "or push any text by its own strokes with --method strokes"
    )


def _layout(options: argparse.Namespace, depth_mm: float = 3.0) -> "Layout":
    from jaxsand.planning.pipeline import Layout

    depth = depth_mm if options.depth_mm is None else options.depth_mm
    spacing = 0.01 if options.spacing is None else options.spacing
    resolution = options.resolution or 6
    for field, value in (("spacing", spacing), ("depth-mm", depth)):
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
    from jaxsand.goals import letters, surfaces

    if options.surface == "level":
        return None
    if options.surface == "terrain":
        if not (math.isfinite(options.relief_mm) and options.relief_mm >= 0):
            raise ValueError(f"relief-mm: got {options.relief_mm}; give the terrain's height range, 0 or more")
        return surfaces.terrain_surface(target.scene.grid.shape, options.relief_mm / 1e3)
    if not options.surface.endswith(".npy"):
        raise ValueError(f"surface: got {options.surface!r}; give level, terrain or a .npy file")
    heights = letters.read_heights(existing(Path(options.surface)))
    if heights.shape != target.scene.grid.shape:
        raise ValueError(
            f"surface: got shape {list(heights.shape)}, the scene has {list(target.scene.grid.shape)}; make them equal"
        )
    return heights
