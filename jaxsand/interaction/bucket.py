"""A bucket: it scoops sand along a path, carries it, and dumps it along another.

A bucket's edge cuts as a blade a cell thick at most (blade_stepped.py). What it cuts goes into the bucket until that is
full; the rest moves ahead. Sand in the bed and in the bucket together keep their volume as well as floats allow: what is
taken up is counted in whole quanta, and a load is a pair of floats (load.py).
"""

from dataclasses import dataclass, replace
from functools import partial

import jax
import jax.numpy as jnp
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from jaxsand.autodiff.while_loop import Tree
from jaxsand.interaction._path import Record, farthest, heading
from jaxsand.interaction.blade_stepped import scoop_along
from jaxsand.interaction.load import Load, added, as_load, inside_of, one_load, spilled
from jaxsand.interaction.pouring import check_amount, path_weights, point_weights, poured, rested
from jaxsand.interaction.simulate import Path, Rules, Shaped, as_needed, as_path, checked, itself, lifted
from jaxsand.interaction.stepped import SteppedPush
from jaxsand.relaxation.ghost_cells import ExactSum
from jaxsand.relaxation.schemes import Scheme
from jaxsand.relaxation.settling import relax
from jaxsand.relaxation.stopping import Outcome, Stop, check_rule, said
from jaxsand.scene.footprint import Pose
from jaxsand.scene.scene import Scene, as_array, cast, check_scene, fit
from jaxsand.scene.tools import Blade, Bucket
from jaxsand.scene.validation import short
from jaxsand.scene.window import Whole, Window


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Loaded(Shaped):
    """A map after a bucket has scooped or dumped and the sand has settled: the fields of `Shaped`, and the load.

    Attributes:
        height: height map [H, W] (m).
        sweeps: number of sweeps of settling.
        residual: largest slope in excess of repose that is left, a tangent. It carries no derivative.
        outcome: bits of `Outcome`, of the bucket's work and of settling; 0 when all went well. See `check`.
        drained: volume that ran off over a draining edge (m^3).
        pose: where the bucket was last, and its heading.
        load: what it holds afterwards; see `Load`.

    Example:
        >>> import jax.numpy as jnp
        >>> import jaxsand as js
        >>> scene = js.make_scene((16, 16), 0.01, tool=js.Bucket(width=0.04, length=0.03, capacity=2e-5))
        >>> scooped = js.scoop(scene, jnp.zeros((16, 16)), jnp.array([[0.04, 0.08, -0.01], [0.08, 0.08, -0.01]]))
        >>> int(scooped.outcome), f"{scooped.pose.x:.3f}", f"{js.load_volume(scene, scooped.load):.1e}"
        (0, '0.080', '1.6e-05')
    """

    load: Load


def scoop(
    scene: Scene,
    height: Float[ArrayLike, "H W"],
    path: Path,
    load: Load | None = None,
    *,
    push: SteppedPush | None = None,
    scheme: Scheme | None = None,
    stop: Stop | None = None,
) -> Loaded:
    """Moves a bucket's edge along a path; what it cuts goes into the bucket. Then the sand settles.

    The edge cuts the sand between the path's two ends, as wide as the bucket and down to the path's height, so that a cut of
    depth d and length l holds w l d. When the bucket is full, the rest is pushed ahead, as by a blade, and the outcome stays
    0. At a corner the edge turns in place, and pushes what it sweeps. Differentiable like `follow`, in the height, the path,
    the load and the bucket, but where the bucket just becomes full.

    Args:
        scene: the scene, with a `Bucket` as its tool.
        height: height map [H, W] (m), with height[i, j] at x = (j + 1/2) dx, y = (i + 1/2) dx.
        path: the points [n, 3] = x, y, z (m) that the middle of the edge visits, z linear along each leg, n >= 2; or [n, 2],
            at the bucket's depth. The edge may begin or end in the air.
        load: what the bucket holds before; None if it is empty.
        push: `SteppedPush`: how finely the edge moves.
        scheme: scheme of settling, as of `settle`.
        stop: stop rule of settling, as of `settle`.

    Returns:
        The settled map, the outcome, the volume that drained, the edge's last pose, and the load.

    Raises:
        ValueError: an argument has the wrong shape or is out of range, or the scene's tool is no bucket.
        NotImplementedError: a second derivative is asked for.

    Example:
        >>> import jax.numpy as jnp
        >>> import jaxsand as js
        >>> scene = js.make_scene((16, 16), 0.01, tool=js.Bucket(width=0.04, length=0.03, capacity=2e-5))
        >>> scooped = js.scoop(scene, jnp.zeros((16, 16)), jnp.array([[0.04, 0.08, 0.0], [0.08, 0.08, -0.01]]))
        >>> print(f"{js.load_volume(scene, scooped.load):.2e} {js.volume(scene, scooped.height):.2e}")
        8.00e-06 -8.00e-06
    """
    return _scoop(scene, height, path, load, push, scheme, stop)[0]


