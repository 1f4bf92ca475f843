"""Vectors and small matrices as arrays whose first axes are their components: a vector (3, ...), a
matrix (3, 3, ...), with the arms of a batch in the axes behind.

Where products of matrices follow each other, as in passes along an arm, this takes a fraction of
the operations of separate component arrays (`component`): programs are half as large, compile in
less time, and solve one arm faster, with fewer and larger operations. A batch of arms, in the last
axis, is slower by a third, since XLA fuses less (measured: `benchmarks/bench_compile.py`).
"""

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array

from .once import once
from .small_product import cross as cross, parts, product as product, total as total


def stack(components: tuple[Array, ...], axis: int = 0) -> Array:
    """Array of components that broadcast to one shape."""
    return jnp.stack(jnp.broadcast_arrays(*components), axis)


def rows(x: Array, start: int, end: int) -> Array:
    """Components from `start` to before `end` of the first axis."""
    return lax.slice_in_dim(x, start, end)


def columns(x: Array, start: int, end: int) -> Array:
    """Components from `start` to before `end` of the second axis."""
    return lax.slice_in_dim(x, start, end, axis=1)


def blocks(a: Array, b: Array, below: Array, d: Array) -> Array:
    """Matrix of four blocks, the first two above the others."""
    top, bottom = jnp.concatenate([a, b], axis=1), jnp.concatenate([below, d], axis=1)
    return jnp.concatenate([top, bottom])


def components(x: Array, axis: int = 0) -> tuple[Array, ...]:
    """The components of an axis, the inverse of `stack`."""
    return tuple(lax.squeeze(part, (axis,)) for part in parts(x, axis))


def matmul(a: Array, b: Array) -> Array:
    """Product of the matrices (n, k, ...) and (k, m, ...)."""
    return once(product(a, b))


def matvec(a: Array, v: Array) -> Array:
    """Product of a matrix (n, k, ...) and a vector (k, ...)."""
    return lax.squeeze(product(a, v[:, None]), (1,))


def turned(R: Array, wrench: Array) -> Array:
    """Moment and force of a wrench (6, ...), each rotated by R."""
    return jnp.concatenate([matvec(R, rows(wrench, 0, 3)), matvec(R, rows(wrench, 3, 6))])


def dot(a: Array, b: Array) -> Array:
    """Scalar product of two vectors."""
    return total(a * b, 0)


def affine(a: Array, v: Array) -> Array:
    """Values $A v + B$ of affine functions, with B the last columns of a matrix (n, k + m, ...),
    for v (k, m, ...)."""
    size = len(v)
    return once(product(columns(a, 0, size), v) + columns(a, size, a.shape[1]))


def transpose(a: Array) -> Array:
    """Transposed matrix."""
    return a.swapaxes(0, 1)


def skew(v: Array) -> Array:
    r"""Matrix $\tilde v$ with $\tilde v w = v \times w$."""
    (x, y, z), (a, b, c) = parts(v, 0), parts(-v, 0)
    zero = jnp.zeros_like(x)
    return jnp.concatenate([zero, c, y, z, zero, a, b, x, zero]).reshape(3, 3, *v.shape[1:])


def identity(like: Array) -> Array:
    """The identity, of the precision of a matrix (3, 3, ...) and with as many axes."""
    return jnp.eye(3, dtype=like.dtype).reshape(3, 3, *(1,) * (like.ndim - 2))


def adjugate(a: Array) -> tuple[Array, Array]:
    """Adjugate and determinant of a matrix of three rows; their quotient is the inverse.

    The columns of the adjugate are the vector products of the rows, in cyclic order."""
    first, second, third = parts(transpose(a), 1)
    products = cross(second, third), cross(third, first), cross(first, second)
    found = once(jnp.concatenate(products, axis=1))
    return found, dot(a[0], found[:, 0])


def trace(a: Array) -> Array:
    """Sum of the diagonal."""
    return a[0, 0] + a[1, 1] + a[2, 2]
