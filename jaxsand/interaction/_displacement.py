"""Where sand goes that a tool displaces.

Whenever the share of a cell that the tool covers grows from a to b, the share (b - a) / (1 - a) of its sand above the
tool's bottom has to leave. It goes to neighbouring cells, to the one or two of the eight that lie in its direction,
shared as the direction divides the angle between them. Every amount is a whole number of quanta (see ghost_cells.py), so
that volume is kept as well as floats allow.
"""

from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp

from jaxsand.autodiff.while_loop import repeat
from jaxsand.interaction._contact_sweeps import Beside
from jaxsand.relaxation.flux import stand
from jaxsand.relaxation.ghost_cells import Bed, Lost, truncate
from jaxsand.relaxation.sweep import Flow

EIGHT = tuple((di, dj) for di in (-1, 0, 1) for dj in (-1, 0, 1) if di or dj)
Shares = list[jax.Array]


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Job:
    """What every part of a push needs: the bed, the cell centres (m), the tool, its bottom's height (m), how sand flows."""

    bed: Bed
    x: jax.Array  # [1, W]
    y: jax.Array  # [H, 1]
    tool: Any  # a Blade or a Wheel
    bottom: jax.Array  # [], or [H, W] where it is not flat
    flow: Flow


def take(job: Job, h: jax.Array, before: jax.Array, cover: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Takes up the sand that has to leave as the cover grows: the height left and the height taken."""
    grown = cover > before
    share = jnp.where(grown, (cover - before) / jnp.where(grown, 1 - before, 1), 0)
    taken = whole(job, share * jnp.where(h > job.bottom, h - job.bottom, 0))
    return h - taken, taken


def shares(p: jax.Array, q: jax.Array) -> Shares:
    """Shares of the eight neighbours for a direction (p along columns, q along rows) of largest component 1 or less.

    Bilinear; the part that would stay in place goes to the four straight neighbours alike.
    """
    columns = {-1: jnp.maximum(-p, 0), 0: 1 - jnp.abs(p), 1: jnp.maximum(p, 0)}
    rows = {-1: jnp.maximum(-q, 0), 0: 1 - jnp.abs(q), 1: jnp.maximum(q, 0)}
    stay = rows[0] * columns[0] / 4
    return [rows[di] * columns[dj] + (stay if di == 0 or dj == 0 else 0) for di, dj in EIGHT]


def contact(job: Job, cover: jax.Array, h: jax.Array) -> jax.Array:
    """1 while the blade is among the sand, falling to 0 where it covers no cell or hangs a spacing above all it covers.

    Keeps a tool that touches nothing from moving sand that is still only to a tolerance.
    """
    above = jnp.where(jnp.isnan(h), -jnp.inf, h) - job.bottom
    near = jnp.clip(1 + jnp.maximum(above, -job.bed.spacing) / job.bed.spacing, 0, 1)
    return jnp.minimum(1, 2 * jnp.max(jnp.max(near * cover, axis=0)))


def settle_around(job: Job, flow: Flow, sweeps: int, cover: jax.Array, h: jax.Array, lost: Lost) -> tuple[jax.Array, Lost]:
    """Sweeps the sand around a blade that covers the share `cover` of each cell."""
    return repeat(Beside(sweeps), 1, (job.bed, flow, stand(cover, job.bottom)), (h, lost))


def whole(job: Job, amount: jax.Array) -> jax.Array:
    """Cut to whole quanta."""
    return truncate(amount / job.flow.quantum) * job.flow.quantum
