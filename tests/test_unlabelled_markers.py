"""Unlabelled markers: in any order they give the fit of the labelled ones."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import vsr_jax as vsr

MODEL = vsr.StrainDependent(3, 4)
X = [0.176, 0.188, 0.2]
OFFSET = [[0.0, 0.0, 0.003], [0.0, 0.003, 0.0], [0.004, 0.0, 0.0]]
INPUTS = np.random.default_rng(7).uniform(0.2, 1.2, (8, 2))
SD = np.array([1e-4, 2e-4, 4e-4])[:, None]
FREE = {"rod.material.young": (1e5, 1e6), "inputs.gain": vsr.Unknown([0.5, 1.0], [1.5, 1.0])}


def arm(young=5e5):
    rod = vsr.Rod(0.2, vsr.Circular(0.008), vsr.Material(young, poisson=0.4))
    routes = [vsr.Linear(0.006, 0.0, -0.01), vsr.Linear(-0.003, 0.005, -0.01, -0.02)]
    return vsr.Scene(rod, [vsr.Tendon(route) for route in routes])


def places(scene, inputs):
    def one(u):
        g = vsr.solve(scene, u, model=MODEL).pose(jnp.array(X))
        return g[:, :3, 3] + (g[:, :3, :3] @ jnp.array(OFFSET)[:, :, None])[..., 0]

    return np.array(jax.vmap(one)(jnp.asarray(inputs)))


@pytest.fixture(scope="module")
def positions():
    """Positions of another arm, with noise; a marker is not seen in one shape, none in another."""

    found = places(arm(2.5e5), INPUTS * [0.9, 1.0])
    found += SD * np.random.default_rng(0).normal(size=found.shape)
    found[2, 1], found[5] = np.nan, np.nan
    return found


def fitted(positions, **options):
    markers = vsr.Markers(positions, X, offset=OFFSET, sd=SD, **options)
    data = vsr.Measurements(INPUTS, markers)
    return vsr.fit(arm(), FREE, data, model=MODEL, progress=False)


@pytest.fixture(scope="module")
def labelled(positions):
    return fitted(positions)


@pytest.fixture(scope="module")
def shuffled(positions):
    rng = np.random.default_rng(1)
    orders = np.array([rng.permutation(3) for _ in positions])
    return np.take_along_axis(positions, orders[..., None], axis=1), orders


@pytest.mark.slow
def test_shuffled_markers_give_the_fit_of_labelled_ones(labelled, shuffled, positions):
    """The start is so far from the arm that the nearest positions are others."""
    gaps = np.linalg.norm(places(arm(), INPUTS)[:, :, None] - positions[:, None], axis=3)
    nearest = np.argmin(np.where(np.isfinite(gaps), gaps, np.inf), axis=2)
    assert np.any(nearest[[0, 1, 3, 4, 6, 7]] != np.arange(3))
    found = fitted(shuffled[0], labelled=False)
    assert found.converged
    np.testing.assert_allclose(found.x, labelled.x, rtol=1e-6)
    np.testing.assert_allclose(found.covariance, labelled.covariance, rtol=1e-4)
    for name, residual in labelled.residuals.items():
        np.testing.assert_allclose(found.residuals[name], residual, atol=1e-8)
    order = found.order["markers"]
    seen = np.isfinite(positions).all(axis=2)
    back = np.take_along_axis(shuffled[1], order, axis=1)
    np.testing.assert_array_equal(back[seen], np.tile(np.arange(3), (8, 1))[seen])
    # the order in which they come says nothing
    wrong = fitted(shuffled[0])
    assert wrong.chi_squared > 100 * found.chi_squared


@pytest.mark.slow
def test_other_measurements_are_assigned_too(labelled, shuffled):
    found = fitted(shuffled[0], labelled=False)
    markers = vsr.Markers(shuffled[0][::-1], X, offset=OFFSET, sd=SD, labelled=False)
    other = found.on(vsr.Measurements(INPUTS[::-1].copy(), markers))
    assert other.chi_squared == pytest.approx(labelled.chi_squared, rel=1e-6)
    np.testing.assert_array_equal(other.order["markers"][::-1], found.order["markers"])


@pytest.mark.slow
def test_half_a_position_cannot_be_assigned(positions):
    half = positions.copy()
    half[0, 0, 2] = np.nan
    with pytest.raises(ValueError, match="without all three coordinates"):
        fitted(half, labelled=False)
