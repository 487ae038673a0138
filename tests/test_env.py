"""Environments: contracts, rewards that telescope, walks as the planner knows them, strokes that make their own goal."""

from dataclasses import replace

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxsand as js
from jaxsand import env as envs
from jaxsand import goals, task
from jaxsand.env.pushing import ByLength, Together, sorted_by_length
from jaxsand.settling import steepest_slope

from .conftest import MU

KEY = jax.random.key(0)
SLOW = pytest.mark.slow
LETTERS = envs.map_pool([goals.letter_map(name)[0] for name in "ALTR"])
QUICK = js.SteppedPush(1.0, 1)
SMALL = js.make_scene((16, 16), 0.01, tool=js.Blade())
LINES = {"line": [[0.1, 0.2, 0.9, 0.3]], "cross": [[0.0, 0.5, 1.0, 0.5], [0.5, 0.0, 0.5, 1.0]]}


def one_map(dig, start=None):
    return envs.map_pool([dig], [start])


def small(**options):
    return js.make("multi-stroke", **{"goals": LINES, "scene": SMALL, "push": QUICK, "batching": Together()} | options)


def walks():
    return js.make("single-stroke", goals=LETTERS, limit=40)


def on_sand():
    return js.make("single-stroke", on=envs.OnSand((3, 3), push=QUICK), goals=one_map(np.ones((3, 3), bool)), limit=40)


each = pytest.mark.parametrize("make", [walks, pytest.param(on_sand, marks=SLOW), small])


def batch(env, params, count):
    keys, draws = (jax.random.split(key, count) for key in jax.random.split(KEY))
    obs, state = jax.vmap(env.reset, (0, None))(keys, params)
    actions = jax.vmap(env.action_space(params).sample)(draws)
    return keys, obs, state, actions


@each
def test_spaces_hold_and_one_is_as_many(make):
    env, params = make()
    keys, obs, state, actions = batch(env, params, 5)
    space = env.observation_space(params)
    assert all(space.contains(jax.tree.map(lambda x, i=i: x[i], obs)) for i in range(5))
    many = jax.jit(jax.vmap(env.step, (0, 0, 0, None)))(keys, state, actions, params)
    assert jax.tree.structure(many[1]) == jax.tree.structure(state)
    chex.assert_trees_all_equal_shapes_and_dtypes(many[1], state)
    step = jax.jit(env.step)
    for i in range(5):
        alone = step(keys[i], jax.tree.map(lambda x, i=i: x[i], state), actions[i], params)
        assert space.contains(alone[0])
        chex.assert_trees_all_close(alone, jax.tree.map(lambda x, i=i: x[i], many), atol=2e-5)
    eager = env.step(keys[0], jax.tree.map(lambda x: x[0], state), actions[0], params)
    chex.assert_trees_all_close(eager, jax.tree.map(lambda x: x[0], many), atol=2e-5)


@each
def test_a_new_episode_begins_where_one_ended(make):
    env, params = make()
    params = replace(params, limit=jnp.array(2))
    step, go_on = jax.jit(env.step), jax.jit(env.step_env)
    key, (obs, state) = KEY, env.reset(KEY, params)
    for time in (1, 2):
        key, own = jax.random.split(key)
        action = jnp.argmax(env.legal(state, params)) if hasattr(env, "legal") else jnp.array([-0.5, 0, 0.5, 0.1])
        alone = go_on(own, state, action, params)
        obs, state, reward, terminated, truncated, info = step(own, state, action, params)
        chex.assert_trees_all_close(info["final_observation"], alone[0], atol=1e-5)
        assert float(reward) == pytest.approx(float(alone[2]), abs=1e-5)
        assert (bool(terminated), bool(truncated)) == (False, time == 2)
        assert bool(info["truncated"]) == (time == 2)
        assert not info["terminated"]
        if time == 1:
            chex.assert_trees_all_close((obs, state), alone[:2], atol=1e-5)
    first = env.reset(jax.random.split(own)[1], params)
    chex.assert_trees_all_close((obs, state), first, atol=1e-5)
    assert np.abs(np.asarray(alone[0]["current"]) - np.asarray(obs["current"])).max() > 0.5


