"""Hindsight imitation: a network sees a goal that random strokes made, and sand on the way there, and learns which strokes
are still to come.

Hindsight makes every plan of random strokes a success to learn from (goal-conditioned supervised learning, Ghosh et al.
2019), and no reward is needed. With s the starts and e the ends of the n strokes that are still to come, all equally
good,

    loss = -1/n sum_r [log p(s_r) + log p(e_r | s_r)] + the losses of pairs of ends: a logistic one (is such a stroke
    still to
           come or not) and Huber's of the ends of one that is.

After some chunks, every second chunk also holds lessons on the way of the network's own strokes (as in DAgger, Ross et
al. 2011), so that it learns to go on from its mistakes. It never sees a letter.
"""

from dataclasses import dataclass
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax

from jaxsand.goals.usual import SHAPE, SPACING, usual_scene
from jaxsand.planning.learned.network import Params, StrokeNet, ends, judge, likeliest, spread
from jaxsand.planning.learned.policy import Policy, in_batches
from jaxsand.scene.scene import Scene, blade_of
from train.imitation.apart import judged_apart
from train.imitation.lessons import Lessons, lessons
from train.imitation.sand import other_scene, starts

_Learned = tuple[Params, Params, optax.OptState]  # parameters, their moving average, the optimiser's state
_WEIGHT = 2.0  # of the loss of pairs: are they due
_ENDS = 4.0  # and how far are their ends off (cells)
_HUBER = 0.05  # cells
_SAME, _OTHER = 1.0, 2.5  # cells: nearer than that to a due stroke is one, farther is none


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Progress:
    """The state of a run: the network's parameters, their moving average (which acts), the optimiser's state, chunks done,
    the seed.
    """

    params: Params
    average: Params
    optimiser: optax.OptState
    chunk: jax.Array
    seed: jax.Array


@dataclass(frozen=True)
class Hindsight:
    """The learner; see the module.

    A chunk has lessons from `plans` plans of random strokes, taken `batch` at a time. From the chunk `own` on every second
    chunk has lessons on the way of its own strokes. A share `rough` of the plans starts on rough sand, and one chunk in
    `other` has another blade and another angle of repose.
    """

    plans: int = 192
    batch: int = 16
    rate: float = 7e-4
    decay: int = 30  # chunks after which the learning rate falls as 1 / sqrt(chunk)
    memory: float = 0.9995  # of the moving average
    own: int = 20
    rough: float = 0.2
    other: int = 3
    every: int = 12
    widths: tuple[int, int, int] = (32, 64, 96)
    blocks: tuple[int, int, int] = (1, 2, 2)

    @property
    def name(self) -> str:
        """The learner's name, in files of runs."""
        return "hindsight"

    @property
    def net(self) -> StrokeNet:
        """The network that proposes strokes."""
        return StrokeNet(self.widths, self.blocks)

    def init(self, seed: int) -> Progress:
        """The state before the first chunk."""
        maps = jnp.zeros((1, SHAPE[0], SHAPE[0]))
        params = jax.jit(self.net.init)(jax.random.key(seed), maps, maps, jnp.zeros((1, 1, 4)))
        return Progress(params, params, jax.jit(_optimiser().init)(params), jnp.int32(0), jnp.int32(seed))

    def advance(self, state: Progress) -> tuple[Progress, dict[str, float]]:
        """One chunk of lessons.

        Returns:
          The next state, and the metrics: the mean `loss`, how many `lessons` and `pushes`, and whether on its `own` way.
        """
        chunk = int(state.chunk)
        rng = np.random.default_rng([int(state.seed), chunk])
        scene = other_scene(rng) if chunk % self.other == self.other - 1 else usual_scene()
        own = chunk >= self.own and chunk % 2 == 1
        choose = partial(_choose, self.net, state.average, _depth(scene)) if own else None
        lesson = lessons(scene, rng, self.plans, starts(scene, rng, self.plans, self.rough), choose)
        order, losses = rng.permutation(len(lesson.goal)), []
        learned = (state.params, state.average, state.optimiser)
        for first in range(0, len(order) - self.batch + 1, self.batch):
            some = _turned(lesson, order[first : first + self.batch], rng, _depth(scene))
            learned, loss = _learn(self, learned, chunk, int(rng.integers(1 << 31)), *some)
            losses.append(loss)
        figures = {"loss": np.mean(losses), "lessons": len(losses) * self.batch, "pushes": lesson.pushes, "own": own}
        return Progress(*learned, state.chunk + 1, state.seed), {name: float(x) for name, x in figures.items()}

    def validate(self, state: Progress) -> dict[str, float]:
        """Judges the policy alone on goals of random strokes set apart.

        Returns:
          The share of goals that is `right`, the share of `strokes` that are, the `iou`, and the mean of the three, `score`.
        """
        return judged_apart(self.policy(state))

    def policy(self, state: Progress) -> Policy:
        """The network with the averaged parameters."""
        return Policy(self.net, state.average)


def _depth(scene: Scene) -> float:
    return float(blade_of(scene).depth)


def _optimiser() -> optax.GradientTransformation:
    return optax.chain(optax.clip_by_global_norm(1.0), optax.scale_by_adam(), optax.add_decayed_weights(1e-4))


def _choose(net: StrokeNet, params: Params, depth: float, goal: np.ndarray, current: np.ndarray) -> np.ndarray:
    """The likeliest strokes [B, 4] (m) from a single view of the maps, which is good enough to learn from."""
    (strokes,) = in_batches(partial(_act, net, params), goal / depth, current / depth, (64,))
    return strokes * SPACING


