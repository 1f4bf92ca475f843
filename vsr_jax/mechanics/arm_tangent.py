"""The tangent system of the coupled balance (see `arm_balance`): solved approximately by
elimination, and exactly by iterative refinement."""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jax.flatten_util import ravel_pytree
from jaxtyping import Array

from ..numerics import component as c, lu
from ..numerics.component import Vector
from ..typing import cast
from .arm_balance import ArmImbalance, ArmProblem, ArmState, ArmUnknown, Kind, state_of
from .balance import free_components, spread, tangent, thread_direction, thread_wrench
from .elimination import eliminate
from .elimination_nodes import Definiteness
from .pose_elimination import eliminate_poses
from .reaction import slopes_of

_REFINEMENTS = 60
"""Bound on the refinement steps of a tangent system; 5 to 10 are usual."""

_KEPT = 8
"""Number of earlier directions against which each new one is orthogonalised."""

_FINAL, _ACCEPTED = 8.0, 1e4
"""Residual at which refinement ends, and largest accepted residual, in machine epsilons."""


def approximate_solve(
    unknown: ArmUnknown,
    at: ArmState,
    right: ArmImbalance,
    problem: ArmProblem,
    kind: Kind,
    damping: Array | float = 0.0,
) -> tuple[ArmUnknown, Array, Array]:
    """Approximate solution of the tangent system (see `elimination`; the tangent of friction is
    neglected), whether it is definite for the changes of shape that taut cables allow, and whether
    that is doubtful.

    In single precision throughout: the passes along the arm are bound by memory, and rounding is
    far below the error of the elimination.
    """
    unknown, at, right, problem, damping = c.single(
        (unknown, at, right, problem, jnp.asarray(damping))
    )
    sections, grid = problem.sections, problem.grid
    lower = tangent(unknown.xi, sections, at.tau)
    lower = tuple(
        (*row[:-1], row[-1] + damping * s) for row, s in zip(lower, sections.stiffness, strict=True)
    )

    along, loads = at.along, problem.loads
    slopes = None if along is None or loads is None else slopes_of(along, loads)

    def solve(b: Vector) -> tuple[Vector, Definiteness]:
        if along is not None and slopes is not None and slopes.motion == 6:
            return eliminate_poses(lower, b, unknown.xi, along, slopes, grid, kind.free)
        return eliminate(lower, b, along, slopes, grid, kind.free)

    strain, (negative, doubtful) = solve(spread(right.wrench, kind.free))
    if not kind.cables:
        return ArmUnknown(strain, (), right.turning), negative == 0, doubtful
    units = [
        thread_wrench(thread_direction(unknown.xi, sections.paths[i])[0], sections.paths[i])
        for i in kind.cables
    ]
    pulls = [c.times(at.carried[i], unit) for i, unit in zip(kind.cables, units, strict=True)]
    lengths = [c.times(sections.reach[i], unit) for i, unit in zip(kind.cables, units, strict=True)]
    answers, _ = jax.vmap(solve)(jax.tree.map(lambda *v: jnp.stack(v), *pulls))
    shortening = jnp.stack(
        [jnp.sum(grid.weight * c.dot(length, answers), axis=(1, 2)) for length in lengths]
    )
    given = jnp.stack(
        [jnp.sum(grid.weight * c.dot(length, strain), axis=(0, 1)) for length in lengths]
    )
    tension, held = _tensions(unknown, at, right, problem, kind, shortening, given)
    strain = tuple(
        a - jnp.sum(tension[:, None, None] * answer, axis=0)
        for a, answer in zip(strain, answers, strict=True)
    )
    return ArmUnknown(strain, tuple(tension), right.turning), negative == held, doubtful


def _tensions(
    unknown: ArmUnknown,
    at: ArmState,
    right: ArmImbalance,
    problem: ArmProblem,
    kind: Kind,
    shortening: Array,
    given: Array,
) -> tuple[Array, Array]:
    """Tensions of the cables from the Schur complement of the strains, and the number of its
    negative pivots.

    `shortening`: of each cable's path per tension of each. Each negative pivot is an unstable
    motion of the arm alone that taut cables prevent: the arm is stable if the tangent has no more
    negative eigenvalues than that."""
    rows, sides = [], []
    for i, (place, cable, tension, slack) in enumerate(
        zip(kind.cables, problem.cables, unknown.tension, at.slack, strict=True)
    ):
        slack_now = tension < cable.scale * slack
        unit = jnp.zeros_like(given).at[i].set(1.0)
        row = shortening[i]
        if cable.compliance is not None:
            row = row + unit * cable.stretch(at.carried[place], problem.grid)
        rows.append(jnp.where(slack_now, unit, cable.scale * row))
        sides.append(jnp.where(slack_now, right.cable[i], right.cable[i] + cable.scale * given[i]))
    factors = lu.factor(jnp.stack(rows))
    return lu.substitute(factors, jnp.stack(sides)), jnp.sum(
        lu.diagonal(factors) < 0, axis=0, dtype=jnp.int32
    )


