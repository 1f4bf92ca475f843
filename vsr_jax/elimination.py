r"""The tangent of the balance of all cross-sections, solved by block elimination along the arm.

In the frame of each section a change of strain $(\kappa, \upsilon)$ turns the sections beyond it, $\theta' = \kappa$, and so changes the
reaction at a node. With $(m, n)$ the wrench there, $(\delta m, \delta n)$ its change and $u$ the axis,

$$H \, \delta\xi = (\delta m - \theta \times m, \ \delta n - \theta \times n) + b, \quad
-\delta m' = (\theta \times u + \upsilon) \times n + u \times \delta n + \theta \times c, \quad -\delta n' = \theta \times f,$$

where c and f are follower densities. Each node stands for a cell of the length w of its weight, with the midpoint rule in it.
The linear strains of a node meet no other node but through its rotation, so they are eliminated first, for all nodes at once.
From the tip to the base the wrench's change is then kept as an affine function of the rotation, $P \theta + p$, and each cell
asks for a system of three rotations. From the base to the tip follow the rotations. The midpoint rule makes the tangent good to
second order in the distance of the nodes: as a preconditioner of the exact one it takes about two digits off the error at
each use.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array

from . import component as c
from .component import Matrix, Vector
from .quadrature import Grid
from .reaction import Loading, Reaction

_EYE = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))


class Cell(NamedTuple):
    r"""What the elimination knows of one node before it comes to it, in the frame of its section.

    - `width` w; `turn`: rotation of the next node's section as seen from here;
    - $\kappa = $ `compliance` $\delta m_r + $ `by_theta` $\theta + $ `bend`, with $\delta m_r$ what P makes of the rotation at the
      cell's end, at its middle;
    - over the cell the moment changes by `moment` $\theta$ + `by_bend` $\kappa$ + `moment_0`;
    - with follower loads only, else None: what a change of the force adds, `compliance_n` to the strain and `stretch` to the
      moment; the `axis` u; `force`, the force's change over half the cell with the rotation; `jump`, the follower wrench at
      the cell's end.
    """

    width: Array
    turn: Matrix
    compliance: Matrix
    by_theta: Matrix
    bend: Vector
    moment: Matrix
    by_bend: Matrix
    moment_0: Vector
    compliance_n: Matrix | None
    stretch: Matrix | None
    axis: Vector | None
    force: Matrix | None
    jump: Vector | None


class Linear(NamedTuple):
    r"""The free linear strains of a node once its rotations are known: `flexibility` $(\delta n_r + $ `by_theta` $\theta + b)$
    $-$ `by_bend` $\kappa$, with $\delta n_r$ what P makes of the force."""

    flexibility: Matrix
    by_theta: Matrix
    by_bend: Matrix
    right: Vector


def inverse(matrix: Matrix) -> tuple[Matrix, Array]:
    """Inverse of a matrix of up to three rows, by cofactors, and whether its leading minors are positive."""
    size = len(matrix)
    if size == 1:
        return ((1 / matrix[0][0],),), matrix[0][0] > 0
    if size == 2:
        (p, q), (r, s) = matrix
        adjugate, det, definite = ((s, -q), (-r, p)), p * s - q * r, p > 0
    else:
        rows = matrix
        cofactors = c.cross(rows[1], rows[2]), c.cross(rows[2], rows[0]), c.cross(rows[0], rows[1])
        adjugate, det = c.transpose(cofactors), c.dot(rows[0], cofactors[0])
        definite = (rows[0][0] > 0) & (cofactors[2][2] > 0)
    return tuple(tuple(x / det for x in row) for row in adjugate), definite & (det > 0)


def eliminate(
    lower: Matrix, right: Vector, xi: Vector, along: Reaction | None, loads: Loading | None, grid: Grid, free: tuple[int, ...]
) -> tuple[Vector, Array]:
    r"""Solution of the tangent system with the right side $b$, and whether the tangent is positive definite.

    **Arguments:** node arrays of shape (stages, steps): `lower`, the lower triangle of $H$, and `right`, $b$, for the free
    strains; `xi` and `along`, the strain where the tangent is taken and its reaction; without loads $H$ alone is solved, node
    by node. Where the tangent is not definite the solution may be anything.
    """
    if along is None or loads is None or min(free) > 2:
        x = c.cholesky_solve(c.cholesky(lower), right)
        return x, ~jnp.any(jnp.isnan(x[-1]), axis=(0, 1))
    lower, right, along = c.keep((lower, right, along._replace(starts=(), density=(), axis=(), world=(), body_density=())), xi[0])
    cells, linear, local = _cells(lower, right, xi, along, loads, grid, free)
    cells = jax.tree.map(_flat, cells)
    zero = jnp.zeros_like(right[0][0, 0])
    nothing = (zero, zero, zero)
    size = 6 if loads.follows else 3
    tip = (nothing,) * size, (zero,) * size
    _, (X, x, force, definite) = lax.scan(_cell, tip, cells, reverse=True)

    def forward(theta: Vector, cell: tuple) -> tuple[Vector, tuple[Vector, Vector]]:
        X, x, turn, width = cell
        kappa = c.add(c.matvec(X, theta), x)
        return c.matvec(c.transpose(turn), c.add(theta, c.scale(width, kappa))), (theta, kappa)

    _, (theta, kappa) = lax.scan(forward, nothing, (X, x, cells.turn, cells.width))
    angular = [i for i in free if i < 3]
    if force is not None:
        force = c.add(c.matvec(force[0], c.add(theta, c.scale(cells.width, kappa))), force[1])
    theta, kappa, force = jax.tree.map(lambda x: _unflat(x, grid), (theta, kappa, force))
    strain = tuple(kappa[i] for i in angular)
    if linear is not None:
        push = c.add(c.matvec(linear.by_theta, theta), linear.right)
        if force is not None:
            push = c.add(push, tuple(force[i - 3] for i in free if i > 2))
        strain = (*strain, *c.subtract(c.matvec(linear.flexibility, push), c.matvec(linear.by_bend, strain)))
    return strain, jnp.all(definite, axis=0) & jnp.all(local, axis=(0, 1))


def _flat(x: Array) -> Array:
    """Nodes one after another along the arm, from node arrays."""
    return x.swapaxes(0, 1).reshape(-1, *x.shape[2:])


def _unflat(x: Array, grid: Grid) -> Array:
    return x.reshape(-1, grid.X.shape[0], *x.shape[1:]).swapaxes(0, 1)


def _cells(
    lower: Matrix, right: Vector, xi: Vector, along: Reaction, loads: Loading, grid: Grid, free: tuple[int, ...]
) -> tuple[Cell, Linear | None, Array]:
    """All that does not depend on P, for all nodes at once."""
    w, half, zero = grid.weight, 0.5 * grid.weight, jnp.zeros_like(grid.weight)
    split = sum(i < 3 for i in free)
    angular, linear = free[:split], tuple(i - 3 for i in free[split:])
    m, n, u = _skew(along.wrench[:3]), _skew(along.wrench[3:]), _skew(xi[3:])
    moment, force, by_force = c.matmul(n, u), None, n
    if loads.follower_density is not None:
        couple, force = (_skew(part) for part in (loads.follower_density[:3], loads.follower_density[3:]))
        moment = _less(moment, _more(couple, _times(half, c.matmul(u, force))))
        force = _times(-half, force)
        by_force = _more(n, force)
    moment = _times(half, moment)
    moment = c.keep(moment, xi[0])
    by_theta = _more(moment, m)  # of the moment and by_force of the force, less what P adds
    whole = c.symmetric(lower)
    stiff = tuple(tuple(whole[p][q] - half * by_theta[i][j] for q, j in enumerate(angular)) for p, i in enumerate(angular))
    drive, bend, definite = tuple(by_theta[i] for i in angular), right[:split], jnp.ones(w.shape, bool)
    over, by_bend, moment_0 = _times(2.0, moment), _times(w, moment), (zero,) * 3
    solved, compliance_n, stretch = None, None, None
    if linear:
        flexibility, definite = inverse(tuple(row[split:] for row in whole[split:]))
        mixed = tuple(tuple(whole[p][split + q] + half * n[i][j] for q, j in enumerate(linear)) for p, i in enumerate(angular))
        D = c.keep(c.matmul(mixed, flexibility), xi[0])
        stiff = _less(stiff, c.matmul(D, c.transpose(mixed)))
        pushed = tuple(by_force[i] for i in linear)
        drive = _less(drive, c.matmul(D, pushed))
        bend = c.subtract(bend, c.matvec(D, right[split:]))
        back = c.transpose(D)
        if force is not None:
            turned = tuple(tuple(half * force[i][j] for j in angular) for i in linear)
            stiff = _more(stiff, c.matmul(D, turned))
            back = _less(back, c.matmul(flexibility, turned))
        solved = Linear(flexibility, pushed, back, right[split:])
        lever = tuple(tuple(-w * n[i][j] for j in linear) for i in range(3))  # moment over the cell by the linear strain
        over = _more(over, c.matmul(lever, c.keep(c.matmul(flexibility, pushed), xi[0])))
        by_bend = _less(by_bend, _placed_columns(c.matmul(lever, back), angular, zero))
        moment_0 = c.matvec(lever, c.keep(c.matvec(flexibility, right[split:]), xi[0]))
    stiff, drive, bend = c.keep((stiff, drive, bend), xi[0])
    compliance, stable = inverse(stiff)
    if linear and loads.follows:
        compliance_n = _placed(_times(-1.0, c.matmul(compliance, D)), angular, linear, zero)
        stretch = _placed_columns(c.matmul(lever, flexibility), linear, zero)
    cell = Cell(
        w,
        _turns(along.rotation, grid),
        _placed(compliance, angular, angular, zero),
        _placed(c.matmul(compliance, drive), angular, (0, 1, 2), zero),
        _placed(tuple((x,) for x in c.matvec(compliance, bend)), angular, (0,), zero),
        over,
        by_bend,
        moment_0,
        compliance_n,
        stretch,
        xi[3:] if loads.follows else None,
        force,
        _jumps(along, loads, grid) if loads.follows else None,
    )
    return cell._replace(bend=tuple(row[0] for row in cell.bend)), solved, definite & stable


def _turns(R: Matrix, grid: Grid) -> Matrix:
    """Rotation from each node's section to the next one's; that of the last is the identity."""
    flat = jax.tree.map(_flat, R)
    relative = c.matmul(c.transpose(jax.tree.map(lambda x: x[:-1], flat)), jax.tree.map(lambda x: x[1:], flat))

    def followed(x: Array, last: float) -> Array:
        return _unflat(jnp.concatenate([x, jnp.full_like(x[:1], last)]), grid)

    return tuple(tuple(map(followed, row, ones)) for row, ones in zip(relative, _EYE, strict=True))


def _jumps(along: Reaction, loads: Loading, grid: Grid) -> Vector | None:
    """Follower wrenches at points, each at the last node before it."""
    total = None
    for point, wrench in zip(loads.follower_points, along.points, strict=True):
        step = jnp.arange(grid.h.shape[0]).reshape(-1, *(1,) * point.step.ndim) == point.step - 1
        place = jnp.zeros((grid.X.shape[0], *step.shape), grid.h.dtype).at[-1].set(step.astype(grid.h.dtype))
        here = c.scale(place, wrench)
        total = here if total is None else c.add(total, here)
    if total is None:
        return None
    back = c.transpose(along.rotation)
    return (*c.matvec(back, total[:3]), *c.matvec(back, total[3:]))


def _cell(end: tuple[Matrix, Vector], cell: Cell) -> tuple[tuple[Matrix, Vector], tuple]:
    r"""One cell from its end to its start: P and p there, and the bend as $X \theta + x$ of the rotation at its start."""
    (P, p), w, T = end, cell.width, cell.turn
    P = (*_rotated(T, P[:3]), *(_rotated(T, P[3:]) if len(p) == 6 else ()))
    p = (*c.matvec(T, p[:3]), *(c.matvec(T, p[3:]) if len(p) == 6 else ()))
    if cell.jump is not None:
        P = _less(P, (*_skew(cell.jump[:3]), *_skew(cell.jump[3:])))
    P, p = c.keep((P, p), end[1][0])
    mean, mean_p = _carried(P, p, cell, 0.5)  # the end's wrench taken to the middle
    Q, q = c.matmul(cell.compliance, mean[:3]), c.matvec(cell.compliance, mean_p[:3])
    if cell.compliance_n is not None:
        Q, q = _more(Q, c.matmul(cell.compliance_n, P[3:])), c.add(q, c.matvec(cell.compliance_n, p[3:]))
    Q, q = c.keep((Q, q), p[0])
    pivot = tuple(tuple(e - w * x for e, x in zip(ones, row, strict=True)) for ones, row in zip(_EYE, Q, strict=True))
    adjugate, det, definite = _adjugate(pivot)
    X = tuple(tuple(entry / det for entry in row) for row in c.matmul(adjugate, _more(Q, cell.by_theta)))
    x = tuple(entry / det for entry in c.matvec(adjugate, c.add(q, cell.bend)))
    whole, whole_p = _carried(P, p, cell, 1.0)
    rows, rows_p = whole[:3], whole_p[:3]
    if cell.stretch is not None:
        rows, rows_p = _more(rows, c.matmul(cell.stretch, P[3:])), c.add(rows_p, c.matvec(cell.stretch, p[3:]))
    by_bend = _more(_times(w, rows), cell.by_bend)
    start = _more(_more(rows, cell.moment), c.matmul(by_bend, X))
    start_p = c.add(c.add(rows_p, cell.moment_0), c.matvec(by_bend, x))
    if len(p) == 3:
        return (start, start_p), (X, x, None, definite)
    by_bend, force = _times(w, P[3:]), P[3:]
    if cell.force is not None:
        by_bend, force = _more(by_bend, _times(w, cell.force)), _more(force, _times(2.0, cell.force))
    start = (*start, *_more(force, c.matmul(by_bend, X)))
    start_p = (*start_p, *c.add(p[3:], c.matvec(by_bend, x)))
    return (start, start_p), (X, x, (P[3:], p[3:]), definite)


def _adjugate(M: Matrix) -> tuple[Matrix, Array, Array]:
    """Adjugate and determinant of a matrix with real eigenvalues, and whether they are all positive."""
    cofactors = c.cross(M[1], M[2]), c.cross(M[2], M[0]), c.cross(M[0], M[1])
    det = c.dot(M[0], cofactors[0])
    definite = (M[0][0] + M[1][1] + M[2][2] > 0) & (cofactors[0][0] + cofactors[1][1] + cofactors[2][2] > 0) & (det > 0)
    return c.transpose(cofactors), det, definite


def _carried(P: Matrix, p: Vector, cell: Cell, part: float) -> tuple[Matrix, Vector]:
    """The end's change of the wrench at a part of the cell before it: the change of the force has an arm."""
    if cell.axis is None:
        return P, p
    arm = c.scale(part * cell.width, cell.axis)
    columns = [c.cross(arm, column) for column in c.transpose(P[3:])]
    moment, moment_p = _more(P[:3], c.transpose(tuple(columns))), c.add(p[:3], c.cross(arm, p[3:]))
    return (*moment, *P[3:]), (*moment_p, *p[3:])