@partial(jax.jit, static_argnames="net")
def _act(net: StrokeNet, params: Params, goal: jax.Array, current: jax.Array) -> tuple[jax.Array]:
    scores: Any = net.apply(params, goal, current, method="look")
    return (likeliest(judge(net, params), scores, 1)[0][:, 0],)


def _turned(lesson: Lessons, who: np.ndarray, rng: np.random.Generator, depth: float) -> tuple[np.ndarray, ...]:
    """Lessons in units of the blade's depth and of cells, each mirrored and transposed at random."""
    goal, current = (x[who] / depth for x in (lesson.goal, lesson.current))
    due = (lesson.due[who] / SPACING).reshape(len(who), -1, 2, 2)
    for axis in (0, 1):  # x, y
        flip = rng.random(len(who)) < 0.5
        goal, current = (np.where(flip[:, None, None], np.flip(x, 2 - axis), x) for x in (goal, current))
        due[flip, ..., axis] = SHAPE[0] - due[flip, ..., axis]
    swap = rng.random(len(who)) < 0.5
    goal, current = (np.where(swap[:, None, None], x.swapaxes(1, 2), x) for x in (goal, current))
    due = np.where(swap[:, None, None, None], due[..., ::-1], due)
    return goal, current, due, lesson.counts[who]


def _pairs(key: jax.Array, due: jax.Array) -> jax.Array:
    """Pairs of ends [B, 7 R, 4] (cells) of strokes [B, R, 2, 2]: the strokes' own, reversed, mixed, and moved."""
    batch, count = due.shape[:2]
    a, b, c, d = jax.random.split(key, 4)
    every = due.reshape(batch, 2 * count, 2)
    mixed = jnp.take_along_axis(every, jax.random.randint(a, (batch, 2 * count, 1), 0, 2 * count), 1)
    other = jnp.take_along_axis(due[:, :, 1], jax.random.randint(b, (batch, count, 1), 0, count), 1)
    far = 10 ** jax.random.uniform(d, (batch, 2 * count, 2, 1), due.dtype, -1, 0.8)
    moved = jnp.tile(due, (1, 2, 1, 1)) + far * jax.random.normal(c, (batch, 2 * count, 2, 2), due.dtype)
    return jnp.concatenate(
        [
            due.reshape(batch, count, 4),
            due[:, :, ::-1].reshape(batch, count, 4),
            jnp.concatenate([due[:, :, 0], other], -1),
            mixed.reshape(batch, count, 4),
            jnp.clip(moved.reshape(batch, 2 * count, 4), 0, SHAPE[0]),
        ],
        1,
    )


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Labels:
    """What is known of pairs of ends.

    Attributes:
      due: [B, P] 1 where the pair is a stroke that is still to come, else 0.
      clear: [B, P] 1 where `due` is beyond doubt, else 0.
      strokes: [B, P, 4] (cells) the nearest stroke to come.
    """

    due: jax.Array
    clear: jax.Array
    strokes: jax.Array


def _labels(pairs: jax.Array, due: jax.Array, counts: jax.Array) -> Labels:
    """Labels of pairs [B, P, 4] for strokes [B, R, 2, 2], of which those with `counts` [B, R] are still to come."""
    strokes = due.reshape(*due.shape[:2], 4)
    every = jnp.max(jnp.abs(pairs[:, :, None] - strokes[:, None]), -1)
    every = jnp.where(counts[:, None] > 0, every, jnp.inf)
    off, which = jnp.min(every, -1), jnp.argmin(every, -1)
    close = off <= _SAME
    nearest = jnp.take_along_axis(strokes, which[..., None], 1)
    return Labels(close.astype(pairs.dtype), (close | (off >= _OTHER)).astype(pairs.dtype), nearest)


@partial(jax.jit, static_argnames="learner")
def _learn(
    learner: Hindsight,
    learned: _Learned,
    chunk: int,
    key: int,
    goal: jax.Array,
    current: jax.Array,
    due: jax.Array,
    counts: jax.Array,
) -> tuple[_Learned, jax.Array]:
    """One step of gradient descent on a batch: the new parameters, their average and the optimiser's state, and the loss."""
    params, average, state = learned
    pairs = _pairs(jax.random.key(key), due)
    label = _labels(pairs, due, counts)

    def loss(params: Params) -> jax.Array:
        made: Any = learner.net.apply(params, goal, current, pairs)
        scores, lines = made
        share = counts / jnp.sum(counts, 1, keepdims=True)
        shape = (goal.shape[1], goal.shape[2])
        start = jnp.einsum("brij,bij->br", spread(due[:, :, 0], shape), scores.start)
        end = jnp.sum(spread(due[:, :, 1], shape) * ends(scores, due[:, :, 0]), (2, 3))
        wrong = _mean(optax.sigmoid_binary_cross_entropy(lines.due, label.due), label.clear)
        off = _mean(jnp.sum(optax.huber_loss(lines.strokes, label.strokes, delta=_HUBER), -1) / _HUBER, label.due)
        return -jnp.mean(jnp.sum(share * (start + end), 1)) + _WEIGHT * wrong + _ENDS * off

    value, gradient = jax.value_and_grad(loss)(params)
    rate = learner.rate * jnp.minimum(1.0, jnp.sqrt(learner.decay / (chunk + 1.0))) * jnp.minimum(1.0, (chunk + 1) / 8)
    update, state = _optimiser().update(gradient, state, params)
    params = jax.tree.map(lambda p, u: p - rate * u, params, update)
    memory = jnp.minimum(learner.memory, 1 - 0.015 * learner.batch / (chunk + 2))
    average = jax.tree.map(lambda a, p: memory * a + (1 - memory) * p, average, params)
    return (params, average, state), value


def _mean(values: jax.Array, weights: jax.Array) -> jax.Array:
    return jnp.sum(weights * values) / jnp.sum(weights)
