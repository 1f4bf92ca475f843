"""Magnus steps: their orders, poses anywhere on the arm, and the geometric Jacobian."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import vsr_jax as vsr
from vsr_jax.numerics import component as c, se3
from vsr_jax.numerics.magnus import step_poses, tip_pose
from vsr_jax.numerics.quadrature import make_grid
from vsr_jax.studies import paper

LENGTH = 0.75

ORDERS = [pytest.param(2, marks=pytest.mark.slow), pytest.param(4, marks=pytest.mark.slow), 6]


def strain(X):
    """A strain that turns about changing axes and does not commute with itself."""
    return jnp.stack(
        [
            2 + 3 * jnp.sin(7 * X),
            4 * jnp.cos(5 * X),
            6 * X,
            1 + 0.1 * X,
            0.2 * jnp.sin(9 * X),
            0.1 * jnp.cos(4 * X),
        ]
    )


@pytest.fixture(scope="module")
def exact_tip():
    def rate(X, g):
        return (g.reshape(4, 4) @ np.asarray(se3.hat(strain(X)))).ravel()

    return (
        solve_ivp(rate, (0, LENGTH), np.eye(4).ravel(), method="DOP853", rtol=1e-13, atol=1e-14)
        .y[:, -1]
        .reshape(4, 4)
    )


def stepped_tip(steps, order):
    grid = make_grid(jnp.array([0.0, LENGTH]), steps, order // 2)
    return tip_pose(tuple(jnp.moveaxis(strain(grid.X), 0, 0)), grid.h)


@pytest.mark.slow
@pytest.mark.parametrize(("order", "steps"), [(2, (64, 128)), (4, (16, 32)), (6, (8, 16))])
def test_steps_converge_with_their_order(order, steps, exact_tip):
    coarse, fine = (np.abs(stepped_tip(n, order) - exact_tip).max() for n in steps)
    assert fine > 1e-12, "the finer run has reached rounding: the order cannot be read"
    assert abs(np.log2(coarse / fine) - order) < 0.35


def test_step_twist_holds_the_named_formulas():
    rng = np.random.default_rng(0)
    xi, h = jnp.asarray(rng.normal(size=(2, 6))), jnp.asarray(0.3)
    want = h / 2 * (xi[0] + xi[1]) + np.sqrt(3) * h**2 / 12 * se3.ad(xi[0]) @ xi[1]
    np.testing.assert_allclose(vsr.zanna_step(xi[0], xi[1], h), want, atol=1e-15)
    np.testing.assert_allclose(vsr.step_twist(xi[:1], h), h * xi[0], atol=1e-15)


@pytest.mark.parametrize("stages", [1, 2, 3])
def test_constant_strain_is_exact_at_every_order(stages):
    xi = jnp.asarray(np.random.default_rng(1).normal(size=6))
    np.testing.assert_allclose(
        vsr.step_twist(jnp.tile(xi, (stages, 1)), jnp.asarray(0.4)), 0.4 * xi, atol=1e-15
    )


def test_step_twist_refuses_four_stages():
    with pytest.raises(ValueError, match=r"strains\.shape\[0\]: got 4"):
        vsr.step_twist(jnp.zeros((4, 6)), jnp.asarray(0.1))


def test_steps_start_from_the_base():
    grid = make_grid(jnp.array([0.0, LENGTH]), 8, 2)
    base = se3.exp(jnp.array([0.3, -0.2, 0.1, 1.0, 2.0, 3.0]))
    parts = tuple(strain(grid.X))
    np.testing.assert_allclose(
        tip_pose(parts, grid.h, base), base @ tip_pose(parts, grid.h), atol=1e-14
    )
    np.testing.assert_allclose(step_poses(parts, grid.h, base)[0], base, atol=1e-15)


@pytest.mark.slow
@pytest.mark.parametrize("order", ORDERS)
def test_pose_between_step_ends_has_the_accuracy_of_the_steps(order, helix):
    coarse = vsr.solve(helix, jnp.array([-10.0]), model=vsr.StrainDependent(48, order))
    fine = vsr.solve(helix, jnp.array([-10.0]), model=vsr.StrainDependent(192, 6))
    X = jnp.array([0.0, 0.1234, 0.4, 0.7499, LENGTH])
    allowed = 2 * np.abs(coarse.tip - fine.tip).max() + 1e-12
    assert np.abs(coarse.pose(X) - fine.pose(X)).max() < allowed
    np.testing.assert_allclose(coarse.pose(LENGTH), coarse.tip, atol=1e-14)


class TestJacobian:
    basis = vsr.Basis.uniform(vsr.Legendre(2))
    scene = paper.scene("C2")
    q = jnp.asarray(np.random.default_rng(2).normal(size=18)) * np.repeat(
        [4, 4, 4, 0.1, 0.1, 0.1], 3
    )

    def pose(self, q, X, steps, order):
        grid = make_grid(jnp.array([0.0, 1.0]) * X, steps, order // 2)
        nodes = grid.X.reshape(-1)
        xi = (
            jax.vmap(lambda x: self.basis.matrix(x, self.scene.rod.length) @ q)(nodes)
            + jnp.eye(6)[3]
        )
        return tip_pose(tuple(x.reshape(grid.X.shape) for x in c.split(xi)), grid.h)

    @pytest.mark.parametrize("order", ORDERS)
    def test_is_the_derivative_of_the_pose(self, order):
        X = jnp.asarray(0.5)
        J = vsr.jacobian(self.scene, self.basis, self.q, X, steps=12, order=order)

        @jax.jit
        def twists(q):
            def pose(q):
                return self.pose(q, X, 12, order)

            inverse, rates = se3.inverse(pose(q)), jax.jacfwd(pose)(q)
            return jax.vmap(lambda rate: se3.vee(inverse @ rate), -1, -1)(rates)

        np.testing.assert_allclose(J, twists(self.q), atol=1e-12)

    @pytest.mark.slow
    def test_is_the_integral_of_eq_15(self):
        """J = Ad_g^-1 int Ad_g B_q ds with the integral by the trapezoidal rule on fine poses,
        extrapolated once."""
        L = float(self.scene.rod.length)

        @partial(jax.jit, static_argnums=0)
        def trapezoid(n):
            X = np.linspace(0, L, n + 1)
            grid = make_grid(jnp.array([0.0, L]), n, 3)
            xi = (
                jax.vmap(lambda x: self.basis.matrix(x, self.scene.rod.length) @ self.q)(
                    grid.X.reshape(-1)
                )
                + jnp.eye(6)[3]
            )
            g = step_poses(tuple(x.reshape(grid.X.shape) for x in c.split(xi)), grid.h)
            values = jax.vmap(
                lambda g, x: se3.adjoint(g) @ self.basis.matrix(x, self.scene.rod.length)
            )(g, jnp.asarray(X))
            return se3.adjoint(se3.inverse(g[-1])) @ jnp.trapezoid(values, dx=L / n, axis=0)

        want = (4 * trapezoid(800) - trapezoid(400)) / 3
        np.testing.assert_allclose(
            vsr.jacobian(self.scene, self.basis, self.q, steps=64), want, atol=2e-7
        )

    @pytest.mark.slow
    def test_converges_with_the_order_of_the_steps(self):
        fine = vsr.jacobian(self.scene, self.basis, self.q, steps=128, order=6)
        errors = [
            np.abs(vsr.jacobian(self.scene, self.basis, self.q, steps=n, order=4) - fine).max()
            for n in (12, 24)
        ]
        assert abs(np.log2(errors[0] / errors[1]) - 4) < 0.5

    def test_refuses_an_unknown_order(self):
        with pytest.raises(ValueError, match="order: got 5, need one of 2, 4, 6"):
            vsr.jacobian(self.scene, self.basis, self.q, order=5)
