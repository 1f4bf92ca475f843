"""Obstacles: distances against other formulas and sampled surfaces, their derivatives, and what
scenes, files and pictures do with them."""

import re

import equinox as eqx
import jax
import jax.numpy as jnp
import matplotlib as mpl
import numpy as np
import pytest
from conftest import central_differences, epsilon
from scipy.interpolate import CubicSpline
from scipy.spatial import cKDTree

mpl.use("Agg")

import matplotlib.pyplot as plt

import vsr_jax as vsr
from vsr_jax.arm import Obstacle
from vsr_jax.files.scene_file import parse_scene, to_toml
from vsr_jax.viewer.mesh import polygons
from vsr_jax.viz import annotate, plot
from vsr_jax.viz.obstacles import Region, polygons_of

TURNED = vsr.pose((0.05, -0.02, 0.03), pointing=(0.3, -0.5, 0.9), roll=0.4)
LINE = np.array([[0, 0, 0], [0.08, 0.01, 0], [0.15, 0.02, 0.05], [0.18, -0.03, 0.1], [0.2, 0, 0.2]])


class Ellipsoid(eqx.Module):
    """An approximate distance with numbers."""

    axes: jax.Array
    centre: jax.Array

    def __call__(self, r):
        scaled = (r - self.centre) / self.axes
        size = jnp.sqrt(jnp.sum(scaled**2))
        return size * (size - 1) / jnp.sqrt(jnp.sum((scaled / self.axes) ** 2))


OBSTACLES = {
    "plane": vsr.Plane((1.0, -2.0, 0.5), (0.1, 0.0, 0.02)),
    "sphere": vsr.Sphere((0.1, -0.05, 0.02), 0.06),
    "endless cylinder": vsr.Cylinder(0.05, pose=TURNED),
    "cylinder": vsr.Cylinder(0.05, length=0.12, pose=TURNED),
    "box": vsr.Box((0.1, 0.06, 0.14), pose=TURNED),
    "rounded box": vsr.Box((0.1, 0.06, 0.14), pose=TURNED, rounding=0.02),
    "straight tube": vsr.Tube(0.05, pose=TURNED),
    "tube": vsr.Tube(0.03, LINE, pose=TURNED),
    "tapered tube": vsr.Tube(vsr.Taper(0.04, 0.02), LINE, pose=TURNED),
    "narrow tube": vsr.Tube(
        vsr.Piecewise([0.1], [vsr.PolynomialProfile([0.04, -0.25]), 0.015]), LINE, pose=TURNED
    ),
    "field": vsr.Field(Ellipsoid(jnp.array([0.1, 0.05, 0.08]), jnp.zeros(3))),
}
POINTS = np.random.default_rng(0).uniform(-0.15, 0.25, (40, 3))


@pytest.fixture(params=OBSTACLES)
def obstacle(request):
    return OBSTACLES[request.param]


@eqx.filter_jit
def distances(obstacle, points):
    return jax.vmap(obstacle.distance)(points)


@eqx.filter_jit
def gradients(obstacle, points):
    return jax.vmap(jax.grad(obstacle.distance))(points)


@eqx.filter_jit
def hessians(obstacle, points):
    return jax.vmap(jax.hessian(obstacle.distance))(points)


def arm(radius=0.01, **more):
    return vsr.Rod(0.3, vsr.Circular(radius), vsr.Material(8e5, poisson=0.45), **more)


def local(obstacle, points):
    g = np.asarray(TURNED)
    return (points - g[:3, 3]) @ g[:3, :3]


def sampled_boxes(size, rounding, steps=160):
    """Points of the surface of a box in its axes."""
    u = np.linspace(-1, 1, steps)
    half = np.asarray(size) / 2
    faces = []
    for i in range(3):
        a, b = np.meshgrid(u, u)
        for side in (-1, 1):
            faces.append(half * np.roll(np.stack([side + 0 * a, a, b], -1).reshape(-1, 3), i, 1))
    # the nearest point of the inner box, moved out by the rounding
    points = np.concatenate(faces)
    inner = np.clip(points, rounding - half, half - rounding)
    out = points - inner
    length = np.linalg.norm(out, axis=1, keepdims=True)
    return inner + rounding * out / length if rounding else points


