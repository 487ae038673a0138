"""Settling: the sand flows until no slope is steeper than repose."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache, partial

import jax
import jax.numpy as jnp
from jax import lax
from jax.typing import ArrayLike
from jaxtyping import Array, Float, Int

from jaxsand.relaxation._integrate import SweepLoop, sweep_loop
from jaxsand.relaxation._multigrid import descend, start
from jaxsand.relaxation.batching import loop_batch, on_all_cores, wide_vectors
from jaxsand.relaxation.flux import WholeCells, middle, steepest, worst_excess
from jaxsand.relaxation.ghost_cells import (
    Bed,
    ExactSum,
    at,
    below_base,
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
from jaxsand.relaxation.schemes import Multilevel, Pairwise, Relaxation, Scheme, SuperTimeStepping, schedule, stable_rate
from jaxsand.relaxation.stopping import Outcome, Stop, Sweeps, as_batch, check_chunk, check_rule, check_settling_window, said
from jaxsand.relaxation.sweep import Swept
from jaxsand.scene.scene import Scene, cast, fit
from jaxsand.scene.window import Whole, Window, cut, edge_movement, near_edge, origin, paste

_WHOLE = Whole()
OnOneGrid = Relaxation | Pairwise | SuperTimeStepping


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Settled:
    """A settled map, and how settling went. Of a batch, every field has the batch axis in front.

    Attributes:
        height: height map [H, W] (m).
        sweeps: number of sweeps that were taken.
        residual: largest slope in excess of repose that is left, a tangent. It carries no derivative.
        outcome: bits of `Outcome`; 0 when all went well. See `check`.
        drained: volume that ran off over a draining edge (m^3).

    Example:
        >>> import jax.numpy as jnp
        >>> import jaxsand as js
        >>> settled = js.settle(js.make_scene((8, 8), 0.01), jnp.zeros((8, 8)).at[4, 4].set(0.03))
        >>> settled.height.shape, int(settled.outcome), float(settled.drained)
        ((8, 8), 0, 0.0)
    """

    height: Float[Array, "*batch H W"]
    sweeps: Int[Array, "*batch"]
    residual: Float[Array, "*batch"]
    outcome: Int[Array, "*batch"]
    drained: Float[Array, "*batch"]


def settle(
    scene: Scene,
    height: Float[ArrayLike, "H W"],
    *,
    scheme: Scheme | None = None,
    stop: Stop | None = None,
    window: Whole | Window | None = None,
) -> Settled:
    """Lets the sand of one map flow until no slope is steeper than repose.

    Sand flows along dh/dt = -grad E(h) until the stop rule is satisfied; `scheme` says by which steps. For 4 or 8 neighbours
    E sums the squared excess over repose of every link between two cells i and j at the distance l dx:

        E(h) = sum over links of (d - clip(d, -m, m))^2 / (2 l),   d = h_j - h_i,   m = tan(repose_angle) l dx.

    Volume is conserved: to the last bit where heights are multiples of the rounding unit (see ghost_cells.py), else without
    a drift. A map that is still is returned unchanged. Mirrored and quarter-turned maps give mirrored and turned results
    (not with `Pairwise`). All is computed in the height's dtype. Differentiable once, in forward and reverse mode, in the
    height, the angle of repose and the spacing, with the number of sweeps held fixed.

    Args:
        scene: grid, material, walls, edge and floor; its tool plays no part.
        height: height map [H, W] (m), with height[i, j] at x = (j + 1/2) dx, y = (i + 1/2) dx. Use `jax.vmap` or
            `settle_batch` for many.
        scheme: `SuperTimeStepping` (the default), `Multilevel`, `Relaxation` or `Pairwise`.
        stop: `UntilStill` (the default) or `Sweeps`.
        window: a `Window` settles only a block of its size around what is too steep; None or `Whole` settles the whole map.
            The outcome says WINDOW_EDGE if a slope outside the block exceeds repose by more than the window's tolerance, or
            if a cell within two cells of the block's edge moved by more than the tolerance, in spacings.

    Returns:
        The settled map, the number of sweeps, what is left above repose, the outcome, and the volume that drained.

    Raises:
        ValueError: the height has the wrong shape or dtype, or a scheme, stop rule or window is out of range.
        NotImplementedError: a second derivative is asked for.

    Source:
        Eq. 1-2 of Kim, Pavlov & Johnson, arXiv:1908.02745, for the flow over a link.

    Example:
        >>> import jax.numpy as jnp
        >>> import jaxsand as js
        >>> scene = js.make_scene((8, 8), 0.01)
        >>> heap = jnp.zeros((8, 8)).at[4, 4].set(0.03)
        >>> settled = js.settle(scene, heap)
        >>> print(f"{js.steepest_slope(scene, heap):.2f} {js.steepest_slope(scene, settled.height):.2f}")
        3.00 0.55
    """
    scheme, stop = check_rule(scene, scheme, stop)
    window = check_settling_window(scene, scheme, window)
    scene, height = fit(scene, height)
    return _settle(scene, height, *cast((scheme, stop, window), height.dtype))


def settle_batch(
    scene: Scene,
    height: Float[ArrayLike, "B H W"],
    *,
    scheme: Scheme | None = None,
    stop: Stop | None = None,
    window: Whole | Window | None = None,
    chunk: int | None = None,
) -> Settled:
    """`settle` for a batch of maps of one scene, on every core.

    It is faster than `jax.vmap` of `settle`: maps are settled in chunks that fit into a core's cache, a slow map does not
    hold up the others, and the program is compiled for wide vectors. Call it from plain Python only, not inside `jit`,
    `grad` or `vmap`, where `jax.vmap` of `settle` does the same.

    Args:
        scene: grid, material, walls and edge of all maps.
        height: height maps [B, H, W] (m).
        scheme: as of `settle`.
        stop: as of `settle`.
        window: as of `settle`.
        chunk: number of maps that are settled together, 1 or more; None for what suits the machine.

    Returns:
        The settled maps; every field has the batch axis in front, `height` [B, H, W] and the others [B].

    Raises:
        ValueError: as of `settle`, or it is called inside `jit`, `grad` or `vmap`.

    Example:
        >>> import jax.numpy as jnp
        >>> import jaxsand as js
        >>> heaps = jnp.zeros((3, 8, 8)).at[:, 4, 4].set(jnp.array([0.0, 0.01, 0.03]))
        >>> settled = js.settle_batch(js.make_scene((8, 8), 0.01), heaps)
        >>> settled.height.shape, int(settled.sweeps[0])
        ((3, 8, 8), 0)
    """
    scheme, stop = check_rule(scene, scheme, stop)
    window = check_settling_window(scene, scheme, window)
    height = as_batch(height)
    check_chunk(chunk)
    scene, _ = fit(scene, height[0])
    scheme, stop, window = cast((scheme, stop, window), height.dtype)
    program = _batch_program()
    return on_all_cores(program, (scene, scheme, stop, window), height, chunk)


def steepest_slope(scene: Scene, height: Float[ArrayLike, "H W"]) -> Float[Array, ""]:
    """The steepest slope of a map, as the scene's neighbourhood measures slopes.

    With 4 or 8 neighbours it is max |h_j - h_i| / (l dx) over all links, l dx the distance of the cells; for isotropic sand
    it is the largest length of a one-sided gradient. Of bare floor (`Base`) slopes do not count. Differentiable in the
    height and the spacing where one slope alone is the steepest.

    Args:
        scene: spacing, neighbours and walls.
        height: height map [H, W] (m).

    Returns:
        The tangent of the slope's angle, a scalar.

    Raises:
        ValueError: the height has the wrong shape or dtype.

    Example:
        >>> import jax.numpy as jnp
        >>> import jaxsand as js
        >>> step = jnp.zeros((8, 8)).at[:, 4:].set(0.02)
        >>> float(js.steepest_slope(js.make_scene((8, 8), spacing=0.01), step))
        2.0
    """
    return _steepest(*fit(scene, height))


def check_at_rest(scene: Scene, height: Float[ArrayLike, "H W"], name: str = "height") -> None:
    """Raises ValueError, which names the map, if a slope of it is steeper than repose by more than 2e-3 (a tangent)."""
    slope, repose = float(steepest_slope(scene, height)), float(jnp.tan(jnp.max(scene.material.repose_angle)))
    if slope > repose + 2e-3:
        raise ValueError(f"{name}: got a slope of {slope:.3g}, steeper than repose ({repose:.3g}); settle it first")


@jax.jit
def _steepest(scene: Scene, height: jax.Array) -> jax.Array:
    return steepest(prepare(scene), halo(mark(scene, height)[0]))


def relax(scene: Scene, height: Float[Array, "H W"], scheme: Scheme, stop: Stop, window: Whole | Window = _WHOLE) -> Settled:
    """`settle` without its checks and casts, for use inside a compiled program."""
    bed = prepare(scene)
    sand = Swept(halo(mark(scene, height)[0]), nothing_lost(bed, height))
    if isinstance(window, Window):
        sand, sweeps, touched = _in_window(scene, bed, window, scheme, stop, sand)
    else:
        sand, sweeps = _run(scene, bed, scheme, stop, sand)
        touched = jnp.zeros((), bool)
    return _judge(scene, bed, stop, height, sand, sweeps, touched)


def run_off(scene: Scene, height: Float[Array, "H W"], scheme: Scheme, stop: Stop) -> tuple[jax.Array, jax.Array]:
    """The map after settling, and what each of its cells lost over the draining edge (m); inside a compiled program."""
    bed = prepare(scene)
    sand, _ = _run(scene, bed, scheme, stop, Swept(halo(mark(scene, height)[0]), nothing_lost(bed, height)))
    assert sand.lost is not None
    return at(sand.height), sand.lost.value


def _judge(
    scene: Scene, bed: Bed, stop: Stop, height: jax.Array, sand: Swept, sweeps: jax.Array, touched: jax.Array
) -> Settled:
    """The result for a map that was `height` before settling and is now `sand`."""
    u = sand.height
    marked, broken = mark(scene, height)
    residual = worst_excess(bed, u)
    broken = broken | spoiled(marked, at(u)) | ~sound(bed)
    still = said(Outcome.NOT_STILL, residual > stop.tolerance)
    outcome = still | said(Outcome.WINDOW_EDGE, touched) | said(Outcome.NOT_FINITE, broken)
    outcome = outcome | said(Outcome.BELOW_BASE, below_base(bed, marked))
    settled = unmark(at(u), height)
    return Settled(settled, sweeps, lax.stop_gradient(residual), outcome, volume_lost(bed, sand.lost))


def _run(scene: Scene, bed: Bed, scheme: Scheme, stop: Stop, sand: Swept) -> tuple[Swept, jax.Array]:
    """The sand after the stop rule is satisfied, and the number of sweeps taken."""
    bound, interval = _groups(stop)
    if isinstance(scheme, Multilevel):
        tolerance = jnp.asarray(stop.tolerance)
        return descend(bed, start(scheme, at(sand.height)), scheme, stable_rate(scene), tolerance, bound, interval, sand)
    return _sweep_loop(scene, bed, scheme, stop).run(bound // interval, sand)


def _sweep_loop(scene: Scene, bed: Bed, scheme: OnOneGrid, stop: Stop) -> SweepLoop:
    bound, interval = _groups(stop)
    plan = schedule(scheme, stable_rate(scene), bound, interval, 0.0) if isinstance(scheme, SuperTimeStepping) else scheme
    return sweep_loop(bed, WholeCells(), plan, None if isinstance(stop, Sweeps) else jnp.asarray(stop.tolerance), interval)


def _groups(stop: Stop) -> tuple[int, int]:
    """The largest number of sweeps, and the number of sweeps between checks."""
    if isinstance(stop, Sweeps):
        return stop.count, next((n for n in range(8, 0, -1) if stop.count and stop.count % n == 0), 1)
    return stop.bound, min(stop.interval, stop.bound)


def _in_window(
    scene: Scene, bed: Bed, window: Window, scheme: Scheme, stop: Stop, sand: Swept
) -> tuple[Swept, jax.Array, jax.Array]:
    """`_run` on the block around what is too steep; also whether sand moves outside of it or near its edge."""
    shape, h = scene.grid.shape, at(sand.height)
    begin = origin(window, shape, middle(bed, sand.height, jnp.asarray(stop.tolerance)))
    block, block_lost = cut(window, shape, begin, (h, sand.lost))
    outside = paste(begin, h, jnp.where(near_edge(window, shape, begin), block, jnp.nan))
    restless = worst_excess(bed, halo(outside)) > window.tolerance
    elsewhere = jnp.maximum(bed.elsewhere, largest(paste(begin, h, jnp.zeros_like(block))))
    here = replace(cut(window, shape, begin, bed), elsewhere=elsewhere)
    after, sweeps = _run(scene, here, scheme, stop, Swept(halo(block), block_lost))
    change = edge_movement(window, shape, begin, block, at(after.height), jnp.zeros_like(block))
    touched = restless | (change > window.tolerance * bed.spacing)
    whole = Swept(halo(paste(begin, h, at(after.height))), paste(begin, sand.lost, after.lost))
    return whole, sweeps, touched


_settle = jax.jit(relax)


def relax_batch(rules: tuple[Scene, Scheme, Stop, Whole | Window], height: Float[Array, "B H W"], *, chunk: int) -> Settled:
    """`relax` for a batch of maps [B, H, W], B a multiple of the chunk."""
    scene, scheme, stop, window = rules
    if isinstance(window, Window) or isinstance(scheme, Multilevel):
        return lax.map(lambda h: relax(scene, h, scheme, stop, window), height, batch_size=chunk)
    bed, (bound, interval) = prepare(scene), _groups(stop)

    def enter(h: jax.Array, lost: ExactSum | None) -> Swept:
        return Swept(halo(mark(scene, h)[0]), lost)

    loop = _sweep_loop(scene, bed, scheme, stop)
    judge = partial(_judge, scene, bed, stop, touched=jnp.zeros((), bool))
    return loop_batch(loop, bound // interval, enter, judge, height, nothing_lost(bed, height), chunk)


@cache
def _batch_program() -> Callable[..., Settled]:
    return jax.jit(relax_batch, static_argnames="chunk", compiler_options=wide_vectors())
