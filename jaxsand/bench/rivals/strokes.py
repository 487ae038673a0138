"""What finds strokes without gradients: random shooting, evolution stroke by stroke, the cross-entropy method, CMA-ES.

Each is a `Search`: it may spend `budget` calls of the simulator, one for each stroke of each candidate. Inside, strokes are
numbers in the unit cube; what a Gaussian draws outside is folded back at the faces. Population sizes and widths are the best
of a few that were tried on five letters at 4,000 calls each.

The landscape is hard for all of them: a stroke that lies a cell beside its trench is further from the goal than level sand,
so that nearly all that is drawn at random is worse than a short stroke in a corner. Therefore the Gaussians start narrow,
from the best of random plans.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cache
from typing import Any

import numpy as np

from jaxsand.planning.stroke_loss import Best, Evaluate


@dataclass(frozen=True)
class BestFound:
    """What a search found: the best plan [N, 4] (m), the calls it used, and every improvement on the way."""

    strokes: np.ndarray
    calls: int
    history: list[Best]


Search = Callable[[Evaluate, int, np.ndarray, int, int], BestFound]
"""`search(evaluate, n_strokes, bounds, budget, seed)`; `bounds` [2, 4] are the lowest and highest x0, y0, x1, y1 (m)."""


_POOL = 128  # random plans, the best of which starts a Gaussian
_WIDTH = 0.1  # of a Gaussian at its start
_NARROW = 5e-3  # the width at which it has converged: 1.6 mm on a map of 0.31 m
_WIDE = 10.0  # the width at which it has come apart
_GENERATION = 32  # plans that a Gaussian draws at a time; CMA-ES from restart to restart twice as many, up to four times
_PARENTS, _CHILDREN = 32, 64
_MUTATIONS = (5e-3, 0.3)  # the range of their widths, drawn evenly in the logarithm
_RANDOM = 0.25  # of the calls of a stroke go to random ones, the rest to evolving them
_ROUND = 1000  # calls in the first round of the greedy evolution
_MOST = 2048  # calls a stroke in any of its rounds


def random_shooting(evaluate: Evaluate, n_strokes: int, bounds: np.ndarray, budget: int, seed: int) -> BestFound:
    """The best of plans whose strokes begin and end anywhere."""
    tally = _Tally(evaluate, n_strokes, bounds, budget)
    rng = np.random.default_rng(seed)
    while tally.room:
        tally.judge(rng.random((256, n_strokes, 4)))
    return tally.found()


def greedy_evolution(evaluate: Evaluate, n_strokes: int, bounds: np.ndarray, budget: int, seed: int) -> BestFound:
    """Stroke by stroke, each evolved on the map that the ones before it left; then all over again, with more calls.

    Rounds take 1,000 calls at first and then three times as many as all before, up to 2,048 a stroke, so that the best plan
    after 1,000, 4,000 or 16,000 calls is no worse for a budget that goes on.
    """
    tally = _Tally(evaluate, n_strokes, bounds, budget)
    rng = np.random.default_rng(seed)
    while tally.room:
        each = max(1, max(_ROUND, 3 * tally.calls) // n_strokes)
        tally.add(*_stroke_by_stroke(tally, min(each, _MOST, tally.room), rng))
    return tally.found()


def cross_entropy(evaluate: Evaluate, n_strokes: int, bounds: np.ndarray, budget: int, seed: int) -> BestFound:
    """Draws plans from a Gaussian of 4 N independent numbers and moves it halfway to the best of them; again when narrow."""
    tally = _Tally(evaluate, n_strokes, bounds, budget)
    rng = np.random.default_rng(seed)
    while tally.room:
        mean, wide = _best_of_random(tally, rng), np.full((n_strokes, 4), _WIDTH)
        while tally.room and wide.max() > _NARROW:
            drawn = mean + wide * rng.standard_normal((_GENERATION, n_strokes, 4))
            losses = tally.judge(drawn)
            elite = drawn[np.argsort(losses, kind="stable")[:6]]
            mean, wide = (mean + elite.mean(0)) / 2, (wide + elite.std(0)) / 2
    return tally.found()


def cma_es(evaluate: Evaluate, n_strokes: int, bounds: np.ndarray, budget: int, seed: int) -> BestFound:
    """CMA-ES as evosax has it, from the best of random plans; again with a larger population when it has converged.

    Source: arXiv:1604.00772. Needs the extra `rivals`: pip install 'jaxsand[rivals]'.
    """
    tally = _Tally(evaluate, n_strokes, bounds, budget)
    rng = np.random.default_rng(seed)
    population = _GENERATION
    while tally.room:
        _until_converged(tally, population, rng)
        population = min(2 * population, 4 * _GENERATION)
    return tally.found()


RIVALS: dict[str, Search] = {
    "random shooting": random_shooting,
    "greedy evolution": greedy_evolution,
    "cross-entropy": cross_entropy,
    "CMA-ES": cma_es,
}


@dataclass
class _Tally:
    """Judges candidates within the budget, counts calls and keeps the best."""

    evaluate: Evaluate
    strokes: int
    bounds: np.ndarray
    budget: int
    calls: int = 0
    history: list[Best] = field(default_factory=list)

    def __post_init__(self) -> None:
        if self.strokes < 1:
            raise ValueError(f"n_strokes: got {self.strokes}; give at least 1")
        if self.budget < self.strokes:
            raise ValueError(f"budget: got {self.budget} calls for {self.strokes} strokes; give at least {self.strokes}")
        self.bounds = np.asarray(self.bounds, float)
        if self.bounds.shape != (2, 4) or not np.all(self.bounds[0] < self.bounds[1]):
            raise ValueError(f"bounds: got {self.bounds.tolist()}; give the lowest and highest x0, y0, x1, y1, [2, 4] in m")

    @property
    def room(self) -> int:
        """How many whole plans may still be judged."""
        return (self.budget - self.calls) // self.strokes

    def judge(self, units: np.ndarray) -> np.ndarray:
        """The losses of plans in the unit cube, of as many as there is room for."""
        plans = self.placed(units[: self.room])
        losses = self.evaluate(plans)
        for plan, loss in zip(plans, losses, strict=True):
            self.calls += self.strokes
            self._improve(float(loss), plan)
        return losses

    def judge_next(self, maps: np.ndarray, units: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The losses and maps after one more stroke each."""
        self.calls += len(units)
        return self.evaluate.after(maps, self.placed(units))

    def add(self, loss: float, units: np.ndarray) -> None:
        """A plan that was judged stroke by stroke."""
        self._improve(loss, self.placed(units))

    def placed(self, units: np.ndarray) -> np.ndarray:
        low, high = self.bounds
        return low + (1 - np.abs(1 - np.mod(units, 2))) * (high - low)

    def found(self) -> BestFound:
        return BestFound(self.history[-1].strokes, self.calls, self.history)

    def _improve(self, loss: float, strokes: np.ndarray) -> None:
        if not self.history or loss < self.history[-1].loss:
            self.history.append(Best(self.calls, loss, strokes))


