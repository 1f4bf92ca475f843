r"""The tangent of the balance of all cross-sections, solved by block elimination along the arm.

In the frame of each section a change of strain $(\kappa, \upsilon)$ rotates the sections beyond
it, $\theta' = \kappa$, and changes the reaction at a node. With $(m, n)$ the wrench at the node,
$(\delta m, \delta n)$ its change and $u$ the axis,

$$H \, \delta\xi = (\delta m - \theta \times m, \ \delta n - \theta \times n) + b, \quad
-\delta m' = (\theta \times u + \upsilon) \times n + u \times \delta n + \theta \times c, \quad
-\delta n' = \theta \times f,$$

where c and f are follower densities. Each node represents a cell whose length is its weight w,
integrated by the midpoint rule. The linear strains depend on other nodes through the rotations
only, so they are eliminated first, for all nodes at once. A pass from the tip to the base then
keeps the change of the wrench as an affine function of the rotation, $P \theta + p$, and solves a
3 x 3 system per cell; a pass from the base to the tip gives the rotations. The error of the tangent
is of the order of the distance between nodes: as a preconditioner of the exact one it gains one to
two digits per application.
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array

from ..numerics import component as c, stacked
from ..numerics.component import Matrix, Vector
from ..numerics.quadrature import Grid
from ..numerics.stacked import affine, columns, matmul, matvec, once, rows, skew, transpose, turned
from .balance import free_block, free_components, spread
from .reaction import Loading, Reaction

UNSTABLE_SECTION = 1_000_000
"""Number of negative eigenvalues reported for a section that is unstable by itself: more than
cables can stabilise."""


class _Node(NamedTuple):
    """What the elimination needs of a node: the blocks of the tangent H (3, 3), the right side
    (6), the axis u, the reaction (6), the rotation (3, 3) and its weight; the follower density and
    the follower wrench at the end of its cell in the world frame (6), None where there are none."""

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


class EliminationCell(NamedTuple):
    r"""Coefficients of one cell that do not depend on P, in the frame of its section. An affine
    function of the rotation $\theta$ at its start is a matrix with the constant as fourth column.

    - `width` w; `turn`: rotation of the next node's section in this frame.
    - $\kappa = $ `compliance` $\delta m$ + `by_theta` $\theta$, affine, with $\delta m$ the part
      from P at the middle of the cell.
    - Over the cell the moment changes by `moment` $\theta$ (affine) + `by_bend` $\kappa$.
    - With follower loads only, else None: the effect of the change of the force on the strain,
      `by_push`, and on the moment, `stretch`; the `axis` u; `force`, the change of the force over
      half the cell per rotation (None without follower density); `jump`, the follower wrench at the
      end of the cell (None without follower points).
    """

    width: Array
    turn: Array
    compliance: Array
    by_theta: Array
    moment: Array
    by_bend: Array
    by_push: Array | None = None
    stretch: Array | None = None
    axis: Array | None = None
    force: Array | None = None
    jump: Array | None = None


class EliminatedLinear(NamedTuple):
    r"""The eliminated linear strains of a node: `flexibility` $(\delta n$ + `by_theta` $\theta)
    -$ `by_bend` $\kappa$, with $\delta n$ the part of the force from P; `by_theta` is affine."""

    flexibility: Array
    by_theta: Array
    by_bend: Array


def eliminate(
    lower: Matrix,
    right: Vector,
    xi: Vector,
    along: Reaction | None,
    loads: Loading | None,
    grid: Grid,
    free: tuple[int, ...],
) -> tuple[Vector, Array]:
    r"""Solution of the tangent system with the right side $b$ for the free strains, and the number
    of negative eigenvalues of the tangent: zero where it is positive definite, `UNSTABLE_SECTION`
    where a section is unstable by itself.

    **Arguments:** node arrays of shape (stages, steps, *arms).
    - `lower`: lower triangle of $H$.
    - `right`: $b$, six components.
    - `xi`, `along`: the strain where the tangent is taken, and its reaction. Without loads only $H$
      is solved, node by node.

    **Returns:** six components, zero for the locked strains; meaningless where the tangent is not
    definite.
    """
    if along is None or loads is None or min(free) > 2:
        x = c.cholesky_solve(c.cholesky(free_block(lower, free)), free_components(right, free))
        return spread(x, free), jnp.where(
            jnp.any(jnp.isnan(x[-1]), axis=(0, 1)), UNSTABLE_SECTION, 0
        ).astype(jnp.int32)
    nodes = _nodes(c.symmetric(lower), right, xi, along, loads, grid)
    cells, linear, local = jax.vmap(partial(_cell_of, free=free, follows=loads.follows))(
        nodes, _turns(nodes.rotation)
    )
    arms = nodes.weight.shape[1:]
    nothing = jnp.zeros((6 if loads.follows else 3, 4, *arms), cells.width.dtype)
    _, (X, push, negative) = lax.scan(_cell, nothing, cells, reverse=True)

    def forward(theta: Array, cell: tuple) -> tuple[Array, tuple[Array, Array]]:
        X, turn, width = jax.tree.map(once, cell)
        kappa = affine(X, theta)
        return matvec(transpose(turn), theta + width * kappa), (theta, kappa)

    start = jnp.zeros((3, *arms), X.dtype)
    _, (theta, kappa) = lax.scan(forward, start, (X, cells.turn, cells.width))
    strain = jax.vmap(_strain)(linear, cells.width, push, theta, kappa)
    return _components(strain, grid), jnp.where(
        jnp.all(local, axis=0), jnp.sum(negative, axis=0, dtype=jnp.int32), UNSTABLE_SECTION
    )


def _nodes(
    H: Matrix, right: Vector, xi: Vector, along: Reaction, loads: Loading, grid: Grid
) -> _Node:
    """The nodes one after another along the arm, in the first axis."""
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

    density, jump = loads.follower_density, _jumps(along, loads, grid)
    rotation = along.rotation
    return _Node(
        joined(sum((row[:3] for row in H[:3]), ()), 3, 3),
        joined(sum((row[3:] for row in H[:3]), ()), 3, 3),
        joined(sum((row[3:] for row in H[3:]), ()), 3, 3),
        joined(right, 6),
        joined(xi[3:], 3),
        moved(along.wrench, 6),
        moved(rotation.reshape(9, *rotation.shape[2:]), 3, 3),
        listed(grid.weight),
        None if density is None else moved(density, 6),
        None if jump is None else moved(jump, 6),
    )


def _components(strain: Array, grid: Grid) -> Vector:
    """Component arrays (stages, steps, *arms) of strains (nodes, 6, *arms)."""
    by_step = strain.reshape(-1, grid.X.shape[0], *strain.shape[1:]).swapaxes(0, 1)
    return tuple(by_step[:, :, i] for i in range(6))


def _strain(
    linear: EliminatedLinear, width: Array, push: Array | None, theta: Array, kappa: Array
) -> Array:
    """The strain (6,) at a node."""
    force = affine(linear.by_theta, theta)
    if push is not None:
        force = force + affine(push, theta + width * kappa)
    upsilon = matvec(linear.flexibility, force) - matvec(linear.by_bend, kappa)
    return jnp.concatenate([kappa, upsilon])


def _cell_of(
    node: _Node, turn: Array, free: tuple[int, ...], follows: bool
) -> tuple[EliminationCell, EliminatedLinear, Array]:
    """All that does not depend on P, for one node, and whether its section is stable by itself."""
    w = node.weight
    half, n = 0.5 * w, skew(rows(node.wrench, 3, 6))
    moment, by_force, force = _per_rotation(n, skew(node.axis), node.density, half)
    moment = once(half * moment)
    by_theta = moment + skew(rows(node.wrench, 0, 3))
    flexibility, rigid = _inverse(node.linear, tuple(i - 3 for i in free if i > 2))
    mixed = node.mixed + half * n
    D = matmul(mixed, flexibility)
    stiff = node.bending - half * by_theta - matmul(D, transpose(mixed))
    by_bend = transpose(D)
    if force is not None:
        stiff = stiff + matmul(D, half * force)
        by_bend = by_bend - matmul(flexibility, half * force)
    right = node.right[:, None]
    linear = jnp.concatenate([by_force, rows(right, 3, 6)], axis=1)
    drive = jnp.concatenate([by_theta, rows(right, 0, 3)], axis=1) - matmul(D, linear)
    compliance, stable = _inverse(once(stiff), tuple(i for i in free if i < 3))
    lever = -w * n  # moment over the cell per linear strain
    doubled = jnp.concatenate([2.0 * moment, jnp.zeros_like(right[:3])], axis=1)
    cell = EliminationCell(
        w,
        turn,
        compliance,
        matmul(compliance, drive),
        doubled + matmul(lever, matmul(flexibility, linear)),
        w * moment - matmul(lever, by_bend),
    )
    if follows:
        jump = node.jump
        cell = cell._replace(
            by_push=-matmul(compliance, D),
            stretch=matmul(lever, flexibility),
            axis=node.axis,
            force=force,
            jump=None if jump is None else turned(transpose(node.rotation), jump),
        )
    return cell, EliminatedLinear(flexibility, linear, by_bend), rigid & stable


def _per_rotation(
    n: Array, u: Array, density: Array | None, half: Array
) -> tuple[Array, Array, Array | None]:
    """Derivatives by the rotation of a section, without those through P: of the change of the
    moment per length, of the force, and of the change of the force over half a cell, which is None
    without follower density."""
    if density is None:
        return matmul(n, u), n, None
    force = -half * skew(rows(density, 3, 6))
    moment = matmul(n, u) + matmul(u, force) - skew(rows(density, 0, 3))
    return moment, n + force, force


def _inverse(matrix: Array, places: tuple[int, ...]) -> tuple[Array, Array]:
    """Inverse of the block of a 3 x 3 matrix at given indices, zero elsewhere, and whether its
    leading minors are positive."""
    if not places:
        return jnp.zeros_like(matrix), jnp.ones(matrix.shape[2:], bool)
    # the cube of the stiffness of a thin arm underflows in single precision
    scale = sum((jnp.abs(matrix[i, i]) for i in places[1:]), jnp.abs(matrix[places[0], places[0]]))
    matrix, inside = matrix / scale, np.isin(np.arange(3), places)
    block = (inside[:, None] & inside).reshape(3, 3, *(1,) * scale.ndim)
    if len(places) < 3:
        matrix = jnp.where(block, matrix, stacked.identity(matrix))
    adjugate, det = stacked.adjugate(matrix)
    definite = (matrix[0, 0] > 0) & (adjugate[2, 2] > 0) & (det > 0)
    inverse = adjugate / (det * scale)
    return inverse if len(places) == 3 else jnp.where(block, inverse, 0.0), definite


def _turns(R: Array) -> Array:
    """Rotation of the next node's section in the frame of each node; the identity for the last."""
    relative = jax.vmap(lambda here, after: matmul(transpose(here), after))(R[:-1], R[1:])
    last = jnp.broadcast_to(stacked.identity(R[0]), R[0].shape)
    return jnp.concatenate([relative, last[None]])