def sampled_cylinder(radius, length, steps=400):
    angle, share = np.linspace(0, 2 * np.pi, steps), np.linspace(-1, 1, steps)
    a, s = (x.ravel() for x in np.meshgrid(angle, share))
    side = np.stack([s * length / 2, radius * np.cos(a), radius * np.sin(a)], -1)
    r = radius * np.sqrt(np.abs(s))
    caps = np.stack([np.sign(s) * length / 2, r * np.cos(a), r * np.sin(a)], -1)
    return np.concatenate([side, caps])


@pytest.mark.parametrize(
    ("name", "surface", "spacing"),
    [
        ("box", sampled_boxes((0.1, 0.06, 0.14), 0.0), 1e-3),
        ("rounded box", sampled_boxes((0.1, 0.06, 0.14), 0.02), 1.2e-3),
        ("cylinder", sampled_cylinder(0.05, 0.12), 1.3e-3),
    ],
)
def test_the_distance_is_that_to_the_nearest_point_of_the_surface(name, surface, spacing):
    """Of a sampled surface, which is off by at most half its spacing."""
    points = np.random.default_rng(1).uniform(-0.12, 0.12, (300, 3)) + np.asarray(TURNED)[:3, 3]
    found = np.asarray(distances(OBSTACLES[name], points))
    nearest, _ = cKDTree(surface).query(local(OBSTACLES[name], points))
    assert np.min(found) < -0.01 < 0.05 < np.max(found)
    assert np.all(nearest >= np.abs(found) - 1e-12)
    assert np.max(nearest - np.abs(found)) < spacing


def test_signs_of_a_box_and_a_cylinder():
    points = np.random.default_rng(1).uniform(-0.12, 0.12, (300, 3)) + np.asarray(TURNED)[:3, 3]
    x, y, z = local(None, points).T
    in_box = (np.abs(x) < 0.05) & (np.abs(y) < 0.03) & (np.abs(z) < 0.07)
    np.testing.assert_array_equal(distances(OBSTACLES["box"], points) < 0, in_box)
    in_cylinder = (np.abs(x) < 0.06) & (np.hypot(y, z) < 0.05)
    np.testing.assert_array_equal(distances(OBSTACLES["cylinder"], points) < 0, in_cylinder)


def test_distances_to_planes_spheres_and_endless_cylinders():
    n, p = np.array([1.0, -2.0, 0.5]), np.array([0.1, 0.0, 0.02])
    foot = POINTS - np.outer((POINTS - p) @ n / (n @ n), n)
    height = np.linalg.norm(POINTS - foot, axis=1) * np.sign((POINTS - foot) @ n)
    np.testing.assert_allclose(distances(OBSTACLES["plane"], POINTS), height, atol=1e-15)
    away = np.linalg.norm(POINTS - (0.1, -0.05, 0.02), axis=1)
    np.testing.assert_allclose(distances(OBSTACLES["sphere"], POINTS), away - 0.06, atol=1e-15)
    off = np.linalg.norm(np.cross(POINTS - TURNED[:3, 3], TURNED[:3, 0]), axis=1)
    cylinder, tube = OBSTACLES["endless cylinder"], OBSTACLES["straight tube"]
    np.testing.assert_allclose(distances(cylinder, POINTS), off - 0.05, atol=1e-15)
    np.testing.assert_allclose(distances(tube, POINTS), 0.05 - off, atol=1e-15)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "ends", "radii"),
    [
        ("tube", (0.0, 1.0), (0.03, 0.03)),
        ("tapered tube", (0.0, 1.0), (0.04, 0.02)),
        ("narrow tube", (0.0, 0.1, 1.0), (0.04, 0.015, 0.015)),
    ],
)
def test_the_distance_in_a_tube_is_the_depth_in_its_deepest_ball(name, ends, radii):
    """Against SciPy's spline, sampled densely, with straight ends."""
    knots = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(LINE, axis=0), axis=1))])
    spline = CubicSpline(knots, LINE)
    s = np.union1d(np.linspace(-0.3, knots[-1] + 0.3, 200_000), [0.0, 0.1, knots[-1]])
    inner = np.clip(s, 0, knots[-1])
    centre = spline(inner) + (s - inner)[:, None] * spline(inner, 1)
    share = np.array(ends) if name == "narrow tube" else np.array(ends) * knots[-1]
    radius = np.interp(inner, share, radii)
    expected = [np.max(radius - np.linalg.norm(p - centre, axis=1)) for p in local(None, POINTS)]
    np.testing.assert_allclose(distances(OBSTACLES[name], POINTS), expected, atol=2e-9)


