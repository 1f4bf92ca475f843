"""Newton's method with a step that is cut where the residual rises, for one vector or for a batch
of small problems in component arrays."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array

from .component import select
from .loops import while_loop

MAX_STEPS = 50
"""Bound on the evaluations of `newton`; the cases of the paper take 1 to 5."""
_MIN_FRACTION = 0.05
"""Fraction of a step below which `newton` gives up: three cuts to a quarter. Of 600,000 random
sections with one to three threads and up to ten times the forces that collapse them, the same
386,606 are balanced with ten cuts, and with one."""
_FAST = 1e-4
"""Ratio of successive steps below which convergence is quadratic: a step may then be larger when
`newton` ends."""


class Evaluation(NamedTuple):
    """Evaluation of one point for `newton`: the step to subtract, its size, the size of the
    residual, and whether the tangent is positive definite. The sizes are dimensionless, with one
    entry per problem."""

    step: Any
    size: Array
    merit: Array
    definite: Array


class Iterate(NamedTuple):
    """Where `newton` ended: the point, whether the last tangent was positive definite, and the
    number of steps."""

    x: Any
    definite: Array
    steps: Array


class Root(NamedTuple):
    """Result of a root search: the point, whether the residual vanishes there, whether the tangent
    is positive definite there, the number of evaluations, whether it is that of a loosened problem,
    where there is one, and whether the search gave up its start and began again."""

    x: Any
    converged: Array
    definite: Array
    steps: Array
    loose: Array | None = None
    restarted: Array | None = None


def newton(evaluate: Callable[[Any], Evaluation], start: Any, floor: Array) -> Iterate:
    """Root of a residual from `start`.

    A step that does not lower the residual's size is cut to a quarter and tried again. The loop
    ends when the next step of every problem is so small that its quadratic error is below rounding
    (that step is still taken; the bound is larger where steps shrink fast), when the fraction of a
    step is negligible, or after `MAX_STEPS` evaluations. The caller judges the result from the
    residual there.

    **Arguments:**
    - `evaluate`: maps a point, a pytree of arrays, to its `Evaluation`.
    - `floor`: size of the residual that counts as rounding; steps below it are always accepted.
    """
    merit = jnp.full_like(floor, jnp.inf)
    eps = jnp.finfo(merit.dtype).eps
    small, smaller = eps**0.5, eps**0.6

    def proceed(state: tuple) -> Array:
        _, at, fraction, enough, count = state
        pending = ((at.size > enough) | jnp.isinf(at.merit)) & (fraction > _MIN_FRACTION)
        return (count < MAX_STEPS) & jnp.any(pending)

    def advance(state: tuple) -> tuple:
        x, at, fraction, enough, count = state
        trial = jax.tree.map(lambda a, s: a - fraction * s, x, at.step)
        new = evaluate(trial)
        better = (new.merit < at.merit) | (new.merit < floor)
        enough = jnp.where(better & (new.size < _FAST * at.size), small, smaller)
        x, at = select(better, (trial, new), (x, at))
        return x, at, jnp.where(better, jnp.ones_like(fraction), fraction / 4), enough, count + 1

    still = jax.tree.map(jnp.zeros_like, start)
    first = Evaluation(still, jnp.zeros_like(merit), merit, jnp.ones(merit.shape, bool))
    begin = (start, first, jnp.ones_like(merit), jnp.zeros_like(merit), jnp.zeros((), jnp.int32))
    x, at, fraction, _, count = while_loop(proceed, advance, begin)
    # a step of which even a fraction was rejected is not taken
    last = select(fraction == 1, at.step, jax.tree.map(jnp.zeros_like, at.step))
    return Iterate(jax.tree.map(jnp.subtract, x, last), at.definite, count)
