"""Probes keep the protocol of environments, and DDPG finds their known values."""

import jax
import numpy as np
import pytest

from train.ddpg.learner import Ddpg
from train.ddpg.networks import Flat
from train.ddpg.tasks import Probing
from train.evaluation.probes import QUESTIONS, Line, Probe, Two
from train.replay.her import Own


def prober(question, **options):
    return Ddpg(
        task=Probing(Probe(question, Line())),
        sight=Flat((32, 32)),
        strategy=Own(),
        exchange=0.0,
        discount=0.9,
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


@pytest.mark.wide
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
