"""What it takes to cut soil with a blade: forces that are read off a scene and change nothing in it.

The fundamental equation of earthmoving. A wedge of soil between the blade's face (rake a from the horizontal), the
level surface and a plane failure surface (angle b) slides up; its limit equilibrium gives the force
F = w (g d^2 N_g + c d N_c + c_a d N_ca + q d N_q), and the soil fails at the angle b of least F. Sources: Reece 1964
(doi:10.1243/PIME_CONF_1964_179_134_02), McKyes 1985, "Soil Cutting and Tillage". Sides of the wedge: after Perumpral,
Grisso & Desai 1983, "A soil-tool model based on limit equilibrium analysis", Trans. ASAE 26(4).

The forces are quasi-static. All functions take scalars and work under jit, grad and vmap; traced values are not checked.
"""

import math
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from jaxsand.scene.boundaries import Base
from jaxsand.scene.footprint import Pose, coverage
from jaxsand.scene.grid import centres
from jaxsand.scene.scene import Scene, cast, fit
from jaxsand.scene.soil import TINY, Scalar, Soil, check_number, check_soil
from jaxsand.scene.tools import Blade, square
from jaxsand.scene.validation import concrete, short


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Cut:
    """A cut by a straight blade, as `cut_force` takes it.

    Args:
      depth: of the blade's lower edge below the level surface (m).
      width: of the blade (m).
      rake: angle of the blade's face from the horizontal (rad); pi/2 is upright.
      surcharge: pressure of a heap on the surface (Pa).
      sides: how many upright faces the wedge tears off along: 0 in plane strain (a wide blade), 2 in the open.

    Example:
      >>> import jaxsand as js
      >>> js.forces.Cut(depth=0.02, width=0.1).sides
      0.0
    """

    depth: Scalar
    width: Scalar
    rake: Scalar = math.pi / 2
    surcharge: Scalar = 0.0
    sides: Scalar = 0.0


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class BladeForce:
    """The force of the soil on a blade (N); a steep blade is lifted, a flat one is drawn in.

    Attributes:
      draught: against the blade's travel (N).
      lift: upward (N).

    Example:
      >>> import jaxsand as js
      >>> force = js.forces.cut_force(js.forces.WONG_DRY_SAND, js.forces.Cut(depth=0.02, width=0.1))
      >>> bool(force.draught > force.lift > 0)
      True
    """

    draught: jax.Array
    lift: jax.Array


def wedge_factors(soil: Soil, rake: Scalar, angle: Scalar) -> tuple[jax.Array, jax.Array, jax.Array, jax.Array]:
    """The factors N_g, N_c, N_ca and N_q of the earthmoving equation at a given failure angle.

    N_q = (cot a + cot b) sin(b + phi) / S, N_g = N_q / 2, N_c = cos phi / (sin b S), N_ca = -cos(a + b + phi) / (sin a S),
    with S = sin(a + b + phi + delta), which must be above 0.

    Args:
      soil: gives phi and delta.
      rake: a, of the blade's face from the horizontal (rad).
      angle: b, of the failure surface from the horizontal (rad).

    Returns:
      N_g, N_c, N_ca, N_q (no unit). Differentiable in all arguments.

    Source: McKyes 1985, "Soil Cutting and Tillage", multiplied out.

    Example:
      >>> import math
      >>> import jax.numpy as jnp
      >>> import jaxsand as js
      >>> weight, cohesion, adhesion, surcharge = js.forces.wedge_factors(js.forces.WONG_DRY_SAND, math.pi / 2, 0.5)
      >>> bool(jnp.isclose(weight, surcharge / 2))
      True
    """
    slide = angle + jnp.asarray(soil.friction)
    total = jnp.sin(rake + slide + soil.interface_friction)
    top = (1 / jnp.tan(rake) + 1 / jnp.tan(angle)) * jnp.sin(slide) / total
    cut, held = jnp.cos(soil.friction) / jnp.sin(angle), -jnp.cos(rake + slide) / jnp.sin(rake)
    return top / 2, cut / total, held / total, top


