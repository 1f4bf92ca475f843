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


def inverse_block(matrix: Array, places: tuple[int, ...]) -> tuple[Array, Array]:
    """Inverse of the block of a 3 x 3 matrix at given indices, zero elsewhere, and the number of
    its negative eigenvalues if it is symmetric: the sign changes of its leading minors."""
    if not places:
        return jnp.zeros_like(matrix), jnp.zeros(matrix.shape[2:], jnp.int32)
    # the cube of the stiffness of a thin arm underflows in single precision
    scale = sum((jnp.abs(matrix[i, i]) for i in places[1:]), jnp.abs(matrix[places[0], places[0]]))
    matrix, inside = matrix / scale, np.isin(np.arange(3), places)
    block = (inside[:, None] & inside).reshape(3, 3, *(1,) * scale.ndim)
    if len(places) < 3:
        matrix = jnp.where(block, matrix, stacked.identity(matrix))
    adjugate, det = stacked.adjugate(matrix)
    first, second, third = matrix[0, 0] > 0, adjugate[2, 2] > 0, det > 0
    changes = (~first, first != second, second != third)
    negative = sum((x.astype(jnp.int32) for x in changes[1:]), changes[0].astype(jnp.int32))
    inverse = adjugate / (det * scale)
    return inverse if len(places) == 3 else jnp.where(block, inverse, 0.0), negative
