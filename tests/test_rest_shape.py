"""Rods through points: helices and arcs in closed form, given frames, derivatives by points."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import checked_derivative

import vsr_jax as vsr

SOFT = vsr.Material(1e7, poisson=0.5, density=1273.52)
WIRE = vsr.Circular(0.005)
COIL, PITCH, LENGTH = 0.02, 0.05, 0.50040865
RISE = PITCH / (2 * np.pi)
SPEED = np.hypot(COIL, RISE)


def helix(X):
    """Points (stations, 3) of a helix that descends."""
    angle = np.asarray(X) / SPEED
    return np.stack([COIL * np.cos(angle), COIL * np.sin(angle), -RISE * angle], axis=-1)


def helix_frames(X):
    """Rotations with the tangent, the inward normal and their product, (stations, 3, 3)."""
    angle = np.asarray(X) / SPEED
    cosine, sine = np.cos(angle), np.sin(angle)
    tangent = np.stack([-COIL * sine, COIL * cosine, -RISE + 0 * angle], axis=-1) / SPEED
    inward = np.stack([-cosine, -sine, 0 * angle], axis=-1)
    return np.stack([tangent, inward, np.cross(tangent, inward)], axis=-1)


def arc(number, radius=0.3, angle=1.0):
    """Points of an arc in the xz plane."""
    t = np.linspace(0, angle, number)
    return radius * np.stack([np.sin(t), 0 * t, 1 - np.cos(t)], axis=-1)


@pytest.mark.parametrize("framed", [False, True])
def test_a_helix_from_points_hangs_as_that_of_its_strain(framed):
    X = np.linspace(0, LENGTH, 100)
    frames = helix_frames(X) if framed else None
    rod = vsr.Rod.through(helix(X), WIRE, SOFT, frames=frames)
    scene = vsr.Scene(rod, loads=vsr.Gravity((0, 0, -9.8)))
    eq = vsr.solve(scene, [], model=vsr.StrainDependent(64), throw=True)
    tip, middle = (-0.001512, -0.015259, -0.199269), (0.013706, -0.012101, -0.103037)
    np.testing.assert_allclose(eq.tip[:3, 3], tip, atol=2e-6)
    np.testing.assert_allclose(eq.position(rod.length / 2), middle, atol=2e-6)


def test_given_frames_give_the_strain_of_the_helix():
    """Curvature $a / (a^2 + b^2)$, torsion $b / (a^2 + b^2)$, left-handed as it descends."""
    X = np.linspace(0, LENGTH, 100)
    rod = vsr.Rod.through(helix(X), WIRE, SOFT, frames=helix_frames(X))
    strain = np.array([rod.rest(x) for x in np.linspace(0.02, 0.48, 7)])
    exact = -RISE / SPEED**2, 0, COIL / SPEED**2, 1, 0, 0
    np.testing.assert_allclose(strain, np.tile(exact, (7, 1)), rtol=1e-5, atol=1e-4)


def test_an_arm_at_rest_goes_through_its_points():
    t = np.linspace(0, 1, 15)
    points = 0.2 * np.stack([t + 0.1 * np.sin(5 * t), 0.3 * t**2, np.cos(3 * t)], axis=-1)
    rod = vsr.Rod.through(points, WIRE, SOFT, roll=0.4)
    eq = vsr.solve(vsr.Scene(rod), [], model=vsr.StrainDependent(60), throw=True)
    places = rod.rest_strain.parameters[0]
    np.testing.assert_allclose(eq.position(places), points, atol=2e-7)
    usual = vsr.pose(points[0], pointing=rod.base[:3, 0], roll=0.4)
    np.testing.assert_allclose(rod.base, usual, atol=0.02)


def test_the_error_of_an_arc_falls_with_the_points():
    """Its length by fourth order or faster, its strain between the points by second."""
    errors = []
    for number in (9, 17):
        rod = vsr.Rod.through(arc(number), WIRE, SOFT)
        strain = np.array([rod.rest(x) for x in np.linspace(0.1, 0.9, 9) * 0.3])
        assert np.abs(strain[:, [0, 2, 4]]).max() < 1e-12
        errors.append((abs(float(rod.length) - 0.3), np.abs(strain[:, 1] + 1 / 0.3).max()))
    coarse, fine = np.array(errors)
    assert np.all(fine < (1e-8, 2e-3))
    assert np.all(coarse / fine > (14, 3.9))


@pytest.mark.parametrize("number", [2, 3, 8])
def test_points_in_a_row_are_a_straight_rod(number):
    row = np.linspace(0, 1, number)[:, None] * np.array([0.0, 0.0, -0.4])
    rod = vsr.Rod.through(row, WIRE, SOFT)
    np.testing.assert_allclose(rod.length, 0.4, rtol=1e-12)
    np.testing.assert_allclose(rod.rest(jnp.asarray(0.13)), (0, 0, 0, 1, 0, 0), atol=1e-12)
    np.testing.assert_allclose(rod.base, vsr.pose(pointing="down"), atol=1e-12)


@pytest.mark.slow
def test_derivatives_by_the_points():
    """In both modes, of the tip of a loaded arm through points that move, and in a batch."""
    moved = np.random.default_rng(1).normal(size=(3, 9, 3))

    def number(p):
        points = arc(9) + jnp.tensordot(p, moved, 1)
        rod = vsr.Rod.through(points, WIRE, SOFT)
        tendon = vsr.Tendon(vsr.Parallel(0.003, 0.0))
        scene = vsr.Scene(rod, tendon, vsr.Gravity())
        eq = vsr.solve(scene, jnp.array([2.0]), model=vsr.StrainDependent(12))
        return eq.tip[:3, 3] @ jnp.array([1.0, -2.0, 3.0])

    p = jnp.array([1e-3, 0.0, -1e-3])
    solve, _ = checked_derivative(number, p, 1e-4)
    batch = jax.jit(jax.vmap(number))(jnp.stack([p, 2 * p]))
    np.testing.assert_allclose(batch, [solve(p)[0], solve(2 * p)[0]], rtol=1e-10)


def test_the_precision_is_that_of_the_points(dtype):
    rod = vsr.Rod.through(jnp.asarray(arc(9), dtype), WIRE, SOFT)
    assert rod.length.dtype == rod.rest(jnp.asarray(0.1, dtype))[1].dtype == dtype
    np.testing.assert_allclose(rod.length, 0.3, rtol=1e-4)


TURNED = np.tile(np.diag([-1.0, -1.0, 1.0]), (9, 1, 1))


@pytest.mark.parametrize(
    ("points", "options", "message"),
    [
        (np.zeros((1, 3)), {}, "Rod.through.points: got shape (1, 3), need two points or more"),
        (np.zeros((4, 2)), {}, "Rod.through.points: got shape (4, 2), need two points or more"),
        (arc(9)[[0, 1, 1, 2]], {}, "Rod.through.points: got the same point at 1 and 2, need"),
        (arc(9), {"frames": np.zeros((9, 3))}, "Rod.through.frames: got shape (9, 3), need"),
        (arc(9), {"frames": 2 * TURNED}, "Rod.through.frames: got no rotation at point 0, need"),
        (
            arc(9),
            {"frames": TURNED},
            "Rod.through.frames: got an x axis against the curve at point",
        ),
    ],
)
def test_bad_points_are_refused(points, options, message, unchecked):
    with pytest.raises(ValueError) as told:  # noqa: PT011
        vsr.Rod.through(points, WIRE, SOFT, **options)
    assert str(told.value).startswith(message)
