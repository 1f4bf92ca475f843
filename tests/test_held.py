"""Held sections against closed forms, free bodies and finite differences."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import with_derivative
from scipy.integrate import quad, solve_bvp
from scipy.optimize import brentq
from scipy.spatial.transform import Rotation
from scipy.special import ellipe, ellipk
from test_contact import MODEL, NO_INPUTS, L, rod, solved, stiffness

import vsr_jax as vsr
from vsr_jax.arm import Frame, PoseLoad, Support
from vsr_jax.typing import Scalar

BENDING = ("bending_y", "bending_z")


def test_a_propped_cantilever_is_held_by_three_eighths_of_its_load():
    q = 1e-4
    prop = vsr.Held(position=(L, 0, 0), along=(1, 0, 0))
    eq = solved(vsr.DistributedWrench(force=(0, 0, -q)), held=prop, free_strains=BENDING)
    np.testing.assert_allclose(eq.supports[0], [0, 0, 0, 0, 0, 3 / 8 * q * L], atol=1e-6 * q * L)
    np.testing.assert_allclose(eq.tip[2, 3], 0, atol=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("orientation", "load"),
    [(np.eye(3), 4 * np.pi**2), (None, 20.190728556426629)],
    ids=["clamped", "pinned"],
)
def test_the_margin_of_a_held_column_vanishes_at_its_buckling_load(orientation, load):
    """The pinned end: tan x = x at x^2 = 20.19."""
    force = 0.5 * load * stiffness() / L**2
    end = vsr.Held(position=(L, 0, 0), orientation=orientation, along=(1, 0, 0))
    eq = solved(
        vsr.TipWrench(force=(-force, 0, 0)),
        held=end,
        free_strains=BENDING,
        model=vsr.StrainDependent(24),
    )
    np.testing.assert_allclose(eq.stability, 0.5, atol=1e-7)


class Sleeve(Support):
    """The tip stays on the x axis and along it, and is free to slide and to turn about it."""

    X = None
    effect = "sleeve"
    units = ("m", "m", "rad", "rad")

    def deviation(self, base, rotation, position):
        return jnp.stack((position[1], position[2], rotation[1, 0], rotation[2, 0]))


class Torque(PoseLoad):
    """A torque about the x axis by its potential, where the tip stays along that axis."""

    torque: Scalar
    frame: Frame = eqx.field(static=True, default="world", init=False)
    effect = "torque"
    needs = "rotation"

    def place(self, rod):
        return rod.length

    def potential(self, rod, X, R, position):
        return -self.torque * jnp.arctan2(R[2, 1] - R[1, 2], R[1, 1] + R[2, 2])


@pytest.mark.slow
def test_a_twisted_rod_under_tension_buckles_at_greenhills_torque():
    """Clamped rods: M L / EI = 8.986819, 9.134730, 10.428856, 13.113500 for T L^2 / EI = 0, 1, 10,
    30 (Greenhill 1883, inextensible; a rod of this slenderness is 0.1 % off at most)."""
    arm, EI = vsr.Rod(1.0, vsr.Circular(0.01), vsr.Material(1e6, poisson=0.5)), 2.5e-3 * np.pi
    critical = np.array([8.986819, 9.134730, 10.428856, 13.113500])
    tension, share = np.repeat([0.0, 1.0, 10.0, 30.0], 3), np.tile([0.98, 0.995, 1.005], 4)

    def outcome(tension, torque):
        pull = vsr.TipWrench(force=(tension * EI, 0.0, 0.0))
        scene = vsr.Scene(arm, loads=[pull, Torque(torque * EI)], held=Sleeve())
        eq = vsr.solve(scene, [])
        return eq.stability, eq.status

    margin, status = jax.jit(jax.vmap(outcome))(tension, share * np.repeat(critical, 3))
    margin, status = margin.reshape(4, 3), status.reshape(4, 3)
    assert (status[:, :2] == vsr.Status.CONVERGED).all()
    assert (status[:, 2] != vsr.Status.CONVERGED).all()
    vanishes = 0.995 + 0.015 * margin[:, 1] / (margin[:, 0] - margin[:, 1])
    np.testing.assert_allclose(vanishes, 1.0, atol=1e-3)


@pytest.mark.slow
def test_a_moment_leaves_a_buckled_arm_stable():
    """With a moment the tangent is not symmetric, and its pivots alone miss pairs of the negative
    eigenvalues that the hold takes away; a margin above zero proves that the arm is stable."""
    moment = vsr.TipWrench(moment=(*[stiffness() / L] * 3,))
    eq = solved(moment, held=vsr.Held(position=(0.9 * L, 0.1 * L, 0.05 * L)))
    assert eq.status == vsr.Status.CONVERGED
    assert eq.stability > 0.1


@pytest.mark.slow
@pytest.mark.parametrize("free", [("bending_y",), ("bending_y", "elongation")])
def test_an_arm_in_a_plane_may_be_held_across_it(free):
    """Clamped at one end, in a slide at the other: it sags by F L^3 / (192 EI) in the middle."""
    held = vsr.Held(position=(L, 0, 0), orientation=np.eye(3), along=(1, 0, 0))
    load = vsr.PointWrench(L / 2, force=(0, 0, -1e-4))
    eq = solved(load, held=held, free_strains=free)
    assert eq.status == vsr.Status.CONVERGED
    sag = -1e-4 * L**3 / (192 * stiffness())
    np.testing.assert_allclose(eq.position(L / 2)[2], sag, rtol=1e-4)
    np.testing.assert_allclose(eq.supports[0, 5], 5e-5, rtol=1e-4)


@pytest.mark.slow
@pytest.mark.parametrize("along", [None, pytest.param((1.0, 0.0, 0.5), marks=pytest.mark.slow)])
def test_an_arm_in_a_plane_is_held_alike_wherever_the_plane_lies(along):
    """Nothing can move across the plane; no support then pushes there, about no axis in it."""
    place, turn = np.array([0.7 * L, 0, -0.4 * L]), Rotation.from_rotvec([0, 0.8, 0]).as_matrix()

    def held(turned):
        base = jnp.eye(4).at[:3, :3].set(turned)
        way = None if along is None else turned @ jnp.array(along)
        end = vsr.Held(position=turned @ place, orientation=turned @ turn, along=way)
        aside = vsr.DistributedWrench(force=turned @ jnp.array([0, 0, 0.05]))
        arm = rod(base=base)
        scene = vsr.Scene(arm, loads=aside, held=end, free_strains=("bending_y", "elongation"))
        eq = vsr.solve(scene, jnp.zeros(0), model=vsr.StrainDependent(8))
        support = eq.supports[0].reshape(2, 3) @ turned
        return eq.status, turned.T @ eq.position(0.6 * L), support, eq.stability

    ways = np.concatenate([np.eye(3)[None], Rotation.random(7, random_state=1).as_matrix()])
    status, middle, support, margin = jax.jit(jax.vmap(held))(jnp.asarray(ways))
    assert np.all(status == vsr.Status.CONVERGED)
    np.testing.assert_allclose(middle, np.broadcast_to(middle[0], middle.shape), atol=1e-10 * L)
    np.testing.assert_allclose(support, np.broadcast_to(support[0], support.shape), atol=2e-8)
    np.testing.assert_allclose(margin, np.full(8, margin[0]), rtol=1e-6)
    np.testing.assert_allclose(support[0][[0, 0, 1], [0, 2, 1]], 0, atol=1e-12)
    assert np.abs(support[0][[0, 1, 1], [1, 0, 2]]).min() > 1e-4


@pytest.mark.slow
def test_a_rigid_piece_may_be_held_twice():
    """Both supports exert together what the one at its end exerts alone."""
    arm = rod(rigid=[vsr.RigidPiece(0.12, L)])
    turn = Rotation.from_rotvec([0, 0.4, 0]).as_matrix()

    def held(*abscissas):
        places = [np.array([0.17, 0, -0.05]) - (L - X) * turn[:, 0] for X in abscissas]
        ends = [
            vsr.Held(X, position=place, orientation=turn)
            for X, place in zip(abscissas, places, strict=True)
        ]

        @jax.jit
        def found():
            eq = solved(vsr.Gravity(), held=ends, arm=arm)
            return eq.status, eq.position(0.1), eq.supports

        status, position, supports = found()
        assert status == vsr.Status.CONVERGED
        moments = supports[:, :3] + np.cross(places, supports[:, 3:])
        return position, np.concatenate([moments.sum(0), supports[:, 3:].sum(0)])

    once, alone = held(L)
    twice, together = held(L, 0.15)
    np.testing.assert_allclose(together, alone, rtol=2e-3, atol=1e-12)
    np.testing.assert_allclose(twice, once, atol=5e-5 * L)


@pytest.mark.slow
def test_a_clamped_elastica_has_the_force_of_the_elliptic_integrals():
    """Both ends clamped, brought to 0.8 L: four quarter waves, 2 E / K - 1 = 0.8 and
    P = (4 K)^2 EI / L^2."""
    m = brentq(lambda m: 2 * ellipe(m) / ellipk(m) - 1.8, 1e-6, 0.9)
    force = (4 * ellipk(m)) ** 2 * stiffness() / L**2
    end = vsr.Held(position=(0.8 * L, 0, 0), orientation=np.eye(3))
    aside = vsr.PointWrench(L / 2, force=(0, 0, 0.05 * force))
    more = {"held": end, "free_strains": BENDING, "model": vsr.StrainDependent(24)}
    bent = solved(aside, **more)
    eq = solved(start=bent, **more)
    np.testing.assert_allclose(eq.supports[0, 3], -force, rtol=1e-6)
    assert float(eq.position(L / 2)[2]) > 0.2 * L


def test_held_sections_have_exact_derivatives():
    def height(shortened):
        end = vsr.Held(position=jnp.array([1.0, 0, 0]) * L * (1 - shortened))
        scene = vsr.Scene(rod(), (), [vsr.TipWrench(moment=(0, 0.01, 0))], held=end)
        return vsr.solve(scene, NO_INPUTS, model=MODEL).position(L / 2)[2]

    h, at, solved = 1e-5, 0.1, with_derivative(height)
    difference = (solved(at + h)[0] - solved(at - h)[0]) / (2 * h)
    np.testing.assert_allclose(solved(at)[1], difference, rtol=1e-6)
    np.testing.assert_allclose(jax.jit(jax.grad(height))(at), difference, rtol=1e-6)


@pytest.mark.slow
def test_a_clamp_within_the_arm_exerts_the_wrench_that_bends_it_there():
    """A section of an arm on a turned base is clamped in the pose to which a wrench brings it."""
    base = vsr.pose((0.01, 0.0, 0.02), pointing=(1.0, 0.2, 0.1))
    material = vsr.Material(1e6, poisson=0.3, density=1000.0)
    arm = vsr.Rod(L, vsr.Circular(0.005), material, base=base)
    force, moment = np.array([0.01, 0.01, 0.02]), np.array([1e-4, -2e-4, 5e-4])
    bent = solved(vsr.Gravity(), vsr.PointWrench(0.12, force=force, moment=moment), arm=arm)
    pose = bent.pose(0.12)
    hold = vsr.Held(0.12, position=pose[:3, 3], orientation=pose)
    eq = solved(vsr.Gravity(), held=hold, arm=arm)
    np.testing.assert_allclose(eq.supports[0, 3:], force, atol=1e-5 * 0.02)
    np.testing.assert_allclose(eq.supports[0, :3], moment, atol=1e-5 * 5e-4)
    np.testing.assert_allclose(eq.tip, bent.tip, atol=1e-7)


@pytest.mark.slow
def test_the_margin_of_a_held_arm_can_be_differentiated():
    def margin(push):
        end = vsr.Held(position=jnp.array([L, 0, 0.0]), along=(1, 0, 0))
        load = vsr.TipWrench(force=jnp.array([-1.0, 0, 0]) * push)
        return solved(load, held=end, free_strains=BENDING).stability

    euler = 20.190728556426629 * stiffness() / L**2
    slope = jax.jit(jax.grad(margin))(0.3 * euler)
    np.testing.assert_allclose(slope, -1 / euler, rtol=1e-5)


def wire(length=1.0, radius=1e-3, young=200e9, shear=80e9):
    return vsr.Rod(length, vsr.Circular(radius), vsr.Material(young, shear=shear, density=7800.0))


TAUT = {
    "natural length": ({}, 0.0, {}),
    "1e-9": ({}, 1e-9, {}),
    "1e-5": ({}, 1e-5, {}),
    "1e-3": ({}, 1e-3, {}),
    "short of Euler's load": ({}, -5e-6, {}),
    "pinned": ({}, 1e-5, {"orientation": None}),
    "rubber": ({"young": 1e6, "shear": 4e5}, 1e-5, {}),
    "eight steps": ({}, 1e-5, {"steps": 8}),
    "no shear": ({}, 1e-5, {"free_strains": ("torsion", *BENDING, "elongation")}),
    "stout": ({"radius": 0.05}, 1e-4, {}),
    "hair": ({"radius": 3e-5}, 1e-4, {}),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", TAUT)
def test_a_taut_wire_bears_its_stretch(name):
    """N = EA s, straight: lengths and curvatures differ by the square of the slenderness."""
    numbers, stretch, options = TAUT[name]
    arm, turn = wire(**numbers), options.get("orientation", np.eye(3))
    end = vsr.Held(position=(1 + stretch, 0, 0), orientation=turn)
    free = options.get("free_strains", vsr.arm.STRAINS)
    model = vsr.StrainDependent(options.get("steps", 32))
    eq = vsr.solve(vsr.Scene(arm, held=end, free_strains=free), [], model=model)
    assert eq.status == vsr.Status.CONVERGED
    axial = numbers.get("young", 200e9) * np.pi * numbers.get("radius", 1e-3) ** 2
    np.testing.assert_allclose(eq.supports[0, 3], axial * stretch, rtol=1e-6, atol=1e-12 * axial)
    np.testing.assert_allclose(eq.curvature(np.linspace(0, 1, 7)), 0, atol=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("steps", [8, 48])
@pytest.mark.parametrize("stretch", [1e-5, 1e-4, 1e-3])
def test_the_margin_of_a_taut_wire_is_that_of_its_shear(stretch, steps):
    r"""Where it shears by $\gamma$ under its tension N, N turns by $\gamma / (1 + \epsilon)$: the
    least eigenvalue is $1 - N / (GA (1 + \epsilon))$. Beside it lies a band of others."""
    end = vsr.Held(position=(1 + stretch, 0, 0))
    eq = vsr.solve(vsr.Scene(wire(), held=end), [], model=vsr.StrainDependent(steps))
    np.testing.assert_allclose(eq.stability, 1 - 2.5 * stretch / (1 + stretch), atol=2e-6)


@pytest.mark.slow
@pytest.mark.parametrize("aside", [5e-5, 5e-4])
def test_a_wire_held_aside_in_its_middle(aside):
    r"""Each half is a beam of length l between clamps, under a tension N that its own deflection w
    causes, with slopes $w' = V / N (1 - \cosh(k (x - l/2)) / \cosh(k l / 2))$, $k^2 = N / EI$, for
    small slopes."""
    half, bending, axial = 0.05, 200e9 * np.pi / 4 * 2e-4**4, 200e9 * np.pi * 2e-4**2

    def slopes(N):
        k = np.sqrt(N / bending)
        shear = N * aside / (half - 2 / k * np.tanh(k * half / 2))
        return (
            shear,
            lambda x: shear / N * (1 - np.cosh(k * (x - half / 2)) / np.cosh(k * half / 2)),
        )

    def excess(N):
        slope = slopes(N)[1]
        return N - axial / half * quad(lambda x: 0.5 * slope(x) ** 2, 0, half, epsabs=1e-15)[0]

    tension = brentq(excess, 1e-6, 10.0, xtol=1e-12)
    ends = [
        vsr.Held(half, position=(half, aside, 0)),
        vsr.Held(position=(2 * half, 0, 0), orientation=np.eye(3)),
    ]
    eq = vsr.solve(vsr.Scene(wire(length=0.1, radius=2e-4), held=ends), [])
    assert eq.status == vsr.Status.CONVERGED
    np.testing.assert_allclose(eq.supports[0, 4], 2 * slopes(tension)[0], rtol=1e-3)
    np.testing.assert_allclose(eq.supports[1, 3], tension, rtol=1e-3)


def pinned_arch(arm, end, load):
    """Force on the base of a planar arm between a clamp and a pin, under a load per length across,
    by SciPy."""
    stiff = [float(x) for x in arm.stiffness(0.0)]
    bending, axial, shear = stiff[2], stiff[3], stiff[4]

    def slopes(s, y, p):
        _, _, angle, moment = y
        cos, sin, across = np.cos(angle), np.sin(angle), p[1] - load * s
        along, aside = 1 + (p[0] * cos + across * sin) / axial, (across * cos - p[0] * sin) / shear
        dx, dz = along * cos - aside * sin, along * sin + aside * cos
        return np.vstack([dx, dz, moment / bending, p[0] * dz - across * dx])

    def ends(a, b, p):
        return np.array([*a[:3], b[0] - end[0], b[1] - end[1], b[3]])

    s = np.linspace(0, 1, 101)
    high = 0.6 * np.sqrt(1 - end[0] ** 2 - end[1] ** 2)
    z = end[1] * s + high * np.sin(np.pi * s) ** 2
    guess = np.vstack([end[0] * s, z, np.gradient(z, s), np.zeros_like(s)])
    p0 = np.array([load, 0.5 * load])
    found = solve_bvp(slopes, ends, s, guess, p0, tol=1e-9, max_nodes=20_000)
    assert found.success
    return found.p


@pytest.mark.slow
@pytest.mark.parametrize(("end", "load"), [((0.95, 0.1), 20), ((0.9, 0.1), 5), ((0.7, 0.3), 20)])
def test_an_arm_held_with_slack_finds_its_stable_shape(end, load):
    """The way from rest leads to shapes in the plane that are unstable across it."""
    arm = vsr.Rod(1.0, vsr.Circular(0.01), vsr.Material(1e9, poisson=0.3))
    load = load * 1e9 * np.pi / 4 * 0.01**4
    held = vsr.Held(position=(end[0], 0, end[1]))
    scene = vsr.Scene(arm, (), vsr.DistributedWrench(force=(0, 0, load)), held=held)
    eq = vsr.solve(scene, [], model=vsr.StrainDependent(48))
    assert eq.status == vsr.Status.CONVERGED
    assert not eq.loosened
    assert eq.stability > 0.02
    force = pinned_arch(arm, end, load)
    np.testing.assert_allclose(eq.supports[0, 3::2], force - [0, load], rtol=1e-6)
