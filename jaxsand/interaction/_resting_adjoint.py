"""The derivative of sand's coming to rest (resting.py), by hand: where sand flows in pairs, with one angle and over no rim.

Of a step f' = S(z, g T), z = f + g c rise, T = rate * drop, c = rate / length, with rise = D s of the surface
s = u + stretch (u - bottom)+ of u = h + G f, the tape holds s and f': f' is 0 where the link stood still, and has z's sign
elsewhere. With psi the cotangent of f' and zeta = psi where f' is not 0,

    of g: zeta (c rise - sign T),   of T: -sum of sign g zeta,   of s: E = D' (g c zeta),
    of u: e = E + [u > bottom] stretch E,   of f: zeta + G' e,   of h: the sum of all e,

and the rate, which appears in T and in c, gets drop times that of T and the sum of E s / rate. Gates and stretch vary near
the tool alone.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax

from jaxsand.interaction.resting import Links
from jaxsand.interaction.stencil import inner, net, outer, rises, steps, total
from jaxsand.relaxation.flux import Fluxes


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Tape:
    """What the steps leave behind: the surface before each, in a halo, and which way sand flows after it; [sweeps, ...]."""

    surface: jax.Array
    way: tuple[jax.Array, ...]  # int8: 1, -1, or 0 where it does not


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Rested:
    """The cotangents of all that the sand's coming to rest depends on; those of gates, stretch and bottom near the tool."""

    gates: Fluxes
    stretch: jax.Array
    bottom: jax.Array
    drop: jax.Array
    rate: jax.Array
    height: jax.Array
    guess: Fluxes


def blank(sweeps: int, h: jax.Array, flux: Fluxes) -> Tape:
    """A tape with room for so many steps."""
    ways = tuple(jnp.zeros((sweeps, *f.shape), jnp.int8) for f in flux)
    return Tape(jnp.zeros((sweeps, *outer(h).shape), h.dtype), ways)


def rest_taped(model: Links, sweeps: int, h: jax.Array, guess: Fluxes, tape: Tape) -> Tape:
    """The steps of `bring_to_rest`, on tape."""

    def stage(k: jax.Array, carry: tuple[Fluxes, Tape]) -> tuple[Fluxes, Tape]:
        flux, tape = carry
        here, flux = lax.optimization_barrier((model, flux))
        surface = outer(here.sand.surface(h + here.gained(flux)))
        flux = lax.optimization_barrier(here.shrink(flux, surface))
        taped = Tape(surface, tuple((f > 0).astype(jnp.int8) - (f < 0).astype(jnp.int8) for f in flux))
        return flux, jax.tree.map(lambda t, x: lax.dynamic_update_index_in_dim(t, x, k, 0), tape, taped)

    return lax.fori_loop(0, sweeps, stage, (guess, tape))[1]


def rest_vjp(
    model: Links, sweeps: int, part: Callable[[jax.Array], jax.Array], tape: Tape, cotangent: tuple[jax.Array, Fluxes]
) -> Rested:
    """The cotangents, from those of the heights and the fluxes in the end; `part` cuts a map to what is near the tool."""
    neighbours = model.sand.neighbours
    gain, psi = cotangent
    psi = tuple(p - d for p, d in zip(psi, steps(neighbours, gain), strict=True))

    # E sums to 0 over a block, so E s may be summed with s above any one height, which keeps the terms small.
    level = model.sand.bottom
    one_height = level if level.ndim < gain.ndim else part(level)[0, 0]

    def fetched(k: jax.Array) -> Tape:
        return jax.tree.map(lambda t: lax.dynamic_index_in_dim(t, k, 0, keepdims=False), tape)

    def stage(j: jax.Array, carry: Any) -> Any:
        # What was taped is part of what is carried: XLA would fetch it anew for all that uses it.
        taped, gain, psi, of_gates, of_most, of_stretch, lift, work = carry
        here, taped, psi = lax.optimization_barrier((model, taped, psi))
        sand, surface, ways = here.sand, taped.surface, taped.way
        moved = [jnp.where(way == 0, 0, p) for way, p in zip(ways, psi, strict=True)]
        driven = tuple(y * (g * c) for y, g, c in zip(moved, sand.gates, here.factors, strict=True))
        lifted = inner(surface) > sand.bottom
        slope = 1 + jnp.where(lifted, sand.stretch, 0)
        change = outer(-net(neighbours, driven) * slope)
        back = tuple(y - d for y, d in zip(moved, rises(neighbours, change), strict=True))
        of_surface = inner(change) / slope
        above = inner(surface) - jnp.where(jnp.isfinite(sand.bottom), sand.bottom, 0)
        work = work + of_surface * (inner(surface) - jnp.where(jnp.isfinite(one_height), one_height, 0))
        raised = jnp.where(part(lifted), part(of_surface), 0)
        of_stretch, lift = of_stretch + raised * part(above), lift + raised
        signed = [way.astype(p.dtype) * p * g for way, p, g in zip(ways, psi, sand.gates, strict=True)]
        of_most = of_most + sum(y[: gain.shape[0], : gain.shape[1]] for y in signed)  # the last row and column are closed
        near = zip(of_gates, ways, moved, rises(neighbours, surface), here.factors, strict=True)
        of_gates = tuple(
            old + part(y) * (c * part(rise) - part(way).astype(y.dtype) * here.most) for old, way, y, rise, c in near
        )
        return fetched(sweeps - 2 - j), gain + inner(change), back, of_gates, of_most, of_stretch, lift, work

    nothing = jnp.zeros_like(gain)
    none, little = jax.tree.map(lambda g: jnp.zeros_like(part(g)), (model.sand.gates, nothing))
    carry = (fetched(jnp.int32(sweeps - 1)), gain, psi, none, nothing, little, little, nothing)
    _, gain, psi, of_gates, of_most, of_stretch, lift, work = lax.fori_loop(0, sweeps, stage, carry)
    stretch, of_threshold = part(model.sand.stretch), -total(of_most)
    of_factors = total(work) / jnp.where(model.rate > 0, model.rate, 1)
    return Rested(
        of_gates,
        of_stretch / (1 + stretch),
        -(lift * stretch if model.sand.bottom.ndim == gain.ndim else total(lift * stretch)),
        of_threshold * model.rate,
        of_threshold * model.sand.drop + of_factors,
        gain,
        psi,
    )
