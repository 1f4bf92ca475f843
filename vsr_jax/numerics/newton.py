"""Newton's method with a guarded step, for one vector or for many small problems side by side in
component arrays."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array

from .component import Tree

MAX_STEPS = 50
MAX_DAMPED_STEPS = 200
MAX_PLAIN_STEPS = 25
LOAD_SHARES = 5
MOST_TURN = 1.5
"""Bound on how far [rad] one step of a loaded solve may turn the arm: one that coils it may lower
the residual, and lead nowhere."""
_LEAST_FRACTION = 1e-6
_FAST = 1e-4
_LEAST_DAMPING, _MOST_DAMPING = 0.1, 1e8
_RAISE, _LOWER = 10.0, 30.0
_LEAST_LEFT, _MOST_LEFT = 0.25, 0.99
_ACCEPTED = 64
_MOST_RISES = 3


class Evaluation(NamedTuple):
    """What Newton's method learns at a point: the step to subtract, its size, the size of the
    residual, and whether the tangent is positive definite there. The sizes have no unit and the
    shape of one problem per entry."""

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
    is positive definite there, and the number of evaluations."""

    x: Any
    converged: Array
    definite: Array
    steps: Array


def newton(evaluate: Callable[[Any], Evaluation], start: Any, floor: Array) -> Iterate:
    """Root of a residual from `start`.

    A step that does not lower the residual's size is cut to a quarter and tried again. The loop
    ends when the next step of every problem is so small that its own quadratic error is below
    rounding (that step is still taken; a greater one will do where steps shrink fast), when the
    fraction of a step has become negligible, or after 50 evaluations. The caller decides from the
    residual at the end what was reached.

    **Arguments:**
    - `evaluate`: maps a point, a pytree of arrays, to its `Evaluation`.
    - `floor`: size of the residual that counts as rounding; steps below it are always accepted.
    """
    merit = jnp.full_like(floor, jnp.inf)
    eps = jnp.finfo(merit.dtype).eps
    small, smaller = eps**0.5, eps**0.6

    def proceed(state: tuple) -> Array:
        _, at, fraction, enough, count = state
        pending = ((at.size > enough) | jnp.isinf(at.merit)) & (fraction > _LEAST_FRACTION)
        return (count < MAX_STEPS) & jnp.any(pending)

    def advance(state: tuple) -> tuple:
        x, at, fraction, enough, count = state
        trial = jax.tree.map(lambda a, s: a - fraction * s, x, at.step)
        new = evaluate(trial)
        better = (new.merit < at.merit) | (new.merit < floor)
        enough = jnp.where(better & (new.size < _FAST * at.size), small, smaller)
        x, at = _where(better, (trial, new), (x, at))
        return x, at, jnp.where(better, jnp.ones_like(fraction), fraction / 4), enough, count + 1

    still = jax.tree.map(jnp.zeros_like, start)
    first = Evaluation(still, jnp.zeros_like(merit), merit, jnp.ones(merit.shape, bool))
    begin = (start, first, jnp.ones_like(merit), jnp.zeros_like(merit), jnp.zeros((), jnp.int32))
    x, at, _, _, count = lax.while_loop(proceed, advance, begin)
    return Iterate(jax.tree.map(jnp.subtract, x, at.step), at.definite, count)


class Damped(NamedTuple):
    """What `damped_newton` learns at a point for one damping: the step to subtract, its size, the
    residual, its size, and whether the damped tangent is positive definite there."""

    step: Any
    size: Array
    residual: Any
    merit: Array
    definite: Array


