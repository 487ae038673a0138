"""A bounded while loop that can be differentiated in forward and in reverse mode.

`lax.while_loop` stops as soon as the work is done but has no reverse mode. `lax.scan` has one but always runs its full
length. Settling and pushing need both. So this loop runs a `while_loop` forwards, and differentiates the number of steps
that it took. Each step decides what it records on a tape for its derivative.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Protocol, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.flatten_util import ravel_pytree

from jaxsand.autodiff import _batched_while, _once
from jaxsand.autodiff._batched_while import Done, Forward, Loop

Tree: TypeAlias = _once.Tree


class Step(Protocol):
    """One step of a loop, with its jvp and vjp.

    All methods are pure, and none may close over traced values. A step must be hashable, and equal steps must do the same:
    what JAX traces for one serves for the other, and is kept with all that the step holds. So make steps of frozen
    dataclasses, or once in a module. `params` is a pytree that is the same in all steps, `k` the number of the step from 0,
    and `state` a pytree of floats.
    """

    @property
    def tape(self) -> int:
        """The number of records that reverse mode keeps; it computes the earlier records of a longer loop anew."""

    def __call__(self, params: Tree, k: jax.Array, state: Tree, /) -> Tree: ...

    def recorded(self, params: Tree, k: jax.Array, state: Tree, /) -> tuple[Tree, Tree]:
        """The state after step k, and a record of what the derivatives of the step need."""

    def jvp(self, params: Tree, k: jax.Array, record: Tree, dparams: Tree, dstate: Tree, /) -> Tree:
        """The jvp: the tangent of the state after step k, from those of params and of the state before."""

    def vjp(self, params: Tree, k: jax.Array, record: Tree, cotangent: Tree, /) -> tuple[Tree, Tree]:
        """The vjp: the cotangents of params and of the state before step k, from that of the state after."""


class TrailingStep(Step, Protocol):
    """A step that computes a batch by itself, in the last axis of all arrays; see _batched_while.py."""

    trailing: bool

    @property
    def together(self) -> int:
        """The number of maps that are computed at a time, at most."""

    def work(self, params: Tree, /) -> jax.Array:
        """A number that grows with the steps that a map takes."""


@dataclass(frozen=True)
class Plain:
    """A step that records the state before it, and is differentiated by JAX.

    Args:
        body: the step as a function of params, k and the state.
        tape: number of records that reverse mode keeps.
    """

    body: Callable[[Tree, jax.Array, Tree], Tree]
    tape: int = 16

    def __call__(self, params: Tree, k: jax.Array, state: Tree) -> Tree:
        return self.body(params, k, state)

    def recorded(self, params: Tree, k: jax.Array, state: Tree) -> tuple[Tree, Tree]:
        """The state after step k, and the state before it as the record."""
        return self.body(params, k, state), state

    def jvp(self, params: Tree, k: jax.Array, record: Tree, dparams: Tree, dstate: Tree) -> Tree:
        """The jvp, by JAX."""
        floats, merge = split(params)
        return jax.jvp(lambda f, x: self.body(merge(f), k, x), (floats, record), (dparams, dstate))[1]

    def vjp(self, params: Tree, k: jax.Array, record: Tree, cotangent: Tree) -> tuple[Tree, Tree]:
        """The vjp, by JAX."""
        floats, merge = split(params)
        return jax.vjp(lambda f, x: self.body(merge(f), k, x), floats, record)[1](cotangent)


def split(params: Tree) -> tuple[tuple[jax.Array, ...], Callable[[Tree], Tree]]:
    """The floating-point leaves of a tree, and a function that puts such leaves back into the tree."""
    leaves, treedef = jax.tree.flatten(params)
    inexact = [bool(jnp.issubdtype(jnp.result_type(leaf), jnp.inexact)) for leaf in leaves]

    def merge(floats: Tree) -> Tree:
        f = iter(floats)
        return jax.tree.unflatten(treedef, [next(f) if yes else x for x, yes in zip(leaves, inexact, strict=True)])

    return tuple(x for x, yes in zip(leaves, inexact, strict=True) if yes), merge


def repeat(step: Step, count: int, params: Tree, state: Tree) -> Tree:
    """Repeats `state = step(params, k, state)` for k = 0 to `count` - 1 and returns the last state.

    Differentiable like `repeat_until`.
    """
    return _loop(Loop(None, step, count, 0), params, state)[0]


def repeat_until(done: Done, step: Step, bound: int, params: Tree, state: Tree) -> tuple[Tree, jax.Array]:
    """Repeats `state = step(params, k, state)` for k = 0, 1, ... until `done(params, k, state)` or k = `bound`.

    Differentiable once, in forward and reverse mode, with respect to the floats of `params` and `state`; the number of steps
    is held fixed. Forward mode computes the steps a second time. Reverse mode keeps the records of the last `step.tape`
    steps and up to ten states, whatever the bound. From these states it computes the earlier records of a longer loop,
    at the cost of about one forward pass, and half of one more for each doubling of the steps beyond 8 `step.tape`.

    Args:
        done: whether to stop before step k; a function of params, k and the state that can be hashed and closes over no
            traced value.
        step: the step.
        bound: largest number of steps.
        params: pytree of arrays.
        state: pytree of floats, the state before the first step.

    Returns:
        The last state, and the number of steps taken.

    Raises:
        NotImplementedError: a second derivative is asked for.
        ValueError: the step or `done` cannot be hashed.

    Example:
        >>> import jax
        >>> import jax.numpy as jnp
        >>> from jaxsand.autodiff.while_loop import Plain, repeat_until
        >>> halve = Plain(lambda factor, k, x: factor * x)
        >>> small = lambda factor, k, x: x < 1
        >>> x, steps = repeat_until(small, halve, 100, jnp.float32(0.5), jnp.float32(6.0))
        >>> print(x, steps)
        0.75 3
        >>> jax.grad(lambda x: repeat_until(small, halve, 100, jnp.float32(0.5), x)[0])(6.0).item()
        0.125
    """
    return _loop(Loop(done, step, bound, 0), params, state)


@partial(jax.custom_jvp, nondiff_argnums=(0,))
def _loop(loop: Loop, params: Tree, state: Tree) -> tuple[Tree, jax.Array]:
    return _batched_while.batched(_batched_while.run, loop, params, state)


@_loop.defjvp
def _loop_jvp(loop: Loop, primals: Tree, tangents: Tree) -> Tree:
    params, state = first_order(primals)
    dparams, dstate = tangents
    dparams = tuple(d for d in jax.tree.leaves(dparams) if d.dtype != jax.dtypes.float0)
    ran: Forward = _batched_while.batched(_batched_while.record, loop, params, state)
    count = ran.count
    none = None if count is None else np.zeros(count.shape, jax.dtypes.float0)
    if not jax.tree.leaves((dparams, dstate)):
        return (ran.end, count), (dstate, none)
    kept, shown = hidden((params, state, ran.tape, ran.memory))
    # One flat vector, so that vmap sees a single operand that is batched or not.
    start, unravel = ravel_pytree((dparams, dstate))

    def forward(_: object, vector: jax.Array) -> jax.Array:
        df, dx = unravel(vector)
        params, state, *_ = shown(kept)
        return ravel_pytree((df, _batched_while.batched(_batched_while.jvp, loop, params, state, count, df, dx)))[0]

    def backward(_: object, vector: jax.Array) -> jax.Array:
        cf, cx = unravel(vector)
        params, _, tape, memory = shown(kept)
        df, dx = _batched_while.batched(_batched_while.vjp, loop, params, count, tape, memory, cx)
        return ravel_pytree((jax.tree.map(jnp.add, cf, df), dx))[0]

    # The solution of "identity times x = start" by rules of our own: how JAX is told a linear map and its transpose.
    out = unravel(lax.custom_linear_solve(lambda v: v, start, forward, backward))
    return (ran.end, count), (out[1], none)


def hidden(tree: Tree) -> tuple[Tree, Callable[[Tree], Tree]]:
    """The bits of a tree's floats as integers, and a function that turns them back into floats.

    What reverse mode saves leaves the compiled program that computes it. There `jax_debug_nans` would report the NaN that
    marks cells without sand (ghost_cells.py). The conversion costs nothing.
    """
    types = jax.tree.map(jnp.result_type, tree)

    def bits(x: jax.Array, dtype: jnp.dtype) -> jax.Array:
        inexact = jnp.issubdtype(dtype, jnp.inexact)
        return lax.bitcast_convert_type(x, f"uint{8 * dtype.itemsize}") if inexact else x

    def floats(x: jax.Array, dtype: jnp.dtype) -> jax.Array:
        return lax.bitcast_convert_type(x, dtype) if jnp.issubdtype(dtype, jnp.inexact) else x

    return jax.tree.map(bits, tree, types), lambda kept: jax.tree.map(floats, kept, types)


@jax.custom_jvp
def first_order(tree: Tree) -> Tree:
    """The tree itself; differentiating its derivative again raises NotImplementedError."""
    return tree


@first_order.defjvp
def _refuse(primals: Tree, tangents: Tree) -> Tree:
    raise NotImplementedError(
        "second derivatives through settling or pushing are not available; differentiate once, "
        "and take differences of gradients where a second derivative is needed"
    )
