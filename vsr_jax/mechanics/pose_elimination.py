r"""The tangent of the balance under loads that depend on positions, solved by block elimination
along the arm, a chain of hinges (see `pose_hinges`).

In a batch of arms a pass over all hinges from the tip to the base keeps the change of the wrench
beyond each as an affine function of the motion, $\hat Q z + q$, and one from the base to the tip
gives the motions.

One arm would wait for many small operations in that. Its hinges are put together step by step, all
steps at once: by the same pass over the hinges of a step, with the wrench beyond its end, $W_1$, as
further unknowns. With the motions $z_0, z_1$ at both ends of a step, which are before its first
hinge and that of the next step here,

$$z_1 = T z_0 + F W_1 + f, \quad W_0 = S z_0 + G W_1 + s.$$

With $F = L U$, where $U = L^T$ if the loads have a potential, $y = U W_1$, and $W_1 = Q z_1 + q$ of
the arm beyond,

$$(1 - U Q L) \, y = U (Q (T z_0 + f) + q), \quad z_1 = T z_0 + f + L y, \quad
W_1 = Q (T z_0 + f) + q + Q L y,$$

so that a pass over the steps solves a 6 x 6 system for each, whose negative eigenvalues count with
those of the hinges. The strains in a step follow from $z_0$ and y; from $W_1$, the small difference
of large forces where a stiff contact is near, they would be less exact.
"""

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array

from ..numerics import component as c
from ..numerics.component import Matrix, Vector
from ..numerics.once import once
from ..numerics.quadrature import Grid
from ..numerics.stacked import (
    affine,
    columns,
    cross,
    matmul,
    product,
    rows,
    stack,
    total,
    transpose,
    turned,
)
from .balance import ALL
from .elimination_nodes import Definiteness, asymmetry_of, at_node, definiteness, places_of
from .pose_hinges import Hinge, before, behind, halves, hinges_of, solved
from .reaction import Reaction, Slopes

_SINGULAR = 64
"""Smallest pivot of the compliance of a step, relative to its diagonal, in machine epsilons: where
strains are locked or pieces rigid, some are zero."""


