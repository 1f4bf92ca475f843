"""Damped Gauss-Newton steps against closed forms and SciPy."""

import numpy as np
import pytest
from scipy import optimize

from vsr_jax.calibration.least_squares import LOSSES, Box, Residuals, loss_of, minimise
from vsr_jax.calibration.uncertainty import covariance_of, in_words, undetermined


def box(size, low=-np.inf, high=np.inf, mean=0.0, sd=np.inf):
    return Box(*(np.broadcast_to(np.asarray(x, float), size) for x in (low, high, mean, sd)))


def linear(J, y):
    def evaluate(x, near):
        del near
        return Residuals((J @ x - y)[None], J[None], np.array([True]))

    return evaluate


@pytest.fixture
def system():
    rng = np.random.default_rng(0)
    return rng.normal(size=(12, 3)) * [1.0, 1e3, 1e-4], rng.normal(size=12)


def test_a_linear_fit_with_priors_is_the_closed_form(system):
    J, y = system
    mean, sd = np.array([0.3, 1e-4, 50.0]), np.array([0.2, np.inf, 1e3])
    found = minimise(linear(J, y), np.zeros(3), box(3, mean=mean, sd=sd))
    A = J.T @ J + np.diag(sd**-2.0)
    exact = np.linalg.solve(A, J.T @ y + mean / sd**2)
    covariance = np.linalg.inv(A)
    # the steps end where 1e-6 of the variance of a residual is left: 1e-3 of a standard error
    assert np.all(np.abs(found.x - exact) < 1e-3 * np.sqrt(np.diag(covariance)))
    assert found.converged
    np.testing.assert_allclose(
        covariance_of(found, box(3, mean=mean, sd=sd), "linear"), covariance, rtol=1e-9
    )


def test_bounds_hold_and_the_rest_is_optimal(system):
    J, y = system
    free = np.linalg.lstsq(J, y, rcond=None)[0]
    low = np.array([-np.inf, -np.inf, free[2] + 100.0])
    found = minimise(linear(J, y), np.array([0.0, 0.0, free[2] + 200.0]), box(3, low=low))
    exact = optimize.lsq_linear(J, y, (low, [np.inf] * 3), tol=1e-14).x
    covariance = covariance_of(found, box(3, low=low), "linear")
    assert found.x[2] == low[2]
    assert np.all(np.abs(found.x - exact)[:2] < 2e-3 * np.sqrt(np.diag(covariance)[:2]))
    assert np.all(np.isnan(covariance[2]))
    np.testing.assert_allclose(covariance[:2, :2], np.linalg.inv(J[:, :2].T @ J[:, :2]))


def test_large_residuals_take_few_steps():
    """Brown and Dennis's problem, whose sum of squares is 85822.2 at the minimum: without an
    estimate of the second-order term the steps are more than two hundred."""
    t = np.arange(1, 21) / 5

    def evaluate(x, near):
        del near
        a, b = x[0] + t * x[1] - np.exp(t), x[2] + x[3] * np.sin(t) - np.cos(t)
        slopes = np.stack([2 * a, 2 * a * t, 2 * b, 2 * b * np.sin(t)], axis=-1)
        return Residuals((a**2 + b**2)[None], slopes[None], np.array([True]))

    found = minimise(evaluate, np.array([25.0, 5.0, -5.0, -1.0]), box(4))
    assert found.converged
    np.testing.assert_allclose(2 * found.cost, 85822.2016, rtol=1e-6)
    assert found.steps <= 40


def curve(t, y):
    """Residuals of a exp(-b t)."""

    def evaluate(x, near):
        del near
        e = np.exp(-x[1] * t)
        return Residuals(
            (x[0] * e - y)[None], np.stack([e, -x[0] * t * e], 1)[None], np.array([True])
        )

    return evaluate


