"""Newton's method with a guarded step, for one vector or for many small problems side by side in component arrays."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array

MAX_STEPS = 50
_LEAST_FRACTION = 1e-6


class Evaluation(NamedTuple):
    """What Newton's method learns at a point: the step to subtract, its size, the size of the residual, and whether the
    tangent is positive definite there. The sizes have no unit and the shape of one problem per entry."""

    step: Any
    size: Array
    merit: Array
    definite: Array


class Root(NamedTuple):
    """Where Newton's method ended: the point, whether the last tangent was positive definite, and the steps taken."""

    x: Any
    definite: Array
    steps: Array


def newton(evaluate: Callable[[Any], Evaluation], start: Any, floor: Array) -> Root:
    """Root of a residual from `start`.

    A step that does not lower the residual's size is cut to a quarter and tried again. The loop ends when the next step
    of every problem is so small that its own quadratic error is below rounding (that step is still taken), when the
    fraction of a step has become negligible, or after 50 evaluations. The caller decides from the residual at the end
    what was reached.

    **Arguments:**
    - `evaluate`: maps a point, a pytree of arrays, to its `Evaluation`.
    - `floor`: size of the residual that counts as rounding; steps below it are always accepted.
    """
    merit = jnp.full_like(floor, jnp.inf)
    small = jnp.finfo(merit.dtype).eps ** 0.6

    def proceed(state: tuple) -> Array:
        _, at, fraction, count = state
        pending = ((at.size > small) | jnp.isinf(at.merit)) & (fraction > _LEAST_FRACTION)
        return (count < MAX_STEPS) & jnp.any(pending)

    def advance(state: tuple) -> tuple:
        x, at, fraction, count = state
        trial = jax.tree.map(lambda a, s: a - fraction * s, x, at.step)
        new = evaluate(trial)
        better = (new.merit < at.merit) | (new.merit < floor)
        x, at = jax.tree.map(lambda a, b: jnp.where(better, a, b), (trial, new), (x, at))
        return x, at, jnp.where(better, jnp.ones_like(fraction), fraction / 4), count + 1

    still = jax.tree.map(jnp.zeros_like, start)
    first = Evaluation(still, jnp.zeros_like(merit), merit, jnp.ones(merit.shape, bool))
    x, at, _, count = lax.while_loop(proceed, advance, (start, first, jnp.ones_like(merit), jnp.zeros((), jnp.int32)))
    return Root(jax.tree.map(jnp.subtract, x, at.step), at.definite, count)
