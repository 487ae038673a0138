"""DDPG finds the known values of probes, its parts do what they say, and sand is one more environment."""

from dataclasses import replace
from functools import cache, partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxsand.env.multi import LevelGoals, MultiStroke, StrokeParams
from jaxsand.env.pushing import Together
from jaxsand.scene import make_scene
from jaxsand.swath import SwathPush
from jaxsand.tool import Blade
from train import tasks
from train.ddpg import Ddpg, begin, practise, update
from train.her import Future, Own, Steps
from train.nets import Flat, Maps
from train.probes import QUESTIONS, ByBoth, Constant, Late, Line, Probe, Two
from train.runs import learner_of, load, run
from train.sand import usual_scene
from train.tasks import Probing, Strokes


def prober(question, **options):
    return Ddpg(
        task=Probing(Probe(question, Line())),
        sight=Flat((32, 32)),
        strategy=Own(),
        actor_rate=2e-3,
        critic_rate=5e-3,
        follow=0.05,
        calm=0.0,
        noise=0.3,
        envs=16,
        steps=4,
        updates=100,
        batch=64,
        capacity=512,
        every=4,
        **options,
    )


def bits(state):
    leaves = jax.tree.leaves(state)
    return [np.asarray(jax.random.key_data(x) if jnp.issubdtype(x.dtype, jax.dtypes.prng_key) else x) for x in leaves]


@pytest.mark.parametrize("question", QUESTIONS, ids=lambda q: type(q).__name__)
def test_the_critic_and_the_actor_find_a_probe_s_known_values(question):
    learner = prober(question)
    probe = learner.task.probe
    state = learner.init(0)
    for _ in range(12):
        state, _ = learner.advance(state)
    assert learner.validate(state)["score"] > -0.02
    for place in probe.states():
        seen = probe.observe(place)[None]
        action = learner.policy(state).act(seen)
        value = learner.critic.apply(state.agent.critic, seen, action)
        assert abs(float(value[0]) - probe.value(place, action[0], learner.discount)) < 0.05


@pytest.mark.parametrize("actions", [Two(), Line()], ids=lambda a: type(a).__name__)
@pytest.mark.parametrize("question", QUESTIONS, ids=lambda q: type(q).__name__)
def test_probes_keep_the_protocol_and_their_values_are_what_their_best_actions_bring(question, actions):
    probe = Probe(question, actions)
    for state in probe.states():
        brought, factor, now = 0.0, 1.0, state
        while True:
            best = probe.best(now)
            assert probe.action_space(None).contains(best)
            seen, new, reward, terminated, truncated, info = probe.step(jax.random.key(1), now, best, None)
            brought, factor = brought + factor * float(reward), factor * 0.9
            assert not truncated
            assert probe.observation_space(None).contains(info["final_observation"])
            if terminated:
                break
            np.testing.assert_array_equal(seen, info["final_observation"])
            now = new
        np.testing.assert_array_equal(seen, probe.reset(jax.random.split(jax.random.key(1))[1], None)[0])
        assert probe.value(state, probe.best(state), 0.9) == pytest.approx(brought)
        other = probe.actions.space.sample(jax.random.key(3))
        assert probe.value(state, other, 0.9) <= probe.value(state, probe.best(state), 0.9) + 1e-6


def test_a_time_limit_is_no_end_and_a_terminated_step_has_no_value_ahead():
    learner = prober(Constant())
    agent = learner.init(0).agent
    key = jax.random.key(5)
    seen, after = jax.random.normal(key, (2, 6, 2), jnp.float32)
    action = jnp.full((6, 1), 0.5, jnp.float32)
    loss = {}
    for ended in (True, False):
        for terminated in (True, False):
            done, over = jnp.full(6, terminated), jnp.full(6, ended)
            some = Steps(seen, action, jnp.arange(6.0, dtype=jnp.float32), done, after, over)
            loss[ended, terminated] = float(update(learner, agent, some)[1]["loss"])
    ahead = learner.critic.apply(agent.slow_critic, after, learner.actor.apply(agent.slow_actor, after)[0])
    now = learner.critic.apply(agent.critic, seen, action)
    for terminated, target in ((True, np.arange(6)), (False, np.arange(6) + learner.discount * ahead)):
        assert loss[True, terminated] == loss[False, terminated] == pytest.approx(float(np.mean((target - now) ** 2)), rel=1e-5)


