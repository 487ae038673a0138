"""The actor-critic's parts do what they say, and it finds the known values of a probe; a run goes on bit for bit."""

from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxsand.goals.usual import SHAPE, usual_scene
from jaxsand.planning.learned.network import Scores, best_of
from jaxsand.scene.scene import make_scene
from jaxsand.scene.tools import Blade
from train.actor_critic import learner as learning
from train.actor_critic import practice
from train.actor_critic.acting import Chooses, best
from train.actor_critic.learner import ActorCritic, improve
from train.actor_critic.memory import Batch, Memory, Tries, draw, empty, remembered
from train.actor_critic.network import HIGH, LOW, climbed, drawn, log_likelihood, looked, valued
from train.actor_critic.practice import practise
from train.runs.runs import learner_of, load, run

TINY = ActorCritic(plans=2, tries=7, updates=2, batch=4, capacity=64, every=1, widths=(8, 8, 8), blocks=(0, 0, 0))
SIDE = SHAPE[0]


def rng(seed=0):
    return np.random.default_rng(seed)


def painted(scene, maps, strokes):
    """A stand-in for the push: cells whose centres are within a cell of the stroke are one blade's depth below 0."""
    y, x = np.meshgrid(*[(np.arange(SIDE) + 0.5) * float(scene.grid.spacing)] * 2, indexing="ij")
    a, b = strokes[:, None, None, :2], strokes[:, None, None, 2:]
    point, way = np.stack([x, y], -1)[None], b - a
    part = np.clip(((point - a) * way).sum(-1) / np.maximum((way**2).sum(-1), 1e-12), 0, 1)
    far = np.linalg.norm(point - a - part[..., None] * way, axis=-1)
    return np.where(far < float(scene.grid.spacing), -float(scene.tool.depth), maps).astype(np.float32)


@pytest.fixture
def quick(monkeypatch):
    """Strokes are painted in place of pushed, which compiles nothing, and validation asks no one."""
    for module in ("train.actor_critic.practice", "train.imitation.lessons"):
        monkeypatch.setattr(f"{module}.pushed", painted)
    monkeypatch.setattr(learning, "_SIZES", (4,))
    monkeypatch.setattr(ActorCritic, "validate", lambda _, state: {"score": float(state.chunk)})


def scores_of(start, end):
    """Scores that draw strokes from one cell to another cell, each given as its row and column."""
    cells = np.full(SHAPE, -30.0, np.float32)
    cells[start] = 0
    key = np.zeros((*SHAPE, 1), np.float32)
    key[end] = 30
    query = np.ones((*SHAPE, 1), np.float32)
    return Scores(*(jnp.asarray(x)[None] for x in (cells, query, key)), jnp.zeros((1, 1, *SHAPE, 4), jnp.float32))


def test_strokes_are_drawn_where_the_actor_says():
    strokes = drawn(jax.random.key(0), scores_of((3, 20), (25, 7)), 200)[0]
    assert strokes.shape == (200, 4)
    np.testing.assert_array_equal(np.floor(strokes), np.tile([20.0, 3, 7, 25], (200, 1)))
    assert np.ptp(strokes, axis=0).min() > 0.9
    edge = drawn(jax.random.key(0), scores_of((0, 0), (31, 31)), 50)
    assert (float(edge.min()), float(edge.max())) == (LOW, HIGH)


def test_strokes_are_drawn_as_often_as_is_likely():
    start = jnp.log(jnp.asarray(rng(1).dirichlet(np.ones(SIDE**2)), jnp.float32)).reshape(1, *SHAPE)
    zero = jnp.zeros((1, *SHAPE, 1), jnp.float32)
    scores = Scores(start, zero, zero, zero[:, None])
    cells = np.floor(np.asarray(drawn(jax.random.key(1), scores, 4_000)[0])).astype(int)
    often = np.bincount(cells[:, 1] * SIDE + cells[:, 0], minlength=SIDE**2) / len(cells)
    likely = np.exp(np.asarray(start)).ravel()
    assert np.abs(often - likely).sum() < 0.5
    assert np.corrcoef(often, likely)[0, 1] > 0.85
    ends = np.bincount(cells[:, 3] * SIDE + cells[:, 2], minlength=SIDE**2)
    assert ends.max() < 16


