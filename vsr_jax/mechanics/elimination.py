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

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array

from ..numerics import component as c, stacked
from ..numerics.component import Matrix, Tree, Vector
from ..numerics.once import once
from ..numerics.quadrature import Grid
from ..numerics.stacked import matvec, rows, transpose, turned
from .balance import free_block, free_components, spread
from .elimination_nodes import (
    UNSTABLE_SECTION,
    Definiteness,
    at_last_nodes,
    at_node,
    block_of,
    definiteness,
    jumps,
    places_of,
    whole,
)
from .elimination_step import Joint, Link, StepNodes, by_start, condensed, join
from .reaction import Reaction, Slopes


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
    nothing = jnp.zeros((size, 3, *arms), nodes.axis.dtype)
    end, last = (nothing, nothing[:, 0]), -1 - len(arms)  # the axis of the steps
    passed = _node_by_node if arms else _step_by_step
    (by_theta, constant), theta, signs = passed(nodes, end, grid, free)
    found = matvec(by_theta, jnp.moveaxis(theta, 0, last)[:, None]) + constant
    if arms:
        found = found.reshape(6, *grid.X.shape[1::-1], *arms).swapaxes(1, 2)
    found = turned(transpose(nodes.rotation), found)
    # turning a strain into the world frame and back leaves rounding in those that are locked
    strain = spread(free_components(stacked.components(found), free), free)
    return strain, definiteness(*signs, grid)


def _step_by_step(
    nodes: StepNodes, end: tuple[Array, Array], grid: Grid, free: tuple[int, ...]
) -> tuple[tuple[Array, Array], Array, tuple[Array, Array, Array]]:
    """The strain of the nodes of all steps by the rotation at the start and by the right side alone
    (see `by_start`), these rotations (steps, 3), and the arguments of `definiteness`.

    One arm condenses all steps at once. A pass over them then takes and gives few arrays: each
    would be an operation of its own in every step."""
    sections, step, local, stable = condensed(nodes, free)
    link, size = step.link, len(end[0])
    maps = jnp.concatenate([link.turn, link.start])
    given = jnp.concatenate([link.turned, link.started])

    def parted(x: Array) -> tuple[Array, Array]:
        """What belongs to the rotation, and what to the wrench."""
        return rows(x, 0, 3), rows(x, 3, 3 + size)

    def backward(end: tuple, step: tuple) -> tuple[tuple, tuple]:
        maps, given, jump, cut = jax.tree.map(once, step)
        start, (joint, negative) = join(end, Link(*parted(maps), *parted(given), jump, cut))
        maps = jnp.concatenate([joint.turn, joint.wrench, rows(start[0], 0, 3)])
        return start, (maps, jnp.concatenate([joint.turned, joint.pulled]), negative)

    steps = _moved((maps, given, link.jump, link.joined), -1, 0)
    _, (maps, given, negative) = lax.scan(backward, end, steps, reverse=True)
    maps, given = _moved((maps, given), 0, -1)
    (turn, wrench), (turned_end, pulled) = parted(maps), parted(given)
    joint = Joint(turn, turned_end, wrench, pulled)
    theta = _rotations(*_moved((turn, turned_end, link.joined), -1, 0))
    asymmetry = step.asymmetry(rows(maps, 3 + size, 6 + size))
    signs = negative + local, stable, asymmetry
    return by_start(nodes, sections, step, joint), theta, signs


def _node_by_node(
    nodes: StepNodes, end: tuple[Array, Array], grid: Grid, free: tuple[int, ...]
) -> tuple[tuple[Array, Array], Array, tuple[Array, Array, Array]]:
    """As `_step_by_step`, of a batch, one node after another, which stays in the cache."""
    arms, places = nodes.axis.ndim - 3, places_of(grid)
    last, nodes = -1 - arms, _apart(nodes, grid)

    def backward(end: tuple, place: tuple[Array, Array]) -> tuple[tuple, tuple]:
        node = _alone(at_node(nodes, place, arms), last)
        sections, step, local, stable = condensed(node, free)
        start, (joint, negative) = join(end, jax.tree.map(once, step.link))
        strain = by_start(node, sections, step, joint)
        signs = negative + local, stable, step.asymmetry(start[0])
        return start, (strain, joint.turn, joint.turned, signs)

    _, (strain, turn, turned_end, signs) = lax.scan(backward, end, places, reverse=True)
    joined = None if nodes.joined is None else nodes.joined[places]
    theta = _rotations(turn, turned_end, joined)
    return _moved(strain, 0, last), theta, signs


def _rotations(turn: Array, more: Array, joined: Array | None) -> Array:
    """Rotations at the starts of the steps, from the base on."""
    none = jnp.zeros(more.shape[1:], more.dtype)

    def forward(theta: Array, step: tuple) -> tuple[Array, Array]:
        turn, more, joined = jax.tree.map(once, step)
        return c.times(joined, matvec(turn, theta) + more), theta

    return lax.scan(forward, none, (turn, more, joined))[1]


def _nodes(
    H: Matrix,
    right: Vector,
    along: Reaction,
    slopes: Slopes,
    grid: Grid,
    flexible: Array | None,
) -> StepNodes:
    """The nodes of all steps, in the last axes (stages, steps, *arms)."""
    stacks = along.world.shape[1:], along.axis.shape[1:]
    shape = jnp.broadcast_shapes(*(x.shape for x in (*H[0], *right, grid.weight)), *stacks)
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
