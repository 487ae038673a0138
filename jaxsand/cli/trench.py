"""`jaxsand trench`: the trenches of a wheel, beside what is known of them."""

import argparse
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Any

from jaxsand.bench.tables import as_table
from jaxsand.cli.files import as_json, folder, progress
from jaxsand.cli.printing import show
from jaxsand.goals.writing import written

if TYPE_CHECKING:
    from jaxsand.terramechanics.trench_experiment import Rut
    from jaxsand.viz.viewer import Page

_FILES = ("profiles.csv", "trench.png", "trench-errors.png", "trench.json")


def run_trench(options: argparse.Namespace) -> None:
    """Runs `jaxsand trench`."""
    tell = progress()
    if not 0.25 <= options.spacing_mm <= 20:
        raise ValueError(f"spacing-mm: got {options.spacing_mm:g}; give millimetres from 0.25 to 20")
    out = folder(options.out) if options.out else None
    if options.html and not out:
        raise ValueError("html: goes to a folder; add --out DIR")
    files = [out / name for name in _FILES + ("trench.html",) * options.html] if out else []
    for file in files:
        if file.is_dir():
            raise ValueError(f"out: cannot write {file}, which is a folder; choose another folder")
    from jaxsand.terramechanics import trench_experiment
    from jaxsand.terramechanics.scans import read_scans

    if options.no_data is not None and not options.measured:
        raise ValueError("no-data: has an effect on --measured only; leave it out")
    scans = read_scans(options.measured, options.no_data) if options.measured else {}
    trench_experiment.check_scans(scans)
    rules = [options.rule] if options.rule else list(trench_experiment.RULES)
    report, profiles, ruts = trench_experiment.experiment(options.spacing_mm * 1e-3, rules, scans, tell)
    if out:
        from jaxsand.viz.render import save_figure
        from jaxsand.viz.trenches import errors_figure, profiles_figure

        report["files"] = [str(file) for file in files]
        tell("drawing")
        with ExitStack() as all_of_them:  # take their places together
            paths = [all_of_them.enter_context(written(file)) for file in files]
            _write_profiles(profiles, paths[0])
            save_figure(lambda: profiles_figure(profiles), paths[1])
            save_figure(lambda: errors_figure(profiles), paths[2])
            paths[3].write_text(as_json(report, indent=1) + "\n", encoding="utf-8")
            if options.html:
                paths[4].write_text(_page(ruts[rules[0]]).html(), encoding="utf-8")
    tell("")
    show(options, report, _table)


def _page(ruts: dict[tuple[float, float], "Rut"]) -> "Page":
    """What shows the sand of all trenches in a browser."""
    from jaxsand.viz.viewer import Panel, view

    panels = [Panel(rut.height, rut.spacing, f"{beta:g}°, {sinkage:g} mm") for (beta, sinkage), rut in ruts.items()]
    return view(*panels, title="Trenches of a wheel, by slip angle and sinkage")


def _write_profiles(profiles: dict[str, dict[tuple[float, float], Any]], path: Path) -> None:
    """All sections: the simulated ones at their cells, the others at their corners or points."""
    with path.open("w", encoding="utf-8") as file:
        file.write("beta_deg,sinkage_mm,source,x_mm,z_mm\n")
        for source, of in profiles.items():
            for (beta, sinkage), profile in of.items():
                for x, z in zip(profile.x * 1e3, profile.z * 1e3, strict=True):
                    file.write(f"{beta:g},{sinkage:g},{source},{x:.4f},{z:.4f}\n")


def _table(report: dict[str, Any]) -> str:
    """Every trench, then the means by angle, by sinkage and over all, then the paper's."""
    rows = [
        {"name": f"{row['rule']} against {row['reference']}", **{k: v for k, v in row.items() if not isinstance(v, str)}}
        for row in report["rows"]
    ]
    lines = as_table(rows, f"trenches, {report['spacing_mm']:g} mm")
    means = {
        "over all": report["summary"],
        **{f"at {beta} degrees": of for beta, of in report["by_beta_deg"].items()},
        **{f"at {sinkage} mm": of for sinkage, of in report["by_sinkage_mm"].items()},
    }
    averages = [
        {"name": f"{where}: {rule} against {reference}", **figures}
        for where, of in means.items()
        for rule, against in of.items()
        for reference, figures in against.items()
    ]
    paper = [
        {"name": f"arXiv:1908.02745 against {reference}", **report["paper"][reference]}
        for reference in ("closed-form", "measured")
    ]
    return "\n".join([*lines, "", *as_table(averages + paper, "means")])
