r"""Small dense systems, $A = L U$, in plain array operations.

A matrix whose leading minors are positive, as for a stable arm, needs no pivoting; the diagonal of
U is positive exactly then. One that may be singular is solved with pivots. The last axes may hold a
batch of systems. LAPACK is avoided: two of its batched routines in one program can block each other
(jaxlib 0.10.2, two cores).
"""

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

from .loops import fori_loop


def factor(matrix: Float[Array, "n n *#arms"]) -> Float[Array, "n n *#arms"]:
    """Both factors in one matrix: U on and above the diagonal, L without its unit diagonal below
    it."""
    place = jnp.arange(matrix.shape[0]).reshape(-1, *(1,) * (matrix.ndim - 2))

    def eliminate(k: Array, A: Array) -> Array:
        row, below = A[k], place > k
        ratio = jnp.where(below, A[:, k] / row[k], 0.0)
        A = A - ratio[:, None] * jnp.where(below, row, 0.0)
        return A.at[:, k].set(jnp.where(below, ratio, A[:, k]))

    return fori_loop(0, matrix.shape[0], eliminate, matrix)


def diagonal(factors: Float[Array, "n n *#arms"]) -> Float[Array, "n *#arms"]:
    """Diagonal of U: all positive if and only if all leading minors of the matrix are."""
    return jnp.diagonal(factors, axis1=0, axis2=1).transpose(
        factors.ndim - 2, *range(factors.ndim - 2)
    )


def substitute(
    factors: Float[Array, "n n *#arms"], right: Float[Array, "n *#arms"]
) -> Float[Array, "n *#arms"]:
    """Solution of $L U x = b$."""
    size = right.shape[0]
    place = jnp.arange(size).reshape(-1, *(1,) * (right.ndim - 1))

    def forward(k: Array, b: Array) -> Array:
        return b - jnp.where(place > k, factors[:, k], 0.0) * b[k]

    def backward(i: Array, b: Array) -> Array:
        k = size - 1 - i
        x = b[k] / factors[k, k]
        return jnp.where(place < k, b - factors[:, k] * x, b).at[k].set(x)

    return fori_loop(0, size, backward, fori_loop(0, size, forward, right))


def solve(
    matrix: Float[Array, "n n *#arms"], right: Float[Array, "n *#arms"]
) -> Float[Array, "n *#arms"]:
    """Solution of $A x = b$, with derivatives of any order in both modes."""

    def product(x: Array) -> Array:
        return jnp.sum(matrix * x, axis=1)

    def transposed(_: object, b: Array) -> Array:
        return substitute(factor(matrix.swapaxes(0, 1)), b)

    return lax.custom_linear_solve(
        product, right, lambda _, b: substitute(factor(matrix), b), transposed
    )


def solve_with_pivots(
    matrix: Float[Array, "n n *#arms"], right: Float[Array, "n *#arms"], rounding: float
) -> tuple[Float[Array, "n *#arms"], Bool[Array, "n *#arms"]]:
    """Solution of $A x = b$ and which rows have negative pivots, those of the diagonal with the
    greatest first. Where only unknowns are left whose pivots are rounding, they are zero.

    **Arguments:** `rounding`: size of a pivot that is rounding where it was 1 at first or less,
    and in proportion where it was greater.
    """
    place = jnp.arange(len(right)).reshape(-1, *(1,) * (right.ndim - 1))
    least = rounding * jnp.maximum(jnp.abs(diagonal(matrix)), 1.0)

    def eliminate(_: object, state: tuple[Array, ...]) -> tuple[Array, ...]:
        A, b, left, negative = state
        pivots = diagonal(A)
        beyond = jnp.where(left, jnp.abs(pivots) - least, -jnp.inf)
        chosen = place == jnp.argmax(beyond, axis=0)
        sound = jnp.max(beyond, axis=0) > 0
        chosen &= sound
        pivot = jnp.where(sound, jnp.sum(jnp.where(chosen, pivots, 0.0), axis=0), 1.0)
        row = jnp.sum(jnp.where(chosen[:, None], A, 0.0), axis=0) / pivot
        value = jnp.sum(jnp.where(chosen, b, 0.0), axis=0) / pivot
        column = jnp.sum(jnp.where(chosen, A, 0.0), axis=1)
        A = jnp.where(chosen[:, None], row, A - column[:, None] * row)
        b = jnp.where(chosen, value, b - column * value)
        return A, b, left & ~chosen, negative | (chosen & (pivot < 0))

    none = jnp.zeros_like(right, bool)
    start = matrix, right, ~none, none
    _, x, left, negative = fori_loop(0, len(right), eliminate, start)
    return jnp.where(left, 0.0, x), negative
