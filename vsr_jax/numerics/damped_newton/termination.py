"""When a problem is done: solved, or given up."""

import jax.numpy as jnp
from jaxtyping import Array

from .convergence import MAX_CONTRACTION, Contraction
from .problem import Schedule, Setting, Tolerance
from .state import Local, State, Trial

_MAX_EVALUATIONS, _MAX_STAGED = 200, 300
"""Bound on the evaluations, and that where there are stages; heavy soft arms take 22 to 45."""
_MAX_DAMPING = 1e8
"""Bound on the damping."""
_MAX_PLAIN = 25
"""Bound on the plain Newton steps that follow where damping has failed."""
_MAX_RISES = 3
"""Rises of an accepted residual after which it is taken to be at rounding level."""
_CERTAIN, _NEAR = 0.1, 1e-4
"""Contraction of steps and residuals, and norm of a step, below which the last step is taken
without an evaluation after it: what it leaves is then known from the contraction."""


def begin(like: Array) -> Local:
    """Nothing is known before the first evaluation."""
    zero, no = jnp.zeros_like(like), jnp.zeros(like.shape, bool)
    return Local(zero, zero + jnp.inf, zero, definite=~no, doubtful=no, clear=no, out=no)


def takes_plain_steps(state: State, schedule: Schedule) -> Array:
    """Which problems have reached a bound: undamped steps that are always accepted follow, which
    find an unstable equilibrium if one is near.

    Without them, a column beyond its critical weight is not solved, in place of unstable
    (`test_status_and_shape_are_what_they_must_be` in tests/test_hard_loads.py).
    """
    bound = _MAX_STAGED if schedule.stages else _MAX_EVALUATIONS
    return (
        (state.evaluations >= bound) | (state.control.damping >= _MAX_DAMPING) | (state.plain > 0)
    )


def solving(state: State, setting: Setting) -> Array:
    """Which problems are neither solved nor given up.

    A residual that has risen three times is rounding: without that end, hard arms take 29 % more
    evaluations. One that is rounding where the tangent is indefinite is an unstable solution:
    without that end, upright arms take 2.5 times as many. Both by the arms of `TABLE` in
    tests/test_hard_loads.py and the structure "upright, chamber at rest" of
    benchmarks/ordinary_scenes.py.
    """
    local, control, tolerance = state.local, state.control, setting.tolerance
    negligible = (local.error < tolerance.step) | (state.convergence.rises >= _MAX_RISES)
    accepted = local.residual_norm <= tolerance.accepted
    done = control.ready & (control.damping == 0) & accepted & negligible
    stuck = ~local.definite & (local.residual_norm < tolerance.rounding)
    ended = (done | stuck) & (state.path.level == setting.schedule.last)
    return ~ended & ~local.out & (state.plain < _MAX_PLAIN)


def converged(state: State, setting: Setting) -> Array:
    """Which problems have an accepted residual, with constraints that are exact.

    Without the second condition, the solution with springs is given where the exact residual is not
    finite (`test_a_softened_problem_alone_is_no_solution` in tests/test_damped_newton.py).
    """
    accepted = state.local.residual_norm <= setting.tolerance.accepted
    schedule = setting.schedule
    return accepted & (state.path.level == schedule.last) if schedule.stages else accepted


def local(
    state: State, trial: Trial, found: Contraction, tolerance: Tolerance
) -> tuple[Array, Local]:
    """Whether the step from the point of a trial is the last one, taken without another evaluation;
    and what is known there, or after the last step.

    Without last steps, catheters take 12 %, arms driven by lengths 11 % and arms of all slenderness
    under tip forces 10 % more evaluations.
    """
    new, clear, out = trial.new, trial.new.clear, trial.new.out
    rate = jnp.maximum(jnp.maximum(found.steps, state.convergence.rate), found.residuals)
    rate = jnp.clip(rate, 0.0, 1.0)
    residual_norm, error = rate * new.merit, rate / (1 - rate) * new.size
    certain = found.full & new.definite & (rate < _CERTAIN) & (new.size < _NEAR)
    last = certain & (residual_norm <= tolerance.accepted) & (error < tolerance.step)
    rho = jnp.where(found.full, jnp.clip(found.steps, 0.0, MAX_CONTRACTION), 0.0)
    return last, Local(
        step_norm=new.size,
        residual_norm=jnp.where(last, residual_norm, new.merit),
        error=jnp.where(last, error, new.size / (1 - rho)),
        definite=new.definite,
        doubtful=new.doubtful,
        clear=state.local.clear if clear is None else clear,
        out=state.local.out if out is None else out,
    )
