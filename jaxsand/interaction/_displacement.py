"""Displacement: where the sand goes that a tool pushes out of cells.

Whenever the share of a cell that the tool covers grows from a to b, the share (b - a) / (1 - a) of its sand above the tool's
bottom has to leave. It goes to the one or two of the eight neighbouring cells that lie in the direction of displacement,
divided between them by angle. Every amount is a whole number of quanta (see ghost_cells.py), which conserves volume.
"""

from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxsand.autodiff.while_loop import Tree, repeat
from jaxsand.interaction._contact_sweeps import Beside
from jaxsand.relaxation.flux import tool_in_sand
from jaxsand.relaxation.ghost_cells import Bed, ExactSum, truncate
from jaxsand.relaxation.sweep import Flow

EIGHT = tuple((di, dj) for di in (-1, 0, 1) for dj in (-1, 0, 1) if di or dj)
Shares = list[jax.Array]


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Carried:
    """Sand that moves on from under a tool, cell by cell (quanta).

    Attributes:
        height: of each cell.
        lost: what each has lost over a rim, or None where the edge is closed.
        carried: what is still being carried.
    """

    height: jax.Array
    lost: jax.Array | None
    carried: jax.Array


def none_carried(params: Tree, k: jax.Array, state: Carried) -> jax.Array:
    """Whether no sand is being carried any more."""
    return ~jnp.any(state.carried > 0)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Site:
    """A tool at the start of a leg, and the bed that it moves over: what every part of a push needs.

    Attributes:
        bed: spacing, largest stable steps and rim.
        x, y: coordinates of the cell centres (m).
        tool: the blade or wheel.
        bottom: height of the tool's lowest point at the start of a leg (m).
        rise: slope at which that rises along the leg, a tangent, or None if it stays at one height.
        flow: rate and quantum of sweeps.
        room: sum of heights (m) that the tool's bucket can still take up, or None if it has none.
    """

    bed: Bed
    x: Float[Array, "1 W"]
    y: Float[Array, "H 1"]
    tool: Any
    bottom: Float[Array, ""]
    rise: Float[Array, ""] | None
    flow: Flow
    room: Float[Array, ""] | None = None


def take(site: Site, h: jax.Array, before: jax.Array, cover: jax.Array) -> tuple[jax.Array, jax.Array]:
    """The height left and the height taken of each cell, as the footprint grows from `before` to `cover`."""
    grown = cover > before
    share = jnp.where(grown, (cover - before) / jnp.where(grown, 1 - before, 1), 0)
    taken = whole(site, share * jnp.where(h > site.bottom, h - site.bottom, 0))
    return h - taken, taken


def shares(p: jax.Array, q: jax.Array) -> Shares:
    """The shares of the eight neighbours for displacement along (p, q), p along x and q along y, |p| and |q| at most 1.

    They are bilinear weights; the part that would stay in place goes to the four straight neighbours in equal shares.
    """
    columns = {-1: jnp.maximum(-p, 0), 0: 1 - jnp.abs(p), 1: jnp.maximum(p, 0)}
    rows = {-1: jnp.maximum(-q, 0), 0: 1 - jnp.abs(q), 1: jnp.maximum(q, 0)}
    stay = rows[0] * columns[0] / 4
    return [rows[di] * columns[dj] + (stay if di == 0 or dj == 0 else 0) for di, dj in EIGHT]


def contact(site: Site, cover: jax.Array, h: jax.Array) -> jax.Array:
    """How much the blade is in contact with sand: 1 in the sand, falling to 0 a spacing above it or where it covers no cell.

    Rates are multiplied by it, so that a tool that touches nothing moves no sand that is still only to a tolerance.
    """
    above = jnp.where(jnp.isnan(h), -jnp.inf, h) - site.bottom
    near = jnp.clip(1 + jnp.maximum(above, -site.bed.spacing) / site.bed.spacing, 0, 1)
    return jnp.minimum(1, 2 * jnp.max(jnp.max(near * cover, axis=0)))


def settle_around(
    site: Site, flow: Flow, sweeps: int, cover: jax.Array, h: jax.Array, lost: ExactSum | None
) -> tuple[jax.Array, ExactSum | None]:
    """The height and the losses after some sweeps of the sand around a blade whose footprint is `cover`."""
    return repeat(Beside(sweeps), 1, (site.bed, flow, tool_in_sand(cover, site.bottom)), (h, lost))


def whole(site: Site, amount: jax.Array) -> jax.Array:
    """The amount (m) cut to whole quanta."""
    return truncate(amount / site.flow.quantum) * site.flow.quantum
