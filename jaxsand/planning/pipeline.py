"""From strokes to the sand that they leave, and figures of how near that comes to the goal."""

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache, partial
from importlib import import_module
from itertools import pairwise
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxsand.goals import metrics
from jaxsand.goals.goal import Goal, as_goal
from jaxsand.goals.surfaces import rested
from jaxsand.interaction.outcome import check
from jaxsand.interaction.simulate import Shaped, follow_frames
from jaxsand.interaction.stepped import SteppedPush
from jaxsand.planning.targets import Target
from jaxsand.relaxation.settling import steepest_slope
from jaxsand.scene.progress import Tell, quiet
from jaxsand.scene.scene import Scene, blade_of, make_scene
from jaxsand.scene.tools import Blade
from jaxsand.scene.window import Whole

_PARTS = 6  # of a single stroke, in its recording
_KEPT = 2**28  # bytes of a recording's maps: more legs than that are recorded less often


@dataclass(frozen=True)
class ShapeResult:
    """What pushing a target's strokes made of the sand.

    Attributes:
      target: the goal and the strokes.
      before: the map [H, W] (m) before, at rest.
      after: the map [H, W] (m) after all strokes.
      frames: maps [F, H, W] (m) on the way, for an animation.
      tools: [F, 4] x, y (m), cos and sin of the tool's heading in each frame; NaN while it is lifted.
      bottoms: [F] height of the tool's bottom (m) in each frame; NaN while it is lifted.
      figures: iou, l2_reduction (by the goal's weights, if it has any), l2_reduction_with_berms (all cells alike),
        volume_error and max_slope_deg.
      seconds: run times of `prepare`, `compile` and `run`.

    Example:
      >>> import numpy as np
      >>> import jaxsand as js
      >>> scene = js.make_scene((8, 8), 0.01, tool=js.Blade())
      >>> result = js.film(scene, None, np.zeros((8, 8)), [np.array([[0.02, 0.04], [0.06, 0.04]])])
      >>> len(result.frames) == len(result.tools)
      True
    """

    target: Target
    before: np.ndarray
    after: np.ndarray
    frames: np.ndarray
    tools: np.ndarray  # x, y, cos, sin of the tool in each frame; NaN while it is lifted
    bottoms: np.ndarray
    figures: dict[str, float]
    seconds: dict[str, float]

    @property
    def lifted(self) -> bool:
        """Whether the tool is lifted between paths."""
        return len(self.target.paths) > 1

    @property
    def steps(self) -> int:
        """The number of legs that have a length above 0."""
        return sum(int(np.any(np.diff(path[:, :2], axis=0), axis=1).sum()) for path in self.target.paths)

    @property
    def strokes(self) -> list[list[float]]:
        """Every leg as x0, y0, x1, y1 (m), in order, without its heights."""
        return [[float(v) for v in (*a[:2], *b[:2])] for p in self.target.paths for a, b in pairwise(p)]

    def to_html(self, path: str | Path) -> None:
        """Writes one HTML file in which a browser shows the sand being shaped (see `jaxsand.view`).

        Args:
          path: the file to write.
        """
        import_module("jaxsand").view(self).to_html(path)

    def _repr_html_(self) -> str:
        """What a notebook shows: the sand being shaped."""
        return str(import_module("jaxsand").view(self)._repr_html_())


def glyph_target(strokes: np.ndarray, name: str) -> Target:
    """A glyph's own strokes [n, 4] of the unit square, pushed one by one; the goal is what they leave on level sand.

    A glyph takes 32 x 32 cells of 0.01 m, and a wider text as many more columns as it needs.
    """
    blade, spacing = Blade(), 0.01
    placed = metrics.place(strokes)
    beyond = max(0.0, placed[:, [0, 2]].max() - metrics.GLYPH_SQUARE[1])
    scene = make_scene((32, 32 + math.ceil(beyond / spacing - 1e-6)), spacing, tool=blade)
    paths = tuple(stroke.reshape(2, 2) for stroke in placed)
    goal, (program, _) = np.zeros(scene.grid.shape, np.float32), _program(scene, _rounded(2), 2)
    for path in paths:
        shaped, _ = program(jnp.asarray(goal), _padded(_divided(path, spacing), _rounded(2)))
        check(shaped)
        goal = np.asarray(shaped.height)
    return Target(name, "glyph", "strokes", scene, goal, paths, False, float(blade.depth))


