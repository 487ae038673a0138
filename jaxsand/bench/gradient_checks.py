"""How right gradients are: by height, stroke and angle of repose, against differences at random points."""

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cache
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxsand.interaction.bucket import dump, load_volume, scoop
from jaxsand.interaction.simulate import act, step
from jaxsand.relaxation.settling import Settled, settle
from jaxsand.relaxation.stopping import Stop, Sweeps
from jaxsand.scene.boundaries import Base, Deep
from jaxsand.scene.grid import Neighbours
from jaxsand.scene.scene import Scene, cast, make_scene
from jaxsand.scene.tools import Blade, Bucket, Tool, Wheel
from jaxsand.scene.window import Window

Inputs = tuple[np.ndarray, np.ndarray, np.ndarray]
"""Heights [B, H, W] (m), strokes [B, 4] or [B, 6] (m) and angles of repose [B] (rad)."""

SPACING = 0.01
STEPS = (1e-4, 1e-5, 1e-6, 1e-7)
"""Steps of differences, in spacings and in rad."""
APART = 1e-5
"""How far one-sided differences may be apart at a smooth point, over the gradient's norm."""

_UNITS = (SPACING, SPACING, 1.0)


@dataclass(frozen=True)
class GradientCase:
    """A program whose gradient is wanted: settling, or a push by a tool and settling; of a bucket, a scoop and a dump.

    `rises`: strokes have heights. `base`: what lies under the sand.
    """

    pushes: bool
    neighbours: Neighbours = 8
    window: Window | None = None
    stop: Stop | None = None
    tool: Tool = field(default_factory=Blade)
    rises: bool = False
    base: Deep | Base = field(default_factory=Deep)

    @property
    def name(self) -> str:
        """What the case is called in tables."""
        parts = [self._work(), f"{self.neighbours}"]
        if self.window:
            parts.append("window {} x {}".format(*self.window.size))
        if isinstance(self.stop, Sweeps):
            parts.append(f"{self.stop.count} sweeps")
        if isinstance(self.base, Base):
            parts.append("on a floor")
        return ", ".join(parts)

    def _work(self) -> str:
        if not self.pushes:
            return "settle"
        if isinstance(self.tool, Bucket):
            return "scoop and dump"
        way = "rise and settle" if self.rises else "push and settle"
        if isinstance(self.tool, Wheel):
            return f"{way}, wheel"
        yaw, plates = (getattr(self.tool, name, None) for name in ("yaw", "plates"))
        return way + (", at an angle" if yaw is not None else "") + (", plates" if plates is not None else "")


def program(case: GradientCase, cells: int) -> Callable[..., Any]:
    """From a height [H, W], stroke, angle, and perhaps a stop rule: a weighted sum of the map that is left, and the sweeps
    that settling took."""
    weights = np.random.default_rng(9).standard_normal((cells, cells))

    def run(
        height: jax.Array, stroke: jax.Array, angle: jax.Array, stop: Stop | None = case.stop
    ) -> tuple[jax.Array, jax.Array]:
        of: Any = {"neighbours": case.neighbours}
        if case.pushes:
            scene = make_scene((cells, cells), SPACING, angle, tool=case.tool, window=case.window, base=case.base, **of)
            after = _worked(scene, height, stroke, stop)
        else:
            after = settle(make_scene((cells, cells), SPACING, angle, **of), height, stop=stop, window=case.window)
        return jnp.sum(jnp.asarray(weights, after.height.dtype) * after.height), after.sweeps

    return run


def _worked(scene: Scene, height: jax.Array, stroke: jax.Array, stop: Stop | None) -> Settled:
    """A push; of a bucket a scoop, and a dump of 0.6 of what it took up where the scoop ended."""
    if not isinstance(scene.tool, Bucket):
        return step(scene, height, stroke, stop=stop)
    path = stroke.reshape(2, -1)
    scooped = scoop(scene, height, path, stop=stop)
    amount = 0.6 * load_volume(scene, scooped.load)
    return dump(scene, scooped.height, path[1:], scooped.load, amount=amount, stop=stop)


def differentiated(run: Callable[..., Any]) -> Callable[..., Any]:
    """`((value, sweeps), gradient)`, of a batch."""
    return jax.vmap(sloped(run))


def sloped(run: Callable[..., Any]) -> Callable[..., Any]:
    """`((value, sweeps), gradient)`, by every input."""
    return jax.value_and_grad(run, (0, 1, 2), has_aux=True)


