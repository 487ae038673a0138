"""Forces along a path: a blade as wide as its bed, whose heap is known; wheels; a bucket."""

import math
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import quad

import jaxsand as js
from jaxsand.terramechanics.forces import LETE_SAND, WONG_DRY_SAND, Cut, cut_force, follow_forces, wheel_force, wheel_sinkage

from ..conftest import ANGLE, MU
from .test_forces import CLEAN

DX = 0.005
DEEP, THICK = 0.01, 0.02
BED = (4, 48)
CHANNEL = js.make_scene(BED, DX, ANGLE, tool=js.Blade(0.04, THICK, DEEP), window=js.Whole())
START, WAY = 0.03, 0.1
PATH = np.array([[START, 0.01], [START + WAY, 0.01]])
feel = jax.jit(follow_forces, static_argnames="substeps")


def draught_at(way):
    """The draught after a way, by the exact triangle: V = d (way + thickness / 2) a unit of width stands ahead of the blade at
    repose, and is read one to two spacings ahead of its face."""
    heap = math.sqrt(2 * MU * DEEP * (way + THICK / 2)) - 1.5 * DX * MU
    return float(cut(CLEAN, Cut(DEEP, 0.04, surcharge=heap * CLEAN.unit_weight, sides=2.0)).draught)


cut = jax.jit(cut_force)


@pytest.fixture(scope="module")
def channel():
    return feel(CHANNEL, np.zeros(BED), PATH, CLEAN, substeps=8)


@pytest.mark.wide
def test_the_force_grows_with_the_heap(channel):
    """It is that of the exact triangle once the heap is a few cells long."""
    shaped, trace = channel
    assert int(shaped.outcome) == 0
    draught = -np.asarray(trace.force[:, 0])
    ways = np.cumsum(trace.length)
    np.testing.assert_allclose(ways, np.arange(1, 9) * WAY / 8)
    np.testing.assert_allclose(draught[1:], [draught_at(way) for way in ways[1:]], rtol=0.02)
    assert np.all(np.diff(draught) > 0)
    np.testing.assert_allclose(trace.pose.x, START + ways)
    assert np.abs(trace.force[:, 1]).max() == 0


def test_the_work_is_the_force_times_the_way(channel):
    _, trace = channel
    exact = quad(draught_at, WAY / 8, WAY, epsrel=1e-6)[0]
    assert float(trace.work[1:].sum()) == pytest.approx(exact, rel=0.01)
    np.testing.assert_allclose(trace.power(0.5), np.asarray(trace.work) / (WAY / 8) * 0.5, rtol=1e-12)
    bare = float(cut(CLEAN, Cut(DEEP, 0.04, sides=2.0)).draught)  # before there is a heap
    first = (bare - float(trace.force[0, 0])) / 2 * WAY / 8
    assert float(trace.work[0]) == pytest.approx(first, rel=1e-9)


def test_the_force_acts_a_third_of_the_cut_above_the_bottom(channel):
    """Seen from the middle of the bottom: the draught tips the blade back, its lift forward."""
    _, trace = channel
    force = np.asarray(trace.force)
    expected = np.cross([THICK / 2, 0, DEEP / 3], force)
    np.testing.assert_allclose(trace.moment, expected, rtol=1e-6, atol=1e-12)
    assert np.all(expected[:, 1] < 0)


def test_mirrors_turn_the_force(channel):
    """A push the other way, and one across: the same program, other arrays."""
    _, trace = channel
    back = PATH.copy()
    back[:, 0] = BED[1] * DX - PATH[:, 0]
    _, mirrored = feel(CHANNEL, np.zeros(BED), back, CLEAN, substeps=8)
    np.testing.assert_allclose(mirrored.force, np.asarray(trace.force) * [-1, 1, 1], rtol=1e-5, atol=1e-9)
    np.testing.assert_allclose(mirrored.moment, np.asarray(trace.moment) * [1, -1, 1], rtol=1e-5, atol=1e-9)
    np.testing.assert_allclose(mirrored.work, trace.work, rtol=1e-5)


