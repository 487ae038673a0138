"""How near to a goal sand can come at best: the floor that repose and volume set, and the map that reaches it.

Maps at rest whose volume is the start's are a convex set, and a goal's cost J is convex. So the least cost is that of a
convex programme,

    min J(h)   with   h_i - h_j <= c_ij over every link,   low <= h <= high,   sum h = V.

With any multipliers, a flow f over the links and a price nu of sand, it is at least

    sum over cells of min { J_i(x) + (div f_i + nu) x : low_i <= x <= high_i }  -  sum c |f|  -  nu V,

which is one closed form for each cell. So what is told as a bound holds however good or bad the solver is, which is a
splitting (ADMM) between the cells' costs and the links' limits, with one sparse factorisation. More: the theory page on
planning, notebooks/site/theory/planning.md.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

import jax.numpy as jnp
import numpy as np
from scipy import sparse
from scipy.sparse.csgraph import dijkstra
from scipy.sparse.linalg import splu

from jaxsand.goals.goal import Goal, Power, as_goal
from jaxsand.goals.metrics import finite
from jaxsand.interaction.outcome import check
from jaxsand.relaxation.flux import THIN
from jaxsand.relaxation.settling import settle
from jaxsand.relaxation.stopping import UntilStill
from jaxsand.scene.boundaries import Base, Draining, Walls
from jaxsand.scene.grid import links
from jaxsand.scene.scene import Scene, as_array, fit
from jaxsand.scene.validation import concrete, short

_GAP = 1e-3  # of the cost: where the solver stops
_ZERO = 3e-5  # of the distance before, or of a step at repose in every cell: what counts as no distance
_ROUNDS, _EVERY = 4000, 50  # of the solver at most, and between looks at what it has
_RELAXED = 1.6  # steps of the solver are longer by this factor
_PULL = 0.1  # of the weights, for p = 1: what multipliers are measured by where they are less
_HAIR = 1e-6  # of the steps that repose allows: kept free, so that rounding does not set the sand in motion
_BELOW = 1e-6  # spacings: what counts as below the floor
_SMALL = 1e-12


@dataclass(frozen=True)
class AtBest:
    """The nearest to a goal that sand at rest can come, and the proof.

    Attributes:
        height: a map [H, W] (m) at rest, of the start's volume, as near to the goal as was found.
        cost: its cost J by the goal (m^2, or m for p = 1).
        bound: no map at rest of that volume costs less.
        power: p of the goal.

    Example:
        >>> import numpy as np
        >>> import jaxsand as js
        >>> best = js.at_best(js.make_scene((8, 8), 0.01), np.zeros((8, 8)), np.full((8, 8), 0.001))  # it lacks sand
        >>> print(f"{best.distance:.4f} {best.distance_bound:.4f}")
        0.0080 0.0080
    """

    height: np.ndarray
    cost: float
    bound: float
    power: Power

    @property
    def distance(self) -> float:
        """The map's distance from the goal, J^(1/p) (m)."""
        return self.cost ** (1 / self.power)

    @property
    def distance_bound(self) -> float:
        """No map at rest of that volume is nearer to the goal (m)."""
        return self.bound ** (1 / self.power)

    @property
    def gap(self) -> float:
        """distance - distance_bound (m)."""
        return self.distance - self.distance_bound


