"""Every letter, shaped: how close the sand comes to it."""

import string

from jaxsand.bench.tables import Row
from jaxsand.goals import letters
from jaxsand.planning.pipeline import glyph_target, shape
from jaxsand.planning.targets import Layout, map_target
from jaxsand.scene.progress import Tell, quiet


def bench_letters(tell: Tell = quiet) -> list[Row]:
    """Every letter by the plan of its map, and by its own strokes.

    A letter pushed by its own strokes is its own goal, so that row checks the plumbing.
    """
    rows = []
    for letter in string.ascii_uppercase:
        tell(f"letter {letter}")
        dig, start = letters.letter_map(letter)
        planned = shape(map_target(dig, start, letter, Layout()))
        own = shape(glyph_target(letters.letter_strokes(letter), letter))
        figures = planned.figures
        rows.append(
            {
                "name": letter,
                "steps": planned.steps,
                "iou": figures["iou"],
                "l2_reduction": figures["l2_reduction"],
                "l2_reduction_with_berms": figures["l2_reduction_with_berms"],
                "volume_error": figures["volume_error"],
                "max_slope_deg": figures["max_slope_deg"],
                "run_seconds": planned.seconds["run"],
                "own_strokes": own.steps,
                "own_iou": own.figures["iou"],
                "own_l2_reduction": own.figures["l2_reduction"],
            }
        )
    return rows
