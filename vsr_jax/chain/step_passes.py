r"""Passes along a chain whose sections act on each other by their turns alone: its product, and its
solution by block elimination.

In the world frame a change of strain $(\kappa, \upsilon)$ rotates the sections beyond it, $\theta'
= \kappa$, and changes the reaction at a node. With $(m, n)$ the wrench at the node, $(\delta m,
\delta n)$ its change and $u = p'$ the axis,

$$H \, \delta\xi = (\delta m - \theta \times m, \ \delta n - \theta \times n) + b, \quad
-\delta m' = (\theta \times u + \upsilon) \times n + u \times \delta n + C \theta, \quad
-\delta n' = F \theta,$$

where C and F are the derivatives of the load densities by the rotation. Loads that depend on
positions are the matter of `hinges`. The integrals over a step are those of the residual, exact for
polynomials through its nodes (Gauss collocation), so that the matrix differs from the derivative of
the residual only by that of the rotations within a step, of the order of the steps.

The linear strains are eliminated at each node. The balance of the nodes of a step, a system of 3 x
3 blocks, then gives their bending by the rotation at the start of the step, the wrench at its end
and the right side. A pass from the tip to the base keeps the change of the wrench as an affine
function of the rotation, $P \theta + p$, and solves a 3 x 3 system per step; a pass from the base
to the tip gives the rotations. Matrices and the vectors that depend on b are kept apart, so that
the derivative by b and its transpose are small programs.

In a batch of arms each node is a step of its own, whose length is its weight (the midpoint rule).
That matrix is off by some percent, but a solve takes only one or two steps more, each with half the
memory traffic, which is what bounds a batch.
"""

from functools import partial

import jax
import jax.numpy as jnp
from jaxtyping import Array

from ..numerics.component import Matrix, Tree
from ..numerics.loops import scan
from ..numerics.once import once
from ..numerics.quadrature import Grid, collocation, gauss_legendre, remaining, weighted
from ..numerics.stacked import cross, matvec, rows
from .coupled import Coupled
from .nodes import at_last_nodes, at_node, block_of, by_place, places_of, whole
from .steps import Joint, Link, StepNodes, by_start, condensed, join


def solved_by_steps(
    nodes: StepNodes, grid: Grid, free: tuple[int, ...]
) -> tuple[Array, Array, Array, Array]:
    """The strain in the world's axes, (6, stages, steps, *arms), and for each step the number of
    negative pivots, whether its sections are stable by themselves, and the asymmetry."""
    arms = nodes.axis.ndim - 3
    turning = nodes.slope is not None or nodes.jump is not None
    nothing = jnp.zeros((6 if turning else 3, 3, *nodes.axis.shape[3:]), nodes.axis.dtype)
    passed = _node_by_node if arms else _step_by_step
    (by_theta, constant), theta, signs = passed(nodes, (nothing, nothing[:, 0]), grid, free)
    found = matvec(by_theta, jnp.moveaxis(theta, 0, -1 - arms)[:, None]) + constant
    return by_place(found[:, 0], grid, arms) if arms else found, *signs


