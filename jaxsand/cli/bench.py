"""`jaxsand bench`: error against run time, and speed beside rivals."""

import argparse
import subprocess
import sys
from contextlib import suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from jaxsand.cli.files import folder, progress, write_json
from jaxsand.cli.printing import show
from jaxsand.goals.writing import written

_STROKE_GOALS = ("letters", "turned", "rough", "eight")


def run_benchmark(options: argparse.Namespace) -> None:
    """Runs `jaxsand bench`."""
    tell = progress()
    out = folder(options.out) if options.out else None
    if options.what == "env":
        _device_for_each_core()
    from jaxsand.bench.report import bench, table

    own = _own(options)
    origin = {"command": options.command_line, "commit": _commit(), "date": f"{datetime.now(UTC):%Y-%m-%d}"}
    report = origin | bench(options.what, options.batch, tell, options.grids, options.seed, **own)
    if out:
        from jaxsand.viz.render import alpha_figure, complexity_figure, save_figure, work_precision_figure

        if report.get("work_precision"):
            with written(out / f"bench-{options.what}.png") as path:
                save_figure(lambda: work_precision_figure(report["work_precision"]), path)
        if "plan_by_size" in report:
            with written(out / "bench-plan.png") as path:
                save_figure(lambda: complexity_figure(report), path)
            with written(out / "bench-plan-alpha.png") as path:
                save_figure(lambda: alpha_figure(report), path)
        if "trench_by_spacing" in report:
            from jaxsand.viz.trenches import spacing_figure

            with written(out / "bench-trench.png") as path:
                save_figure(lambda: spacing_figure(report["trench_by_spacing"]), path)
        if "ramp_maps" in report:
            from jaxsand.bench.ramps import shown as ramps_shown
            from jaxsand.viz.side import sides_figure

            with written(out / "bench-ramp.png") as path:
                save_figure(lambda: sides_figure(ramps_shown(report["ramp_maps"])), path)
        if "tasks_maps" in report:
            from jaxsand.bench.tasks import shown as tasks_shown
            from jaxsand.viz.gallery import gallery_figure

            with written(out / "bench-tasks.png") as path:
                save_figure(lambda: gallery_figure(tasks_shown(report.pop("tasks_maps"))), path)
        if "strokes_curves" in report:
            from jaxsand.bench.strokes import REACHED, found
            from jaxsand.viz.strokes import found_figure, strokes_figure

            with written(out / "bench-strokes.png") as path:
                save_figure(lambda: strokes_figure(report["strokes_curves"], REACHED), path)
            shown = found(own["goals"], report["strokes_curves"])
            if shown:
                with written(out / "bench-strokes-found.png") as path:
                    save_figure(lambda: found_figure(shown), path)
        write_json(out / f"bench-{options.what}.json", report)
    tell("")
    if out and options.what == "speed":
        _compare_speed(report, out)
    show(options, report, table)


def _compare_speed(report: dict[str, Any], out: Path) -> None:
    """Adds a run to the history of speed and draws that; says on standard error what has become slower."""
    from jaxsand.bench.speed import history, with_history
    from jaxsand.viz.history import history_figure
    from jaxsand.viz.render import save_figure

    for line in with_history(report["speed"], report, out):
        print(f"warning: {line}", file=sys.stderr)
    with written(out / "bench-speed.png") as path:
        save_figure(lambda: history_figure(history(out)), path)


def _commit() -> str | None:
    """The commit of the checkout that this code runs from, with "-dirty" where files were changed; None if installed."""
    here = Path(__file__)
    for command in (["ls-files", "--error-unmatch", here.name], ["describe", "--always", "--dirty"]):
        try:
            done = subprocess.run(["git", *command], cwd=here.parent, capture_output=True, text=True, check=True)
        except (OSError, subprocess.CalledProcessError):
            return None
    return done.stdout.strip()


def _device_for_each_core() -> None:
    """As the site has it for batches of environments; too late once JAX has begun to compute."""
    import jax

    from jaxsand.relaxation.batching import processors

    with suppress(RuntimeError):
        jax.config.update("jax_num_cpu_devices", processors())


_WHERE = {
    "goals": ("strokes", "tasks"),
    "calls": ("strokes", "tasks"),
    "seeds": ("strokes", "tasks"),
    "methods": ("strokes", "tasks"),
    "strokes": ("tasks",),
    "points": ("tools",),
}


def _own(options: argparse.Namespace) -> dict[str, Any]:
    """The options that only some benches have."""
    for option, where in _WHERE.items():
        if getattr(options, option) is not None and options.what not in where:
            raise ValueError(f"{option}: has an effect on {' and '.join(f'bench {w}' for w in where)} only; leave it out")
    if options.what == "tools":
        return {"out": options.out} | ({"points": options.points} if options.points else {})
    if options.what not in ("strokes", "tasks"):
        return {}
    methods = tuple(name.strip() for name in options.methods.split(",")) if options.methods else ()
    if options.what == "tasks":
        names = tuple(name.strip() for name in options.goals.split(",")) if options.goals else ()
        given = {
            "names": names,
            "methods": methods,
            "instances": options.seeds,
            "pushes": options.calls,
            "strokes": options.strokes,
            "out": options.out,
        }
        return {name: value for name, value in given.items() if value}
    if options.goals not in (None, *_STROKE_GOALS):
        raise ValueError(f"goals: got {options.goals!r}; give one of {', '.join(_STROKE_GOALS)}")
    return {
        "goals": options.goals or "letters",
        "calls": options.calls or 4_000,
        "seeds": tuple(range(options.seed, options.seed + (options.seeds or 1))),
        "methods": methods,
        "out": options.out,
    }