def shape(
    target: Target, before: np.ndarray | None = None, tell: Tell = quiet, see: Callable[[np.ndarray], None] = lambda _: None
) -> ShapeResult:
    """Pushes a target's strokes and measures the result.

    Args:
      target: the goal and the strokes.
      before: the surface [H, W] (m), which is settled first; None stands for level sand at 0.
      tell: is called with a line of progress.
      see: is called with the start, and with every map [H, W] (m) on the way, a path at a time.

    Raises:
      OutcomeError: if the sand does not come to rest, or something is not finite.
    """
    scene = target.scene
    began = time.perf_counter()
    start = at_rest(scene, before, tell)
    prepared = time.perf_counter()
    height, compile_seconds, run_seconds = start, 0.0, 0.0
    see(start)
    frames, tools, bottoms = [start], [_nowhere()], [math.nan]
    ways = [_divided(path, float(scene.grid.spacing)) for path in target.paths]
    longest = _rounded(max(map(len, ways), default=2))
    every = math.ceil(sum(map(len, ways)) * start.nbytes / _KEPT) or 1
    for number, way in enumerate(ways, 1):
        tell(f"pushing path {number} of {len(ways)}" if number > 1 else "compiling")
        program, compile_seconds = _program(scene, longest, way.shape[1])
        began_to_run = time.perf_counter()
        shaped, on_the_way = program(jnp.asarray(height), _padded(way, longest))
        check(shaped)
        run_seconds += time.perf_counter() - began_to_run
        maps, poses, heights = _moments(way, np.asarray(on_the_way), every, -target.depth)
        height = np.array(shaped.height)
        for one in (*maps, height):
            see(one)
        frames += [*maps, height]
        tools += [*poses, _nowhere()]
        bottoms += [*heights, math.nan]
    seconds = {"prepare": prepared - began, "compile": compile_seconds, "run": run_seconds}
    figures = _figures(target, start, height)
    return ShapeResult(target, start, height, np.stack(frames), np.stack(tools), np.array(bottoms), figures, seconds)


def film(
    scene: Scene,
    height: np.ndarray | None,
    goal: Goal | np.ndarray,
    paths: Sequence[np.ndarray],
    *,
    name: str = "sand",
    tell: Tell = quiet,
) -> ShapeResult:
    """Pushes paths one after the other, such as those of a `SandPlan`, and keeps the maps on the way.

    Args:
      scene: grid, sand and a `Blade`.
      height: the map [H, W] (m) to start from, which is settled first; None stands for level sand at 0.
      goal: a map [H, W] (m) to compare with, NaN where it is free, or a `Goal`.
      paths: points [n, 2] = x, y (m) of each path, or [n, 3] = x, y, z with the height of the tool's bottom; the tool is
        lifted between paths.
      name: for titles.
      tell: is called with a line of progress.

    Returns:
      A `ShapeResult` with the maps `before` and `after`, `frames` on the way, and `figures`. A notebook shows it;
      `to_html(path)` writes it as one file for a browser.

    Raises:
      ValueError: for a scene without a blade, maps of another shape, and paths that are no points.
      OutcomeError: if the sand does not come to rest.

    Example:
      >>> import numpy as np
      >>> import jaxsand as js
      >>> scene = js.make_scene((8, 8), 0.01, tool=js.Blade())
      >>> stroke = np.array([[0.02, 0.04], [0.06, 0.04]])
      >>> result = js.film(scene, None, np.zeros((8, 8)), [stroke])
      >>> result.steps, result.after.shape
      (1, (8, 8))
    """
    wanted, blade = as_goal(scene, goal), blade_of(scene)
    ways = tuple(np.asarray(path, np.float32) for path in paths)
    for k, way in enumerate(ways):
        if way.ndim != 2 or way.shape[1] not in (2, 3) or len(way) < 2 or not np.isfinite(way).all():
            raise ValueError(f"paths[{k}]: got shape {list(way.shape)}; give two points or more, of 2 or 3 finite numbers")
    drawn = not np.any(np.asarray(wanted.height) > 0)
    target = Target(name, "heights", "strokes", scene, np.asarray(wanted.height), ways, drawn, float(blade.depth))
    return shape(target, height, tell)


