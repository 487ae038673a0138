"""Many pushes at once, on every core.

A vmapped push takes as long as the longest of its strokes, and sand moves only near the tool. So a batch is sorted by the
length of its strokes and cut into groups, which the cores take one after the other. Only a window around the blade is
computed. A push whose sand reaches the window's edge is computed again in a wider window, in the end on the whole map. Each
map comes out as it would alone, up to rounding.
"""

from collections.abc import Callable
from functools import cache, partial

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from jaxsand.autodiff.while_loop import Tree
from jaxsand.interaction._path import Pushed
from jaxsand.interaction.rule import PushRule
from jaxsand.interaction.simulate import STROKES, Rules, Shaped, Strokes, checked, lifted, step, windows_for
from jaxsand.relaxation.batching import in_groups, in_turns, on_host, wide_vectors
from jaxsand.relaxation.schemes import Scheme
from jaxsand.relaxation.settling import relax_batch
from jaxsand.relaxation.stopping import Outcome, Stop, as_batch, check_chunk
from jaxsand.scene.masked import POINTS
from jaxsand.scene.scene import Scene, as_array
from jaxsand.scene.window import Whole

Loss = Callable[..., Float[Array, ""]]
Batch = tuple[jax.Array, jax.Array, tuple[Tree, ...]]  # maps [B, H, W], strokes [B, 4], and what else a loss needs
_GRADIENTS = 16  # the most maps that are differentiated together, on a CPU


def step_batch(
    scene: Scene,
    height: Float[ArrayLike, "B H W"],
    stroke: Strokes,
    *,
    push: PushRule | None = None,
    scheme: Scheme | None = None,
    stop: Stop | None = None,
    chunk: int | None = None,
) -> Shaped:
    """`step` for a batch of maps and strokes of one scene, on every core.

    It is faster than `jax.vmap` of `step`: strokes of like length are computed together, each in a window around its tool.
    Call it from plain Python only, not inside `jit`, `grad` or `vmap`, where `jax.vmap` of `step` does the same.

    Args:
        scene: the scene of all maps, with the tool.
        height: height maps [B, H, W] (m).
        stroke: one stroke for each map, as of `step`: [B, 4], or [B, 6] with heights.
        push: as of `step`.
        scheme: as of `settle`.
        stop: as of `settle`.
        chunk: number of maps that are pushed together, 1 or more; None for what suits the machine.

    Returns:
        The results; every field has the batch axis in front, `height` [B, H, W].

    Raises:
        ValueError: an argument has the wrong shape or is out of range, the push does not go with the tool, or it is called
            inside `jit`, `grad` or `vmap`.

    Example:
        >>> import jax.numpy as jnp
        >>> import jaxsand as js
        >>> scene = js.make_scene((8, 8), 0.01, tool=js.Blade())
        >>> strokes = jnp.array([[0.02, 0.04, 0.06, 0.04], [0.04, 0.02, 0.04, 0.06]])
        >>> js.step_batch(scene, jnp.zeros((2, 8, 8)), strokes).height.shape
        (2, 8, 8)
    """
    return _batch(_step_program(), scene, height, stroke, (push, scheme, stop), chunk)


def act_batch(
    scene: Scene,
    height: Float[ArrayLike, "B H W"],
    stroke: Strokes,
    *,
    push: PushRule | None = None,
    chunk: int | None = None,
) -> Pushed:
    """`act` for a batch of maps [B, H, W] (m) and strokes [B, 4] (m) of one scene, called like `step_batch`."""
    return _batch(_act_program(), scene, height, stroke, (push, None, None), chunk)


