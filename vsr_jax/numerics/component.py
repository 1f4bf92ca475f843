"""Vectors and small matrices whose components are separate arrays.

A vector is a tuple of three arrays, a twist or a wrench a tuple of six (angular part first), a
matrix a tuple of rows. All components share one shape: a scalar for a single cross-section,
`(nodes,)` along an arm, with a batch axis in front under `jax.vmap` (the solver of loaded arms puts
its batch last). The kernels are then elementwise arithmetic, which XLA fuses into a few loops. It
cannot fuse small batched `dot_general`, `concatenate` and LAPACK calls, so these are avoided.
"""

from functools import partial
from typing import TypeVar

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array

from ..typing import cast
from . import stacked

Vector = tuple[Array, ...]
Vector3 = tuple[Array, Array, Array]
Wrench = tuple[Array, Array, Array, Array, Array, Array]
Forces = tuple[Array, ...]
Matrix = tuple[Vector, ...]
Tree = TypeVar("Tree")


def single(tree: Tree) -> Tree:
    """The same values in single precision; integers and booleans are unchanged."""
    return cast(tree, jnp.float32)


def split(array: Array) -> Vector:
    """Components of the last axis of `array`."""
    return stacked.components(array, array.ndim - 1)


def join(components: Vector) -> Array:
    """Array whose last axis holds `components`; the inverse of `split`."""
    return jnp.stack(jnp.broadcast_arrays(*components), axis=-1)


def join_matrix(rows: Matrix) -> Array:
    """Array whose last two axes hold the matrix `rows`."""
    return jnp.stack([join(row) for row in rows], axis=-2)


def symmetric(lower: Matrix) -> Matrix:
    """The whole symmetric matrix from its lower triangle."""
    size = len(lower)
    return tuple(tuple(lower[max(i, j)][min(i, j)] for j in range(size)) for i in range(size))


def _alike(a: Array | float, b: Array | float) -> bool:
    """Whether two factors are arrays of one shape and precision.

    `a * b` of JAX then has nothing to convert, but still looks for it, which takes longer than the
    rest of tracing an operation; `lax.mul` does not look.
    """
    return (
        isinstance(a, Array) and isinstance(b, Array) and a.shape == b.shape and a.dtype == b.dtype
    )


def _sum(a: Array, b: Array) -> Array:
    return lax.add(a, b) if _alike(a, b) else a + b


def _difference(a: Array, b: Array) -> Array:
    return lax.sub(a, b) if _alike(a, b) else a - b


def _product(a: Array | float, b: Array) -> Array:
    return lax.mul(a, b) if _alike(a, b) else a * b


def select(condition: Array, a: Tree, b: Tree) -> Tree:
    """`a` where the condition holds and `b` elsewhere, component by component; what is the same in
    both costs no operation."""

    def chosen(x: Array, y: Array) -> Array:
        if x is y and jnp.broadcast_shapes(condition.shape, x.shape) == x.shape:
            return x
        alike = _alike(x, y) and condition.shape == x.shape
        return lax.select(condition, x, y) if alike else jnp.where(condition, x, y)

    return jax.tree.map(chosen, a, b)


def add(a: Tree, b: Tree) -> Tree:
    """Sum $a + b$ of two vectors or two matrices, component by component."""
    return jax.tree.map(_sum, a, b)


def subtract(a: Tree, b: Tree) -> Tree:
    """Difference $a - b$ of two vectors or two matrices, component by component."""
    return jax.tree.map(_difference, a, b)


def multiply(a: Vector, b: Vector) -> Vector:
    """Component-wise product, as of a diagonal matrix and a vector."""
    return tuple(_product(x, y) for x, y in zip(a, b, strict=True))


def scale(s: Array | float, a: Tree) -> Tree:
    """Product $s a$ of a scalar and a vector or a matrix."""
    return jax.tree.map(partial(_product, s), a)


def times(factor: Array | None, a: Tree) -> Tree:
    """`scale`, where None stands for the factor 1 and costs no operation."""
    return a if factor is None else scale(factor, a)


def dot(a: Vector, b: Vector) -> Array:
    """Scalar product $a \\cdot b$."""
    total = _product(a[0], b[0])
    for x, y in zip(a[1:], b[1:], strict=True):
        total = _sum(total, _product(x, y))
    return total


def norm(a: Vector) -> Array:
    """Length $|a|$, with derivative 0 at $a = 0$."""
    square = dot(a, a)
    zero = square == 0
    return jnp.where(zero, 0.0, jnp.sqrt(jnp.where(zero, 1.0, square)))


def cross(a: Vector, b: Vector) -> Vector:
    """Vector product $a \\times b$ of two vectors of three components."""
    return tuple(
        _difference(_product(a[i], b[j]), _product(a[j], b[i])) for i, j in ((1, 2), (2, 0), (0, 1))
    )


def matvec(matrix: Matrix, vector: Vector) -> Vector:
    """Product of a matrix and a vector."""
    return tuple(dot(row, vector) for row in matrix)


def free_components(vector: Vector, free: tuple[int, ...]) -> Vector:
    """Components of the free strains."""
    return tuple(vector[i] for i in free)


def free_block(lower: Matrix, free: tuple[int, ...]) -> Matrix:
    """Lower triangle of the block of the free strains in a symmetric matrix."""
    return tuple(tuple(lower[i][j] for j in free if j <= i) for i in free)


def spread(vector: Vector, free: tuple[int, ...]) -> Vector:
    """Six components from those of the free strains, zero for the locked ones."""
    return tuple(
        vector[free.index(i)] if i in free else jnp.zeros_like(vector[0]) for i in range(6)
    )


def cholesky(lower: Matrix) -> Matrix:
    """Cholesky factor $L$, $A = L L^T$, of a symmetric matrix, unrolled.

    Every entry of $L$ ends in a division or a square root, which XLA does not compute twice;
    factors whose entries end in a product or a sum (an $L D L^T$) are recomputed in each of their
    uses and cost twice as much (measured).

    **Arguments:**
    - `lower`: the lower triangle of $A$: row `i` holds `i + 1` components.

    **Returns:** the lower triangle of $L$; its last row is NaN where $A$ is not positive definite.
    """
    factor: list[list[Array]] = []
    for i, row in enumerate(lower):
        entries: list[Array] = []
        for j in range(i):
            remainder = row[j]
            for k in range(j):
                remainder = _difference(remainder, _product(entries[k], factor[j][k]))
            entries.append(remainder / factor[j][j])
        pivot = row[i]
        for entry in entries:
            pivot = _difference(pivot, _product(entry, entry))
        entries.append(jnp.sqrt(pivot))
        factor.append(entries)
    return tuple(tuple(row) for row in factor)


def cholesky_solve(factor: Matrix, right: Vector) -> Vector:
    """Solution $x$ of $L L^T x = b$ with the factor of `cholesky`."""
    x = list(right)
    size = len(x)
    for i in range(size):
        for j in range(i):
            x[i] = _difference(x[i], _product(factor[i][j], x[j]))
        x[i] = x[i] / factor[i][i]
    for i in reversed(range(size)):
        for j in range(i + 1, size):
            x[i] = _difference(x[i], _product(factor[j][i], x[j]))
        x[i] = x[i] / factor[i][i]
    return tuple(x)
