"""Pictures of searches for strokes; matplotlib only."""

from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def strokes_figure(rows: list[dict[str, Any]]) -> "Figure":
    """Against the simulator's calls: how many runs reach IoU 0.8, and the l2 reduction (median, and quartiles shaded)."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(11, 4), layout="constrained")
    counts, curves = figure.subplots(1, 2)
    for k, method in enumerate(dict.fromkeys(row["method"] for row in rows)):
        mine, colour = [row for row in rows if row["method"] == method], f"C{k}"
        budgets = mine[0]["budgets"]
        share = [np.mean([row["at"][i]["iou"] >= 0.8 for row in mine]) for i in range(len(budgets))]
        counts.plot(budgets, share, "o-", ms=4, color=colour, label=method)
        calls = np.geomspace(min(50, budgets[-1]), budgets[-1], 100)
        ends = np.array([_held(row["curve"], calls) for row in mine])
        low, middle, high = np.quantile(ends, [0.25, 0.5, 0.75], axis=0)
        curves.plot(calls, middle, color=colour, label=method)
        curves.fill_between(calls, low, high, color=colour, alpha=0.15, lw=0)
    counts.set(xscale="log", xlabel="calls of the simulator", ylim=(-0.03, 1.03))
    counts.set_title("share of runs with an IoU of 0.8", loc="left")
    curves.set(xscale="log", xlabel="calls of the simulator", ylim=(-0.3, 1.03))
    curves.set_title("l2 reduction, median and quartiles", loc="left")
    counts.legend(frameon=False, fontsize=8)
    return figure


def _held(curve: list[list[float]], calls: np.ndarray) -> np.ndarray:
    """The best figure after so many calls; none before the first."""
    known, figures = np.array(curve).T
    at = np.searchsorted(known, calls, side="right") - 1
    return np.where(at >= 0, figures[np.maximum(at, 0)], np.nan)
