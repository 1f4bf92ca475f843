"""What both eliminations share: the nodes of an arm one after another, with the blocks of the
tangent of each section, its frame, and the derivatives of the loads there."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from ..numerics import stacked
from ..numerics.component import Matrix, Vector
from ..numerics.quadrature import Grid
from ..numerics.stacked import columns, matmul, rows, transpose
from .reaction import Reaction, Slopes

UNSTABLE_SECTION = 1_000_000
"""Number of negative eigenvalues reported for a section that is unstable by itself: more than
cables can stabilise."""


_ASYMMETRIC = 1.5
"""Part without potential of the stiffness of the arm beyond a section, in units of EI / L, above
which the pivots may miss a pair of negative eigenvalues. Half of the least at which they do: the
stiffness of a bent rod of length L that loses stability passes through infinity; with an imaginary
part in place of a pole it passes through at least pi i / 2, an asymmetry of pi."""


class Node(NamedTuple):
    """What the elimination needs of a node: the blocks of the tangent H (3, 3), the right side
    (6), the axis u, the reaction (6), the rotation (3, 3) and its weight; the derivatives (6,
    motion) of the load density, and of the load at the end of its cell in the world frame, None
    where there are none; the right side (6) of the wrenches at the end of its cell, in the world
    frame, None without one; whether the section is `flexible`, 1 or 0, None without rigid
    pieces."""

    bending: Array
    mixed: Array
    linear: Array
    right: Array
    axis: Array
    wrench: Array
    rotation: Array
    weight: Array
    density: Array | None
    jump: Array | None
    push: Array | None
    flexible: Array | None


class Definiteness(NamedTuple):
    """What the pivots say of the tangent: the number of its negative eigenvalues, zero where it is
    positive definite and `UNSTABLE_SECTION` where a section is unstable by itself; and whether a
    pair of them may be missed, since loads without a potential make the tangent asymmetric."""

    negative: Array
    doubtful: Array


def nodes_of(
    H: Matrix,
    right: Vector,
    xi: Vector,
    along: Reaction,
    slopes: Slopes,
    grid: Grid,
    flexible: Array | None,
    push: Array | None,
) -> Node:
    """The nodes one after another along the arm, in the first axis; see `eliminate_poses`."""
    everything = (*right, *xi, grid.weight, *along.wrench)
    arms = jnp.broadcast_shapes(*(x.shape[2:] for x in everything))

    def listed(x: Array) -> Array:
        """Of an array (stages, steps, ...)."""
        return jnp.broadcast_to(x, (*x.shape[:2], *arms)).swapaxes(0, 1).reshape(-1, *arms)

    def joined(parts: Vector, *shape: int) -> Array:
        return jnp.stack([listed(x) for x in parts], axis=1).reshape(-1, *shape, *arms)

    def moved(x: Array, *shape: int) -> Array:
        """Of an array (components, stages, steps, *arms)."""
        return jnp.moveaxis(x, (2, 1), (0, 1)).reshape(-1, *shape, *x.shape[3:])

    density, jump, rotation = slopes.density, jumps(slopes, grid), along.rotation
    if jump is not None:
        jump = at_last_nodes(jump, grid.X.shape[0])
    if slopes.cells is not None:
        jump = slopes.cells if jump is None else jump + slopes.cells

    def slope(x: Array | None) -> Array | None:
        """Of a matrix (6, motion, stages, steps, *arms)."""
        return None if x is None else moved(x.reshape(-1, *x.shape[2:]), *x.shape[:2])

    return Node(
        joined(sum((row[:3] for row in H[:3]), ()), 3, 3),
        joined(sum((row[3:] for row in H[:3]), ()), 3, 3),
        joined(sum((row[3:] for row in H[3:]), ()), 3, 3),
        joined(right, 6),
        joined(xi[3:], 3),
        moved(along.wrench, 6),
        moved(rotation.reshape(9, *rotation.shape[2:]), 3, 3),
        listed(grid.weight),
        slope(density),
        slope(jump),
        None if push is None else moved(push, 6),
        None if flexible is None else listed(flexible),
    )


def node_components(strain: Array, grid: Grid) -> Vector:
    """Component arrays (stages, steps, *arms) of strains (nodes, 6, *arms)."""
    by_step = strain.reshape(-1, grid.X.shape[0], *strain.shape[1:]).swapaxes(0, 1)
    return tuple(by_step[:, :, i] for i in range(6))


def definiteness(negative: Array, local: Array, asymmetry: Array, grid: Grid) -> Definiteness:
    """From the number of negative eigenvalues of the pivots of each cell, whether its section is
    stable by itself, and its `asymmetry_of`."""
    total = jnp.sum(negative, axis=0, dtype=jnp.int32)
    return Definiteness(
        jnp.where(jnp.all(local, axis=0), total, UNSTABLE_SECTION),
        jnp.sum(grid.h, axis=0) * jnp.max(asymmetry, axis=0) > _ASYMMETRIC,
    )


def seen_from(R: Array, slope: Array) -> Array:
    """A derivative (6, motion, ...) of a wrench by a motion, in a frame with the rotation R."""
    back = transpose(R)
    seen = jnp.concatenate([matmul(back, rows(slope, i, i + 3)) for i in (0, 3)])
    parts = [matmul(columns(seen, i, i + 3), R) for i in range(0, slope.shape[1], 3)]
    return parts[0] if len(parts) == 1 else jnp.concatenate(parts, axis=1)


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


def turns(R: Array) -> Array:
    """Rotation of the next node's section in the frame of each node; the identity for the last."""
    relative = jax.vmap(lambda here, after: matmul(transpose(here), after))(R[:-1], R[1:])
    last = jnp.broadcast_to(stacked.identity(R[0]), R[0].shape)
    return jnp.concatenate([relative, last[None]])


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


def asymmetry_of(by_rotation: Array, moment: Array, compliance: Array) -> Array:
    r"""Part of the stiffness of the arm beyond a cell that has no potential, times the compliance
    of its section per length, 1/m.

    The moment $m(R)$ of a potential changes with a rotation $\theta$ by $\delta m = P \theta$ where
    $P^T - P = \tilde m$, since rotations do not commute.

    **Arguments:** `by_rotation`: P (3, 3, ...); `moment`: m (3, ...).
    """
    a, m, c = by_rotation, moment, jnp.abs(compliance)
    apart = [
        jnp.abs(a[(k + 2) % 3, (k + 1) % 3] - a[(k + 1) % 3, (k + 2) % 3] + m[k]) for k in range(3)
    ]
    softest = jnp.maximum(jnp.maximum(c[0, 0], c[1, 1]), c[2, 2])
    return softest * jnp.maximum(jnp.maximum(apart[0], apart[1]), apart[2])
