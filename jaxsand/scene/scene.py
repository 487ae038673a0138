"""A scene: everything about the sand except its height."""

import math
from dataclasses import dataclass, field
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
import numpy.typing as npt
from jax.typing import ArrayLike, DTypeLike
from jaxtyping import Array, Float

from jaxsand.scene.boundaries import Closed, Draining, Open, Walls
from jaxsand.scene.grid import Grid, Neighbours
from jaxsand.scene.material import DRY_SAND, Material
from jaxsand.scene.tools import Blade, Grousers, NoTool, Smooth, Wheel
from jaxsand.scene.window import AsNeeded, Whole, Window

T = TypeVar("T")


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Scene:
    """Everything about the sand except its height: the grid, the material, what bounds the sand, and the tool.

    Build one with `make_scene`, which checks it. A scene is a pytree. Angles, lengths and depths are leaves, which
    `jax.vmap` batches and `jax.grad` differentiates by; sizes and alternatives are static. What is left out is not compiled.

    Attributes:
        grid: cells and their neighbours.
        material: the sand's angle of repose.
        walls: `Open`, or `Walls` with solid cells.
        edge: `Closed`, or `Draining` with sand running off over the map's edge.
        window: which part of the map is computed: `AsNeeded`, `Whole` or `Window`.
        tool: `NoTool`, `Blade` or `Wheel`.

    Example:
        A batch of scenes with three angles of repose, each with its own map:

        >>> import jax
        >>> import jax.numpy as jnp
        >>> import jaxsand as js
        >>> scenes = jax.vmap(lambda angle: js.make_scene((8, 8), 0.01, angle))(jnp.array([0.4, 0.5, 0.6]))
        >>> scenes.material.repose_angle.shape
        (3,)
        >>> axes = jax.tree.map(lambda _: 0, scenes)
        >>> jax.vmap(js.steepest_slope, in_axes=(axes, None))(scenes, jnp.zeros((8, 8))).shape
        (3,)
    """

    grid: Grid
    material: Material = DRY_SAND
    walls: Open | Walls = field(default_factory=Open)
    edge: Closed | Draining = field(default_factory=Closed)
    window: AsNeeded | Whole | Window = field(default_factory=AsNeeded)
    tool: NoTool | Blade | Wheel = field(default_factory=NoTool)


def make_scene(
    shape: tuple[int, int],
    spacing: Float[ArrayLike, ""],
    repose_angle: Float[ArrayLike, ""] | Float[ArrayLike, "H W"] = DRY_SAND.repose_angle,
    neighbours: Neighbours = 8,
    *,
    tool: NoTool | Blade | Wheel | None = None,
    walls: Open | Walls | None = None,
    edge: Closed | Draining | None = None,
    window: AsNeeded | Whole | Window | None = None,
) -> Scene:
    """Builds a scene and checks every value in it.

    Args:
        shape: number of rows and of columns of the height maps, H and W.
        spacing: distance dx of neighbouring cell centres (m). Cell [i, j] is centred at x = (j + 1/2) dx, y = (i + 1/2) dx.
        repose_angle: angle of repose (rad), above 0 and below pi/2: a scalar, or one angle per cell [H, W].
        neighbours: between which cells repose holds: 4, 8 (diagonal neighbours are sqrt(2) dx apart), or "isotropic" (the
            length of the gradient is limited).
        tool: a `Blade` or a `Wheel`; None for no tool.
        walls: `Walls` with solid cells; None for none.
        edge: `Draining` where sand runs off over the map's edge; None for a closed edge.
        window: `Window` or `Whole`, the part of the map that is computed; None for `AsNeeded`.

    Returns:
        The scene, for `settle`, `step` and the other functions of this package.

    Raises:
        ValueError: a value is out of range; the message names the field, the value and the remedy. Values that are being
            traced (inside `jit`, `vmap` or `grad`) are not checked.

    Example:
        >>> import math
        >>> import jaxsand as js
        >>> scene = js.make_scene(shape=(8, 8), spacing=0.01, repose_angle=math.radians(29), tool=js.Blade())
        >>> scene.grid.shape
        (8, 8)
        >>> js.make_scene((8, 8), spacing=-1)
        Traceback (most recent call last):
            ...
        ValueError: spacing: got -1; it must be one finite number above 0: ...
    """
    shape = _shape(shape)
    _positive("spacing", spacing, "give the distance of cell centres in metres, such as 0.01")
    _angle(repose_angle, shape)
    known = neighbours == "isotropic" if isinstance(neighbours, str) else isinstance(neighbours, int | np.integer)
    if not known or neighbours not in (4, 8, "isotropic"):
        raise ValueError(f'neighbours: got {neighbours!r}; choose 4, 8 or "isotropic"')
    scene = Scene(
        Grid(_number(spacing), shape, neighbours if isinstance(neighbours, str) else 4 if neighbours == 4 else 8),
        Material(_number(repose_angle)),
        Open() if walls is None else _as_walls(walls),
        Closed() if edge is None else edge,
        AsNeeded() if window is None else window,
        NoTool() if tool is None else tool,
    )
    _check_walls(scene.walls, shape)
    _check_edge(scene.edge)
    check_window(scene.window, shape)
    _check_tool(scene.tool, scene.grid)
    return scene