def test_a_tube_through_two_points_is_straight():
    axis = np.asarray(TURNED)[:3, 0] * 0.1
    start = np.asarray(TURNED)[:3, 3]
    tube = vsr.Tube(0.05, [start, start + axis])
    expected = distances(OBSTACLES["straight tube"], POINTS)
    np.testing.assert_allclose(distances(tube, POINTS), expected, atol=1e-14)


def test_the_wall_of_a_cone_is_that_of_its_balls():
    """Balls whose radius falls at the rate sin(a) along a line envelop a cone of half angle a."""
    a, start = 0.2, 0.05
    tube = vsr.Tube(vsr.Taper(start, start - 0.1 * np.sin(a)), [[0, 0, 0], [0.1, 0, 0]])
    apex = start / np.sin(a)
    x, y = np.random.default_rng(2).uniform((0.03, 0.005), (0.06, 0.02), (30, 2)).T
    expected = (apex - x) * np.sin(a) - y * np.cos(a)
    found = distances(tube, np.stack([x, y, 0 * x], -1))
    np.testing.assert_allclose(found, expected, atol=1e-14)


@pytest.mark.slow
def test_derivatives_are_those_of_finite_differences(obstacle):
    step = 1e-5
    slopes, curvatures = (
        np.moveaxis(central_differences(lambda u, f=f: f(obstacle, POINTS + step * u), 3), 0, 1)
        / step
        for f in (distances, gradients)
    )
    np.testing.assert_allclose(gradients(obstacle, POINTS), slopes, atol=2e-9)
    for found, expected in zip(hessians(obstacle, POINTS), curvatures, strict=True):
        # the pieces of a surface meet in a jump of the curvature, which few points are near
        np.testing.assert_allclose(found, expected, atol=1e-7 * (1 + np.max(found)))


def test_gradients_are_unit_vectors(obstacle):
    if not isinstance(obstacle, vsr.Field):
        size = np.linalg.norm(gradients(obstacle, POINTS), axis=1)
        np.testing.assert_allclose(size, 1.0, atol=1e-12)


@pytest.mark.slow
def test_third_derivatives_of_a_tube():
    tube, step = OBSTACLES["tapered tube"], 1e-5
    third = jax.jit(jax.vmap(jax.jacfwd(jax.hessian(tube.distance))))(POINTS[:5])
    for p, found in zip(POINTS, third, strict=False):
        expected = central_differences(lambda u, p=p: hessians(tube, p[None] + step * u)[0], 3)
        np.testing.assert_allclose(np.moveaxis(found, -1, 0), expected / step, rtol=1e-5, atol=1e-3)


