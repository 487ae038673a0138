"""Gradients in many random cases: never NaN or infinite, however extreme; and right wherever the result is smooth."""

from collections import Counter
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxsand as js
from jaxsand.bench.gradient_checks import against_differences
from jaxsand.bench.gradients import CASES

SHAPE = (12, 12)
NAMES = ("height", "stroke", "angle", "spacing", "width", "thickness", "depth", "level")
WEIGHTS = np.random.default_rng(9).standard_normal(SHAPE).astype(np.float32)


@dataclass(frozen=True)
class Kind:
    """What is compiled; all else is drawn."""

    name: str
    neighbours: int | str = 8
    tool: str = "blade"
    draining: bool = False
    window: js.Window | None = None
    push: object = None
    scheme: object = None


KINDS = [
    Kind("blade, 8"),
    Kind("blade, isotropic, draining", "isotropic", draining=True),
    Kind("blade, 8, window", window=js.Window((8, 8))),
    Kind("blade in closed form", push=js.SwathPush(), scheme=js.Relaxation()),
    Kind("wheel", 4, tool="wheel"),
    Kind("wheel in closed form, multilevel", tool="wheel", push=js.SplitPush(), scheme=js.Multilevel()),
    Kind("no tool, pairwise", tool="none", scheme=js.Pairwise()),
]


def gradients(kind):
    """The gradient, by all of NAMES, of a weighted sum of the cells that are finite."""

    def loss(inputs, solid):
        height, stroke, angle, spacing, width, thickness, depth, level = inputs
        tool = {
            "blade": js.Blade(width, thickness, depth),
            "wheel": js.Wheel(2 * thickness, width, thickness * 0.7, angle / 2),
            "none": None,
        }[kind.tool]
        edge = js.Draining(level) if kind.draining else None
        of = {"tool": tool, "walls": js.Walls(solid), "edge": edge, "window": kind.window}
        scene = js.make_scene(SHAPE, spacing, angle, kind.neighbours, **of)
        after = js.step(scene, height, stroke, push=kind.push, scheme=kind.scheme, stop=js.UntilStill(bound=96)).height
        return jnp.sum(jnp.where(jnp.isfinite(after), WEIGHTS * after, 0))

    return jax.jit(jax.vmap(jax.grad(loss)))


def draw(rng, count):
    """Random cases in float32, most of them extreme in something: the inputs, and which cells are solid."""

    def some(*ways):
        """Each case by one of the ways."""
        which = rng.integers(len(ways), size=count)
        return np.choose(which.reshape(-1, *[1] * (np.ndim(ways[0]) - 1)), np.broadcast_arrays(*ways))

    def uniform(low, high, *shape):
        return rng.uniform(low, high, (count, *shape))

    dx = some(np.full(count, 0.01), 10 ** uniform(-9, 9), 10 ** uniform(-3, 0))
    angle = np.radians(some(np.full(count, 0.01), np.full(count, 89.9), uniform(0.01, 89.9), uniform(20, 40)))
    y, x = np.indices(SHAPE)
    size = 10 ** uniform(-4, 4, 1, 1)
    spike = np.zeros((count, *SHAPE))
    spike[np.arange(count), rng.integers(12, size=count), rng.integers(12, size=count)] = 1
    height = size * some(
        np.zeros((count, *SHAPE)),
        uniform(-1, 1, *SHAPE),
        spike,
        -spike,
        1.0 * (x > uniform(0, 12, 1, 1)),
        (-1.0) ** (x + y) + np.zeros((count, 1, 1)),
        np.sin(x * uniform(0, 1, 1, 1) + y * uniform(0, 1, 1, 1)),
        np.tan(angle)[:, None, None] * x / size,  # a slope of repose, on the kink
    )
    height += some(np.zeros(count), np.zeros(count), 10 ** uniform(-2, 3))[:, None, None]
    inside, first = uniform(1, 11, 4), uniform(1, 11, 2)
    length = 10 ** uniform(-9, 0, 2)
    stroke = some(
        inside,
        inside,
        np.round(inside),
        uniform(-6, 18, 4),
        uniform(-1, 1, 4) * 10 ** uniform(1, 4, 1),
        np.concatenate([first, first], 1),
        np.concatenate([first, first + length], 1),
        np.concatenate([first, first + np.array([[5, 0]])], 1),
    )
    depth = some(uniform(-1, 2), uniform(-1, 2), np.full(count, -1e3), np.full(count, 1e3), np.zeros(count))
    bad = (rng.random((count, *SHAPE)) < 0.02) & (rng.random((count, 1, 1)) < 0.3)
    solid = rng.random((count, *SHAPE)) < some(np.zeros(count), np.zeros(count), uniform(0, 1))[:, None, None]
    height = np.where(bad, some(np.nan, np.inf, -np.inf)[:, None, None], height * dx[:, None, None])
    lengths = (uniform(1, 5) * dx, uniform(1, 5) * dx, depth * dx, uniform(-3, 1) * dx)
    inputs = (height, stroke * dx[:, None], angle, dx, *lengths)
    return tuple(np.asarray(v, np.float32) for v in inputs), solid


def check_finite(kind, count, seed):
    """Fails with the numbers of cases by what their gradients are not finite in, and a few of them."""
    wrong, numbers = [], Counter()
    inputs, solid = draw(np.random.default_rng(seed), count)
    found = [np.isfinite(np.asarray(g)).reshape(count, -1).all(1) for g in gradients(kind)(inputs, solid)]
    for i in np.flatnonzero(~np.all(found, 0)):
        by = " ".join(name for name, good in zip(NAMES, found, strict=True) if not good[i])
        case = {name: v[i].tolist() for name, v in zip(NAMES, inputs, strict=True) if v[i].size < 9}
        holes = solid[i].any() or not np.isfinite(inputs[0][i]).all()
        numbers[by, "with holes" if holes else "without"] += 1
        wrong.append(f"case {i}, by {by}: {case}")
    assert not wrong, "\n".join(map(str, [numbers, *wrong[:5]]))


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind.name)
def test_gradients_are_finite_in_extreme_cases(kind):
    check_finite(kind, 150, seed=1)


def check_smooth_points(case, least, most, batch=16):
    """At so many points that are smooth by every input, of at most so many random ones; `against_differences` says what
    that is and how kinks are kept away from."""
    found = tried = 0
    while found < least:
        assert tried < most, f"only {found} of {tried} points are smooth"
        error, smooth = against_differences(case, batch, seed=7 * tried, cells=24)
        assert error[smooth].max() <= 1e-5
        found, tried = found + int(smooth.all(0).sum()), tried + batch


@pytest.mark.slow
@pytest.mark.parametrize("case", CASES[:6], ids=lambda case: case.name)
def test_gradients_are_right_at_smooth_points(case):
    """At a thousand a tool by `jaxsand bench tools --points 1000`."""
    check_smooth_points(case, 5, 160)
