"""Sand kept at rest around a tool that moves slowly.

In the quasi-static limit sand flows only over links that stand at repose, and no slope exceeds it. Over a sub-step in which
a tool changes the heights to h, that is (Prigozhin's sandpile, doi:10.1016/0009-2509(96)00259-5, one implicit step)

    h' = h + G f,   f = argmin over f of |h + G f|^2 / 2 + sum over links of m |f|,

m the largest stable step of a link, f what crosses it, G f what cells gain: h' is the map nearest to h within repose. With D
the steps over links, proximal gradient steps

    f <- S(f + r w D (h + G f), r w m),   S(z, t) = z - clip(z, -t, t)

lead there from any start, since r w is below 2 / |G|^2 (the limit of a sweep of settling). Unlike a sweep of settling,
such a step takes back what has crossed a link too many times. That allows a good guess to begin with: around a tool that
moves steadily the sand does too. So every sub-step starts from the fluxes of the last one, and a few steps suffice, however
far the heap reaches. Isotropic sand has a flux along each of the four one-sided gradients of a cell, which S shortens to
length.

The weight w of a link is how open it is. A cell of which the share o is open rises by 1 / o of what it gains, so that steps
are stable if for every f the sum over cells of (sum of f)^2 / o is at most 2 sum of f^2 / (r w); with n links to a cell, all
open, that is r n <= 1, and for others it holds if 2 / w >= 1 / o + 1 / o', the two ends': w is their harmonic mean at most.
Isotropic sand couples two links in a gradient, which must have one weight: with each arm felt and moved by the same part a,
1 but where a link is nearly closed, that is the lesser of the two w / a^2. Fluxes are whole quanta (ghost_cells.py).
"""

from dataclasses import dataclass, field

import jax
import jax.numpy as jnp
from jax import lax

from jaxsand.interaction.stencil import both_ends, inner, net, outer, rises
from jaxsand.relaxation.flux import Fluxes, ends
from jaxsand.relaxation.ghost_cells import nearest, truncate
from jaxsand.scene.grid import Neighbours, links

_FELT = 0.25  # an arm of a gradient counts in full once it is so far open
_CALM = 0.6  # of the rate: beyond this, gradients that start from a guess overshoot, now and then without end
_GUESSED = 0.07  # and so does a guess: the less, the closer to the limit, and the more a stroke moved by a hair changes
_RUNS_OFF = 5  # times as fast as over a link: nothing lies beyond a rim that it would have to share with


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
        return h + self.stretch * jnp.where(h > self.bottom, h - self.bottom, 0)


def no_flux(neighbours: Neighbours, drains: bool, h: jax.Array) -> Fluxes:
    """No flux in a block of heights [m, m]."""
    if neighbours == "isotropic":
        maps = [jnp.zeros_like(h)] * 8
    else:
        around = jnp.zeros((h.shape[0] + 2, h.shape[1] + 2, *h.shape[2:]), h.dtype)
        maps = [ends(around, di, dj)[0] for di, dj, _ in links(neighbours)]
    return (*maps, jnp.zeros_like(h)) if drains else tuple(maps)