def test_a_blade_in_the_air_feels_nothing():
    above = replace(CHANNEL, tool=replace(CHANNEL.tool, depth=-0.01))
    _, trace = feel(above, np.zeros(BED), PATH, CLEAN, substeps=8)
    assert float(jnp.abs(trace.force).max()) == 0
    assert float(trace.work.sum()) == 0


# Wheels

SHAPE = (12, 16)
LEVEL = np.zeros(SHAPE)
ROLL = np.array([[0.05, 0.06], [0.09, 0.06], [0.09, 0.08]])
DRIVEN = js.Wheel(radius=0.03, width=0.03, load=5.0, soil=LETE_SAND, slip=0.2)


@jax.jit
def rolling(scene, height, path, soil):
    """The forces alone: without the map, the push is left out of the program."""
    return follow_forces(scene, height, path, soil, substeps=2)[1]


def roll(wheel, path=ROLL, height=LEVEL, soil=None):
    return rolling(js.make_scene(SHAPE, 0.01, ANGLE, tool=wheel), height, np.asarray(path), soil)


@pytest.mark.wide
def test_a_loaded_wheel_pulls_along_its_way():
    trace = roll(DRIVEN)
    sinkage = wheel_sinkage(LETE_SAND, 0.03, 0.03, 5.0, 0.2)
    force = wheel_force(LETE_SAND, 0.03, 0.03, sinkage, 0.2)
    ways = np.array([[1, 0, 0]] * 2 + [[0, 1, 0]] * 2)
    np.testing.assert_allclose(trace.force, np.asarray(force.pull) * ways + [0, 0, 5.0], rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(
        trace.moment, np.asarray(force.torque) * np.array([[0, -1, 0]] * 2 + [[1, 0, 0]] * 2), rtol=1e-9, atol=1e-12
    )
    np.testing.assert_allclose(trace.length, [0.02, 0.02, 0.01, 0.01])
    per_metre = force.torque / (0.03 * 0.8) - force.pull
    np.testing.assert_allclose(trace.work, float(per_metre) * np.asarray(trace.length), rtol=1e-9)
    assert per_metre > force.resistance  # what slips costs more than the rut


@pytest.mark.wide
def test_a_wheel_at_a_height_feels_its_sinkage_in_the_ground_as_found():
    wheel, ground = js.Wheel(radius=0.03, width=0.03), np.full(SHAPE, 0.02)
    path = np.column_stack([ROLL[:2], [0.015, 0.025]])
    trace = roll(wheel, path, ground, soil=CLEAN)
    load = wheel_force(CLEAN, 0.03, 0.03, 0.0, 0.0).load
    np.testing.assert_allclose(trace.force[:, 2], [load, load], atol=1e-12)  # at 0.02 it touches, at 0.025 it does not
    deeper = roll(wheel, path - np.array([0, 0, 0.008]), ground, soil=CLEAN)
    np.testing.assert_allclose(deeper.force[0, 2], wheel_force(CLEAN, 0.03, 0.03, 0.008, 0.0).load, rtol=1e-9)
    off = roll(js.Wheel(radius=0.03, width=0.03), ROLL + np.array([1.0, 0]), ground)
    assert float(jnp.abs(off.force).max()) == 0
    with pytest.raises(ValueError, match="^soil: got one for a wheel under a load"):
        roll(DRIVEN, soil=CLEAN)


def test_a_bucket_feels_its_cut():
    """An edge that takes up all that it cuts has no heap ahead: the force is that of the cut."""
    scene = js.make_scene(BED, DX, ANGLE, tool=js.Bucket(0.04, 0.02, 1.0, depth=DEEP))
    loaded, trace = feel(scene, np.zeros(BED), PATH, CLEAN, substeps=4)
    bare = float(cut(CLEAN, Cut(DEEP, 0.04, sides=2.0)).draught)
    np.testing.assert_allclose(-trace.force[:, 0], bare, rtol=0.02)
    assert float(js.load_volume(scene, loaded.load)) == pytest.approx(WAY * DEEP * 0.02, rel=1e-6)


@pytest.mark.slow
def test_derivatives_of_a_wheels_forces():
    """By the load and the slip; and in a batch."""

    def work(v):
        wheel = js.Wheel(radius=0.03, width=0.03, load=v[0], slip=v[1])
        trace = rolling(js.make_scene(SHAPE, 0.01, ANGLE, tool=wheel), LEVEL, ROLL, None)
        return trace.work.sum() - 0.01 * trace.force[-1, 1]

    v = np.array([5.0, 0.2])
    got, many = jax.jit(jax.grad(work))(v), jax.jit(jax.vmap(work))
    steps = np.diag(1e-5 * v)
    np.testing.assert_allclose(got, (many(v + steps) - many(v - steps)) / (2e-5 * v), rtol=1e-6)


@pytest.mark.parametrize(
    ("tool", "more", "named"),
    [
        (js.Blade(), {"substeps": 0}, "substeps: got 0"),
        (js.Blade(), {"push": js.SwathPush()}, "push: got SwathPush"),
        (js.Blade(), {"load": js.Load(0.0, 0.0)}, "load: got one for a Blade"),
        (None, {}, "scene.tool: got NoTool"),
        (js.Blade(yaw=0.1), {}, "scene.tool.yaw: got 0.1"),
    ],
)
def test_what_makes_no_sense_is_named(tool, more, named):
    with pytest.raises(ValueError, match=f"^{named}"):
        follow_forces(js.make_scene(SHAPE, 0.01, tool=tool), np.zeros(SHAPE), ROLL, **more)


@pytest.mark.slow
def test_work_converges_as_sub_steps_are_refined():
    work = [float(feel(CHANNEL, np.zeros(BED), PATH, CLEAN, substeps=n)[1].work.sum()) for n in (2, 4, 8, 16)]
    changes = np.abs(np.diff(work))
    assert np.all(changes[1:] < 0.7 * changes[:-1])
    assert changes[-1] < 0.02 * work[-1]


@pytest.mark.slow
def test_derivatives_of_the_work():
    def work(depth, unit_weight, height):
        scene = replace(CHANNEL, tool=replace(CHANNEL.tool, depth=depth))
        return follow_forces(scene, height, PATH, replace(CLEAN, unit_weight=unit_weight), substeps=2)[1].work.sum()

    rough = np.random.default_rng(2).uniform(-5e-4, 5e-4, BED)
    at, value = (DEEP, 15e3, jnp.asarray(rough)), jax.jit(work)
    by_depth, by_weight, by_height = jax.jit(jax.grad(work, (0, 1, 2)))(*at)
    for i, (slope, step) in enumerate([(by_depth, 1e-8), (by_weight, 1e-2)]):
        up, down = (value(*(x + sign * step if k == i else x for k, x in enumerate(at))) for sign in (1, -1))
        assert float(slope) == pytest.approx(float(up - down) / (2 * step), rel=1e-5)
    way = np.random.default_rng(3).standard_normal(BED)
    difference = float(value(*at[:2], rough + 1e-9 * way) - value(*at[:2], rough - 1e-9 * way)) / 2e-9
    assert float(jnp.sum(by_height * way)) == pytest.approx(difference, rel=1e-5)
    depths = jnp.array([0.008, 0.01])
    many = jax.jit(jax.vmap(lambda d: work(d, 15e3, at[2])))(depths)
    np.testing.assert_allclose(many, [value(d, *at[1:]) for d in depths], rtol=1e-9)


def test_a_dry_sand_is_the_default_soil():
    wheel = js.Wheel(radius=0.03, width=0.03, sinkage=0.005)
    np.testing.assert_array_equal(roll(wheel).force, roll(wheel, soil=WONG_DRY_SAND).force)
