"""Deep Q-learning with hindsight on the single stroke: a map of cells, dug by one walk in as few steps as possible.

Many environments walk side by side, each on random maps of its own. A walk is learned from with its own goal, or with the
cells dug at its end as the goal (hindsight, `train.replay.her`). The network sees the map as seen from the tool, and illegal
actions are never compared. With Q' a slowly following copy of the network, the target of an action is either

    Sampled:  r + gamma Q'(s', argmax Q(s', .)), over `reach` steps as they were taken (double DQN), or
    Every:    r + gamma max Q'(s', .) by the model's next state, for each legal action: approximate value iteration on the
              states that the walks visit. It wins by far, and is the default; `Dqn.plain()` is the other.

Mnih et al. 2015 (doi:10.1038/nature14236); van Hasselt et al. 2016; Wang et al. 2016; Andrychowicz et al. 2017.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import optax

from jaxsand.envs.onmap import MapParams, MapState
from train.dqn.networks import Bins, Greedy, Head, Mean, QNet
from train.dqn.targets import Backup, Every, Items, Sampled, items_of
from train.dqn.tasks import SingleStroke, Task
from train.evaluation.probes import ProbeState
from train.replay.buffer import Buffer
from train.replay.her import Final, Observation, Steps, Strategy, chosen, relabel

Learned = tuple[optax.Params, optax.Params, optax.OptState]
"""A network's parameters, their moving average, and the optimiser's state."""


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Walking:
    """The state of a run.

    Attributes:
      params: of the network.
      average: their moving average, which is the target network, and what acts.
      optimiser: its state.
      memory: the replay buffer's state.
      observation, world: the environments' observations and states [E].
      key: of what is drawn next.
      chunk: chunks done.
    """

    params: optax.Params
    average: optax.Params
    optimiser: optax.OptState
    memory: Any
    observation: Observation
    world: Any
    key: jax.Array
    chunk: jax.Array


@dataclass(frozen=True)
class Dqn:
    """The learner. A chunk is `steps` steps in each of `envs` environments, then `updates` updates by Adam on `batch` items
    each.

    The share of random actions goes from `careful` to its eighth root over the environments (as in Ape-X,
    arXiv:1803.00933). The learning rate falls as 1 / sqrt(chunk) after `decay` chunks.
    """

    task: Task = field(default_factory=SingleStroke)
    strategy: Strategy = field(default_factory=Final)
    backup: Backup = field(default_factory=Every)
    head: Head = field(default_factory=Bins)
    width: int = 384
    blocks: int = 2
    reach: int = 64
    gamma: float = 1.0
    envs: int = 64
    steps: int = 64
    updates: int = 64
    batch: int = 256
    capacity: int = 65_536
    rate: float = 1e-3
    decay: int = 100
    memory: float = 0.99  # of the moving average
    careful: float = 1e-3
    every: int = 20

    @classmethod
    def plain(cls) -> "Dqn":
        """Double dueling DQN with hindsight on sampled three-step returns, a value being one number."""
        return cls(backup=Sampled(), head=Mean(), reach=3)

    @property
    def name(self) -> str:
        """The learner's name, in files of runs."""
        return "dqn"

    @property
    def net(self) -> QNet:
        """The network that values actions."""
        return QNet(self.task.look, self.task.actions, self.head, self.width, self.blocks)

    def init(self, seed: int) -> Walking:
        """The state before the first chunk."""
        return begin(self, jax.random.key(seed))

    def advance(self, state: Walking) -> tuple[Walking, dict[str, float]]:
        """One chunk of work.

        Returns:
          The next state, and the metrics: the mean `loss`, the mean `reward` of a step, the share of steps that finished
            their map
          (`done`), and how many `steps` were made.
        """
        state, metrics = practise(self, state)
        return state, {name: float(value) for name, value in metrics.items()} | {"steps": float(self.envs * self.steps)}

    def validate(self, state: Walking) -> dict[str, float]:
        """What greedy walks reach on maps set apart; see the task."""
        return self.task.validate(self.policy(state))

    def walker(self, state: Walking) -> Greedy:
        """The policy that acts while it learns."""
        return Greedy(self.net, state.average)

    def policy(self, state: Walking) -> Greedy:
        """The policy that is judged; see the task."""
        return self.task.policy(self.walker(state))

    def ring(self) -> Buffer:
        """The replay buffer."""
        return Buffer(self.capacity, self.batch)


@partial(jax.jit, static_argnames="learner")
def begin(learner: Dqn, key: jax.Array) -> Walking:
    """The state before the first chunk. It may be vmapped over keys."""
    task: Any = learner.task
    key, goals, reset, weights = jax.random.split(key, 4)
    params = task.world(goals)
    seen, world = jax.vmap(task.env.reset, (0, None))(jax.random.split(reset, learner.envs), params)
    seen = jax.vmap(task.packed)(seen)
    net = learner.net.init(weights, seen)
    none = jnp.zeros(learner.envs, jnp.float32)
    items = items_of(Steps(seen, none.astype(jnp.int32), none, none > 0, seen, none > 0), learner.reach, learner.gamma)
    memory = learner.ring().init(jax.tree.map(lambda x: x[0], items))
    return Walking(net, net, _optimiser().init(net), memory, seen, world, key, jnp.int32(0))


