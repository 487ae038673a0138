"""Pieces of earth that were shaped: before, the goal, what came of it, and a section through all three."""

import math
from typing import TYPE_CHECKING, Any

import numpy as np

from jaxsand.goals.tasks import Task

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_SAND = ("#123a5c", "#3f86b0", "#a9cbd6", "#f3ead6", "#dcb27a", "#a8652a", "#5a2f0c")  # from pits to heaps
_FREE = "#d0d0d0"
_PER_ROW = 2  # tasks
_SECTION: tuple[tuple[str, dict[str, Any]], ...] = (
    ("before", {"color": "0.6", "ls": "--", "lw": 1.0}),
    ("goal", {"color": "#2a9d55", "lw": 2.6, "alpha": 0.55}),
    ("result", {"color": "#7a3b0c", "lw": 1.3}),
)


def gallery_figure(shown: list[tuple[str, Task, np.ndarray]]) -> "Figure":
    """Of each task what lay there before, its goal, what was left, and a section through the middle.

    Pits are blue, heaps brown, and sand at height 0 is light, alike for the three maps of a task, in mm; free cells of a
    goal are grey. The line across the maps is where the section lies.

    Args:
      shown: of each task a title, the task, and the map [H, W] (m) that was left of it.

    Example:
      >>> import jaxsand as js
      >>> from jaxsand.viz.gallery import gallery_figure
      >>> task = js.tasks.make_task("ring", key=0)
      >>> len(gallery_figure([("nothing done", task, task.start)]).axes)
      5
    """
    from matplotlib.figure import Figure

    rows = math.ceil(len(shown) / _PER_ROW)
    figure = Figure(figsize=(8.4 * _PER_ROW, 2.15 * rows), layout="constrained")
    parts = np.atleast_2d(figure.subfigures(rows, _PER_ROW, squeeze=False, wspace=0.02)).ravel()
    for part, (title, task, after) in zip(parts, shown, strict=False):
        part.suptitle(title, x=0.012, ha="left", fontsize=11, weight="bold", parse_math=False)
        panels = part.subplots(1, 4, width_ratios=[1, 1, 1, 1.35])
        maps = (task.start, np.where(task.goal.free, np.nan, np.asarray(task.goal.height)), after)
        _maps(panels[:3], task, maps)
        _section(panels[3], task, maps)
    return figure


def _maps(panels: np.ndarray, task: Task, maps: tuple[np.ndarray, ...]) -> None:
    """Draws the three maps [H, W] (m) of a task, with one scale of colours beside them."""
    from matplotlib.colors import LinearSegmentedColormap

    colours = LinearSegmentedColormap.from_list("sand", _SAND)
    high, wide = (n * float(task.scene.grid.spacing) for n in task.scene.grid.shape)
    top = max(1e-3, *(1e3 * float(np.nanmax(abs(m[~np.isnan(m)]), initial=0.0)) for m in maps[:2]))
    along_x, k = _line(task)
    at = (k + 0.5) * float(task.scene.grid.spacing)
    for panel, values, (name, _) in zip(panels, maps, _SECTION, strict=True):
        panel.set_facecolor(_FREE)
        image = panel.imshow(
            1e3 * values,
            origin="lower",
            extent=(0, wide, 0, high),
            cmap=colours,
            vmin=-top,
            vmax=top,
            interpolation="nearest",
        )
        (panel.axhline if along_x else panel.axvline)(at, color="k", lw=0.6, ls=":")
        panel.set_title(name, fontsize=9, loc="left")
        panel.set_xticks([])
        panel.set_yticks([])
    bar = panels[2].figure.colorbar(image, ax=list(panels), shrink=0.75, aspect=18, pad=0.01)
    bar.ax.tick_params(labelsize=7)
    bar.outline.set_visible(False)


def _section(panel: "Axes", task: Task, maps: tuple[np.ndarray, ...]) -> None:
    """Draws the heights (mm) of the three maps along the line of the section."""
    along_x, k = _line(task)
    spacing = float(task.scene.grid.spacing)
    for values, (name, look) in zip(maps, _SECTION, strict=True):
        line = 1e3 * (values[k] if along_x else values[:, k])
        panel.plot((np.arange(len(line)) + 0.5) * spacing, line, label=name, **look)
    panel.set_title(f"mm along {'x' if along_x else 'y'} (m)", fontsize=9, loc="left")
    panel.tick_params(labelsize=7)
    panel.legend(fontsize=7, frameon=False, handlelength=1.4)
    panel.spines[["top", "right"]].set_visible(False)


def _line(task: Task) -> tuple[bool, int]:
    """Whether the section runs along x, and in which row or column: through the middle, whichever crosses more to shape."""
    asked = np.where(task.cells, np.nan_to_num(np.asarray(task.goal.height) - task.start), 0.0) ** 2
    row, column = (round(float(k)) for k in np.argwhere(task.cells).mean(0))
    along_x = bool(asked[row].sum() >= asked[:, column].sum())
    return along_x, row if along_x else column
