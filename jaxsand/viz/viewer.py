"""Sand in a browser: one HTML file with a lit surface to turn, play and cut, which needs neither a network nor a library.

The page (data/viewer.html) draws by WebGL 2; where that is missing, a lit picture from above. Heights travel as 16-bit
numbers, each map as its difference from the one before, deflated.
"""

import base64
import html
import json
import math
import zlib
from dataclasses import dataclass, replace
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np

from jaxsand.goals.writing import written
from jaxsand.planning.pipeline import ShapeResult
from jaxsand.scene.masked import gaps

_MOST_FRAMES = 100
_SECONDS = 8.0  # that a film takes at most
_NONE = -32768  # stands for a cell without sand, or free
_FIGURES = 65534  # of heights that are told apart
_CELLS = 2**24  # of all maps of a page together


@dataclass(frozen=True)
class Panel:
    """A map, or a film of maps, to be shown by `view`.

    Attributes:
      heights: a map [H, W] (m), or maps [F, H, W] in order; row 0 at y = 0, NaN where there is no sand.
      spacing: of the grid (m).
      title: what stands above it.
      goal: a map [H, W] (m) to compare with, NaN where it is free; or None.
      paths: points [n, 2] = x, y (m), or [n, 3] with heights, of each path that is drawn over the sand.
      poses: x, y (m), cos and sin of the tool's heading, and the height of its bottom (m), in each map [F, 5]; NaN while it
        is lifted. None shows no tool.
      footprint: the tool's extent along and across its heading (m).

    Example:
      >>> import numpy as np
      >>> import jaxsand as js
      >>> js.Panel(np.zeros((2, 16, 16)), 0.01, "level sand").frames.shape
      (2, 16, 16)
    """

    heights: np.ndarray
    spacing: float
    title: str = "sand"
    goal: np.ndarray | None = None
    paths: tuple[np.ndarray, ...] = ()
    poses: np.ndarray | None = None
    footprint: tuple[float, float] = (0.0, 0.0)

    def __post_init__(self) -> None:
        frames = self.frames
        if frames.ndim != 3 or not frames.size or frames.dtype.kind not in "fiub":
            raise ValueError(
                f"heights: got {frames.dtype} of shape {list(np.shape(self.heights))}; give a map [H, W] or maps [F, H, W], "
                "in metres"
            )
        if not (math.isfinite(self.spacing) and self.spacing > 0):
            raise ValueError(f"spacing: got {self.spacing}; give metres, above 0")
        if self.goal is not None and np.shape(self.goal) != frames.shape[1:]:
            raise ValueError(
                f"goal: got shape {list(np.shape(self.goal))}, the maps have {list(frames.shape[1:])}; make them equal"
            )
        if self.poses is not None and np.shape(self.poses) != (len(frames), 5):
            raise ValueError(f"poses: got shape {list(np.shape(self.poses))}; give {[len(frames), 5]}")
        for name, maps in (("heights", frames), ("goal", self.goal)):
            if maps is not None and np.isinf(np.asarray(maps, float)).any():
                raise ValueError(f"{name}: got cells that are infinite; give NaN where there is no sand")

    @property
    def frames(self) -> np.ndarray:
        """The maps [F, H, W] (m)."""
        maps = np.asarray(gaps(self.heights))
        return maps[None] if maps.ndim == 2 else maps


@dataclass(frozen=True)
class Page:
    """Panels side by side, as `view` makes them: a notebook shows them, `to_html` writes them.

    Attributes:
      panels: what it shows.
      title: of the page.

    Example:
      >>> import numpy as np
      >>> import jaxsand as js
      >>> js.view(np.zeros((16, 16)), spacing=0.01).html()[:15]
      '<!doctype html>'
    """

    panels: tuple[Panel, ...]
    title: str

    def html(self) -> str:
        """The page as text."""
        page = files("jaxsand").joinpath("data", "viewer.html").read_text(encoding="utf-8")
        shown = [_thinned(panel) for panel in self.panels]
        frames = max(len(panel.frames) for panel in shown)
        goals = [panel for panel in shown if panel.goal is not None]
        reach = max(panel.spacing * max(panel.frames.shape[1:]) for panel in shown)
        relief = max(_range(panel)[1] - _range(panel)[0] for panel in shown)
        data = {
            "title": self.title,
            "panels": [_packed(panel) for panel in shown],
            "span": max(_largest(panel.frames) for panel in shown),
            "difference": max((_largest(panel.frames[-1] - np.asarray(panel.goal)) for panel in goals), default=1.0),
            "stretch": max(1.0, min(10.0, round(2 * 0.12 * reach / relief) / 2)) if relief > 0 else 1.0,
            "rate": max(1.0, (frames - 1) / _SECONDS),
        }
        return page.replace("__DATA__", json.dumps(data, allow_nan=False).replace("<", "\\u003c"), 1)

    def to_html(self, path: str | Path) -> None:
        """Writes the page.

        Args:
          path: the file to write.

        Raises:
          ValueError: if it cannot be written; what was there stays.
        """
        page = self.html()
        with written(Path(path), "path") as beside:
            beside.write_text(page, encoding="utf-8")

    def _repr_html_(self) -> str:
        """The page in a frame of a notebook."""
        return (
            f'<iframe srcdoc="{html.escape(self.html(), quote=True)}" width="100%" height="760" style="border:0" '
            f'title="{html.escape(self.title, quote=True)}" loading="lazy"></iframe>'
        )


