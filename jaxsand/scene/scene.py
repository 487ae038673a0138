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

from jaxsand.scene.boundaries import Base, Closed, Deep, Draining, Open, Walls
from jaxsand.scene.grid import Grid, Neighbours
from jaxsand.scene.masked import BED, unmasked
from jaxsand.scene.material import DRY_SAND, Material
from jaxsand.scene.tools import Blade, NoTool, Tool, square
from jaxsand.scene.validation import concrete, finite, positive, short
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
        tool: `NoTool`, `Blade`, `Wheel`, or another `Tool`.
        base: `Deep`, or `Base` with a floor under the sand.

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
    tool: Tool = field(default_factory=NoTool)
    base: Deep | Base = field(default_factory=Deep)


def make_scene(
    shape: tuple[int, int],
    spacing: Float[ArrayLike, ""],
    repose_angle: Float[ArrayLike, ""] | Float[ArrayLike, "H W"] = DRY_SAND.repose_angle,
    neighbours: Neighbours = 8,
    *,
    tool: Tool | None = None,
    walls: Open | Walls | None = None,
    edge: Closed | Draining | None = None,
    window: AsNeeded | Whole | Window | None = None,
    base: Deep | Base | None = None,
) -> Scene:
    """Builds a scene and checks every value in it.

    Args:
        shape: number of rows and of columns of the height maps, H and W.
        spacing: distance dx of neighbouring cell centres (m). Cell [i, j] is centred at x = (j + 1/2) dx, y = (i + 1/2) dx.
        repose_angle: angle of repose (rad), above 0 and below pi/2: a scalar, or one angle per cell [H, W].
        neighbours: between which cells repose holds: 4, 8 (diagonal neighbours are sqrt(2) dx apart), or "isotropic" (the
            length of the gradient is limited).
        tool: a `Blade`, a `Wheel`, or another `Tool`; None for no tool.
        walls: `Walls` with solid cells; None for none.
        edge: `Draining` where sand runs off over the map's edge; None for a closed edge.
        window: `Window` or `Whole`, the part of the map that is computed; None for `AsNeeded`.
        base: `Base`, a floor under the sand; None for a bed deeper than any tool reaches.

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
    positive("spacing", spacing, "give the distance of cell centres in metres, such as 0.01")
    repose_angle = unmasked("repose_angle", repose_angle, "give every cell an angle, such as angle.filled(angle.mean())")
    _angle(repose_angle, shape)
    known = neighbours == "isotropic" if isinstance(neighbours, str) else isinstance(neighbours, int | np.integer)
    if not known or neighbours not in (4, 8, "isotropic"):
        raise ValueError(f'neighbours: got {short(neighbours)}; choose 4, 8 or "isotropic"')
    scene = Scene(
        Grid(_number(spacing), shape, neighbours if isinstance(neighbours, str) else 4 if neighbours == 4 else 8),
        Material(_number(repose_angle)),
        Open() if walls is None else _as_walls(walls),
        Closed() if edge is None else edge,
        AsNeeded() if window is None else window,
        NoTool() if tool is None else tool,
        Deep() if base is None else _as_base(base),
    )
    _check_walls(scene.walls, shape)
    _check_edge(scene.edge)
    _check_base(scene.base, shape)
    check_window(scene.window, shape)
    if isinstance(scene.tool, type) or not isinstance(scene.tool, Tool):
        raise ValueError(
            f"tool: got {short(tool)}; give NoTool(), Blade(width, thickness, depth), Wheel(radius, width, sinkage), "
            "or a Tool of your own"
        )
    scene.tool.check(scene.grid)
    return scene


def blade_of(scene: Scene) -> Blade:
    """The scene's blade; raises ValueError if its tool is another, or the blade stands at an angle or has plates."""
    if not isinstance(scene.tool, Blade):
        raise ValueError(f"scene.tool: got {type(scene.tool).__name__}; give make_scene(..., tool=Blade()) to push with")
    square(scene.tool)
    return scene.tool


def deep(scene: Scene, push: str) -> None:
    """Raises ValueError if a floor lies under the sand, which the push named `push` does not know."""
    if isinstance(scene.base, Base):
        raise ValueError(
            f"push: got {push} on a Base, which it does not know; give SteppedPush(), or make_scene without base"
        )


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
    check_scene(scene)
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
            f"spacing: got {short(scene.grid.spacing)}, whose square is 0 in {height.dtype}; give metres, such as 0.01"
        )
    return cast(scene, height.dtype), height


