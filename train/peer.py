"""Goals such as those of Kreis et al. 2025 (arXiv:2509.06469), rectangles, L shapes and polygons, dug by several methods.

    python -m train.peer [--goals N] [--strokes N] [--pushes N] [--methods NAME ...] [--seed K] [--json]

A bed of 60 x 30 cells of 10 mm, 30 degrees; rectangles 40 to 60 mm wide and L shapes of 60 to 100 mm, 5 to 20 mm deep,
polygons 10 to 30 mm deep. The blade here goes as deep as the goal. Their tool is another one, and what they average over is
not known in every detail, so their figures are a yardstick and this is no race.
"""

import math
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.path import Path as Outline

from jaxsand.bench.tables import as_table
from jaxsand.cli.arguments import Parser, count, ended, seed
from jaxsand.cli.files import as_json, progress
from jaxsand.planning.gradient import optimise_strokes
from jaxsand.planning.learned.policy import load_policy
from jaxsand.planning.learned.stages import Stages, plan_by_policy
from jaxsand.planning.search import plan_sand
from jaxsand.planning.stroke_loss import SandLoss, sand_loss
from jaxsand.relaxation.stopping import check_whole
from jaxsand.scene.grid import places
from jaxsand.scene.progress import Tell
from jaxsand.scene.scene import Scene, make_scene
from jaxsand.scene.tools import Blade

_SHAPE, _SPACING, _ANGLE = (30, 60), 0.01, math.radians(30)
_CHANGED = 0.1  # of the goal's depth
PUBLISHED = [
    {"method": "Kreis et al. 2025, as published", "mm": 3.4, "changed_percent": 97.0, "strokes": 23.5},
    {"method": "their coverage paths, as published", "mm": 4.8},
    {"method": "their random actions, as published", "mm": 7.2},
]


@dataclass(frozen=True)
class PeerGoal:
    """A goal: level sand with a shape dug out of it, `goal` [H, W] (m), and its scene."""

    name: str
    scene: Scene
    goal: np.ndarray


def peer_goals(number: int, key: int) -> list[PeerGoal]:
    """Rectangles, L shapes and polygons in turn, at random places of the bed."""
    rng = np.random.default_rng(key)
    makers = {"rectangle": _rectangle, "L": _corner, "polygon": _polygon}
    out = []
    for k in range(number):
        name = list(makers)[k % len(makers)]
        corners = makers[name](rng)
        depth = rng.uniform(0.01, 0.03) if name == "polygon" else rng.uniform(0.005, 0.02)
        low, high = corners.min(0), corners.max(0)
        room = np.array(_SHAPE[::-1]) * _SPACING - 0.04
        corners = corners - low + 0.02 + rng.random(2) * np.maximum(room - (high - low), 0)
        x, y = places(_SHAPE, _SPACING)
        inside = Outline(corners).contains_points(np.stack([x.ravel(), y.ravel()], 1)).reshape(_SHAPE)
        scene = make_scene(_SHAPE, _SPACING, _ANGLE, tool=Blade(depth=depth))
        out.append(PeerGoal(f"{name} {k // len(makers) + 1}", scene, np.where(inside, -depth, 0.0).astype(np.float32)))
    return out


def _rectangle(rng: np.random.Generator) -> np.ndarray:
    width, length = rng.uniform(0.04, 0.06), rng.uniform(0.06, 0.2)
    return np.array([[0, 0], [length, 0], [length, width], [0, width]])


def _corner(rng: np.random.Generator) -> np.ndarray:
    (a, b), wide = rng.uniform(0.06, 0.1, 2), 0.03
    return np.array([[0, 0], [a, 0], [a, wide], [wide, wide], [wide, b], [0, b]])


def _polygon(rng: np.random.Generator) -> np.ndarray:
    angles = np.sort(rng.uniform(0, 2 * math.pi, 6))
    return rng.uniform(0.03, 0.07, 6)[:, None] * np.stack([np.cos(angles), np.sin(angles)], 1)


def methods(most: int, pushes: int, key: int) -> dict[str, Callable[[SandLoss], np.ndarray]]:
    """Methods that find strokes [N, 4] (m), at most `most`; gradients and the search cost at most `pushes` pushes."""
    policy = load_policy()
    return {
        "policy, looking ahead": lambda s: plan_by_policy(policy, s, most, Stages(width=6)).strokes,
        "the same, then gradients": lambda s: plan_by_policy(policy, s, most, Stages(6, pushes)).strokes,
        "plan_sand": lambda s: plan_sand(s.scene, s.start, s.goal, strokes=most, budget=pushes, seed=key).strokes,
        "optimise_strokes": lambda s: optimise_strokes(s.scene, s.goal, strokes=most, key=key, budget=pushes).strokes,
    }


def judged(goal: PeerGoal, height: np.ndarray) -> dict[str, float]:
    """The figures of a result.

    Over the goal's cells: the mean height difference (mm) after and before, and the share (%) that changed by more than a
    tenth of the depth. And the mean difference (mm) over the whole bed, berms too.
    """
    dig = goal.goal < 0
    depth = -float(goal.goal.min())
    return {
        "mm": 1e3 * float(np.abs(height - goal.goal)[dig].mean()),
        "before_mm": 1e3 * depth,
        "changed_percent": 100 * float((np.abs(height[dig]) > _CHANGED * depth).mean()),
        "bed_mm": 1e3 * float(np.abs(height - goal.goal).mean()),
    }


def compare(
    number: int, most: int, pushes: int, key: int, tell: Tell, only: list[str] | None = None
) -> list[dict[str, Any]]:
    """A row for each method with means over the goals, and the published figures.

    Raises:
      ValueError: for a method that does not exist.
    """
    found = methods(most, pushes, key)
    for name in only or ():
        if name not in found:
            raise ValueError(f"methods: got {name!r}; give some of {', '.join(map(repr, found))}")
    goals = peer_goals(number, key)
    rows = []
    for name in only or found:
        find = found[name]
        figures, began = [], time.perf_counter()
        for goal in goals:
            tell(f"{name}: {goal.name}")
            sand = sand_loss(goal.scene, np.zeros(_SHAPE, np.float32), goal.goal)
            plan = find(sand)
            height = sand.maps(plan[None])[0] if len(plan) else sand.start
            figures.append(judged(goal, height) | {"strokes": float(len(plan))})
        means = {key: float(np.mean([f[key] for f in figures])) for key in figures[0]}
        rows.append({"method": name, **means, "seconds": (time.perf_counter() - began) / number})
    return [*rows, *PUBLISHED]


def main(arguments: list[str] | None = None) -> int:
    """Compares the methods and prints the table; returns the exit code."""
    parser = Parser(prog="python -m train.peer", description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--goals", type=count, default=12, metavar="N", help="goals (12)")
    parser.add_argument(
        "--strokes", type=count, default=24, metavar="N", help="at most so many (24, about as many as theirs)"
    )
    parser.add_argument(
        "--pushes", type=count, default=4000, metavar="N", help="pushes a goal for searches and gradients (4000)"
    )
    parser.add_argument("--methods", nargs="+", metavar="NAME", help="only these (all; a wrong name lists them)")
    parser.add_argument("--seed", type=seed, default=0, metavar="K")
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    options = parser.parse_args(arguments)

    def show() -> None:
        check_whole("strokes", options.strokes, 1, 100)
        rows = compare(options.goals, options.strokes, options.pushes, options.seed, progress(), options.methods)
        print(as_json({"rows": rows}) if options.json else "\n".join(as_table(rows, "method")))

    return ended(show)


if __name__ == "__main__":
    sys.exit(main())
