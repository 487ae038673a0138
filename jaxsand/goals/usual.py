"""The usual scene: where glyphs are judged, policies are trained and benches push, unless they say otherwise."""

from jax.typing import ArrayLike
from jaxtyping import Float

from jaxsand.scene.material import DRY_SAND
from jaxsand.scene.scene import Scene, make_scene
from jaxsand.scene.tools import Blade, Tool
from jaxsand.scene.window import AsNeeded, Whole, Window

SHAPE, SPACING = (32, 32), 0.01
"""Rows and columns of its map, and the size of a cell (m)."""


def usual_scene(
    repose_angle: Float[ArrayLike, ""] | Float[ArrayLike, "H W"] = DRY_SAND.repose_angle,
    *,
    tool: Tool | None = None,
    window: AsNeeded | Whole | Window | None = None,
) -> Scene:
    """32 x 32 cells of 0.01 m, 29 degrees, 8 neighbours, and the default blade unless another tool is given."""
    return make_scene(SHAPE, SPACING, repose_angle, tool=Blade() if tool is None else tool, window=window)
