"""Finds strokes that turn a start map into a goal map, by gradients through the simulator.

First guesses cost one call (sketch.py): the marks of strokes, copied from one simulated stroke, are matched to the goal.
Then several plans at once are improved in rounds (moves.py): other orders and directions, Adam on blurred and then on sharp
maps, strokes placed where the goal is not yet reached, and L-BFGS, until the goal is reached or the budget is spent.
"""

import math
from dataclasses import dataclass, replace

import jax
import jax.numpy as jnp
import numpy as np

from jaxsand.goals.goal import Goal
from jaxsand.interaction.simulate import STROKES
from jaxsand.planning.gradient import moves
from jaxsand.planning.gradient.account import Account
from jaxsand.planning.gradient.sketch import Print, guesses
from jaxsand.planning.no_strokes import why_no_strokes
from jaxsand.planning.stroke_loss import GRADIENT, Best, pushed, sand_loss
from jaxsand.relaxation.stopping import check_whole
from jaxsand.scene.masked import POINTS
from jaxsand.scene.progress import Tell, quiet
from jaxsand.scene.scene import Scene, as_array, blade_of
from jaxsand.scene.validation import short

_LANES = 4  # plans that go downhill together
_STEPS = 6  # of Adam on blurred maps
_REACHED = 1e-4  # of the start's loss: near enough to stop
_NEARLY = 1.15  # times the least that prints leave of the squared change


@dataclass(frozen=True)
class Optimised:
    """What `optimise_strokes` found.

    Attributes:
      strokes: the best plan [N, 4] = x0, y0, x1, y1 (m), in order, or [N, 6] = x0, y0, z0, x1, y1, z1 (m) from a guess with
        heights; N is 0 if nothing was found or nothing is to change.
      losses: the cost, sum (h - goal)^2 (m^2) for a goal that is a map, of the start, then of every better plan found on the
        way [K]; the last is that of `strokes`.
      calls: after how many calls of the simulator each of `losses` was found [K].
      spent: calls in all: pushes simulated, a gradient counted as what it costs.
      height: the map [H, W] (m) that `strokes` leave.
      reason: why there are no strokes, and what to do; None where there are some.

    Example:
      >>> import jax.numpy as jnp
      >>> import jaxsand as js
      >>> scene = js.make_scene((16, 16), 0.01, tool=js.Blade())
      >>> found = js.optimise_strokes(scene, goal=jnp.zeros((16, 16)), strokes=1)
      >>> found.strokes.shape, found.spent
      ((0, 4), 0)
    """

    strokes: np.ndarray
    losses: np.ndarray
    calls: np.ndarray
    spent: int
    height: np.ndarray
    reason: str | None = None


@dataclass(frozen=True)
class Blurred:
    """Blurs maps and goal before gradients are taken, so that a stroke beside its trench feels it from farther away.

    `optimise_strokes` takes a few steps of Adam for each width in turn, and then goes on with sharp maps.

    Args:
      cells: standard deviations of the Gaussians, in cells, in the order in which they are used.

    Raises:
      ValueError: for a number that is not above 0.

    Example:
      >>> import jaxsand as js
      >>> js.Blurred((2.0, 1.0)).cells
      (2.0, 1.0)
    """

    cells: tuple[float, ...] = (1.0,)

    def __post_init__(self) -> None:
        if not all(0 < c < math.inf for c in self.cells):
            raise ValueError(f"smoothing.cells: got {short(self.cells)}; give positive numbers, or smoothing=None")


