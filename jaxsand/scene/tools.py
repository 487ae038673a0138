"""Tools: what they are, and what can be told of them without a place to stand."""

import math
from dataclasses import Field, dataclass, field, replace
from typing import Any, ClassVar, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxsand.scene.bearing import wheel_force, wheel_sinkage
from jaxsand.scene.grid import Grid
from jaxsand.scene.soil import WONG_DRY_SAND, Soil, check_soil
from jaxsand.scene.validation import concrete, finite, positive, short

MOST_YAW = math.pi / 3  # the largest angle of a blade to its way (rad)
Scalar = Float[Array, ""]
Number = Scalar | float


@runtime_checkable
class Tool(Protocol):
    """What a scene can have as its tool: a frozen dataclass, registered as a pytree, that checks its own fields.

    Fields that are numbers are leaves, which `jax.vmap` batches and `jax.grad` differentiates by. What a tool does to the
    sand is up to a `PushRule`. The site's guide "A new tool" builds a round rod in a page.

    Example:
        >>> import jaxsand as js
        >>> isinstance(js.Blade(), js.Tool), isinstance("a spade", js.Tool)
        (True, False)
    """

    __dataclass_fields__: ClassVar[dict[str, Field[Any]]]

    def check(self, grid: Grid) -> None:
        """Raises ValueError, which names the field, the value and the remedy, if the tool makes no sense on the grid.

        Called by `make_scene`. Values that are being traced are not known yet and pass.
        """


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class NoTool:
    """No tool: nothing touches the sand, the default of `make_scene`.

    Example:
        >>> import jaxsand as js
        >>> js.make_scene((8, 8), 0.01).tool
        NoTool()
    """

    def check(self, grid: Grid) -> None:
        """Nothing can be wrong."""


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Blade:
    """A flat upright blade that is pushed perpendicular to its face, or at an angle to it.

    While it is lowered, its bottom edge is at height -depth. The depth is measured from height 0 and not from the surface
    of the sand, so that a blade of negative depth passes above a level map of height 0.

    A blade at an angle throws a windrow to one side: its left end leads where the angle is negative, and the sand leaves to
    the left where it is positive. What the blade covers leaves along its normal, turned towards the way by the angle of
    repose at most, as sand that slides on sand would.

    An angle above pi/4 leaves some sand in the swath of a blade that is hardly thicker than a cell.

    A blade with plates, a box blade, carries its heap instead of spilling it to the sides, as long as the heap's toe lies
    between the plates: V / w of it (m^2) has its toe sqrt(2 V / (w mu)) ahead. A plate is a cell thick and as deep as the
    blade; it stands beside the blade's end. While the blade turns in place, its plates are up.

    Attributes:
        width: extent along its face (m), at least one cell.
        thickness: extent along its normal (m), at least one cell.
        depth: depth of the bottom edge below height 0 (m).
        yaw: angle from the direction of travel to the blade's normal (rad), counter-clockwise, -pi/3 to pi/3; None for a
            blade that stands square to its way, which costs nothing.
        plates: how far plates at its two ends reach ahead of its face (m), for a blade that stands square; None without.

    Example:
        >>> import jaxsand as js
        >>> scene = js.make_scene((8, 8), 0.01, tool=js.Blade(width=0.03, thickness=0.015, depth=0.005))
        >>> scene.tool.width
        0.03
    """

    width: Number = 0.02
    thickness: Number = 0.015
    depth: Number = 0.0075
    yaw: Number | None = None
    plates: Number | None = None

    def check(self, grid: Grid) -> None:
        """Raises ValueError if a length or the angle is out of range, or a length less than a cell; see `Tool`."""
        positive("tool.width", self.width, "give the blade's width in metres")
        positive("tool.thickness", self.thickness, "give the blade's thickness in metres")
        finite("tool.depth", self.depth, "give the depth of the blade's bottom below height 0 in metres")
        if self.yaw is not None:
            finite("tool.yaw", self.yaw, "give the angle from the way to the blade's normal in rad, or None")
            yaw = concrete(self.yaw)
            if yaw is not None and abs(yaw) > MOST_YAW * (1 + 1e-6):
                raise ValueError(
                    f"tool.yaw: got {short(self.yaw)} rad; give -pi/3 to pi/3: for degrees use math.radians(30)"
                )
        if self.plates is not None:
            positive("tool.plates", self.plates, "give how far the plates reach ahead in metres, or None")
            _within_the_map({"plates": self.plates}, grid)
            if self.yaw is not None:
                raise ValueError("tool.yaw: got an angle and plates; a blade with plates stands square, so give yaw=None")
        thickness, dx = concrete(self.thickness), concrete(grid.spacing)
        if thickness is None or dx is None:
            return
        _at_least_a_cell("blade", {"width": self.width, "thickness": self.thickness}, grid)
        _within_the_map({"thickness": self.thickness}, grid)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Bucket:
    """A bucket that scoops sand with its front edge, carries it, and dumps it.

    `scoop` moves the edge along a path: what it cuts goes into the bucket until that is full, and the rest is pushed ahead,
    as by a blade. `dump` pours it out, across the bucket's width. What it holds is one number, or, with walls, a heap; see
    `Load` and `Heaped`.

    Attributes:
        width: extent of the edge across the direction of travel (m), at least one cell.
        length: extent along the direction of travel (m), at least one cell. It moves no sand.
        capacity: volume that it holds when full (m^3), above 0.
        depth: depth of the edge below height 0 (m) on paths without heights.
        walls: height of its walls above its floor (m): what it holds is then a small map, in whole cells of the bed, that
            keeps to repose; what does not stay spills over the walls onto the bed after each scoop. None for a load that is
            one number, which costs nothing.

    Example:
        >>> import jaxsand as js
        >>> scene = js.make_scene((8, 8), 0.01, tool=js.Bucket(width=0.03, length=0.02, capacity=6e-6))
        >>> scene.tool.capacity
        6e-06
    """

    width: Number
    length: Number
    capacity: Number
    depth: Number = 0.0075
    walls: Number | None = None

    def check(self, grid: Grid) -> None:
        """Raises ValueError if a length is out of range, or less than a cell, or it holds nothing; see `Tool`."""
        positive("tool.width", self.width, "give the bucket's width in metres")
        positive("tool.length", self.length, "give the bucket's length in metres")
        positive("tool.capacity", self.capacity, "give what the bucket holds in m^3")
        finite("tool.depth", self.depth, "give the depth of the bucket's edge below height 0 in metres")
        if self.walls is not None:
            positive("tool.walls", self.walls, "give the height of the bucket's walls in metres, or None")
        sizes = {"width": self.width, "length": self.length}
        _at_least_a_cell("bucket", sizes, grid)
        _within_the_map(sizes, grid)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Smooth:
    """A wheel whose rim carries no sand to behind it: it has no grousers, or does not turn. The default of `Wheel`.

    Example:
        >>> import jaxsand as js
        >>> js.Wheel().grousers
        Smooth()
    """


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Grousers:
    """Bars across the rim of a turning wheel, which carry sand to behind the wheel.

    For each metre of travel they set down spin * width * height * fill (m^3) in the cut behind the wheel, where width is the
    wheel's; at most what the wheel displaces.

    Attributes:
        height: how far the bars stand out of the rim (m).
        fill: share of the space between the bars that sand fills, usually 0 to 1.
        spin: speed of the rim over the speed of travel: 1 / (1 - i) for a wheel driven at the slip ratio i.

    Example:
        >>> import jaxsand as js
        >>> driven = js.Wheel(grousers=js.Grousers(height=0.005, fill=0.1, spin=1 / (1 - 0.2)))
        >>> driven.grousers.spin
        1.25
    """

    height: Number = 0.005
    fill: Number = 0.1
    spin: Number = 1.0


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Wheel:
    """A wheel at a fixed sinkage or under a load, with its plane at an angle to the direction of travel.

    The lowest point of its rim is at height -sinkage. The defaults are those of arXiv:1908.02745.

    Under a load it sinks until the soil carries it (`js.forces.wheel_sinkage`), and follows the ground: over each point
    of its way its lowest point is that sinkage below the mean level of the sand over its width, as the push found it. A load
    that the soil does not carry before the wheel stands in it up to its axle is refused, by `make_scene` or, where numbers
    are traced, by the outcome NOT_CARRIED.

    Attributes:
        radius: radius of the rim (m).
        width: width of the rim (m).
        sinkage: depth of the lowest point below height 0 (m), above 0 and at most the radius; not used under a load.
        slip_angle: angle from the wheel's plane to the direction of travel (rad), counter-clockwise, -pi/2 to pi/2. At
            pi/2 the wheel is dragged sideways, to its left.
        grousers: `Smooth`, or `Grousers` that carry sand to behind the wheel.
        load: what the wheel carries, with its own weight (N), above 0; None for a wheel at a fixed sinkage, which costs
            nothing.
        soil: what carries a load, a `js.forces.Soil`; None for `js.forces.WONG_DRY_SAND`.
        slip: slip ratio under a load, 1 - speed / (radius * rate), 0 to 1; None for that of the grousers' spin,
            1 - 1 / spin, and 0 of a smooth wheel.

    Example:
        >>> import math
        >>> import jaxsand as js
        >>> wheel = js.Wheel(radius=0.03, width=0.02, sinkage=0.005, slip_angle=math.radians(30))
        >>> js.make_scene((8, 8), 0.01, tool=wheel).tool.sinkage
        0.005
        >>> js.make_scene((8, 8), 0.01, tool=js.Wheel(radius=0.03, width=0.02, load=2.0, slip=0.2)).tool.load
        2.0
    """

    radius: Number = 0.048
    width: Number = 0.05
    sinkage: Number = 0.015
    slip_angle: Number = 0.0
    grousers: Smooth | Grousers = field(default_factory=Smooth)
    load: Number | None = None
    soil: Soil | None = None
    slip: Number | None = None

    def check(self, grid: Grid) -> None:
        """Raises ValueError if a length or an angle is out of range, or the soil does not carry the load; see `Tool`."""
        for name in ("radius", "width", "sinkage") if self.load is None else ("radius", "width"):
            positive(f"tool.{name}", getattr(self, name), f"give the wheel's {name} in metres")
        finite("tool.slip_angle", self.slip_angle, "give the angle from the wheel's plane to its way in rad")
        radius, sinkage, slip = map(concrete, (self.radius, self.sinkage, self.slip_angle))
        if self.load is None and sinkage is not None and radius is not None and sinkage > radius:
            raise ValueError(f"tool.sinkage: got {short(self.sinkage)} m, deeper than the axle; give at most the radius")
        if slip is not None and abs(slip) > math.pi / 2 * (1 + 1e-6):
            raise ValueError(
                f"tool.slip_angle: got {short(self.slip_angle)} rad; give -pi/2 to pi/2: for degrees use math.radians(45)"
            )
        sizes = {"radius": self.radius, "width": self.width}
        _at_least_a_cell("wheel", sizes, grid)
        _within_the_map(sizes, grid)
        if isinstance(self.grousers, Grousers):
            for name in ("height", "fill", "spin"):
                value = concrete(getattr(self.grousers, name))
                if value is not None and not (value.ndim == 0 and np.isfinite(value) and value >= 0):
                    got = short(getattr(self.grousers, name))
                    raise ValueError(f"tool.grousers.{name}: got {got}; it must be one finite number of 0 or more")
        elif not isinstance(self.grousers, Smooth):
            raise ValueError(f"tool.grousers: got {short(self.grousers)}; give Smooth() or Grousers(height, fill, spin)")
        _check_load(self)


