r"""The tangent system of the strains with a border, by its Schur complement."""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array

from ..numerics import component as c, lu
from ..numerics.component import Vector
from ..numerics.quadrature import Grid
from .definiteness import Definiteness

_IDLE = 0.75
"""Power of the machine epsilon below which a pivot of the Schur complement is taken to be rounding,
as of a section held in a direction in which the arm cannot move, or in one twice."""


class Border(NamedTuple):
    r"""Part of a coupling with m unknowns in the tangent system.

    - `columns`: P, for each unknown the wrench at the nodes that it adds to the residual: six
      components, each of shape (m, stages, steps, ...).
    - `rows`: R, for each row a wrench at the nodes; its work over a change of strain, times the
      factor, is the change of the row.
    - `factors`: F, shape (m, ...). `corner`: the diagonal of D, shape (m, ...).
    - `resists`: 1 where a negative pivot of the Schur complement is an unstable motion that the
      unknown prevents, -1 where it is one that it causes, shape (m, ...).
    """

    columns: Vector
    rows: Vector
    factors: Array
    corner: Array
    resists: Array


Solve = Callable[..., tuple[Vector, Definiteness]]
"""Solution of a system for several right sides, components (k, stages, steps, ...)."""


def listed(parts: tuple[Array, ...]) -> Array:
    """Arrays (m, ...) one after another, the axes behind of the same sizes."""
    if len(parts) == 1:
        return parts[0]
    shape = jnp.broadcast_shapes(*(part.shape[1:] for part in parts))
    return jnp.concatenate([jnp.broadcast_to(part, (len(part), *shape)) for part in parts])


def solved_with(
    solve: Solve, sides: Sequence, columns: Vector, *, apart: bool = False
) -> tuple[Vector, Vector, Definiteness]:
    """Solutions for right sides and what pushes them, and for columns that nothing pushes;
    `apart`: each by a pass of its own."""
    b, *pushes = sides
    if apart:
        found, definiteness = solve(b, *pushes)
        return found, solve(columns)[0], definiteness
    count, more = len(b[0]), len(columns[0])
    pushes = (jnp.pad(push, [(0, more), *[(0, 0)] * (push.ndim - 1)]) for push in pushes)
    both = tuple(map(listed, zip(b, columns, strict=True)))
    found, definiteness = solve(both, *pushes)
    return tuple(x[:count] for x in found), tuple(x[count:] for x in found), definiteness


def bordered_solve(
    strain: Vector, answers: Vector, right: Array, border: Border, grid: Grid
) -> tuple[Vector, Array, Array]:
    """Solution of a system with a border: the strain, the unknowns of the couplings, and the number
    of unstable motions of the arm alone that the couplings prevent, less those that they cause, by
    the negative pivots of the Schur complement: the arm is stable if its tangent has no more
    negative eigenvalues than that.

    **Arguments:** `strain`, `answers`: solutions of the system of the strains for their right side,
    and for each of the columns; `right`: that of the couplings, shape (m, ...).
    """

    def work(rows: Vector, change: Vector) -> Array:
        return jnp.sum(grid.weight * c.dot(rows, change), axis=(-grid.X.ndim, 1 - grid.X.ndim))

    size = len(border.factors)
    given = work(border.rows, strain)
    unit = jnp.eye(size, dtype=right.dtype).reshape(size, size, *(1,) * (right.ndim - 1))
    pulled = work(tuple(row[:, None] for row in border.rows), answers)
    schur = unit * border.corner[:, None] - border.factors[:, None] * pulled
    rounding = float(jnp.finfo(schur.dtype).eps) ** _IDLE
    x, negative = lu.solve_with_pivots(schur, right - border.factors * given, rounding)
    prevented = jnp.sum(jnp.where(negative, border.resists, 0), axis=0, dtype=jnp.int32)
    strain = tuple(
        a - jnp.sum(x[:, None, None] * answer, axis=0)
        for a, answer in zip(strain, answers, strict=True)
    )
    return strain, x, prevented