@each
def test_rewards_add_up_to_what_was_gained(make):
    env, params = make()
    measure = env.left if isinstance(env, envs.OnMap) else lambda state: env.distance(state, params)
    _, state = env.reset(KEY, params)
    begun, earned = float(measure(state)), 0.0
    step = jax.jit(env.step_env)
    for k in range(6):
        action = env.action_space(params).sample(jax.random.fold_in(KEY, k))
        _, state, reward, *_ = step(KEY, state, action, params)
        earned += float(reward)
    assert earned == pytest.approx(begun - float(measure(state)), abs=1e-4)
    assert begun != float(measure(state))


@each
def test_numbers_never_retrace(make):
    env, params = make()
    chex.clear_trace_counter()

    @jax.jit
    @chex.assert_max_traces(n=1)
    def step(key, state, action, params):
        return env.step(key, state, action, params)

    _, state = env.reset(KEY, params)
    action = env.action_space(params).sample(KEY)
    for k in range(3):
        changed = jax.tree.map(
            lambda x, k=k: x * (1 + 0.01 * k) if jnp.issubdtype(jnp.result_type(x), jnp.floating) else x, params
        )
        _, state, *_ = step(KEY, state, action, replace(changed, limit=20 + k))


def test_the_planners_walk_solves_a_map_in_as_many_steps():
    for name in "AST":
        dig, _ = goals.letter_map(name)
        env, params = js.make("single-stroke", goals=one_map(dig), step_cost=1.0)
        plan = js.plan(dig)
        _, state = env.reset(KEY, params)
        step, legal = jax.jit(env.step_env), jax.jit(env.legal)
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
    dig, _ = goals.letter_map("R")
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
        js.planner.make_problem(dig, tuple(start.tolist()))  # raises if it falls into pieces
        sizes.append(dig.sum())
    assert min(sizes) >= 2
    assert max(sizes) <= 21
    straight = envs.pool_of(envs.Walks(4, 4, 1.0), KEY, 64, (9, 9))
    spans = [np.ptp(np.argwhere(dig), axis=0) for dig in np.asarray(straight.dig)]
    turning = envs.pool_of(envs.Walks(4, 4, 0.0), KEY, 64, (9, 9))
    assert all(min(span) == 0 for span in spans)
    assert not any(min(np.ptp(np.argwhere(dig), axis=0)) == 0 for dig in np.asarray(turning.dig))


@pytest.mark.slow
def test_a_glyphs_own_strokes_make_it():
    strokes = goals.letter_strokes("T")
    env, params = js.make("multi-stroke", goals={"T": strokes}, limit=len(strokes))
    _, state = env.reset(KEY, params)
    begun = float(env.distance(state, params))
    step = jax.jit(env.step_env)
    for stroke in task.place(strokes):
        action = env.action(stroke, params)
        assert env.stroke(action, params) == pytest.approx(stroke, abs=1e-7)
        _, state, _, terminated, truncated, info = step(KEY, state, action, params)
        assert int(info["outcome"]) == 0
    assert (bool(terminated), bool(truncated)) == (False, True)
    assert float(env.distance(state, params)) < 1e-3 * begun
    whole = np.zeros((32, 32), np.float32)
    scene = js.make_scene((32, 32), 0.01, tool=js.Blade())
    for stroke in task.place(strokes):
        whole = js.step(scene, whole, stroke).height
    assert np.abs(np.asarray(whole) - np.asarray(params.goals.goals[0])).max() < 1e-6  # as the simulator has it


def test_actions_reach_from_the_first_to_the_last_cell():
    env, params = small()
    assert env.stroke(jnp.array([-1.0, -1, 1, 1]), params).tolist() == pytest.approx([0.005, 0.005, 0.155, 0.155])
    with_stop, _ = small(stop=envs.Stop())
    assert with_stop.action([0.005, 0.005, 0.155, 0.155], params).tolist() == pytest.approx([-1, -1, 1, 1, -1])


