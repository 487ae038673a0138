"""What bounds the sand: solid cells inside the map, the map's edge, and the floor under it."""

from dataclasses import dataclass

import jax
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Open:
    """No cell is solid: a map without walls, the default of `make_scene`.

    Example:
        >>> import jaxsand as js
        >>> js.make_scene((8, 8), 0.01).walls
        Open()
    """


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Walls:
    """Solid cells, which hold no sand and let none through.

    The height of a solid cell is never used and is returned unchanged.

    Attributes:
        solid: booleans [H, W], true where the cell is solid.

    Example:
        A wall along column 4 keeps a heap on its own side.

        >>> import jax.numpy as jnp
        >>> import jaxsand as js
        >>> solid = jnp.zeros((8, 8), bool).at[:, 4].set(True)
        >>> scene = js.make_scene((8, 8), 0.01, walls=js.Walls(solid))
        >>> heap = jnp.zeros((8, 8)).at[4, 1].set(0.03)
        >>> float(abs(js.settle(scene, heap).height[:, 5:]).max())
        0.0
    """

    solid: Bool[Array, "H W"]


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Closed:
    """A wall stands along the map's edge, so that no sand leaves: the default of `make_scene`.

    Example:
        >>> import jaxsand as js
        >>> js.make_scene((8, 8), 0.01).edge
        Closed()
    """


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Draining:
    """Sand runs off over the map's edge, whose rim stands half a spacing beyond the centres of the outer cells.

    Sand flows over the rim where it stands higher than repose against it. Results count what left in `drained` (m^3).

    Attributes:
        level: height of the rim (m), a scalar.

    Example:
        A corner cell drains over two sides until it stands at repose against the rim.

        >>> import jax.numpy as jnp
        >>> import jaxsand as js
        >>> scene = js.make_scene((8, 8), 0.01, edge=js.Draining(level=0.0))
        >>> settled = js.settle(scene, jnp.zeros((8, 8)).at[0, 0].set(0.03))
        >>> bool(settled.drained > 0)
        True
    """

    level: Float[Array, ""] | float = 0.0


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Deep:
    """The sand is deeper than any tool reaches: a bed without a floor, the default of `make_scene`.

    Example:
        >>> import jaxsand as js
        >>> js.make_scene((8, 8), 0.01).base
        Deep()
    """


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Base:
    """A floor under the sand: a tray's bottom, rock, concrete. No tool cuts it.

    In each cell the sand is h - base thick, 0 or more. Over a link flows no more than there is: if the fluxes that leave a
    cell sum to more than its thickness, all are reduced in proportion. The floor itself may be steeper than repose; bare, it
    is still. Sand thinner than 1e-4 spacings counts as none when slopes are judged. Where the map lies below the floor there
    is no sand, and outcomes say BELOW_BASE.

    Attributes:
        height: height of the floor (m): one number, or a map [H, W]. Differentiable.

    Example:
        A tray 2 cm deep: a heap slides off a slope of bare rock.

        >>> import jax.numpy as jnp
        >>> import jaxsand as js
        >>> rock = jnp.broadcast_to(0.01 * jnp.maximum(jnp.arange(8.0) - 3, 0), (8, 8))
        >>> scene = js.make_scene((8, 8), 0.01, base=js.Base(rock))
        >>> settled = js.settle(scene, rock.at[4, 6].add(0.01))
        >>> print(f"{settled.height[4, 6] - rock[4, 6]:.6f} {js.volume(scene, settled.height - rock):.1e}")
        0.000000 1.0e-06
    """

    height: Float[ArrayLike, "H W"] | Float[ArrayLike, ""]
