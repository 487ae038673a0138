"""The simulator: a tool moves through the sand, then the sand settles."""

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from typing import TypeVar

import jax
import numpy as np
from jax.typing import ArrayLike, DTypeLike
from jaxtyping import Array, Float

from jaxsand.autodiff.while_loop import Tree
from jaxsand.interaction import blade_stepped
from jaxsand.interaction._path import Pushed, Record
from jaxsand.interaction.blade_stepped import with_near
from jaxsand.interaction.rule import PushRule
from jaxsand.interaction.stepped import SteppedPush
from jaxsand.relaxation.schemes import Multilevel, Pairwise, Scheme
from jaxsand.relaxation.settling import Settled, relax
from jaxsand.relaxation.stopping import Outcome, Stop, check_rule
from jaxsand.scene.footprint import Pose
from jaxsand.scene.masked import POINTS
from jaxsand.scene.scene import Scene, as_array, cast, check_scene, fit
from jaxsand.scene.validation import short
from jaxsand.scene.window import Whole, Window

Rules = tuple[PushRule, Scheme, Stop]
Result = TypeVar("Result", bound="Pushed | Shaped | tuple[Shaped, jax.Array]")
STROKES = (4, 6)  # numbers of a stroke: x, y of its start and end, or x, y, z
Stroke = Float[ArrayLike, "4"] | Float[ArrayLike, "6"]
Strokes = Float[ArrayLike, "n 4"] | Float[ArrayLike, "n 6"]
Path = Float[ArrayLike, "n 2"] | Float[ArrayLike, "n 3"]
_SURE = 1.5  # times the width of a window that a stroke asks for, where there is no second try


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Shaped(Settled):
    """A map after a push and settling: the fields of `Settled`, and the tool's last pose.

    Of a batch or a rollout, every field has an axis more in front.

    Attributes:
        height: height map [H, W] (m).
        sweeps: number of sweeps of settling.
        residual: largest slope in excess of repose that is left, a tangent. It carries no derivative.
        outcome: bits of `Outcome`, of the push and of settling; 0 when all went well. See `check`.
        drained: volume that ran off over a draining edge, during the push and settling (m^3).
        pose: where the tool was lifted, and its heading.

    Example:
        >>> import jax.numpy as jnp
        >>> import jaxsand as js
        >>> scene = js.make_scene((8, 8), 0.01, tool=js.Blade())
        >>> shaped = js.step(scene, jnp.zeros((8, 8)), jnp.array([0.02, 0.04, 0.06, 0.04]))
        >>> int(shaped.outcome), shaped.height.shape
        (0, (8, 8))
    """

    pose: Pose


def act(scene: Scene, height: Float[ArrayLike, "H W"], stroke: Stroke, *, push: PushRule | None = None) -> Pushed:
    """One straight push without settling: the map just after the tool was lifted.

    Sand that was not at rest when the tool was lifted stays as it is; `step` lets it settle too. Differentiable like `step`.

    Args:
        scene: the scene, with the tool.
        height: height map [H, W] (m), with height[i, j] at x = (j + 1/2) dx, y = (i + 1/2) dx.
        stroke: as of `step`.
        push: `SteppedPush` (the default), `SwathPush` for a blade, `SplitPush` for a wheel, or another `PushRule`.

    Returns:
        The map, the outcome, the volume that drained, and the tool's last pose.

    Raises:
        ValueError: an argument has the wrong shape or is out of range, or the push does not go with the tool.
        NotImplementedError: a second derivative is asked for.

    Example:
        >>> import jax.numpy as jnp
        >>> import jaxsand as js
        >>> scene = js.make_scene((8, 8), 0.01, tool=js.Blade(depth=0.0075))
        >>> pushed = js.act(scene, jnp.zeros((8, 8)), jnp.array([0.02, 0.04, 0.06, 0.04]))
        >>> bool(pushed.height[4, 4] < 0), bool(pushed.height[4, 7] > 0)  # a trench, and a heap ahead of it
        (True, True)
    """
    scene, height, rules = checked(scene, height, push, None, None)
    path = _stroke(stroke, height.dtype)
    return as_needed(lambda scene, _: _act(scene, height, path, rules), scene, rules, (height, path))