def test_a_stop_ends_an_episode_in_place_of_a_push():
    env, params = small(stop=envs.Stop())
    _, state = env.reset(KEY, params)
    push = jnp.array([-0.5, -0.5, 0.5, 0.3])
    _, after, _, goes_on, _, _ = env.step_env(KEY, state, jnp.append(push, -1), params)
    assert not goes_on
    assert np.abs(after.height).max() > 0
    _, after, reward, terminated, truncated, _ = env.step_env(KEY, state, jnp.append(push, 1), params)
    assert (float(reward), bool(terminated), bool(truncated)) == (0, True, False)
    assert not np.abs(after.height).any()


def test_a_push_that_is_not_finite_leaves_the_map():
    env, params = small()
    _, state = env.reset(KEY, params)
    _, after, reward, *_, info = env.step_env(KEY, state, jnp.array([0.0, jnp.nan, 0, 0]), params)
    assert int(info["outcome"]) & js.Outcome.NOT_FINITE
    assert float(reward) == 0
    assert np.array_equal(after.height, state.height)


def test_rough_starts_are_at_rest_and_their_goals_are_made_from_them():
    env, params = small(starts=envs.Rough(0.03, 2.0))
    keys = jax.random.split(KEY, 8)
    _, states = jax.vmap(env.reset, (0, None))(keys, params)
    assert len(np.unique(np.asarray(states.height).reshape(8, -1), axis=0)) == 2
    for height in np.asarray(params.goals.starts):
        assert float(steepest_slope(SMALL, height)) < MU + 2e-3
        assert np.ptp(height) > 0.005
    goals_, starts = (np.asarray(x) for x in (params.goals.goals, params.goals.starts))
    changed = np.abs(goals_[:, None] - starts[None]).sum((2, 3))
    assert (changed.argmin(1) == [0, 1]).all()
    assert (changed.min(1) > 0.1).all()


@pytest.mark.slow
def test_the_angle_of_repose_may_differ_from_one_environment_to_the_next():
    env, params = small(batching=ByLength(2))
    angles = jnp.array([0.3, 0.5, 0.6, 0.45, 0.35])
    keys, _, state, actions = batch(env, params, 5)

    def sand(angle):
        return replace(params, scene=replace(params.scene, material=js.Material(angle)))

    axes = jax.tree.map(lambda _: None, params)
    axes = replace(axes, scene=replace(axes.scene, material=js.Material(0)))
    many = jax.vmap(env.step, (0, 0, 0, axes))(keys, state, actions, sand(angles))
    for i, angle in enumerate(angles):
        alone = env.step(keys[i], jax.tree.map(lambda x, i=i: x[i], state), actions[i], sand(angle))
        assert many[2][i] == pytest.approx(float(alone[2]), abs=1e-5)
    assert len(np.unique(np.asarray(many[2]).round(4))) == 5


@pytest.mark.parametrize(("size", "chunk"), [(7, 2), (1, 4), (5, 8)])
def test_sorting_a_batch_changes_no_map(size, chunk):
    """Whatever is numpy's and whatever is batched; the next test does it with a real push."""

    def push(scene, height, stroke):
        return height * stroke[0] + scene["angle"], stroke[2:].astype(int).sum()

    rng = np.random.default_rng(0)
    strokes, maps, angles = rng.uniform(0, 9, (size, 4)), rng.uniform(size=(size, 3, 2)), rng.uniform(size=size)
    sorted_ = sorted_by_length(ByLength(chunk), push)
    for scenes, axes in (({"angle": angles}, (0, 0, 0)), ({"angle": 0.5}, (None, 0, 0)), ({"angle": 0.5}, (None, 0, None))):
        inputs = scenes, maps, strokes if axes[2] == 0 else jnp.asarray(strokes[0])
        chex.assert_trees_all_close(jax.vmap(sorted_, axes)(*inputs), jax.vmap(push, axes)(*inputs))
    seeds = jax.vmap(jax.vmap(sorted_, (None, 0, None)), (None, None, 0))({"angle": 0.5}, maps, strokes)
    expected = jax.vmap(jax.vmap(push, (None, 0, None)), (None, None, 0))({"angle": 0.5}, maps, strokes)
    chex.assert_trees_all_close(seeds, expected)


