"""Values that are computed once: the same values and derivatives, and the compiler does keep
them."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from vsr_jax.numerics.once import once
from vsr_jax.numerics.stacked import total

SHAPES = [(), (3,), (2, 3, 5)]


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
def test_values_and_derivatives_are_those_without_it(shape, dtype):
    x = jnp.asarray(np.random.default_rng(0).normal(size=shape), dtype)

    def through(x):
        return jnp.sum(jnp.sin(once(x * x)))

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


def test_infinities_stay():
    x = jnp.asarray([jnp.inf, -jnp.inf, 1.0])
    np.testing.assert_array_equal(jax.jit(once)(x), x)


def fused(keep, products, dtype):
    """Number of fused operations in the compiled program of a chain of products of matrices."""

    def chain(x):
        for _ in range(products):
            x = keep(total(x[:, :, None] * x[None], 1))
        return x

    text = jax.jit(chain).lower(jnp.ones((3, 3, 48), dtype)).compile().as_text()
    return text.count(" fusion(")


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
def test_the_compiler_fuses_nothing_across_it(dtype):
    """It must be noticed if a newer XLA knows how to remove what `once` puts in."""
    assert fused(once, 6, dtype) == 6
    assert fused(lambda x: x, 6, dtype) < 6
