"""Stiffness across spans: a chain with springs between sections far from each other, which the
turning chords of straight tendons are, from the chain without them."""

from collections.abc import Callable, Sequence
from functools import partial

import jax
import jax.numpy as jnp
from jaxtyping import Array

from ..numerics import component as c, lu
from ..numerics.component import Vector
from ..numerics.quadrature import Grid
from ..numerics.stacked import components, stack
from .border import listed
from .definiteness import Definiteness

Solve = Callable[..., tuple[Vector, Definiteness]]
"""Solution of a system for several right sides, components (k, stages, steps, ...)."""


def with_spans(
    solve: Solve, springs: Vector, grid: Grid, conservative: Array | bool, *, apart: bool
) -> Solve:
    r"""From the `solve` of a matrix A that of $A + \sum_j w_j w_j^T$ (Woodbury's formula).

    Its number of negative eigenvalues is that of A, less the number of negative pivots of
    $1 + W^T A^{-1} W$.

    **Arguments:**
    - `conservative`: whether the loads have a potential.
    - `apart`: solve for the springs apart from the right sides.
    """
    weighted = stack(tuple(grid.weight * w for w in springs))

    def work(x: Array) -> Array:
        """Work (springs, k, ...) of the weighted springs over changes of strain."""
        return jnp.einsum("cisn...,cksn...->ik...", weighted, x)

    def held_by(answers: Array) -> Array:
        """The factors of $1 + W^T A^{-1} W$."""
        gram = work(answers)
        one = jnp.eye(len(gram), dtype=gram.dtype)
        return lu.factor(gram + one.reshape(*one.shape, *(1,) * (gram.ndim - 2)))

    known = stack(solve(springs)[0]) if apart else None
    factored = None if known is None else held_by(known)

    def stiffer(b: Vector, *push: Array) -> tuple[Vector, Definiteness]:
        answers, factors = known, factored
        if answers is None or factors is None:
            x, answers, definiteness = solve_both(solve, (b, *push), springs)
            answers = stack(answers)
            factors = held_by(answers)
        else:
            x, definiteness = solve(b, *push)
        force = jax.vmap(partial(lu.substitute, factors), 1, 1)(work(stack(x)))
        less = jnp.einsum("jk...,cjsn...->cksn...", force, answers)
        held = jnp.sum(lu.diagonal(factors) < 0, axis=0, dtype=jnp.int32)
        return c.subtract(x, components(less)), definiteness.without(held, conservative)

    return stiffer


def solve_both(
    solve: Solve, sides: Sequence, columns: Vector, *, apart: bool = False
) -> tuple[Vector, Vector, Definiteness]:
    """Solutions for right sides and what pushes them, and for columns that nothing pushes;
    `apart`: each by a pass of its own."""
    b, *pushes = sides
    if apart:
        found, definiteness = solve(b, *pushes)
        return found, solve(columns)[0], definiteness
    count, more = len(b[0]), len(columns[0])
    pushes = (jnp.pad(push, [(0, more), *[(0, 0)] * (push.ndim - 1)]) for push in pushes)
    both = tuple(map(listed, zip(b, columns, strict=True)))
    found, definiteness = solve(both, *pushes)
    return tuple(x[:count] for x in found), tuple(x[count:] for x in found), definiteness
