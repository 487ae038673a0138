"""Zones: a stroke ends at their edge or is not made, and without them nothing is computed."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxsand as js
from jaxsand import envs

from .cases import KEY, SMALL, level, program, rising, small

RIGHT = np.arange(16) >= np.full((16, 1), 9)
THROUGH = jnp.float32([0.03, 0.055, 0.13, 0.055])  # from the left half into the right
EDGE = 0.09 - SMALL.tool.thickness / 2  # where the blade's front touches the zone


def made(env, params, stroke):
    state = env.reset(KEY, params)[1]
    _, after, reward, *_, info = program(env)(KEY, state, env.action(stroke, params), params)
    return after, float(reward), info


@pytest.mark.parametrize("make", [level, pytest.param(rising, marks=pytest.mark.slow)])
def test_a_stroke_ends_at_the_edge_of_a_zone(make):
    free, clipped = make(), make(zones=envs.ClippedBy(RIGHT))
    stroke, end = THROUGH, THROUGH.at[2].set(EDGE)
    if free[0].size == 6:
        rise = np.float32([-0.01, 0.0])
        at = rise[0] + (rise[1] - rise[0]) * (EDGE - 0.03) / 0.1
        stroke, end = (
            jnp.insert(stroke, np.array([2, 4]), rise),
            jnp.insert(end, np.array([2, 4]), np.float32([rise[0], at])),
        )
    after, _, info = made(*clipped, stroke)
    assert info["clipped"]
    assert float(info["went"]) == pytest.approx((EDGE - 0.03) / 0.1, abs=1e-5)
    expected, _, plain = made(*free, end)
    assert np.abs(after.height - expected.height).max() < 2e-6
    assert set(plain) == {"outcome"}
    backwards, back = (made(*one, stroke.at[0].set(0.05).at[stroke.size // 2].set(0.01)) for one in (clipped, free))
    assert np.abs(backwards[0].height - back[0].height).max() < 1e-7  # it does not meet the zone
    assert (bool(backwards[2]["clipped"]), float(backwards[2]["went"])) == (False, 1)


def test_what_rises_ends_as_high_as_it_is_at_the_edge():
    stroke = np.insert(np.asarray(THROUGH), [2, 4], [-0.01, 0.0])
    made, told = envs.ClippedBy(RIGHT).way(jnp.asarray(stroke), SMALL.grid, SMALL.tool.width, SMALL.tool.thickness)
    share = (EDGE - 0.03) / 0.1
    assert float(told["went"]) == pytest.approx(share, abs=1e-5)
    np.testing.assert_allclose(made, [0.03, 0.055, -0.01, EDGE, 0.055, -0.01 + 0.01 * share], atol=1e-6)


def test_what_begins_at_the_edge_of_a_zone_stays_out_of_it():
    """Where the last stroke was clipped, the next has hardly any way left, too short for floats to tell its heading."""
    zone = np.zeros((32, 32), bool)
    zone[20:] = True
    scene = js.make_scene((32, 32), 0.01, tool=js.Blade(width=0.1, thickness=0.015))
    env, params = js.make("multi-stroke", scene=scene, goals=np.zeros((1, 32, 32), np.float32), zones=envs.ClippedBy(zone))
    step = jax.jit(env.step_env)
    for degrees in (23, 40, 58, 71):
        way = 0.2 * np.array([np.cos(np.radians(degrees)), np.sin(np.radians(degrees))])
        _, state = env.reset(KEY, params)
        start = np.array([0.14, 0.08])
        for _ in range(3):
            action = env.action(jnp.asarray(np.concatenate([start, start + way]), jnp.float32), params)
            _, state, *_, info = step(KEY, state, action, params)
            start = start + float(info["went"]) * way
        assert float(info["went"]) == 0
        assert np.asarray(state.height)[20:].min() > -1e-4


def test_what_may_not_be_made_leaves_the_map_and_counts():
    refused, clipped = level(zones=envs.RefusedBy(RIGHT)), level(zones=envs.ClippedBy(RIGHT))
    for one, stroke in ((refused, THROUGH), (clipped, THROUGH[jnp.array([2, 3, 0, 1])])):  # the second begins in the zone
        after, reward, info = made(*one, stroke)
        assert (bool(info["clipped"]), float(info["went"]), reward, int(info["outcome"])) == (True, 0, 0, 0)
        assert int(after.time) == 1
        assert not np.asarray(after.height).any()
    after, _, info = made(*refused, THROUGH.at[2].set(0.07))
    assert not info["clipped"]
    assert float(after.height.min()) < -0.005
    _, _, info = made(*clipped, THROUGH.at[0].set(jnp.nan))
    assert int(info["outcome"]) & js.Outcome.NOT_FINITE


def test_a_batch_is_its_maps_and_each_may_have_its_zones():
    cells = np.stack([RIGHT, ~RIGHT, RIGHT.T])
    env, params = level(zones=envs.ClippedBy(RIGHT))
    axes = replace(jax.tree.map(lambda _: None, params), zones=envs.ClippedBy(0))
    state = env.reset(KEY, params)[1]
    many = jax.jit(jax.vmap(env.step_env, (None, None, None, axes)))(
        KEY, state, env.action(THROUGH, params), replace(params, zones=envs.ClippedBy(cells))
    )
    for i, zone in enumerate(cells):
        alone, _, info = made(env, replace(params, zones=envs.ClippedBy(zone)), THROUGH)
        assert np.abs(alone.height - many[1].height[i]).max() < 2e-6
        assert float(info["went"]) == pytest.approx(float(many[5]["went"][i]), abs=1e-6)
    assert len(np.unique(np.asarray(many[5]["went"]).round(3))) == 3


@pytest.mark.slow
def test_derivatives_of_a_clipped_stroke_are_those_of_small_differences():
    env, params = level(zones=envs.ClippedBy(RIGHT), goals=envs.LevelGoals(jnp.zeros((1, 16, 16))))
    weight = jnp.asarray(np.random.default_rng(0).normal(size=(16, 16)))
    state = env.reset(KEY, params)[1]
    left = jax.jit(lambda action: (program(env)(KEY, state, action, params)[1].height * weight).sum())
    action = env.action(jnp.array([0.031, 0.052, 0.134, 0.091]), params)
    slope, size = jax.grad(left)(action), 1e-6
    differences = [float(left(action + size * e) - left(action - size * e)) / (2 * size) for e in jnp.eye(4)]
    np.testing.assert_allclose(slope, differences, atol=1e-5 * np.abs(differences).max())
    assert min(np.abs(differences)) > 0


def test_goals_are_made_around_zones():
    """By the strokes that the environment would make of a glyph's."""
    line = np.float32(np.array([[0.1, 0.5, 0.9, 0.5]]) * 0.125 + 0.0175)[0]
    env, params = small(zones=envs.ClippedBy(RIGHT), goals={"line": [[0.1, 0.5, 0.9, 0.5]]})
    after, _, info = made(env, params, line)
    assert info["clipped"]
    assert np.abs(after.height - params.goals.goals[0]).max() < 2e-6


