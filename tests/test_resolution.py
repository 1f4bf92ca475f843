"""Steps too few for a shape: told from the shape itself, over random threads and steps of every
order."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import vsr_jax as vsr
from vsr_jax.mechanics.resolution import COARSE

LENGTH = 0.3


def tip_of(order, steps):
    """Tip [1/L] and status of an arm with a helix and a parallel thread, its taper, turns and
    tensions given, one of a batch."""
    model = vsr.StrainDependent(steps, order)

    def tip(taper, turns, tensions):
        rod = vsr.Rod(
            LENGTH, vsr.Circular(vsr.Taper(0.01, 0.01 * taper)), vsr.Material(1e6, poisson=0.45)
        )
        helix = vsr.Helix(0.002, pitch=LENGTH / turns)
        eq = vsr.solve(
            vsr.Scene(rod, [vsr.Tendon(helix), vsr.Tendon(vsr.Parallel(0.0, 0.002))]),
            tensions,
            model=model,
        )
        return eq.tip[:3, 3] / LENGTH, eq.status

    return jax.jit(jax.vmap(tip))


@pytest.fixture(scope="module")
def draws():
    random = np.random.default_rng(1)
    turns = np.exp(random.uniform(math.log(0.3), math.log(60), 300))
    return (
        random.uniform(0.4, 1, 300),
        turns,
        np.exp(random.uniform(math.log(0.05), math.log(20), (300, 2))),
    )


@pytest.fixture(scope="module")
def exact(draws):
    tip, status = tip_of(6, 600)(*draws)
    assert np.all(status == vsr.Status.CONVERGED)
    return np.asarray(tip)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("order", "steps", "largest"), [(2, 32, 0.05), (4, 16, 0.06), (6, 8, 0.05), (6, 32, 0.02)]
)
def test_what_converges_is_resolved(order, steps, largest, draws, exact):
    """The largest error allowed, as a share of the length; and what is refused is threads that turn
    fast."""
    tip, status = map(np.asarray, tip_of(order, steps)(*draws))
    kept = status == vsr.Status.CONVERGED
    assert set(status) <= {vsr.Status.CONVERGED, vsr.Status.UNDER_RESOLVED}
    errors = np.linalg.norm(tip - exact, axis=-1)
    assert np.max(errors[kept]) < largest < COARSE
    assert np.mean(kept) > 0.6
    if steps < 32:
        assert np.median(draws[1][~kept]) > 2 * np.median(draws[1][kept])


@pytest.mark.slow
@pytest.mark.parametrize("order", [2, 4, 6])
def test_no_choice_of_nodes_hides_a_wave(order):
    """With a whole turn from node to node, or nearly, the strain looks slow."""
    tip, status = tip_of(order, 16)(
        np.array([1.0]), np.array([8.0 * order]), np.array([[10.0, 0.0]])
    )
    assert status[0] == vsr.Status.UNDER_RESOLVED
    assert np.all(np.isnan(tip))


@pytest.mark.slow
def test_a_weak_wave_does_not_matter():
    _, status = tip_of(6, 16)(np.array([1.0]), np.array([16.0]), np.array([[0.01, 0.0]]))
    assert status[0] == vsr.Status.CONVERGED


@pytest.mark.slow
@pytest.mark.parametrize(
    "model", [vsr.Prescribed(vsr.Basis.uniform(vsr.Legendre(2)), steps=4), vsr.Continuum()]
)
def test_other_models(model):
    """Steps of a smooth basis resolve it; the continuum model chooses its own."""
    rod = vsr.Rod(LENGTH, vsr.Circular(0.01), vsr.Material(1e6, poisson=0.45))
    eq = vsr.solve(
        vsr.Scene(rod, [vsr.Thread(vsr.Parallel(0.0, 0.005))]), jnp.array([-5.0]), model=model
    )
    assert eq.status == vsr.Status.CONVERGED
    assert eq.model.finer() != eq.model