def at_best(scene: Scene, start: np.ndarray, goal: Goal | np.ndarray, *, tolerance: float = 1e-3) -> AtBest:
    """How near to a goal the sand of a map can come, however it is moved, and a map that comes as near.

    It is the least cost of all maps at rest that hold as much sand as the start. No tool and no plan can beat it: up to
    there the goal asks too much, and only beyond does a plan fall short. At rest is what `settle` leaves as it is, so slopes
    may exceed repose by the tolerance. Walls, an angle for each cell, a floor (`Base`) and a draining edge, over which sand
    may leave, count. Sand may be carried over walls, but none is kept in a bucket. Solid cells cost what they cost before.

    The bound is proven by multipliers, in exact arithmetic, and holds even where the solver gives up; else it lies within a
    thousandth of the cost. For two kinds of scene the programme allows too much: the bound is true but may be low, and the
    map is the programme's after it has settled. Isotropic sand at rest is so for 8 neighbours too, but not the other way
    round. And sand on a floor that is steeper than repose may stand as high above its neighbours as the bare floor does.

    Args:
        scene: grid, material, walls, edge and floor; its tool plays no part.
        start: the map [H, W] (m), of which only the volume counts; it need not be at rest.
        goal: a map [H, W] (m), or a `Goal`, which says what matters. NaN and masked cells are free.
        tolerance: slope above repose (a tangent) that counts as still, as of `UntilStill`. With 0 it is what exact repose
            allows, which the sand of a simulation, still to its own tolerance, may beat by a little.

    Returns:
        An `AtBest`: the map, its cost, and the bound; all in float64.

    Raises:
        ValueError: for maps that do not fit the scene, a start below the floor, or a tolerance below 0.
        OutcomeError: if the sand of one of those two kinds of scene does not come to rest.

    Example:
        A trench with vertical walls, deeper than sand can keep; heaps may lie beside it, but no holes:

        >>> import numpy as np
        >>> import jaxsand as js
        >>> scene, trench = js.make_scene((16, 16), 0.01), np.zeros((16, 16))
        >>> trench[4:12, 6:10] = -0.02
        >>> best = js.at_best(scene, np.zeros((16, 16)), js.Goal(trench, above=trench < 0))
        >>> print(f"{best.distance:.3f} {best.gap < 1e-3 * best.distance} {js.settle(scene, best.height).sweeps}")
        0.048 True 0
    """
    wanted, height = as_goal(scene, goal), _started(scene, start, tolerance)
    limits = _limits(scene, height, tolerance)
    sand, best = limits.sand, height.copy()
    want, above, below = (np.asarray(a)[sand] for a in (wanted.height, wanted.above, wanted.below))
    cells = CellCosts(want, above, below, wanted.power)
    cost, bound = math.inf, 0.0
    before, steps = float(cells.cost(height[sand]).sum()), float(np.maximum(cells.above, cells.below).sum())
    none = _ZERO**cells.power * max(before, steps * limits.unit**cells.power)
    for h, flow, price in _iterates(limits, cells):
        near = limits.feasible(h)
        left = float(cells.cost(near).sum())
        if left < cost:
            best[sand], cost = near, left
        bound = max(bound, lagrangian(limits, cells, flow, price, cost))
        if cost - bound <= max(_GAP * cost, none):
            break
    fixed = float(wanted.cost(np.where(sand, height - wanted.apart(height), height)))
    if not limits.exact:
        settled = settle(scene, best.astype(jnp.result_type(float)), stop=UntilStill(tolerance, bound=200_000))
        check(settled)
        best = np.asarray(settled.height, float)
    cost = float(wanted.cost(best))
    return AtBest(best, cost, min(bound + fixed, cost), wanted.power)


def _started(scene: Scene, start: np.ndarray, tolerance: float) -> np.ndarray:
    """The start in float64; raises ValueError unless it fits the scene, and the tolerance is 0 or more."""
    fit(scene, as_array("start", start, np.float32))
    height = np.asarray(start, float)
    finite(height, "start")
    allowed = concrete(tolerance)
    if allowed is None or allowed.ndim or not 0 <= allowed < math.inf:
        raise ValueError(f"tolerance: got {short(tolerance)}; give a slope of 0 or more, such as 0.001")
    return height


