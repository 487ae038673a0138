"""Runs batches of maps on every core, in chunks that stay in a core's cache.

The maps of a chunk are swept together until only one in eight of them still moves. Those are set aside, and new chunks are
made of them. So a slow map costs its own sweeps and not those of its neighbours. Every map is swept as it would be alone.
"""

import math
import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from jaxsand.autodiff.while_loop import Tree
from jaxsand.relaxation._integrate import SweepLoop
from jaxsand.relaxation.ghost_cells import ExactSum
from jaxsand.relaxation.sweep import Swept

_CELLS = 65_536  # cells in a chunk, whose sweep then works in a core's cache
_LEFT = 8  # a chunk stops when one in so many of its maps still moves


def loop_batch(
    loop: SweepLoop,
    groups: int,
    enter: Callable[[jax.Array, ExactSum | None], Swept],
    judge: Callable[[jax.Array, Swept, jax.Array], Tree],
    height: jax.Array,
    lost: ExactSum | None,
    chunk: int,
) -> Tree:
    """`SweepLoop.run` for every map of a batch [B, H, W], B a multiple of the chunk.

    `enter(height, lost)` makes the sand of a map; `judge(height, sand, sweeps)` makes its result, which has a `height`.
    """
    total = height.shape[0]
    run = partial(_together, loop, groups, enter, judge)
    fresh = (height, lost, jnp.zeros(total, jnp.int32), jnp.zeros(total, bool))
    chunks = jax.tree.map(lambda x: x.reshape(-1, chunk, *x.shape[1:]), fresh)
    state = lax.map(lambda some: run(total > chunk, *some), chunks)
    state = jax.tree.map(lambda x: x.reshape(total, *x.shape[2:]), state)
    if total > chunk:
        state = lax.while_loop(lambda s: ~jnp.all(s[3]), partial(_left_over, run, chunk), state)
    return state[0]


