"""Stable-Baselines3 on jaxsand: its own DDPG with hindsight, on many strokes.

    python -m train.sb3 [--steps N] [--seed K] [--json]

It checks that the environment is what other libraries expect, and measures strokes a second in their loop. Needs the extra
`sb3`: pip install 'jaxsand[sb3]'.
"""

import json
import sys
import time
from typing import Any

import numpy as np

from jaxsand.cli.arguments import Parser, count, ended
from jaxsand.cli.arguments import seed as a_seed

_LIMIT = 3  # strokes to an episode
_JUDGED = 16  # episodes that the mean reward is taken over


def main(arguments: list[str] | None = None) -> int:
    """Trains, and prints strokes a second and the mean reward of an episode before and after; returns the exit code."""
    parser = Parser(prog="python -m train.sb3", description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--steps", type=count, default=2_000, metavar="N", help="strokes to train for (2000)")
    parser.add_argument("--seed", type=a_seed, default=0, metavar="K", help="(0)")
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    options = parser.parse_args(arguments)

    def show() -> None:
        report = trained(options.steps, options.seed)
        print(json.dumps(report) if options.json else "\n".join(f"{name:24} {value:.4g}" for name, value in report.items()))

    return ended(show)


def trained(steps: int, seed: int) -> dict[str, float]:
    """Trains for `steps` strokes, and measures rewards and run times without the environment's compilation.

    Raises:
      ValueError: if Stable-Baselines3 is missing, or for fewer strokes than two episodes have.
    """
    try:
        from stable_baselines3 import DDPG, HerReplayBuffer
        from stable_baselines3.common.env_checker import check_env
        from stable_baselines3.common.noise import NormalActionNoise
    except ImportError:
        raise ValueError("sb3: Stable-Baselines3 is not there; run pip install 'jaxsand[sb3]'") from None
    if steps < 2 * _LIMIT:
        raise ValueError(f"steps: got {steps}; give {2 * _LIMIT} or more, two episodes")
    import gymnasium

    import jaxsand.gym
    from jaxsand.envs import RandomStrokes

    env = gymnasium.make(jaxsand.gym.MULTI, goals=RandomStrokes(goals=64, most=_LIMIT), limit=_LIMIT, seed=seed)
    check_env(env.unwrapped, warn=False)  # which also compiles its programs
    agent = DDPG(
        "MultiInputPolicy",
        env,
        replay_buffer_class=HerReplayBuffer,
        replay_buffer_kwargs={"n_sampled_goal": 4, "goal_selection_strategy": "future", "copy_info_dict": True},
        action_noise=NormalActionNoise(np.zeros(4), np.full(4, 0.3)),
        learning_starts=min(100, steps // 2),
        buffer_size=max(steps, 1_000),
        gamma=1.0,
        seed=seed,
    )
    before = _mean_reward(agent, env, seed)
    began = time.perf_counter()
    agent.learn(steps)
    seconds = time.perf_counter() - began
    return {
        "strokes": steps,
        "strokes_per_second": steps / seconds,
        "strokes_alone_per_second": _alone(env, seed),
        "reward_before": before,
        "reward_after": _mean_reward(agent, env, seed),
    }


def _mean_reward(agent: Any, env: Any, seed: int) -> float:
    """The mean reward of an episode without noise, on the same goals every time."""
    earned = 0.0
    for episode in range(_JUDGED):
        obs, _ = env.reset(seed=1_000 * (seed + 1) + episode)
        over = False
        while not over:
            obs, reward, terminated, truncated, _ = env.step(agent.predict(obs, deterministic=True)[0])
            earned += reward
            over = terminated or truncated
    return earned / _JUDGED


def _alone(env: Any, seed: int) -> float:
    """Random strokes a second in the same environment, without an agent."""
    env.action_space.seed(seed)
    env.reset(seed=seed)
    began = time.perf_counter()
    for k in range(1, _JUDGED * _LIMIT + 1):
        env.step(env.action_space.sample())
        if k % _LIMIT == 0:
            env.reset()
    return _JUDGED * _LIMIT / (time.perf_counter() - began)


if __name__ == "__main__":
    sys.exit(main())
