"""DDPG with hindsight experience replay, all of it in JAX: environments, replay buffer and updates.

Deep deterministic policy gradients (Lillicrap et al. 2016, arXiv:1509.02971). With Q' and pi' the slowly following target
copies of the critic Q and the actor pi, and o' the observation after o, gradient steps make

    (r + discount (1 - terminated) min(Q'(o', pi'(o')), most(o')) - Q(o, a))^2   smaller, by the critic,
    Q(o, pi(o)) - calm |raw(o)|^2 / A                                            larger, by the actor,

with pi = tanh(raw) in R^A. A time limit is no end: only `terminated` cuts the values off. No value can exceed `most`, a
bound that the task knows. Without it values diverge; the original implementation of HER clips them for the same reason.
By default the discount is 0: the reward of a stroke tells what is gained at once, an episode's rewards sum up to all that it
gains, and what later strokes may mend would hide how good this one is. Hindsight is in `train.replay.her`.
"""

import math
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import chex
import jax
import jax.numpy as jnp
import optax

from jaxsand.envs.multi import StrokeParams
from train.ddpg.acting import Acts
from train.ddpg.networks import Actor, Critic, Flat, Maps, Sight
from train.ddpg.tasks import Strokes, Task
from train.replay.buffer import Buffer
from train.replay.her import Future, Observation, Steps, Strategy, exchanged, mixed

_REMEMBERED = jnp.float16  # observations: maps in units of the blade's depth


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Agent:
    """The parameters of actor and critic, of their target copies, and both optimisers' states."""

    actor: optax.Params
    critic: optax.Params
    slow_actor: optax.Params
    slow_critic: optax.Params
    actor_optimiser: optax.OptState
    critic_optimiser: optax.OptState


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Practice:
    """The state of a run: the agent, the replay buffer, the environments' observations and states [E], the key, the chunks
    done.
    """

    agent: Agent
    memory: Any
    observation: Observation
    world: Any
    key: jax.Array
    chunk: jax.Array


@dataclass(frozen=True)
class Ddpg:
    """The learner. A chunk is `steps` steps in each of `envs` environments, then `updates` updates of `batch` steps each.

    In the first `warm` chunks all actions are uniform. Later a share `random` of them is, and the others are the actor's
    plus normal noise of standard deviation `noise`. The buffer holds `capacity` rows of `steps` steps. A step that is drawn
    has its own goal or one in hindsight (`strategy`), and a share `exchange` of them then the goal of another.
    """

    task: Task = field(default_factory=Strokes)
    sight: Sight = field(default_factory=Maps)
    strategy: Strategy = field(default_factory=Future)
    exchange: float = 0.5
    discount: float = 0.0
    actor_rate: float = 3e-4
    critic_rate: float = 1e-3
    follow: float = 0.01  # how far slow copies go to what they follow, at each update
    calm: float = 0.01
    noise: float = 0.2
    random: float = 0.2
    warm: int = 4
    envs: int = 64
    steps: int = 3
    updates: int = 64
    batch: int = 128
    capacity: int = 4096
    every: int = 20

    @classmethod
    def paper(cls) -> "Ddpg":
        """The setting of arXiv:1908.02745 as far as it is known: DDPG with HER, 10,000 episodes, for the multi stroke.

        What the paper does not say is taken from the original implementation of HER (OpenAI Baselines, Plappert et al. 2018,
        arXiv:1802.09464): three fully connected layers of 256, both rates 1e-3, target copies that follow by 5%, batches of
        256, four goals in hindsight to one and none exchanged, 30% random actions, noise of 0.2, and a discount of 0.98.
        Assumed: episodes of three strokes towards what three random strokes make of level sand; the reward L_t - L_{t+1},
        with L the squared distance over 5; one update an episode, where that implementation makes 20, so that it ends in
        minutes.
        """
        return cls(
            sight=Flat((256, 256, 256)),
            exchange=0.0,
            discount=0.98,
            actor_rate=1e-3,
            critic_rate=1e-3,
            follow=0.05,
            random=0.3,
            batch=256,
        )

    def chunks(self, episodes: int) -> int:
        """How many chunks make `episodes` episodes, if each takes a row of `steps`."""
        return math.ceil(episodes / self.envs)

    @property
    def name(self) -> str:
        """The learner's name, in files of runs."""
        return "ddpg"

    @property
    def actor(self) -> Actor:
        """The network that chooses actions."""
        env, params = self.world()
        return Actor(self.sight.module(), env.action_space(params).shape[0])

    @property
    def critic(self) -> Critic:
        """The network that values actions."""
        return Critic(self.sight.module())

    def world(self) -> tuple[Any, Any]:
        """The environment and its parameters."""
        return self.task.world()

    def init(self, seed: int) -> Practice:
        """The state before the first chunk."""
        return begin(self, self.world()[1], jax.random.key(seed))

    def advance(self, state: Practice) -> tuple[Practice, dict[str, float]]:
        """One chunk of work.

        Returns:
          The next state, and the metrics: the mean `reward` of the steps made, the critic's `loss`, the `value` of the
            actor's
          actions, and how many `steps` were made.
        """
        state, metrics = practise(self, self.world()[1], state)
        return state, {name: float(value) for name, value in metrics.items()} | {"steps": float(self.envs * self.steps)}

    def validate(self, state: Practice) -> dict[str, float]:
        """What the actor alone reaches in episodes set apart; see the task."""
        return self.task.validate(self.policy(state))

    def policy(self, state: Practice) -> Acts:
        """The agent as a policy."""
        return Acts(self.actor, self.critic, state.agent.actor, state.agent.critic, self.noise)