def _rotated(T: Matrix, P: Matrix) -> Matrix:
    return c.matmul(c.matmul(T, P), c.transpose(T))


def _placed(matrix: Matrix, rows: tuple[int, ...], columns: tuple[int, ...], zero: Array) -> Matrix:
    """Matrix of three rows with the given entries at the given places."""
    width = 3 if max(columns) > 0 or len(columns) > 1 else 3
    return tuple(
        tuple(matrix[rows.index(i)][columns.index(j)] if i in rows and j in columns else zero for j in range(width)) for i in range(3)
    )


def _placed_columns(matrix: Matrix, columns: tuple[int, ...], zero: Array) -> Matrix:
    return _placed(matrix, (0, 1, 2), columns, zero)


def _skew(v: Vector) -> Matrix:
    zero = jnp.zeros_like(v[0])
    return (zero, -v[2], v[1]), (v[2], zero, -v[0]), (-v[1], v[0], zero)


def _more(a: Matrix, b: Matrix) -> Matrix:
    return tuple(c.add(x, y) for x, y in zip(a, b, strict=True))


def _less(a: Matrix, b: Matrix) -> Matrix:
    return tuple(c.subtract(x, y) for x, y in zip(a, b, strict=True))


def _times(s: Array | float, a: Matrix) -> Matrix:
    return tuple(c.scale(s, row) for row in a)
