"""Classical problems of rod theory, each against its closed form, an independent integration by
SciPy, or published tables.

Lengths, bending stiffness and weight per length are 1 unless a problem brings its own numbers, so
that loads are the dimensionless parameters of the literature. Planar problems bend in the xy-plane;
`theta` is the tangent's angle with x. Rods with `BENDING` alone are the inextensible and
unshearable elastica; those with `FULL` have all six strains.
"""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import integrate, optimize, special

import vsr_jax as vsr

MODEL = vsr.StrainDependent(steps=64, order=6)
STATIONS = np.linspace(0, 1, 11)
BENDING = ("bending_z",)
FULL = ("torsion", "bending_y", "bending_z", "elongation", "shear_y", "shear_z")


# -------------------------------------------------------------------------------------------------
# The library. Three scene structures serve all problems, so that the file compiles three solves and
# one margin of stability.


def square_rod(
    side=1.0, *, young=None, torsion_constant=None, kappa=1.0, length=1.0, curvature=0.0
):
    """A rod of square section with G = E / 2; bending stiffness 1 unless `young` is given, weight 1
    per length at unit gravity.

    GJ takes the polar moment, or the `torsion_constant` given: G is then scaled by it, and `kappa`
    so that kappa GA stays.
    """
    side = float(side)  # a weak type, as for plain numbers, and so the same compiled solve
    young = 12 / side**4 if young is None else young
    part = 1.0 if torsion_constant is None else torsion_constant / (side**4 / 6)
    section = vsr.Rectangular(side, side, torsion="polar", shear_correction=kappa / part)
    material = vsr.Material(young, shear=young / 2 * part, density=1 / side**2)
    return vsr.Rod(length, section, material, rest_strain=(0.0, 0.0, curvature, 1.0, 0.0, 0.0))


def dead(
    rod, *, force=(0.0, 0.0, 0.0), moment=(0.0, 0.0, 0.0), gravity=(0.0, 0.0, 0.0), free=BENDING
):
    loads = [
        vsr.TipWrench(force=force, moment=moment, frame="world"),
        vsr.Gravity(acceleration=gravity),
    ]
    return vsr.Scene(rod, [], loads=loads, free_strains=free)


def follower(rod, *, force=(0.0, 0.0, 0.0), moment=(0.0, 0.0, 0.0)):
    return vsr.Scene(
        rod,
        [],
        loads=[vsr.TipWrench(force=force, moment=moment, frame="body")],
        free_strains=BENDING,
    )


@eqx.filter_jit
def _solve(scene):
    """The equilibrium, and the poses at the stations for dead loads in the plane, at the end alone
    for the others."""
    eq = vsr.solve(scene, jnp.zeros(0), model=MODEL)
    whole = scene.free_strains == BENDING and scene.loads[0].frame == "world"
    return eq, eq.pose(STATIONS) if whole else eq.tip[None]


class Solved:
    """An equilibrium with what the tests ask of it as NumPy arrays: positions, the tangent's angle
    in the xy-plane, the end."""

    def __init__(self, scene):
        self.equilibrium, poses = _solve(scene)
        poses = np.asarray(poses)
        self.status = vsr.Status(int(self.equilibrium.status))
        self.position, self.tip = poses[:, :3, 3], poses[-1, :3, 3]
        self.angle = np.unwrap(np.arctan2(poses[:, 1, 0], poses[:, 0, 0]))

    @property
    def stability(self):
        return float(self.equilibrium.stability)


# -------------------------------------------------------------------------------------------------
# References


