"""A window's block: which of its cells are watched, and how it is cut out and pasted back."""

import jax.numpy as jnp
import numpy as np
import pytest

import jaxsand as js
from jaxsand.scene.window import cut, near_edge, origin, paste

SHAPE, WINDOW = (9, 10), js.Window((6, 5))


@pytest.mark.parametrize(
    ("first", "rows", "columns"),
    [
        ((2, 3), {0, 1, 4, 5}, {0, 1, 3, 4}),  # in the middle
        ((0, 0), {4, 5}, {3, 4}),  # at the map's lower left corner, whose own edges are no window's
        ((3, 5), {0, 1}, {0, 1}),  # at its upper right one
    ],
)
def test_two_cells_beside_each_edge_that_is_not_the_maps_are_watched(first, rows, columns):
    near = near_edge(WINDOW, SHAPE, [jnp.int32(n) for n in first])
    expected = [[i in rows or j in columns for j in range(5)] for i in range(6)]
    np.testing.assert_array_equal(near, expected)


def test_a_block_stays_on_the_map_and_is_pasted_where_it_was_cut():
    maps = jnp.arange(90.0).reshape(SHAPE)
    for centre, first in (((4.2, 5.9), (1, 3)), ((-3.0, 99.0), (0, 5))):
        start = origin(WINDOW, SHAPE, tuple(jnp.asarray(c) for c in centre))
        assert [int(n) for n in start] == [*first]
        block = cut(WINDOW, SHAPE, start, maps)
        np.testing.assert_array_equal(block, maps[first[0] : first[0] + 6, first[1] : first[1] + 5])
        np.testing.assert_array_equal(paste(start, maps, block), maps)
        assert float(jnp.abs(paste(start, maps, -block) - maps).sum()) == pytest.approx(2 * float(block.sum()))
