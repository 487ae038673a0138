"""How many glyphs a policy gets right: alone, with look-ahead by the simulator, and after refinement by gradients."""

import time
from collections.abc import Iterator
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


def picture(glyphs: list[StrokeGoal], report: dict[str, Any]) -> "Figure":
    """Goals, and below each what the pushes of a report left, with its IoU; a star where it is right."""
    return found_figure(
        [
            (name, row["iou"], glyph.goal - glyph.start, maps[-1] - glyph.start)
            for name, row, glyph, maps in _pushed(glyphs, report)
        ]
    )


def page(glyphs: list[StrokeGoal], report: dict[str, Any]) -> Page:
    """Sand to turn and play in a browser: every glyph after each of its pushes, beside its goal."""
    return view(
        *[
            Panel(maps, float(glyph.scene.grid.spacing), f"{name}: IoU {row['iou']:.3f}", glyph.goal, _ways(row))
            for name, row, glyph, maps in _pushed(glyphs, report)
        ],
        title=f"{report['right']} of {report['total']} right",
    )


def _ways(row: dict[str, Any]) -> tuple[np.ndarray, ...]:
    return tuple(np.array(row["pushes"], float).reshape(-1, 2, 2))


def _pushed(
    glyphs: list[StrokeGoal], report: dict[str, Any]
) -> Iterator[tuple[str, dict[str, Any], StrokeGoal, np.ndarray]]:
    """Each glyph's name, with a star where it is right, its row of the report, and its maps [M + 1, H, W] (m)."""
    for glyph in glyphs:
        row = report["glyphs"][glyph.name]
        maps = [np.asarray(glyph.start, np.float32)]
        for way in _ways(row):
            maps.append(pushed(glyph.scene, maps[-1][None], way.reshape(1, 4))[0])
        yield f"{glyph.name}*" if row["right"] else glyph.name, row, glyph, np.stack(maps)
