"""Settling: the sand flows until no slope is steeper than repose."""

from dataclasses import dataclass, replace
from functools import cache, partial
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax

from jaxsand.relaxation._integrate import March, Sand, march
from jaxsand.relaxation._multigrid import descend, start
from jaxsand.relaxation.batching import march_batch, on_all_cores, wide_vectors
from jaxsand.relaxation.flux import Nothing, middle, steepest, worst_excess
from jaxsand.relaxation.ghost_cells import (
    Bed,
    Lost,
    at,
    halo,
    largest,
    mark,
    nothing_lost,
    prepare,
    sound,
    spoiled,
    unmark,
    volume_lost,
)
from jaxsand.relaxation.schemes import Multilevel, Scheme, SuperTimeStepping, schedule, stable_rate
from jaxsand.relaxation.stopping import Outcome, Stop, Sweeps, as_batch, check_chunk, check_rule, check_settling_window, said
from jaxsand.scene.scene import Scene, cast, fit
from jaxsand.scene.window import Whole, Window, cut, edge_movement, near_edge, origin, paste

_WHOLE = Whole()


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
    window: Whole | Window | None = None,
) -> Settled:
    """Lets a map [H, W] (m) settle to its angle of repose. One map; batch with `jax.vmap` or `settle_batch`.

    Conserves volume up to what ghost_cells.py says of rounding, leaves a settled map as it is to the last bit, and
    commutes with h -> -h, with mirrors and quarter turns (to rounding for isotropic sand and on coarse grids; not
    `Pairwise`) and, up to the floats' spacing, with adding a constant. What else holds is said of each scheme.

    With a `window` it settles a block of that size around what is too steep. The outcome says WINDOW_EDGE if a slope
    outside exceeds repose by more than the window's tolerance, or a cell within two cells of the block's edge (where that is
    not the map's) ends more than the tolerance, in spacings, from where it began. With tolerance 0 and no such outcome the
    map is the one that settling everywhere gives; with a tolerance it may also differ by what sand moves that is still to
    that tolerance.

    Computes in the height's dtype. Differentiable in the height and the angle of repose, by what `stop` says of itself.

    Raises:
      ValueError: for a height of the wrong shape or dtype, or a scheme or stop rule out of range.
    """
    scheme, stop = check_rule(scene, scheme, stop)
    window = check_settling_window(scene, scheme, window)
    scene, height = fit(scene, height)
    return _settle(scene, height, *cast((scheme, stop, window), height.dtype))


def settle_batch(
    scene: Scene,
    height: jax.typing.ArrayLike,
    *,
    scheme: Scheme | None = None,
    stop: Stop | None = None,
    window: Whole | Window | None = None,
    chunk: int | None = None,
) -> Settled:
    """Lets a batch of maps [B, H, W] of one scene settle; every field of the result gains the batch axis.

    Faster than `jax.vmap(settle)`: maps are taken in chunks, so that a slow map holds up only its own chunk and a chunk
    stays in the cache, and the program is compiled for wide vectors on CPUs. For the same reason it is an outermost program:
    call it as it is, not inside `jit`, `grad` or `vmap`.
    """
    scheme, stop = check_rule(scene, scheme, stop)
    window = check_settling_window(scene, scheme, window)
    height = as_batch(height)
    check_chunk(chunk)
    scene, _ = fit(scene, height[0])
    scheme, stop, window = cast((scheme, stop, window), height.dtype)
    program = _batch_program()
    return on_all_cores(program, (scene, scheme, stop, window), height, chunk)


def steepest_slope(scene: Scene, height: jax.typing.ArrayLike) -> jax.Array:
    """The tangent of the steepest slope between neighbours of a map [H, W]."""
    return _steepest(*fit(scene, height))


@jax.jit
def _steepest(scene: Scene, height: jax.Array) -> jax.Array:
    return steepest(prepare(scene), halo(mark(scene, height)[0]))


def relax(scene: Scene, height: jax.Array, scheme: Scheme, stop: Stop, window: Whole | Window = _WHOLE) -> Settled:
    """`settle` without its checks and casts, for use inside a program."""
    bed = prepare(scene)
    sand = (halo(mark(scene, height)[0]), nothing_lost(bed, height))
    if isinstance(window, Window):
        sand, sweeps, touched = _in_window(scene, bed, window, scheme, stop, sand)
    else:
        sand, sweeps = _run(scene, bed, scheme, stop, sand)
        touched = jnp.zeros((), bool)
    return _judge(scene, bed, stop, height, sand, sweeps, touched)


