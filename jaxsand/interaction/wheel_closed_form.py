"""A wheel's whole leg in closed form: its cut, and the sand of the cut in a pile on each side.

The closed form's step before the sand flows (wheel_trench.py), as a push: in the way's frame the wheel cuts down to the
lowest its rim comes to, here a parabola as deep as the sinkage h and as wide as the chord 2 s, and what was above stands
beside the cut's edges at w / 2, w = b cos(beta) + 2 s sin(beta), in right triangles at repose of the height sqrt(2 t A),
t = tan(angle of repose) and A the area that their side gets of each section. Sections exchange nothing.

Grousers leave their part in the cut, level, and the pile that the rim pushes has less.

Source: Pavlov & Johnson, ICRA 2019, restated in wheel_trench.py.
"""

import math
from dataclasses import dataclass, replace

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from jaxsand.autodiff.while_loop import Tree
from jaxsand.interaction._displacement import Site, whole
from jaxsand.interaction._path import Pushed, Record, State, along_legs, corners, over_the_map
from jaxsand.interaction._slices import hat, wedge
from jaxsand.interaction.blade_closed_form import ROOM, complete, typical_drop
from jaxsand.scene.footprint import Pose, local
from jaxsand.scene.scene import Scene, deep
from jaxsand.scene.tools import Grousers, NoTool, Wheel, carried_area, half_chord, reach
from jaxsand.scene.window import Whole

_SAMPLES = 8  # of the cut, along each side of a cell
_TEN = math.radians(10)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class SplitPush:
    """A wheel's whole leg at once, in closed form: its cut, and the sand of the cut in two piles beside it.

    The cut is a parabola as deep as the sinkage h; the sand of each section stands beside the cut's edges in right triangles
    at repose, of height sqrt(2 tan(repose_angle) A), A the area that their side gets. For a `Wheel`.

    First order in the spacing. It computes the whole map, whatever the scene's window. Where there is no room for a pile
    (a wall, the map's edge) its sand stays in the cut; nothing drains before the sand settles. The result is continuous and
    piecewise smooth in the stroke, the wheel and the sand, except that the piles jump as the slip angle passes 80 degrees
    (and 10 degrees, if the flanks cut more than the rim there).

    Source:
        Pavlov & Johnson, ICRA 2019; wheel_trench.py restates it.

    Example:
        >>> import jax.numpy as jnp
        >>> import jaxsand as js
        >>> scene = js.make_scene((8, 8), 0.01, tool=js.Wheel(radius=0.03, width=0.02, sinkage=0.005))
        >>> pushed = js.act(scene, jnp.zeros((8, 8)), jnp.array([0.02, 0.04, 0.06, 0.04]), push=js.SplitPush())
        >>> bool(pushed.height[4, 4] < 0)
        True
    """

    def check(self, scene: Scene) -> None:
        """Raises ValueError if the scene's tool is no wheel; see `PushRule`."""
        if not isinstance(scene.tool, NoTool | Wheel):
            raise ValueError(
                f"push: got SplitPush for a {type(scene.tool).__name__}; SplitPush() is for a Wheel, SteppedPush() for both"
            )
        deep(scene, "SplitPush")
        if isinstance(scene.tool, Wheel) and scene.tool.load is not None:
            raise ValueError(
                "push: got SplitPush for a wheel under a load, but it keeps its wheel at one depth; give SteppedPush() or a "
                "sinkage, such as that of js.forces.wheel_sinkage"
            )

    def along(self, scene: Scene, height: jax.Array, path: jax.Array, record: Record | None = None) -> tuple[Pushed, Tree]:
        """Moves the scene's wheel along the path; see `PushRule`."""
        return push_split(scene, height, path, self, record)


def push_split(
    scene: Scene, height: Float[Array, "H W"], path: Float[Array, "n 2"], push: SplitPush, record: Record | None = None
) -> tuple[Pushed, Tree]:
    """Moves the wheel along the legs of `path` [n, 2] (m); see `along_legs`."""
    scene = replace(scene, window=Whole())

    def leg(site: Site, pose: Pose, length: jax.Array, before: Pose | None, state: State) -> State:
        return replace(state, height=_pass(scene, site, pose, length, state.height))

    return along_legs(scene, height, path, 0.125, leg, record)


