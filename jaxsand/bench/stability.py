"""How robust: settling and pushing where numbers are hard. Every row is judged anew, in float64 and without JAX."""

import math
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import jax
import jax.numpy as jnp
import numpy as np

from jaxsand.bench.tables import Row
from jaxsand.goals.metrics import volume_error
from jaxsand.goals.usual import usual_scene
from jaxsand.interaction.simulate import rollout
from jaxsand.relaxation.schemes import Multilevel, Pairwise, Relaxation, Scheme, SuperTimeStepping
from jaxsand.relaxation.settling import Settled, settle, settle_batch, steepest_slope
from jaxsand.relaxation.stopping import Outcome, UntilStill
from jaxsand.scene.boundaries import Draining, Walls
from jaxsand.scene.grid import Neighbours, links
from jaxsand.scene.progress import Tell, quiet
from jaxsand.scene.scene import make_scene

VOLUME = {"float16": 2e-3, "float32": 1e-6, "float64": 1e-12}  # the largest volume error
QUANTA = 64  # sand that the floats stop is steeper by at most so many quanta to a spacing
OVERSHOOT = 0.02  # of the first range, for super-time-stepping; other schemes may not leave it at all
_DX = 0.01
_ANGLE = math.radians(29)
_BOUND = 20_000
_SHAPE = (31, 17)
_SCHEMES = (SuperTimeStepping(), Multilevel(), Relaxation(), Pairwise())


@dataclass(frozen=True)
class SettlingCase:
    """A map [H, W] (m) to settle, and what bounds it. Angles in radians."""

    name: str
    height: np.ndarray
    scheme: Scheme
    angle: float | np.ndarray = _ANGLE
    spacing: float = _DX
    neighbours: Neighbours = 8
    solid: np.ndarray | None = None
    rim: float | None = None
    dtypes: tuple[str, ...] = ("float32", "float64")
    bad: bool = False

    def settle(self, height: np.ndarray) -> Settled:
        """Settles a map [H, W] (m) in the scene of the case."""
        walls = None if self.solid is None else Walls(jnp.asarray(self.solid))
        edge = None if self.rim is None else Draining(self.rim)
        scene = make_scene(self.height.shape, self.spacing, self.angle, self.neighbours, walls=walls, edge=edge)
        return settle(scene, height, scheme=self.scheme, stop=UntilStill(self.tolerance, _BOUND))

    @property
    def tolerance(self) -> float:
        """The slope in excess of repose that counts as still (a tangent)."""
        return min(1e-3, math.tan(np.min(self.angle)) / 10)


def cases(largest: int = 1024) -> Iterator[SettlingCase]:
    """One axis at a time away from a rough map of 31 x 17 cells, which walls and coarser grids do not divide evenly."""
    rough = SettlingCase("rough", _rough(_SHAPE, 5 * _DX), SuperTimeStepping())
    for scheme in _SCHEMES:
        base = replace(rough, scheme=scheme)
        for angle in (0.01, 1, 29, 60, 89.9):
            steep = max(1.0, math.tan(math.radians(angle)))
            yield replace(base, name=f"angle {angle} deg", height=base.height * steep, angle=math.radians(angle))
        for spacing in (1e-6, 1e3):
            yield replace(base, name=f"spacing {spacing:g} m", height=base.height * (spacing / _DX), spacing=spacing)
        yield from _reliefs(base)
    for scheme in _SCHEMES[:2]:
        base = replace(rough, scheme=scheme)
        yield from _structures(base)
        for shape in ((1, 1), (2, 2), (1, 32), (32, 1)):
            yield replace(base, name=f"{shape[0]} x {shape[1]}", height=_rough(shape, 5 * _DX))
        yield replace(base, name=f"column on {largest} x {largest}", height=_column(largest))
        yield replace(base, name="a NaN in a batch", bad=True)
    for scheme in _SCHEMES[2:]:
        yield replace(rough, name="neighbours 4", neighbours=4, scheme=scheme)
        yield replace(rough, name="draining, offset", height=1e3 + rough.height, rim=1e3, scheme=scheme)
    for angle in (1, 29, 60):
        yield replace(rough, name=f"angle {angle} deg", angle=math.radians(angle), dtypes=("float16",))
    yield replace(rough, name="neighbours isotropic", neighbours="isotropic", dtypes=("float16",))


