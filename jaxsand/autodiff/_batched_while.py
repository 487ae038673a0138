"""The loops of while_loop.py under `vmap`: the maps of a batch run in lockstep, each until it is done.

All maps share one step number, so that the tape for reverse mode can be written in place.

A step whose attribute `trailing` is true computes a batch by itself. `vmap` then moves the batch to the last axis of all
arrays, the lanes of the vector unit, for the whole loop. It takes at most `step.together` maps at a time (on a CPU, what a
core's cache holds), and runs maps of like `step.work(params)` together, a number that grows with a map's steps. Such a step
must not change a map that is done, and its `done` returns one boolean for all maps.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, cast

import jax
import jax.numpy as jnp
from jax import lax
from jax.custom_batching import custom_vmap

from jaxsand.autodiff._once import Axes, Tree, advanced, cotangents, recorded, tangent, whole

if TYPE_CHECKING:
    from jaxsand.autodiff.while_loop import Step, TrailingStep

Done = Callable[[Tree, jax.Array, Tree], jax.Array]
KEPT = 8  # states of a long loop that the forward pass keeps for reverse mode; when full, it drops every other one
SPARE = 2  # further states that reverse mode may keep between them


@dataclass(frozen=True)
class Loop:
    """A loop, run in lockstep for all maps of a batch, to which `vmap` may add axes.

    Attributes:
        done: whether a map stops before step k; None where all take `bound` steps.
        step: the step; a `TrailingStep` if it computes a batch in the last axis.
        bound: largest number of steps.
        batch_axes: number of leading batch axes of the state.
        width: size of the trailing batch, 0 where there is none.
    """

    done: Done | None
    step: "Step"
    bound: int
    batch_axes: int
    width: int = 0

    @property
    def trailing(self) -> bool:
        """Whether the step computes a batch in the last axis of all arrays."""
        return getattr(self.step, "trailing", False)

    @property
    def room(self) -> int:
        """The number of records that the tape holds."""
        return max(1, min(self.bound, self.step.tape))

    def over(self, axes: Axes) -> "Loop":
        """The loop with one more leading batch axis: of the state, and of the params that `axes` names."""
        done = None if self.done is None else _ManyDone(self.done, axes)
        return Loop(done, _Many(self.step, axes), self.bound, self.batch_axes + 1)

    def ended(self, params: Tree, k: jax.Array, state: Tree) -> jax.Array:
        """Which maps have ended before step k: booleans with the leading batch axes, one for a whole trailing batch."""
        over = k >= self.bound
        return over if self.done is None else over | self.done(params, k, state)

    def taken(self, count: jax.Array) -> jax.Array | None:
        """The number of steps of each map, or None where all take `bound` steps."""
        return None if self.done is None else self.for_each_map(count)

    def for_each_map(self, number: jax.Array) -> jax.Array:
        """A number that all maps share, repeated for each map of a trailing batch."""
        return jnp.broadcast_to(number[..., None], (*number.shape, self.width)) if self.width else number

    def total(self, count: jax.Array | None) -> jax.Array:
        """The largest number of steps of any map."""
        return jnp.int32(self.bound) if count is None else jnp.max(count)

    def beyond(self, k: jax.Array, count: jax.Array | None) -> jax.Array:
        """Which maps had stopped before step k."""
        return jnp.zeros((), bool) if count is None else k >= count

    def keep(self, ended: jax.Array, old: Tree, new: Tree) -> Tree:
        """The state after a step: the old one of the maps that had ended before it, the new one of the others."""
        if not self.batch_axes or not ended.ndim:
            return new
        return jax.tree.map(
            lambda x, y: jnp.where(ended.reshape(ended.shape + (1,) * (x.ndim - self.batch_axes)), x, y), old, new
        )

    def put(self, tape: Tree, k: jax.Array, record: Tree) -> Tree:
        """The tape with the record in place k; a tape's places follow its leading batch axes."""
        return jax.tree.map(lambda t, x: lax.dynamic_update_index_in_dim(t, x, k, self.batch_axes), tape, record)

    def get(self, tape: Tree, k: jax.Array) -> Tree:
        """The record in place k of the tape."""
        return jax.tree.map(lambda t: lax.dynamic_index_in_dim(t, k, self.batch_axes, keepdims=False), tape)

    def blank(self, n: int, record: Tree) -> Tree:
        """A tape of n records of zeros."""

        def zeros(x: jax.Array) -> jax.Array:
            return jnp.zeros((*x.shape[: self.batch_axes], n, *x.shape[self.batch_axes :]), x.dtype)

        return jax.tree.map(zeros, record)


