"""The steps of loops, traced once.

Batches and derivatives of a loop ask for its steps again and again, and a loop within a loop each time once more. So each
step is a program within the program: JAX traces it once for values of like shapes and equal steps, and keeps what becomes of
it under `vmap` and in derivatives. XLA sees the same operations.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any

import jax

if TYPE_CHECKING:
    from jaxsand.autodiff._batched_while import Loop
    from jaxsand.autodiff.while_loop import Step

Tree = Any


@partial(jax.jit, static_argnums=0)
def advanced(step: "Step", params: Tree, k: jax.Array, state: Tree) -> Tree:
    """`Step.__call__`."""
    return step(params, k, state)


@partial(jax.jit, static_argnums=0)
def recorded(step: "Step", params: Tree, k: jax.Array, state: Tree) -> tuple[Tree, Tree]:
    """`Step.recorded`."""
    return step.recorded(params, k, state)


@partial(jax.jit, static_argnums=0)
def tangent(step: "Step", params: Tree, k: jax.Array, record: Tree, dparams: Tree, dstate: Tree) -> Tree:
    """`Step.jvp`."""
    return step.jvp(params, k, record, dparams, dstate)


@partial(jax.jit, static_argnums=0)
def cotangents(step: "Step", params: Tree, k: jax.Array, record: Tree, cotangent: Tree) -> tuple[Tree, Tree]:
    """`Step.vjp`."""
    return step.vjp(params, k, record, cotangent)


@partial(jax.jit, static_argnums=(0, 1))
def whole(program: Callable[..., Tree], loop: "Loop", params: Tree, rest: tuple[Tree, ...]) -> Tree:
    """All steps of a loop, by a program of _batched_while.py."""
    return program(loop, params, *rest)


@dataclass(frozen=True)
class Axes:
    """Which leaves of the params have a batch axis, in a form that can be hashed."""

    mapped: tuple[bool, ...]
    tree: jax.tree_util.PyTreeDef

    @classmethod
    def of(cls, mapped: Tree) -> "Axes":
        """From a tree of booleans."""
        leaves, tree = jax.tree.flatten(mapped)
        return cls(tuple(leaves), tree)

    def over(self, function: Callable[..., Tree], *others: int | None) -> Callable[..., Tree]:
        """A function of params and `others` under `vmap`; of the others those are mapped whose number is 0."""
        params = jax.tree.unflatten(self.tree, [0 if yes else None for yes in self.mapped])
        return jax.vmap(function, in_axes=(params, *others))
