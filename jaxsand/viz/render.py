"""Pictures of maps beside their goal, of plans and benchmarks, and animations of the sand being pushed."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from jaxsand.planning.binary import Plan
from jaxsand.planning.pipeline import ShapeResult
from jaxsand.planning.targets import Target

if TYPE_CHECKING:
    from collections.abc import Callable

    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

HEIGHTS = "RdYlBu_r"
"""Colours of heights."""
ERRORS = "PuOr"
"""Colours of differences from a goal."""
_SAND = ((0.42, 0.30, 0.18), (0.80, 0.66, 0.44), (0.98, 0.92, 0.76))  # shadow, level sand, light


def shape_figure(result: ShapeResult) -> "Figure":
    """Goal, result with the tool's path, their difference, and the sand lit from the north-west."""
    from matplotlib.figure import Figure

    target, f = result.target, result.figures
    rows, columns = target.scene.grid.shape
    figure = Figure(figsize=(11, min(max(10 * rows / columns, 5), 20)), layout="constrained")
    axes = figure.subplots(2, 2)
    goal, after = target.goal * 1e3, result.after * 1e3
    top = 2.5e3 * target.depth if target.drawn else _span(goal, after)
    _map(axes[0, 0], goal, target, "goal", HEIGHTS, top, "height (mm)")
    _map(axes[0, 1], after, target, "result and path", HEIGHTS, top, "height (mm)")
    _path(axes[0, 1], result)
    error = after - goal
    span = top if target.drawn else max(_span(error), 1e-2)
    _map(axes[1, 0], error, target, "result - goal", ERRORS, span, "difference (mm)")
    axes[1, 1].imshow(lit(result.after, float(target.scene.grid.spacing)), origin="lower", extent=_extent(target))
    axes[1, 1].set_title("the sand, lit from the north-west", loc="left")
    axes[1, 1].set(xlabel="x (m)", ylabel="y (m)")
    figure.suptitle(
        f"{target.name}: {result.steps} {'steps' if target.method == 'plan' else 'strokes'}, "
        f"IoU {f['iou']:.3f}, l2 reduction {f['l2_reduction']:.3f}, steepest slope {f['max_slope_deg']:.1f}°",
        parse_math=False,  # a goal may be called $a$
    )
    return figure


def work_precision_figure(rows: list[dict[str, Any]]) -> "Figure":
    """Error against run time of every scheme, by scene (rows) and grid (columns); a curve runs over tolerances."""
    from matplotlib.figure import Figure
    from matplotlib.ticker import FixedLocator

    problems = list(dict.fromkeys(row["problem"] for row in rows))
    schemes = list(dict.fromkeys(row["scheme"] for row in rows))
    sides = {p: list(dict.fromkeys(row["cells"] for row in rows if row["problem"] == p)) for p in problems}
    figure = Figure(figsize=(11, 2.9 * len(problems) + 0.8), layout="constrained")
    axes = figure.subplots(len(problems), max(map(len, sides.values())), squeeze=False, sharey=True)
    for line, problem in zip(axes, problems, strict=True):
        for ax, cells in zip(line, sides[problem], strict=False):
            for k, scheme in enumerate(schemes):
                some = [r for r in rows if (r["problem"], r["cells"], r["scheme"]) == (problem, cells, scheme)]
                ax.plot([r["seconds"] for r in some], [r["error"] for r in some], "osD^vPX"[k % 7] + "-", ms=4, label=scheme)
            ax.axhline(0.01, color="gray", lw=0.8, ls=":")
            ax.set(xscale="log", yscale="log", xlabel="run time (s)")
            ax.xaxis.set_major_locator(FixedLocator([m * 10.0**k for k in range(-6, 4) for m in (1, 2, 5)]))
            ax.xaxis.set_major_formatter("{x:g}")
            ax.xaxis.set_minor_formatter("")
            ax.tick_params(axis="x", labelsize=8)
            ax.set_title(f"{problem}, {cells} cells", loc="left", fontsize=9)
        line[0].set_ylabel("error / largest change")
    figure.legend(*axes[0, 0].get_legend_handles_labels(), loc="outside upper center", ncols=3, fontsize=8, frameon=False)
    return figure


