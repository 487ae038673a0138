"""The notebooks run from top to bottom on coarse grids, and what they say of their results is so."""

import ast
import io
import json
from itertools import pairwise
from pathlib import Path

import jax
import matplotlib
import matplotlib.pyplot as plt
import numpy as np
import pytest
from matplotlib.figure import Figure

import jaxsand as js

NOTEBOOKS = sorted((Path(__file__).parent.parent / "notebooks").glob("*.ipynb"))
NONE = pytest.param(None, marks=pytest.mark.skip(reason="no notebooks beside the tests"))
FULL, SMALL = 'SIZE = "full"\n', 'SIZE = "small"\n'
LARGEST = 300_000  # bytes


def case(path, marks=()):
    return pytest.param(path, id=path.stem, marks=marks)


def sources(notebook):
    """The code of every code cell, by its id."""
    cells = json.loads(notebook.read_text(encoding="utf-8"))["cells"]
    return {cell["id"]: "".join(cell["source"]) for cell in cells if cell["cell_type"] == "code"}


def run(name, source, names):
    """Runs a cell, and draws what a reader would see: open figures, and a figure on the last line."""
    tree = ast.parse(source, name)
    last = tree.body.pop() if isinstance(tree.body[-1], ast.Expr) else None
    exec(compile(tree, name, "exec"), names)
    shown = eval(compile(ast.Expression(last.value), name, "eval"), names) if last else None
    for figure in [*map(plt.figure, plt.get_fignums()), *([shown] if isinstance(shown, Figure) else [])]:
        figure.savefig(io.BytesIO(), format="png", dpi=40)
    plt.close("all")


def settling(names):
    """Checks what notebooks/settling.ipynb says."""
    js.check(names["settled"])
    sweeps, errors = names["sweeps"], names["errors"]
    assert max(errors, key=errors.get) == "Pairwise"
    assert max(sweeps, key=sweeps.get) == "Relaxation"
    assert errors["SuperTimeStepping"] < 0.01
    isotropic, octagon = names["cone_errors"]["isotropic"], names["cone_errors"][8]
    assert isotropic[-1] < octagon[-1] / 2
    assert isotropic[-1] < isotropic[0] * names["CONES"][0] / names["CONES"][-1]
    assert octagon[-1] > 0.9 * octagon[-2]
    assert {row["scheme"] for row in names["rows"]} == set(names["workprec"].SCHEMES)
    whole, windowed = (np.asarray(names[k].height) for k in ("whole", "windowed"))
    assert int(names["windowed"].outcome) == 0
    assert np.abs(windowed - whole).max() <= 1e-6 * whole.max()
    assert int(names["cramped"].outcome) & js.Outcome.WINDOW_EDGE
    assert names["gradient"] < 0
    assert names["gradient"] == pytest.approx(names["difference"], rel=1e-4)
    assert np.all(np.diff(names["values"]) < 0)


def planning(names):
    """Checks what notebooks/planning.ipynb says."""
    assert names["found"].optimal
    assert names["anywhere"].steps <= names["found"].steps <= names["home"].steps
    assert all(0.98 < r["ratio"] < 1.13 for r in names["rows"])
    combs = [r for r in names["sizes"] if r["name"].startswith("comb")]
    counted = [r["paper_expanded"] for r in combs if r["paper_expanded"]]
    assert all(3 < b / a < 6 for a, b in pairwise(counted))
    assert all(r["astar_expanded"] == r["steps"] for r in combs)
    nodes = {a: [r["nodes"] for r in names["alphas"] if r["alpha"] == a] for a in (7.2, 1.0)}
    assert min(nodes[7.2]) > 10 * max(nodes[1.0])
    assert all(plan.optimal for plan in names["proofs"].values())
    gaps = [plan.gap for _, plan in names["timed"]]
    assert 0 <= gaps[-1] <= gaps[0] + 1e-9
    assert names["sand"].lower_bound <= names["sand"].after < 0.8 * names["sand"].before


def wheel(names):
    """Checks what notebooks/wheel.ipynb says."""
    assert int(names["towed"].outcome) == 0
    errors = names["errors"]
    assert errors["split", "exact"][0] < 0.15  # cells of 5 mm
    assert errors["own", "exact"][0] < 2
    assert errors["exact", "closed-form"][0] > 1
    jumps = names["angles"][1:][names["steps"] > 1e-3]
    assert {round(angle) for angle in jumps} == {80}
    by_rule = {rule: [r["error"] for r in names["runs"] if r["rule"] == rule] for rule in ("own", "split")}
    assert by_rule["split"][-1] < by_rule["split"][0]
    assert max(by_rule["split"]) < min(by_rule["own"])
    simulated, closed = np.array(names["rows"])[:, 1:].T
    assert np.all(np.diff(simulated) < 0)
    assert np.all(np.diff(closed) < 0)
    assert float(names["map_"].min()) < float(names["ground"].min()) + 0.02
    assert all(np.diff(values)[0] > 0 for values in names["pull"].values())


def strokes(names):
    """Checks what notebooks/strokes.ipynb says."""
    assert names["off"] < 1e-5
    for found in [*names["found"], names["free"], names["levelled"]]:
        assert np.all(np.diff(found.losses) < 0)
    assert all(found.losses[-1] < found.losses[0] / 4 for found in names["found"])
    assert max(names["left"].values()) <= 1
    degrees = names["degrees"]
    assert {name: fit.verdict for name, fit in names["fits"].items()} == {
        "a collapse": js.Verdict(0),
        "a push": js.Verdict.GRID_UNKNOWN,
        "both": js.Verdict(0),
    }
    assert all(abs(value - 31) < 4 * error for value, error in degrees.values())
    assert degrees["both"][1] <= degrees["a collapse"][1] * 1.05 < degrees["a push"][1]


CHECKS = {"settling": settling, "planning": planning, "wheel": wheel, "strokes": strokes}


@pytest.mark.filterwarnings("ignore:FigureCanvasAgg is non-interactive")  # plt.show() where there is a display
@pytest.mark.parametrize("notebook", [case(path, pytest.mark.pages) for path in NOTEBOOKS] or [NONE])
def test_a_notebook_runs_and_says_what_is_so(notebook):
    cells = sources(notebook)
    assert sum(f"{source}\n".count(FULL) for source in cells.values()) == 1
    matplotlib.use("Agg")
    names = {"__name__": "__main__"}
    before = jax.config.jax_enable_x64
    try:
        with jax.enable_x64(False):  # as its readers run it
            for name, source in cells.items():
                run(f"{notebook.name}, cell {name}", f"{source}\n".replace(FULL, SMALL), names)
    finally:
        plt.close("all")
        jax.config.update("jax_enable_x64", before)
    assert names["SIZE"] == "small"
    if notebook.stem in CHECKS:
        CHECKS[notebook.stem](names)


@pytest.mark.parametrize("notebook", [case(path) for path in NOTEBOOKS] or [NONE])
def test_a_notebook_is_small_and_clean(notebook):
    """No outputs that a run could contradict; ids for every cell."""
    assert notebook.stat().st_size < LARGEST
    content = json.loads(notebook.read_text(encoding="utf-8"))
    assert (content["nbformat"], content["nbformat_minor"]) >= (4, 5)
    ids = [cell["id"] for cell in content["cells"]]
    assert len(set(ids)) == len(ids)
    assert not any(cell.get("outputs") for cell in content["cells"])
