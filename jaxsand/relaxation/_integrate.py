"""Integrates the flow of sand on one grid: groups of sweeps until the map is still."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from jaxsand.autodiff.while_loop import Plain, Step, repeat, repeat_until
from jaxsand.relaxation._rkl import RklStages
from jaxsand.relaxation.flux import Cells, Fluxes, WholeCells, fluxes, fluxes_zero, link_flux, worst_excess
from jaxsand.relaxation.ghost_cells import Bed, ExactSum, at, grain, truncate
from jaxsand.relaxation.schemes import Pairwise, Relaxation, Schedule
from jaxsand.relaxation.sweep import Flow, Sweep, apply, within
from jaxsand.scene.grid import links

Sand: TypeAlias = tuple[jax.Array, ExactSum | None]  # a map with ghost cells, and what it lost over the rim
State: TypeAlias = Sand | tuple[jax.Array, ExactSum | None, Fluxes]
Rate: TypeAlias = jax.Array | float
Limits: TypeAlias = tuple[jax.Array, jax.Array]  # see `still`
Params: TypeAlias = tuple[Bed, Cells, Limits | None, *tuple[Rate, ...]]
Swept: TypeAlias = tuple[Bed, Cells, Limits | None, Rate]


@dataclass(frozen=True)
class SweepLoop:
    """A loop over groups of `interval` sweeps, which ends when no slope exceeds repose by more than a tolerance.

    Attributes:
        begin: from the sand to the state before the first group, whose first two members are the sand.
        body: from params, k and the state before group k to the state after it.
        done: from params, k and the state, whether to stop before group k.
        between: whether before group k the state holds nothing but the sand, so that the loop can be restarted there.
        params: what `body` and `done` depend on.
        interval: number of sweeps in a group.
    """

    begin: Callable[[Sand], State]
    body: Step
    done: Callable[..., jax.Array]
    between: Callable[[jax.Array], jax.Array]
    params: Params
    interval: int

    def run(self, groups: int, sand: Sand) -> tuple[Sand, jax.Array]:
        """The sand after at most `groups` groups, and the number of sweeps that it took."""
        state, taken = repeat_until(self.done, self.body, groups, self.params, self.begin(sand))
        return (state[0], state[1]), taken * self.interval


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
    begin: Callable[[Sand], State]
    body: Step
    done: Callable[..., jax.Array]
    between: Callable[[jax.Array], jax.Array]
    rate: Rate
    limits: Limits | None = None
    if isinstance(scheme, Schedule):
        begin = partial(_with_momentum, bed)
        body = RklStages(scheme, interval)
        rate = float(scheme.rates[-1])
        done = partial(_still_after_a_step, scheme, interval)
        between = partial(_between_steps, scheme, interval)
    else:
        begin = _as_it_is
        body = Plain(partial(_pairs if isinstance(scheme, Pairwise) else _sweeps, interval))
        rate = scheme.share / 2 if isinstance(scheme, Pairwise) else scheme.rate
        done, between = _still, _always
    if tolerance is None:
        done = _never
    else:  # over the rim flows at least 1/2 of rate * excess * spacing (`Pairwise`: 1/4), over links all of it
        quanta = 4 if isinstance(scheme, Pairwise) and bed.rim is not None else 2
        limits = (tolerance, lax.stop_gradient(quanta / (rate * bed.spacing)))
    params: Params = (bed, cells, limits) if isinstance(scheme, Schedule) else (bed, cells, limits, rate)
    return SweepLoop(begin, body, done, between, params, interval)


def _with_momentum(bed: Bed, sand: Sand) -> State:
    return (*sand, fluxes_zero(bed, sand[0]))


def _as_it_is(sand: Sand) -> State:
    return sand


def _always(k: jax.Array) -> jax.Array:
    return jnp.ones((), bool)


def still(bed: Bed, cells: Cells, limits: Limits, u: jax.Array) -> jax.Array:
    """Whether no slope of a map with ghost cells exceeds repose by more than floats can still move, or than the tolerance.

    The limits are the tolerance (a tangent) and, per quantum (1/m), the excess slope below which fluxes may be cut to 0.
    """
    tolerance, floor = limits
    if bed.neighbours == "isotropic":  # the larger component of a gradient moves at least 1/(4 sqrt(2)) of its excess
        floor = 3 * floor
    return worst_excess(bed, u, cells) <= jnp.maximum(tolerance, floor * grain(bed, u))


def _never(params: Params, k: jax.Array, state: State) -> jax.Array:
    return jnp.zeros((), bool)


def _still(params: tuple[Bed, Cells, Limits, *tuple[Rate, ...]], k: jax.Array, state: State) -> jax.Array:
    bed, cells, limits = params[:3]
    return still(bed, cells, limits, state[0])


def _still_after_a_step(
    plan: Schedule, interval: int, params: tuple[Bed, Cells, Limits], k: jax.Array, state: State
) -> jax.Array:
    return _between_steps(plan, interval, k) & _still(params, k, state)


def _between_steps(plan: Schedule, interval: int, k: jax.Array) -> jax.Array:
    return jnp.any(jnp.asarray(plan.starts) == k * interval)


def _sweeps(interval: int, params: Swept, k: jax.Array, state: Sand) -> Sand:
    bed, cells, _, rate = params
    flow = Flow(jnp.asarray(rate), grain(bed, state[0]))
    return repeat(Sweep(), interval, (bed, flow, cells), state)


def _pairs(interval: int, params: Swept, k: jax.Array, state: Sand) -> Sand:
    bed, _, _, half = params
    flow = Flow(jnp.asarray(half), grain(bed, state[0]))
    return repeat(_EACH_PAIR, interval, (bed, flow), state)


def _each_pair(bed: Bed, flow: Flow, u: jax.Array, lost: ExactSum | None) -> Sand:
    """One sweep of `Pairwise`: in each direction every other pair, then the rest; `flow.rate` is half the share."""
    scale = flow.rate / flow.quantum
    for chosen, link in enumerate(links(bed.neighbours)):
        for colour in (0, 1):
            excess = link_flux(bed, None, u, link) * link[2]
            rows, columns = excess.shape
            turn = (np.arange(rows)[:, None] if link[0] else np.arange(columns)[None, :]) % 2 == colour
            moved = list(fluxes_zero(bed, u))
            moved[chosen] = lax.optimization_barrier(jnp.where(turn, truncate(excess * scale), 0))
            u, lost = apply(bed, flow, within(bed, flow, tuple(moved), at(u)), u, lost)
    if bed.rim is None:
        return u, lost
    drain = truncate(fluxes(bed, WholeCells(), u)[-1] * (scale / 2))  # a cell has up to four sides
    return apply(bed, flow, within(bed, flow, (*fluxes_zero(bed, u)[:-1], drain), at(u)), u, lost)


_EACH_PAIR = Plain(lambda params, _, state: _each_pair(*params, *state))
