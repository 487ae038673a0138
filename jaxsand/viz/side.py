"""The sand from the side: profiles along a tool's path and across it, with the tool's outline where it stands."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike
from scipy.ndimage import map_coordinates

from jaxsand.scene.scene import Scene
from jaxsand.scene.tools import Blade, Bucket, NoTool, Number, Tool, Wheel

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Maps = Mapping[str, ArrayLike]
_BEYOND = 6  # spacings that are drawn on both sides of a path
_LOOKS: tuple[dict[str, Any], ...] = (
    {"color": "0.55", "ls": "--", "lw": 1.2},
    {"color": "tab:brown", "lw": 2.0},
    {"color": "tab:green", "lw": 1.2},
)


def side_figure(scene: Scene, maps: Maps, path: ArrayLike, title: str = "") -> "Figure":
    """The sand along a path of the tool, and across its middle, each with the tool's outline.

    Args:
      scene: grid and tool.
      maps: height maps [H, W] (m) by name, such as before, after and goal; NaN is left out.
      path: the points [n, 2] = x, y (m) of the tool, at its own depth, or [n, 3] = x, y, z (m), z that of its lowest point.
      title: of the figure.

    Returns:
      A figure with heights in mm: on the left over the distance along the path, with the way of the tool's lowest point and
      its outline at both ends; on the right over the distance to the left of the path, at half its length.

    Raises:
      ValueError: for a path of another shape or of no length.

    Example:
      >>> import numpy as np
      >>> import jaxsand as js
      >>> from jaxsand.viz.side import side_figure
      >>> scene = js.make_scene((8, 16), 0.01, tool=js.Blade(width=0.04, thickness=0.015))
      >>> figure = side_figure(scene, {"before": np.zeros((8, 16))}, [[0.03, 0.04, -0.01], [0.13, 0.04, 0.0]])
      >>> [ax.get_xlabel() for ax in figure.axes]
      ['along the path (m)', 'to the left of the path (m)']
    """
    from matplotlib.figure import Figure

    path = _checked(path)
    figure = Figure(figsize=(10, 3.4), layout="constrained")
    along, across = figure.subplots(1, 2, sharey=True, width_ratios=[2, 1])
    draw_along(along, scene, maps, path)
    draw_across(across, scene, maps, path)
    along.set_ylabel("height (mm)")
    figure.legend(*along.get_legend_handles_labels(), loc="outside lower center", ncols=6, frameon=False)
    figure.suptitle(title, fontsize=11, parse_math=False)
    return figure


@dataclass(frozen=True)
class Side:
    """A line of `sides_figure`: its title, the scene, maps [H, W] (m) by name, and a path [n, 2] or [n, 3] (m)."""

    title: str
    scene: Scene
    maps: Maps
    path: ArrayLike


def sides_figure(shown: Sequence[Side]) -> "Figure":
    """As `side_figure`, a line for each of several."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(10, 2.6 * len(shown) + 0.4), layout="constrained")
    lines = figure.subplots(len(shown), 2, squeeze=False, sharey="row", width_ratios=[2, 1])
    for (along, across), side in zip(lines, shown, strict=True):
        draw_along(along, side.scene, side.maps, side.path)
        draw_across(across, side.scene, side.maps, side.path)
        along.set_title(side.title, loc="left", fontsize=10, parse_math=False)
        along.set_ylabel("height (mm)")
    figure.legend(*lines[0, 0].get_legend_handles_labels(), loc="outside lower center", ncols=6, frameon=False)
    return figure


