"""The tangent system of the coupled balance (see `coupled`): solved nearly, by elimination, and exactly, by refining that."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array

from . import component as c
from .balance import chosen, spread, tangent, thread_direction, thread_wrench
from .component import Vector
from .coupled import Imbalance, Kind, Problem, State, Unknown, state_of
from .elimination import eliminate

_REFINEMENTS = 60
"""Bound on how often a tangent system is refined; it takes five to ten."""

_KEPT = 3
"""How many directions are kept for the next to be conjugate to."""


def approximate_solve(
    unknown: Unknown, at: State, right: Imbalance, problem: Problem, kind: Kind, damping: Array | float = 0.0
) -> tuple[Unknown, Array]:
    """Solution of the tangent system, nearly (see `elimination`; friction's own tangent is left out), and whether it is definite.

    In single precision throughout, the solution too: the passes along the arm move memory more than they compute, and what
    is lost is far less than what the elimination leaves out.
    """
    unknown, at, right, problem, damping = c.single((unknown, at, right, problem, jnp.asarray(damping)))
    sections, grid = problem.sections, problem.grid
    lower = tangent(unknown.xi, sections, at.tau)
    lower = tuple((*row[:-1], row[-1] + damping * s) for row, s in zip(lower, sections.stiffness, strict=True))

    def solve(b: Vector) -> tuple[Vector, Array]:
        return eliminate(lower, b, unknown.xi, at.along, problem.loads, grid, kind.free)

    strain, definite = solve(spread(right.wrench, kind.free))
    if not kind.cables:
        return Unknown(strain, (), right.turning), definite
    units = [thread_wrench(thread_direction(unknown.xi, sections.paths[i])[0], sections.paths[i]) for i in kind.cables]
    pulls = [_times(at.carried[i], unit) for i, unit in zip(kind.cables, units, strict=True)]
    lengths = [_times(sections.reach[i], unit) for i, unit in zip(kind.cables, units, strict=True)]
    answers, _ = jax.vmap(solve)(jax.tree.map(lambda *v: jnp.stack(v), *pulls))
    shortening = jnp.stack([jnp.sum(grid.weight * c.dot(length, answers), axis=(1, 2)) for length in lengths])
    given = jnp.stack([jnp.sum(grid.weight * c.dot(length, strain), axis=(0, 1)) for length in lengths])
    tension = _tensions(unknown, at, right, problem, kind, shortening, given)
    strain = tuple(a - jnp.sum(tension[:, None, None] * answer, axis=0) for a, answer in zip(strain, answers, strict=True))
    return Unknown(strain, tuple(tension), right.turning), definite


def _times(share: Array | None, wrench: Vector) -> Vector:
    return wrench if share is None else c.scale(share, wrench)


def _tensions(unknown: Unknown, at: State, right: Imbalance, problem: Problem, kind: Kind, shortening: Array, given: Array) -> Array:
    """Tensions of the cables from the equations left when the strain is eliminated; `shortening`: by each cable of each."""
    rows, sides = [], []
    for i, (place, cable, tension, slack) in enumerate(zip(kind.cables, problem.cables, unknown.tension, at.slack, strict=True)):
        slack_now = tension < cable.scale * slack
        unit = jnp.zeros_like(given).at[i].set(1.0)
        row = shortening[i]
        if cable.compliance is not None:
            row = row + unit * cable.stretch(at.carried[place], problem.grid)
        rows.append(jnp.where(slack_now, unit, cable.scale * row))
        sides.append(jnp.where(slack_now, right.cable[i], right.cable[i] + cable.scale * given[i]))
    matrix, side = jnp.moveaxis(jnp.stack(rows), (0, 1), (-2, -1)), jnp.moveaxis(jnp.stack(sides), 0, -1)
    return jnp.moveaxis(jnp.linalg.solve(matrix, side[..., None])[..., 0], -1, 0)


def tangent_solve(imbalance: Callable, unknown: Unknown, problem: Problem, right: Imbalance, kind: Kind) -> Imbalance:
    """Solution of the exact tangent system, with `approximate_solve` as preconditioner; NaN where it is not found."""
    # custom_linear_solve has a transpose only if all of its right side is linear in the tangents; rows that nothing moves are not
    tie = 0.0 * sum((jnp.sum(x) for x in jax.tree.leaves(right)), jnp.zeros_like(right.wrench[0][0, 0]))
    right = jax.tree.map(lambda x: x + tie, right)
    still = jax.tree.map(jnp.zeros_like, right)
    _, matvec = jax.linearize(imbalance, still)
    at = state_of(unknown, problem, kind)

    def nearly(b: Imbalance) -> Imbalance:
        step, _ = approximate_solve(unknown, at, b, problem, kind)
        step = jax.tree.map(lambda x: x.astype(problem.grid.h.dtype), step)
        return Imbalance(chosen(step.xi, kind.free), step.tension, step.turning)

    # what does not depend on the right side is done once, before the loop
    _, nearly = jax.linearize(nearly, still)
    back = jax.linear_transpose(nearly, still)
    weight = _weights(problem, kind)

    def solve(apply: Callable, b: Imbalance) -> Imbalance:
        return _refined(apply, nearly, b, weight)

    def transpose_solve(apply: Callable, b: Imbalance) -> Imbalance:
        return _refined(apply, lambda r: back(r)[0], b, weight)

    return lax.custom_linear_solve(matvec, right, solve, transpose_solve)


def _weights(problem: Problem, kind: Kind) -> Imbalance:
    """Weights that make the squares of wrenches, forces and turning rates comparable: as strains without unit."""
    stiffness = problem.sections.stiffness
    axial = jnp.mean(stiffness[3])
    wrench = tuple(1 / (axial * s) for s in chosen(stiffness, kind.free))
    return Imbalance(wrench, (axial**-2,) * len(kind.cables), (jnp.mean(stiffness[1]) / axial,) * len(kind.rubbing))


def _refined(apply: Callable, nearly: Callable, right: Imbalance, weight: Imbalance) -> Imbalance:
    """Solution by generalised conjugate residuals with a solver that is nearly right, each new residual normal to the last few.

    Where an arm is soft the approximate tangent may be ten times too stiff for one of its motions. Refining by the residual
    alone would then take hundreds of steps; the few directions kept find such a motion at once.
    """
    least = 4 * jnp.finfo(right.wrench[0].dtype).eps
    still, zero = jax.tree.map(jnp.zeros_like, right), jnp.zeros_like(_largest(right))

    def dot(a: Imbalance, b: Imbalance) -> Array:
        return sum(jax.tree.leaves(jax.tree.map(lambda w, x, y: jnp.sum(w * x * y), weight, a, b)), zero)

    def proceed(carry: tuple) -> Array:
        *_, correction, whole, count = carry
        return (count < _REFINEMENTS) & (correction > least * whole)

    def advance(carry: tuple) -> tuple:
        x, r, kept, _, _, count = carry
        p = nearly(r)
        q = apply(p)
        for old_p, old_q in kept:
            share = dot(q, old_q)
            p, q = c.subtract(p, c.scale(share, old_p)), c.subtract(q, c.scale(share, old_q))
        size = dot(q, q)
        inverse = jnp.where(size > 0, 1 / jnp.sqrt(jnp.where(size > 0, size, 1.0)), 0.0)
        p, q = c.scale(inverse, p), c.scale(inverse, q)
        part = dot(r, q)
        step = c.scale(part, p)
        x, r = c.add(x, step), c.subtract(r, c.scale(part, q))
        return x, r, (*kept[1:], (p, q)), _largest(step), _largest(x), count + 1

    start = still, right, ((still, still),) * _KEPT, zero + jnp.inf, zero, 0
    x, *_, correction, whole, _ = lax.while_loop(proceed, advance, start)
    found = correction <= least**0.5 * whole  # no derivative rather than a wrong one
    return jax.tree.map(lambda leaf: jnp.where(found, leaf, jnp.nan), x)


def _largest(tree: Imbalance) -> Array:
    return jnp.max(jnp.stack([jnp.max(jnp.abs(leaf)) for leaf in jax.tree.leaves(tree)]))
