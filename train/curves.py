"""Learning curves of runs: the validation score against wall time and against strokes simulated.

python -m train.curves RUN [RUN ...] --out FILE.png
"""

import json
import sys
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from jaxsand.cli.arguments import Parser, ended, path_name
from jaxsand.cli.files import existing
from jaxsand.goals.writing import written

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_COUNTS = ("pushes", "steps")  # what a chunk's row counts, by the learner


def curve(run: Path) -> dict[str, np.ndarray]:
    """Reads a run's validations: minutes, strokes or steps simulated up to then, and score.

    Raises:
      ValueError: when the folder holds no metrics, or others.
    """
    file = existing(run / "metrics.jsonl")
    done, points = 0.0, []
    try:
        for line in file.read_text(encoding="utf-8").splitlines(keepends=True):
            if not line.endswith("\n"):  # cut off, or being written
                break
            row = json.loads(line)
            if row["kind"] == "validate":
                points.append((row["seconds"] / 60, done, row["score"]))
            else:
                done += next(row[name] for name in _COUNTS if name in row)
        figures = np.array(points, float)
    except (ValueError, KeyError, TypeError, StopIteration, OverflowError, RecursionError) as error:
        raise ValueError(f"run: cannot read {file} ({type(error).__name__}); give folders of runs of this version") from None
    if not points:
        raise ValueError(f"run: {run} holds no validation yet; train it on with --resume")
    return dict(zip(("minutes", "simulated", "score"), figures.T, strict=True))


def curves_figure(curves: dict[str, dict[str, np.ndarray]]) -> "Figure":
    """Score against wall time and against what was simulated, a line for each run."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(10, 3.6), layout="constrained")
    axes = figure.subplots(1, 2, sharey=True)
    for name, points in curves.items():
        for ax, by in zip(axes, ("minutes", "simulated"), strict=True):
            ax.plot(points[by], points["score"], "o-", ms=3, label=name)
    axes[0].set(xlabel="minutes", ylabel="validation score")
    axes[0].set_ylim(top=1)
    axes[1].set(xlabel="strokes or steps simulated")
    for ax in axes:
        ax.grid(alpha=0.3)
    axes[0].legend(frameon=False, fontsize=8)
    return figure


def main(arguments: list[str] | None = None) -> int:
    """Draws the curves of runs; returns the exit code."""
    parser = Parser(prog="python -m train.curves", description=(__doc__ or "").splitlines()[0])
    parser.add_argument("runs", type=path_name, nargs="+", metavar="RUN")
    parser.add_argument("--out", type=path_name, required=True, metavar="FILE.png")
    options = parser.parse_args(arguments)

    def draw() -> None:
        if options.out.suffix.lower() != ".png":
            raise ValueError(f"out: got {options.out}; give a name that ends in .png")
        names = [run.name for run in options.runs]
        figure = curves_figure({run.name if names.count(run.name) == 1 else str(run): curve(run) for run in options.runs})
        with written(options.out) as path:
            figure.savefig(path, dpi=110, format="png")

    return ended(draw)


if __name__ == "__main__":
    sys.exit(main())
