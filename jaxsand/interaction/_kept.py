"""What is known at the end of a leg of how sand flows around the tool, kept for the next leg.

A sub-step brings sand to rest from a guess, the fluxes of the one before (resting.py). Without them a path of many short
legs would begin each from nothing, and leave less settled sand than one long leg. The next leg has another heading, hence
another frame, and another block. So fluxes are laid on the map: mirrored and swapped from the frame of one leg to the map's
own, and from there to the next one's, link by link.

A tool moves and turns; the two drive sand differently, so each is guessed from its own kind. A guess counts the less, the
less the new motion is like the one that it stems from: by the cosine of the angle between two legs, and by how far the tool
went between two turns.
"""

from dataclasses import dataclass
from typing import TypeVar

import jax
import jax.numpy as jnp

from jaxsand.interaction._block import Block, First
from jaxsand.interaction._frame import Frame, bounded
from jaxsand.relaxation.flux import Fluxes
from jaxsand.scene.grid import Neighbours, links

X = TypeVar("X")


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Laid:
    """Fluxes in a block of the map: as the map's own axes have them, from the block's first column and row on."""

    flux: Fluxes
    column: jax.Array
    row: jax.Array


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Kept:
    """How sand flowed in the last sub-step ahead and in the last of a turn.

    Attributes:
        ahead: fluxes of a whole sub-step ahead.
        turned: fluxes of a whole sub-step of a turn.
        sense: 1 if that turn was counter-clockwise, -1 if clockwise, 0 if there was none.
        since: how far the tool has moved since then (spacings).
    """

    ahead: Laid
    turned: Laid
    sense: jax.Array
    since: jax.Array


def lay(block: Block, frame: Frame, first: First, flux: Fluxes) -> Laid:
    """The fluxes of the block of a frame that begins at `first`."""
    flux = _mirrored(block.neighbours, _swapped(block.neighbours, flux, frame.swap), frame.flip_x, frame.flip_y)
    return Laid(flux, *_corner(block, frame, first))


def seen(block: Block, frame: Frame, first: First, laid: Laid) -> Fluxes:
    """The fluxes in the block of a frame that begins at `first`; 0 where nothing is known."""
    moved = laid.flux
    if block.follows or block.shape[0] != block.shape[1]:  # else the block is the map, in every frame
        column, row = _corner(block, frame, first)
        moved = bounded(tuple(_moved(_moved(f, row - laid.row, 0), column - laid.column, 1) for f in moved))
    return _swapped(block.neighbours, _mirrored(block.neighbours, moved, frame.flip_x, frame.flip_y), frame.swap)


def _corner(block: Block, frame: Frame, first: First) -> First:
    """The first column and row of a block on the map."""
    rows, columns = frame.shape
    column, row = jnp.where(frame.swap, first[1], first[0]), jnp.where(frame.swap, first[0], first[1])
    return (
        jnp.where(frame.flip_x, columns - block.size - column, column),
        jnp.where(frame.flip_y, rows - block.size - row, row),
    )


def _moved(x: jax.Array, by: jax.Array, axis: int) -> jax.Array:
    """The map from `by` rows or columns further on; 0 beyond its end."""
    index = jnp.arange(x.shape[axis], dtype=jnp.result_type(by)) + by
    index = jnp.where(index < 0, x.shape[axis], index)  # a negative index would count from the end
    return jnp.take(x, index, axis, mode="fill", fill_value=0)


def _mirrored(neighbours: Neighbours, flux: Fluxes, flip_x: jax.Array, flip_y: jax.Array) -> Fluxes:
    """The fluxes seen in a mirror or two."""
    for axis, flip in ((1, flip_x), (0, flip_y)):
        flux = _where(flip, _reversed(neighbours, flux, axis), flux)
    return flux


def _reversed(neighbours: Neighbours, flux: Fluxes, axis: int) -> Fluxes:
    flux = tuple(jnp.flip(f, axis) for f in flux)
    if neighbours == "isotropic":  # x and y of four gradients, from the west or east and the south or north
        other = 2 if axis else 1
        turned = [flux[2 * (n ^ other) + part] for n in range(4) for part in (0, 1)]
        return (*(-f if part % 2 == 1 - axis else f for part, f in enumerate(turned)), *flux[8:])
    return _relinked(neighbours, flux, (1, -1) if axis else (-1, 1), False)


def _swapped(neighbours: Neighbours, flux: Fluxes, swap: jax.Array) -> Fluxes:
    """The fluxes with x and y swapped, if `swap`."""
    turned = tuple(jnp.swapaxes(f, 0, 1) for f in flux)
    if neighbours == "isotropic":
        other = (0, 2, 1, 3)
        return _where(swap, (*(turned[2 * other[n] + 1 - part] for n in range(4) for part in (0, 1)), *turned[8:]), flux)
    return _where(swap, _relinked(neighbours, turned, (1, 1), True), flux)


def _relinked(neighbours: Neighbours, flux: Fluxes, signs: tuple[int, int], swap: bool) -> Fluxes:
    """The fluxes by the directions that links have once rows and columns are counted the other way or swapped."""
    ways = [(di, dj) for di, dj, _ in links(neighbours)]
    out = []
    for di, dj in ways:
        way = (dj, di) if swap else (signs[0] * di, signs[1] * dj)
        out.append(flux[ways.index(way)] if way in ways else -flux[ways.index((-way[0], -way[1]))])
    return (*out, *flux[len(ways) :])


def _where(condition: jax.Array, yes: Fluxes, no: Fluxes) -> Fluxes:
    # The shapes of the two agree, since blocks are square.
    return tuple(jnp.where(condition, a, b) for a, b in zip(yes, no, strict=True))
