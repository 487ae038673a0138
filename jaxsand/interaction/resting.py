"""Brings sand to rest around a tool that moves slowly, by proximal gradient steps from the fluxes of the last sub-step.

The limit, the steps f <- S(f + r w D (h + G f), r w m), and the weights w that keep them stable in narrow cells:
notebooks/site/theory/push.md ("The limit" to "Weights of narrow cells"). Fluxes are whole quanta (ghost_cells.py). On a
floor no cell gives more than it held before the steps (floor.py).
"""

from dataclasses import dataclass, field

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from jaxsand.interaction.stencil import both_ends, inner, net, outer, rises
from jaxsand.relaxation.floor import held, no_more_than
from jaxsand.relaxation.flux import THIN, Fluxes, ends, share_beyond
from jaxsand.relaxation.ghost_cells import nearest, truncate
from jaxsand.scene.grid import Neighbours, links

Map = Float[Array, "m m ..."]  # a block, or one for each map of a batch in the last axis
_FELT = 0.25  # the open share from which on a link counts in full in a gradient
_CALM = 0.6  # factor of the rate of isotropic sand, which overshoots at the full rate when it starts from a guess
_GUESSED = 0.07  # the open share from which on a guess counts in full; less is closer to the limit but less smooth
_RUNS_OFF = 5  # factor of the rate over a rim, beyond which no cell has to be kept stable


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Sand:
    """A block of sand around a tool; heights are in quanta.

    Attributes:
        gates: open share of each link, in the shapes of flux.py.
        open: open share of each cell [m, m].
        stretch: how much higher sand stands in partly covered cells: at h + stretch (h - bottom).
        bottom: height of the tool's bottom, a scalar or [m, m].
        drop: largest stable step of a straight link.
        sides: number of sides over which each cell drains [m, m], or None where the edge is closed.
        rim: height of the draining rim, or None.
        neighbours: 4, 8 or "isotropic".
        base: height of the floor [m, m] (whole quanta), or None without one.
    """

    gates: Fluxes
    open: Map
    stretch: Map
    bottom: Map | Float[Array, "..."]
    drop: Map | Float[Array, "..."]
    sides: Map | None
    rim: Float[Array, "..."] | None
    neighbours: Neighbours = field(metadata={"static": True})
    base: Map | None = None

    def surface(self, h: Map) -> Map:
        """The height at which the sand of each cell stands in its open share."""
        return h + self.stretch * jnp.where(h > self.bottom, h - self.bottom, 0)


def no_flux(neighbours: Neighbours, drains: bool, h: Map) -> Fluxes:
    """Fluxes of 0 for a block of heights [m, m]."""
    if neighbours == "isotropic":
        maps = [jnp.zeros_like(h)] * 8
    else:
        with_ghosts = jnp.zeros((h.shape[0] + 2, h.shape[1] + 2, *h.shape[2:]), h.dtype)
        maps = [ends(with_ghosts, di, dj)[0] for di, dj, _ in links(neighbours)]
    return (*maps, jnp.zeros_like(h)) if drains else tuple(maps)


