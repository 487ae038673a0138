"""Hindsight on hand-made rows of steps, and the ring that steps are remembered in."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from train.replay.buffer import Buffer
from train.replay.her import Final, Future, Own, Steps, exchanged, last_steps, mixed, relabel

ENDED = np.array([False, False, True, False, True, False, False])  # episodes 0-2, 3-4, and 5-6, which goes on
LAST = np.array([2, 2, 2, 4, 4, 6, 6])


def row():
    """Step t leads from a place t + 1/2 to t + 1, where an episode does not start anew; the goal is never reached."""
    time = jnp.arange(7.0)
    goal = jnp.full(7, -1.0)
    return Steps(
        observation={"goal": goal, "current": time + 0.5, "pose": time},
        action=time,
        reward=jnp.full(7, -1.0),
        terminated=jnp.zeros(7, bool),
        after={"goal": goal, "current": time + 1, "pose": time + 100},
        ended=jnp.asarray(ENDED),
    )


def judge(before, after, goal):
    return jnp.abs(goal - before) - jnp.abs(goal - after), after == goal


def test_the_last_step_of_an_episode_is_where_it_ended_or_the_row_does():
    np.testing.assert_array_equal(last_steps(jnp.asarray(ENDED)), LAST)


def test_final_gives_what_there_was_at_the_end_as_the_goal_of_both_observations():
    new = relabel(jax.random.key(0), row(), Final(), judge)
    np.testing.assert_array_equal(new.observation["goal"], LAST + 1)
    np.testing.assert_array_equal(new.after["goal"], LAST + 1)
    np.testing.assert_array_equal(new.reward, np.full(7, 0.5))
    np.testing.assert_array_equal(new.terminated, [False, False, True, False, True, False, True])
    for name in ("current", "pose"):
        np.testing.assert_array_equal(new.observation[name], row().observation[name])
        np.testing.assert_array_equal(new.after[name], row().after[name])
    np.testing.assert_array_equal(new.ended, ENDED)
    np.testing.assert_array_equal(new.action, row().action)


def test_future_draws_every_outcome_from_this_step_on_alike_and_none_of_another_episode():
    keys = jax.random.split(jax.random.key(1), 3000)
    goals = np.asarray(jax.vmap(lambda key: relabel(key, row(), Future(), judge).after["goal"])(keys)) - 1
    for t in range(7):
        which, counts = np.unique(goals[:, t], return_counts=True)
        np.testing.assert_array_equal(which, np.arange(t, LAST[t] + 1))
        share = 1 / (LAST[t] + 1 - t)
        assert np.all(np.abs(counts / 3000 - share) < 5 * np.sqrt(share / 3000))


@pytest.mark.parametrize(("strategy", "share"), [(Own(), 1.0), (Final(), 1 / 2), (Future(4), 1 / 5)])
def test_one_step_in_one_and_copies_keeps_its_goal_reward_and_end(strategy, share):
    keys = jax.random.split(jax.random.key(2), 2000)
    new = jax.vmap(lambda key: mixed(key, row(), strategy, judge))(keys)
    own = np.asarray(new.after["goal"]) == -1
    assert abs(own.mean() - share) < 0.02
    np.testing.assert_array_equal(np.asarray(new.reward)[own], -1)
    np.testing.assert_array_equal(np.asarray(new.observation["goal"]), np.asarray(new.after["goal"]))
    assert not np.asarray(new.terminated)[own].any()
    assert np.all(np.asarray(new.reward)[~own] == 0.5)


def test_a_share_has_the_goal_of_the_step_before_it_and_is_judged_by_it():
    steps = relabel(jax.random.key(0), row(), Final(), judge)
    keys = jax.random.split(jax.random.key(3), 2000)
    new = jax.vmap(lambda key: exchanged(key, steps, 0.25, judge))(keys)
    goal, before = np.asarray(new.after["goal"]), np.roll(LAST + 1.0, 1)
    swapped = (goal == before) & (before != LAST + 1)
    assert abs(swapped[:, [0, 3, 5]].mean() - 0.25) < 0.02  # elsewhere the step before has the same goal
    np.testing.assert_array_equal(goal[~swapped], np.broadcast_to(LAST + 1, goal.shape)[~swapped])
    np.testing.assert_array_equal(np.asarray(new.observation["goal"]), goal)
    place = np.asarray(row().observation["current"])
    reward, end = judge(place, place + 0.5, goal)
    np.testing.assert_array_equal(np.asarray(new.reward), reward)
    np.testing.assert_array_equal(np.asarray(new.terminated), end)
    np.testing.assert_array_equal(np.asarray(new.action), np.broadcast_to(row().action, goal.shape))


def test_what_is_neutral_computes_nothing():
    for neutral in (
        lambda key, steps: mixed(key, steps, Own(), judge),
        lambda key, steps: exchanged(key, steps, 0.0, judge),
    ):
        assert not jax.make_jaxpr(neutral)(jax.random.key(0), row()).eqns


def test_goals_may_be_maps():
    steps = row()
    maps = {name: jnp.broadcast_to(x[:, None, None], (7, 2, 3)) for name, x in steps.after.items()}
    steps = Steps(maps, steps.action, steps.reward, steps.terminated, maps, steps.ended)
    new = relabel(jax.random.key(0), steps, Final(), lambda before, after, goal: (jnp.sum(goal), jnp.all(after == goal)))
    np.testing.assert_array_equal(new.after["goal"], np.broadcast_to((LAST + 1)[:, None, None], (7, 2, 3)))
    np.testing.assert_array_equal(new.reward, 6 * (LAST + 1))


def test_the_ring_draws_what_was_added_and_forgets_the_oldest():
    ring = Buffer(capacity=5, batch=5)
    state = ring.init({"x": jnp.zeros(2)})
    state = ring.add(state, {"x": jnp.stack([jnp.arange(3.0)] * 2, 1)})

    def drawn(state):
        keys = jax.random.split(jax.random.key(0), 100)
        items = np.asarray(jax.vmap(lambda key: ring.sample(state, key)["x"])(keys))
        assert items.shape == (100, 5, 2)
        return np.unique(items)

    np.testing.assert_array_equal(drawn(state), [0, 1, 2])
    state = ring.add(state, {"x": jnp.stack([jnp.arange(3.0, 7)] * 2, 1)})
    np.testing.assert_array_equal(drawn(state), [2, 3, 4, 5, 6])
