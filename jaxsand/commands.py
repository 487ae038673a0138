"""What the commands do, once their arguments are read."""

import argparse
import math
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from jaxsand.files import as_json, existing, folder, progress, read_text, written

if TYPE_CHECKING:
    import numpy as np

    from jaxsand.shaping import Layout, ShapeResult, Target


SCHEMES = ("relaxation", "pairwise", "super-time-stepping", "multilevel")


def run_shape(options: argparse.Namespace) -> None:
    tell = progress()
    started = time.perf_counter()
    tell("reading the goal")
    from jaxsand.render import save_animation, save_figure, shape_figure
    from jaxsand.shaping import shape

    began = time.perf_counter()
    target = _target(options)
    planned = time.perf_counter() - began
    surface = _surface(options, target)
    out = folder(options.out or Path(f"shape-{_plain(options.goal)}"))
    result = shape(target, surface, tell)
    tell("drawing")
    began = time.perf_counter()
    files = {name: out / name for name in ("result.json", "shape.png", "shape.gif")}
    with written(files["shape.png"]) as path:
        save_figure(shape_figure(result), path)
    with written(files["shape.gif"]) as path:
        save_animation(result, path)
    if target.method == "strokes":  # a glyph's goal is pushed first, by the same program
        planned -= result.seconds["compile"]
    ended = time.perf_counter()
    report = _report(result, ended - started, planned, ended - began, files)
    with written(files["result.json"]) as path:
        path.write_text(as_json(report, indent=1) + "\n", encoding="utf-8")
    tell("")
    _print(options, report, _summary)


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


def _summary(report: dict[str, Any]) -> str:
    how = f"{report['steps']} strokes"
    if report["method"] == "plan":
        proof = "proven shortest" if report["optimal"] else f"at least {report['lower_bound']} are needed"
        how = f"{report['steps']} steps ({proof})"
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
    from jaxsand import goals, shaping

    name, method = options.goal, options.method
    path = Path(name)
    suffix = path.suffix.lower()
    is_file = suffix in (".txt", ".png", ".npy")
    if not name.strip():
        raise ValueError("goal: got an empty name; give a letter, a .txt, .png or .npy file, or terrain")
    if method == "strokes":
        if is_file or name == "terrain":
            raise ValueError(f"method: 'strokes' pushes a glyph's own strokes, {name} has none; use --method plan")
        for option in ("start", "depth_mm", "spacing", "resolution", "cells"):
            if getattr(options, option) is not None:
                raise ValueError(f"{option.replace('_', '-')}: has no effect with --method strokes; leave it out")
        letter = name.upper() if len(name) == 1 and name.isascii() and name.isalpha() else ""
        return shaping.glyph_target(goals.letter_strokes(letter) if letter else goals.text_strokes(name), name)
    start = _cell(options.start)
    if len(name) == 1:
        dig, own = goals.letter_map(name.upper() if name.isascii() else name)
        return shaping.map_target(dig, start if options.start else own, name.upper(), _layout(options))
    if suffix == ".txt":
        dig, marked = goals.read_text_map(read_text(path), str(path))
        return shaping.map_target(dig, start if options.start else marked, path.stem, _layout(options))
    if options.start:
        raise ValueError(f"start: {name} is no map of # and .; leave --start out")
    if suffix == ".png":
        return shaping.image_target(goals.read_image(existing(path)), path.stem, _layout(options), _cells(options))
    if suffix == ".npy":
        return shaping.height_target(goals.read_heights(existing(path)), "heights", path.stem, _layout(options, 7.5))
    if name == "terrain":
        layout = _layout(options, 7.5)
        land = shaping.terrain_surface((_cells(options), _cells(options)), 4 * layout.depth)
        return shaping.height_target(land, "terrain", name, layout)
    raise ValueError(
        f"goal: got {name!r}; give a letter A to Z, a .txt, .png or .npy file, or terrain, "
        "or push any text by its own strokes with --method strokes"
    )


def _layout(options: argparse.Namespace, depth_mm: float = 3.0) -> "Layout":
    from jaxsand.shaping import Layout

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
    from jaxsand import goals, shaping

    if options.surface == "level":
        return None
    if options.surface == "terrain":
        if not (math.isfinite(options.relief_mm) and options.relief_mm >= 0):
            raise ValueError(f"relief-mm: got {options.relief_mm}; give the terrain's height range, 0 or more")
        return shaping.terrain_surface(target.scene.grid.shape, options.relief_mm / 1e3)
    if not options.surface.endswith(".npy"):
        raise ValueError(f"surface: got {options.surface!r}; give level, terrain or a .npy file")
    heights = goals.read_heights(existing(Path(options.surface)))
    if heights.shape != target.scene.grid.shape:
        raise ValueError(
            f"surface: got shape {list(heights.shape)}, the scene has {list(target.scene.grid.shape)}; make them equal"
        )
    return heights


