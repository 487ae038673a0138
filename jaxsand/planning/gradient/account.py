"""What the optimiser has spent and found: each stroke pushed on a map is one call, a gradient counts as what it costs."""

from dataclasses import dataclass, field

import numpy as np
from scipy.ndimage import gaussian_filter

from jaxsand.planning.around import Around
from jaxsand.planning.stroke_loss import GRADIENT, Best, SandLoss
from jaxsand.scene.progress import Tell, quiet


@dataclass
class Account:
    """Counts the simulator's calls up to a budget and keeps the best plan; every method that pushes adds to the calls."""

    sand: SandLoss
    budget: int
    tell: Tell = quiet
    calls: int = 0
    history: list[Best] = field(default_factory=list)
    near: Around | None = None

    @property
    def before(self) -> float:
        """The loss of the start (m^2)."""
        return self.sand.loss_of(self.sand.start)

    @property
    def best(self) -> Best:
        """The best plan so far."""
        return self.history[-1]

    def room(self, strokes: int) -> int:
        """How many plans of `strokes` strokes the budget still allows."""
        return (self.budget - self.calls) // max(strokes, 1)

    def losses(self, plans: np.ndarray) -> np.ndarray:
        """The losses [P] of plans [P, N, 4]; infinite for plans beyond the budget, which are not pushed."""
        some = plans[: self.room(plans.shape[1])]
        out = np.full(len(plans), np.inf)
        if len(some):
            self.calls += len(some) * plans.shape[1]
            out[: len(some)] = self.sand(some)
            self._note(some, out[: len(some)])
        return out

    def around(self, plan: np.ndarray) -> Around:
        """A plan [N, 4], pushed, for `varied`; the last one is kept."""
        if self.near is None or not np.array_equal(self.near.plan, plan):
            self.calls += len(plan)
            self.near = Around(self.sand, plan)
        return self.near

    def left(self, near: Around, plans: np.ndarray) -> np.ndarray:
        """The maps [P, H, W] that plans [P, N, 4] like one leave; NaN for plans beyond the budget, which are not pushed."""
        some, before = plans[near.most(plans).cumsum() <= self.budget - self.calls], near.calls
        maps = np.full((len(plans), *self.sand.start.shape), np.nan, np.float32)
        maps[: len(some)] = near.left(some)
        self.calls += near.calls - before
        return maps

    def varied(self, near: Around, plans: np.ndarray) -> np.ndarray:
        """Like `losses`, of plans that are like one that has been pushed, for fewer calls."""
        losses = self.sand.costs(self.left(near, plans))
        self._note(plans, losses)
        return losses

    def gradient(self, plans: np.ndarray, blur: float) -> tuple[np.ndarray, np.ndarray]:
        """The losses [P] of plans [P, N, 4] or [P, N, 6], and the gradients of those of maps blurred by `blur` cells."""
        self.calls += len(plans) * plans.shape[1] * (1 + GRADIENT)
        sharp, power = list[np.ndarray](), self.sand.goal.power

        def weigh(off: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            sharp.append((np.abs(off) ** power).sum((1, 2)))
            soft = gaussian_filter(off, (0, blur, blur)) if blur else off
            slope = 2 * soft if power == 2 else np.sign(soft)
            return sharp[0], gaussian_filter(slope, (0, blur, blur)) if blur else slope

        losses, gradients = self.sand.gradient(plans, weigh)
        self._note(plans, losses)
        return losses, gradients

    def afford(self, plans: np.ndarray) -> bool:
        """Whether the budget has room for a gradient of all the plans."""
        return self.room(plans.shape[1]) >= len(plans) * (1 + GRADIENT)

    def after(self, height: np.ndarray, strokes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The losses [P] and the maps [P, H, W] after each of the strokes [P, 4] (m) on one map [H, W]."""
        self.calls += len(strokes)
        return self.sand.after(np.repeat(height[None], len(strokes), axis=0), strokes)

    def _note(self, plans: np.ndarray, losses: np.ndarray) -> None:
        """Keeps the best of some plans if it beats all before."""
        first = int(np.argmin(losses))
        if np.isfinite(losses[first]) and (not self.history or losses[first] < self.best.loss):
            self.history.append(Best(self.calls, float(losses[first]), plans[first].copy()))
            left = (losses[first] / self.before) ** (1 / self.sand.goal.power) if self.before else 0.0
            self.tell(
                f"{self.calls:,} of {self.budget:,} calls: {len(plans[first])} strokes, {left:.1%} of the distance left"
            )