@dataclass(frozen=True)
class CellCosts:
    """The costs of cells: goals, NaN where a cell is free, and weights, all of one shape."""

    goal: np.ndarray
    above: np.ndarray
    below: np.ndarray
    power: Power

    def cost(self, h: np.ndarray) -> np.ndarray:
        """What each cell costs at the height h."""
        apart = h - np.where(np.isnan(self.goal), h, self.goal)
        return np.where(apart > 0, self.above, self.below) * np.abs(apart) ** self.power

    def lowest(self, price: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
        """The height from `low` to `high` at which cost + price * height is least; infinite if it has no minimum."""
        weight, far = np.where(price < 0, self.above, self.below), np.where(price < 0, np.inf, -np.inf)
        goal = np.where(np.isnan(self.goal), 0, self.goal)
        if self.power == 2:
            x = np.where(weight > 0, goal - price / np.where(weight > 0, 2 * weight, 1), far)
        else:
            x = np.where(np.abs(price) > weight, far, goal)
        return np.clip(np.where(price == 0, goal, x), low, high)

    def nearest(self, v: np.ndarray, rate: float) -> np.ndarray:
        """The height x at which cost + rate (x - v)^2 / 2 is least."""
        g = np.where(np.isnan(self.goal), v, self.goal)
        apart = v - g
        weight = np.where(apart > 0, self.above, self.below)
        if self.power == 2:
            return g + apart * (rate / (2 * weight + rate))
        return g + np.sign(apart) * np.maximum(np.abs(apart) - weight / rate, 0)


@dataclass(frozen=True)
class RestLimits:
    """What maps at rest keep to: the sand's cells, numbered row by row, and their links.

    Attributes:
        sand: which cells of the map [H, W] hold sand.
        one, two: the numbers of the cells that each link joins.
        up: how far at most the first of them may stand above the second (m).
        down: how far at most the second may stand above the first (m).
        low, high: what bounds each cell's height (m).
        total: the sum of the heights (m), or the most it may be where sand drains.
        drains: whether it does.
        exact: whether every map within these limits is at rest.
        unit: the step between neighbours that repose allows (m).
    """

    sand: np.ndarray
    one: np.ndarray
    two: np.ndarray
    up: np.ndarray
    down: np.ndarray
    low: np.ndarray
    high: np.ndarray
    total: float
    drains: bool
    exact: bool
    unit: float

    def most(self, high: np.ndarray) -> np.ndarray:
        """The highest map below `high` that no link forbids; infinite where nothing bounds it."""
        tail, head = np.append(self.two, self.one), np.append(self.one, self.two)
        return _spread(high, tail, head, np.append(self.up, self.down))

    def least(self, low: np.ndarray) -> np.ndarray:
        """The lowest map above `low` that no link forbids."""
        tail, head = np.append(self.one, self.two), np.append(self.two, self.one)
        return -_spread(-low, tail, head, np.append(self.up, self.down))

    def feasible(self, h: np.ndarray) -> np.ndarray:
        """A map near h within all limits, with a hair to spare, and of the right volume: between the highest below h that
        repose allows and the lowest above it, lifted or lowered as a whole between what bounds it.
        """
        inner = replace(self, up=self.up * (1 - _HAIR), down=self.down * (1 - _HAIR))
        low = self.low
        high = np.maximum(inner.most(self.high - _HAIR * self.unit), low)
        h = np.clip(h, low, self.high)
        h = (inner.most(h) + inner.least(h)) / 2

        def lifted(by: float) -> np.ndarray:
            return np.clip(h + by, low, high)

        missing = self.total - lifted(0.0).sum()
        if self.drains and missing >= 0:
            return lifted(0.0)
        few = many = missing / len(h)
        while lifted(few).sum() > self.total and (lifted(few) > low).any():
            few -= 2 * abs(few) + self.unit
        while lifted(many).sum() < self.total and (lifted(many) < high).any():
            many += 2 * abs(many) + self.unit
        for _ in range(100):
            by = (few + many) / 2
            few, many = (by, many) if lifted(by).sum() <= self.total else (few, by)
        return lifted(few)


def _spread(high: np.ndarray, tail: np.ndarray, head: np.ndarray, rise: np.ndarray) -> np.ndarray:
    """The highest map below `high` that stands at each arc's head at most its rise above its tail."""
    n, known = len(high), np.flatnonzero(np.isfinite(high))
    if not len(known):
        return high
    deep = high[known].min() - 1  # from one more cell, and by arcs above 0, which no reader can take for none
    arcs = (np.append(tail, np.full(len(known), n)), np.append(head, known))
    graph = sparse.csr_matrix((np.append(rise, high[known] - deep), arcs), (n + 1, n + 1))
    return dijkstra(graph, indices=n)[:n] + deep


def _limits(scene: Scene, start: np.ndarray, tolerance: float) -> RestLimits:
    """The limits of maps at rest; raises ValueError if the start lies below the floor, or every cell is solid."""
    shape, dx = scene.grid.shape, float(scene.grid.spacing)
    sand = ~np.asarray(scene.walls.solid) if isinstance(scene.walls, Walls) else np.ones(shape, bool)
    if not sand.any():
        raise ValueError("scene.walls: got no cell that is not solid; leave some to the sand")
    mu = np.broadcast_to(np.tan(np.asarray(scene.material.repose_angle, float)), shape)
    if scene.grid.neighbours == "isotropic":
        mu = np.full(shape, mu[sand].max())  # a gradient's limit is a mean over its cells
    one, two, level = _links(scene, sand, (mu + tolerance) * dx)
    low, high, up, down = np.full(len(start[sand]), -np.inf), np.full(shape, np.inf), level, level
    bare = np.full(shape, -np.inf)
    if isinstance(scene.base, Base):  # bare floor, or as good as bare, is still however steep
        floor, thin = np.broadcast_to(np.asarray(scene.base.height, float), shape), THIN * dx
        low, bare = floor[sand], floor + thin
        if (start[sand] < low - _BELOW * dx).any():
            raise ValueError(f"start: got {(low - start[sand]).max():.3g} m below the floor; give a map above scene.base")
        up, down = (np.maximum(level, low[a] + thin - low[b]) for a, b in ((one, two), (two, one)))
    if isinstance(scene.edge, Draining):
        edge = np.ones(shape, bool)
        edge[1:-1, 1:-1] = False
        high = np.where(edge, np.maximum(float(scene.edge.level) + (mu + tolerance) * dx / 2, bare), np.inf)
    exact = scene.grid.neighbours != "isotropic" and bool((up == level).all() and (down == level).all())
    total = max(float(start[sand].sum()), float(low.sum()))
    unit = float(mu[sand].mean()) * dx
    return RestLimits(sand, one, two, up, down, low, high[sand], total, isinstance(scene.edge, Draining), exact, unit)


def _links(scene: Scene, sand: np.ndarray, drop: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The numbers of the cells that each link joins, and the step over it that repose allows (m).

    Isotropic sand limits gradients (gx, gy), one over each pair of a straight link along x and one along y that share a
    cell: |gx|, |gy| <= mu and |gx| + |gy| <= sqrt(2) mu, so that no diagonal is steeper than mu if one of the two cells
    beside it holds sand. Over a floor a link whose upper end is bare counts as level, and only straight ones are limited.
    """
    rows, columns = sand.shape
    isotropic, number = scene.grid.neighbours == "isotropic", np.cumsum(sand).reshape(sand.shape) - 1
    ends = []
    for di, dj, length in links(8 if isotropic and not isinstance(scene.base, Base) else scene.grid.neighbours):
        i, j = slice(0, rows - di), slice(max(-dj, 0), columns - max(dj, 0))
        k, m = slice(di, rows), slice(max(dj, 0), columns + min(dj, 0))
        there = sand[i, j] & sand[k, m]
        if isotropic and di and dj:
            there &= sand[i, m] | sand[k, j]
        ends.append((number[i, j][there], number[k, m][there], ((drop[i, j] + drop[k, m]) * (length / 2))[there]))
    one, two, level = (np.concatenate(x) for x in zip(*ends, strict=True))
    return one, two, level


def _iterates(limits: RestLimits, cells: CellCosts) -> Iterator[tuple[np.ndarray, np.ndarray, float]]:
    """Maps [n] (m), flows over the links and prices of sand that come ever nearer to the best ones.

    The alternating direction method of multipliers, over-relaxed: x is a map of the right volume, z and s are what the
    cells and the links make of its heights and steps, and u and v add up how far these are from x's own. Heights are in
    units of the step that repose allows, from the mean, and the largest weight is 1. Both penalties grow or shrink
    together where x is much farther from z and s than these are from coming to rest, or the other way round.
    """
    n, m, middle, unit = len(limits.low), len(limits.one), limits.total / len(limits.low), limits.unit
    heavy = float(max(cells.above.max(), cells.below.max())) or 1.0
    scaled = CellCosts((cells.goal - middle) / unit, cells.above / heavy, cells.below / heavy, cells.power)
    low, high, up, down = (a / unit for a in (limits.low - middle, limits.high - middle, limits.up, limits.down))
    ends = (np.tile(np.arange(m), 2), np.append(limits.one, limits.two))
    steps = sparse.csr_matrix((np.repeat([1.0, -1.0], m), ends), (m, n))
    back = steps.T.tocsr()
    rate, solve = 1.0, splu((sparse.eye(n) + back @ steps).tocsc()).solve
    x = z = np.where(np.isnan(scaled.goal), 0, scaled.goal)
    pull = _PULL * _size(np.maximum(scaled.above, scaled.below)) if cells.power == 1 else 0.0
    s, u, v = np.clip(steps @ x, -down, up), np.zeros(n), np.zeros(m)
    for k in range(_ROUNDS + 1):
        if k % _EVERY == 0:
            worth = rate * heavy * unit ** (cells.power - 1)
            yield unit * x + middle, worth * v, -worth * float(u.mean())
        old = z + back @ s
        x = solve(z - u + back @ (s - v))
        if not limits.drains or x.sum() > 0:
            x = x - x.mean()
        slopes = steps @ x
        near, over = _RELAXED * x + (1 - _RELAXED) * z, _RELAXED * slopes + (1 - _RELAXED) * s
        z, s = np.clip(scaled.nearest(near + u, rate), low, high), np.clip(over + v, -down, up)
        u, v = u + near - z, v + over - s
        if k % _EVERY == _EVERY - 1:
            apart = _size(x - z, slopes - s) / max(_size(x, slopes), _SMALL)
            moved = _size(z + back @ s - old) / max(_size(u), pull / rate, _SMALL)
            more = float(np.clip(math.sqrt(apart / max(moved, _SMALL)), 0.1, 10))
            if not 0.5 < more < 2:
                rate, u, v = rate * more, u / more, v / more


def _size(*parts: np.ndarray) -> float:
    return math.hypot(*(float(np.linalg.norm(part)) for part in parts))


def lagrangian(limits: RestLimits, cells: CellCosts, flow: np.ndarray, price: float, cost: float) -> float:
    """What no map within the limits costs less than, by these multipliers, unless `cost` is less; -inf if they tell nothing.

    Args:
      limits: what maps at rest keep to.
      cells: the goal's costs.
      flow: for each link, a number of either sign.
      price: of sand; below 0 it counts as 0 where sand drains.
      cost: of some map within the limits.
    """
    price = max(price, 0.0) if limits.drains else price
    n = len(limits.low)
    prices = np.bincount(limits.one, flow, n) - np.bincount(limits.two, flow, n) + price
    x = cells.lowest(prices, *_box(limits, cells, cost))
    if not np.isfinite(x).all():
        return -math.inf
    loose = float((np.where(flow > 0, limits.up, limits.down) * np.abs(flow)).sum())
    return min(float((cells.cost(x) + prices * x).sum()) - loose - price * limits.total, cost)


def _box(limits: RestLimits, cells: CellCosts, cost: float) -> tuple[np.ndarray, np.ndarray]:
    """The least and the greatest height of every cell (m) in maps within the limits that cost no more than this.

    A cell that alone would cost more bounds the others by the links between. Where all hang together and no sand leaves,
    the mean bounds them too. So multipliers that are a little off for a cell of weight 0 still tell something.
    """
    far = [(cost / np.where(w > 0, w, 1)) ** (1 / cells.power) for w in (cells.below, cells.above)]
    low = np.where(cells.below > 0, np.maximum(limits.low, cells.goal - far[0]), limits.low)
    high = np.where(cells.above > 0, np.minimum(limits.high, cells.goal + far[1]), limits.high)
    low, high = limits.least(low), limits.most(high)
    if limits.drains:
        return low, high
    first = np.where(np.arange(len(low)) == 0, 0, np.inf)
    middle, across = limits.total / len(low), float(limits.most(first).max() - limits.least(-first).min())
    return np.maximum(low, middle - across), np.minimum(high, middle + across)