@dataclass(frozen=True)
class _Many:
    """A step with one more leading batch axis."""

    step: "Step"
    axes: Axes

    @property
    def tape(self) -> int:
        return self.step.tape

    def __call__(self, params: Tree, k: jax.Array, state: Tree) -> Tree:
        return self.axes.over(partial(advanced, self.step), None, 0)(params, k, state)

    def recorded(self, params: Tree, k: jax.Array, state: Tree) -> tuple[Tree, Tree]:
        return self.axes.over(partial(recorded, self.step), None, 0)(params, k, state)

    def jvp(self, params: Tree, k: jax.Array, record: Tree, dparams: Tree, dstate: Tree) -> Tree:
        return self.axes.over(partial(tangent, self.step), None, 0, 0, 0)(params, k, record, dparams, dstate)

    def vjp(self, params: Tree, k: jax.Array, record: Tree, cotangent: Tree) -> tuple[Tree, Tree]:
        return self.axes.over(partial(cotangents, self.step), None, 0, 0)(params, k, record, cotangent)


@dataclass(frozen=True)
class _ManyDone:
    """Which maps stop, with one more leading batch axis."""

    done: Done
    axes: Axes

    def __call__(self, params: Tree, k: jax.Array, state: Tree) -> jax.Array:
        return self.axes.over(self.done, None, 0)(params, k, state)


def batched(program: Callable[..., Tree], loop: Loop, params: Tree, *rest: Tree) -> Tree:
    """`program(loop, params, *rest)`; under `vmap` the same program with one more batch axis, which all of `rest` gains."""

    @custom_vmap
    def run(params: Tree, rest: Tree) -> Tree:
        return whole(program, loop, params, rest)

    @run.def_vmap
    def rule(size: int, mapped: list[Tree], params: Tree, rest: Tree) -> tuple[Tree, Tree]:
        if loop.trailing:
            out = _trailing(program, loop, size, mapped, (params, rest))
            return out, jax.tree.map(lambda _: True, out)
        axes = Axes.of(mapped[0])
        rest = jax.tree.map(lambda yes, x: x if yes else jnp.broadcast_to(x, (size, *x.shape)), mapped[1], rest)
        out = batched(program, loop.over(axes), params, *rest)
        return out, jax.tree.map(lambda _: True, out)

    return run(params, rest)


