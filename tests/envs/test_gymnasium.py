"""Gymnasium's interface: its own checkers, goal dictionaries, vectors of environments."""

import warnings

import gymnasium
import numpy as np
import pytest
from gymnasium.error import ResetNeeded
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode

import jaxsand.gym
from jaxsand.envs import LevelGoals, OnlyDug, OnSand, Stop, Together, Walks, map_pool
from jaxsand.goals.letters import letter_map
from jaxsand.interaction.stepped import SteppedPush

from .cases import SCOOPING

POOL = map_pool([letter_map(name)[0] for name in "LT"])
RAISED = np.zeros((2, 32, 32), np.float32)
RAISED[0, 10:12, 8:20] = -0.0075
RAISED[1, 8:20, 10:12] = -0.0075
GOALS = LevelGoals(RAISED)
SLOW = pytest.mark.slow
QUICK = {"goals": GOALS, "push": SteppedPush(1.0, 1), "batching": Together()}
DIGS = {"goals": LevelGoals(RAISED[:, :16, :16]), "scene": SCOOPING, "push": SteppedPush(1.0, 1), "batching": Together()}


def single(**options):
    return gymnasium.make(jaxsand.gym.SINGLE, goals=POOL, **options)


def multi(**options):
    return gymnasium.make(jaxsand.gym.MULTI, **QUICK | options)


def rising(**options):
    return gymnasium.make(jaxsand.gym.HEIGHTS, **QUICK | options)


def digging(**options):
    return gymnasium.make(jaxsand.gym.EXCAVATE, **DIGS | options)


@pytest.mark.parametrize(
    "make", [single, pytest.param(multi, marks=pytest.mark.wide), pytest.param(rising, marks=SLOW), digging]
)
def test_gymnasium_finds_nothing_wrong(make):
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", ".*(infinity|render_fps).*")  # heights have no bounds
        check_env(make(render_mode="rgb_array").unwrapped)


def test_a_seed_makes_an_episode():
    a, b, c = (single(limit=5).reset(seed=seed) for seed in (3, 3, 4))
    for name in a[0]:
        assert np.array_equal(a[0][name], b[0][name])
    assert any(not np.array_equal(single(limit=5).reset(seed=seed)[0]["goal"], c[0]["goal"]) for seed in range(8))


def test_a_single_environment_ends_and_waits():
    env = multi(limit=2)
    first, _ = env.reset(seed=0)
    assert not first["observation"].any()
    ends = [env.step(np.array([-0.5, -0.3, 0.4, 0.2], np.float32))[2:4] for _ in range(2)]
    assert ends == [(False, False), (False, True)]
    assert np.abs(env.unwrapped.shown["current"]).max() > 0.5  # not begun anew


def test_a_stop_ends_an_episode_in_place_of_a_push():
    env = multi(stop=Stop())
    env.reset(seed=0)
    obs, reward, terminated, truncated, _ = env.step(np.array([-0.5, -0.3, 0.4, 0.2, 1], np.float32))
    assert (reward, terminated, truncated) == (0.0, True, False)
    assert not obs["observation"].any()


@pytest.mark.wide
@pytest.mark.parametrize("measure", [None, OnlyDug()])
def test_the_reward_is_that_of_the_goal_and_works_on_a_batch(measure):
    env = multi(**({"measure": measure} if measure else {}))
    env.reset(seed=0)
    rng = np.random.default_rng(0)
    rows = []
    for _ in range(3):
        obs, reward, _, _, info = env.step(rng.uniform(-1, 1, 4).astype(np.float32))
        assert reward == env.unwrapped.compute_reward(obs["achieved_goal"], obs["desired_goal"], info)
        rows.append((obs, reward, info))
        state, params = env.unwrapped.state, env.unwrapped.params
        after = float(env.unwrapped.core.distance(state, params))
        before = state.__class__(state.goal, info["previous"] * params.scene.tool.depth, state.time)
        assert reward == pytest.approx(float(env.unwrapped.core.distance(before, params)) - after, abs=2e-5)
    achieved, desired = (np.stack([row[0][name] for row in rows]) for name in ("achieved_goal", "desired_goal"))
    infos = np.array([row[2] for row in rows])
    assert env.unwrapped.compute_reward(achieved, desired, infos).tolist() == [row[1] for row in rows]
    relabelled = env.unwrapped.compute_reward(achieved, achieved, infos)
    assert (relabelled > 0).all()  # what was reached was the goal
    with pytest.raises(ValueError, match=r"^info: got one without 'previous'.*copy_info_dict"):
        env.unwrapped.compute_reward(achieved, desired, [{}] * 3)


def test_heights_are_six_numbers_unless_told_otherwise():
    assert rising().action_space.shape == (6,)
    assert rising(heights=jaxsand.env.OwnDepth()).action_space.shape == (4,)