def check_scene(scene: object) -> None:
    """Raises ValueError unless it is a scene."""
    if not isinstance(scene, Scene):
        raise ValueError(f"scene: got {type(scene).__name__}; give make_scene(shape, spacing)")


def as_array(name: str, value: ArrayLike | npt.ArrayLike, dtype: DTypeLike | None = None, masked: str = BED) -> jax.Array:
    """The value as an array; raises a ValueError that bears the name if it is none, or has cells that are masked, for which
    `masked` is the remedy.
    """
    value = unmasked(name, value, masked)
    try:
        return jnp.asarray(value, dtype)
    except (TypeError, ValueError, OverflowError) as error:
        reason = str(error).split("\n", maxsplit=1)[0][:80]
        raise ValueError(f"{name}: got {type(value).__name__}, no array of numbers ({reason}); give numbers") from None


def cast(tree: T, dtype: DTypeLike) -> T:
    """The tree with every number as an array of `dtype`, so that 0.5, np.float32(0.5) and an array share one program."""

    def one(leaf: ArrayLike) -> jax.Array:
        if jnp.issubdtype(jnp.result_type(leaf), jnp.bool_):
            return jnp.asarray(leaf)
        return jnp.asarray(leaf, dtype)

    return jax.tree.map(one, tree)


def _number(value: ArrayLike) -> Any:
    return float(value) if isinstance(value, (int, float)) else value


def _shape(shape: tuple[int, int]) -> tuple[int, int]:
    try:
        rows, columns = shape
        good = all(int(n) == n and not isinstance(n, bool) and n >= 1 for n in (rows, columns))
    except (TypeError, ValueError, OverflowError):
        good = False
    if not good:
        raise ValueError(f"shape: got {short(shape)}; give two whole numbers of at least 1, (rows, columns)")
    return int(rows), int(columns)


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
    if not isinstance(walls, Walls):
        return walls
    solid = unmasked("walls.solid", walls.solid, "say of each whether it is solid: solid.filled(True), or False")
    return Walls(solid if hasattr(solid, "dtype") else jnp.asarray(solid))


def _check_walls(walls: object, shape: tuple[int, int]) -> None:
    if isinstance(walls, Walls):
        solid = concrete(walls.solid)
        if solid is not None and (solid.dtype != bool or solid.shape != shape):
            raise ValueError(
                f"walls.solid: got {solid.dtype} of shape {list(solid.shape)}; give booleans of shape {list(shape)}"
            )
    elif not isinstance(walls, Open):
        raise ValueError(f"walls: got {short(walls)}; give Open() or Walls(solid)")


def _check_edge(edge: object) -> None:
    if isinstance(edge, Draining):
        finite("edge.level", edge.level, "give the height of the rim in metres")
    elif not isinstance(edge, Closed):
        raise ValueError(f"edge: got {short(edge)}; give Closed() or Draining(level)")


def _as_base(base: Deep | Base) -> Deep | Base:
    if not isinstance(base, Base):
        return base
    height = unmasked("base.height", base.height, "give every cell a floor, however deep")
    return Base(_number(height) if np.ndim(height) == 0 or hasattr(height, "dtype") else jnp.asarray(height))


def _check_base(base: object, shape: tuple[int, int]) -> None:
    if isinstance(base, Base):
        height = concrete(base.height)
        if height is not None and height.shape not in ((), shape):
            remedy = f"give one number or a map of shape {list(shape)}"
            raise ValueError(f"base.height: got shape {list(height.shape)}; {remedy}")
        if height is not None and not np.all(np.isfinite(height)):
            raise ValueError("base.height: got a number that is not finite; give metres, such as -0.06")
    elif not isinstance(base, Deep):
        raise ValueError(f"base: got {short(base)}; give Deep() or Base(height)")


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
                f"window.size: got {short(window.size)}; give (rows, columns) from 1 up to the map's {shape}, or use Whole()"
            )
        tolerance = concrete(window.tolerance)
        if tolerance is not None and not np.all(tolerance >= 0):
            raise ValueError(
                f"window.tolerance: got {short(window.tolerance)}; give 0 or a small positive number of spacings"
            )
    elif not isinstance(window, AsNeeded | Whole):
        raise ValueError(f"window: got {short(window)}; give AsNeeded(), Whole() or Window(size)")
