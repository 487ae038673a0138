"""Plans strokes for a goal by trying them on simulated sand: by search, by gradients, or by the shipped policy."""

from collections.abc import Iterable
from dataclasses import replace

import numpy as np

from jaxsand.planning.gradient import Optimised, optimise_strokes
from jaxsand.planning.learned.policy import load_policy
from jaxsand.planning.learned.stages import Planned, Stages, plan_by_policy
from jaxsand.planning.pipeline import at_rest
from jaxsand.planning.search import SandPlan, plan_sand
from jaxsand.planning.search.actions import Lattice, Rising
from jaxsand.planning.stroke_loss import sand_loss
from jaxsand.planning.targets import Target
from jaxsand.scene.progress import Tell
from jaxsand.scene.scene import Scene, blade_of
from jaxsand.scene.tools import Blade

_WIDTHS = (0.5, 2.0)  # of the blades to choose from beside the target's own, in that one's
_THICKNESS = 1.5  # spacings


def searched(target: Target, before: np.ndarray | None, strokes: int, pushes: int, seed: int, tell: Tell) -> Target:
    """The target with at most `strokes` strokes from a search on real sand, which costs at most `pushes` pushes (see
    `plan_sand`).

    For a glyph they are as deep as the blade; for other goals the tool rises and sinks on them, and is the best of three
    blades. The distance counts all sand, berms too, unless the goal has weights.
    """
    scene, start = target.scene, at_rest(target.scene, before, tell)
    tell(f"searching {strokes} strokes in {pushes} pushes")
    level = target.kind == "glyph"
    found = plan_sand(
        scene,
        start,
        target.wanted,
        strokes=strokes,
        actions=Lattice() if level else Rising(),
        budget=pushes,
        seed=seed,
        tools=() if level else _blades(scene),
    )
    return _by("search", replace(target, scene=replace(scene, tool=found.tool or scene.tool)), found, found.paths)


def _blades(scene: Scene) -> tuple[Blade, ...]:
    """Blades as wide as the scene's, half and twice as wide; none narrower than a cell, or wider than the shorter side."""
    blade, spacing = blade_of(scene), float(scene.grid.spacing)
    own, most = float(blade.width), min(scene.grid.shape) * spacing
    widths = [own, *(times * own for times in _WIDTHS if spacing <= times * own <= most)]
    return tuple(Blade(width=width, thickness=_THICKNESS * spacing, depth=0.0) for width in widths)


def optimised(target: Target, before: np.ndarray | None, strokes: int | None, pushes: int, seed: int, tell: Tell) -> Target:
    """The target with `strokes` strokes (None: as many as pay) from gradients, which cost at most `pushes` pushes."""
    start = at_rest(target.scene, before, tell)
    tell("sketching")
    found = optimise_strokes(target.scene, target.wanted, strokes=strokes, key=seed, start=start, budget=pushes, tell=tell)
    return _by("optimise", target, found, found.strokes.reshape(-1, 2, 2))


def by_policy(target: Target, before: np.ndarray | None, strokes: int, stages: Stages, tell: Tell) -> Target:
    """The target with at most `strokes` strokes of the policy, improved by the stages that follow it."""
    sand = sand_loss(target.scene, at_rest(target.scene, before, tell), target.wanted)
    found = plan_by_policy(load_policy(), sand, strokes, stages, tell)
    return _by("policy", target, found, found.strokes.reshape(-1, 2, 2))


def _by(method: str, target: Target, found: SandPlan | Optimised | Planned, paths: Iterable[np.ndarray]) -> Target:
    """The target with the paths that a method found, compared as they were sought: with berms."""
    return replace(target, method=method, paths=tuple(paths), drawn=False, optimal=None, lower_bound=None, found=found)