def value_and_grad_batch(
    scene: Scene,
    loss: Loss,
    height: Float[ArrayLike, "B H W"],
    stroke: Strokes,
    *args: Tree,
    push: PushRule | None = None,
    scheme: Scheme | None = None,
    stop: Stop | None = None,
    chunk: int | None = None,
) -> tuple[Float[Array, " B"], tuple[Float[Array, "B H W"], Float[Array, "B _"]]]:
    """A loss of what each stroke of a batch leaves, and its gradient with respect to map and stroke, on every core.

    For each map it computes loss(step(scene, height, stroke).height, *args) and differentiates that. Call it from plain
    Python only, not inside `jit`, `grad` or `vmap`, where `jax.value_and_grad` and `jax.vmap` do the same, but without
    marking what is not clean by NaN.

    Args:
        scene: the scene of all maps, with the tool.
        loss: a function of a settled map [H, W] (m) and of its part of `args` that returns one floating-point number. Pass
            the same function in every call: each new one is compiled anew, which takes a quarter of a minute.
        height: height maps [B, H, W] (m) before the pushes.
        stroke: one stroke for each map, as of `step`: [B, 4], or [B, 6] with heights.
        *args: arrays, or pytrees of arrays, with a leading axis of length B: such as one goal for each map.
        push: as of `step`.
        scheme: as of `settle`.
        stop: as of `settle`.
        chunk: number of maps that are computed together, 1 or more; None for what suits the machine.

    Returns:
        The losses [B], and a pair of gradients: by the maps [B, H, W], and by the strokes [B, 4] or [B, 6]. They are NaN
        where the outcome is NOT_FINITE, or where sand reached the edge of a `Window` that the scene was given.

    Raises:
        ValueError: as of `step_batch`, or the loss is no hashable function, or returns anything but one
            floating-point number for a map, or `args` do not have the batch axis.

    Example:
        The distance to a goal; here of a scene without a tool, which compiles faster.

        >>> import jax.numpy as jnp
        >>> import jaxsand as js
        >>> def miss(height, goal):
        ...     return jnp.sum((height - goal) ** 2)
        >>> scene = js.make_scene((8, 8), 0.01)
        >>> heights, goals, strokes = jnp.zeros((2, 8, 8)), jnp.ones((2, 8, 8)), jnp.zeros((2, 4))
        >>> losses, (by_height, by_stroke) = js.value_and_grad_batch(scene, miss, heights, strokes, goals)
        >>> losses.tolist(), by_height[0, 0, 0].tolist(), by_stroke.shape
        ([64.0, 64.0], -2.0, (2, 4))
    """
    _check_loss(loss)
    height = as_batch(height)
    args = jax.tree.map(lambda x: as_array("args", x, masked="fill them first, or have the loss leave them out"), args)
    for arg in jax.tree.leaves(args):
        if arg.shape[:1] != height.shape[:1]:
            remedy = f"give [{height.shape[0]}, ...], one for each map"
            raise ValueError(f"args: got an array of shape {list(arg.shape)}; {remedy}")
    program = _gradient_program(loss)
    chunk = _GRADIENTS if chunk is None and jax.default_backend() == "cpu" else chunk
    value, *slopes, outcome = _batch(program, scene, height, stroke, (push, scheme, stop), chunk, args)
    clean = np.asarray(outcome) & (Outcome.NOT_FINITE | Outcome.WINDOW_EDGE) == 0
    value, by_height, by_stroke = (jnp.where(clean.reshape(-1, *[1] * (x.ndim - 1)), x, jnp.nan) for x in (value, *slopes))
    return value, (by_height, by_stroke)