def plan_figure(dig: np.ndarray, plan: Plan) -> "Figure":
    """The cells of a binary map and the path over them, coloured by its order.

    The path is drawn to the right of its direction, so that the way there and the way back lie apart.
    """
    from matplotlib.collections import LineCollection
    from matplotlib.figure import Figure
    from matplotlib.ticker import MaxNLocator

    rows, columns = dig.shape
    side = 0.5 * min(1.0, 24 / max(rows, columns))
    figure = Figure(figsize=(max(columns * side, 3) + 2, max(rows * side, 2.5) + 0.8), layout="constrained")
    axes = figure.subplots()
    axes.imshow(dig, cmap="Greys", vmin=0, vmax=6)
    cells = np.array(plan.cells, float)[:, ::-1]
    runs = np.diff(cells, axis=0)
    lines = np.stack([cells[:-1], cells[1:]], 1) + 0.13 * np.stack([-runs[:, 1], runs[:, 0]], 1)[:, None]
    # Each step is joined to the next, round corners and reversals.
    joined = np.concatenate([lines[:-1, 1:], lines[1:, :1]], 1) if len(lines) else lines
    for some, width in ((joined, 1.2), (lines, 2.4)):
        order = LineCollection(list(some), cmap="viridis", linewidths=width)
        order.set_array(np.arange(len(some)))
        axes.add_collection(order)
    middles = lines.mean(1)
    axes.quiver(
        *middles.T, runs[:, 0], -runs[:, 1], scale=2.2 * max(rows, columns), width=0.05 / max(rows, columns, 6), pivot="mid"
    )
    axes.plot(*cells[0], "o", color="black", ms=9 * side / 0.5, label="start")
    axes.plot(*cells[-1], "s", color="black", ms=10 * side / 0.5, mfc="none", label="end")
    if len(lines):
        figure.colorbar(order, ax=axes, label="step", shrink=0.7)
    what = f"{plan.steps} steps" if plan.cost == plan.steps else f"cost {plan.cost:g} in {plan.steps} steps"
    proof = "proven least" if plan.optimal else f"at least {plan.lower_bound:g} needed"
    figure.suptitle(f"{what}, {proof}", fontsize=11)
    axes.set(xlabel="column", ylabel="row")
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_locator(MaxNLocator(integer=True))
    figure.legend(loc="outside lower center", ncols=2, frameon=False, fontsize=8)
    return figure


def complexity_figure(report: dict[str, Any]) -> "Figure":
    """States expanded and time of planning against back-tracks and map size, of three engines."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(11, 7), layout="constrained")
    axes = figure.subplots(2, 3)
    sizes = report["plan_by_size"]
    families = {"combs of 28 cells": "comb", "letter T, stretched": "T,", "letter A, stretched": "A,"}
    for column, (title, start) in enumerate(families.items()):
        some = [row for row in sizes if row["name"].startswith(start)]
        for line, unit, label in ((0, "expanded", "states expanded"), (1, "ms", "time (ms)")):
            ax = axes[line, column]
            for engine, mark in (("paper", "s-"), ("astar", "o-"), ("exact", "^-")):
                points = [(row["x"], row[f"{engine}_{unit}"]) for row in some if row[f"{engine}_{unit}"]]
                if points:
                    ax.plot(*zip(*points, strict=True), mark, ms=4, label=engine)
            ax.set(yscale="log", xlabel="teeth" if start == "comb" else "times as long", ylabel=label)
            ax.set_title(title, loc="left", fontsize=10)
    axes[1, 0].legend(frameon=False, fontsize=8)
    return figure


def alpha_figure(report: dict[str, Any]) -> "Figure":
    """Nodes that the paper's search opens, and its steps in excess of the fewest, against alpha."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(8, 3.4), layout="constrained")
    left, right = figure.subplots(1, 2)
    for k, letter in enumerate("ASTR"):
        some = [row for row in report["plan_by_alpha"] if row["name"] == letter]
        alphas = [row["alpha"] for row in some]
        left.plot(alphas, [row["nodes"] for row in some], "osD^"[k] + "-", ms=4, label=letter)
        right.plot(alphas, [row["steps_in_excess"] + 0.04 * k for row in some], "osD^"[k] + "-", ms=4, label=letter)
    left.set(yscale="log", xlabel="alpha", ylabel="nodes opened")
    right.set(xlabel="alpha", ylabel="steps in excess of the fewest")
    left.legend(frameon=False, fontsize=8)
    return figure


def save_figure(draw: "Callable[[], Figure]", path: Path) -> None:
    """Draws a figure and writes it as PNG, with matplotlib's defaults whatever the user's settings are."""
    import matplotlib.style

    with matplotlib.style.context("default"):
        draw().savefig(path, dpi=110, format="png")


