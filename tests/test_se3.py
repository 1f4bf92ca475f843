"""SE(3): the maps against their definitions and the exponential's derivatives against extended
precision."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests.conftest import epsilon
from vsr_jax.numerics import se3, step_twist, zanna_step

AXIS = np.array([1.0, 2.0, 2.0]) / 3
ANGLES = (0.0, 1e-12, 1e-8, 1e-4, 1e-2, 0.5, 1.0, 1.99, 2.01, 3.0, np.pi, 6.0)


def twist(seed=0):
    return jnp.asarray(np.random.default_rng(seed).normal(size=6))


def exact_derivatives(omega, directions):
    """exp and its first three derivatives along `directions`, in extended precision.

    The exponential of a matrix over the algebra of three dual numbers e1, e2, e3 (each squares to
    zero) holds the mixed derivatives as its coefficients; represent the algebra by 8 x 8 nilpotent
    matrices and sum the power series.
    """

    def hat(xi):
        matrix = np.zeros((4, 4), np.longdouble)
        matrix[0, 1], matrix[0, 2], matrix[1, 2] = -xi[2], xi[1], -xi[0]
        matrix[1, 0], matrix[2, 0], matrix[2, 1] = xi[2], -xi[1], xi[0]
        matrix[:3, 3] = xi[3:]
        return matrix

    one, dual = np.eye(2, dtype=np.longdouble), np.array([[0, 1], [0, 0]], np.longdouble)
    total = np.kron(np.eye(8, dtype=np.longdouble), hat(omega))
    for i, direction in enumerate(directions):
        factors = [dual if j == i else one for j in range(3)]
        total = total + np.kron(np.kron(np.kron(*factors[:2]), factors[2]), hat(direction))
    term = result = np.eye(32, dtype=np.longdouble)
    for j in range(1, 70):
        term = term @ total / j
        result = result + term
    return [result[:4, 4 * i : 4 * i + 4] for i in (0, 4, 6, 7)]


@jax.jit
def computed_derivatives(omega, a, b, c):
    def first(x):
        return jax.jvp(se3.exp, (x,), (a,))[1]

    def second(x):
        return jax.jvp(first, (x,), (b,))[1]

    return se3.exp(omega), first(omega), second(omega), jax.jvp(second, (omega,), (c,))[1]


@pytest.mark.slow
@pytest.mark.parametrize("angle", ANGLES)
def test_exp_and_three_derivatives_are_exact_to_rounding(angle, dtype):
    rng = np.random.default_rng(1)
    omega = np.concatenate([angle * AXIS, [1.0, 0.0, 0.0]]).astype(dtype)
    for _ in range(4):
        directions = rng.normal(size=(3, 6)).astype(dtype)
        exact = exact_derivatives(omega.astype(np.longdouble), directions.astype(np.longdouble))
        for order, (got, want) in enumerate(
            zip(computed_derivatives(omega, *directions), exact, strict=True)
        ):
            error = np.abs(np.asarray(got, np.longdouble) - want).max() / max(1, np.abs(want).max())
            assert got.dtype == dtype
            assert error <= 32 * epsilon(dtype), (
                f"derivative {order} is off by {error / epsilon(dtype):.0f} eps"
            )


@pytest.mark.slow
def test_reverse_mode_agrees_with_forward_at_the_identity(dtype):
    omega = jnp.asarray([0, 0, 0, 1, 0, 0], dtype)
    np.testing.assert_allclose(
        jax.jacrev(se3.exp)(omega), jax.jacfwd(se3.exp)(omega), atol=4 * epsilon(dtype)
    )


def test_exp_is_a_rigid_motion_and_inverts():
    g = se3.exp(twist())
    np.testing.assert_allclose(g[:3, :3] @ g[:3, :3].T, np.eye(3), atol=1e-15)
    np.testing.assert_allclose(se3.inverse(g) @ g, np.eye(4), atol=1e-15)
    np.testing.assert_allclose(se3.exp(-twist()), se3.inverse(g), atol=1e-15)


def test_vee_inverts_hat():
    np.testing.assert_array_equal(se3.vee(se3.hat(twist())), twist())


def test_adjoint_is_conjugation():
    g, xi = se3.exp(twist(1)), twist(2)
    np.testing.assert_allclose(
        se3.hat(se3.adjoint(g) @ xi), g @ se3.hat(xi) @ se3.inverse(g), atol=1e-14
    )


def test_ad_is_the_bracket():
    a, b = twist(3), twist(4)
    bracket = se3.hat(a) @ se3.hat(b) - se3.hat(b) @ se3.hat(a)
    np.testing.assert_allclose(se3.hat(se3.ad(a) @ b), bracket, atol=1e-14)


def test_duals_follow_from_the_adjoints():
    g, xi = se3.exp(twist(5)), twist(6)
    np.testing.assert_allclose(se3.coadjoint(g), se3.adjoint(se3.inverse(g)).T, atol=1e-14)
    np.testing.assert_array_equal(se3.coad(xi), -se3.ad(xi).T)


def test_coadjoint_moves_by_coad_along_an_arm():
    g, xi = se3.exp(twist(7)), twist(8)
    _, rate = jax.jvp(lambda s: se3.coadjoint(g @ se3.exp(s * xi)), (0.0,), (1.0,))
    np.testing.assert_allclose(rate, se3.coadjoint(g) @ se3.coad(xi), atol=1e-13)


def test_maps_of_a_batch_by_vmap():
    batch = jnp.stack([twist(i) for i in range(3)])
    np.testing.assert_allclose(jax.vmap(se3.exp)(batch)[1], se3.exp(batch[1]), atol=1e-15)


@pytest.mark.parametrize("angle", [0.0, 1e-9, 1e-3, 1.0, 2.0, 2.2, 3.0, 3.14159, np.pi])
def test_rotation_vectors_are_those_of_the_exponential(angle):
    """Half a turn included, where the skew part of the rotation is nothing: it was taken for no
    turn at all."""
    for axis in np.array([[1.0, 0, 0], [0, 1, 0], [0, 0, -1], [0.6, -0.8, 0], [0.48, 0.6, 0.64]]):
        rotation = se3.exp(jnp.append(jnp.asarray(angle * axis), jnp.zeros(3)))[:3, :3]
        found = np.asarray(se3.rotation_vector(rotation))
        sign = np.sign(found @ axis) if angle == np.pi else 1.0
        np.testing.assert_allclose(
            sign * found, angle * axis, atol=1e-12 * max(angle, 1e-3) + 1e-15
        )
    exact = np.diag([1.0, -1.0, -1.0])
    np.testing.assert_allclose(
        np.abs(se3.rotation_vector(jnp.asarray(exact))), [np.pi, 0, 0], atol=1e-15
    )


@pytest.mark.slow
@jax.jit
def there_and_back(twist):
    """A twist by way of its pose, and the derivative in both modes."""

    def through(twist):
        return se3.log(se3.exp(twist))

    return through(twist), jax.jacfwd(through)(twist), jax.jacrev(through)(twist)


@pytest.mark.parametrize("angle", [0.0, 1e-6, 0.3, 1.99, 2.01, 3.1])
def test_the_logarithm_inverts_the_exponential(angle):
    axis = np.array([0.6, -0.48, 0.64])
    twist = jnp.append(angle * axis, jnp.array([0.3, -1.2, 0.7]))

    found, *derivatives = there_and_back(twist)
    np.testing.assert_allclose(found, twist, atol=2e-13)
    for derivative in derivatives:
        np.testing.assert_allclose(derivative, np.eye(6), atol=1e-11)


def test_rotation_vectors_have_derivatives_up_to_half_a_turn():
    for angle in (0.0, 0.5, 2.0, 2.2, 3.1, 3.14):
        at = jnp.array([0.48, 0.6, 0.64]) * angle
        slope = jax.jacfwd(
            lambda k: se3.rotation_vector(se3.exp(jnp.append(k, jnp.zeros(3)))[:3, :3])
        )(at)
        np.testing.assert_allclose(slope, np.eye(3), atol=1e-10)


@pytest.mark.parametrize("batch", [(), (5,), (2, 3)])
def test_a_pose_is_put_together_from_arrays_or_components(batch):
    rng = np.random.default_rng(0)
    R, r = jnp.asarray(rng.normal(size=(3, 3, *batch))), jnp.asarray(rng.normal(size=(3, *batch)))
    found = se3.pose(R, r)
    np.testing.assert_array_equal(found[..., :3, :3], jnp.moveaxis(R, (0, 1), (-2, -1)))
    np.testing.assert_array_equal(found[..., :3, 3], jnp.moveaxis(r, 0, -1))
    np.testing.assert_array_equal(found[..., 3, :], np.broadcast_to([0, 0, 0, 1], (*batch, 4)))
    np.testing.assert_array_equal(se3.pose(tuple(map(tuple, R)), tuple(r)), found)


@pytest.mark.parametrize("kernel", [se3.exp, se3.hat, se3.ad, se3.coad, se3.skew])
def test_twists_may_be_lists(kernel):
    vector = [0.0, 0.1, 0.2, 1, 0, 0][: 3 if kernel is se3.skew else 6]
    assert jax.eval_shape(lambda: kernel(vector)) == jax.eval_shape(kernel, jnp.asarray(vector))


@pytest.mark.parametrize(
    "kernel", [se3.inverse, se3.vee, se3.adjoint, se3.coadjoint, se3.nearest_pose]
)
def test_poses_may_be_lists(kernel):
    g = np.eye(4).tolist()
    assert jax.eval_shape(lambda: kernel(g)) == jax.eval_shape(kernel, jnp.asarray(g))


def test_steps_may_be_of_lists():
    low, high = [0.0, 1.0, 0.0, 1.0, 0.0, 0.0], [0.0, 2.0, 0.0, 1.0, 0.0, 0.0]
    found = jax.eval_shape(lambda: zanna_step(low, high, 1))
    assert found == jax.eval_shape(lambda: step_twist([low, high], 1.0))
    assert (found.shape, found.dtype) == ((6,), jnp.float64)
