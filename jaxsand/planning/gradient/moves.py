"""Moves that improve plans: downhill by gradients, other orders and directions, strokes placed where the goal is not
reached.

A move takes plans with their losses, closest first, and returns plans that are no worse.
"""

from dataclasses import dataclass

import jax
import numpy as np
import optax

from jaxsand.planning.gradient.account import Account
from jaxsand.planning.gradient.sketch import Print, guesses, swaps

_HEIGHTS = 0.3  # as long as steps along the ground are steps in a stroke's heights
_STEPS = (1.0, 0.3, 0.1, 0.03)  # lengths that a quasi-Newton step is tried at
_MEMORY = 8  # gradients that the quasi-Newton steps remember
_DRAWN = 32  # strokes that are tried at a time
_TRIED = 3  # strokes that are tried in the place of one


@dataclass(frozen=True)
class Plans:
    """Plans of equally many strokes, `strokes` [P, N, 4] or [P, N, 6] (m), and their `losses` [P] (m^2)."""

    strokes: np.ndarray
    losses: np.ndarray

    def part(self, which: slice) -> "Plans":
        """Some of the plans."""
        return Plans(self.strokes[which], self.losses[which])

    def joined(self, other: "Plans") -> "Plans":
        """These plans, then the others."""
        return Plans(np.concatenate([self.strokes, other.strokes]), np.concatenate([self.losses, other.losses]))


def ranked(plans: np.ndarray, losses: np.ndarray, most: int) -> Plans:
    """The best `most` plans, no two of them alike within 0.1 mm."""
    kept: list[int] = []
    for i in np.argsort(losses, kind="stable"):
        if all(np.abs(plans[i] - plans[k]).max() > 1e-4 for k in kept):
            kept.append(int(i))
        if len(kept) == most:
            break
    return Plans(plans[kept], losses[kept])


def adam(account: Account, start: Plans, steps: int, size: float, blur: float = 0.0, *, momentum: float = 0.9) -> Plans:
    """Follows the gradient by Adam; its first step is `size` (m) long, its last a tenth of that, in heights less.

    Where it leads at last is pushed too, if the budget allows.
    """
    plans, losses = start.strokes.copy(), start.losses.copy()
    rule = optax.adam(optax.cosine_decay_schedule(size, max(steps, 1), 0.1), b1=momentum, b2=0.95)
    here = plans.copy()
    state, units = rule.init(here), _units(here)
    for _ in range(steps):
        if not account.afford(here):
            break
        now, slope = account.gradient(here, blur)
        better = now < losses
        plans[better], losses[better] = here[better], now[better]
        update, state = rule.update(np.nan_to_num(slope) * units / account.before, state)
        here = account.sand.inside(here + np.asarray(update) * units)
    if (here != start.strokes).any():
        now = account.losses(here)
        better = now < losses
        plans[better], losses[better] = here[better], now[better]
    return ranked(plans, losses, len(plans))


def quasi_newton(account: Account, start: Plans, steps: int) -> Plans:
    """Follows the gradient by L-BFGS, every plan for itself; of four step lengths the best is taken."""
    plans, losses = start.strokes.copy(), start.losses.copy()
    rule = optax.scale_by_lbfgs(_MEMORY)
    scale = 1e-3 * _units(plans)  # metres to about the size that gradients change over
    state = jax.vmap(rule.init)(plans / scale)
    for _ in range(steps):
        if not account.afford(plans):
            break
        _, slope = account.gradient(plans, 0.0)
        slope = np.nan_to_num(slope) * scale / account.before
        way, state = jax.vmap(rule.update)(slope, state, plans / scale)
        way = -np.asarray(way) * scale
        longest = np.abs(way).max((1, 2), keepdims=True)
        way *= np.minimum(1, 5e-3 / np.maximum(longest, 1e-12))
        tried = account.sand.inside(plans[:, None] + way[:, None] * np.array(_STEPS)[None, :, None, None])
        far = account.losses(tried.reshape(-1, *plans.shape[1:])).reshape(len(plans), -1)
        which = np.argmin(far, axis=1)
        lane = np.arange(len(plans))
        better = far[lane, which] < losses
        plans[better], losses[better] = tried[lane, which][better], far[lane, which][better]
        if not better.any():
            break
    return ranked(plans, losses, len(plans))


