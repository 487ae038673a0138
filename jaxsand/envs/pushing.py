"""Pushes inside an environment, of one map or of many.

A vmapped push takes as long as the longest of its strokes. So `ByLength` makes vmap sort a batch by the strokes' lengths,
and push chunk after chunk of strokes of like length, each chunk small enough for a core's cache. Each map comes out as it
would alone, up to rounding. On several cores of a CPU, give each a device of its own and a share of the batch.

A rule for vmap has no derivative of its own. Here a push gets one that is batched in the same way: tangents and cotangents
are sorted and computed chunk by chunk like the maps. The derivative is that of a push alone, in forward and reverse mode,
and can be taken once. Reverse mode stores only what went into a push, and pushes each chunk again when it goes back through
it.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.custom_batching import custom_vmap
from jax.flatten_util import ravel_pytree

from jaxsand.autodiff.while_loop import first_order, split
from jaxsand.interaction.blade_closed_form import SwathPush
from jaxsand.interaction.simulate import step
from jaxsand.interaction.stepped import SteppedPush
from jaxsand.relaxation.stopping import Stop, check_whole
from jaxsand.scene.scene import Scene, cast

Push = SteppedPush | SwathPush
Pushing = Callable[[Scene, Any, jax.Array], tuple[Any, jax.Array]]
"""From a scene, a map [H, W] (m), or a tree with one, and a stroke to what is left and its outcome.

A stroke is [4] or [6] (m); more numbers may follow the six.
"""


@dataclass(frozen=True)
class Together:
    """Tells an environment to push a batch all at once, which takes as long as its longest stroke: suits a GPU.

    Example:
      >>> import numpy as np
      >>> import jaxsand as js
      >>> env, params = js.make("multi-stroke", goals=np.zeros((1, 32, 32)), batching=js.env.Together())
      >>> env.batching
      Together()
    """

    def batched(self, alone: Pushing) -> Pushing:
        """What is done to one map, to be vmapped as it is."""
        return alone


@dataclass(frozen=True)
class ByLength:
    """Tells an environment to push a batch in chunks of maps with strokes of like length: suits a CPU.

    Args:
      chunk: maps to a chunk.

    Raises:
      ValueError: for a chunk below 1.

    Example:
      >>> import jaxsand as js
      >>> js.env.ByLength(chunk=16)
      ByLength(chunk=16)
    """

    chunk: int = 32

    def __post_init__(self) -> None:
        check_whole("chunk", self.chunk, 1)

    def batched(self, alone: Pushing) -> Pushing:
        """What is done to one map, which vmap batches by length."""
        return by_length(self, alone)


Batching = Together | ByLength


@cache
def pushing(push: Push, stop: Stop | None) -> Pushing:
    """The push of one map: the map that it leaves, and the outcome."""

    def one(scene: Scene, height: jax.Array, stroke: jax.Array) -> tuple[jax.Array, jax.Array]:
        shaped = step(scene, height, stroke, push=push, stop=stop)
        return shaped.height, shaped.outcome

    return one


@cache
def by_length(way: ByLength, alone: Pushing) -> Pushing:
    """A push that vmap batches by length, and so its derivatives."""

    def of_floats(scene: Scene, before: Any, stroke: jax.Array) -> tuple[Callable[..., Any], Any]:
        """The map that is left as a function of all floats, and these."""
        floats, merge = split((scene, stroke))

        def left(floats: Any, before: Any) -> Any:
            scene, stroke = merge(floats)
            return alone(scene, before, stroke)[0]

        return left, (floats, before)

    def tangent(scene: Scene, before: Any, stroke: jax.Array, *tangents: Any) -> Any:
        return jax.jvp(*of_floats(scene, before, stroke), tangents)[1]

    def cotangent(scene: Scene, before: Any, stroke: jax.Array, gain: Any) -> tuple[Any, Any]:
        left, at = of_floats(scene, before, stroke)
        return jax.vjp(left, *at)[1](gain)

    many, forwards, backwards = (sorted_by_length(way, f) for f in (alone, tangent, cotangent))

    @jax.custom_jvp
    def pushed(scene: Scene, before: Any, stroke: jax.Array) -> tuple[Any, jax.Array]:
        return many(scene, before, stroke)

    @pushed.defjvp
    def _(primals: Any, tangents: Any) -> Any:
        primals = first_order(primals)
        dscene, dbefore, dstroke = tangents
        dfloats = tuple(d for d in jax.tree.leaves((dscene, dstroke)) if d.dtype != jax.dtypes.float0)
        start, unravel = ravel_pytree((dfloats, dbefore))

        def solve(_: Callable[..., Any], vector: jax.Array) -> jax.Array:
            dfloats, dbefore = unravel(vector)
            return ravel_pytree((dfloats, forwards(*primals, dfloats, dbefore)))[0]

        def transpose(_: Callable[..., Any], vector: jax.Array) -> jax.Array:
            to_floats, gain = unravel(vector)
            more, to_before = backwards(*primals, gain)
            return ravel_pytree((jax.tree.map(jnp.add, to_floats, more), to_before))[0]

        # As in while_loop.py: the solution of "identity times x = start" by rules of our own.
        dheight = unravel(lax.custom_linear_solve(lambda v: v, start, solve, transpose))[1]
        after, outcome = many(*primals)
        return (after, outcome), (dheight, np.zeros(outcome.shape, jax.dtypes.float0))

    def cast_first(scene: Scene, before: Any, stroke: jax.Array) -> tuple[Any, jax.Array]:
        dtype = jnp.result_type(jax.tree.leaves(before)[0])
        return pushed(cast(scene, dtype), cast(before, dtype), jnp.asarray(stroke, dtype))

    return cast_first


@cache
def sorted_by_length(way: ByLength, alone: Callable[..., Any]) -> Callable[..., Any]:
    """A function of a scene, a map, a stroke and more, which vmap batches by length; it has no derivatives."""
    one = custom_vmap(alone)

    @one.def_vmap
    def many(size: int, batched: Any, *of_one: Any) -> tuple[Any, Any]:
        leaves, tree = jax.tree.flatten(of_one)
        mapped = jax.tree.leaves(batched)
        stroke = jnp.asarray(of_one[2])
        ends = stroke[..., :6].reshape(*stroke.shape[:-1], 2, -1)
        run = ends[..., 1, :2] - ends[..., 0, :2]
        length = jnp.hypot(run[..., 0], run[..., 1])
        order = jnp.argsort(jnp.broadcast_to(-length, (size,)))
        chunk = min(way.chunk, size)
        chunks = -(-size // chunk)
        filled = jnp.concatenate([order, jnp.repeat(order[-1:], chunk * chunks - size)]).reshape(chunks, chunk)

        def pushed(who: jax.Array) -> Any:
            some = [jnp.asarray(leaf)[who] if m else leaf for leaf, m in zip(leaves, mapped, strict=True)]
            axes = jax.tree.unflatten(tree, [0 if m else None for m in mapped])
            return jax.vmap(alone, in_axes=axes)(*jax.tree.unflatten(tree, some))

        out = jax.tree.map(lambda x: x.reshape(chunks * chunk, *x.shape[2:])[:size], lax.map(pushed, filled))
        out = jax.tree.map(lambda x: jnp.zeros_like(x).at[order].set(x, unique_indices=True), out)
        return out, jax.tree.map(lambda _: True, out)

    return one