@pytest.mark.slow
def test_derivatives_are_finite_where_the_normal_is_not_unique():
    sharp, rounded = vsr.Box((0.2, 0.2, 0.2)), vsr.Box((0.2, 0.2, 0.2), rounding=0.1)
    at = [
        (vsr.Sphere((0.1, 0.2, 0.3), 0.1), [(0.1, 0.2, 0.3)]),
        (vsr.Cylinder(0.1), [(0, 0, 0), (0.3, 0, 0)]),
        (vsr.Cylinder(0.1, length=0.2), [(0, 0, 0), (0.1, 0, 0), (0.1, 0.1, 0), (0.2, 0, 0)]),
        (sharp, [(0, 0, 0), (0.1, 0, 0), (0.1, 0.1, 0), (0.1, 0.1, 0.1), (0.05, 0.05, 0)]),
        (rounded, [(0, 0, 0), (0.1, 0, 0), (0.1, 0.1, 0), (0.1, 0.1, 0.1)]),
        (vsr.Tube(0.1), [(0, 0, 0)]),
        (vsr.Tube(0.1, LINE), [*LINE, *(LINE - (0.1, 0.0, 0.0))]),
        (vsr.Tube(vsr.Taper(0.1, 0.05), LINE), LINE),
    ]
    for obstacle, points in at:
        points = np.resize(points, POINTS.shape).astype(float)  # for which programs are compiled
        assert np.all(np.isfinite(distances(obstacle, points)))
        assert np.all(np.isfinite(gradients(obstacle, points)))
        assert np.all(np.isfinite(hessians(obstacle, points)))
    points = np.resize([0.1, 0.02, 0.03], POINTS.shape)
    np.testing.assert_allclose(gradients(sharp, points)[0], (1, 0, 0))


@pytest.mark.parametrize("name", [name for name in OBSTACLES if "pose" in dir(OBSTACLES[name])])
def test_distances_do_not_change_in_a_rigid_motion(name):
    obstacle = OBSTACLES[name]
    motion = vsr.pose((0.7, -0.2, 0.4), pointing=(-0.4, 0.8, 0.1), roll=1.1)
    moved = eqx.tree_at(lambda o: o.pose, obstacle, motion @ obstacle.pose)
    points = POINTS @ motion[:3, :3].T + motion[:3, 3]
    np.testing.assert_allclose(distances(moved, points), distances(obstacle, POINTS), atol=1e-14)


@pytest.mark.slow
def test_single_precision(obstacle, dtype):
    points = POINTS.astype(dtype)
    typed = jax.tree.map(lambda x: x.astype(dtype) if eqx.is_inexact_array(x) else x, obstacle)
    found = distances(typed, points)
    assert found.dtype == dtype
    expected = distances(obstacle, points.astype(float))
    np.testing.assert_allclose(found, expected, atol=4 * epsilon(dtype))
    slopes = gradients(typed, points)
    exact = gradients(obstacle, points.astype(float))
    np.testing.assert_allclose(slopes, exact, atol=200 * epsilon(dtype))


def test_a_scene_of_obstacles():
    scene = vsr.Scene(arm(), obstacles=vsr.Sphere((0.1, 0, 0.1), 0.05))
    assert scene.coupled
    assert scene.effects == ("sphere",)
    assert "obstacles[0]  Sphere(centre=(0.1, 0, 0.1) m, radius=0.05 m)" in repr(scene)
    assert vsr.parameters(scene)["obstacles[0].radius"].unit == "m"
    bare = vsr.Scene(arm())
    assert bare.obstacles == ()
    assert not bare.coupled
    assert "obstacles" not in repr(bare)


@pytest.mark.parametrize(
    ("section", "radius"),
    [
        (vsr.Circular(0.01), 0.01),
        (vsr.Annular(0.012, 0.01), 0.012),
        (vsr.Rectangular(0.008, 0.006), 0.005),
        (vsr.Elliptic(0.01, 0.02), 0.02),
        (vsr.Joined([0.1], [vsr.Circular(0.01), vsr.Circular(0.02)]), 0.02),
        (vsr.Circular(vsr.Taper(0.02, 0.01)), 0.0125),
    ],
)
def test_the_outline_of_a_rod(section, radius):
    X = jnp.array(0.225)
    rod = vsr.Rod(0.3, section, vsr.Material(8e5, poisson=0.45))
    np.testing.assert_allclose(rod.outline(X), radius, rtol=1e-14)
    y, z = section.outline(jnp.linspace(0, 2 * np.pi, 721), X, rod.length)
    np.testing.assert_allclose(np.max(np.hypot(y, z)), radius, rtol=1e-12)
    guided = vsr.Rod(
        0.3, section, vsr.Material(8e5, poisson=0.45), discs=vsr.Discs(10, radius=0.03)
    )
    assert guided.outline(X) == 0.03


