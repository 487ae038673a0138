"""How fast things were from commit to commit."""

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_MARKS = "osD^vPX"
_MOST = 60  # runs that are drawn


def history_figure(runs: Sequence[dict[str, Any]]) -> "Figure":
    """Ratios to the reference loop of each job, run after run, of the machine that the last run was made on.

    Args:
      runs: as `jaxsand.bench.speed.history` reads them, one at least.
    """
    from matplotlib.figure import Figure

    same = [run for run in runs if run["machine"] == runs[-1]["machine"]][-_MOST:]
    figure = Figure(figsize=(11, 4.2), layout="constrained")
    for ax, name, title in zip(figure.subplots(1, 2), ("ratio", "compile_ratio"), ("run time", "compile time"), strict=True):
        for k, job in enumerate(same[-1]["figures"]):
            ratios = [run["figures"].get(job, {}).get(name, math.nan) for run in same]
            ax.plot(ratios, _MARKS[k % len(_MARKS)] + "-", ms=5, label=job)
        ax.set(yscale="log", ylabel="over the reference loop's")
        ax.set_title(title, loc="left")
        ax.set_xticks(range(len(same)), [run["commit"] or "" for run in same], rotation=90, fontsize=7)
        ax.grid(alpha=0.3)
    figure.legend(
        *figure.axes[0].get_legend_handles_labels(), loc="outside upper center", ncols=5, fontsize=8, frameon=False
    )
    return figure
