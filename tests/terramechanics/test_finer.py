"""A scene and its maps on a finer grid: every field that is a map is refined, means are kept, no sand lies below its floor."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxsand as js
from jaxsand.terramechanics.finer import finer, means, resolve

N, DX, TIMES = 12, 0.01, 3
ROCK = 0.004 * np.cumsum(np.random.default_rng(0).normal(size=(N, N)), 0)
SOLID = np.zeros((N, N), bool)
SOLID[3, 5:] = True


def scene(base=None, walls=None, angle=math.radians(29)):
    return js.make_scene((N, N), DX, angle, base=base, walls=walls)


def test_every_map_of_a_scene_is_refined():
    """So that whatever field is added to a scene is refined too, or this fails."""
    whole = scene(js.Base(ROCK), js.Walls(SOLID), np.full((N, N), 0.5))
    for name, leaf in jax.tree_util.tree_leaves_with_path(finer(whole, TIMES)):
        assert np.shape(leaf) in ((), (TIMES * N, TIMES * N)), name
    maps = sum(np.ndim(leaf) == 2 for leaf in jax.tree.leaves(whole))
    assert maps == sum(np.ndim(leaf) == 2 for leaf in jax.tree.leaves(finer(whole, TIMES))) == 3
    one = finer(scene(js.Base(-0.01)), TIMES).base.height
    assert np.shape(one) == ()


@pytest.mark.parametrize("walls", [None, js.Walls(SOLID)])
@pytest.mark.parametrize("base", [js.Base(ROCK), js.Base(0.0), None])
def test_means_are_kept_and_no_sand_lies_below_its_floor(base, walls):
    sand = scene(base, walls)
    floor = 0.0 if base is None else np.asarray(base.height)
    thick = np.maximum(np.random.default_rng(1).normal(0.002, 0.004, (N, N)), 0)  # some of it bare
    fine = resolve(sand, jnp.asarray(floor + thick), TIMES)
    assert np.asarray(means(fine, (N, N))) == pytest.approx(floor + thick, abs=1e-9)
    if base is not None:
        assert np.asarray(fine - finer(sand, TIMES).base.height).min() >= -1e-9


def test_a_surface_is_interpolated_as_if_there_were_no_floor_where_that_is_deep():
    x = np.arange(N) * DX
    plane = 0.1 * x + 0.2 * x[:, None]
    with_floor, without = (resolve(scene(base), jnp.asarray(plane), TIMES) for base in (js.Base(ROCK - 1), None))
    assert np.array_equal(with_floor, without)
    fine = (np.arange(TIMES * N) + 0.5) / TIMES * DX - DX / 2
    inner = slice(TIMES, -TIMES)  # beside the edge the slope across it is 0
    assert np.asarray(without)[inner, inner] == pytest.approx((0.1 * fine + 0.2 * fine[:, None])[inner, inner], abs=1e-7)


def test_beside_the_edge_only_the_slope_across_it_is_level():
    plane = jnp.asarray(np.add.outer(np.arange(4.0), np.arange(4.0)))
    left = np.asarray(resolve(js.make_scene((4, 4), 1.0), plane, TIMES))[TIMES : 2 * TIMES, :TIMES]
    assert np.ptp(left, axis=1) == pytest.approx(0)
    assert np.diff(left, axis=0) == pytest.approx(1 / TIMES)


@pytest.mark.slow
@pytest.mark.parametrize("base", [js.Base(-0.005), js.Base(0.2 * ROCK)])
def test_calibration_on_a_floor(base):
    """The grid's error is found too, on a tray and on rock; once this ended in an error of broadcasting."""
    floor = np.broadcast_to(np.asarray(base.height), (N, N))
    column = floor + np.pad(np.full((4, 4), 0.03), 4)
    sand = scene(base, angle=math.radians(30))
    found = js.calibrate(scene(base), js.Trial(column, js.settle(sand, column).height), free=["repose_angle"], noise=1e-4)
    assert math.degrees(found.values["repose_angle"]) == pytest.approx(30, abs=0.1)
    assert math.isfinite(found.errors["repose_angle"])
