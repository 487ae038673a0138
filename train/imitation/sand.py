"""The sand that learners practise on: level or rough, with the default blade or another one."""

import math

import numpy as np

from jaxsand.goals.surfaces import rough_surface
from jaxsand.goals.usual import SHAPE, SPACING
from jaxsand.relaxation.settling import settle_batch
from jaxsand.scene.scene import Scene, make_scene
from jaxsand.scene.tools import Blade

_RELIEF = 0.015  # m, at most
_FEATURES = (1.0, 6.0)  # cells


def other_scene(rng: np.random.Generator) -> Scene:
    """The usual scene with another blade (15 to 32 mm wide, 4.5 to 11 mm deep) and angle of repose (23 to 36 degrees)."""
    blade = Blade(width=rng.uniform(0.015, 0.032), thickness=0.015, depth=rng.uniform(0.0045, 0.011))
    return make_scene(SHAPE, SPACING, repose_angle=math.radians(rng.uniform(23, 36)), tool=blade)


def starts(scene: Scene, rng: np.random.Generator, count: int, rough: float) -> np.ndarray:
    """Maps [P, H, W] (m) at rest.

    About a share `rough` of them has smoothed noise with a range of up to 15 mm; the others are level.
    """
    maps = np.zeros((count, *scene.grid.shape), np.float32)
    some = rng.random(count) < rough
    if not some.any():
        return maps
    drawn = [(rng.uniform(0, _RELIEF), np.exp(rng.uniform(*np.log(_FEATURES)))) for _ in maps[some]]
    surface = np.stack([rough_surface(rng, scene.grid.shape, relief, scale) for relief, scale in drawn])
    maps[some] = np.asarray(settle_batch(scene, surface.astype(np.float32)).height)
    return maps