def draw_along(axes: "Axes", scene: Scene, maps: Maps, path: ArrayLike) -> None:
    """Draws maps [H, W] (m) in mm over the distance (m) along a path [n, 2] or [n, 3] (m), with the tool at both ends.

    The sand is drawn a little beyond the ends too.
    """
    spacing = float(scene.grid.spacing)
    path = _checked(path)
    far, points = _walked(path, spacing / 2)
    beyond = np.arange(1, 2 * _BEYOND) * spacing / 2
    before, after = (points[a] + beyond[:, None] * _ahead(points[a] - points[b]) for a, b in ((0, 1), (-1, -2)))
    wide = np.concatenate([-beyond[::-1], far, far[-1] + beyond])
    _profiles(axes, scene, maps, wide, np.concatenate([before[::-1], points, after]))
    z = _bottom(scene.tool, path, far)
    if not isinstance(scene.tool, NoTool):
        axes.plot(far, 1e3 * z, ":", color="black", lw=1.0, label="the tool's bottom")
    for at in (0, -1):
        outline = outline_along(scene.tool)
        axes.fill(far[at] + outline[:, 0], 1e3 * (z[at] + outline[:, 1]), color="0.3", alpha=0.35 if at else 0.15, lw=0)
    axes.set(xlabel="along the path (m)")


def draw_across(axes: "Axes", scene: Scene, maps: Maps, path: ArrayLike, share: float = 0.5) -> None:
    """Draws the sand on a straight section across a path [n, 2] or [n, 3] (m), at a share of its length, and the tool there.

    Args:
      axes: what is drawn on: heights in mm over the distance to the left of the path (m).
      scene: grid and tool.
      maps: height maps [H, W] (m) by name.
      path: the points of the tool, as of `side_figure`.
      share: how far along the path the section lies, 0 at its start, 1 at its end.

    The section is as long on each side as the tool is wide, and 8 spacings at least.
    """
    spacing = float(scene.grid.spacing)
    path = _checked(path)
    far, points = _walked(path, spacing / 2)
    at = min(round(share * (len(far) - 1)), len(far) - 2)
    ahead = _ahead(points[at + 1] - points[at])
    outline = outline_across(scene.tool)
    reach = max(2 * float(np.abs(outline[:, 0]).max(initial=0)), 8 * spacing)
    left = np.arange(-reach, reach + spacing / 4, spacing / 2)
    _profiles(axes, scene, maps, left, points[at] + left[:, None] * np.array([-ahead[1], ahead[0]]))
    z = _bottom(scene.tool, path, far)[at]
    axes.fill(outline[:, 0], 1e3 * (z + outline[:, 1]), color="0.3", alpha=0.25, lw=0)
    axes.set(xlabel="to the left of the path (m)")
    axes.locator_params(axis="x", nbins=5)


def section(height: np.ndarray, spacing: float, points: np.ndarray) -> np.ndarray:
    """Heights [n] (m) of a map [H, W] (m) at points [n, 2] = x, y (m), interpolated between cells; NaN beyond the map."""
    rows, columns = height.shape
    x, y = (np.asarray(points, float) / spacing).T
    found = map_coordinates(np.asarray(height, float), [y - 0.5, x - 0.5], order=1, mode="nearest")
    return np.where((x >= 0) & (x <= columns) & (y >= 0) & (y <= rows), found, np.nan)


def outline_along(tool: Tool) -> np.ndarray:
    """The outline [n, 2] (m) of a tool from its side: how far ahead, and how far above its lowest point.

    Nothing, [0, 2], for tools whose shape is not known.
    """
    if isinstance(tool, Wheel):
        radius, turn = float(tool.radius), float(tool.slip_angle)
        if abs(math.sin(turn)) < 1e-9:
            angle = np.linspace(0, 2 * math.pi, 49)
            return radius * np.stack([np.sin(angle), 1 - np.cos(angle)], axis=1)
        half = radius * math.cos(turn) + float(tool.width) / 2 * abs(math.sin(turn))
        return _box(-half, half, 2 * radius)
    if isinstance(tool, Blade):
        half = _turned(float(tool.thickness) / 2, float(tool.width) / 2, tool.yaw)
        return _box(-half, half, float(tool.width) / 2)
    if isinstance(tool, Bucket):
        return _box(-float(tool.length), 0.0, float(tool.width) / 2)
    return np.zeros((0, 2))