def failure_angle(soil: Soil, cut: Cut) -> jax.Array:
    """The angle b of the failure surface at which the force on the blade is least.

    b lies in (0, pi - a - phi - delta). It is found on six nested grids of 33 angles, each between the neighbours of the
    best angle so far.

    Args:
      soil: the soil's strength.
      cut: the blade and its depth.

    Returns:
      b (rad), or NaN if the interval is empty, so that no wedge can slide. Derivatives treat b as a constant.

    Example:
      >>> import math
      >>> import jaxsand as js
      >>> angle = js.forces.failure_angle(js.forces.WONG_DRY_SAND, js.forces.Cut(depth=0.02, width=0.1))
      >>> round(math.degrees(angle))
      21
    """
    soil, cut = lax.stop_gradient((soil, cut))
    stop = math.pi - (jnp.asarray(cut.rake) + soil.friction + soil.interface_friction)

    def narrow(_: jax.Array, span: jax.Array) -> jax.Array:
        grid = span[0] + (span[1] - span[0]) * jnp.linspace(0, 1, 33, dtype=stop.dtype)
        return lax.dynamic_slice(grid, [jnp.clip(jnp.argmin(_stress(soil, cut, grid)), 1, 31) - 1], [3])[::2]

    low, high = lax.fori_loop(0, 6, narrow, jnp.stack([1e-3 * stop, 0.999 * stop]))
    return jnp.where(stop > 0, (low + high) / 2, jnp.nan)


def cut_force(soil: Soil, cut: Cut) -> BladeForce:
    """The force of the soil on a blade that cuts, by the fundamental equation of earthmoving.

    F = w (g d^2 N_g + c d N_c + c_a d N_ca + q d N_q) acts at the angle a + delta, and the adhesion c_a d w / sin a acts
    along the blade's face; see `wedge_factors` and `failure_angle`.

    Args:
      soil: the soil's strength.
      cut: the blade and its depth.

    Returns:
      A `BladeForce` (N); NaN where no wedge can slide. First derivatives are exact: F is least over b, so dF/dp is the
      partial derivative at fixed b (envelope theorem). Second derivatives are not.

    Raises:
      ValueError: for a value out of range.

    Source: Reece 1964, doi:10.1243/PIME_CONF_1964_179_134_02; McKyes 1985.

    Example:
      >>> import jaxsand as js
      >>> shallow = js.forces.cut_force(js.forces.WONG_DRY_SAND, js.forces.Cut(depth=0.01, width=0.1))
      >>> deep = js.forces.cut_force(js.forces.WONG_DRY_SAND, js.forces.Cut(depth=0.02, width=0.1))
      >>> bool(deep.draught > 2 * shallow.draught)
      True
    """
    check_soil(soil)
    check_number("cut.width", cut.width, TINY, np.inf, "give metres")
    for name in ("depth", "surcharge", "sides"):
        check_number(
            f"cut.{name}", getattr(cut, name), 0, 2 if name == "sides" else np.inf, "give metres below the surface, Pa"
        )
    held = sum(float(a) for a in map(concrete, (soil.friction, soil.interface_friction)) if a is not None)
    check_number("cut.rake", cut.rake, TINY, math.pi - held - 1e-6, "pi less both angles of friction locks the wedge")
    area = jnp.asarray(cut.depth) * cut.width
    force, stuck = area * _stress(soil, cut, failure_angle(soil, cut)), area * soil.adhesion
    out = cut.rake + soil.interface_friction
    return BladeForce(force * jnp.sin(out) + stuck / jnp.tan(cut.rake), stuck - force * jnp.cos(out))


def blade_force(scene: Scene, height: jax.typing.ArrayLike, pose: Pose, soil: Soil, level: Scalar = 0.0) -> BladeForce:
    """The force of the sand on a scene's blade that stands upright at a pose and is about to move ahead.

    It is the `cut_force` of the `cut_ahead`.

    Args:
      scene: its tool must be a `Blade`, whose lower edge lies at height -depth.
      height: [H, W] (m), `height[i, j]` at x = (j + 1/2) dx, y = (i + 1/2) dx.
      pose: where the blade stands (m), and the cosine and sine of its heading.
      soil: the soil's strength.
      level: height (m) of the undisturbed ground, of all cells or [H, W]; `jnp.inf` counts all sand as cut.

    Returns:
      A `BladeForce` (N), 0 off the map. A blade that moves only a heap has no cut and feels nothing. Differentiable in
      height, pose and soil, except at kinks of the depth and of the coverage.

    Raises:
      ValueError: if the scene has no blade, or a value is out of range.

    Example:
      >>> import jax.numpy as jnp
      >>> import jaxsand as js
      >>> scene = js.make_scene((8, 8), 0.01, tool=js.Blade(0.04, 0.02, 0.01))
      >>> pose = js.Pose(0.03, 0.04, 1.0, 0.0)
      >>> force = js.forces.blade_force(scene, jnp.zeros((8, 8)), pose, js.forces.WONG_DRY_SAND)
      >>> bool(force.draught > 0)
      True
    """
    cut = cut_ahead(scene, height, pose, soil, level)
    return cut_force(cast(soil, jnp.result_type(cut.depth)), cut)


