"""Newton's method with damping, on residuals of two numbers."""

import jax.numpy as jnp
import numpy as np
import pytest

from vsr_jax.numerics.batching import iterated
from vsr_jax.numerics.damped_newton import Damped, Measures, Schedule, damped_newton


def solved(stiffness, says_definite, dtype, cubic=1.0):
    r"""Root of $k_i x_i + c x_i^3 - 1$ from 0, where the sign of the tangent is always doubtful."""
    k = jnp.asarray(stiffness, dtype)

    def evaluate(x, damping, stage):
        residual = k * x + cubic * x**3 - 1
        step = residual / (k + 3 * cubic * x**2 + damping)
        size = jnp.linalg.norm(step)
        definite = says_definite(size, damping)
        return Damped(step, size, residual, jnp.linalg.norm(residual), definite, jnp.array(True))

    stirs = jnp.array([0.6, 0.8], dtype)
    measures = Measures(lambda r, step: jnp.sum(r * step), jnp.linalg.norm, stirs)
    floor = jnp.asarray(4 * jnp.finfo(dtype).eps, dtype)
    return iterated(damped_newton(evaluate, measures, jnp.zeros(2, dtype), floor, Schedule()))


def test_a_softened_problem_alone_is_no_solution():
    """Where constraints are exact, the residual is not finite."""

    def solved(hardest):
        def evaluate(x, damping, stage):
            residual = jnp.where(stage.share > hardest, jnp.nan, x - 1)
            step, no = residual / (1 + damping), jnp.array(False)
            size = jnp.linalg.norm(step)
            return Damped(step, size, residual, size, jnp.isfinite(size), no, no)

        measures = Measures(jnp.vdot, jnp.linalg.norm, jnp.array([0.6, 0.8]), jnp.vdot)
        stages = Schedule(stages=4, soft=1)
        return iterated(damped_newton(evaluate, measures, jnp.zeros(2), jnp.array(1e-15), stages))

    assert solved(2.0).converged
    assert not solved(1.9).converged


def wrong_near_the_root(size, damping):
    return (size > 1e-4) | (damping > 0)


def always(size, damping):
    return size == size


@pytest.mark.slow
def test_a_wrong_sign_near_the_root_is_rounding_in_single_precision():
    stable = solved((1.0, 2.0), wrong_near_the_root, jnp.float32)
    assert stable.converged
    assert stable.definite
    np.testing.assert_allclose(stable.x, [0.6823278, 0.4533977], atol=1e-6)


def test_a_wrong_sign_counts_in_double_precision():
    assert not solved((1.0, 2.0), wrong_near_the_root, jnp.float64).definite


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
def test_a_doubtful_root_without_stability_is_found_out(dtype):
    unstable = solved((-0.7, 2.0), always, dtype, cubic=0.0)
    np.testing.assert_allclose(unstable.x, [-1 / 0.7, 0.5], rtol=1e-6)
    assert not unstable.definite
    assert solved((0.7, 2.0), always, dtype, cubic=0.0).definite
