"""The cut of a blade read off a scene."""

import math
import re
from dataclasses import replace
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxsand as js
from jaxsand.terramechanics.forces import Cut, blade_force

from .test_forces import AT, CLEAN, run

LAYER = re.compile(r"^\s*(from|import) jaxsand\.(terramechanics\.)?(forces|force_trace)\b", re.MULTILINE)
DX = 0.005
BLADE = js.Blade(width=0.06, thickness=0.015, depth=0.0075)
SCENE = js.make_scene((64, 64), DX, tool=BLADE)


ahead = jax.jit(blade_force)


def same(a, b, rtol=1e-10):
    np.testing.assert_allclose([a.draught, a.lift], [b.draught, b.lift], rtol=rtol)


@pytest.mark.parametrize("angle", [0, 0.3, math.pi / 2, 2.5])
def test_level_sand_is_cut_at_the_blade_depth(angle):
    pose = replace(AT, cos=jnp.cos(angle), sin=jnp.sin(angle))
    same(ahead(SCENE, np.zeros((64, 64)), pose, CLEAN), run(CLEAN, Cut(0.0075, 0.06, sides=2.0)))


def test_heap_is_surcharge_and_trench_is_no_depth():
    heap = run(CLEAN, Cut(0.0075, 0.06, surcharge=0.002 * CLEAN.unit_weight, sides=2.0))
    same(ahead(SCENE, np.full((64, 64), 0.002), AT, CLEAN), heap)
    same(
        ahead(SCENE, np.full((64, 64), 0.052), AT, CLEAN, 0.05),
        run(CLEAN, Cut(0.0575, 0.06, surcharge=0.002 * CLEAN.unit_weight, sides=2.0)),
    )
    same(ahead(SCENE, np.full((64, 64), 0.002), AT, CLEAN, jnp.inf), run(CLEAN, Cut(0.0095, 0.06, sides=2.0)))
    same(ahead(SCENE, np.full((64, 64), -0.003), AT, CLEAN), run(CLEAN, Cut(0.0045, 0.06, sides=2.0)))
    for bare in (
        ahead(SCENE, np.full((64, 64), -0.01), AT, CLEAN),
        ahead(SCENE, np.zeros((64, 64)), replace(AT, x=AT.x + 9), CLEAN),
    ):
        assert bare.draught == 0


def test_only_the_sand_ahead_counts():
    """Columns of the strip: one spacing ahead of the face at x = 0.1675, so all of it in 0.1725 to 0.1775."""
    got = jax.grad(lambda h: ahead(SCENE, h, AT, CLEAN).draught)(jnp.full((64, 64), -0.001))
    rows, columns = np.nonzero(np.asarray(got))
    assert set(columns) == {34, 35}
    assert set(rows) == set(range(26, 38))


def test_pushing_raises_the_force():
    """A heap grows ahead of a pushed blade."""
    scene = js.make_scene((64, 96), DX, tool=BLADE)
    flat = np.zeros((64, 96))
    pushed = js.act(scene, flat, (0.1, 0.16, 0.33, 0.16)).height
    at = replace(AT, x=AT.x + 0.17)
    assert ahead(scene, pushed, at, CLEAN).draught > 1.5 * ahead(scene, flat, at, CLEAN).draught


def test_blade_force_in_batches_of_float32():
    heights = jnp.linspace(-0.004, 0.004, 3, dtype="float32")[:, None, None] + jnp.zeros((1, 64, 64), "float32")
    got = jax.vmap(lambda h: ahead(SCENE, h, AT, CLEAN).draught)(heights)
    assert got.dtype == "float32"
    np.testing.assert_allclose(got, [ahead(SCENE, h, AT, CLEAN).draught for h in heights], rtol=1e-5)
    assert np.all(np.diff(got) > 0)


def test_costs_nothing_when_absent():
    """Nothing in the package imports the layer, but its other name."""
    root = Path(js.__file__).parent
    assert not [p for p in root.rglob("*.py") if p.name != "forces.py" and LAYER.search(p.read_text())]
