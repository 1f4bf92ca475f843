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

_REFINEMENTS = 30
"""Bound on how often a tangent system is refined; it takes five to ten."""


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
    """Solution of the exact tangent system: what `approximate_solve` leaves is solved for again, until nothing is left."""
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

    def refine(apply: Callable, precondition: Callable, b: Imbalance) -> Imbalance:
        least = 4 * jnp.finfo(problem.grid.h.dtype).eps

        def proceed(carry: tuple) -> Array:
            _, correction, whole, count = carry
            return (count < _REFINEMENTS) & (correction > least * whole)

        def advance(carry: tuple) -> tuple:
            x, _, _, count = carry
            step = precondition(c.subtract(b, apply(x)))
            x = c.add(x, step)
            return x, _largest(step), _largest(x), count + 1

        size = jnp.zeros_like(_largest(b))
        return lax.while_loop(proceed, advance, (still, size + jnp.inf, size, 0))[0]

    def transposed(b: Imbalance) -> Imbalance:
        return jax.vjp(nearly, still)[1](b)[0]

    return lax.custom_linear_solve(matvec, right, lambda apply, b: refine(apply, nearly, b), lambda apply, b: refine(apply, transposed, b))


def _largest(tree: Imbalance) -> Array:
    return jnp.max(jnp.stack([jnp.max(jnp.abs(leaf)) for leaf in jax.tree.leaves(tree)]))
