"""A goal that says what matters: a height map, and what it costs where sand stands above it or below it."""

from dataclasses import dataclass, field
from typing import Any, Literal, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike

from jaxsand.goals.metrics import fits_where_it_counts
from jaxsand.scene.masked import gaps
from jaxsand.scene.scene import Scene
from jaxsand.scene.validation import concrete, short

Power = Literal[1, 2]
Maps = TypeVar("Maps", np.ndarray, jax.Array)
"""Arrays of numpy or of JAX: what is given says what is returned."""


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Goal:
    """A height map to be reached, and what each cell costs where the sand stands too high or too low.

    With p the power, the cost of a map h is

        J(h) = sum_ij  a_ij max(h_ij - g_ij, 0)^p + b_ij max(g_ij - h_ij, 0)^p,

    and its distance from the goal J^(1/p), which for weights of 1 and p = 2 is the l2 distance. A cell with a = b = 0 is
    free, and so is one whose goal is NaN: any height will do there. Where a = 0 and b = 1, heaps may lie, but holes may not.

    Args:
        height: g [H, W] (m), with g[i, j] at x = (j + 1/2) dx, y = (i + 1/2) dx; or maps [B, H, W].
        above: a, the weight of sand above the goal, 0 or more: a number or a map [H, W]; or maps [B, H, W].
        below: b, the weight of sand below the goal, 0 or more: likewise.
        power: p, 2 or 1. Squares spread what is left evenly; with 1 the cost is a mean difference, and a few cells may be
            far off.

    `cost` and `distance` take numpy or JAX arrays, and are differentiable in the heights, the goal and the weights, but not
    at the goal: `distance`, and `cost` with p = 1, have a kink there, and a derivative of 0.

    Raises:
        ValueError: for another power, or a list that is no array of numbers.

    Example:
        >>> import jax.numpy as jnp
        >>> import jaxsand as js
        >>> goal = js.Goal(jnp.array([[-0.02, 0.0]]), above=jnp.array([[1.0, 0.0]]))  # the heap beside the hole is free
        >>> print(f"{goal.distance(jnp.array([[-0.02, 0.02]])):.3f} {goal.distance(jnp.array([[0.0, 0.0]])):.3f}")
        0.000 0.020
    """

    height: ArrayLike
    above: ArrayLike = 1.0
    below: ArrayLike = 1.0
    power: Power = field(default=2, metadata={"static": True})

    def __post_init__(self) -> None:
        if not isinstance(self.power, int | float) or self.power not in (1, 2):
            raise ValueError(f"goal.power: got {short(self.power)}; give 1 or 2")
        for name in ("height", "above", "below"):
            value: Any = getattr(self, name)
            if isinstance(value, list | tuple | np.ma.MaskedArray):
                try:
                    object.__setattr__(self, name, np.asarray(gaps(value)))
                except ValueError:
                    raise ValueError(f"goal.{name}: got rows of different lengths; give a map [H, W]") from None

    @property
    def free(self) -> Any:
        """Which cells may have any height.

        Returns:
            Booleans [H, W], or [B, H, W] for a batch of goals.
        """
        return _space(self.height).isnan(self.height) | ((self.above == 0) & (self.below == 0))

    def off(self, height: Maps) -> Maps:
        """How far a map stands from the goal where that costs.

        Args:
            height: [..., H, W] (m).

        Returns:
            [..., H, W] (m): above 0 where the sand is too high, below 0 where it is too low, and 0 where that costs nothing.
            `height - off(height)` is the nearest map that costs nothing. A height that is not finite stays so.
        """
        xp, apart = _space(height, self.height), self.apart(height)
        costs = ((apart > 0) & (xp.asarray(self.above) > 0)) | ((apart < 0) & (xp.asarray(self.below) > 0))
        return xp.where(costs | ~xp.isfinite(apart), apart, 0)

    def apart(self, height: Maps) -> Maps:
        """How far a map stands above the goal, whether or not that costs.

        Args:
            height: [..., H, W] (m).

        Returns:
            [..., H, W] (m), 0 where the goal is NaN.
        """
        xp = _space(height, self.height)
        return height - xp.where(xp.isnan(self.height), height, self.height)

    def weight(self, off: Maps) -> Maps:
        """The weight that differences of these signs have.

        Args:
            off: differences [..., H, W] (m), as of `apart`.

        Returns:
            [..., H, W]: the weight `above` where `off` is above 0, else `below`.
        """
        return _space(off, self.above, self.below).where(off > 0, self.above, self.below)

    def residual(self, height: Maps) -> tuple[Maps, Maps]:
        """Differences such that the cost is sum |r|^p, for methods of least squares.

        Args:
            height: [..., H, W] (m).

        Returns:
            r [..., H, W], and their derivatives by the heights, 0 beside a kink at the goal.
        """
        off = self.off(height)
        rate = self.weight(off) ** (1 / self.power)
        xp = _space(off, rate)
        one = xp.asarray(self.above) == xp.asarray(self.below)
        return off * rate, xp.where((off == 0) & ~one, 0, rate)  # beside a kink, a cell at the goal may go either way

    def cost(self, height: Maps) -> Maps:
        """What a map costs, J.

        Args:
            height: [..., H, W] (m).

        Returns:
            [...] (m^2, or m for p = 1).
        """
        apart = self.apart(height)
        size = apart**2 if self.power == 2 else abs(apart)
        return (self.weight(apart) * size).sum((-2, -1))

    def slope(self, height: Maps) -> Maps:
        """The derivative of the cost by the heights.

        Args:
            height: [..., H, W] (m).

        Returns:
            [..., H, W] (m, or a number for p = 1), 0 at the goal.
        """
        off = self.off(height)
        return self.weight(off) * (2 * off if self.power == 2 else _space(off).sign(off))

    def distance(self, height: Maps) -> Maps:
        """How far a map is from the goal, J^(1/p).

        Args:
            height: [..., H, W] (m).

        Returns:
            [...] (m), 0 at the goal.
        """
        cost = self.cost(height)
        if self.power == 1:
            return cost
        xp = _space(cost)
        return xp.where(cost == 0, 0, xp.sqrt(xp.where(cost == 0, 1, cost)))


