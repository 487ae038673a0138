"""Tasks of DDPG: an environment, rewards for goals in hindsight, and how a policy is judged."""

from dataclasses import dataclass
from functools import cache

import jax
import jax.numpy as jnp
import numpy as np

from jaxsand.envs.library import RandomStrokes
from jaxsand.envs.multi import LevelGoals, MultiStroke, StrokeParams
from jaxsand.goals import metrics
from jaxsand.goals.success import right
from jaxsand.goals.usual import usual_scene
from jaxsand.planning.learned.beam_search import one_after_the_other
from jaxsand.planning.stroke_loss import pushed
from jaxsand.scene.tools import Blade
from train.ddpg.acting import Acts
from train.evaluation.probes import Probe
from train.replay.her import Observation
from train.replay.reward import far

_PRACTICE, _SET_APART = 2_000_029, 1_000_003  # seeds of goals
_ENV = MultiStroke()
_SHORTEST = 0.15  # stroke of a goal, of the glyphs' square


@dataclass(frozen=True)
class Strokes:
    """Episodes of `count` strokes by the full push towards goals that as many random strokes make of level sand.

    There are `goals` goals to practise on, and `trials` others to validate on.
    """

    count: int = 3
    goals: int = 1024
    trials: int = 64

    def world(self) -> tuple[MultiStroke, StrokeParams]:
        """The environment and its parameters, made once."""
        return _ENV, _goals(self.count, self.goals, _PRACTICE)

    def judge(self, before: jax.Array, after: jax.Array, goal: jax.Array) -> tuple[jax.Array, jax.Array]:
        """The reward for any goal, from maps [..., H, W] in units of the blade's depth, and False: no goal ends an episode.

        It is what a stroke takes off the squared distance, L_t - L_{t+1} with L = |g - h|^2 / 5; the
        environment's own is of the distance.
        """
        return far(goal, before) - far(goal, after), jnp.zeros(before.shape[:-2], bool)

    def reward(self, observation: Observation, after: Observation, given: jax.Array) -> jax.Array:
        """The rewards [B] of steps, to which the environment gave others."""
        return self.judge(observation["current"], after["current"], observation["goal"])[0]

    def most(self, observation: dict[str, jax.Array]) -> jax.Array:
        """An upper bound [B] of every value: with rewards L_t - L_{t+1}, L >= 0 and a discount g <= 1,

        sum_t g^t (L_t - L_{t+1}) = L_0 - (1 - g) sum_t g^t L_{t+1} <= L_0.
        """
        return far(observation["goal"], observation["current"])

    def validate(self, acts: Acts) -> dict[str, float]:
        """Judges a policy on goals set apart.

        Returns:
          `score`, the mean share of the l2 distance that is gone, and `right`, the share of goals that are right.
        """
        params = _goals(self.count, self.trials, _SET_APART)
        goal, depth = np.asarray(params.goals.goals), float(Blade().depth)
        _, maps = one_after_the_other(acts, params.scene, np.zeros_like(goal), goal, self.count)
        after = np.nan_to_num(maps[-1])
        before, left = (np.asarray(metrics.l2(goal, x)) for x in (maps[0], after))
        good = [right(g, x, depth) for g, x in zip(goal, after, strict=True)]
        return {"score": float(np.mean(1 - left / before)), "right": float(np.mean(good))}


@dataclass(frozen=True)
class Probing:
    """A probe environment, without hindsight."""

    probe: Probe

    def world(self) -> tuple[Probe, None]:
        """The environment and its parameters, of which it has none."""
        return self.probe, None

    def judge(self, before: jax.Array, after: jax.Array, goal: jax.Array) -> tuple[jax.Array, jax.Array]:
        """No reward and no end, since a probe has no goals."""
        return jnp.zeros(()), jnp.zeros((), bool)

    def reward(self, observation: Observation, after: Observation, given: jax.Array) -> jax.Array:
        """The rewards [B] that the environment gave."""
        return given

    def most(self, observation: jax.Array) -> jax.Array:
        """No bound, [B]."""
        return jnp.full(len(observation), jnp.inf, observation.dtype)

    def validate(self, acts: Acts) -> dict[str, float]:
        """Minus the mean regret of the actions that the actor chooses."""
        regrets = []
        for state in self.probe.states():
            action = acts.act(self.probe.observe(state)[None])[0]
            regrets.append(self.probe.value(state, self.probe.best(state), 1) - self.probe.value(state, action, 1))
        return {"score": -float(np.mean(regrets))}


Task = Strokes | Probing


@cache
def _goals(count: int, goals: int, seed: int) -> StrokeParams:
    """The environment's parameters, with goals that random strokes leave; goals whose outcome is not clean are left out."""
    scene = usual_scene()
    plans = np.stack(RandomStrokes(goals, count, count, _SHORTEST).plans(np.random.default_rng(seed)))
    maps = np.zeros((goals, *scene.grid.shape), np.float32)
    for k in range(count):
        maps = pushed(scene, maps, metrics.place(plans[:, k]))
    return StrokeParams(scene, LevelGoals(jnp.asarray(maps[np.isfinite(maps).all((1, 2))])), count)
