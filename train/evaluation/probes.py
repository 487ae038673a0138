"""Probe environments: each tests one ability of a learner, and the values of all its states and actions are known.

The idea is Andy Jones's ("Debugging RL without the agonizing pain"): they show what is broken before a learner meets sand.
If an agent fails on a probe, the fault lies in one part: the critic, its discount, or the choice of actions.
"""

from dataclasses import dataclass

import jax
import jax.numpy as jnp

from jaxsand.envs import episode
from jaxsand.envs.episode import Action, Step
from jaxsand.envs.spaces import Box, Discrete


@dataclass(frozen=True)
class Two:
    """Actions 0 and 1: the reward is 1 for the wanted one (0 for a negative sign), and -1 for the other."""

    space = Discrete(2)

    def reward(self, action: jax.Array, wanted: jax.Array) -> jax.Array:
        """The reward of an action."""
        return (2.0 * action - 1) * wanted

    def best(self, wanted: jax.Array) -> jax.Array:
        """The action of the largest reward."""
        return jnp.int32(wanted > 0)


@dataclass(frozen=True)
class Line:
    """An action [1] from -1 to 1, whose reward is 1 - (action - wanted / 2)^2."""

    space = Box(-1.0, 1.0, (1,))

    def reward(self, action: jax.Array, wanted: jax.Array) -> jax.Array:
        """The reward of an action."""
        return 1 - (action[0] - wanted / 2) ** 2

    def best(self, wanted: jax.Array) -> jax.Array:
        """The action of the largest reward."""
        return wanted[None] / 2


Actions = Two | Line


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class ProbeState:
    """The state of a probe: the `sign` that is shown, -1, 0 or 1, and the `time`."""

    sign: jax.Array
    time: jax.Array


@dataclass(frozen=True)
class Constant:
    """The reward is 1 whatever is done: does the critic learn at all?"""

    steps, shows = 1, False

    def reward(self, actions: Actions, state: ProbeState, action: jax.Array) -> jax.Array:
        """The reward of an action in a state."""
        return jnp.float32(1)


@dataclass(frozen=True)
class ByObservation:
    """The reward is the sign that is shown: does the critic see the observation?"""

    steps, shows = 1, True

    def reward(self, actions: Actions, state: ProbeState, action: jax.Array) -> jax.Array:
        """The reward of an action in a state."""
        return state.sign


@dataclass(frozen=True)
class Late:
    """The reward is 0, then 1 at the second step: does the value come back through time, with the right discount?"""

    steps, shows = 2, False

    def reward(self, actions: Actions, state: ProbeState, action: jax.Array) -> jax.Array:
        """The reward of an action in a state."""
        return state.time.astype(jnp.float32)


@dataclass(frozen=True)
class ByAction:
    """The reward is for a positive action: does the policy follow the critic?"""

    steps, shows = 1, False

    def reward(self, actions: Actions, state: ProbeState, action: jax.Array) -> jax.Array:
        """The reward of an action in a state."""
        return actions.reward(action, jnp.float32(1))


@dataclass(frozen=True)
class ByBoth:
    """The reward is for an action of the sign that is shown: does the policy see the observation?"""

    steps, shows = 1, True

    def reward(self, actions: Actions, state: ProbeState, action: jax.Array) -> jax.Array:
        """The reward of an action in a state."""
        return actions.reward(action, state.sign)


Question = Constant | ByObservation | Late | ByAction | ByBoth


@dataclass(frozen=True)
class Probe:
    """A question asked with one kind of actions.

    The observation [2] is the sign that is shown and the time. An episode terminates after the question's steps. There are
    no
    parameters: `params` is None.
    """

    question: Question
    actions: Actions

    def reset(self, key: jax.Array, params: None) -> tuple[jax.Array, ProbeState]:
        """Begins an episode; returns its first observation and its state."""
        sign = jax.random.rademacher(key, (), jnp.float32) if self.question.shows else jnp.float32(0)
        state = ProbeState(sign, jnp.int32(0))
        return self.observe(state), state

    def step_env(self, key: jax.Array, state: ProbeState, action: Action, params: None) -> Step[jax.Array, ProbeState]:
        """Takes one action, and does not begin a new episode after the last."""
        reward = self.question.reward(self.actions, state, jnp.asarray(action))
        new = ProbeState(state.sign, state.time + 1)
        return self.observe(new), new, reward, new.time >= self.question.steps, jnp.zeros((), bool), {}

    step = episode.step

    def observe(self, state: ProbeState) -> jax.Array:
        """The observation of a state."""
        return jnp.stack([state.sign, state.time.astype(jnp.float32)])

    def action_space(self, params: None) -> Discrete | Box:
        """The space of actions."""
        return self.actions.space

    def observation_space(self, params: None) -> Box:
        """The space of observations."""
        return Box(-1.0, float(self.question.steps), (2,))

    def states(self) -> list[ProbeState]:
        """Every state in which an action is chosen."""
        signs = (-1.0, 1.0) if self.question.shows else (0.0,)
        return [ProbeState(jnp.float32(s), jnp.int32(t)) for s in signs for t in range(self.question.steps)]

    def value(self, state: ProbeState, action: jax.Array, discount: float) -> float:
        """The value of an action under the best policy: reward + discount x the value of the next state."""
        now = float(self.question.reward(self.actions, state, action))
        new = ProbeState(state.sign, state.time + 1)
        return now if new.time >= self.question.steps else now + discount * self.value(new, self.best(new), discount)

    def best(self, state: ProbeState) -> jax.Array:
        """The best action; any action where none is better."""
        return self.actions.best(state.sign if self.question.shows else jnp.float32(1))


QUESTIONS: tuple[Question, ...] = (Constant(), ByObservation(), Late(), ByAction(), ByBoth())
