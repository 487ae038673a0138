"""How many glyphs a learner gets right: by itself, by looking ahead with the simulator, and after polish by gradients."""

import json
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from jaxsand import goals, task
from jaxsand.lookahead import Proposes
from jaxsand.stages import Stages, plan_by_policy
from jaxsand.strokegoals import StrokeGoal, stroke_goal
from jaxsand.strokeloss import SandLoss
from jaxsand.success import right, strict, strokes_right
from jaxsand.tool import Blade

Tell = Callable[[str], None]


def evaluate(
    policy: Proposes, glyphs: list[StrokeGoal], stages: Stages, tell: Tell = lambda _: None
) -> dict[str, Any]:
    """As many pushes as each glyph has strokes, judged at the end; see `jaxsand.success`."""
    began = time.perf_counter()
    rows = {}
    for number, glyph in enumerate(glyphs, 1):
        tell(f"{glyph.name}, {number} of {len(glyphs)}")
        sand = SandLoss(glyph.scene, glyph.start, glyph.goal)
        plan = plan_by_policy(policy, sand, len(glyph.strokes), stages)
        rows[glyph.name] = judged(glyph, plan.strokes)
    return {
        "right": sum(row["right"] for row in rows.values()),
        "strict": sum(row["strict"] for row in rows.values()),
        "total": len(rows),
        "stroke_right": sum(row["strokes_right"] > 0 for row in rows.values()),
        "glyphs": rows,
        "seconds": time.perf_counter() - began,
    }


def judged(glyph: StrokeGoal, pushes: np.ndarray) -> dict[str, Any]:
    """The figures of one glyph after these pushes [M, 4] (m)."""
    depth = float(glyph.scene.tool.depth) if isinstance(glyph.scene.tool, Blade) else 0.0
    after = SandLoss(glyph.scene, glyph.start, glyph.goal).maps(pushes[None])[0] if len(pushes) else glyph.start
    goal, dug = glyph.goal - glyph.start, after - glyph.start
    level = np.zeros_like(goal)
    return {
        "iou": float(task.iou(goal, dug, depth)),
        "l2_reduction": float(task.l2_reduction(goal, level, dug)),
        "right": right(goal, dug, depth),
        "strict": strict(goal, level, dug, depth),
        "strokes_right": strokes_right(glyph.strokes, pushes),
        "strokes": len(glyph.strokes),
        "pushes": [[round(float(v), 6) for v in push] for push in pushes],
    }


def read_glyphs(path: Path | None) -> list[StrokeGoal]:
    """The glyphs of a file, a name to straight strokes [x0, y0, x1, y1] in the unit square, y up; the 26 letters if None.

    Raises:
      ValueError: names the file, the glyph and what is wrong.
    """
    if path is None:
        table = {letter: goals.letter_strokes(letter).tolist() for letter in "ABCDEFGHIJKLMNOPQRSTUVWXYZ"}
    else:
        try:
            table = json.loads(path.read_text(encoding="utf-8"))
        except (OSError, UnicodeDecodeError, json.JSONDecodeError) as error:
            raise ValueError(
                f"glyphs: cannot read {path} ({type(error).__name__}); give a JSON file of names and strokes"
            ) from None
    if not isinstance(table, dict) or not table:
        raise ValueError(f"glyphs: got no glyph in {path}; give a JSON object of names and strokes")
    return [stroke_goal(name, task.place(_strokes(name, strokes))) for name, strokes in table.items()]


def _strokes(name: str, strokes: Any) -> np.ndarray:
    try:
        array = np.array(strokes, float)
        good = array.ndim == 2 and array.shape[1] == 4 and len(array) and np.all((array >= 0) & (array <= 1))
    except (TypeError, ValueError):
        good = False
    if not good:
        raise ValueError(f"glyphs: {name!r} has no list of strokes [x0, y0, x1, y1] from 0 to 1; y goes up")
    return array
