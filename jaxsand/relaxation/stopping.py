"""What settling is told, and what it says: stop rules, outcomes, and the checks of both."""

from dataclasses import dataclass, field
from enum import IntFlag
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxsand.relaxation.schemes import Multilevel, Pairwise, Relaxation, Scheme, SuperTimeStepping, stable_rate
from jaxsand.scene.scene import Scene, as_array, check_window, concrete
from jaxsand.scene.window import Whole, Window

_MOST = 1_000_000_000  # sweeps, which are counted in 32 bits


class Outcome(IntFlag):
    """What a result has to say for itself; 0 is a clean one. See `check`."""

    NOT_STILL = 1
    """Some slope is still steeper than repose by more than the tolerance."""
    WINDOW_EDGE = 2
    """Sand moved at the edge of the window, of the scene's while the tool was down or of the one that was to settle."""
    NOT_FINITE = 4
    """The map, the stroke or the scene holds a NaN or an infinity, the heights overflowed, or the stroke lies farther away
    than the floats resolve. A bad cell of the map was treated as solid and given back as it was."""


def said(outcome: Outcome, yes: jax.Array) -> jax.Array:
    """The outcome's bit where there is something to say, 0 elsewhere (int32)."""
    return jnp.where(yes, jnp.int32(outcome), jnp.int32(0))


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class UntilStill:
    """Sweep until no slope (a tangent) exceeds repose by more than `tolerance`, at most `bound` sweeps (`Multilevel`: on
    every grid, down and up).

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


def check_rule(scene: Scene, scheme: Scheme | None, stop: Stop | None) -> tuple[Scheme, Stop]:
    """The scheme and stop rule, by default SuperTimeStepping() and UntilStill(), if they are in range."""
    scheme = SuperTimeStepping() if scheme is None else scheme
    stop = UntilStill() if stop is None else stop
    _check_scheme(scene, scheme)
    if isinstance(stop, UntilStill):
        for name, count in (("bound", stop.bound), ("interval", stop.interval)):
            check_whole(f"stop.{name}", count, 1, _MOST)
    elif isinstance(stop, Sweeps):
        check_whole("stop.count", stop.count, 0, _MOST)
        if isinstance(scheme, Multilevel):
            raise ValueError("stop: got Sweeps with Multilevel, which settles until still; give UntilStill()")
    else:
        raise ValueError(f"stop: got {stop!r}; give UntilStill() or Sweeps(count)")
    _check_number("stop.tolerance", stop.tolerance)
    tolerance = concrete(stop.tolerance)
    if tolerance is not None and not ((tolerance >= 0) & (tolerance < float("inf"))).all():
        raise ValueError(f"stop.tolerance: got {stop.tolerance!r}; give a slope of 0 or more, such as 1e-3")
    return scheme, stop


def _check_scheme(scene: Scene, scheme: Scheme) -> None:
    if isinstance(scheme, Relaxation):
        check_rate(scene, "scheme.rate", scheme.rate)
    elif isinstance(scheme, Pairwise):
        _check_number("scheme.share", scheme.share)
        share = concrete(scheme.share)
        if share is not None and not ((share > 0) & (share <= 1)).all():
            raise ValueError(f"scheme.share: got {scheme.share!r}; give a share above 0 and up to 1")
        if scene.grid.neighbours == "isotropic":
            raise ValueError("scheme: got Pairwise with isotropic sand, which does not flow in pairs; use 4 or 8 neighbours")
    elif isinstance(scheme, SuperTimeStepping | Multilevel):
        for name, value, most in (("growth", scheme.growth, 4), ("first", scheme.first, 1), ("safety", scheme.safety, 1)):
            if not (isinstance(value, int | float) and 1e-4 <= value <= most):
                raise ValueError(f"scheme.{name}: got {value!r}; give a number from 1e-4 to {most}")
        if isinstance(scheme, Multilevel):
            check_whole("scheme.coarsest", scheme.coarsest, 2)
            if not (isinstance(scheme.handover, int | float) and 1 <= scheme.handover < float("inf")):
                raise ValueError(f"scheme.handover: got {scheme.handover!r}; give a time of at least 1, such as 128")
    else:
        raise ValueError(f"scheme: got {scheme!r}; give Relaxation, Pairwise, SuperTimeStepping or Multilevel")


def check_settling_window(scene: Scene, scheme: Scheme, window: Any) -> Whole | Window:
    window = Whole() if window is None else window
    check_window(window, scene.grid.shape)
    if isinstance(window, Window) and isinstance(scheme, Pairwise | Multilevel):
        name = type(scheme).__name__
        raise ValueError(f"window: got {window!r} with {name}, which depends on where the map begins; use another scheme")
    return window


def check_rate(scene: Scene, name: str, value: jax.typing.ArrayLike) -> None:
    """Raises ValueError unless a rate is positive and in the scene's stable range."""
    _check_number(name, value)
    rate = concrete(value)
    limit = stable_rate(scene)
    if rate is not None and not (rate > 0).all():
        raise ValueError(f"{name}: got {value!r}; give a positive share such as 0.125")
    if rate is not None and not (rate <= limit).all():
        raise ValueError(f"{name}: got {value!r}, unstable above {limit:.4f}; the paper uses 0.125")


def as_batch(height: jax.typing.ArrayLike) -> jax.Array:
    """The height as an array, if it is a batch [B, H, W]."""
    height = as_array("height", height)
    if height.ndim != 3 or not height.shape[0]:
        raise ValueError(f"height: got shape {list(height.shape)}; give a batch of at least one map [B, H, W]")
    return height


def check_chunk(chunk: int | None) -> None:
    """Raises ValueError unless `chunk` is a number of maps, or None."""
    if chunk is not None:
        check_whole("chunk", chunk, 1)


def check_whole(name: str, value: Any, least: int, most: int | None = None) -> None:
    """Raises ValueError unless the value is a whole number from `least` to `most`."""
    if isinstance(value, bool) or not isinstance(value, int | np.integer) or value < least:
        raise ValueError(f"{name}: got {value!r}; give a whole number of at least {least}")
    if most is not None and value > most:
        raise ValueError(f"{name}: got {value!r}; give at most {most:,}")


def _check_number(name: str, value: Any) -> None:
    try:
        single = jnp.ndim(value) == 0 and jnp.issubdtype(jnp.result_type(value), jnp.number)
    except TypeError:
        single = False
    if not single:
        raise ValueError(f"{name}: got {value!r}; give one number, and use jax.vmap for several")
