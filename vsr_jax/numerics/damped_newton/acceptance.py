"""Whether a step is accepted, and how the damping follows from that."""

import jax.numpy as jnp
from jaxtyping import Array

from ..component import select
from ..once import once
from . import continuation
from .problem import Schedule, Setting, Tolerance
from .state import Control, State, Trial, Verdict

_MIN_DAMPING = 0.3
"""Least damping above zero."""
_RAISE, _LOWER = 8.0, 4.0
"""Factor by which damping rises after a rejected step, and divisor after an accepted one."""
_SLIDING_CUTS, _SLIDING_PART = 5, 0.5
"""Number of times that a step is cut where something slides with friction, and what is left of
it."""
_STEEP_CUTS, _STEEP_PART = 2, 0.25
"""The same where springs stand for constraints."""


def begin(damping: Array) -> Control:
    """Control of the first step, with a `damping`. The start is not evaluated yet."""
    zero = jnp.zeros_like(damping)
    no, none = jnp.zeros(damping.shape, bool), jnp.zeros(damping.shape, jnp.int32)
    return Control(damping, ready=no, slope=zero, cuts=none)


def next_damping(control: Control) -> Array:
    """Damping of the next evaluation: less than before, if the step is ready to be tried."""
    lower = jnp.where(control.damping >= _LOWER * _MIN_DAMPING, control.damping / _LOWER, 0.0)
    return jnp.where(control.ready, lower, control.damping)


def judge(state: State, trial: Trial, setting: Setting) -> Verdict:
    """What becomes of the step of a trial. A point that was evaluated only with more damping is
    kept."""
    tolerance, schedule = setting.tolerance, setting.schedule
    control, merit = state.control, trial.new.merit
    better = (
        (trial.work >= -control.slope)
        | (merit < state.local.residual_norm)
        | (merit < tolerance.rounding)
        | trial.forced
    )
    accepted = ~control.ready | (jnp.isfinite(merit) & better)
    sliding = steep = cut = None
    part = _SLIDING_PART
    if trial.new.slides is not None:
        sliding = cut = _rises_sliding(state, trial, tolerance)
        accepted = accepted & ~sliding
    if schedule.stages:
        steep = ~accepted & _may_be_steep(state, trial, schedule)
        cut = steep if sliding is None else sliding | steep
        part = jnp.where(steep, _STEEP_PART, _SLIDING_PART)
    return Verdict(once(accepted), sliding, steep, None if cut is None else once(cut), part)


def _rises_sliding(state: State, trial: Trial, tolerance: Tolerance) -> Array:
    """Whether something slides, so that no energy can fall, and the residual does not become
    smaller.

    Without cuts of such steps, eight of 1,344 samples on floors fail in place of two
    (benchmarks/friction_search.py --arms 64 --steps 12).
    """
    assert trial.new.slides is not None
    control, same = state.control, state.path.level == trial.level
    here = trial.new.slides & control.ready & same & (control.cuts < _SLIDING_CUTS)
    lower = trial.new.merit < jnp.maximum(state.local.residual_norm, tolerance.accepted)
    return ~trial.probing & here & ~lower


def _may_be_steep(state: State, trial: Trial, schedule: Schedule) -> Array:
    """Whether springs stand for constraints, which may be too steep for the step.

    Without cuts of such steps, held arms take 6 % and arms in bent tubes 5 % more evaluations.
    """
    control = state.control
    other = trial.probing | trial.forced | continuation.is_slow(state.path, schedule)
    loaded = state.path.level >= schedule.increments
    return ~other & control.ready & loaded & (control.cuts < _STEEP_CUTS)


def updated(control: Control, trial: Trial, verdict: Verdict) -> Control:
    """Control after a trial, its slope that of the last step."""
    accepted, forced = verdict.accepted, trial.forced
    definite = trial.new.definite | forced
    rejected = _raised(jnp.where(accepted, trial.damping, control.damping))
    following = control._replace(
        damping=jnp.where(accepted & definite, trial.damping, rejected),
        ready=jnp.where(accepted, definite, forced),
    )
    if verdict.cut is None:
        return following
    shorter = control._replace(cuts=control.cuts + 1)
    if verdict.steep is not None:
        shorter = shorter._replace(
            damping=jnp.where(verdict.steep, _raised(control.damping), control.damping),
            slope=jnp.where(verdict.steep, verdict.part, 1.0) * control.slope,
        )
    return select(verdict.cut, shorter, following._replace(cuts=jnp.zeros_like(control.cuts)))


def _raised(damping: Array) -> Array:
    return jnp.maximum(_RAISE * damping, _MIN_DAMPING)
