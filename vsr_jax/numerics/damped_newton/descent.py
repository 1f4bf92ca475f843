"""The next step: a damped Newton step, extrapolated or accelerated."""

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array

from ..acceleration import Earlier, accelerated
from ..component import select
from ..once import once
from .convergence import MAX_CONTRACTION, Contraction
from .problem import Setting, Tolerance
from .state import State, Trial, Verdict

MAX_TURN = 1.5
"""Bound on the angle [rad] by which one step of a loaded solve bends and twists the arm. A step
that coils the arm may lower the residual without approaching a solution."""
_MIN_CONTRACTION = 0.25
"""Contraction of the residual above which a step is extrapolated."""


def ahead(state: State, step: Any) -> Any:
    """The point after a step, where that is ready to be tried, else the same point."""
    ready = state.control.ready
    return jax.tree.map(lambda x, s: jnp.where(ready, x - s.astype(x.dtype), x), state.point, step)


def next_step(
    state: State, trial: Trial, verdict: Verdict, found: Contraction, setting: Setting
) -> Any:
    """The step from the point of a trial, or what is left of the last one where that is cut.

    Where convergence is linear, `accelerated` takes its place: without, arms in bent tubes take
    12 % more evaluations. With nearly exact constraints, a step that goes back by half of the last
    one is halved: without, three of 64 arms in straight tubes are not solved
    (benchmarks/contact_search.py --tubes 64 --steps 12).
    """
    last, dot = trial.step, setting.measures.dot
    fraction = jnp.zeros_like(found.work)
    if dot is None:
        fraction = _extrapolation(trial, found, setting.tolerance)
    fraction = once(jnp.where(trial.probing, 1.0, fraction))  # a probe sums up its steps
    step = jax.tree.map(lambda s, last: s + fraction.astype(s.dtype) * last, trial.new.step, last)
    if dot is not None:
        if setting.schedule.stages:
            back = dot(step, last) < -0.5 * dot(last, last)
            halved = trial.without_energy & ~state.local.clear & back
            step = _scaled(jnp.where(halved, 0.5, 1.0), step)
        assert state.earlier is not None
        assert found.linear is not None
        several = found.linear & (state.convergence.full > 0)
        near = accelerated(trial.new.step, last, state.earlier, several, dot)
        step = select(found.linear, near, step)
    if verdict.cut is not None:
        step = select(verdict.cut, _scaled(verdict.part, last), step)
    return step


def _extrapolation(trial: Trial, found: Contraction, tolerance: Tolerance) -> Array:
    r"""Fraction of the last step to take again, where there is an energy.

    The tangent may be approximate. Where it is much too stiff for a soft motion of the arm, the
    residual along a full step contracts only by $\rho$ near 1, and $\rho^2 / (1 - \rho)$ of the
    last step is the remainder of the geometric series. Without it, two of the hard arms of
    `TABLE` in tests/test_hard_loads.py are not solved side by side.
    """
    rho = jnp.clip(jnp.minimum(found.work, found.steps), 0.0, MAX_CONTRACTION)
    slow = found.full & (trial.new.merit > 4 * tolerance.rounding) & (rho > _MIN_CONTRACTION)
    return jnp.where(slow, rho**2 / (1 - rho), 0.0)


def finished(trial: Trial, last: Array) -> Any:
    """The point of a trial, or that after one more step where this is the `last`."""
    last = once(last)
    return jax.tree.map(
        lambda x, s: x - jnp.where(last, s, 0.0).astype(x.dtype), trial.point, trial.new.step
    )


def remembered(earlier: Earlier | None, trial: Trial, verdict: Verdict) -> Earlier | None:
    """The steps before the last one, where that was accepted."""
    if earlier is None:
        return None
    latest = Earlier(trial.new.step, trial.step, earlier.proposed)
    return select(verdict.accepted, latest, earlier)


def _scaled(factor: Array | float, step: Any) -> Any:
    return jax.tree.map(lambda s: jnp.asarray(factor, s.dtype) * s, step)
