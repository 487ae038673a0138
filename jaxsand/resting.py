"""Sand kept at rest around a tool that moves slowly.

In the quasi-static limit sand flows only over links that stand at repose, and no slope exceeds it. Over a sub-step in which
a tool changes the heights to h, that is (Prigozhin's sandpile, doi:10.1016/0009-2509(96)00259-5, one implicit step)

    h' = h + G f,   f = argmin over f of |h + G f|^2 / 2 + sum over links of m |f|,

m the largest stable step of a link, f what crosses it, G f what cells gain: h' is the map nearest to h within repose. With D
the steps over links, proximal gradient steps

    f <- S(f + r w D (h + G f), r w m),   S(z, t) = z - clip(z, -t, t)

lead there from any start, since r w is below 2 / |G|^2 (the limit of a sweep of settling). Unlike a sweep of settling,
such a step takes back what has crossed a link too many times. That allows a good guess to begin with: around a tool the sand
moves as it did a moment ago, a little farther ahead. So every sub-step starts from the fluxes of the last one, moved on with
the tool, and a few steps suffice, however far the heap reaches. Isotropic sand has a flux along each of the four one-sided
gradients of a cell, which S shortens to length.

The weight w of a link is how open it is. A cell of which the share o is open rises by 1 / o of what it gains, so that steps
are stable if for every f the sum over cells of (sum of f)^2 / o is at most 2 sum of f^2 / (r w); with n links to a cell, all
open, that is r n <= 1, and for others it holds if 2 / w >= 1 / o + 1 / o', the two ends': w is their harmonic mean at most.
Fluxes are whole quanta (bed.py).
"""

from dataclasses import dataclass, field
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax

from jaxsand.bed import truncate
from jaxsand.flux import Fluxes, ends
from jaxsand.grid import Neighbours, links
from jaxsand.stencil import both_ends, inner, neighbour, net, outer, spread, steps, total

_FELT = 0.25  # an arm of a gradient counts in full once it is so far open
_GUESSED = 0.02  # and so does a guess


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Sand:
    """A block of sand around a tool; heights are in quanta.

    `gates` say how open each link is, [m, m + 1] and so on as in flux.py; `open` [m, m] is the share of each cell that the
    tool leaves, above whose `bottom` the sand stands higher by `stretch`; `drop` is the largest stable step of a straight
    link; over `sides` [m, m] sand runs off where it stands above `rim` (both None where nothing drains).
    """

    gates: Fluxes
    open: jax.Array
    stretch: jax.Array
    bottom: jax.Array
    drop: jax.Array
    sides: jax.Array | None
    rim: jax.Array | None
    neighbours: Neighbours = field(metadata={"static": True})

    def surface(self, h: jax.Array) -> jax.Array:
        return h + self.stretch * jnp.maximum(h - self.bottom, 0)


def no_flux(neighbours: Neighbours, drains: bool, h: jax.Array) -> Fluxes:
    """No flux in a block of heights [m, m]."""
    if neighbours == "isotropic":
        maps = [jnp.zeros_like(h)] * 8
    else:
        around = jnp.zeros((h.shape[0] + 2, h.shape[1] + 2, *h.shape[2:]), h.dtype)
        maps = [ends(around, di, dj)[0] for di, dj, _ in links(neighbours)]
    return (*maps, jnp.zeros_like(h)) if drains else tuple(maps)


def moved_on(flux: Fluxes, x: jax.Array, y: jax.Array) -> Fluxes:
    """Fluxes moved by a part x, y of a cell across and up, 0 to 1."""

    def one(f: jax.Array) -> jax.Array:
        a, b = spread(x, f), spread(y, f)
        near = (1 - a) * f + a * neighbour(f, 0, -1)
        return (1 - b) * near + b * ((1 - a) * neighbour(f, -1, 0) + a * neighbour(f, -1, -1))

    return tuple(one(f) for f in flux)


def bring_to_rest(sand: Sand, rate: jax.Array, sweeps: int, h: jax.Array, guess: Fluxes) -> tuple[jax.Array, Fluxes]:
    """The heights after so many proximal steps from a guess, and the fluxes that led there."""
    model = _Gradients(sand, rate) if sand.neighbours == "isotropic" else _Links.of(sand, rate)

    def stage(_: jax.Array, flux: Fluxes) -> Fluxes:
        # All that is the same for every step goes through the barrier too: XLA would compute more beforehand, and store it.
        here, flux = lax.optimization_barrier((model, flux))
        return lax.optimization_barrier(here.shrink(flux, here.sand.surface(h + here.gained(flux))))

    flux = lax.fori_loop(0, sweeps, stage, lax.optimization_barrier(_where_open(sand, guess)))
    return lax.optimization_barrier(h + model.gained(flux)), flux


