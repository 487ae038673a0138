"""Settling: the sand flows until no slope is steeper than repose."""

from dataclasses import dataclass, field
from enum import IntFlag
from functools import cache, partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from jaxsand.loop import repeat_until
from jaxsand.scene import Scene, cast, concrete, fit
from jaxsand.sweep import (
    Bed,
    Flow,
    Lost,
    Nothing,
    at,
    halo,
    largest,
    mark,
    nothing_lost,
    prepare,
    quantum,
    sound,
    spoiled,
    steepest,
    sweep,
    unmark,
    volume_lost,
    worst_excess,
)
from jaxsand.walls import Draining


class Outcome(IntFlag):
    """What a result has to say for itself; 0 is a clean one. See `check`."""

    NOT_STILL = 1
    """Some slope is still steeper than repose by more than the tolerance."""
    WINDOW_EDGE = 2
    """Sand moved at the edge of the window while the tool was down."""
    NOT_FINITE = 4
    """The map, the stroke or the scene holds a NaN or an infinity, the heights overflowed, or the stroke lies farther away
    than the floats resolve. A bad cell of the map was treated as solid and given back as it was."""


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Relaxation:
    """The paper's sweep (arXiv:1908.02745, Eq. 1-2) with flow rate k = rate dx^2; first order in the rate.

    With 8 neighbours it is stable for rate < 1/4.83 and a convex combination of neighbouring heights (no overshoot: the
    highest point never rises, the lowest never falls) up to 1/6.83; with 4 neighbours for both up to 1/4, on a map of one
    row or column up to 1/2 (1/4 if its edge drains). The default is the paper's dx^2/8. The settled map
    depends slightly on the rate.
    """

    rate: jax.Array | float = 0.125


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class UntilStill:
    """Sweep until no slope (a tangent) exceeds repose by more than `tolerance`, at most `bound` sweeps.

    Looks every `interval` sweeps, so that the number of sweeps is a multiple of it (and 0 on a map that is still). Where the
    floats are too coarse to move sand down to the tolerance (large offsets in float32), it stops when nothing moves any more
    and the outcome says NOT_STILL. Differentiable once, in forward and reverse mode (see `loop.repeat_until`).
    """

    tolerance: jax.Array | float = 1e-3
    bound: int = field(default=20_000, metadata={"static": True})
    interval: int = field(default=8, metadata={"static": True})


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Sweeps:
    """Exactly `count` sweeps; `tolerance` only judges the outcome. Differentiable once, in forward and reverse mode."""

    count: int = field(metadata={"static": True})
    tolerance: jax.Array | float = 1e-3


Stop = UntilStill | Sweeps


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Settled:
    """A settled map: `height` [H, W] (m), the `sweeps` it took, the largest slope in excess of repose left (`residual`, a
    tangent), the `outcome` (bits of `Outcome`), and the volume that `drained` over the map's edge (m^3)."""

    height: jax.Array
    sweeps: jax.Array
    residual: jax.Array
    outcome: jax.Array
    drained: jax.Array


def settle(
    scene: Scene,
    height: jax.typing.ArrayLike,
    *,
    scheme: Relaxation | None = None,
    stop: Stop | None = None,
) -> Settled:
    """Lets a map [H, W] (m) settle to its angle of repose. One map; batch with `jax.vmap` or `settle_batch`.

    Conserves volume up to what sweep.py says of rounding, keeps the map within its lowest and highest point at the rates
    that `Relaxation` names, commutes with adding a constant, with h -> -h, mirrors and quarter turns, and leaves a settled
    map as it is, to the last bit.
    Computes in the height's dtype. Differentiable in the height and the angle of repose, by what `stop` says of itself.

    Raises:
      ValueError: for a height of the wrong shape or dtype, or a scheme or stop rule out of range.
    """
    scheme, stop = check_rule(scene, scheme, stop)
    scene, height = fit(scene, height)
    scheme, stop = cast((scheme, stop), height.dtype)
    return _settle(scene, height, scheme, stop)


def settle_batch(
    scene: Scene,
    height: jax.typing.ArrayLike,
    *,
    scheme: Relaxation | None = None,
    stop: Stop | None = None,
    chunk: int = 256,
) -> Settled:
    """Lets a batch of maps [B, H, W] of one scene settle; every field of the result gains the batch axis.

    Faster than `jax.vmap(settle)`: maps are taken in chunks, so that a slow map holds up only its own chunk and a chunk
    stays in the cache, and the program is compiled for wide vectors on CPUs. For the same reason it is an outermost program:
    call it as it is, not inside `jit`, `grad` or `vmap`.
    """
    scheme, stop = check_rule(scene, scheme, stop)
    height = as_batch(height)
    check_chunk(chunk)
    scene, _ = fit(scene, height[0])
    scheme, stop = cast((scheme, stop), height.dtype)
    return _batch_program()(scene, height, scheme, stop, chunk=min(chunk, height.shape[0]))


def steepest_slope(scene: Scene, height: jax.typing.ArrayLike) -> jax.Array:
    """The tangent of the steepest slope between neighbours of a map [H, W]."""
    scene, height = fit(scene, height)
    marked, _ = mark(scene, height)
    return steepest(prepare(scene), halo(marked))


