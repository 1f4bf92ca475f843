"""The continuous model: its right side is eq. 12-13 as printed, and diffrax's solvers agree on
it."""

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import vsr_jax as vsr
from vsr_jax.models.continuum import cosserat_strain_rate
from vsr_jax.numerics import se3
from vsr_jax.studies import paper


def printed_rate(scene, tau, xi, X):
    """Eq. (12)-(13) term by term, with d' and d'' by differentiation of the routing and Sigma' of
    the section."""
    k, u = xi[:3], xi[3:]
    rest = jnp.eye(6)[3]

    def stiffness(x):
        return jnp.diag(jnp.stack(scene.rod.stiffness(x)))

    A, a, active = jnp.zeros((6, 6)), jnp.zeros(6), jnp.zeros(6)
    for actuator, force in zip(scene.actuators, tau, strict=True):

        def d(x, routing=actuator.routing):
            return jnp.stack([0.0 * x, *routing(x)])

        d1, d2 = jax.jacfwd(d)(X), jax.jacfwd(jax.jacfwd(d))(X)
        t_c = jnp.cross(k, d(X)) + u + d1
        norm = jnp.linalg.norm(t_c)
        D, T2 = se3.skew(d(X)), se3.skew(t_c) @ se3.skew(t_c)
        weight = force / norm**3
        A = A + weight * jnp.block([[D @ T2 @ D, -D @ T2], [T2 @ D, -T2]])
        turn = se3.skew(k) @ d1 + d2
        a = a + weight * jnp.concatenate([se3.skew(d1) @ t_c * norm**2 - D @ T2 @ turn, -T2 @ turn])
        active = active + force * jnp.concatenate([jnp.cross(d(X), t_c), t_c]) / norm
    b = se3.coad(xi) @ (stiffness(X) @ (xi - rest) - active)
    c = jax.jacfwd(stiffness)(X) @ (xi - rest)
    return jnp.linalg.solve(stiffness(X) - A, a - b - c)


@pytest.mark.slow
@pytest.mark.parametrize("case", ["C1", "C2"])
def test_right_side_is_eq_12_and_13_as_printed(case):
    scene = paper.scene(case)
    tau = tuple(jnp.array([-15.0, 4.0, -5.0][: len(scene.actuators)]))
    rng = np.random.default_rng(0)
    for X in (0.1, 0.6):
        xi = jnp.asarray(rng.normal(size=6)) * 0.2 + jnp.eye(6)[3]
        want = printed_rate(scene, tau, xi, jnp.asarray(X))
        np.testing.assert_allclose(
            cosserat_strain_rate(scene, tau, xi, jnp.asarray(X)), want, rtol=1e-10, atol=1e-10
        )


@pytest.mark.slow
def test_tolerance_rules_the_error_of_another_solver(helix):
    reference = paper.reference("B1")[0]
    errors = []
    for rtol in (1e-4, 1e-7):
        eq = vsr.solve(
            helix, reference.tau, model=vsr.Continuum(diffrax.Tsit5(), rtol=rtol, atol=rtol / 100)
        )
        errors.append(float(np.linalg.norm(eq.tip[:3, 3] - reference.tip[:3, 3])))
    assert errors[1] < 1e-6
    assert errors[0] > 30 * errors[1]


def test_too_few_steps_are_reported(helix):
    eq = vsr.solve(helix, [-15.0], model=vsr.Continuum(rtol=1e-10, atol=1e-12, max_steps=8))
    assert int(eq.status) == vsr.Status.NOT_CONVERGED
    assert bool(jnp.all(jnp.isnan(eq.tip)))
    with pytest.raises(ValueError, match="q: got a solution by Continuum"):
        _ = eq.q


@pytest.mark.slow
def test_precision_follows_the_inputs(dtype, helix):
    reference = paper.reference("B1")[0]
    eq = vsr.solve(helix, jnp.asarray(reference.tau, dtype), model=vsr.Continuum())
    assert bool(eq.converged)
    assert eq.tip.dtype == dtype
    assert np.linalg.norm(eq.tip[:3, 3] - reference.tip[:3, 3]) < (
        7.5e-5 if dtype == "float32" else 1e-7
    )


def test_base_moves_the_shape(helix):
    base = se3.exp(jnp.array([0.3, -0.2, 0.1, 1.0, 2.0, 3.0]))
    moved = eqx.tree_at(lambda s: s.rod.base, helix, base, is_leaf=lambda x: x is None)
    for eq_moved, eq in [(vsr.solve(s, [-5.0], model=vsr.Continuum()) for s in (moved, helix))]:
        np.testing.assert_allclose(eq_moved.tip, base @ eq.tip, atol=1e-12)


@pytest.fixture(scope="module")
def tilted():
    """A rod on a tilted base, whose dead loads see the base's rotation."""
    base = se3.exp(jnp.array([0.3, 0.5, -0.2, 0.0, 0.0, 0.0]))
    material = vsr.Material(1e6, poisson=0.45, density=1000.0)
    return vsr.Rod(0.3, vsr.Circular(0.01), material, base=base)


@pytest.mark.slow
def test_locked_strains_carry_the_reaction_that_the_strain_does_not_show(tilted):
    scene = vsr.Scene(
        tilted,
        [vsr.Tendon(vsr.Parallel(0.007, 0.0))],
        loads=[vsr.Gravity(), vsr.TipWrench([0.0, 0.05, 0.0])],
        free_strains=["torsion", "bending_y", "bending_z"],
    )
    eq = vsr.solve(scene, [2.0], model=vsr.Continuum())
    steps = vsr.solve(scene, [2.0], model=vsr.StrainDependent(64))
    assert bool(eq.converged)
    np.testing.assert_allclose(eq.tip, steps.tip, atol=1e-9)
    np.testing.assert_allclose(eq.reaction(0.1), steps.reaction(0.1), atol=1e-8)


@pytest.mark.slow
def test_jumps_do_not_stop_single_precision(tilted):
    scene = vsr.Scene(
        tilted, [vsr.Tendon(vsr.Parallel(0.007, 0.0), end=0.2)], loads=[vsr.Gravity()]
    )
    eq = vsr.solve(scene, jnp.array([2.0], "float32"), model=vsr.Continuum())
    steps = vsr.solve(scene, [2.0], model=vsr.StrainDependent(64))
    assert bool(eq.converged)
    np.testing.assert_allclose(eq.tip[:3, 3], steps.tip[:3, 3], atol=1e-5 * 0.3)


@pytest.mark.slow
def test_derivatives_between_steps_see_the_direction_of_gravity(tilted):
    scene = vsr.Scene(tilted, [vsr.Tendon(vsr.Parallel(0.007, 0.0))], loads=[vsr.Gravity()])
    X, steps = 0.117, vsr.StrainDependent(64)

    def place(tension, model):
        return vsr.solve(scene, [tension], model=model).position(X)

    _, rate = jax.jvp(lambda t: place(t, vsr.Continuum()), (2.0,), (1.0,))
    differences = (place(2.001, steps) - place(1.999, steps)) / 0.002
    np.testing.assert_allclose(rate, differences, rtol=1e-5, atol=1e-9)