def as_goal(scene: Scene, goal: Goal | ArrayLike, name: str = "goal") -> Goal:
    """A user's goal for the scene, as numpy maps of floats: NaN in every free cell, and weights of the grid's shape.

    Raises:
      ValueError: if a map has another shape or an infinite cell, a weight is below 0, no cell counts, or the power is
        neither 1 nor 2.
    """
    given = goal if isinstance(goal, Goal) else Goal(goal)
    height = np.array(gaps(given.height)) if not isinstance(given.height, Goal) else np.array(None)
    if height.dtype.kind not in "fiub":
        raise ValueError(f"{name}: got {type(given.height).__name__}; give a height map [H, W] of numbers (m)")
    height = height.astype(float)
    above, below = (_weights(f"{name}.{side}", getattr(given, side), scene) for side in ("above", "below"))
    if height.shape == scene.grid.shape:
        height = np.where((above == 0) & (below == 0), np.nan, height)
    fits_where_it_counts(scene, height, name)
    free = np.isnan(height)
    return Goal(height, np.where(free, 0, above), np.where(free, 0, below), given.power)


def _weights(name: str, value: ArrayLike, scene: Scene) -> np.ndarray:
    """Weights as a map; ValueError unless they are finite and 0 or more."""
    array = concrete(value)
    shape = scene.grid.shape
    if array is None or array.shape not in ((), shape) or not np.all(np.isfinite(array) & (array >= 0)):
        raise ValueError(f"{name}: got {short(value)}; give a weight of 0 or more, or a map of them of shape {list(shape)}")
    return np.broadcast_to(array.astype(float), shape)


def _space(*arrays: Any) -> Any:
    """JAX's numpy if one of them is JAX's, else numpy."""
    return jnp if any(isinstance(a, jax.Array) for a in arrays) else np
