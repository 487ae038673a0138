"""Goals that known strokes make: letters, upright, turned and on rough sand, and many strokes that cross."""

import string
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from jaxsand.goals import letters as goals
from jaxsand.goals import metrics
from jaxsand.goals.surfaces import rested, terrain_surface
from jaxsand.goals.usual import usual_scene
from jaxsand.interaction.outcome import check
from jaxsand.interaction.simulate import rollout
from jaxsand.planning.stroke_loss import SandLoss, sand_loss
from jaxsand.scene.scene import Scene
from jaxsand.scene.tools import Blade


@dataclass(frozen=True)
class StrokeGoal:
    """What `strokes` [N, 4] (m) leave of `start` [H, W] (m); a search is told the start, the goal and N. `size` (m) is that
    of the square they were drawn in."""

    name: str
    scene: Scene
    start: np.ndarray
    goal: np.ndarray
    strokes: np.ndarray
    size: float = metrics.GLYPH_SQUARE[1] - metrics.GLYPH_SQUARE[0]

    @property
    def sand(self) -> SandLoss:
        """How far plans end from the goal."""
        return sand_loss(self.scene, self.start, self.goal)

    @property
    def depth(self) -> float:
        """How deep the blade goes (m); 0 without one."""
        tool = self.scene.tool
        return float(tool.depth) if isinstance(tool, Blade) else 0.0

    def iou(self, after: np.ndarray) -> float:
        """Of what is dug below the start."""
        return float(metrics.iou(self.goal - self.start, after - self.start, self.depth))


def stroke_goal(name: str, strokes: np.ndarray, start: np.ndarray | None = None, scene: Scene | None = None) -> StrokeGoal:
    """The goal that strokes (m) leave on a map at rest (level if None), of 32 x 32 cells of 0.01 m, by the default blade, or
    of another scene."""
    scene = usual_scene() if scene is None else scene
    start = np.zeros(scene.grid.shape, np.float32) if start is None else np.asarray(start, np.float32)
    shaped = rollout(scene, start, np.asarray(strokes, np.float32))
    check(shaped)
    return StrokeGoal(name, scene, start, np.asarray(shaped.height[-1]), np.asarray(strokes, float))


def letters(names: str = string.ascii_uppercase) -> list[StrokeGoal]:
    """Capital letters on level sand."""
    return [stroke_goal(name, metrics.place(goals.letter_strokes(name))) for name in names]


def turned_letters(names: str = string.ascii_uppercase, degrees: float = 30.0) -> list[StrokeGoal]:
    """Letters turned about the middle of the map, counter-clockwise, and made smaller where they would leave it."""
    angle = np.radians(degrees)
    turn = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
    out = []
    for name in names:
        points = (goals.letter_strokes(name).reshape(-1, 2) - 0.5) @ turn
        points *= min(1.0, 0.5 / np.abs(points).max())
        out.append(stroke_goal(f"{name} turned by {degrees:g}", metrics.place((points + 0.5).reshape(-1, 4))))
    return out


def letters_on_rough_sand(names: str = string.ascii_uppercase, relief: float = 0.01) -> list[StrokeGoal]:
    """Letters pushed into terrain of a height range `relief` (m)."""
    scene = usual_scene(tool=None)
    rough = rested(scene, terrain_surface(scene.grid.shape, relief))
    return [stroke_goal(f"{name} on rough sand", metrics.place(goals.letter_strokes(name)), rough) for name in names]


def many_strokes(count: int = 8, goals: int = 5, seed: int = 0) -> list[StrokeGoal]:
    """Goals of random strokes inside the square of the glyphs, each at least a quarter of it long."""
    rng = np.random.default_rng(seed)
    out = []
    for k in range(goals):
        drawn = rng.random((64 * count, 4))
        long = drawn[np.hypot(*(drawn[:, 2:] - drawn[:, :2]).T) >= 0.25][:count]
        out.append(stroke_goal(f"{count} strokes, {k + 1}", metrics.place(long)))
    return out


GOALS: dict[str, Callable[[], list[StrokeGoal]]] = {
    "letters": letters,
    "turned": turned_letters,
    "rough": letters_on_rough_sand,
    "eight": many_strokes,
}