@SLOW
def test_zones_are_told_of():
    cells = np.zeros((32, 32), bool)
    cells[:, 16:] = True
    env = rising(zones=jaxsand.env.ClippedBy(cells))
    env.reset(seed=0)
    *_, info = env.step(np.array([-0.5, 0, -0.5, 0.5, 0.1, -0.3], np.float32))
    assert info["clipped"]
    assert 0 < info["went"] < 1


def test_masks_say_where_the_walk_may_go():
    env = single()
    _, info = env.reset(seed=1)
    for _ in range(6):
        mask = info["action_mask"]
        for action in np.flatnonzero(mask == 0):
            before = env.unwrapped.shown["pose"]
            obs, *_, info = env.step(int(action))
            assert not info["legal"]
            assert np.array_equal(obs["pose"], before)
        *_, info = env.step(int(np.flatnonzero(mask)[-1]))
        assert info["legal"]


@pytest.mark.wide
@pytest.mark.parametrize(
    ("name", "options"),
    [
        (jaxsand.gym.SINGLE, {"goals": POOL}),
        (jaxsand.gym.MULTI, QUICK),
        pytest.param(jaxsand.gym.HEIGHTS, QUICK, marks=SLOW),
        pytest.param(jaxsand.gym.EXCAVATE, DIGS, marks=SLOW),
    ],
)
def test_a_vector_is_as_many_single_ones(name, options):
    options = options | {"limit": 3}
    envs = gymnasium.make_vec(name, num_envs=3, **options)
    assert envs.metadata["autoreset_mode"] is AutoresetMode.SAME_STEP
    alone = [gymnasium.make(name, **options) for _ in range(3)]
    obs, info = envs.reset(seed=7)
    begun = [env.reset(seed=7 + i) for i, env in enumerate(alone)]
    assert all(np.array_equal(obs[key][i], one[0][key]) for i, one in enumerate(begun) for key in obs)
    envs.action_space.seed(0)
    for step in range(3):
        actions = envs.action_space.sample()
        obs, reward, terminated, truncated, info = envs.step(actions)
        for i, env in enumerate(alone):
            own = env.step(actions[i])
            assert (terminated[i], truncated[i]) == own[2:4]
            assert reward[i] == pytest.approx(own[1], abs=2e-5)
            seen = obs if step < 2 else info["final_obs"][i]
            for key in own[0]:
                assert seen[key][i if step < 2 else ...] == pytest.approx(own[0][key], abs=2e-5)
            if step < 2 and "previous" in own[4]:
                assert info["previous"][i] == pytest.approx(own[4]["previous"], abs=2e-5)
    assert truncated.all()
    assert info["_final_obs"].all()
    assert info["_final_info"].all()
    assert "pose" in obs or not obs["current" if "current" in obs else "observation"].sum((1, 2)).any()
    assert envs.observation_space.contains(obs)


def test_pictures_show_goal_and_sand():
    env = multi(render_mode="rgb_array")
    env.reset(seed=0)
    picture = env.render()
    assert picture.dtype == np.uint8
    assert picture.shape == (256, 520, 3)
    assert len(np.unique(picture[:, :256].reshape(-1, 3), axis=0)) == 2  # what is to be dug, and what is not
    assert len(np.unique(picture[:, 264:].reshape(-1, 3), axis=0)) == 1
    env.step(np.array([-0.5, -0.3, 0.4, 0.2], np.float32))
    assert len(np.unique(env.render()[:, 264:].reshape(-1, 3), axis=0)) > 20
    walk = single(render_mode="rgb_array")
    walk.reset(seed=0)
    assert (walk.render()[:, 290:, 0] == 149).sum() == 36**2  # 0.7 of the tool, 0.3 of a cell that is dug


def test_the_walk_on_sand_is_there_too():
    env = single(on=OnSand(push=SteppedPush(1.0, 1)))
    _, info = env.reset(seed=0)
    obs, reward, *_ = env.step(int(np.argmax(info["action_mask"])))
    assert obs["current"].min() < -0.9
    assert reward > 0


def test_what_there_is_not_is_named():
    with pytest.raises(ValueError, match="^render_mode: got 'human'; give rgb_array"):
        jaxsand.gym.MultiStrokeEnv(render_mode="human", **QUICK)
    env = jaxsand.gym.SingleStrokeEnv()
    env.reset(seed=0)
    for action in (-1, 4, 1.5):
        with pytest.raises(ValueError, match=f"^action: got {action}; give 0 to 3"):
            env.step(action)
    for action in (np.array([1]), [0, [1]]):
        with pytest.raises(ValueError, match=r"^action: got .*; give numbers \[\]"):
            env.step(action)
    many = jaxsand.gym.SandVectorEnv("single-stroke", 3)
    many.reset(seed=0)
    for action in (1, [0, 1], np.zeros((3, 1), int)):
        with pytest.raises(ValueError, match=r"^action: got .* of shape .*; give numbers \[3\]"):
            many.step(action)
    strokes = jaxsand.gym.MultiStrokeEnv(**QUICK)
    strokes.reset(seed=0)
    for action in (np.zeros(3), "x"):
        with pytest.raises(ValueError, match=r"^action: got .* of shape .*; give numbers \[4\]"):
            strokes.step(action)
    with pytest.raises(ValueError, match=r"^action: got shape \[3\]; give 4 numbers"):
        strokes.core.step_env(None, strokes.state, np.zeros(3), strokes.params)
    with pytest.raises(ValueError, match="^wind: no option of multi-stroke"):
        jaxsand.gym.MultiStrokeEnv(wind=3)


