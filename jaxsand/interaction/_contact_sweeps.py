"""Sweeps around a tool that stands in the sand, and their vjp.

Let s be the surface before a sweep, D s its steps over the links, e their excess over repose, g the open share of a link and
l its length. A sweep adds G (rate g e / l) to the heights; see flux_adjoint.py. With y = D lambda, and sums over all sweeps,

    E = sum of e y        gives the cotangents  -rate E / l  of g  and  -sum of g E / l  of the rate, and
    M = sum of sigma g y  gives the cotangent   rate M       of the largest stable step of a straight link.
"""

from dataclasses import dataclass, replace
from typing import TypeAlias

import jax
import jax.numpy as jnp
from jax import lax

from jaxsand.autodiff.while_loop import Plain, Tree, repeat, split
from jaxsand.relaxation import flux_adjoint
from jaxsand.relaxation.flux import ToolInSand, flows
from jaxsand.relaxation.ghost_cells import Bed, ExactSum, at, halo, stored, total
from jaxsand.relaxation.sweep import Flow, counted, pass_over
from jaxsand.scene.grid import links

Params: TypeAlias = tuple[Bed, Flow, ToolInSand]
State: TypeAlias = tuple[jax.Array, ExactSum | None]
Carry: TypeAlias = tuple[jax.Array, list[jax.Array], list[jax.Array], jax.Array, jax.Array]


@dataclass(frozen=True)
class Beside:
    """A number of sweeps around a tool as one step of a loop; `params` are the bed, the flow and the tool in the sand."""

    sweeps: int
    tape: int = 1

    def __call__(self, params: Params, k: jax.Array, state: State) -> State:
        return repeat(_SWEEP, self.sweeps, params, state)

    def recorded(self, params: Params, k: jax.Array, state: State) -> tuple[State, State]:
        """The state after the sweeps, and the state before them as the record."""
        return self(params, k, state), state

    def jvp(self, params: Params, k: jax.Array, record: State, dparams: Tree, dstate: State) -> State:
        """The jvp, by JAX."""
        return Plain(self).jvp(params, k, record, dparams, dstate)

    def vjp(self, params: Params, k: jax.Array, record: State, cotangent: State) -> tuple[Tree, State]:
        """The vjp: written out for 4 and 8 neighbours, else by JAX."""
        bed, flow, tool = params
        if not bed.by_links or not self.sweeps:
            return Plain(self).vjp(params, k, record, cotangent)
        of = vjp(bed, flow, tool, surfaces(bed, flow, tool, self.sweeps, record[0]), cotangent[0])
        dbed, dflow, dtool = jax.tree.map(jnp.zeros_like, params)
        dtool = replace(dtool, open=halo(of.open, 0.0), stretch=of.stretch, bottom=of.bottom)
        dparams = (replace(dbed, drop=of.drop), replace(dflow, rate=of.rate), dtool)
        return split(dparams)[0], (of.height, None)


@dataclass(frozen=True)
class SweepCotangents:
    """The cotangents of what some sweeps depend on: the height [H, W] before them, the tool's `open` share, `stretch` and
    `bottom`, the sweeps' `rate`, and the bed's `drop`."""

    height: jax.Array
    open: jax.Array
    stretch: jax.Array
    bottom: jax.Array
    rate: jax.Array
    drop: jax.Array


def surfaces(bed: Bed, flow: Flow, tool: ToolInSand, sweeps: int, height: jax.Array) -> jax.Array:
    """The surface before each sweep, [sweeps, H, W]."""

    def again(i: jax.Array, kept: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        h, tape = kept
        tape = lax.dynamic_update_index_in_dim(tape, tool.surface(h), i, 0)
        return _sweep(bed, flow, tool, h, None)[0], tape

    tape = jnp.zeros((sweeps, *height.shape), height.dtype)
    h, tape = lax.fori_loop(0, sweeps - 1, again, (height, tape))
    return lax.dynamic_update_index_in_dim(tape, tool.surface(h), sweeps - 1, 0)


def _sweep(bed: Bed, flow: Flow, tool: ToolInSand, h: jax.Array, lost: ExactSum | None) -> tuple[jax.Array, ExactSum | None]:
    """One sweep of a map [H, W]; only its surface needs ghost cells."""
    moved = counted(flow, flows(bed, tool.open, halo(tool.surface(h))))
    return pass_over(bed, flow, moved, h, lost)


_SWEEP = Plain(lambda params, _, state: _sweep(*params, *state))


def vjp(bed: Bed, flow: Flow, tool: ToolInSand, tape: jax.Array, cotangent: jax.Array) -> SweepCotangents:
    """The vjp of the sweeps whose surfaces are on the tape, for a cotangent [H, W] of the height after them."""
    sweeps = tape.shape[0]
    gates = [jnp.minimum(here, there) for here, there in flux_adjoint.pairs(bed, tool.open)]
    lengths = [length for _, _, length in links(bed.neighbours)]
    most = flux_adjoint.yields(bed)
    per_cell = bool(bed.drop.ndim)

    def stage(j: jax.Array, carry: Carry) -> Carry:
        gain, excess, tilt, lift, moved = carry
        s = halo(lax.dynamic_index_in_dim(tape, sweeps - 1 - j, keepdims=False))
        rises = flux_adjoint.steps(bed, s)
        passed = stored(
            [
                jnp.where(jnp.abs(d) > m, y, 0)
                for d, m, y in zip(rises, most, flux_adjoint.steps(bed, halo(gain, 0.0)), strict=True)
            ]
        )
        beyond = [jnp.where(jnp.abs(d) > m, d - jnp.copysign(m, d), 0) for d, m in zip(rises, most, strict=True)]
        excess = [e + x * y for e, x, y in zip(excess, beyond, passed, strict=True)]
        signed = [jnp.copysign(y, y * d) for d, y in zip(rises, passed, strict=True)]
        if per_cell:
            tilt = [t + x for t, x in zip(tilt, signed, strict=True)]
        else:
            tilt = [tilt[0] + sum(g * x for g, x in zip(gates, signed, strict=True))]
        onward = tuple(g * (y / length) for g, y, length in zip(gates, passed, lengths, strict=True))
        slope = at(halo(flow.rate * flux_adjoint.gains(bed, onward), 0.0))
        rise = at(s) - tool.bottom
        raised = jnp.where(rise > 0, slope, 0)
        return (
            gain + slope + raised * tool.stretch,
            excess,
            tilt,
            lift + raised,
            moved + jnp.where(rise > 0, slope * rise, 0),
        )

    none = jnp.zeros_like(gates[0])
    nothing = jnp.zeros_like(cotangent)
    carry = (cotangent, [none] * len(gates), [none] * (len(gates) if per_cell else 1), nothing, nothing)
    gain, excess, tilt, lift, moved = lax.fori_loop(0, sweeps, stage, carry)
    per_length = [e / length for e, length in zip(excess, lengths, strict=True)]
    if per_cell:
        drop = flux_adjoint.drop_cotangent(
            bed, [flow.rate * g / length * t for g, length, t in zip(gates, lengths, tilt, strict=True)]
        )
    else:
        drop = flow.rate * total(tilt[0])
    return SweepCotangents(
        gain,
        -flow.rate * at(flux_adjoint.to_less_open(bed, tool.open, per_length)),
        moved / (1 + tool.stretch),
        -flux_adjoint.to_shape(lift * tool.stretch, tool.bottom),
        -total(sum(g * e for g, e in zip(gates, per_length, strict=True))),
        drop,
    )