SCENE = vsr.Scene(
    arm(),
    obstacles=[
        vsr.Plane((0.1, 0.2, 1.0), (0.0, 0.0, -0.1)),
        vsr.Sphere((0.2, 0.1, 0.1), 0.05),
        vsr.Cylinder(0.03, length=0.1, pose=vsr.pose((0.1, 0.2, 0.0), pointing="up")),
        vsr.Box((0.1, 0.06, 0.14), pose=vsr.pose((0.1, -0.2, 0.0)), rounding=0.01),
        vsr.Tube(vsr.Taper(0.04, 0.03), LINE),
        vsr.Field(Ellipsoid(jnp.array([0.02, 0.02, 0.03]), jnp.array([0.1, 0.1, 0.1]))),
    ],
)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "place"),
    [
        ("obstacles[0].normal", 0),
        ("obstacles[0].point", 2),
        ("obstacles[1].centre", 1),
        ("obstacles[2].radius", ()),
        ("obstacles[2].pose", (0, 3)),
        ("obstacles[3].size", 1),
        ("obstacles[3].rounding", ()),
        ("obstacles[4].line", (2, 1)),
        ("obstacles[4].radius.tip", ()),
        ("obstacles[5].function.axes", 0),
    ],
)
def test_derivatives_by_the_numbers_of_a_scene(name, place):
    i, value = int(name[10]), vsr.parameters(SCENE)[name].value
    point = jnp.array([0.16, -0.13, 0.085])

    @jax.jit
    def gap(x):
        return SCENE.replace(name, value.at[place].set(x)).obstacles[i].distance(point)

    x, step = value[place], 1e-5
    expected = central_differences(lambda u: gap(x + step * u[0]), 1)[0] / step
    assert abs(expected) > 1e-2
    np.testing.assert_allclose(jax.grad(gap)(x), expected, rtol=1e-6)
    np.testing.assert_allclose(jax.jvp(gap, (x,), (jnp.ones_like(x),))[1], expected, rtol=1e-6)
    several = x * jnp.array([0.9, 1.0, 1.1])
    np.testing.assert_allclose(jax.vmap(gap)(several), [gap(y) for y in several], rtol=1e-12)


def test_replaced_numbers_are_checked():
    assert SCENE.replace("obstacles[1].radius", 0.06).obstacles[1].radius == 0.06
    with pytest.raises(ValueError, match=r"^Scene.obstacles\[1\].radius: got 0, need"):
        SCENE.replace("obstacles[1].radius", 0.0)
    with pytest.raises(ValueError, match=r"^Scene.obstacles\[0\].normal: got 0, need"):
        SCENE.replace("obstacles[0].normal", 0.0)
    with pytest.raises(ValueError, match=r"^Scene.obstacles\[1\]: .* inside the sphere at X = 0 m"):
        SCENE.replace("obstacles[1].centre", (0.02, 0.05, 0.0))
    with pytest.raises(ValueError, match=r"^Scene.obstacles\[4\].radius: got 0.009 m"):
        SCENE.replace("obstacles[4].radius.tip", 0.009)


def depth_of(error):
    return float(str(error.value).split(" m ")[0].split()[-1])


def test_an_arm_may_cross_obstacles_at_rest_but_must_start_outside():
    vsr.Scene(arm(), obstacles=[vsr.Sphere((0.2, 0.0, 0.0), 0.05)])
    with pytest.raises(
        ValueError, match=r"obstacles\[1\]: .* inside the plane at X = 0 m"
    ) as error:
        vsr.Scene(arm(), obstacles=[vsr.Plane((0, 0, 1), (0, 0, -0.01)), vsr.Plane((0, 1, 0))])
    np.testing.assert_allclose(depth_of(error), 0.01, rtol=1e-6)
    # the arm touches
    vsr.Scene(arm(), obstacles=[vsr.Plane((0, 0, 1), (0, 0, -0.01))])


