"""DDPG's parts do what they say, and sand is one more environment; whether it learns: see test_probes."""

from dataclasses import replace
from functools import partial
from itertools import pairwise

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxsand.envs.multi import LevelGoals, MultiStroke, StrokeParams, StrokeState
from jaxsand.goals.usual import usual_scene
from jaxsand.planning.stroke_loss import pushed
from jaxsand.scene.scene import make_scene
from jaxsand.scene.tools import Blade
from train.ddpg.acting import Acts
from train.ddpg.learner import Ddpg, _drawn, begin, practise
from train.ddpg.learner import update as eager_update
from train.ddpg.networks import Actor, Critic, Flat, Maps
from train.ddpg.tasks import Strokes
from train.evaluation.probes import ByBoth, Constant, Late
from train.replay.her import Future, Steps
from train.runs.runs import learner_of, load, run

from .test_probes import prober

DEPTH = float(Blade().depth)

update = jax.jit(eager_update, static_argnames="learner")


def bits(state):
    leaves = jax.tree.leaves(state)
    return [np.asarray(jax.random.key_data(x) if jnp.issubdtype(x.dtype, jax.dtypes.prng_key) else x) for x in leaves]


@pytest.mark.wide
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
        assert (
            loss[True, terminated] == loss[False, terminated] == pytest.approx(float(np.mean((target - now) ** 2)), rel=1e-5)
        )


def test_slow_copies_follow_by_a_share():
    learner = prober(Constant())
    before = learner.init(0).agent
    seen = jnp.ones((6, 2), jnp.float32)
    some = Steps(seen, seen[:, :1], seen[:, 0], seen[:, 0] > 0, seen, seen[:, 0] > 0)
    after = update(learner, before, some)[0]
    for slow, new, old in (
        (after.slow_critic, after.critic, before.slow_critic),
        (after.slow_actor, after.actor, before.slow_actor),
    ):
        want = jax.tree.map(lambda n, o: 0.95 * o + 0.05 * n, new, old)
        jax.tree.map(partial(np.testing.assert_allclose, atol=1e-7), slow, want)
    assert any(np.any(a != b) for a, b in zip(bits(after.critic), bits(before.critic), strict=True))


@pytest.mark.wide
def test_updates_of_many_agents_at_once_are_each_one_s_own():
    learner = prober(ByBoth())
    one = learner.init(0).agent
    agents = jax.tree.map(lambda x: jnp.stack([x, 1.5 * x if x.ndim else x]), one)
    seen, after = jax.random.normal(jax.random.key(2), (2, 2, 6, 2), jnp.float32)
    no = jnp.zeros((2, 6), bool)
    some = Steps(seen, jnp.tanh(seen[..., :1]), seen[..., 1], no, after, no)
    together, metrics = jax.vmap(partial(update, learner))(agents, some)
    for k in range(2):
        alone, figures = update(learner, *jax.tree.map(lambda x, k=k: x[k], (agents, some)))
        jax.tree.map(
            partial(np.testing.assert_allclose, rtol=1e-4, atol=1e-5), jax.tree.map(lambda x, k=k: x[k], together), alone
        )
        assert float(metrics["loss"][k]) == pytest.approx(float(figures["loss"]), rel=1e-4)


@pytest.mark.slow
def test_many_seeds_at_once_learn_what_each_learns_alone():
    learner = prober(ByBoth(), warm=1)
    params = learner.world()[1]
    together = jax.vmap(partial(begin, learner, params))(jax.random.split(jax.random.key(7), 3))
    alone = [jax.tree.map(lambda x, k=k: x[k], together) for k in range(3)]
    for _ in range(2):
        together, metrics = jax.vmap(partial(practise, learner, params))(together)
        alone = [practise(learner, params, state)[0] for state in alone]
    for k, state in enumerate(alone):
        of_one = bits(jax.tree.map(lambda x, k=k: x[k], together.agent))
        for a, b in zip(of_one, bits(state.agent), strict=True):
            np.testing.assert_allclose(a, b, rtol=1e-3, atol=1e-4)
    assert len({float(x) for x in metrics["loss"]}) == 3


