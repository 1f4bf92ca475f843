"""Sections, materials and profiles against published constants and closed forms."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.interpolate import CubicSpline

import vsr_jax as vsr

X, L = jnp.asarray(0.3), jnp.asarray(0.75)
STEEL = vsr.Material(2e11, poisson=0.3)


def geometry(section):
    return section.geometry(X, L)


def based(base):
    return vsr.Rod(1.0, vsr.Circular(0.01), STEEL, base=base)


def test_circle():
    shape = geometry(vsr.Circular(vsr.Taper(0.012, 0.010)))
    r = 0.012 - 0.002 * 0.4
    np.testing.assert_allclose(
        [shape.area, shape.moment_y, shape.torsion],
        [np.pi * r**2, np.pi * r**4 / 4, np.pi * r**4 / 2],
        rtol=1e-14,
    )


def test_tube_is_the_difference_of_two_circles():
    tube, outer, inner = (
        geometry(s) for s in (vsr.Annular(0.02, 0.015), vsr.Circular(0.02), vsr.Circular(0.015))
    )
    for a, b, c in zip(
        jax.tree.leaves(tube)[:4],
        jax.tree.leaves(outer)[:4],
        jax.tree.leaves(inner)[:4],
        strict=True,
    ):
        np.testing.assert_allclose(a, b - c, rtol=1e-14)


def test_only_tubes_have_a_hole():
    tube = vsr.Annular(0.02, vsr.Taper(0.015, 0.010))
    assert vsr.Circular(0.02).inner_radius(X, L) == 0
    np.testing.assert_allclose(tube.inner_radius(X, L), 0.015 - 0.005 * 0.4, rtol=1e-14)
    for end, radius in ((0.2, 0.0), (0.4, 0.013)):
        joined = vsr.Joined([end], [tube, vsr.Circular(0.02)])
        np.testing.assert_allclose(joined.inner_radius(X, L), radius, rtol=1e-14)


@pytest.mark.parametrize(
    ("ratio", "constant"),
    [(1.0, 0.1406), (1.5, 0.1958), (2.0, 0.2287), (3.0, 0.2633), (10.0, 0.3123)],
)
def test_rectangle_torsion_is_the_published_table(ratio, constant):
    """J = k1 a b^3. Timoshenko and Goodier, Theory of Elasticity, 3rd ed., art. 109, table 11
    (k1)."""
    for w, h in ((ratio * 0.01, 0.01), (0.01, ratio * 0.01)):
        J = geometry(vsr.Rectangular(w, h)).torsion
        np.testing.assert_allclose(
            J / (ratio * 0.01**4), constant, atol=6e-5 if ratio < 10 else 1.1e-4
        )


def test_square_torsion_to_rounding():
    """0.1405770149... from the series summed to 10,000 terms."""
    n = np.arange(1, 20000, 2)
    series = (1 - 192 / np.pi**5 * np.sum(np.tanh(n * np.pi / 2) / n**5)) / 3
    np.testing.assert_allclose(geometry(vsr.Rectangular(1.0, 1.0)).torsion, series, rtol=1e-13)


def test_rectangle_torsion_has_no_kink_at_the_square():
    def torsion(w):
        return vsr.Rectangular(w, 0.01).geometry(X, L).torsion

    slopes = [float(jax.grad(torsion)(jnp.asarray(0.01 * f))) for f in (1 - 1e-9, 1.0, 1 + 1e-9)]
    np.testing.assert_allclose(slopes, slopes[1], rtol=1e-7)


def test_ellipse_and_its_choice_of_torsion():
    a, b = 0.02, 0.01
    saint_venant, polar = (
        geometry(vsr.Elliptic(a, b, torsion=t)) for t in ("saint_venant", "polar")
    )
    np.testing.assert_allclose(
        saint_venant.torsion, np.pi * a**3 * b**3 / (a**2 + b**2), rtol=1e-14
    )
    np.testing.assert_allclose(polar.torsion, np.pi / 4 * (a * b**3 + a**3 * b), rtol=1e-14)
    np.testing.assert_allclose(saint_venant.moment_z, np.pi / 4 * a**3 * b, rtol=1e-14)


def test_stiffness_order_and_shear_correction():
    section = vsr.Rectangular(0.02, 0.01, shear_correction=(0.5, 0.8))
    E, G, shape = 2e11, 2e11 / 2.6, geometry(section)
    want = [
        G * shape.torsion,
        E * 0.02 * 0.01**3 / 12,
        E * 0.01 * 0.02**3 / 12,
        E * 2e-4,
        0.5 * G * 2e-4,
        0.8 * G * 2e-4,
    ]
    np.testing.assert_allclose(STEEL.stiffness(section, X, L), want, rtol=1e-13)


def test_clearance_is_the_distance_to_the_wall():
    y, z = jnp.asarray(0.003), jnp.asarray(0.004)
    np.testing.assert_allclose(vsr.Circular(0.01).clearance(y, z, X, L), 0.005, rtol=1e-12)
    np.testing.assert_allclose(vsr.Rectangular(0.02, 0.01).clearance(y, z, X, L), 0.001, rtol=1e-12)
    assert vsr.Elliptic(0.02, 0.003).clearance(y, z, X, L) < 0


SECTIONS = {
    "circle": vsr.Circular(0.01),
    "tube": vsr.Annular(0.01, 0.005),
    "rectangle": vsr.Rectangular(0.02, 0.03),
    "ellipse": vsr.Elliptic(0.02, 0.01),
    "joined": vsr.Joined([0.4], [vsr.Circular(0.01), vsr.Elliptic(0.02, 0.01)]),
}


@pytest.mark.parametrize("name", SECTIONS)
def test_clearance_on_the_axis_has_finite_derivatives(name):
    section, guided = (
        SECTIONS[name],
        vsr.Rod(L, SECTIONS[name], STEEL, discs=vsr.Discs(10, radius=0.05)),
    )
    zero = jnp.zeros(())
    for clearance, expected in (
        (lambda y, z: section.clearance(y, z, X, L), 0.01),
        (lambda y, z: guided.clearance(y, z, X), 0.05),
    ):
        value, slope = jax.value_and_grad(clearance, argnums=(0, 1))(zero, zero)
        np.testing.assert_allclose(value, expected, rtol=1e-12)
        assert np.all(
            np.abs(slope) <= (1.0 if name == "rectangle" else 0.0)
        )  # of the kink the slope of one side
        assert np.all(np.isfinite(jax.hessian(clearance, argnums=(0, 1))(zero, zero)))


def test_profiles():
    knots, values = np.array([0.0, 0.2, 0.5, 0.75]), np.array([0.01, 0.012, 0.009, 0.008])
    cases = [
        (vsr.Constant(0.01), 0.01),
        (vsr.PolynomialProfile([0.01, 0.02, -0.03]), 0.01 + 0.006 - 0.0027),
        (vsr.SplineProfile(knots, values), CubicSpline(knots, values)(0.3)),
        (vsr.FunctionProfile(lambda x, a: a * jnp.exp(-x), 0.01), 0.01 * np.exp(-0.3)),
    ]
    for profile, want in cases:
        np.testing.assert_allclose(profile(X, L), want, rtol=1e-13)
        np.testing.assert_allclose(
            geometry(vsr.Circular(profile)).area, np.pi * want**2, rtol=1e-12
        )


def test_a_python_function_is_a_profile():
    np.testing.assert_allclose(
        geometry(vsr.Circular(lambda x: 0.01 - 0.01 * x)).area, np.pi * 0.007**2, rtol=1e-13
    )


class Narrowing(eqx.Module):
    """A radius that is a module."""

    rate: jax.Array

    def __call__(self, x):
        return 0.01 - self.rate * x


def test_the_arrays_of_a_module_that_is_a_profile_are_differentiated_and_batched():
    def area(rate):
        return geometry(vsr.Circular(Narrowing(rate))).area

    rates = jnp.array([0.01, 0.02])
    radius = 0.01 - 0.3 * rates
    slopes = jax.jit(jax.vmap(jax.grad(area)))(rates)
    np.testing.assert_allclose(jax.vmap(area)(rates), np.pi * radius**2, rtol=1e-13)
    np.testing.assert_allclose(slopes, -0.6 * np.pi * radius, rtol=1e-13)
    assert str(vsr.Circular(Narrowing(rates[0])).radius) == (
        "FunctionProfile(function=Narrowing(X))"
    )


@pytest.mark.slow
def test_what_a_function_closes_over_is_differentiated_and_batched():
    def tip(rate, offset):
        radius = vsr.FunctionProfile(lambda x: 0.01 - rate * x)
        thread = vsr.Tendon(vsr.Function(lambda x: (offset + 0.01 * x, 0.002)))
        rod = vsr.Rod(0.2, vsr.Circular(radius), vsr.Material(1e6, poisson=0.5))
        scene = vsr.Scene(rod, [thread])
        return vsr.solve(scene, [1.0], model=vsr.StrainDependent(steps=4)).tip[0, 3]

    at, both = jnp.array([0.01, 0.004]), jax.grad(tip, (0, 1))
    found, sizes = jax.jit(jax.value_and_grad(tip, (0, 1))), np.array([1e-5, 1e-6])
    expected = [
        (found(*(at + move))[0] - found(*(at - move))[0]) / (2 * size)
        for move, size in zip(np.diag(sizes), sizes, strict=True)
    ]
    for slopes in (both(*at), found(*at)[1]):
        np.testing.assert_allclose(slopes, expected, rtol=1e-5)
    for batched in (jax.vmap(both), jax.jit(jax.vmap(both))):
        slopes = batched(jnp.array([0.012, at[0]]), jnp.full(2, at[1]))
        np.testing.assert_allclose([slope[1] for slope in slopes], expected, rtol=1e-5)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: vsr.Circular(0.0), r"Circular\.radius: got 0\.0, need a finite number > 0"),
        (lambda: vsr.Circular(-0.01), r"Circular\.radius: got -0\.01"),
        (lambda: vsr.Circular("thick"), r"Circular\.radius: got 'thick'"),
        (lambda: vsr.Circular(np.inf), r"Circular\.radius: got inf"),
        (lambda: vsr.Circular(vsr.Taper(0.01, 0.0)), r"Circular\.radius \(Taper\.tip\)"),
        (
            lambda: vsr.Elliptic(0.01, 0.01, torsion="exact"),
            "torsion: got 'exact', need one of 'saint_venant', 'polar'",
        ),
        (lambda: vsr.Circular(0.01, shear_correction=[1, 1, 1]), "shear_correction: got shape"),
        (
            lambda: vsr.Material(1e6),
            "Material: got shear=None and poisson=None, need one of the two",
        ),
        (lambda: vsr.Material(1e6, shear=1e5, poisson=0.3), "need one of the two"),
        (
            lambda: vsr.Circular(),
            r"Circular: got radius=None and diameter=None, need one of the two",
        ),
        (
            lambda: vsr.Circular(0.01, diameter=0.02),
            r"Circular: got radius=0\.01 and diameter=0\.02, need one of the two",
        ),
        (
            lambda: vsr.Circular(diameter=-0.02),
            r"Circular\.diameter: got -0\.02, need a finite number > 0",
        ),
        (
            lambda: vsr.Annular(0.01, 0.02),
            r"Annular\.inner: got 0\.02 m, need less than the outer radius, 0\.01 m",
        ),
        (lambda: vsr.Annular(0.01, 0.01), r"Annular\.inner: got 0\.01 m, need less"),
        (
            lambda: vsr.Material(1e6, poisson=0.6),
            r"Material\.poisson: got 0\.6, need a finite number > -1 and <= 0\.5",
        ),
        (lambda: vsr.Material(1e6, poisson=-1), r"Material\.poisson: got -1, need"),
        (
            lambda: vsr.Material(1e6, poisson=vsr.Piecewise([0.1], [0.3, 0.7])),
            r"Material\.poisson \(Piecewise\.values\[1\]\): got",
        ),
        (lambda: vsr.Material(-1e6, shear=1e5), r"Material\.young: got -1000000\.0"),
        (lambda: vsr.PolynomialProfile([[0.1]]), "need an array of at least one number"),
        (lambda: vsr.Rod(0.0, vsr.Circular(0.01), STEEL), r"Rod\.length: got 0\.0"),
        (lambda: vsr.Rod(1.0, 0.01, STEEL), r"Rod\.section: got 0\.01, need a section"),
        (lambda: vsr.Rod(1.0, vsr.Circular(0.01), 2e11), r"Rod\.material: got .*, need a Material"),
        (
            lambda: vsr.Rod(1.0, vsr.Circular(0.01), STEEL, rest_strain=[0, 0]),
            r"Rod\.rest_strain: got \[0, 0\], need six profiles",
        ),
        (
            lambda: vsr.Rod(1.0, vsr.Circular(0.01), STEEL, base=np.eye(3)),
            r"Rod\.base: got shape \(3, 3\)",
        ),
        (
            lambda: based(np.diag([1.0, 1.0, -1.0, 1.0])),
            r"Rod\.base: got a reflection \(.* determinant -1\), need a rigid transform",
        ),
        (
            lambda: based(np.diag([2.0, 2.0, 2.0, 1.0])),
            r"Rod\.base: got columns of a rotation that are not orthonormal \(.* by 3\)",
        ),
        (lambda: based(np.diag([0.0, 0.0, 0.0, 1.0])), r"Rod\.base: got a rotation of zeros"),
        (lambda: based(np.eye(4) + np.eye(4, k=-3)), r"Rod\.base: got a last row of 1 0 0 1"),
        (
            lambda: vsr.objective.TipError([np.eye(4), np.diag([1.0, 1.0, -1.0, 1.0])]),
            r"TipError\.targets\[1\]: got a reflection",
        ),
    ],
)
@pytest.mark.usefixtures("unchecked")
def test_refusals_say_what_and_where(make, message):
    with pytest.raises(ValueError, match=message):
        make()


def test_a_base_needs_six_digits_in_double_precision_and_three_in_single():
    pose = np.asarray(vsr.se3.exp(jnp.array([0.3, -0.7, 2.0, 0.1, 0.2, 0.3])))
    based(pose.round(6))
    based(pose.round(4).astype(np.float32))
    with pytest.raises(
        ValueError, match=r"Rod\.base: got columns of a rotation that are not orthonormal"
    ):
        based(pose.round(4))


@pytest.mark.parametrize(
    "diameter",
    [
        0.02,
        vsr.Constant(0.02),
        vsr.Taper(0.02, 0.016),
        vsr.PolynomialProfile([0.02, -0.01, 0.003]),
        vsr.SplineProfile([0.0, 0.2, 0.5, 0.75], [0.02, 0.021, 0.018, 0.016]),
        vsr.Piecewise([0.1], [vsr.Taper(0.02, 0.018), 0.016]),
        lambda x: 0.02 - 0.01 * x,
    ],
    ids=lambda value: type(value).__name__,
)
def test_a_diameter_is_twice_the_radius(diameter):
    section = vsr.Circular(diameter=diameter)
    wide = vsr.Circular(diameter)  # taken for a radius
    np.testing.assert_allclose(geometry(section).moment_y, geometry(wide).moment_y / 16, rtol=1e-13)
    np.testing.assert_array_equal(section.breakpoints, wide.breakpoints)


def test_a_diameter_may_be_traced():
    slope = jax.grad(lambda d: vsr.Circular(diameter=d).geometry(X, L).area)(0.02)
    np.testing.assert_allclose(slope, np.pi * 0.02 / 2, rtol=1e-13)
