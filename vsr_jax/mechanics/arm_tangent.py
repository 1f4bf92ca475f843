"""The tangent system of the coupled balance (see `arm_balance`): solved approximately by
elimination, and exactly by iterative refinement."""

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, PyTree

from ..chain import Border, Chain, Definiteness, bordered_solve, solved_with
from ..chain.border import Solve
from ..numerics import component as c
from ..numerics.component import Vector, free_components, spread
from ..numerics.loops import while_loop
from ..numerics.once import once
from ..numerics.quadrature import Grid
from ..typing import cast
from .arm_balance import ArmImbalance, ArmUnknown
from .balance import tangent
from .coupling import ArmProblem, ArmState, borders_of, springs_of
from .sizes import node_weight

_REFINEMENTS = 60
"""Bound on the refinement steps of a tangent system; 5 to 10 are usual."""

_KEPT, _KEPT_TOUCHING = 8, 48
"""Number of earlier directions against which each new one is orthogonalised, and that with
constraints: each contact of an arm that lies along a wall may have an inexact direction."""

_FINAL, _ACCEPTED = 8.0, 1e4
"""Residual at which refinement ends, and largest accepted residual, in machine epsilons."""


def approximate_solve(
    unknown: ArmUnknown,
    at: ArmState,
    right: ArmImbalance,
    problem: ArmProblem,
    free: tuple[int, ...],
    damping: Array | float = 0.0,
    *,
    symmetric: bool = False,
    apart: bool = False,
) -> tuple[ArmUnknown, Array, Array]:
    """Approximate solution of the tangent system (see `chain`; a coupling without a border
    has the tangent 1), whether it is definite for the changes of shape that the couplings allow,
    and whether that is doubtful.

    In single precision: the passes along the arm are bound by memory, and rounding is far below the
    error of the elimination. Constraints keep the precision of the unknowns, since an arm may be a
    million times as stiff along its axis as across.

    **Arguments:** `symmetric`: with the contact forces that friction follows held; `apart`: solve
    for `right` apart from all that does not depend on it, in place of one pass for everything, so
    that derivatives by `right` repeat only the former.
    """
    if not problem.constrained:
        unknown, at, right, problem, damping = c.single(
            (unknown, at, right, problem, jnp.asarray(damping))
        )
    sections, grid, along, loads = problem.sections, problem.grid, at.along, at.loads
    lower = tangent(unknown.xi, sections, at.tau)
    lower = tuple(
        (*row[:-1], row[-1] + damping * s) for row, s in zip(lower, sections.stiffness, strict=True)
    )
    springs = springs_of(problem, unknown.coupled, at, free)
    if symmetric:
        springs = {place: one.symmetric() for place, one in springs.items()}
    coupled = None if along is None or loads is None else along.coupled(loads)
    b, pushes = spread(right.wrench, free), []
    for place, one in springs.items():
        assert coupled is not None  # what presses an arm is a load
        coupled = one.added_to(coupled)
        b, push = one.driven(b, right.coupled[place])
        pushes.append(push)
    pushes = [sum(pushes[1:], pushes[0])] if pushes else []
    chain = Chain(lower, free, sections.flexible, coupled, grid)
    solve = partial(chain.solve, apart=apart)
    borders = borders_of(problem, unknown.coupled, at)
    conservative = loads is None or loads.conservative
    strain, changes, (negative, doubtful) = _bordered(
        solve, b, pushes, right.coupled, borders, grid, conservative, apart=apart
    )
    if springs:
        motions = chain.motions(strain)
        for place, one in springs.items():
            strain, changes[place] = one.followed(strain, changes[place], motions)
    return ArmUnknown(strain, tuple(changes)), negative == 0, doubtful


