"""Schemes: the numerical methods by which `settle` takes sand to rest. Each is a small class.

Sand flows down along the gradient flow dh/dt = -grad E, where E is the convex function of flux.py and time is counted in
sweeps of rate 1. E has many minima, so that the settled map depends on the path of the flow: a scheme is accurate as far as
its path stays close to that of infinitely small steps. `jaxsand bench settle` measures that error against run time.
"""

import math
from dataclasses import dataclass, field
from functools import cache

import jax
import numpy as np
from jaxtyping import Array, Float

from jaxsand.scene.boundaries import Draining
from jaxsand.scene.scene import Scene


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Relaxation:
    """The sweep of Kim, Pavlov & Johnson, repeated: forward Euler with a constant step.

    In one sweep, every pair of neighbours i, j at the distance l dx exchanges

        rate / l * excess,   excess = (h_j - h_i) - clip(h_j - h_i, -m, m),   m = tan(repose_angle) l dx.

    First order in the rate. The number of sweeps until the sand is still grows with the square of the distance that sand
    travels. With 8 neighbours, sweeps are stable for rates below 1/4.83, and up to 1/6.83 the highest point never rises and
    the lowest never falls. With 4 neighbours or isotropic sand both limits are 1/4; on a map of one row or column 1/2 (1/4
    if its edge drains). Differentiable in the rate.

    Attributes:
        rate: share of the excess that a straight link passes on in one sweep; the paper's flow rate is rate * dx^2.

    Source:
        Eq. 1-2 of Kim, Pavlov & Johnson, arXiv:1908.02745, where rate = 1/8.

    Example:
        >>> import jax.numpy as jnp
        >>> import jaxsand as js
        >>> scene = js.make_scene((8, 8), 0.01)
        >>> heap = jnp.zeros((8, 8)).at[4, 4].set(0.03)
        >>> settled = js.settle(scene, heap, scheme=js.Relaxation(rate=0.1))
        >>> bool(settled.residual <= 1e-3)
        True
    """

    rate: Float[Array, ""] | float = 0.125


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Pairwise:
    """Red-black relaxation: pairs of neighbours are brought to repose one after the other.

    A sweep visits each link once, in four passes (8 neighbours: eight): for each direction first every other pair, then the
    rest. A pair whose step exceeds the largest stable one by e exchanges share * e / 2. Sand is still after few sweeps, but
    the settled map is not accurate (order 0): it approaches that of small steps only as `share` goes to 0, to first order.
    The result is not symmetric under mirrors. For 4 or 8 neighbours, not for isotropic sand. Differentiable in the share.

    Attributes:
        share: part of the exchange that brings a pair to repose, above 0 and at most 1.

    Example:
        >>> import jax.numpy as jnp
        >>> import jaxsand as js
        >>> scene = js.make_scene((8, 8), 0.01, neighbours=4)
        >>> heap = jnp.zeros((8, 8)).at[4, 4].set(0.03)
        >>> bool(js.settle(scene, heap, scheme=js.Pairwise()).residual <= 1e-3)
        True
    """

    share: Float[Array, ""] | float = 1.0


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class SuperTimeStepping:
    """Runge-Kutta-Legendre steps of first order (RKL1) whose length grows with the time elapsed: the default scheme.

    A step has s stages, each of them a sweep. Stage j = 1..s has the rate c (2 - 1/j) and repeats the share (j - 1)/j of
    what the stage before moved. The step advances the time by c (s^2 + s)/2, and is stable for c up to the largest rate of
    `Relaxation`. The step at time t is growth * t long: sand that has flowed for a time t varies over distances of sqrt(t),
    so that late steps are as accurate as early ones. The number of sweeps until the sand is still then grows only in
    proportion to the distance that sand travels. First order in `growth` and `first`. Linear diffusion keeps its maximum
    principle; sand need not.

    Attributes:
        growth: length of a step over the time elapsed, 1e-4 to 4; static.
        first: rate of the first sweep, 1e-4 to 1; static.
        safety: share of the largest stable rate that is used, 1e-4 to 1; static.

    Source:
        Meyer, Balsara & Aslam, Journal of Computational Physics 257 (2014), doi:10.1016/j.jcp.2013.08.021.

    Example:
        >>> import jax.numpy as jnp
        >>> import jaxsand as js
        >>> scene = js.make_scene((8, 8), 0.01)
        >>> heap = jnp.zeros((8, 8)).at[4, 4].set(0.03)
        >>> bool(js.settle(scene, heap, scheme=js.SuperTimeStepping()).residual <= 1e-3)
        True
    """

    growth: float = field(default=0.4, metadata={"static": True})
    first: float = field(default=1 / 32, metadata={"static": True})
    safety: float = field(default=0.6, metadata={"static": True})


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Multilevel:
    """Super-time-stepping on a hierarchy of grids (multigrid), for wide maps.

    On each grid, super-time-stepping runs until the time `handover`, in sweeps of rate 1. What still moves then is smooth,
    and the next coarser grid, whose cells are twice as wide, continues, down to a grid narrower than 2 `coarsest` cells.
    What changed on a coarse grid is added to the finer one by linear interpolation, and settles there. The cost for a given
    error is in proportion to the number of cells. First order in `growth` and `first`; the error also falls as `handover`
    grows. Volume is conserved exactly.

    Coarse grids miss features a few cells wide (a column of one cell, a thin trench), and next to walls only the finest
    grids carry sand. It takes `UntilStill` only, and no `Window`.

    Attributes:
        handover: time after which the next coarser grid takes over, at least 1; static.
        coarsest: least number of cells across the narrower side of the coarsest grid, 2 or more; static.
        growth: length of a step over the time elapsed, see `SuperTimeStepping`; static.
        first: rate of the first sweep, see `SuperTimeStepping`; static.
        safety: share of the largest stable rate that is used; static.

    Example:
        >>> import jax.numpy as jnp
        >>> import jaxsand as js
        >>> scene = js.make_scene((8, 8), 0.01)
        >>> heap = jnp.zeros((8, 8)).at[4, 4].set(0.03)
        >>> settled = js.settle(scene, heap, scheme=js.Multilevel())  # a map so small has one grid alone
        >>> bool(settled.residual <= 1e-3)
        True
    """

    handover: float = field(default=128.0, metadata={"static": True})
    coarsest: int = field(default=8, metadata={"static": True})
    growth: float = field(default=0.8, metadata={"static": True})
    first: float = field(default=1 / 32, metadata={"static": True})
    safety: float = field(default=0.6, metadata={"static": True})

    def steps(self) -> SuperTimeStepping:
        """The scheme used on each grid."""
        return SuperTimeStepping(self.growth, self.first, self.safety)