def _check_load(wheel: Wheel) -> None:
    """Raises ValueError unless the soil carries the wheel's load, or if what belongs to a load is given without one."""
    if wheel.load is None:
        for name, value in (("soil", wheel.soil), ("slip", wheel.slip)):
            if value is not None:
                raise ValueError(f"tool.{name}: got one for a wheel without a load; give load= in newtons, or {name}=None")
        return
    positive("tool.load", wheel.load, "give newtons, or None for a wheel at a fixed sinkage")
    if wheel.soil is not None and not isinstance(wheel.soil, Soil):
        raise ValueError(f"tool.soil: got {short(wheel.soil)}; give a js.forces.Soil, or None for a dry sand")
    spin = concrete(wheel.grousers.spin) if isinstance(wheel.grousers, Grousers) and wheel.slip is None else None
    if spin is not None and not (spin.ndim == 0 and spin >= 1):
        remedy = "give a slip ratio of 0 to 1, which is 1 - 1 / spin of a driven wheel"
        raise ValueError(f"tool.grousers.spin: got {spin} under a load; {remedy}")
    soil, slip = soil_of(wheel), concrete(slip_of(wheel))
    check_soil(soil)
    if slip is not None and not (slip.ndim == 0 and 0 <= slip <= 1):
        raise ValueError(f"tool.slip: got {short(wheel.slip)}; give a slip ratio of 0 to 1, 1 - 1 / spin of a driven wheel")
    if any(concrete(leaf) is None for leaf in jax.tree.leaves((wheel, soil))):
        return
    with jax.ensure_compile_time_eval():
        most = float(_most(wheel))
    if not float(wheel.load) <= most:
        raise ValueError(
            f"tool.load: got {short(wheel.load)} N, but the soil carries {most:.4g} N when the wheel stands in it up to its "
            "axle; lighten it, give a larger wheel, or a firmer soil"
        )


