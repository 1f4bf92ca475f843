"""What the pivots of an elimination say of the signs of a matrix's eigenvalues."""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from ..numerics import stacked
from ..numerics.quadrature import Grid

UNSTABLE_SECTION = 1_000_000
"""Number of negative eigenvalues reported for a section that is unstable by itself: more than
cables can stabilise."""

_ASYMMETRIC = 1.5
"""Part without potential of the stiffness of the arm beyond a section, in units of EI / L, above
which the pivots may miss a pair of negative eigenvalues. Half of the least at which they do: the
stiffness of a bent rod of length L that loses stability passes through infinity; with an imaginary
part in place of a pole it passes through at least pi i / 2, an asymmetry of pi."""


class Definiteness(NamedTuple):
    """What the pivots say of a matrix: the number of its negative eigenvalues, zero where it is
    positive definite and `UNSTABLE_SECTION` where a section is unstable by itself; and whether a
    pair of them may be missed, since loads without a potential make the matrix asymmetric."""

    negative: Array
    doubtful: Array

    def without(self, prevented: Array, conservative: Array | bool) -> "Definiteness":
        """That of a matrix in which so many of the motions with negative eigenvalues are prevented.
        If there are fewer of them, the pivots have missed pairs; if there are more, that may be
        rounding, since a matrix with such motions may be nearly singular.

        Every such motion is a pole of the stiffness beyond a section. Near a pole the errors of the
        quadrature look like a part without potential, which says nothing if the loads are
        `conservative`."""
        negative = self.negative - prevented
        some = prevented > 0
        unlike = some & (negative != 0) & (self.negative < UNSTABLE_SECTION)
        doubtful = jnp.where(some & conservative, unlike, self.doubtful | unlike)
        return Definiteness(jnp.where(negative < 0, negative % 2, negative), doubtful)


def definiteness(
    negative: Array, asymmetry: Array, grid: Grid, stable: Array | None = None
) -> Definiteness:
    """From the number of negative eigenvalues of the pivots of each cell, its `asymmetry_of`, and
    whether its section is `stable` by itself."""
    total = jnp.sum(negative, axis=0, dtype=jnp.int32)
    if stable is not None:
        total = jnp.where(jnp.all(stable, axis=0), total, UNSTABLE_SECTION)
    length = jnp.sum(grid.h, axis=0)
    return Definiteness(total, length * jnp.max(asymmetry, axis=0) > _ASYMMETRIC)


def asymmetry_of(by_rotation: Array, moment: Array | None, compliance: Array) -> Array:
    r"""Part of the stiffness of the arm beyond a cell that has no potential, times the compliance
    of its section per length, 1/m.

    The moment $m(R)$ of a potential changes with a rotation $\theta$ by $\delta m = P \theta$ where
    $P^T - P = \tilde m$, since rotations do not commute.

    **Arguments:** `by_rotation`: P (3, 3, ...); `moment`: m (3, ...), None where P is that of
    `hinges`, symmetric.
    """
    a, c = by_rotation, jnp.abs(compliance)
    apart = [a[(k + 2) % 3, (k + 1) % 3] - a[(k + 1) % 3, (k + 2) % 3] for k in range(3)]
    if moment is not None:
        apart = [part + moment[k] for k, part in enumerate(apart)]
    apart = [jnp.abs(part) for part in apart]
    softest = jnp.maximum(jnp.maximum(c[0, 0], c[1, 1]), c[2, 2])
    return softest * jnp.maximum(jnp.maximum(apart[0], apart[1]), apart[2])


def factored_block(matrix: Array, places: tuple[int, ...]) -> tuple[Array, Array, Array]:
    """Factors whose product is the inverse of the block of a 3 x 3 matrix at given indices, zero
    elsewhere, and the number of its negative eigenvalues if it is symmetric.

    They are those of an elimination, one pivot after another, so that a nearly rigid spring is one
    large pivot, in whatever direction it acts. In the entries of the inverse and in the determinant
    everything else would be rounding."""
    inside = np.isin(np.arange(3), places)
    if len(places) < 3:
        block = (inside[:, None] & inside).reshape(3, 3, *(1,) * (matrix.ndim - 2))
        matrix = jnp.where(block, matrix, stacked.identity(matrix))
    (a, b, c), (d, e, f), (g, h, i) = ((row[0], row[1], row[2]) for row in matrix)
    second, third = d / a, g / a
    e, f, h, i = e - second * b, f - second * c, h - third * b, i - third * c
    last, by_second, by_third, by_last = h / e, b / a, c / a, f / e
    pivots = jnp.stack([a, e, i - last * f])
    zero, one = jnp.zeros_like(a), jnp.ones_like(a)
    down = [one, zero, zero, -second, one, zero, last * second - third, -last, one]
    up = [one, -by_second, by_last * by_second - by_third, zero, one, -by_last, zero, zero, one]
    down, up = (jnp.stack(x).reshape(matrix.shape) for x in (down, up))
    up = up / pivots
    if len(places) < 3:
        up = jnp.where(inside.reshape(3, 1, *(1,) * a.ndim), up, 0.0)
    return up, down, jnp.sum(~(pivots > 0), axis=0, dtype=jnp.int32)


def inverse_block(matrix: Array, places: tuple[int, ...]) -> tuple[Array, Array]:
    """Inverse of the block of a 3 x 3 matrix at given indices, zero elsewhere, and the number of
    its negative eigenvalues if it is symmetric."""
    if not places:
        return jnp.zeros_like(matrix), jnp.zeros(matrix.shape[2:], jnp.int32)
    up, down, negative = factored_block(matrix, places)
    return stacked.matmul(up, down), negative
