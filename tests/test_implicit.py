"""The implicit derivative of a root: exact in both modes and to second order; a lane without a root
affects no other."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from vsr_jax.numerics.implicit import at_nodes, implicit_root
from vsr_jax.numerics.newton import Root


def square_root(p, other):
    """Root of x^2 - p = 0; there is none for negative p. `other` has no influence."""

    def find(p, other):
        true = jnp.ones_like(p, bool)
        return Root(jnp.sqrt(p), p > 0, true, jnp.ones_like(p, jnp.int32))

    return implicit_root(
        find,
        lambda x, p, other: x**2 - p,
        lambda x, p, other, b: b / (2 * x),
        lambda x, p, other: (jnp.ones_like(x), jnp.ones_like(p), other),
        p,
        other,
    ).x


@pytest.mark.slow
@pytest.mark.parametrize("derivative", [jax.jacfwd, jax.jacrev])
def test_derivatives_of_both_orders_are_exact_in_both_modes(derivative):
    p = jnp.array(3.0)
    np.testing.assert_allclose(derivative(square_root)(p, p), 0.5 / np.sqrt(3), rtol=1e-15)
    second = derivative(derivative(square_root))(p, p)
    np.testing.assert_allclose(second, -0.25 / 3**1.5, rtol=1e-14)


def test_a_parameter_without_influence_has_derivative_zero():
    p = jnp.array(3.0)
    assert float(jax.grad(square_root, argnums=1)(p, p)) == 0


@pytest.mark.slow
def test_lanes_without_a_root_affect_no_other():
    @jax.grad
    def slope(scale, p):
        x = jax.vmap(square_root)(scale * p, p)
        return jnp.sum(jnp.where(p > 0, x, 0.0))

    good, bad = jnp.array([4.0, 9.0]), jnp.array([4.0, -1.0, jnp.nan, 9.0])
    np.testing.assert_allclose(slope(1.0, jnp.nan_to_num(bad, nan=-1.0)), slope(1.0, good))
    each = jax.vmap(jax.grad(square_root), in_axes=(0, None))(bad, 1.0)
    np.testing.assert_allclose(each[jnp.array([0, 3])], [0.25, 1 / 6], rtol=1e-15)
    assert np.all(np.isfinite(each))


@pytest.mark.slow
def test_a_function_of_each_node_has_its_own_derivatives():
    """Against those of the function itself: in both modes, to second order, over a batch, and by an
    argument that is the same for all nodes."""

    def rows(x, scale):
        a, b = x
        return jnp.sin(scale * a) * b, a * b**2

    def total(function, x, scale):
        return jnp.sum(jnp.stack(function(x, scale)) ** 2)

    x = tuple(jax.random.normal(jax.random.key(0), (2, 5, 3, 4)))  # a batch of 5
    scale = jnp.array(0.7)
    for derivative in (jax.jacfwd, jax.jacrev, jax.hessian):
        found, expected = (
            jax.vmap(derivative(partial(total, function), argnums=(0, 1)), (0, None))(x, scale)
            for function in (at_nodes(rows), rows)
        )
        for one, other in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
            np.testing.assert_allclose(one, other, rtol=1e-12, atol=1e-13)
