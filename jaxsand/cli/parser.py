"""The command line: degrees, millimetres, files and exit codes.

A command that did its job exits with 0. On bad input it exits with 2 and one line on standard error, `error: field: what is
wrong; what to do`. Arguments are read before JAX is imported, so that --help and mistakes answer at once.
"""

import argparse
import shlex
import sys
from typing import Any

from jaxsand.cli import SCHEMES, run_benchmark, run_plan, run_settle, run_shape, run_trench
from jaxsand.cli.arguments import (
    Parser,
    count,
    draw_without_a_screen,
    ended,
    keep_compiled_programs,
    neighbours,
    number,
    path_name,
    repose,
    seed,
    width,
)


def main(arguments: list[str] | None = None) -> int:
    """Runs one command; returns its exit code. Mistakes in the arguments themselves raise SystemExit(2)."""
    options = _parser().parse_args(arguments)
    options.command_line = shlex.join(["jaxsand", *(sys.argv[1:] if arguments is None else arguments)])
    draw_without_a_screen()
    if options.run is not run_benchmark:  # which tells compile time apart
        keep_compiled_programs()
    return ended(lambda: options.run(options))


def _parser() -> argparse.ArgumentParser:
    parser = Parser(prog="jaxsand", description="Robots that shape sand. Every command answers --help.")
    commands = parser.add_subparsers(metavar="COMMAND", required=True, parser_class=Parser)
    _shape(commands)
    _settle(commands)
    _plan(commands)
    _trench(commands)
    _bench(commands)
    return parser


def _shape(commands: Any) -> None:
    p = commands.add_parser("shape", help="find the strokes that trench a goal, push them, show what came out")
    p.add_argument("goal", help=_GOAL)
    p.add_argument("--method", choices=["plan", "optimise", "policy", "search", "strokes"], help=_METHODS)
    p.add_argument(
        "--strokes",
        type=count,
        metavar="N",
        help="strokes to use at most (a glyph's own number; else optimise: as many as pay, policy: 6, search: 24)",
    )
    p.add_argument(
        "--pushes",
        type=count,
        metavar="N",
        help="most pushes that are tried (optimise: 4000; search: 2000, of a glyph 1000 a stroke; policy: its own, and 4000 "
        "by --refine)",
    )
    p.add_argument(
        "--lookahead",
        type=width,
        metavar="K",
        help="policy: try its K likeliest strokes on K best plans, put the best right",
    )
    p.add_argument("--refine", action="store_true", help="policy: improve its plan by gradients")
    p.add_argument("--seed", type=seed, metavar="K", help="for the random choices of optimise and search (0)")
    p.add_argument("--start", metavar="R,C", help="cell where the stroke starts (row 0 on top), or best")
    p.add_argument("--surface", default="level", help="what lies there before: level, terrain or a .npy file, as the goal")
    p.add_argument("--relief-mm", type=number, default=10.0, help="height range of --surface terrain")
    p.add_argument(
        "--depth-mm",
        type=number,
        help="trench depth (3; 7.5 for .npy, .json and terrain, or as deep as the goal is by search, optimise and policy)",
    )
    p.add_argument("--spacing", type=number, help="grid spacing in m (0.01; a .json gives its own)")
    p.add_argument("--resolution", type=count, help="grid cells to a map cell (6)")
    p.add_argument("--cells", type=count, help="grid cells along the longer side of a .png or terrain (48)")
    p.add_argument("--first-row", choices=["bottom", "top"], help="where the first row of .npy files lies (bottom: y = 0)")
    p.add_argument("--no-data", type=number, metavar="V", help=_NO_DATA)
    p.add_argument(
        "--free",
        type=path_name,
        metavar="MASK",
        help="search, optimise, policy: cells of a .npy goal where any height will do, as its NaN cells: a .png (dark is "
        "free; first row on top) or a .npy of booleans (first row as in the goal)",
    )
    p.add_argument("--live", action="store_true", help="show the sand in the terminal, path by path")
    p.add_argument("--html", action="store_true", help="also write shape.html, which a browser shows: sand to turn and play")
    p.add_argument("--out", type=path_name, metavar="DIR", help="folder to write to (shape-GOAL)")
    p.add_argument("--json", action="store_true", help="print one JSON object")
    p.set_defaults(run=run_shape)


def _settle(commands: Any) -> None:
    p = commands.add_parser("settle", help="let a height map settle to its angle of repose")
    p.add_argument(
        "input", type=path_name, metavar="IN.npy", help="height map [H, W] in m; OUT.npy has its rows in the same order"
    )
    p.add_argument("--out-file", type=path_name, required=True, metavar="OUT.npy")
    p.add_argument("--spacing", type=number, default=0.01, metavar="M", help="grid spacing in m (0.01)")
    p.add_argument("--repose-deg", type=repose, default=29.0, help="angle of repose, in degrees (29)")
    p.add_argument("--neighbours", type=neighbours, choices=[4, 8, "isotropic"], default=8, help="4, 8 or isotropic (8)")
    p.add_argument("--scheme", choices=SCHEMES, default="super-time-stepping", help="relaxation: the paper's sweep")
    p.add_argument("--tol", type=number, default=1e-3, help="largest slope in excess of repose, a tangent (1e-3)")
    p.add_argument("--no-data", type=number, metavar="V", help="cells of this value are solid: -9999, nan, ...")
    p.add_argument("--bound", type=count, default=200_000, help="most sweeps (200000)")
    p.add_argument("--json", action="store_true", help="print one JSON object")
    p.set_defaults(run=run_settle)