def _at_least_a_cell(kind: str, sizes: dict[str, Number], grid: Grid) -> None:
    dx = concrete(grid.spacing)
    for name, value in sizes.items():
        size = concrete(value)
        if size is not None and dx is not None and np.any(size < dx * (1 - 1e-6)):
            raise ValueError(
                f"tool.{name}: got {short(value)} m, less than a cell of {short(grid.spacing)} m; "
                f"enlarge the {kind} or refine the grid"
            )


def _within_the_map(sizes: dict[str, Number], grid: Grid) -> None:
    dx = concrete(grid.spacing)
    for name, value in sizes.items():
        size = concrete(value)
        if size is not None and dx is not None and np.any(size > dx * max(2, math.hypot(*grid.shape))):
            raise ValueError(
                f"tool.{name}: got {short(value)} m, more than the map's diagonal; give lengths in metres, or enlarge "
                "the map"
            )


def square(blade: Blade) -> None:
    """Raises ValueError unless the blade stands square to its way and has no plates."""
    if blade.yaw is not None:
        raise ValueError(f"scene.tool.yaw: got {short(blade.yaw)}; give a blade that stands square to its way, yaw=None")
    if blade.plates is not None:
        raise ValueError(f"scene.tool.plates: got {short(blade.plates)}; give a blade without, plates=None")


