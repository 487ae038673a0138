"""Tools over a floor: they clear it, and cut no deeper."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxsand as js

from ..conftest import ANGLE, MU, rough

DX = 0.01
N = 20
LEVEL = np.zeros((N, N))


def on(base, tool, neighbours=8, **options):
    return js.make_scene((N, N), DX, ANGLE, neighbours, base=js.Base(base), tool=tool, **options)


@pytest.mark.wide
def test_a_tray_is_emptied_to_its_floor():
    tray = on(-0.02, js.Bucket(width=0.28, length=0.03, capacity=1.0, depth=0.05))
    out = js.scoop(tray, LEVEL, [[0.04, 0.1], [0.16, 0.1]])
    js.check(out)
    assert np.abs(np.asarray(out.height)[:, 6:14] + 0.02).max() < 1e-9
    assert float(js.load_volume(tray, out.load)) == pytest.approx(0.12 * N * DX * 0.02, rel=1e-9)


@pytest.mark.wide
@pytest.mark.parametrize("neighbours", [8, "isotropic"])
def test_a_blade_clears_a_layer_off_its_floor(neighbours):
    """What a blade as wide as the bed clears, V a unit of width, stands ahead as a triangle upon the layer there."""
    layer, cells = 0.01, 48
    dx = 0.32 / cells
    options = {"tool": js.Blade(1.0, 0.015, 0.05), "window": js.Whole()}
    scene = js.make_scene((6, cells), dx, ANGLE, neighbours, base=js.Base(0.0), **options)
    out = js.act(scene, np.full((6, cells), layer), [0.06, 3 * dx, 0.16, 3 * dx])
    js.check(out)
    row = np.asarray(out.height)[3]
    x, front = (np.arange(cells) + 0.5) * dx, 0.16 + 0.0075
    assert row[int(0.08 / dx) : int(0.145 / dx)].max() < 1e-9
    ahead = np.sum((row - layer)[x > front - dx / 2]) * dx
    assert ahead == pytest.approx(layer * (0.1 + 0.015 / 2), rel=0.03)  # half of what lay under it at first
    heap = layer + np.maximum(np.sqrt(2 * MU * ahead) - MU * (x - front), 0)
    assert np.sum(np.abs(row - heap)[x > front + dx / 2]) * dx < 0.05 * ahead


@pytest.mark.parametrize(
    "tool",
    [
        pytest.param(js.Blade(0.06, 0.015, 0.05), id="blade"),
        pytest.param(js.Blade(0.06, 0.015, 0.05, yaw=0.4), id="at an angle", marks=pytest.mark.wide),
        pytest.param(js.Wheel(0.06, 0.04, 0.03), id="wheel"),
    ],
)
def test_no_tool_cuts_the_floor(tool):
    rock, stroke = rough(4, 0.06) - 0.06, [0.06, 0.07, 0.14, 0.12]
    sand = np.maximum(rough(5, 0.04) - 0.04, rock)
    scene = on(rock, tool)
    still = js.settle(scene, sand).height
    out = js.step(scene, still, stroke)
    js.check(out)
    after = np.asarray(out.height)
    assert np.all(after >= rock)
    assert np.sum(after - still) == pytest.approx(0, abs=1e-13)
    assert np.abs(after - still).max() > 0.01
    assert js.steepest_slope(scene, after) < MU + 1.1e-3
    bare = js.step(scene, rock, stroke)
    assert np.array_equal(bare.height, rock)


@pytest.mark.wide
def test_a_floor_deeper_than_the_tool_changes_nothing():
    far, deep = (js.make_scene((N, N), DX, ANGLE, base=base, tool=js.Blade()) for base in (js.Base(-0.2), None))
    stroke = [0.05, 0.08, 0.13, 0.11]
    assert np.abs(js.step(far, LEVEL, stroke).height - js.step(deep, LEVEL, stroke).height).max() < 1e-10


def random_action(scene, rng, height, load):
    """The map and the load after an action of any kind."""
    kind, path = rng.integers(6), np.column_stack([rng.uniform(0.0, 0.2, (2, 2)), rng.uniform(-0.07, 0.02, 2)])
    stroke, load_scene = path.ravel(), on(scene.base.height, js.Bucket(0.05, 0.04, 1e-4, walls=0.03))
    if kind == 0:
        return js.step(on(scene.base.height, js.Blade(0.06, 0.02)), height, stroke), load
    if kind == 1:
        return js.step(on(scene.base.height, js.Wheel(0.05, 0.03, 0.01)), height, path[:, :2].ravel()), load
    if kind == 2:
        return js.step(on(scene.base.height, js.Blade(0.06, 0.02, yaw=0.5)), height, stroke), load
    if kind == 3:
        out = js.scoop(load_scene, height, path, load)
        return out, out.load
    amount = None if kind == 5 else 0.3 * js.load_volume(load_scene, load)
    out = js.dump(load_scene, height, path[:, :2] if kind == 4 else path[:1, :2], load, amount=amount)
    return out, out.load


FEW, MANY = 24, 10_000


@pytest.mark.wide
@pytest.mark.parametrize(
    ("dtype", "count", "most"),
    [
        ("float32", FEW, 1e-8),
        pytest.param("float32", MANY, 4e-8, marks=[pytest.mark.slow, pytest.mark.long]),
        pytest.param("float64", MANY // 10, 1e-14, marks=[pytest.mark.slow, pytest.mark.long]),
    ],
)
def test_mixed_actions_keep_volume_and_floor(dtype, count, most):
    rock = (rough(4, 0.08) - 0.08).astype(dtype)
    scene = on(rock, js.Bucket(0.05, 0.04, 1e-4, walls=0.03))
    height, load = jnp.asarray(np.maximum(rough(6, 0.05).astype(dtype) - np.float32(0.05), rock)), None
    height = js.settle(scene, height).height
    rng, worth = np.random.default_rng(8), DX**2 * np.sum(np.asarray(height, float) - rock)
    for _ in range(count):
        out, load = random_action(scene, rng, height, load)
        assert int(out.outcome) in (0, int(js.Outcome.NOT_POURED))
        height = out.height
        assert np.all(np.asarray(height) >= rock)
    held = 0.0 if load is None else DX**2 * (float(load.high) + float(load.low))
    now = DX**2 * np.sum(np.asarray(height, float) - rock) + held
    assert abs(now - worth) < most * worth


def test_what_is_removed_is_no_more_than_there_is():
    """Thin cells give all they have, the others the rest in proportion."""
    scene = js.make_scene((4, 4), DX, ANGLE, base=js.Base(0.0))
    thick = np.full((4, 4), 1e-3)
    thick[0] = 2.5e-4
    out = js.remove(scene, thick, np.ones((4, 4)), DX**2 * 7e-3)
    js.check(out)
    assert np.asarray(out.height)[0] == pytest.approx(0, abs=1e-12)
    assert np.asarray(out.height)[1:] == pytest.approx(0.5e-3, rel=1e-9)
    more = js.remove(scene, thick, np.ones((4, 4)), 1.0)
    assert js.Outcome(int(more.outcome)) == js.Outcome.NOT_POURED
    assert np.asarray(more.height) == pytest.approx(0, abs=1e-12)
    assert np.asarray(more.height).min() >= 0


@pytest.mark.wide
def test_a_batch_is_its_strokes():
    rock = rough(4, 0.06) - 0.06
    scene = on(rock, js.Blade(0.06, 0.015, 0.03))
    sand = js.settle(scene, np.maximum(rough(5, 0.04) - 0.04, rock)).height
    strokes = jnp.array([[0.06, 0.07, 0.14, 0.12], [0.12, 0.14, 0.05, 0.05]])
    batch = js.step_batch(scene, jnp.stack([sand, sand]), strokes)
    for k in range(2):
        assert np.abs(batch.height[k] - js.step(scene, sand, strokes[k]).height).max() < 1e-9


@pytest.mark.slow
@pytest.mark.parametrize("neighbours", [8, "isotropic"])
def test_derivatives(neighbours):
    rock = rough(4, 0.06) - 0.06
    weights = np.random.default_rng(1).normal(size=(N, N))
    sand = js.settle(on(rock, None, neighbours), np.maximum(rough(5, 0.04) - 0.04, rock)).height
    hill = np.where(sand > rock + 1e-3, np.outer(np.hanning(N), np.hanning(N)), 0)  # bare floor has a kink

    def of(stroke, lift):
        scene = on(rock + lift * hill, js.Blade(0.06, 0.015, 0.03), neighbours)
        return jnp.sum(weights * js.act(scene, sand, stroke).height)

    at = (jnp.array([0.06, 0.071, 0.14, 0.123]), 0.0)
    by_stroke, by_lift = jax.jit(jax.grad(of, (0, 1)))(*at)
    value, step = jax.jit(of), 1e-8
    for k in range(4):
        ends = [value(at[0].at[k].add(sign * step), 0.0) for sign in (-1, 1)]
        assert float(by_stroke[k]) == pytest.approx(float(ends[1] - ends[0]) / (2 * step), rel=1e-4, abs=1e-4)
    ends = [value(at[0], sign * step) for sign in (-1, 1)]
    assert float(by_lift) == pytest.approx(float(ends[1] - ends[0]) / (2 * step), rel=1e-4, abs=1e-4)


@pytest.mark.parametrize(("push", "tool"), [(js.SwathPush(), js.Blade()), (js.SplitPush(), js.Wheel())])
def test_closed_forms_refuse_floors(push, tool):
    with pytest.raises(ValueError, match="on a Base, which it does not know"):
        js.step(on(-0.1, tool), LEVEL, [0.05, 0.05, 0.1, 0.1], push=push)


@pytest.mark.wide
@pytest.mark.parametrize("neighbours", ["isotropic", pytest.param(8, marks=pytest.mark.slow)])
def test_what_drains_off_a_floor_is_what_the_map_loses(neighbours):
    tray = on(-0.01, js.Blade(0.05, 0.015, 0.03), neighbours, edge=js.Draining(-0.02))
    sand = js.settle(tray, LEVEL).height
    out = js.act(tray, sand, [0.03, 0.1, 0.12, 0.1])
    js.check(out)
    assert float(out.drained) == pytest.approx(DX**2 * float((sand - out.height).sum()), rel=1e-9)
    assert float(out.drained) > 1e-6


@pytest.mark.wide
def test_a_blade_feels_no_floor():
    """Forces are those of the sand that is cut: none on bare floor, and no more than lies upon it."""
    soil, path = js.forces.WONG_DRY_SAND, [[0.05, 0.1], [0.1, 0.1]]
    feel = [
        np.abs(js.forces.follow_forces(on(base, js.Blade(0.06, 0.015, depth)), LEVEL, path, soil, substeps=1)[1].force).max()
        for base, depth in ((0.0, 0.02), (-0.01, 0.05), (-0.2, 0.01))
    ]
    assert feel[0] == 0
    assert feel[1] == pytest.approx(feel[2], rel=0.02)
