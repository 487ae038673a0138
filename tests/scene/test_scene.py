"""Bad input to the library: each a ValueError that names the field, the value and the remedy."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxsand as js

SHAPE = (8, 9)
LEVEL = np.zeros(SHAPE, "float32")
SAND = js.make_scene(SHAPE, 0.01, tool=js.Blade())
STROKE = (0.02, 0.02, 0.05, 0.05)


def made(shape=SHAPE, spacing=0.01, *args, **kwargs):
    return lambda: js.make_scene(shape, spacing, *args, **kwargs)


BAD = {
    "one number for a shape": (made(8), "shape: got 8; .*rows, columns"),
    "empty shape": (made((0, 4)), r"shape: got \(0, 4\)"),
    "three dimensions": (made((2, 3, 4)), "shape: "),
    "half a cell": (made((2.5, 3)), "shape: "),
    "negative spacing": (made(spacing=-0.01), "spacing: got -0.01; .*above 0"),
    "zero spacing": (made(spacing=0), "spacing: got 0"),
    "infinite spacing": (made(spacing=np.inf), "spacing: got inf"),
    "no spacing": (made(spacing="fine"), "spacing: got 'fine'"),
    "right angle": (made(SHAPE, 0.01, np.pi / 2), "repose_angle: .*pi/2"),
    "angle in degrees": (made(SHAPE, 0.01, 29), r"repose_angle: got 29.* rad; .*math\.radians\(29\)"),
    "angle of zero": (made(SHAPE, 0.01, 0.0), "repose_angle: got 0.0"),
    "negative angle": (made(SHAPE, 0.01, -0.5), "repose_angle: got -0.5"),
    "angle not finite": (made(SHAPE, 0.01, np.nan), "repose_angle: got nan"),
    "one bad cell angle": (made(SHAPE, 0.01, np.where(np.arange(72).reshape(SHAPE) == 7, 2.0, 0.5)), "repose_angle: got 2.0"),
    "angles of another shape": (made(SHAPE, 0.01, np.full((3, 3), 0.5)), r"repose_angle: got shape \[3, 3\]"),
    "six neighbours": (made(SHAPE, 0.01, 0.5, 6), 'neighbours: got 6; choose 4, 8 or "isotropic"'),
    "walls of another shape": (made(walls=js.Walls(np.zeros((3, 3), bool))), r"walls\.solid: got bool of shape \[3, 3\]"),
    "walls of numbers": (made(walls=js.Walls(np.zeros(SHAPE))), r"walls\.solid: got float64"),
    "walls by name": (made(walls="open"), "walls: got 'open'"),
    "edge by name": (made(edge="closed"), "edge: got 'closed'"),
    "rim at infinity": (made(edge=js.Draining(np.inf)), r"edge\.level: got inf"),
    "window larger than the map": (made(window=js.Window((9, 9))), r"window\.size: got \(9, 9\)"),
    "window of nothing": (made(window=js.Window((0, 4))), r"window\.size: "),
    "negative tolerance": (made(window=js.Window((4, 4), -1.0)), r"window\.tolerance: got -1.0"),
    "tool by name": (made(tool="blade"), "tool: got 'blade'"),
    "blade of no width": (made(tool=js.Blade(width=0)), r"tool\.width: got 0"),
    "blade thinner than a cell": (made(tool=js.Blade(thickness=0.005)), r"tool\.thickness: got 0.005 m, less than a cell"),
    "blade narrower than a cell": (made(tool=js.Blade(width=0.005)), r"tool\.width: got 0.005 m, less than a cell"),
    "blade thicker than the map": (made(tool=js.Blade(thickness=15)), r"tool\.thickness: got 15 m, more than the map's diagonal"),
    "depth not finite": (made(tool=js.Blade(depth=np.nan)), r"tool\.depth: got nan"),
    "a batch to settle": (lambda: js.settle(SAND, np.zeros((3, *SHAPE))), r"height: got shape \[3, 8, 9\].*use jax\.vmap"),
    "another shape": (lambda: js.settle(SAND, np.zeros((9, 8))), r"height: got shape \[9, 8\], the scene has \[8, 9\]"),
    "whole numbers": (lambda: js.settle(SAND, np.zeros(SHAPE, int)), "height: got dtype int64; convert it to float32"),
    "one map to a batch": (lambda: js.settle_batch(SAND, LEVEL), r"height: got shape \[8, 9\]; give a batch"),
    "no map in a batch": (lambda: js.settle_batch(SAND, np.zeros((0, *SHAPE))), r"height: got shape \[0, 8, 9\]"),
    "chunk of none": (lambda: js.settle_batch(SAND, LEVEL[None], chunk=0), "chunk: got 0"),
    "unstable rate": (lambda: js.settle(SAND, LEVEL, scheme=js.Relaxation(0.3)), r"scheme\.rate: got 0.3, unstable above 0.2071"),
    "negative rate": (lambda: js.settle(SAND, LEVEL, scheme=js.Relaxation(-0.1)), r"scheme\.rate: got -0.1"),
    "scheme by name": (lambda: js.settle(SAND, LEVEL, scheme="paper"), "scheme: got 'paper'"),
    "stop by number": (lambda: js.settle(SAND, LEVEL, stop=100), "stop: got 100; give UntilStill"),
    "half a sweep": (lambda: js.settle(SAND, LEVEL, stop=js.Sweeps(0.5)), r"stop\.count: got 0.5"),
    "no bound": (lambda: js.settle(SAND, LEVEL, stop=js.UntilStill(bound=0)), r"stop\.bound: got 0"),
    "tolerance below zero": (lambda: js.settle(SAND, LEVEL, stop=js.UntilStill(-1.0)), r"stop\.tolerance: got -1.0"),
    "a batch of strokes": (lambda: js.step(SAND, LEVEL, np.zeros((5, 4))), r"stroke: got shape \[5, 4\]; use jax\.vmap"),
    "two numbers for a stroke": (lambda: js.step(SAND, LEVEL, (1, 2)), r"stroke: got shape \[2\]; give x0, y0, x1, y1"),
    "one point for a path": (lambda: js.follow(SAND, LEVEL, [(0, 0)]), r"path: got shape \[1, 2\]; give at least two"),
    "a batch of paths": (lambda: js.follow(SAND, LEVEL, np.zeros((2, 3, 2))), r"path: got shape \[2, 3, 2\]; use jax\.vmap"),
    "strokes for one": (lambda: js.rollout(SAND, LEVEL, STROKE), r"strokes: got shape \[4\]; give a row x0, y0, x1, y1 \[n, 4\]"),
    "strokes for another batch": (lambda: js.step_batch(SAND, LEVEL[None], np.zeros((2, 4))), r"stroke: got shape \[2, 4\]; give \[1, 4\]"),
    "unstable push": (lambda: js.step(SAND, LEVEL, STROKE, push=js.SteppedPush(rate=0.3)), r"push\.rate: got 0.3, unstable"),
    "tolerance without end": (lambda: js.settle(SAND, LEVEL, stop=js.UntilStill(np.inf)), r"stop\.tolerance: got inf"),
    "two spacings": (made(spacing=np.ones(2)), r"spacing: got an array of shape \[2\]; it must be one"),
    "blade of many widths": (made(tool=js.Blade(width=np.ones(9))), r"tool\.width: got an array of shape \[9\]"),
    "half a window": (made(window=js.Window((4.5, 4.5))), r"window\.size: got \(4.5, 4.5\)"),
    "endless shape": (made((np.inf, 4)), "shape: got"),
    "many neighbours": (made(SHAPE, 0.01, 0.5, np.array([4, 8])), "neighbours: got"),
    "nearly a right angle": (lambda: js.settle(js.make_scene(SHAPE, 0.01, np.pi / 2 - 1e-9), LEVEL), "repose_angle: got an angle of pi/2 in float32"),
    "words for sand": (lambda: js.settle(SAND, "sand"), "height: got str, no array of numbers"),
    "words for a stroke": (lambda: js.step(SAND, LEVEL, "abcd"), "stroke: got str"),
    "volume of whole numbers": (lambda: js.volume(SAND, np.zeros(SHAPE, int)), "height: got dtype int64"),
    "push by number": (lambda: js.step(SAND, LEVEL, STROKE, push=3), "push: got 3"),
    "sub-step of two cells": (lambda: js.step(SAND, LEVEL, STROKE, push=js.SteppedPush(2.0)), r"push\.substep: got 2.0"),
    "minus one sweep": (lambda: js.step(SAND, LEVEL, STROKE, push=js.SteppedPush(0.5, -1)), r"push\.sweeps: got -1"),
    "boundless numbers for sand": (lambda: js.settle(SAND, 10**400), "height: got int, no array of numbers"),
    "boundless numbers for a stroke": (lambda: js.step(SAND, LEVEL, [10**400, 0, 0, 0]), "stroke: got list, no array of numbers"),
    "a stroke of several lengths": (lambda: js.step(SAND, LEVEL, [[1, 2], [3]]), "stroke: got list, no array"),
    "an array for a tool": (made(tool=np.eye(9)), r"tool: got an array of shape \[9, 9\]; give NoTool"),
    "an array for a window": (made(window=np.eye(9)), r"window: got an array of shape \[9, 9\]"),
    "an array for an edge": (made(edge=np.eye(9)), r"edge: got an array of shape \[9, 9\]"),
    "walls for a floor": (made(base=js.Walls(np.eye(9, dtype=bool))), r"base: got Walls\(solid=array\(.*\.\.\.; give Deep"),
    "spacings of several lengths": (made(spacing=[[1, 2], [3]]), r"spacing: got \[\[1, 2\], \[3\]\]; it must be one"),
    "an array for a push": (lambda: js.step(SAND, LEVEL, STROKE, push=np.eye(9)), r"push: got an array of shape \[9, 9\]"),
    "an array for a stop": (lambda: js.settle(SAND, LEVEL, stop=np.eye(9)), r"stop: got an array of shape \[9, 9\]"),
    "a word for a sub-step": (lambda: js.step(SAND, LEVEL, STROKE, push=js.SteppedPush("x")), "push.substep: got 'x'"),
    "an array for an environment": (lambda: js.make(np.eye(9)), r"name: got an array of shape \[9, 9\]"),
    "boundless seconds for a plan": (lambda: js.plan(np.ones((2, 2), bool), seconds=10**400), "seconds: got 1000.*; give a number above 0"),
    "an array for an engine": (lambda: js.plan(np.ones((2, 2), bool), engine=np.eye(9)), r"engine: got an array"),
    "a start of several lengths": (lambda: js.plan(np.ones((2, 2), bool), [[1, 2], [3]]), r"start: got \[\[1, 2\], \[3\]\]"),
}  # fmt: skip


@pytest.mark.parametrize("name", BAD)
def test_bad_input(name):
    call, message = BAD[name]
    with pytest.raises(ValueError, match=message) as caught:
        call()
    assert "\n" not in str(caught.value)


@pytest.mark.wide
def test_checks_let_traced_values_pass():
    def height(spacing, angle, width):
        return js.settle(js.make_scene(SHAPE, spacing, angle, tool=js.Blade(width)), LEVEL).height.sum()

    jax.jit(height)(0.01, 0.5, 0.02)
    jax.grad(height, (0, 1, 2))(0.01, 0.5, 0.02)
    jax.vmap(height)(jnp.ones(2) * 0.01, jnp.ones(2) * 0.5, jnp.ones(2) * 0.02)


def test_a_scene_may_be_batched_by_its_leaves():
    many = jax.vmap(lambda a: js.make_scene(SHAPE, 0.01, a))(jnp.array([0.3, 0.5]))
    h = np.random.default_rng(0).uniform(-0.05, 0.05, SHAPE)
    axes = jax.tree.map(lambda leaf: 0, many)
    settled = jax.vmap(js.settle, in_axes=(axes, None))(many, h).height
    assert np.array_equal(settled[1], js.settle(js.make_scene(SHAPE, 0.01, 0.5), h).height)


def test_check_passes_a_clean_result_and_refuses_a_traced_one():
    js.check(js.settle(SAND, LEVEL))
    with pytest.raises(ValueError, match="result: got a traced value"):
        jax.jit(lambda h: js.check(js.settle(SAND, h)))(LEVEL)


def test_presets_and_names():
    assert js.DRY_SAND.repose_angle == pytest.approx(np.radians(29))
    assert sorted(js.__all__) == js.__all__
    for name in js.__all__:
        assert getattr(js, name) is not None
        assert name in dir(js)
    with pytest.raises(AttributeError, match="no attribute 'shovel'"):
        _ = js.shovel
