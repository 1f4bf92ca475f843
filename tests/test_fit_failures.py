"""Shapes that a fit cannot use: without an equilibrium at the start, or without derivatives."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import vsr_jax as vsr

MODEL = vsr.StrainDependent(3, 4)
YOUNG, START = 4.2e5, 8e4
FREE = {"rod.material.young": (1e4, 1e6)}


def arm(young):
    rod = vsr.Rod(0.2, vsr.Circular(0.008), vsr.Material(young, poisson=0.4))
    routes = [vsr.Linear(0.006, 0.0, -0.01), vsr.Linear(-0.003, 0.005, -0.01, -0.02)]
    return vsr.Scene(rod, [vsr.Tendon(route) for route in routes])


class Deflection(vsr.Observation):
    """Distance of the tip from the axis of the arm at rest: no derivatives where it is zero."""

    value: jax.Array
    sd: jax.Array | None = None
    name: str = eqx.field(static=True, default="deflection")

    def predicted(self, eq):
        return jnp.linalg.norm(eq.tip[1:3, 3]).reshape(1, 1)


def solved(inputs, quantity):
    return jax.vmap(lambda u: quantity(vsr.solve(arm(YOUNG), u, model=MODEL)))(jnp.asarray(inputs))


def fitted(data):
    return vsr.fit(arm(START), FREE, data, model=MODEL, progress=False)


@pytest.mark.slow
def test_a_shape_that_fails_at_the_start_counts_once_it_can_be_solved():
    """Tensions that crush the soft arm of the start, but not the true one."""
    inputs = np.array([[0.5, 0.2], [0.3, 0.9], [0.8, 0.6], [4.0, 6.0]])
    tip = solved(inputs, lambda eq: eq.tip[:3, 3])
    found = fitted(vsr.Measurements(inputs, vsr.Markers(tip, sd=1e-4)))
    assert found.problem.at(found.problem.start).solved.tolist() == [True, True, True, False]
    assert found.converged
    assert found.failed == ()
    assert found.counted[3].all()
    np.testing.assert_allclose(found.x, YOUNG, rtol=1e-5)


@pytest.mark.slow
def test_a_shape_without_derivatives_is_named_and_has_no_weight():
    """Without tension the arm is straight; the slopes of its deflection are NaN."""
    inputs = np.array([[0.5, 0.2], [0.0, 0.0], [0.3, 0.9], [0.8, 0.6]])
    measured = solved(inputs, lambda eq: jnp.linalg.norm(eq.tip[1:3, 3]))[:, None, None]
    found = fitted(vsr.Measurements(inputs, Deflection(measured, jnp.array(1e-4))))
    at = found.problem.at(found.x)
    assert np.isnan(at.slopes[1]).any()
    assert np.isfinite(at.residual[1]).all()
    assert found.converged
    assert found.failed == (1,)
    assert np.isfinite(found.numbers["rod.material.young"].error)
    np.testing.assert_allclose(found.x, YOUNG, rtol=1e-5)
    assert "no derivatives there) and no weight: 1" in str(found)