def test_likelihoods_are_of_both_ends():
    generator = rng(2)
    score = jnp.asarray(generator.standard_normal((1, *SHAPE)), jnp.float32)
    query, key = jnp.asarray(generator.standard_normal((2, 1, *SHAPE, 3)), jnp.float32)
    start = score - jax.nn.logsumexp(score)
    scores = Scores(start, query, key, jnp.zeros((1, 1, *SHAPE, 4), jnp.float32))
    y, x = np.meshgrid(np.arange(SIDE) + 0.5, np.arange(SIDE) + 0.5, indexing="ij")
    every = np.stack([np.full_like(x, 4.5), np.full_like(x, 9.5), x, y], -1).reshape(1, -1, 4)
    likely = jnp.exp(log_likelihood(scores, jnp.asarray(every, jnp.float32)))
    assert float(likely.sum()) == pytest.approx(float(jnp.exp(start[0, 9, 4])), rel=1e-4)


def test_climbing_goes_up_and_stays_on_the_map():
    top = jnp.array([[[10.0, 10.4, 20.0, 40.0]]])

    def value(strokes):
        return -jnp.sum((strokes - top) ** 2, -1)

    strokes = jnp.array([[[10.0, 10.0, 20.0, 31.0], [12.0, 9.0, 20.0, 30.0], [10.0, 10.4, 20.0, 31.5]]])
    moved, values = climbed(value, strokes)
    np.testing.assert_allclose(values, value(moved), rtol=1e-6)
    assert np.all(values >= value(strokes))
    assert np.all(values[0, :2] > value(strokes)[0, :2] + 0.05)
    assert float(moved.max()) <= HIGH
    assert np.all(np.linalg.norm(moved - strokes, axis=-1) <= 2.4)


def test_of_strokes_that_are_alike_the_best_is_kept():
    strokes = jnp.array([[[5.0, 5, 9, 9], [5, 6, 9, 9], [5, 5, 9, 20], [5, 5, 9, 19]]])
    kept, scores = best_of(strokes, jnp.array([[1.0, 2, 4, 3]]), 2)
    np.testing.assert_array_equal(kept[0], strokes[0, [2, 1]])
    np.testing.assert_array_equal(scores, [[4, 2]])


def numbered(first, left):
    """Tries whose maps tell which they are: the goal, the current map, and the results of three strokes."""
    number = first + np.arange(len(left))
    full = np.ones(SHAPE, np.float32)
    maps = 0.001 * number[:, None, None] * full
    after = 0.1 + maps[:, None] + 0.01 * np.arange(3)[None, :, None, None] * full
    strokes = np.repeat(number, 12).reshape(-1, 3, 4).astype(np.float32)
    return Tries(1 + maps, maps, strokes, after, np.array(left))


def test_goals_are_own_or_results_of_this_or_later_strokes_of_the_episode():
    left = [2, 1, 0, 1, 0]
    memory = remembered(empty(8, 3), numbered(0, left))
    seen = {}
    for _ in range(20):
        some = draw(memory, rng(len(seen)), 200)
        for goal, current, stroke in zip(some.goal, some.current, some.strokes, strict=True):
            assert stroke[0, 0] == pytest.approx(current[0, 0] / 0.001, abs=0.01)
            seen.setdefault(int(stroke[0, 0]), set()).add(round(float(goal[0, 0]), 3))
    for k, more in enumerate(left):
        own = 1 + 0.001 * k
        results = {0.1 + 0.001 * k + 0.01 * j for j in range(3)} | {0.1 + 0.001 * (k + j) for j in range(more + 1)}
        assert seen[k] == {round(float(np.float16(x)), 3) for x in {own} | results}


def test_the_reward_is_the_squared_distance_that_is_gone():
    memory = remembered(empty(8, 3), numbered(0, [1, 0]))
    some = draw(memory, rng(), 16)
    g, h, after = (
        some.goal[:, 0, 0],
        some.current[:, 0, 0],
        np.float16(0.1 + some.strokes[:, 0, :1] * 0.001 + [[0, 0.01, 0.02]]),
    )
    want = SIDE**2 * ((g - h)[:, None] ** 2 - (g[:, None] - after) ** 2) / 5
    np.testing.assert_allclose(some.reward, want, rtol=2e-3, atol=1e-3)


