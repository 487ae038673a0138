"""Goals of `jaxsand shape`, and the shortest strokes over their maps of blocks."""

import math
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from jaxsand.goals import metrics
from jaxsand.goals.goal import Goal, as_goal
from jaxsand.planning.binary import Cell, connected_pieces, plan
from jaxsand.planning.gradient import Optimised
from jaxsand.planning.learned.stages import Planned
from jaxsand.planning.search import SandPlan
from jaxsand.scene.scene import Scene, make_scene
from jaxsand.scene.tools import Blade

Kind = Literal["map", "glyph", "image", "heights", "drawing", "terrain"]


@dataclass(frozen=True)
class Layout:
    """How a binary map is laid out on sand, for the single stroke.

    A pushed trench is narrower than the blade, since its berms slide back over the edges: at half depth by about sqrt(depth
    width / tan(repose angle)). So trenches are shallow against a cell, and the blade is a little larger than a cell.

    Args:
      cell: grid cells to a side of a map cell.
      spacing: of the grid (m).
      depth: of the trench (m).
      oversize: the blade's side over the map cell's side.
      margin: grid cells of level sand around the map.
    """

    cell: int = 6
    spacing: float = 0.01
    depth: float = 0.003
    oversize: float = 1.15
    margin: int = 10

    @property
    def blade(self) -> Blade:
        """The square blade that digs one map cell at a time."""
        side = self.oversize * self.cell * self.spacing
        return Blade(side, side, self.depth)


@dataclass(frozen=True)
class Target:
    """A goal, and the strokes that are to make it.

    Attributes:
      name: of the goal, for titles and files.
      kind: what the goal was given as.
      method: what planned the strokes.
      scene: grid, sand and tool.
      goal: [H, W] (m), row 0 at y = 0, NaN where it is free.
      paths: points [n, 2] = x, y (m) of each path, or [n, 3] with the heights of the tool's bottom; the tool is lifted
        between paths.
      drawn: whether the goal was drawn without berms, so that only min(h, 0) is compared.
      depth: of a trench (m).
      optimal: whether the number of steps is proven to be the fewest; None where nothing was proven.
      lower_bound: no plan has fewer steps; None where nothing was proven.
      found: what a method that tries strokes on sand reported.
      weighted: the goal with its weights, if some cell that is not free costs more or less than another.
      missed: how many of the goal's dug cells the blade does not pass over, by a plan over blocks of cells; nothing is
        proven of such a plan.
    """

    name: str
    kind: Kind
    method: str
    scene: Scene
    goal: np.ndarray
    paths: tuple[np.ndarray, ...]
    drawn: bool
    depth: float
    optimal: bool | None = None  # whether the steps are proven fewest, and what is proven of them; plans only
    lower_bound: float | None = None
    found: SandPlan | Optimised | Planned | None = None  # what a search on real sand says of itself
    weighted: Goal | None = None
    missed: int = 0

    @property
    def wanted(self) -> Goal | np.ndarray:
        """The goal as methods are to seek it: with its weights, if it has any."""
        return self.goal if self.weighted is None else self.weighted

    @property
    def footprint(self) -> tuple[float, float]:
        """The blade's extent along and across its heading (m)."""
        tool = self.scene.tool
        return (float(tool.thickness), float(tool.width)) if isinstance(tool, Blade) else (0.0, 0.0)


def map_target(dig: np.ndarray, start: Cell | None, name: str, layout: Layout) -> Target:
    """The shortest single stroke over a binary map (row 0 on top), with a blade about as wide as a map cell."""
    found = plan(dig, start)
    rows, columns = dig.shape
    shape = (rows * layout.cell + 2 * layout.margin, columns * layout.cell + 2 * layout.margin)
    scene = make_scene(shape, layout.spacing, tool=layout.blade)
    goal = metrics.map_goal(dig, layout.cell, layout.margin, layout.depth)
    path = metrics.cell_centre(np.array(found.cells), rows, layout.cell, layout.margin, layout.spacing)
    path = np.concatenate([path, path[-1:]]) if len(path) == 1 else path
    return Target(name, "map", "plan", scene, goal, (path,), True, layout.depth, found.optimal, found.lower_bound)