def _bordered(
    solve: Solve,
    b: Vector,
    pushes: list[Array],
    rows: tuple[PyTree, ...],
    borders: tuple[dict[int, Border], Border | None],
    grid: Grid,
    conservative: Array | bool,
    *,
    apart: bool,
) -> tuple[Vector, list[PyTree], Definiteness]:
    """Strain and unknowns of the couplings from the right side and their rows, with the unknowns of
    those without a border still their rows."""
    (places, border), coupled = borders, list(rows)
    sides = [tuple(x[None] for x in b), *(push[None] for push in pushes)]
    if border is None:
        found, definiteness = solve(*sides)
        return tuple(x[0] for x in found), coupled, definiteness
    found, answers, definiteness = solved_with(solve, sides, border.columns, apart=apart)
    right = jnp.concatenate([rows[place] for place in places])
    strain, x, held = bordered_solve(tuple(x[0] for x in found), answers, right, border, grid)
    first = 0
    for place in places:
        size = len(rows[place])
        coupled[place], first = x[first : first + size], first + size
    return strain, coupled, definiteness.without(held, conservative)


def tangent_solve(
    apply: Callable,
    unknown: ArmUnknown,
    at: ArmState,
    problem: ArmProblem,
    right: ArmImbalance,
    free: tuple[int, ...],
) -> ArmUnknown:
    r"""Solution of the exact tangent system $A x = b$, with `approximate_solve` as preconditioner;
    NaN where not found.

    All entries are scaled by energies: a change of strain $\delta\xi$ becomes $\sqrt{\Sigma
    w}\,\delta\xi$, a wrench $\sqrt{w / \Sigma}\,r$, with the weight w of its node, and the unknowns
    and rows of couplings likewise (`Coupling.units`). The scaled A is the identity plus the terms
    of loads and threads. It is symmetric where these have a potential, so that one norm serves both
    modes of differentiation.

    **Arguments:** `apply`: product with A; `at`: `state_of` the unknowns. Of `unknown` and the
    result only the free strains count.
    """
    flat, unravel_row = ravel_pytree(right)
    _, unravel_change = ravel_pytree(_free_part(unknown, free))
    to_row, to_change = lax.stop_gradient(_units(problem, free, right))

    def nearly(row: ArmImbalance) -> ArmUnknown:
        step, _, _ = approximate_solve(unknown, at, row, problem, free, apart=True)
        return _free_part(cast(step, problem.grid.h.dtype), free)

    # all that does not depend on the right side is computed once, before the loop
    _, nearly = jax.linearize(nearly, jax.tree.map(jnp.zeros_like, right))

    def scaled_apply(x: Array) -> Array:
        return to_row * ravel_pytree(apply(unravel_change(to_change * x)))[0]

    def scaled_nearly(r: Array) -> Array:
        row = unravel_row(r / to_row)
        found = followed(nearly(row), row, lambda step: apply(step).coupled, problem)
        return ravel_pytree(found)[0] / to_change

    b = to_row * flat
    back = jax.linear_transpose(scaled_nearly, b)
    kept = _KEPT_TOUCHING if problem.constrained else _KEPT

    def solve(apply: Callable, b: Array) -> Array:
        return _refined(apply, scaled_nearly, b, kept)

    def transpose_solve(apply: Callable, b: Array) -> Array:
        return _refined(apply, lambda r: back(r)[0], b, kept)

    return unravel_change(
        to_change * lax.custom_linear_solve(scaled_apply, b, solve, transpose_solve)
    )


def followed(
    step: ArmUnknown, right: ArmImbalance, changes: Callable, problem: ArmProblem
) -> ArmUnknown:
    r"""The step, with the unknowns of couplings that follow from the strain changed by its step
    too: $\delta x = s - \partial s / \partial\xi \, \delta\xi$ for their rows s.

    With $\delta x = s$ they would be one step late: twice as many Newton steps, or none that
    converge, and up to sixty refinement steps of the transposed system in place of eight.

    **Arguments:** `right`: the right side of the tangent system; `changes`: of the rows of all
    couplings by a step without these unknowns.
    """
    late = [i for i, one in enumerate(problem.couplings) if one.follows_rate]
    if not late:
        return step
    step = jax.tree.map(once, step)  # in reverse mode, the whole way back from the rows
    coupled = list(step.coupled)
    for i in late:
        coupled[i] = jax.tree.map(jnp.zeros_like, coupled[i])
    rows = changes(step._replace(coupled=tuple(coupled)))
    for i in late:
        coupled[i] = jax.tree.map(
            lambda x, row, by: (row - by).astype(x.dtype), coupled[i], right.coupled[i], rows[i]
        )
    return step._replace(coupled=tuple(coupled))


