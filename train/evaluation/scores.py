"""How many glyphs a policy gets right: alone, with look-ahead by the simulator, and after refinement by gradients."""

import time
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from jaxsand.bench.stroke_goals import StrokeGoal
from jaxsand.goals import metrics
from jaxsand.goals.success import right, strict, strokes_right
from jaxsand.planning.learned.beam_search import Proposes
from jaxsand.planning.learned.stages import Stages, plan_by_policy
from jaxsand.planning.side_by_side import side_by_side
from jaxsand.planning.stroke_loss import pushed
from jaxsand.scene.progress import Tell, quiet
from jaxsand.viz.strokes import found_figure
from jaxsand.viz.viewer import Page, Panel, view

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def evaluate(policy: Proposes, glyphs: list[StrokeGoal], stages: Stages, tell: Tell = quiet) -> dict[str, Any]:
    """Lets a policy push as often as each glyph has strokes, and judges the result (see `jaxsand.goals.success`).

    All glyphs are pushed side by side, in batches of one simulator (see `jaxsand.planning.side_by_side`).

    Returns:
      How many glyphs are `right` and `strict`, how many there are (`total`), how many have at least one right stroke
      (`stroke_right`), the figures of each by name (`glyphs`), and the `seconds`.
    """
    began = time.perf_counter()

    def row(number: int, glyph: StrokeGoal) -> dict[str, Any]:
        plan = plan_by_policy(policy, glyph.sand, len(glyph.strokes), stages)
        figures = judged(glyph, plan.strokes)
        tell(f"{glyph.name}, {number} of {len(glyphs)}: {'right' if figures['right'] else 'not right'}")
        return figures

    found = side_by_side([partial(row, number, glyph) for number, glyph in enumerate(glyphs, 1)])
    rows = {glyph.name: figures for glyph, figures in zip(glyphs, found, strict=True)}
    return {
        "right": sum(row["right"] for row in rows.values()),
        "strict": sum(row["strict"] for row in rows.values()),
        "total": len(rows),
        "stroke_right": sum(row["strokes_right"] > 0 for row in rows.values()),
        "glyphs": rows,
        "seconds": time.perf_counter() - began,
    }


def judged(glyph: StrokeGoal, pushes: np.ndarray) -> dict[str, Any]:
    """The figures of one glyph after the pushes [M, 4] (m)."""
    after = glyph.sand.maps(pushes[None])[0] if len(pushes) else glyph.start
    goal, dug = glyph.goal - glyph.start, after - glyph.start
    level = np.zeros_like(goal)
    return {
        "iou": glyph.iou(after),
        "l2_reduction": float(metrics.l2_reduction(goal, level, dug)),
        "right": right(goal, dug, glyph.depth),
        "strict": strict(goal, level, dug, glyph.depth),
        "strokes_right": strokes_right(glyph.strokes, pushes, glyph.size),
        "strokes": len(glyph.strokes),
        "pushes": [[round(float(v), 6) for v in push] for push in pushes],
    }


def replayed(glyphs: list[StrokeGoal], report: dict[str, Any]) -> dict[str, np.ndarray]:
    """The maps [M + 1, H, W] (m) of each glyph by name: its start, and what each of a report's M pushes left."""
    return {glyph.name: _replayed(glyph, _ways(report["glyphs"][glyph.name])) for glyph in glyphs}


def picture(glyphs: list[StrokeGoal], report: dict[str, Any], maps: dict[str, np.ndarray]) -> "Figure":
    """Goals, and below each what was left of `replayed` maps, with its IoU; a star where it is right."""
    return found_figure(
        [
            (_starred(g, row), row["iou"], g.goal - g.start, maps[g.name][-1] - g.start)
            for g, row in ((g, report["glyphs"][g.name]) for g in glyphs)
        ]
    )


def page(glyphs: list[StrokeGoal], report: dict[str, Any], maps: dict[str, np.ndarray]) -> Page:
    """Sand to turn and play in a browser: every glyph's `replayed` maps, beside its goal."""
    return view(
        *[
            Panel(maps[g.name], float(g.scene.grid.spacing), f"{_starred(g, row)}: IoU {row['iou']:.3f}", g.goal, _ways(row))
            for g, row in ((g, report["glyphs"][g.name]) for g in glyphs)
        ],
        title=f"{report['right']} of {report['total']} right",
    )


def _replayed(glyph: StrokeGoal, ways: tuple[np.ndarray, ...]) -> np.ndarray:
    maps = [np.asarray(glyph.start, np.float32)]
    for way in ways:
        maps.append(pushed(glyph.scene, maps[-1][None], way.reshape(1, 4))[0])
    return np.stack(maps)


def _ways(row: dict[str, Any]) -> tuple[np.ndarray, ...]:
    return tuple(np.array(row["pushes"], float).reshape(-1, 2, 2))


def _starred(glyph: StrokeGoal, row: dict[str, Any]) -> str:
    return f"{glyph.name}*" if row["right"] else glyph.name
