"""Settling: the sand flows until no slope is steeper than repose."""

from dataclasses import dataclass, field
from enum import IntFlag
from functools import cache
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from jaxsand.bed import at, halo, mark, nothing_lost, prepare, sound, spoiled, unmark, volume_lost
from jaxsand.flux import Nothing, steepest, worst_excess
from jaxsand.levels import descend, start
from jaxsand.march import march
from jaxsand.scene import Scene, cast, concrete, fit
from jaxsand.schemes import (
    Multilevel,
    Pairwise,
    Relaxation,
    Scheme,
    SuperTimeStepping,
    schedule,
    stable_rate,
)


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
    scheme: Scheme | None = None,
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
    scheme: Scheme | None = None,
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


def check_rule(scene: Scene, scheme: Scheme | None, stop: Stop | None) -> tuple[Scheme, Stop]:
    """The scheme and stop rule, by default SuperTimeStepping() and UntilStill(), if they are in range."""
    scheme = SuperTimeStepping() if scheme is None else scheme
    stop = UntilStill() if stop is None else stop
    _check_scheme(scene, scheme)
    if isinstance(stop, UntilStill):
        for name, count in (("bound", stop.bound), ("interval", stop.interval)):
            check_whole(f"stop.{name}", count, 1)
    elif isinstance(stop, Sweeps):
        check_whole("stop.count", stop.count, 0)
        if isinstance(scheme, Multilevel):
            raise ValueError("stop: got Sweeps with Multilevel, which settles until still; give UntilStill()")
    else:
        raise ValueError(f"stop: got {stop!r}; give UntilStill() or Sweeps(count)")
    tolerance = concrete(stop.tolerance)
    if tolerance is not None and not ((tolerance >= 0) & (tolerance < float("inf"))).all():
        raise ValueError(f"stop.tolerance: got {stop.tolerance!r}; give a slope of 0 or more, such as 1e-3")
    return scheme, stop


def _check_scheme(scene: Scene, scheme: Scheme) -> None:
    if isinstance(scheme, Relaxation):
        check_rate(scene, "scheme.rate", scheme.rate)
    elif isinstance(scheme, Pairwise):
        share = concrete(scheme.share)
        if share is not None and not ((share > 0) & (share <= 1)).all():
            raise ValueError(f"scheme.share: got {scheme.share!r}; give a share above 0 and up to 1")
        if scene.grid.neighbours == "isotropic":
            raise ValueError("scheme: got Pairwise with isotropic sand, which does not flow in pairs; use 4 or 8 neighbours")
    elif isinstance(scheme, SuperTimeStepping | Multilevel):
        for name, value, most in (("growth", scheme.growth, 4), ("first", scheme.first, 1), ("safety", scheme.safety, 1)):
            if not 0 < value <= most:
                raise ValueError(f"scheme.{name}: got {value!r}; give a number above 0 and up to {most}")
        if isinstance(scheme, Multilevel):
            check_whole("scheme.coarsest", scheme.coarsest, 2)
            if not 1 <= scheme.handover < float("inf"):
                raise ValueError(f"scheme.handover: got {scheme.handover!r}; give a time of at least 1, such as 128")
    else:
        raise ValueError(f"scheme: got {scheme!r}; give Relaxation, Pairwise, SuperTimeStepping or Multilevel")


def check_rate(scene: Scene, name: str, value: jax.typing.ArrayLike) -> None:
    """Raises ValueError unless a rate is positive and in the scene's stable range."""
    rate = concrete(value)
    limit = stable_rate(scene)
    if rate is not None and not (rate > 0).all():
        raise ValueError(f"{name}: got {value!r}; give a positive share such as 0.125")
    if rate is not None and not (rate <= limit).all():
        raise ValueError(f"{name}: got {value!r}, unstable above {limit:.4f}; the paper uses 0.125")


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


def relax(scene: Scene, height: jax.Array, scheme: Scheme, stop: Stop) -> Settled:
    """`settle` without its checks and casts, for use inside a program."""
    bed = prepare(scene)
    marked, broken = mark(scene, height)
    sand = (halo(marked), nothing_lost(bed, height))
    tolerance = jnp.asarray(stop.tolerance)
    limit = stable_rate(scene)
    if isinstance(stop, Sweeps):
        bound, interval = stop.count, next((n for n in range(8, 0, -1) if stop.count and stop.count % n == 0), 1)
    else:
        bound, interval = stop.bound, min(stop.interval, stop.bound)
    if isinstance(scheme, Multilevel):
        cells = start(scheme, marked)
        sand, sweeps = descend(bed, cells, scheme, limit, tolerance, bound, interval, sand)
    else:
        plan = schedule(scheme, limit, bound, interval) if isinstance(scheme, SuperTimeStepping) else scheme
        enough = None if isinstance(stop, Sweeps) else tolerance
        sand, sweeps = march(bed, Nothing(), plan, enough, bound // interval, interval, sand)
    u, lost = sand
    residual = worst_excess(bed, u)
    broken = broken | spoiled(marked, at(u)) | ~sound(bed)
    outcome = Outcome.NOT_STILL * (residual > stop.tolerance) + Outcome.NOT_FINITE * broken
    settled = unmark(at(u), height)
    return Settled(settled, sweeps, lax.stop_gradient(residual), outcome.astype(jnp.int32), volume_lost(bed, lost))


_settle = jax.jit(relax)


def _chunks(scene: Scene, height: jax.Array, scheme: Scheme, stop: Stop, *, chunk: int) -> Settled:
    return lax.map(lambda h: relax(scene, h, scheme, stop), height, batch_size=chunk)


def wide_vectors() -> dict[str, Any]:
    """Compiler options for the outermost programs: 512-bit vectors where the CPU has them."""
    return {"xla_cpu_prefer_vector_width": 512} if jax.default_backend() == "cpu" else {}


@cache
def _batch_program() -> Any:
    return jax.jit(_chunks, static_argnames="chunk", compiler_options=wide_vectors())