@pytest.mark.wide
def test_a_tool_passes_through_walls_unless_they_are_zones():
    walls = js.Walls(np.arange(16) == np.full((16, 1), 8))
    scene = replace(SMALL, walls=walls)
    after, _, _ = made(*level(scene=scene), THROUGH)
    beyond = np.asarray(after.height)[:, 9:]
    assert beyond.min() < -0.005  # the blade dug on the other side
    after, _, info = made(*level(scene=scene, zones=envs.ClippedBy(walls.solid)), THROUGH)
    assert info["clipped"]
    assert not np.asarray(after.height)[:, 8:].any()
    assert np.asarray(after.height)[:, :8].min() < -0.005


def test_without_zones_nothing_is_computed_for_them():
    sizes = []
    for zones in (envs.NoZones(), envs.RefusedBy(RIGHT), envs.ClippedBy(RIGHT)):
        env, params = level(zones=zones)
        state = env.reset(KEY, params)[1]
        sizes.append(len(jax.make_jaxpr(env.step_env)(KEY, state, jnp.zeros(4, "float32"), params).eqns))
    env, params = level()
    state = env.reset(KEY, params)[1]
    bare = len(jax.make_jaxpr(env.step_env)(KEY, state, jnp.zeros(4, "float32"), params).eqns)
    assert bare == sizes[0] < sizes[1] < sizes[2]


@pytest.mark.parametrize(
    ("zones", "message"),
    [
        (RIGHT, r"^zones: got an array of shape .*; give one of NoZones\(\.\.\.\), ClippedBy\(\.\.\.\), RefusedBy"),
        (envs.ClippedBy(RIGHT[:5]), r"^zones.cells: got bool of shape \[5, 16\]; give booleans of shape \[16, 16\]"),
        (envs.RefusedBy(RIGHT.astype(int)), "^zones.cells: got int64 of shape"),
        (envs.ClippedBy(np.ma.masked_where(RIGHT, RIGHT)), "^zones.cells: got 112 masked cells; say of each"),
    ],
)
def test_what_are_no_zones_is_said(zones, message):
    with pytest.raises(ValueError, match=message):
        level(zones=zones)
