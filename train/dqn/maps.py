"""Random maps drawn as letters are: a few straight lines, across, along or in stairs, each from a cell already dug."""

from dataclasses import dataclass
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from jaxsand.envs.maps import STEPS, MapPool

_FEWEST, _MOST = 6, 16  # lines
_SHORTEST, _LONGEST = 2, 6  # steps of a line
_SECOND = np.array([0, 1, 2, 3, 1, 2, 3, 0])  # a line's odd steps, by its way; its even ones are 0, 1, 2, 3, 0, 1, 2, 3


@dataclass(frozen=True)
class Shapes:
    """Draws six to sixteen lines of two to six steps, cut off at the map's edge.

    A line starts at the last one's end with probability `onward`, else on any cell already dug, and goes in stairs with
    probability `stairs`. A line that would fill a block of 2 x 2 cells is left out with probability `thin`: letters are one
    cell wide. The stroke starts on any cell.
    """

    onward: float = 0.4
    stairs: float = 0.2
    thin: float = 0.9

    def draw(self, key: jax.Array, shape: tuple[int, int]) -> tuple[jax.Array, jax.Array]:
        """A map [H, W] (bool) and its start [2] (row, column)."""
        size = jnp.asarray(shape, jnp.float32)
        chance = jax.random.uniform(key, (1 + _MOST, 6), jnp.float32)  # all at once: each draw takes time to compile
        first = (chance[0, :2] * size).astype(jnp.int32)
        count = _whole(chance[0, 2], _FEWEST, _MOST)

        def one(k: jax.Array, carry: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
            dig, end = carry
            onward, anywhere, way, stairs, steps, thin = chance[1 + k]
            place = jnp.where(onward < self.onward, end, _any_of(anywhere, dig))
            new, there = _line(
                dig, place, _whole(way, 0, 3) + 4 * (stairs < self.stairs), _whole(steps, _SHORTEST, _LONGEST)
            )
            blocked = (_blocks(new) > _blocks(dig)) & (thin < self.thin)
            good = (k < count) & ~blocked
            return jnp.where(good, new, dig), jnp.where(good, there, end)

        dig = jnp.zeros(shape, bool).at[first[0], first[1]].set(True)
        dig = lax.fori_loop(0, _MOST, one, (dig, first))[0]
        return dig, _any_of(chance[0, 3], dig)


@partial(jax.jit, static_argnames=("shapes", "count", "shape"))
def shape_pool(shapes: Shapes, key: jax.Array, count: int, shape: tuple[int, int], barred: jax.Array) -> MapPool:
    """Draws `count` random maps and their starts, none of them among `barred` [N, H, W]; see `among`.

    The first map that is not barred stands in for those that are.
    """
    dig, starts = jax.vmap(lambda k: shapes.draw(k, shape))(jax.random.split(key, count))
    out = among(dig, barred)
    own = jnp.where(out, jnp.argmin(out), jnp.arange(count))
    return MapPool(dig[own], starts[own])


def among(dig: jax.Array, barred: jax.Array) -> jax.Array:
    """Which of the maps [G, H, W] equal one of the maps `barred` [N, H, W] up to a shift, [G]."""
    ours, theirs = jax.vmap(_to_corner)(dig), jax.vmap(_to_corner)(barred)
    return jnp.any(jnp.all(ours[:, None] == theirs[None], axis=(2, 3)), axis=1)


def _to_corner(dig: jax.Array) -> jax.Array:
    """The map shifted up and left as far as it goes."""
    up, left = (jnp.argmax(jnp.any(dig, axis=axis)) for axis in (1, 0))
    return jnp.roll(dig, jnp.stack([-up, -left]), (0, 1))


def _whole(chance: jax.Array, low: int, high: int) -> jax.Array:
    """A whole number from low to high with equal chances, from a number `chance` between 0 and 1."""
    return low + (chance * (high - low + 1)).astype(jnp.int32)


def _any_of(chance: jax.Array, dig: jax.Array) -> jax.Array:
    """The row and column of a true cell with equal chances, from a number `chance` between 0 and 1."""
    rank = jnp.cumsum(dig.ravel())
    which = jnp.argmax(rank > (chance * rank[-1]).astype(rank.dtype))
    return jnp.stack(jnp.divmod(which, dig.shape[1])).astype(jnp.int32)


def _line(dig: jax.Array, place: jax.Array, way: jax.Array, steps: jax.Array) -> tuple[jax.Array, jax.Array]:
    """The map with one more line, and the cell where that ends."""
    both = jnp.asarray(STEPS)[jnp.stack([way % 4, jnp.asarray(_SECOND)[way]])]

    def one(t: jax.Array, carry: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        dig, place = carry
        there = place + both[t % 2]
        good = (t < steps) & jnp.all((there >= 0) & (there < jnp.asarray(dig.shape)))
        place = jnp.where(good, there, place)
        return dig.at[place[0], place[1]].set(True), place

    return lax.fori_loop(0, _LONGEST, one, (dig, place))


def _blocks(dig: jax.Array) -> jax.Array:
    """How many blocks of 2 x 2 cells are true."""
    return jnp.sum(dig[1:, 1:] & dig[:-1, 1:] & dig[1:, :-1] & dig[:-1, :-1])