def step(
    scene: Scene,
    height: Float[ArrayLike, "H W"],
    stroke: Stroke,
    *,
    push: PushRule | None = None,
    scheme: Scheme | None = None,
    stop: Stop | None = None,
) -> Shaped:
    """One straight push, then settling.

    The tool is lowered at the start of the stroke, moved to its end, and lifted. Then the sand settles. Parts of a stroke
    off the map touch nothing. A stroke of no length lowers and lifts the tool, facing +x. A stroke that is not finite, or
    leads straight up or down, leaves the map as it is, and the outcome says NOT_FINITE. At a wall or a closed edge the sand
    ahead of a blade has nowhere to go: it stays in its cells, inside the blade, and flows off when the blade is lifted.

    Differentiable once, in forward and reverse mode, in the height, the stroke, the angle of repose and the tool. The
    derivative is exactly zero where the push changes nothing (a stroke off the map, a tool above the sand). The result is
    continuous in the stroke, except where its length goes to zero and the heading is lost.

    Args:
        scene: the scene, with the tool.
        height: height map [H, W] (m), with height[i, j] at x = (j + 1/2) dx, y = (i + 1/2) dx. Use `jax.vmap` or
            `step_batch` for many.
        stroke: start and end of the tool's centre [4] = x0, y0, x1, y1 (m), at the tool's own depth; or [6] = x0, y0, z0,
            x1, y1, z1 (m), with z the height of the tool's lowest point, which rises or sinks evenly on the way.
        push: how the tool moves the sand: `SteppedPush` (the default), `SwathPush` for a blade, `SplitPush` for a wheel, or
            another `PushRule`.
        scheme: scheme of settling, as of `settle`.
        stop: stop rule of settling, as of `settle`.

    Returns:
        The settled map, the outcome of push and settling, the volume that drained, and the tool's last pose.

    Raises:
        ValueError: an argument has the wrong shape or is out of range, or the push does not go with the tool.
        NotImplementedError: a second derivative is asked for.

    Source:
        Kim, Pavlov & Johnson, arXiv:1908.02745, section "Tool Interaction".

    Example:
        >>> import jax.numpy as jnp
        >>> import jaxsand as js
        >>> scene = js.make_scene((8, 8), 0.01, tool=js.Blade())
        >>> level = jnp.zeros((8, 8))
        >>> shaped = js.step(scene, level, jnp.array([0.02, 0.04, 0.06, 0.04]))
        >>> bool(shaped.height[4, 4] < 0), bool(shaped.height[4, 7] > 0)  # a trench, and a heap ahead of it
        (True, True)
        >>> bool(abs(js.volume(scene, shaped.height)) < 1e-9)
        True
    """
    height = as_array("height", height)
    return follow(scene, height, _stroke(stroke, height.dtype), push=push, scheme=scheme, stop=stop)


def follow(
    scene: Scene,
    height: Float[ArrayLike, "H W"],
    path: Path,
    *,
    push: PushRule | None = None,
    scheme: Scheme | None = None,
    stop: Stop | None = None,
) -> Shaped:
    """Pushes along a path of straight legs without lifting the tool, then settles.

    The tool is lowered once, at the first point, and carries the sand in front of it along from leg to leg. At a corner it
    turns in place about its centre, by the smaller angle; a blade pushes what it sweeps ahead of its faces. A reversal is
    half a turn, to the left. A leg of no length keeps the heading. On a map wider than the blade's heap, only a window
    around the blade is computed; see `AsNeeded`. Differentiable like `step`, also in the path.

    Args:
        scene: the scene, with the tool.
        height: height map [H, W] (m), with height[i, j] at x = (j + 1/2) dx, y = (i + 1/2) dx.
        path: the points [n, 2] = x, y (m) that the tool's centre visits, n >= 2; or [n, 3] = x, y, z (m), with z the
            height of the tool's lowest point, linear along each leg. The tool may begin or end in the air. Of a wheel under
            a load [n, 2].
        push: as of `step`.
        scheme: as of `settle`.
        stop: as of `settle`.

    Returns:
        The settled map, the outcome, the volume that drained, and the tool's last pose.

    Raises:
        ValueError: an argument has the wrong shape or is out of range, or the push does not go with the tool.
        NotImplementedError: a second derivative is asked for.

    Example:
        >>> import jax.numpy as jnp
        >>> import jaxsand as js
        >>> scene = js.make_scene((8, 8), 0.01, tool=js.Blade())
        >>> shaped = js.follow(scene, jnp.zeros((8, 8)), jnp.array([[0.02, 0.03], [0.06, 0.03], [0.06, 0.06]]))
        >>> print(f"{shaped.pose.x:.2f} {shaped.pose.y:.2f} {shaped.pose.sin:.2f}")
        0.06 0.06 1.00
    """
    scene, height, rules = checked(scene, height, push, scheme, stop)
    path = as_path(path, height.dtype)
    return as_needed(partial(_followed, height, path, rules), scene, rules, (height, path))


