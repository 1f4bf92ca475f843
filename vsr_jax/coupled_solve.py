r"""Solution of the coupled balance (see `coupled`): damped Newton steps with a tangent that is nearly exact, and implicit derivatives."""

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array

from . import component as c
from .balance import (
    chosen,
    no_derivative,
    rounding_floor,
    solve_balance,
    spread,
    strain_norm,
    tangent,
    thread_direction,
    thread_wrench,
)
from .component import Vector
from .coupled import Imbalance, Kind, Problem, State, Unknown, harmless, imbalance_of, size_of_loads, state_of, with_tensions
from .elimination import eliminate
from .newton import LOAD_SHARES, Damped, Solution, damped_newton

_MOST_TURN = 1.5
"""Bound on how far [rad] one Newton step may turn the arm's end."""

_REFINEMENTS = 30
"""Bound on how often a tangent system is refined; it takes five to ten."""


def approximate_solve(
    unknown: Unknown, at: State, right: Imbalance, problem: Problem, kind: Kind, damping: Array | float = 0.0
) -> tuple[Unknown, Array]:
    """Solution of the tangent system, nearly (see `elimination`; friction's own tangent is left out), and whether it is definite."""
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


@partial(jax.custom_jvp, nondiff_argnums=(1,))
def solve_arm(problem: Problem, kind: Kind) -> Solution:
    """Equilibrium of the arm, from the balance without loads and with slack cables.

    Derivatives are implicit, of any order, in forward and reverse mode: the exact tangent is solved by refining
    `approximate_solve`.
    """
    return _side_by_side(kind)(_start(problem, kind), problem)


@solve_arm.defjvp
def _solve_arm_jvp(kind: Kind, primals: tuple[Problem], tangents: tuple[Problem]) -> tuple[Solution, Solution]:
    solution = solve_arm(primals[0], kind)
    # Where nothing was found there is no derivative: take it at rest without loads and forces, where it is finite.
    sound = solution.balanced & solution.definite

    def placed(change: Imbalance, problem: Problem) -> Unknown:
        """Unknowns at the solution plus a change of those that are solved for; locked strains are those of the rod at rest."""
        rest = problem.sections.rest
        xi = tuple(jnp.where(sound, x, jnp.broadcast_to(r, x.shape)) for x, r in zip(solution.unknown.xi, rest, strict=True))
        xi = c.add(xi, spread(change.wrench, kind.free))
        xi = tuple(x if i in kind.free else jnp.broadcast_to(rest[i], x.shape) for i, x in enumerate(xi))
        others = (tuple(jnp.where(sound, x, 0.0) for x in part) for part in solution.unknown[1:])
        tension, turning = (c.add(x, dx) for x, dx in zip(others, change[1:], strict=True))
        return Unknown(xi, tension, turning)

    def imbalance(change: Imbalance, problem: Problem) -> Imbalance:
        unknown, problem = placed(change, problem), harmless(problem, sound)
        return imbalance_of(unknown, state_of(unknown, problem, kind), problem, kind)

    free, others = chosen(solution.unknown.xi, kind.free), solution.unknown[1:]
    still = jax.tree.map(jnp.zeros_like, Imbalance(free, *others))
    _, right = jax.jvp(lambda problem: imbalance(still, problem), primals, tangents)
    change = _tangent_solve(
        lambda change: imbalance(change, primals[0]), placed(still, primals[0]), harmless(primals[0], sound), right, kind
    )
    # the rods' own rest strain moves the locked strains
    _, locked = jax.jvp(lambda problem: placed(still, problem).xi, primals, tangents)
    moved = spread(c.scale(-1.0, change.wrench), kind.free)
    xi = tuple(x if i in kind.free else y for i, (x, y) in enumerate(zip(moved, locked, strict=True)))
    d_unknown = Unknown(xi, c.scale(-1.0, change.cable), c.scale(-1.0, change.turning))
    return solution, Solution(d_unknown, *no_derivative(*solution[1:]))


def _tangent_solve(imbalance: Callable, unknown: Unknown, problem: Problem, right: Imbalance, kind: Kind) -> Imbalance:
    """Solution of the exact tangent system: what `approximate_solve` leaves is solved for again, until nothing is left."""
    still = jax.tree.map(jnp.zeros_like, right)
    _, matvec = jax.linearize(imbalance, still)
    at = state_of(unknown, problem, kind)

    def nearly(b: Imbalance) -> Imbalance:
        step, _ = approximate_solve(unknown, at, b, problem, kind)
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


