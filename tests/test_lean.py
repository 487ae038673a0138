"""A scene compiles only what it needs, and once."""

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxsand as js

pytestmark = pytest.mark.usefixtures("both_ways")

SHAPE = (64, 64)


def flops(scene, stop=js.Sweeps(1), dtype="float32"):
    program = jax.jit(lambda h: js.settle(scene, h, stop=stop).height).lower(jnp.zeros(scene.grid.shape, dtype)).compile()
    return program.cost_analysis()["flops"]


def size(scene):
    return len(
        jax.jit(lambda h: js.step(scene, h, jnp.zeros(4, "float32")).height).lower(jnp.zeros(SHAPE, "float32")).as_text()
    )


def test_what_is_left_out_costs_nothing():
    plain = flops(js.make_scene(SHAPE, 0.01, neighbours=4))
    assert flops(js.make_scene(SHAPE, 0.01)) > 1.7 * plain
    assert flops(js.make_scene(SHAPE, 0.01, np.full(SHAPE, 0.5), neighbours=4)) > 1.1 * plain
    assert flops(js.make_scene(SHAPE, 0.01, neighbours=4, edge=js.Draining())) > 1.1 * plain


def test_a_scene_without_a_tool_or_window_holds_no_code_for_them():
    bare = size(js.make_scene(SHAPE, 0.01))
    blade = size(js.make_scene(SHAPE, 0.01, tool=js.Blade(), window=js.Whole()))
    window = size(js.make_scene(SHAPE, 0.01, tool=js.Blade(), window=js.Window((16, 16))))
    assert blade > 3 * bare
    assert window > blade


@pytest.mark.wide
def test_a_window_costs_its_share_of_a_sub_step():
    """XLA counts a loop's body once, so the flops of a push are those of lowering and one sub-step."""

    def push(window):
        scene = js.make_scene((128, 128), 0.01, tool=js.Blade(), window=window)
        program = jax.jit(lambda h: js.act(scene, h, jnp.zeros(4, "float32")).height)
        return program.lower(jnp.zeros((128, 128), "float32")).compile().cost_analysis()["flops"]

    assert push(js.Window((16, 16))) < 0.2 * push(js.Whole())


def test_six_calls_of_two_kinds_and_three_angles_trace_twice():
    @jax.jit
    @chex.assert_max_traces(n=2)
    def run(scene, h):
        return js.settle(scene, h, stop=js.Sweeps(2)).height

    chex.clear_trace_counter()
    h = jnp.zeros((8, 8), "float32")
    for angle in (0.3, np.float32(0.4), jnp.float32(0.5)):
        for neighbours in (4, 8):
            run(jax.tree.map(lambda x: jnp.asarray(x, "float32"), js.make_scene((8, 8), 0.01, angle, neighbours)), h)


@pytest.mark.wide
def test_public_functions_trace_once_whatever_kind_of_number_is_given():
    from jaxsand.interaction import simulate as sim
    from jaxsand.relaxation import settling

    for module, name in ((settling, "_settle"), (sim, "_follow")):
        getattr(module, name).clear_cache()
    h = np.zeros((9, 9), "float32")
    for spacing, angle, depth in (
        (0.01, 0.5, 0.003),
        (np.float32(0.02), np.float64(0.4), 0.002),
        (jnp.float32(0.01), 0.3, 1e-3),
    ):
        scene = js.make_scene((9, 9), spacing, angle, tool=js.Blade(0.03, 0.02, depth))
        js.settle(scene, h)
        js.step(scene, h, [0.02, 0.02, 0.05, 0.05])
        js.step(scene, h, np.array([0.02, 0.02, 0.05, 0.06]))
    assert settling._settle._cache_size() == 1
    assert sim._follow._cache_size() == 1