def check_rule(scene: Scene, scheme: Relaxation | None, stop: Stop | None) -> tuple[Relaxation, Stop]:
    """The scheme and stop rule, by default Relaxation() and UntilStill(), if they are in range."""
    scheme = Relaxation() if scheme is None else scheme
    stop = UntilStill() if stop is None else stop
    if not isinstance(scheme, Relaxation):
        raise ValueError(f"scheme: got {scheme!r}; give Relaxation(rate)")
    check_rate(scene, "scheme.rate", scheme.rate)
    if isinstance(stop, UntilStill):
        for name, count in (("bound", stop.bound), ("interval", stop.interval)):
            check_whole(f"stop.{name}", count, 1)
    elif isinstance(stop, Sweeps):
        check_whole("stop.count", stop.count, 0)
    else:
        raise ValueError(f"stop: got {stop!r}; give UntilStill() or Sweeps(count)")
    tolerance = concrete(stop.tolerance)
    if tolerance is not None and not ((tolerance >= 0) & (tolerance < float("inf"))).all():
        raise ValueError(f"stop.tolerance: got {stop.tolerance!r}; give a slope of 0 or more, such as 1e-3")
    return scheme, stop


def check_rate(scene: Scene, name: str, value: jax.typing.ArrayLike) -> None:
    """Raises ValueError unless a rate is positive and in the scene's stable range."""
    rate = concrete(value)
    limit = _stable_rate(scene)
    if rate is not None and not (rate > 0).all():
        raise ValueError(f"{name}: got {value!r}; give a positive share such as 0.125")
    if rate is not None and not (rate <= limit).all():
        raise ValueError(f"{name}: got {value!r}, unstable above {limit:.4f}; the paper uses 0.125")


def _stable_rate(scene: Scene) -> float:
    """The rate above which the checkerboard (in one dimension: the saw-tooth) grows."""
    if 1 in scene.grid.shape:
        return 1 / 4 if isinstance(scene.edge, Draining) else 1 / 2
    return {4: 1 / 4, 8: 1 / (2 + 2 * 2**0.5)}[scene.grid.neighbours]


def as_batch(height: jax.typing.ArrayLike) -> jax.Array:
    """The height as an array, if it is a batch [B, H, W]."""
    height = jnp.asarray(height)
    if height.ndim != 3 or not height.shape[0]:
        raise ValueError(f"height: got shape {list(height.shape)}; give a batch of at least one map [B, H, W]")
    return height


def check_chunk(chunk: int) -> None:
    """Raises ValueError unless `chunk` is a number of maps."""
    check_whole("chunk", chunk, 1)


def check_whole(name: str, value: Any, least: int) -> None:
    """Raises ValueError unless the value is a whole number of at least `least`."""
    if isinstance(value, bool) or not isinstance(value, int | np.integer) or value < least:
        raise ValueError(f"{name}: got {value!r}; give a whole number of at least {least}")


def relax(scene: Scene, height: jax.Array, scheme: Relaxation, stop: Stop) -> Settled:
    """`settle` without its checks and casts, for use inside a program."""
    bed = prepare(scene)
    marked, broken = mark(scene, height)
    flow = Flow(jnp.asarray(scheme.rate), quantum(largest(marked)))
    state, sweeps = _run(bed, flow, stop, (halo(marked), nothing_lost(scene, height)))
    residual = worst_excess(bed, state[0])
    settled = unmark(at(state[0]), height)
    broken = broken | spoiled(marked, at(state[0])) | ~sound(bed)
    outcome = Outcome.NOT_STILL * (residual > stop.tolerance) + Outcome.NOT_FINITE * broken
    return Settled(settled, sweeps, lax.stop_gradient(residual), outcome.astype(jnp.int32), volume_lost(bed, state[1]))


def _run(bed: Bed, flow: Flow, stop: Stop, state: tuple[jax.Array, Lost]) -> tuple[Any, jax.Array]:
    if isinstance(stop, Sweeps):
        return repeat_until(_never, partial(_some_sweeps, 1), stop.count, (bed, flow, stop.tolerance), state)
    # Below this slope every flux is cut to nothing.
    floor = 2 * flow.quantum / (flow.rate * bed.spacing)
    limit = jnp.maximum(stop.tolerance, lax.stop_gradient(floor))
    interval = min(stop.interval, stop.bound)
    state, looks = repeat_until(_still, partial(_some_sweeps, interval), stop.bound // interval, (bed, flow, limit), state)
    return state, looks * interval


def _still(params: Any, _: jax.Array, state: Any) -> jax.Array:
    bed, _, limit = params
    return worst_excess(bed, state[0]) <= limit


def _never(params: Any, _: jax.Array, state: Any) -> jax.Array:
    return jnp.zeros((), bool)


def _some_sweeps(interval: int, params: Any, _: jax.Array, state: Any) -> Any:
    bed, flow, _ = params
    return lax.fori_loop(0, interval, lambda _, s: sweep(bed, flow, Nothing(), *s), state)


_settle = jax.jit(relax)


def _chunks(scene: Scene, height: jax.Array, scheme: Relaxation, stop: Stop, *, chunk: int) -> Settled:
    return lax.map(lambda h: relax(scene, h, scheme, stop), height, batch_size=chunk)


def wide_vectors() -> dict[str, Any]:
    """Compiler options for the outermost programs: 512-bit vectors where the CPU has them."""
    return {"xla_cpu_prefer_vector_width": 512} if jax.default_backend() == "cpu" else {}


@cache
def _batch_program() -> Any:
    return jax.jit(_chunks, static_argnames="chunk", compiler_options=wide_vectors())
