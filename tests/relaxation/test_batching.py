"""A batch is its maps, one by one: however slow some are, however it is cut up, on however many cores."""

from itertools import pairwise

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxsand as js
from jaxsand.relaxation import batching as batch

from ..conftest import ANGLE

pytestmark = pytest.mark.compiled  # a batch is its maps to the last bit, as users compile it

SHAPE, DX = (16, 12), 0.01


def maps(dtype, many=37):
    """Mostly rough sand, some still, some with a tall column, one with a bad cell."""
    h = np.random.default_rng(0).uniform(-0.01, 0.01, (many, *SHAPE))
    h[3] = 0
    h[[5, 17, 30], 4:9, 3:8] = 0.2
    h[11, 2, 2] = np.nan
    return h.astype(dtype)


def same(a, b):
    """To the last bit, but for a quotient and a sum that compilers may round otherwise."""
    for name in vars(b):
        x, y = np.asarray(getattr(a, name)), np.asarray(getattr(b, name))
        rounding = 1e-6 * np.abs(y) if name in ("residual", "drained") else 0
        assert np.all((np.abs(x - y) <= rounding) | (np.isnan(x) & np.isnan(y))), name


@pytest.mark.wide
@pytest.mark.parametrize(
    ("scheme", "edge"),
    [
        (None, js.Closed()),
        (js.Pairwise(), js.Draining(-0.01)),
        pytest.param(None, js.Draining(-0.01), marks=pytest.mark.slow),
        pytest.param(js.Relaxation(), js.Closed(), marks=pytest.mark.slow),
        pytest.param(js.Relaxation(), js.Draining(-0.01), marks=pytest.mark.slow),
        pytest.param(js.Pairwise(), js.Closed(), marks=pytest.mark.slow),
    ],
)
def test_a_batch_is_its_maps(scheme, edge, dtype):
    scene = js.make_scene(SHAPE, DX, ANGLE, walls=js.Walls(jnp.zeros(SHAPE, bool).at[7, 3:9].set(True)), edge=edge)
    h = maps(dtype)
    alone = jax.jit(jax.vmap(lambda x: js.settle(scene, x, scheme=scheme)))(h)
    assert len(np.unique(alone.sweeps)) > 2
    same(js.settle_batch(scene, h, scheme=scheme, chunk=8), alone)


CUTS = [(None, 37), (1, 2), (1, 7), (5, 1), (5, 37), (64, 7)]
OTHERS = [(chunk, many) for chunk in (None, 1, 5, 64) for many in (1, 2, 7, 37) if (chunk, many) not in CUTS]


@pytest.mark.wide
@pytest.mark.parametrize(("chunk", "many"), [*CUTS, *(pytest.param(*cut, marks=pytest.mark.slow) for cut in OTHERS)])
def test_however_it_is_cut_up(many, chunk, monkeypatch):
    scene, h = js.make_scene(SHAPE, DX, ANGLE), maps("float32")[:many]
    whole = js.settle_batch(scene, h, chunk=64)
    assert whole.height.shape == h.shape
    for cores in (1, 2, 3):
        monkeypatch.setattr(batch, "cores", lambda n=cores: n)
        same(js.settle_batch(scene, h, chunk=chunk), whole)


@pytest.mark.wide
def test_the_bound_holds_for_maps_that_were_set_aside():
    scene, h = js.make_scene(SHAPE, DX, ANGLE), maps("float32")
    stop = js.UntilStill(bound=40)
    out = js.settle_batch(scene, h, stop=stop, chunk=8)
    same(out, jax.vmap(lambda x: js.settle(scene, x, stop=stop))(h))
    assert np.asarray(out.outcome)[[5, 17, 30]].tolist() == [js.Outcome.NOT_STILL] * 3
    assert int(out.sweeps.max()) == 40


@pytest.mark.wide
def test_pushes_on_every_core(monkeypatch):
    scene = js.make_scene(SHAPE, DX, ANGLE, tool=js.Blade())
    strokes = np.random.default_rng(1).uniform(0.02, 0.1, (5, 4)).astype("float32")
    level = np.zeros((5, *SHAPE), "float32")
    one, two = [], []
    for cores, found in ((1, one), (2, two)):
        monkeypatch.setattr(batch, "cores", lambda n=cores: n)
        found.append(js.step_batch(scene, level, strokes, chunk=2))
    same(two[0].pose, one[0].pose)
    assert np.array_equal(one[0].height, two[0].height)


@pytest.mark.wide
def test_threads_compute_in_the_callers_precision(monkeypatch):
    monkeypatch.setattr(batch, "cores", lambda: 2)
    scene = js.make_scene(SHAPE, DX, ANGLE)
    with jax.enable_x64(False):
        narrow = js.settle_batch(scene, maps("float32"), chunk=8)
    assert narrow.height.dtype == jnp.float32
    with jax.enable_x64(True):
        assert js.settle_batch(scene, maps("float64"), chunk=8).height.dtype == jnp.float64


@pytest.mark.parametrize("chunk", [None, 4, 100])
def test_groups_of_like_cost_come_back_in_the_order_of_the_batch(chunk):
    """Of numbers, whose squares are wanted: each group holds like costs, the dearest first, and copies fill the last."""
    whole, cost, groups = np.arange(21.0), np.random.default_rng(0).permutation(21), []

    def run(part):
        groups.append(np.asarray(part))
        return {"square": jnp.asarray(part) ** 2}

    found = batch.in_groups(run, whole, lambda numbers: cost[numbers.astype(int)], chunk)
    assert np.array_equal(found["square"], whole**2)
    assert len({len(group) for group in groups}) == 1
    costs = sorted((cost[group.astype(int)] for group in groups), key=max, reverse=True)
    assert all(one.min() >= other.max() for one, other in pairwise(costs))


def test_inside_another_program_it_says_what_to_use():
    scene, h = js.make_scene(SHAPE, DX, ANGLE), jnp.asarray(maps("float32"))
    for call in (lambda h: js.settle_batch(scene, h), lambda h: js.settle_batch(scene, h, chunk=64)):
        with pytest.raises(ValueError, match=r"outermost programs: .*use jax\.vmap"):
            jax.jit(call)(h)
    with pytest.raises(ValueError, match="outermost programs"):
        jax.grad(lambda a: js.settle_batch(js.make_scene(SHAPE, DX, a), h).height.sum())(ANGLE)


def test_an_error_comes_out_of_a_thread(monkeypatch):
    monkeypatch.setattr(batch, "cores", lambda: 2)
    with pytest.raises(ValueError, match="chunk"):
        js.settle_batch(js.make_scene(SHAPE, DX, ANGLE), maps("float32"), chunk=0)