def _reliefs(base: SettlingCase) -> Iterator[SettlingCase]:
    rows, columns = _SHAPE
    spike = np.zeros(_SHAPE)
    spike[rows // 2, columns // 3] = 1e6 * _DX
    cliff = np.where(np.arange(columns) < columns // 2, 1e6 * _DX, 0) + np.zeros(_SHAPE)
    yield replace(base, name="checkerboard", height=np.indices(_SHAPE).sum(0) % 2 * 20 * _DX)
    yield replace(base, name="spike of 1e6 cells", height=base.height + spike)
    yield replace(base, name="hole of 1e6 cells", height=base.height - spike)
    yield replace(base, name="cliff of 1e6 cells", height=base.height + cliff)
    yield replace(base, name="offset of 1e4 reliefs", height=base.height + 1e4 * np.ptp(base.height))


def _structures(base: SettlingCase) -> Iterator[SettlingCase]:
    random = np.random.default_rng(1)
    walls = random.random(_SHAPE) < 0.3
    fours, isotropic = replace(base, neighbours=4), replace(base, neighbours="isotropic")
    if not isinstance(base.scheme, Multilevel):  # whose programs take longest to compile
        yield replace(fours, name="neighbours 4")
        yield replace(next(_reliefs(fours)), name="checkerboard, neighbours 4")
        yield replace(isotropic, name="walls at random, isotropic", solid=walls)
    yield replace(isotropic, name="neighbours isotropic")
    yield from (replace(case, name=f"{case.name}, isotropic") for case in _reliefs(isotropic))
    yield replace(base, name="an angle per cell", angle=np.radians(random.uniform(1, 60, _SHAPE)))
    yield replace(base, name="walls at random", solid=walls)
    yield replace(base, name="walls everywhere", solid=np.ones(_SHAPE, bool))
    yield replace(base, name="draining", height=base.height + 10 * _DX, rim=0.0)
    yield replace(base, name="draining, level far below", height=base.height + 10 * _DX, rim=-1e4 * _DX)


def stability(
    largest: int = 1024, pushes: int = 100_000, tell: Tell = quiet, only: Callable[[SettlingCase], bool] = lambda _: True
) -> list[Row]:
    """One row for each case and dtype, and one for `pushes` random pushes in a row (none for 0). `only` picks cases.

    `residual` is the largest slope in excess of repose, `rounding` the slope that one quantum of the largest height makes
    over a spacing, `overshoot` how far the map left its first range, as a part of that. A row is `right` when sand is finite
    and all else as it was, volume error and overshoot are in bounds, and the outcome is true: still, or stopped by rounding.
    """
    rows = []
    for case, dtype in ((c, dtype) for c in cases(largest) if only(c) for dtype in c.dtypes):
        tell(f"{case.name}, {type(case.scheme).__name__}, {dtype}")
        with jax.enable_x64(dtype == "float64"):
            rows.append(_row(case, dtype))
    if pushes:
        with jax.enable_x64(False):
            rows.append(_pushing(pushes, tell))
    return rows


def _row(case: SettlingCase, dtype: str) -> Row:
    height = case.height.astype(dtype)
    others = True
    began = time.perf_counter()
    if case.bad:
        height, settled, others = _with_a_bad_map(case, height)
    else:
        settled = jax.block_until_ready(case.settle(height))
    seconds = time.perf_counter() - began
    h0, h1 = height.astype(float), np.asarray(settled.height, float)
    sand = np.isfinite(h0) if case.solid is None else np.isfinite(h0) & ~case.solid
    before, after = h0[sand], h1[sand]
    outcome, residual, sweeps = Outcome(int(settled.outcome)), float(settled.residual), int(settled.sweeps)
    error = volume_error(np.append(before, 0), np.append(after, float(settled.drained) / case.spacing**2))
    start = before if case.rim is None else np.append(before, case.rim)
    first, last = (np.ptp(x) if x.size else 0 for x in (start, np.append(start, after)))
    over = float((last - first) / (first or 1))
    info = np.finfo(dtype)
    size = max(np.abs(after).max(initial=0), float(info.tiny) * 2.0**info.nmant)
    rounding = 2.0 ** (math.frexp(size)[1] - info.nmant) / case.spacing
    steepness = np.tan(np.asarray(case.angle, dtype)).astype(float)
    slack = 4 * rounding + 8 * float(info.eps) * float(steepness.max())
    still = residual <= case.tolerance
    named = Outcome.NOT_FINITE * case.bad | Outcome.NOT_STILL * (not still)
    right = (
        others
        and outcome == named
        and (still or (residual <= QUANTA * rounding and sweeps < _BOUND))
        and abs(_residual(case, np.where(sand, h1, np.nan), steepness) - residual) <= slack
        and bool(np.all(np.isfinite(after)))
        and np.array_equal(h0[~sand], h1[~sand], equal_nan=True)
        and error <= VOLUME[dtype]
        and over <= (OVERSHOOT if isinstance(case.scheme, SuperTimeStepping | Multilevel) else 0)
    )
    which = {
        "name": case.name,
        "dtype": dtype,
        "scheme": type(case.scheme).__name__,
        "outcome": (outcome.name or "clean").lower(),
    }
    figures = {"residual": residual, "rounding": rounding, "volume_error": error, "overshoot": over}
    return {**which, **figures, "sweeps": sweeps, "seconds": seconds, "right": right}


def _with_a_bad_map(case: SettlingCase, height: np.ndarray) -> tuple[np.ndarray, Settled, bool]:
    """A map with a NaN between two others, before and after, and whether those are clean and what they are without it."""
    scene = make_scene(_SHAPE, case.spacing, case.angle, case.neighbours)
    good = np.stack([height, height, -height])
    bad = good.copy()
    bad[1, 7, 5] = np.nan
    a, b = (settle_batch(scene, maps, scheme=case.scheme, stop=UntilStill(case.tolerance, _BOUND)) for maps in (good, bad))
    same = all(np.array_equal(getattr(a, name)[i], getattr(b, name)[i]) for i in (0, 2) for name in vars(a))
    return bad[1], jax.tree.map(lambda leaf: leaf[1], b), same and not np.any(b.outcome[np.array([0, 2])])


def _residual(case: SettlingCase, h: np.ndarray, mu: np.ndarray) -> float:
    """The largest slope in excess of repose, NaN being no sand."""
    rows, columns = h.shape
    wide, mus = np.pad(h, 1, constant_values=np.nan), np.pad(np.broadcast_to(mu, h.shape), 1, mode="edge")

    def at(x: np.ndarray, di: int, dj: int) -> np.ndarray:
        return x[1 + di : 1 + di + rows, 1 + dj : 1 + dj + columns]

    if case.neighbours == "isotropic":  # of one angle
        x, y = ([np.nan_to_num(at(wide, *way) - h) for way in ways] for ways in (((0, 1), (0, -1)), ((1, 0), (-1, 0))))
        excesses = [np.hypot(i, j) / case.spacing - mu for i in x for j in y]
    else:
        excesses = [
            np.abs(at(wide, di, dj) - h) / (length * case.spacing) - (at(mus, di, dj) + mu) / 2
            for di, dj, length in links(case.neighbours)
        ]
    if case.rim is not None:
        edge = np.pad(np.zeros((rows - 2, columns - 2)), 1, constant_values=1)
        excesses.append((2 * (h - case.rim) / case.spacing - mu) * edge)
    return max(float(np.nanmax(e, initial=0)) for e in excesses)


def _rough(shape: tuple[int, int], size: float) -> np.ndarray:
    return np.random.default_rng(0).uniform(-size, size, shape)


def _column(side: int) -> np.ndarray:
    """A column a quarter of the map in radius, as tall as that."""
    x = np.arange(side) - (side - 1) / 2
    return np.where(x[:, None] ** 2 + x**2 <= (side / 4) ** 2, side / 4 * _DX, 0)


def _pushing(pushes: int, tell: Tell, at_once: int = 1000) -> Row:
    """Random pushes of the default blade from anywhere to anywhere on 32 x 32 cells, at first level, in float32."""
    began = time.perf_counter()
    scene = usual_scene()
    at_once = min(at_once, pushes)
    height = jnp.zeros((32, 32), jnp.float32)
    outcome, drift, size, residual, sweeps = Outcome(0), 0.0, 0.0, 0.0, 0
    for chunk in range(-(-pushes // at_once)):
        tell(f"push {chunk * at_once} of {pushes}")
        strokes = jax.random.uniform(jax.random.key(chunk), (at_once, 4), jnp.float32, maxval=32 * _DX)
        shaped = rollout(scene, height, strokes)
        height = shaped.height[-1]
        drift = max(drift, volume_error(np.zeros((32, 32)), height))
        outcome |= Outcome(int(np.bitwise_or.reduce(shaped.outcome)))
        size = max(size, float(jnp.max(jnp.abs(shaped.height))))
        residual = max(residual, float(jnp.max(shaped.residual)))
        sweeps += int(jnp.sum(shaped.sweeps))
    which = {
        "name": f"{pushes} pushes",
        "dtype": "float32",
        "scheme": "SuperTimeStepping",
        "outcome": (outcome.name or "clean").lower(),
    }
    rounding = 2.0 ** (math.frexp(size)[1] - 23) / _DX
    figures = {"residual": residual, "rounding": rounding, "volume_error": drift, "overshoot": 0.0, "sweeps": sweeps}
    extra = {"largest_height": size, "steepest_slope": float(steepest_slope(scene, height))}
    right = drift <= 1e-5 and not outcome
    return {**which, **figures, "seconds": time.perf_counter() - began, "right": right, **extra}
