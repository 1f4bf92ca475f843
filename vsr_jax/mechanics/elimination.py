r"""The tangent of the balance of all cross-sections, solved by block elimination along the arm.

In the world frame a change of strain $(\kappa, \upsilon)$ rotates the sections beyond it, $\theta'
= \kappa$, and changes the reaction at a node. With $(m, n)$ the wrench at the node, $(\delta m,
\delta n)$ its change and $u = p'$ the axis,

$$H \, \delta\xi = (\delta m - \theta \times m, \ \delta n - \theta \times n) + b, \quad
-\delta m' = (\theta \times u + \upsilon) \times n + u \times \delta n + C \theta, \quad
-\delta n' = F \theta,$$

where C and F are the derivatives of the load densities by the rotation. Loads that depend on
positions are the matter of `pose_elimination`. The integrals over a step are those of the residual,
exact for polynomials through its nodes (Gauss collocation), so that the tangent differs from the
exact one only by the derivative of the rotations within a step, of the order of the steps.

The linear strains are eliminated at each node. The balance of the nodes of a step, a system of 3 x
3 blocks, then gives their bending by the rotation at the start of the step, the wrench at its end
and the right side. A pass from the tip to the base keeps the change of the wrench as an affine
function of the rotation, $P \theta + p$, and solves a 3 x 3 system per step; a pass from the base
to the tip gives the rotations. Matrices and the vectors that depend on b are kept apart, so that
the derivative by b and its transpose are small programs.

In a batch of arms each node is a step of its own, whose length is its weight (the midpoint rule).
That tangent is off by some percent, but a solve takes only one or two steps more, each with half
the memory traffic, which is what bounds a batch.
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array

from ..numerics import component as c, stacked
from ..numerics.component import Matrix, Tree, Vector
from ..numerics.once import once
from ..numerics.quadrature import Grid, collocation, gauss_legendre, remaining, weighted
from ..numerics.stacked import columns, matmul, matvec, rows, skew, total, transpose, turned
from .balance import free_block, free_components, spread
from .elimination_nodes import (
    UNSTABLE_SECTION,
    Definiteness,
    asymmetry_of,
    at_last_nodes,
    at_node,
    block_of,
    definiteness,
    inverse_block,
    jumps,
    places_of,
    whole,
)
from .reaction import Reaction, Slopes


class StepNodes(NamedTuple):
    r"""What the elimination needs of the nodes of a step, in the world frame but for H and b: the
    length h of the step; the rotations, the blocks of H (3, 3), the right side b (6), the axis u,
    the wrench (6) and its density (6); the derivatives (6, 3) of the load density at the nodes and
    of the loads at the end of the step by rotations, None where there are none; `flexible` of the
    sections.

    Behind the components come the axis of the nodes (but for h, `jump` and
    `joined`) and those of steps or
    arms.
    """

    h: Array
    rotation: Array
    bending: Array
    mixed: Array
    linear: Array
    right: Array
    axis: Array
    wrench: Array
    density: Array
    slope: Array | None
    jump: Array | None
    flexible: Array | None
    joined: Array | None


class Sections(NamedTuple):
    """The nodes of a step each alone, in the world frame: the `compliance` of bending, the
    `flexibility` of the linear strains, the bending moment `across` per force on them, the change
    of the moment per length `pull` by the linear strain that a force causes; the bending `moment`
    and the `force` of the right side."""

    compliance: Array
    flexibility: Array
    across: Array
    pull: Array
    moment: Array
    force: Array


class Condensed(NamedTuple):
    r"""A step without what lies beyond it. The columns of a map belong to $(\theta_0, \delta m_1,
    \delta n_1)$: the rotation at the start, and the change of the wrench at the end, of the moment
    alone if no load turns. To each belongs a vector, its value by the right side alone.

    - `bend` (3, columns, nodes), `bent`: bending $\kappa$ of the nodes.
    - `turn` (3, columns), `turned`: rotation at the end.
    - `start` (wrench, columns), `started`: change of the wrench at the start.
    - `jump` (6, 3): derivative of the loads at the end by their rotation, None without such loads.
    - `joined`: 0 where the arm is cut at the end, 1 where it is not; None without cuts.
    - `moment`, `compliance`: the moment at the start and the compliance of the first node.
    """

    bend: Array
    turn: Array
    start: Array
    bent: Array
    turned: Array
    started: Array
    jump: Array | None
    joined: Array | None
    moment: Array
    compliance: Array


class Joint(NamedTuple):
    """A step with all that lies beyond it: by the rotation at its start, and by the right side
    alone, the rotation at its end, `turn` (3, 3) and `turned`, and the change of the wrench there,
    `wrench` (wrench, 3) and `pulled`."""

    turn: Array
    turned: Array
    wrench: Array
    pulled: Array


def eliminate(
    lower: Matrix,
    right: Vector,
    along: Reaction | None,
    slopes: Slopes | None,
    grid: Grid,
    free: tuple[int, ...],
    flexible: Array | None = None,
) -> tuple[Vector, Definiteness]:
    r"""Solution of the tangent system with the right side $b$ for the free strains, and the
    `Definiteness` of the tangent.

    **Arguments:** node arrays of shape (stages, steps, *arms).
    - `lower`: lower triangle of $H$.
    - `right`: $b$, six components.
    - `along`, `slopes`: the reaction where the tangent is taken, and the derivatives of the loads.
      Without loads only $H$ is solved, node by node.
    - `free`: the strains that are not locked.
    - `flexible`: 0 on rigid pieces and 1 elsewhere, None without rigid pieces.

    **Returns:** six components, zero for the locked strains and on rigid pieces; meaningless where
    the tangent is not definite.
    """
    if along is None or slopes is None or min(free) > 2:
        right = c.times(flexible, right)
        x = c.cholesky_solve(c.cholesky(free_block(lower, free)), free_components(right, free))
        unstable = jnp.any(jnp.isnan(x[-1]), axis=(0, 1))
        negative = jnp.where(unstable, UNSTABLE_SECTION, 0).astype(jnp.int32)
        return spread(x, free), Definiteness(negative, jnp.zeros_like(unstable))
    nodes = _nodes(c.symmetric(lower), right, along, slopes, grid, flexible)
    arms, size = nodes.axis.shape[3:], 6 if slopes.motion else 3
    last = -1 - len(arms)  # the axis of the steps
    nothing = jnp.zeros((size, 3, *arms), nodes.axis.dtype)
    end, joined = (nothing, nothing[:, 0]), nodes.joined
    if arms:  # of a batch one step at a time, which stays in the cache
        places = places_of(grid)
        nodes = _apart(nodes, grid)
        joined = None if nodes.joined is None else nodes.joined[places]

        def backward(end: tuple, place: tuple[Array, Array]) -> tuple[tuple, tuple]:
            node = _alone(at_node(nodes, place, len(arms)), last)
            sections, step, *found = _condensed(node, free)
            start, (joint, *others) = _joined(end, step)
            strain = _by_start(node, sections, step, joint)
            return start, (joint.turn, joint.turned, strain, *found, *others)

        _, found = lax.scan(backward, end, places, reverse=True)
        turn, turned_end, strain, local, stable, negative, asymmetry = found
        strain = _moved(strain, 0, last)
    else:
        sections, step, local, stable = _condensed(nodes, free)
        _, found = lax.scan(_joined, end, _moved(step, last, 0), reverse=True)
        joint, negative, asymmetry = found
        turn, turned_end = joint.turn, joint.turned
        strain = _by_start(nodes, sections, step, _moved(joint, 0, last))

    def forward(theta: Array, step: tuple) -> tuple[Array, Array]:
        turn, more, joined = jax.tree.map(once, step)
        return c.times(joined, matvec(turn, theta) + more), theta

    _, theta = lax.scan(forward, nothing[:3, 0], (turn, turned_end, joined))
    by_theta, constant = strain
    found = matvec(by_theta, jnp.moveaxis(theta, 0, last)[:, None]) + constant
    if arms:
        found = found.reshape(6, *grid.X.shape[1::-1], *arms).swapaxes(1, 2)
    found = turned(transpose(nodes.rotation), found)
    # turning a strain into the world frame and back leaves rounding in those that are locked
    strain = spread(free_components(stacked.components(found), free), free)
    return strain, definiteness(negative + local, stable, asymmetry, grid)


def _nodes(
    H: Matrix,
    right: Vector,
    along: Reaction,
    slopes: Slopes,
    grid: Grid,
    flexible: Array | None,
) -> StepNodes:
    """The nodes of all steps, in the last axes (stages, steps, *arms)."""
    everything = (*H[0], *right, grid.weight, *along.world, *along.axis)
    shape = jnp.broadcast_shapes(*(x.shape for x in everything))
    jump, all_of = jumps(slopes, grid), partial(whole, shape=shape)
    return StepNodes(
        jnp.broadcast_to(grid.h, shape[1:]),
        all_of(along.rotation),
        block_of(H, 0, 0, shape),
        block_of(H, 0, 3, shape),
        block_of(H, 3, 3, shape),
        jnp.stack([all_of(x) for x in right]),
        all_of(along.axis),
        all_of(along.world),
        all_of(along.density),
        None if slopes.density is None else all_of(slopes.density),
        None if jump is None else jnp.broadcast_to(jump, (*jump.shape[:2], *shape[1:])),
        None if flexible is None else all_of(flexible),
        None if slopes.joined is None else jnp.broadcast_to(slopes.joined, shape[1:]),
    )


def _apart(nodes: StepNodes, grid: Grid) -> StepNodes:
    """Each node as a step of its own, whose length is its weight."""
    stages, jump, joined = grid.X.shape[0], nodes.jump, nodes.joined
    return nodes._replace(
        h=jnp.broadcast_to(grid.weight, nodes.axis.shape[1:]),
        jump=None if jump is None else at_last_nodes(jump, stages),
        joined=None
        if joined is None
        else 1.0 - at_last_nodes(1.0 - joined[None, None], stages)[0, 0],
    )


def _alone(node: StepNodes, last: int) -> StepNodes:
    """A step of one node, with the axis of nodes in the place before the last axes."""
    step = jax.tree.map(lambda x: jnp.expand_dims(x, last), node)
    return step._replace(h=node.h, jump=node.jump, joined=node.joined)


def _moved(tree: Tree, source: int, destination: int) -> Tree:
    """Arrays with one axis moved."""
    return jax.tree.map(lambda x: jnp.moveaxis(x, source, destination), tree)


def _constant(weights: np.ndarray, like: Array) -> Array:
    """Constants in front of the axes of an array."""
    return jnp.asarray(weights, like.dtype).reshape(*weights.shape, *(1,) * like.ndim)


def _condensed(node: StepNodes, free: tuple[int, ...]) -> tuple[Sections, Condensed, Array, Array]:
    """The sections of a step and the step, the number of negative pivots of its system, and whether
    its sections are stable by themselves."""
    stages, h, rest = node.axis.shape[1], node.h, remaining(node.axis.shape[1])
    weights = gauss_legendre(stages)[1]
    n = skew(rows(node.wrench, 3, 6))
    sections, stable = _sections(node, n, free)
    by_end, by_bend = _moments(node, n, sections)
    compliance, negative = _compliance(sections.compliance, by_bend[:3, :, :stages])
    X = total(matmul(compliance, by_end[:3, :, None, :stages]), 3)
    start, turning = by_end[:, :, stages], by_bend[:, :, stages]
    start = start + total(matmul(turning, X), 2)
    turn = h * weighted(weights, X, 2) + _constant(np.eye(3, X.shape[1]), h)
    density = -h * weighted(rest, matvec(sections.pull, sections.force), 1)
    moment = sections.moment + density[:, :stages]
    bent = once(total(matvec(compliance, moment[:, None]), 2))
    started = total(matvec(turning, bent), 1)
    started = jnp.concatenate([rows(started, 0, 3) + density[:, stages], started[3:]])
    before = h * weighted(collocation(stages)[0], rows(node.density, 0, 3), 1)
    step = Condensed(
        X,
        turn,
        start,
        bent,
        h * weighted(weights, bent, 1),
        started,
        node.jump,
        node.joined,
        node.wrench[:3, 0] + before,
        sections.compliance[:, :, 0],
    )
    return sections, step, negative, stable


def _sections(node: StepNodes, n: Array, free: tuple[int, ...]) -> tuple[Sections, Array]:
    """The nodes of a step each alone, and whether their sections are stable by themselves."""
    linear, below = inverse_block(node.linear, tuple(i - 3 for i in free if i > 2))
    linear = c.times(node.flexible, linear)
    across = matmul(node.mixed, linear)
    stiff = once(node.bending - matmul(across, transpose(node.mixed)))
    compliance, negative = inverse_block(stiff, tuple(i for i in free if i < 3))
    compliance = c.times(node.flexible, compliance)
    R = node.rotation[:, :, None]
    three = jnp.stack([compliance, linear, across], axis=2)
    three = matmul(matmul(R, three), transpose(R))
    compliance, linear, across = (three[:, :, i] for i in range(3))
    b = turned(node.rotation, node.right)
    force = rows(b, 3, 6)
    moment = rows(b, 0, 3) - matvec(across, force)
    stable = jnp.all((negative == 0) & (below == 0), axis=0)
    return Sections(compliance, linear, across, matmul(n, linear), moment, force), stable


def _moments(node: StepNodes, n: Array, sections: Sections) -> tuple[Array, Array]:
    r"""The moment that bends each node, and in the last place the change of the wrench at the start
    of the step, as maps: of $(\theta_0, \delta m_1, \delta n_1)$, (wrench, columns, places), and
    of the bending of the nodes, (wrench, 3, places, nodes). Only the last place has a force."""
    stages, h, D, pull = node.axis.shape[1], node.h, sections.across, sections.pull
    u, m = skew(node.axis), skew(rows(node.wrench, 0, 3))
    rest, only = remaining(stages), np.eye(stages + 1, stages)
    beyond, here = h * _constant(rest, h), _constant(only, h)
    density = matmul(n, u) - matmul(pull, n)  # of the moment, by the rotation
    if node.slope is not None:
        density = density + node.slope[:3]
    by_theta = beyond * density[:, :, None] + here * (m - matmul(D, n))[:, :, None]
    by_bend = beyond * matmul(n, transpose(D))[:, :, None]
    same = jnp.zeros((3, 3, stages + 1, *h.shape), h.dtype) + _constant(
        np.eye(3), by_theta[0, 0, 0]
    )
    by_end = [same]
    if node.slope is not None or node.jump is not None:
        by_force = once(beyond * (u - pull)[:, :, None] - here * D[:, :, None])
        force = jnp.zeros_like(by_theta)
        if node.slope is not None:
            force = beyond * node.slope[3:][:, :, None]
            change = matmul(by_force[:, :, :, :, None], force[:, :, None, :stages])
            by_theta = by_theta + total(change, 3)
        none = jnp.zeros_like(same)
        by_theta, by_bend = (
            jnp.concatenate(pair) for pair in ((by_theta, force), (by_bend, jnp.zeros_like(force)))
        )
        by_end = [jnp.concatenate([same, none]), jnp.concatenate([total(by_force, 3), same])]
    by_theta = once(by_theta)
    by_bend = by_bend + h * weighted(collocation(stages).T, by_theta, 3)
    return jnp.concatenate([total(by_theta, 3), *by_end], axis=1), by_bend


def _compliance(C: Array, by_bend: Array) -> tuple[Array, Array]:
    r"""Solution B (3, 3, i, j) of $B_{ij} = C_i (1_{ij} + \sum_k A_{ik} B_{kj})$, and the number of
    negative eigenvalues of the pivots.

    The inverse of $1 - C A$ by blocks, in place: one pivot after another, in a loop of the
    program.
    """
    stages, one = C.shape[2], stacked.identity(C[:, :, 0])
    places = jnp.arange(stages)
    same = _constant(np.eye(stages), C[0, 0, 0])
    system = one[:, :, None, None] * same - matmul(C[:, :, :, None], by_bend)

    def eliminate(place: Array, state: tuple) -> tuple:
        system, negative = state
        here = (places == place).reshape(-1, *(1,) * negative.ndim)
        row = lax.dynamic_index_in_dim(system, place, 2, keepdims=False)
        column = lax.dynamic_index_in_dim(system, place, 3)
        inverse, below = _inverse_pivot(lax.dynamic_index_in_dim(row, place, 2, keepdims=False))
        row = matmul(inverse[:, :, None], jnp.where(here, one[:, :, None], row))
        others = jnp.where(here, 0.0, system) - matmul(column, row[:, :, None])
        return once(jnp.where(here[:, None], row[:, :, None], others)), negative + below

    negative = jnp.zeros(C.shape[3:], jnp.int32)
    inverse, negative = lax.fori_loop(0, stages, eliminate, (system, negative))
    return matmul(inverse, C[:, :, None]), negative


def _inverse_pivot(pivot: Array) -> tuple[Array, Array]:
    """Inverse and number of negative eigenvalues of a 3 x 3 matrix with real ones: three minus the
    sign changes of its characteristic polynomial."""
    adjugate, det = stacked.adjugate(pivot)
    first, second, third = stacked.trace(pivot) > 0, stacked.trace(adjugate) > 0, det > 0
    changes = (first, first == second, second == third)
    negative = 3 - sum(
        (change.astype(jnp.int32) for change in changes), jnp.zeros(det.shape, jnp.int32)
    )
    return adjugate / det, negative


def _joined(end: tuple[Array, Array], step: Condensed) -> tuple[tuple, tuple[Joint, Array, Array]]:
    """One step, from P and p at its end to those at its start; its `Joint`, the number of negative
    pivots and the asymmetry."""
    step = jax.tree.map(once, step)  # fused with a use of theirs, slices of the scan are slow
    P, p = end
    if step.joined is not None:
        P, p = step.joined * P, step.joined * p
    if step.jump is not None:
        P = P + step.jump
    by_end = columns(step.turn, 3, step.turn.shape[1])
    inverse, negative = _inverse_pivot(stacked.identity(P) - matmul(by_end, P))
    turn = matmul(inverse, columns(step.turn, 0, 3))
    turned_end = once(matvec(inverse, step.turned + matvec(by_end, p)))
    wrench, pulled = matmul(P, turn), once(matvec(P, turned_end) + p)
    by_end = columns(step.start, 3, step.start.shape[1])
    start = columns(step.start, 0, 3) + matmul(by_end, wrench)
    asymmetry = asymmetry_of(start[:3], step.moment, step.compliance)
    joint = Joint(turn, turned_end, wrench, pulled)
    return (start, step.started + matvec(by_end, pulled)), (joint, negative, asymmetry)


def _by_start(
    node: StepNodes, sections: Sections, step: Condensed, joint: Joint
) -> tuple[Array, Array]:
    """The strain of the nodes in the world frame by the rotation at the start, (6, 3, nodes), and
    by the right side alone, (6, nodes)."""
    stages, h = node.axis.shape[1], node.h
    by_end = columns(step.bend, 3, step.bend.shape[1])
    kappa = once(columns(step.bend, 0, 3) + matmul(by_end, joint.wrench[:, :, None]))
    bent = once(step.bent + matvec(by_end, joint.pulled[:, None]))
    theta = h * weighted(collocation(stages), kappa, 2) + _constant(np.eye(3), kappa[0, 0])
    turns = h * weighted(collocation(stages), bent, 1)
    theta, turns = once(theta), once(turns)
    back, across = transpose(sections.pull), transpose(sections.across)
    upsilon = -matmul(back, theta) - matmul(across, kappa)
    force = sections.force
    if joint.wrench.shape[0] == 6:
        push, pushed = joint.wrench[3:, :, None], joint.pulled[3:, None]
        if node.slope is not None:
            by_turn, rest = node.slope[3:], remaining(stages)[:-1]
            push = push + h * weighted(rest, matmul(by_turn, theta), 2)
            pushed = pushed + h * weighted(rest, matvec(by_turn, turns), 1)
        upsilon = upsilon + matmul(sections.flexibility, push)
        force = force + pushed
    stretched = matvec(sections.flexibility, force) - matvec(back, turns) - matvec(across, bent)
    return jnp.concatenate([kappa, upsilon]), jnp.concatenate([bent, stretched])
