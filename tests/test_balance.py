"""The cross-section balance: gradient and Hessian of an energy, solved to rounding, honest where it
cannot be."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import root

import vsr_jax as vsr
from tests.conftest import epsilon
from vsr_jax.mechanics.balance import residual, solve_balance, tangent, thread_direction
from vsr_jax.numerics import component as c
from vsr_jax.studies import paper


@pytest.fixture(scope="module")
def sections():
    return paper.scene("C2").sections(jnp.array([0.1, 0.37, 0.7]))


def at(sections, i):
    return jax.tree.map(lambda x: x[i], sections)


def energy(xi, sections, tau, reaction):
    elastic = sum(
        0.5 * s * (x - x0) ** 2
        for s, x, x0 in zip(sections.stiffness, xi, sections.rest, strict=True)
    )
    work = sum(
        f * thread_direction(tuple(xi), path)[1]
        for f, path in zip(tau, sections.paths, strict=True)
    )
    return elastic - work - jnp.dot(jnp.stack(reaction), xi)


def test_residual_and_tangent_are_gradient_and_hessian_of_the_energy(sections):
    rng = np.random.default_rng(0)
    xi = jnp.asarray(rng.normal(size=6)) * 0.2 + jnp.eye(6)[3]
    tau, reaction = (jnp.asarray(-9.0), jnp.asarray(4.0)), tuple(jnp.asarray(rng.normal(size=6)))
    one = at(sections, 0)
    gradient = jax.jit(jax.grad(energy))(xi, one, tau, reaction)
    np.testing.assert_allclose(
        c.join(residual(tuple(xi), one, tau, reaction)), gradient, rtol=1e-12, atol=1e-13
    )
    hessian = jax.jit(jax.hessian(energy))(xi, one, tau, reaction)
    np.testing.assert_allclose(
        c.join_matrix(c.symmetric(tangent(tuple(xi), one, tau))), hessian, rtol=1e-12, atol=1e-12
    )


@pytest.mark.parametrize("tau", [(-15.0, -15.0), (15.0, 10.0), (-20.0, 12.0)])
def test_solution_is_scipys(sections, tau):
    reaction = tuple(jnp.full(3, x) for x in (1e-3, -2e-3, 3e-3, 0.5, 0.2, -0.1))
    forces = tuple(jnp.asarray(f) for f in tau)
    solution = solve_balance(sections, forces, reaction)
    assert bool(jnp.all(solution.balanced & solution.definite))
    for i in range(3):
        one, load = at(sections, i), tuple(x[i] for x in reaction)
        scale = np.sqrt(np.asarray(one.stiffness))

        def scaled(y, one=one, load=load, scale=scale):
            return (
                np.asarray(c.join(residual(tuple(jnp.asarray(y / scale)), one, forces, load)))
                / scale
            )

        found = root(scaled, np.asarray(one.rest) * scale, tol=1e-14)
        np.testing.assert_allclose(
            [float(x[i]) for x in solution.xi], found.x / scale, rtol=1e-9, atol=1e-9
        )


@pytest.mark.slow
def test_no_force_is_rest_with_finite_derivatives(sections):
    one = at(sections, 1)._replace(paths=at(sections, 1).paths[:1])

    def strain(tau):
        return c.join(solve_balance(one, (tau,)).xi)

    zero = jnp.asarray(0.0)
    np.testing.assert_allclose(strain(zero), c.join(one.rest), atol=1e-15)
    for derivative in (jax.jacfwd(jax.jacfwd(strain)), jax.jacfwd(jax.jacrev(strain))):
        assert bool(jnp.all(jnp.isfinite(jax.jit(derivative)(zero))))


def test_derivatives_to_second_order_are_those_of_finite_differences(sections):
    @jax.jit
    def strain(force):
        return c.join(solve_balance(sections, (force, jnp.asarray(-8.0))).xi)

    at_, h = jnp.asarray(-12.0), 1e-3
    values = [np.asarray(strain(at_ + i * h)) for i in (-2, -1, 0, 1, 2)]
    first = (values[0] - 8 * values[1] + 8 * values[3] - values[4]) / (12 * h)
    second = (-values[0] + 16 * values[1] - 30 * values[2] + 16 * values[3] - values[4]) / (
        12 * h**2
    )
    np.testing.assert_allclose(
        jax.jit(jax.jacrev(strain))(at_), first, atol=1e-9 * np.abs(first).max()
    )
    np.testing.assert_allclose(
        jax.jit(jax.jacfwd(jax.jacfwd(strain)))(at_), second, atol=1e-5 * np.abs(second).max()
    )


def test_balances_to_rounding_in_either_precision(dtype):
    scene = paper.scene("B2").astype(dtype)
    sections = scene.sections(jnp.linspace(0, 0.75, 9, dtype=dtype))
    solution = solve_balance(sections, (jnp.asarray(-15, dtype), jnp.asarray(-5, dtype)))
    assert bool(jnp.all(solution.balanced))
    assert all(x.dtype == dtype for x in solution.xi)


@pytest.mark.parametrize(
    ("routing", "limit"),
    [(vsr.Parallel(0.005, 0.0), "offset"), (vsr.Parallel(0.0, 0.0), "axis")],
    ids=["offset", "axis"],
)
def test_a_tendon_that_eats_its_path_is_reported(routing, limit):
    """T = 1 / (1/EA + d^2/EI) for a parallel tendon, EA on the axis (93.1 N and 186 N for this
    arm)."""
    arm = vsr.Rod(0.75, vsr.Circular(0.01), vsr.Material(5.93e5, shear=2e5))
    EA, EI = 5.93e5 * np.pi * 1e-4, 5.93e5 * np.pi / 4 * 1e-8
    critical = EA if limit == "axis" else 1 / (1 / EA + 0.005**2 / EI)
    scene = vsr.Scene(arm, [vsr.Tendon(routing)])
    below, above = (vsr.solve(scene, jnp.array([f * critical])) for f in (0.99, 1.01))
    assert bool(below.converged)
    assert int(above.status) == vsr.Status.COLLAPSED
    assert bool(jnp.all(jnp.isnan(above.tip)))


def test_lost_stability_is_reported():
    scene = paper.scene("A1")
    eq = vsr.solve(scene, jnp.array([1000.0]))
    assert int(eq.status) in (vsr.Status.UNSTABLE, vsr.Status.NOT_CONVERGED)
    assert bool(jnp.isnan(eq.stability))


@pytest.mark.slow
def test_bad_lanes_change_neither_the_others_nor_their_gradients():
    scene = paper.scene("B1")

    def tips(scene, taus):
        return jax.vmap(lambda tau: vsr.solve(scene, tau).tip[:3, 3])(taus)

    def total(scene, taus):
        tip = tips(scene, taus)
        return jnp.sum(jnp.where(jnp.isfinite(tip), tip, 0.0))

    good = jnp.array([[-15.0], [-2.0], [7.0], [-8.0]])
    bad = jnp.array([[-15.0], [jnp.nan], [7.0], [-500.0]])
    run, slope = jax.jit(tips), jax.jit(jax.grad(total))
    np.testing.assert_array_equal(run(scene, bad)[::2], run(scene, good)[::2])
    assert bool(jnp.all(jnp.isnan(run(scene, bad)[1::2])))
    for mixed, alone in zip(
        jax.tree.leaves(slope(scene, bad)), jax.tree.leaves(slope(scene, bad[::2])), strict=True
    ):
        np.testing.assert_allclose(mixed, alone, rtol=1e-12, atol=1e-14)


def test_residual_floor_follows_the_precision(dtype):
    eq = vsr.solve(paper.scene("A1"), jnp.asarray([-7.5], dtype))
    exact = vsr.solve(paper.scene("A1"), jnp.asarray([-7.5]))
    assert np.abs(eq.strain(0.3) - exact.strain(0.3)).max() < 200 * epsilon(dtype) * 8
