"""A bucket with walls: what it holds keeps to repose, and spills over them."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxsand as js

from ..conftest import ANGLE, MU

DX = 0.01
SHAPE = (24, 40)
LEVEL = np.zeros(SHAPE)
WIDE, LONG, WALLS = 0.06, 0.05, 0.02
DEEP_CUT = np.array([[0.1, 0.12, -0.015], [0.3, 0.12, -0.015]])


def sand(walls=WALLS, neighbours=8, **sizes):
    bucket = js.Bucket(**{"width": WIDE, "length": LONG, "capacity": 1.0, "walls": walls} | sizes)
    return js.make_scene(SHAPE, DX, ANGLE, neighbours, tool=bucket)


@pytest.mark.parametrize("neighbours", [8, pytest.param("isotropic", marks=pytest.mark.wide)])
def test_a_full_bucket_holds_what_its_walls_do_and_a_heap_upon_it(neighbours):
    """W L walls, and of an overfilled table W <= L, mu W^2 (3 L - W) / 12; the rest lies beside it."""
    scene = sand(neighbours=neighbours)
    out = js.scoop(scene, LEVEL, DEEP_CUT)
    js.check(out)
    short, far = sorted((WIDE, LONG))
    held = float(js.load_volume(scene, out.load))
    assert held == pytest.approx(WIDE * LONG * WALLS + MU * short**2 * (3 * far - short) / 12, rel=0.015)
    assert float(js.volume(scene, out.height)) == pytest.approx(-held, rel=1e-12)
    assert DX**2 * float(out.load.surface.sum()) == pytest.approx(held, rel=1e-9)
    assert np.asarray(out.height)[:, 24:34].max() > 0.005  # it spilled there
    assert js.steepest_slope(scene, out.height) < MU + 1.1e-3


def test_a_little_lies_as_a_number_would():
    one, many = (js.scoop(sand(walls), LEVEL, DEEP_CUT[:, :] * [1, 1, 0.2]) for walls in (None, WALLS))
    assert float(many.load.high) == pytest.approx(float(one.load.high), rel=1e-9)
    assert np.abs(one.height - many.height).max() < 1e-9
    assert many.load.surface == pytest.approx(float(one.load.high) / 30)


@pytest.mark.wide
def test_what_is_dumped_is_taken_from_all_of_it():
    full = js.scoop(sand(), LEVEL, DEEP_CUT).load
    out = js.dump(sand(), LEVEL, [[0.2, 0.12]], full, amount=0.25 * js.load_volume(sand(), full))
    js.check(out)
    assert out.load.surface == pytest.approx(0.75 * np.asarray(full.surface), rel=1e-9)
    rest = js.dump(sand(), out.height, [[0.2, 0.12]], out.load)
    assert abs(float(rest.load.high + rest.load.low)) < 1e-15  # less than a quantum
    assert float(js.volume(sand(), rest.height)) == pytest.approx(float(js.load_volume(sand(), full)), rel=1e-12)


@pytest.mark.wide
def test_a_batch_is_its_scoops():
    cuts = jnp.stack([DEEP_CUT, DEEP_CUT * np.array([1, 1, 0.5])])
    batch = jax.vmap(lambda path: js.scoop(sand(), LEVEL, path))(cuts)
    for k in range(2):
        one = js.scoop(sand(), LEVEL, cuts[k])
        assert np.abs(batch.height[k] - one.height).max() < 1e-9
        assert np.abs(batch.load.surface[k] - one.load.surface).max() < 1e-9


@pytest.mark.slow
def test_derivatives_where_it_spills():
    weights = np.random.default_rng(2).normal(size=SHAPE)

    def of(z):
        out = js.scoop(sand(), LEVEL, jnp.array([[0.1, 0.12, 0.0], [0.3, 0.123, 0.0]]).at[:, 2].set(z))
        return jnp.sum(weights * out.height) + js.load_volume(sand(), out.load) / DX**2

    z, step = jnp.array([-0.0151, -0.0163]), 1e-8
    slope, value = jax.jit(jax.grad(of))(z), jax.jit(of)
    for k in range(2):
        ends = [value(z.at[k].add(sign * step)) for sign in (-1, 1)]
        assert float(slope[k]) == pytest.approx(float(ends[1] - ends[0]) / (2 * step), rel=1e-4, abs=1e-4)


@pytest.mark.parametrize(
    ("make", "match"),
    [
        (lambda: sand(0.0), "tool.walls: got 0.0; it must be one finite number above 0"),
        (
            lambda: js.dump(sand(length=0.03), LEVEL, [[0.2, 0.12]], js.scoop(sand(), LEVEL, DEEP_CUT).load),
            r"load.surface: got shape \[5, 6\]; of this bucket it is \[3, 6\]",
        ),
        (lambda: jax.vmap(lambda w: js.scoop(sand(width=w), LEVEL, DEEP_CUT).load.high)(jnp.array([0.05])), "tool.walls"),
    ],
)
def test_bad_walls_are_refused(make, match):
    with pytest.raises(ValueError, match=match):
        make()
