"""An off-policy actor-critic with hindsight, of DDPG's family, for strokes.

The critic Q learns what a stroke gains, from strokes tried on the way to goals that random strokes leave, with goals in
hindsight for most of them (`train.actor_critic.memory`). With r the reward and c_1, c_2, ... the strokes tried from a state
and others that the actor draws, gradient steps make

    huber(Q(s, a) - r)                                              smaller, by the critic,
    sum_i w_i log p(c_i | s) + calm H(p(. | s)),
        w = softmax(Q(s, c) / temperature)                          larger, by the actor p.

As in DDPG the policy climbs dQ/da, but where it acts (`train.actor_critic.acting`): what is due has many modes, of which a
single deterministic actor would take the mean, so it acts by samples. The reward of a stroke tells what is gained at once,
and an episode's rewards sum up to all that it gains; values look no farther ahead. It sees no letter, and imitates nothing.

Lillicrap et al. 2016 (arXiv:1509.02971); Andrychowicz et al. 2017 (arXiv:1707.01495). The actor's loss is that of maximum a
posteriori policy optimisation (Abdolmaleki et al. 2018, arXiv:1806.06920).
"""

from dataclasses import dataclass
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import optax

from jaxsand.goals.usual import SHAPE, usual_scene
from jaxsand.planning.learned.network import Params
from jaxsand.planning.learned.policy import in_batches
from jaxsand.planning.learned.square_symmetries import turned, turned_strokes
from train.actor_critic.acting import Chooses, best
from train.actor_critic.memory import Batch, Memory, draw, empty, remembered
from train.actor_critic.network import StrokeCritic, drawn, log_likelihood, looked, valued
from train.actor_critic.practice import practise
from train.imitation.apart import judged_apart

Learned = tuple[Params, Params, optax.OptState]
"""A network's parameters, their moving average, and the optimiser's state."""

_ACTOR = 0.15  # the weight of the actor's loss
_CALM = 0.02  # the weight in it of the entropy of starts
_DRAWN = 24  # strokes that the actor draws for its loss
_SIZES = (16,)  # of the batches in which it chooses while it practises


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Skill:
    """The state of a run: the network's parameters, their moving average (which acts), the optimiser's state, what is
    remembered, chunks done, the seed.
    """

    params: Params
    average: Params
    optimiser: optax.OptState
    memory: Memory
    chunk: jax.Array
    seed: jax.Array


@dataclass(frozen=True)
class ActorCritic:
    """The learner; see the module.

    A chunk practises on `plans` goals, with `tries` strokes from each state on the way, and then makes `updates` updates of
    `batch` states each. The learning rate falls as 1 / sqrt(updates) after `decay` updates.
    """

    plans: int = 16
    tries: int = 8
    updates: int = 16
    batch: int = 32
    capacity: int = 8192
    rate: float = 7e-4
    decay: int = 1000
    temperature: float = 0.15
    every: int = 24
    widths: tuple[int, int, int] = (32, 64, 96)
    blocks: tuple[int, int, int] = (1, 2, 2)

    @property
    def name(self) -> str:
        """The learner's name, in files of runs."""
        return "actor-critic"

    @property
    def net(self) -> StrokeCritic:
        """The network that values and draws strokes."""
        return StrokeCritic(self.widths, self.blocks)

    def init(self, seed: int) -> Skill:
        """The state before the first chunk."""
        maps = jnp.zeros((1, *SHAPE), jnp.float32)
        params = jax.jit(self.net.init)(jax.random.key(seed), maps, maps, jnp.ones((1, 1, 4), jnp.float32))
        memory = empty(self.capacity, self.tries)
        return Skill(params, params, jax.jit(_optimiser().init)(params), memory, jnp.int32(0), jnp.int32(seed))

    def advance(self, state: Skill) -> tuple[Skill, dict[str, float]]:
        """One chunk of practice and updates.

        Returns:
          The next state, and the metrics: the mean losses of `critic` and `actor`, and how many `pushes`.
        """
        chunk = int(state.chunk)
        rng = np.random.default_rng([int(state.seed), chunk])
        choose = partial(_choose, self.net, state.average, int(rng.integers(1 << 31)))
        tries, pushes = practise(usual_scene(), rng, self.plans, self.tries, choose)
        memory = remembered(state.memory, tries)
        learned, losses = (state.params, state.average, state.optimiser), []
        for number in range(chunk * self.updates, (chunk + 1) * self.updates):
            learned, loss = improve(self, learned, number, int(rng.integers(1 << 31)), draw(memory, rng, self.batch))
            losses.append(loss)
        critic, actor = np.mean(losses, axis=0)
        figures = {"critic": float(critic), "actor": float(actor), "pushes": float(pushes)}
        return Skill(*learned, memory, state.chunk + 1, state.seed), figures

    def validate(self, state: Skill) -> dict[str, float]:
        """Judges the policy alone on goals of random strokes set apart; see `judged_apart`."""
        return judged_apart(self.policy(state))

    def policy(self, state: Skill) -> Chooses:
        """The network with the averaged parameters."""
        return Chooses(self.net, state.average)