def _start(problem: Problem, kind: Kind) -> Unknown:
    """Balance of each section alone, without loads, cables slack and without friction."""
    tension = (jnp.zeros_like(problem.grid.h[0]),) * len(kind.cables)
    tau = problem.sections.carry(with_tensions(problem.forces, tension, kind))
    alone = solve_balance(problem.sections, tau, None, kind.free)
    sound = alone.balanced & alone.definite
    xi = tuple(jnp.where(sound, x, rest) for x, rest in zip(alone.xi, problem.sections.rest, strict=True))
    return Unknown(xi, tension, (jnp.zeros_like(xi[0]),) * len(kind.rubbing))


def _side_by_side(kind: Kind) -> Callable[[Unknown, Problem], Solution]:
    """`_solve` with another rule for `jax.vmap`: the batch goes into the last axis.

    Passes along the arm then read and write whole rows. With the batch in front every array that goes through a pass is
    transposed on the way in and out, which took most of the time.
    """

    @jax.custom_batching.custom_vmap
    def solve(start: Unknown, problem: Problem) -> Solution:
        return _solve(start, problem, kind)

    @solve.def_vmap
    def _(size: int, batched: list, *arguments: Any) -> tuple[Solution, Any]:
        rows = jax.tree.map(lambda x, along: jnp.moveaxis(x, 0, -1) if along else x[..., None], arguments, tuple(batched))
        start = jax.tree.map(lambda x: jnp.broadcast_to(x, (*x.shape[:-1], size)), rows[0])
        solution = jax.tree.map(lambda x: jnp.moveaxis(x, -1, 0), solve(start, rows[1]))
        return solution, jax.tree.map(lambda _: True, solution)

    return solve


def _solve(start: Unknown, whole: Problem, kind: Kind) -> Solution:
    grid, sections = whole.grid, whole.sections
    stiffness, length = sections.stiffness, jnp.sum(grid.h, axis=0)
    axial = jnp.sum(grid.weight * stiffness[3], axis=(0, 1)) / length

    arms = start.xi[0].shape[2:]

    def inner(x: Array) -> tuple[int, ...]:
        return tuple(range(x.ndim - len(arms)))

    def largest(x: Array) -> Array:
        return jnp.max(jnp.abs(x), axis=inner(x))

    def strains(wrench: Vector) -> Array:
        return strain_norm(spread(wrench, kind.free), stiffness)

    def rows(imbalance: Imbalance, at: State) -> list[Array]:
        """The other rows as strains: a force by the axial stiffness, a turning rate by what friction makes of it."""
        turned = [length * at.tau[place] * rate / axial for place, rate in zip(kind.rubbing, imbalance.turning, strict=True)]
        return [*(force / axial for force in imbalance.cable), *turned]

    def evaluate(unknown: Unknown, damping: Array, share: Array) -> Damped:
        problem = whole.with_share(share)
        at = state_of(unknown, problem, kind)
        imbalance = imbalance_of(unknown, at, problem, kind)
        step, definite = approximate_solve(unknown, at, imbalance, problem, kind, damping)
        moved = largest(jnp.sqrt(c.dot(step.xi, c.multiply(stiffness, step.xi)) / stiffness[3]))
        others = rows(Imbalance((), step.tension, step.turning), at)
        # A step that coils the arm may well lower the residual, and lead nowhere.
        turned = sum((jnp.sum(grid.weight * jnp.abs(k), axis=(0, 1)) for k in step.xi[:3]), jnp.zeros_like(moved))
        step = jax.tree.map(lambda x: x * jnp.minimum(1.0, _MOST_TURN / jnp.maximum(turned, _MOST_TURN)), step)
        size = moved + sum((largest(x) for x in others), jnp.zeros_like(moved))
        square = jnp.sum(grid.weight * strains(imbalance.wrench) ** 2, axis=(0, 1)) / length
        square = square + sum((jnp.mean(x**2, axis=inner(x)) for x in rows(imbalance, at)), jnp.zeros_like(square))
        return Damped(step, size, imbalance.wrench, jnp.sqrt(square), definite)

    def work(wrench: Vector, step: Unknown) -> Array:
        return jnp.sum(grid.weight * c.dot(wrench, chosen(step.xi, kind.free)), axis=(0, 1))

    floor = jnp.max(rounding_floor(stiffness, whole.forces), axis=(0, 1)) * (1 + size_of_loads(whole))
    shares = 1 if whole.loads is None else LOAD_SHARES
    return damped_newton(evaluate, work, start, jnp.broadcast_to(floor, arms), shares)
