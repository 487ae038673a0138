"""Goals as drawings: shapes in metres in a small JSON form, one over the other, drawn on a scene's grid."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from scipy.ndimage import distance_transform_edt

from jaxsand.goals.fields import LENGTH, METRES, Flag, Object, Pair, Several, WholeNumber, read_object
from jaxsand.goals.goal import Goal, as_goal
from jaxsand.goals.shapes import WEIGHT, OneShape, Shape
from jaxsand.goals.surfaces import rested
from jaxsand.goals.untrusted import read_json
from jaxsand.scene.grid import Grid
from jaxsand.scene.scene import Scene, check_scene

_SHAPES = 1000
_SIDE = 1024  # cells
_MOVED = 0.01  # spacings: what rest moves by less is as it was drawn


@dataclass(frozen=True, kw_only=True)
class Outside:
    """What is wanted where nothing is drawn: a height (m), and the weights of sand above and below it."""

    height: Annotated[float, METRES] = 0.0
    above: Annotated[float, WEIGHT] = 1.0
    below: Annotated[float, WEIGHT] = 1.0


@dataclass(frozen=True, kw_only=True)
class Sheet:
    """The grid that a drawing is meant for: its cells [rows, columns], and their spacing (m)."""

    shape: Annotated[
        tuple[int, int],
        Pair("the numbers of [rows, columns]", WholeNumber(f"a whole number of cells from 1 to {_SIDE}", 1, _SIDE)),
    ]
    spacing: Annotated[float, LENGTH]


SHEET = Object('{"shape": [rows, columns], "spacing": metres}', Sheet)
"""A drawing's grid, as JSON has it."""

_LEVEL = Outside()
_OUTSIDE = Object(
    '"free", "heaps" (heaps may lie, holes may not) or {"height": metres, "above": weight, "below": weight}',
    Outside,
    {"free": Outside(above=0.0, below=0.0), "heaps": Outside(above=0.0)},
)


@dataclass(frozen=True, kw_only=True)
class Drawing:
    """Shapes, each drawn over those before it, and the ground around them.

    Attributes:
      shapes: in the order in which they are drawn.
      outside: what is wanted where nothing is drawn.
      repose: whether the drawn surface is brought to rest.
      grid: that it is meant for; None for any.
    """

    shapes: Annotated[tuple[Shape, ...], Several("a list of shapes", OneShape(), 1, _SHAPES)]
    outside: Annotated[Outside, _OUTSIDE] = _LEVEL
    repose: Annotated[bool, Flag()] = False
    grid: Annotated[Sheet | None, SHEET] = None

    def on(self, scene: Scene) -> Goal:
        """The drawing as a goal on a scene's grid; see `read_drawing`."""
        check_scene(scene)
        grid = Grid(float(scene.grid.spacing), scene.grid.shape)
        self._check_size(grid)
        around = self.outside
        height, above, below = (np.full(grid.shape, v) for v in (around.height, around.above, around.below))
        drawn = np.zeros(grid.shape, bool)
        for number, shape in enumerate(self.shapes):
            cells = shape.covers(grid)
            if not cells.any():
                raise ValueError(
                    f"shapes[{number}]: covers no cell's centre on a map of {_size(grid)} with cells of {grid.spacing:g} m; "
                    "move it onto the map, make it larger or the cells smaller, or leave it out"
                )
            height[cells] = shape.over(height, grid)[cells]
            above[cells], below[cells] = shape.weights
            drawn |= cells
        if self.repose:
            still = rested(scene, height)
            moved = abs(still - height) > _MOVED * grid.spacing
            row, column = distance_transform_edt(~drawn, return_distances=False, return_indices=True)
            above, below = (np.where(moved, weight[row, column], weight) for weight in (above, below))
            height = still
        return as_goal(scene, Goal(height, above, below), "drawing")

    def _check_size(self, grid: Grid) -> None:
        """ValueError if the drawing is meant for a map of another size (m), to half a cell."""
        if self.grid is None:
            return
        meant = Grid(self.grid.spacing, self.grid.shape)
        most = max(self.grid.spacing, float(grid.spacing)) / 2
        apart = np.array(meant.shape) * self.grid.spacing - np.array(grid.shape) * float(grid.spacing)
        if np.any(abs(apart) > most):
            raise ValueError(
                f"grid: is for a map of {_size(meant)}, the scene has {_size(grid)}; make them equal, or leave grid out"
            )


def read_drawing(drawing: dict[str, Any] | str | Path, scene: Scene) -> Goal:
    """The goal that a drawing stands for on a scene's grid.

    A drawing is a list of shapes, each over those before it, on ground that is level at 0 unless it says otherwise:

        {"shapes": [{"kind": "disc", "centre": [0.08, 0.08], "radius": 0.05, "height": -0.01}, ...],
         "outside": "heaps", "repose": true, "grid": {"shape": [16, 16], "spacing": 0.01}}

    The kinds of shapes are rectangle, polygon, disc, path, text and ramp; the guide to goals lists their fields. A cell
    belongs to a shape if its centre does, and a shape may reach beyond the map. `outside` is a height and weights, "free",
    or "heaps", where heaps may lie but holes may not. With `repose` the drawn surface is brought to rest, as steep as the
    scene's sand can keep; cells around the shapes that this moves by more than a hundredth of a spacing count as the
    nearest cell of a shape does.

    Args:
        drawing: what JSON holds, or the path of a file of it. Metres, weights, and degrees in names that end in `_deg`.
        scene: grid and sand. Where the drawing says for which grid it is, the scene's may be finer or coarser, but has to be
            as large.

    Returns:
        A `Goal` whose maps [H, W] are numpy's; NaN where any height will do.

    Raises:
        ValueError: names the field, such as `shapes[2].points`, the value and the remedy, for an unknown, missing or wrong
            field, a shape that covers no cell, and where every cell is free.
        OutcomeError: if the sand does not come to rest.

    Example:
        >>> import jaxsand as js
        >>> scene = js.make_scene((4, 6), 0.01)
        >>> pit = {"kind": "rectangle", "centre": [0.03, 0.02], "size": [0.04, 0.02], "height": -0.01}
        >>> goal = js.read_drawing({"shapes": [pit], "outside": "heaps"}, scene)
        >>> goal.height[1].tolist(), goal.above[1].tolist()
        ([0.0, -0.01, -0.01, -0.01, -0.01, 0.0], [0.0, 1.0, 1.0, 1.0, 1.0, 0.0])
        >>> js.read_drawing({"shapes": [{"kind": "disc", "centre": [0.03, 0.02], "radius": -1, "height": 0}]}, scene)
        Traceback (most recent call last):
            ...
        ValueError: shapes[0].radius: got -1; give a length in metres, above 0 and at most 10000
    """
    return as_drawing(drawing).on(scene)


def as_drawing(drawing: dict[str, Any] | str | Path) -> Drawing:
    """A drawing from what JSON holds, or from a file of it.

    Raises:
      ValueError: names the field, the value and the remedy.
    """
    return read_object(Drawing, "", _loaded(Path(drawing)) if isinstance(drawing, str | Path) else drawing)


def _loaded(path: Path) -> Any:
    """What a JSON file holds."""
    try:
        return read_json(path)
    except ValueError as error:
        raise ValueError(f'{path}: cannot be read as a drawing ({error}); give JSON, {{"shapes": [...]}}') from None


def _size(grid: Grid) -> str:
    """The width and the height of a map."""
    return " x ".join(f"{n * float(grid.spacing):g}" for n in grid.shape[::-1]) + " m"
