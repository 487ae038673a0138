"""Where a tool's footprint first meets a cell, against footprints sampled along the way."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads

from jaxsand.interaction.obstacles import free_way
from jaxsand.scene.grid import Grid

DX, N, FINE = 0.01, 12, 0.0005
GRID = Grid(DX, (N, N))
CELLS = np.zeros((N, N), bool)
CELLS[3:5, 8] = CELLS[9, 2:6] = CELLS[6, 6] = True
WIDTH, THICKNESS = 0.024, 0.013

way = jax.jit(
    lambda start, stop, cells=CELLS, width=WIDTH, thickness=THICKNESS: free_way(cells, GRID, start, stop, width, thickness)
)


def first_sampled(start, stop, width, thickness):
    """The way (m) to the first place where a fine lattice of the footprint's points has one in a cell."""
    run = stop - start
    length = np.hypot(*run)
    ahead = run / length
    aside = np.array([-ahead[1], ahead[0]])
    s, n = (np.linspace(-size / 2, size / 2, int(np.ceil(size / FINE)) + 1) for size in (thickness, width))
    points = s[:, None, None] * ahead + n[None, :, None] * aside
    for at in np.arange(0, length, FINE / 2):
        j, i = np.floor((start + at * ahead + points) / DX).astype(int).reshape(-1, 2).T
        on = (i >= 0) & (i < N) & (j >= 0) & (j < N)
        if CELLS[i[on], j[on]].any():
            return at
    return length


def test_it_is_between_what_finds_a_footprint_and_a_slightly_larger_one():
    rng = np.random.default_rng(3)
    met = 0
    for start, stop in rng.uniform(-0.02, N * DX + 0.02, (40, 2, 2)):
        length = np.hypot(*(stop - start))
        meets, share = way(start, stop)
        free = float(share) * length
        assert first_sampled(start, stop, WIDTH + 4 * FINE, THICKNESS + 4 * FINE) - FINE < free + 1e-12
        assert free < first_sampled(start, stop, WIDTH, THICKNESS) + 1e-12
        met += bool(meets) and free > 0
        assert bool(meets) == (float(share) < 1)
    assert met > 8


@pytest.mark.parametrize(
    ("start", "stop", "share"),
    [
        ((0.02, 0.065), (0.1, 0.065), 0.04 / 0.08 - THICKNESS / 2 / 0.08),  # straight at a cell
        ((0.1, 0.065), (0.02, 0.065), 0.03 / 0.08 - THICKNESS / 2 / 0.08),  # from the other side
        ((0.065, 0.02), (0.065, 0.06), 0.04 / 0.04 - THICKNESS / 2 / 0.04),  # along a column
        ((0.02, 0.02), (0.06, 0.02 - 1e-12), 1),  # all but level, past everything
        ((0.068, 0.065), (0.1, 0.065), 0),  # it comes down on a cell
        ((0.065, 0.065), (0.065, 0.065), 0),  # and so without a way
        ((0.02, 0.03), (0.02, 0.03), 1),
        ((0.02, 0.0779), (0.05, 0.0779), 1),  # its side is just below a row
        ((0.02, 0.0781), (0.05, 0.0781), 0),  # a little higher it would come down on one
        ((-3.0, 0.065), (3.0, 0.065), (3.06 - THICKNESS / 2) / 6),
    ],
)
def test_known_ways(start, stop, share):
    assert float(way(jnp.asarray(start), jnp.asarray(stop))[1]) == pytest.approx(share, abs=1e-9)


def test_turned_strokes_meet_turned_cells():
    rng = np.random.default_rng(4)
    side = N * DX
    for start, stop in rng.uniform(0, side, (12, 2, 2)):
        straight = way(start, stop)
        turned = way(*(np.array([side - p[1], p[0]]) for p in (start, stop)), np.rot90(CELLS, -1))
        assert float(turned[1]) == pytest.approx(float(straight[1]), abs=1e-9)


def test_its_derivatives():
    start, stop = jnp.array([0.021, 0.043]), jnp.array([0.108, 0.071])
    sizes = jnp.array([WIDTH, THICKNESS])
    free = jax.jit(lambda start, stop, sizes: free_way(CELLS, GRID, start, stop, sizes[0], sizes[1])[1])
    assert 0 < float(free(start, stop, sizes)) < 1
    check_grads(free, (start, stop, sizes), 1, modes=("fwd", "rev"), atol=1e-6, rtol=1e-6, eps=1e-6)


def test_what_is_not_finite_meets_nothing():
    meets, share = way(jnp.array([jnp.nan, 0.05]), jnp.array([0.1, 0.05]))
    assert (bool(meets), float(share)) == (False, 1)