def save_animation(result: ShapeResult, path: Path, width: int = 420, milliseconds: int = 90) -> None:
    """Writes a GIF of the sand being pushed, with the tool's outline."""
    from PIL import Image, ImageDraw

    grid = result.target.scene.grid
    dx = float(grid.spacing)
    rows, columns = grid.shape
    zoom = max(1, round(width / max(rows, columns)))
    frames = []
    for height, tool in zip(result.frames, result.tools, strict=True):
        picture = np.flipud((lit(height, dx)[..., :3] * 255).astype(np.uint8))
        image = Image.fromarray(picture).resize((columns * zoom, rows * zoom), Image.Resampling.BICUBIC)
        if np.all(np.isfinite(tool)):
            corners = _outline(result, tool) / dx * zoom
            corners[:, 1] = rows * zoom - corners[:, 1]
            ImageDraw.Draw(image).polygon([tuple(c) for c in corners], outline=(30, 30, 40), fill=(70, 80, 95))
        frames.append(image.quantize(96))
    frames[0].save(
        path,
        format="GIF",
        save_all=True,
        append_images=frames[1:],
        duration=[*[milliseconds] * (len(frames) - 1), 1500],
        loop=0,
        disposal=1,
    )


def lit(height: np.ndarray, spacing: float) -> np.ndarray:
    """A map [H, W] (m) as sand in slanting light, RGBA [H, W, 4].

    The brightness follows Lambert's law for a lamp 40 degrees up in the north-west.
    """
    from matplotlib.colors import LinearSegmentedColormap

    rows, columns = height.shape
    slope_y = np.gradient(height, spacing, axis=0) if rows > 1 else np.zeros_like(height)
    slope_x = np.gradient(height, spacing, axis=1) if columns > 1 else np.zeros_like(height)
    up = np.sin(np.radians(40))
    side = np.cos(np.radians(40)) / np.sqrt(2)
    brightness = (up + side * slope_x - side * slope_y) / np.sqrt(1 + slope_x**2 + slope_y**2)
    sand = LinearSegmentedColormap.from_list("sand", [(0.0, _SAND[0]), (up, _SAND[1]), (1.0, _SAND[2])])
    shade: np.ndarray = sand(np.clip(brightness, 0, 1))
    return shade


def _map(axes: "Axes", values: np.ndarray, target: Target, title: str, colours: str, top: float, label: str) -> None:
    """Draws a map with its colour bar."""
    image = axes.imshow(values, origin="lower", extent=_extent(target), cmap=colours, vmin=-top, vmax=top)
    axes.set_title(title, loc="left")
    axes.set(xlabel="x (m)", ylabel="y (m)", aspect="equal")
    over = "both" if np.abs(values).max() > top else "neither"
    axes.figure.colorbar(image, ax=axes, label=label, shrink=0.85, extend=over)


def _path(axes: "Axes", result: ShapeResult) -> None:
    """Draws the tool's paths with arrows."""
    size = 6 if len(result.target.paths) < 10 else 3
    for number, path in enumerate(path[:, :2] for path in result.target.paths):
        axes.plot(*path.T, "-", color="black", lw=1.2, alpha=0.7)
        axes.plot(*path[0], "o", color="black", ms=size, label="lowered" if not number else None)
        axes.plot(*path[-1], "s", color="black", ms=size, mfc="none", label="lifted" if not number else None)
        runs = np.diff(path, axis=0)
        middle = (path[:-1] + path[1:]) / 2
        axes.quiver(*middle.T, *_unit(runs).T, angles="xy", scale=38, width=0.006, pivot="mid", color="black")
    if result.target.paths:
        axes.legend(loc="lower right", bbox_to_anchor=(1, 1), ncol=2, fontsize=8, frameon=False)


def _unit(runs: np.ndarray) -> np.ndarray:
    """Vectors [n, 2] of length 1; NaN where there is no direction."""
    length = np.hypot(*runs.T)[:, None]
    return np.where(length > 0, runs / np.where(length > 0, length, 1), np.nan)


def _outline(result: ShapeResult, tool: np.ndarray) -> np.ndarray:
    """The corners [4, 2] = x, y (m) of the tool at a pose x, y, cos, sin."""
    x, y, cos, sin = tool
    corners = np.array([(1, 1), (1, -1), (-1, -1), (-1, 1)]) / 2 * result.target.footprint
    return np.stack([x + corners @ [cos, -sin], y + corners @ [sin, cos]], 1)


def _extent(target: Target) -> tuple[float, float, float, float]:
    """The map's left, right, lower and upper edge (m)."""
    rows, columns = target.scene.grid.shape
    dx = float(target.scene.grid.spacing)
    return (0, columns * dx, 0, rows * dx)


def _span(*maps: np.ndarray) -> float:
    """The largest height of some maps."""
    return max(1e-6, *(float(np.nanmax(np.abs(m))) for m in maps))
