"""Goals that say what matters, inside an environment: how a pool holds them, and what an agent sees of them."""

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxsand.envs.spaces import Box
from jaxsand.goals.goal import Goal, as_goal
from jaxsand.scene.masked import gaps
from jaxsand.scene.scene import Scene
from jaxsand.scene.validation import concrete

Wanted = jax.Array | Goal
"""Goals [..., H, W] (m): plain maps, or a `Goal` of such whose weights are numbers or maps of the same shape."""


def heights(goal: Any) -> Any:
    """The maps [..., H, W] (m) of plain goals or of goals with weights."""
    return goal.height if isinstance(goal, Goal) else goal


def chosen(goals: Wanted, i: jax.Array) -> Any:
    """The i-th goal [H, W] of a pool [G, H, W], with its weights where it has some."""
    return jax.tree.map(lambda x: x[i] if jnp.ndim(x) else x, goals)


def shown_weights(goal: Wanted) -> dict[str, Any]:
    """The weights that an agent has to see: those that are maps."""
    if isinstance(goal, Goal) and jnp.ndim(goal.above) == jnp.ndim(goal.height):
        return {"above": goal.above, "below": goal.below}
    return {}


def shown(goal: Wanted, height: jax.Array, depth: Any) -> dict[str, Any]:
    """What an agent sees of a goal and the sand: both in units of a tool's depth, and weights that are maps (float32)."""
    maps = {"goal": heights(goal) / depth, "current": height / depth} | shown_weights(goal)
    return {name: x.astype(jnp.float32) for name, x in maps.items()}


def shown_spaces(goals: Wanted, shape: tuple[int, int]) -> dict[str, Box]:
    """The spaces of what `shown` gives for goals of a pool."""
    maps = {name: Box(-jnp.inf, jnp.inf, shape) for name in ("goal", "current")}
    return maps | {name: Box(0, jnp.inf, shape) for name in shown_weights(goals)}


def pooled(scene: Scene, goals: Any) -> np.ndarray | Goal:
    """A user's goals for the scene as a pool holds them, in float32: maps [G, H, W] (m), and weights beside them.

    Args:
      scene: the scene.
      goals: a map [H, W] or maps [G, H, W] (m), NaN in free cells; or a `Goal` of such, whose weights are numbers, one map
        [H, W] for all, or maps [G, H, W].

    Returns:
      Plain maps without free cells as they are. Else a `Goal` whose weights are maps too, with 0 for the height and the
      weights of free cells; but they stay numbers where they are given as numbers and no cell is free.

    Raises:
      ValueError: for maps of another shape, an infinite cell, a weight below 0, or a goal in which no cell counts.
    """
    plain = not isinstance(goals, Goal)
    given = Goal(goals) if plain else goals
    height = np.asarray(gaps(given.height))
    if height.ndim not in (2, 3) or not height.size or height.dtype.kind not in "fiub":
        what = f"shape {list(height.shape)}" if height.dtype.kind in "fiub" else f"{height.dtype}"
        raise ValueError(f"goals: got {what}; give a map [H, W], or maps [G, H, W], in metres")
    height = height.reshape(-1, *height.shape[-2:])
    sides = [_for_each(len(height), f"goals.{side}", getattr(given, side)) for side in ("above", "below")]
    own = [as_goal(scene, Goal(g, a, b, given.power), "goals") for g, a, b in zip(height, *sides, strict=True)]
    maps, above, below = (
        np.stack([getattr(one, name) for one in own]).astype(np.float32) for name in ("height", "above", "below")
    )
    free = np.isnan(maps)
    if free.any() or np.ndim(given.above) or np.ndim(given.below):
        return Goal(np.where(free, 0, maps), above, below, given.power)
    return maps if plain else Goal(maps, above[0, 0, 0], below[0, 0, 0], given.power)


def _for_each(count: int, name: str, weights: Any) -> Sequence[Any]:
    """The weights of each of several goals."""
    array = concrete(weights)
    if array is None or array.ndim != 3:
        return [weights] * count
    if len(array) != count:
        raise ValueError(f"{name}: got {len(array)} maps for {count} goals; give one map [H, W] for all, or one for each")
    return list(array)
