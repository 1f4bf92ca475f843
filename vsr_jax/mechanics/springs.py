"""The tangent of an arm with springs between sections far from each other, which the turning chords
of straight tendons are, from the tangent without them."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jaxtyping import Array

from ..numerics import lu
from ..numerics.component import Vector
from ..numerics.quadrature import Grid
from .elimination_nodes import Definiteness

Solve = Callable[..., tuple[Vector, Definiteness]]


def with_springs(solve: Solve, springs: Vector, grid: Grid) -> Solve:
    r"""From the `solve` of a tangent A that of $A + \sum_j w_j w_j^T$ (Woodbury's formula).

    Its number of negative eigenvalues is that of A, less the number of negative pivots of
    $1 + W^T A^{-1} W$.
    """

    weighted = tuple(grid.weight * w for w in springs)

    def work(x: Vector) -> Array:
        """Work of the weighted springs over a change of strain, one number each."""
        parts = [jnp.einsum("isn...,sn...->i...", w, v) for w, v in zip(weighted, x, strict=True)]
        return sum(parts[1:], parts[0])

    answers = jax.vmap(lambda b: solve(b)[0])(springs)
    gram = jax.vmap(work, out_axes=1)(answers)
    one = jnp.eye(len(gram), dtype=gram.dtype)
    factors = lu.factor(gram + one.reshape(*one.shape, *(1,) * (gram.ndim - 2)))
    held = jnp.sum(lu.diagonal(factors) < 0, axis=0, dtype=jnp.int32)

    def stiffer(b: Vector, *push: Array) -> tuple[Vector, Definiteness]:
        x, (negative, doubtful) = solve(b, *push)
        force = lu.substitute(factors, work(x))
        less = (jnp.einsum("j...,jsn...->sn...", force, answer) for answer in answers)
        return tuple(a - b for a, b in zip(x, less, strict=True)), Definiteness(
            negative - held, doubtful
        )

    return stiffer
