r"""Stability probe of a solution whose tangent is doubtful: the arm is moved from it and creeps,

$$s_{n+1} = s_n + (H + \mu \Sigma)^{-1} r(x - s_n).$$

The solution is unstable if the motion grows after some steps. Without the probe, solutions with a
pair of unstable motions, which pivots miss, are called stable
(`test_a_doubtful_root_without_stability_is_found_out` in tests/test_damped_newton.py).
"""

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array

from .problem import Damped, Measures, Tolerance
from .state import Local, Probe, State, Trial

DAMPING = 1.0
"""Damping of a probe: a motion of stiffness $\\lambda$, relative to the elastic one, is multiplied
by $1 / (1 + \\lambda)$ in each step."""
_STEPS, _SETTLING = 16, 6
"""Steps of a probe, and the first of them that only let the slowest motion prevail."""
_DECAYED = 0.1
"""Remainder of the motion that ends a probe."""
_CLOSE = 1e-3
"""Norm of a step below which a doubtful sign of the tangent may be rounding."""


def begin(like: Array) -> Probe:
    """Nothing is probed yet."""
    return Probe(jnp.zeros(like.shape, jnp.int32), jnp.ones_like(like))


def pending(state: State, solving: Array, tolerance: Tolerance) -> Array:
    """Which solutions are still to be probed."""
    local, probe = state.local, state.probe
    found = ~solving & local.definite & (local.residual_norm <= tolerance.accepted)
    decayed = probe.growth < _DECAYED
    return found & local.doubtful & (probe.steps < _STEPS) & ~decayed


def displaced(state: State, probing: Array, measures: Measures) -> Any:
    """The steps, those of a probe made so small that the residual is linear and so large that its
    rounding is small.

    The first one also stirs the motions that a symmetric problem never makes. Without it, an arm
    that leaves its plane is called stable
    (`test_an_arm_in_a_plane_that_is_unstable_across_it_is_found_out` in tests/test_hard_loads.py).
    """
    size = measures.turn(state.step)
    small = jnp.finfo(size.dtype).eps ** 0.25
    scale = jnp.where(probing, small / jnp.where(size > 0, size, 1.0), 1.0)
    stir = jnp.where(probing & (state.probe.steps == 0), small, 0.0)
    return jax.tree.map(
        lambda s, d: scale.astype(s.dtype) * s + (stir * d).astype(s.dtype),
        state.step,
        measures.stirs,
    )


def left_to_it(new: Damped, old: Local) -> Damped:
    """The evaluation; in single precision and near the solution, a doubtful tangent is taken to be
    as definite as the one before it: rounding may change a sign. The probe decides in the end.

    Without this, a stable solution is called unstable
    (`test_a_wrong_sign_near_the_root_is_rounding_in_single_precision` in
    tests/test_damped_newton.py).
    """
    if new.size.dtype != jnp.float32:
        return new
    same = old.definite & new.doubtful & (new.size < _CLOSE)
    return new._replace(definite=new.definite | same)


def updated(old: Probe, trial: Trial, ratio: Array) -> Probe:
    """Probe after a trial, if that was a step of it, along which the motion changed by the factor
    `ratio`."""
    steps = old.steps + trial.probing.astype(jnp.int32)
    settled = trial.probing & (steps > _SETTLING)
    growth = jnp.where(settled, old.growth * ratio, old.growth)
    return Probe(steps, growth)


def unstable(probe: Probe) -> Array:
    """Whether the motion has grown in all steps."""
    return (probe.steps == _STEPS) & (probe.growth > 1)


def stable(state: State) -> Array:
    """Which tangents are positive definite, and not found out by the probe."""
    return state.local.definite & ~unstable(state.probe)
