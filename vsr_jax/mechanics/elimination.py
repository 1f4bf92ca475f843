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

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array

from ..numerics import component as c
from ..numerics.component import Matrix, Vector
from ..numerics.quadrature import Grid
from .balance import free_block, free_components, spread
from .reaction import Loading, Reaction, turned

UNSTABLE_SECTION = 1_000_000
"""Number of negative eigenvalues reported for a section that is unstable by itself: more than
cables can stabilise."""


class EliminationCell(NamedTuple):
    r"""Coefficients of one cell that do not depend on P, in the frame of its section.

    - `width` w; `turn`: rotation of the next node's section in this frame.
    - $\kappa = $ `compliance` $\delta m$ + `by_theta` $\theta$ + `bend`, with $\delta m$ the part
      from P at the middle of the cell.
    - Over the cell the moment changes by `moment` $\theta$ + `by_bend` $\kappa$ + `moment_0`.
    - With follower loads only, else None: the effect of the change of the force on the strain,
      `by_push`, and on the moment, `stretch`; the `axis` u; `force`, the change of the force over
      half the cell per rotation (None without follower density); `jump`, the follower wrench at the
      end of the cell (None without follower points).
    """

    width: Array
    turn: Matrix
    compliance: Matrix
    by_theta: Matrix
    bend: Vector
    moment: Matrix
    by_bend: Matrix
    moment_0: Vector
    by_push: Matrix | None = None
    stretch: Matrix | None = None
    axis: Vector | None = None
    force: Matrix | None = None
    jump: Vector | None = None


class EliminatedLinear(NamedTuple):
    r"""The eliminated linear strains of a node: `flexibility` $(\delta n$ + `by_theta` $\theta$ +
    `right`) $-$ `by_bend` $\kappa$, with $\delta n$ the part of the force from P."""

    flexibility: Matrix
    by_theta: Matrix
    right: Vector
    by_bend: Matrix


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
    flat = jax.tree.map(_flat, (lower, right, xi, along.wrench, along.rotation))
    lower, right, xi, wrench, rotation = c.keep(flat, flat[1][0])
    loads = loads._replace(follower_density=jax.tree.map(_flat, loads.follower_density))
    cells, linear, local = _cells(
        lower, right, xi, wrench, rotation, loads, _flat(grid.weight), free
    )
    cells = cells._replace(jump=jax.tree.map(_flat, _jumps(along, loads, grid)))
    zero = jnp.zeros_like(right[0][0])
    nothing = (zero, zero, zero)
    size = 6 if loads.follows else 3
    _, (X, x, push, negative) = lax.scan(
        _cell, ((nothing,) * size, (zero,) * size), cells, reverse=True
    )

    def forward(theta: Vector, cell: tuple) -> tuple[Vector, tuple[Vector, Vector]]:
        X, x, turn, width = cell
        kappa = c.add(c.matvec(X, theta), x)
        return c.matvec(c.transpose(turn), c.add(theta, c.scale(width, kappa))), (theta, kappa)

    _, (theta, kappa) = lax.scan(forward, nothing, (X, x, cells.turn, cells.width))
    force = c.add(c.matvec(linear.by_theta, theta), linear.right)
    if push is not None:
        force = c.add(
            force, c.add(c.matvec(push[0], c.add(theta, c.scale(cells.width, kappa))), push[1])
        )
    upsilon = c.subtract(c.matvec(linear.flexibility, force), c.matvec(linear.by_bend, kappa))
    strain = tuple(_unflat(x, grid) for x in (*kappa, *upsilon))
    return strain, jnp.where(
        jnp.all(local, axis=0), jnp.sum(negative, axis=0, dtype=jnp.int32), UNSTABLE_SECTION
    )


def _flat(x: Array) -> Array:
    """Nodes one after another along the arm, from node arrays."""
    return x.swapaxes(0, 1).reshape(-1, *x.shape[2:])


def _unflat(x: Array, grid: Grid) -> Array:
    return x.reshape(-1, grid.X.shape[0], *x.shape[1:]).swapaxes(0, 1)