@partial(jax.jit, static_argnames="learner")
def begin(learner: Ddpg, params: StrokeParams | None, key: jax.Array) -> Practice:
    """The state before the first chunk; `params` are the environments'. It may be vmapped over keys."""
    env, _ = learner.world()
    key, first, second, reset = jax.random.split(key, 4)
    observation, world = jax.vmap(env.reset, (0, None))(jax.random.split(reset, learner.envs), params)
    action = jnp.zeros((learner.envs, learner.actor.size), jnp.float32)
    actor = learner.actor.init(first, observation)
    critic = learner.critic.init(second, observation, action)
    row = Steps(_remembered(observation), action, action[:, 0], action[:, 0] > 0, _remembered(observation), action[:, 0] > 0)
    row = jax.tree.map(lambda x: jnp.zeros((learner.steps, *x.shape[1:]), x.dtype), row)
    optimisers = [opt.init(p) for opt, p in zip(_optimisers(learner), (actor, critic), strict=True)]
    agent = Agent(actor, critic, actor, critic, *optimisers)
    return Practice(agent, _memory(learner).init(row), observation, world, key, jnp.int32(0))


def practise(learner: Ddpg, params: StrokeParams | None, state: Practice) -> tuple[Practice, dict[str, jax.Array]]:
    """One chunk. It may be vmapped over states, for many seeds at once.

    Steps and updates are programs called one by one: inside a loop of XLA's, a CPU computes convolutions by a path that is
    an order slower.
    """
    key, act, learn = jax.random.split(state.key, 3)
    observation, world, steps = state.observation, state.world, []
    for k in range(learner.steps):
        now = jax.random.fold_in(act, k)
        observation, world, step = _step(learner, params, state.agent.actor, state.chunk, observation, world, now)
        steps.append(step)
    memory, reward = _keep(learner, state.memory, steps)
    agent, made = state.agent, []
    for k in range(learner.updates):
        agent, metrics = _improve(learner, agent, memory, jax.random.fold_in(learn, k))
        made.append(metrics)
    metrics = {"reward": reward} | {name: jnp.mean(jnp.stack([one[name] for one in made])) for name in made[0]}
    return Practice(agent, memory, observation, world, key, state.chunk + 1), metrics


def update(learner: Ddpg, agent: Agent, some: Steps) -> tuple[Agent, dict[str, jax.Array]]:
    """Updates both networks and their target copies once, from steps [B]."""
    target = some.reward
    if learner.discount:
        next_action, _ = _act(learner, agent.slow_actor, some.after)
        ahead = jnp.minimum(_value(learner, agent.slow_critic, some.after, next_action), learner.task.most(some.after))
        target += learner.discount * jnp.where(some.terminated, 0, ahead)
    chex.assert_equal_shape([some.reward, some.terminated, target])  # [B]: a [B, 1] would broadcast to [B, B]

    def critic_loss(critic: optax.Params) -> jax.Array:
        return jnp.mean((target - _value(learner, critic, some.observation, some.action)) ** 2)

    def actor_loss(actor: optax.Params) -> tuple[jax.Array, jax.Array]:
        action, raw = _act(learner, actor, some.observation)
        value = jnp.mean(_value(learner, agent.critic, some.observation, action))
        return learner.calm * jnp.mean(raw**2) - value, value

    loss, of_critic = jax.value_and_grad(critic_loss)(agent.critic)
    (_, value), of_actor = jax.value_and_grad(actor_loss, has_aux=True)(agent.actor)
    for_actor, for_critic = _optimisers(learner)
    step, actor_optimiser = for_actor.update(of_actor, agent.actor_optimiser)
    actor = optax.apply_updates(agent.actor, step)
    step, critic_optimiser = for_critic.update(of_critic, agent.critic_optimiser)
    critic = optax.apply_updates(agent.critic, step)
    slow_actor = optax.incremental_update(actor, agent.slow_actor, learner.follow)
    slow_critic = optax.incremental_update(critic, agent.slow_critic, learner.follow)
    new = Agent(actor, critic, slow_actor, slow_critic, actor_optimiser, critic_optimiser)
    return new, {"loss": loss, "value": value}