def run_settle(options: argparse.Namespace) -> None:
    tell = progress()
    if options.out_file.suffix != ".npy":
        raise ValueError(f"out-file: got {options.out_file}; give a name that ends in .npy")
    from jaxsand import goals

    heights = goals.read_heights(existing(options.input))
    import jax
    import numpy as np

    if heights.dtype == np.float64:
        jax.config.update("jax_enable_x64", True)
    elif heights.dtype.kind != "f":
        heights = heights.astype(np.float32)
    from jaxsand import schemes
    from jaxsand.rules import Outcome, UntilStill
    from jaxsand.scene import make_scene
    from jaxsand.settling import settle
    from jaxsand.sim import OutcomeError, check
    from jaxsand.task import volume_error

    if not np.all(np.isfinite(heights)):
        raise ValueError(f"{options.input}: got {np.sum(~np.isfinite(heights))} cells that are not finite; fill them first")
    scene = make_scene(heights.shape, options.spacing, math.radians(options.repose_deg), options.neighbours)
    scheme = getattr(schemes, options.scheme.title().replace("-", ""))()
    stop = UntilStill(options.tol, bound=options.bound)
    folder(options.out_file.parent)
    tell("settling")
    began = time.perf_counter()
    compiled = jax.jit(lambda h: settle(scene, h, scheme=scheme, stop=stop)).lower(heights).compile()
    ready = time.perf_counter()
    settled = jax.block_until_ready(compiled(heights))
    ran = time.perf_counter() - ready
    with written(options.out_file) as path, path.open("wb") as file:
        np.save(file, np.asarray(settled.height))
    tell("")
    outcome = Outcome(int(settled.outcome))
    report = {
        "sweeps": int(settled.sweeps),
        "residual": float(settled.residual),
        "volume_error": volume_error(heights, settled.height),
        "outcome": "clean" if not outcome else (outcome.name or str(int(outcome))).lower(),
        "seconds": ran + ready - began,
        "seconds_compile": ready - began,
        "seconds_run": ran,
        "files": [str(options.out_file)],
    }
    if outcome:
        try:
            check(settled)
        except OutcomeError as error:
            print(f"warning: {error}", file=sys.stderr)
    _print(options, report, _lines)


def run_plan(options: argparse.Namespace) -> None:
    from jaxsand import goals
    from jaxsand.planner import plan

    start = _cell(options.start)
    own: tuple[int, int] | None
    if len(options.map) == 1:
        dig, own = goals.letter_map(options.map.upper() if options.map.isascii() else options.map)
    else:
        dig, own = goals.read_text_map(read_text(Path(options.map)), options.map)
    began = time.perf_counter()
    found = plan(dig, start if options.start else own)
    report = {
        "steps": found.steps,
        "path": found.path,
        "start": list(found.start),
        "optimal": found.optimal,
        "lower_bound": found.lower_bound,
        "expanded": found.expanded,
        "opened": found.opened,
        "engine": "astar",
        "seconds": time.perf_counter() - began,
    }
    _print(options, report, _lines)


def run_benchmark(options: argparse.Namespace) -> None:
    tell = progress()
    out = folder(options.out) if options.out else None
    from jaxsand.benchmark import bench, table

    report = bench(options.what, options.batch, tell, options.grids)
    if out:
        if report.get("work_precision"):
            from jaxsand.render import save_figure, work_precision_figure

            with written(out / f"bench-{options.what}.png") as path:
                save_figure(work_precision_figure(report["work_precision"]), path)
        with written(out / f"bench-{options.what}.json") as path:
            path.write_text(as_json(report, indent=1) + "\n", encoding="utf-8")
    tell("")
    _print(options, report, table)


def _cell(text: str | None) -> tuple[int, int] | None:
    if text is None or text == "best":
        return None
    try:
        row, column = (int(part) for part in text.split(","))
    except ValueError:
        raise ValueError(f"start: got {text!r}; give row,column such as 3,3, or best") from None
    return row, column


def _print(options: argparse.Namespace, report: dict[str, Any], human: Callable[[dict[str, Any]], str]) -> None:
    print(as_json(report) if options.json else human(report))


def _lines(report: dict[str, Any]) -> str:
    return "\n".join(f"{name}: {value}" for name, value in report.items())


def _plain(name: str) -> str:
    stem = Path(name).stem if Path(name).suffix in (".txt", ".png", ".npy") else name
    return "".join(c if c.isalnum() else "-" for c in stem)[:40]