@pytest.mark.slow
def test_stable_baselines_finds_nothing_wrong():
    check = pytest.importorskip("stable_baselines3.common.env_checker").check_env
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        for make in (multi, rising, digging, single):
            check(make().unwrapped)


def test_forked_processes_are_told_what_to_do_instead_of_hanging(monkeypatch):
    monkeypatch.setattr("jaxsand.envs.gymnasium._AT_HOME", -1)
    with pytest.raises(RuntimeError, match=r'vectorization_mode: .*forked.*"context": "spawn"'):
        gymnasium.make("jaxsand/MultiStroke-v0")


def test_a_mask_begins_only_some_environments_anew():
    envs = jaxsand.gym.SandVectorEnv("single-stroke", 3, goals=POOL, limit=4)
    envs.reset(seed=1)
    before = envs.step(np.array([0, 1, 2]))[0]
    alone = single(limit=4).reset(seed=12)[0]
    obs, info = envs.reset(seed=[None, 12, None], options={"reset_mask": np.array([False, True, False])})
    for name, plane in obs.items():
        assert np.array_equal(plane[[0, 2]], before[name][[0, 2]])
        assert np.array_equal(plane[1], alone[name])
    assert info["_action_mask"].tolist() == [False, True, False]
    assert info["action_mask"][1].any()
    assert not info["action_mask"][[0, 2]].any()
    for step in range(3):  # the others are as far as they were
        truncated = envs.step(np.zeros(3, int))[3]
        assert truncated.tolist() == [step == 2, False, step == 2]


def test_seeds_can_be_a_list():
    envs = jaxsand.gym.SandVectorEnv("single-stroke", 3, goals=Walks())
    listed, _ = envs.reset(seed=[5, 6, 7])
    counted, _ = envs.reset(seed=5)
    for name in listed:
        assert np.array_equal(listed[name], counted[name])
    back, _ = envs.reset(seed=np.array([7, 6, 5]))
    assert np.array_equal(back["goal"], listed["goal"][::-1])


def test_what_reset_does_not_know_is_named():
    envs = jaxsand.gym.SandVectorEnv("single-stroke", 2, goals=POOL)
    with pytest.raises(ResetNeeded, match="reset a part"):
        envs.reset(options={"reset_mask": np.array([True, False])})
    for mask in ([True], [1, 0], [False, False]):
        with pytest.raises(ValueError, match="^reset_mask: got .*; give 2 booleans"):
            envs.reset(options={"reset_mask": np.array(mask)})
    with pytest.raises(ValueError, match="^seed: got 3 for 2 environments"):
        envs.reset(seed=[1, 2, 3])
    for env in (envs, jaxsand.gym.SingleStrokeEnv(goals=POOL)):
        with pytest.raises(ValueError, match="^options: got 'goal', no option of reset"):
            env.reset(options={"goal": 1})


def test_nothing_goes_before_the_first_reset():
    kinds = {"render_mode": "rgb_array"}
    for env, action in (
        (jaxsand.gym.SingleStrokeEnv(**kinds), 0),
        (jaxsand.gym.MultiStrokeEnv(**QUICK, **kinds), np.zeros(4)),
        (jaxsand.gym.SandVectorEnv("single-stroke", 2, **kinds), np.zeros(2, int)),
    ):
        with pytest.raises(ResetNeeded, match="step before the first reset"):
            env.step(action)
        with pytest.raises(ResetNeeded, match="render before the first reset"):
            env.render()


def test_rewards_of_flattened_goals():
    env = jaxsand.gym.MultiStrokeEnv(**QUICK)
    rng = np.random.default_rng(0)
    before, achieved, desired = rng.normal(size=(3, 2, 32, 32))
    infos = [{"previous": one} for one in before]
    rewards = env.compute_reward(achieved, desired, infos)
    apart = [np.sqrt(((desired - maps) ** 2).sum((1, 2))) for maps in (before, achieved)]
    assert rewards == pytest.approx(apart[0] - apart[1])
    flat = [maps.reshape(2, 1024) for maps in (achieved, desired)]
    assert np.array_equal(env.compute_reward(*flat, np.array(infos)), rewards)
    assert env.compute_reward(flat[0][0], flat[1][0], infos[0]) == rewards[0]
    assert env.compute_reward(achieved[0], desired[0], infos[0]) == rewards[0]
    with pytest.raises(ValueError, match=r"^achieved_goal: got shape \[2, 1024\] for 1 infos; give \[32, 32\]"):
        env.compute_reward(flat[0], flat[1][0], infos[0])
