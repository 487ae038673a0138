"""The simulator: a tool acts, the sand settles."""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import jax
import numpy as np

from jaxsand.interaction._path import Pushed
from jaxsand.interaction.blade_closed_form import SwathPush, push_swath
from jaxsand.interaction.blade_stepped import SteppedPush, push_along, windows_for, with_near
from jaxsand.interaction.wheel_closed_form import SplitPush, push_split
from jaxsand.interaction.wheel_stepped import roll_along
from jaxsand.relaxation.schemes import Multilevel, Scheme
from jaxsand.relaxation.settling import Settled, relax
from jaxsand.relaxation.stopping import Outcome, Stop, check_rate, check_rule, check_whole
from jaxsand.scene.scene import Scene, as_array, cast, concrete, fit
from jaxsand.scene.tools import Blade, NoTool, Pose, Wheel
from jaxsand.scene.window import Whole, Window

Push = SteppedPush | SwathPush | SplitPush
Rules = tuple[Push, Scheme, Stop]
_PUSHES: dict[tuple[type, type], Any] = {
    (Blade, SteppedPush): push_along,
    (Blade, SwathPush): push_swath,
    (Wheel, SteppedPush): roll_along,
    (Wheel, SplitPush): push_split,
    (NoTool, SteppedPush): push_along,
    (NoTool, SwathPush): push_along,
    (NoTool, SplitPush): push_split,
}


_SURE = 1.5  # times the width of a window that a stroke asks for, where there is no second try


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Shaped(Settled):
    """A settled map (see `Settled`) and the `pose` in which the tool was lifted."""

    pose: Pose


def act(scene: Scene, height: jax.typing.ArrayLike, stroke: jax.typing.ArrayLike, *, push: Push | None = None) -> Pushed:
    """What the tool does to a map [H, W] (m) along `stroke` [4] = x0, y0, x1, y1 (m), up to when it has been lifted.

    The map is not settled afterwards; see `step`.
    """
    scene, height, rules = ready(scene, height, push, None, None)
    path = _stroke(stroke, height.dtype)
    return _as_needed(lambda scene, _: _act(scene, height, path, rules), scene, rules, (height, path))


def step(
    scene: Scene,
    height: jax.typing.ArrayLike,
    stroke: jax.typing.ArrayLike,
    *,
    push: Push | None = None,
    scheme: Scheme | None = None,
    stop: Stop | None = None,
) -> Shaped:
    """One straight push on a map [H, W] (m), then settling. One map; batch with `jax.vmap` or `step_batch`.

    `stroke` [4] is x0, y0, x1, y1 (m). The tool is lowered at the start, moved to the end and lifted. Parts of a stroke that
    lie off the map touch nothing; a stroke of no length lowers and lifts the tool, facing +x. A stroke that is not finite
    leaves the map as it is and says so in the outcome.

    At a wall or a closed edge the sand ahead has nowhere to go: it stays in its columns, inside the blade, and flows off
    when the blade is lifted. Everywhere else no sand is inside the tool.

    Differentiable once, in forward and reverse mode, in the height, the stroke, the angle of repose and the tool; exactly
    zero where nothing changes (a stroke off the map, a tool above the sand). Continuous in the stroke, except where its
    length goes to zero and its heading is lost.
    """
    height = as_array("height", height)
    return follow(scene, height, _stroke(stroke, height.dtype), push=push, scheme=scheme, stop=stop)


def follow(
    scene: Scene,
    height: jax.typing.ArrayLike,
    path: jax.typing.ArrayLike,
    *,
    push: Push | None = None,
    scheme: Scheme | None = None,
    stop: Stop | None = None,
) -> Shaped:
    """A path of legs without lifting the tool on a map [H, W] (m), then settling.

    `path` [n, 2] holds x, y (m). The tool is lowered once, at the first point, and takes the sand in front of it along. At a
    corner it turns in place about its centre, by the smaller angle, and a blade pushes what it sweeps ahead of its faces; a
    reversal is half a turn, to the left. A leg of no length keeps the heading. What a turn leaves does not depend on how it
    is divided into parts.

    On a map wider than a blade's heap only a window around the blade is computed; see `AsNeeded`.
    """
    scene, height, rules = ready(scene, height, push, scheme, stop)
    path = _path(path, height.dtype)
    return _as_needed(partial(_followed, height, path, rules), scene, rules, (height, path))