def test_slow_copies_follow_by_a_share():
    learner = prober(Constant(), random=1.0)
    before = learner.init(0).agent
    seen = jnp.ones((3, 2), jnp.float32)
    some = Steps(seen, seen[:, :1], seen[:, 0], seen[:, 0] > 0, seen, seen[:, 0] > 0)
    after = update(learner, before, some)[0]
    for slow, new, old in (
        (after.slow_critic, after.critic, before.slow_critic),
        (after.slow_actor, after.actor, before.slow_actor),
    ):
        want = jax.tree.map(lambda n, o: 0.95 * o + 0.05 * n, new, old)
        jax.tree.map(partial(np.testing.assert_allclose, atol=1e-7), slow, want)
    assert any(np.any(a != b) for a, b in zip(bits(after.critic), bits(before.critic), strict=True))


def test_many_seeds_at_once_learn_what_each_learns_alone():
    learner = prober(ByBoth(), warm=1)
    params = learner.world()[1]
    keys = jax.random.split(jax.random.key(7), 3)
    together = jax.vmap(partial(begin, learner, params))(keys)
    alone = [begin(learner, params, key) for key in keys]
    for _ in range(2):
        together, metrics = jax.vmap(partial(practise, learner, params))(together)
        alone = [practise(learner, params, state)[0] for state in alone]
    for k, state in enumerate(alone):
        of_one = bits(jax.tree.map(lambda x, k=k: x[k], together.agent))
        for a, b in zip(of_one, bits(state.agent), strict=True):
            np.testing.assert_allclose(a, b, rtol=1e-3, atol=1e-4)
    assert metrics["loss"].shape == (3,)
    assert len({float(x) for x in metrics["loss"]}) == 3


def test_a_chunk_follows_from_the_state_alone_and_a_run_can_be_gone_on_with(tmp_path):
    learner = prober(Late())
    run(learner, tmp_path / "whole", 5, steps=8)
    run(learner, tmp_path / "parts", 5, steps=3)
    run(learner, tmp_path / "parts", 5, steps=8, resume=True)
    again = learner_of(tmp_path / "parts")
    assert again == learner
    one, two = (load(tmp_path / name, again, "last") for name in ("whole", "parts"))
    for a, b in zip(bits(one), bits(two), strict=True):
        np.testing.assert_array_equal(a, b)


def test_a_probe_has_no_goals_to_learn_from_in_hindsight():
    learner = replace(prober(Constant()), strategy=Future(2))
    with pytest.raises((ValueError, TypeError, IndexError)):
        learner.advance(learner.init(0))


# Sand: a fast push, so that it stays quick.


@cache
def small_world(count, goals, seed):
    del goals
    rng = np.random.default_rng(seed)
    scene = usual_scene()
    start = np.zeros((8, 32, 32), np.float32)
    strokes = rng.uniform(0.05, 0.27, (8, 4)).astype(np.float32)
    env = MultiStroke(push=SwathPush(), batching=Together())
    push = jax.jit(jax.vmap(env.batching.pushing(env.push, env.settle), (None, 0, 0)))
    return StrokeParams(scene, LevelGoals(push(scene, start, strokes)[0]), count)


@pytest.fixture
def sand(monkeypatch):
    monkeypatch.setattr(tasks, "_goals", small_world)
    monkeypatch.setattr(tasks, "_ENV", MultiStroke(push=SwathPush(), batching=Together()))
    return Ddpg(
        task=Strokes(count=2, goals=8, trials=8), sight=Maps((8, 8), (16,)), envs=4, steps=2, updates=2, batch=4, capacity=8
    )