def scoop_frames(
    scene: Scene,
    height: Float[ArrayLike, "H W"],
    path: Path,
    load: Load | None = None,
    *,
    push: SteppedPush | None = None,
    scheme: Scheme | None = None,
    stop: Stop | None = None,
) -> tuple[Loaded, Float[Array, "n-1 H W"]]:
    """`scoop`, and the maps [n - 1, H, W] (m) after each leg, as `follow_frames`."""
    return _scoop(scene, height, path, load, push, scheme, stop, itself)


def _scoop(
    scene: Scene,
    height: Float[ArrayLike, "H W"],
    path: Path,
    load: Load | None,
    push: SteppedPush | None,
    scheme: Scheme | None,
    stop: Stop | None,
    record: Record | None = None,
) -> tuple[Loaded, Tree]:
    """`scoop`, and what `record` returned after each leg."""
    bucket = bucket_of(scene)
    if push is not None and not isinstance(push, SteppedPush):
        raise ValueError(f"push: got {short(push)}; a bucket scoops by SteppedPush(substep, sweeps)")
    edge = replace(scene, tool=Blade(bucket.width, scene.grid.spacing, bucket.depth))
    edge, height, rules = checked(edge, height, push, scheme, stop)
    path = as_path(path, height.dtype)
    if path.shape[1] == 2:
        path = jnp.concatenate([path, jnp.full_like(path[:, :1], -jnp.asarray(bucket.depth, path.dtype))], 1)
    inside = inside_of(scene, bucket)
    held = one_load(load, height.dtype, inside)
    capacity = jnp.asarray(bucket.capacity, height.dtype)
    run = partial(_scooped, height, path, held, capacity, inside, rules, record=record)
    return as_needed(run, edge, rules, (height, path, held, capacity))


def dump(
    scene: Scene,
    height: Float[ArrayLike, "H W"],
    path: Float[ArrayLike, "n 2"] | Float[ArrayLike, "n 3"],
    load: Load | None,
    *,
    amount: Float[ArrayLike, ""] | None = None,
    scheme: Scheme | None = None,
    stop: Stop | None = None,
) -> Loaded:
    """Pours sand out of a bucket, and lets it settle.

    On a path of one point all falls there, and makes a cone. On a longer one it is spread evenly along the way, as wide as
    the bucket: a volume V over a way l is V / (w l) thick. What falls on solid cells or off the map falls on the rest of the
    path instead. Differentiable in the height, the path, the load and the amount, but where the amount is just the load.

    Args:
        scene: the scene, with a `Bucket` as its tool.
        height: height map [H, W] (m), with height[i, j] at x = (j + 1/2) dx, y = (i + 1/2) dx.
        path: the points [n, 2] = x, y (m) over which the bucket is emptied, n >= 1; of [n, 3] the heights do not matter.
        load: what the bucket holds; None if it is empty.
        amount: how much to pour (m^3), 0 or more; None for all of it.
        scheme: scheme of settling, as of `settle`.
        stop: stop rule of settling, as of `settle`.

    Returns:
        The settled map, the outcome, the volume that drained, the bucket's last pose, and what it still holds. If the amount
        is more than the load, the load is poured and the outcome says NOT_POURED; so it does if no cell with sand lies below
        the path, and then nothing is poured.

    Raises:
        ValueError: an argument has the wrong shape or is out of range, or the scene's tool is no bucket.

    Example:
        >>> import jax.numpy as jnp
        >>> import jaxsand as js
        >>> scene = js.make_scene((16, 16), 0.01, tool=js.Bucket(width=0.04, length=0.03, capacity=2e-5))
        >>> scooped = js.scoop(scene, jnp.zeros((16, 16)), jnp.array([[0.02, 0.04, -0.01], [0.06, 0.04, -0.01]]))
        >>> poured = js.dump(scene, scooped.height, jnp.array([[0.11, 0.11]]), scooped.load)
        >>> print(f"{js.load_volume(scene, poured.load):.0e} {poured.height[10:12, 10:12].mean():.3f}")
        0e+00 0.013
    """
    inside = inside_of(scene, bucket_of(scene))
    if amount is not None:
        check_amount("amount", amount, "give what to pour, or None for all of it")
    scheme, stop = check_rule(scene, scheme, stop)
    scene, height = fit(scene, height)
    path = as_path(path, height.dtype, 1)[:, :2]
    held = one_load(load, height.dtype, inside)
    pour = None if amount is None else as_array("amount", amount, height.dtype)
    return _dumped(scene, height, path, held, pour, cast((scheme, stop), height.dtype))


