"""The jvp and vjp of a sweep with 4 or 8 neighbours: links steeper than repose pass tangents on, other links do not.

Such a sweep is piecewise linear; its derivatives are written out in notebooks/site/theory/gradients.md ("A sweep"). Links of
all directions are kept on one lattice [H + 1, W + 1]. At its point (i, j) the cells (i, j) to (i + 1, j + 1) of a map with
ghost cells meet. Two bits for each link say whether it is active, and to which side.
"""

from dataclasses import replace

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxsand.relaxation.ghost_cells import Bed, halo, total
from jaxsand.scene.grid import links

Ghosted = Float[Array, "H+2 W+2"]  # a map with ghost cells
OnLattice = Float[Array, "H+1 W+1"]
Codes = Int[Array, "H+1 W+1"]
Lattice = tuple[OnLattice, ...]  # for each direction of links
_CORNERS = {(0, 1): (0, 1), (1, 0): (0, 2), (1, 1): (0, 3), (1, -1): (1, 2)}


def _corners(u: jax.Array) -> tuple[jax.Array, ...]:
    """The four cells of a map with ghost cells that meet at each point of the lattice."""
    return u[:-1, :-1], u[:-1, 1:], u[1:, :-1], u[1:, 1:]


def pairs(bed: Bed, u: Ghosted) -> list[tuple[OnLattice, OnLattice]]:
    """The values in the first and the second cell of every link, for each direction."""
    cells = _corners(u)
    return [(cells[_CORNERS[di, dj][0]], cells[_CORNERS[di, dj][1]]) for di, dj, _ in links(bed.neighbours)]


def steps(bed: Bed, u: Ghosted) -> Lattice:
    """The step over every link, from its first to its second cell."""
    return tuple(there - here for here, there in pairs(bed, u))


def gains(bed: Bed, flow: Lattice) -> Float[Array, "H W"]:
    """What each cell [H, W] gains from fluxes, which are positive towards the links' first cells."""
    net: jax.Array | float = 0.0
    for (di, dj, _), f in zip(links(bed.neighbours), flow, strict=True):
        beside = _corners(f)  # a cell is corner 3 of the point before it, and corner 0 of its own
        first, second = _CORNERS[di, dj]
        net = net + (beside[3 - first] - beside[3 - second])
    return jnp.asarray(net)


def yields(bed: Bed) -> Lattice | tuple[jax.Array, ...]:
    """The largest stable step over every link; one number for each direction where the angle of repose is a scalar."""
    if not bed.drop.ndim:
        return tuple(bed.drop * length for _, _, length in links(bed.neighbours))
    both = pairs(bed, halo(bed.drop, 0.0))
    return tuple((a + b) * (length / 2) for (a, b), (_, _, length) in zip(both, links(bed.neighbours), strict=True))


def active(bed: Bed, s: Ghosted) -> Codes:
    """Two bits for each link, in the low byte of integers [H + 1, W + 1]: too steep upwards, too steep downwards."""
    code = jnp.zeros((), jnp.int32)
    for k, (d, m) in enumerate(zip(steps(bed, s), yields(bed), strict=True)):
        code = code | jnp.where(d > m, 1 << 2 * k, jnp.where(d < -m, 2 << 2 * k, 0))
    return code


def opened(bed: Bed, gate: Ghosted | None) -> list[jax.Array | float]:
    """The part of a surface's excess that flows over each link at rate 1; `gate` is the open share of each cell."""
    lengths: list[jax.Array | float] = [1 / length for _, _, length in links(bed.neighbours)]
    if gate is None:
        return lengths
    return [jnp.minimum(here, there) * w for (here, there), w in zip(pairs(bed, gate), lengths, strict=True)]


def upward(code: Codes, link: int) -> Bool[Array, "H+1 W+1"]:
    """Whether a link is too steep upwards; see `active`."""
    return (code & (1 << 2 * link)) != 0


def downward(code: Codes, link: int) -> Bool[Array, "H+1 W+1"]:
    """Whether a link is too steep downwards; see `active`."""
    return (code & (2 << 2 * link)) != 0


def moving(code: Codes, link: int) -> Bool[Array, "H+1 W+1"]:
    """Whether a link is too steep to either side; see `active`."""
    return (code & (3 << 2 * link)) != 0


def to_lattice(bed: Bed, flow: tuple[jax.Array, ...]) -> Lattice:
    """Fluxes in the shapes of flux.py, moved to the lattice."""
    along_x, along_y, *diagonal = flow
    return (jnp.pad(along_x, ((1, 0), (0, 0))), jnp.pad(along_y, ((0, 0), (1, 0))), *diagonal)


def from_lattice(bed: Bed, flow: Lattice) -> tuple[jax.Array, ...]:
    """Fluxes on the lattice, in the shapes of flux.py."""
    along_x, along_y, *diagonal = flow
    return (along_x[1:], along_y[:, 1:], *diagonal)


def drop_cotangent(bed: Bed, parts: list[jax.Array]) -> jax.Array:
    """The cotangent of `bed.drop` from those of the largest stable step over every link."""
    if not bed.drop.ndim:
        both = [p * length for p, (_, _, length) in zip(parts, links(bed.neighbours), strict=True)]
        return jnp.sum(jnp.asarray(sum(both)))
    return jax.vjp(lambda drop: yields(replace(bed, drop=drop)), bed.drop)[1](tuple(parts))[0]


def to_less_open(bed: Bed, gate: Ghosted, parts: list[OnLattice]) -> Ghosted:
    """The cotangent of the open shares [H + 2, W + 2], of which the lesser at each link is the share of the link."""
    net: jax.Array | float = 0.0
    for (di, dj, _), (here, there), part in zip(links(bed.neighbours), pairs(bed, gate), parts, strict=True):
        first, second = _CORNERS[di, dj]
        less = here <= there
        net = net + _corners(jnp.where(less, part, 0))[3 - first] + _corners(jnp.where(less, 0, part))[3 - second]
    return halo(jnp.asarray(net), 0.0)


def to_shape(cotangent: jax.Array, like: jax.Array) -> jax.Array:
    """The cotangent of a map or number that was broadcast to a map."""
    return cotangent if like.ndim else total(cotangent)