def at_rest(scene: Scene, before: np.ndarray | None, tell: Tell) -> np.ndarray:
    """A surface [H, W] (m) after it has settled; level sand at 0 for None."""
    if before is None:
        return np.zeros(scene.grid.shape, np.float32)
    metrics.fits(scene, before, "surface")
    tell("settling the surface")
    return rested(scene, np.asarray(before))


def _figures(target: Target, before: np.ndarray, after: np.ndarray) -> dict[str, float]:
    """The figures of a result by name; see `ShapeResult`."""

    def reduction(view: Callable[[np.ndarray], np.ndarray]) -> float:
        goal = view(np.where(np.isnan(target.goal), before, target.goal))
        seen = np.where(np.isnan(target.goal), before, after).astype(float)  # what is free has nothing to be gained
        return float(metrics.l2_reduction(goal, view(before.astype(float)), view(seen)))

    whole = alone = reduction(lambda h: h)
    if target.drawn:
        alone = reduction(lambda h: np.minimum(h, 0))
    elif target.weighted is not None:
        far, left = (float(target.weighted.distance(h.astype(float))) for h in (before, after))
        alone = 1 - left / far if far else (-math.inf if left else 1.0)
    return {
        "iou": float(metrics.iou(target.goal, np.where(np.isnan(target.goal), np.nan, after), target.depth)),
        "l2_reduction": alone,
        "l2_reduction_with_berms": whole,
        "volume_error": metrics.volume_error(before, after),
        "max_slope_deg": math.degrees(math.atan(float(steepest_slope(target.scene, after)))),
    }


def _rounded(points: int) -> int:
    """A few lengths for all paths, so that like goals share a program: single strokes, and others."""
    return _PARTS + 1 if points <= _PARTS + 1 else -(-points // 32) * 32


def _divided(path: np.ndarray, spacing: float) -> np.ndarray:
    """A single stroke as a path of short legs, for its recording; other paths as they are.

    All legs but the last are of whole sub-steps of the push, so that the path leaves what the stroke leaves, up to rounding.
    """
    run = path[-1] - path[0]
    length = float(np.hypot(*run[:2]))
    if len(path) > 2 or not length:
        return path
    substep = SteppedPush().substep * spacing / length
    inner = np.unique(np.round(np.arange(1, _PARTS) / _PARTS / substep)) * substep
    parts = np.array([0.0, *inner[(inner > 0) & (inner < 1)], 1.0])
    return path[0] + parts[:, None] * run


@cache
def _program(
    scene: Scene, points: int, columns: int
) -> tuple[Callable[[jax.Array, jax.Array], tuple[Shaped, jax.Array]], float]:
    """`follow_frames` for paths [points, columns], compiled ahead, and the seconds that compiling took.

    It works on the whole map: the heap of a path of many legs outgrows any window that fits the blade.
    """
    began = time.perf_counter()
    scene = replace(scene, window=Whole())
    height = jax.ShapeDtypeStruct(scene.grid.shape, np.float32)
    path = jax.ShapeDtypeStruct((points, columns), np.float32)
    program: Callable[..., Any] = jax.jit(partial(follow_frames, scene)).lower(height, path).compile()
    return program, time.perf_counter() - began


def _padded(path: np.ndarray, points: int) -> jax.Array:
    """The path with its last point repeated up to `points` points; a leg without length changes nothing."""
    return jnp.asarray(np.concatenate([path, np.repeat(path[-1:], points - len(path), axis=0)]), jnp.float32)


def _moments(path: np.ndarray, recorded: np.ndarray, every: int, usual: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Every so many of the maps `recorded` after the legs of a path, and the last, with the tool's pose in each, and the
    height of its bottom, `usual` for a path without heights; nothing of what was recorded of the padding behind the path.
    """
    after = np.unique(np.append(np.arange(every, len(path), every), len(path) - 1))
    flat = path[:, :2]
    poses = np.concatenate([flat[after], _headings(np.diff(flat, axis=0))[after - 1]], 1)
    return recorded[after - 1], poses, path[after, 2] if path.shape[1] == 3 else np.full(len(after), usual)


def _headings(runs: np.ndarray) -> np.ndarray:
    lengths = np.hypot(runs[:, 0], runs[:, 1])[:, None]
    return np.where(lengths > 0, runs / np.where(lengths > 0, lengths, 1), [1.0, 0.0])


def _nowhere() -> np.ndarray:
    return np.full(4, np.nan)