def _cells(
    lower: Matrix,
    right: Vector,
    xi: Vector,
    wrench: Vector,
    rotation: Matrix,
    loads: Loading,
    w: Array,
    free: tuple[int, ...],
) -> tuple[EliminationCell, EliminatedLinear, Array]:
    """All that does not depend on P, for all nodes at once, and whether each section is stable by
    itself."""
    half, n = 0.5 * w, c.skew(wrench[3:])
    moment, by_force, force = _per_rotation(n, c.skew(xi[3:]), loads, half)
    moment = c.keep(c.scale(half, moment), xi[0])
    by_theta, H = c.add(moment, c.skew(wrench[:3])), c.symmetric(lower)
    flexibility, rigid = _inverse(
        tuple(row[3:] for row in H[3:]), tuple(i - 3 for i in free if i > 2)
    )
    mixed = c.add(tuple(row[3:] for row in H[:3]), c.scale(half, n))
    D = c.keep(c.matmul(mixed, flexibility), xi[0])
    stiff = c.subtract(
        tuple(row[:3] for row in H[:3]),
        c.add(c.scale(half, by_theta), c.matmul(D, c.transpose(mixed))),
    )
    by_bend = c.transpose(D)
    if force is not None:
        stiff = c.add(stiff, c.matmul(D, c.scale(half, force)))
        by_bend = c.subtract(by_bend, c.matmul(flexibility, c.scale(half, force)))
    drive, bend = (
        c.subtract(by_theta, c.matmul(D, by_force)),
        c.subtract(right[:3], c.matvec(D, right[3:])),
    )
    stiff, drive, bend, moved, pushed = c.keep(
        (stiff, drive, bend, c.matmul(flexibility, by_force), c.matvec(flexibility, right[3:])),
        xi[0],
    )
    compliance, stable = _inverse(stiff, tuple(i for i in free if i < 3))
    lever = c.scale(-w, n)  # moment over the cell per linear strain
    cell = EliminationCell(
        w,
        _turns(rotation),
        compliance,
        c.matmul(compliance, drive),
        c.matvec(compliance, bend),
        c.add(c.scale(2.0, moment), c.matmul(lever, moved)),
        c.subtract(c.scale(w, moment), c.matmul(lever, by_bend)),
        c.matvec(lever, pushed),
    )
    if loads.follows:
        by_push, stretch = c.scale(-1.0, c.matmul(compliance, D)), c.matmul(lever, flexibility)
        cell = cell._replace(by_push=by_push, stretch=stretch, axis=xi[3:], force=force)
    return cell, EliminatedLinear(flexibility, by_force, right[3:], by_bend), rigid & stable


def _per_rotation(
    n: Matrix, u: Matrix, loads: Loading, half: Array
) -> tuple[Matrix, Matrix, Matrix | None]:
    """Derivatives by the rotation of a section, without those through P: of the change of the
    moment per length, of the force, and of the change of the force over half a cell, which is None
    without follower density."""
    density = loads.follower_density
    if density is None:
        return c.matmul(n, u), n, None
    force = c.scale(-half, c.skew(density[3:]))
    moment = c.add(c.matmul(n, u), c.matmul(u, force))
    return c.subtract(moment, c.skew(density[:3])), c.add(n, force), force


def _inverse(matrix: Matrix, places: tuple[int, ...]) -> tuple[Matrix, Array]:
    """Inverse of the block of a 3 x 3 matrix at given indices, zero elsewhere, and whether its
    leading minors are positive."""
    zero = jnp.zeros_like(matrix[0][0])
    # the cube of the stiffness of a thin arm underflows in single precision
    scale = sum((jnp.abs(matrix[i][i]) for i in places), zero)
    matrix = tuple(tuple(x / scale for x in row) for row in matrix)
    if len(places) == 3:
        adjugate, det = c.adjugate(matrix)
        definite = (matrix[0][0] > 0) & (adjugate[2][2] > 0) & (det > 0)
    elif len(places) == 2:
        (a, b), (d, e) = (tuple(matrix[i][j] for j in places) for i in places)
        adjugate, det = ((e, -b), (-d, a)), a * e - b * d
        definite = (a > 0) & (det > 0)
    elif len(places) == 1:
        adjugate, det = ((jnp.ones_like(zero),),), matrix[places[0]][places[0]]
        definite = det > 0
    else:
        return ((zero,) * 3,) * 3, jnp.ones_like(zero, bool)
    entries = {
        (i, j): adjugate[p][q] / (det * scale)
        for p, i in enumerate(places)
        for q, j in enumerate(places)
    }
    return tuple(tuple(entries.get((i, j), zero) for j in range(3)) for i in range(3)), definite


def _turns(R: Matrix) -> Matrix:
    """Rotation of the next node's section in the frame of each node; the identity for the last."""
    relative = c.matmul(
        c.transpose(jax.tree.map(lambda x: x[:-1], R)), jax.tree.map(lambda x: x[1:], R)
    )

    def followed(x: Array, last: float) -> Array:
        return jnp.concatenate([x, jnp.full_like(x[:1], last)])

    return tuple(
        tuple(followed(x, float(i == j)) for j, x in enumerate(row))
        for i, row in enumerate(relative)
    )