def load_volume(scene: Scene, load: Load | None) -> Float[Array, "*batch"]:
    """The volume that a bucket holds.

    Args:
        scene: the scene in which it was loaded; its spacing counts.
        load: what a `Loaded` has as its `load`, or a batch of them; None for an empty bucket.

    Returns:
        The volume (m^3), a scalar, or one for each of the batch. Differentiable in the load and in the spacing.

    Example:
        >>> import jaxsand as js
        >>> scene = js.make_scene((8, 8), 0.01, tool=js.Bucket(width=0.03, length=0.02, capacity=6e-6))
        >>> float(js.load_volume(scene, None))
        0.0
    """
    check_scene(scene)
    dx = jnp.asarray(scene.grid.spacing)
    held = as_load(load, None if load is not None else jnp.result_type(dx))
    return (held.high + held.low) * dx.astype(held.high.dtype) ** 2


def bucket_of(scene: Scene) -> Bucket:
    """The scene's bucket; raises ValueError where its tool is another."""
    check_scene(scene)
    if not isinstance(scene.tool, Bucket):
        raise ValueError(
            f"scene.tool: got {type(scene.tool).__name__}; give make_scene(..., tool=Bucket(width, length, capacity))"
        )
    return scene.tool


@partial(jax.jit, static_argnames="record")
def _scooped(
    height: jax.Array,
    path: jax.Array,
    load: Load,
    capacity: jax.Array,
    inside: Scene | None,
    rules: Rules,
    scene: Scene,
    window: Whole | Window,
    record: Record | None = None,
) -> tuple[Loaded, Tree]:
    push, scheme, stop = rules
    assert isinstance(push, SteppedPush)
    there = load.high + load.low
    sound = jnp.isfinite(there) & (there >= 0) & (capacity > 0)
    room = jnp.where(sound, jnp.maximum(capacity / scene.grid.spacing**2 - there, 0), 0)
    path = jnp.where(sound, path, jnp.nan)  # which leaves the map as it is, and is told of
    pushed, frames, account = scoop_along(scene, height, path, push, room, record)
    edge = replace(pushed, pose=replace(pushed.pose, x=path[-1, 0], y=path[-1, 1]))
    load = jax.tree.map(partial(jnp.where, sound), added(load, account, 1), load)
    if inside is not None:
        after, load, missed = spilled(scene, inside, edge.pose, edge.height, load)
        edge = replace(edge, height=after, outcome=edge.outcome | missed)
    shaped = lifted(edge, relax(scene, edge.height, scheme, stop, window))
    return Loaded(**vars(shaped), load=load), frames


@jax.jit
def _dumped(
    scene: Scene,
    height: jax.Array,
    path: jax.Array,
    load: Load,
    amount: jax.Array | None,
    rules: tuple[Scheme, Stop],
) -> Loaded:
    tool = scene.tool
    assert isinstance(tool, Bucket)
    there = load.high + load.low
    asked = there if amount is None else amount / scene.grid.spacing**2
    width = jnp.asarray(tool.width)
    sound = jnp.all(jnp.abs(path) < farthest(scene, path.dtype)) & jnp.isfinite(width)
    sound = sound & jnp.isfinite(asked) & (asked >= 0) & jnp.isfinite(there) & (there >= 0)
    path = jnp.where(sound, path, 0)
    asked, held = jnp.where(sound, asked, 0), jax.tree.map(lambda x: jnp.where(sound, x, 0), load)
    weights = point_weights(scene, path[0])
    if path.shape[0] > 1:  # where the path has no length, it is a point
        spread = path_weights(scene, path, jnp.where(sound, width, 0))
        weights = jnp.where(jnp.any(path[1:] != path[:-1]), spread, weights)
    after, account, missed = poured(scene, height, weights, asked, ExactSum(held.low, held.high))
    settled = rested(scene, after, rules)
    outcome = settled.outcome | missed | said(Outcome.NOT_FINITE, ~sound)
    way, _ = heading(path[-2 if path.shape[0] > 1 else 0], path[-1], None)
    pose = Pose(path[-1, 0], path[-1, 1], way.cos, way.sin)
    fields = {**vars(settled), "outcome": outcome}
    return Loaded(**fields, pose=pose, load=jax.tree.map(partial(jnp.where, sound), added(held, account, -1), load))
