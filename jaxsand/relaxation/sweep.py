"""One sweep of settling: every link moves its flux (flux.py) times a rate, cut to whole quanta (ghost_cells.py)."""

from dataclasses import dataclass, replace

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from jaxsand.autodiff.while_loop import Plain, Tree, split
from jaxsand.relaxation import flux_adjoint
from jaxsand.relaxation.floor import held, no_more_than
from jaxsand.relaxation.flux import Cells, Fluxes, PartialCells, WholeCells, fluxes, gained
from jaxsand.relaxation.ghost_cells import Bed, ExactSum, at, halo, lose, truncate

Ghosted = Float[Array, "H+2 W+2"]  # a map with ghost cells


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Flow:
    """The size of a sweep: the share of the excess that crosses a straight link, and the quantum of fluxes (m)."""

    rate: Float[Array, ""]
    quantum: Float[Array, ""]


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Swept:
    """The sand that is swept.

    Attributes:
        height: a map with ghost cells.
        lost: the height that each cell lost over a draining rim so far (see `lose`), None where the edge is closed.
    """

    height: Ghosted
    lost: ExactSum | None


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class RklState(Swept):
    """The sand, and `last`: what each link moved in the last stage."""

    last: Fluxes


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Limits:
    """When sand counts as still.

    Attributes:
        tolerance: the slope above repose, a tangent, that counts as still.
        per_quantum: the excess slope below which fluxes may be cut to 0, per quantum (1/m).
    """

    tolerance: jax.Array
    per_quantum: jax.Array


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class GroupParams:
    """What a group of sweeps depends on: the bed, its cells, when the sand is still (None: never), and the sweeps' rate
    (None where a schedule has it)."""

    bed: Bed
    cells: Cells
    limits: Limits | None
    rate: jax.Array | float | None


def sweep(bed: Bed, flow: Flow, cells: Cells, sand: Swept) -> Swept:
    """One sweep, by forward Euler."""
    moved = within(bed, flow, counted(flow, fluxes(bed, cells, sand.height)), at(sand.height))
    return apply(bed, flow, moved, sand)


def counted(flow: Flow, driven: Fluxes) -> Fluxes:
    """The numbers of quanta that cross the links in a sweep, from the fluxes at rate 1."""
    scale = flow.rate / flow.quantum
    return lax.optimization_barrier(tuple(truncate(f * scale) for f in driven))


def within(bed: Bed, flow: Flow, moved: Fluxes, h: Float[Array, "H W"]) -> Fluxes:
    """The numbers of quanta that cross the links, of which no cell of a map [H, W] gives more than lies on its floor."""
    if bed.base is None:
        return moved
    return lax.optimization_barrier(no_more_than(bed.neighbours, held(h, bed.base, flow.quantum), moved))


def rkl_stage(bed: Bed, flow: Flow, momentum: Float[Array, ""], cells: Cells, state: RklState) -> RklState:
    """An RKL stage: a sweep that also repeats the share `momentum` of what each link moved in the stage before (quanta)."""
    scale = flow.rate / flow.quantum
    driven = zip(fluxes(bed, cells, state.height), state.last, strict=True)
    moved = tuple(truncate(f * scale) + truncate(m * momentum) for f, m in driven)
    moved = within(bed, flow, lax.optimization_barrier(moved), at(state.height))
    sand = apply(bed, flow, moved, state)
    return RklState(sand.height, sand.lost, moved)


def apply(bed: Bed, flow: Flow, moved: Fluxes, sand: Swept) -> Swept:
    """The sand after `moved` quanta crossed the links.

    `moved` must be stored, behind a barrier, so that both ends of a link use the same number.
    """
    h, lost = pass_over(bed, flow, moved, at(sand.height), sand.lost)
    return Swept(halo(h), lost)


def pass_over(
    bed: Bed, flow: Flow, moved: Fluxes, h: Float[Array, "H W"], lost: ExactSum | None
) -> tuple[Float[Array, "H W"], ExactSum | None]:
    """`apply` for a map [H, W] without ghost cells."""
    if lost is not None:
        lost = lose(flow.quantum, lost, moved[-1] * flow.quantum)
    return h + gained(bed, moved) * flow.quantum, lost


def _one_sweep(params: tuple[Bed, Flow, Cells], k: jax.Array, sand: Swept) -> Swept:
    return sweep(*params, sand)


class Sweep(Plain):
    """A sweep as a step of a loop. `params` are the bed, the flow and the cells; the state is the sand."""

    def __init__(self) -> None:
        super().__init__(_one_sweep)

    def vjp(self, params: tuple[Bed, Flow, Cells], k: jax.Array, record: Swept, cotangent: Swept) -> tuple[Tree, Swept]:
        """The vjp, with 4 or 8 neighbours, a closed edge and no floor by the formulas of flux_adjoint.py, else by JAX."""
        bed, flow, cells = params
        if not bed.by_links:
            return super().vjp(params, k, record, cotangent)
        h, gain = at(record.height), at(cotangent.height)
        s = record.height if isinstance(cells, WholeCells) else halo(cells.surface(h))
        gate = None if isinstance(cells, WholeCells) else cells.open
        d, m, weights = flux_adjoint.steps(bed, s), flux_adjoint.yields(bed), flux_adjoint.opened(bed, gate)
        back = flux_adjoint.steps(bed, halo(gain, 0.0))
        onward, of_yield, of_rate = [], [], []
        for step, most, w, y in zip(d, m, weights, back, strict=True):
            up, down = step > most, step < -most
            passed = flow.rate * w * y
            onward.append(jnp.where(up | down, passed, 0))
            of_yield.append(jnp.where(up, passed, jnp.where(down, -passed, 0)))
            excess = jnp.where(up, step - most, jnp.where(down, step + most, 0)) * y
            of_rate.append(excess * w)
        slope = flux_adjoint.gains(bed, lax.optimization_barrier(tuple(onward)))
        dbed, dflow, dcells = jax.tree.map(jnp.zeros_like, params)
        dbed = replace(dbed, drop=flux_adjoint.drop_cotangent(bed, of_yield))
        dflow = replace(dflow, rate=-jnp.sum(sum(of_rate)))
        if isinstance(cells, PartialCells):
            share = at(cells.open)
            slope = slope / jnp.where(share > 0, share, 1)
        return split((dbed, dflow, dcells))[0], Swept(halo(gain + slope, 0.0), None)