def elastica(load, s):
    """x, y and angle at s of a cantilever under a dead transverse force `load` = F L^2 / EI, by
    elliptic integrals.

    With theta' ^2 = 2 load (sin theta_L - sin theta) and 1 + sin theta = 2 p^2 sin^2 phi the length
    becomes an elliptic integral of modulus p: sqrt(load) s = F(phi) - F(phi_0), where sin phi_0 = 1
    / (p sqrt 2). Bisshopp & Drucker, Quart. Appl. Math. 3 (1945).
    """

    def lower_end(p):
        return np.arcsin(1 / (p * np.sqrt(2)))

    def length(p):
        return special.ellipk(p**2) - special.ellipkinc(lower_end(p), p**2)

    p = optimize.brentq(
        lambda p: length(p) - np.sqrt(load), np.sqrt(0.5) + 1e-15, 1 - 1e-15, xtol=1e-16, rtol=1e-15
    )
    m, phi_0, root = p**2, lower_end(p), np.sqrt(load)
    phi = special.ellipj(special.ellipkinc(phi_0, m) + root * s, m)[3]
    x = 2 * p / root * (np.cos(phi_0) - np.cos(phi))
    y = s - 2 / root * (special.ellipeinc(phi, m) - special.ellipeinc(phi_0, m))
    return x, y, np.arcsin(np.clip(2 * m * np.sin(phi) ** 2 - 1, -1, 1))


def reissner_tip(load, stretch, shear):
    """Tip (x, y) of a cantilever that stretches and shears, compliances `stretch` = EI / EA L^2 and
    `shear` = EI / GA L^2.

    E. Reissner, J. Appl. Math. Phys. 23 (1972): theta'' = -load x', x' = (1 + N stretch) cos theta
    - Q shear sin theta, likewise y', with N = load sin theta and Q = load cos theta. Integrated
    from the tip, where only the angle is unknown.
    """

    def rate(_, state):
        angle, curvature = state[:2]
        along, across = 1 + load * np.sin(angle) * stretch, load * np.cos(angle) * shear
        dx = along * np.cos(angle) - across * np.sin(angle)
        return [curvature, -load * dx, dx, along * np.sin(angle) + across * np.cos(angle)]

    def base(tip_angle):
        return integrate.solve_ivp(
            rate, (1, 0), [tip_angle, 0, 0, 0], method="DOP853", rtol=1e-13, atol=1e-14
        ).y[:, -1]

    tip_angle = optimize.brentq(lambda angle: base(angle)[0], 0, np.pi / 2, xtol=1e-14)
    return -base(tip_angle)[2:]


def follower_elastica(load):
    """x, y and angle of the end of a cantilever under a transverse force `load` = P L^2 / EI that
    follows it.

    Seen from the end the force keeps its direction: with psi = pi/2 + theta - theta_L and t the
    distance from the end, psi'' = -load sin psi, psi = pi/2 and psi' = 0 at t = 0. This is the
    pendulum let go from the horizontal, sin(psi/2) = k sn(sqrt(load) t + K), k^2 = 1/2; the
    position is its first integrals. No unknown is left.
    """
    m, root = 0.5, np.sqrt(load)
    sn, cn, _, amplitude = special.ellipj(root + special.ellipk(m), m)
    angle = np.pi / 2 - 2 * np.arcsin(np.sqrt(m) * sn)
    along = -2 * np.sqrt(m) / root * cn  # int sin psi dt = -psi' / load
    across = 1 - 2 / root * (special.ellipeinc(amplitude, m) - special.ellipe(m))  # -int cos psi dt
    return (
        along * np.cos(angle) - across * np.sin(angle),
        along * np.sin(angle) + across * np.cos(angle),
        angle,
    )


