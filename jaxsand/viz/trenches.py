"""Figures of the wheel's trenches, by matplotlib."""

from typing import TYPE_CHECKING, Any

import numpy as np

from jaxsand.terramechanics.trench_experiment import ANGLES, SINKAGES, Trench, distances
from jaxsand.terramechanics.wheel_trench import Profile

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.figure import Figure

_LOOKS: dict[str, dict[str, Any]] = {
    "closed-form": {"color": "0.6", "lw": 3.0, "label": "closed form"},
    "exact": {"color": "C1", "lw": 1.6, "label": "exact relaxation of its section before the flow"},
    "own": {"color": "C0", "lw": 1.4, "label": "simulated"},
    "split": {"color": "C2", "lw": 1.2, "ls": "--", "label": "simulated, sand put where the closed form puts it"},
    "measured": {"color": "C3", "lw": 0, "marker": ".", "ms": 1.5, "label": "measured"},
}


def profiles_figure(profiles: dict[str, dict[Trench, Profile]]) -> "Figure":
    """The sections of all trenches: a row for every sinkage, a column for every slip angle."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(15, 7), layout="constrained")
    axes = figure.subplots(len(SINKAGES), len(ANGLES), sharex=True, sharey="row")
    for line, sinkage in zip(axes, SINKAGES, strict=True):
        for ax, beta in zip(line, ANGLES, strict=True):
            for source, look in _LOOKS.items():
                if (beta, sinkage) in profiles.get(source, {}):
                    profile = profiles[source][beta, sinkage]
                    ends = [-0.15, *profile.x[np.abs(profile.x) < 0.15], 0.15]
                    heights = np.interp(ends, profile.x, profile.z, left=0, right=0)
                    if source == "measured":
                        ax.plot(profile.x * 1e3, profile.z * 1e3, **look)
                    else:
                        ax.plot(np.array(ends) * 1e3, heights * 1e3, **look)
            ax.set_title(f"{beta:g}°, {sinkage:g} mm", loc="left", fontsize=10)
            ax.set_xlim(-140, 140)
        line[0].set_ylabel("height (mm)")
    for ax in axes[-1]:
        ax.set_xlabel("across the way (mm)")
    figure.legend(*_labels(axes), loc="outside upper center", ncols=len(_LOOKS), frameon=False)
    return figure


def errors_figure(profiles: dict[str, dict[Trench, Profile]]) -> "Figure":
    """Histograms of |difference| over all points of all trenches, of each rule against each reference."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(10, 4), layout="constrained")
    axes = figure.subplots(1, 2, sharey=True)
    bins = np.arange(0, 15.25, 0.25)
    for ax, reference in zip(axes, ("closed-form", "exact"), strict=True):
        for rule in ("own", "split"):
            if rule not in profiles:
                continue
            points = np.concatenate([distances(profiles[rule][t], known) for t, known in profiles[reference].items()])
            share = np.full(points.size, 1 / points.size)
            look = _LOOKS[rule]
            ax.hist(points, bins, weights=share, histtype="step", color=look["color"], lw=1.6, label=look["label"])
            ax.axvline(points.mean(), color=look["color"], lw=1, ls=":")
        ax.set(xlabel="|difference| (mm)", yscale="log")
        ax.set_title(f"against the {_LOOKS[reference]['label']}", loc="left", fontsize=10)
    axes[0].set_ylabel("share of all points (dotted: mean)")
    axes[0].legend(frameon=False, fontsize=8)
    return figure


def spacing_figure(rows: list[dict[str, Any]]) -> "Figure":
    """Mean error against run time; a curve runs over spacings."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(10, 4), layout="constrained")
    axes = figure.subplots(1, 2, sharex=True)
    for ax, figure_of in zip(axes, ("mean_abs_mm", "depth_error_mm"), strict=True):
        for k, (rule, against) in enumerate(dict.fromkeys((row["rule"], row["against"]) for row in rows)):
            some = [row for row in rows if (row["rule"], row["against"]) == (rule, against) and row[figure_of] > 0]
            label = f"{rule} against {against.replace('-', ' ')}"
            ax.plot([r["seconds"] for r in some], [r[figure_of] for r in some], "osD^vP"[k % 6] + "-", ms=4, label=label)
            for row in some if not k else []:
                ax.annotate(f"{row['spacing_mm']:g} mm", (row["seconds"], row[figure_of]), fontsize=7)
        ax.margins(x=0.15)
        ax.set(xscale="log", yscale="log", xlabel="run time of one trench (s)")
        ax.set_title({"mean_abs_mm": "mean error (mm)", "depth_error_mm": "depth error (mm)"}[figure_of], loc="left")
    axes[0].legend(frameon=False, fontsize=8)
    return figure


def _labels(axes: np.ndarray) -> tuple[list["Artist"], list[str]]:
    """Each label in the axes once, with its line."""
    found: dict[str, Artist] = {}
    for ax in axes.ravel():
        for handle, label in zip(*ax.get_legend_handles_labels(), strict=True):
            found.setdefault(label, handle)
    return list(found.values()), list(found)