def blade_of(scene: Scene) -> Blade:
    """The scene's blade; raises ValueError if its tool is another."""
    if not isinstance(scene.tool, Blade):
        raise ValueError(f"scene.tool: got {type(scene.tool).__name__}; give make_scene(..., tool=Blade()) to push with")
    return scene.tool


def volume(scene: Scene, height: Float[ArrayLike, "H W"]) -> Float[Array, ""]:
    """The volume of the sand above height 0, less what is missing below it.

    volume = dx^2 * (sum of the heights of all cells that are not solid), summed in the height's dtype. To tell whether sand
    was lost, use `jaxsand.task.volume_error`, which sums in float64. Differentiable in the height and the spacing.

    Args:
        scene: the scene, which gives the spacing dx and the solid cells.
        height: height map [H, W] (m).

    Returns:
        The volume (m^3), a scalar.

    Raises:
        ValueError: the height has the wrong shape or is not a floating-point array.

    Example:
        >>> import jax.numpy as jnp
        >>> import jaxsand as js
        >>> scene = js.make_scene((8, 8), spacing=0.01)
        >>> print(f"{js.volume(scene, jnp.full((8, 8), 0.1)):.6f}")
        0.000640
    """
    scene, height = fit(scene, height)
    if isinstance(scene.walls, Walls):
        height = jnp.where(scene.walls.solid, 0, height)
    return jnp.sum(jnp.sum(height, axis=0)) * jnp.asarray(scene.grid.spacing, height.dtype) ** 2


def fit(scene: Scene, height: Float[ArrayLike, "H W"]) -> tuple[Scene, Float[Array, "H W"]]:
    """The scene with every float cast to the height's dtype, and the height as an array; ValueError if it is unfit."""
    height = as_array("height", height)
    if not jnp.issubdtype(height.dtype, jnp.floating):
        raise ValueError(f"height: got dtype {height.dtype}; convert it to float32 or float64 metres")
    if height.shape != scene.grid.shape:
        rows, columns = scene.grid.shape
        remedy = "use jax.vmap" if height.shape[-2:] == scene.grid.shape else f"give a map of shape [{rows}, {columns}]"
        raise ValueError(f"height: got shape {list(height.shape)}, the scene has [{rows}, {columns}]; {remedy}")
    angle, spacing = concrete(scene.material.repose_angle), concrete(scene.grid.spacing)
    if angle is not None and not np.all(np.tan(angle.astype(height.dtype)) > 0):
        which = "pi/2" if np.any(angle > 1) else "0"
        raise ValueError(f"repose_angle: got an angle of {which} in {height.dtype}; give another, or float64 heights")
    if spacing is not None and not np.all(spacing.astype(height.dtype) ** 2 > 0):
        raise ValueError(
            f"spacing: got {scene.grid.spacing!r}, whose square is 0 in {height.dtype}; give metres, such as 0.01"
        )
    return cast(scene, height.dtype), height


def as_array(name: str, value: ArrayLike | npt.ArrayLike, dtype: DTypeLike | None = None) -> jax.Array:
    """The value as an array; raises a ValueError that bears the name if it is none."""
    try:
        return jnp.asarray(value, dtype)
    except (TypeError, ValueError) as error:
        reason = str(error).split("\n", maxsplit=1)[0][:80]
        raise ValueError(f"{name}: got {type(value).__name__}, no array of numbers ({reason}); give numbers") from None


