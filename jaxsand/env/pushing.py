"""Pushes inside an environment, one map or many.

A vmapped push takes as long as the longest of its strokes. `ByLength` therefore tells vmap to sort a batch by the strokes'
lengths and to push chunk after chunk of like ones, each small enough for a core's cache. A map comes out as it would alone,
up to rounding. On several cores of a CPU, give each a device of its own and a share of the batch (see the README).
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax
from jax.custom_batching import custom_vmap

from jaxsand.push import SteppedPush
from jaxsand.rules import Stop, check_whole
from jaxsand.scene import Scene
from jaxsand.sim import step
from jaxsand.swath import SwathPush

Push = SteppedPush | SwathPush
Pushing = Callable[[Scene, jax.Array, jax.Array], tuple[jax.Array, jax.Array]]
"""From a scene, a map [H, W] (m) and a stroke [4] (m) to the map it leaves and its outcome."""


@dataclass(frozen=True)
class Together:
    """A batch is pushed all at once, as long as its longest stroke takes (neutral): what suits a GPU, and derivatives."""

    def pushing(self, push: Push, stop: Stop | None) -> Pushing:
        return _alone(push, stop)


@dataclass(frozen=True)
class ByLength:
    """A batch is pushed in chunks of maps with strokes of like length: what suits a CPU. Has no reverse mode."""

    chunk: int = 32

    def __post_init__(self) -> None:
        check_whole("chunk", self.chunk, 1)

    def pushing(self, push: Push, stop: Stop | None) -> Pushing:
        return sorted_by_length(self, _alone(push, stop))


Batching = Together | ByLength


@cache
def _alone(push: Push, stop: Stop | None) -> Pushing:
    def one(scene: Scene, height: jax.Array, stroke: jax.Array) -> tuple[jax.Array, jax.Array]:
        shaped = step(scene, height, stroke, push=push, stop=stop)
        return shaped.height, shaped.outcome

    return one


@cache
def sorted_by_length(way: ByLength, alone: Pushing) -> Pushing:
    """A push that vmap batches that way."""
    one = custom_vmap(alone)

    @one.def_vmap
    def many(size: int, batched: Any, *of_one: Any) -> tuple[Any, Any]:
        leaves, tree = jax.tree.flatten(of_one)
        mapped = jax.tree.leaves(batched)
        stroke = jnp.asarray(of_one[2])
        length = jnp.hypot(stroke[..., 2] - stroke[..., 0], stroke[..., 3] - stroke[..., 1])
        order = jnp.argsort(jnp.broadcast_to(-length, (size,)))
        chunk = min(way.chunk, size)
        chunks = -(-size // chunk)
        filled = jnp.concatenate([order, jnp.repeat(order[-1:], chunk * chunks - size)]).reshape(chunks, chunk)

        def pushed(who: jax.Array) -> tuple[jax.Array, jax.Array]:
            some = [jnp.asarray(leaf)[who] if m else leaf for leaf, m in zip(leaves, mapped, strict=True)]
            axes = jax.tree.unflatten(tree, [0 if m else None for m in mapped])
            return jax.vmap(alone, in_axes=axes)(*jax.tree.unflatten(tree, some))

        out = jax.tree.map(lambda x: x.reshape(chunks * chunk, *x.shape[2:])[:size], lax.map(pushed, filled))
        return jax.tree.map(lambda x: jnp.zeros_like(x).at[order].set(x, unique_indices=True), out), (True, True)

    return one