@partial(jax.jit, static_argnames="learner")
def practise(learner: Dqn, state: Walking) -> tuple[Walking, dict[str, jax.Array]]:
    """One chunk. It may be vmapped over states, for many seeds at once."""
    key, goals, walk, hindsight, learn = jax.random.split(state.key, 5)
    params = learner.task.world(goals)
    (seen, world), rows = _walk(learner, state, params, walk)
    memory = learner.ring().add(state.memory, _items(learner, rows, hindsight))
    learned, loss = _learn(learner, state, params, partial(learner.ring().sample, memory), learn)
    metrics = {"loss": jnp.mean(loss), "reward": jnp.mean(rows.reward), "done": jnp.mean(rows.terminated)}
    return Walking(*learned, memory, seen, world, key, state.chunk + 1), metrics


def _optimiser() -> optax.GradientTransformation:
    return optax.chain(optax.clip_by_global_norm(10.0), optax.scale_by_adam())


def _walk(
    learner: Dqn, state: Walking, params: MapParams | None, key: jax.Array
) -> tuple[tuple[Observation, MapState | ProbeState], Steps]:
    """The environments' last observations and states [E, ...], and their steps [T, E, ...]."""
    task: Any = learner.task
    number, policy = learner.envs, learner.walker(state)
    share = learner.careful ** jnp.linspace(1 / 8, 1, number)

    def one(
        carry: tuple[Observation, MapState | ProbeState], key: jax.Array
    ) -> tuple[tuple[Observation, MapState | ProbeState], Steps]:
        seen, world = carry
        chance, choose, step = jax.random.split(key, 3)
        legal = jax.vmap(task.legal)(seen)
        anything = jax.random.categorical(choose, jnp.where(legal, jnp.float32(0), -jnp.inf))
        action = jnp.where(jax.random.uniform(chance, (number,)) < share, anything, policy.act(seen, legal))
        stepped = jax.vmap(task.env.step, (0, 0, 0, None))
        new, world, reward, terminated, truncated, info = stepped(jax.random.split(step, number), world, action, params)
        after = jax.vmap(task.packed)(info["final_observation"])
        made = Steps(seen, action.astype(jnp.int32), reward.astype(jnp.float32), terminated, after, terminated | truncated)
        return (jax.vmap(task.packed)(new), world), made

    return jax.lax.scan(one, (state.observation, state.world), jax.random.split(key, learner.steps))


def _items(learner: Dqn, rows: Steps, key: jax.Array) -> Items:
    """Items [E T] of steps [T, E, ...].

    One environment in 1 + copies keeps its own goals, and so does one whose goals in hindsight are barred; the others learn
    in hindsight.
    """
    task, strategy = learner.task, learner.strategy
    rows = jax.tree.map(lambda x: jnp.moveaxis(x, 1, 0), rows)
    if strategy.copies:
        choose, draw = jax.random.split(key)
        other = jax.vmap(lambda k, row: relabel(k, row, strategy, task.judge))(jax.random.split(draw, learner.envs), rows)
        own = jax.random.uniform(choose, (learner.envs,)) * (1 + strategy.copies) < 1
        own |= jax.vmap(lambda row: jnp.any(task.barred(row.observation)))(other)
        rows = chosen(own, rows, other)
    items = jax.vmap(lambda row: items_of(row, learner.reach, learner.gamma))(rows)
    return jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), items)


def _learn(
    learner: Dqn, state: Walking, params: MapParams | None, sample: Callable[[jax.Array], Items], key: jax.Array
) -> tuple[Learned, jax.Array]:
    """The network's parameters, their average and the optimiser's state after the chunk's updates, and the losses."""
    net = learner.net
    rate = learner.rate * jnp.minimum(1.0, jnp.sqrt(learner.decay / (state.chunk + 1.0)))

    def one(carry: Learned, key: jax.Array) -> tuple[Learned, jax.Array]:
        own, average, optimiser = carry
        items = sample(key)
        targets, weights = learner.backup.targets(
            learner.task, params, learner.gamma, items, Greedy(net, own).values, Greedy(net, average).values
        )

        def loss(own: optax.Params) -> jax.Array:
            made: Any = net.apply(own, items.observation)
            return jnp.mean(jnp.sum(weights * net.head.loss(made, targets), axis=1))

        value, gradient = jax.value_and_grad(loss)(own)
        update, optimiser = _optimiser().update(gradient, optimiser, own)
        own = jax.tree.map(lambda p, u: p - rate * u, own, update)
        average = jax.tree.map(lambda a, p: learner.memory * a + (1 - learner.memory) * p, average, own)
        return (own, average, optimiser), value

    carry = (state.params, state.average, state.optimiser)
    return jax.lax.scan(one, carry, jax.random.split(key, learner.updates))
