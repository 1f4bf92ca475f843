r"""Passes along a chain of hinges (see `hinges`): its product, and its solution by block
elimination.

In a batch of arms a pass over all hinges from the tip to the base keeps the change of the wrench
beyond each as an affine function of the motion, $\hat Q z + q$, and one from the base to the tip
gives the motions. Stiffness across spans of steps adds a force to that (see `spans`).

One arm would wait for many small operations in that. There the hinges are put together step by
step, all steps at once: by the same pass over the hinges of a step, with the wrench beyond its end,
$W_1$, as further unknowns. With the motions $z_0, z_1$ at both ends of a step, which are before its
first hinge and that of the next step here,

$$z_1 = T z_0 + F W_1 + f, \quad W_0 = S z_0 + G W_1 + s.$$

With $F = L S U$, where S has signs on its diagonal and $U = L^T$ if the loads have a potential,
$y = S U W_1$, and $W_1 = Q z_1 + q$ of the arm beyond,

$$(S - U Q L) \, y = U (Q (T z_0 + f) + q), \quad z_1 = T z_0 + f + L y, \quad
W_1 = Q (T z_0 + f) + q + Q L y,$$

so that a pass over the steps solves a 6 x 6 system for each. Its negative eigenvalues, less those
of S, count with those of the hinges. The strains in a step follow from $z_0$ and y; from $W_1$, the
small difference of large forces where a stiff contact is near, they would be less exact.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array

from ..numerics.loops import fori_loop, scan
from ..numerics.once import once
from ..numerics.quadrature import Grid
from ..numerics.stacked import affine, columns, matmul, product, rows, transpose
from .definiteness import asymmetry_of
from .hinges import Hinge, before, behind, halves, motion_behind, solved
from .nodes import at_node, by_place, places_of
from .spans import SpanStiffness

_SINGULAR = 64
"""Smallest pivot of the compliance of a step, relative to its diagonal, in machine epsilons: where
strains are locked or pieces rigid, some are zero."""


def multiplied_by_hinges(
    hinges: Hinge, strain: Array, grid: Grid, spans: SpanStiffness | None = None
) -> Array:
    """Product with strains in the world's axes, (6, sides, stages, steps, *arms), of the same
    shape."""
    arms, none = hinges.width.ndim - 2, jnp.zeros_like(strain[:, :, 0, 0])
    places = places_of(grid)

    def forward(z: Array, place: tuple[Array, Array]) -> tuple[Array, tuple]:
        link, w, change = at_node((hinges.link, hinges.width, strain), place, arms)
        still = jnp.zeros((6, 6, *change.shape[2:]), change.dtype)
        return behind(z, link, w, still, change)[0], (z, change)

    def backward(end: Array, hinge: tuple) -> tuple[Array, Array]:
        (z, change), jump, place = hinge
        at = at_node(hinges, place, arms)
        end = end if jump is None else end + jump
        half, ahead = columns(at.given, 0, 6), z + at.width * change
        moment, force = halves(end)
        lever = columns(at.lever, 0, 3)
        beyond = jnp.concatenate([moment + matmul(lever, force), force])
        beyond = beyond + matmul(columns(at.load, 0, 6), ahead)
        wrench = _stiffness(at, change) - beyond - matmul(half, z)
        start = beyond - at.width * matmul(half, change)
        if at.inside is not None:
            K, part = columns(at.inside[0], 0, 6), at.inside[1]
            inside = matmul(K, z + part * at.width * change)
            wrench, start = wrench - part * inside, start + inside
        return start, wrench

    tip, motions = scan(forward, none, places)
    jumps = None
    if spans is not None:
        stages = grid.X.shape[0]
        starts = jnp.concatenate([motions[0][::stages], tip[None]])
        jumps = spans.wrenches(starts, arms)
        jumps = jnp.zeros_like(motions[0]).at[stages - 1 :: stages].set(jumps)
    _, wrench = scan(backward, none, (motions, jumps, places), reverse=True)
    return by_place(jnp.moveaxis(wrench, 0, 2), grid, arms)


def _stiffness(hinge: Hinge, change: Array) -> Array:
    """The wrench by a strain of the hinge alone."""
    bent, stretched = halves(change)
    if len(hinge.stiff) == 1:
        return jnp.concatenate([matmul(hinge.stiff[0], bent), jnp.zeros_like(stretched)])
    a, b, d = hinge.stiff
    bending = matmul(a, bent) + matmul(b, stretched)
    return jnp.concatenate([bending, matmul(transpose(b), bent) + matmul(d, stretched)])


def solved_by_hinges(
    hinges: Hinge, grid: Grid, free: tuple[int, ...], spans: SpanStiffness | None = None
) -> tuple[Array, Array, Array]:
    r"""Strains in the world frame (size, sides, stages, steps, *arms), numbers of negative pivots
    and asymmetries, by passes over the steps and over the hinges of each.

    With stiffness across spans about the hinges, all depends on the force $\phi$ too, and the
    motion of the section at the end of its span is kept beside the wrench (see `spans`)."""
    (stages, steps), arms = grid.X.shape[:2], hinges.width.shape[2:]
    width, first = hinges.given.shape[1], 6 if spans is None else 12
    none = jnp.zeros((6, width, *arms), hinges.width.dtype)
    motion = jnp.eye(6, width, dtype=none.dtype).reshape(6, width, *(1,) * len(arms))
    every_step, every_stage = jnp.arange(steps), jnp.arange(stages)

    def hinge_before(beyond: tuple, place: tuple[Array, Array]) -> tuple[tuple, tuple]:
        end, ends = beyond
        hinge = at_node(hinges, place, len(arms))
        start, (X, negative, compliance, Q) = before(free, end, hinge)
        if ends is not None:
            ahead = motion_behind(motion, X, hinge.link, hinge.width)
            further = _padded(columns(ends, 6, width), 6)
            ends = once(product(columns(ends, 0, 6), ahead) + further)
        return (start, ends), (X, negative, asymmetry_of(Q, None, compliance))

    def at_end(change: Callable, beyond: tuple) -> tuple:
        wrench, ends = change(jnp.concatenate(beyond[0]), beyond[1])
        return halves(wrench), ends

    def backward(beyond: tuple, step: Array) -> tuple[tuple, tuple]:
        span = at_node(spans, (step,), len(arms))
        beyond = beyond if span is None else at_end(span.closing, beyond)
        places = every_stage, jnp.full_like(every_stage, step)
        beyond, found = scan(hinge_before, beyond, places, reverse=True)
        return beyond if span is None else at_end(span.opening, beyond), found

    tip = halves(none), None if spans is None else none
    _, (X, negative, asymmetry) = scan(backward, tip, every_step, reverse=True)

    def forward(base: tuple, now: tuple) -> tuple[tuple, Array]:
        (z, force), (X, step) = base, now
        if spans is not None:
            force = at_node(spans, (step,), len(arms)).force(z, force)

        def hinge_behind(z: Array, hinge: tuple) -> tuple[Array, Array]:
            X, stage = once(hinge[0]), hinge[1]
            link, w = at_node((hinges.link, hinges.width), (stage, step), len(arms))
            others = columns(X, first, width)
            if force is not None:
                others = others + product(columns(X, 6, 12), force)
            return behind(z, link, w, columns(X, 0, 6), others)

        z, strain = scan(hinge_behind, z, (X, every_stage))
        return (z, force), strain

    start = columns(none, first, width)
    base = start, None if spans is None else start
    _, strain = scan(forward, base, (X, every_step))
    strain = jnp.moveaxis(strain, (0, 1), (3, 2))
    negative, asymmetry = (x.reshape(-1, *arms) for x in (negative, asymmetry))
    return strain, negative, asymmetry


def solved_by_joints(
    hinges: Hinge, grid: Grid, free: tuple[int, ...], spans: SpanStiffness | None = None
) -> tuple[Array, Array, Array]:
    """As `solved_by_hinges`, with stiffness across spans about the hinges, by passes over the
    hinges of all steps at once and then over the steps."""
    found, pushed, negative, compliance = _condensed(hinges, grid, free)
    count, arms = len(found), hinges.width.ndim - 2
    by_slide, U, signs, left = _factors(columns(found, 6, 12))
    found, pushed_by = (_without_wrench(x) for x in (found, pushed))
    step = _Step(
        rows(by_slide, 0, 6), U, signs, rows(found, 0, 6), pushed_by, columns(pushed, 6, 12)
    )
    z, y, W, more, Q = _joined(step, spans, arms)
    strain = affine(rows(found, 6, count), z) + product(rows(by_slide, 6, count), y)
    strain = strain + product(rows(left, 6, count), W)
    strain = strain.reshape(grid.X.shape[0], -1, *strain.shape[1:])
    return jnp.moveaxis(strain, 0, 2), negative + more, asymmetry_of(Q, None, compliance)


def _condensed(hinges: Hinge, grid: Grid, free: tuple[int, ...]) -> tuple[Array, ...]:
    """The motions at the ends of all steps, followed by the strains of their nodes, and the
    wrenches at their starts, (6 and more, columns, steps, *arms), by the motion at the start, the
    wrench beyond the end and the right sides; the numbers of negative pivots and the compliance of
    the first nodes."""
    stages, others = grid.X.shape[0], hinges.width.shape[1:]
    width = hinges.given.shape[1]
    one = jnp.eye(6, width, dtype=hinges.width.dtype)
    motion, wrench = (
        jnp.broadcast_to(x.reshape(6, width, *(1,) * len(others)), (6, width, *others))
        for x in (one, jnp.roll(one, 6, 1))
    )

    def backward(end: tuple[Array, Array], stage: Array) -> tuple[tuple, tuple]:
        hinge = at_node(hinges, (stage,), len(others))
        start, (X, negative, compliance, _) = before(free, end, hinge)
        return start, (X, negative, compliance)

    order = jnp.arange(stages)
    pushed, found = scan(backward, halves(wrench), order, reverse=True)
    X, negative, compliance = found

    def forward(z: Array, hinge: tuple) -> tuple[Array, Array]:
        X, stage = hinge
        link, w = at_node((hinges.link, hinges.width), (stage,), len(others))
        by_others = _padded(columns(X, 6, width), 6)
        return behind(z, link, w, columns(X, 0, 6), by_others)

    moved, strain = scan(forward, motion, (X, order))
    moved = jnp.concatenate([moved, strain.reshape(-1, width, *others)])
    negative = jnp.sum(negative, axis=0, dtype=jnp.int32)
    return moved, jnp.concatenate(pushed), negative, compliance[0]


def _without_wrench(x: Array) -> Array:
    """The columns of the motion and of the right sides."""
    return jnp.concatenate([columns(x, 0, 6), columns(x, 12, x.shape[1])], axis=1)


class _Step(NamedTuple):
    """What the join of steps takes of each, (6, columns, *arms): L, U and the signs S (6, *arms),
    (T, f), (S, s) and G."""

    L: Array
    U: Array
    signs: Array
    moved: Array
    pushed: Array
    by_wrench: Array


def _joined(step: _Step, spans: SpanStiffness | None, arms: int) -> tuple[Array, ...]:
    r"""All steps joined: the motions z at their starts, y and the wrenches beyond their ends (6,
    sides, steps, *arms), the numbers of negative pivots, and the changes of the moments at their
    starts by the rotations there.

    Across spans there is a force beside the motion, $\phi$ (see `spans`): columns of its own."""
    last = -1 - arms
    if spans is not None:
        step = step._replace(moved=_with_force(step.moved), pushed=_with_force(step.pushed))
    L, U, signs, moved, pushed, by_wrench = step
    width = moved.shape[1]
    given = jnp.concatenate([L, moved], axis=1), U, signs, pushed, by_wrench
    given, spans = jax.tree.map(lambda x: jnp.moveaxis(x, last, 0), (given, spans))

    def backward(beyond: tuple, now: tuple) -> tuple[tuple, tuple]:
        (ahead, U, signs, pushed, G), span = now
        if span is not None:
            beyond = span.closing(*beyond)
        wrench, ends = beyond
        others = _padded(columns(wrench, 6, width), 12)
        change = once(product(columns(wrench, 0, 6), ahead) + others)
        by_slide, W = columns(change, 0, 6), columns(change, 6, 6 + width)
        reduced = matmul(U, change)
        y, negative = _solved_for(signs, columns(reduced, 0, 6), columns(reduced, 6, 6 + width))
        W = once(W + product(by_slide, y))
        start = once(pushed + product(G, W))
        if span is not None:
            end = once(columns(ahead, 6, 6 + width) + product(columns(ahead, 0, 6), y))
            ends = product(columns(ends, 0, 6), end) + _padded(columns(ends, 6, width), 6)
            start, ends = span.opening(start, once(ends))
        return (start, ends), (y, W, negative, columns(rows(start, 0, 3), 0, 3))

    none = jnp.zeros_like(given[3][0])
    tip = none, None if spans is None else none
    _, (y, W, negative, Q) = scan(backward, tip, (given, spans), reverse=True)
    y, W, Q = (jnp.moveaxis(x, 0, last) for x in (y, W, Q))
    ends = jnp.moveaxis(once(moved + product(L, y)), last, 0)

    def forward(base: tuple, now: tuple) -> tuple[tuple, Array]:
        (end, span), (z, force) = now, base
        if span is None:
            return (affine(end, z), None), z
        force = span.force(z, force)
        both = jnp.concatenate([z, force])
        return (affine(end, both), force), both

    still = jnp.zeros_like(none[:, (6 if spans is None else 12) :])
    base = still, None if spans is None else still
    z = jnp.moveaxis(scan(forward, base, (ends, spans))[1], 0, last)
    negative = jnp.moveaxis(negative, 0, last)
    return rows(z, 0, 6), affine(y, z), affine(W, z), negative, Q


def _with_force(x: Array) -> Array:
    """A matrix with columns of a force across spans, zero, between those of motions and those of
    right sides."""
    motion, sides = columns(x, 0, 6), columns(x, 6, x.shape[1])
    return jnp.concatenate([motion, jnp.zeros_like(motion), sides], axis=1)


def _padded(x: Array, before: int) -> Array:
    """A matrix with so many columns of zeros before its own."""
    return jnp.pad(x, [(0, 0), (before, 0), *[(0, 0)] * (x.ndim - 2)])


def _solved_for(signs: Array, by_itself: Array, right: Array) -> tuple[Array, Array]:
    """Solution y of $S y = A y + b$, and the negative eigenvalues of S - A less those of S."""
    one = jnp.eye(6, dtype=right.dtype).reshape(6, 6, *(1,) * (right.ndim - 2))
    rest = one * signs - by_itself
    (a, b), (d, e) = ((columns(half, 0, 3), columns(half, 3, 6)) for half in halves(rest))
    y, negative, _ = solved(((a, b), (d, e)), halves(right), a, tuple(range(6)))
    return jnp.concatenate(y), negative - jnp.sum(signs < 0, axis=0, dtype=jnp.int32)


def _factors(F: Array) -> tuple[Array, Array, Array, Array]:
    """L, U and the signs S of the first six rows of matrices (6 and more, 6, steps), with pivots
    shared between both factors evenly, where L has all rows, and what is left, F - L S U: rounding,
    but for a step without length, whose strains turn nothing."""
    smallest = _SINGULAR * float(jnp.finfo(F.dtype).eps) * jnp.abs(jnp.einsum("ii...->i...", F[:6]))

    def eliminate(i: Array, state: tuple) -> tuple[Array, Array, Array, Array]:
        F, L, U, signs = state
        row, column = (lax.dynamic_index_in_dim(F, i, axis, keepdims=False) for axis in (0, 1))
        pivot = lax.dynamic_index_in_dim(row, i, 0, keepdims=False)
        size, sign = jnp.abs(pivot), jnp.where(pivot < 0, -1.0, 1.0).astype(F.dtype)
        regular = size > lax.dynamic_index_in_dim(smallest, i, 0, keepdims=False)
        root = jnp.where(regular, lax.rsqrt(jnp.where(regular, size, 1.0)), 0.0)
        sign, column, row = jnp.where(regular, sign, 1.0), root * column, root * row
        less = once(F - sign * column[:, None] * row)
        return less, L.at[:, i].set(column), U.at[i].set(row), signs.at[i].set(sign)

    state = F, jnp.zeros_like(F), jnp.zeros_like(F[:6]), jnp.ones_like(F[:6, 0])
    left, L, U, signs = fori_loop(0, 6, eliminate, state)
    return L, U, signs, left