def _free_part(unknown: ArmUnknown, free: tuple[int, ...]) -> ArmUnknown:
    return unknown._replace(xi=free_components(unknown.xi, free))


def _units(problem: ArmProblem, free: tuple[int, ...], like: ArmImbalance) -> tuple[Array, Array]:
    """Factors from rows of the residual to scaled rows, and from scaled changes of the unknowns to
    changes."""
    stiffness, weight = problem.sections.stiffness, node_weight(problem.grid)
    root = tuple(jnp.sqrt(weight * s) for s in free_components(stiffness, free))
    pairs = [coupling.scales(problem).units for coupling in problem.couplings]
    rows = ArmImbalance(tuple(weight / x for x in root), tuple(row for row, _ in pairs))
    changes = ArmImbalance(tuple(1 / x for x in root), tuple(change for _, change in pairs))
    row, change = (
        ravel_pytree(jax.tree.map(lambda x, y: jnp.broadcast_to(x, y.shape), tree, like))[0]
        for tree in (rows, changes)
    )
    return row, change


class _Refinement(NamedTuple):
    """State of `_refined`: the solution and its residual; the kept directions and their images; the
    number of steps, whether the next one checks the solution, whether that is done, and whether it
    was accepted."""

    x: Array
    r: Array
    directions: Array
    images: Array
    taken: Array
    checking: Array
    done: Array
    found: Array


def _refined(apply: Callable, nearly: Callable, right: Array, kept: int) -> Array:
    """Solution of a scaled system by the preconditioned generalised conjugate residual method,
    where each direction is orthogonalised against the last ones that are `kept`.

    For a soft motion of the arm the approximate tangent may be ten times too stiff. Plain iterative
    refinement would then take hundreds of steps; orthogonalisation finds such a motion at once. The
    solution is accepted by its own residual, in a last step of the same loop, so that the program
    holds the product once.
    """
    # the approximate tangent, in single precision, would take a right side of rounding for zero
    largest = jnp.max(jnp.abs(right))
    right = right / jnp.where(largest > 0, largest, 1.0)
    eps, size = jnp.finfo(right.dtype).eps, jnp.linalg.norm(right)

    def whole(x: Array) -> Array:
        return jnp.maximum(size, jnp.linalg.norm(x))

    def advance(at: _Refinement) -> _Refinement:
        p = jnp.where(at.checking, at.x, nearly(at.r))
        q = apply(p)
        found = jnp.linalg.norm(right - q) <= _ACCEPTED * eps * whole(at.x)
        for _ in range(2):  # once is inexact where the remainder is small
            share = at.images @ q
            p, q = p - share @ at.directions, q - share @ at.images
        square = q @ q
        inverse = jnp.where(square > 0, 1 / jnp.sqrt(jnp.where(square > 0, square, 1.0)), 0.0)
        p, q = inverse * p, inverse * q
        part = jnp.where(at.checking, 0.0, q @ at.r)
        x, r, place, taken = at.x + part * p, at.r - part * q, at.taken % kept, at.taken + 1
        refined = ~(jnp.linalg.norm(r) > _FINAL * eps * whole(x)) | (taken >= _REFINEMENTS)
        directions, images = at.directions.at[place].set(p), at.images.at[place].set(q)
        return _Refinement(x, r, directions, images, taken, refined, at.checking, found)

    # all of it depends on the right side, so that `jax.vmap` goes over the loop once, not thrice
    nothing = jnp.where(size > 0, 0, 0)
    none, no = jnp.zeros((kept, *right.shape), right.dtype) + nothing, nothing > 0
    begin = _Refinement(none[0], right, none, none, nothing, ~(size > 0), no, no)
    end = while_loop(lambda at: ~at.done, advance, begin)
    return jnp.where(end.found, largest * end.x, jnp.nan)  # no derivative rather than a wrong one
