"""Pieces of earth that were shaped: the goal, what came of it, and a section through both."""

import math
from typing import TYPE_CHECKING

import numpy as np

from jaxsand.goals.tasks import Task

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_HEIGHTS = "RdYlBu_r"
_PER_ROW = 2  # tasks
_SECTION = ({"color": "0.6", "ls": "--", "lw": 1.0}, {"color": "tab:green", "lw": 1.4}, {"color": "tab:brown", "lw": 1.8})


def gallery_figure(shown: list[tuple[str, Task, np.ndarray]]) -> "Figure":
    """Of each task its goal, what was left, and a section along x through the middle of what was to be shaped.

    Free cells of a goal are grey. Heights are in mm, red above 0 and blue below, alike for a goal and its result.

    Args:
      shown: of each task a title, the task, and the map [H, W] (m) that was left of it.

    Example:
      >>> import jaxsand as js
      >>> from jaxsand.viz.gallery import gallery_figure
      >>> task = js.tasks.make_task("ring", key=0)
      >>> len(gallery_figure([("nothing done", task, task.start)]).axes)
      3
    """
    from matplotlib.figure import Figure

    rows = math.ceil(len(shown) / _PER_ROW)
    figure = Figure(figsize=(7.5 * _PER_ROW, 2.3 * rows), layout="constrained")
    parts = np.atleast_2d(figure.subfigures(rows, _PER_ROW, squeeze=False)).ravel()
    for part, (title, task, after) in zip(parts, shown, strict=False):
        part.suptitle(title, x=0.01, ha="left", fontsize=10, parse_math=False)
        axes = part.subplots(1, 3, width_ratios=[1, 1, 1.2])
        spacing = float(task.scene.grid.spacing)
        goal = 1e3 * np.where(task.goal.free, np.nan, np.asarray(task.goal.height))
        before, left = 1e3 * task.start, 1e3 * after
        top = max(1e-6, float(np.nanmax(abs(goal))), float(abs(before).max()))
        across = task.scene.grid.shape[1] * spacing, task.scene.grid.shape[0] * spacing
        for panel, values, name in ((axes[0], goal, "goal"), (axes[1], left, "result")):
            panel.set_facecolor("0.8")
            panel.imshow(values, origin="lower", extent=(0, across[0], 0, across[1]), cmap=_HEIGHTS, vmin=-top, vmax=top)
            panel.set_title(name, fontsize=8, loc="left")
            panel.tick_params(labelsize=6)
        row = round(float(np.argwhere(task.cells)[:, 0].mean()))
        x = (np.arange(goal.shape[1]) + 0.5) * spacing
        for values, name, look in zip((before, goal, left), ("before", "goal", "result"), _SECTION, strict=True):
            axes[2].plot(x, values[row], label=name, **look)
        axes[2].set_title(f"heights (mm) along y = {(row + 0.5) * spacing:.3g} m", fontsize=8, loc="left")
        axes[2].tick_params(labelsize=6)
        axes[2].legend(fontsize=6, frameon=False)
    return figure
