"""The usual scene: where glyphs are judged, policies are trained and benches push, unless they say otherwise."""

from typing import Any

from jaxsand.scene.scene import Scene, make_scene
from jaxsand.scene.tools import Blade

SHAPE, SPACING = (32, 32), 0.01
"""Rows and columns of its map, and the size of a cell (m)."""


def usual_scene(**parts: Any) -> Scene:
    """32 x 32 cells of 0.01 m, 29 degrees, 8 neighbours, the default blade; `parts` as of `make_scene`."""
    return make_scene(SHAPE, SPACING, **{"tool": Blade(), **parts})