def optimise_strokes(
    scene: Scene,
    goal: Goal | jax.typing.ArrayLike,
    *,
    strokes: int | None = None,
    key: jax.Array | int = 0,
    start: jax.typing.ArrayLike | None = None,
    budget: int = 4_000,
    most: int = 8,
    smoothing: Blurred | None = Blurred(),
    guess: jax.typing.ArrayLike | None = None,
    tell: Tell = quiet,
) -> Optimised:
    """Finds straight pushes that turn one map into another, by gradients through the simulator.

    Minimises the goal's cost over plans of strokes: sum (h - goal)^2, h [H, W] the map that a plan leaves, or what a `Goal`
    with weights says. Stops when the loss is a ten-thousandth of the start's, or when the budget is spent.

    Args:
      scene: grid, sand and a `Blade`.
      goal: heights [H, W] (m), `goal[i, j]` at x = (j + 1/2) dx, y = (i + 1/2) dx, or a `Goal`, which says what matters.
        Cells that are NaN or masked are free: the sand there may have any height, and the loss leaves them out.
      strokes: how many pushes; None lets the optimiser choose as many as pay, up to `most`.
      key: a JAX key or a whole number; the same key finds the same plan on the same machine.
      start: the map [H, W] (m) before the first push, at rest; None stands for level sand at 0.
      budget: how many calls of the simulator may be made; a push of one stroke is one call, its gradient four more.
      most: the largest number of pushes if `strokes` is None.
      smoothing: blurs the maps for the first steps; None does not.
      guess: a plan [N, 4] or, with heights, [N, 6] (m) to start from, such as a policy's or `plan_sand(...).strokes`, with
        N = `strokes` if that is given; None starts from a sketch. A guess with heights keeps its order, and is moved by
        gradients alone.
      tell: is called with a line of progress.

    Returns:
      An `Optimised`; where nothing is to change or no plan brings the sand closer to the goal it has no strokes, and
      `reason` says why. Not differentiable itself.

    Raises:
      ValueError: for a scene without a blade, a start or goal of another shape, or a key or count out of range.

    The first call for a shape of map compiles, which takes about half a minute on two cores.

    Example:
      >>> import jax.numpy as jnp
      >>> import jaxsand as js
      >>> scene = js.make_scene((16, 16), 0.01, tool=js.Blade())
      >>> js.optimise_strokes(scene, goal=jnp.zeros((16, 16)), strokes=1).losses.tolist()
      [0.0]
      >>> goal = jnp.zeros((16, 16)).at[8, 4:12].set(-0.004)
      >>> found = js.optimise_strokes(scene, goal, strokes=1, budget=200)  # doctest: +SKIP
      >>> found.losses[-1] < found.losses[0]  # doctest: +SKIP
      True

    The last lines are not run by the tests: compiling takes half a minute.
    """
    blade_of(scene)
    check_whole("budget", budget, 1)
    check_whole("most", most, 1, 64)
    if strokes is not None:
        check_whole("strokes", strokes, 1, 64)
    level = np.zeros(scene.grid.shape, np.float32)
    sand = sand_loss(
        scene,
        level if start is None else np.asarray(as_array("start", start), np.float32),
        goal,
    )
    rng = np.random.default_rng(_entropy(key))
    account = Account(sand, budget, tell)
    plan = None if guess is None else _plan(guess, strokes)
    if account.before > 0 and plan is None:
        search(account, strokes, rng, most, smoothing)
    elif account.before > 0 and plan is not None and len(plan):
        if plan.shape[1] == 6:
            downhill(account, moves.Plans(plan[None], account.losses(plan[None])))
        else:
            improve(account, print_of(account), moves.Plans(plan[None], account.losses(plan[None])), rng, smoothing)
    numbers = 4 if plan is None else plan.shape[1]
    steps = [
        Best(0, account.before, np.zeros((0, numbers))),
        *(best for best in account.history if best.loss < account.before),
    ]
    found = steps[-1].strokes
    height = sand.maps(found[None])[0]
    if len(found):  # as it is pushed from the start, not beside another plan
        last = replace(steps[-1], loss=sand.loss_of(height))
        steps = [*(step for step in steps[:-1] if step.loss > last.loss), last]
    losses, calls = np.array([s.loss for s in steps]), np.array([s.calls for s in steps])
    reason = None if len(found) else why_no_strokes(scene, sand.start, sand.goal)
    return Optimised(found, losses, calls, account.calls, height, reason)


