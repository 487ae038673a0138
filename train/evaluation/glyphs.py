"""Sets of glyphs to judge learners by: the letters, unchanged and changed, any glyph file, and random strokes."""

import json
import math
import string
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from jaxsand.bench.stroke_goals import StrokeGoal, letters, letters_on_rough_sand, stroke_goal, turned_letters
from jaxsand.goals import letters as goals
from jaxsand.goals import metrics
from jaxsand.goals.usual import usual_scene
from jaxsand.scene.scene import Scene
from jaxsand.scene.tools import Blade
from train.imitation.plans import random_plans

_SEED = 2_000_003


def read_glyphs(path: Path) -> list[StrokeGoal]:
    """Reads the glyphs of a JSON file: names, each with straight strokes [x0, y0, x1, y1] in the unit square, y up.

    Raises:
      ValueError: names the file or the glyph, and what is wrong.
    """
    try:
        table = json.loads(path.read_text(encoding="utf-8-sig"), object_pairs_hook=tuple)
    except (OSError, ValueError, RecursionError) as error:
        why = type(error).__name__
        raise ValueError(f"glyphs: cannot read {path} ({why}); give a JSON file of names and strokes") from None
    if not isinstance(table, tuple) or not table:  # an object's pairs
        raise ValueError(f"glyphs: got no glyph in {path}; give a JSON object of names and strokes")
    names = [name for name, _ in table]
    for name in names:
        if not (name.strip() and name.isprintable()) or names.count(name) > 1:
            raise ValueError(f"glyphs: got the name {name!r:.60}; give each glyph a name of its own that can be printed")
    return [stroke_goal(name, metrics.place(goals.stroke_list("glyphs", name, strokes, 0, 1))) for name, strokes in table]


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