def _optimiser() -> optax.GradientTransformation:
    return optax.chain(optax.clip_by_global_norm(1.0), optax.scale_by_adam(), optax.add_decayed_weights(1e-4))


def _choose(
    net: StrokeCritic, params: Params, key: int, goal: np.ndarray, current: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """The best strokes [B, 4] (cells) from a single view of the maps, and those that the actor drew [B, C, 4]."""
    strokes, own = in_batches(partial(_act, net, params, key), goal, current, _SIZES)
    return strokes[:, 0], own


@partial(jax.jit, static_argnames="net")
def _act(net: StrokeCritic, params: Params, key: int, goal: jax.Array, current: jax.Array) -> tuple[jax.Array, jax.Array]:
    scores = looked(net, params, goal, current)
    strokes, _, own = best(net, params, scores, jax.random.key(key), 1)
    return strokes, own


@partial(jax.jit, static_argnames="learner")
def improve(learner: ActorCritic, learned: Learned, number: int, key: int, some: Batch) -> tuple[Learned, jax.Array]:
    """One step of gradient descent, the `number`th, on states seen in a random view.

    Returns:
      The new parameters, their average and the optimiser's state; and the losses of critic and actor [2].
    """
    params, average, state = learned
    view, draw = jax.random.split(jax.random.key(key))
    goal, current, strokes = _turned(view, some)

    def loss(params: Params) -> tuple[jax.Array, jax.Array]:
        scores = looked(learner.net, params, goal, current)
        value = valued(learner.net, params, scores)
        critic = jnp.mean(optax.huber_loss(value(strokes), some.reward, delta=1.0))
        fixed = jax.lax.stop_gradient(scores)
        tried = jnp.concatenate([strokes, drawn(draw, fixed, _DRAWN)], 1)
        weight = jax.nn.softmax(jax.lax.stop_gradient(value(tried)) / learner.temperature, 1)
        entropy = -jnp.sum(jnp.exp(scores.start) * scores.start, (1, 2))
        actor = -jnp.mean(jnp.sum(weight * log_likelihood(scores, tried), 1) + _CALM * entropy)
        return critic + _ACTOR * actor, jnp.stack([critic, actor])

    gradient, losses = jax.grad(loss, has_aux=True)(params)
    rate = learner.rate * jnp.minimum(1.0, jnp.sqrt(learner.decay / (number + 1.0))) * jnp.minimum(1.0, (number + 1) / 100)
    update, state = _optimiser().update(gradient, state, params)
    params = jax.tree.map(lambda p, u: p - rate * u, params, update)
    share = 10 / (number + 100.0)  # the mean of about the last tenth of the updates
    average = jax.tree.map(lambda a, p: a + share * (p - a), average, params)
    return (params, average, state), losses


def _turned(key: jax.Array, some: Batch) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Goals, current maps and strokes of a batch, all turned or mirrored in one random way of eight."""
    goal, current, strokes = (jnp.asarray(x) for x in (some.goal, some.current, some.strokes))

    def seen(way: int) -> tuple[jax.Array, jax.Array, jax.Array]:
        return turned(goal, way), turned(current, way), turned_strokes(strokes, way, SHAPE[0])

    return jax.lax.switch(jax.random.randint(key, (), 0, 8), [partial(seen, way) for way in range(8)])