def test_an_arm_may_leave_a_tube_at_rest_but_must_start_in_it():
    vsr.Scene(arm(), obstacles=[vsr.Tube(0.02, LINE)])
    with pytest.raises(
        ValueError, match=r"obstacles\[0\]: .* outside the tube at X = 0 m"
    ) as error:
        vsr.Scene(arm(), obstacles=[vsr.Tube(0.02, LINE + np.array([0.0, 0.0, 0.015]))])
    assert 0.003 < depth_of(error) <= 0.005
    with pytest.raises(ValueError, match=r"got 0.015 m .* need more .* 0.02 m"):
        vsr.Scene(arm(discs=vsr.Discs(10, radius=0.02)), obstacles=[vsr.Tube(0.015)])


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: vsr.Plane((0, 0, 0)), "Plane.normal: got (0, 0, 0), need a direction, not zeros"),
        (lambda: vsr.Plane((0, 0)), "Plane.normal: got shape (2,), need finite numbers of shape"),
        (lambda: vsr.Sphere((0, 0, 0), 0.0), "Sphere.radius: got 0.0, need a finite number > 0"),
        (lambda: vsr.Sphere(0.0, 0.1), "Sphere.centre: got shape (), need finite numbers of shape"),
        (lambda: vsr.Cylinder(0.1, length=0), "Cylinder.length: got 0, need a finite number > 0"),
        (lambda: vsr.Cylinder(0.1, pose=np.zeros((4, 4))), "Cylinder.pose: got a last row of"),
        (lambda: vsr.Box((1, 1, 0)), "Box.size: got (1, 1, 0), need finite numbers of shape (3,)"),
        (lambda: vsr.Box((1, 1, 1), rounding=0.6), "Box.rounding: got 0.6, need a finite number"),
        (lambda: vsr.Tube(-1.0), "Tube.radius: got -1.0, need a finite number > 0"),
        (lambda: vsr.Tube(vsr.Taper(2, 1)), "Tube.radius: got Taper(base=2, tip=1) and no line"),
        (lambda: vsr.Tube(0.1, [[0, 0, 0]]), "Tube.line: got shape (1, 3), need (points, 3), two"),
        (lambda: vsr.Tube(0.1, np.zeros((2, 3))), "Tube.line: got the point [0.0, 0.0, 0.0] twice"),
        (lambda: vsr.Field(0.1), "Field.function: got 0.1, need a function of the position"),
        (lambda: vsr.Field(lambda r: r), "Field.function: got a function that returns shape (3,)"),
        (
            lambda: vsr.Field(lambda r: (r[0], r[1])),
            "Field.function: got a function that ret",
        ),
        (
            lambda: vsr.Scene(arm(), obstacles=[1]),
            "Scene.obstacles[0]: got 1, need a Plane",
        ),
    ],
)
def test_errors(make, message, unchecked):
    with pytest.raises(ValueError, match=f"^{re.escape(message)}") as error:
        make()
    assert "\n" not in str(error.value)


def test_scene_files():
    text = to_toml(vsr.Scene(arm(), obstacles=SCENE.obstacles[:5]))
    assert eqx.tree_equal(parse_scene(text).scene.obstacles, SCENE.obstacles[:5])
    with pytest.raises(ValueError, match=r"^obstacles\[5\]: a Field cannot be stored in a scene"):
        to_toml(SCENE)
    with pytest.raises(ValueError, match=r"^obstacles\[0\]: unknown type 'Spere', .* 'Sphere'\?$"):
        parse_scene(text.replace("Plane", "Spere"))


class Wall(Obstacle):
    """An obstacle of a user."""

    effect = "wall"

    def distance(self, point):
        return point[2] + 0.05