def test_the_oldest_tries_make_room():
    memory = remembered(remembered(empty(6, 3), numbered(0, [3, 2, 1, 0])), numbered(4, [2, 1, 0]))
    assert memory.added == 7
    np.testing.assert_array_equal(memory.ring.strokes[:, 0, 0], [6, 1, 2, 3, 4, 5])
    seen = {round(float(x), 3) for seed in range(20) for x in draw(memory, rng(seed), 50).current[:, 0, 0]}
    assert seen == {round(0.001 * k, 3) for k in range(1, 7)}
    with pytest.raises(ValueError, match="capacity: got 6, but a chunk has 7 states"):
        remembered(memory, numbered(0, [0] * 7))


def test_both_ways_lead_from_level_sand_by_the_strokes_that_come_first(quick):
    scene, asked = usual_scene(), []

    def choose(goal, current):
        asked.append(len(goal))
        at = rng(len(asked)).uniform(LOW, HIGH, (len(goal), 5, 4))
        return at[:, 0], at

    tries, pushes = practise(scene, rng(), 5, 8, choose)
    assert asked[0] == len(tries.left) / 2 == sum(asked[1:])
    assert tries.strokes.shape == (len(tries.left), 8, 4)
    assert pushes == (1 + 8) * len(tries.left)
    assert np.all((tries.strokes[:, 1:] >= LOW) & (tries.strokes[:, 1:] <= HIGH))
    firsts = [0, *np.flatnonzero(tries.left[:-1] == 0) + 1]
    assert len(firsts) == 10
    for k, left in enumerate(tries.left):
        if k in firsts:
            assert not tries.current[k].any()
        else:
            np.testing.assert_array_equal(tries.current[k], tries.after[k - 1, 0])
            np.testing.assert_array_equal(tries.goal[k], tries.goal[k - 1])
            assert left == tries.left[k - 1] - 1
    ends = np.flatnonzero(tries.left == 0)
    np.testing.assert_array_equal(tries.goal[ends[:5]], tries.after[ends[:5], 0])  # the plan's own strokes
    np.testing.assert_array_equal(tries.goal[ends[:5]], tries.goal[ends[5:]])
    with pytest.raises(ValueError, match="tries: got 5; give 6 or more"):
        practise(scene, rng(), 5, 5, choose)


def test_a_stroke_whose_outcome_is_not_clean_gains_nothing(monkeypatch):
    monkeypatch.setattr(
        practice, "pushed", lambda scene, maps, strokes: np.where(strokes[:, :1, None] > 0.1, np.nan, maps + 1)
    )
    current, strokes = np.zeros((1, *SHAPE), np.float32), np.array([[[5.0, 5, 9, 9], [15, 5, 9, 9]]])
    after = practice._after(usual_scene(), current, strokes)
    assert np.all(after[0, 0] > 1)
    np.testing.assert_array_equal(after[0, 1], current[0])


@pytest.mark.wide
def test_a_chunk_follows_from_the_state_alone_and_a_run_can_be_gone_on_with(tmp_path, quick):
    run(TINY, tmp_path / "whole", 5, steps=2)
    run(TINY, tmp_path / "parts", 5, steps=1)
    run(TINY, tmp_path / "parts", 5, steps=2, resume=True)
    again = learner_of(tmp_path / "parts")
    assert again == TINY
    one, two = (load(tmp_path / name, again, "last") for name in ("whole", "parts"))
    assert int(one.memory.added) > 0
    for a, b in zip(jax.tree.leaves(one), jax.tree.leaves(two), strict=True):
        np.testing.assert_array_equal(a, b)
    before = jax.tree.map(np.array, one)
    after, metrics = TINY.advance(one)
    twin, _ = TINY.advance(one)
    for old, kept, a, b in zip(*map(jax.tree.leaves, (before, one, after, twin)), strict=True):
        np.testing.assert_array_equal(old, kept)
        np.testing.assert_array_equal(a, b)
    assert set(metrics) == {"critic", "actor", "pushes"}
    assert np.isfinite([*metrics.values()]).all()


