"""RKL stages as steps of a loop: sweeps with momentum, and derivatives that store one byte for each cell and sweep."""

from dataclasses import dataclass, replace
from typing import TypeAlias

import jax
import jax.numpy as jnp
from jax import lax
from jax.typing import DTypeLike

from jaxsand.autodiff.while_loop import Plain, Tree, repeat, split
from jaxsand.relaxation import flux_adjoint
from jaxsand.relaxation.flux import Cells, Fluxes, WholeCells
from jaxsand.relaxation.ghost_cells import Bed, at, grain, halo
from jaxsand.relaxation.schemes import Schedule
from jaxsand.relaxation.sweep import Flow, GroupParams, RklState, rkl_stage

Cotangents: TypeAlias = tuple[jax.Array, list[jax.Array], list[jax.Array]]  # cotangents of heights, fluxes, stable steps


@dataclass(frozen=True)
class RklStages:
    """A group of `interval` RKL stages of a schedule. Between groups `last` is in m, within them in quanta.

    With 4 or 8 neighbours, a closed edge and no floor it records two bits for each link and stage, from which
    flux_adjoint.py computes the derivative. Else it records the state before the group, and JAX differentiates it.
    """

    plan: Schedule
    interval: int
    tape: int = 16

    def __call__(self, params: GroupParams, k: jax.Array, state: RklState) -> RklState:
        bed, cells = params.bed, params.cells
        rates, momenta = self._stages(k, state.height.dtype)
        cut = grain(bed, state.height)
        state = replace(state, last=tuple(m / cut for m in state.last))
        state = repeat(_STAGE, self.interval, (bed, cells, rates, momenta, cut), state)
        return replace(state, last=tuple(m * cut for m in state.last))

    def recorded(self, params: GroupParams, k: jax.Array, state: RklState) -> tuple[RklState, Tree]:
        """The state after the stages, and for its derivative two bits for each link and stage, or else the state before."""
        bed, cells = params.bed, params.cells
        if not bed.by_links:
            return Plain(self).recorded(params, k, state)
        rates, momenta = self._stages(k, state.height.dtype)
        cut = grain(bed, state.height)

        def stage(i: jax.Array, carry: tuple[RklState, jax.Array]) -> tuple[RklState, jax.Array]:
            state, codes = carry
            word = lax.dynamic_index_in_dim(codes, i // 4, keepdims=False)
            code = flux_adjoint.active(bed, _surface(cells, state.height)) << (8 * (i % 4)).astype(jnp.int32)
            codes = lax.dynamic_update_index_in_dim(codes, word | code, i // 4, 0)
            return rkl_stage(bed, Flow(rates[i], cut), momenta[i], cells, state), codes

        rows, columns = state.height.shape
        codes = jnp.zeros((-(-self.interval // 4), rows - 1, columns - 1), jnp.int32)
        state = replace(state, last=tuple(m / cut for m in state.last))
        state, codes = lax.fori_loop(0, self.interval, stage, (state, codes))
        return replace(state, last=tuple(m * cut for m in state.last)), codes

    def jvp(self, params: GroupParams, k: jax.Array, record: Tree, dparams: Tree, dstate: RklState) -> RklState:
        """The jvp, from which links were active."""
        bed, cells = params.bed, params.cells
        if not bed.by_links:
            return Plain(self).jvp(params, k, record, dparams, dstate)
        rates, momenta = self._stages(k, dstate.height.dtype)
        dbed = split(params)[1](dparams).bed
        weights = flux_adjoint.opened(bed, None if isinstance(cells, WholeCells) else cells.open)
        dyields = jax.jvp(lambda drop: flux_adjoint.yields(replace(bed, drop=drop)), (bed.drop,), (dbed.drop,))[1]

        def stage(i: jax.Array, carry: tuple[jax.Array, Fluxes]) -> tuple[jax.Array, Fluxes]:
            dh, last = carry
            code, moved = _code(record, i), []
            for n, (step, dm, w) in enumerate(
                zip(flux_adjoint.steps(bed, halo(_ease(cells, dh), 0.0)), dyields, weights, strict=True)
            ):
                beyond = jnp.where(
                    flux_adjoint.upward(code, n), step - dm, jnp.where(flux_adjoint.downward(code, n), step + dm, 0)
                )
                moved.append(rates[i] * w * beyond + momenta[i] * last[n])
            moved = lax.optimization_barrier(tuple(moved))
            return dh + flux_adjoint.gains(bed, moved), moved

        last = flux_adjoint.to_lattice(bed, dstate.last)
        dh, last = lax.fori_loop(0, self.interval, stage, (at(dstate.height), last))
        return RklState(halo(dh, 0.0), None, flux_adjoint.from_lattice(bed, last))

    def vjp(self, params: GroupParams, k: jax.Array, record: Tree, cotangent: RklState) -> tuple[Tree, RklState]:
        """The vjp, from which links were active."""
        bed, cells = params.bed, params.cells
        if not bed.by_links:
            return Plain(self).vjp(params, k, record, cotangent)
        rates, momenta = self._stages(k, cotangent.height.dtype)
        weights = flux_adjoint.opened(bed, None if isinstance(cells, WholeCells) else cells.open)
        lengths = flux_adjoint.opened(bed, None)
        stretch = weights if bed.drop.ndim else [w / v for w, v in zip(weights, lengths, strict=True)]

        def stage(j: jax.Array, carry: Cotangents) -> Cotangents:
            i = self.interval - 1 - j
            gain, last, tilt = carry
            again = jnp.where(j > 0, momenta[jnp.minimum(i + 1, self.interval - 1)], 1)
            again, rate = lax.optimization_barrier((again, rates[i]))
            code = _code(record, i)
            back = [y + again * p for y, p in zip(flux_adjoint.steps(bed, halo(gain, 0.0)), last, strict=True)]
            back = lax.optimization_barrier(back)
            onward = [
                w * jnp.where(flux_adjoint.moving(code, n), y, 0) for n, (w, y) in enumerate(zip(weights, back, strict=True))
            ]
            signed = [
                s * jnp.where(flux_adjoint.upward(code, n), y, jnp.where(flux_adjoint.downward(code, n), -y, 0))
                for n, (y, s) in enumerate(zip(back, stretch, strict=True))
            ]
            if not bed.drop.ndim:
                signed = [jnp.asarray(sum(signed))]
            tilt = [t + rate * s for t, s in zip(tilt, signed, strict=True)]
            return gain + rate * _ease(cells, flux_adjoint.gains(bed, tuple(onward))), back, tilt

        gain = at(cotangent.height)
        last = [-p for p in flux_adjoint.to_lattice(bed, cotangent.last)]
        tilt = [jnp.zeros_like(last[0])] * (len(last) if bed.drop.ndim else 1)
        gain, last, tilt = lax.fori_loop(0, self.interval, stage, (gain, last, tilt))
        last = [momenta[0] * y for y in last]
        dparams = jax.tree.map(jnp.zeros_like, params)
        drop = flux_adjoint.drop_cotangent(bed, tilt) if bed.drop.ndim else jnp.sum(tilt[0])
        floats = split(replace(dparams, bed=replace(dparams.bed, drop=drop)))[0]
        return floats, RklState(halo(gain, 0.0), None, flux_adjoint.from_lattice(bed, tuple(-p for p in last)))

    def _stages(self, k: jax.Array, dtype: DTypeLike) -> tuple[jax.Array, jax.Array]:
        """The rate and the momentum of each stage of group k."""
        starts = jnp.asarray(self.plan.starts)[:, None]
        now = (k * self.interval + jnp.arange(self.interval, dtype=jnp.int32))[None, :]
        begun = starts <= now
        taken = (now[0] - jnp.max(jnp.where(begun, starts, 0), axis=0)).astype(
            dtype
        )  # stages of the same step before this one
        rates = jnp.asarray(self.plan.rates, dtype)[jnp.sum(begun, axis=0) - 1] * (2 - 1 / (taken + 1))
        return rates, taken / (taken + 1)


def _code(codes: jax.Array, i: jax.Array) -> jax.Array:
    """The record of stage i in its low byte; a word of 32 bits holds the records of four stages."""
    word, shift = lax.optimization_barrier((lax.dynamic_index_in_dim(codes, i // 4, keepdims=False), 8 * (i % 4)))
    return lax.shift_right_logical(word, jnp.full(word.shape, shift, word.dtype))


def _surface(cells: Cells, u: jax.Array) -> jax.Array:
    """The height of the surface for a map of volumes per cell area, both with ghost cells."""
    return u if isinstance(cells, WholeCells) else halo(cells.surface(at(u)))


def _ease(cells: Cells, change: jax.Array) -> jax.Array:
    """The change of the surface for a change of the volume per cell area; a diagonal linear map, its own transpose."""
    return change if isinstance(cells, WholeCells) else cells.surface(change)


def _one_stage(params: tuple[Bed, Cells, jax.Array, jax.Array, jax.Array], i: jax.Array, state: RklState) -> RklState:
    bed, cells, rates, momenta, cut = params
    return rkl_stage(bed, Flow(rates[i], cut), momenta[i], cells, state)


_STAGE = Plain(_one_stage)
