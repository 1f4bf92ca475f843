"""Arms in contact against solutions found by SciPy, where nothing of the package is used: shooting
along the elastica and along a rod in space, and the least energy of straight pieces with hinges
between them, whose joints must not pass a wall."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.interpolate import CubicSpline
from scipy.optimize import fsolve, minimize

import vsr_jax as vsr

L, RADIUS, YOUNG = 0.2, 0.001, 5e7
EI = YOUNG * np.pi * RADIUS**4 / 4


def arm(load, obstacle, start=None):
    rod = vsr.Rod(L, vsr.Circular(RADIUS), vsr.Material(YOUNG, poisson=0.4))
    scene = vsr.Scene(
        rod, (), [vsr.TipWrench(force=load)], obstacles=obstacle, free_strains=("bending_y",)
    )
    model = vsr.StrainDependent(24)
    return vsr.solve(scene, jnp.zeros(0), model=model, start=start, throw=True)


def minimum(load, gaps, start):
    """Joints (n, 2) in the plane of x and z, and the forces on them, where the energy is least.

    `gaps` maps joints to gaps and their gradients, `start` are the angles of the pieces."""
    h, pieces = L / len(start), len(start)
    stiffness = np.full(pieces, EI / h)
    stiffness[0] *= 2  # from the clamp to the middle of the first piece
    sums = np.tri(pieces) * h

    def joints(angles):
        return np.stack([sums @ np.cos(angles), sums @ np.sin(angles)], 1)

    def moved(angles):
        """Derivatives of the joints by the angles."""
        return -sums * np.sin(angles), sums * np.cos(angles)

    def energy(angles):
        bent = np.diff(angles, prepend=0.0)
        end = joints(angles)[-1]
        value = 0.5 * stiffness @ bent**2 - load @ end
        pull = stiffness * bent
        slope = pull - np.append(pull[1:], 0.0)
        x, z = moved(angles)
        return value / EI, (slope - load[0] * x[-1] - load[1] * z[-1]) / EI

    def room(angles):
        return gaps(joints(angles))[0] / L

    def room_slope(angles):
        _, gradient = gaps(joints(angles))
        x, z = moved(angles)
        return (gradient[:, :1] * x + gradient[:, 1:] * z) / L

    found = minimize(
        energy,
        start,
        jac=True,
        method="SLSQP",
        constraints={"type": "ineq", "fun": room, "jac": room_slope},
        options={"maxiter": 500, "ftol": 1e-13},
    )
    assert found.success, found.message
    return joints(found.x)


def axis(eq, pieces):
    """Positions of the joints of an equilibrium in the plane."""
    return np.asarray(eq.position(jnp.linspace(0, L, pieces + 1)[1:]))[:, [0, 2]]


def leaning(load, centre, radius, first):
    r"""Tip of an arm that touches a pillar, place and size of the contact force, by shooting:
    $EI \theta'' = F_x \sin\theta - F_z \cos\theta$ with the force F beyond each section, which the
    contact changes; the tip is free of moments. All in units of EI.

    `first`: curvature at the base, place, force and direction of the contact to begin with."""

    def piece(force, start, end, state):
        def slope(_, y):
            turn = force[0] * np.sin(y[0]) - force[1] * np.cos(y[0])
            return [y[1], turn, np.cos(y[0]), np.sin(y[0])]

        return solve_ivp(slope, (start, end), state, rtol=1e-11, atol=1e-13).y[:, -1]

    def misses(unknown):
        """Of curvature at the base, place, force and direction of the contact."""
        bend, place, push, angle = unknown
        normal = np.array([np.cos(angle), np.sin(angle)])
        there = piece(load + push * normal, 0.0, place, [0.0, bend, 0.0, 0.0])
        tip = piece(load, place, L, there)
        apart = (there[2:] - centre - (radius + RADIUS) * normal) / L
        slides = normal @ [np.cos(there[0]), np.sin(there[0])]
        return [*apart, slides, tip[1] * L], tip[2:]

    unknown = fsolve(lambda u: misses(u)[0], first, xtol=1e-13)
    assert np.abs(misses(unknown)[0]).max() < 1e-10
    return misses(unknown)[1], unknown[1], unknown[2]


def pillar(centre, radius):
    return vsr.Cylinder(radius, pose=vsr.pose((centre[0], 0, centre[1]), pointing=(0.0, 1.0, 0.0)))


def assert_leans(eq, tip, place, push):
    contacts = eq.contacts
    at = int(contacts.force[0].argmax())
    np.testing.assert_allclose(eq.tip[[0, 2], 3], tip, atol=1e-6 * L)
    np.testing.assert_allclose(contacts.X[0, at], place, atol=5e-6 * L)
    np.testing.assert_allclose(contacts.force.sum(), push * EI, rtol=1e-5)


@pytest.mark.slow
def test_an_arm_that_leans_on_a_pillar():
    load, centre, radius = np.array([0.0, -2.0]) / L**2, np.array([0.08, -0.012]), 0.01
    found = leaning(load, centre, radius, [5.0, 0.4 * L, 6 / L**2, np.pi / 2])
    assert_leans(arm((0.0, 0.0, load[1] * EI), pillar(centre, radius)), *found)


@pytest.mark.slow
@pytest.mark.parametrize("side", [1.0, -1.0])
def test_an_arm_is_pushed_out_of_a_pillar_to_the_side_where_it_starts(side):
    """From rest, where it crosses the pillar, to the nearer side; from a `start` to that of it."""
    near, far, none = np.array([0.1, -0.001 * side]), np.array([0.1, 0.002 * side]), np.zeros(2)
    first = [side * 2.0, 0.5 * L, 2.0 / L**2, side * np.pi / 2]
    pushed = arm((0.0, 0.0, 0.0), pillar(near, 0.01))
    assert_leans(pushed, *leaning(none, near, 0.01, first))
    start = arm((0.0, 0.0, 0.0), pillar(far, 0.01), pushed)
    assert_leans(start, *leaning(none, far, 0.01, first))


@pytest.mark.slow
@pytest.mark.parametrize("steps", [12, 24])
def test_a_thick_arm_that_slides_along_a_cylinder(steps):
    """A chamber presses a hanging arm, with long steps, onto a cylinder in its way. Tips of the
    least energy (SciPy's SLSQP) of 44 pieces of constant strain, whose ends and middles may not
    pass the cylinder: with twice as many they change by 3e-5 m at most."""
    radius, ends, pressures = 0.0211, [0.033, 0.143], jnp.linspace(0.0, 1e5, 41)
    young = vsr.Piecewise(ends, [3.2e5, 173480.0, 3.2e5])
    rod = vsr.Rod(
        0.155,
        vsr.Annular(radius, 0.0035),
        vsr.Material(young, poisson=0.5, density=1080.0),
        rigid=[vsr.RigidPiece(end=0.023), vsr.RigidPiece(start=0.153)],
        base=vsr.pose(pointing="down"),
    )
    chamber = vsr.Chamber(vsr.Parallel(0.0, -0.012), 1.487e-4, start=ends[0], end=ends[1])
    across = vsr.pose((0.054164, 0.018809, -0.122), pointing=(1.0, -1.0, 0.0))
    scene = vsr.Scene(rod, chamber, vsr.Gravity(), obstacles=vsr.Cylinder(0.03, pose=across))

    @jax.jit
    @jax.vmap
    def pressed(pressure):
        eq = vsr.solve(scene, pressure[None], model=vsr.StrainDependent(steps))
        return eq.status, eq.loosened, eq.tip[:3, 3]

    status, loosened, tip = pressed(pressures)
    assert np.all(status == vsr.Status.CONVERGED)
    assert not np.any(loosened)
    np.testing.assert_allclose(tip[26], [0.018043, -0.010416, -0.157396], atol=5e-5)
    np.testing.assert_allclose(tip[28], [0.019336, -0.011289, -0.157346], atol=5e-5)


@pytest.mark.slow
def test_a_curved_arm_on_a_ball_in_space():
    r"""Against shooting along a rod that bends and twists: $m' = f \times r'$ with the force f
    beyond each section, $R' = R \hat k$ and $k = K^{-1} R^T m + k_0$. Unknown are the moment at
    the base and the place, force and normal of the contact, where the axis is at the distance of
    both radii from the centre and at right angles to the normal."""
    load, moment = np.array([0.0, 2.0, -3.0]), np.array([0.6, 0.0, 0.0])
    centre, radius = np.array([0.55, 0.1, -0.02]), 0.15
    poisson, rest = 0.4, np.array([0.0, -1.0, 0.0])
    stiffness = np.array([1 / (1 + poisson), 1.0, 1.0])

    def piece(force, start, end, state):
        def slope(_, y):
            R = y[:9].reshape(3, 3)
            k = R.T @ y[12:] / stiffness + rest
            turn = np.cross(R, k)  # the rows of R times the skew matrix of k
            return np.concatenate([turn.ravel(), R[:, 0], np.cross(force, R[:, 0])])

        return solve_ivp(slope, (start, end), state, rtol=1e-11, atol=1e-13).y[:, -1]

    def misses(unknown):
        """Of the moment at the base, place, force and normal of the contact; and the tip."""
        place, push, normal = unknown[3], unknown[4], unknown[5:]
        base = np.concatenate([np.eye(3).ravel(), np.zeros(3), unknown[:3]])
        there = piece(load + push * normal, 0.0, place, base)
        tip = piece(load, place, 1.0, there)
        apart = there[9:12] - centre - (radius + RADIUS / L) * normal
        slides = normal @ there[[0, 3, 6]]
        return np.array([*apart, slides, *(tip[12:] - moment), normal @ normal - 1]), tip

    first = [-0.36, 2.5, 1.7, 0.5, 0.12, -0.6, 0.4, -0.7]
    unknown = fsolve(lambda u: misses(u)[0], first, xtol=1e-13)
    miss, tip = misses(unknown)
    assert np.abs(miss).max() < 1e-10
    material = vsr.Material(YOUNG, poisson=poisson)
    scene = vsr.Scene(
        vsr.Rod(L, vsr.Circular(RADIUS), material, rest_strain=(0, rest[1] / L, 0, 1, 0, 0)),
        loads=[vsr.TipWrench(load * EI / L**2, moment * EI / L)],
        obstacles=vsr.Sphere(centre * L, radius * L),
        free_strains=("torsion", "bending_y", "bending_z"),
    )
    eq = vsr.solve(scene, jnp.zeros(0), model=vsr.StrainDependent(12), throw=True)
    force = np.asarray(eq.contacts.force[0])
    at = int(force.argmax())
    np.testing.assert_allclose(eq.tip[:3, 3] / L, tip[9:12], atol=1e-7)
    np.testing.assert_allclose(eq.tip[:3, :3], tip[:9].reshape(3, 3), atol=1e-7)
    np.testing.assert_allclose(eq.contacts.X[0, at] / L, unknown[3], atol=1e-6)
    np.testing.assert_allclose(force.sum() * L**2 / EI, unknown[4], rtol=1e-5)
    np.testing.assert_allclose(eq.contacts.normal[0, at], unknown[5:], atol=1e-5)
    # the arm leaves its plane by the load, the contact and its torsion
    assert abs(tip[10]) > 0.4
    assert np.ptp(eq.strain(np.linspace(0, L, 9))[:, 0]) * L > 1


@pytest.mark.slow
def test_an_arm_in_a_bent_tube():
    width = 0.003
    turn = np.linspace(0, 1.2, 6)
    line = np.concatenate(
        [
            [[0.0, 0.0], [0.03, 0.0]],
            np.stack([0.06 + 0.1 * np.sin(turn), 0.1 - 0.1 * np.cos(turn)], 1),
            [[0.06 + 0.1 * np.sin(1.2) + d * np.cos(1.2), 0.1 - 0.1 * np.cos(1.2) + d * np.sin(1.2)]
             for d in (0.04, 0.08)],
        ]
    )  # fmt: skip
    along = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(line, axis=0), axis=1)))
    middle = CubicSpline(along, line)(np.linspace(0, along[-1], 1001))

    def gaps(p):
        """From the nearest of many chords of the middle line."""
        apart = p[:, None] - middle[:-1]
        chords = np.diff(middle, axis=0)
        share = np.clip(np.sum(apart * chords, 2) / np.sum(chords**2, 1), 0, 1)
        away = apart - share[..., None] * chords
        far = np.linalg.norm(away, axis=2)
        at = np.argmin(far, axis=1)
        rows = np.arange(len(p))
        off, size = away[rows, at], far[rows, at]
        return width - RADIUS - size, -off / np.maximum(size, 1e-12)[:, None]

    tube = vsr.Tube(width, line=np.insert(line, 1, 0.0, axis=1))
    eq = arm((0.0, 0.0, 0.0), tube)
    # pieces along the middle line, to begin with
    lengths = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(middle, axis=0), axis=1)))
    ends = np.stack([np.interp(np.linspace(0, L, 101), lengths, m) for m in middle.T], 1)
    start = np.arctan2(*np.diff(ends, axis=0).T[::-1])
    joints = minimum(np.zeros(2), gaps, start)
    assert int((eq.contacts.force > 0.1 * EI / L**2).sum()) >= 2
    np.testing.assert_allclose(axis(eq, 100), joints, atol=2e-4 * L)
    # no wall, of the spline through the same points, is passed by more than is stated
    assert (
        gaps(np.asarray(eq.position(jnp.linspace(0, L, 401)))[:, [0, 2]])[0].min() > -2e-3 * RADIUS
    )