def _pass(scene: Scene, site: Site, pose: Pose, length: jax.Array, h: jax.Array) -> jax.Array:
    """One leg: takes up the sand of the cut and sets it down in piles beside it, slice by slice along the leg."""
    dx, wheel = site.bed.spacing, site.tool
    _, pose, length = over_the_map(scene, site, pose, length)
    side = jnp.where(wheel.slip_angle < 0, -1, 1)
    s, n = local(pose, site.x, site.y)
    n = n * side  # the flank leads on the positive side
    rim, flank, share, floor = _shares(wheel)
    taken = whole(site, _cut(site, s, n, length, floor, h))
    sand = jnp.where(jnp.isnan(h), 0.0, 1.0).astype(h.dtype)
    mu = typical_drop(site, (taken + 1e-6) * sand) / dx

    # Slices along the way, of a spacing or more each; a cell belongs to two of them, or to one at the map's edge, where
    # slices are as long as others.
    least, most = corners(scene, site, pose)
    far = reach(wheel) + dx
    first, last = jnp.maximum(-far, least), jnp.minimum(length + far, most)
    count = math.ceil(math.hypot(*scene.grid.shape) / 4) + 2
    slices = jnp.arange(count, dtype=h.dtype)
    thick = jnp.maximum(dx, (last - first) / count)
    hats = hat(jnp.clip((s - first) / thick - 0.5, 0, count - 1).reshape(1, -1), slices)
    cut = hats @ taken.ravel()
    put, kept = jnp.zeros_like(h), cut
    for way, amount in ((1, share * cut), (-1, (1 - share) * cut)):
        height = (amount * (dx**2 / thick) / mu * 2) @ hats
        long = jnp.maximum(jnp.where(height > 0, jnp.sqrt(jnp.where(height > 0, height, 1)), 0), dx / 2).reshape(h.shape)
        pile = wedge(way * n - (rim / 2 + flank), long, dx) * sand
        room = hats @ pile.ravel() * (dx / thick)
        placed = amount * jnp.minimum(room / ROOM, 1)
        kept = kept - placed
        put = put + pile * (placed / jnp.where(room > 0, room, 1) * (dx / thick) @ hats).reshape(h.shape)
    stays = (kept / jnp.where(cut > 0, cut, 1)) @ hats
    put = whole(site, put + taken * stays.reshape(h.shape))
    return h - taken + complete(site, taken, put)


def _shares(wheel: Wheel) -> tuple[jax.Array, jax.Array, jax.Array, jax.Array]:
    """The widths of the cut made by the rim and by a flank (m), the share of its sand that goes to the side of the leading
    flank, and the height of its floor (m)."""
    slip = jnp.abs(wheel.slip_angle)
    rim, flank = wheel.width * jnp.cos(slip), half_chord(wheel.radius, wheel.sinkage) * jnp.sin(slip)
    flanks, middle = 4 / 3 * flank * wheel.sinkage, wheel.sinkage * rim
    alike = (slip < _TEN) | (jnp.abs(slip - math.pi / 2) < _TEN) | (flanks <= middle)
    if isinstance(wheel.grousers, Grousers):
        behind = jnp.minimum(carried_area(wheel, wheel.grousers), jnp.where(alike, flanks + middle, middle))
        floor = -_floor(jnp.asarray(wheel.sinkage), middle, flanks, behind)
        middle = middle - behind
    else:
        floor = -jnp.asarray(wheel.sinkage)
    total = flanks + middle
    return rim, flank, jnp.where(alike, 0.5, flanks / jnp.where(total > 0, total, 1)), floor


def _floor(sinkage: jax.Array, middle: jax.Array, flanks: jax.Array, behind: jax.Array) -> jax.Array:
    """The depth (m) of the cut after sand of the cross-section `behind` (m^2) was levelled in it.

    It is sinkage (1 - x^2), middle x^2 + flanks x^3 = behind, by Newton's method, whose last step carries the derivative.
    """

    def newton(_: int, x: jax.Array) -> jax.Array:
        steep = 2 * middle * x + 3 * flanks * x * x
        return x - (middle * x * x + flanks * x**3 - behind) / jnp.where(steep > 0, steep, 1)

    x = newton(0, lax.stop_gradient(lax.fori_loop(0, 30, newton, jnp.ones_like(sinkage))))
    return sinkage * (1 - jnp.where(behind > 0, x, 0) ** 2)


def _cut(site: Site, s: jax.Array, n: jax.Array, length: jax.Array, floor: jax.Array, h: jax.Array) -> jax.Array:
    """The height of sand that the wheel cuts from each cell [H, W] (m): what lies above its lowest pass and the floor."""
    wheel = site.tool
    slip, half, chord = jnp.abs(wheel.slip_angle), jnp.asarray(wheel.width) / 2, half_chord(wheel.radius, wheel.sinkage)
    cos, sin = jnp.cos(slip), jnp.sin(slip)
    least = float(jnp.finfo(h.dtype).eps)
    least_cos, least_sin = jnp.maximum(cos, least), jnp.maximum(sin, least)
    slack = site.bed.spacing / (2 * _SAMPLES) * jnp.maximum(1 - 10 * sin, 0) / least_sin  # for samples at an upright flank

    def sample(k: jax.Array, total: jax.Array) -> jax.Array:
        """Adds what is cut at one point of each cell.

        The wheel passes the point (s, n) at a = u cos - n sin along its plane and c = u sin + n cos along its axle, with
        s - length <= u <= s.
        """
        offset = (jnp.stack([k // _SAMPLES, k % _SAMPLES]) + 0.5) / _SAMPLES - 0.5
        at, off = s + offset[0] * site.bed.spacing, n + offset[1] * site.bed.spacing
        near, far = (-half - off * cos) / least_sin, (half - off * cos) / least_sin
        first, last = jnp.maximum(at - length, near - slack), jnp.minimum(at, far + slack)
        a = jnp.clip(off * sin / least_cos, first, last) * cos - off * sin
        inside = jnp.minimum(at - near, far - (at - length)) * least_sin  # how far, across the wheel; a sample has a width
        share = jnp.clip(0.5 + inside * (_SAMPLES / site.bed.spacing), 0, 1)
        bottom = jnp.maximum(site.bottom * (1 - (a / chord) ** 2), floor)
        return total + share * jnp.where((jnp.abs(a) < chord) & (h > bottom), h - bottom, 0)

    return lax.fori_loop(0, _SAMPLES**2, sample, jnp.zeros_like(h)) / _SAMPLES**2
