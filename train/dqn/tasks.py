"""Tasks of DQN: an environment, goals, what the network sees, and how a policy is judged."""

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cache
from string import ascii_uppercase
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxsand.envs.maps import MapPool
from jaxsand.envs.onmap import MapParams, MapState, OnMap
from jaxsand.goals import letters
from train.dqn.maps import Shapes, among, shape_pool
from train.dqn.networks import Greedy, around, flat
from train.dqn.symmetries import Symmetric
from train.dqn.walks import fewest, walks
from train.evaluation.probes import Probe, ProbeState, Two

Look = Callable[[Any], jax.Array]
_SET_APART, _TRIALS = 1_000_003, 256  # the seed, and the number, of maps that it is validated on
_COST = 1.0  # of a step


@dataclass(frozen=True)
class SingleStroke:
    """Digs maps of random `shapes` in the fewest steps; `pool` new maps in every chunk, walks of at most `limit` steps.

    A step's reward is -1, and 1 more when it digs a new cell. So the sum of rewards is minus the number of steps beyond one
    for each cell to dig: 0 at best, and largest for the shortest walk. Letters, and the maps for validation, are never
    goals.
    """

    env: OnMap = field(default_factory=OnMap)
    shapes: Shapes = field(default_factory=Shapes)
    pool: int = 512
    limit: int = 64

    @property
    def actions(self) -> int:
        """How many actions there are."""
        return 4

    @property
    def look(self) -> Look:
        """How the network sees an observation."""
        return around

    def world(self, key: jax.Array) -> MapParams:
        """The environment's parameters, with new goals."""
        pool = shape_pool(self.shapes, key, self.pool, self.env.shape, jnp.asarray(_barred(self)))
        return MapParams(pool, step_cost=_COST, limit=self.limit)

    def legal(self, observation: dict[str, jax.Array]) -> jax.Array:
        """Which steps lead to a cell of the goal [4]."""
        return self.env.legal(self.state(observation), MapParams())

    def packed(self, observation: dict[str, jax.Array]) -> dict[str, jax.Array]:
        """An observation as it is stored."""
        return {name: plane > 0.5 for name, plane in observation.items()}

    def state(self, observation: dict[str, jax.Array]) -> MapState:
        """The environment's state that an observation shows, with time 0."""
        goal, dug, pose = (observation[name] for name in ("goal", "current", "pose"))
        place = jnp.stack(jnp.divmod(jnp.argmax(pose), pose.shape[1])).astype(jnp.int32)
        return MapState(goal > 0.5, dug > 0.5, place, jnp.zeros((), jnp.int32))

    def judge(self, before: jax.Array, after: jax.Array, goal: jax.Array) -> tuple[jax.Array, jax.Array]:
        """The reward for any goal, and whether the goal is dug."""
        left, still = (jnp.sum(goal & ~dug) for dug in (before, after))
        return jnp.float32(left - still) - jnp.float32(_COST), still == 0

    def barred(self, observations: dict[str, jax.Array]) -> jax.Array:
        """Which observations [B, ...] have a goal that must not be learned from, [B]."""
        return among(observations["goal"], jnp.asarray(_barred(self)))

    def policy(self, own: Greedy) -> Greedy:
        """The policy that is judged: on square maps, the mean over all eight views."""
        rows, columns = self.env.shape
        return Symmetric(own.net, own.params) if rows == columns else own

    def validate(self, policy: Greedy) -> dict[str, float]:
        """Judges a policy on random maps set apart.

        Returns:
          `solved`, the share of maps solved; `optimal`, the share solved in the fewest steps; and `score`, the mean of
          fewest steps / steps, 0 for a map that is not solved.
        """
        steps, few = walks(policy, _set_apart(self)), _fewest_apart(self)
        good = steps > 0
        return {
            "score": float(np.mean(np.where(good, few, 0) / np.maximum(steps, 1))),
            "solved": float(np.mean(good)),
            "optimal": float(np.mean(good & (steps == few))),
        }


@dataclass(frozen=True)
class Asking:
    """A probe environment with actions 0 and 1, both always legal."""

    probe: Probe

    @property
    def env(self) -> Probe:
        """The environment."""
        return self.probe

    @property
    def actions(self) -> int:
        """How many actions there are."""
        return Two.space.n

    @property
    def look(self) -> Look:
        """How the network sees an observation."""
        return flat

    def world(self, key: jax.Array) -> None:
        """A probe has no parameters."""

    def legal(self, observation: jax.Array) -> jax.Array:
        """Both actions [2]."""
        return jnp.ones(self.actions, bool)

    def packed(self, observation: jax.Array) -> jax.Array:
        """An observation as it is stored."""
        return observation

    def state(self, observation: jax.Array) -> ProbeState:
        """The environment's state that an observation shows."""
        return ProbeState(observation[0], observation[1].astype(jnp.int32))

    def judge(self, before: jax.Array, after: jax.Array, goal: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Raises ValueError: a probe has no goals."""
        raise ValueError("strategy: a probe has no goals; learn without hindsight, with Own()")

    def barred(self, observations: jax.Array) -> jax.Array:
        """No observation is barred, [B]."""
        return jnp.zeros(len(observations), bool)

    def policy(self, own: Greedy) -> Greedy:
        """The policy that is judged."""
        return own

    def validate(self, policy: Greedy) -> dict[str, float]:
        """Minus the mean regret of the actions that the policy chooses."""
        regrets = []
        for state in self.probe.states():
            action = policy.act(self.probe.observe(state)[None], jnp.ones((1, self.actions), bool))[0]
            regrets.append(self.probe.value(state, self.probe.best(state), 1) - self.probe.value(state, action, 1))
        return {"score": -float(np.mean(regrets))}


Task = SingleStroke | Asking


@cache
def _letters(shape: tuple[int, int]) -> np.ndarray:
    maps = np.stack([letters.letter_map(letter)[0] for letter in ascii_uppercase])
    return maps if maps.shape[1:] == shape else np.zeros((0, *shape), bool)


@cache
def _set_apart(task: SingleStroke) -> MapPool:
    shape = task.env.shape
    with jax.ensure_compile_time_eval():
        return shape_pool(task.shapes, jax.random.key(_SET_APART), _TRIALS, shape, jnp.asarray(_letters(shape)))


@cache
def _fewest_apart(task: SingleStroke) -> np.ndarray:
    return fewest(_set_apart(task))


@cache
def _barred(task: SingleStroke) -> np.ndarray:
    """The maps [N, H, W] that are never trained on: letters, and those it is validated on."""
    return np.concatenate([_letters(task.env.shape), np.asarray(_set_apart(task).dig)])