@pytest.mark.wide
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
    with pytest.raises(ValueError, match="strategy: these observations hold no goal"):
        learner.advance(learner.init(0))
    learner = replace(prober(Constant()), exchange=0.5)
    with pytest.raises(ValueError, match="exchange: these observations hold no goal"):
        learner.advance(learner.init(0))


def test_half_of_what_is_learned_from_has_another_s_goal_and_all_is_rewarded_for_its_own():
    learner = Ddpg(batch=64, steps=1)
    maps = jnp.arange(64, dtype=jnp.float16)[:, None, None, None] * jnp.ones((1, 1, 4, 4), jnp.float16) / 64
    none = jnp.zeros((64, 1), bool)
    rows = Steps(
        {"goal": -maps, "current": 0 * maps},
        jnp.zeros((64, 1, 4)),
        jnp.zeros((64, 1)),
        none,
        {"goal": -maps, "current": maps},
        none,
    )
    some = _drawn(learner, jax.random.key(0), rows)
    goal, made = some.after["goal"][:, 0, 0], some.after["current"][:, 0, 0]
    others = np.asarray(jnp.abs(goal) != made)
    assert 0.3 < others[1:].mean() < 0.7
    kept = ~others & np.asarray(goal < 0)  # whose reward is the stored one
    want = learner.task.reward(some.observation, some.after, some.reward)
    np.testing.assert_allclose(np.where(kept, 0, want), np.where(kept, 0, some.reward), rtol=1e-5)


def test_the_judge_rewards_what_is_gone_of_the_squared_distance_of_any_goal():
    env, params = MultiStroke(), StrokeParams(usual_scene(), LevelGoals(jnp.zeros((1, 32, 32), jnp.float32)))
    goal, before, after = 0.005 * jax.random.normal(jax.random.key(0), (3, 32, 32), jnp.float32)
    states = [StrokeState(goal, x, jnp.int32(0)) for x in (before, after)]
    far = [float(env.distance(state, params)) for state in states]
    seen = [env.observe(state, params) for state in states]
    reward, end = Strokes().judge(seen[0]["current"], seen[1]["current"], seen[0]["goal"])
    assert float(reward) == pytest.approx((far[0] ** 2 - far[1] ** 2) / 5, rel=1e-4)
    assert not end


def test_no_gain_on_sand_exceeds_the_bound_of_values():
    rng = np.random.default_rng(0)
    goal, way = rng.normal(size=(8, 8)), rng.normal(size=(9, 8, 8))
    way[1] = goal  # the best there is
    seen = {"goal": jnp.asarray(goal)[None], "current": jnp.asarray(way[0])[None]}
    most = float(Strokes().most(seen)[0])
    for way_on in (way, way[[0, *[1] * 8]]):
        gained = [float(Strokes().judge(jnp.asarray(a), jnp.asarray(b), jnp.asarray(goal))[0]) for a, b in pairwise(way_on)]
        for discount in (0.5, 0.9, 1.0):
            assert sum(discount**t * r for t, r in enumerate(gained)) <= most + 1e-9
    assert sum(gained) == pytest.approx(most)


@pytest.fixture(scope="module")
def acts():
    look = Maps((4, 4), (8,))
    actor, critic = Actor(look.module(), 4), Critic(look.module())
    maps = {name: jnp.zeros((1, 32, 32), jnp.float32) for name in ("goal", "current")}
    of_actor = jax.jit(actor.init)(jax.random.key(0), maps)
    of_critic = jax.jit(critic.init)(jax.random.key(1), maps, jnp.zeros((1, 4), jnp.float32))
    return Acts(actor, critic, of_actor, of_critic, 0.2)


