r"""One step of the elimination along a chain (see `step_passes`): its nodes, the step without what
lies beyond it, and the step joined with that."""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array

from ..numerics import component as c, stacked
from ..numerics.loops import fori_loop
from ..numerics.once import once
from ..numerics.quadrature import collocation, gauss_legendre, remaining, weighted
from ..numerics.stacked import (
    columns,
    matmul,
    matvec,
    product,
    rows,
    skew,
    total,
    transpose,
    turned,
)
from .definiteness import asymmetry_of, inverse_block


class StepNodes(NamedTuple):
    r"""What the elimination needs of the nodes of a step, in the world frame but for H and b: the
    length h of the step; the rotations, the blocks of H (3, 3), the right side b (6), the axis u,
    the wrench (6) and its density (6); the derivatives (6, 3) of the load density at the nodes and
    of the loads at the end of the step by rotations, None where there are none; `flexible` of the
    sections.

    Behind the components come the axis of the nodes (but for h and `jump`) and those of steps or
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


class Link(NamedTuple):
    r"""What a step passes on between its ends. The columns of a map belong to $(\theta_0, \delta
    m_1, \delta n_1)$: the rotation at the start, and the change of the wrench at the end, of the
    moment alone if no load turns. To each belongs a vector, its value by the right side alone.

    - `turn` (3, columns), `turned`: rotation at the end.
    - `start` (wrench, columns), `started`: change of the wrench at the start.
    - `jump` (6, 3): derivative of the loads at the end by their rotation, None without such loads.
    """

    turn: Array
    start: Array
    turned: Array
    started: Array
    jump: Array | None


class Condensed(NamedTuple):
    r"""A step without what lies beyond it: its `Link`; the bending $\kappa$ of the nodes in the
    same way, `bend` (3, columns, nodes) and `bent`; the moment at the start and the compliance of
    the first node."""

    link: Link
    bend: Array
    bent: Array
    moment: Array
    compliance: Array

    def asymmetry(self, P: Array) -> Array:
        """`asymmetry_of` the arm from the start on, from the change of the wrench there by the
        rotation."""
        return asymmetry_of(rows(P, 0, 3), self.moment, self.compliance)


class Joint(NamedTuple):
    """A step with all that lies beyond it: by the rotation at its start, and by the right side
    alone, the rotation at its end, `turn` (3, 3) and `turned`, and the change of the wrench there,
    `wrench` (wrench, 3) and `pulled`."""

    turn: Array
    turned: Array
    wrench: Array
    pulled: Array


def _constant(weights: np.ndarray, like: Array) -> Array:
    """Constants in front of the axes of an array."""
    return jnp.asarray(weights, like.dtype).reshape(*weights.shape, *(1,) * like.ndim)


def condensed(node: StepNodes, free: tuple[int, ...]) -> tuple[Sections, Condensed, Array, Array]:
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
    link = Link(turn, start, h * weighted(weights, bent, 1), started, node.jump)
    moment = node.wrench[:3, 0] + before
    step = Condensed(link, X, bent, moment, sections.compliance[:, :, 0])
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
    inverse, negative = fori_loop(0, stages, eliminate, (system, negative))
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


def join(end: tuple[Array, Array], step: Link) -> tuple[tuple[Array, Array], tuple[Joint, Array]]:
    """One step, from P and p at its end to those at its start; its `Joint` and the number of
    negative pivots."""
    P, p = end
    if step.jump is not None:
        P = P + step.jump
    by_end = columns(step.turn, 3, step.turn.shape[1])
    inverse, negative = _inverse_pivot(once(stacked.identity(P) - product(by_end, P)))
    turn = matmul(inverse, columns(step.turn, 0, 3))
    turned_end = once(matvec(inverse, step.turned + matvec(by_end, p)))
    wrench, pulled = matmul(P, turn), once(matvec(P, turned_end) + p)
    by_end = columns(step.start, 3, step.start.shape[1])
    start = columns(step.start, 0, 3) + matmul(by_end, wrench)
    started = step.started + matvec(by_end, pulled)
    return (start, started), (Joint(turn, turned_end, wrench, pulled), negative)


def by_start(
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