def inputs(case: GradientCase, cells: int, batch: int, seed: int = 0) -> Inputs:
    """Random strokes, in a square of 0.2 m in the middle of the map, on gentle dunes; where the case does not push, the
    maps that the blade has just left. In float64."""
    rng = np.random.default_rng(seed)
    y, x = np.indices((cells, cells)) / 10
    slow, fast = rng.uniform(0.5, 2, (2, 4, batch, 1, 1))
    size, phase = rng.uniform(-2e-3, 2e-3, (4, batch, 1, 1)), rng.uniform(0, 6, (4, batch, 1, 1))
    heights = (size * np.sin(slow * x + fast * y + phase)).sum(0)
    strokes = cells * SPACING / 2 + rng.uniform(-0.1, 0.1, (batch, 4))
    if case.rises:
        ends, z = np.split(strokes, 2, axis=1), rng.uniform(-0.012, 0.0, (2, batch, 1))
        strokes = np.concatenate([ends[0], z[0], ends[1], z[1]], 1)
    angles = np.radians(rng.uniform(27, 31, batch))
    if not case.pushes:
        heights = _pushed(heights, strokes, angles)
    return heights, strokes, angles


def _pushed(heights: np.ndarray, strokes: np.ndarray, angles: np.ndarray) -> np.ndarray:
    with jax.enable_x64(True):
        return np.asarray(_act_program()(*cast((heights, strokes, angles), jnp.float64)))


def against_differences(
    case: GradientCase, points: int = 64, seed: int = 0, cells: int = 32, chunk: int | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Errors [3, P] of the gradient by each input against central differences at random points, in float64 and over the
    gradient's norm; and which of these points are smooth [3, P].

    Differences are taken in a normally distributed direction of one input at a time, so that the error is what the
    gradient by that input is off by, in the mean square. Lengths count in spacings, angles in rad.

    Kinks are kept away from, and of the gradient no more is asked than its norm. A point is smooth if at two steps in a row
    the one-sided differences are at most `APART` apart (a kink between the two ends shifts the central difference by half of
    that; kinks on both sides that make up for each other at one step do not at the next) and settling takes the same number
    of sweeps there and at both ends. Of such pairs that which agrees best gives the difference.
    """
    chunk = chunk or points
    parts = [_differences(case, cells, chunk, seed + 1000 * k) for k in range(-(-points // chunk))]
    error, smooth = (np.concatenate(both, -1)[:, :points] for both in zip(*parts, strict=True))
    return error, smooth


def _differences(case: GradientCase, cells: int, batch: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    rng, given = np.random.default_rng(seed), inputs(case, cells, batch, seed)
    with jax.enable_x64(True):
        x = cast(given, jnp.float64)
        (value, sweeps), gradient = _gradient(case, cells)(*x)
        norm = np.sqrt(_dot(gradient, gradient))
        error, smooth = [], []
        for k, unit in enumerate(_UNITS):
            way = rng.standard_normal(x[k].shape)
            apart, central, last = np.full(batch, np.inf), np.zeros(batch), np.full(batch, np.inf)
            for size in STEPS:
                (up, n), (down, m) = (
                    _forward(case, cells)(*x[:k], x[k] + sign * size * unit * way, *x[k + 1 :]) for sign in (1, -1)
                )
                now = np.abs(up - 2 * value + down) / (size * norm)
                now = np.where((n == sweeps) & (m == sweeps), now, np.inf)
                both = np.maximum(now, last)
                central = np.where(both < apart, (up - down) / (2 * size), central)
                apart, last = np.minimum(apart, both), now
            own = unit * np.asarray(gradient[k] * way).reshape(batch, -1).sum(1)
            error.append(np.abs(own - central) / norm)
            smooth.append(apart <= APART)
    return np.array(error), np.array(smooth)


def of_float32(case: GradientCase, points: int = 64, seed: int = 0, cells: int = 32) -> np.ndarray:
    """Errors [P] of the gradient in float32 at random points, against that in float64, over its norm."""
    given = inputs(case, cells, points, seed)
    single = _gradient(case, cells)(*cast(given, jnp.float32))[1]
    with jax.enable_x64(True):
        double = _gradient(case, cells)(*cast(given, jnp.float64))[1]
        return relative(single, double)


def _dot(a: Any, b: Any) -> np.ndarray:
    """Scalar products of gradients of batches, by spacings and rad."""
    parts = (unit**2 * np.asarray(u * v, float) for unit, u, v in zip(_UNITS, a, b, strict=True))
    return sum((part.reshape(len(part), -1).sum(1) for part in parts), np.zeros(()))


def relative(found: Any, right: Any) -> np.ndarray:
    """The error of gradients of a batch over their norm."""
    off = [np.asarray(a, float) - np.asarray(b) for a, b in zip(found, right, strict=True)]
    return np.sqrt(_dot(off, off) / _dot(right, right))


@cache
def _forward(case: GradientCase, cells: int) -> Callable[..., Any]:
    return jax.jit(jax.vmap(program(case, cells)))


@cache
def _gradient(case: GradientCase, cells: int) -> Callable[..., Any]:
    return jax.jit(differentiated(program(case, cells)))


@cache
def _act_program() -> Callable[..., Any]:
    def one(height: jax.Array, stroke: jax.Array, angle: jax.Array) -> jax.Array:
        rows, columns = height.shape
        return act(make_scene((rows, columns), SPACING, angle, tool=Blade()), height, stroke).height

    return jax.jit(jax.vmap(one))
