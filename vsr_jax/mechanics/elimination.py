r"""The tangent of the balance of all cross-sections, solved by block elimination along the arm.

In the frame of each section a change of strain $(\kappa, \upsilon)$ rotates the sections beyond
it, $\theta' = \kappa$, and changes the reaction at a node. With $(m, n)$ the wrench at the node,
$(\delta m, \delta n)$ its change and $u$ the axis,

$$H \, \delta\xi = (\delta m - \theta \times m, \ \delta n - \theta \times n) + b, \quad
-\delta m' = (\theta \times u + \upsilon) \times n + u \times \delta n + C \theta, \quad
-\delta n' = F \theta,$$

where C and F are the derivatives of the load densities by the rotation. Loads that depend on
positions are the matter of `pose_elimination`. Each node represents a cell whose length is its
weight w, integrated by the midpoint rule. The linear strains depend on other nodes through the
rotations only, so they are eliminated first, for all nodes at once. A pass from the tip to the base
then keeps the change of the wrench as an affine function of the rotation, $P \theta + p$, and
solves a 3 x 3 system per cell; a pass from the base to the tip gives the rotations. The error of
the tangent is of the order of the distance between nodes: as a preconditioner of the exact one it
gains one to two digits per application.
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array

from ..numerics import component as c, stacked
from ..numerics.component import Matrix, Vector
from ..numerics.quadrature import Grid
from ..numerics.stacked import affine, columns, matmul, matvec, once, rows, skew, transpose
from .balance import free_block, free_components, spread
from .elimination_nodes import (
    UNSTABLE_SECTION,
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


class EliminationCell(NamedTuple):
    r"""Coefficients of one cell that do not depend on P, in the frame of its section. An affine
    function of the rotation $\theta$ at its start is a matrix with the constant as fourth column.

    - `width` w; `turn`: rotation of the next node's section in this frame; `reaction`: the moment.
    - $\kappa = $ `compliance` $\delta m$ + `by_theta` $\theta$, affine, with $\delta m$ the part
      from P at the middle of the cell.
    - Over the cell the moment changes by `moment` $\theta$ (affine) + `by_bend` $\kappa$.
    - With loads that turn only, else None: the effect of the change of the force on the strain,
      `by_push`, and on the moment, `stretch`; the `axis` u; `force`, the change of the force over
      half the cell per rotation (None without density); `jump`, the derivative of the wrench at the
      end of the cell (None without points).
    """

    width: Array
    turn: Array
    reaction: Array
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
    slopes: Slopes | None,
    grid: Grid,
    free: tuple[int, ...],
) -> tuple[Vector, Definiteness]:
    r"""Solution of the tangent system with the right side $b$ for the free strains, and the
    `Definiteness` of the tangent.

    **Arguments:** node arrays of shape (stages, steps, *arms).
    - `lower`: lower triangle of $H$.
    - `right`: $b$, six components.
    - `xi`, `along`, `slopes`: the strain where the tangent is taken, its reaction and the
      derivatives of the loads. Without loads only $H$ is solved, node by node.

    **Returns:** six components, zero for the locked strains; meaningless where the tangent is not
    definite.
    """
    if along is None or slopes is None or min(free) > 2:
        x = c.cholesky_solve(c.cholesky(free_block(lower, free)), free_components(right, free))
        unstable = jnp.any(jnp.isnan(x[-1]), axis=(0, 1))
        negative = jnp.where(unstable, UNSTABLE_SECTION, 0).astype(jnp.int32)
        return spread(x, free), Definiteness(negative, jnp.zeros_like(unstable))
    nodes = nodes_of(c.symmetric(lower), right, xi, along, slopes, grid)
    follows = slopes.motion > 0
    of_node = partial(_cell_of, free=free, follows=follows)
    relative, arms = turns(nodes.rotation), nodes.weight.shape[1:]
    nothing = jnp.zeros((6 if follows else 3, 4, *arms), nodes.weight.dtype)
    if arms:  # of a batch one cell at a time, which stays in the cache

        def backward(end: Array, node: tuple[Node, Array]) -> tuple[Array, tuple]:
            cell, linear, local = of_node(*jax.tree.map(once, node))
            start, found = _cell(end, cell)
            return start, (found, linear, local)

        _, ((X, push, negative, asymmetry), linear, local) = lax.scan(
            backward, nothing, (nodes, relative), reverse=True
        )
    else:
        cells, linear, local = jax.vmap(of_node)(nodes, relative)
        _, (X, push, negative, asymmetry) = lax.scan(_cell, nothing, cells, reverse=True)

    def forward(theta: Array, cell: tuple) -> tuple[Array, tuple[Array, Array]]:
        X, turn, width = jax.tree.map(once, cell)
        kappa = affine(X, theta)
        return matvec(transpose(turn), theta + width * kappa), (theta, kappa)

    start = jnp.zeros((3, *arms), X.dtype)
    _, (theta, kappa) = lax.scan(forward, start, (X, relative, nodes.weight))
    strain = jax.vmap(_strain)(linear, nodes.weight, push, theta, kappa)
    return node_components(strain, grid), definiteness(negative, local, asymmetry, grid)


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
    node: Node, turn: Array, free: tuple[int, ...], follows: bool
) -> tuple[EliminationCell, EliminatedLinear, Array]:
    """All that does not depend on P, for one node, and whether its section is stable by itself."""
    w = node.weight
    half, n = 0.5 * w, skew(rows(node.wrench, 3, 6))
    R = node.rotation
    density = None if node.density is None else seen_from(R, node.density)
    moment, by_force, force = _per_rotation(n, skew(node.axis), density, half)
    moment = once(half * moment)
    by_theta = moment + skew(rows(node.wrench, 0, 3))
    flexibility, stretching = inverse_block(node.linear, tuple(i - 3 for i in free if i > 2))
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
    compliance, bending = inverse_block(once(stiff), tuple(i for i in free if i < 3))
    lever = -w * n  # moment over the cell per linear strain
    doubled = jnp.concatenate([2.0 * moment, jnp.zeros_like(right[:3])], axis=1)
    cell = EliminationCell(
        w,
        turn,
        rows(node.wrench, 0, 3),
        compliance,
        matmul(compliance, drive),
        doubled + matmul(lever, matmul(flexibility, linear)),
        w * moment - matmul(lever, by_bend),
    )
    if follows:
        cell = cell._replace(
            by_push=-matmul(compliance, D),
            stretch=matmul(lever, flexibility),
            axis=node.axis,
            force=force,
            jump=None if node.jump is None else seen_from(R, node.jump),
        )
    stable = (bending == 0) & (stretching == 0)
    return cell, EliminatedLinear(flexibility, linear, by_bend), stable


def _per_rotation(
    n: Array, u: Array, density: Array | None, half: Array
) -> tuple[Array, Array, Array | None]:
    """Derivatives by the rotation of a section, without those through P: of the change of the
    moment per length, of the force, and of the change of the force over half a cell, which is None
    without follower density."""
    if density is None:
        return matmul(n, u), n, None
    force = half * density[3:]
    return matmul(n, u) + matmul(u, force) + density[:3], n + force, force


def _cell(end: Array, cell: EliminationCell) -> tuple[Array, tuple]:
    r"""One cell, from its end to its start: the affine change of the wrench at the start, (3, 4) or
    with follower loads (6, 4); the affine bending $X \theta$ by the rotation at the start, and the
    number of negative pivots and the asymmetry of the cell."""
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
    by_rotation = 0.5 * (columns(P[:3], 0, 3) + columns(start, 0, 3))
    asymmetry = asymmetry_of(by_rotation, cell.reaction, cell.compliance)
    if cell.axis is None:
        return start, (X, None, negative, asymmetry)
    force, by_bend = P[3:], width * columns(P[3:], 0, 3)
    if cell.force is not None:
        by_bend = by_bend + width * cell.force
        none = jnp.zeros_like(columns(force, 3, 4))
        force = force + jnp.concatenate([2.0 * cell.force, none], axis=1)
    return jnp.concatenate([start, force + matmul(by_bend, X)]), (X, P[3:], negative, asymmetry)


def _seen_from_here(P: Array, cell: EliminationCell) -> Array:
    """P at the start of the next cell in the frame of this node, including the load between
    them."""
    parts = []
    for i in range(0, P.shape[0], 3):
        seen = matmul(cell.turn, rows(P, i, i + 3))
        by_theta = matmul(columns(seen, 0, 3), transpose(cell.turn))
        if cell.jump is not None:
            by_theta = by_theta + rows(cell.jump, i, i + 3)
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
