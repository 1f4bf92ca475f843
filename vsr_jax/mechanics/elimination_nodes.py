"""What both eliminations share: inverses of blocks with the signs of their eigenvalues, and the
derivatives of the loads at points."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array

from ..numerics import stacked
from ..numerics.component import Matrix, Tree
from ..numerics.once import once
from ..numerics.quadrature import Grid
from .reaction import Slopes

UNSTABLE_SECTION = 1_000_000
"""Number of negative eigenvalues reported for a section that is unstable by itself: more than
cables can stabilise."""


_ASYMMETRIC = 1.5
"""Part without potential of the stiffness of the arm beyond a section, in units of EI / L, above
which the pivots may miss a pair of negative eigenvalues. Half of the least at which they do: the
stiffness of a bent rod of length L that loses stability passes through infinity; with an imaginary
part in place of a pole it passes through at least pi i / 2, an asymmetry of pi."""


class Definiteness(NamedTuple):
    """What the pivots say of the tangent: the number of its negative eigenvalues, zero where it is
    positive definite and `UNSTABLE_SECTION` where a section is unstable by itself; and whether a
    pair of them may be missed, since loads without a potential make the tangent asymmetric."""

    negative: Array
    doubtful: Array

    def without(self, prevented: Array, conservative: Array | bool) -> "Definiteness":
        """That of a tangent in which so many of the motions with negative eigenvalues are
        prevented. If there are fewer of them, the pivots have missed pairs; if there are more, that
        may be rounding, since a tangent with such motions may be nearly singular.

        Every such motion is a pole of the stiffness beyond a section. Near a pole the errors of the
        quadrature look like a part without potential, which says nothing if the loads are
        `conservative`."""
        negative = self.negative - prevented
        some = prevented > 0
        unlike = some & (negative != 0) & (self.negative < UNSTABLE_SECTION)
        doubtful = jnp.where(some & conservative, unlike, self.doubtful | unlike)
        return Definiteness(jnp.where(negative < 0, negative % 2, negative), doubtful)


def definiteness(negative: Array, local: Array, asymmetry: Array, grid: Grid) -> Definiteness:
    """From the number of negative eigenvalues of the pivots of each cell, whether its section is
    stable by itself, and its `asymmetry_of`."""
    total = jnp.sum(negative, axis=0, dtype=jnp.int32)
    return Definiteness(
        jnp.where(jnp.all(local, axis=0), total, UNSTABLE_SECTION),
        jnp.sum(grid.h, axis=0) * jnp.max(asymmetry, axis=0) > _ASYMMETRIC,
    )


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


def whole(x: Array, shape: tuple[int, ...]) -> Array:
    """An array whose last axes are those of all nodes, (stages, steps, *arms)."""
    return jnp.broadcast_to(x, (*x.shape[: x.ndim - len(shape)], *shape))


def block_of(H: Matrix, first: int, second: int, shape: tuple[int, ...]) -> Array:
    """Block (3, 3, stages, steps, *arms) of a matrix of all nodes, from two indices on."""
    entries = [whole(H[first + i][second + j], shape) for i in range(3) for j in range(3)]
    return jnp.stack(entries).reshape(3, 3, *shape)


def places_of(grid: Grid) -> tuple[Array, Array]:
    """Stage and step of each node, from the base to the tip."""
    stages, steps = grid.X.shape[:2]
    return jnp.tile(jnp.arange(stages), steps), jnp.repeat(jnp.arange(steps), stages)


def at_node(tree: Tree, place: tuple[Array, ...], arms: int) -> Tree:
    """Values (..., *arms) at the stage and the step of a node, of arrays (..., stages, steps,
    *arms) with so many axes of arms; or at a stage of all steps, which take the place of arms.

    A pass takes them from where they are: to bring the nodes into its order first would copy the
    arrays."""

    def own(x: Array) -> Array:
        for index in reversed(place):
            x = lax.dynamic_index_in_dim(x, index, x.ndim - arms - 1, keepdims=False)
        return once(x)

    return jax.tree.map(own, tree)


def jumps(slopes: Slopes, grid: Grid) -> Array | None:
    """Derivatives (6, motion, steps, ...) of the loads at points, each at the end of the step
    before it, and of the chords and contacts; None without any."""
    total = slopes.ends
    for point in slopes.points:
        step = jnp.arange(grid.h.shape[0]).reshape(-1, *(1,) * point.step.ndim) == point.step - 1
        here = step.astype(grid.h.dtype) * point.matrix[:, :, None]
        total = here if total is None else total + here
    return total


def at_last_nodes(jump: Array, stages: int) -> Array:
    """Matrices at the ends of steps (n, m, steps, ...) as those of nodes (n, m, stages, steps,
    ...), of the last of each step."""
    return jnp.pad(jump[:, :, None], [(0, 0), (0, 0), (stages - 1, 0), *[(0, 0)] * (jump.ndim - 2)])


def asymmetry_of(by_rotation: Array, moment: Array | None, compliance: Array) -> Array:
    r"""Part of the stiffness of the arm beyond a cell that has no potential, times the compliance
    of its section per length, 1/m.

    The moment $m(R)$ of a potential changes with a rotation $\theta$ by $\delta m = P \theta$ where
    $P^T - P = \tilde m$, since rotations do not commute.

    **Arguments:** `by_rotation`: P (3, 3, ...); `moment`: m (3, ...).
    """
    a, c = by_rotation, jnp.abs(compliance)
    apart = [a[(k + 2) % 3, (k + 1) % 3] - a[(k + 1) % 3, (k + 2) % 3] for k in range(3)]
    if moment is not None:
        apart = [part + moment[k] for k, part in enumerate(apart)]
    apart = [jnp.abs(part) for part in apart]
    softest = jnp.maximum(jnp.maximum(c[0, 0], c[1, 1]), c[2, 2])
    return softest * jnp.maximum(jnp.maximum(apart[0], apart[1]), apart[2])
