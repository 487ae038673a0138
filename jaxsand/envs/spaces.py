"""What an action or an observation may be: boxes, choices, and dictionaries of these."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import jax
import jax.numpy as jnp


@dataclass(frozen=True)
class Box:
    """The space of arrays of a shape and dtype with every entry between two bounds.

    Args:
      low: the lower bound, or -inf.
      high: the upper bound, or inf.
      shape: of the arrays.
      dtype: of the arrays.

    Example:
      >>> import jax
      >>> import jaxsand as js
      >>> box = js.env.Box(-1, 1, (4,))
      >>> bool(box.contains(box.sample(jax.random.key(0))))
      True
    """

    low: float
    high: float
    shape: tuple[int, ...]
    dtype: Any = jnp.float32

    def sample(self, key: jax.Array) -> jax.Array:
        """Draws an array: uniform between the bounds; where one of them is infinite, normal about the other, or about 0."""
        if math.isfinite(self.low) and math.isfinite(self.high):
            return jax.random.uniform(key, self.shape, self.dtype, self.low, self.high)
        drawn = jax.random.normal(key, self.shape, self.dtype)
        if math.isfinite(self.low):
            return self.low + jnp.abs(drawn)
        return self.high - jnp.abs(drawn) if math.isfinite(self.high) else drawn

    def contains(self, x: jax.typing.ArrayLike) -> jax.Array:
        """Whether x has the shape and lies within the bounds."""
        x = jnp.asarray(x)
        if x.shape != self.shape:
            return jnp.zeros((), bool)
        return jnp.all((x >= self.low) & (x <= self.high))


@dataclass(frozen=True)
class Discrete:
    """The space of the whole numbers from 0 to n - 1.

    Args:
      n: how many.

    Example:
      >>> import jaxsand as js
      >>> bool(js.env.Discrete(4).contains(4))
      False
    """

    n: int
    shape: tuple[int, ...] = field(default=(), init=False)
    dtype: Any = field(default=jnp.int32, init=False)

    def sample(self, key: jax.Array) -> jax.Array:
        """Draws a number."""
        return jax.random.randint(key, (), 0, self.n, self.dtype)

    def contains(self, x: jax.typing.ArrayLike) -> jax.Array:
        """Whether x is one of the numbers."""
        x = jnp.asarray(x)
        if x.shape != () or not jnp.issubdtype(x.dtype, jnp.integer):
            return jnp.zeros((), bool)
        return (x >= 0) & (x < self.n)


@dataclass(frozen=True)
class Dict:
    """The space of dictionaries, with a space for each key.

    Args:
      spaces: the spaces by key.

    Example:
      >>> import jax
      >>> import jaxsand as js
      >>> space = js.env.Dict({"goal": js.env.Box(0, 1, (7, 7))})
      >>> space.sample(jax.random.key(0))["goal"].shape
      (7, 7)
    """

    spaces: Mapping[str, Any]

    def sample(self, key: jax.Array) -> dict[str, Any]:
        """Draws a dictionary."""
        keys = jax.random.split(key, len(self.spaces))
        return {name: space.sample(k) for (name, space), k in zip(self.spaces.items(), keys, strict=True)}

    def contains(self, x: Mapping[str, Any]) -> jax.Array:
        """Whether x has the keys, and each entry lies in its space."""
        if set(x) != set(self.spaces):
            return jnp.zeros((), bool)
        return jnp.all(jnp.stack([space.contains(x[name]) for name, space in self.spaces.items()]))


Space = Box | Discrete | Dict