def heavy_elastica(weight, s):
    """x, y and angle at s of a cantilever, horizontal at its clamp, under its own `weight` = rho A
    g L^3 / EI.

    phi = theta + pi/2, the angle with the vertical, obeys phi'' = weight t sin phi, t the distance
    from the free end, with phi' = 0 there (Rohde, Quart. Appl. Math. 11, 1953; Wang, Int. J. Mech.
    Sci. 28, 1986). It is integrated from the end, where phi is tiny for a heavy rod: the linear
    equation, solved by Airy functions, grows faster, so it bounds phi there from below.
    """
    ai, _, bi, _ = special.airy(weight ** (1 / 3))
    ai_0, _, bi_0, _ = special.airy(0.0)
    least = np.pi / 2 * (np.sqrt(3) * ai_0 + bi_0) / (np.sqrt(3) * ai + bi)

    def rate(t, state):
        return [state[1], weight * t * np.sin(state[0]), -np.sin(state[0]), np.cos(state[0])]

    def from_the_end(logarithm):
        start = [np.exp(logarithm), 0, 0, 0]
        return integrate.solve_ivp(
            rate, (0, 1), start, method="DOP853", rtol=3e-14, atol=1e-18, dense_output=True
        ).sol

    bracket = np.log(least) - 1e-9, min(np.log(3 * least), np.log(np.pi / 2))
    sol = from_the_end(
        optimize.brentq(
            lambda logarithm: from_the_end(logarithm)(1.0)[0] - np.pi / 2, *bracket, xtol=1e-14
        )
    )
    (phi, _, x, y), (_, _, x_0, y_0) = sol(1 - s), sol(1.0)
    return x - x_0, y - y_0, phi - np.pi / 2


def bent_tip(force, torsion_constant, guess):
    """Tip of Bathe and Bolourchi's bend under a force along z, and the moment at its base, by
    shooting on that moment."""
    E, G, load = 1e7, 5e6, np.array([0.0, 0.0, force])
    bending, stretching = (
        1 / np.array([G * torsion_constant, E / 12, E / 12]),
        1 / np.array([E, G, G]),
    )

    def rate(_, state):
        R, moment = state[:9].reshape(3, 3), state[12:]
        k = bending * (R.T @ moment) + [0, 0, 0.01]
        dr = R @ (stretching * (R.T @ load) + [1, 0, 0])
        return np.concatenate([np.cross(R, k).ravel(), dr, np.cross(load, dr)])

    def tip(moment):
        start = np.concatenate([np.eye(3).ravel(), np.zeros(3), moment])
        return integrate.solve_ivp(
            rate, (0, 25 * np.pi), start, method="DOP853", rtol=1e-11, atol=1e-11
        ).y[:, -1]

    base = optimize.root(lambda moment: tip(moment)[12:], guess, tol=1e-12).x
    return tip(base)[9:12], base


# -------------------------------------------------------------------------------------------------
# A dead force across the end


MATTIASSON = {
    1.0: (0.05643, 0.30172, 0.46135),
    2.0: (0.16064, 0.49346, 0.78175),
    5.0: (0.38763, 0.71379, 1.21537),
    10.0: (0.555, 0.81061, 1.43029),
}
"""Shortening, deflection and angle of the end by load F L^2 / EI: K. Mattiasson, Int. J. Numer.
Meth. Eng. 17 (1981), to five digits."""


@pytest.mark.slow
@pytest.mark.parametrize("load", [0.1, 1.0, 2.0, 5.0, 10.0])
def test_elastica_under_a_dead_force_is_bisshopp_and_druckers(load):
    """Whole shape by elliptic integrals (Bisshopp & Drucker 1945), end as in Mattiasson's table of
    1981."""
    solved = Solved(dead(square_rod(), force=(0.0, load, 0.0)))
    x, y, angle = elastica(load, STATIONS)
    np.testing.assert_allclose(solved.position, np.stack([x, y, 0 * x], axis=1), atol=1e-10)
    np.testing.assert_allclose(solved.angle, angle, atol=1e-10)
    if load in MATTIASSON:
        np.testing.assert_allclose(
            (1 - solved.tip[0], solved.tip[1], solved.angle[-1]), MATTIASSON[load], atol=6e-6
        )


@pytest.mark.slow
def test_slender_rod_with_all_strains_tends_to_the_elastica_with_the_square_of_its_thickness():
    """EI / EA L^2 and EI / GA L^2 go with the square of thickness over length, and so must the
    distance from Bisshopp & Drucker's tip."""
    sides, load = np.array([0.04, 0.02, 0.01]), 10.0
    x, y, _ = elastica(load, np.ones(1))
    tips = np.array(
        [Solved(dead(square_rod(side), force=(0.0, load, 0.0), free=FULL)).tip for side in sides]
    )
    distance = np.linalg.norm(tips - [x[0], y[0], 0], axis=1)
    np.testing.assert_allclose(np.diff(np.log(distance)) / np.diff(np.log(sides)), 2, atol=0.01)
    assert distance[-1] < load * sides[-1] ** 2


