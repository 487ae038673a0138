"""Many pushes at once: on every core, strokes of like length together, each in a window around its blade.

A vmapped push takes as long as the longest of its strokes, and the sand moves in a part of the map alone. So a batch is
sorted by length and cut into groups, of which each core takes the next; only a window around the blade is computed, and
what reaches the window's edge is pushed again in a wider one, in the end on the whole map. A map comes out as it would
alone, up to rounding.
"""

from collections.abc import Callable
from functools import cache, partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxsand.interaction._path import Pushed
from jaxsand.interaction.blade_stepped import windows_for
from jaxsand.interaction.simulate import Push, Rules, Shaped, lifted, ready, step, way_of
from jaxsand.relaxation.batching import in_groups, in_turns, wide_vectors
from jaxsand.relaxation.schemes import Scheme
from jaxsand.relaxation.settling import relax_batch
from jaxsand.relaxation.stopping import Outcome, Stop, as_batch, check_chunk
from jaxsand.scene.scene import Scene, as_array
from jaxsand.scene.window import Whole

Array = jax.typing.ArrayLike
Loss = Callable[..., jax.Array]
_GRADIENTS = 32  # the most that are pulled back together, on a CPU


def step_batch(
    scene: Scene,
    height: Array,
    stroke: Array,
    *,
    push: Push | None = None,
    scheme: Scheme | None = None,
    stop: Stop | None = None,
    chunk: int | None = None,
) -> Shaped:
    """`step` on a batch of maps [B, H, W] and strokes [B, 4] of one scene; every field of the result gains the batch axis.

    Faster than `jax.vmap(step)`, and for the same reason an outermost program: call it as it is, not inside `jit`, `grad` or
    `vmap`. `chunk` is how many maps are pushed together; the default suits the machine.
    """
    return _batch(_step_program(), scene, height, stroke, (push, scheme, stop), chunk)


def act_batch(scene: Scene, height: Array, stroke: Array, *, push: Push | None = None, chunk: int | None = None) -> Pushed:
    """`act` on a batch of maps [B, H, W] and strokes [B, 4] of one scene, like `step_batch`."""
    return _batch(_act_program(), scene, height, stroke, (push, None, None), chunk)


def value_and_grad_batch(
    scene: Scene,
    loss: Loss,
    height: Array,
    stroke: Array,
    *args: Any,
    push: Push | None = None,
    scheme: Scheme | None = None,
    stop: Stop | None = None,
    chunk: int | None = None,
) -> tuple[jax.Array, tuple[jax.Array, jax.Array]]:
    """Losses of what strokes leave, and their gradients: an outermost program like `step_batch`.

    Args:
      loss: from a map [H, W] (m) after the push, and what of `args` belongs to it, to a number. Pass the same function every
        time: a new one is compiled anew, which takes a quarter of a minute.
      height, stroke: maps [B, H, W] (m) before, and strokes [B, 4] (m).
      args: arrays, or trees of them, with a leading axis of length B.

    Returns:
      The losses [B], and the gradients by the maps [B, H, W] and by the strokes [B, 4]. NaN where the outcome is not finite,
      or where sand reached the edge of the scene's own window.

    Example:
      >>> def miss(height, goal):
      ...     return jnp.sum((height - goal) ** 2)
      >>> values, (by_height, by_stroke) = js.value_and_grad_batch(scene, miss, heights, strokes, goals)
    """
    program = _gradient_program(loss)
    chunk = _GRADIENTS if chunk is None and jax.default_backend() == "cpu" else chunk
    args = jax.tree.map(jnp.asarray, args)
    value, *slopes, outcome = _batch(program, scene, height, stroke, (push, scheme, stop), chunk, args)
    clean = np.asarray(outcome) & (Outcome.NOT_FINITE | Outcome.WINDOW_EDGE) == 0
    value, by_height, by_stroke = (jnp.where(clean.reshape(-1, *[1] * (x.ndim - 1)), x, jnp.nan) for x in (value, *slopes))
    return value, (by_height, by_stroke)


def _batch(
    program: Callable[..., Any],
    scene: Scene,
    height: Any,
    stroke: Any,
    rules: Any,
    chunk: int | None,
    args: tuple[Any, ...] = (),
) -> Any:
    height = as_batch(height)
    stroke = as_array("stroke", stroke, height.dtype)
    if stroke.shape != (height.shape[0], 4):
        raise ValueError(f"stroke: got shape {list(stroke.shape)}; give [{height.shape[0]}, 4], one stroke for each map")
    check_chunk(chunk)
    scene, _, rules = ready(scene, height[0], *rules)

    def run(scene: Scene, who: Any) -> Any:
        batch = jax.tree.map(lambda x: x[who], (height, stroke, args))
        return in_groups(partial(program, scene, rules), batch, _lengths, chunk)

    scenes = [*windows_for(scene, rules[0]), scene]
    return in_turns([partial(run, one) for one in scenes], _flagged)


def _lengths(batch: Any) -> np.ndarray:
    stroke = np.asarray(batch[1])
    return np.hypot(*(stroke[:, 2:] - stroke[:, :2]).T)


def _flagged(out: Any) -> jax.Array:
    """Where sand reached a window's edge."""
    return (out[-1] if isinstance(out, tuple) else out.outcome) & Outcome.WINDOW_EDGE


@cache
def _step_program() -> Any:
    def run(scene: Scene, rules: Rules, batch: Any) -> Shaped:
        push, scheme, stop = rules
        pushed = _acted(scene, push, batch)
        settled = relax_batch((scene, scheme, stop, Whole()), pushed.height, chunk=pushed.height.shape[0])
        return lifted(pushed, settled)

    return jax.jit(run, compiler_options=wide_vectors())


@cache
def _act_program() -> Any:
    def run(scene: Scene, rules: Rules, batch: Any) -> Pushed:
        return _acted(scene, rules[0], batch)

    return jax.jit(run, compiler_options=wide_vectors())


def _acted(scene: Scene, push: Push, batch: Any) -> Pushed:
    return jax.vmap(lambda h, s: way_of(scene, push)(scene, h, s.reshape(2, 2), push)[0])(*batch[:2])


@cache
def _gradient_program(loss: Loss) -> Any:
    def run(scene: Scene, rules: Rules, batch: Any) -> Any:
        push, scheme, stop = rules

        def one(height: jax.Array, stroke: jax.Array, args: tuple[Any, ...]) -> tuple[jax.Array, jax.Array]:
            shaped = step(scene, height, stroke, push=push, scheme=scheme, stop=stop)
            return loss(shaped.height, *args), shaped.outcome

        (value, outcome), slopes = jax.vmap(jax.value_and_grad(one, argnums=(0, 1), has_aux=True))(*batch)
        return value, *slopes, outcome

    return jax.jit(run, compiler_options=wide_vectors())
