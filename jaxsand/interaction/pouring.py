"""Sand that is put down or taken away: from a bucket, at a point, or over a footprint."""

from dataclasses import dataclass, replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from jaxsand.interaction._path import heading
from jaxsand.relaxation.flux import worst_excess
from jaxsand.relaxation.ghost_cells import (
    Bed,
    ExactSum,
    counted,
    halo,
    largest,
    mark,
    prepare,
    quantum,
    total,
    truncate,
    unmark,
)
from jaxsand.relaxation.schemes import Scheme
from jaxsand.relaxation.settling import Settled, relax
from jaxsand.relaxation.stopping import Outcome, Stop, check_rule, said
from jaxsand.scene.footprint import interval, local
from jaxsand.scene.grid import centres
from jaxsand.scene.masked import POINTS
from jaxsand.scene.scene import Scene, as_array, cast, check_scene, fit
from jaxsand.scene.validation import concrete, short

_ROUNDS = 32  # in each of which the cells that are emptied are found; on the usual footprints two or three suffice


def deposit(
    scene: Scene,
    height: Float[ArrayLike, "H W"],
    where: Float[ArrayLike, "2"] | Float[ArrayLike, "H W"],
    volume: Float[ArrayLike, ""],
    *,
    scheme: Scheme | None = None,
    stop: Stop | None = None,
) -> Settled:
    """Puts sand down and lets it settle: rain on a point, or a truck's heap.

    A volume V raises cell [i, j] by V w[i, j] / (dx^2 sum w), where the weights w are the footprint's, or, for a point, the
    bilinear ones of the four cells around it. Cells that are solid or off the map get none. Differentiable once, in the
    height, in the point or the footprint, and in the volume.

    Args:
        scene: the scene; its tool does not matter.
        height: height map [H, W] (m), with height[i, j] at x = (j + 1/2) dx, y = (i + 1/2) dx.
        where: a point [2] = x, y (m), or a footprint: weights [H, W] of 0 or more, such as the share of each cell.
        volume: how much sand (m^3), 0 or more.
        scheme: scheme of settling, as of `settle`.
        stop: stop rule of settling, as of `settle`.

    Returns:
        The settled map, and how settling went. The outcome says NOT_POURED where all weights are 0, and the map is then as
        if no sand had come.

    Raises:
        ValueError: an argument has the wrong shape or is out of range.

    Example:
        A heap of sand at a point becomes a cone.

        >>> import jax.numpy as jnp
        >>> import jaxsand as js
        >>> scene = js.make_scene((16, 16), 0.01)
        >>> heap = js.deposit(scene, jnp.zeros((16, 16)), jnp.array([0.08, 0.08]), 1e-5)
        >>> print(f"{js.volume(scene, heap.height):.2e} {heap.height.max():.3f}")
        1.00e-05 0.011
    """
    return _changed("deposit", scene, height, where, volume, scheme, stop, 1.0)


def remove(
    scene: Scene,
    height: Float[ArrayLike, "H W"],
    where: Float[ArrayLike, "2"] | Float[ArrayLike, "H W"],
    volume: Float[ArrayLike, ""],
    *,
    scheme: Scheme | None = None,
    stop: Stop | None = None,
) -> Settled:
    """Takes sand away and lets the rest settle: the opposite of `deposit`.

    A volume V lowers cell [i, j] by V w[i, j] / (dx^2 sum w), with the weights w of `deposit`. On a floor (`Base`) a cell
    gives no more than lies on it, and the others give the rest in the same proportions. Differentiable as `deposit` is.

    Args:
        scene: the scene; its tool does not matter.
        height: height map [H, W] (m), with height[i, j] at x = (j + 1/2) dx, y = (i + 1/2) dx.
        where: a point [2] = x, y (m), or a footprint: weights [H, W] of 0 or more, such as the share of each cell.
        volume: how much sand (m^3), 0 or more.
        scheme: scheme of settling, as of `settle`.
        stop: stop rule of settling, as of `settle`.

    Returns:
        The settled map, and how settling went. The outcome says NOT_POURED where there is less sand than `volume`: all that
        there is is taken then. It says so too where all weights are 0, and the map is then as if no sand had gone.

    Raises:
        ValueError: an argument has the wrong shape or is out of range.

    Example:
        >>> import jax.numpy as jnp
        >>> import jaxsand as js
        >>> scene = js.make_scene((16, 16), 0.01)
        >>> pit = js.remove(scene, jnp.zeros((16, 16)), jnp.array([0.08, 0.08]), 1e-5)
        >>> print(f"{js.volume(scene, pit.height):.2e} {pit.height.min():.3f}")
        -1.00e-05 -0.011
    """
    return _changed("remove", scene, height, where, volume, scheme, stop, -1.0)