@pytest.mark.parametrize("load", [1.0, 10.0])
def test_stout_rod_is_reissners(load):
    """A rod five times as long as thick, kappa = 5/6, against Reissner's finite-strain beam (1972)
    integrated from its end."""
    side, kappa = 0.2, 5 / 6
    solved = Solved(dead(square_rod(side, kappa=kappa), force=(0.0, load, 0.0), free=FULL))
    expected = reissner_tip(load, side**2 / 12, side**2 / 6 / kappa)
    np.testing.assert_allclose(solved.tip, [*expected, 0], atol=1e-10)
    assert (
        np.linalg.norm(expected - np.ravel(elastica(load, np.ones(1))[:2])) > 1e-3
    )  # and the elastica is another rod


def test_small_loads_meet_timoshenkos_beam_with_an_error_of_second_order():
    """Deflection F L^3 / 3EI + F L / kappa GA (Timoshenko 1921), and how the finite rod leaves it.

    The deflection is odd in F, so its relative deviation has slope 2 against the load. Reissner's
    equations expanded to F^3 give y = a (1/3 + c) - a^3 (4/105 - 4/15 (b - c)) with a = F L^2 / EI,
    b = EI / EA L^2 and c = EI / kappa GA L^2.
    """
    side, kappa = 0.2, 5 / 6
    b, c = side**2 / 12, side**2 / 6 / kappa
    loads = np.array([0.02, 0.04, 0.08])
    y = np.array(
        [
            Solved(dead(square_rod(side, kappa=kappa), force=(0.0, F, 0.0), free=FULL)).tip[1]
            for F in loads
        ]
    )
    beam = loads * (1 / 3 + c)
    deviation = (beam - y) / beam
    np.testing.assert_allclose(np.diff(np.log(deviation)) / np.diff(np.log(loads)), 2, atol=0.01)
    coefficient = (4 / 105 - 4 / 15 * (b - c)) / (1 / 3 + c)
    np.testing.assert_allclose(deviation / loads**2, coefficient, rtol=0.01)
    assert abs(deviation[0] / loads[0] ** 2 / coefficient - 1) < 1e-3


# -------------------------------------------------------------------------------------------------
# An end moment


@pytest.mark.parametrize("turns", [0.5, 1.0, 2.0])
@pytest.mark.parametrize("kind", [dead, follower])
def test_end_moment_rolls_a_cantilever_into_circles(kind, turns):
    """M = 2 pi n EI / L gives curvature M / EI, hence n circles (Euler 1744); at whole n the end is
    back at the base.

    In the plane a moment kept in the world frame and one that turns with the end are the same.
    """
    moment = 2 * np.pi * turns
    solved = Solved(kind(square_rod(), moment=(0.0, 0.0, moment)))
    angle = moment * STATIONS
    circle = np.stack([np.sin(angle), 1 - np.cos(angle), 0 * angle], axis=1) / moment
    np.testing.assert_allclose(solved.position, circle[-len(solved.position) :], atol=1e-12)
    np.testing.assert_allclose(
        np.exp(1j * solved.angle), np.exp(1j * angle[-len(solved.angle) :]), atol=1e-11
    )
    assert turns % 1 or np.linalg.norm(solved.tip) < 1e-12


# -------------------------------------------------------------------------------------------------
# Buckling


EULER = np.pi**2 / 4
GREENHILL = 9 / 4 * optimize.brentq(lambda z: special.jv(-1 / 3, z), 1.5, 2.2, xtol=1e-15) ** 2
"""Weight rho A g L^3 / EI at which an upright column bends over: 7.8373, from the first zero of
J_-1/3 (A. G. Greenhill 1881)."""