def follow_frames(
    scene: Scene,
    height: jax.typing.ArrayLike,
    path: jax.typing.ArrayLike,
    *,
    push: Push | None = None,
    scheme: Scheme | None = None,
    stop: Stop | None = None,
) -> tuple[Shaped, jax.Array]:
    """`follow`, and the map after each leg, before the tool is lifted: [n - 1, H, W] (m)."""
    scene, height, rules = ready(scene, height, push, scheme, stop)
    path = _path(path, height.dtype)
    return _as_needed(lambda scene, _: _follow(scene, height, path, rules, record=_itself), scene, rules, (height, path))


def rollout(
    scene: Scene,
    height: jax.typing.ArrayLike,
    strokes: jax.typing.ArrayLike,
    *,
    push: Push | None = None,
    scheme: Scheme | None = None,
    stop: Stop | None = None,
) -> Shaped:
    """Pushes one after the other: `strokes` [n, 4] (m). Every field of the result gains a leading axis of length n."""
    scene, height, rules = ready(scene, height, push, scheme, stop)
    strokes = as_array("strokes", strokes, height.dtype)
    if strokes.ndim != 2 or strokes.shape[1] != 4:
        raise ValueError(f"strokes: got shape {list(strokes.shape)}; give [n, 4], a row x0, y0, x1, y1 for each push")
    return _as_needed(lambda scene, _: _rollout(scene, height, strokes, rules), scene, rules, (height, strokes))


def _as_needed(run: Callable[[Scene, Whole | Window], Any], scene: Scene, rules: Rules, arrays: tuple[Any, Any]) -> Any:
    """What a run gives in a window around the blade, and settled in one around where it went, as wide as the sand asks for;
    traced, in a window that is likely enough."""
    if any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves((scene, rules, arrays))):
        return run(next(windows_for(scene, rules[0], _SURE), scene), Whole())
    for part in windows_for(scene, rules[0]):
        out = run(part, _around(part, arrays[1], rules[1]))
        outcome = (out[0] if isinstance(out, tuple) else out).outcome
        if not np.any(np.asarray(outcome) & Outcome.WINDOW_EDGE):
            return out
    return run(scene, Whole())


def _around(scene: Scene, path: jax.Array, scheme: Scheme) -> Whole | Window:
    """A window that holds a path, and what its blade's window holds at its ends, if the map is much wider."""
    far = float(np.max(np.ptp(np.asarray(path), axis=0))) / float(scene.grid.spacing)
    if isinstance(scheme, Multilevel) or not isinstance(scene.window, Window) or not far < max(scene.grid.shape):
        return Whole()
    size = 1 << math.ceil(math.log2(far + 2 * max(scene.window.size)))
    rows, columns = scene.grid.shape
    return Window((min(size, rows), min(size, columns))) if 4 * size <= max(rows, columns) else Whole()


class OutcomeError(RuntimeError):
    """A result that is not clean; its message says what to do."""


_ADVICE = {
    Outcome.WINDOW_EDGE: (
        "sand moved at the window's edge, or the map was not still before the tool came down: enlarge Window(size) or use "
        "Whole(), and settle to the window's tolerance first"
    ),
    Outcome.NOT_STILL: (
        "the sand is not still ({residual:.2g} in slope above repose after {sweeps} sweeps): raise the stop rule's bound or "
        "tolerance, or, where heights are large against the spacing, subtract their mean or use float64"
    ),
    Outcome.NOT_FINITE: (
        "the map, the stroke or the scene holds a NaN or an infinity, or heights overflowed: look with numpy.isfinite"
    ),
}


def check(result: Settled | Pushed) -> None:
    """Raises `OutcomeError`, with advice, if the outcome of a result (or of any in a batch) is not clean. Host side."""
    outcome = concrete(result.outcome)
    if outcome is None:
        raise ValueError("result: got a traced value; call check outside jit, vmap and grad")
    bad = np.flatnonzero(outcome.ravel())
    if not bad.size:
        return
    first = bad[0]
    code = Outcome(int(outcome.ravel()[first]))
    detail = {}
    if isinstance(result, Settled):
        detail["residual"] = float(np.ravel(result.residual)[first])
        detail["sweeps"] = int(np.broadcast_to(result.sweeps, outcome.shape).ravel()[first])
    where = f"{bad.size} of {outcome.size} maps, first {int(first)}: " if outcome.ndim else ""
    raise OutcomeError(where + "; ".join(advice.format(**detail) for bit, advice in _ADVICE.items() if bit in code))


