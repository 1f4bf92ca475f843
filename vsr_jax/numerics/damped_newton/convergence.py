"""How fast full steps shrink."""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array

from ..once import once
from .problem import Setting, Tolerance
from .state import Control, Convergence, State, Trial, Verdict

_TAIL = 0.3
"""Angle [rad] of a step below which convergence may be linear."""
MAX_CONTRACTION = 0.99
"""Largest contraction that is used: it bounds an extrapolation to 98 steps."""
_QUADRATIC = 0.3
"""Ratio of successive contractions below which convergence is quadratic."""


class Contraction(NamedTuple):
    """Contraction along the last step.

    **Fields:** whether this was a `full` one: accepted, undamped, and between two points at one
    load level; ratios of the norms of the `steps` and of the `residuals`; ratio of the `work` of
    both residuals over the step; whether convergence is `linear`, None where that does not matter.
    """

    full: Array
    steps: Array
    residuals: Array
    work: Array
    linear: Array | None


def begin(like: Array) -> Convergence:
    """Nothing is known."""
    zero, none = jnp.zeros_like(like), jnp.zeros(like.shape, jnp.int32)
    return Convergence(none, zero + jnp.inf, zero, none)


def measured(
    state: State, trial: Trial, verdict: Verdict, control: Control, setting: Setting
) -> Contraction:
    """Contraction along the step of a trial, after which `control` holds."""
    before, local, new = state.control, state.local, trial.new
    undamped = verdict.accepted & (before.damping == 0) & (control.damping == 0)
    full = before.ready & undamped & (state.path.level == trial.level)
    steps, linear = new.size / local.step_norm, None
    if setting.measures.dot is not None:
        near = ~trial.probing & (trial.turn < _TAIL) & (new.size > setting.tolerance.step)
        linear = once(near & full & (steps > _QUADRATIC * state.convergence.ratio))
    return Contraction(
        full, steps, new.merit / local.residual_norm, trial.work / before.slope, linear
    )


def updated(state: State, trial: Trial, found: Contraction, tolerance: Tolerance) -> Convergence:
    """Convergence after a trial. A full step that raises an accepted residual is at rounding
    level."""
    old, before = state.convergence, state.local.residual_norm
    risen = found.full & (before <= tolerance.accepted) & (trial.new.merit >= before)
    rate = old.rate
    if found.linear is not None:
        slowest = jnp.maximum(old.rate, jnp.where(found.linear, found.steps, 0.0))
        rate = jnp.where(found.full, slowest, 0.0)
    return Convergence(
        full=jnp.where(found.full, old.full + 1, 0),
        ratio=jnp.where(found.full, found.steps, jnp.inf),
        rate=rate,
        rises=old.rises + risen.astype(jnp.int32),
    )