def _batch(
    program: Callable[..., Tree],
    scene: Scene,
    height: ArrayLike,
    stroke: ArrayLike,
    rules: tuple[PushRule | None, Scheme | None, Stop | None],
    chunk: int | None,
    args: tuple[Tree, ...] = (),
) -> Tree:
    height = as_batch(height)
    stroke = as_array("stroke", stroke, height.dtype, POINTS)
    if stroke.ndim != 2 or stroke.shape[0] != height.shape[0] or stroke.shape[1] not in STROKES:
        remedy = f"give [{height.shape[0]}, 4], one stroke for each map, or [{height.shape[0]}, 6] with heights"
        raise ValueError(f"stroke: got shape {list(stroke.shape)}; {remedy}")
    check_chunk(chunk)
    every = on_host((height, stroke, args))
    scene, _, rules = checked(scene, every[0][0], *rules)

    def run(scene: Scene, who: slice | np.ndarray) -> Tree:
        batch = jax.tree.map(lambda x: x[who], every)
        return in_groups(partial(program, scene, rules), batch, _lengths, chunk)

    scenes = [*windows_for(scene, rules[0]), scene]
    return jax.tree.map(jnp.asarray, in_turns([partial(run, one) for one in scenes], _flagged))


def _lengths(batch: Batch) -> np.ndarray:
    start, stop = np.split(np.asarray(batch[1]), 2, axis=1)
    return np.hypot(*(stop - start)[:, :2].T)


def _flagged(out: Tree) -> jax.Array:
    """Which results of a batch say that sand reached the edge of the window."""
    return (out[-1] if isinstance(out, tuple) else out.outcome) & Outcome.WINDOW_EDGE


@cache
def _step_program() -> Callable[[Scene, Rules, Batch], Shaped]:
    def run(scene: Scene, rules: Rules, batch: Batch) -> Shaped:
        push, scheme, stop = rules
        pushed = _acted(scene, push, batch)
        settled = relax_batch((scene, scheme, stop, Whole()), pushed.height, chunk=pushed.height.shape[0])
        return lifted(pushed, settled)

    return jax.jit(run, compiler_options=wide_vectors())


@cache
def _act_program() -> Callable[[Scene, Rules, Batch], Pushed]:
    def run(scene: Scene, rules: Rules, batch: Batch) -> Pushed:
        return _acted(scene, rules[0], batch)

    return jax.jit(run, compiler_options=wide_vectors())


def _acted(scene: Scene, push: PushRule, batch: Batch) -> Pushed:
    return jax.vmap(lambda h, s: push.along(scene, h, s.reshape(2, -1))[0])(*batch[:2])


@cache
def _gradient_program(loss: Loss) -> Callable[[Scene, Rules, Batch], tuple[jax.Array, ...]]:
    def run(scene: Scene, rules: Rules, batch: Batch) -> tuple[jax.Array, ...]:
        push, scheme, stop = rules

        def one(height: jax.Array, stroke: jax.Array, args: tuple[Tree, ...]) -> tuple[jax.Array, jax.Array]:
            shaped = step(scene, height, stroke, push=push, scheme=scheme, stop=stop)
            return _one_number(loss(shaped.height, *args)), shaped.outcome

        (value, outcome), slopes = jax.vmap(jax.value_and_grad(one, argnums=(0, 1), has_aux=True))(*batch)
        return value, *slopes, outcome

    return jax.jit(run, compiler_options=wide_vectors())


def _check_loss(loss: object) -> None:
    """Raises ValueError unless it is a function that finds its compiled program again."""
    if not callable(loss):
        raise ValueError(f"loss: got {type(loss).__name__}; give a function of a map [H, W] that returns one number")
    try:
        hash(loss)
    except TypeError as error:
        raise ValueError(f"loss: got {type(loss).__name__} ({error}); give a function, and what it needs as args") from None


def _one_number(value: object) -> jax.Array:
    """What a loss returned for a map; ValueError unless it is one floating-point number."""
    remedy = "return one floating-point number for a map, such as jnp.sum((height - goal) ** 2)"
    try:
        found = jnp.asarray(value)
    except (TypeError, ValueError):
        raise ValueError(f"loss: got {type(value).__name__} from it; {remedy}") from None
    if found.shape or not jnp.issubdtype(found.dtype, jnp.floating):
        raise ValueError(f"loss: got {found.dtype} of shape {list(found.shape)} from it; {remedy}")
    return found