def test_only_what_is_dug_counts_for_drawn_goals():
    drawn = np.zeros((1, 16, 16), np.float32)
    drawn[0, 6:10, 6:10] = -0.0075
    berms = jnp.asarray(drawn[0]).at[2].set(0.004)
    for measure, far in ((envs.OnlyDug(), 0.0), (envs.WithBerms(), 4 * 0.004 / 0.0075)):
        env, params = small(goals=drawn, measure=measure)
        _, state = env.reset(KEY, params)
        assert float(env.distance(replace(state, height=berms), params)) == pytest.approx(far)


def test_a_batch_by_length_is_its_maps():
    push = ByLength(2).pushing(QUICK, js.Sweeps(8))
    rng = np.random.default_rng(1)
    strokes, maps = rng.uniform(0.02, 0.14, (5, 4)).astype("float32"), np.zeros((5, 16, 16), "float32")
    many, outcome = jax.jit(jax.vmap(push, (None, 0, 0)))(SMALL, maps, strokes)
    assert len({round(float(h.min()), 5) for h in many}) > 1
    alone = jax.jit(push)
    for i in range(5):
        height, code = alone(SMALL, maps[i], strokes[i])
        np.testing.assert_allclose(many[i], height, atol=2e-6)
        assert int(code) == int(outcome[i])


def test_the_fast_push_digs_too():
    env, params = small(push=js.SwathPush(), limit=2)
    _, state = env.reset(KEY, params)
    action = env.action(jnp.array([0.03, 0.05, 0.13, 0.08]), params)
    _, after, *_, info = jax.jit(env.step_env)(KEY, state, action, params)
    assert int(info["outcome"]) == 0
    assert float(after.height.min()) < -0.005


def test_a_walk_on_sand_ends_with_the_planners_and_digs():
    dig, _ = goals.letter_map("L")
    env, params = js.make("single-stroke", on=envs.OnSand(), goals=one_map(dig))
    _, state = env.reset(KEY, params)
    step = jax.jit(env.step_env)
    for letter in js.plan(dig).path:
        _, state, _, terminated, _, info = step(KEY, state, "NESW".index(letter), params)
        assert int(info["outcome"]) == 0
    assert terminated
    lifted = js.settle(params.scene, state.height).height
    assert float(task.iou(env.goal(state.walk, params), lifted, params.scene.tool.depth)) > 0.85


def test_spaces_know_what_belongs_to_them():
    box, choice = envs.Box(-1, 1, (3,)), envs.Discrete(4)
    assert box.contains(jnp.array([0.0, 1, -1]))
    assert not box.contains(jnp.array([0.0, 1.1, -1]))
    assert not box.contains(jnp.array([jnp.nan, 0, 0]))
    assert not box.contains(jnp.zeros(2))
    assert choice.contains(3)
    assert not choice.contains(4)
    assert not choice.contains(0.5)
    both = envs.Dict({"a": box, "b": choice})
    assert both.contains(both.sample(KEY))
    assert not both.contains({"a": jnp.zeros(3)})
    drawn = jax.jit(jax.vmap(envs.Box(0, jnp.inf, ()).sample))(jax.random.split(KEY, 64))
    assert (drawn >= 0).all()
    assert drawn.max() > 1
    assert jax.vmap(envs.Box(-jnp.inf, jnp.inf, ()).sample)(jax.random.split(KEY, 64)).min() < -1