def damped_newton(
    evaluate: Callable[[Any, Array, Array], Damped],
    work: Callable[[Any, Any], Array],
    start: Any,
    floor: Array,
    shares: int = 1,
) -> Root:
    r"""Root of a residual that is the gradient of an energy, or nearly so, by Newton's method with
    Levenberg's damping.

    The tangent is $H + \mu \Sigma$: a short step in implicit time of an arm that creeps. $\mu$
    rises until the tangent is positive definite, and falls with every step taken. A step is taken
    if the residual does not push back over it more than it pulled, $r(x + s) \cdot s \le -r(x)
    \cdot s$, so that the energy falls, or if the residual has become smaller. The loads come in
    equal shares, one more with every step taken until all are there, and such a step is always
    taken: what matters of the way is only where it leads. All at once they often make the tangent
    indefinite at the start. The tangent may be approximate. Where it is much too stiff for a soft
    motion of the arm, what is left of the residual along a full step is a share $\rho$ near 1, and
    the steps shrink by it alone: so the next takes $\rho^2 / (1 - \rho)$ of the last step with it,
    the rest of the geometric series.

    The end is reached where the residual is one that is accepted, the step is undamped, and either
    the step is negligible together with those that would follow it, $1 / (1 - \rho)$ of it, or the
    residual has risen three times: rounding. Nothing that would be refused ends the loop before its
    bounds do. A problem that meets the bound on its evaluations or on $\mu$ gets some plain Newton
    steps from where it is: these end in an equilibrium that is not stable where there is one
    nearby. The last step is never taken, so that the residual returned is that of the point
    returned. Problems may be solved together, in the last axes of all arrays: each takes its own
    steps and stands still when it is done.

    **Arguments:**
    - `evaluate`: maps a point, a damping $\mu$ and the share of the loads to `Damped`.
    - `work`: scalar product of a residual and a step.
    - `floor`: size of the residual that counts as rounding, of the shape of the problems side by
      side.

    **Returns:** a `Root`; it is converged if the residual at the end is rounding or as small as a
    negligible step.
    """
    small = jnp.finfo(floor.dtype).eps ** 0.75
    accepted = jnp.maximum(_ACCEPTED * floor, small)

    def pending(guard: _Guard) -> Array:
        negligible = (guard.miss < small) | (guard.rises >= _MOST_RISES)
        done = guard.fresh & (guard.damping == 0) & (guard.merit <= accepted) & negligible
        stuck = ~guard.definite & (guard.merit < floor)
        return ~((done | stuck) & (guard.given == shares)) & (guard.plain < MAX_PLAIN_STEPS)

    def advance(state: tuple) -> tuple:
        x, step, old = state
        plain = (old.spent >= MAX_DAMPED_STEPS) | (old.damping >= _MOST_DAMPING) | (old.plain > 0)
        trial = jax.tree.map(lambda a, s: jnp.where(old.fresh, a - s.astype(a.dtype), a), x, step)
        damping = jnp.where(plain, 0.0, jnp.where(old.fresh, _lowered(old.damping), old.damping))
        given = jnp.where(
            plain, shares, jnp.where(old.fresh, jnp.minimum(old.given + 1, shares), old.given)
        )
        new = evaluate(trial, damping, given / shares)
        left = work(new.residual, step)
        better = (
            (old.given < shares)
            | (left >= -old.pull)
            | (new.merit < old.merit)
            | (new.merit < floor)
            | plain
        )
        taken = ~old.fresh | (jnp.isfinite(new.merit) & better)
        damping = jnp.where(
            taken & (new.definite | plain), damping, _raised(jnp.where(taken, damping, old.damping))
        )
        whole = (old.damping == 0) & (damping == 0) & old.fresh & (old.given == shares)
        more = _extrapolated(
            whole & (new.merit > 4 * floor), jnp.minimum(left / old.pull, new.size / old.size)
        )
        new = new._replace(
            step=jax.tree.map(lambda s, last: s + more.astype(s.dtype) * last, new.step, step)
        )
        share = jnp.where(whole, jnp.clip(new.size / old.size, 0.0, _MOST_LEFT), 0.0)
        rises = old.rises + (whole & (old.merit <= accepted) & (new.merit >= old.merit)).astype(
            jnp.int32
        )
        there = _Guard(
            new.size,
            new.size / (1 - share),
            new.merit,
            new.definite,
            work(new.residual, new.step),
            damping,
            given,
            new.definite | plain,
            rises,
            old.spent,
            old.plain,
        )
        here = old._replace(damping=damping, fresh=plain)
        guard = _where(taken, there, here)._replace(
            spent=old.spent + 1, plain=old.plain + plain.astype(jnp.int32)
        )
        # a step that is not taken is computed again with more damping before it is used, and that
        # of a problem that is done never is
        go = pending(old)
        return _where(go & taken, trial, x), new.step, _where(go, guard, old)

    zero, no, none = (
        jnp.zeros_like(floor),
        jnp.zeros(floor.shape, bool),
        jnp.zeros(floor.shape, jnp.int32),
    )
    damping = jnp.full_like(floor, _LEAST_DAMPING if shares == 1 else 0.0)
    guard = _Guard(zero, zero, zero + jnp.inf, ~no, zero, damping, zero + 1, no, none, none, none)
    step = jax.tree.map(
        lambda leaf: jnp.zeros(leaf.shape, leaf.dtype),
        jax.eval_shape(evaluate, start, floor, floor).step,
    )
    x, _, guard = lax.while_loop(
        lambda state: jnp.any(pending(state[2])), advance, (start, step, guard)
    )
    return Root(x, guard.merit <= accepted, guard.definite, guard.spent)


class _Guard(NamedTuple):
    """What `damped_newton` keeps of each problem besides the point and the step: size of the step,
    what is missed without it and those that would follow, size of the residual, whether the tangent
    is definite, the work of the residual over the step; damping, shares of the loads so far,
    whether the step may be tried, how often an undamped step raised a residual that is accepted,
    evaluations so far, and the plain ones of them."""

    size: Array
    miss: Array
    merit: Array
    definite: Array
    pull: Array
    damping: Array
    given: Array
    fresh: Array
    rises: Array
    spent: Array
    plain: Array


def _extrapolated(wanted: Array, left: Array) -> Array:
    """How much of the last step to take again where wanted, from the share of the residual that it
    left along itself."""
    share = jnp.clip(left, 0.0, _MOST_LEFT)
    return jnp.where(wanted & (share > _LEAST_LEFT), share**2 / (1 - share), 0.0)


def _raised(damping: Array) -> Array:
    return jnp.maximum(_RAISE * damping, _LEAST_DAMPING)


def _lowered(damping: Array) -> Array:
    return jnp.where(damping > 1e-2 * _LEAST_DAMPING, damping / _LOWER, 0.0)


def _where(condition: Array, a: Tree, b: Tree) -> Tree:
    return jax.tree.map(lambda x, y: jnp.where(condition, x, y), a, b)
