"""Zones that the tool may not enter: none, or cells at whose edge a stroke ends, or that no stroke may meet."""

from dataclasses import dataclass
from typing import TypeVar

import jax
import jax.numpy as jnp
from jax import lax

from jaxsand.interaction.obstacles import free_way
from jaxsand.scene.grid import Grid
from jaxsand.scene.tools import Number

Told = dict[str, jax.Array]
"""What `info` says of zones: nothing where there are none."""
Tree = TypeVar("Tree")
_LEAST = 1e-2  # spacings: a stroke that would be clipped to less is not made


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class NoZones:
    """Tells an environment that its tool may go anywhere, the default, which costs nothing.

    Example:
      >>> import numpy as np
      >>> import jaxsand as js
      >>> js.make("multi-stroke", goals=np.zeros((1, 32, 32)))[1].zones
      NoZones()
    """

    def way(self, stroke: jax.Array, grid: Grid, width: Number, thickness: Number) -> tuple[jax.Array, Told]:
        """The stroke [4] or [6] (m) as it is, and nothing to tell."""
        del grid, width, thickness
        return stroke, {}

    def over(self, point: jax.Array, grid: Grid) -> Told:
        """Nothing to tell of a point x, y (m)."""
        del point, grid
        return {}


def _over(zones: "ClippedBy | RefusedBy", point: jax.Array, grid: Grid) -> Told:
    """Whether a bucket may be emptied over a point x, y (m): sand falls on none of the zones' cells then."""
    return {"poured": ~free_way(zones.cells, grid, point, point, grid.spacing, grid.spacing)[0]}


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class ClippedBy:
    """Tells an environment that a stroke ends where its tool's footprint would first enter a zone.

    Where that is, is exact, and differentiable in the stroke; heights end where they are by then. A stroke whose tool would
    come down on a zone, or be clipped to less than a hundredth of a spacing, is not made. The footprint is a blade's; of a
    bucket it is its edge, behind which it hangs above the sand. `info` holds "clipped", whether the stroke met a zone, and
    "went", the share of its way that was made, 0 to 1; 0 leaves the map as it was. Zones keep the tool out; sand may flow
    there. A scene's walls hold no sand, but let tools pass, unless their cells are given here too.

    Args:
      cells: booleans [H, W], true where the tool may not be.

    Example:
      >>> import jax
      >>> import jax.numpy as jnp
      >>> import numpy as np
      >>> import jaxsand as js
      >>> cells = np.arange(32) >= np.full((32, 1), 16)  # the right half
      >>> env, params = js.make("multi-stroke", goals=np.zeros((1, 32, 32)), zones=js.env.ClippedBy(cells))
      >>> obs, state = env.reset(jax.random.key(0), params)
      >>> action = env.action(jnp.array([0.0525, 0.16, 0.2525, 0.16]), params)
      >>> info = env.step_env(jax.random.key(1), state, action, params)[-1]
      >>> bool(info["clipped"]), f"{info['went']:.2f}"  # the blade's front is 0.0075 m ahead of its middle
      (True, '0.50')
    """

    cells: jax.Array

    def way(self, stroke: jax.Array, grid: Grid, width: Number, thickness: Number) -> tuple[jax.Array, Told]:
        """The part of a stroke [4] or [6] (m) that is made, and what to tell."""
        start, stop = stroke.reshape(2, -1)
        met, share = free_way(self.cells, grid, start[:2], stop[:2], width, thickness)
        left = lax.stop_gradient(share * jnp.hypot(*(stop - start)[:2]))  # of a shorter way floats do not tell the heading
        share = jnp.where(met & (left < _LEAST * grid.spacing), 0, share)
        made = jnp.concatenate([start, jnp.where(met, start + share * (stop - start), stop)])
        return made, {"clipped": met, "went": share}

    over = _over


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class RefusedBy:
    """Tells an environment that a stroke whose tool's footprint would enter a zone anywhere is not made at all.

    `info` holds "clipped" and "went" as with `ClippedBy`, of which "went" is 0 or 1.

    Args:
      cells: booleans [H, W], true where the tool may not be.

    Example:
      >>> import numpy as np
      >>> import jaxsand as js
      >>> zones = js.env.RefusedBy(np.zeros((32, 32), bool))
      >>> js.make("multi-stroke", goals=np.zeros((1, 32, 32)), zones=zones)[1].zones.cells.shape
      (32, 32)
    """

    cells: jax.Array

    def way(self, stroke: jax.Array, grid: Grid, width: Number, thickness: Number) -> tuple[jax.Array, Told]:
        """The stroke [4] or [6] (m) as it is, and what to tell."""
        start, stop = stroke.reshape(2, -1)
        met, _ = free_way(self.cells, grid, start[:2], stop[:2], width, thickness)
        return stroke, {"clipped": met, "went": jnp.where(met, 0, jnp.ones_like(start[0]))}

    over = _over


Zones = NoZones | ClippedBy | RefusedBy


def kept(told: Told, name: str, before: Tree, after: Tree) -> Tree:
    """What an action leaves: `after` where it was made as what is told says under `name`, else `before`."""
    if name not in told:
        return after
    return jax.tree.map(lambda old, new: jnp.where(told[name] > 0, new, old), before, after)
