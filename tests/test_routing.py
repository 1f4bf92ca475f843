"""Thread paths: positions and slopes against formulas written out by hand, and SciPy's spline."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.interpolate import CubicSpline

import vsr_jax as vsr

X = jnp.linspace(0.01, 0.74, 7)


def path(routing):
    return jax.vmap(routing.path)(X)


@pytest.mark.slow
def test_linear():
    p = path(vsr.Linear(0.001, 0.002, 0.003, -0.004))
    np.testing.assert_allclose(p.y, 0.001 + 0.003 * X)
    np.testing.assert_allclose(p.slope_z, -0.004 * np.ones(7))


def test_parallel_has_no_slope():
    p = path(vsr.Parallel(0.001, 0.002))
    assert not np.any([p.slope_y, p.slope_z])


@pytest.mark.parametrize(("hand", "sign"), [("right", 1), ("left", -1)])
def test_helix_by_angle_is_eq_23(hand, sign):
    p = path(vsr.Helix(0.005, 1.5, phase=0.3, hand=hand))
    pitch = 2 * np.pi * 0.005 * np.tan(1.5)
    phi = 0.3 + sign * 2 * np.pi * X / pitch
    np.testing.assert_allclose(p.y, 0.005 * np.cos(phi), atol=1e-15)
    np.testing.assert_allclose(
        p.slope_z, sign * 0.005 * 2 * np.pi / pitch * np.cos(phi), atol=1e-14
    )


def test_helix_by_pitch_is_the_helix_by_angle():
    pitch = 2 * np.pi * 0.005 * np.tan(1.5)
    for a, b in zip(path(vsr.Helix(0.005, 1.5)), path(vsr.Helix(0.005, pitch=pitch)), strict=True):
        np.testing.assert_allclose(a, b, atol=1e-14)


def test_polynomial_takes_rising_powers():
    p = path(vsr.Polynomial(y=[0.004, 0.01, -0.02], z=[0.001]))
    np.testing.assert_allclose(p.y, 0.004 + 0.01 * X - 0.02 * X**2, rtol=1e-14)
    np.testing.assert_allclose(p.slope_y, 0.01 - 0.04 * X, rtol=1e-13)


@pytest.mark.slow
@pytest.mark.parametrize("points", [2, 3, 4, 7])
def test_spline_is_scipys(points):
    rng = np.random.default_rng(points)
    knots = np.sort(np.concatenate([[0.0, 0.75], rng.uniform(0.05, 0.7, points - 2)]))
    y, z = rng.normal(size=(2, points)) * 0.003
    p = path(vsr.Spline(knots, y, z))
    spline = CubicSpline(knots, y)
    np.testing.assert_allclose(p.y, spline(X), atol=1e-15)
    np.testing.assert_allclose(p.slope_y, spline(X, 1), atol=1e-13)
    np.testing.assert_allclose(p.z, CubicSpline(knots, z)(X), atol=1e-15)


def test_spline_breaks_only_where_a_derivative_jumps():
    routing = vsr.Spline([0.0, 0.2, 0.4, 0.6, 0.75], np.zeros(5), np.zeros(5))
    np.testing.assert_allclose(routing.breakpoints, [0.4])
    assert vsr.Spline([0.0, 0.3, 0.75], np.zeros(3), np.zeros(3)).breakpoints == ()


def test_function_takes_parameters_that_can_be_differentiated():
    def helix(x, radius):
        return radius * jnp.cos(8 * x), radius * jnp.sin(8 * x)

    routing = vsr.Function(helix, 0.005)
    np.testing.assert_allclose(path(routing).slope_y, -0.04 * np.sin(8 * X), rtol=1e-12)
    slope = jax.grad(lambda r: r(jnp.asarray(0.1))[0])(routing).function.parameters[0]
    np.testing.assert_allclose(slope, np.cos(0.8), rtol=1e-14)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: vsr.Helix(0.005), "Helix: got angle=None and pitch=None, need one of the two"),
        (
            lambda: vsr.Helix(0.005, 87.6),
            r"Helix\.angle: got 87\.6, need a finite number > 0 and <= 1\.5708",
        ),
        (lambda: vsr.Helix(0.0, 1.5), r"Helix\.radius: got 0\.0, need a finite number > 0"),
        (
            lambda: vsr.Helix(0.005, 1.5, hand="up"),
            r"Helix\.hand: got 'up', need one of 'right', 'left'",
        ),
        (lambda: vsr.Linear("a", 0.0), r"Linear\.y: got 'a', need a finite number"),
        (lambda: vsr.Parallel(np.nan, 0.0), r"Parallel\.y: got nan, need a finite number"),
        (
            lambda: vsr.Parallel([0.1, 0.2], 0.0),
            r"Parallel\.y: got shape \(2,\), need a finite number",
        ),
        (
            lambda: vsr.Spline([0.0, 0.5, 0.4], np.zeros(3), np.zeros(3)),
            "increasing abscissas",
        ),
        (lambda: vsr.Spline([0.0, 0.5], np.zeros(3), np.zeros(2)), r"Spline\.y: got shape \(3,\)"),
        (lambda: vsr.Polynomial([], [0.0]), "need an array of at least one number"),
        (lambda: vsr.Function(3.0), "need a function of X"),
    ],
)
@pytest.mark.usefixtures("unchecked")
def test_refusals_say_what_and_where(make, message):
    with pytest.raises(ValueError, match=message):
        make()
