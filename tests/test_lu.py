"""Small dense systems, against NumPy."""

import jax
import jax.numpy as jnp
import numpy as np

from vsr_jax.numerics import lu


def systems(size=7, arms=3):
    """Matrices with a positive definite symmetric part and right sides, side by side in the last
    axis."""
    random = np.random.default_rng(0)
    square = random.normal(size=(arms, size, size))
    skew = square - square.swapaxes(1, 2)
    matrices = square @ square.swapaxes(1, 2) + 0.5 * np.eye(size) + skew
    return np.moveaxis(matrices, 0, -1), random.normal(size=(size, arms))


def test_solutions_are_those_of_numpy():
    matrices, right = systems()
    expected = np.linalg.solve(np.moveaxis(matrices, -1, 0), right.T[..., None])[..., 0].T
    found = lu.substitute(lu.factor(jnp.asarray(matrices)), jnp.asarray(right))
    np.testing.assert_allclose(found, expected, rtol=1e-11)
    np.testing.assert_allclose(
        lu.solve(jnp.asarray(matrices), jnp.asarray(right)), expected, rtol=1e-11
    )


def test_the_diagonal_holds_the_ratios_of_leading_minors():
    matrices, _ = systems()
    matrices[3, 3] -= 20.0
    minors = np.stack(
        [[np.linalg.det(matrices[:k, :k, arm]) for arm in range(3)] for k in range(8)]
    )
    np.testing.assert_allclose(
        lu.diagonal(lu.factor(jnp.asarray(matrices))), minors[1:] / minors[:-1], rtol=1e-9
    )
    assert np.any(minors < 0)


def test_derivatives_of_any_order_in_both_modes():
    matrices, right = (jnp.asarray(x[..., 0]) for x in systems())

    def value(x, solve):
        return jnp.sum(jnp.sin(solve(matrices + jnp.diag(x), right * (1 + x))))

    at = jnp.linspace(0.1, 0.7, 7)
    for derivative in (jax.jacfwd, jax.jacrev, jax.hessian):
        np.testing.assert_allclose(
            jax.jit(derivative(value), static_argnums=1)(at, lu.solve),
            jax.jit(derivative(value), static_argnums=1)(at, jnp.linalg.solve),
            rtol=1e-8,
            atol=1e-10,
        )


def test_systems_that_may_be_singular():
    """Of rank 4 and 2 of 6, neither of them definite, and of full rank; one unknown of three orders
    of magnitude more than the others."""
    random = np.random.default_rng(1)
    factors = random.normal(size=(3, 6, 6))
    factors[:, :, 0] *= 1e3
    signs = np.array([1, -1, 1, -1, 1, 1.0]) * [[1, 1, 1, 1, 0, 0], [1, 1, 0, 0, 0, 0], np.ones(6)]
    matrices = np.einsum("aki,ak,akj->aij", factors, signs, factors)
    right = np.einsum("aij,aj->ai", matrices, random.normal(size=(3, 6)))
    x, negative = jax.jit(lu.solve_with_pivots, static_argnums=2)(
        jnp.moveaxis(matrices, 0, -1), right.T, 1e-11
    )
    left = np.einsum("aij,ja->ai", matrices, x) - right
    np.testing.assert_allclose(left / np.abs(right).max(1, keepdims=True), 0, atol=1e-11)
    np.testing.assert_array_equal(np.sum(negative, axis=0), [2, 1, 2])
    np.testing.assert_array_equal(np.sum(np.asarray(x) == 0, axis=0), [2, 4, 0])