def test_an_obstacle_of_a_user():
    assert vsr.Scene(arm(), obstacles=Wall()).effects == ("wall",)
    with pytest.raises(ValueError, match=r"0\.06 m inside the wall at X = 0 m"):
        vsr.Scene(arm(base=vsr.pose((0, 0, -0.1))), obstacles=Wall())


@pytest.mark.slow
def test_drawn_surfaces_lie_on_the_obstacle(obstacle):
    points = np.array([[-0.1, -0.1, 0.0], [0.2, 0.1, 0.15]])
    polygons = polygons_of(obstacle, points)
    corners = np.concatenate(polygons)
    assert len(polygons) == 1 or np.min(np.ptp(corners, axis=0)) > 0.05
    region = Region(points)
    assert np.all((corners >= region.low - 1e-12) & (corners <= region.high + 1e-12))
    off = np.abs(distances(obstacle, corners))
    assert np.max(off) < 2e-3  # of corners within a facet that was clipped
    whole = np.all((corners > region.low + 1e-9) & (corners < region.high - 1e-9), axis=1)
    if getattr(obstacle, "line", None) is not None:  # without the ends, where the wall has kinks
        whole[:96] = whole[-96:] = False
    assert np.sum(whole) > 10 or isinstance(obstacle, vsr.Plane)
    assert np.max(off[whole], initial=0.0) < 1e-9


def test_a_large_obstacle_is_drawn_near_the_points():
    large = vsr.Sphere((0.0, 0.0, -50.0), 49.9)
    corners = np.concatenate(polygons_of(large, np.array([[-0.1, 0.0, 0.0], [0.1, 0.0, 0.1]])))
    assert np.max(np.abs(corners)) < 0.3
    np.testing.assert_allclose(corners[:, 2], -0.1, atol=2e-3)
    far = vsr.Sphere((0.0, 0.0, -50.0), 49.0)
    field = vsr.Field(Ellipsoid(jnp.full(3, 0.1), jnp.array([0.0, 0.0, 5.0])))
    for obstacle in (far, field):
        assert polygons_of(obstacle, np.array([[-0.1, 0.0, 0.0], [0.1, 0.0, 0.1]])) == []


def test_triangles_of_polygons_have_their_area():
    square = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], float)
    mesh = polygons([square, square[:3] + 2.0])
    a, b, c = np.moveaxis(mesh.vertices[mesh.triangles], 1, 0)
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2
    np.testing.assert_allclose(area, [0.5, 0.5, 0.5])
    assert polygons([]).triangles.shape == (0, 3)


def test_a_workspace_among_obstacles():
    tips = np.random.default_rng(0).normal(scale=0.05, size=(200, 3))
    bare, among = (
        plot.workspace(tips, obstacles=obstacles) for obstacles in ((), SCENE.obstacles[:5])
    )
    added = [len(b.collections) - len(a.collections) for a, b in zip(bare, among, strict=True)]
    assert added == [5, 5, 5, 5]
    plt.close("all")


@pytest.mark.slow
def test_arms_and_films_among_obstacles(tmp_path):
    """Each obstacle is one more collection; none without details."""
    model = vsr.StrainDependent(4)
    scenes = [vsr.Scene(arm(), obstacles=obstacles) for obstacles in ((), SCENE.obstacles[:3])]
    bare, among = (vsr.solve(scene, [], model=model) for scene in scenes)

    def count(ax):
        number = len(ax.collections)
        plt.close(ax.figure)
        return number

    assert count(plot.arm(among)) - count(plot.arm(bare)) == 3
    given = plot.arm(bare)
    assert count(plot.arm(among, details=False)) == count(plot.arm(bare, details=False))
    before = len(given.collections)
    assert len(annotate.obstacles(among, given).collections) == before + 3
    counts = []
    for name, eq in (("bare", bare), ("among", among)):
        film = vsr.film([eq, eq], tmp_path / f"{name}.gif", dpi=20)
        counts.append(len(film._fig.axes[0].collections))
    assert counts[1] - counts[0] == 3
    plt.close("all")
