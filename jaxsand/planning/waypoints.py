"""Plans as waypoints that a robot, or another simulator, can replay."""

import csv
import json
import math
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path

import numpy as np

from jaxsand.goals.writing import written
from jaxsand.scene.scene import Scene
from jaxsand.scene.tools import Blade, Bucket

FIELDS = ("x", "y", "z", "lifted")


def waypoints(scene: Scene, paths: Sequence[np.ndarray], clear: float) -> np.ndarray:
    """The places [n, 4] = x, y, z (m), lifted (0 or 1) of the middle of the tool's bottom, in order, for paths one by one.

    Before and after each path there is a point straight above its end, at the height `clear`, which is lifted; so the way
    from one path to the next leads through the air.

    Args:
        scene: the scene, with a blade or a bucket, whose depth is that of paths without heights.
        paths: points [k, 2] = x, y or [k, 3] = x, y, z (m) of each path, such as `plan_sand(...).paths`.
        clear: a height (m) at which the tool touches no sand.

    Raises:
        ValueError: for a tool without a depth where a path has no heights, or a height above `clear`.

    Example:
        >>> import numpy as np
        >>> import jaxsand as js
        >>> from jaxsand.planning.waypoints import waypoints
        >>> scene = js.make_scene((8, 8), 0.01, tool=js.Blade(depth=0.005))
        >>> waypoints(scene, [np.array([[0.02, 0.04], [0.06, 0.04]])], clear=0.05)[:, 2:].tolist()
        [[0.05, 1.0], [-0.005, 0.0], [-0.005, 0.0], [0.05, 1.0]]
    """
    found = []
    for path in paths:
        points = np.asarray(path, float)
        if points.ndim != 2 or points.shape[1] not in (2, 3) or not len(points) or not np.all(np.isfinite(points)):
            raise ValueError(
                f"paths: got one of shape {list(points.shape)}; give finite points [k, 2] or [k, 3] (m) of each"
            )
        if points.shape[1] == 2:
            if not isinstance(scene.tool, Blade | Bucket):
                raise ValueError(
                    f"scene.tool: got {type(scene.tool).__name__}, which has no depth; give paths [n, 3] = x, y, z"
                )
            points = np.column_stack([points, np.full(len(points), -float(scene.tool.depth))])
        if not points[:, 2].max() <= clear < np.inf:
            raise ValueError(
                f"clear: got {clear}; give a height of at least {points[:, 2].max():.6g}, the highest of a path"
            )
        above = [[*points[end, :2], clear, 1.0] for end in (0, -1)]
        found += [above[0], *np.column_stack([points, np.zeros(len(points))]).tolist(), above[1]]
    return np.array(found).reshape(-1, len(FIELDS))


def in_steps(places: np.ndarray, longest: float | Sequence[float]) -> np.ndarray:
    """Waypoints with others put in between, such that no step from one to the next is longer than a robot can make.

    Each leg is cut into the fewest equal steps that are short enough; where it goes up or down to or from a lifted point,
    the points in between are not lifted, as they may be in the sand. The way through the air and the way down are steps
    like all others, so that the number of steps is `len(in_steps(places, longest)) - 1`.

    Args:
        places: waypoints [n, 4] = x, y, z (m), lifted, such as `waypoints` makes; a first row may say where the tool is.
        longest: the longest step (m): one number, of the way, or three, along x, y and z each.

    Returns:
        Waypoints [m, 4], m >= n.

    Raises:
        ValueError: for places of another shape, or lengths that are not above 0.

    Example:
        >>> import numpy as np
        >>> from jaxsand.planning.waypoints import in_steps
        >>> in_steps(np.array([[0, 0, 0.05, 1], [0, 0, 0, 0], [0.05, 0, 0, 0]]), longest=0.04)[:, :3].tolist()
        [[0.0, 0.0, 0.05], [0.0, 0.0, 0.025], [0.0, 0.0, 0.0], [0.025, 0.0, 0.0], [0.05, 0.0, 0.0]]
    """
    places, most = np.asarray(places, float), np.asarray(longest, float)
    if places.ndim != 2 or places.shape[1] != len(FIELDS) or not np.all(np.isfinite(places)):
        raise ValueError(f"places: got shape {list(places.shape)}; give finite waypoints [n, 4] = x, y, z, lifted")
    if most.shape not in ((), (3,)) or not np.all(most > 0):
        raise ValueError(f"longest: got {longest!r}; give a length (m) above 0, or three, along x, y and z")
    found = [places[:1]]
    for a, b in pairwise(places):
        way = np.abs(b[:3] - a[:3])
        steps = max(1, math.ceil((np.linalg.norm(way) / most if most.ndim == 0 else way / most).max() - 1e-9))
        leg = a + np.arange(1, steps + 1)[:, None] / steps * (b - a)
        leg[:, 3] = min(a[3], b[3])
        leg[-1] = b
        found.append(leg)
    return np.concatenate(found)


def write_waypoints(file: Path | str, places: np.ndarray) -> None:
    """Writes waypoints [n, 4] as .csv, with a line of names first, or as .json, a list of objects; lengths are in metres.

    Raises:
        ValueError: for another kind of file, or one that cannot be written; what was there stays.
    """
    file = Path(file)
    rows = [[*map(float, place[:3]), bool(place[3])] for place in places]
    if file.suffix not in (".csv", ".json"):
        raise ValueError(f"file: got {str(file)!r}; give a name that ends in .csv or .json")
    with written(file, "file") as beside, beside.open("w", newline="", encoding="utf-8") as out:
        if file.suffix == ".json":
            out.write(json.dumps([dict(zip(FIELDS, row, strict=True)) for row in rows], indent=1) + "\n")
        else:
            csv.writer(out).writerows([FIELDS, *([*row[:3], int(row[3])] for row in rows)])
