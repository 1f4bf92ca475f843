"""Values that are computed once: the same values and derivatives, and the compiler does keep
them."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from vsr_jax.numerics.once import once
from vsr_jax.numerics.stacked import total

SHAPES = [(), (3,), (2, 3, 5)]


@pytest.mark.slow
@pytest.mark.parametrize("summed", [False, True])
@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
def test_values_and_derivatives_are_those_without_it(shape, dtype, summed):
    x = jnp.asarray(np.random.default_rng(0).normal(size=shape), dtype)

    def through(x):
        return jnp.sum(jnp.sin(once(x * x, summed=summed)))

    def plain(x):
        return jnp.sum(jnp.sin(x * x))

    for kind in (jax.grad, jax.jacfwd, lambda f: jax.jacfwd(jax.grad(f)), lambda f: f):
        for run in (lambda f: f, jax.jit, lambda f: jax.vmap(f, axis_size=1, in_axes=None)):
            np.testing.assert_allclose(
                run(kind(through))(x), run(kind(plain))(x), rtol=10 * jnp.finfo(dtype).eps
            )
    assert once(x).dtype == dtype


def test_truth_values_stay():
    x = jnp.asarray([True, False, True])
    for run in (once, jax.jit(once), jax.vmap(once)):
        np.testing.assert_array_equal(run(x), x)
    assert once(x).dtype == bool
    assert bool(jax.jit(once)(jnp.asarray(True)))


@pytest.mark.parametrize("axis", [0, 1])
def test_a_batch_in_any_axis(axis):
    x = jnp.arange(6.0).reshape(2, 3)
    np.testing.assert_array_equal(jax.jit(jax.vmap(once, axis, axis))(x), x)


@pytest.mark.parametrize("shape", [(), (1,), (2, 1)])
def test_infinities_stay(shape):
    for value in (jnp.inf, -jnp.inf, jnp.nan):
        x = jnp.full(shape, value)
        np.testing.assert_array_equal(jax.jit(once)(x), x)


def squared(x):
    return total(x[:, :, None] * x[None], 1)


def turned(x):
    return x * x[::-1] + x


def fused(step, keep, x):
    """Number of fused operations in the compiled program of a chain of six steps."""

    def chain(x):
        for _ in range(6):
            x = keep(step(x))
        return x

    return jax.jit(chain).lower(x).compile().as_text().count(" fusion(")


@pytest.mark.skipif(jax.default_backend() != "cpu", reason="only CPUs need it")
@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
@pytest.mark.parametrize(("step", "shape"), [(squared, (3, 3, 48)), (turned, (48,))])
def test_the_compiler_fuses_nothing_across_it(step, shape, dtype):
    """It must be noticed if a newer XLA knows how to remove what `once` puts in."""
    x = jnp.ones(shape, dtype)
    assert fused(step, once, x) == fused(step, partial(once, summed=True), x) == 6
    assert fused(step, lambda x: x, x) < 6