def reordered(account: Account, start: Plans) -> Plans:
    """Swaps two strokes of the best plan, or reverses one, as long as that helps."""
    plans, losses = start.strokes, start.losses
    while True:
        plan, n = plans[0], plans.shape[1]
        if account.room(n) < 1:
            return Plans(plans, losses)
        others = list(plan[swaps(n)])
        for k in range(n):
            turned = plan.copy()
            turned[k] = plan[k, [2, 3, 0, 1]]
            others.append(turned)
        far = account.varied(account.around(plan), np.stack(others))
        better = float(far.min()) < losses[0] * 0.999
        best = ranked(np.concatenate([plans, others]), np.concatenate([losses, far]), len(plans))
        plans, losses = best.strokes, best.losses
        if not better:
            return best


def replaced(account: Account, mark: Print, start: Plans, rng: np.random.Generator) -> Plans:
    """Moves one stroke of the best plan to where the others leave most to do, as the first, the last, or in its place."""
    plans, losses = start.strokes, start.losses
    plan, n = plans[0], plans.shape[1]
    if account.room(n) < 2:
        return start
    dx = float(account.sand.scene.grid.spacing)
    near, others = account.around(plan), list[np.ndarray]()
    for k, left in enumerate(account.left(near, np.stack([np.delete(plan, k, axis=0) for k in range(n)]))):
        if np.isnan(left).any():
            continue
        rest = np.delete(plan, k, axis=0)
        new = account.sand.inside(guesses(mark, left, account.sand.target, 1, rng)[0][:_TRIED, 0] * dx)
        others += [np.insert(rest, place, stroke, axis=0) for stroke in new for place in {0, k, n - 1}]
    if not others:
        return start
    far = account.varied(near, np.stack(others))
    return ranked(np.concatenate([plans, others]), np.concatenate([losses, far]), len(plans))


def stroke_by_stroke(account: Account, strokes: int, calls: int, rng: np.random.Generator) -> Plans:
    """Builds a plan on the sand itself, stroke by stroke, in about `calls` calls.

    Each stroke is the best of those tried on the map that the strokes before it left. They run from where sand is too high
    to where it is too low, or anywhere; later ones lie near the best.
    """
    sand, low, high = account.sand, *account.sand.bounds
    dx = float(sand.scene.grid.spacing)
    here, plan = sand.start, np.zeros((0, 4))
    for _ in range(strokes):
        best, least = np.concatenate([low[:2], low[:2]]), np.inf
        rounds = max(1, calls // strokes // _DRAWN)
        for k in range(rounds):
            if k < max(1, rounds // 3):
                drawn = _from_high_to_low(sand.goal.off(here), rng) * dx
                anywhere = rng.random((_DRAWN, 4)) * (high - low) + low
                drawn = np.where(rng.random((_DRAWN, 1)) < 0.5, drawn, anywhere)
            else:
                drawn = best + rng.normal(0, 1, (_DRAWN, 4)) * np.geomspace(0.3, 6, _DRAWN)[:, None] * dx
            drawn = sand.inside(drawn)[: account.room(1)]
            if not len(drawn):
                break
            far, maps = account.after(here, drawn)
            first = int(np.argmin(far))
            if far[first] < least:
                best, least, there = drawn[first], float(far[first]), maps[first]
        if not np.isfinite(least):
            break
        here, plan = there, np.concatenate([plan, best[None]])
    return Plans(plan[None], account.losses(plan[None]))


def _from_high_to_low(off: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Random strokes [n, 4] (cells) from where `off` [H, W] is above 0 to where it is below, in proportion to its size."""
    ends = []
    for much in (np.maximum(off, 0), np.maximum(-off, 0)):
        share = (much + 1e-12).ravel()
        rows, columns = np.unravel_index(rng.choice(share.size, _DRAWN, p=share / share.sum()), off.shape)
        ends += [columns, rows]
    return np.stack(ends, 1) + 0.5


def _units(plans: np.ndarray) -> np.ndarray:
    """How long a step in each of a stroke's numbers is, next to one along the ground."""
    return np.array([1, 1, _HEIGHTS] * 2) if plans.shape[-1] == 6 else np.ones(plans.shape[-1])