@pytest.mark.parametrize(
    ("build", "message"),
    [
        (lambda: js.make("sand"), "^name: got 'sand'; give single-stroke or multi-stroke"),
        (lambda: js.make("multi-stroke", wind=1, goals=np.zeros((1, 32, 32))), "^wind: no option of multi-stroke"),
        (lambda: js.make("single-stroke", wind=1), "^wind: no option of single-stroke"),
        (lambda: js.make("single-stroke", scene=SMALL), "^scene: has no effect on a binary map"),
        (lambda: js.make("single-stroke", on=envs.OnSand(), scene=SMALL), r"^scene: got \[16, 16\] cells.*\[62, 62\]"),
        (lambda: small(goals=np.zeros((2, 5, 5))), r"^goals: got shape \[5, 5\], the scene has \[16, 16\]"),
        (lambda: small(goals=np.zeros((16, 16))), r"^goals: got shape \[16, 16\]; give one or more maps"),
        (lambda: small(goals=[np.zeros((16, 16))]), "^goals: got list; give RandomStrokes"),
        (lambda: small(starts="rough"), "^starts: got 'rough'; give Level"),
        (lambda: small(goals={"x": []}), "^goals: got a glyph without strokes"),
        (lambda: small(goals={"x": [[0, 0, 1, 1], [0]]}), "^goals: got a glyph without strokes, 'x'; give names"),
        (lambda: small(goals=np.array([[["a"]]])), "^goals: got <U1; give one or more maps"),
        (
            lambda: small(goals=envs.LevelGoals(jnp.zeros((1, 5, 5)))),
            r"^goals: got maps of \[5, 5\], the scene has \[16, 16\]",
        ),
        (
            lambda: small(goals=envs.LevelGoals(jnp.zeros((1, 16, 16))), starts=envs.Level()),
            "^starts: got Level.*leave it out",
        ),
        (lambda: small(push="fast"), r"^push: got 'fast'; give one of SteppedPush\(\.\.\.\), SwathPush"),
        (lambda: small(stop=True), r"^stop: got True; give one of NoStop"),
        (lambda: small(batching=ByLength), r"^batching: got <class.*; give one of Together\(\.\.\.\), ByLength"),
        (lambda: small(settle=0.1), "^settle: got 0.1; give one of UntilStill.*None"),
        (lambda: small(limit=0), "^limit: got 0; give 1 step or more"),
        (lambda: small(limit="a"), "^limit: got 'a'; give 1 step or more"),
        (lambda: small(seed=-1), "^seed: got -1; give a whole number"),
        (lambda: small(scene="x"), "^scene: got 'x'; give make_scene"),
        (lambda: small(scene=js.make_scene((16, 16), 0.01)), "^scene.tool: got NoTool"),
        (lambda: js.make("single-stroke", on="sand"), r"^on: got 'sand'; give one of OnMap\(\.\.\.\), OnSand"),
        (lambda: js.make("single-stroke", goals="letters"), r"^goals: got 'letters'; give one of MapPool"),
        (lambda: js.make("single-stroke", limit=-3), "^limit: got -3"),
        (lambda: ByLength(0), "^chunk: got 0; give a whole number of at least 1"),
        (lambda: small(starts=envs.Rough(np.inf)), "^starts: got Rough"),
        (lambda: small(goals=envs.RandomStrokes(fewest=3, most=2)), "^goals: got RandomStrokes.*fewest <= most"),
        (lambda: small(starts=envs.Rough(-1.0)), "^starts: got Rough"),
        (lambda: one_map(np.eye(2, dtype=bool)), "^map: got 2 pieces"),
        (lambda: envs.map_pool([]), "^maps: got shapes"),
        (lambda: envs.OnMap((2, 2)).reset(KEY, envs.MapParams(LETTERS)), r"^goals.dig: got maps of \[7, 7\]"),
    ],
)
def test_what_cannot_be_made_is_said(build, message):
    with pytest.raises(ValueError, match=message):
        build()
