"""Solves that peers lose: scenes of every size and stiffness, and the two-section arm with six tendons, all from a cold start."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import vsr_jax as vsr

MODEL = vsr.StrainDependent(8)


def similar_arm(length, young):
    """An arm that hangs from the horizontal, whose numbers without unit do not depend on its size: weight $\\rho g A L^3 / EI = 9$."""
    radius = length / 30
    density = 9 * young * radius**2 / (4 * 9.81 * length**3)
    rod = vsr.Rod(length, vsr.Circular(radius), vsr.Material(young, poisson=0.45, density=density))
    return vsr.Scene(rod, [vsr.Tendon(vsr.Parallel(0.7 * radius, 0.0))], [vsr.Gravity()]), 0.01 * young * math.pi * radius**2


@jax.jit
def shape_of(scene, inputs):
    eq = vsr.solve(scene, inputs, model=MODEL)
    return eq.tip[:3, 3] / scene.rod.length, eq.stability, eq.status


@pytest.mark.parametrize("young", [1e3, 1e6, 2e11])
@pytest.mark.parametrize("length", [1e-3, 0.3, 10.0])
def test_arms_of_all_sizes_and_stiffnesses_behave_alike(length, young, dtype):
    scene, tension = similar_arm(length, young)
    tip, margin, status = shape_of(scene.astype(dtype), jnp.array([tension], dtype))
    like, like_tension = similar_arm(1.0, 1.0)
    expected, expected_margin, _ = shape_of(like.astype("float64"), jnp.array([like_tension]))
    assert status == vsr.Status.CONVERGED
    close = 1e-10 if dtype == "float64" else 1e-4
    np.testing.assert_allclose(tip, expected, atol=close)
    np.testing.assert_allclose(margin, expected_margin, atol=100 * close)


def six_tendon_arm(loads=()):
    """Two sections of 0.2 m; tendons at 10 mm, at 90, -30 and 210 degrees, three to the middle and three to the end."""
    rod = vsr.Rod(0.4, vsr.Circular(0.0007), vsr.Material(54e9, poisson=0.3), guide_radius=0.0101)
    places = [(0.01 * math.cos(angle), 0.01 * math.sin(angle)) for angle in (math.pi / 2, -math.pi / 6, 7 * math.pi / 6)]
    return vsr.Scene(rod, [vsr.Tendon(vsr.Parallel(*place), end=end) for end in (0.2, None) for place in places], loads)


@pytest.fixture(scope="module")
def draws():
    random = np.random.default_rng(0)
    sizes = [(0, 5, 6), (-0.1, 0.1, 3), (-5e-3, 5e-3, 3)]  # tensions [N], tip forces [N] and moments [N m]
    return [jnp.asarray(random.uniform(low, high, (200, count))) for low, high, count in sizes]


def test_six_tendons_pulled_at_random_converge(draws):
    scene = six_tendon_arm()
    status, margin = jax.jit(jax.vmap(lambda t: (lambda eq: (eq.status, eq.stability))(vsr.solve(scene, t, model=MODEL))))(draws[0])
    assert np.all(status == vsr.Status.CONVERGED)
    assert np.all(margin > 1 - 1e-9)


@pytest.mark.slow
def test_six_tendons_with_random_tip_wrenches_converge(draws):
    def solved(tensions, force, moment):
        return vsr.solve(six_tendon_arm([vsr.TipWrench(force=force, moment=moment)]), tensions, model=MODEL)

    eqs = jax.jit(jax.vmap(solved))(*draws)
    assert np.all(eqs.converged)
    margin = np.asarray(jax.jit(jax.vmap(lambda eq: eq.stability))(eqs))
    assert np.all(np.isfinite(margin))
    assert np.all(margin > 0)
