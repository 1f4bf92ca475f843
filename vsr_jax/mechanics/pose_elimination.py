r"""The tangent of the balance under loads that depend on positions, solved by block elimination.

As in `elimination`, each node represents a cell of its weight w, integrated by the midpoint rule.
In the frame of its section the motion of a section is $z = (\theta, \rho)$, rotation and
displacement, and the change of the wrench at its end an affine function of it, $P z + p$: the
stiffness of the arm beyond, springs included, so that a stiff spring is eliminated exactly. With
$K = (C; F)$ the derivative of the load density (c, f) by the motion,

$$\theta' = \kappa, \quad \rho' = \theta \times u + \upsilon, \quad
-\delta m' = \rho' \times n + u \times \delta n + C z, \quad -\delta n' = F z,$$

and $H \, \delta\xi = (\delta m - \theta \times m, \delta n - \theta \times n) + b$ in the middle of
the cell is a 6 x 6 system for the strain $\delta\xi = (\kappa, \upsilon)$, solved by blocks.
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array

from ..numerics import component as c
from ..numerics.component import Matrix, Vector
from ..numerics.quadrature import Grid
from ..numerics.stacked import (
    affine,
    columns,
    cross,
    matmul,
    matvec,
    once,
    rows,
    skew,
    stack,
    transpose,
    turned,
)
from .elimination_nodes import (
    Definiteness,
    Node,
    asymmetry_of,
    definiteness,
    inverse_block,
    node_components,
    nodes_of,
    seen_from,
    turns,
)
from .reaction import Reaction, Slopes


class PoseCell(NamedTuple):
    r"""Coefficients of one cell that do not depend on P.

    - `width` w; `turn`: rotation of the next node's section in this frame; `reaction`: the moment.
    - `lever` $-\frac w2 \tilde u$: the motion in the middle of the cell is $Z (z + \frac w2
      \delta\xi)$ with $Z = (1, 0; \text{lever}, 1)$.
    - `stiff`: the 6 x 6 system without P; `drive`, `right`: its right side per motion, and b.
    - Over the cell the wrench changes by `by_motion` z + `by_strain` $\delta\xi$, without the part
      through P.
    - `jump`: derivative of the load at the end of the cell by its motion, None without such loads;
      `push`: right side of the wrenches there, None without one.
    - `flexible`: 1, or 0 where the section is rigid; None without rigid pieces.
    """

    width: Array
    turn: Array
    reaction: Array
    lever: Array
    stiff: Array
    drive: Array
    right: Array
    by_motion: Array
    by_strain: Array
    jump: Array | None
    push: Array | None
    flexible: Array | None


def eliminate_poses(
    lower: Matrix,
    right: Vector,
    xi: Vector,
    along: Reaction,
    slopes: Slopes,
    grid: Grid,
    free: tuple[int, ...],
    flexible: Array | None = None,
    push: Array | None = None,
) -> tuple[Vector, Definiteness]:
    """As `eliminate`, for motions of size 6.

    **Arguments:** `push`: changes (6, stages, steps, *arms) of the wrenches at the ends of the
    cells in the world frame that do not depend on the motions, a right side too.
    """
    nodes = nodes_of(c.symmetric(lower), right, xi, along, slopes, grid, flexible, push)
    cells = jax.vmap(_cell_of)(nodes, turns(nodes.rotation))
    arms = nodes.weight.shape[1:]
    nothing = jnp.zeros((6, 7, *arms), cells.width.dtype)
    _, (X, negative, asymmetry) = lax.scan(partial(_cell, free), nothing, cells, reverse=True)

    def forward(z: Array, cell: tuple) -> tuple[Array, Array]:
        X, turn, lever, width = jax.tree.map(once, cell)
        strain = affine(X, z)
        middle = z + 0.5 * width * strain
        sheared = rows(middle, 3, 6) + matvec(lever, rows(middle, 0, 3))
        end = 2.0 * jnp.concatenate([rows(middle, 0, 3), sheared]) - z
        return turned(transpose(turn), end), strain

    start = jnp.zeros((6, *arms), X.dtype)
    _, strain = lax.scan(forward, start, (X, cells.turn, cells.lever, cells.width))
    local = jnp.ones(negative.shape, bool)
    return node_components(strain, grid), definiteness(negative, local, asymmetry, grid)


def motions(strain: Vector, xi: Vector, along: Reaction, grid: Grid) -> Array:
    """Rotations and displacements (6, stages, steps, *arms) in the world frame of the ends of the
    cells by a change of strain, as the elimination has them."""
    change = grid.weight * turned(along.rotation, stack(strain))
    axis = grid.weight * matvec(along.rotation, stack(xi[3:]))

    def summed(x: Array) -> Array:
        """Sums over the cells from the base."""
        listed = x.swapaxes(1, 2)
        flat = listed.reshape(3, -1, *listed.shape[3:])
        return jnp.cumsum(flat, axis=1).reshape(listed.shape).swapaxes(1, 2)

    bent = rows(change, 0, 3)
    ends = summed(bent)
    middle = ends - 0.5 * bent
    return jnp.concatenate([ends, summed(cross(middle, axis) + rows(change, 3, 6))])


def _cell_of(node: Node, turn: Array) -> PoseCell:
    """All that does not depend on P, for one node."""
    w = node.weight
    u, m, n = skew(node.axis), skew(rows(node.wrench, 0, 3)), skew(rows(node.wrench, 3, 6))
    none, lever = jnp.zeros_like(n), -0.5 * w * u
    H = _blocks(node.bending, node.mixed, transpose(node.mixed), node.linear)
    by_middle = _blocks(matmul(n, u), none, none, none)
    if node.density is not None:
        by_middle = by_middle + _from_left(lever, seen_from(node.rotation, node.density))
    by_motion = _from_right(w * by_middle, lever)
    by_strain = w * _blocks(none, -n, none, none)
    drive = 0.5 * by_motion + _blocks(m, none, n, none)
    return PoseCell(
        w,
        turn,
        rows(node.wrench, 0, 3),
        lever,
        H - 0.5 * (w * drive + by_strain),
        drive,
        node.right,
        by_motion,
        0.5 * w * by_motion + by_strain,
        None if node.jump is None else seen_from(node.rotation, node.jump),
        None if node.push is None else turned(transpose(node.rotation), node.push),
        node.flexible,
    )


def _cell(free: tuple[int, ...], end: Array, cell: PoseCell) -> tuple[Array, tuple]:
    """One cell, from its end to its start: the affine change of the wrench at the start (6, 7), the
    affine strain by the motion at the start (6, 7), the number of negative pivots and the asymmetry
    of the cell."""
    cell = jax.tree.map(once, cell)
    w, lever = cell.width, cell.lever
    by_motion = seen_from(transpose(cell.turn), columns(end, 0, 6))
    if cell.jump is not None:
        by_motion = by_motion + cell.jump
    constant = turned(cell.turn, end[:, 6])
    if cell.push is not None:
        constant = constant + cell.push
    P = jnp.concatenate([by_motion, constant[:, None]], axis=1)
    middle = _from_left(lever, P)  # of the wrench in the middle of the cell
    square = once(_from_right(columns(middle, 0, 6), lever))
    by_start = 2.0 * square - columns(middle, 0, 6) + cell.drive
    constant = columns(middle, 6, 7) + cell.right[:, None]
    X, negative, compliance = _solved(
        cell.stiff - w * square, jnp.concatenate([by_start, constant], axis=1), free
    )
    if cell.flexible is not None:
        bends = cell.flexible > 0
        X, compliance = (jnp.where(bends, x, 0.0) for x in (X, compliance))
        negative = jnp.where(bends, negative, 0)
    start = 2.0 * middle - P  # of the wrench at the start of the cell, without its own loads
    square = once(_from_right(columns(start, 0, 6), lever))
    by_start = 2.0 * square - columns(start, 0, 6) + cell.by_motion
    start = jnp.concatenate([by_start, columns(start, 6, 7)], axis=1)
    start = start + matmul(w * square + cell.by_strain, X)
    by_rotation = 0.5 * (P[:3, :3] + start[:3, :3])
    return start, (X, negative, asymmetry_of(by_rotation, cell.reaction, compliance))


def _solved(D: Array, right: Array, free: tuple[int, ...]) -> tuple[Array, Array, Array]:
    """Solution of a 6 x 6 system for the free strains, zero for the others, the number of negative
    eigenvalues of the matrix, and the inverse of its bending block."""
    b, below, d = D[:3, 3:], D[3:, :3], D[3:, 3:]
    flexibility, first = inverse_block(d, tuple(i - 3 for i in free if i > 2))
    across = matmul(b, flexibility)
    compliance, second = inverse_block(
        D[:3, :3] - matmul(across, below), tuple(i for i in free if i < 3)
    )
    bent = matmul(compliance, right[:3] - matmul(across, right[3:]))
    stretched = matmul(flexibility, right[3:] - matmul(below, bent))
    return jnp.concatenate([bent, stretched]), first + second, compliance


def _blocks(a: Array, b: Array, below: Array, d: Array) -> Array:
    """Matrix (6, 6, ...) of four blocks."""
    top, bottom = jnp.concatenate([a, b], axis=1), jnp.concatenate([below, d], axis=1)
    return jnp.concatenate([top, bottom])


def _from_left(lever: Array, a: Array) -> Array:
    r"""$Z^T A$ of a matrix with six rows."""
    upper = rows(a, 0, 3) + matmul(transpose(lever), rows(a, 3, 6))
    return jnp.concatenate([upper, rows(a, 3, 6)])


def _from_right(a: Array, lever: Array) -> Array:
    r"""$A Z$ of a matrix with six columns."""
    left = columns(a, 0, 3) + matmul(columns(a, 3, 6), lever)
    return jnp.concatenate([left, columns(a, 3, 6)], axis=1)
