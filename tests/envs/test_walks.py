"""Single strokes: walks as the planner knows them, on maps and on sand."""

from dataclasses import replace

import chex
import jax.numpy as jnp
import numpy as np
import pytest

import jaxsand as js
from jaxsand import envs
from jaxsand.goals import letters, metrics
from jaxsand.planning.binary import make_problem

from .cases import KEY, one_map, program


def test_the_planners_walk_solves_a_map_in_as_many_steps():
    for name in "AST":
        dig, _ = letters.letter_map(name)
        env, params = js.make("single-stroke", goals=one_map(dig), step_cost=1.0)
        plan = js.plan(dig)
        _, state = env.reset(KEY, params)
        step, legal = program(env), program(env, "legal")
        earned, ended = 0.0, []
        for letter in plan.path:
            assert legal(state, params)["NESW".index(letter)]
            _, state, reward, terminated, truncated, _ = step(KEY, state, "NESW".index(letter), params)
            earned += float(reward)
            ended.append(bool(terminated))
            assert not truncated
        assert ended == [False] * (plan.steps - 1) + [True]
        assert earned == dig.sum() - 1 - plan.steps


def test_legal_steps_are_the_planners():
    """On every cell of a letter: exactly those to a neighbour that is to be dug."""
    dig, _ = letters.letter_map("R")
    env, params = js.make("single-stroke", goals=one_map(dig))
    _, state = env.reset(KEY, params)
    steps = {"N": (-1, 0), "E": (0, 1), "S": (1, 0), "W": (0, -1)}
    for cell in np.argwhere(dig):
        here = replace(state, place=jnp.asarray(cell))
        expected = [tuple(cell + step) in set(map(tuple, np.argwhere(dig))) for step in steps.values()]
        assert env.legal(here, params).tolist() == expected


def test_what_is_not_legal_changes_nothing_and_costs_a_step():
    env, params = js.make(
        "single-stroke", goals=one_map(np.ones((1, 2), bool), (0, 0)), on=envs.OnMap((1, 2)), step_cost=0.5
    )
    obs, state = env.reset(KEY, params)
    for action in (0, 2, 3):
        again, after, reward, terminated, truncated, info = env.step_env(KEY, state, action, params)
        chex.assert_trees_all_equal(again, obs)
        assert (float(reward), bool(info["legal"]), bool(terminated), bool(truncated)) == (-0.5, False, False, False)
        assert int(after.time) == 1
    _, _, reward, terminated, _, info = env.step_env(KEY, state, 1, params)
    assert (float(reward), bool(info["legal"]), bool(terminated)) == (0.5, True, True)


def test_random_walks_are_maps_of_one_piece():
    shape = (5, 8)
    pool = envs.pool_of(envs.Walks(4, 20, 0.7), KEY, 64, shape)
    sizes = []
    for dig, start in zip(np.asarray(pool.dig), np.asarray(pool.starts), strict=True):
        assert dig[tuple(start)]
        make_problem(dig, tuple(start.tolist()))  # raises if it falls into pieces
        sizes.append(dig.sum())
    assert min(sizes) >= 2
    assert max(sizes) <= 21
    straight = envs.pool_of(envs.Walks(4, 4, 1.0), KEY, 64, (9, 9))
    spans = [np.ptp(np.argwhere(dig), axis=0) for dig in np.asarray(straight.dig)]
    turning = envs.pool_of(envs.Walks(4, 4, 0.0), KEY, 64, (9, 9))
    assert all(min(span) == 0 for span in spans)
    assert not any(min(np.ptp(np.argwhere(dig), axis=0)) == 0 for dig in np.asarray(turning.dig))


@pytest.mark.wide
def test_a_walk_on_sand_ends_with_the_planners_and_digs():
    dig, _ = letters.letter_map("L")
    env, params = js.make("single-stroke", on=envs.OnSand(), goals=one_map(dig))
    _, state = env.reset(KEY, params)
    step = program(env)
    for letter in js.plan(dig).path:
        _, state, _, terminated, _, info = step(KEY, state, "NESW".index(letter), params)
        assert int(info["outcome"]) == 0
    assert terminated
    lifted = js.settle(params.scene, state.height).height
    assert float(metrics.iou(env.goal(state.walk, params), lifted, params.scene.tool.depth)) > 0.85