def tangent_solve(
    apply: Callable, unknown: ArmUnknown, problem: ArmProblem, right: ArmImbalance, kind: Kind
) -> ArmUnknown:
    r"""Solution of the exact tangent system $A x = b$, with `approximate_solve` as preconditioner;
    NaN where not found.

    All entries are scaled by energies: a change of strain $\delta\xi$ becomes $\sqrt{\Sigma
    w}\,\delta\xi$, a wrench $\sqrt{w / \Sigma}\,r$, with the weight w of its node, and tensions and
    turning rates likewise. The scaled A is the identity plus the terms of loads and threads. It is
    symmetric where these have a potential, so that one norm serves both modes of differentiation.

    **Arguments:** `apply`: product with A; of `unknown` and the result only the free strains count.
    """
    at = state_of(unknown, problem, kind)
    flat, unravel_row = ravel_pytree(right)
    _, unravel_change = ravel_pytree(_free_part(unknown, kind))
    to_row, to_change = lax.stop_gradient(_units(problem, kind, right))

    def nearly(b: ArmImbalance) -> ArmUnknown:
        step, _, _ = approximate_solve(unknown, at, b, problem, kind)
        return _free_part(cast(step, problem.grid.h.dtype), kind)

    def scaled_apply(x: Array) -> Array:
        return to_row * ravel_pytree(apply(unravel_change(to_change * x)))[0]

    def scaled_nearly(b: Array) -> Array:
        return ravel_pytree(nearly(unravel_row(b / to_row)))[0] / to_change

    # all that does not depend on the right side is computed once, before the loop
    b = to_row * flat
    _, forward = jax.linearize(scaled_nearly, jnp.zeros_like(b))
    back = jax.linear_transpose(forward, b)

    def solve(apply: Callable, b: Array) -> Array:
        return _refined(apply, forward, b)

    def transpose_solve(apply: Callable, b: Array) -> Array:
        return _refined(apply, lambda r: back(r)[0], b)

    return unravel_change(
        to_change * lax.custom_linear_solve(scaled_apply, b, solve, transpose_solve)
    )


def _free_part(unknown: ArmUnknown, kind: Kind) -> ArmUnknown:
    return unknown._replace(xi=free_components(unknown.xi, kind.free))


def _units(problem: ArmProblem, kind: Kind, like: ArmImbalance) -> tuple[Array, Array]:
    """Factors from rows of the residual to scaled rows, and from scaled changes of the unknowns to
    changes."""
    stiffness, weight = problem.sections.stiffness, problem.grid.weight
    weight = jnp.maximum(weight, 1e-6 * jnp.max(weight))  # 0 at an empty step
    root = tuple(jnp.sqrt(weight * s) for s in free_components(stiffness, kind.free))
    turn = jnp.sqrt(weight * jnp.minimum(stiffness[1], stiffness[2]))
    tension = tuple(jnp.sqrt(cable.scale) for cable in problem.cables)
    rows = ArmImbalance(
        tuple(weight / x for x in root),
        tuple(1 / x for x in tension),
        (turn,) * len(kind.frictional),
    )
    changes = ArmImbalance(tuple(1 / x for x in root), tension, (1 / turn,) * len(kind.frictional))
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


def _refined(apply: Callable, nearly: Callable, right: Array) -> Array:
    """Solution of a scaled system by the preconditioned generalised conjugate residual method,
    where each direction is orthogonalised against the last few.

    For a soft motion of the arm the approximate tangent may be ten times too stiff. Plain iterative
    refinement would then take hundreds of steps; orthogonalisation finds such a motion at once. The
    solution is accepted by its own residual, in a last step of the same loop, so that the program
    holds the product once.
    """
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
        x, r, place, taken = at.x + part * p, at.r - part * q, at.taken % _KEPT, at.taken + 1
        refined = ~(jnp.linalg.norm(r) > _FINAL * eps * whole(x)) | (taken >= _REFINEMENTS)
        directions, images = at.directions.at[place].set(p), at.images.at[place].set(q)
        return _Refinement(x, r, directions, images, taken, refined, at.checking, found)

    kept, no = jnp.zeros((_KEPT, *right.shape), right.dtype), jnp.array(False)
    begin = _Refinement(
        jnp.zeros_like(right), right, kept, kept, jnp.zeros((), int), ~(size > 0), no, no
    )
    end = lax.while_loop(lambda at: ~at.done, advance, begin)
    return jnp.where(end.found, end.x, jnp.nan)  # no derivative rather than a wrong one