def _changed(
    name: str,
    scene: Scene,
    height: ArrayLike,
    where: ArrayLike,
    volume: ArrayLike,
    scheme: Scheme | None,
    stop: Stop | None,
    sign: float,
) -> Settled:
    check_scene(scene)
    scheme, stop = check_rule(scene, scheme, stop)
    scene, height = fit(scene, height)
    where = as_array("where", where, height.dtype, POINTS)
    if where.shape not in ((2,), height.shape):
        raise ValueError(
            f"where: got shape {list(where.shape)}; give a point [2] = x, y (m), or weights of shape {list(height.shape)}"
        )
    known = concrete(where)
    if known is not None and ((where.ndim > 1 and not np.all(known >= 0)) or not np.all(np.isfinite(known))):
        raise ValueError(
            "where: got a number that is not finite, or a weight below 0; give x and y, or weights of 0 or more"
        )
    check_amount("volume", volume, f"give what to {name}, 0 or more")
    volume = as_array("volume", volume, height.dtype)
    return _settled(scene, height, where, volume, cast((scheme, stop), height.dtype), sign=sign)


def check_amount(name: str, value: object, remedy: str) -> None:
    """Raises ValueError unless it is one finite number of m^3, 0 or more; what is being traced passes."""
    array = concrete(value)
    if array is not None and not (array.ndim == 0 and np.isfinite(array) and array >= 0):
        raise ValueError(f"{name}: got {short(value)}; it must be one finite number of m^3: {remedy}")


@partial(jax.jit, static_argnames="sign")
def _settled(
    scene: Scene, height: jax.Array, where: jax.Array, volume: jax.Array, rules: tuple[Scheme, Stop], *, sign: float
) -> Settled:
    if where.ndim == 1:
        where = point_weights(scene, where)
    amount = volume / scene.grid.spacing**2
    bed, there = prepare(scene), amount
    if bed.base is not None and sign < 0:
        where, there = _on_floor(bed, mark(scene, height)[0], where, amount)
    changed, _, missed = poured(scene, height, where, amount, ExactSum(jnp.zeros_like(amount), there), sign)
    settled = rested(scene, changed, rules)
    return replace(settled, outcome=settled.outcome | missed)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Poured:
    """A map to which sand was added.

    Attributes:
      height: the map (m), in multiples of the quantum in which columns as tall as the tallest add up exactly.
      finer: what lay below that quantum (m), from 0 to a quantum.
      quantum: the quantum (m).
    """

    height: Float[Array, "H W"]
    finer: Float[Array, "H W"]
    quantum: Float[Array, ""]

    @property
    def whole(self) -> Float[Array, "H W"]:
        """The map (m), rounded where it has to be."""
        return self.height + self.finer


def rested(scene: Scene, changed: Poured, rules: tuple[Scheme, Stop]) -> Settled:
    """The settled map, with what is finer than the quantum of the tallest column set aside until that has flowed apart.

    Otherwise heights beside a tall column are rounded to its digits, and the volume drifts with each that is poured. Where
    a quantum is more than a small part of what counts as still, nothing is set aside.
    """
    scheme, stop = rules
    steeper = changed.quantum / scene.grid.spacing  # no slope becomes steeper by more, when it is added again
    aside = steeper < stop.tolerance / 2
    finer = jnp.where(aside, changed.finer, 0)
    stricter = replace(stop, tolerance=stop.tolerance - jnp.where(aside, steeper, 0))
    settled = relax(scene, changed.height + (changed.finer - finer), scheme, stricter)
    height = settled.height + finer
    residual = worst_excess(prepare(scene), halo(mark(scene, height)[0]))
    return replace(settled, height=height, residual=lax.stop_gradient(residual))


def _on_floor(bed: Bed, height: jax.Array, weights: jax.Array, amount: jax.Array) -> tuple[jax.Array, jax.Array]:
    """What each cell gives of a sum of heights `amount` (m) that is taken from a marked map, and the most there is.

    Cell k gives min(s w_k, t_k), of weight w_k and thickness t_k, with s such that the sum is the amount.
    """
    assert bed.base is not None
    thick, weights = height - bed.base, jnp.where(weights > 0, weights, 0)
    most = jnp.minimum(largest(thick), amount)
    spare = 4 * quantum(2 * (largest(height) + most))  # so that rounding takes no cell below its floor
    thick = jnp.where((thick > spare) & (weights > 0), thick - spare, 0)
    weights = weights / jnp.where(jnp.max(weights) > 0, jnp.max(weights), 1)
    most = total(thick)

    def scale(empty: jax.Array) -> jax.Array:
        left = amount - total(jnp.where(empty, thick, 0))
        share = total(jnp.where(empty, 0, weights))
        return jnp.where(share > 0, jnp.maximum(left, 0) / jnp.where(share > 0, share, 1), jnp.inf)

    def once(_: jax.Array, empty: jax.Array) -> jax.Array:
        return empty | (lax.stop_gradient(scale(empty)) * weights >= thick)

    empty = lax.fori_loop(0, _ROUNDS, once, weights <= 0)
    return jnp.where(empty, thick, jnp.minimum(jnp.where(empty, 0, weights) * scale(empty), thick)), most


