"""One sweep of settling: every link passes on its flux (flux.py), times a rate, cut to whole quanta (bed.py)."""

from dataclasses import dataclass

import jax
from jax import lax

from jaxsand.bed import Bed, Lost, at, halo, lose, truncate
from jaxsand.flux import Around, Fluxes, Nothing, Partial, fluxes, gained


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Flow:
    """How far a sweep goes: the share of the excess that crosses a straight link, and the quantum it is cut to (m)."""

    rate: jax.Array
    quantum: jax.Array


def sweep(bed: Bed, flow: Flow, around: Nothing | Around | Partial, u: jax.Array, lost: Lost) -> tuple[jax.Array, Lost]:
    """One sweep of a map with halo [H + 2, W + 2].

    `lost` gathers the height that left each cell over a draining rim (see `lose`); None where nothing drains.
    """
    scale = flow.rate / flow.quantum
    moved = lax.optimization_barrier(tuple(truncate(f * scale) for f in fluxes(bed, around, u)))
    return apply(bed, flow, moved, u, lost)


def surge(
    bed: Bed, flow: Flow, momentum: jax.Array, around: Nothing | Around | Partial, state: tuple[jax.Array, Lost, Fluxes]
) -> tuple[jax.Array, Lost, Fluxes]:
    """A sweep that also repeats the share `momentum` of what each link moved in the last one (quanta)."""
    u, lost, last = state
    scale = flow.rate / flow.quantum
    moved = tuple(truncate(f * scale) + truncate(m * momentum) for f, m in zip(fluxes(bed, around, u), last, strict=True))
    moved = lax.optimization_barrier(moved)
    u, lost = apply(bed, flow, moved, u, lost)
    return u, lost, moved


def apply(bed: Bed, flow: Flow, moved: Fluxes, u: jax.Array, lost: Lost) -> tuple[jax.Array, Lost]:
    """The map after whole quanta `moved` over its links; stored ones, lest each end compute its own."""
    if lost is not None:
        lost = lose(flow.quantum, lost, moved[-1] * flow.quantum)
    return halo(at(u) + gained(bed, moved) * flow.quantum), lost
