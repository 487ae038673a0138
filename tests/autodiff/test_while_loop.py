"""Loops against the same steps written out: values, derivatives however long they are, and what is refused."""

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxsand as js
from jaxsand.autodiff.while_loop import Plain, repeat, repeat_until

from ..conftest import ANGLE


@pytest.mark.wide
@pytest.mark.parametrize("bound", [1, 7, 100])
def test_the_loop_stops_where_told_and_is_differentiated_as_its_steps(bound):
    """x <- p x + sin(x) / 10 until x > 3, against the same steps written out."""

    def body(p, k, x):
        return p * x + jnp.sin(x) / 10 + 0.01 * k

    def looped(p, x):
        return repeat_until(lambda p, k, x: x > 3, Plain(body), bound, p, x)

    p, x = jnp.asarray(1.1), jnp.asarray(0.5)
    end, count = looped(p, x)
    assert int(count) == min(bound, 10)

    def unrolled(p, x):
        for k in range(int(count)):
            x = body(p, k, x)
        return x

    assert float(end) == pytest.approx(float(unrolled(p, x)), rel=1e-14)
    expected = jax.grad(unrolled, (0, 1))(p, x)
    for got in (
        jax.grad(lambda p, x: looped(p, x)[0], (0, 1))(p, x),
        jax.jacfwd(lambda p, x: looped(p, x)[0], (0, 1))(p, x),
    ):
        assert np.allclose(got, expected, rtol=1e-12)
    xs = jnp.array([0.5, 2.9, 3.5])
    assert np.allclose(
        jax.vmap(jax.grad(lambda x: looped(p, x)[0]))(xs), [jax.grad(lambda x: looped(p, x)[0])(v) for v in xs], rtol=1e-12
    )


@pytest.mark.wide
@pytest.mark.parametrize("count", [0, 5, 16, 17, 100, 777])
def test_long_loops_restore_what_the_tape_lost(count):
    """x <- p x (1 - x), where every step's derivative differs, against the same steps in a scan; lanes of unequal length."""

    def body(p, k, x):
        return p * x * (1 - x) + 1e-3 * jnp.sin(1.0 * k)

    def scanned(p, x, n):
        return jax.lax.fori_loop(0, n, lambda k, x: body(p, k, x), x)

    def looped(p, x, n):
        return repeat_until(lambda q, k, x: k >= q[1], Plain(lambda q, k, x: body(q[0], k, x)), 1000, (p, n), x)[0]

    p, x = jnp.asarray(2.9), jnp.array([0.3, 0.4])
    ends = jnp.array([count, count // 2])
    found = jax.jit(jax.vmap(jax.grad(looped, (0, 1)), (None, 0, 0)))(p, x, ends)
    expected = jax.jit(jax.vmap(lambda x, n: jax.jacfwd(scanned, (0, 1))(p, x, n)))(x, ends)
    for a, b in zip(found, expected, strict=True):
        assert np.allclose(a, b, rtol=1e-10, atol=1e-300)


def test_a_counted_loop_is_restored_as_well():
    def looped(p, x):
        return repeat(Plain(lambda p, k, x: p * jnp.sin(x + k)), 60, p, x)

    x = jnp.array([0.3, 0.4])
    found = jax.vmap(jax.grad(looped), (None, 0))(1.1, x)
    assert np.allclose(found, jax.vmap(jax.jacfwd(looped), (None, 0))(1.1, x), rtol=1e-10)


def test_second_derivatives_are_refused():
    scene = js.make_scene((8, 8), 0.01, ANGLE)
    h = jnp.zeros((8, 8)).at[4, 4].set(0.1)

    def f(h, stop):
        return jnp.sum(js.settle(scene, h, stop=stop).height ** 2)

    for stop in (None, js.Sweeps(4)):
        for twice in (jax.hessian, lambda f: jax.jacrev(jax.jacrev(f)), lambda f: jax.jacfwd(jax.jacfwd(f))):
            with pytest.raises(NotImplementedError, match="second derivatives .*are not available"):
                jax.make_jaxpr(twice(lambda h, stop=stop: f(h, stop)))(h)


@pytest.mark.parametrize(
    ("axes", "of"),
    [(0, jax.grad), (1, lambda f: jax.vmap(jax.grad(f))), (2, lambda f: jax.vmap(jax.vmap(jax.jacfwd(f))))],
)
def test_the_steps_of_a_loop_in_a_loop_are_traced_a_few_times(axes, of):
    """Traced anew wherever derivatives and batches ask, they were traced 21, 97 and 313 times."""
    traced = []

    def body(p, k, x):
        traced.append(k)
        return p * jnp.sin(x)

    inner = Plain(body)
    outer = Plain(lambda p, k, x: repeat(inner, 3, p, x))
    jax.jit(of(lambda p, x: jnp.sum(repeat(outer, 4, p, x)))).trace(*2 * [jnp.ones((2,) * axes)])
    assert 0 < len(traced) <= 10


def test_a_step_that_cannot_be_hashed_is_refused():
    @dataclass
    class Changing:
        factor: float

        def __call__(self, p, k, x):
            return self.factor * x

    with pytest.raises(ValueError, match="Non-hashable"):
        repeat(Plain(Changing(2.0)), 3, 1.0, jnp.ones(()))


def test_what_was_traced_for_a_step_serves_an_equal_one_and_no_other():
    traced = []

    @dataclass(frozen=True)
    class Times:
        factor: float

        def __call__(self, p, k, x):
            traced.append(self.factor)
            return self.factor * x

    ends = [float(repeat(Plain(Times(factor)), 3, 1.0, jnp.ones(()))) for factor in (2.0, 3.0, 2.0)]
    assert ends == [8, 27, 8]
    assert traced == [2.0, 3.0]
