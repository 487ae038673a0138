"""A bounded while loop that can be differentiated in reverse and in forward mode.

`lax.while_loop` stops as soon as the work is done but has no reverse mode; `lax.scan` has one but always runs its full
length. Settling and pushing need both, so this loop runs a `while_loop` forwards and is differentiated as the fixed number
of steps that it turned out to take.
"""

import math
from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.flatten_util import ravel_pytree

Tree = Any
Body = Callable[[Tree, jax.Array, Tree], Tree]
Done = Callable[[Tree, jax.Array, Tree], jax.Array]


def repeat_until(done: Done, body: Body, bound: int, params: Tree, state: Tree) -> tuple[Tree, jax.Array]:
    """Repeats `state = body(params, k, state)` for k = 0, 1, ... until `done(params, k, state)` or k = `bound`.

    `state` is a tree of floats; `params` is any tree of arrays. Neither function may close over traced values. Returns the
    last state and the number of steps taken.

    Differentiable once, in both modes, with respect to the floats of `params` and `state`, the number of steps held fixed.
    Forward mode repeats the primal steps. Reverse mode keeps ceil(sqrt(bound)) states, restores the steps between two of
    them, and so costs one more forward pass and memory for 2 sqrt(bound) states. A second derivative raises
    NotImplementedError.
    """
    leaves, treedef = jax.tree.flatten(params)
    inexact = tuple(bool(jnp.issubdtype(jnp.result_type(leaf), jnp.inexact)) for leaf in leaves)
    floats = tuple(leaf for leaf, yes in zip(leaves, inexact, strict=True) if yes)
    others = tuple(leaf for leaf, yes in zip(leaves, inexact, strict=True) if not yes)

    def merge(floats: tuple[Tree, ...], others: tuple[Tree, ...]) -> Tree:
        f, o = iter(floats), iter(others)
        return jax.tree.unflatten(treedef, [next(f) if yes else next(o) for yes in inexact])

    def step(floats: Tree, others: Tree, k: jax.Array, state: Tree) -> Tree:
        return body(merge(floats, others), k, state)

    def stop(floats: Tree, others: Tree, k: jax.Array, state: Tree) -> jax.Array:
        return (k >= bound) | done(merge(floats, others), k, state)

    return _loop(stop, step, bound, floats, others, state)


@partial(jax.custom_jvp, nondiff_argnums=(0, 1, 2))
def _loop(stop: Callable, step: Callable, bound: int, floats: Tree, others: Tree, state: Tree) -> tuple[Tree, jax.Array]:
    def proceed(carry: Tree) -> jax.Array:
        return ~stop(floats, others, carry[1], carry[0])

    def advance(carry: Tree) -> Tree:
        return step(floats, others, carry[1], carry[0]), carry[1] + 1

    return lax.while_loop(proceed, advance, (state, jnp.int32(0)))


@_loop.defjvp
def _loop_jvp(stop: Callable, step: Callable, bound: int, primals: Tree, tangents: Tree) -> Tree:
    floats, others, state = primals
    dfloats, _, dstate = tangents
    stride = max(1, math.isqrt(max(bound - 1, 0)) + 1)
    end, count, saved = _run_saving(stop, step, bound, stride, floats, others, state)
    if not jax.tree.leaves((dfloats, dstate)):
        return (end, count), (dstate, np.zeros((), jax.dtypes.float0))
    floats, state, saved = _first_order((floats, state, saved))
    # One flat vector, so that vmap sees a single operand that is batched or not.
    start, unravel = ravel_pytree((dfloats, dstate))

    def at(k: jax.Array) -> Callable:
        return lambda f, x: step(f, others, k, x)

    def forward(_: Callable, vector: jax.Array) -> jax.Array:
        df, dx = unravel(vector)

        def push(k: jax.Array, carry: Tree) -> Tree:
            x, dx = carry
            return jax.jvp(at(k), (floats, x), (df, dx))

        return ravel_pytree((df, lax.fori_loop(0, count, push, (state, dx))[1]))[0]

    def backward(_: Callable, vector: jax.Array) -> jax.Array:
        cf, cx = unravel(vector)
        segments = (count + stride - 1) // stride

        def segment(i: jax.Array, carry: Tree) -> Tree:
            first = (segments - 1 - i) * stride
            steps = jnp.minimum(stride, count - first)
            x0 = jax.tree.map(lambda s: lax.dynamic_index_in_dim(s, first // stride, keepdims=False), saved)

            def restore(j: jax.Array, c: Tree) -> Tree:
                x, xs = c
                return step(floats, others, first + j, x), _put(xs, j, x)

            _, xs = lax.fori_loop(0, steps, restore, (x0, _room(stride, x0)))

            def pull(j: jax.Array, c: Tree) -> Tree:
                cf, cx = c
                j = steps - 1 - j
                x = jax.tree.map(lambda s: lax.dynamic_index_in_dim(s, j, keepdims=False), xs)
                _, vjp = jax.vjp(at(first + j), floats, x)
                df, dx = vjp(cx)
                return jax.tree.map(jnp.add, cf, df), dx

            return lax.fori_loop(0, steps, pull, carry)

        return ravel_pytree(lax.fori_loop(0, segments, segment, (cf, cx)))[0]

    # The solution of "identity times x = start" by rules of our own: how JAX is told a linear map and its transpose.
    out = unravel(lax.custom_linear_solve(lambda v: v, start, forward, backward))
    return (end, count), (out[1], np.zeros((), jax.dtypes.float0))


def _run_saving(
    stop: Callable, step: Callable, bound: int, stride: int, floats: Tree, others: Tree, state: Tree
) -> tuple[Tree, jax.Array, Tree]:
    """The loop, keeping the state before every `stride`-th step."""

    def proceed(carry: Tree) -> jax.Array:
        return ~stop(floats, others, carry[1], carry[0])

    def segment(carry: Tree) -> Tree:
        x, k, saved = carry
        saved = _put(saved, k // stride, x)
        last = k + stride
        x, k = lax.while_loop(
            lambda c: (c[1] < last) & proceed(c), lambda c: (step(floats, others, c[1], c[0]), c[1] + 1), (x, k)
        )
        return x, k, saved

    return lax.while_loop(proceed, segment, (state, jnp.int32(0), _room(-(-bound // stride), state)))


def _room(n: int, state: Tree) -> Tree:
    return jax.tree.map(lambda x: jnp.zeros((max(n, 1), *x.shape), x.dtype), state)


def _put(saved: Tree, k: jax.Array, state: Tree) -> Tree:
    return jax.tree.map(lambda s, x: lax.dynamic_update_index_in_dim(s, x, k, 0), saved, state)


@jax.custom_jvp
def _first_order(tree: Tree) -> Tree:
    return tree


@_first_order.defjvp
def _refuse(primals: Tree, tangents: Tree) -> Tree:
    raise NotImplementedError(
        "second derivatives through settling or pushing are not available; differentiate once, "
        "and take differences of gradients where a second derivative is needed"
    )