@pytest.mark.parametrize("part", [-1.0, 0.5, 0.9, 0.99])
def test_thrust_magnifies_the_deflection_of_a_column(part):
    """A small force Q across a column under thrust P deflects it by Q (tan u / u - 1) / P, u^2 = P
    L^2 / EI (Timoshenko & Gere, ch. 1).

    The factor grows without bound towards Euler's P = pi^2 EI / 4 L^2; a pull (P < 0) has tanh for
    tan.
    """
    thrust, small = (
        part * EULER,
        3e-5 * (1 - part),
    )  # which deflects by 1e-5, small enough to be linear
    solved = Solved(dead(square_rod(), force=(-thrust, small, 0.0)))
    u = np.sqrt(abs(thrust))
    factor = (np.tan(u) / u - 1 if thrust > 0 else np.tanh(u) / u - 1) / thrust
    np.testing.assert_allclose(solved.tip[1], small * factor, rtol=3e-7)


def test_southwell_plot_gives_eulers_load():
    """Deflection y times thrust P against y is a line of slope P_cr (R. V. Southwell, Proc. R. Soc.
    A 135, 1932).

    y (1 - P / P_cr) is constant, exactly so for an imperfection in the shape of the buckling mode.
    A force across the end brings higher modes, whose share of y dies out as 1 - P / P_cr: between
    0.98 and 0.99 of P_cr the slope is 3.2e-6 of P_cr above it.
    """
    thrust = np.array([0.98, 0.99]) * EULER
    y = np.array([Solved(dead(square_rod(), force=(-P, 1e-7, 0.0))).tip[1] for P in thrust])
    np.testing.assert_allclose(np.diff(thrust * y) / np.diff(y), EULER, rtol=1e-5)


@pytest.mark.parametrize(("side", "free"), [(1.0, BENDING), (0.05, FULL), (0.2, FULL)])
def test_straight_column_is_stable_up_to_the_critical_thrust(side, free):
    """Euler's load for the elastica; P (1 - P / EA + P / GA) = pi^2 EI / 4 L^2 for a rod that
    shortens and shears (Reissner 1972)."""
    difference = 0.0 if free == BENDING else side**2 / 6 - side**2 / 12
    critical = (
        EULER if difference == 0 else (np.sqrt(1 + 4 * difference * EULER) - 1) / (2 * difference)
    )

    def column(part):
        return Solved(dead(square_rod(side), force=(-part * critical, 0.0, 0.0), free=free))

    below, above = column(0.9999), column(1.0001)
    assert below.status == vsr.Status.CONVERGED
    assert above.status == vsr.Status.UNSTABLE
    assert np.all(np.isnan(above.position))
    np.testing.assert_allclose(
        below.tip,
        [1 - (0 if free == BENDING else 0.9999 * critical * side**2 / 12), 0, 0],
        atol=1e-12,
    )


def test_margin_of_the_column_is_what_is_left_of_eulers_load():
    """Second variation over elastic energy: 1 - P / P_cr."""
    for part in (0.0, 0.25, 0.5, 0.9, 0.9999):
        np.testing.assert_allclose(
            Solved(dead(square_rod(), force=(-part * EULER, 0.0, 0.0))).stability,
            1 - part,
            atol=1e-10,
        )


def test_upright_column_stands_up_to_greenhills_weight():
    assert abs(GREENHILL - 7.8373) < 5e-5
    below, above = (
        Solved(dead(square_rod(), gravity=(-part * GREENHILL, 0.0, 0.0)))
        for part in (0.9999, 1.0001)
    )
    assert below.status == vsr.Status.CONVERGED
    assert above.status == vsr.Status.UNSTABLE
    np.testing.assert_allclose(below.stability, 1e-4, atol=1e-9)


# -------------------------------------------------------------------------------------------------
# Its own weight


