"""Sets of glyphs to judge learners by: the letters, unchanged and changed, any glyph file, and random strokes."""

import math
import string
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from jaxsand.bench.stroke_goals import StrokeGoal, letters, letters_on_rough_sand, stroke_goal, turned_letters
from jaxsand.goals import letters as goals
from jaxsand.goals import metrics
from jaxsand.goals.untrusted import read_json
from jaxsand.goals.usual import usual_scene
from jaxsand.scene.scene import Scene
from jaxsand.scene.tools import Blade
from train.imitation.plans import random_plans

_SEED = 2_000_003
_GLYPHS, _STROKES = 1000, 1000  # in a file, and of a glyph


def read_glyphs(path: Path) -> list[StrokeGoal]:
    """Reads the glyphs of a JSON file: names, each with straight strokes [x0, y0, x1, y1] in the unit square, y up.

    Raises:
      ValueError: names the file or the glyph, and what is wrong.
    """
    return [stroke_goal(name, metrics.place(strokes)) for name, strokes in read_strokes(path).items()]


def read_strokes(path: Path) -> dict[str, np.ndarray]:
    """The strokes [n, 4] of each glyph in a file by its name; see `read_glyphs`."""
    try:
        table = read_json(path)
    except ValueError as error:
        raise ValueError(f"glyphs: cannot read {path} ({error}); give a JSON file of names and strokes") from None
    if not isinstance(table, dict) or not table:
        raise ValueError(f"glyphs: got no glyph in {path}; give a JSON object of names and strokes")
    if len(table) > _GLYPHS:
        raise ValueError(f"glyphs: got {len(table)} of them in {path}; give at most {_GLYPHS}")
    for name, strokes in table.items():
        if not (name.strip() and name.isprintable()):
            raise ValueError(f"glyphs: got the name {name!r:.60}; give each glyph a name of its own that can be printed")
        if isinstance(strokes, list) and len(strokes) > _STROKES:
            raise ValueError(f"glyphs: {name!r:.60} has {len(strokes)} strokes; give at most {_STROKES}")
    return {name: goals.stroke_list("glyphs", name, strokes, 0, 1) for name, strokes in table.items()}


def _moved(scale: float, shift: float) -> list[StrokeGoal]:
    """Letters scaled, and moved by up to `shift` (of the square) in a random direction each."""
    rng = np.random.default_rng(_SEED)
    out = []
    for name in string.ascii_uppercase:
        angle = rng.uniform(0, 2 * math.pi)
        away = 0.5 + shift * np.array([math.cos(angle), math.sin(angle)] * 2)
        moved = stroke_goal(name, metrics.place((goals.letter_strokes(name) - 0.5) * scale + away))
        out.append(replace(moved, size=scale * moved.size))
    return out


def _pushed_by(blade: Blade, degrees: float = 29.0) -> list[StrokeGoal]:
    """Letters pushed by another blade, or in sand of another angle of repose."""
    scene: Scene = usual_scene(repose_angle=math.radians(degrees), tool=blade)
    return [stroke_goal(name, metrics.place(goals.letter_strokes(name)), scene=scene) for name in string.ascii_uppercase]


def _many() -> list[StrokeGoal]:
    """26 goals of six to eight random strokes, drawn as those of training are."""
    strokes, numbers = random_plans(np.random.default_rng(_SEED), 200)
    some = np.flatnonzero(numbers >= 6)[:26]
    return [stroke_goal(f"{numbers[k]} strokes, {i}", strokes[k, : numbers[k]]) for i, k in enumerate(some, 1)]


def _few() -> list[StrokeGoal]:
    """100 goals of one to eight random strokes."""
    strokes, numbers = random_plans(np.random.default_rng(_SEED + 1), 100)
    return [stroke_goal(f"{numbers[k]} strokes, {k + 1}", strokes[k, : numbers[k]]) for k in range(100)]


SETS: dict[str, Callable[[], list[StrokeGoal]]] = {
    "letters": letters,
    "turned": turned_letters,
    "shifted": lambda: _moved(1.0, 0.1),
    "small": lambda: _moved(0.7, 0.15),
    "rough": letters_on_rough_sand,
    "wide": lambda: _pushed_by(Blade(width=0.03)),
    "shallow": lambda: _pushed_by(Blade(depth=0.005)),
    "deep": lambda: _pushed_by(Blade(depth=0.01)),
    "flat": lambda: _pushed_by(Blade(), 25.0),
    "steep": lambda: _pushed_by(Blade(), 35.0),
    "many": _many,
    "random": _few,
}
"""The sets of glyphs by name, for `--goals NAME`."""
