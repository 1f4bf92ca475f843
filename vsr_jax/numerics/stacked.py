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

_FEW = 16
"""Number of terms up to which `total` adds them one by one."""


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


def components(x: Array) -> tuple[Array, ...]:
    """The components of the first axis, the inverse of `stack`."""
    return tuple(lax.index_in_dim(x, i, keepdims=False) for i in range(x.shape[0]))


def matmul(a: Array, b: Array) -> Array:
    """Product of the matrices (n, k, ...) and (k, m, ...)."""
    return once(product(a, b))


def product(a: Array, b: Array) -> Array:
    """As `matmul`, to be part of a sum."""
    return total(a[:, :, None] * b[None], 1)


def matvec(a: Array, v: Array) -> Array:
    """Product of a matrix (n, k, ...) and a vector (k, ...)."""
    return total(a * v[None], 1)


def total(x: Array, axis: int) -> Array:
    """Sum over an axis; where it is short term by term, since a reduction is slow in a batch."""
    if x.shape[axis] > _FEW:
        return jnp.sum(x, axis)
    parts = [lax.slice_in_dim(x, i, i + 1, axis=axis) for i in range(x.shape[axis])]
    return lax.squeeze(sum(parts[1:], parts[0]), (axis,))


def turned(R: Array, wrench: Array) -> Array:
    """Moment and force of a wrench (6, ...), each rotated by R."""
    return jnp.concatenate([matvec(R, rows(wrench, 0, 3)), matvec(R, rows(wrench, 3, 6))])


def dot(a: Array, b: Array) -> Array:
    """Scalar product of two vectors."""
    parts = components(a * b)
    return sum(parts[1:], parts[0])


def cross(a: Array, b: Array) -> Array:
    """Vector product of two vectors."""
    (x, y, z), (u, v, w) = ([rows(p, i, i + 1) for i in range(3)] for p in (a, b))
    return jnp.concatenate([y * w - z * v, z * u - x * w, x * v - y * u])


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
    less = -v
    x, y, z = (rows(v, i, i + 1) for i in range(3))
    zero = jnp.zeros_like(x)
    entries = [
        zero, rows(less, 2, 3), y, z, zero, rows(less, 0, 1), rows(less, 1, 2), x, zero
    ]  # fmt: skip
    return jnp.concatenate(entries).reshape(3, 3, *v.shape[1:])


def identity(like: Array) -> Array:
    """The identity, of the precision of a matrix (3, 3, ...) and with as many axes."""
    return jnp.eye(3, dtype=like.dtype).reshape(3, 3, *(1,) * (like.ndim - 2))


def adjugate(a: Array) -> tuple[Array, Array]:
    """Adjugate and determinant of a matrix of three rows; their quotient is the inverse."""
    twice = jnp.concatenate([a, a])
    twice = jnp.concatenate([twice, twice], axis=1)

    def shifted(i: int, j: int) -> Array:
        return columns(rows(twice, i, i + 3), j, j + 3)

    cofactors = once(shifted(1, 1) * shifted(2, 2) - shifted(1, 2) * shifted(2, 1))
    det = [a[0, j] * cofactors[0, j] for j in range(3)]
    return transpose(cofactors), det[0] + det[1] + det[2]


def trace(a: Array) -> Array:
    """Sum of the diagonal."""
    return a[0, 0] + a[1, 1] + a[2, 2]
