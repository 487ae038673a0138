"""`jaxsand plan`: the shortest single stroke over a binary map."""

import argparse
import time
from pathlib import Path

from jaxsand.cli.files import folder, progress, read_text, write_json
from jaxsand.cli.printing import lines, plain_name, read_cell, show
from jaxsand.goals.writing import written


def run_plan(options: argparse.Namespace) -> None:
    """Runs `jaxsand plan`."""
    tell = progress()
    from jaxsand.goals import letters
    from jaxsand.planning.binary import plan

    own: tuple[int, int] | None
    if len(options.map) == 1:
        dig, own = letters.letter_map(options.map.upper() if options.map.isascii() else options.map)
    else:
        dig, own = letters.read_text_map(read_text(Path(options.map)), options.map)
    start = own if options.start is None else read_cell(options.start)
    out = folder(options.out) if options.out else None
    tell("planning")
    began = time.perf_counter()
    found = plan(
        dig,
        start,
        end=None if options.end is None else read_cell(options.end, "end"),
        turn_cost=options.turn_cost,
        engine=options.engine,
        weight=options.weight,
        seconds=options.seconds,
    )
    report = {
        "steps": found.steps,
        "path": found.path,
        "start": list(found.start),
        **({"cost": found.cost} if options.turn_cost else {}),
        "optimal": found.optimal,
        "lower_bound": found.lower_bound,
        "gap": found.gap,
        "expanded": found.expanded,
        "opened": found.opened,
        "engine": found.engine,
        "seconds": time.perf_counter() - began,
    }
    if out:
        from jaxsand.viz.render import plan_figure, save_figure

        stem = plain_name(options.map)
        files = [out / f"plan-{stem}.{suffix}" for suffix in ("png", "json")]
        report["files"] = [str(file) for file in files]
        tell("drawing")
        with written(files[0]) as path:
            save_figure(lambda: plan_figure(dig, found), path)
        write_json(files[1], report)
    tell("")
    show(options, report, lines)
