"""Where cells lie."""

import numpy as np

from jaxsand.scene.grid import Grid, centres


def test_cells_are_centred_half_a_spacing_from_the_border():
    x, y = centres(Grid(0.5, (2, 3)), "float64")
    np.testing.assert_array_equal(x, [[0.25, 0.75, 1.25]])
    np.testing.assert_array_equal(y, [[0.25], [0.75]])