def changes_by_steps(nodes: StepNodes, strain: Array, grid: Grid) -> Array:
    r"""What a change of strain in the world's axes does to the wrenches on the sections,
    $(\delta m - \theta \times m, \ \delta n - \theta \times n)$, both (6, stages, steps, *arms)."""
    arms = nodes.axis.ndim - 3
    last = -1 - arms
    places = places_of(grid) if arms else (jnp.arange(len(grid.h)),)
    nodes = _apart(nodes, grid) if arms else nodes

    def own(place: tuple[Array, ...]) -> tuple[StepNodes, Array]:
        node, change = at_node((nodes, strain), place, arms)
        return (_alone(node, last), jnp.expand_dims(change, last)) if arms else (node, change)

    def forward(theta: Array, place: tuple[Array, ...]) -> tuple[Array, tuple[Array, Array]]:
        node, change = own(place)
        kappa, h, stages = rows(change, 0, 3), node.h, change.shape[1]
        turns = theta[:, None] + h * weighted(collocation(stages), kappa, 1)
        end = theta + h * weighted(gauss_legendre(stages)[1], kappa, 1)
        return end, (turns, end)

    def backward(beyond: Array, step: tuple) -> tuple[Array, Array]:
        (turns, end), place = step
        node, change = own(place)
        if node.jump is not None:
            beyond = beyond + matvec(node.jump, end)
        moment, force = (rows(beyond, i, i + 3)[:, None] for i in (0, 3))
        m, n = rows(node.wrench, 0, 3), rows(node.wrench, 3, 6)
        density = jnp.zeros_like(change)
        if node.slope is not None:
            density = matvec(node.slope, turns)
        rest = remaining(change.shape[1])
        forces = force + node.h * weighted(rest, rows(density, 3, 6), 1)
        shift = cross(turns, node.axis) + rows(change, 3, 6)
        lever = cross(shift, n) + cross(node.axis, forces[:, :-1])
        moments = moment + node.h * weighted(rest, lever + rows(density, 0, 3), 1)
        wrench = moments[:, :-1] - cross(turns, m), forces[:, :-1] - cross(turns, n)
        return jnp.concatenate([moments[:, -1], forces[:, -1]]), jnp.concatenate(wrench)

    none = jnp.zeros_like(strain[:, 0, 0])
    _, turns = scan(forward, none[:3], places)
    _, found = scan(backward, none, (turns, places), reverse=True)
    found = jnp.moveaxis(found, 0, -1 - arms)
    return by_place(found[:, 0], grid, arms) if arms else found


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
        maps, given, jump = jax.tree.map(once, step)
        start, (joint, negative) = join(end, Link(*parted(maps), *parted(given), jump))
        maps = jnp.concatenate([joint.turn, joint.wrench, rows(start[0], 0, 3)])
        return start, (maps, jnp.concatenate([joint.turned, joint.pulled]), negative)

    steps = _moved((maps, given, link.jump), -1, 0)
    _, (maps, given, negative) = scan(backward, end, steps, reverse=True)
    maps, given = _moved((maps, given), 0, -1)
    (turn, wrench), (turned_end, pulled) = parted(maps), parted(given)
    joint = Joint(turn, turned_end, wrench, pulled)
    theta = _rotations(*_moved((turn, turned_end), -1, 0))
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

    _, (strain, turn, turned_end, signs) = scan(backward, end, places, reverse=True)
    theta = _rotations(turn, turned_end)
    return _moved(strain, 0, last), theta, signs


def _rotations(turn: Array, more: Array) -> Array:
    """Rotations at the starts of the steps, from the base on."""
    none = jnp.zeros(more.shape[1:], more.dtype)

    def forward(theta: Array, step: tuple) -> tuple[Array, Array]:
        turn, more = jax.tree.map(once, step)
        return matvec(turn, theta) + more, theta

    return scan(forward, none, (turn, more))[1]


def step_nodes(
    H: Matrix, right: Array, coupled: Coupled, grid: Grid, flexible: Array | None
) -> StepNodes:
    """The nodes of all steps, in the last axes (stages, steps, *arms), with a right side b (6,
    stages, steps, *arms) in their axes."""
    shape = right.shape[1:]
    all_of = partial(whole, shape=shape)

    def at_ends(x: Array | None) -> Array | None:
        lead = 0 if x is None else x.ndim - len(shape) + 1
        return None if x is None else jnp.broadcast_to(x, (*x.shape[:lead], *shape[1:]))

    return StepNodes(
        jnp.broadcast_to(grid.h, shape[1:]),
        all_of(coupled.rotation),
        block_of(H, 0, 0, shape),
        block_of(H, 0, 3, shape),
        block_of(H, 3, 3, shape),
        right,
        all_of(coupled.axis),
        all_of(coupled.wrench),
        all_of(coupled.wrench_density),
        None if coupled.density is None else all_of(coupled.density),
        at_ends(coupled.ends),
        None if flexible is None else all_of(flexible),
    )


def _apart(nodes: StepNodes, grid: Grid) -> StepNodes:
    """Each node as a step of its own, whose length is its weight."""
    stages, jump = grid.X.shape[0], nodes.jump
    return nodes._replace(
        h=jnp.broadcast_to(grid.weight, nodes.axis.shape[1:]),
        jump=None if jump is None else at_last_nodes(jump, stages),
    )


def _alone(node: StepNodes, last: int) -> StepNodes:
    """A step of one node, with the axis of nodes in the place before the last axes."""
    step = jax.tree.map(lambda x: jnp.expand_dims(x, last), node)
    return step._replace(h=node.h, jump=node.jump)


def _moved(tree: Tree, source: int, destination: int) -> Tree:
    """Arrays with one axis moved."""
    return jax.tree.map(lambda x: jnp.moveaxis(x, source, destination), tree)