Scheme = Relaxation | Pairwise | SuperTimeStepping | Multilevel


def stable_rate(scene: Scene) -> float:
    """The largest stable rate of a sweep in this scene: above it, the shortest wave on the grid grows."""
    if 1 in scene.grid.shape:
        return 1 / 4 if isinstance(scene.edge, Draining) else 1 / 2
    return {4: 1 / 4, 8: 1 / (2 + 2 * 2**0.5), "isotropic": 1 / 4}[scene.grid.neighbours]


@dataclass(frozen=True, eq=False)
class Schedule:
    """The steps of super-time-stepping; each ends with, or within, a group of sweeps.

    Compared by identity: `schedule` gives the same object for like arguments.

    Attributes:
        starts: number of the sweep with which each step begins.
        rates: rate c of each step.
        times: time elapsed before each step.
    """

    starts: np.ndarray
    rates: np.ndarray
    times: np.ndarray


@cache
def schedule(scheme: SuperTimeStepping, limit: float, sweeps: int, group: int, elapsed: float) -> Schedule:
    """The steps that make up `sweeps` sweeps in groups of `group`, from the time `elapsed` on; `limit` is the stable rate.

    A step lies within one group, or consists of whole groups.
    """
    c = scheme.safety * limit
    starts: list[int] = []
    rates, times, done, time = [], [], 0, elapsed
    while not starts or done < sweeps:
        starts.append(done)
        times.append(time)
        step = max(scheme.first, scheme.growth * time)
        stages = max(1, int((math.sqrt(1 + 8 * step / c) - 1) / 2))
        room = group - done % group
        stages = stages // group * group if stages >= group and room == group else min(stages, room)
        stages = min(stages, sweeps - done)
        rates.append(min(c, step))
        time += rates[-1] * (stages**2 + stages) / 2
        done += stages
    return Schedule(np.array(starts, np.int32), np.array(rates), np.array(times))
