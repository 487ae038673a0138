"""Methods that find strokes at equal numbers of simulator calls, on letters and other goals that strokes make."""

import time
from collections.abc import Callable, Iterable
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np

from jaxsand.bench.kept import append_row, known_rows
from jaxsand.bench.rivals.strokes import RIVALS, BestFound
from jaxsand.bench.stroke_goals import GOALS, StrokeGoal
from jaxsand.bench.tables import Row
from jaxsand.planning.gradient import first, print_of, search
from jaxsand.planning.gradient.account import Account
from jaxsand.planning.gradient.moves import reordered
from jaxsand.planning.stroke_loss import Best, SandLoss
from jaxsand.scene.progress import Tell, quiet

Method = Callable[[SandLoss, int, np.ndarray, int, int], BestFound]
BUDGETS = (1_000, 4_000, 16_000, 64_000)
REACHED = 0.8
"""The IoU of dug cells from which a goal counts as reached."""


def by_gradients(sand: SandLoss, n_strokes: int, bounds: np.ndarray, budget: int, seed: int) -> BestFound:
    """What `optimise_strokes` does."""
    account = Account(sand, budget)
    search(account, n_strokes, np.random.default_rng(seed))
    return BestFound(account.best.strokes, account.calls, account.history)


def number_open(sand: SandLoss, n_strokes: int, bounds: np.ndarray, budget: int, seed: int) -> BestFound:
    """What `optimise_strokes` does when it is not told how many strokes there are."""
    account = Account(sand, budget)
    search(account, None, np.random.default_rng(seed))
    return BestFound(account.best.strokes, account.calls, account.history)


def without_gradients(sand: SandLoss, n_strokes: int, bounds: np.ndarray, budget: int, seed: int) -> BestFound:
    """From the same first guesses, orders and directions, by mutations that grow when they help and shrink when not."""
    account, rng = Account(sand, budget), np.random.default_rng(seed)
    plans = first(account, print_of(account), n_strokes, rng)
    if plans is not None:
        plan = reordered(account, plans).strokes[0]
        width = 2e-3
        while account.room(n_strokes):
            last = account.best.loss
            account.losses(np.clip(plan + rng.normal(0, width, (16, *plan.shape)), *bounds))
            plan = account.best.strokes
            width = min(max(width * (1.3 if account.best.loss < last else 0.8), 1e-5), 2e-2)
    return BestFound(account.best.strokes, account.calls, account.history)


METHODS: dict[str, Method] = {
    "gradients": by_gradients,
    "gradients with N open": number_open,
    "sketch and mutations": without_gradients,
    **RIVALS,
}


def run_all(
    methods: dict[str, Method],
    some: Iterable[StrokeGoal],
    budgets: tuple[int, ...] = BUDGETS,
    seeds: tuple[int, ...] = (0,),
    out: Path | None = None,
    tell: Tell = quiet,
) -> list[Row]:
    """A row for every method, goal and seed: one run at the largest budget, with what it had at each of the others.

    Rows are also written to `out`/strokes.jsonl as they come, and what is there already, or was run with more calls, is not
    computed again.
    """
    path = out / "strokes.jsonl" if out else None
    known = _known(path) if path else {}
    rows = []
    for goal in some:
        for seed in seeds:
            for name, method in methods.items():
                tell(f"{goal.name}, seed {seed}: {name}")
                want = {"method": name, "goal": goal.name, "seed": seed, "strokes": len(goal.strokes), "budgets": [*budgets]}
                row = known.get(_key(want))
                if row is None or not set(budgets) <= set(row["budgets"]):
                    row = want | run_one(method, goal, budgets, seed)
                    if path:
                        append_row(path, row)
                rows.append(_up_to(row, budgets))
    return rows


def run_one(method: Method, goal: StrokeGoal, budgets: tuple[int, ...], seed: int) -> Row:
    """One search: at each budget its best plan so far, that plan's l2 reduction and IoU; and the curve of all of them."""
    loss = goal.sand
    began = time.perf_counter()
    found = method(loss, len(goal.strokes), loss.bounds, max(budgets), seed)
    seconds = time.perf_counter() - began
    before = float(((goal.start.astype(float) - goal.goal) ** 2).sum())
    marks = [_at(found.history, budget) for budget in budgets]
    maps = loss.maps(np.stack([found.strokes if mark is None else mark.strokes for mark in marks]))
    at = [
        {
            "budget": budget,
            "iou": goal.iou(after) if mark else 0.0,
            "l2_reduction": 1 - (mark.loss / before) ** 0.5 if mark else 0.0,
            "plan": mark.strokes.tolist() if mark else None,
        }
        for budget, mark, after in zip(budgets, marks, maps, strict=True)
    ]
    curve = [[best.calls, 1 - (best.loss / before) ** 0.5] for best in found.history]
    return {"calls": found.calls, "seconds": seconds, "at": at, "curve": curve}


