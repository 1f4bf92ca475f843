r"""The tangent of the balance of all cross-sections, solved by block elimination along the arm.

A change of strain $(\kappa, \upsilon)$, in the world frame here, turns the sections beyond it, $\theta' = \kappa$, and so changes the
reaction at a node. With $(m, n)$ the wrench there, $a = R u$ the axis and $(\delta m, \delta n)$ the wrench's change,

$$H \, \delta\xi = (\delta m - \theta \times m, \ \delta n - \theta \times n) + b, \quad
-\delta m' = (\theta \times a + \upsilon) \times n + a \times \delta n + \theta \times c, \quad -\delta n' = \theta \times f,$$

where c and f are follower densities. Each node stands for a cell of the length w of its weight, with the midpoint rule in it.
From the tip to the base the wrench's change is kept as an affine function of the rotation, $P \theta + p$; each cell then asks
for a system of the size of its strain, whose pivots are all positive when the equilibrium is stable. From the base to the tip
follow the strains. The midpoint rule makes the tangent good to second order in the distance of the nodes: as a preconditioner
of the exact one it takes about two digits off the error at each use.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array

from . import component as c
from .component import Matrix, Vector
from .quadrature import Grid
from .reaction import Loading, Reaction


class Factor(NamedTuple):
    """Factors of a matrix $A = L U$ with equal diagonals, and whether all pivots are positive.

    A pivot that is not positive is replaced by its absolute value.
    """

    lower: Matrix
    upper: Matrix
    definite: Array


def factor(matrix: Matrix) -> Factor:
    """`Factor` of a small matrix, unrolled; every entry ends in a division or a square root (see `component.cholesky`)."""
    size = len(matrix)
    L: list[list[Array]] = [[] for _ in range(size)]
    U: list[list[Array]] = [[] for _ in range(size)]  # by columns
    definite = None
    for i in range(size):
        for j in range(i):
            L[i].append(_eliminated(matrix[i][j], L[i], U[j], j) / U[j][j])
            U[i].append(_eliminated(matrix[j][i], L[j], U[i], j) / L[j][j])
        pivot = _eliminated(matrix[i][i], L[i], U[i], i)
        definite = pivot > 0 if definite is None else definite & (pivot > 0)
        root = jnp.sqrt(jnp.abs(pivot))
        L[i].append(root)
        U[i].append(root)
    assert definite is not None
    return Factor(tuple(map(tuple, L)), tuple(map(tuple, U)), definite)


def _eliminated(entry: Array, row: list[Array], column: list[Array], upto: int) -> Array:
    for k in range(upto):
        entry = entry - row[k] * column[k]
    return entry


def factor_solve(factors: Factor, right: Vector) -> Vector:
    """Solution of $L U x = b$."""
    x, size = list(right), len(right)
    for i in range(size):
        for j in range(i):
            x[i] = x[i] - factors.lower[i][j] * x[j]
        x[i] = x[i] / factors.lower[i][i]
    for i in reversed(range(size)):
        for j in range(i + 1, size):
            x[i] = x[i] - factors.upper[j][i] * x[j]
        x[i] = x[i] / factors.upper[i][i]
    return tuple(x)


class Cell(NamedTuple):
    r"""What the elimination knows of one node before it comes to it. The strain is in the body frame, all else in the world's.

    - `matrix`, `right`, `by_theta`: system for the strain, its right side and the latter's change with $\theta$, less what P adds;
    - `rotation` R, `width` w;
    - `axis` $w a$, and the changes of the wrench over the cell: `moment` and `force` with $\theta$, `moment_by_angular`,
      `moment_by_linear` and `force_by_angular` with the strain; `jump`: the follower wrench at the cell's end. Without
      follower loads `axis`, `force`, `force_by_angular` and `jump` are None: no force changes.
    """

    matrix: Matrix
    right: Vector
    by_theta: Matrix
    rotation: Matrix
    width: Array
    moment: Matrix
    moment_by_angular: Matrix
    moment_by_linear: Matrix
    axis: Vector | None
    force: Matrix | None
    force_by_angular: Matrix | None
    jump: Vector | None


def eliminate(
    lower: Matrix, right: Vector, along: Reaction | None, loads: Loading | None, grid: Grid, free: tuple[int, ...]
) -> tuple[Vector, Array]:
    r"""Solution of the tangent system with the right side $b$, and whether all pivots are positive.

    **Arguments:** node arrays of shape (stages, steps): `lower`, the lower triangle of $H$, and `right`, $b$, for the free
    strains; `along`, the reaction of the shape where the tangent is taken; without loads $H$ alone is solved, node by node.
    """
    if along is None or loads is None:
        factors = factor(c.symmetric(lower))
        return factor_solve(factors, right), jnp.all(factors.definite)
    cells = jax.tree.map(lambda x: x.T.reshape(-1), _cells(lower, right, along, loads, grid, free))
    zero = jnp.zeros_like(grid.h[0])
    nothing = (zero, zero, zero)
    size = 6 if loads.follows else 3
    tip = (nothing,) * size, (zero,) * size
    _, (X, x, definite) = lax.scan(lambda end, cell: _cell(end, cell, free), tip, cells, reverse=True)

    def forward(theta: Vector, cell: tuple) -> tuple[Vector, Vector]:
        X, x, R, width = cell
        strain = c.add(c.matvec(X, theta), x)
        kappa = tuple(strain[free.index(i)] if i in free else zero for i in range(3))
        return c.add(theta, c.scale(width, c.matvec(R, kappa))), strain

    _, strains = lax.scan(forward, nothing, (X, x, cells.rotation, cells.width))
    return tuple(s.reshape(-1, grid.X.shape[0]).T for s in strains), jnp.all(definite)


def _cells(lower: Matrix, right: Vector, along: Reaction, loads: Loading, grid: Grid, free: tuple[int, ...]) -> Cell:
    """All that does not depend on P, for all nodes at once."""
    R, w = along.rotation, grid.weight
    half, m, n, a = 0.5 * w, _skew(along.world[:3]), _skew(along.world[3:]), _skew(along.axis)
    moment, force = c.matmul(n, a), None
    if along.follower is not None:
        couple, force = (_skew(part) for part in (along.follower[:3], along.follower[3:]))
        moment = _less(moment, _more(couple, _times(half, c.matmul(a, force))))
        force = _times(-half, force)
    moment = _times(half, moment)
    body = c.transpose(R)
    by_theta = (*c.matmul(body, _more(moment, m)), *c.matmul(body, n if force is None else _more(force, n)))
    angular = _times(half, c.matmul(by_theta, R))
    linear = _times(-half, c.matmul(body, c.matmul(n, R)))
    zero = jnp.zeros_like(w)
    geometric = [(*x, *y) for x, y in zip(angular, (*linear, *((zero,) * 3,) * 3), strict=True)]
    whole = c.symmetric(lower)
    matrix = tuple(tuple(whole[p][q] - geometric[i][j] for q, j in enumerate(free)) for p, i in enumerate(free))
    follows = loads.follows
    return Cell(
        matrix,
        right,
        tuple(by_theta[i] for i in free),
        R,
        w,
        _times(2.0, moment),
        _times(w, c.matmul(moment, R)),
        _times(-w, c.matmul(n, R)),
        c.scale(w, along.axis) if follows else None,
        None if force is None else _times(2.0, force),
        None if force is None else _times(w, c.matmul(force, R)),
        _jumps(along, loads, grid) if follows else None,
    )


def _jumps(along: Reaction, loads: Loading, grid: Grid) -> Vector | None:
    """Follower wrenches at points, each at the last node before it."""
    total = None
    for point, wrench in zip(loads.follower_points, along.points, strict=True):
        step = jnp.arange(grid.h.size) == point.step - 1
        place = jnp.zeros(grid.X.shape, grid.h.dtype).at[-1].set(step.astype(grid.h.dtype))
        here = c.scale(place, wrench)
        total = here if total is None else c.add(total, here)
    return total


def _cell(end: tuple[Matrix, Vector], cell: Cell, free: tuple[int, ...]) -> tuple[tuple[Matrix, Vector], tuple]:
    r"""One cell from its end to its start: P and p there, and the strain as $X \theta + x$ of the rotation at its start."""
    P, p = end
    if cell.jump is not None:
        P = _less(P, (*_skew(cell.jump[:3]), *_skew(cell.jump[3:])))
    R, w = cell.rotation, cell.width
    mean, mean_p = _carried(P, p, cell, 0.5)  # the end's wrench taken to the middle
    by_angular = _times(w, c.matmul(mean, R))
    body = c.transpose(R)
    reach = (*c.matmul(body, mean[:3]), *(c.matmul(body, mean[3:]) if len(p) == 6 else ()))
    reach_p = (*c.matvec(body, mean_p[:3]), *(c.matvec(body, mean_p[3:]) if len(p) == 6 else ()))
    by_body = (*c.matmul(body, by_angular[:3]), *(c.matmul(body, by_angular[3:]) if len(p) == 6 else ()))
    matrix = tuple(
        tuple(x - by_body[i][j] if i < len(p) and j < 3 else x for j, x in zip(free, row, strict=True))
        for i, row in zip(free, cell.matrix, strict=True)
    )
    by_theta = [c.add(row, reach[i]) if i < len(p) else row for i, row in zip(free, cell.by_theta, strict=True)]
    right = tuple(b + reach_p[i] if i < len(p) else b for i, b in zip(free, cell.right, strict=True))
    factors = factor(matrix)
    columns = [factor_solve(factors, column) for column in c.transpose(tuple(by_theta))]
    x, X = factor_solve(factors, right), c.transpose(tuple(columns))
    zero = jnp.zeros_like(w)
    placed = [(*X[free.index(i)], x[free.index(i)]) if i in free else (zero,) * 4 for i in range(6)]  # columns: theta, 1
    whole, whole_p = _carried(P, p, cell, 1.0)
    effect = _more(
        c.matmul(_more(_times(w, c.matmul(whole[:3], R)), cell.moment_by_angular), tuple(placed[:3])),
        c.matmul(cell.moment_by_linear, tuple(placed[3:])),
    )
    rows = [(*c.add(c.add(P_, E), e[:3]), p_ + e[3]) for P_, E, p_, e in zip(whole[:3], cell.moment, whole_p[:3], effect, strict=True)]
    if len(p) == 6:
        by_force = _times(w, c.matmul(P[3:], R))
        by_force = by_force if cell.force_by_angular is None else _more(by_force, cell.force_by_angular)
        start = P[3:] if cell.force is None else _more(P[3:], cell.force)
        rows += [(*c.add(P_, e[:3]), p_ + e[3]) for P_, p_, e in zip(start, p[3:], c.matmul(by_force, tuple(placed[:3])), strict=True)]
    return (tuple(row[:3] for row in rows), tuple(row[3] for row in rows)), (X, x, factors.definite)


def _carried(P: Matrix, p: Vector, cell: Cell, part: float) -> tuple[Matrix, Vector]:
    """The end's change of the wrench at a part of the cell before it: the change of the force has an arm."""
    if cell.axis is None:
        return P, p
    arm = c.scale(part, cell.axis)
    columns = [c.cross(arm, column) for column in c.transpose(P[3:])]
    moment, moment_p = _more(P[:3], c.transpose(tuple(columns))), c.add(p[:3], c.cross(arm, p[3:]))
    return (*moment, *P[3:]), (*moment_p, *p[3:])


def _skew(v: Vector) -> Matrix:
    zero = jnp.zeros_like(v[0])
    return (zero, -v[2], v[1]), (v[2], zero, -v[0]), (-v[1], v[0], zero)


def _more(a: Matrix, b: Matrix) -> Matrix:
    return tuple(c.add(x, y) for x, y in zip(a, b, strict=True))


def _less(a: Matrix, b: Matrix) -> Matrix:
    return tuple(c.subtract(x, y) for x, y in zip(a, b, strict=True))


def _times(s: Array | float, a: Matrix) -> Matrix:
    return tuple(c.scale(s, row) for row in a)