def _jumps(along: Reaction, loads: Loading, grid: Grid) -> Vector | None:
    """Follower wrenches at points, each at the last node before it."""
    total = None
    for point, wrench in zip(loads.follower_points, along.points, strict=True):
        step = jnp.arange(grid.h.shape[0]).reshape(-1, *(1,) * point.step.ndim) == point.step - 1
        place = (
            jnp.zeros((grid.X.shape[0], *step.shape), grid.h.dtype)
            .at[-1]
            .set(step.astype(grid.h.dtype))
        )
        here = c.scale(place, wrench)
        total = here if total is None else c.add(total, here)
    return None if total is None else turned(c.transpose(along.rotation), total)


def _cell(end: tuple[Matrix, Vector], cell: EliminationCell) -> tuple[tuple[Matrix, Vector], tuple]:
    r"""One cell, from its end to its start: P and p at the start, and the bending as $X \theta + x$
    of the rotation at the start."""
    P, p = _seen_from_here(*end, cell)
    mean, mean_p = _carried(P, p, cell, 0.5)
    Q, q = c.matmul(cell.compliance, mean[:3]), c.matvec(cell.compliance, mean_p[:3])
    whole, whole_p = _carried(P, p, cell, 1.0)
    rows, rows_p = whole[:3], whole_p[:3]
    if cell.by_push is not None and cell.stretch is not None:
        Q, q = c.add(Q, c.matmul(cell.by_push, P[3:])), c.add(q, c.matvec(cell.by_push, p[3:]))
        rows, rows_p = (
            c.add(rows, c.matmul(cell.stretch, P[3:])),
            c.add(rows_p, c.matvec(cell.stretch, p[3:])),
        )
    Q, q = c.keep((Q, q), p[0])
    less = c.scale(-cell.width, Q)
    pivot = tuple(
        tuple(1.0 + x if i == j else x for j, x in enumerate(row)) for i, row in enumerate(less)
    )
    adjugate, det = c.adjugate(pivot)
    negative = _negative(_trace(pivot), _trace(adjugate), det)
    solved = c.matmul(adjugate, c.add(Q, cell.by_theta)), c.matvec(adjugate, c.add(q, cell.bend))
    X, x = jax.tree.map(lambda entry: entry / det, solved)
    by_bend = c.add(c.scale(cell.width, rows), cell.by_bend)
    start = c.add(c.add(rows, cell.moment), c.matmul(by_bend, X))
    start_p = c.add(c.add(rows_p, cell.moment_0), c.matvec(by_bend, x))
    if len(p) == 3:
        return (start, start_p), (X, x, None, negative)
    by_bend, force = c.scale(cell.width, P[3:]), P[3:]
    if cell.force is not None:
        by_bend, force = (
            c.add(by_bend, c.scale(cell.width, cell.force)),
            c.add(force, c.scale(2.0, cell.force)),
        )
    start = (*start, *c.add(force, c.matmul(by_bend, X)))
    start_p = (*start_p, *c.add(p[3:], c.matvec(by_bend, x)))
    return (start, start_p), (X, x, (P[3:], p[3:]), negative)


def _seen_from_here(P: Matrix, p: Vector, cell: EliminationCell) -> tuple[Matrix, Vector]:
    """P and p at the start of the next cell in the frame of this node, including the follower
    wrench between them."""
    T, like = cell.turn, p[0]
    blocks = [c.matmul(c.matmul(T, P[i : i + 3]), c.transpose(T)) for i in range(0, len(p), 3)]
    P, p = sum(blocks, ()), sum((c.matvec(T, p[i : i + 3]) for i in range(0, len(p), 3)), ())
    if cell.jump is not None:
        P = c.subtract(P, (*c.skew(cell.jump[:3]), *c.skew(cell.jump[3:])))
    return c.keep((P, p), like)


def _carried(P: Matrix, p: Vector, cell: EliminationCell, part: float) -> tuple[Matrix, Vector]:
    """Change of the wrench at a fraction of the cell before its end, including the moment of the
    change of the force."""
    if cell.axis is None:
        return P, p
    arm = c.skew(c.scale(part * cell.width, cell.axis))
    moment, moment_p = c.add(P[:3], c.matmul(arm, P[3:])), c.add(p[:3], c.matvec(arm, p[3:]))
    return (*moment, *P[3:]), (*moment_p, *p[3:])


def _negative(trace: Array, minors: Array, det: Array) -> Array:
    """Number of negative eigenvalues of a 3 x 3 matrix with real ones: three minus the sign changes
    of its characteristic polynomial."""
    first, second, third = trace > 0, minors > 0, det > 0
    changes = (first, first == second, second == third)
    return 3 - sum(
        (change.astype(jnp.int32) for change in changes), jnp.zeros(trace.shape, jnp.int32)
    )


def _trace(matrix: Matrix) -> Array:
    return matrix[0][0] + matrix[1][1] + matrix[2][2]