def _trailing(program: Callable[..., Tree], loop: Loop, size: int, mapped: list[Tree], args: Tree) -> Tree:
    """`program` with one more batch of `size` maps in the last axis, chunk by chunk; in the result it is the first axis.

    `mapped` says which leaves of `args`, the params and the rest, have the batch axis. A chunk takes as many steps as its
    longest map, so maps are sorted by their work.
    """
    leaves, tree = jax.tree.flatten(args)
    yes = jax.tree.leaves(mapped)
    step = cast("TrailingStep", loop.step)
    chunk = min(size, step.together)
    chunks = -(-size // chunk)
    chunk = -(-size // chunks)

    def one_chunk(part: list[jax.Array]) -> Tree:
        own = iter(part)

        def batch_last(x: jax.Array, batched: bool) -> jax.Array:
            if batched:
                x = jnp.moveaxis(next(own), 0, -1)
            else:
                x = jnp.broadcast_to(jnp.asarray(x)[..., None], (*jnp.shape(x), chunk))
            return x.reshape(*x.shape[:-2], loop.width * chunk) if loop.width else x

        params, rest = jax.tree.unflatten(tree, [batch_last(x, y) for x, y in zip(leaves, yes, strict=True)])
        with jax.numpy_rank_promotion("allow"):  # what belongs to one map, [B], meets maps [m, m, B]: that is the layout
            out = batched(program, replace(loop, width=max(loop.width, 1) * chunk), params, *rest)
        if loop.width:
            out = jax.tree.map(lambda x: x.reshape(*x.shape[:-1], loop.width, chunk), out)
        return jax.tree.map(lambda x: jnp.moveaxis(x, -1, 0), out)

    batch = [x for x, y in zip(leaves, yes, strict=True) if y]
    if chunks == 1:
        return one_chunk(batch)
    extra = chunks * chunk - size
    order = place = jnp.arange(size)
    if loop.done is not None:
        axes = jax.tree.map(lambda y: 0 if y else None, mapped[0])
        work = jax.vmap(step.work, in_axes=(axes,), axis_size=size)(args[0])
        order = jnp.argsort(jnp.max(work.reshape(size, -1), axis=1))
        place = jnp.argsort(order)
    order = jnp.concatenate([order, jnp.broadcast_to(order[-1:], (extra,))])
    out = lax.map(one_chunk, [x[order].reshape(chunks, chunk, *x.shape[1:]) for x in batch])
    return jax.tree.map(lambda x: x.reshape(chunks * chunk, *x.shape[2:])[place], out)


def run(loop: Loop, params: Tree, state: Tree) -> tuple[Tree, Tree]:
    """Runs the loop: the last state, and the number of steps."""

    def advance(carry: Tree) -> Tree:
        state, k, count, ended = carry
        state = loop.keep(ended, state, advanced(loop.step, params, k, state))
        k, count = k + 1, count + (~ended).astype(jnp.int32)
        return state, k, count, ended | loop.ended(params, k, state)

    zero = jnp.int32(0)
    ended = loop.ended(params, zero, state)
    state, _, count, _ = lax.while_loop(
        lambda c: ~jnp.all(c[3]), advance, (state, zero, jnp.zeros(ended.shape, jnp.int32), ended)
    )
    return state, loop.taken(count)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Memory:
    """States of a long loop that the forward pass kept.

    Attributes:
        places: the steps before which they were, -1 for a free slot.
        saved: these states.
    """

    places: jax.Array
    saved: Tree


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Forward:
    """A loop that ran, as reverse mode needs it.

    Attributes:
        end: the last state.
        count: the number of steps that each map took, or None where all take `Loop.bound`.
        tape: what step k recorded in place k % `Loop.room`, for the last `Loop.room` steps.
        memory: earlier states, or None where the tape holds every step.
    """

    end: Tree
    count: jax.Array | None
    tape: Tree
    memory: Memory | None


def record(loop: Loop, params: Tree, state: Tree) -> Forward:
    """Runs the loop, and keeps what reverse mode needs."""

    def advance(carry: Tree) -> Tree:
        state, k, count, ended, tape = carry
        new, record = recorded(loop.step, params, k, state)
        tape = loop.put(tape, k % loop.room, record)
        state = loop.keep(ended, state, new)
        k, count = k + 1, count + (~ended).astype(jnp.int32)
        return state, k, count, ended | loop.ended(params, k, state), tape

    def stretch(carry: Tree) -> Tree:
        carry, stride, memory = carry
        places, saved = memory.places, memory.saved
        k = carry[1]
        full = jnp.sum(places >= 0) == KEPT
        stride = jnp.where(full, 2 * stride, stride)
        places = jnp.where(places % stride == 0, places, -1)
        slot = jnp.argmin(places)
        saved = loop.put(saved, slot, carry[0])
        places = places.at[slot].set(jnp.where(k % stride == 0, k, -1))
        carry = lax.while_loop(lambda c: (c[1] < k + loop.room) & ~jnp.all(c[3]), advance, carry)
        return carry, stride, Memory(places, saved)

    zero = jnp.int32(0)
    ended = loop.ended(params, zero, state)
    _, record = jax.eval_shape(partial(recorded, loop.step), params, zero, state)
    carry = (state, zero, jnp.zeros(ended.shape, jnp.int32), ended, loop.blank(loop.room, record))
    if loop.bound <= loop.room:
        state, _, count, _, tape = lax.while_loop(lambda c: ~jnp.all(c[3]), advance, carry)
        return Forward(state, loop.taken(count), tape, None)
    slots = min(-(-loop.bound // loop.room), KEPT + SPARE)
    memory = Memory(jnp.full(slots, -1, jnp.int32), loop.blank(slots, state))
    (state, _, count, _, tape), _, memory = lax.while_loop(
        lambda c: ~jnp.all(c[0][3]), stretch, (carry, jnp.int32(loop.room), memory)
    )
    places = jnp.broadcast_to(memory.places, (*jax.tree.leaves(state)[0].shape[: loop.batch_axes], slots))
    places = loop.for_each_map(places)
    return Forward(state, loop.taken(count), tape, Memory(places, memory.saved))


def jvp(loop: Loop, params: Tree, state: Tree, count: jax.Array | None, dparams: Tree, dstate: Tree) -> Tree:
    """The jvp of the loop: the tangent of the last state. Computes the steps again."""

    def one(k: jax.Array, carry: Tree) -> Tree:
        x, dx = carry
        new, record = recorded(loop.step, params, k, x)
        dnew = tangent(loop.step, params, k, record, dparams, dx)
        return loop.keep(loop.beyond(k, count), carry, (new, dnew))

    return lax.fori_loop(0, loop.total(count), one, (state, dstate))[1]


def vjp(
    loop: Loop, params: Tree, count: jax.Array | None, tape: Tree, memory: Memory | None, cotangent: Tree
) -> tuple[Tree, Tree]:
    """The vjp of the loop: the cotangents of params and of the first state, computed from the last step backwards.

    `tape` and `memory` are those of `record`. Records that are no longer on the tape are computed anew from the last state
    kept before them. Where that state lies far back, a state halfway is kept first, as long as there is a free slot.
    """
    total = loop.total(count)

    def backwards(first: jax.Array, end: jax.Array, tape: Tree, carry: Tree) -> Tree:
        """The cotangents before step `first`, from `carry`, those before step `end`; the tape holds the steps between."""

        def one(j: jax.Array, carry: Tree) -> Tree:
            # The record is part of what is carried: XLA would fetch it anew for all that uses it.
            (cf, cx), record = carry
            k = end - 1 - j
            df, dx = cotangents(loop.step, params, k, record, cx)
            carry = loop.keep(loop.beyond(k, count), (cf, cx), (jax.tree.map(jnp.add, cf, df), dx))
            return carry, loop.get(tape, (k - 1) % loop.room)

        return lax.fori_loop(0, end - first, one, (carry, loop.get(tape, (end - 1) % loop.room)))[0]

    floats = jax.eval_shape(partial(cotangents, loop.step), params, total, loop.get(tape, jnp.int32(0)), cotangent)[0]
    carry = (jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), floats), cotangent)
    if loop.bound <= loop.room:
        return backwards(jnp.int32(0), total, tape, carry)

    def again(k: jax.Array, c: Tree) -> Tree:
        new, record = recorded(loop.step, params, k, c[0])
        return loop.keep(loop.beyond(k, count), c[0], new), loop.put(c[1], k % loop.room, record)

    def stretch(c: Tree) -> Tree:
        # The steps from `end` on are done; `fresh` is whether the tape still is that of the forward pass.
        end, fresh, places, saved, tape, carry = c
        before = jnp.where(places < end, places, -1)
        slot, place, free = jnp.argmax(before), jnp.max(before), jnp.argmin(places)
        gap = end - place
        halve = ~fresh & (gap > loop.room) & (places[free] < 0)
        goal = jnp.where(halve, place + loop.room * ((gap + 2 * loop.room - 1) // (2 * loop.room)), end)
        state, tape = lax.fori_loop(jnp.where(fresh, goal, place), goal, again, (loop.get(saved, slot), tape))
        saved = lax.fori_loop(0, halve.astype(jnp.int32), lambda _, saved: loop.put(saved, free, state), saved)
        places = places.at[free].set(jnp.where(halve, goal, places[free]))
        first = jnp.where(halve, end, jnp.maximum(end - loop.room, jnp.where(fresh, 0, place)))
        carry = backwards(first, end, tape, carry)
        return first, jnp.zeros((), bool), jnp.where(places < first, places, -1), saved, tape, carry

    assert memory is not None
    places = memory.places
    places = places[:, 0] if loop.width else places.reshape(-1, places.shape[-1])[0]
    start = (total, jnp.ones((), bool), places, memory.saved, tape, carry)
    return lax.while_loop(lambda c: c[0] > 0, stretch, start)[-1]