def cast(tree: T, dtype: DTypeLike) -> T:
    """The tree with every number as an array of `dtype`, so that 0.5, np.float32(0.5) and an array share one program."""

    def one(leaf: ArrayLike) -> jax.Array:
        if jnp.issubdtype(jnp.result_type(leaf), jnp.bool_):
            return jnp.asarray(leaf)
        return jnp.asarray(leaf, dtype)

    return jax.tree.map(one, tree)


def concrete(value: object) -> np.ndarray | None:
    """The value as a numpy array (NaN for what is no number), or None if it is being traced."""
    if isinstance(value, jax.core.Tracer):
        return None
    try:
        array = np.asarray(value)
    except (TypeError, ValueError):
        return None
    return array if array.dtype.kind in "fiub" else np.full((), np.nan)


def _number(value: ArrayLike) -> Any:
    return float(value) if isinstance(value, (int, float)) else value


def _shape(shape: tuple[int, int]) -> tuple[int, int]:
    try:
        rows, columns = shape
        good = all(int(n) == n and not isinstance(n, bool) and n >= 1 for n in (rows, columns))
    except (TypeError, ValueError, OverflowError):
        good = False
    if not good:
        raise ValueError(f"shape: got {shape!r}; give two whole numbers of at least 1, (rows, columns)")
    return int(rows), int(columns)


def _positive(name: str, value: object, remedy: str) -> None:
    array = concrete(value)
    if array is not None and not (array.ndim == 0 and np.isfinite(array) and array > 0):
        raise ValueError(f"{name}: got {_short(value)}; it must be one finite number above 0: {remedy}")


def _finite(name: str, value: object, remedy: str) -> None:
    array = concrete(value)
    if array is not None and not (array.ndim == 0 and np.isfinite(array)):
        raise ValueError(f"{name}: got {_short(value)}; it must be one finite number: {remedy}")


def _short(value: Any) -> str:
    return repr(value) if np.ndim(value) == 0 else f"an array of shape {list(np.shape(value))}"


def _angle(angle: object, shape: tuple[int, int]) -> None:
    array = concrete(angle)
    if array is None:
        return
    if not np.all(np.isfinite(array)) or not np.all((array > 0) & (array < math.pi / 2)):
        worst = array.ravel()[np.argmax(~((array > 0) & (array < math.pi / 2)).ravel())] if array.size else array
        raise ValueError(
            f"repose_angle: got {worst} rad; it must lie above 0 and below pi/2: for degrees use math.radians(29)"
        )
    if array.ndim not in (0, 2) or (array.ndim == 2 and array.shape != shape):
        raise ValueError(f"repose_angle: got shape {list(array.shape)}; give one number or a map of shape {list(shape)}")


def _as_walls(walls: Open | Walls) -> Open | Walls:
    return Walls(jnp.asarray(walls.solid)) if isinstance(walls, Walls) and not hasattr(walls.solid, "dtype") else walls


def _check_walls(walls: object, shape: tuple[int, int]) -> None:
    if isinstance(walls, Walls):
        solid = concrete(walls.solid)
        if solid is not None and (solid.dtype != bool or solid.shape != shape):
            raise ValueError(
                f"walls.solid: got {solid.dtype} of shape {list(solid.shape)}; give booleans of shape {list(shape)}"
            )
    elif not isinstance(walls, Open):
        got = type(walls).__name__ if hasattr(walls, "shape") else repr(walls)
        raise ValueError(f"walls: got {got}; give Open() or Walls(solid)")


def _check_edge(edge: object) -> None:
    if isinstance(edge, Draining):
        _finite("edge.level", edge.level, "give the height of the rim in metres")
    elif not isinstance(edge, Closed):
        raise ValueError(f"edge: got {edge!r}; give Closed() or Draining(level)")