def follow_frames(
    scene: Scene,
    height: Float[ArrayLike, "H W"],
    path: Path,
    *,
    push: PushRule | None = None,
    scheme: Scheme | None = None,
    stop: Stop | None = None,
) -> tuple[Shaped, Float[Array, "n-1 H W"]]:
    """`follow`, and the map after each leg, for animations.

    Args:
        scene: the scene, with the tool.
        height: height map [H, W] (m).
        path: the points [n, 2] = x, y (m) that the tool's centre visits, n >= 2; or [n, 3] = x, y, z (m), with z the
            height of the tool's lowest point, linear along each leg. The tool may begin or end in the air.
        push: as of `step`.
        scheme: as of `settle`.
        stop: as of `settle`.

    Returns:
        The result of `follow`, and the maps [n - 1, H, W] (m) after each leg, while the tool is still in the sand.

    Raises:
        ValueError: as of `follow`.
        NotImplementedError: as of `follow`.

    Example:
        >>> import jax.numpy as jnp
        >>> import jaxsand as js
        >>> scene = js.make_scene((8, 8), 0.01, tool=js.Blade())
        >>> shaped, frames = js.follow_frames(scene, jnp.zeros((8, 8)), jnp.array([[0.02, 0.04], [0.06, 0.04]]))
        >>> frames.shape
        (1, 8, 8)
    """
    scene, height, rules = checked(scene, height, push, scheme, stop)
    path = as_path(path, height.dtype)
    return as_needed(lambda scene, _: _follow(scene, height, path, rules, record=itself), scene, rules, (height, path))


def rollout(
    scene: Scene,
    height: Float[ArrayLike, "H W"],
    strokes: Strokes,
    *,
    push: PushRule | None = None,
    scheme: Scheme | None = None,
    stop: Stop | None = None,
) -> Shaped:
    """Straight pushes one after the other, each followed by settling.

    Push k acts on what push k - 1 left. The result holds the whole trajectory, `height[k]` after push k. Differentiable
    like `step`.

    Args:
        scene: the scene, with the tool.
        height: height map [H, W] (m) before the first push.
        strokes: one row for each push, as of `step`: [n, 4] or [n, 6].
        push: as of `step`.
        scheme: as of `settle`.
        stop: as of `settle`.

    Returns:
        The results of the n pushes; every field has an axis of length n in front.

    Raises:
        ValueError: an argument has the wrong shape or is out of range, or the push does not go with the tool.
        NotImplementedError: a second derivative is asked for.

    Example:
        >>> import jax.numpy as jnp
        >>> import jaxsand as js
        >>> scene = js.make_scene((8, 8), 0.01, tool=js.Blade())
        >>> strokes = jnp.array([[0.02, 0.04, 0.06, 0.04], [0.04, 0.02, 0.04, 0.06]])
        >>> js.rollout(scene, jnp.zeros((8, 8)), strokes).height.shape
        (2, 8, 8)
    """
    scene, height, rules = checked(scene, height, push, scheme, stop)
    strokes = as_array("strokes", strokes, height.dtype, POINTS)
    if strokes.ndim != 2 or strokes.shape[1] not in STROKES:
        remedy = "give a row x0, y0, x1, y1 [n, 4] or x0, y0, z0, x1, y1, z1 [n, 6] for each push"
        raise ValueError(f"strokes: got shape {list(strokes.shape)}; {remedy}")
    return as_needed(lambda scene, _: _rollout(scene, height, strokes, rules), scene, rules, (height, strokes))


def as_needed(
    run: Callable[[Scene, Whole | Window], Result], scene: Scene, rules: Rules, arrays: tuple[Tree, ...]
) -> Result:
    """The result of `run(scene, settling window)` in the smallest window whose edge the sand does not reach.

    `arrays` is all that `run` depends on besides, the path or strokes second.

    While values are traced there is one try, in a window that is wide enough for most strokes.
    """
    if any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves((scene, rules, arrays))):
        return run(next(windows_for(scene, rules[0], _SURE), scene), Whole())
    for part in windows_for(scene, rules[0]):
        out = run(part, _settling_window(part, arrays[1], rules[1]))
        outcome = (out[0] if isinstance(out, tuple) else out).outcome
        if not np.any(np.asarray(outcome) & Outcome.WINDOW_EDGE):
            return out
    return run(scene, Whole())


def _settling_window(scene: Scene, path: jax.Array, scheme: Scheme) -> Whole | Window:
    """A settling window that holds the path and the blade's window at its ends.

    Whole() unless the map is much wider, and for schemes whose result depends on where the map begins.
    """
    if not path.size:
        return Whole()
    far = float(np.max(np.ptp(np.asarray(path)[:, :2], axis=0))) / float(scene.grid.spacing)
    if isinstance(scheme, Pairwise | Multilevel) or not isinstance(scene.window, Window) or not far < max(scene.grid.shape):
        return Whole()
    size = 1 << math.ceil(math.log2(far + 2 * max(scene.window.size)))
    rows, columns = scene.grid.shape
    return Window((min(size, rows), min(size, columns))) if 4 * size <= max(rows, columns) else Whole()


