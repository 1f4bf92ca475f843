"""Error estimates: against solutions at far more steps, and against the reference solutions of the
paper's cases."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import vsr_jax as vsr
from vsr_jax.studies import paper

HELICES = paper.scene("B2")
PULL = jnp.array([-8.0, -5.0])


def honest(estimate, true):
    """At least the true error, and at most twenty times as much."""
    assert true <= estimate <= 20 * true


def tip_distance(a, b):
    return float(jnp.linalg.norm((a.tip - b.tip)[:3, 3]))


@pytest.mark.slow
@pytest.mark.parametrize(("steps", "order"), [(8, 6), (16, 6), (13, 6), (16, 4), (64, 2)])
def test_tip_error_of_the_steps(steps, order):
    eq = vsr.solve(HELICES, PULL, model=vsr.StrainDependent(steps, order))
    honest(
        float(eq.error.tip),
        tip_distance(eq, vsr.solve(HELICES, PULL, model=vsr.StrainDependent(160))),
    )


@pytest.mark.slow
def test_tip_error_of_one_step_and_of_an_arm_in_pieces():
    tapering, stiff = (
        vsr.Circular(vsr.Taper(0.012, 0.010)),
        vsr.Material(vsr.Piecewise((0.1,), (8e5, 4e5)), poisson=0.45),
    )
    for young, routing, steps in (
        (vsr.Material(8e5, poisson=0.45), vsr.Parallel(0.005, 0.0), 1),
        (stiff, vsr.Helix(0.007, 1.0), 6),
    ):
        scene = vsr.Scene(vsr.Rod(0.3, tapering, young), [vsr.Tendon(routing)])
        eq = vsr.solve(scene, [1.0], model=vsr.StrainDependent(steps))
        honest(
            float(eq.error.tip),
            tip_distance(eq, vsr.solve(scene, [1.0], model=vsr.StrainDependent(64))),
        )


class Softened(vsr.StrainDependent):
    """A model of somebody else's that finds a hundredth too little strain, and says that it is
    approximate."""

    balanced_everywhere = False

    def solve(self, scene, inputs):
        outcome = super().solve(scene, 0.99 * inputs)
        return outcome._replace(forces=scene.forces(inputs))

    def strain(self, scene, forces, state, X):
        return super().strain(scene, tuple(0.99 * force for force in forces), state, X)


@pytest.mark.slow
def test_a_model_that_is_not_balanced_is_not_taken_for_one_that_is():
    """Its strain is compared with one in balance; as that of a `StrainDependent` it was called
    exact."""
    eq, exact = (
        vsr.solve(HELICES, PULL, model=model) for model in (Softened(16), vsr.StrainDependent(16))
    )
    X = jnp.linspace(0.01, 0.7, 9)
    wrong = np.max(np.abs(np.asarray(eq.strain(X) - exact.strain(X))), axis=0)
    assert np.all(wrong <= np.asarray(eq.error.strain))
    honest(float(eq.error.tip), tip_distance(eq, exact))


@pytest.mark.slow
def test_errors_against_the_independent_reference():
    entry = paper.reference("B2")[0]
    eq = vsr.solve(HELICES, entry.tau, model=vsr.StrainDependent(12))
    honest(float(eq.error.tip), float(np.linalg.norm(np.asarray(eq.tip)[:3, 3] - entry.tip[:3, 3])))
    strain = np.max(np.abs(np.asarray(eq.strain(entry.X)) - entry.strain), axis=0)
    assert np.all(strain <= np.asarray(eq.error.strain))


@pytest.mark.parametrize(
    "model",
    [
        vsr.Prescribed(paper.basis("B2")),
        pytest.param(vsr.Continuum(rtol=1e-5, atol=1e-7), marks=pytest.mark.slow),
    ],
)
def test_errors_of_the_other_models(model):
    eq, exact = (vsr.solve(HELICES, PULL, model=m) for m in (model, vsr.StrainDependent(160)))
    honest(float(eq.error.tip), tip_distance(eq, exact))
    X = jnp.linspace(0, 0.75, 301)
    true = np.max(np.abs(np.asarray(eq.strain(X) - exact.strain(X))), axis=0)
    assert np.all((true <= 1.2 * eq.error.strain) & (eq.error.strain <= 20 * true))


def loaded(**of_the_tendon):
    arm = vsr.Rod(0.3, vsr.Circular(0.01), vsr.Material(5.93e5, shear=2e5, density=1000.0))
    return vsr.Scene(
        arm, [vsr.Tendon(vsr.Helix(0.005, 1.5), **of_the_tendon)], [vsr.Gravity((0.0, 0.0, -9.81))]
    )


@pytest.mark.parametrize(
    ("tendon", "value"),
    [
        pytest.param({}, 8.0, marks=pytest.mark.slow),
        pytest.param({"control": "length"}, -0.01, marks=pytest.mark.slow),
        pytest.param({"friction": 0.1}, 8.0, marks=pytest.mark.slow),
    ],
)
def test_errors_under_loads(tendon, value):
    """Few steps are compared with twice as many, more with half as many."""
    scene, inputs = loaded(**tendon), jnp.array([value])
    exact, X = vsr.solve(scene, inputs, model=vsr.StrainDependent(64)), jnp.linspace(0, 0.3, 51)
    for steps, order in ((6, 6), (12, 6), (16, 4)):
        eq = vsr.solve(scene, inputs, model=vsr.StrainDependent(steps, order))
        honest(float(eq.error.tip), tip_distance(eq, exact))
        true = np.max(np.abs(np.asarray(eq.strain(X) - exact.strain(X))), axis=0)
        assert np.all(true <= eq.error.strain)


@pytest.mark.slow
def test_errors_of_a_basis_under_loads():
    scene, inputs = loaded(), jnp.array([8.0])
    eq = vsr.solve(
        scene, inputs, model=vsr.Prescribed(vsr.Basis.uniform(vsr.Legendre(4)), steps=12)
    )
    honest(
        float(eq.error.tip),
        tip_distance(eq, vsr.solve(scene, inputs, model=vsr.StrainDependent(32))),
    )


def test_rounding_counts():
    eq = vsr.solve(HELICES, PULL.astype(jnp.float32), model=vsr.StrainDependent(64))
    exact = vsr.solve(HELICES, PULL, model=vsr.StrainDependent(160))
    assert tip_distance(eq, exact) <= float(eq.error.tip) < 2e-4
    assert eq.error.tip.dtype == eq.error.strain.dtype == jnp.float32


def test_error_of_a_failed_solve_is_nan_and_it_batches():
    tips = jax.vmap(lambda u: vsr.solve(HELICES, u, model=vsr.StrainDependent(16)).error.tip)(
        jnp.stack([PULL, 1e4 * PULL])
    )
    assert np.isfinite(tips[0])
    assert np.isnan(tips[1])
