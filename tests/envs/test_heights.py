"""Strokes that rise and sink: the simulator's, at the heights that the scene gives."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxsand as js
from jaxsand import envs

from .cases import KEY, SMALL, level, program, rising, small

DEPTH = SMALL.tool.depth


def test_an_action_is_a_stroke_of_six_numbers_between_the_heights():
    env, params = rising()
    assert env.action_space(params).shape == (6,)
    ends = env.stroke(jnp.array([-1.0, -1, -1, 1, 1, 1]), params)
    assert ends.tolist() == pytest.approx([0.005, 0.005, -2 * DEPTH, 0.155, 0.155, DEPTH])
    stroke = jnp.array([0.03, 0.05, -0.004, 0.13, 0.08, 0.002])
    with_stop, _ = rising(stop=envs.Stop())
    action = with_stop.action(stroke, params)
    assert action.shape == (7,)
    assert float(action[6]) == -1
    assert np.abs(with_stop.stroke(action, params) - stroke).max() < 1e-12
    low, _ = level(heights=envs.Heights(-1.0, 0.0))
    assert low.stroke(jnp.zeros(6), params)[2::3].tolist() == pytest.approx([-DEPTH / 2] * 2)


@pytest.mark.wide
def test_a_stroke_is_the_simulators():
    env, params = rising()
    _, state = env.reset(KEY, params)
    for stroke in ([0.03, 0.05, -0.012, 0.13, 0.08, 0.002], [0.12, 0.04, -DEPTH, 0.03, 0.09, -DEPTH]):
        expected = js.step(params.scene, state.height, stroke, push=env.push)
        _, state, *_, info = program(env)(KEY, state, env.action(jnp.float32(stroke), params), params)
        assert int(info["outcome"]) == 0
        assert np.abs(state.height - expected.height).max() < 2e-6
    plain, own = level()
    flat = program(plain)(KEY, plain.reset(KEY, own)[1], plain.action(jnp.float32(stroke[:2] + stroke[3:5]), own), own)[1]
    same = program(env)(KEY, env.reset(KEY, params)[1], env.action(jnp.float32(stroke), params), params)[1]
    assert np.abs(flat.height - same.height).max() < 2e-6  # at its own depth a stroke with heights is one without


def test_above_the_sand_and_straight_down_nothing_changes():
    env, params = rising()
    _, state = env.reset(KEY, params)
    air = env.action(jnp.float32([0.03, 0.05, 0.001, 0.13, 0.08, 0.004]), params)
    _, after, reward, *_, info = program(env)(KEY, state, air, params)
    assert (float(reward), int(info["outcome"])) == (0, 0)
    assert not np.asarray(after.height).any()
    _, after, reward, *_, info = program(env)(KEY, state, jnp.float32([0, 0, -1, 0, 0, 1]), params)
    assert int(info["outcome"]) & js.Outcome.NOT_FINITE
    assert float(reward) == 0
    assert (int(after.time), bool(np.asarray(after.height).any())) == (1, False)


@pytest.mark.slow
def test_the_strokes_that_a_goal_was_drawn_from_make_it():
    goals = envs.RandomStrokes(goals=2, fewest=2, most=2)
    env, params = rising(goals=goals, seed=4)
    rng = np.random.default_rng(4)
    plans = env.heights.drawn(rng, goals.plans(rng))
    assert all(plan.shape == (2, 6) and (plan[:, 2::3] <= 0).all() and (plan[:, 2::3] >= -2).all() for plan in plans)
    low, high = (edge / 2 for edge in (0.035, 0.285))  # a map half as wide
    for plan, goal in zip(plans, params.goals.goals, strict=True):
        state = replace(env.reset(KEY, params)[1], goal=goal)
        begun = float(env.distance(state, params))
        for drawn in plan:
            stroke = np.where(np.arange(6) % 3 == 2, drawn * DEPTH, low + drawn * (high - low))
            state = program(env)(KEY, state, env.action(jnp.float32(stroke), params), params)[1]
        assert begun > 1
        assert float(env.distance(state, params)) < 1e-3 * begun


@pytest.mark.slow
def test_derivatives_by_the_heights_are_those_of_small_differences():
    env, params = small(heights=envs.Heights(), goals=envs.LevelGoals(jnp.zeros((1, 16, 16))))
    weight = jnp.asarray(np.random.default_rng(0).normal(size=(16, 16)))
    state = env.reset(KEY, params)[1]
    assert state.height.dtype == jnp.float64
    left = jax.jit(lambda action: (program(env)(KEY, state, action, params)[1].height * weight).sum())
    action = env.action(jnp.array([0.043, 0.051, -0.0081, 0.112, 0.083, -0.0033]), params)
    slope, size = jax.grad(left)(action), 1e-6
    differences = [float(left(action + size * e) - left(action - size * e)) / (2 * size) for e in jnp.eye(6)]
    np.testing.assert_allclose(slope, differences, atol=1e-5 * np.abs(differences).max())


@pytest.mark.parametrize(
    ("build", "message"),
    [
        (lambda: envs.Heights(1.0, -1.0), "^heights: got Heights.*give lowest < highest"),
        (lambda: envs.Heights(highest=np.inf), "^heights: got Heights.*give lowest < highest"),
        (lambda: rising(push=js.SwathPush()), "^push: got SwathPush.*one depth; give SteppedPush"),
        (lambda: small(heights=True), r"^heights: got True; give one of OwnDepth\(\.\.\.\), Heights"),
        (
            lambda: rising(scene=js.make_scene((16, 16), 0.01, tool=js.Blade(depth=0.0))),
            "^scene.tool.depth: got 0.0 m; give a depth above 0",
        ),
    ],
)
def test_what_cannot_be_made_is_said(build, message):
    with pytest.raises(ValueError, match=message):
        build()