def lowest(tool: Blade | Wheel) -> Scalar:
    """The height of the tool's lowest point (m)."""
    return -jnp.asarray(tool.sinkage if isinstance(tool, Wheel) else tool.depth)


def usable(tool: Tool) -> Bool[Array, ""]:
    """Whether the tool's numbers are finite and, for a wheel, in range; checks traced values, which `make_scene` cannot."""
    good = jnp.ones((), bool)
    for leaf in jax.tree.leaves(tool):
        good = good & jnp.all(jnp.isfinite(leaf))
    if isinstance(tool, Wheel):
        good = good & (tool.sinkage >= 0) & (tool.sinkage <= tool.radius)
        good = good & (jnp.abs(tool.slip_angle) <= math.pi / 2 * (1 + 1e-6))
    if isinstance(tool, Blade) and tool.yaw is not None:
        good = good & (jnp.abs(tool.yaw) <= MOST_YAW * (1 + 1e-6))
    if isinstance(tool, Blade) and tool.plates is not None:
        good = good & (tool.plates >= 0)
    return good


def soil_of(wheel: Wheel) -> Soil:
    """What carries a wheel's load."""
    return WONG_DRY_SAND if wheel.soil is None else wheel.soil


def slip_of(wheel: Wheel) -> Number:
    """The slip ratio of a wheel under a load."""
    if wheel.slip is not None:
        return wheel.slip
    return 1 - 1 / wheel.grousers.spin if isinstance(wheel.grousers, Grousers) else 0.0


def sunk(wheel: Wheel) -> tuple[Wheel, Bool[Array, ""]]:
    """A wheel under a load as one at the sinkage at which its soil carries that, and whether it is too heavy for the soil.

    The sinkage is NaN if the wheel is too heavy or its numbers are out of range.
    """
    assert wheel.load is not None
    slip = jnp.asarray(slip_of(wheel))
    fits = (slip >= 0) & (slip <= 1)
    sinkage = wheel_sinkage(soil_of(wheel), wheel.radius, wheel.width, wheel.load, jnp.where(fits, slip, 0))
    heavy = jnp.isnan(sinkage) & fits
    for leaf in jax.tree.leaves(wheel):
        heavy = heavy & jnp.isfinite(leaf)
    return replace(wheel, sinkage=jnp.where(fits, sinkage, jnp.nan), load=None, soil=None, slip=None), heavy


@jax.jit
def _most(wheel: Wheel) -> Scalar:
    """The load (N) that the soil carries when the wheel stands in it up to its axle."""
    return wheel_force(soil_of(wheel), wheel.radius, wheel.width, wheel.radius, slip_of(wheel)).load


def half_chord(radius: Number, sinkage: Number) -> Scalar:
    """Half of a wheel's chord at level sand, s = sqrt(h (2 r - h)) (m); at least a thousandth of the radius."""
    r = jnp.asarray(radius)
    return jnp.sqrt(jnp.maximum(sinkage * (2 * r - sinkage), 1e-6 * r * r))


def carried_area(wheel: Wheel, grousers: Grousers) -> Scalar:
    """The volume that grousers carry to behind the wheel per length of travel (m^2)."""
    return jnp.asarray(grousers.spin * wheel.width * grousers.height * grousers.fill)


def extent(tool: Blade | Wheel, heights: Float[Array, "n k"]) -> Scalar:
    """The order of magnitude of the heights (m) that the tool can make, up or down; sets the precision of a push.

    `heights` are those of its lowest point on its way [n, 1], or [n, 0] if it stays at its own depth.
    """
    deep = jnp.abs(lowest(tool))
    if heights.size:
        deep = jnp.maximum(deep, jnp.max(-heights))
    return jnp.maximum(tool.radius, deep) if isinstance(tool, Wheel) else deep


def reach(tool: Blade | Wheel) -> Scalar:
    """The largest distance (m) from the tool's centre to its front, along the direction of travel."""
    if isinstance(tool, Wheel):
        return jnp.hypot(tool.radius, jnp.asarray(tool.width) / 2)
    if tool.yaw is not None:
        return jnp.hypot(tool.thickness, jnp.asarray(tool.width)) / 2
    return jnp.asarray(tool.thickness) / 2 + (0 if tool.plates is None else tool.plates)
