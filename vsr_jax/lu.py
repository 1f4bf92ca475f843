r"""Small dense systems, $A = L U$ without pivots, in plain array operations.

For matrices whose leading minors are positive, as those of a stable arm are, no pivots are needed, and the pivots tell whether they
are. Many systems may be solved side by side, and several such solves may stand in one program: LAPACK's batched routines wait for
each other there until nothing moves (jaxlib 0.10.2, two cores).
"""

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float


def factor(matrix: Float[Array, "n n"]) -> Float[Array, "n n"]:
    """Factors of a matrix in one: U on and above the diagonal, L below it without its ones. The diagonal holds the pivots."""
    place = jnp.arange(matrix.shape[0])

    def eliminate(k: Array, A: Array) -> Array:
        row, below = A[k], place > k
        ratio = jnp.where(below, A[:, k] / row[k], 0.0)
        A = A - ratio[:, None] * jnp.where(below, row, 0.0)
        return A.at[:, k].set(jnp.where(below, ratio, A[:, k]))

    return lax.fori_loop(0, place.size, eliminate, matrix)


def substitute(factors: Float[Array, "n n"], right: Float[Array, " n"]) -> Float[Array, " n"]:
    """Solution of $L U x = b$."""
    size = right.size
    place = jnp.arange(size)

    def forward(k: Array, b: Array) -> Array:
        return b - jnp.where(place > k, factors[:, k], 0.0) * b[k]

    def backward(i: Array, b: Array) -> Array:
        k = size - 1 - i
        x = b[k] / factors[k, k]
        return jnp.where(place < k, b - factors[:, k] * x, b).at[k].set(x)

    return lax.fori_loop(0, size, backward, lax.fori_loop(0, size, forward, right))


def inverse(matrix: Float[Array, "n n"]) -> Float[Array, "n n"]:
    """Inverse of a matrix."""
    factors = factor(matrix)
    return jax.vmap(lambda b: substitute(factors, b), out_axes=1)(jnp.eye(matrix.shape[0], dtype=matrix.dtype))


def solve(matrix: Float[Array, "n n"], right: Float[Array, " n"]) -> Float[Array, " n"]:
    """Solution of $A x = b$, with derivatives of any order in both modes."""

    def direct(A: Array, b: Array) -> Array:
        return substitute(factor(A), b)

    return lax.custom_linear_solve(
        lambda x: matrix @ x, right, lambda _, b: direct(matrix, b), transpose_solve=lambda _, b: direct(matrix.T, b)
    )