def _left_over(run: Callable[..., Tree], chunk: int, state: Tree) -> Tree:
    """The state after chunks of the maps that still move were swept once more until few are left."""
    _, _, taken, ended = state
    order = jnp.argsort(jnp.where(ended, jnp.iinfo(jnp.int32).max, taken))
    left = jnp.sum(~ended)

    def one(i: jax.Array, state: Tree) -> Tree:
        who = lax.dynamic_slice(order, (i * chunk,), (chunk,))
        judged, *rest = jax.tree.map(lambda x: x[who], state)
        after = run(left > chunk, judged.height, *rest)
        return jax.tree.map(lambda x, y: x.at[who].set(y, unique_indices=True), state, after)

    return lax.fori_loop(0, (left + chunk - 1) // chunk, one, state)


def _together(
    loop: SweepLoop,
    groups: int,
    enter: Callable[[jax.Array, ExactSum | None], Swept],
    judge: Callable[[jax.Array, Swept, jax.Array], Tree],
    others: jax.Array | bool,
    height: jax.Array,
    lost: ExactSum | None,
    taken: jax.Array,
    ended: jax.Array,
) -> Tree:
    """Sweeps the maps of a chunk until all are still; where there are `others` to join, until all but a few are.

    Returns for each map its result, what it lost, the number of groups of sweeps, and whether it has ended.
    """
    few = ended.shape[0] // _LEFT

    def look(k: jax.Array, moving: Tree) -> jax.Array:
        return (k >= groups) | loop.done(loop.params, k, moving)

    def goes_on(carry: Tree) -> jax.Array:
        _, _, taken, ended = carry
        aside = others & (jnp.sum(~ended) <= few) & jnp.all(ended | jax.vmap(loop.between)(taken))
        return ~jnp.all(ended) & ~aside

    def advance(carry: Tree) -> Tree:
        moving, sand, taken, ended = carry
        moving = jax.vmap(partial(loop.body, loop.params))(taken, moving)
        sand = jax.tree.map(
            lambda x, y: jnp.where(ended.reshape(-1, *[1] * (x.ndim - 1)), x, y), sand, Swept(moving.height, moving.lost)
        )
        taken = taken + (~ended).astype(taken.dtype)
        return moving, sand, taken, ended | jax.vmap(look)(taken, moving)

    sand = jax.vmap(enter)(height, lost)
    moving = jax.vmap(loop.begin)(sand)
    ended = ended | jax.vmap(look)(taken, moving)
    _, sand, taken, ended = lax.while_loop(goes_on, advance, (moving, sand, taken, ended))
    return jax.vmap(judge)(height, sand, taken * loop.interval), sand.lost, taken, ended


def on_all_cores(run: Callable[..., Tree], others: Tree, batch: Tree, chunk: int | None) -> Tree:
    """`run(others, batch, chunk=...)` on every core; each takes a part of the batch [B, ...], in chunks of one size."""
    leaves = jax.tree.leaves(batch)
    _refuse_tracers(jax.tree.leaves((batch, others)))
    total = leaves[0].shape[0]
    if chunk is None:
        chunk = max(1, _CELLS // math.prod(leaves[0].shape[1:])) if _on_cpu() else total
    pieces = -(-total // chunk)
    threads = min(cores(), pieces)
    pieces = -(-pieces // threads) * threads
    width = -(-total // pieces)
    extra = pieces * width - total
    if extra:
        batch = jax.tree.map(lambda x: jnp.concatenate([x, jnp.repeat(x[-1:], extra, axis=0)]), batch)
    if threads == 1:
        out = run(others, batch, chunk=width)
    else:
        x64 = jnp.result_type(float) == jnp.float64  # which may hold for this thread alone

        def part(one: Tree) -> Tree:
            with jax.enable_x64(x64):
                return jax.block_until_ready(run(others, one, chunk=width))

        size = (total + extra) // threads
        parts = [jax.tree.map(lambda x, i=i: x[i * size : (i + 1) * size], batch) for i in range(threads)]
        with ThreadPoolExecutor(threads) as pool:
            outs = list(pool.map(part, parts))
        out = jax.tree.map(lambda *x: jnp.concatenate(x), *outs)
    return jax.tree.map(lambda x: x[:total], out) if extra else out


SIZES = {4: 0.65, 16: 1.0, 64: 3.3}
"""Sizes of groups on a CPU, and how long pushes of so many maps take on a core, over those of 16. There are few, so that few
programs are compiled; 8 maps take longer than 16, and 32 little less than twice 16."""


def in_groups(run: Callable[[Tree], Tree], batch: Tree, cost: Callable[[Tree], np.ndarray], chunk: int | None) -> Tree:
    """`run` on groups of a batch [B, ...] of like cost, the most expensive first; each free core takes the next group.

    The last group is filled up with copies. On a CPU parts are picked and joined by NumPy, which compiles nothing for any
    number of maps, and the results are NumPy's.
    """
    batch = on_host(batch)
    total = jax.tree.leaves(batch)[0].shape[0]
    size = group_size(total, chunk)
    order = np.argsort(-np.nan_to_num(cost(batch), posinf=0, neginf=0), kind="stable")
    extra = -total % size
    filled = np.concatenate([order, np.repeat(order[-1:], extra)]).reshape(-1, size)
    x64 = jnp.result_type(float) == jnp.float64  # which may hold for this thread alone

    def part(who: np.ndarray) -> Tree:
        with jax.enable_x64(x64):
            return on_host(jax.block_until_ready(run(jax.tree.map(lambda x: x[who], batch))))

    with ThreadPoolExecutor(min(cores(), len(filled))) as pool:
        outs = list(pool.map(part, filled))
    join = np.concatenate if _on_cpu() else jnp.concatenate
    back = np.argsort(order)
    return jax.tree.map(lambda *x: join(x)[back], *outs)


def on_host(tree: Tree) -> Tree:
    """The arrays of a pytree, on a CPU as NumPy's: there JAX takes as long to pick or join a few maps as to push them.

    Raises:
      ValueError: inside `jit`, `grad` or `vmap`.
    """
    _refuse_tracers(jax.tree.leaves(tree))
    return jax.tree.map(np.asarray, tree) if _on_cpu() else tree


def group_size(total: int, chunk: int | None) -> int:
    """The number of maps of a batch that are pushed together."""
    if chunk is not None:
        return min(chunk, next((size for size in SIZES if size >= total), chunk))
    if not _on_cpu():
        return 1 << max(0, total - 1).bit_length()
    return min(SIZES, key=lambda size: math.ceil(math.ceil(total / size) / cores()) * SIZES[size])


def _refuse_tracers(leaves: list[object]) -> None:
    if any(isinstance(leaf, jax.core.Tracer) for leaf in leaves):
        raise ValueError(
            "settle_batch, step_batch and their like are outermost programs: inside jit, grad or vmap use jax.vmap of "
            "settle or step"
        )


def in_turns(runs: Sequence[Callable[[slice | np.ndarray], Tree]], flagged: Callable[[Tree], jax.Array]) -> Tree:
    """The results of the first of `runs` for a batch; those that `flagged` marks are replaced by the second's, and so on.

    A run is a function of the indices of maps that returns their results.
    """
    out = runs[0](slice(None))
    for run in runs[1:]:
        left = np.flatnonzero(flagged(out))
        if not left.size:
            break
        out = jax.tree.map(partial(_replaced, left), out, run(left))
    return out


def _replaced(where: np.ndarray, x: jax.Array | np.ndarray, y: jax.Array | np.ndarray) -> jax.Array | np.ndarray:
    """An array with other rows [where]."""
    if isinstance(x, jax.Array):
        return x.at[where].set(y)
    x[where] = y
    return x


def cores() -> int:
    """The number of cores to compute on; 1 on an accelerator."""
    return processors() if _on_cpu() else 1


def processors() -> int:
    """The number of the CPU's cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def wide_vectors() -> dict[str, int]:
    """Compiler options for the outermost programs: 512-bit vectors where the CPU has them."""
    return {"xla_cpu_prefer_vector_width": 512} if _on_cpu() else {}


def _on_cpu() -> bool:
    return jax.default_backend() == "cpu"