def outline_across(tool: Tool) -> np.ndarray:
    """The outline [n, 2] (m) of a tool from behind: how far to the left, and how far above its lowest point.

    Nothing, [0, 2], for tools whose shape is not known.
    """
    if isinstance(tool, Wheel):
        radius, turn = float(tool.radius), float(tool.slip_angle)
        half = radius * abs(math.sin(turn)) + float(tool.width) / 2 * math.cos(turn)
        return _box(-half, half, 2 * radius)
    if isinstance(tool, Blade):
        half = _turned(float(tool.width) / 2, float(tool.thickness) / 2, tool.yaw)
        return _box(-half, half, float(tool.width) / 2)
    if isinstance(tool, Bucket):
        half = float(tool.width) / 2
        return _box(-half, half, half)
    return np.zeros((0, 2))


def _turned(this_way: float, other_way: float, yaw: Number | None) -> float:
    """Half of a rectangle's extent along one of its sides, once it is turned."""
    if yaw is None:
        return this_way
    return this_way * abs(math.cos(float(yaw))) + other_way * abs(math.sin(float(yaw)))


def _box(start: float, stop: float, tall: float) -> np.ndarray:
    return np.array([[start, 0.0], [stop, 0.0], [stop, tall], [start, tall]])


def _profiles(axes: "Axes", scene: Scene, maps: Maps, far: np.ndarray, points: np.ndarray) -> None:
    for k, (name, height) in enumerate(maps.items()):
        if np.shape(height) != scene.grid.shape:
            remedy = f"give a map of shape {list(scene.grid.shape)}"
            raise ValueError(f"maps[{name!r}]: got shape {list(np.shape(height))}; {remedy}")
        heights = section(np.asarray(height), float(scene.grid.spacing), points)
        axes.plot(far, 1e3 * heights, label=name, **_LOOKS[k % len(_LOOKS)])
    axes.margins(x=0.02)


def _walked(path: ArrayLike, step: float) -> tuple[np.ndarray, np.ndarray]:
    """Distances [k] (m) along a path, at its corners and about `step` apart, and the points [k, 2] (m) there."""
    path = _checked(path)
    legs = np.hypot(*np.diff(path[:, :2], axis=0).T)
    at = np.concatenate([[0], np.cumsum(legs)])
    far = np.union1d(np.linspace(0, at[-1], max(2, math.ceil(at[-1] / step) + 1)), at)
    return far, np.stack([np.interp(far, at, path[:, k]) for k in (0, 1)], axis=1)


def _bottom(tool: Tool, path: ArrayLike, far: np.ndarray) -> np.ndarray:
    """Heights [k] (m) of the tool's lowest point at distances [k] (m) along a path."""
    path = _checked(path)
    if isinstance(tool, Wheel) and tool.load is not None:
        raise ValueError("scene.tool: got a wheel under a load, which follows the ground; give one at its sinkage")
    if path.shape[1] == 2:
        own = float(tool.sinkage if isinstance(tool, Wheel) else getattr(tool, "depth", 0.0))
        return np.full(len(far), -own)
    at = np.concatenate([[0], np.cumsum(np.hypot(*np.diff(path[:, :2], axis=0).T))])
    return np.interp(far, at, path[:, 2])


def _ahead(run: np.ndarray) -> np.ndarray:
    """The direction [2] of a step `run` [2], as a vector of length 1; along x where the step is none."""
    length = np.hypot(*run)
    return run / length if length > 0 else np.array([1.0, 0.0])


def _checked(path: ArrayLike) -> np.ndarray:
    points = np.asarray(path, float)
    if not np.isfinite(points).all():
        raise ValueError("path: got a number that is not finite; give every point in metres")
    if points.ndim != 2 or len(points) < 2 or points.shape[1] not in (2, 3) or not np.ptp(points[:, :2], axis=0).any():
        raise ValueError(f"path: got shape {list(points.shape)}; give two points or more, [n, 2] or [n, 3], that lie apart")
    return points
