"""Stop rules, outcomes, and the checks of the options of settling and pushing."""

from dataclasses import dataclass, field
from enum import IntFlag

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float, Int

from jaxsand.relaxation.schemes import Multilevel, Pairwise, Relaxation, Scheme, SuperTimeStepping, stable_rate
from jaxsand.scene.boundaries import Base
from jaxsand.scene.scene import Scene, as_array, check_scene, check_window
from jaxsand.scene.validation import concrete, short
from jaxsand.scene.window import Whole, Window

_MOST = 1_000_000_000  # sweeps, which are counted in 32 bits


class Outcome(IntFlag):
    """What went wrong in a computation, as bits; 0 when nothing did. `check` turns it into an error with advice.

    Attributes:
        NOT_STILL: some slope still exceeds repose by more than the stop rule's tolerance.
        WINDOW_EDGE: sand moved at the edge of a window, so that the result may differ from that of the whole map.
        NOT_FINITE: the map, the stroke or the scene holds a NaN or an infinity, heights overflowed, or the stroke lies
            farther away than floats resolve or leads straight up or down. A bad cell of the map was treated as solid and is
            returned as it was.
        NOT_POURED: less sand was poured, or removed, than asked for: the bucket or the bed held less, or no cell with sand
            lies where it was poured.
        BELOW_BASE: the map lies below the scene's floor somewhere. No sand lies there, and it was left as it is.
        NOT_CARRIED: a wheel's load is more than the soil carries before the wheel stands in it up to its axle. The map is as
            it was.

    Example:
        >>> import jaxsand as js
        >>> js.Outcome(3)
        <Outcome.NOT_STILL|WINDOW_EDGE: 3>
        >>> js.Outcome.NOT_FINITE in js.Outcome(3)
        False
    """

    NOT_STILL = 1
    WINDOW_EDGE = 2
    NOT_FINITE = 4
    NOT_POURED = 8
    BELOW_BASE = 16
    NOT_CARRIED = 32


def said(outcome: Outcome, yes: Bool[Array, "..."]) -> Int[Array, "..."]:
    """The outcome's bit where the condition `yes` holds, 0 elsewhere (int32)."""
    return jnp.where(yes, jnp.int32(outcome), jnp.int32(0))


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class UntilStill:
    """Sweep until the sand is still: no slope exceeds repose by more than the tolerance. The default stop rule.

    A slope is a tangent, and repose is tan(repose_angle). Stillness is checked every `interval` sweeps, so that the number
    of sweeps is a multiple of `interval`, and 0 on a map that is still. Where floats are too coarse to move sand down to the
    tolerance (large heights in float32), sweeping stops when nothing moves any more, and the outcome says NOT_STILL.
    Settling is differentiable once, in forward and reverse mode, with the number of sweeps held fixed.

    Attributes:
        tolerance: slope above repose that counts as still, 0 or more.
        bound: largest number of sweeps (`Multilevel`: on each grid, on the way down and up); static.
        interval: number of sweeps between checks; static.

    Example:
        >>> import jax.numpy as jnp
        >>> import jaxsand as js
        >>> scene = js.make_scene((8, 8), 0.01)
        >>> heap = jnp.zeros((8, 8)).at[4, 4].set(0.03)
        >>> bool(js.settle(scene, heap, stop=js.UntilStill(tolerance=0.01)).residual <= 0.01)
        True
    """

    tolerance: Float[Array, ""] | float = 1e-3
    bound: int = field(default=20_000, metadata={"static": True})
    interval: int = field(default=8, metadata={"static": True})


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Sweeps:
    """Sweep a fixed number of times, whether or not the sand is still.

    Settling is differentiable once, in forward and reverse mode. Not for `Multilevel`.

    Attributes:
        count: number of sweeps; static.
        tolerance: slope above repose beyond which the outcome says NOT_STILL.

    Example:
        >>> import jax.numpy as jnp
        >>> import jaxsand as js
        >>> heap = jnp.zeros((8, 8)).at[4, 4].set(0.03)
        >>> int(js.settle(js.make_scene((8, 8), 0.01), heap, stop=js.Sweeps(8)).sweeps)
        8
    """

    count: int = field(metadata={"static": True})
    tolerance: Float[Array, ""] | float = 1e-3


Stop = UntilStill | Sweeps