def _plan(commands: Any) -> None:
    p = commands.add_parser("plan", help="the shortest single stroke over a binary map")
    p.add_argument("map", metavar="MAP.txt", help="rows of # (dig) and ., S marks the start; or a letter")
    p.add_argument("--start", metavar="R,C", help="cell where the stroke starts (row 0 on top), or best")
    p.add_argument("--end", metavar="R,C", help="cell where the stroke must end (anywhere)")
    p.add_argument("--turn-cost", type=number, default=0.0, metavar="C", help="steps that a change of heading costs (0)")
    p.add_argument("--engine", choices=["auto", "paper", "astar", "exact", "anytime", "frontier"], default="auto")
    p.add_argument("--weight", type=number, metavar="W", help="how much astar and paper overrate what is left (1)")
    p.add_argument("--seconds", type=number, metavar="S", help="time for anytime (10); with auto, use anytime")
    p.add_argument("--out", type=path_name, metavar="DIR", help="folder for a picture of the path, and the report")
    p.add_argument("--json", action="store_true", help="print one JSON object")
    p.set_defaults(run=run_plan)


def _trench(commands: Any) -> None:
    p = commands.add_parser("trench", help="a wheel's trenches, beside their closed form, their exact relaxation and scans")
    p.add_argument("--spacing-mm", type=number, default=2.0, metavar="D", help="grid spacing (2)")
    p.add_argument("--rule", choices=["own", "split"], help="own: the push rule; split: piles as in the closed form (both)")
    columns = "beta_deg, sinkage_mm, scan, x_mm (to the right of the way; the flank that leads is on its left), z_mm"
    p.add_argument("--measured", type=path_name, metavar="CSV", help=f"scans: {columns}")
    p.add_argument("--no-data", type=number, metavar="V", help="heights of this value in the CSV were not seen: -9999, ...")
    p.add_argument("--out", type=path_name, metavar="DIR", help="folder for the profiles, two figures and the report")
    p.add_argument(
        "--html", action="store_true", help="also write trench.html into it: the sand of all trenches, in a browser"
    )
    p.add_argument("--json", action="store_true", help="print one JSON object")
    p.set_defaults(run=run_trench)


def _bench(commands: Any) -> None:
    p = commands.add_parser("bench", help="error against run time, and speed beside plain numpy and plain C")
    p.add_argument(
        "what",
        nargs="?",
        choices=[
            "settle",
            "push",
            "plan",
            "env",
            "grad",
            "calibrate",
            "sand",
            "strokes",
            "trench",
            "all",
            "stability",
            "letters",
            "ramp",
            "tasks",
            "tools",
            "speed",
        ],
        default="all",
    )
    p.add_argument(
        "--batch",
        type=count,
        metavar="N",
        help="maps in a batch (4096; env: 1024; grad: 64, if given larger maps as well; tools: 16)",
    )
    p.add_argument("--grids", type=int, choices=range(4), default=3, help="grids for error against run time; 0: none (3)")
    p.add_argument("--seed", type=seed, default=0, metavar="K", help="of the searches on sand, the first for strokes (0)")
    p.add_argument(
        "--seeds", type=count, metavar="N", help="strokes, tasks: how many seeds, or instances, from that one on (1)"
    )
    p.add_argument("--calls", type=count, metavar="N", help="calls of the simulator (strokes: 4000; tasks: 500)")
    p.add_argument(
        "--goals", metavar="A,B", help="strokes: letters, turned, rough, or eight (letters); tasks: by name (all)"
    )
    p.add_argument("--methods", metavar="A,B", help="strokes, tasks: methods by name (all)")
    p.add_argument("--points", type=count, metavar="N", help="tools: smooth points a tool to check gradients at (64)")
    p.add_argument("--strokes", type=count, metavar="N", help="tasks: at most so many strokes (each task's own number)")
    p.add_argument(
        "--out",
        type=path_name,
        metavar="DIR",
        help="folder for the report and its figure; strokes, tasks and tools go on there",
    )
    p.add_argument("--json", action="store_true", help="print one JSON object")
    p.set_defaults(run=run_benchmark)


_GOAL = (
    "a letter, a .txt map of # and . (first row on top), a .png (dark is dug; first row on top), a .npy height map in m "
    "(first row at the bottom, y = 0; see --first-row), a .json drawing, or terrain"
)
_NO_DATA = (
    "what .npy files hold where nothing is known (-9999, ...); a goal of search, optimise or policy is free in such cells, "
    "else they are refused"
)
_METHODS = (
    "plan: a shortest path (the default for letters and .txt maps); search: strokes tried on real sand (the default for "
    "all that has heights); optimise: strokes by gradients through the sand; policy: what a network learned; strokes: a "
    "glyph's own"
)