def _jumps(along: Reaction, loads: Loading, grid: Grid) -> Array | None:
    """Follower wrenches at points in the world frame, each at the last node before it, shape (6,
    stages, steps)."""
    total = None
    for point, wrench in zip(loads.follower_points, along.points, strict=True):
        step = jnp.arange(grid.h.shape[0]).reshape(-1, *(1,) * point.step.ndim) == point.step - 1
        place = (
            jnp.zeros((grid.X.shape[0], *step.shape), grid.h.dtype)
            .at[-1]
            .set(step.astype(grid.h.dtype))
        )
        here = place * wrench[:, None, None]
        total = here if total is None else total + here
    return total


def _cell(end: Array, cell: EliminationCell) -> tuple[Array, tuple]:
    r"""One cell, from its end to its start: the affine change of the wrench at the start, (3, 4) or
    with follower loads (6, 4), and the affine bending $X \theta$ by the rotation at the start."""
    cell = jax.tree.map(once, cell)  # fused with a use of theirs, slices of the scan are slow
    P = _seen_from_here(end, cell)
    width, (mean, whole) = cell.width, _carried(P, cell)
    Q = matmul(cell.compliance, mean)
    if cell.by_push is not None and cell.stretch is not None:
        Q, whole = once(Q + matmul(cell.by_push, P[3:])), whole + matmul(cell.stretch, P[3:])
    pivot = stacked.identity(Q) - width * columns(Q, 0, 3)
    adjugate, det = stacked.adjugate(pivot)
    negative = _negative(stacked.trace(pivot), stacked.trace(adjugate), det)
    X = matmul(adjugate, Q + cell.by_theta) / det
    start = whole + cell.moment + matmul(width * columns(whole, 0, 3) + cell.by_bend, X)
    if cell.axis is None:
        return start, (X, None, negative)
    force, by_bend = P[3:], width * columns(P[3:], 0, 3)
    if cell.force is not None:
        by_bend = by_bend + width * cell.force
        none = jnp.zeros_like(columns(force, 3, 4))
        force = force + jnp.concatenate([2.0 * cell.force, none], axis=1)
    return jnp.concatenate([start, force + matmul(by_bend, X)]), (X, P[3:], negative)


