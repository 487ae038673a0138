"""A figure of sand: heights, light and shade, a cut through the middle, and how far a goal is."""

from typing import TYPE_CHECKING, Any

import numpy as np

from jaxsand.planning.pipeline import ShapeResult
from jaxsand.viz.render import ERRORS, HEIGHTS, lit, shape_figure
from jaxsand.viz.viewer import Panel, as_panel

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


def plot(
    shown: "Panel | ShapeResult | np.ndarray", *, spacing: float | None = None, goal: np.ndarray | None = None
) -> "Figure":
    """Draws a map: its heights, the sand in slanting light, and a cut along the row in the middle; with a goal also the
    difference from it.

    Of what `film` returns it draws goal, result with the paths, difference and sand, as `jaxsand shape` does.

    Args:
      shown: a map [H, W] (m), of maps [F, H, W] the last, a `Panel`, or what `film` returns.
      spacing: of the grid (m); for maps.
      goal: a map [H, W] (m) to compare a map with, NaN where it is free.

    Returns:
      A matplotlib figure, which a notebook shows and `savefig("sand.pdf")` writes, `.svg` and `.png` too. It needs no
      pyplot, and closes itself.

    Raises:
      ValueError: for maps without `spacing`, and as of `Panel`.

    Example:
      >>> import numpy as np
      >>> import jaxsand as js
      >>> figure = js.plot(np.zeros((16, 16)), spacing=0.01)
      >>> [axes.get_title(loc="left") for axes in figure.axes[:2]]
      ['height', 'lit from the north-west']
    """
    from matplotlib.figure import Figure

    if isinstance(shown, ShapeResult):
        return shape_figure(shown)
    panel = as_panel(shown, spacing, "sand", goal)
    height, dx = np.asarray(panel.frames[-1], float), panel.spacing
    wanted = None if panel.goal is None else np.asarray(panel.goal, float)
    rows, columns = height.shape
    figure = Figure(figsize=(11 if wanted is None else 15, 7.5), layout="constrained")
    pictures = ["height", "light"] if wanted is None else ["height", "light", "difference"]
    mosaic: list[Any] = [pictures, ["cut"] * len(pictures)]
    axes = figure.subplot_mosaic(mosaic, height_ratios=(2, 1))
    extent = (0.0, columns * dx, 0.0, rows * dx)
    _picture(axes["height"], height, extent, "height", HEIGHTS)
    axes["light"].imshow(lit(height, dx), origin="lower", extent=extent)
    axes["light"].set_title("lit from the north-west", loc="left")
    if wanted is not None:
        _picture(axes["difference"], height - wanted, extent, "height - goal", ERRORS)
    for name in pictures:
        axes[name].set(xlabel="x (m)", ylabel="y (m)", aspect="equal")
    _cut(axes["cut"], height, wanted, dx)
    if panel.title != "sand":
        figure.suptitle(panel.title, parse_math=False)
    return figure


def _picture(axes: "Axes", values: np.ndarray, extent: tuple[float, float, float, float], title: str, colours: str) -> None:
    """Heights (m) as colours in mm, with their bar."""
    known = np.abs(values[np.isfinite(values)])
    top = max(1e3 * float(known.max(initial=0.0)), 1e-3)
    image = axes.imshow(1e3 * values, origin="lower", extent=extent, cmap=colours, vmin=-top, vmax=top)
    axes.set_title(title, loc="left")
    axes.figure.colorbar(image, ax=axes, label="mm", shrink=0.8)


def _cut(axes: "Axes", height: np.ndarray, goal: np.ndarray | None, dx: float) -> None:
    """Heights along the row in the middle."""
    row = height.shape[0] // 2
    x = (np.arange(height.shape[1]) + 0.5) * dx
    axes.plot(x, 1e3 * height[row], label="sand")
    if goal is not None:
        axes.plot(x, 1e3 * goal[row], "--", label="goal")
        axes.legend(frameon=False)
    axes.set_title(f"along y = {(row + 0.5) * dx:.3g} m", loc="left")
    axes.set(xlabel="x (m)", ylabel="height (mm)")
    axes.grid(alpha=0.3)