@pytest.fixture(scope="module")
def chooses():
    return Chooses(TINY.net, TINY.init(0).average)


@pytest.mark.wide
def test_its_policy_proposes_different_strokes_ranked_by_their_values(chooses):
    scene, goal = usual_scene(), 0.005 * rng().standard_normal((3, *SHAPE)).astype(np.float32)
    strokes, values = chooses.propose(scene, goal, 0 * goal, 4)
    assert strokes.shape == (3, 4, 4)
    assert np.all(np.diff(values, axis=1) <= 0)
    assert np.all((strokes >= 0.005 - 1e-6) & (strokes <= 0.315 + 1e-6))
    for some in strokes:
        apart = np.abs(some[:, None] - some[None]).max(-1)[np.triu_indices(4, 1)]
        assert apart.min() >= 0.015 - 1e-6


@pytest.mark.parametrize(
    ("scene", "said"),
    [
        (make_scene((16, 16), 0.01, tool=Blade()), r"scene.grid.shape: got \(16, 16\)"),
        (make_scene((32, 32), 0.01), "scene.tool: got NoTool"),
    ],
)
def test_scenes_that_it_does_not_know_are_said(chooses, scene, said):
    flat = np.zeros((1, *scene.grid.shape))
    with pytest.raises(ValueError, match=said):
        chooses.propose(scene, flat, flat)


def shown(generator, count):
    """A probe: a goal shows a disc, and the reward of a stroke is 1 - (the distance (cells) of its middle from there / 10)^2."""
    middle = generator.uniform(6, 26, (count, 2))
    y, x = np.meshgrid(np.arange(SIDE) + 0.5, np.arange(SIDE) + 0.5, indexing="ij")
    goal = -(np.hypot(x[None] - middle[:, :1, None], y[None] - middle[:, 1:, None]) < 3).astype(np.float32)

    def reward(strokes):
        off = np.linalg.norm((strokes[..., :2] + strokes[..., 2:]) / 2 - middle[:, None], axis=-1)
        return np.maximum(1 - (off / 10) ** 2, -2)

    return goal, reward


@pytest.mark.wide
def test_it_finds_the_known_values_of_a_probe_on_maps():
    learner = replace(TINY, batch=16, widths=(16, 16, 16), rate=4e-3, decay=200)
    state, generator = learner.init(0), rng(3)
    learned = (state.params, state.average, state.optimiser)
    losses = []
    for number in range(150):
        goal, reward = shown(generator, learner.batch)
        strokes = generator.uniform(LOW, HIGH, (learner.batch, 8, 4)).astype(np.float32)
        some = Batch(goal, 0 * goal, strokes, reward(strokes).astype(np.float32))
        learned, loss = improve(learner, learned, number, number, some)
        losses.append(np.asarray(loss))
    assert np.mean(losses[-10:], 0)[0] < 0.3 * np.mean(losses[:10], 0)[0]
    goal, reward = shown(rng(4), 16)
    scores = jax.jit(partial(looked, learner.net))(learned[1], goal, 0 * goal)
    strokes, values, own = jax.jit(partial(best, learner.net, count=1))(learned[1], scores, jax.random.key(0))
    assert reward(np.asarray(strokes)).mean() > 0.9  # of 1
    anywhere = reward(rng(5).uniform(LOW, HIGH, (16, 64, 4)))
    assert reward(np.asarray(own)).mean() > anywhere.mean() + 0.5  # the actor follows the critic
    assert np.abs(values - reward(np.asarray(strokes))).mean() < 0.35  # the best of many are overestimated
    np.testing.assert_allclose(valued(learner.net, learned[1], scores)(strokes), values, rtol=1e-3, atol=1e-3)


@pytest.mark.slow
def test_a_small_network_learns_on_sand():
    learner = ActorCritic(plans=8, updates=24, batch=16, capacity=2048, widths=(16, 16, 16), blocks=(1, 1, 1))
    state = learner.init(0)
    for _ in range(5):
        state, _ = learner.advance(state)
    last = learner.validate(state)
    assert set(last) == {"score", "right", "strokes", "iou"}
    assert last["score"] > 0.08  # 0.03 before it learned
    assert isinstance(state.memory, Memory)