def windows_for(scene: Scene, push: PushRule, times: float = 1) -> Iterator[Scene]:
    """The scene with windows in which the push may do, each wider than the one before; see blade_stepped.py."""
    return blade_stepped.windows_for(scene, times) if isinstance(push, SteppedPush) else iter(())


def check_push(push: object) -> None:
    """Raises ValueError unless it is one of the pushes."""
    if isinstance(push, type) or not isinstance(push, PushRule):
        raise ValueError(f"push: got {short(push)}; give SteppedPush(substep, sweeps), SwathPush() or SplitPush()")


def checked(
    scene: Scene, height: Float[ArrayLike, "H W"], push: PushRule | None, scheme: Scheme | None, stop: Stop | None
) -> tuple[Scene, Float[Array, "H W"], Rules]:
    """The checked arguments, with None replaced by defaults and every number cast to the height's dtype."""
    check_scene(scene)
    push = SteppedPush() if push is None else push
    check_push(push)
    push.check(scene)
    scheme, stop = check_rule(scene, scheme, stop)
    scene = with_near(scene)
    fitted, height = fit(scene, height)
    if isinstance(
        fitted.grid.spacing, jax.core.Tracer
    ):  # under jit: what is cast to the height's dtype is no number any more
        fitted, _ = fit(next(windows_for(scene, push, _SURE), scene), height)
    return fitted, height, cast((push, scheme, stop), height.dtype)


def _stroke(stroke: ArrayLike, dtype: DTypeLike) -> Float[Array, "2 _"]:
    """The stroke's start and end as a path; ValueError if it has the wrong shape."""
    stroke = as_array("stroke", stroke, dtype, POINTS)
    if stroke.ndim != 1 or stroke.size not in STROKES:
        many = stroke.ndim > 1 and stroke.shape[-1] in STROKES
        remedy = "use jax.vmap" if many else "give x0, y0, x1, y1 in metres, or x0, y0, z0, x1, y1, z1"
        raise ValueError(f"stroke: got shape {list(stroke.shape)}; {remedy}")
    return stroke.reshape(2, -1)


def as_path(path: ArrayLike, dtype: DTypeLike, least: int = 2) -> Float[Array, "n _"]:
    """The path of `least` points or more, one or two; ValueError if it has the wrong shape."""
    path = as_array("path", path, dtype, POINTS)
    if path.ndim != 2 or path.shape[0] < least or 2 * path.shape[1] not in STROKES:
        points = "two points" if least > 1 else "one point"
        remedy = "use jax.vmap" if path.ndim > 2 else f"give at least {points} x, y [n, 2] or x, y, z [n, 3] in metres"
        raise ValueError(f"path: got shape {list(path.shape)}; {remedy}")
    return path


def itself(height: jax.Array) -> jax.Array:
    """The map itself, to be recorded after each leg."""
    return height


def _followed(height: jax.Array, path: jax.Array, rules: Rules, scene: Scene, window: Whole | Window) -> Shaped:
    return _follow(scene, height, path, rules, window=window)[0]


@partial(jax.jit, static_argnames="record")
def _follow(
    scene: Scene,
    height: jax.Array,
    path: jax.Array,
    rules: Rules,
    record: Record | None = None,
    window: Whole | Window | None = None,
) -> tuple[Shaped, Tree]:
    push, scheme, stop = rules
    pushed, frames = push.along(scene, height, path, record)
    return lifted(pushed, relax(scene, pushed.height, scheme, stop, Whole() if window is None else window)), frames


def lifted(pushed: Pushed, settled: Settled) -> Shaped:
    """The result of a push followed by settling."""
    outcome, drained = settled.outcome | pushed.outcome, settled.drained + pushed.drained
    return Shaped(**vars(replace(settled, outcome=outcome, drained=drained)), pose=pushed.pose)


@jax.jit
def _act(scene: Scene, height: jax.Array, path: jax.Array, rules: Rules) -> Pushed:
    return rules[0].along(scene, height, path)[0]


@jax.jit
def _rollout(scene: Scene, height: jax.Array, strokes: jax.Array, rules: Rules) -> Shaped:
    def one(height: jax.Array, stroke: jax.Array) -> tuple[jax.Array, Shaped]:
        shaped, _ = _follow(scene, height, stroke.reshape(2, -1), rules)
        return shaped.height, shaped

    return jax.lax.scan(one, height, strokes)[1]