def poured(
    scene: Scene, height: jax.Array, weights: jax.Array, amount: jax.Array, held: ExactSum, sign: jax.Array | float = 1.0
) -> tuple[Poured, ExactSum, jax.Array]:
    """The map after a sum of heights `amount` (m) was put down (or, of sign -1, taken away) in proportion to weights [H, W].

    All of `held`, and no more, is put down if `amount` is as much or more.

    Returns the map, the sum of heights that was put down as an account (m), and NOT_POURED if it was less than `amount`, or
    NOT_FINITE, and the map as it was, if a number is not finite or below 0.
    """
    bed = prepare(scene)
    marked, _ = mark(scene, height)
    there = held.value
    sound = jnp.isfinite(there) & (there >= 0) & jnp.isfinite(amount) & (amount >= 0) & jnp.all(jnp.isfinite(weights))
    weights = jnp.where(sound & ~jnp.isnan(marked), jnp.maximum(weights, 0), 0)
    most = jnp.max(weights)
    weights = weights / jnp.where(most > 0, most, 1)
    whole = total(weights)
    asked, there = jnp.where(sound, amount, 0), jnp.where(sound, there, 0)
    given = jnp.where(whole > 0, jnp.minimum(asked, there), 0)
    share = weights / jnp.where(whole > 0, whole, 1)
    size = quantum(jnp.maximum(largest(marked), bed.elsewhere) + jnp.max(share) * given)
    put = truncate(share * given / size)
    zero = jnp.zeros_like(given)
    account = counted(ExactSum(zero, zero), put)

    def rest() -> jax.Array:
        """What is yet to be put down, in whole quanta; of all that is held to the last one."""
        of_all = (held.high / size - account.high) + (held.low / size - account.low)
        left = jnp.where(asked >= there, of_all, given / size - account.value)
        return jnp.where(whole > 0, jnp.floor(lax.stop_gradient(left)), 0)

    # Rounding leaves some: first in proportion to the weights, then a quantum to a cell, then, if need be, to one cell.
    more = jnp.trunc(lax.stop_gradient(share) * rest())
    put, account = put + more, counted(account, more)
    left = rest()
    number = jnp.cumsum((share > 0).ravel().astype(share.dtype)).reshape(share.shape)
    more = jnp.where((share > 0) & (number <= jnp.abs(left)), jnp.sign(left), 0)
    put, account = put + more, counted(account, more)
    last = rest()
    put = put.ravel().at[jnp.argmax(share.ravel())].add(last).reshape(put.shape)
    missed = said(Outcome.NOT_POURED, (asked > there * (1 + 1e-6)) | ((whole <= 0) & (asked > 0)))
    missed = missed | said(Outcome.NOT_FINITE, ~sound)
    finer = lax.stop_gradient(jnp.where(jnp.isfinite(marked), marked - jnp.floor(marked / size) * size, 0))
    if bed.base is not None:
        finer = jnp.where(marked - bed.base > size, finer, 0)
    changed = Poured(unmark(marked - finer + sign * (put * size), height), finer, size)
    return changed, ExactSum((account.low + last) * size, account.high * size), missed


def point_weights(scene: Scene, point: Float[Array, "2"]) -> Float[Array, "H W"]:
    """The bilinear weights of the cells around a point x, y (m)."""
    x, y = centres(scene.grid, point.dtype)
    dx = scene.grid.spacing
    return jnp.maximum(1 - jnp.abs(x - point[0]) / dx, 0) * jnp.maximum(1 - jnp.abs(y - point[1]) / dx, 0)


def path_weights(scene: Scene, path: Float[Array, "n 2"], width: Float[Array, ""]) -> Float[Array, "H W"]:
    """The shares of cells over which a line of a width (m) passes on its way along a path (m), summed over the legs."""
    x, y = centres(scene.grid, path.dtype)
    dx = jnp.asarray(scene.grid.spacing)

    def of_leg(start: jax.Array, stop: jax.Array) -> jax.Array:
        pose, length = heading(start, stop, None)
        along, across = local(pose, x, y)
        return interval(along, jnp.zeros_like(length), length, dx) * interval(across, -width / 2, width / 2, dx)

    return jnp.sum(jax.vmap(of_leg)(path[:-1], path[1:]), axis=0)