def bring_to_rest(sand: Sand, rate: Float[Array, "..."], sweeps: int, h: Map, guess: Fluxes) -> tuple[Map, Fluxes]:
    """The heights after a number of proximal steps that start from a guess of the fluxes, and the fluxes."""
    there = None if sand.base is None else held(h, sand.base, jnp.ones((), h.dtype))
    model: Links | _Gradients = Links(sand, rate, there)
    if sand.neighbours == "isotropic":
        model = _Gradients(sand, _CALM * rate, there)

    def stage(_: jax.Array, flux: Fluxes) -> Fluxes:
        # The model passes the barrier too: XLA would else compute parts of the step beforehand and store them.
        here, flux = lax.optimization_barrier((model, flux))
        return lax.optimization_barrier(here.shrink(flux, outer(here.sand.surface(h + here.gained(flux)))))

    flux = lax.fori_loop(0, sweeps, stage, lax.optimization_barrier(guess))
    return lax.optimization_barrier(h + model.gained(flux)), flux


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Links:
    """The proximal steps with 4 or 8 neighbours: one flux for each link, in whole quanta.

    `there` is what each cell holds on a floor (quanta), or None without one.
    """

    sand: Sand
    rate: jax.Array
    there: Map | None = None

    @property
    def factors(self) -> list[jax.Array]:
        """The flux over an open link per step of the surface, for each direction."""
        return [self.rate / length for _, _, length in links(self.sand.neighbours)]

    @property
    def most(self) -> jax.Array:
        """The flux that the largest stable step would drive, the same in all directions."""
        return self.rate * self.sand.drop

    def shrink(self, flux: Fluxes, surface: jax.Array) -> Fluxes:
        """The fluxes after one proximal step; `surface` is that of the sand, with ghost cells."""
        out, neighbours = [], self.sand.neighbours
        thresholds = [self.most] * len(self.sand.gates)
        if self.sand.drop.ndim == surface.ndim:
            thresholds = [(here + there) / 2 for here, there in both_ends(neighbours, outer(self.most))]
        parts = zip(flux, self.sand.gates, self.factors, rises(neighbours, surface), thresholds, strict=False)
        for f, g, factor, rise, threshold in parts:
            z, most = f + g * (factor * rise), g * threshold
            # Comparisons become single instructions; minimum and maximum, which look for NaN, do not.
            out.append(nearest(z - jnp.where(z > most, most, jnp.where(z < -most, -most, z))))
        if self.sand.sides is not None:
            out.append(_over(self.sand, self.rate, flux[-1], inner(surface)))
        return tuple(out) if self.there is None else no_more_than(neighbours, self.there, out)

    def gained(self, flux: Fluxes) -> jax.Array:
        """What each cell gains from fluxes."""
        return _gained(self.sand, flux)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class _Gradients:
    """The proximal steps of isotropic sand: fluxes along x and y for each of a cell's four one-sided gradients, in turn.

    `there` is as of `Links`. A link whose upper end is bare floor has no step, as if a wall stood there.
    """

    sand: Sand
    rate: jax.Array
    there: Map | None = None

    def shrink(self, y: Fluxes, surface: jax.Array) -> Fluxes:
        """The fluxes after one proximal step; `surface` is that of the sand, with ghost cells."""
        arms = [d * _felt(gate) for d, gate in zip(rises("isotropic", surface), self.sand.gates, strict=True)]
        if self.there is not None:
            wet = outer(jnp.where(self.there > jnp.maximum(THIN * self.sand.drop, 8), 1.0, 0.0).astype(surface.dtype))
            both = both_ends("isotropic", wet)
            arms = [d * jnp.where(d > 0, there, here) for d, (here, there) in zip(arms, both, strict=True)]
        across, up = _both_ends(arms)
        of_x, of_y = _both_ends([_weight(gate) for gate in self.sand.gates])
        out = []
        for n in range(4):
            i, j = n // 2, n % 2
            rate = self.rate * jnp.minimum(of_x[i], of_y[j])
            zx, zy = y[2 * n] + rate * across[i], y[2 * n + 1] + rate * up[j]
            part = share_beyond(zx * zx + zy * zy, rate * self.sand.drop)
            out += [zx * part, zy * part]
        if self.sand.sides is not None:
            over = _over(self.sand, self.rate, y[-1], inner(surface))
            out.append(over if self.there is None else jnp.minimum(over, self.there))
        return tuple(out)

    def gained(self, flux: Fluxes) -> jax.Array:
        west, east = flux[0] + flux[2], flux[4] + flux[6]
        south, north = flux[1] + flux[5], flux[3] + flux[7]
        column, row = jnp.zeros_like(west[:, :1]), jnp.zeros_like(west[:1])
        over_x = (jnp.concatenate([column, east], 1) + jnp.concatenate([west, column], 1)) / 4
        over_y = (jnp.concatenate([row, north], 0) + jnp.concatenate([south, row], 0)) / 4
        moved = tuple(truncate(f * _felt(g)) for f, g in zip((over_x, over_y), self.sand.gates, strict=True))
        moved = lax.optimization_barrier(moved)
        over = () if self.sand.sides is None else (flux[-1],)
        if self.there is not None:  # what runs off over the rim goes first, and is what the fluxes say
            moved = no_more_than("isotropic", self.there - sum(over), moved)
        return _gained(self.sand, (*moved, *over))


def _both_ends(arms: list[jax.Array]) -> tuple[tuple[jax.Array, jax.Array], tuple[jax.Array, jax.Array]]:
    """The steps over each cell's links to the west and east, and to the south and north."""
    x, y = arms
    return (x[:, :-1], x[:, 1:]), (y[:-1], y[1:])


def _felt(gate: jax.Array) -> jax.Array:
    """The factor a of a link's step and flux in a gradient, from its open share."""
    return jnp.minimum(gate / _FELT, 1)


def _weight(gate: jax.Array) -> jax.Array:
    """The weight w / a^2 of a link in a gradient, at most 1; for a closed link, whose a is 0, it has no effect."""
    return jnp.where(gate < _FELT, jnp.minimum(_FELT**2 / jnp.maximum(gate, _FELT**2), 1), gate)


def where_open(neighbours: Neighbours, gates: Fluxes, guess: Fluxes) -> Fluxes:
    """A guess of fluxes, reduced over links that are nearly closed, in whole quanta."""
    if neighbours == "isotropic":
        across, up = _both_ends(list(gates))
        gates = tuple(ends[k] for n in range(4) for ends, k in ((across, n // 2), (up, n % 2)))
    return tuple(nearest(jnp.where(g < _GUESSED, g / _GUESSED, 1) * f) for g, f in zip(gates, guess, strict=True))


def _over(sand: Sand, rate: jax.Array, y: jax.Array, s: jax.Array) -> jax.Array:
    """The flux over the rim after one step: it grows by nearly all the sand that stands above repose against the rim."""
    assert sand.sides is not None
    assert sand.rim is not None
    part = jnp.minimum(_RUNS_OFF * rate, 0.9) * sand.open
    out = jnp.maximum(y + part * (s - (sand.rim + sand.drop / 2)), 0)
    return truncate(jnp.where(sand.sides > 0, out, 0))


def _gained(sand: Sand, flux: Fluxes) -> jax.Array:
    """What each cell gains from the fluxes over its links, less what it loses over the rim."""
    if sand.sides is None:
        return net(sand.neighbours, flux)
    return net(sand.neighbours, flux[:-1]) - flux[-1]