@pytest.mark.wide
def test_its_policy_proposes_strokes_ranked_by_the_critic_its_own_alone(acts):
    scene = usual_scene()
    env, params = MultiStroke(), StrokeParams(scene, LevelGoals(jnp.zeros((1, 32, 32), jnp.float32)))
    goal = 0.005 * np.random.default_rng(0).standard_normal((3, 32, 32)).astype(np.float32)
    strokes, values = acts.propose(scene, goal, 0 * goal, 5)
    assert strokes.shape == (3, 5, 4)
    assert np.all(np.diff(values, axis=1) <= 0)
    assert np.all((strokes >= 0.005 - 1e-6) & (strokes <= 0.315 + 1e-6))
    maps = {"goal": jnp.asarray(goal) / 0.0075, "current": jnp.zeros((3, 32, 32), jnp.float32)}
    own, best = acts.propose(scene, goal, 0 * goal, 1)
    actions = acts.act(maps)
    np.testing.assert_allclose(own[:, 0], [env.stroke(action, params) for action in actions], rtol=1e-5)
    np.testing.assert_allclose(best[:, 0], acts.critic.apply(acts.of_critic, maps, actions), rtol=1e-3, atol=1e-7)
    assert np.all(values[:, 0] > best[:, 0])
    back = jnp.stack([env.action(stroke, params) for stroke in jnp.asarray(strokes[:, 0], jnp.float32)])
    np.testing.assert_allclose(acts.critic.apply(acts.of_critic, maps, back), values[:, 0], rtol=1e-3, atol=1e-7)


@pytest.mark.parametrize(
    ("scene", "said"),
    [
        (make_scene((16, 16), 0.01, tool=Blade()), r"scene.grid.shape: got \(16, 16\)"),
        (make_scene((32, 32), 0.01), "scene.tool: got NoTool"),
    ],
)
def test_scenes_that_it_does_not_know_are_said(acts, scene, said):
    flat = np.zeros((1, *scene.grid.shape))
    with pytest.raises(ValueError, match=said):
        acts.propose(scene, flat, flat)


def test_the_paper_s_setting_is_ddpg_with_hindsight_on_flat_layers_for_ten_thousand_episodes():
    paper = Ddpg.paper()
    assert paper.sight == Flat((256, 256, 256))
    assert paper.strategy == Future(4)
    assert paper.task.count == paper.steps
    chunks = Ddpg.chunks(paper, 10_000)
    assert (chunks - 1) * paper.envs < 10_000 <= chunks * paper.envs


@pytest.mark.slow
@pytest.mark.long
def test_one_stroke_on_sand_is_learned():
    learner = Ddpg(task=Strokes(count=1, goals=256, trials=32), steps=1)
    state = learner.init(0)
    first = learner.validate(state)
    for _ in range(16):
        state, metrics = learner.advance(state)
    last = learner.validate(state)
    assert set(last) == {"score", "right"}
    assert first["right"] == 0
    assert last["right"] > 0.15
    assert last["score"] < 1
    assert np.isfinite([*metrics.values()]).all()
    rows = jax.tree.map(lambda x: np.asarray(x[0, :64], np.float32), state.memory.experience)
    for some in range(64):
        maps = rows.observation["current"][some, 0], rows.after["current"][some, 0], rows.observation["goal"][some, 0]
        assert float(learner.task.judge(*maps)[0]) == pytest.approx(rows.reward[some, 0], abs=0.05)  # in half precision
    assert rows.ended.all()
    assert not rows.terminated.any()


@pytest.mark.slow
@pytest.mark.parametrize(("exchange", "least", "most"), [(0.0, -0.5, 0.5), (0.5, 2.0, 6.0)])
def test_without_others_goals_the_critic_does_not_look_at_the_action(exchange, least, most):
    """By hindsight alone it values strokes as high on goals that they miss as on those they made; 5 apart they should be."""
    learner = Ddpg(task=Strokes(count=1, goals=256, trials=32), steps=1, exchange=exchange, updates=32)
    state = learner.init(0)
    for _ in range(6):
        state, _ = learner.advance(state)
    env, params = learner.world()
    actions = jax.random.uniform(jax.random.key(1), (32, 4), jnp.float32, -1, 1)
    level, strokes = np.zeros((32, 32, 32), np.float32), np.stack([env.stroke(action, params) for action in actions])
    goals = jnp.asarray(pushed(params.scene, level, strokes)) / DEPTH
    seen = {"goal": goals, "current": jnp.asarray(level)}
    own, others = (learner.critic.apply(state.agent.critic, seen, a) for a in (actions, jnp.roll(actions, 1, 0)))
    assert least < float(jnp.mean(own - others)) < most