def _stroke_by_stroke(tally: _Tally, each: int, rng: np.random.Generator) -> tuple[float, np.ndarray]:
    """A plan of which every stroke took `each` calls, and its loss."""
    height, loss, chosen = tally.evaluate.start, np.inf, []
    for _ in range(tally.strokes):
        stroke, loss, height = _evolved(tally, height, each, rng)
        chosen.append(stroke)
    return loss, np.stack(chosen)


def _evolved(tally: _Tally, height: np.ndarray, calls: int, rng: np.random.Generator) -> tuple[np.ndarray, float, Any]:
    """The next stroke, its loss and its map: the best of random ones, and of what mutation makes of the best of those.

    Mutations are of all sizes; parents stay among their children.
    """
    first = min(calls, max(_PARENTS, round(_RANDOM * calls)))
    pool = rng.random((first, 4))
    losses, maps = tally.judge_next(np.repeat(height[None], first, axis=0), pool)
    left = calls - first
    while True:
        kept = np.argsort(losses, kind="stable")[:_PARENTS]
        pool, losses, maps = pool[kept], losses[kept], maps[kept]
        count = min(_CHILDREN, left)
        if not count:
            return pool[0], float(losses[0]), maps[0]
        narrowest, widest = np.log(_MUTATIONS)
        wide = np.exp(rng.uniform(narrowest, widest, (count, 1)))
        born = pool[np.arange(count) % len(pool)] + wide * rng.standard_normal((count, 4))
        new, left = tally.judge_next(np.repeat(height[None], count, axis=0), born), left - count
        pool, losses = np.concatenate([pool, born]), np.concatenate([losses, new[0]])
        maps = np.concatenate([maps, new[1]])


def _best_of_random(tally: _Tally, rng: np.random.Generator) -> np.ndarray:
    drawn = rng.random((_POOL, tally.strokes, 4))
    return drawn[int(np.argmin(tally.judge(drawn)))]


@cache
def _strategy(population: int, n_strokes: int) -> tuple[Any, Any]:
    """The strategy and its parameters; one for each size, since it compiles anew for every object."""
    import jax.numpy as jnp

    try:
        from evosax.algorithms import CMA_ES
    except ImportError:
        raise ValueError("method: CMA-ES needs evosax; run pip install 'jaxsand[rivals]'") from None
    strategy = CMA_ES(population_size=population, solution=jnp.zeros(4 * n_strokes))
    return strategy, strategy.default_params


def _until_converged(tally: _Tally, population: int, rng: np.random.Generator) -> None:
    import jax

    with jax.numpy_rank_promotion("allow"):
        strategy, params = _strategy(population, tally.strokes)
        params = params.replace(std_init=_WIDTH)
        key = jax.random.key(int(rng.integers(2**31)))
        state = strategy.init(key, _best_of_random(tally, rng).ravel().astype(np.float32), params)
        best: list[float] = []
        patience = 10 + round(30 * 4 * tally.strokes / population)
        while tally.room:
            key, ask, tell = jax.random.split(key, 3)
            drawn, state = strategy.ask(ask, state, params)
            losses = tally.judge(np.asarray(drawn, float).reshape(population, -1, 4))
            if len(losses) < population:
                return
            state, _ = strategy.tell(tell, drawn, losses.astype(np.float32), state, params)
            best.append(float(losses.min()))
            spread = float(state.std) * float(np.sqrt(np.max(np.diag(state.C))))
            stuck = len(best) > 2 * patience and min(best[-patience:]) >= min(best[:-patience])
            if stuck or not _NARROW < spread < _WIDE:
                return
