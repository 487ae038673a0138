"""Schemes of settling: how the sand is taken to rest. Each is a small type; `settle` takes any of them.

The sand's way down is the gradient flow dh/dt = -grad E of the convex function of flux.py, t counted in sweeps of rate 1.
Its fixed points are not isolated: where the flow ends depends on the way taken, so a scheme is as faithful as its way is
close to the flow of small steps. `jaxsand bench settle` measures that against run time.
"""

import math
from dataclasses import dataclass, field
from functools import cache

import jax
import numpy as np

from jaxsand.scene.boundaries import Draining
from jaxsand.scene.scene import Scene


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Relaxation:
    """The paper's sweep (arXiv:1908.02745, Eq. 1-2) with flow rate k = rate dx^2: forward Euler, first order in the rate.

    With 8 neighbours it is stable for rate < 1/4.83 and a convex combination of neighbouring heights (no overshoot: the
    highest point never rises, the lowest never falls) up to 1/6.83; with 4 neighbours or isotropic for both up to 1/4, on a
    map of one row or column up to 1/2 (1/4 if its edge drains). The default is the paper's dx^2/8.
    Sweeps to stillness grow with the square of the distance that sand travels.
    """

    rate: jax.Array | float = 0.125


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Pairwise:
    """Red-black relaxation: pairs of neighbours settle at once, one direction and every other pair after the other.

    A pair moves `share` of the half of its excess that brings it to repose. Stable and a convex combination for
    share <= 1, linearly stable below 2. Order 0: it does not approach the flow of small steps, except as share goes to 0
    (first order); still in few sweeps, and far from faithful. A sweep visits each link once, in four or eight passes. Not
    symmetric under mirrors. For 4 or 8 neighbours.
    """

    share: jax.Array | float = 1.0


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class SuperTimeStepping:
    """Runge-Kutta-Legendre steps of first order (RKL1) that grow in proportion to the time elapsed.

    A step of s sweeps, each with the momentum (j - 1)/j and the rate c (2 - 1/j), j = 1..s, advances by c (s^2 + s)/2 and is
    stable for c up to the limit of `Relaxation`, of which `safety` is the share used (Meyer, Balsara & Aslam, JCP 2014,
    doi:10.1016/j.jcp.2013.08.021). Sand that has flowed for a time t varies over distances of sqrt(t), so a step of
    `growth` t is as accurate late as it is early: after sharp edges have been worn by single sweeps, of which the first has
    the rate `first`, sweeps to stillness grow only in proportion to the distance that sand travels. First order in `growth`
    and `first`. Keeps the maximum principle for linear diffusion (Meyer et al.), not in general.
    """

    growth: float = field(default=0.4, metadata={"static": True})
    first: float = field(default=1 / 32, metadata={"static": True})
    safety: float = field(default=0.6, metadata={"static": True})


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Multilevel:
    """Super-time-stepping that hands late times over to coarser grids, whose cells are twice as wide.

    On every grid the flow runs until the time `handover` (in squared spacings of that grid, as a sweep of rate 1 takes it on
    by 1); what then still moves is
    smooth, and the next coarser grid carries it on, down to a grid of less than twice `coarsest` cells. What changed there
    is added to the finer grid, linearly between cells, and settles. The cost to a given error grows with the number of
    cells alone. First order in growth and first, and in the ratio of a coarse spacing to what has been smoothed, so that the
    error falls as `handover` grows. For wide scenes: what is narrower than a few cells (a column of one cell, a thin
    trench) is not seen by coarser grids in time, and next to walls only the finest grids carry sand. Volume is exact. Where
    rows or columns are odd in number the last ones share a cell.
    """

    handover: float = field(default=128.0, metadata={"static": True})
    coarsest: int = field(default=8, metadata={"static": True})
    growth: float = field(default=0.8, metadata={"static": True})
    first: float = field(default=1 / 32, metadata={"static": True})
    safety: float = field(default=0.6, metadata={"static": True})

    def steps(self) -> SuperTimeStepping:
        return SuperTimeStepping(self.growth, self.first, self.safety)


Scheme = Relaxation | Pairwise | SuperTimeStepping | Multilevel


def stable_rate(scene: Scene) -> float:
    """The rate above which the checkerboard, with 8 neighbours stripes, in one dimension the saw-tooth grows."""
    if 1 in scene.grid.shape:
        return 1 / 4 if isinstance(scene.edge, Draining) else 1 / 2
    return {4: 1 / 4, 8: 1 / (2 + 2 * 2**0.5), "isotropic": 1 / 4}[scene.grid.neighbours]


@dataclass(frozen=True)
class Schedule:
    """Steps of super-time-stepping: the sweep with which each begins, and its rate c. Ends of steps are ends of groups."""

    starts: np.ndarray
    rates: np.ndarray
    times: np.ndarray  # elapsed before each step


@cache
def schedule(scheme: SuperTimeStepping, limit: float, sweeps: int, group: int, elapsed: float = 0.0) -> Schedule:
    """Steps for `sweeps` sweeps, looked at every `group` sweeps, that continue a flow which has run for a time `elapsed`.

    A step shorter than a group does not reach over its end; a longer one is a number of whole groups.
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