def height_goal(goal: Goal | np.ndarray, kind: Kind, name: str, layout: Layout) -> Target:
    """A height map, or a `Goal`, as a goal that has no strokes yet; cells that are NaN are free."""
    shape = np.shape(goal.height if isinstance(goal, Goal) else goal)
    most = layout.spacing * max(1, *shape[:2])  # a blade for larger maps is cut to this one
    blade = replace(layout.blade, width=min(layout.blade.width, most), thickness=min(layout.blade.thickness, most))
    scene = make_scene((shape[0], shape[1]), layout.spacing, tool=blade)
    wanted = as_goal(scene, goal)
    height = np.asarray(wanted.height)
    alike = wanted.power == 2 and all(np.array_equal(weight, ~wanted.free) for weight in (wanted.above, wanted.below))
    return Target(
        name, kind, "plan", scene, height, (), not np.any(height > 0), layout.depth, weighted=None if alike else wanted
    )


def height_target(goal: np.ndarray, kind: Kind, name: str, layout: Layout) -> Target:
    """The shortest single stroke over each connected piece of a height map [H, W] (m) that is deeper than half the trench
    depth.

    The map is divided into blocks of about `layout.cell` grid cells a side, none wider than the blade, and a block is dug
    where its mean is deep enough. What is dug in the goal but not in its block's mean is left out: `missed` says how many
    cells are, and then nothing is proven.

    Raises:
      ValueError: for a goal that is not finite, smaller than a block, or nowhere deep enough.
    """
    if min(goal.shape) < layout.cell:
        raise ValueError(
            f"goal: got {list(goal.shape)} cells, fewer than the {layout.cell} of one step of the tool; give a finer goal"
        )
    metrics.finite(goal)
    target = height_goal(goal, kind, name, layout)
    counts = [max(round(n / layout.cell), math.ceil(n / (layout.cell * layout.oversize))) for n in target.goal.shape]
    blocks = metrics.resample(target.goal, (counts[0], counts[1]))
    dig = np.flipud(blocks < -layout.depth / 2 * (1 + 1e-9))
    if not dig.any():
        raise ValueError(
            f"goal: got no block of {layout.cell} x {layout.cell} cells below {-layout.depth / 2 * 1e3:.3g} mm, so there is "
            "nothing to dig; lower the goal, dig less deep, or use the methods that also heap: search or optimise"
        )
    height, width = (n / count * layout.spacing for n, count in zip(target.goal.shape, counts, strict=True))
    paths, optimal, lower = [], True, 0.0
    for piece in connected_pieces(dig):
        part = np.zeros_like(dig)
        part[tuple(np.array(sorted(piece)).T)] = True
        found = plan(part, seconds=10)
        rows, columns = np.array(found.cells, float).T
        path = np.stack([(columns + 0.5) * width, (counts[0] - rows - 0.5) * height], 1)
        paths.append(np.concatenate([path, path[-1:]]) if len(path) == 1 else path)
        optimal, lower = optimal and found.optimal, lower + found.lower_bound
    missed = int((np.asarray(metrics.dug(target.goal, layout.depth)) & ~_passed_over(dig, target.goal.shape, layout)).sum())
    if missed:
        return replace(target, paths=tuple(paths), missed=missed)
    return replace(target, paths=tuple(paths), optimal=optimal, lower_bound=lower)


def _passed_over(dig: np.ndarray, shape: tuple[int, ...], layout: Layout) -> np.ndarray:
    """Which grid cells [H, W] have their centre under the blade where it digs the blocks `dig` (row 0 on top)."""
    half = layout.oversize * layout.cell / 2 + 1e-9
    under = [
        np.abs((np.arange(cells) + 0.5)[:, None] - (np.arange(blocks) + 0.5) * cells / blocks) <= half
        for cells, blocks in zip(shape, dig.shape, strict=True)
    ]
    return np.einsum("ib,bc,jc->ij", under[0], np.flipud(dig), under[1]) > 0


def image_goal(picture: np.ndarray, layout: Layout, cells: int) -> np.ndarray:
    """A picture (0 to -1, row 0 at the bottom) as a height map [H, W] (m), at most `cells` cells a side and a margin."""
    scale = cells / max(picture.shape)
    shape = [max(1, round(n * scale)) for n in picture.shape]
    return np.pad(layout.depth * metrics.resample(picture, (shape[0], shape[1])), layout.margin)