def way_of(scene: Scene, push: Push) -> Any:
    """How the push moves the scene's tool."""
    return _PUSHES[type(scene.tool), type(push)]


def check_push(push: Any) -> None:
    """Raises ValueError unless it is a way of pushing."""
    if not isinstance(push, Push):
        raise ValueError(f"push: got {push!r}; give SteppedPush(substep, sweeps), SwathPush() or SplitPush()")


def ready(scene: Scene, height: Any, push: Any, scheme: Any, stop: Any) -> tuple[Scene, jax.Array, Rules]:
    push = SteppedPush() if push is None else push
    check_push(push)
    if (type(scene.tool), type(push)) not in _PUSHES:
        other = "SwathPush() is for a Blade" if isinstance(push, SwathPush) else "SplitPush() is for a Wheel"
        raise ValueError(
            f"push: got {type(push).__name__} for a {type(scene.tool).__name__}; {other}, SteppedPush() for both"
        )
    if isinstance(push, SteppedPush) and not 0 < push.substep <= 1:
        raise ValueError(f"push.substep: got {push.substep!r}; give a part of a spacing, above 0 and at most 1")
    if not isinstance(push, SplitPush):
        check_whole("push.sweeps", push.sweeps, 0)
        check_rate(scene, "push.rate", push.rate)
    scheme, stop = check_rule(scene, scheme, stop)
    scene = with_near(scene)
    fitted, height = fit(scene, height)
    if isinstance(
        fitted.grid.spacing, jax.core.Tracer
    ):  # under jit: what is cast to the height's dtype is no number any more
        fitted, _ = fit(next(windows_for(scene, push, _SURE), scene), height)
    return fitted, height, cast((push, scheme, stop), height.dtype)


def _stroke(stroke: Any, dtype: Any) -> jax.Array:
    stroke = as_array("stroke", stroke, dtype)
    if stroke.shape != (4,):
        remedy = "use jax.vmap" if stroke.ndim > 1 and stroke.shape[-1] == 4 else "give x0, y0, x1, y1 in metres"
        raise ValueError(f"stroke: got shape {list(stroke.shape)}; {remedy}")
    return stroke.reshape(2, 2)


def _path(path: Any, dtype: Any) -> jax.Array:
    path = as_array("path", path, dtype)
    if path.ndim != 2 or path.shape[0] < 2 or path.shape[1] != 2:
        remedy = "use jax.vmap" if path.ndim > 2 else "give at least two points [n, 2] of x, y in metres"
        raise ValueError(f"path: got shape {list(path.shape)}; {remedy}")
    return path


def _itself(height: jax.Array) -> jax.Array:
    return height


def _followed(height: jax.Array, path: jax.Array, rules: Rules, scene: Scene, window: Whole | Window) -> Shaped:
    return _follow(scene, height, path, rules, window=window)[0]


@partial(jax.jit, static_argnames="record")
def _follow(
    scene: Scene,
    height: jax.Array,
    path: jax.Array,
    rules: Rules,
    record: Any = None,
    window: Whole | Window | None = None,
) -> tuple[Shaped, Any]:
    push, scheme, stop = rules
    pushed, frames = way_of(scene, push)(scene, height, path, push, record)
    return lifted(pushed, relax(scene, pushed.height, scheme, stop, Whole() if window is None else window)), frames


def lifted(pushed: Pushed, settled: Settled) -> Shaped:
    outcome, drained = settled.outcome | pushed.outcome, settled.drained + pushed.drained
    return Shaped(**vars(replace(settled, outcome=outcome, drained=drained)), pose=pushed.pose)


@jax.jit
def _act(scene: Scene, height: jax.Array, path: jax.Array, rules: Rules) -> Pushed:
    return way_of(scene, rules[0])(scene, height, path, rules[0])[0]


@jax.jit
def _rollout(scene: Scene, height: jax.Array, strokes: jax.Array, rules: Rules) -> Shaped:
    def one(height: jax.Array, stroke: jax.Array) -> tuple[jax.Array, Shaped]:
        shaped, _ = _follow(scene, height, stroke.reshape(2, 2), rules)
        return shaped.height, shaped

    return jax.lax.scan(one, height, strokes)[1]