def eliminate_poses(
    lower: Matrix,
    right: Vector,
    along: Reaction,
    slopes: Slopes,
    grid: Grid,
    free: tuple[int, ...],
    flexible: Array | None = None,
    push: Array | None = None,
    *,
    apart: bool = False,
) -> tuple[Vector, Definiteness]:
    """As `eliminate`, for motions of size 6 and several right sides.

    **Arguments:** `right`: six components (sides, stages, steps, *arms); `push`: changes (sides, 6,
    stages, steps, *arms) of the wrenches in the cells in the world frame, about the nodes, that do
    not depend on the motions, right sides too; `apart`: one arm node by node too, whose derivative
    by the right sides is the smaller program, and takes three quarters of the time.

    **Returns:** six components (sides, stages, steps, *arms).
    """
    H = c.symmetric(lower)
    shapes = [x.shape[2:] for x in (*H[0], grid.weight, along.axis[0])]
    arms = jnp.broadcast_shapes(*shapes, *(x.shape[3:] for x in right))
    size = (len(right[0]), *grid.X.shape[:2], *arms)
    b = jnp.stack([jnp.broadcast_to(x, size) for x in right])
    if push is not None:
        push = jnp.broadcast_to(push.swapaxes(0, 1), b.shape)
    by_nodes = apart or bool(arms)
    unknowns = 0 if by_nodes else 6
    hinges = hinges_of(H, b, along, slopes, grid, free, flexible, push, unknowns)
    passed = _node_by_node if by_nodes else _step_by_step
    strain, negative, asymmetry = passed(hinges, grid, free)
    back = transpose(along.rotation)
    strain = jnp.concatenate([matmul(back, part) for part in jnp.split(strain, len(strain) // 3)])
    local = jnp.ones(negative.shape, bool)
    # turning a strain into the world frame and back leaves rounding in those that are locked
    found = tuple(strain[i] if i in free else jnp.zeros_like(strain[0]) for i in range(6))
    return found, definiteness(negative, local, asymmetry, grid)


def motions(strain: Vector, part: Array, along: Reaction, grid: Grid) -> Array:
    """Rotations and displacements (6, stages, steps, *arms) in the world frame behind a part of
    each cell, about the nodes, by a change of strain, as the elimination has them."""
    change = grid.weight * turned(along.rotation, stack(strain))

    def summed(x: Array) -> Array:
        """Sums over the cells from the base, that of each itself included."""
        of_step = total(x, 1)
        before = jnp.cumsum(of_step, axis=1) - of_step
        return before[:, None] + jnp.cumsum(x, axis=1)

    bent, slid = rows(change, 0, 3), rows(change, 3, 6)
    ends, reach = summed(bent), 0.5 * grid.weight * along.axis
    moved = cross(2.0 * ends - bent, reach) + slid
    there = summed(moved) - cross(ends, reach)  # behind the hinge at the node
    ahead = 1.0 - part
    return once(jnp.concatenate([ends - ahead * bent, there - ahead * slid]))


def _node_by_node(hinges: Hinge, grid: Grid, free: tuple[int, ...]) -> tuple[Array, Array, Array]:
    """Strains in the world frame (size, sides, stages, steps, *arms), numbers of negative pivots
    and asymmetries, by passes over all hinges."""
    arms, width = hinges.width.shape[2:], hinges.given.shape[1]
    none = jnp.zeros((3, width, *arms), hinges.width.dtype)
    places = places_of(grid)

    def backward(end: tuple[Array, Array], place: tuple[Array, Array]) -> tuple[tuple, tuple]:
        start, (X, negative, compliance, Q) = before(free, end, at_node(hinges, place, len(arms)))
        return start, (X, negative, asymmetry_of(Q, None, compliance))

    _, (X, negative, asymmetry) = lax.scan(backward, (none, none), places, reverse=True)

    def forward(z: Array, hinge: tuple) -> tuple[Array, Array]:
        X = once(hinge[0])
        link, w = at_node((hinges.link, hinges.width), hinge[1], len(arms))
        return behind(z, link, w, columns(X, 0, 6), columns(X, 6, width))

    start = jnp.zeros((6, width - 6, *arms), X.dtype)
    _, strain = lax.scan(forward, start, (X, places))
    strain = jnp.moveaxis(strain, 0, 2)
    strain = strain.reshape(*strain.shape[:2], *grid.X.shape[1::-1], *arms).swapaxes(2, 3)
    return strain, negative, asymmetry


def _step_by_step(hinges: Hinge, grid: Grid, free: tuple[int, ...]) -> tuple[Array, Array, Array]:
    """As `_node_by_node`, for one arm, by passes over the hinges of all steps at once and then over
    the steps."""
    found, pushed, negative, compliance = _condensed(hinges, grid, free)
    count = len(found)
    by_slide, U, left = _factors(columns(found, 6, 12))
    found, pushed_by = (_without_wrench(x) for x in (found, pushed))
    step = rows(by_slide, 0, 6), U, rows(found, 0, 6), pushed_by, columns(pushed, 6, 12)
    z, y, W, more, Q = _joined(*step)
    strain = affine(rows(found, 6, count), z) + product(rows(by_slide, 6, count), y)
    strain = strain + product(rows(left, 6, count), W)
    strain = strain.reshape(grid.X.shape[0], -1, *strain.shape[1:])
    return jnp.moveaxis(strain, 0, 2), negative + more, asymmetry_of(Q, None, compliance)


def _condensed(hinges: Hinge, grid: Grid, free: tuple[int, ...]) -> tuple[Array, ...]:
    """The motions at the ends of all steps, followed by the strains of their nodes, and the
    wrenches at their starts, (6 and more, columns, steps), by the motion at the start, the wrench
    beyond the end and the right sides; the numbers of negative pivots and the compliance of the
    first nodes."""
    stages, steps = grid.X.shape
    width = hinges.given.shape[1]
    one = jnp.eye(6, width, dtype=hinges.width.dtype)
    motion, wrench = (
        jnp.broadcast_to(x[:, :, None], (6, width, steps)) for x in (one, jnp.roll(one, 6, 1))
    )

    def backward(end: tuple[Array, Array], stage: Array) -> tuple[tuple, tuple]:
        start, (X, negative, compliance, _) = before(free, end, at_node(hinges, (stage,), 1))
        return start, (X, negative, compliance)

    order = jnp.arange(stages)
    pushed, found = lax.scan(backward, halves(wrench), order, reverse=True)
    X, negative, compliance = found

    def forward(z: Array, hinge: tuple) -> tuple[Array, Array]:
        X, stage = hinge
        link, w = at_node((hinges.link, hinges.width), (stage,), 1)
        others = jnp.pad(columns(X, 6, width), [(0, 0), (6, 0), (0, 0)])
        return behind(z, link, w, columns(X, 0, 6), others)

    moved, strain = lax.scan(forward, motion, (X, order))
    moved = jnp.concatenate([moved, strain.reshape(-1, width, steps)])
    negative = jnp.sum(negative, axis=0, dtype=jnp.int32)
    return moved, jnp.concatenate(pushed), negative, compliance[0]


def _without_wrench(x: Array) -> Array:
    """The columns of the motion and of the right sides."""
    return jnp.concatenate([columns(x, 0, 6), columns(x, 12, x.shape[1])], axis=1)


def _joined(L: Array, U: Array, moved: Array, pushed: Array, by_wrench: Array) -> tuple[Array, ...]:
    """All steps joined: the motions z at their starts, y and the wrenches beyond their ends (6,
    sides, steps), the numbers of negative pivots, and the changes of the moments at their starts by
    the rotations there.

    **Arguments:** of all steps (6, columns, steps): L, U, (T, f), (S, s) and G.
    """
    width = moved.shape[1]
    given = jnp.concatenate([L, moved], axis=1), U, pushed, by_wrench

    def backward(beyond: Array, step: tuple) -> tuple[Array, tuple]:
        ahead, U, pushed, G = step
        Q, q = columns(beyond, 0, 6), columns(beyond, 6, width)
        change = once(product(Q, ahead) + jnp.pad(q, [(0, 0), (12, 0)]))
        by_slide, W = columns(change, 0, 6), columns(change, 6, 6 + width)
        reduced = matmul(U, change)
        y, negative = _solved_for(columns(reduced, 0, 6), columns(reduced, 6, 6 + width))
        W = once(W + product(by_slide, y))
        start = once(pushed + product(G, W))
        return start, (y, W, negative, columns(rows(start, 0, 3), 0, 3))

    none = jnp.zeros(moved.shape[:2], moved.dtype)
    steps = jax.tree.map(lambda x: jnp.moveaxis(x, -1, 0), given)
    _, (y, W, negative, Q) = lax.scan(backward, none, steps, reverse=True)
    y, W, Q = (jnp.moveaxis(x, 0, -1) for x in (y, W, Q))
    ends = once(moved + product(L, y))

    def forward(z: Array, end: Array) -> tuple[Array, Array]:
        return affine(end, z), z

    _, z = lax.scan(forward, columns(none, 6, width), jnp.moveaxis(ends, -1, 0))
    z = jnp.moveaxis(z, 0, -1)
    return z, affine(y, z), affine(W, z), negative, Q


def _solved_for(by_itself: Array, right: Array) -> tuple[Array, Array]:
    """Solution y of $y = A y + b$, and the negative eigenvalues of 1 - A."""
    rest = jnp.eye(6, dtype=right.dtype) - by_itself
    (a, b), (d, e) = ((columns(half, 0, 3), columns(half, 3, 6)) for half in halves(rest))
    y, negative, _ = solved(((a, b), (d, e)), halves(right), a, ALL)
    return jnp.concatenate(y), negative


def _factors(F: Array) -> tuple[Array, Array, Array]:
    """L and U of the first six rows of matrices (6 and more, 6, steps), with pivots shared between
    both evenly, where L has all rows, and what is left, F - L U: rounding, but for a step without
    length, whose strains turn nothing."""
    smallest = _SINGULAR * float(jnp.finfo(F.dtype).eps) * jnp.abs(jnp.einsum("ii...->i...", F[:6]))

    def eliminate(i: Array, state: tuple) -> tuple[Array, Array, Array]:
        F, L, U = state
        row, column = (lax.dynamic_index_in_dim(F, i, axis, keepdims=False) for axis in (0, 1))
        pivot = lax.dynamic_index_in_dim(row, i, 0, keepdims=False)
        size = jnp.abs(pivot)
        regular = size > lax.dynamic_index_in_dim(smallest, i, 0, keepdims=False)
        root = jnp.where(regular, lax.rsqrt(jnp.where(regular, size, 1.0)), 0.0)
        column, row = root * column, jnp.sign(pivot) * root * row
        return once(F - column[:, None] * row), L.at[:, i].set(column), U.at[i].set(row)

    state = F, jnp.zeros_like(F), jnp.zeros_like(F[:6])
    left, L, U = lax.fori_loop(0, 6, eliminate, state)
    return L, U, left