def _seen_from_here(P: Array, cell: EliminationCell) -> Array:
    """P at the start of the next cell in the frame of this node, including the follower wrench
    between them."""
    parts = []
    for i in range(0, P.shape[0], 3):
        seen = matmul(cell.turn, rows(P, i, i + 3))
        by_theta = matmul(columns(seen, 0, 3), transpose(cell.turn))
        if cell.jump is not None:
            by_theta = by_theta - skew(rows(cell.jump, i, i + 3))
        parts.append(jnp.concatenate([by_theta, columns(seen, 3, 4)], axis=1))
    return parts[0] if len(parts) == 1 else jnp.concatenate(parts)


def _carried(P: Array, cell: EliminationCell) -> tuple[Array, Array]:
    """Change of the moment at the middle and at the start of the cell, including that by the change
    of the force."""
    if cell.axis is None:
        return P, P
    moment, lever = P[:3], matmul(skew(cell.width * cell.axis), P[3:])
    return moment + 0.5 * lever, moment + lever


def _negative(trace: Array, minors: Array, det: Array) -> Array:
    """Number of negative eigenvalues of a 3 x 3 matrix with real ones: three minus the sign changes
    of its characteristic polynomial."""
    first, second, third = trace > 0, minors > 0, det > 0
    changes = (first, first == second, second == third)
    return 3 - sum(
        (change.astype(jnp.int32) for change in changes), jnp.zeros(trace.shape, jnp.int32)
    )
