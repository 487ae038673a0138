"""The flags with which users hunt their own faults: `jax_debug_nans` and strict dtype promotion, on clean maps."""

from collections.abc import Iterator

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxsand as js
from jaxsand.envs import LevelGoals, OnSand, map_pool

SLOW = pytest.mark.slow
SOLID = np.zeros((8, 8), bool)
SOLID[3, 5:] = True
MAP = np.random.default_rng(0).normal(size=(8, 8)).astype("float32") * 0.003
STROKE = np.float32([0.02, 0.025, 0.06, 0.055])
PATH = np.float32([[0.02, 0.025], [0.06, 0.055], [0.04, 0.06]])
QUICK = js.SteppedPush(1.0, 1)
STOP = js.UntilStill(bound=64)
BLADE, WHEEL = js.Blade(0.03, 0.015, 0.0075), js.Wheel(0.04, 0.03, 0.01, 0.2)
PLAIN = {"tool": BLADE}
DRAINED = {"neighbours": 4, "edge": js.Draining(-0.005), "walls": js.Walls(SOLID), "tool": BLADE}
ISOTROPIC = {"neighbours": "isotropic", "window": js.Window((6, 6)), "tool": BLADE}
ROLLED = {"tool": WHEEL, "walls": js.Walls(SOLID)}


@pytest.fixture(autouse=True)
def _flags() -> Iterator[None]:
    with jax.debug_nans(True), jax.numpy_dtype_promotion("strict"):
        yield


def scene(kind):
    return js.make_scene((8, 8), 0.01, **kind)


def clean(result):
    js.check(result)
    assert np.isfinite(result.height).all()


def gradient(one, *inputs):
    def loss(*inputs):
        return jnp.sum(one(*inputs).height ** 2)

    for slope in jax.grad(loss, range(len(inputs)))(*map(jnp.asarray, inputs)):
        assert np.isfinite(slope).all()
        assert np.abs(slope).max() > 0


def test_a_fault_of_the_users_own_is_still_found():
    with pytest.raises(FloatingPointError):
        jnp.log(jnp.float32(-1))
    with pytest.raises(jax.dtypes.TypePromotionError):
        jnp.float32(1) + jnp.arange(2, dtype=jnp.int32)


@pytest.mark.wide
@pytest.mark.parametrize("kind", [pytest.param(PLAIN, marks=SLOW), DRAINED, pytest.param(ISOTROPIC, marks=SLOW)])
def test_settling(kind):
    sand = scene(kind)
    clean(js.settle(sand, MAP))
    gradient(lambda h: js.settle(sand, h, stop=STOP), MAP)
    assert float(js.steepest_slope(sand, MAP)) > 0
    assert np.isfinite(float(js.volume(sand, MAP)))
    if kind is not ISOTROPIC:
        clean(js.settle_batch(sand, np.stack([MAP, MAP[::-1]])))
    else:
        js.settle(sand, MAP, window=js.Window((6, 6)))


@pytest.mark.parametrize(
    ("kind", "push"),
    [
        (PLAIN, QUICK),
        pytest.param(PLAIN, js.SwathPush(), marks=SLOW),
        pytest.param(ROLLED, QUICK, marks=SLOW),
        pytest.param(ROLLED, js.SplitPush(), marks=SLOW),
    ],
)
def test_a_push(kind, push):
    sand = scene(kind)
    gradient(lambda h, s: js.step(sand, h, s, push=push, stop=STOP), MAP, STROKE)


@SLOW
def test_a_path():
    sand = scene(ISOTROPIC)
    gradient(lambda h, s: js.follow(sand, h, s, push=QUICK, stop=STOP), MAP, PATH)


BUCKET = {"tool": js.Bucket(0.03, 0.02, 1e-5), "base": js.Base(-0.02)}


@pytest.mark.parametrize("pour", [js.deposit, js.remove])
def test_sand_put_down_and_taken_away(pour):
    sand = scene(BUCKET)
    clean(pour(sand, MAP, np.float32([0.041, 0.037]), 1e-6, stop=STOP))


@pytest.mark.wide
def test_sand_over_a_footprint_has_gradients():
    gradient(lambda h, v: js.deposit(scene(PLAIN), h, np.ones((8, 8), "float32"), v, stop=STOP), MAP, np.float32(1e-6))


@pytest.mark.wide
def test_a_bucket():
    sand = scene(BUCKET)
    loaded = js.scoop(sand, MAP, np.float32([[0.02, 0.025], [0.05, 0.045]]), push=QUICK, stop=STOP)
    clean(loaded)
    assert float(js.load_volume(sand, loaded.load)) > 0
    clean(js.dump(sand, loaded.height, np.float32([[0.04, 0.04]]), loaded.load, stop=STOP))


@SLOW
def test_entry_points():
    sand, ways = scene(DRAINED), {"push": QUICK, "stop": STOP}
    js.act(sand, MAP, STROKE, push=QUICK)
    assert np.isfinite(js.follow_frames(sand, MAP, PATH, **ways)[1]).all()
    js.rollout(sand, MAP, np.stack([STROKE, STROKE[::-1]]), **ways)
    two = np.stack([MAP, MAP[::-1]]), np.stack([STROKE, STROKE[::-1]])
    js.step_batch(sand, *two, **ways)
    outcomes = jax.jit(jax.vmap(lambda h, s: js.step(sand, h, s, **ways).outcome))(*two)
    assert not outcomes.any()


def begun():
    goals = LevelGoals(jnp.stack([jnp.asarray(MAP)]))
    env, params = js.make("multi-stroke", goals=goals, scene=scene(PLAIN), push=js.SwathPush(), settle=js.Sweeps(8))
    obs, state = env.reset(jax.random.key(0), params)
    assert env.observation_space(params).contains(obs)
    return lambda action: env.step(jax.random.key(1), state, action, params)[2]


@pytest.mark.wide
def test_environments_trace():
    reward, actions = begun(), jnp.zeros((3, 4), jnp.float32)
    jax.eval_shape(jax.vmap(jax.value_and_grad(reward)), actions)
    for options in ({}, {"on": OnSand((2, 2), push=QUICK), "goals": map_pool([np.ones((2, 2), bool)])}):
        env, params = js.make("single-stroke", **options)
        state = jax.eval_shape(env.reset, jax.random.key(0), params)[1]
        jax.eval_shape(env.step, jax.random.key(0), state, jnp.int32(1), params)


@SLOW
def test_an_environment():
    reward, action = begun(), jnp.float32([-0.5, -0.4, 0.3, 0.2])
    assert np.isfinite(reward(action))
    assert np.isfinite(jax.grad(reward)(action)).all()


def test_a_bad_cell_may_be_found():
    """NaN in a user's map is told of by the flag, or by the outcome."""
    bad = MAP.copy()
    bad[2, 2] = np.nan
    with pytest.raises(FloatingPointError):
        js.settle(scene(PLAIN), bad)
    with jax.debug_nans(False):
        assert int(js.settle(scene(PLAIN), bad).outcome) & js.Outcome.NOT_FINITE