@pytest.mark.parametrize(
    ("weight", "atol"), [(1.0, 1e-11), (10.0, 1e-11), (100.0, 1e-9), (1000.0, 1e-7)]
)
def test_heavy_elastica_hangs_from_its_clamp(weight, atol):
    """Whole shape against Rohde's equation (1953). Heavy rods hang like chains from a boundary
    layer of length weight^-1/2."""
    solved = Solved(dead(square_rod(), gravity=(0.0, -weight, 0.0)))
    x, y, angle = heavy_elastica(weight, STATIONS)
    np.testing.assert_allclose(solved.position, np.stack([x, y, 0 * x], axis=1), atol=atol)
    np.testing.assert_allclose(solved.angle, angle, atol=10 * atol)


def test_hanging_rod_stretches_by_half_its_weight():
    """rho g L^2 / 2E at the end of a rod that hangs straight down; nothing else moves."""
    side, weight = 0.2, 5.0
    solved = Solved(dead(square_rod(side), gravity=(weight, 0.0, 0.0), free=FULL))
    np.testing.assert_allclose(solved.tip, [1 + weight * side**2 / 12 / 2, 0, 0], atol=1e-13)


# -------------------------------------------------------------------------------------------------
# Bathe and Bolourchi's bend


BEND = {
    ("Bathe & Bolourchi 1979", "polar"): {300: (59.2, 22.5, 39.5), 600: (47.2, 15.9, 53.4)},
    ("Simo & Vu-Quoc 1986", "polar"): {
        300: (58.84, 22.33, 40.08),
        450: (52.32, 18.62, 48.39),
        600: (47.23, 15.79, 53.37),
    },
    ("Cardona & Geradin 1988", None): {
        300: (58.64, 22.14, 40.35),
        450: (52.11, 18.38, 48.59),
        600: (47.04, 15.55, 53.50),
    },
    ("Crisfield 1990", "saint_venant"): {
        300: (58.53, 22.16, 40.53),
        450: (51.93, 18.43, 48.79),
        600: (46.84, 15.61, 53.71),
    },
    ("Ibrahimbegovic 1995", "saint_venant"): {600: (46.897, 15.560, 53.605)},
    ("Longva 2015", "saint_venant"): {
        300: (58.56, 22.18, 40.47),
        450: (51.99, 18.45, 48.72),
        600: (46.91, 15.65, 53.64),
    },
}
"""Published tips (x along the tangent at the clamp, y towards the centre, z along the force) and
the torsion constant they fit."""

TORSION = {"polar": 1 / 6, "saint_venant": 0.140577014955}
"""Torsion constant of the unit square: its polar moment, and Saint-Venant's (Timoshenko & Goodier,
art. 109)."""


@pytest.fixture(scope="module")
def bends():
    """Tips by torsion constant and force: the library's and those of `bent_tip`."""
    found = {}
    for torsion, constant in TORSION.items():
        rod, moment = (
            square_rod(young=1e7, length=25 * np.pi, curvature=0.01, torsion_constant=constant),
            np.zeros(3),
        )
        for force in (300, 450, 600):
            expected, moment = bent_tip(force, constant, moment)
            found[torsion, force] = (
                Solved(dead(rod, force=(0.0, 0.0, force), free=FULL)).tip,
                expected,
            )
    return found