def test_it_learns_on_sand_in_hindsight_and_its_judge_is_the_environment_s_reward(sand):
    state, metrics = sand.advance(sand.init(0))
    assert np.isfinite([*metrics.values()]).all()
    rows = state.memory.experience
    full = jax.tree.map(lambda x: np.asarray(x[0, :4], np.float32), rows)
    for e in range(4):
        for t in range(2):
            reward, end = sand.task.judge(
                full.observation["current"][e, t], full.after["current"][e, t], full.observation["goal"][e, t]
            )
            assert float(reward) == pytest.approx(full.reward[e, t], abs=0.02)  # remembered in half precision
            assert not end
    assert np.array_equal(full.ended[:, 1], np.ones(4))
    np.testing.assert_array_equal(full.after["current"][:, 0], full.observation["current"][:, 1])
    figures = sand.validate(state)
    assert set(figures) == {"score", "right"}
    assert -5 < figures["score"] < 1
    assert sand.validate(state) == figures


def test_its_policy_proposes_strokes_ranked_by_the_critic_its_own_alone(sand):
    state = sand.init(1)
    acts, params = sand.policy(state), small_world(2, 8, 0)
    goal = np.asarray(params.goals.goals[:3])
    strokes, values = acts.propose(params.scene, goal, 0 * goal, 5)
    assert strokes.shape == (3, 5, 4)
    assert np.all(np.diff(values, axis=1) <= 0)
    assert np.all((strokes >= 0.005 - 1e-6) & (strokes <= 0.315 + 1e-6))
    maps = {"goal": jnp.asarray(goal) / 0.0075, "current": jnp.zeros((3, 32, 32), jnp.float32)}
    own, best = acts.propose(params.scene, goal, 0 * goal, 1)
    env = MultiStroke()
    actions = acts.act(maps)
    np.testing.assert_allclose(own[:, 0], [env.stroke(action, params) for action in actions], rtol=1e-5)
    np.testing.assert_allclose(best[:, 0], sand.critic.apply(state.agent.critic, maps, actions), rtol=1e-4, atol=1e-6)
    assert np.all(values[:, 0] >= best[:, 0] - 1e-6)
    back = jnp.stack([env.action(stroke, params) for stroke in jnp.asarray(strokes[:, 0], jnp.float32)])
    np.testing.assert_allclose(sand.critic.apply(state.agent.critic, maps, back), values[:, 0], rtol=1e-3, atol=1e-6)


@pytest.mark.parametrize(
    ("scene", "said"),
    [
        (make_scene((16, 16), 0.01, tool=Blade()), r"scene.grid.shape: got \(16, 16\)"),
        (make_scene((32, 32), 0.01), "scene.tool: got NoTool"),
    ],
)
def test_scenes_that_it_does_not_know_are_said(sand, scene, said):
    flat = np.zeros((1, *scene.grid.shape))
    with pytest.raises(ValueError, match=said):
        sand.policy(sand.init(0)).propose(scene, flat, flat)


def test_the_paper_s_setting_is_ddpg_with_hindsight_on_flat_layers_for_ten_thousand_episodes():
    paper = Ddpg.paper()
    assert paper.sight == Flat((256, 256, 256))
    assert paper.strategy == Future(4)
    assert paper.task.count == paper.steps
    chunks = Ddpg.chunks(paper, 10_000)
    assert (chunks - 1) * paper.envs < 10_000 <= chunks * paper.envs


@pytest.mark.slow
def test_one_stroke_on_sand_is_learned_better_than_chance():
    learner = Ddpg(task=Strokes(count=1, goals=256, trials=32), steps=1)
    state = learner.init(0)
    first = learner.validate(state)["score"]
    for _ in range(30):
        state, _ = learner.advance(state)
    assert learner.validate(state)["score"] > first
