"""What a scene is made of, at known answers: a tool's own coordinates, tools that are no numbers, sand beside walls."""

import math

import jax.numpy as jnp
import numpy as np
import pytest

import jaxsand as js
from jaxsand.scene.footprint import Pose, local
from jaxsand.scene.tools import usable


def test_across_a_tool_counts_to_its_left():
    angle = math.radians(30)
    pose = Pose(*map(jnp.asarray, (0.1, 0.2, math.cos(angle), math.sin(angle))))
    along, across = local(pose, 0.1 - math.sin(angle), 0.2 + math.cos(angle))
    assert (float(along), float(across)) == pytest.approx((0, 1), abs=1e-12)


@pytest.mark.parametrize("size", ["width", "thickness", "depth"])
def test_a_tool_that_is_not_finite_is_not_usable(size):
    assert usable(js.Blade())
    assert not usable(js.Blade(**{size: math.nan}))


def test_solid_cells_hold_no_volume():
    solid = np.zeros((4, 4), bool)
    solid[1, 2] = True
    height = np.where(solid, 7.0, 0.5)
    scene = js.make_scene((4, 4), 0.1, walls=js.Walls(solid))
    assert float(js.volume(scene, height)) == pytest.approx(15 * 0.5 * 0.01)