def check_window(window: object, shape: tuple[int, int]) -> None:
    """Raises ValueError unless it is a window that fits on a map of this shape."""
    if isinstance(window, Window):
        try:
            inside = len(window.size) == 2 and all(
                isinstance(n, int | np.integer) and 1 <= n <= m for n, m in zip(window.size, shape, strict=True)
            )
        except (TypeError, ValueError):
            inside = False
        if not inside:
            raise ValueError(
                f"window.size: got {window.size!r}; give (rows, columns) from 1 up to the map's {shape}, or use Whole()"
            )
        tolerance = concrete(window.tolerance)
        if tolerance is not None and not np.all(tolerance >= 0):
            raise ValueError(f"window.tolerance: got {window.tolerance!r}; give 0 or a small positive number of spacings")
    elif not isinstance(window, AsNeeded | Whole):
        raise ValueError(f"window: got {window!r}; give AsNeeded(), Whole() or Window(size)")


def _check_tool(tool: object, grid: Grid) -> None:
    if isinstance(tool, Blade):
        _positive("tool.width", tool.width, "give the blade's width in metres")
        _positive("tool.thickness", tool.thickness, "give the blade's thickness in metres")
        _finite("tool.depth", tool.depth, "give the depth of the blade's bottom below height 0 in metres")
        thickness, dx = concrete(tool.thickness), concrete(grid.spacing)
        if thickness is None or dx is None:
            return
        for name, extent in (("width", concrete(tool.width)), ("thickness", thickness)):
            if extent is not None and np.any(extent < dx * (1 - 1e-6)):
                raise ValueError(
                    f"tool.{name}: got {getattr(tool, name)!r} m, less than a cell of {grid.spacing!r} m; "
                    "enlarge the blade or refine the grid"
                )
        if np.any(thickness > dx * max(2, math.hypot(*grid.shape))):
            raise ValueError(
                f"tool.thickness: got {tool.thickness!r} m, more than the map's diagonal; "
                "give lengths in metres, or enlarge the map"
            )
    elif isinstance(tool, Wheel):
        _check_wheel(tool, grid)
    elif not isinstance(tool, NoTool):
        raise ValueError(
            f"tool: got {tool!r}; give NoTool(), Blade(width, thickness, depth) or Wheel(radius, width, sinkage)"
        )


def _check_wheel(wheel: Wheel, grid: Grid) -> None:
    for name in ("radius", "width", "sinkage"):
        _positive(f"tool.{name}", getattr(wheel, name), f"give the wheel's {name} in metres")
    _finite("tool.slip_angle", wheel.slip_angle, "give the angle from the wheel's plane to its way in rad")
    radius, width, sinkage, slip, dx = map(
        concrete, (wheel.radius, wheel.width, wheel.sinkage, wheel.slip_angle, grid.spacing)
    )
    if sinkage is not None and radius is not None and sinkage > radius:
        raise ValueError(f"tool.sinkage: got {wheel.sinkage!r} m, deeper than the axle; give at most the radius")
    if slip is not None and abs(slip) > math.pi / 2 * (1 + 1e-6):
        raise ValueError(
            f"tool.slip_angle: got {wheel.slip_angle!r} rad; give -pi/2 to pi/2: for degrees use math.radians(45)"
        )
    if dx is not None:
        for name, extent in (("radius", radius), ("width", width)):
            if extent is not None and extent < dx * (1 - 1e-6):
                raise ValueError(
                    f"tool.{name}: got {getattr(wheel, name)!r} m, less than a cell of {grid.spacing!r} m; "
                    "enlarge the wheel or refine the grid"
                )
            if extent is not None and extent > dx * max(2, math.hypot(*grid.shape)):
                raise ValueError(
                    f"tool.{name}: got {getattr(wheel, name)!r} m, more than the map's diagonal; "
                    "give lengths in metres, or enlarge the map"
                )
    if isinstance(wheel.grousers, Grousers):
        for name in ("height", "fill", "spin"):
            value = concrete(getattr(wheel.grousers, name))
            if value is not None and not (value.ndim == 0 and np.isfinite(value) and value >= 0):
                got = _short(getattr(wheel.grousers, name))
                raise ValueError(f"tool.grousers.{name}: got {got}; it must be one finite number of 0 or more")
    elif not isinstance(wheel.grousers, Smooth):
        raise ValueError(f"tool.grousers: got {wheel.grousers!r}; give Smooth() or Grousers(height, fill, spin)")
