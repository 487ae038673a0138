"""A lower bound of the steps that a walk still needs, from the tree of the graph's blocks, with its proof.

A walk from p over all cells of a set U, seen as the multigraph of the edges it uses, is connected, and only its two ends
have odd degree. Let the blocks (2-connected parts and bridges) hang from p in their tree; let B be a block with cells of U
in it or below it, and g its gate, the cell towards p. The part of the walk inside B is connected (what leaves B through a
cell comes back through it), holds g and the set R of those other cells of B that are in U or have cells of U below them, and
has even degrees, but for g and v if the walk's end lies in or below v. So it is itself a walk over R inside B, closed or
from g to v, and the length is the sum over blocks. With k_o and k_s the number of cells in R of the other and of the same
colour as g (every step changes colour), such a part takes at least

- a bridge: 2 steps, and 1 if open;
- closed: 2 m steps visit each colour m times, so m >= k_o, m >= k_s + 1, and m is at least the way to R's farthest cell x;
- open, L steps: (L + 1) / 2, rounded down, visits to the other colour and L / 2, rounded down, to g's own after g itself.
  v of the other colour makes L odd, so L >= max(2 k_o - 1, 2 k_s + 1); v of the same makes L >= 2 max(k_o, k_s). And L is
  at least the way from g to x and on to v.

The open parts lie on one path down the tree. If the walk is as short as can be, it ends on a cell of U, so that v is in R.
The bound takes the path on which open parts save most over closed ones; every term being a lower bound, so is their sum.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

from jaxsand.planning.binary.board import Board, GraphBlock, Hanging, blocks_of, hang

BlockBound = Callable[[int, int], int]
_NEVER = -(10**9)


@dataclass(frozen=True, slots=True)
class _Part:
    """A block below its gate, its sets of cells as bits.

    Attributes:
      bridge: whether the block is a bridge.
      at_root: whether its gate is the root.
      own: its cells, without the gate.
      other, same: those of the other colour than the gate, and of the same.
      reach: its cells and all below them.
      below: for each cell with blocks below it, the cell, all cells below it, and the places of these blocks.
      rings: distance from the gate and the cells at that distance, farthest first.
    """

    bridge: bool
    at_root: bool
    own: int
    other: int
    same: int
    reach: int
    below: tuple[tuple[int, int, tuple[int, ...]], ...]
    rings: tuple[tuple[int, int], ...]


def block_bound(board: Board, end: int | None = None) -> BlockBound:
    """The bound as a function of the tool's cell and the cells left to dig (bits); with `end`, of walks that end there."""
    blocks = blocks_of(board.near)
    roots = max(16, 200_000 // len(board.cells))  # kept at a time: each takes as many bits as there are cells, squared
    parts = lru_cache(roots)(lambda root: _parts(board, hang(blocks, root), root))

    def bound(cell: int, left: int) -> int:
        target = 0 if end is None or end == cell else 1 << end
        needed = left | target
        total = 0
        best = _NEVER if target else 0
        saved: list[int] = []
        for part in parts(cell):
            if not needed & part.reach:
                saved.append(_NEVER)
                continue
            visit = needed & part.own
            beyond = {}
            for bit, reach, children in part.below:
                if needed & reach:
                    visit |= bit
                    beyond[bit] = max([saved[k] for k in children])
            if part.bridge:
                total += 2
                saving = 1 + _gain(visit, target, beyond)
            else:
                closed, saving = _block(board, part, visit, target, beyond)
                total += closed
            saved.append(saving)
            if part.at_root and saving > best:
                best = saving
        return total if cell == end else total - best

    return bound


def _gain(bit: int, target: int, beyond: dict[int, int]) -> int:
    """What is saved below a cell if the walk ends there or below it; `_NEVER` where a required end lies elsewhere."""
    below = beyond.get(bit, _NEVER)
    return below if target and bit != target else max(below, 0)


def _block(board: Board, part: _Part, visit: int, target: int, beyond: dict[int, int]) -> tuple[int, int]:
    """The bound of a closed part, and what an open one saves over it, with all below it."""
    k_other, k_same = (visit & part.other).bit_count(), (visit & part.same).bit_count()
    way, ring = next(ring for ring in part.rings if ring[1] & visit)
    farthest = (ring & visit).bit_length() - 1
    closed = 2 * max(k_other, k_same + 1, way)
    odd, even = max(2 * k_other - 1, 2 * k_same + 1), 2 * max(k_other, k_same)
    onwards = board.steps[farthest]
    saving, rest = _NEVER, visit
    while rest:
        bit = rest & -rest
        rest ^= bit
        opened = max(odd if bit & part.other else even, way + onwards[bit.bit_length() - 1])
        saving = max(saving, closed - opened + _gain(bit, target, beyond))
    return closed, saving


def _parts(board: Board, hung: list[Hanging], root: int) -> tuple[_Part, ...]:
    """The blocks hung from a root as `_Part`s, children before parents."""
    parts: list[_Part] = []
    for one in hung:
        block: GraphBlock = one.block
        own = sum(1 << v for v in block.cells if v != one.gate)
        below = tuple((1 << v, sum(parts[k].reach for k in children), children) for v, children in one.below)
        rings: dict[int, int] = {}
        for v in block.cells:
            if v != one.gate:
                rings[board.steps[one.gate][v]] = rings.get(board.steps[one.gate][v], 0) | 1 << v
        same = board.masks[board.colour[one.gate]] & own
        reach = own | sum(r for _, r, _ in below)
        parts.append(
            _Part(block.bridge, one.gate == root, own, own & ~same, same, reach, below, tuple(sorted(rings.items())[::-1]))
        )
    return tuple(parts)
