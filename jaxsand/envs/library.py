"""Pools of goals for many strokes, made once: of random strokes, glyphs, or height maps, on level or on rough sand."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np

from jaxsand.envs.multi import LevelGoals, MultiStroke, RoughGoals
from jaxsand.envs.weights import heights, pooled
from jaxsand.envs.zones import NoZones, Zones
from jaxsand.goals import metrics
from jaxsand.goals.goal import Goal
from jaxsand.goals.letters import stroke_list
from jaxsand.goals.surfaces import rested, rough_surface
from jaxsand.relaxation.settling import check_at_rest
from jaxsand.scene.masked import gaps
from jaxsand.scene.scene import Scene, blade_of
from jaxsand.scene.validation import short

Tree = TypeVar("Tree")

_TRIES = 16
_GLYPH_MAP = 0.32  # m: the side of the map that the glyphs' square is given for


@dataclass(frozen=True)
class RandomStrokes:
    """Tells `make` to use goals that random strokes leave, within the square in which glyphs lie.

    Args:
      goals: how many goals.
      fewest, most: how many strokes make a goal.
      shortest: the least length of a stroke, as a share of the square's side, up to a half.

    Example:
      >>> import numpy as np
      >>> import jaxsand as js
      >>> plans = js.env.RandomStrokes(goals=2, fewest=3, most=3).plans(np.random.default_rng(0))
      >>> len(plans), plans[0].shape
      (2, (3, 4))
    """

    goals: int = 256
    fewest: int = 1
    most: int = 6
    shortest: float = 0.15

    def plans(self, rng: np.random.Generator) -> list[np.ndarray]:
        """Draws the strokes [n, 4] of the unit square for each goal."""
        if not (self.goals >= 1 and 1 <= self.fewest <= self.most and 0 <= self.shortest <= 0.5):
            raise ValueError(f"goals: got {self}; give one goal or more, 1 <= fewest <= most, and shortest from 0 to 0.5")
        drawn = rng.random((_TRIES, self.goals, self.most, 4))
        long = np.hypot(*np.moveaxis(drawn[..., 2:] - drawn[..., :2], -1, 0)) >= self.shortest
        first = np.argmax(long, axis=0)[None, ..., None]
        strokes = np.take_along_axis(drawn, first, 0)[0]
        numbers = rng.integers(self.fewest, self.most + 1, self.goals)
        return [some[:n] for some, n in zip(strokes, numbers, strict=True)]


@dataclass(frozen=True)
class Level:
    """Tells `make` to begin from level sand at height 0, the default.

    Example:
      >>> import numpy as np
      >>> import jaxsand as js
      >>> env, params = js.make("multi-stroke", goals=np.zeros((1, 32, 32)), starts=js.env.Level())
      >>> params.goals.goals.shape
      (1, 32, 32)
    """


@dataclass(frozen=True)
class Rough:
    """Tells `make` to begin from random surfaces at rest.

    Args:
      relief: from the lowest to the highest point before the surface settles (m).
      scale: over how many cells it is smooth.

    Example:
      >>> import jaxsand as js
      >>> js.env.Rough(relief=0.02).scale
      3.0
    """

    relief: float = 0.01
    scale: float = 3.0


Goals = RandomStrokes | Mapping[str, Any] | np.ndarray | jax.Array | Goal
"""Random strokes, names with strokes [n, 4] of the unit square as a glyph file has them, maps [G, H, W] (m), or a `Goal`."""
Starts = Level | Rough | np.ndarray | jax.Array
"""Level sand, random surfaces, or a map [H, W] or one for each goal [G, H, W] (m)."""


def library(
    env: MultiStroke, scene: Scene, goals: Goals, starts: Starts, seed: int, zones: Zones | None = None
) -> LevelGoals | RoughGoals:
    """Makes the pool of goals that an environment draws from; strokes are pushed as the environment pushes them.

    Args:
      env: the environment.
      scene: grid, sand and blade.
      goals: a `RandomStrokes()`, glyphs {name: strokes [n, 4] of the unit square}, a map [H, W] or maps [G, H, W] (m) with
        NaN in free cells, or a `jaxsand.Goal` of such, whose weights are numbers, a map [H, W] or maps [G, H, W].
      starts: `Level()`, `Rough()`, or sand at rest: a map [H, W], or one for each goal [G, H, W] (m).
      seed: of all that is drawn.
      zones: where the blade may not be; None for nowhere. Strokes are clipped or refused as the environment does.

    Returns:
      The goals as `LevelGoals`, or with the surfaces that they start from as `RoughGoals`.

    Raises:
      ValueError: for goals of the wrong type, without any goal, or not of the scene's shape, and for such starts.

    Example:
      >>> import numpy as np
      >>> import jaxsand as js
      >>> scene = js.make_scene((8, 8), 0.01, tool=js.Blade())
      >>> pool = js.env.library(js.env.MultiStroke(), scene, np.zeros((2, 8, 8)), js.env.Level(), seed=0)
      >>> pool.goals.shape
      (2, 8, 8)
    """
    rng = np.random.default_rng(seed)
    if isinstance(goals, np.ndarray | jax.Array | Goal):
        wanted = pooled(scene, goals)
        return pool_from(starts, surfaces(scene, starts, len(heights(wanted)), rng), wanted)
    if isinstance(goals, RandomStrokes):
        plans, count = env.heights.drawn(rng, goals.plans(rng)), goals.goals
    elif isinstance(goals, Mapping):
        plans, count = [stroke_list("goals", name, goals[name]) for name in goals], len(goals)
        if not plans:
            raise ValueError("goals: got no glyph; give names with strokes [[x0, y0, x1, y1], ...]")
    else:
        raise ValueError(
            f"goals: got {type(goals).__name__}; give RandomStrokes(), names with strokes, maps [G, H, W], or a Goal of such"
        )
    before = surfaces(scene, starts, count, rng)
    return pool_from(starts, before, _pushed(env, scene, before, plans, zones))


def pool_from(starts: Starts, before: np.ndarray, after: np.ndarray | Goal) -> LevelGoals | RoughGoals:
    """The pool of goals `after` [G, H, W] (m) that are to be made from the surfaces `before`."""
    wanted = jax.tree.map(jnp.asarray, after)
    return LevelGoals(wanted) if isinstance(starts, Level) else RoughGoals(wanted, jnp.asarray(before))


def surfaces(scene: Scene, starts: Starts, count: int, rng: np.random.Generator) -> np.ndarray:
    """The surfaces [count, H, W] (m) to start from, at rest."""
    shape = (count, *scene.grid.shape)
    if isinstance(starts, np.ndarray | jax.Array):
        maps = np.asarray(gaps(starts))
        if maps.dtype.kind not in "fiub" or maps.ndim not in (2, 3) or (maps.ndim == 3 and len(maps) != count):
            raise ValueError(
                f"starts: got {maps.dtype} of shape {list(maps.shape)} for {count} goals; give a map [H, W], or one for "
                "each goal [G, H, W], in metres"
            )
        for start in maps.reshape(-1, *maps.shape[-2:]):
            metrics.fits(scene, start, "starts")
            check_at_rest(scene, start.astype(np.float32), "starts")
        return np.broadcast_to(maps.astype(np.float32), shape)
    if not isinstance(starts, Level | Rough):
        raise ValueError(f"starts: got {short(starts)}; give Level(), Rough(), or maps of sand at rest")
    if isinstance(starts, Level):
        return np.zeros(shape, np.float32)
    if not (0 <= starts.relief < np.inf and 0 < starts.scale < np.inf):
        raise ValueError(f"starts: got {starts}; give a relief of 0 m or more, and a scale above 0 cells")
    return rested(scene, rough_surface(rng, shape, starts.relief, starts.scale))


def _pushed(env: MultiStroke, scene: Scene, maps: np.ndarray, plans: list[np.ndarray], zones: Zones | None) -> np.ndarray:
    """The maps [G, H, W] (m) after the strokes of each plan: [n, 4] of the unit square, or [n, 6] with heights in depths."""
    depth, square = float(blade_of(scene).depth), glyph_square(scene)
    push, around = _program(env), NoZones() if zones is None else zones

    def placed(strokes: np.ndarray) -> np.ndarray:
        ends = strokes.reshape(len(strokes), 2, -1)
        metres = np.concatenate([metrics.place(ends[..., :2], square), ends[..., 2:] * depth], axis=2)
        return metres.reshape(len(strokes), -1)

    after = played(lambda maps, strokes: push(scene, maps, strokes, around), jnp.asarray(maps), list(map(placed, plans)))
    return np.asarray(after)


def played(act: Callable[[Tree, jax.Array], Tree], before: Tree, plans: list[np.ndarray]) -> Tree:
    """What the actions [n, k] of each plan leave, one after the other; `act` takes one action for each of a batch."""
    for k in range(max(map(len, plans))):
        actions = np.stack([some[min(k, len(some) - 1)] for some in plans]).astype(np.float32)
        after = act(before, jnp.asarray(actions))
        due = np.array([k < len(some) for some in plans])

        def kept(old: jax.Array, new: jax.Array, due: np.ndarray = due) -> jax.Array:
            return jnp.where(due.reshape(-1, *[1] * (old.ndim - 1)), new, old)

        before = jax.tree.map(kept, before, after)
    return before


def glyph_square(scene: Scene) -> tuple[float, float]:
    """The lowest and highest x and y (m) of the square on the scene's map in which glyphs and drawn strokes lie."""
    side = min(scene.grid.shape) * float(scene.grid.spacing) / _GLYPH_MAP
    low, high = metrics.GLYPH_SQUARE
    return low * side, high * side


@cache
def _program(env: MultiStroke) -> Callable[[Scene, jax.Array, jax.Array, Zones], jax.Array]:
    def one(scene: Scene, height: jax.Array, stroke: jax.Array, zones: Zones) -> jax.Array:
        return env.pushed(scene, height, stroke, zones)[0]

    return jax.jit(jax.vmap(one, in_axes=(None, 0, 0, None)))
