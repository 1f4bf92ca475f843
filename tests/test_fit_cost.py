"""What a fit minimises, as a function for other optimisers and samplers."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import vsr_jax as vsr

MODEL = vsr.StrainDependent(3, 4)
INPUTS = np.array([[0.5], [0.9], [0.2]])
SD, PRIOR = 1e-3, (4e5, 5e4)


def arm(young):
    rod = vsr.Rod(0.2, vsr.Circular(0.008), vsr.Material(young, poisson=0.4))
    return vsr.Scene(rod, [vsr.Tendon(vsr.Parallel(0.0, 0.006))])


def tips(young, gain=1.0):
    def tip(u):
        return vsr.solve(arm(young), u, model=MODEL).tip[:3, 3]

    return np.array(jax.vmap(tip)(jnp.asarray(gain * INPUTS)))


@pytest.fixture(scope="module")
def noisy():
    places = tips(4.2e5, 0.95) + np.random.default_rng(0).normal(0, SD, (3, 3))
    data = vsr.Measurements(INPUTS, vsr.Markers(places, sd=SD))
    free = {"rod.material.young": vsr.Unknown(1e3, 1e6, prior=PRIOR), "inputs.gain": (0.5, 1.5)}
    return vsr.fit(arm(5e5), free, data, model=MODEL, progress=False)


@pytest.mark.slow
def test_it_is_the_sum_of_squares_and_the_prior(noisy):
    """Against solves one after another."""
    measured = np.asarray(noisy.problem.data.observations[0].value)[:, 0]
    for young, gain in ((4.2e5, 0.95), (6e5, 1.2)):
        gap = (tips(young, gain) - measured) / SD
        wanted = 0.5 * np.sum(gap**2) + 0.5 * ((young - PRIOR[0]) / PRIOR[1]) ** 2
        assert noisy.cost([young, gain]) == pytest.approx(wanted, rel=1e-9)


@pytest.mark.slow
def test_it_is_least_at_the_fit(noisy):
    least = noisy.cost(noisy.x)
    for step in np.vstack([np.eye(2), -np.eye(2)]) * np.sqrt(np.diag(noisy.covariance)):
        assert noisy.cost(noisy.x + step) > least


def test_it_is_infinite_where_there_is_nothing(noisy):
    assert noisy.cost([2e6, 1.0]) == np.inf  # beyond the bounds
    assert noisy.cost([1e3, 1.0]) == np.inf  # crushed
    with pytest.raises(ValueError, match="x: got shape"):
        noisy.cost(noisy.x[1:])
