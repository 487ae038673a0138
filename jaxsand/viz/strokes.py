"""Figures of searches for strokes, by matplotlib."""

from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def strokes_figure(rows: list[dict[str, Any]], reached: float) -> "Figure":
    """How many runs reach an IoU of `reached`, and the l2 reduction (median, quartiles), against the simulator's calls."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(11, 4), layout="constrained")
    counts, curves = figure.subplots(1, 2)
    for k, method in enumerate(dict.fromkeys(row["method"] for row in rows)):
        mine, colour = [row for row in rows if row["method"] == method], f"C{k}"
        budgets = sorted({budget for row in mine for budget in row["budgets"]})
        share = [np.mean([at["iou"] >= reached for row in mine for at in row["at"] if at["budget"] == b]) for b in budgets]
        counts.plot(budgets, share, "o-", ms=4, color=colour, label=method)
        calls = np.geomspace(min(50, budgets[-1]), budgets[-1], 100)
        ends = np.array([_held(row["curve"], calls, max(row["budgets"])) for row in mine])
        some = np.isfinite(ends).any(0)
        low, middle, high = np.nanquantile(ends[:, some], [0.25, 0.5, 0.75], axis=0)
        curves.plot(calls[some], middle, color=colour, label=method)
        curves.fill_between(calls[some], low, high, color=colour, alpha=0.15, lw=0)
    counts.set(xscale="log", xlabel="calls of the simulator", ylim=(-0.03, 1.03))
    counts.set_title(f"share of runs with an IoU of {reached:g}", loc="left")
    curves.set(xscale="log", xlabel="calls of the simulator", ylim=(-0.3, 1.03))
    curves.set_title("l2 reduction, median and quartiles", loc="left")
    counts.legend(frameon=False, fontsize=8)
    return figure


def found_figure(shown: list[tuple[str, float, np.ndarray, np.ndarray]], columns: int = 13) -> "Figure":
    """Goals, and below each what strokes made of it, as heights (mm) over the sand before.

    `shown` lists the name, the IoU, the goal and the result [H, W] (m) of each.
    """
    from matplotlib.figure import Figure

    columns = min(columns, len(shown))
    lines = -(-len(shown) // columns)
    figure = Figure(figsize=(0.95 * columns + 1.2, 2.3 * lines + 0.2), layout="constrained")
    axes = figure.subplots(2 * lines, columns, squeeze=False)
    for ax in axes.flat:
        ax.set_axis_off()
    for k, (name, iou, goal, found) in enumerate(shown):
        top, below = axes[2 * (k // columns) : 2 * (k // columns) + 2, k % columns]
        for ax, height in ((top, goal), (below, found)):
            image = ax.imshow(1e3 * height, origin="lower", cmap="RdYlBu_r", vmin=-10, vmax=10)
        top.set_title(f"{name}  {iou:.2f}", fontsize=8, parse_math=False)
    figure.colorbar(image, ax=axes, label="height over the sand before (mm)", shrink=0.7, aspect=30)
    return figure


def _held(curve: list[list[float]], calls: np.ndarray, most: int) -> np.ndarray:
    """The best figure after each number of calls; NaN before the first call and beyond the budget."""
    known, figures = np.array(curve).T
    at = np.searchsorted(known, calls, side="right") - 1
    return np.where((at >= 0) & (calls <= most), figures[np.maximum(at, 0)], np.nan)