def view(*shown: "Panel | ShapeResult | np.ndarray", spacing: float | None = None, title: str | None = None) -> Page:
    """Shows sand as a lit surface in a browser: to be turned, played, coloured by height or by the difference from a goal,
    and cut along a line. Several are shown side by side, seen from the same place at the same time.

    Args:
      shown: maps [H, W] or films [F, H, W] (m), `Panel` for more than that, or what `film` returns.
      spacing: of the grid (m); for maps and films.
      title: of the page; by default that of the first.

    Returns:
      A page, which a notebook shows and `to_html(path)` writes as one file; films are thinned to 100 maps.

    Raises:
      ValueError: for nothing to show, for maps without `spacing`, and as of `Panel`.

    Example:
      >>> import numpy as np
      >>> import jaxsand as js
      >>> page = js.view(np.zeros((16, 16)), np.zeros((3, 16, 16)), spacing=0.01)
      >>> len(page.panels)
      2
    """
    if not shown:
        raise ValueError("shown: got nothing; give a map [H, W], a film [F, H, W], a Panel, or what js.film returns")
    panels = tuple(as_panel(one, spacing, f"map {k}" if len(shown) > 1 else "sand") for k, one in enumerate(shown, 1))
    if (cells := sum(min(len(one.frames), _MOST_FRAMES) * one.frames[0].size for one in panels)) > _CELLS:
        raise ValueError(f"shown: got {cells} cells in all maps together; give at most {_CELLS}, such as every second cell")
    return Page(panels, panels[0].title if title is None else title)


def as_panel(
    one: "Panel | ShapeResult | np.ndarray", spacing: float | None, title: str, goal: np.ndarray | None = None
) -> Panel:
    """The panel that shows it, with a title for a map that has none, and beside a goal if one is given."""
    if isinstance(one, Panel):
        return one if goal is None else replace(one, goal=goal)
    if not isinstance(one, ShapeResult):
        if spacing is None:
            raise ValueError("spacing: is missing; give the grid's, in metres")
        return Panel(np.asarray(gaps(one)), spacing, title, goal)
    target = one.target
    poses = np.concatenate([one.tools, one.bottoms[:, None]], axis=1)
    title = f"{target.name}: {one.steps} {'steps' if target.method == 'plan' else 'strokes'}, IoU {one.figures['iou']:.3f}"
    wanted = np.asarray(target.goal)
    return Panel(one.frames, float(target.scene.grid.spacing), title, wanted, target.paths, poses, target.footprint)


def _thinned(panel: Panel) -> Panel:
    """The panel with at most as many maps as are shown, the first and the last among them."""
    frames = panel.frames
    if len(frames) <= _MOST_FRAMES:
        return panel
    kept = np.unique(np.linspace(0, len(frames) - 1, _MOST_FRAMES).round().astype(int))
    poses = None if panel.poses is None else panel.poses[kept]
    return replace(panel, heights=frames[kept], poses=poses)


def _range(panel: Panel) -> tuple[float, float]:
    """The lowest and the highest of all heights (m), goal included."""
    maps = [panel.frames] if panel.goal is None else [panel.frames, np.asarray(panel.goal)]
    known = np.concatenate([np.asarray(some, float).ravel() for some in maps])
    known = known[np.isfinite(known)]
    return (float(known.min()), float(known.max())) if known.size else (0.0, 0.0)


def _largest(maps: np.ndarray) -> float:
    """The largest height, up or down (m), to which colours reach."""
    known = np.abs(maps[np.isfinite(maps)])
    return max(float(known.max(initial=0.0)), 1e-6)


def _packed(panel: Panel) -> dict[str, Any]:
    """What the page is told of a panel."""
    low, high = _range(panel)
    step = (high - low) / _FIGURES
    maps = panel.frames if panel.goal is None else np.concatenate([panel.frames, np.asarray(panel.goal)[None]])
    whole = np.where(np.isfinite(maps), np.round((np.nan_to_num(maps) - low) / (step or 1.0)) + _NONE + 1, _NONE)
    numbers = whole.astype(np.int16).view(np.uint16)
    numbers[1:] -= numbers[:-1].copy()
    parts = np.concatenate([(numbers & 255).ravel(), (numbers >> 8).ravel()]).astype(np.uint8)
    paths = [[[round(float(v), 6) for v in point] for point in path] for path in panel.paths]
    poses = None
    if panel.poses is not None:
        poses = [[round(float(v), 6) for v in pose] if np.isfinite(pose).all() else None for pose in panel.poses]
    return {
        "title": panel.title,
        "shape": list(maps.shape[1:]),
        "spacing": panel.spacing,
        "maps": len(maps),
        "has_goal": panel.goal is not None,
        "low": low,
        "step": step,
        "bottom": low - max(0.25 * (high - low), 0.02 * panel.spacing * max(maps.shape[1:])),
        "paths": paths,
        "poses": poses,
        "footprint": list(panel.footprint),
        "data": base64.b64encode(zlib.compress(parts.tobytes(), 9)).decode("ascii"),
    }
