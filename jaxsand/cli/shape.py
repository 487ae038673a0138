"""`jaxsand shape`: from a goal to the strokes that trench it, to the sand they leave."""

import argparse
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

from jaxsand.cli.files import folder, progress, write_json
from jaxsand.cli.printing import plain_name, show
from jaxsand.cli.target import RESOLUTION, read_surface, read_target
from jaxsand.goals.writing import written

if TYPE_CHECKING:
    from collections.abc import Callable

    import numpy as np

    from jaxsand.planning.gradient import Optimised
    from jaxsand.planning.learned.stages import Planned
    from jaxsand.planning.pipeline import ShapeResult
    from jaxsand.planning.search import SandPlan
    from jaxsand.planning.targets import Target

_FILES = ("result.json", "shape.png", "shape.gif")
_STROKES, _PUSHES = 24, 2000  # of a search for strokes that rise and sink, unless told otherwise
_REFINED = 4000  # pushes by --refine, unless told otherwise

_BY = {
    "strokes": ("search", "optimise", "policy"),
    "pushes": ("search", "optimise", "policy"),
    "seed": ("search", "optimise"),
    "lookahead": ("policy",),
    "refine": ("policy",),
    "free": ("search", "optimise", "policy"),
}


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
    target = read_target(options)
    surface = read_surface(options, target)
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
    result = shape(target, surface, tell, _live(target) if options.live else lambda _: None)
    tell("drawing")
    began = time.perf_counter()
    files = {name: out / name for name in _FILES + ("shape.html",) * options.html}
    with written(files["shape.png"]) as path:
        save_figure(lambda: shape_figure(result), path)
    with written(files["shape.gif"]) as path:
        save_animation(result, path)
    if options.html:
        with written(files["shape.html"]) as path:
            result.to_html(path)
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


def _live(target: "Target") -> "Callable[[np.ndarray], None]":
    """What draws maps in the terminal, in colours that span the goal's heights."""
    import numpy as np

    from jaxsand.viz.terminal import live

    return live(max(2 * target.depth, float(np.nanmax(np.abs(target.goal), initial=0))))


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


def _left_out(target: "Target", options: argparse.Namespace) -> str:
    """What a plan over blocks leaves out of a goal, and what to do about it."""
    from jaxsand.goals.metrics import dug

    finer = " smaller --resolution" if (options.resolution or RESOLUTION) > 1 else " finer goal"
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
