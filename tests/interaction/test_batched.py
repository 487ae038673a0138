"""Many pushes at once: every map as it would come out alone, its loss and gradient too; what is refused."""

from dataclasses import dataclass, replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxsand as js
from jaxsand.interaction.batched import act_batch
from jaxsand.relaxation import batching

from ..conftest import GROUPS

QUICK = {"push": js.SteppedPush(1.0, 2), "stop": js.Sweeps(8)}
SAND = js.make_scene((9, 9), 0.01, 0.5, tool=js.Blade(0.025, 0.015, 0.006))
RNG = np.random.default_rng(0)
MAPS = RNG.normal(0, 1e-3, (5, 9, 9))
STROKES = RNG.uniform(0.02, 0.07, (5, 4))
WEIGHTS = RNG.normal(size=(5, 9, 9))


@pytest.fixture(autouse=True)
def _groups(monkeypatch):
    monkeypatch.setattr(batching, "SIZES", GROUPS)


def weighed(height, weight):
    return jnp.sum(weight * height)


def alone(height, stroke, weight):
    return weighed(js.step(SAND, height, stroke, **QUICK).height, weight)


@pytest.mark.wide
def test_losses_and_gradients_are_those_of_each_map_alone():
    value, slopes = js.value_and_grad_batch(SAND, weighed, MAPS, STROKES, WEIGHTS, chunk=2, **QUICK)
    one = jax.jit(jax.value_and_grad(alone, argnums=(0, 1)))
    for k, inputs in enumerate(zip(MAPS, STROKES, WEIGHTS, strict=True)):
        want, wanted = one(*inputs)
        assert np.allclose(value[k], want, atol=1e-12)
        for found, slope in zip(slopes, wanted, strict=True):
            assert np.abs(slope).max() > 0
            assert np.allclose(found[k], slope, atol=1e-9)


def test_what_is_not_clean_has_no_loss_and_no_gradient():
    """A map that is not finite, of sand without a tool, whose gradient compiles in a tenth of the time."""
    maps = MAPS.copy()
    maps[3, 4, 4] = np.nan
    seen = np.where(np.isnan(maps), 0, WEIGHTS)

    def loss(height, weight):
        return jnp.sum(jnp.where(weight == 0, 0, weight * height))

    bare = js.make_scene((9, 9), 0.01, 0.5)
    value, (by_height, by_stroke) = js.value_and_grad_batch(bare, loss, maps, STROKES, seen, chunk=2, stop=QUICK["stop"])
    for found in (value, by_height, by_stroke):
        bad = np.isnan(np.asarray(found).reshape(5, -1))
        assert bad[3].all()
        assert not np.delete(bad, 3, 0).any()


@pytest.mark.wide
def test_acting_leaves_the_sand_as_the_tool_did():
    found = act_batch(SAND, MAPS, STROKES, push=QUICK["push"]).height
    want = jax.vmap(lambda h, s: js.act(SAND, h, s, push=QUICK["push"]).height)(MAPS, STROKES)
    assert np.allclose(found, want, atol=1e-12)


def test_wheels_are_sorted_by_their_way_too():
    """More wheels than are computed together once ended in an error."""
    sand = js.make_scene((24, 24), 0.01, 0.5, tool=js.Wheel())
    strokes = np.random.default_rng(1).uniform(0.04, 0.2, (17, 4))
    found = np.asarray(js.step_batch(sand, np.zeros((17, 24, 24)), strokes, chunk=32, **QUICK).height)
    for k in (0, 16):
        assert np.allclose(found[k], js.step(sand, np.zeros((24, 24)), strokes[k], **QUICK).height, atol=1e-12)


@pytest.mark.wide
def test_large_maps_are_pushed_in_windows_and_again_where_these_are_too_small():
    """A window made for the blade alone does not hold the heap of a deep map of ridges; the results are the whole map's."""
    sand = js.make_scene((40, 40), 0.01, 0.5, tool=js.Blade())
    x = np.linspace(0, 4 * np.pi, 40)
    maps = np.stack([np.zeros((40, 40)), 0.02 * np.sin(x)[:, None] * np.ones(40)])
    maps = np.asarray(js.settle_batch(sand, maps).height)
    strokes = np.array([[0.1, 0.1, 0.2, 0.15], [0.2, 0.05, 0.22, 0.3]])
    found = act_batch(sand, maps, strokes)
    want = jax.jit(jax.vmap(partial(js.act, replace(sand, window=js.Whole()))))(maps, strokes)
    assert not np.asarray(found.outcome).any()
    assert np.abs(found.height - want.height).max() < 2e-4


@dataclass(frozen=True)
class Weighed:
    weight: np.ndarray

    def __call__(self, height, _):
        return jnp.sum(self.weight * height)


BARE = js.make_scene((9, 9), 0.01, 0.5)
LOSSES = {
    "a map": (lambda h, w: w * h, r"loss: got float64 of shape \[9, 9\] from it; return one floating-point number"),
    "a row": (lambda h, w: jnp.sum(w * h, axis=0, keepdims=True)[0, :1], r"loss: got float64 of shape \[1\] from it"),
    "a count": (lambda h, w: jnp.sum(h > w), r"loss: got int64 of shape \[\] from it; return one floating-point"),
    "a complex number": (lambda h, w: 1j * jnp.sum(w * h), r"loss: got complex128 of shape \[\] from it"),
    "two numbers": (lambda h, w: (jnp.sum(h), jnp.sum(w)), r"loss: got float64 of shape \[2\] from it"),
    "names": (lambda h, w: {"miss": jnp.sum(w * h)}, "loss: got dict from it; return one floating-point number"),
    "nothing": (lambda h, w: None, "loss: got NoneType from it; return one floating-point number"),
    "what has no hash": (Weighed(WEIGHTS[0]), r"loss: got Weighed \(unhashable type.*; give a function, and what it needs"),
    "no function": (0.5, "loss: got float; give a function of a map"),
}


@pytest.mark.parametrize("name", LOSSES)
def test_a_loss_that_is_no_number_is_refused(name):
    loss, message = LOSSES[name]
    with pytest.raises(ValueError, match=message):
        js.value_and_grad_batch(BARE, loss, MAPS, STROKES, WEIGHTS, **QUICK)


def test_what_a_loss_needs_has_a_part_for_each_map():
    with pytest.raises(ValueError, match=r"args: got an array of shape \[2, 9, 9\]; give \[5, \.\.\.\], one for each map"):
        js.value_and_grad_batch(BARE, weighed, MAPS, STROKES, WEIGHTS[:2], **QUICK)
    with pytest.raises(ValueError, match="args: got 1 masked cells; fill them first"):
        js.value_and_grad_batch(BARE, weighed, MAPS, STROKES, np.ma.masked_equal(WEIGHTS, WEIGHTS[0, 0, 0]), **QUICK)


def test_what_is_refused():
    with pytest.raises(ValueError, match=r"stroke: got shape \[5, 3\]; give \[5, 4\]"):
        js.value_and_grad_batch(SAND, weighed, MAPS, STROKES[:, :3], WEIGHTS)
    with pytest.raises(ValueError, match=r"outermost programs: .*use jax\.vmap"):
        jax.jit(partial(js.step_batch, SAND))(MAPS, STROKES)