def bring_to_rest(sand: Sand, rate: jax.Array, sweeps: int, h: jax.Array, guess: Fluxes) -> tuple[jax.Array, Fluxes]:
    """The heights after so many proximal steps from a guess, and the fluxes that led there."""
    model: Links | _Gradients = Links(sand, rate)
    if sand.neighbours == "isotropic":
        model = _Gradients(sand, _CALM * rate)

    def stage(_: jax.Array, flux: Fluxes) -> Fluxes:
        # All that is the same for every step goes through the barrier too: XLA would compute more beforehand, and store it.
        here, flux = lax.optimization_barrier((model, flux))
        return lax.optimization_barrier(here.shrink(flux, outer(here.sand.surface(h + here.gained(flux)))))

    flux = lax.fori_loop(0, sweeps, stage, lax.optimization_barrier(guess))
    return lax.optimization_barrier(h + model.gained(flux)), flux


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Links:
    """Sand that flows in pairs: one flux to a link, in whole quanta."""

    sand: Sand
    rate: jax.Array

    @property
    def factors(self) -> list[jax.Array]:
        """What a rise drives over an open link in each direction."""
        return [self.rate / length for _, _, length in links(self.sand.neighbours)]

    @property
    def most(self) -> jax.Array:
        """What the largest stable rise would drive, the same in all directions."""
        return self.rate * self.sand.drop

    def shrink(self, flux: Fluxes, around: jax.Array) -> Fluxes:
        """The fluxes after a step, where the surface, in a halo, is `around`."""
        out, neighbours = [], self.sand.neighbours
        thresholds = [self.most] * len(self.sand.gates)
        if self.sand.drop.ndim == around.ndim:
            thresholds = [(here + there) / 2 for here, there in both_ends(neighbours, outer(self.most))]
        parts = zip(flux, self.sand.gates, self.factors, rises(neighbours, around), thresholds, strict=False)
        for f, g, factor, rise, threshold in parts:
            z, most = f + g * (factor * rise), g * threshold
            # Comparisons become single instructions; minimum and maximum, which look for NaN, do not.
            out.append(nearest(z - jnp.where(z > most, most, jnp.where(z < -most, -most, z))))
        if self.sand.sides is not None:
            out.append(_over(self.sand, self.rate, flux[-1], inner(around)))
        return tuple(out)

    def gained(self, flux: Fluxes) -> jax.Array:
        return _gained(self.sand, flux)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class _Gradients:
    """Isotropic sand: a vector to each of a cell's four one-sided gradients, along x and y in turn."""

    sand: Sand
    rate: jax.Array

    def shrink(self, y: Fluxes, around: jax.Array) -> Fluxes:
        """The fluxes after a step, where the surface, in a halo, is `around`."""
        arms = [d * _felt(gate) for d, gate in zip(rises("isotropic", around), self.sand.gates, strict=True)]
        across, up = _both_ends(arms)
        of_x, of_y = _both_ends([_weight(gate) for gate in self.sand.gates])
        out = []
        for n in range(4):
            i, j = n // 2, n % 2
            rate = self.rate * jnp.minimum(of_x[i], of_y[j])
            zx, zy = y[2 * n] + rate * across[i], y[2 * n + 1] + rate * up[j]
            square, least = zx * zx + zy * zy, rate * self.sand.drop
            beyond = square > least * least
            part = jnp.where(beyond, 1 - least / jnp.sqrt(jnp.where(beyond, square, 1)), 0)
            out += [zx * part, zy * part]
        if self.sand.sides is not None:
            out.append(_over(self.sand, self.rate, y[-1], inner(around)))
        return tuple(out)

    def gained(self, flux: Fluxes) -> jax.Array:
        west, east = flux[0] + flux[2], flux[4] + flux[6]
        south, north = flux[1] + flux[5], flux[3] + flux[7]
        column, row = jnp.zeros_like(west[:, :1]), jnp.zeros_like(west[:1])
        over_x = (jnp.concatenate([column, east], 1) + jnp.concatenate([west, column], 1)) / 4
        over_y = (jnp.concatenate([row, north], 0) + jnp.concatenate([south, row], 0)) / 4
        moved = tuple(truncate(f * _felt(g)) for f, g in zip((over_x, over_y), self.sand.gates, strict=True))
        moved = lax.optimization_barrier(moved)
        return _gained(self.sand, (*moved, *((flux[-1],) if self.sand.sides is not None else ())))


def _both_ends(arms: list[jax.Array]) -> tuple[tuple[jax.Array, jax.Array], tuple[jax.Array, jax.Array]]:
    """The steps over each cell's links to the west and east, and to the south and north."""
    x, y = arms
    return (x[:, :-1], x[:, 1:]), (y[:-1], y[1:])


def _felt(gate: jax.Array) -> jax.Array:
    """How far an arm of a gradient counts, a."""
    return jnp.minimum(gate / _FELT, 1)


def _weight(gate: jax.Array) -> jax.Array:
    """w / a^2, at most 1; what a closed link would have is of no account."""
    return jnp.where(gate < _FELT, jnp.minimum(_FELT**2 / jnp.maximum(gate, _FELT**2), 1), gate)


def where_open(neighbours: Neighbours, gates: Fluxes, guess: Fluxes) -> Fluxes:
    """A guess of what crosses links as far as they are open, in whole quanta."""
    if neighbours == "isotropic":
        across, up = _both_ends(list(gates))
        gates = tuple(ends[k] for n in range(4) for ends, k in ((across, n // 2), (up, n % 2)))
    return tuple(nearest(jnp.where(g < _GUESSED, g / _GUESSED, 1) * f) for g, f in zip(gates, guess, strict=True))


def _over(sand: Sand, rate: jax.Array, y: jax.Array, s: jax.Array) -> jax.Array:
    """What runs off over the rim, half a spacing beyond the outer cells: at each step nearly all that stands too high."""
    assert sand.sides is not None
    assert sand.rim is not None
    part = jnp.minimum(_RUNS_OFF * rate, 0.9) * sand.open
    out = jnp.maximum(y + part * (s - (sand.rim + sand.drop / 2)), 0)
    return truncate(jnp.where(sand.sides > 0, out, 0))


def _gained(sand: Sand, flux: Fluxes) -> jax.Array:
    if sand.sides is None:
        return net(sand.neighbours, flux)
    return net(sand.neighbours, flux[:-1]) - flux[-1]