def check_rule(scene: Scene, scheme: Scheme | None, stop: Stop | None) -> tuple[Scheme, Stop]:
    """The scheme and stop rule, with None replaced by SuperTimeStepping() and UntilStill(); ValueError if out of range."""
    check_scene(scene)
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
        raise ValueError(f"stop: got {short(stop)}; give UntilStill() or Sweeps(count)")
    _check_number("stop.tolerance", stop.tolerance)
    tolerance = concrete(stop.tolerance)
    if tolerance is not None and not ((tolerance >= 0) & (tolerance < float("inf"))).all():
        raise ValueError(f"stop.tolerance: got {short(stop.tolerance)}; give a slope of 0 or more, such as 1e-3")
    return scheme, stop


def _check_scheme(scene: Scene, scheme: Scheme) -> None:
    if isinstance(scheme, Relaxation):
        check_rate(scene, "scheme.rate", scheme.rate)
    elif isinstance(scheme, Pairwise):
        _check_number("scheme.share", scheme.share)
        share = concrete(scheme.share)
        if share is not None and not ((share > 0) & (share <= 1)).all():
            raise ValueError(f"scheme.share: got {short(scheme.share)}; give a share above 0 and up to 1")
        if scene.grid.neighbours == "isotropic":
            raise ValueError("scheme: got Pairwise with isotropic sand, which does not flow in pairs; use 4 or 8 neighbours")
    elif isinstance(scheme, SuperTimeStepping | Multilevel):
        for name, value, most in (("growth", scheme.growth, 4), ("first", scheme.first, 1), ("safety", scheme.safety, 1)):
            if not (isinstance(value, int | float) and 1e-4 <= value <= most):
                raise ValueError(f"scheme.{name}: got {short(value)}; give a number from 1e-4 to {most}")
        if isinstance(scheme, Multilevel):
            if isinstance(scene.base, Base):
                raise ValueError(
                    "scheme: got Multilevel on a Base, whose coarse grids know no floor; give SuperTimeStepping()"
                )
            check_whole("scheme.coarsest", scheme.coarsest, 2)
            if not (isinstance(scheme.handover, int | float) and 1 <= scheme.handover < float("inf")):
                raise ValueError(f"scheme.handover: got {short(scheme.handover)}; give a time of at least 1, such as 128")
    else:
        raise ValueError(f"scheme: got {short(scheme)}; give Relaxation, Pairwise, SuperTimeStepping or Multilevel")


def check_settling_window(scene: Scene, scheme: Scheme, window: Whole | Window | None) -> Whole | Window:
    """The window in which to settle, with None replaced by Whole(); ValueError if it does not go with scene or scheme."""
    window = Whole() if window is None else window
    check_window(window, scene.grid.shape)
    if isinstance(window, Window) and isinstance(scheme, Pairwise | Multilevel):
        name = type(scheme).__name__
        raise ValueError(
            f"window: got {short(window)} with {name}, which depends on where the map begins; use another scheme"
        )
    return window


def check_rate(scene: Scene, name: str, value: Float[ArrayLike, ""]) -> None:
    """Raises ValueError unless a rate is positive and stable in the scene."""
    _check_number(name, value)
    rate = concrete(value)
    limit = stable_rate(scene)
    if rate is not None and not (rate > 0).all():
        raise ValueError(f"{name}: got {short(value)}; give a positive share such as 0.125")
    if rate is not None and not (rate <= limit).all():
        raise ValueError(f"{name}: got {short(value)}, unstable above {limit:.4f}; the paper uses 0.125")


def as_batch(height: Float[ArrayLike, "B H W"]) -> Float[Array, "B H W"]:
    """The height as an array; raises ValueError unless it is a batch [B, H, W] of at least one map."""
    height = as_array("height", height)
    if height.ndim != 3 or not height.shape[0]:
        raise ValueError(f"height: got shape {list(height.shape)}; give a batch of at least one map [B, H, W]")
    return height


def check_chunk(chunk: int | None) -> None:
    """Raises ValueError unless `chunk` is a number of maps, or None."""
    if chunk is not None:
        check_whole("chunk", chunk, 1)


def check_whole(name: str, value: object, least: int, most: int | None = None) -> None:
    """Raises ValueError unless the value is a whole number from `least` to `most`."""
    if isinstance(value, bool) or not isinstance(value, int | np.integer) or value < least:
        raise ValueError(f"{name}: got {short(value)}; give a whole number of at least {least}")
    if most is not None and value > most:
        raise ValueError(f"{name}: got {short(value)}; give at most {most:,}")


def _check_number(name: str, value: ArrayLike) -> None:
    try:
        single = jnp.ndim(value) == 0 and jnp.issubdtype(jnp.result_type(value), jnp.number)
    except TypeError:
        single = False
    if not single:
        raise ValueError(f"{name}: got {short(value)}; give one number, and use jax.vmap for several")
