"""A* by whole layers: thousands of states are expanded, bounded and compared in one compiled call.

A tool walks over a graph of cells and digs each cell that it enters; the shortest walk that digs exactly the goal is sought
(arXiv:1908.02745, "Single Stroke"). A state is the tool's cell and the set of dug cells, held as bits. A step raises
f = g + h by 0, 1 or 2, so no heap is needed: the states of one f lie in a stack on the host, a chunk of them goes to the
device, and their children come back sorted by how much f rose. A table on the device remembers the states expanded. It may
forget some, which costs only time: a state is dropped if, and only if, the very same one was expanded before, at the same f
or a lower one, so with no more steps. Hence a goal that is taken up at f is reached in f steps, and in no fewer.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

from jaxsand.planning.binary.graph import Graph

_RISES = 3
_UNSPLIT = {"xla_disable_hlo_passes": "cpu-parallel-task-assigner"}  # a third faster on a CPU than many short parallel loops


# h [n] int32 of the tool's cell [n] and the dug cells [n, words]: admissible, and a step changes it by 1 at most.
Bound = Callable[[Graph, jax.Array, jax.Array], jax.Array]


@dataclass(frozen=True)
class Layered:
    """What a search by layers found.

    Attributes:
      walk: the cells passed, the start included; None where the search stopped at its limits.
      lower_bound: no walk takes fewer steps.
      expanded: how many states were expanded.
      opened: how many neighbours were looked at.
    """

    walk: tuple[int, ...] | None
    lower_bound: int
    expanded: int
    opened: int

    @property
    def optimal(self) -> bool:
        """Whether the walk was found, and so is proven shortest."""
        return self.walk is not None

    @property
    def steps(self) -> int | None:
        """The number of steps of the walk; None where there is none."""
        return None if self.walk is None else len(self.walk) - 1


def misdug(graph: Graph, cell: jax.Array, dug: jax.Array) -> jax.Array:
    """h = (goal cells not dug) + (other cells dug) [n], the paper's estimate.

    A step digs one cell at most and mends none: f rises by 0 (a goal cell dug), 1 (nothing dug) or 2 (a wrong one).
    """
    return _count(dug ^ graph.goal[None])


def two_colours(graph: Graph, cell: jax.Array, dug: jax.Array) -> jax.Array:
    """h = max(2 o - 1, 2 s) [n], where s and o goal cells are left of the tool's colour and of the other.

    Admissible: colours alternate along a walk, so the cells of the other colour are entered at steps 1, 3, ..., 2 o - 1 at
    the earliest, those of the tool's at 2, 4, ..., 2 s. A step that digs leaves max(2 s - 1, 2 o - 2) = h - 1, so f stays;
    any other leaves max(2 s - 1, 2 o): f rises by 2 if o > s, by 1 if o = s, and stays if o < s.
    """
    left = ~dug & graph.goal[None]
    odd = _count(left & graph.odd[None])
    on_odd = (graph.odd[cell >> 5] >> (cell & 31).astype(jnp.uint32)) & jnp.uint32(1)
    same = jnp.where(on_odd == 1, odd, _count(left) - odd)
    return jnp.maximum(2 * (_count(left) - same) - 1, 2 * same)


def layered(
    graph: Graph, bound: Bound, *, limit: int = 1 << 27, memory: int = 1 << 30, slots: int = 1 << 19, chunk: int = 1 << 13
) -> Layered:
    """The shortest walk over a graph, proven, by A* over whole layers.

    Args:
      graph: cells, goal and start.
      bound: the estimate h: admissible, and changed by at most 1 in a step.
      limit: expansions after which it stops, with a lower bound but no walk.
      memory: bytes of the host that waiting states may take before it stops.
      slots: states that the device remembers; a long search that forgets many expands some again.
      chunk: states that a call expands at most. Few reach the goal sooner; many are expanded faster, above all on a GPU.

    Raises:
      ValueError: for `limit`, `slots` or `chunk` out of range, and a bound that breaks its contract.
    """
    if not 0 < limit <= 1 << 27:
        raise ValueError(f"limit: got {limit}; give 1 to {1 << 27}")
    if slots & (slots - 1) or chunk & (chunk - 1) or not 512 <= chunk <= slots <= 1 << 30:
        raise ValueError(f"chunk, slots: got {chunk}, {slots}; give powers of two, 512 <= chunk <= slots")
    words = len(graph.goal)
    root = np.zeros((1, words + 2), np.uint32)
    root[0, 0] = graph.start
    root[0, 1 + graph.start // 32] = 1 << (graph.start % 32)
    on_device = jax.device_put(graph)
    f = int(jax.jit(bound)(on_device, root[:, 0].astype(np.int32), root[:, 1:-1])[0])
    table = jnp.zeros((slots, words + 1), jnp.uint32)
    stacks = [_Stack(), _Stack(), _Stack()]
    sizes = chunk // 64, chunk // 8, chunk
    stacks[0].push(root)
    origins: list[np.ndarray] = []
    taken = expanded = opened = 0
    while expanded < limit and sum(stack.size for stack in stacks) * root.nbytes <= memory:
        while not stacks[0].size:
            stacks, f = [*stacks[1:], _Stack()], f + 1
        size = next(size for size in sizes if size >= min(stacks[0].size, chunk))
        rows = np.zeros((size, words + 2), np.uint32)
        live = stacks[0].pop(rows[: limit - expanded])
        origins.append(rows[:live, -1].copy())
        table, children, counts = _expand(table, on_device, rows, bound=bound)
        *ends, goal, looked_at, new = np.asarray(counts).tolist()
        expanded += new
        opened += looked_at
        if ends[-1] != looked_at:
            raise ValueError("bound: got an estimate that changes by more than 1 in a step")
        if goal >= 0:
            return Layered(_walk(graph, np.concatenate(origins), taken + goal), f, expanded, opened)
        found = np.asarray(children)
        for stack, a, b in zip(stacks, [0, *ends], ends, strict=False):
            part = found[a:b].copy()
            part[:, -1] += np.uint32(taken << 2)
            stack.push(part)
        taken += live
    return Layered(None, f, expanded, opened)


@dataclass
class _Stack:
    """States that wait, [size, words + 2] in parts."""

    parts: list[np.ndarray] = field(default_factory=list)
    size: int = 0

    def push(self, rows: np.ndarray) -> None:
        if len(rows):
            self.parts.append(rows)
            self.size += len(rows)

    def pop(self, rows: np.ndarray) -> int:
        """Fills `rows` with states from the top, and returns how many there were."""
        got = 0
        while got < len(rows) and self.parts:
            part = self.parts.pop()
            keep = max(len(part) - (len(rows) - got), 0)
            rows[got : got + len(part) - keep] = part[keep:]
            got += len(part) - keep
            if keep:
                self.parts.append(part[:keep])
        self.size -= got
        return got


def _walk(graph: Graph, origins: np.ndarray, last: int) -> tuple[int, ...]:
    """The cells from the start to the state that was expanded as number `last`."""
    moves = []
    while last:
        moves.append(int(origins[last]) & 3)
        last = int(origins[last]) >> 2
    walk = [int(graph.start)]
    for move in reversed(moves):
        walk.append(int(graph.near[walk[-1], move]))
    return tuple(walk)


@partial(jax.jit, static_argnames="bound", donate_argnames="table", compiler_options=_UNSPLIT)
def _expand(table: jax.Array, graph: Graph, rows: jax.Array, *, bound: Bound) -> tuple[jax.Array, jax.Array, jax.Array]:
    """The children of those states `rows` [n, words + 2] that are new, in order of the rise of f.

    A row holds the cell, the dug cells as bits (none in a row to be skipped), and where the state comes from: its parent's
    number, here the row's, times 4 plus the move. `table` [slots, words + 1] holds rows without the last column.

    Returns:
      The table, the children [4 n, words + 2], and six counts: where the children of each rise end [3], the row of the goal
      or -1, the neighbours looked at, the new states.
    """
    n, slots = len(rows), len(table)
    cell, dug, key = rows[:, 0].astype(jnp.int32), rows[:, 1:-1], rows[:, :-1]
    slot = (_hash(cell, dug) & jnp.uint32(slots - 1)).astype(jnp.int32)
    new = jnp.any(dug != 0, axis=1) & jnp.any(table[slot] != key, axis=1)
    # Of the new states that share a place in the ring one, the owner, goes into the table: no slot is written twice.
    ring = min(slots, 8 * n)
    index = jnp.arange(n, dtype=jnp.int32)
    owner = jnp.zeros(ring, jnp.int32).at[jnp.where(new, slot & (ring - 1), ring)].set(index, mode="drop")
    owner = owner[slot & (ring - 1)]
    owns = new & (owner == index)
    new = owns | (new & jnp.any(key[owner] != key, axis=1))
    table = table.at[jnp.where(owns, slot, slots)].set(key, mode="drop")
    goal = new & jnp.all(dug == graph.goal[None], axis=1)

    to = graph.near[cell].reshape(-1)
    there = (to >= 0) & jnp.repeat(new, 4)
    to = jnp.maximum(to, 0)
    bit = jnp.uint32(1) << (to & 31).astype(jnp.uint32)
    at = (to >> 5)[:, None] == jnp.arange(dug.shape[1], dtype=jnp.int32)[None]
    then = jnp.repeat(dug, 4, axis=0) | jnp.where(at, bit[:, None], jnp.uint32(0))
    rise = 1 + bound(graph, to, then) - jnp.repeat(bound(graph, cell, dug), 4)
    before, ends = _ranks(there[None] & (rise[None] == jnp.arange(_RISES, dtype=jnp.int32)[:, None]))
    place = jnp.select([rise == r for r in range(_RISES)], list(before), 4 * n)
    out = jnp.concatenate([to.astype(jnp.uint32)[:, None], then, jnp.arange(4 * n, dtype=jnp.uint32)[:, None]], axis=1)
    children = jnp.zeros_like(out).at[jnp.where(there, place, 4 * n)].set(out, mode="drop")
    first = jnp.where(jnp.any(goal), jnp.argmax(goal).astype(jnp.int32), -1)
    counts = [first, jnp.sum(there, dtype=jnp.int32), jnp.sum(new, dtype=jnp.int32)]
    return table, children, jnp.concatenate([ends, jnp.stack(counts)])


def _count(words: jax.Array) -> jax.Array:
    """The number of bits set in the words along the last axis."""
    return jnp.sum(jax.lax.population_count(words).astype(jnp.int32), axis=-1, dtype=jnp.int32)


def _hash(cell: jax.Array, dug: jax.Array) -> jax.Array:
    h = cell.astype(jnp.uint32) * jnp.uint32(0x9E3779B1)
    for i in range(dug.shape[1]):
        h = (h ^ dug[:, i]) * jnp.uint32(0x85EBCA6B)
        h = h ^ (h >> 15)
    h = h * jnp.uint32(0xC2B2AE35)
    return h ^ (h >> 16)


def _ranks(masks: jax.Array) -> tuple[jax.Array, jax.Array]:
    """For every true entry of masks [k, n] how many come before it, row after row [k, n]; and how many up to each row's end
    [k].
    """
    lane = jnp.arange(32, dtype=jnp.uint32)[None]
    word = jnp.sum(masks.reshape(-1, 32).astype(jnp.uint32) << lane, axis=1, dtype=jnp.uint32)
    ends = jnp.cumsum(jax.lax.population_count(word).astype(jnp.int32), dtype=jnp.int32)
    lower = jax.lax.population_count(word[:, None] & ((jnp.uint32(1) << lane) - 1)).astype(jnp.int32)
    before = (ends - jax.lax.population_count(word).astype(jnp.int32))[:, None] + lower
    return before.reshape(masks.shape), ends.reshape(len(masks), -1)[:, -1]
