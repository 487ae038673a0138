"""Integrates the flow of sand on one grid: groups of sweeps until the map is still."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from jaxsand.autodiff.while_loop import Plain, Step, repeat, repeat_until
from jaxsand.relaxation._rkl import RklStages
from jaxsand.relaxation.flux import Cells, WholeCells, fluxes, fluxes_zero, link_flux, worst_excess
from jaxsand.relaxation.ghost_cells import Bed, at, grain, truncate
from jaxsand.relaxation.schemes import Pairwise, Relaxation, Schedule
from jaxsand.relaxation.sweep import Flow, GroupParams, Limits, RklState, Sweep, Swept, apply, within
from jaxsand.scene.grid import links


@dataclass(frozen=True)
class SweepLoop:
    """A loop over groups of `interval` sweeps, which ends when no slope exceeds repose by more than a tolerance.

    Attributes:
        begin: from the sand to the state before the first group: the sand, or more.
        body: from params, k and the state before group k to the state after it.
        done: from params, k and the state, whether to stop before group k.
        between: whether before group k the state holds nothing but the sand, so that the loop can be restarted there.
        params: what `body` and `done` depend on.
        interval: number of sweeps in a group.
    """

    begin: Callable[[Swept], Swept]
    body: Step
    done: Callable[..., jax.Array]
    between: Callable[[jax.Array], jax.Array]
    params: GroupParams
    interval: int

    def run(self, groups: int, sand: Swept) -> tuple[Swept, jax.Array]:
        """The sand after at most `groups` groups, and the number of sweeps that it took."""
        state, taken = repeat_until(self.done, self.body, groups, self.params, self.begin(sand))
        return Swept(state.height, state.lost), taken * self.interval


def sweep_loop(
    bed: Bed,
    cells: Cells,
    scheme: Relaxation | Pairwise | Schedule,
    tolerance: jax.Array | None,
    interval: int,
) -> SweepLoop:
    """The loop of a scheme on this bed; without a tolerance it runs to its bound.

    The quantum of the fluxes is chosen anew for each group, from the largest height before it. So the quantum becomes finer
    as a spike wears off, and the sand ends smooth.
    """
    begin: Callable[[Swept], Swept]
    body: Step
    done: Callable[..., jax.Array]
    between: Callable[[jax.Array], jax.Array]
    rate: jax.Array | float
    limits: Limits | None = None
    if isinstance(scheme, Schedule):
        begin = partial(_with_momentum, bed)
        body = RklStages(scheme, interval)
        rate = float(scheme.rates[-1])
        between = _BetweenSteps(scheme, interval)
        done = _StillAfterAStep(between)
    else:
        begin = _as_it_is
        body = Plain(_Pairs(interval) if isinstance(scheme, Pairwise) else _Sweeps(interval))
        rate = scheme.share / 2 if isinstance(scheme, Pairwise) else scheme.rate
        done, between = _still, _always
    if tolerance is None:
        done = _never
    else:  # over the rim flows at least 1/2 of rate * excess * spacing (`Pairwise`: 1/4), over links all of it
        quanta = 4 if isinstance(scheme, Pairwise) and bed.rim is not None else 2
        limits = Limits(tolerance, lax.stop_gradient(quanta / (rate * bed.spacing)))
    params = GroupParams(bed, cells, limits, None if isinstance(scheme, Schedule) else rate)
    return SweepLoop(begin, body, done, between, params, interval)


def _with_momentum(bed: Bed, sand: Swept) -> RklState:
    return RklState(sand.height, sand.lost, fluxes_zero(bed, sand.height))


def _as_it_is(sand: Swept) -> Swept:
    return sand


def _always(k: jax.Array) -> jax.Array:
    return jnp.ones((), bool)


def still(bed: Bed, cells: Cells, limits: Limits, u: jax.Array) -> jax.Array:
    """Whether no slope of a map with ghost cells exceeds repose by more than the tolerance, or than floats can move."""
    floor = limits.per_quantum
    if bed.neighbours == "isotropic":  # the larger component of a gradient moves at least 1/(4 sqrt(2)) of its excess
        floor = 3 * floor
    return worst_excess(bed, u, cells) <= jnp.maximum(limits.tolerance, floor * grain(bed, u))


def _never(params: GroupParams, k: jax.Array, sand: Swept) -> jax.Array:
    return jnp.zeros((), bool)


def _still(params: GroupParams, k: jax.Array, sand: Swept) -> jax.Array:
    assert params.limits is not None
    return still(params.bed, params.cells, params.limits, sand.height)


@dataclass(frozen=True)
class _BetweenSteps:
    """Whether group k is the first of a step of the schedule."""

    plan: Schedule
    interval: int

    def __call__(self, k: jax.Array) -> jax.Array:
        return jnp.any(jnp.asarray(self.plan.starts) == k * self.interval)


@dataclass(frozen=True)
class _StillAfterAStep:
    """Whether the sand is still, and a step of the schedule complete."""

    between: _BetweenSteps

    def __call__(self, params: GroupParams, k: jax.Array, sand: Swept) -> jax.Array:
        return self.between(k) & _still(params, k, sand)


@dataclass(frozen=True)
class _Sweeps:
    """A group of sweeps."""

    interval: int

    def __call__(self, params: GroupParams, k: jax.Array, sand: Swept) -> Swept:
        return repeat(Sweep(), self.interval, (params.bed, _flow(params, sand), params.cells), sand)


@dataclass(frozen=True)
class _Pairs:
    """A group of sweeps of `Pairwise`."""

    interval: int

    def __call__(self, params: GroupParams, k: jax.Array, sand: Swept) -> Swept:
        return repeat(_EACH_PAIR, self.interval, (params.bed, _flow(params, sand)), sand)


def _flow(params: GroupParams, sand: Swept) -> Flow:
    return Flow(jnp.asarray(params.rate), grain(params.bed, sand.height))


def _each_pair(bed: Bed, flow: Flow, sand: Swept) -> Swept:
    """One sweep of `Pairwise`: in each direction every other pair, then the rest; `flow.rate` is half the share."""
    scale = flow.rate / flow.quantum
    for chosen, link in enumerate(links(bed.neighbours)):
        for colour in (0, 1):
            excess = link_flux(bed, None, sand.height, link) * link[2]
            rows, columns = excess.shape
            turn = (np.arange(rows)[:, None] if link[0] else np.arange(columns)[None, :]) % 2 == colour
            moved = list(fluxes_zero(bed, sand.height))
            moved[chosen] = lax.optimization_barrier(jnp.where(turn, truncate(excess * scale), 0))
            sand = apply(bed, flow, within(bed, flow, tuple(moved), at(sand.height)), sand)
    if bed.rim is None:
        return sand
    drain = truncate(fluxes(bed, WholeCells(), sand.height)[-1] * (scale / 2))  # a cell has up to four sides
    moved = [*fluxes_zero(bed, sand.height)[:-1], drain]
    return apply(bed, flow, within(bed, flow, tuple(moved), at(sand.height)), sand)


_EACH_PAIR = Plain(lambda params, _, sand: _each_pair(params[0], params[1], sand))