@pytest.mark.parametrize("loss", LOSSES)
def test_a_robust_fit_agrees_with_scipy(loss):
    rng = np.random.default_rng(1)
    t = np.linspace(0, 3, 40)
    y = 5 * np.exp(-1.2 * t) / 0.05 + rng.normal(size=40)
    y[[3, 20]] += 30

    def cost(x):
        return np.sum(loss_of(loss, x[0] * np.exp(-x[1] * t) - y)[0])

    found = minimise(curve(t, y), np.array([50.0, 0.5]), box(2, low=0, high=500))
    found = minimise(curve(t, y), found.x, box(2, low=0, high=500), loss=loss)
    best = optimize.minimize(cost, [100.0, 1.2], method="Nelder-Mead", tol=1e-10)
    np.testing.assert_allclose(found.x, best.x, rtol=2e-4)
    if loss != "linear":
        assert np.all(
            np.abs(found.x - [100, 1.2])
            < 4 * np.sqrt(np.diag(covariance_of(found, box(2, low=0, high=500), loss)))
        )


@pytest.mark.parametrize("loss", LOSSES)
def test_weights_are_derivatives_of_the_loss(loss):
    f, h = np.array([-7.0, -1.0, -0.2, 0.3, 1.3, 4.0]), 1e-6
    half, weight, slope = loss_of(loss, f)
    up, down = loss_of(loss, f + h), loss_of(loss, f - h)
    np.testing.assert_allclose((up[0] - down[0]) / (2 * h), weight * f, rtol=1e-6)
    np.testing.assert_allclose(
        ((f + h) * up[1] - (f - h) * down[1]) / (2 * h), slope, rtol=1e-6, atol=1e-9
    )
    assert np.all(half >= 0)


def test_no_step_gives_up_a_shape():
    """The second shape cannot be solved beyond x = 0.5, where the minimum of the first lies."""

    def evaluate(x, near):
        del near
        solved = np.array([True, x[0] <= 0.5])
        value = np.where(solved, np.array([10 * (x[0] - 2), 0.1 * x[0]]), 0.0)[:, None]
        slopes = np.where(solved, [10.0, 0.1], 0.0)[:, None, None]
        return Residuals(value, slopes, solved)

    found = minimise(evaluate, np.zeros(1), box(1))
    assert 0.4 < found.x[0] <= 0.5
    assert not found.converged
    assert found.reason == "no step lowers the cost"


def test_steps_end_at_an_edge():
    """Beyond a circle a residual jumps; the minimum of the others lies there. A step towards it
    that stays within is never long, and each gains a little."""

    def evaluate(x, near):
        del near
        value = np.array([[3 * (x[0] - 2), x[1] - 1, 50.0 * (x @ x > 1)]])
        slopes = np.array([[[3.0, 0.0], [0.0, 1.0], [0.0, 0.0]]])
        return Residuals(value, slopes, np.array([True]))

    found = minimise(evaluate, np.array([0.0, -0.9]), box(2))
    assert found.reason == "no step lowers the cost"
    assert found.steps <= 25
    assert 0.99 < np.linalg.norm(found.x) <= 1


def test_what_is_not_determined_is_named():
    """Only a b and c are determined, of a, b, c and d."""

    def evaluate(x, near):
        del near
        a, b, c, _ = x
        J = np.array([[b, a, 0, 0], [2 * b, 2 * a, 0, 0], [0, 0, 1, 0], [b, a, 1, 0]])
        return Residuals(
            100 * np.array([[a * b - 6, 2 * (a * b - 6), c - 1, a * b + c - 7]]),
            100 * J[None],
            np.array([True]),
        )

    limits = box(4, low=0.1, high=10)
    found = minimise(evaluate, np.array([2.5, 2.0, 0.5, 3.0]), limits)
    words = [in_words(one, ("a", "b", "c", "d"), found.x) for one in undetermined(found, limits)]
    assert sorted(words) == [
        "a and b: the data determine only their product",
        "d: not determined by the data",
    ]
    errors = np.sqrt(np.diag(covariance_of(found, limits, "linear")))
    assert np.all(np.isinf(errors[[0, 1, 3]]))
    np.testing.assert_allclose(errors[2], 0.01 / np.sqrt(11 / 6), rtol=1e-6)