def bring_to_rest_and_back(
    sand: Sand, rate: jax.Array, sweeps: int, h: jax.Array, guess: Fluxes
) -> tuple[jax.Array, Fluxes]:
    """`bring_to_rest` for reverse mode alone, by hand where sand flows in pairs, with one angle and over no rim.

    With lambda the cotangent of the heights, psi that of the fluxes f' of a step, e = z - f' that step's own threshold with
    its sign, and a where |z| exceeds r w m,

        zeta = a psi,   of w: zeta (D s - m sign z),   of s: D' (r w zeta),   of f: zeta + G' (of s) stretched.
    """
    if sand.neighbours == "isotropic" or sand.sides is not None or sand.drop.ndim == h.ndim:
        return bring_to_rest(sand, rate, sweeps, h, guess)
    return _rest(sweeps, sand, rate, h, _where_open(sand, guess))


@partial(jax.custom_vjp, nondiff_argnums=(0,))
def _rest(sweeps: int, sand: Sand, rate: jax.Array, h: jax.Array, guess: Fluxes) -> tuple[jax.Array, Fluxes]:
    return _rest_forth(sweeps, sand, rate, h, guess)[0]


def _rest_forth(sweeps: int, sand: Sand, rate: jax.Array, h: jax.Array, guess: Fluxes) -> tuple[Any, Any]:
    model = _Links.of(sand, rate)

    def stage(k: jax.Array, carry: Any) -> Any:
        flux, tape = carry
        here, flux = lax.optimization_barrier((model, flux))
        tape = jax.tree.map(lambda t, x: lax.dynamic_update_index_in_dim(t, x, k, 0), tape, flux)
        return lax.optimization_barrier(here.shrink(flux, here.sand.surface(h + here.gained(flux)))), tape

    tape = jax.tree.map(lambda x: jnp.zeros((sweeps, *x.shape), x.dtype), guess)
    flux, tape = lax.fori_loop(0, sweeps, stage, (guess, tape))
    return (h + model.gained(flux), flux), (model, h, tape)


def _rest_back(sweeps: int, kept: Any, cotangent: Any) -> tuple[Any, ...]:
    model, h, tape = kept
    sand, neighbours = model.sand, model.sand.neighbours
    lengths = [length for _, _, length in links(neighbours)]
    gain, psi = cotangent
    psi = tuple(p - d for p, d in zip(psi, steps(neighbours, gain), strict=True))

    around = outer(sand.stretch)

    def fetched(k: jax.Array) -> Fluxes:
        return jax.tree.map(lambda t: lax.dynamic_index_in_dim(t, k, 0, keepdims=False), tape)

    def stage(j: jax.Array, carry: Any) -> Any:
        # The fluxes are part of what is carried: XLA would fetch them anew for all that uses them.
        flux, gain, psi, felt, signs, of_stretch, lift = carry
        here, gain, psi = lax.optimization_barrier((model, gain, psi))
        s = outer(here.sand.surface(h + here.gained(flux)))
        zeta, leaning = [], []
        for f, w, (a, b), length, p in zip(flux, here.weights, both_ends(neighbours, s), lengths, psi, strict=True):
            rise, least = b - a, here.sand.drop * length
            z = f + w * rise
            moved = jnp.where(jnp.abs(z) > least * w, p, 0)
            zeta.append(moved)
            leaning.append((moved * rise, jnp.where(z > 0, moved, -moved)))
        of_surface = outer(-net(neighbours, tuple(w * y for w, y in zip(here.weights, zeta, strict=True))))
        raised = jnp.where(s > here.sand.bottom, of_surface, 0)
        change = both_ends(neighbours, of_surface + raised * around)
        psi = tuple(y - (b - a) for y, (a, b) in zip(zeta, change, strict=True))
        felt = tuple(old + y for old, (y, _) in zip(felt, leaning, strict=True))
        signs = tuple(old + y for old, (_, y) in zip(signs, leaning, strict=True))
        s, of_surface, raised = inner(s), inner(of_surface), inner(raised)
        of_stretch = of_stretch + raised * (s - here.sand.bottom) / (1 + here.sand.stretch)
        gain = gain + of_surface + raised * here.sand.stretch
        return fetched(sweeps - 2 - j), gain, psi, felt, signs, of_stretch, lift + raised

    nothing, none = jnp.zeros_like(h), jax.tree.map(jnp.zeros_like, model.weights)
    carry = (fetched(jnp.int32(sweeps - 1)), gain, psi, none, none, nothing, nothing)
    _, gain, psi, felt, signs, of_stretch, lift = lax.fori_loop(0, sweeps, stage, carry)
    weights = tuple(y - z * (sand.drop * length) for y, z, length in zip(felt, signs, lengths, strict=True))
    tilts = [total(z * w) * length for z, w, length in zip(signs, model.weights, lengths, strict=True)]
    of_sand = Sand(
        tuple(w * (model.rate / length) for w, length in zip(weights, lengths, strict=True)),
        nothing,
        of_stretch,
        -total(lift * sand.stretch),
        -sum(tilts, jnp.zeros_like(sand.drop)),
        None,
        None,
        neighbours,
    )
    of_rate = sum(total(w * g) / length for w, g, length in zip(weights, sand.gates, lengths, strict=True))
    return of_sand, of_rate, gain, psi


