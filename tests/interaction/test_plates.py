"""A blade with plates at its ends carries its heap."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxsand as js

from ..conftest import ANGLE, MU, turned

DX = 0.01
DEEP, WIDE = 0.004, 0.08
LEVEL = np.zeros((24, 48))
STROKE = np.array([0.1, 0.12, 0.3, 0.12])


def sand(plates, shape=LEVEL.shape, neighbours=8, **options):
    tool = js.Blade(WIDE, 0.015, DEEP, plates=plates)
    return js.make_scene(shape, DX, ANGLE, neighbours, tool=tool, **options)


@pytest.mark.wide
@pytest.mark.parametrize("neighbours", [8, "isotropic"])
@pytest.mark.parametrize("aside", [0.0, 0.004])
def test_what_it_cuts_stays_between_the_plates(neighbours, aside):
    """There it is the triangle of a blade as wide as its bed: V a unit of width has the peak sqrt(2 mu V)."""
    heaps, peaks = [], []
    for plates in (None, 0.05):
        out = js.act(sand(plates, neighbours=neighbours), LEVEL, np.add(STROKE, [0, aside, 0, aside]))
        js.check(out)
        h = np.asarray(out.height)
        assert np.sum(h) == pytest.approx(0, abs=1e-12)
        cut = (WIDE if plates is None else WIDE + 2 * DX) * DEEP * 0.2  # plates cut a cell each
        heaps.append(DX**2 * h[8:17, 30:].clip(0).sum() / cut)
        peaks.append(h.max() / np.sqrt(2 * MU * DEEP * 0.2))
    assert heaps[0] < 0.6
    assert heaps[1] > (0.9 if aside == 0 else 0.75)  # between cells some is left in the plates' strips
    assert peaks[0] < 0.85
    assert peaks[1] == pytest.approx(1, abs=0.12)


def test_mirrors_and_quarter_turns():
    rough = np.random.default_rng(2).uniform(-0.002, 0.002, (24, 24))
    scene, stroke = sand(0.04, (24, 24)), (0.07, 0.08, 0.15, 0.14)
    out = np.asarray(js.step(scene, rough, stroke).height)
    for turn, other in turned(stroke, 0.24):
        assert np.abs(js.step(scene, turn(rough), other).height - turn(out)).max() < 2e-6


@pytest.mark.wide
def test_a_window_around_it_is_the_whole():
    near, far = (js.step(sand(0.05, (96, 96), window=w), np.zeros((96, 96)), STROKE + 0.3) for w in (None, js.Whole()))
    assert np.abs(near.height - far.height).max() < 1e-4


@pytest.mark.slow
def test_derivatives():
    rough = jnp.asarray(np.random.default_rng(2).uniform(-0.002, 0.002, (24, 24)))
    weights = np.random.default_rng(3).normal(size=(24, 24))

    def of(x):
        return jnp.sum(weights * js.act(sand(x[4], (24, 24)), rough, x[:4]).height)

    at, step = jnp.array([0.071, 0.082, 0.152, 0.143, 0.043]), 1e-8
    slope, value = jax.jit(jax.grad(of))(at), jax.jit(of)
    for k in range(5):
        ends = [value(at.at[k].add(sign * step)) for sign in (-1, 1)]
        assert float(slope[k]) == pytest.approx(float(ends[1] - ends[0]) / (2 * step), rel=1e-4, abs=1e-4)


@pytest.mark.parametrize(
    ("make", "match"),
    [
        (lambda: sand(0.0), "tool.plates: got 0.0; it must be one finite number above 0"),
        (lambda: sand(9.0), "more than the map's diagonal"),
        (lambda: js.make_scene((8, 8), DX, tool=js.Blade(yaw=0.2, plates=0.02)), "tool.yaw: got an angle and plates"),
        (lambda: js.step(sand(0.04), LEVEL, STROKE, push=js.SwathPush()), "scene.tool.plates: got 0.04"),
    ],
)
def test_bad_plates_are_refused(make, match):
    with pytest.raises(ValueError, match=match):
        make()