def cut_ahead(scene: Scene, height: jax.typing.ArrayLike, pose: Pose, soil: Soil, level: Scalar = 0.0) -> Cut:
    """The cut that a scene's blade, upright at a pose, is about to make.

    The sand is read over the blade's width in a strip one spacing long that begins one spacing ahead of the face, so that
    along the grid no cell is read that the blade covers in part. The mean thickness of the sand in the strip between the
    blade's bottom and `level` is the depth of cut. The sand above both is a heap, whose mean weight is the surcharge. The
    wedge has two sides.

    Args:
      scene: as of `blade_force`.
      height: as of `blade_force`.
      pose: as of `blade_force`.
      soil: gives the unit weight.
      level: as of `blade_force`.

    Returns:
      The `Cut`, of depth 0 off the map.

    Raises:
      ValueError: if the scene has no blade.

    Example:
      >>> import jax.numpy as jnp
      >>> import jaxsand as js
      >>> scene = js.make_scene((8, 8), 0.01, tool=js.Blade(0.04, 0.02, 0.01))
      >>> cut = js.forces.cut_ahead(scene, jnp.zeros((8, 8)), js.Pose(0.03, 0.04, 1.0, 0.0), js.forces.WONG_DRY_SAND)
      >>> round(float(cut.depth), 6)
      0.01
    """
    scene, height = fit(scene, height)
    blade, dx = scene.tool, jnp.asarray(scene.grid.spacing)
    if not isinstance(blade, Blade):
        raise ValueError(f"tool: got {short(blade)}; give the scene a Blade(width, thickness, depth)")
    square(blade)
    soil, pose, level = cast((soil, pose, level), height.dtype)
    ahead = jnp.asarray(blade.thickness) / 2 + 1.5 * dx
    middle = Pose(pose.x + ahead * pose.cos, pose.y + ahead * pose.sin, pose.cos, pose.sin)
    share = coverage(Blade(blade.width, dx), middle, *centres(scene.grid, height.dtype), dx)
    share /= jnp.maximum(jnp.sum(share), TINY)
    bottom = jnp.broadcast_to(-jnp.asarray(blade.depth), height.shape)
    if isinstance(scene.base, Base):  # no tool cuts the floor
        bottom = jnp.maximum(bottom, scene.base.height)
    depth = jnp.sum(share * jnp.maximum(jnp.minimum(height, level) - bottom, 0))
    heap = jnp.sum(share * jnp.maximum(height - jnp.maximum(level, bottom), 0))
    return Cut(depth, blade.width, surcharge=heap * soil.unit_weight, sides=2.0)


def _stress(soil: Soil, cut: Cut, angle: jax.Array) -> jax.Array:
    """The force on the blade over its width and depth, F / (w d) (Pa).

    Each of the wedge's sides, of area A = d^2 (cot a + cot b) / 2, resists sliding with A (c + K_0 (g d / 3 + q) tan phi):
    the mean pressure at rest, with K_0 = 1 - sin phi (Jaky 1944). It acts as cohesion on the failure surface does.
    """
    weight, cohesion, adhesion, surcharge = wedge_factors(soil, cut.rake, angle)
    mean = soil.unit_weight * cut.depth / 3 + cut.surcharge
    shear = soil.cohesion + (1 - jnp.sin(soil.friction)) * mean * jnp.tan(soil.friction)
    area = cut.depth / cut.width * (1 / jnp.tan(cut.rake) + 1 / jnp.tan(angle)) / 2
    plane = soil.unit_weight * cut.depth * weight + soil.adhesion * adhesion + cut.surcharge * surcharge
    return plane + (soil.cohesion + cut.sides * area * shear * jnp.sin(angle)) * cohesion