_rest.defvjp(_rest_forth, _rest_back)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class _Links:
    """Sand that flows in pairs: one flux to a link, in whole quanta; `weights` are r w."""

    sand: Sand
    rate: jax.Array
    weights: Fluxes

    @classmethod
    def of(cls, sand: Sand, rate: jax.Array) -> "_Links":
        lengths = [length for _, _, length in links(sand.neighbours)]
        weights = tuple(g * (rate / length) for g, length in zip(sand.gates, lengths, strict=True))
        return cls(sand, rate, lax.optimization_barrier(weights))

    def shrink(self, flux: Fluxes, s: jax.Array) -> Fluxes:
        out, drop = [], self.sand.drop
        rises = steps(self.sand.neighbours, s)
        drops = [drop] * len(rises)
        if drop.ndim == s.ndim:
            drops = [(here + there) / 2 for here, there in both_ends(self.sand.neighbours, outer(drop))]
        parts = zip(links(self.sand.neighbours), self.weights, flux, rises, drops, strict=False)
        for (_, _, length), w, f, rise, least in parts:
            most = least * length * w
            z = f + w * rise
            out.append(truncate(z - jnp.clip(z, -most, most)))
        if self.sand.sides is not None:
            out.append(_over(self.sand, self.rate, flux[-1], s))
        return tuple(out)

    def gained(self, flux: Fluxes) -> jax.Array:
        return _gained(self.sand, flux)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class _Gradients:
    """Isotropic sand: a vector to each of a cell's four one-sided gradients, along x and y in turn."""

    sand: Sand
    rate: jax.Array

    def shrink(self, y: Fluxes, s: jax.Array) -> Fluxes:
        arms = [d * _felt(gate) for d, gate in zip(steps("isotropic", s), self.sand.gates, strict=True)]
        across, up = _both_ends(arms)
        out = []
        for n in range(4):
            i, j = n // 2, n % 2
            zx, zy = y[2 * n] + self.rate * across[i], y[2 * n + 1] + self.rate * up[j]
            square, least = zx * zx + zy * zy, self.rate * self.sand.drop
            beyond = square > least * least
            part = jnp.where(beyond, 1 - least / jnp.sqrt(jnp.where(beyond, square, 1)), 0)
            out += [zx * part, zy * part]
        if self.sand.sides is not None:
            out.append(_over(self.sand, self.rate, y[-1], s))
        return tuple(out)

    def gained(self, flux: Fluxes) -> jax.Array:
        west, east = flux[0] + flux[2], flux[4] + flux[6]
        south, north = flux[1] + flux[5], flux[3] + flux[7]
        column, row = jnp.zeros_like(west[:, :1]), jnp.zeros_like(west[:1])
        over_x = (jnp.concatenate([column, east], 1) + jnp.concatenate([west, column], 1)) / 4
        over_y = (jnp.concatenate([row, north], 0) + jnp.concatenate([south, row], 0)) / 4
        moved = tuple(truncate(f * g) for f, g in zip((over_x, over_y), self.sand.gates, strict=True))
        moved = lax.optimization_barrier(moved)
        return _gained(self.sand, (*moved, *((flux[-1],) if self.sand.sides is not None else ())))


def _both_ends(arms: list[jax.Array]) -> tuple[tuple[jax.Array, jax.Array], tuple[jax.Array, jax.Array]]:
    """The steps over each cell's links to the west and east, and to the south and north."""
    x, y = arms
    return (x[:, :-1], x[:, 1:]), (y[:-1], y[1:])


def _felt(gate: jax.Array) -> jax.Array:
    return jnp.minimum(gate / _FELT, 1)


def _where_open(sand: Sand, guess: Fluxes) -> Fluxes:
    """The guess, as far as links are open."""
    if sand.neighbours == "isotropic":
        return guess
    gates = sand.gates if sand.sides is None else (*sand.gates, sand.open)
    return tuple(truncate(jnp.minimum(g / _GUESSED, 1) * f) for g, f in zip(gates, guess, strict=True))


def _over(sand: Sand, rate: jax.Array, y: jax.Array, s: jax.Array) -> jax.Array:
    """What runs off over the rim, half a spacing beyond the outer cells."""
    assert sand.sides is not None
    assert sand.rim is not None
    out = jnp.maximum(y + rate * sand.open * sand.sides * (s - (sand.rim + sand.drop / 2)), 0)
    return truncate(jnp.where(sand.sides > 0, out, 0))


def _gained(sand: Sand, flux: Fluxes) -> jax.Array:
    if sand.sides is None:
        return net(sand.neighbours, flux)
    return net(sand.neighbours, flux[:-1]) - flux[-1]