class TestBend:
    """An eighth of a circle of radius 100, clamped, pulled out of its plane at the end; unit
    square, E = 1e7, G = 5e6.

    K.-J. Bathe & S. Bolourchi, Int. J. Numer. Meth. Eng. 14 (1979). The published tips, quoted here
    as later authors quote them, differ by up to 1.0 at force 300 and 0.4 at 450 and 600. Part of
    that is the meshes, mostly of eight elements; part is that two torsion constants are about: the
    polar moment 1/6 (GJ = EI) and Saint-Venant's 0.1406, which move the tip by 0.40, 0.36 and 0.32.
    Bathe & Bolourchi (0.85 and 0.23 away) and Simo & Vu-Quoc (0.18 at most) are nearer to the
    first; Crisfield (0.13 at most), Ibrahimbegovic (0.006) and Longva (0.10 at most) to the second;
    Cardona & Geradin lie between (0.24 and 0.18 at most). Which constant an author took is
    inferred here from these distances alone.
    """

    def test_tip_is_that_of_an_independent_shooting_method(self, bends):
        for tip, expected in bends.values():
            np.testing.assert_allclose(tip, expected, atol=1e-8)

    @pytest.mark.parametrize("force", [300, 450, 600])
    def test_tip_lies_among_the_published_ones(self, bends, force):
        """With the polar moment inside their spread in each coordinate; with Saint-Venant's y is
        0.03 and 0.01 outside at 300 and 450."""
        tables = np.array([table[force] for table in BEND.values() if force in table])
        tip = bends["polar", force][0]
        assert np.all(tables.min(axis=0) <= tip)
        assert np.all(tip <= tables.max(axis=0))

    @pytest.mark.parametrize(("author", "torsion"), [key for key in BEND if key[1]])
    def test_each_table_belongs_to_one_torsion_constant(self, bends, author, torsion):
        """Nearer to it than to the other, and not further than the spread of all the tables."""
        other = "polar" if torsion == "saint_venant" else "saint_venant"
        for force, table in BEND[author, torsion].items():
            spread = np.ptp([t[force] for t in BEND.values() if force in t], axis=0)
            tip = bends[torsion, force][0]
            assert np.all(np.abs(tip - table) < spread)
            assert np.linalg.norm(tip - table) < np.linalg.norm(bends[other, force][0] - table)

    def test_curved_elements_of_third_order_are_met_to_their_last_digit(self, bends):
        """Eight curved three-node elements of Ibrahimbegovic (1995) print three decimals."""
        np.testing.assert_allclose(
            bends["saint_venant", 600][0],
            BEND["Ibrahimbegovic 1995", "saint_venant"][600],
            atol=0.006,
        )


# -------------------------------------------------------------------------------------------------
# A force that follows the end


@pytest.mark.parametrize("load", [0.5, 2.0, 5.0, 13.75, 130e3 * 100**2 / 3.5e7])
def test_follower_force_curls_a_cantilever_as_the_pendulum_swings(load):
    """End by Jacobi's functions; an initial value problem from the end confirms the reference.

    The last load is the largest of the cantilever of Argyris & Symeonidis (Comput. Methods Appl.
    Mech. Eng. 26, 1981; L = 100, EI = 3.5e7, P = 130 kN), of which no table is at hand.
    """
    x, y, angle = follower_elastica(load)

    def swing(_, state):
        return [state[1], -load * np.cos(state[0]), np.cos(state[0]), np.sin(state[0])]

    end = integrate.solve_ivp(
        swing, (1, 0), [0, 0, 0, 0], method="DOP853", rtol=1e-13, atol=1e-14
    ).y[:, -1]
    tip = -np.exp(-1j * end[0]) * (end[2] + 1j * end[3])
    np.testing.assert_allclose((x, y, angle), (tip.real, tip.imag, -end[0]), atol=1e-12)

    solved = Solved(follower(square_rod(), force=(0.0, load, 0.0)))
    np.testing.assert_allclose(solved.tip, [x, y, 0], atol=1e-9)
    np.testing.assert_allclose(np.exp(1j * solved.angle[-1]), np.exp(1j * angle), atol=1e-9)


def test_follower_force_turns_the_end_by_half_a_turn_and_no_more():
    """(2 K)^2 with K = Gamma(1/4)^2 / 4 sqrt(pi): there the end points back at the clamp, and more
    force turns it back."""
    most = (special.gamma(0.25) ** 2 / (2 * np.sqrt(np.pi))) ** 2
    before, there, after = (
        Solved(follower(square_rod(), force=(0.0, part * most, 0.0))).angle[-1]
        for part in (0.9, 1.0, 1.1)
    )
    np.testing.assert_allclose(abs(there), np.pi, atol=1e-9)
    assert 3.0 < before < np.pi  # an angle past half a turn would come out negative
    assert 3.0 < after < np.pi