def search(
    account: Account,
    strokes: int | None,
    rng: np.random.Generator,
    most: int = 8,
    smoothing: Blurred | None = Blurred(),
) -> None:
    """Spends the account's budget on plans of `strokes` strokes, or of as many as pay."""
    mark = print_of(account)
    count = strokes or as_many_as_pay(account, mark, most, rng)
    plans = first(account, mark, count, rng)
    if plans is not None and np.ptp(account.sand.start) > 0:  # prints say little of rough sand
        felt = moves.stroke_by_stroke(account, count, account.room(count) * count // 2, rng)
        both = felt.joined(plans)
        plans = moves.ranked(both.strokes, both.losses, 1)
    if plans is not None:
        improve(account, mark, plans, rng, smoothing)


def as_many_as_pay(account: Account, mark: Print, most: int, rng: np.random.Generator) -> int:
    """The fewest strokes with which the sketch comes nearly as close as with any number up to `most`; calls no simulator."""
    sand, far = account.sand, list[float]()
    for n in range(1, most + 1):
        far.append(guesses(mark, sand.start, sand.target, n, rng)[1][0])
        if n > 2 and min(far[-2:]) > min(far):  # the prints of more only get in each other's way
            break
    return 1 + next(n for n, left in enumerate(far) if left <= _NEARLY * min(far))


def print_of(account: Account) -> Print:
    """Simulates one stroke, half as long as the map's shorter side, on level sand, for the sketch."""
    scene = account.sand.scene
    rows, columns = scene.grid.shape
    dx = float(scene.grid.spacing)
    length = max(min(rows, columns) / 2, 1.0)
    x, y = round((columns - length) / 2), round(rows / 2) + 0.5
    stroke = np.array([[x, y, x + length, y]]) * dx
    account.calls += 1
    height = pushed(scene, np.zeros((1, rows, columns)), stroke)[0]
    return Print(jnp.asarray(np.nan_to_num(height)), jnp.array([x - 0.5, y - 0.5], jnp.float32), jnp.float32(length))


def first(account: Account, mark: Print, strokes: int, rng: np.random.Generator) -> moves.Plans | None:
    """Plans from the sketch, closest first; None if the budget is spent."""
    dx = float(account.sand.scene.grid.spacing)
    plans = guesses(mark, account.sand.start, account.sand.target, strokes, rng)[0] * dx
    plans = account.sand.inside(plans)
    plans = plans[: max(1, min(len(plans), account.room(strokes) // 4))]
    losses = account.losses(plans)
    return moves.ranked(plans, losses, _LANES) if np.isfinite(losses).any() else None


def improve(account: Account, mark: Print, plans: moves.Plans, rng: np.random.Generator, smoothing: Blurred | None) -> None:
    """Improves plans in rounds until the goal is reached or the budget is spent; does nothing if no plan has been pushed
    yet.
    """
    if not account.history:
        return
    dx = float(account.sand.scene.grid.spacing)
    plans = moves.reordered(account, plans)
    for blur in smoothing.cells if smoothing else ():
        plans = moves.adam(account, plans, _STEPS, 0.15 * dx, blur)
    while account.best.loss > _REACHED * account.before and account.room(plans.strokes.shape[1]) > 0:
        last, spent = plans.losses[0], account.calls
        plans = moves.reordered(account, plans)
        plans = moves.adam(account, plans, 8, 0.1 * dx)
        plans = moves.replaced(account, mark, plans, rng)
        plans = moves.quasi_newton(account, plans.part(slice(1)), 4).joined(plans.part(slice(1, None)))
        if plans.losses[0] > 0.98 * last:  # stuck: from beside the best plan
            near = plans.strokes[:1] + rng.normal(0, 0.7 * dx, (_LANES - 1, *plans.strokes.shape[1:]))
            near = account.sand.inside(near)
            plans = plans.part(slice(1)).joined(moves.Plans(near, account.losses(near)))
        if account.calls == spent:
            break


def downhill(account: Account, plans: moves.Plans) -> None:
    """Moves plans by gradients alone, in turns of Adam, for two thirds of what is left of the budget, and of L-BFGS.

    Each turn begins with steps half as long as the last one's, and they end where a turn no longer helps.
    """
    size, last = 0.15 * float(account.sand.scene.grid.spacing), math.inf
    while account.history and account.afford(plans.strokes) and plans.losses[0] < last:
        last, steps = float(plans.losses[0]), account.room(plans.strokes.shape[1]) // (1 + GRADIENT)
        plans = moves.adam(account, plans, max(1, 2 * steps // 3), size)
        plans = moves.quasi_newton(account, plans, steps)
        size /= 2


def _plan(guess: jax.typing.ArrayLike, strokes: int | None) -> np.ndarray:
    """A user's guess as an array [N, 4] or [N, 6]."""
    plan = np.asarray(as_array("guess", guess, masked=POINTS), float)
    if plan.ndim != 2 or plan.shape[1] not in STROKES or strokes not in (None, len(plan)) or not np.isfinite(plan).all():
        shapes = f"[{strokes or 'N'}, 4], finite x0, y0, x1, y1 in metres, or [{strokes or 'N'}, 6] with heights"
        raise ValueError(f"guess: got shape {list(plan.shape)}; give {shapes}")
    return plan


def _entropy(key: jax.Array | int) -> np.ndarray:
    """The whole numbers that seed a key stands for."""
    if hasattr(key, "dtype") and jnp.issubdtype(key.dtype, jax.dtypes.prng_key):
        key = jax.random.key_data(key)
    numbers = np.atleast_1d(np.asarray(key)).ravel()
    if numbers.dtype.kind not in "iu" or not len(numbers) or numbers.min() < 0:
        raise ValueError(f"key: got {short(key)}; give jax.random.key(0), or a whole number from 0 on")
    return numbers