@partial(jax.jit, static_argnames="learner")
def _step(
    learner: Ddpg,
    params: StrokeParams | None,
    actor: optax.Params,
    chunk: jax.Array,
    observation: Observation,
    world: Any,
    key: jax.Array,
) -> tuple[Observation, Any, Steps]:
    """The environments' observations and states after one step, and this step, [E, ...]."""
    env, _ = learner.world()
    share = jnp.where(chunk < learner.warm, 1.0, learner.random)
    noise, uniform, which, world_key = jax.random.split(key, 4)
    action, _ = _act(learner, actor, observation)
    near = action + learner.noise * jax.random.normal(noise, action.shape, action.dtype)
    anywhere = jax.random.uniform(uniform, action.shape, action.dtype, -1, 1)
    action = jnp.where(jax.random.uniform(which, (len(action), 1)) < share, anywhere, jnp.clip(near, -1, 1))
    keys = jax.random.split(world_key, learner.envs)
    after, world, reward, terminated, truncated, info = jax.vmap(env.step, (0, 0, 0, None))(keys, world, action, params)
    last, done = info["final_observation"], terminated | truncated
    reward = learner.task.reward(observation, last, reward)
    return after, world, Steps(_remembered(observation), action, reward, terminated, _remembered(last), done)


@partial(jax.jit, static_argnames="learner")
def _keep(learner: Ddpg, memory: Any, steps: list[Steps]) -> tuple[Any, jax.Array]:
    """The replay buffer with a row more of each environment, and the mean reward of its steps."""
    rows = jax.tree.map(lambda *x: jnp.stack(x, 1), *steps)
    return _memory(learner).add(memory, rows), jnp.mean(rows.reward)


@partial(jax.jit, static_argnames="learner")
def _improve(learner: Ddpg, agent: Agent, memory: Any, key: jax.Array) -> tuple[Agent, dict[str, jax.Array]]:
    """One update, from a batch that is drawn and relabelled."""
    draw, relabel = jax.random.split(key)
    return update(learner, agent, _drawn(learner, relabel, _memory(learner).sample(memory, draw)))


def _drawn(learner: Ddpg, key: jax.Array, rows: Steps) -> Steps:
    """One step of each row [B, T, ...], with its own goal, one in hindsight, or that of another step."""
    rows = jax.tree.map(lambda x: x.astype(jnp.float32) if x.dtype == _REMEMBERED else x, rows)

    def one(key: jax.Array, row: Steps) -> Steps:
        which, relabel = jax.random.split(key)
        at = jax.random.randint(which, (), 0, learner.steps)
        return jax.tree.map(lambda x: x[at], mixed(relabel, row, learner.strategy, learner.task.judge))

    key, exchange = jax.random.split(key)
    some = jax.vmap(one)(jax.random.split(key, learner.batch), rows)
    return exchanged(exchange, some, learner.exchange, learner.task.judge)


def _act(learner: Ddpg, actor: optax.Params, observation: Observation) -> tuple[jax.Array, jax.Array]:
    made: Any = learner.actor.apply(actor, observation)
    return made[0], made[1]


def _value(learner: Ddpg, critic: optax.Params, observation: Observation, action: jax.Array) -> jax.Array:
    value: Any = learner.critic.apply(critic, observation, action)
    return value


def _memory(learner: Ddpg) -> Buffer:
    return Buffer(learner.capacity, learner.batch)


def _optimisers(learner: Ddpg) -> tuple[optax.GradientTransformation, optax.GradientTransformation]:
    return optax.adam(learner.actor_rate), optax.adam(learner.critic_rate)


def _remembered(observation: Observation) -> Observation:
    return jax.tree.map(lambda x: x.astype(_REMEMBERED), observation)
