"""Q-learning: probes of known values, the algebra of targets, masks, letters kept out, and small maps learned."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxsand.envs.maps import STEPS, map_pool
from jaxsand.envs.onmap import MapParams, OnMap
from jaxsand.goals import letters
from train.dqn.learner import Dqn, begin, practise
from train.dqn.maps import Shapes, among, shape_pool
from train.dqn.networks import Bins, Greedy, Mean, QNet, around, dueling
from train.dqn.symmetries import VIEWS, Symmetric, turned, turned_steps
from train.dqn.targets import Every, Items, Sampled, items_of
from train.dqn.tasks import Asking, SingleStroke
from train.dqn.walks import beams, evaluate, fewest, walks
from train.evaluation.probes import QUESTIONS, ByBoth, Probe, Two
from train.replay.her import Own, Steps

KEY = jax.random.key(0)
TINY = Dqn(
    task=SingleStroke(OnMap((3, 3)), pool=64, limit=16),
    width=48,
    blocks=1,
    reach=16,
    envs=32,
    steps=16,
    updates=24,
    batch=64,
    capacity=4096,
    rate=3e-3,
    memory=0.95,
    every=4,
)
QUICK = replace(TINY, rate=1e-2)  # one program for all tests that learn by default
LINE = np.ones((1, 4), bool)


def seen(dig, dug, place):
    pose = np.zeros_like(dig)
    pose[place] = True
    return {"goal": jnp.asarray(dig)[None], "current": jnp.asarray(dug)[None], "pose": jnp.asarray(pose)[None]}


def same(a, b):
    plain = [jax.random.key_data(x) if jnp.issubdtype(x.dtype, jax.dtypes.prng_key) else x for x in jax.tree.leaves((a, b))]
    half = len(plain) // 2
    return all(np.array_equal(x, y) for x, y in zip(plain[:half], plain[half:], strict=True))


ASKED = [  # the other way to targets, and the other questions, are as long in compiling again
    pytest.param(q, b, marks=() if type(b) is Every and type(q) is ByBoth else pytest.mark.slow)
    for b in (Every(), Sampled())
    for q in QUESTIONS
]


@pytest.mark.wide
@pytest.mark.parametrize(("question", "backup"), ASKED, ids=lambda x: type(x).__name__)
def test_a_probe_s_known_values_are_found(question, backup):
    probe = Probe(question, Two())
    learner = Dqn(
        task=Asking(probe),
        strategy=Own(),
        backup=backup,
        head=Bins(-1.5, 1.5, 31) if isinstance(backup, Every) else Mean(),
        width=32,
        blocks=1,
        reach=1,
        gamma=0.9,
        envs=16,
        steps=8,
        updates=60,
        batch=64,
        capacity=512,
        rate=1e-2,
        memory=0.9,
        careful=0.1,
    )
    state = learner.init(0)
    for _ in range(32):
        state, _ = learner.advance(state)
    assert learner.validate(state)["score"] == 0
    for place in probe.states():
        values = learner.policy(state).values(probe.observe(place)[None])[0]
        for action in range(2):
            assert abs(float(values[action]) - probe.value(place, jnp.int32(action), 0.9)) < 0.05


def test_dueling_advantages_have_no_mean_and_a_constant_in_them_changes_nothing():
    state, advantage = jax.random.normal(KEY, (5, 7)), jax.random.normal(KEY, (5, 4, 7))
    out = dueling(state, advantage)
    np.testing.assert_allclose(out.mean(1), state, atol=1e-12)
    np.testing.assert_allclose(dueling(state, advantage + 3), out, atol=1e-12)
    np.testing.assert_allclose(out[:, 0] - out[:, 2], advantage[:, 0] - advantage[:, 2], atol=1e-12)


@pytest.mark.wide
def test_bins_reach_the_targets_that_they_can_write_and_stay_within_their_bounds():
    head, targets = Bins(-3.0, 1.0, 9), jnp.array([-3.0, -1.3, 0.2, 1.0, 9.0])
    raw = jnp.zeros((5, 9))
    for _ in range(300):
        raw -= 4 * jax.grad(lambda r: jnp.sum(head.loss(r, targets)))(raw)
    np.testing.assert_allclose(head.value(raw), [-3, -1.3, 0.2, 1, 1], atol=0.02)
    assert np.all(np.abs(head.value(100 * jax.random.normal(KEY, (64, 9))) + 1) <= 2)


def test_items_sum_rewards_up_to_their_reach_the_episode_s_end_or_the_row_s():
    rewards, g = jnp.array([1.0, 2, 4, 8, 16, 32]), 0.5
    ended = jnp.array([False, False, True, False, False, False])
    steps = Steps(jnp.arange(6), jnp.arange(6), rewards, ended, jnp.arange(6) + 100, ended)
    items = items_of(steps, 2, g)
    np.testing.assert_allclose(items.total, [1 + 2 * g, 2 + 4 * g, 4, 8 + 16 * g, 16 + 32 * g, 32])
    np.testing.assert_allclose(items.discount, [g**2, 0, 0, g**2, g**2, g])
    np.testing.assert_array_equal(items.after, [101, 102, 102, 104, 105, 105])
    cut = items_of(replace(steps, terminated=ended & False), 2, g)
    np.testing.assert_allclose(cut.discount, [g**2, g**2, g, g**2, g**2, g])
    np.testing.assert_array_equal(cut.after, items.after)


def test_the_sampled_target_is_the_slow_value_of_what_the_online_network_likes_among_what_is_legal():
    task = SingleStroke(OnMap((1, 4)))
    dug = np.array([[False, True, True, False]])
    look = seen(LINE, dug, (0, 1))  # E and W are legal
    items = Items(look, jnp.array([1]), jnp.array([-0.5]), seen(LINE, dug, (0, 2)), jnp.array([0.25]))
    targets, weights = Sampled().targets(
        task, None, 0.5, items, lambda _: jnp.array([[9.0, 1, 9, 2]]), lambda _: jnp.array([[7.0, 5, 7, -4]])
    )
    np.testing.assert_allclose(targets, [[0, -0.5 + 0.25 * -4, 0, 0]])
    np.testing.assert_array_equal(weights, [[0, 1, 0, 0]])


@pytest.mark.wide
def test_targets_of_every_action_follow_the_model_and_no_walk_that_came_to_its_end_is_undercut():
    task = SingleStroke(OnMap((1, 4)))
    params = MapParams(map_pool([LINE], [(0, 1)]), step_cost=1.0)
    dug = np.array([[False, True, True, True]])
    look = seen(LINE, dug, (0, 2))

    def slow(after):
        return jnp.where(after["pose"][:, 0], -2.0, -8.0) - jnp.array([[9.0, 0, 9, 0]])

    def targets(total, discount):
        items = Items(look, jnp.array([1]), jnp.array([total]), look, jnp.array([discount]))
        return Every().targets(task, params, 1.0, items, slow, slow)

    values, weights = targets(-5.0, 1.0)
    np.testing.assert_allclose(values, [[0, -1 - 2, 0, -1 - 2]])  # -2 for what is not the first cell, by its best legal step
    np.testing.assert_array_equal(weights, [[0, 0.5, 0, 0.5]])
    np.testing.assert_allclose(targets(-1.5, 0.0)[0], [[0, -1.5, 0, -3]])
    np.testing.assert_allclose(targets(-1.5, 1.0)[0], [[0, -3, 0, -3]])
    items = Items(seen(LINE, dug, (0, 1)), jnp.array([3]), jnp.array([-9.0]), look, jnp.array([1.0]))
    assert Every().targets(task, params, 1.0, items, slow, slow)[0][0, 3] == 0  # digs the last cell: a step, less its reward


@pytest.mark.wide
def test_where_there_is_no_room_for_an_action_it_has_no_weight():
    task = SingleStroke(OnMap((3, 3)))
    dig = np.ones((3, 3), bool)
    one = seen(dig, dig & False, (1, 1))
    look = jax.tree.map(lambda x: jnp.repeat(x, 2, axis=0), one)
    items = Items(look, jnp.zeros(2, int), jnp.full(2, -9.0), look, jnp.ones(2))
    params = MapParams(map_pool([dig], [(0, 0)]), step_cost=1.0)
    slow = lambda after: jnp.full((len(after["goal"]), 4), -3.0)  # noqa: E731
    targets, weights = Every(branches=2).targets(task, params, 1.0, items, slow, slow)
    np.testing.assert_allclose(targets, [[-3] * 4, [0] * 4])
    np.testing.assert_allclose(weights, [[0.25] * 4, [0] * 4])


@pytest.mark.wide
def test_only_legal_actions_are_chosen_when_learning_and_when_walking():
    state, _ = QUICK.advance(QUICK.init(3))
    kept, number = state.memory.experience, QUICK.envs * QUICK.steps
    items = jax.tree.map(lambda x: x[0, :number], kept)
    legal = jax.vmap(QUICK.task.legal)(items.observation)
    assert not bool(jnp.all(legal))
    assert bool(jnp.all(jnp.take_along_axis(legal, items.action[:, None], axis=1)))
    policy = QUICK.policy(state)
    values = policy.values(items.observation)
    chosen = policy.act(items.observation, legal)
    np.testing.assert_array_equal(chosen, jnp.argmax(jnp.where(legal, values, -1e9), axis=1))


def test_what_is_around_is_the_same_wherever_the_map_is():
    dig = np.zeros((7, 7), bool)
    dig[1:4, 2], dig[3, 2:5] = True, True
    dug = np.zeros((7, 7), bool)
    dug[1:3, 2] = True
    here, there = (
        around(seen(np.roll(dig, by, (0, 1)), np.roll(dug, by, (0, 1)), (2 + by[0], 2 + by[1]))) for by in ((0, 0), (2, -1))
    )
    np.testing.assert_array_equal(here, there)
    planes = here.reshape(2, 13, 13)
    assert planes[0].sum() == 3
    assert planes[1].sum() == 2
    assert planes[1, 6, 6] == 1  # the tool, on a dug cell
    assert planes[1, 5, 6] == 1
    assert planes[0, 7, 8] == 1


def test_shapes_are_of_one_piece_start_on_a_cell_and_differ():
    pool = shape_pool(Shapes(), KEY, 64, (7, 7), jnp.zeros((0, 7, 7), bool))
    map_pool(np.asarray(pool.dig), [tuple(map(int, s)) for s in pool.starts])  # raises for pieces or a wrong start
    assert len({np.asarray(d).tobytes() for d in pool.dig}) > 60
    cells = np.asarray(pool.dig).sum((1, 2))
    assert 12 < cells.mean() < 20


@pytest.mark.wide
def test_letters_and_maps_set_apart_are_never_drawn():
    pool = shape_pool(Shapes(), KEY, 16, (7, 7), jnp.zeros((0, 7, 7), bool))
    barred = pool.dig[jnp.array([0, 1, 5])]
    np.testing.assert_array_equal(among(pool.dig[:6], barred), [True, True, False, False, False, True])
    new = shape_pool(Shapes(), KEY, 16, (7, 7), barred)
    assert not among(new.dig, barred).any()
    np.testing.assert_array_equal(new.dig[jnp.array([0, 1, 5])], pool.dig[jnp.array([2, 2, 2])])
    np.testing.assert_array_equal(new.starts[jnp.array([3, 4])], pool.starts[jnp.array([3, 4])])
    letter = jnp.asarray(letters.letter_map("L")[0])
    assert among(jnp.roll(letter, 1, axis=1)[None], letter[None]).all()
    look = {"goal": jnp.stack([letter, pool.dig[2]])}
    np.testing.assert_array_equal(SingleStroke().barred(look), [True, False])


@pytest.mark.wide
def test_a_chunk_is_a_function_of_the_state():
    state = QUICK.init(0)
    assert same(QUICK.advance(state)[0], QUICK.advance(state)[0])


@pytest.mark.slow
def test_a_chunk_may_be_vmapped_over_seeds():
    one, _ = TINY.advance(TINY.init(0))
    keys = jnp.stack([jax.random.key(0), jax.random.key(1)])
    both, _ = jax.vmap(lambda s: practise(TINY, s))(jax.vmap(lambda k: begin(TINY, k))(keys))
    for a, b in zip(jax.tree.leaves(both.params), jax.tree.leaves(one.params), strict=True):
        np.testing.assert_allclose(a[0], b, rtol=0.02, atol=2e-3)  # the order of sums differs, and Adam amplifies it
        assert a.ndim < 3 or not np.array_equal(a[0], a[1])


@pytest.mark.slow
@pytest.mark.parametrize("learner", [QUICK, replace(QUICK, backup=Sampled(), reach=3)])
def test_small_maps_are_learned_and_a_beam_does_no_worse(learner):
    pool = shape_pool(Shapes(), jax.random.key(5), 64, (3, 3), jnp.zeros((0, 3, 3), bool))
    few, state = fewest(pool), learner.init(1)
    before = np.mean(walks(learner.policy(state), pool) == few)
    for _ in range(240):
        state, _ = learner.advance(state)
    after = walks(learner.policy(state), pool)
    assert before < 0.7
    assert np.mean(after == few) > 0.85
    assert learner.validate(state)["optimal"] > 0.85
    assert np.all((after == 0) | (after >= few))
    beam = beams(learner.policy(state), pool, 8)
    assert np.all(beam >= few)
    assert np.mean(beam == few) >= np.mean(after == few)


class Blind:
    """A learner that knows nothing: every value is 0."""

    task = SingleStroke()

    def policy(self, state):
        return Greedy(Dqn(width=8, blocks=1).net, state)


@pytest.mark.wide
def test_evaluation_counts_what_is_solved_beside_the_planner_and_gives_up_circles():
    net = Dqn(width=8, blocks=1).net
    zero = jax.tree.map(jnp.zeros_like, net.init(KEY, jax.tree.map(jnp.asarray, seen(*[np.eye(7, dtype=bool)] * 2, (0, 0)))))
    maps = {
        "line": (np.eye(7, dtype=bool)[[3] * 7], (6, 3)),  # a column, walked north
        "two": (np.eye(7, dtype=bool)[[3] * 7], (3, 3)),  # from its middle: north, then to and fro
    }
    report = evaluate(Blind(), zero, maps)
    assert report["maps"] == {
        "line": {"solved": True, "steps": 6, "fewest": 6},
        "two": {"solved": False, "steps": None, "fewest": 9},
    }
    assert (report["solved"], report["optimal"], report["total"]) == (1, 1, 2)
    wide = evaluate(Blind(), zero, maps, width=64)
    assert (wide["solved"], wide["optimal"]) == (2, 2)
    with pytest.raises(ValueError, match="maps: 'small' has shape"):
        evaluate(Blind(), zero, {"small": (np.ones((2, 2), bool), None)})


def test_letters_start_where_their_maps_say():
    net = Dqn(width=8, blocks=1).net
    zero = jax.tree.map(jnp.zeros_like, net.init(KEY, jax.tree.map(jnp.asarray, seen(*[np.eye(7, dtype=bool)] * 2, (0, 0)))))
    report = evaluate(Blind(), zero)
    assert report["total"] == 26
    assert [report["maps"][letter]["fewest"] for letter in "ASTR"] == [23, 27, 18, 25]  # the paper's


@pytest.mark.parametrize("view", VIEWS)
def test_a_step_on_a_turned_map_is_the_turned_step(view):
    for step, there in zip(STEPS, turned_steps(view), strict=True):
        pose, after = np.zeros((2, 1, 5, 5))
        pose[0, 2, 1], after[0, 2 + step[0], 1 + step[1]] = 1, 1
        begin = np.argwhere(np.asarray(turned(pose, view))[0])[0]
        end = np.argwhere(np.asarray(turned(after, view))[0])[0]
        np.testing.assert_array_equal(end - begin, STEPS[there])


@pytest.mark.wide
def test_what_looks_at_all_views_values_turned_steps_alike():
    net = QNet(around, 4, Mean(), 16, 1)
    dig = np.random.default_rng(0).random((1, 5, 5)) < 0.6
    planes = {"goal": dig, "current": dig & (np.indices((5, 5)).sum(0) > 4), "pose": np.zeros((1, 5, 5), bool)}
    planes["pose"][0, 1, 3] = True
    params = net.init(KEY, planes)
    policy = Symmetric(net, jax.tree.map(lambda p: p + 0.1, params))
    values = policy.values(planes)
    for view in VIEWS:
        there = policy.values({name: turned(plane, view) for name, plane in planes.items()})
        np.testing.assert_allclose(there[:, turned_steps(view)], values, atol=1e-5)
    alone = Greedy(net, policy.params)
    assert not np.allclose(alone.values({n: turned(p, 1) for n, p in planes.items()})[:, turned_steps(1)], values, atol=1e-3)