def reached(rows: list[Row]) -> list[Row]:
    """For each method and budget: on how many goals the IoU of dug cells reaches 0.8 (median over seeds), and the medians
    over goals of the medians over seeds of IoU and l2 reduction."""
    out = []
    for method in dict.fromkeys(row["method"] for row in rows):
        mine = [row for row in rows if row["method"] == method]
        line: Row = {"method": method, "goals": len({row["goal"] for row in mine})}
        for budget in sorted({budget for row in mine for budget in row["budgets"]}):
            ends = at_budget(mine, budget)
            names = dict.fromkeys(row["goal"] for row, _ in ends)
            line[f"seeds_at_{budget}"] = len({row["seed"] for row, _ in ends})
            middle = {
                figure: [median(at[figure] for row, at in ends if row["goal"] == name) for name in names]
                for figure in ("iou", "l2_reduction")
            }
            line[f"reached_at_{budget}"] = sum(iou >= REACHED for iou in middle["iou"])
            line[f"iou_at_{budget}"] = median(middle["iou"])
            line[f"l2_reduction_at_{budget}"] = median(middle["l2_reduction"])
        line["milliseconds_a_call"] = 1e3 * median(row["seconds"] / row["calls"] for row in mine)
        out.append(line)
    return out


def at_budget(rows: list[Row], budget: int) -> list[tuple[Row, Row]]:
    """The rows that were run with so many calls, each with what it had then."""
    return [(row, at) for row in rows for at in row["at"] if at["budget"] == budget]


def bench_strokes(
    tell: Tell = quiet,
    goals: str = "letters",
    calls: int = 4_000,
    seeds: tuple[int, ...] = (0,),
    methods: tuple[str, ...] = (),
    out: Path | None = None,
) -> dict[str, list[Row]]:
    """Runs methods on goals that strokes make, and tabulates how near they come.

    Args:
      tell: is called with a line of progress.
      goals: a kind of `GOALS`.
      calls: how many calls of the simulator a method may make; smaller `BUDGETS` are tabulated too.
      seeds: a run of each method on each goal for every seed.
      methods: names of `METHODS`; none stands for all.
      out: a folder that keeps the runs; those of these goals that are there already are tabulated too.

    Returns:
      `strokes`, a row for each method, as of `reached`; `strokes_by_goal`, a row for each run; and `strokes_curves`, the
      runs themselves with the best so far after every call.

    Raises:
      ValueError: for the name of a method that does not exist.
    """
    unknown = [name for name in methods if name not in METHODS]
    if unknown:
        raise ValueError(f"methods: got {', '.join(map(repr, unknown))}; give some of {', '.join(METHODS)}")
    tell("making the goals")
    chosen = {name: METHODS[name] for name in methods or METHODS}
    budgets = (*(b for b in BUDGETS if b < calls), calls)
    some = GOALS[goals]()
    rows = run_all(chosen, some, budgets, seeds, out, tell)
    if out:
        names = {goal.name for goal in some}
        rows = [row for row in _known(out / "strokes.jsonl").values() if row["goal"] in names]
    return {"strokes": reached(rows), "strokes_by_goal": [_line(row) for row in rows], "strokes_curves": rows}


def found(goals: str, rows: list[Row]) -> list[tuple[str, float, np.ndarray, np.ndarray]]:
    """What the first method and seed had found of each goal in the end: its name, the IoU, and the changes of height (m)
    that the goal and the plan found make."""
    out = []
    mine = {
        row["goal"]: row for row in reversed(rows) if (row["method"], row["seed"]) == (rows[0]["method"], rows[0]["seed"])
    }
    for goal in GOALS[goals]():
        if goal.name in mine and mine[goal.name]["at"][-1]["plan"] is not None:
            plan = np.array(mine[goal.name]["at"][-1]["plan"])
            after = goal.sand.maps(plan[None])[0]
            out.append((goal.name, goal.iou(after), goal.goal - goal.start, after - goal.start))
    return out


def _line(row: Row) -> Row:
    found = {f"strokes_at_{at['budget']}": len(at["plan"] or ()) for at in row["at"]}
    return (
        {key: row[key] for key in ("method", "goal", "strokes", "seed")}
        | found
        | {f"iou_at_{at['budget']}": at["iou"] for at in row["at"]}
    )


def _up_to(row: Row, budgets: tuple[int, ...]) -> Row:
    """What a run had at each of some of its budgets."""
    curve = [point for point in row["curve"] if point[0] <= max(budgets)]
    return row | {"budgets": [*budgets], "at": [at for at in row["at"] if at["budget"] in budgets], "curve": curve}


def _at(history: list[Best], budget: int) -> Best | None:
    return next((best for best in reversed(history) if best.calls <= budget), None)


def _key(row: Row) -> tuple[Any, ...]:
    return row["method"], row["goal"], row["seed"], row["strokes"]


def _known(path: Path) -> dict[tuple[Any, ...], Row]:
    """The rows of a file by their keys, of several those with most calls."""
    rows = known_rows(path, {"method", "goal", "seed", "strokes", "budgets", "at", "curve"})
    return {_key(row): row for row in sorted(rows, key=lambda row: max(row["budgets"]))}