def _judge(
    scene: Scene, bed: Bed, stop: Stop, height: jax.Array, sand: Sand, sweeps: jax.Array, touched: jax.Array
) -> Settled:
    """What there is to say of a map that was `height` and is now `sand`."""
    u, lost = sand
    marked, broken = mark(scene, height)
    residual = worst_excess(bed, u)
    broken = broken | spoiled(marked, at(u)) | ~sound(bed)
    still = said(Outcome.NOT_STILL, residual > stop.tolerance)
    outcome = still | said(Outcome.WINDOW_EDGE, touched) | said(Outcome.NOT_FINITE, broken)
    settled = unmark(at(u), height)
    return Settled(settled, sweeps, lax.stop_gradient(residual), outcome, volume_lost(bed, lost))


def _run(scene: Scene, bed: Bed, scheme: Scheme, stop: Stop, sand: Sand) -> tuple[Sand, jax.Array]:
    """The sand at rest, or as far as the stop rule lets it go, and the sweeps that took."""
    bound, interval = _groups(stop)
    if isinstance(scheme, Multilevel):
        tolerance = jnp.asarray(stop.tolerance)
        return descend(bed, start(scheme, at(sand[0])), scheme, stable_rate(scene), tolerance, bound, interval, sand)
    return _march(scene, bed, scheme, stop).run(bound // interval, sand)


def _march(scene: Scene, bed: Bed, scheme: Scheme, stop: Stop) -> March:
    bound, interval = _groups(stop)
    plan: Any = scheme
    if isinstance(scheme, SuperTimeStepping):
        plan = schedule(scheme, stable_rate(scene), bound, interval)
    return march(bed, Nothing(), plan, None if isinstance(stop, Sweeps) else jnp.asarray(stop.tolerance), interval)


def _groups(stop: Stop) -> tuple[int, int]:
    """The largest number of sweeps, and after how many of them to look."""
    if isinstance(stop, Sweeps):
        return stop.count, next((n for n in range(8, 0, -1) if stop.count and stop.count % n == 0), 1)
    return stop.bound, min(stop.interval, stop.bound)


def _in_window(
    scene: Scene, bed: Bed, window: Window, scheme: Scheme, stop: Stop, sand: Sand
) -> tuple[Sand, jax.Array, jax.Array]:
    """`_run` on the block around what is too steep; also whether sand moves outside or came within two cells of its edge."""
    u, lost = sand
    shape, h = scene.grid.shape, at(u)
    begin = origin(window, shape, middle(bed, u, jnp.asarray(stop.tolerance)))
    block, block_lost = cut(window, shape, begin, (h, lost))
    outside = paste(begin, h, jnp.where(near_edge(window, shape, begin), block, jnp.nan))
    restless = worst_excess(bed, halo(outside)) > window.tolerance
    elsewhere = jnp.maximum(bed.elsewhere, largest(paste(begin, h, jnp.zeros_like(block))))
    here = replace(cut(window, shape, begin, bed), elsewhere=elsewhere)
    (after, block_lost), sweeps = _run(scene, here, scheme, stop, (halo(block), block_lost))
    change = edge_movement(window, shape, begin, block, at(after), jnp.zeros_like(block))
    touched = restless | (change > window.tolerance * bed.spacing)
    return (halo(paste(begin, h, at(after))), paste(begin, lost, block_lost)), sweeps, touched


_settle = jax.jit(relax)


def relax_batch(rules: tuple[Scene, Scheme, Stop, Whole | Window], height: jax.Array, *, chunk: int) -> Settled:
    """`relax` for a batch of maps [B, H, W], B a multiple of the chunk."""
    scene, scheme, stop, window = rules
    if isinstance(window, Window) or isinstance(scheme, Multilevel):
        return lax.map(lambda h: relax(scene, h, scheme, stop, window), height, batch_size=chunk)
    bed, (bound, interval) = prepare(scene), _groups(stop)

    def enter(h: jax.Array, lost: Lost) -> Sand:
        return halo(mark(scene, h)[0]), lost

    way = _march(scene, bed, scheme, stop)
    judge = partial(_judge, scene, bed, stop, touched=jnp.zeros((), bool))
    return march_batch(way, bound // interval, enter, judge, height, nothing_lost(bed, height), chunk)


@cache
def _batch_program() -> Any:
    return jax.jit(relax_batch, static_argnames="chunk", compiler_options=wide_vectors())
