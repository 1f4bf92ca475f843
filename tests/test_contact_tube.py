r"""A straight heavy arm pressed along a narrow tube, ends clamped and one sliding along the
tube, against the theory of small deflections.

Lengths are per length L of the arm, forces in $EI / L^2$; r is the clearance, by which the axis may
move aside."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import brentq

import vsr_jax as vsr

L, RADIUS, YOUNG, DENSITY = 1.0, 0.002, 5e9, 1000.0
EI = YOUNG * np.pi * RADIUS**4 / 4
FORCE = EI / L**2
MODEL = vsr.StrainDependent(24)


def pressed(thrust, clearance, weight):
    """The equilibrium of an arm along the bottom of the tube."""
    g = weight * FORCE / L / (DENSITY * np.pi * RADIUS**2)
    base = vsr.pose((0, 0, -clearance), pointing=(1, 0, 0))
    end = vsr.Held(position=(L, 0, -clearance), orientation=np.eye(3), along=(1, 0, 0))
    material = vsr.Material(YOUNG, poisson=0.4, density=DENSITY)
    scene = vsr.Scene(
        vsr.Rod(L, vsr.Circular(RADIUS), material, base=base),
        loads=[vsr.Gravity((0, 0, -g)), vsr.TipWrench(force=(-thrust * FORCE, 0, 0))],
        held=end,
        obstacles=vsr.Tube(clearance + RADIUS),
        free_strains=("bending_y", "bending_z"),
    )
    return vsr.solve(scene, jnp.zeros(0), model=MODEL)


def snaking_thrust(restoring):
    r"""Least thrust F at which $v'''' + F v'' + (w / r) v = 0$ has a solution that vanishes with
    its slope at both ends: as $\cos k_1 s, \sin k_1 s, \cos k_2 s, \sin k_2 s$ with
    $k^4 - F k^2 + w / r = 0$."""

    def determinant(thrust):
        apart = np.sqrt(thrust**2 - 4 * restoring)
        rows = [
            [value for k in np.sqrt((thrust + np.array([-apart, apart])) / 2) for value in row(k)]
            for row in (
                lambda k: (1.0, 0.0),
                lambda k: (0.0, k),
                lambda k: (np.cos(k), np.sin(k)),
                lambda k: (-k * np.sin(k), k * np.cos(k)),
            )
        ]
        return np.linalg.det(rows)

    tried = 2 * np.sqrt(restoring) * np.linspace(1.001, 2.5, 2000)
    signs = np.sign([determinant(thrust) for thrust in tried])
    first = int(np.argmax(signs[1:] != signs[:-1]))
    return brentq(determinant, tried[first], tried[first + 1])


@pytest.mark.slow
@pytest.mark.parametrize(("weight", "clearance"), [(20.0, 0.02), (5.0, 0.001), (20.0, 0.002)])
def test_a_heavy_arm_snakes_in_a_tube_at_its_critical_thrust(weight, clearance):
    """An arm that lies along the bottom of a tube leaves its line where its stability margin
    vanishes: w / r restores it, as in the formula of Paslay and Bogy for long arms,
    $F = 2 \\sqrt{EI w / r}$."""
    restoring = weight / clearance
    critical = snaking_thrust(restoring)
    assert critical > 2 * np.sqrt(restoring)
    shares, margins = np.array([0.98, 0.99]), []
    for share in shares:
        eq = pressed(share * critical, clearance, weight)
        assert bool(eq.converged)
        np.testing.assert_allclose(eq.position(L / 2)[1:], [0, -clearance], atol=1e-5 * L)
        margins.append(float(eq.stability))
    vanishes = shares[1] + margins[1] * (shares[1] - shares[0]) / (margins[0] - margins[1])
    np.testing.assert_allclose(vanishes, 1, atol=5e-4)


CLEARANCE, WEIGHT = 0.002, 100.0
TOUCHING = 4 * np.pi**2
"""Thrust at which an arm with clamped ends buckles, and touches where the clearance is small."""


def aside(thrust, weight, start=None):
    """The equilibrium of an arm in the middle of the tube at both ends, under a thrust and a load
    of weight times the clearance."""
    end = vsr.Held(position=(L, 0, 0), orientation=np.eye(3), along=(1, 0, 0))
    down = jnp.array([0.0, 0.0, -1.0]) * weight * CLEARANCE * FORCE / L
    push = jnp.array([-1.0, 0.0, 0.0]) * thrust * FORCE
    scene = vsr.Scene(
        vsr.Rod(L, vsr.Circular(RADIUS), vsr.Material(YOUNG, poisson=0.4)),
        loads=[vsr.DistributedWrench(force=down), vsr.TipWrench(force=push)],
        held=end,
        obstacles=vsr.Tube(CLEARANCE + RADIUS),
        free_strains=("torsion", "bending_y", "bending_z"),
    )
    return vsr.solve(scene, jnp.zeros(0), model=vsr.StrainDependent(25), start=start)


def small_deflections(thrust, weight):
    r"""Deflection at the abscissas and force of the contact in the middle, per clearance: $w'''' +
    F w'' = q$ with $w = a (1 - \cos kX) + b (kX - \sin kX) + q X^2 / (2 F)$, $k^2 = F$, and $w = 1,
    w' = 0$ at l = L / 2. The shear there is $w''' + F w' = k^3 b + q l$ on both sides. The force is
    $2 k^3 / (kl - 2 \tan(kl / 2)) + q l$."""
    k, half = np.sqrt(thrust), 0.5
    rows = [
        [1 - np.cos(k * half), k * half - np.sin(k * half)],
        [k * np.sin(k * half), k * (1 - np.cos(k * half))],
    ]
    rest = [1 - weight * half**2 / (2 * thrust), -weight * half / thrust]
    a, b = np.linalg.solve(rows, rest)

    def deflection(X):
        return a * (1 - np.cos(k * X)) + b * (k * X - np.sin(k * X)) + weight * X**2 / (2 * thrust)

    return deflection, 2 * (k**3 * b + weight * half)


@pytest.mark.slow
def test_an_arm_that_has_buckled_in_a_tube():
    """Shape, contact force and stability between the thrust at which an arm buckles and the one at
    which it leaves its plane: half of it is then a column with one end clamped and one pinned, by
    the contact, which the tube lets slide aside. A large load selects the side; a small one, which
    makes the position around the tube unique, remains."""
    leaves = 4 * 20.190728556426629
    eq = aside(1.05 * TOUCHING, 10 * WEIGHT)
    X = np.linspace(0, L, 21)
    for share in (1.05, 1.2, 1.4, 1.7, 1.9, 2.0):
        eq = aside(share * TOUCHING, WEIGHT, eq)
        assert bool(eq.converged)
        deflection, force = small_deflections(share * TOUCHING, WEIGHT)
        expected = CLEARANCE * deflection(np.minimum(X, L - X))
        np.testing.assert_allclose(-eq.position(X)[:, 2], expected, atol=5e-5 * CLEARANCE)
        np.testing.assert_allclose(eq.position(X)[:, 1], 0, atol=1e-8 * L)
        pressed = float(eq.contacts.force.sum()) / (CLEARANCE * FORCE)
        np.testing.assert_allclose(pressed, force, rtol=5e-5)
        if share >= 1.9:
            margin = 1 - share * TOUCHING / leaves
            np.testing.assert_allclose(eq.stability, margin, atol=2e-4)
    assert int(aside(1.01 * leaves, WEIGHT, eq).status) == vsr.Status.UNSTABLE


@pytest.mark.slow
@pytest.mark.parametrize("clearance", [0.005, 0.01])
def test_an_arm_that_has_buckled_into_a_helix(clearance):
    r"""Weightless arm with one end free, pressed far beyond snaking. Nothing turns it about the
    tube, so that away from the ends it is the helix of the angle $\alpha$ with $F = 2 EI \sin^2
    \alpha \cos\alpha / r^2$, pressed to the wall by $EI \sin^4\alpha / r^3$ per length; for small
    angles the pitch is $\pi \sqrt{8 EI / F}$ and the force $r F^2 / (4 EI)$ (Lubinski, Althouse
    and Logan 1962; Mitchell 1982). The formulas hold for any thrust and clearance; a bend at rest
    near the base, which is gone in the middle, selects one of all helices around the tube."""
    thrust, steps = 300.0, 48
    angle = brentq(
        lambda x: 2 * np.sin(x) ** 2 * np.cos(x) - thrust * (clearance / L) ** 2, 1e-6, 0.9
    )
    bend, turn = np.sin(angle) ** 2 / clearance, np.sin(angle) * np.cos(angle) / clearance
    bends = [
        vsr.FunctionProfile(lambda X, trig=trig: 4 * bend * jnp.exp(-20 * X / L) * trig(turn * X))
        for trig in (jnp.cos, jnp.sin)
    ]
    rod = vsr.Rod(
        L,
        vsr.Circular(RADIUS),
        vsr.Material(YOUNG, poisson=0.4),
        rest_strain=(0.0, *bends, 1.0, 0.0, 0.0),
    )
    scene = vsr.Scene(
        rod,
        loads=[vsr.TipWrench(force=(-thrust * FORCE, 0.0, 0.0))],
        obstacles=vsr.Tube(clearance + RADIUS),
        free_strains=("torsion", "bending_y", "bending_z"),
    )
    eq = vsr.solve(scene, jnp.zeros(0), model=vsr.StrainDependent(steps))
    assert bool(eq.converged)
    X = np.linspace(20, 26, 41) * L / steps
    _, y, z = eq.position(X).T
    np.testing.assert_allclose(np.hypot(y, z), clearance, rtol=1e-4)
    around = np.abs(np.polyfit(X, np.unwrap(np.arctan2(z, y)), 1)[0])
    np.testing.assert_allclose(around, np.sin(angle) / clearance, rtol=5e-4)
    force = eq.contacts.force.reshape(steps, 2).sum(1)[20:26] * steps / L
    np.testing.assert_allclose(force, EI * np.sin(angle) ** 4 / clearance**3, rtol=2e-3)


@pytest.mark.slow
def test_an_arm_that_would_snap_aside_is_found_aside():
    """Two tendons bend an arm in the plane between them, where its tip comes to the wall; what is
    symmetric stays in that plane, and is unstable there."""
    length, radius = 0.2, 0.005
    arm = vsr.Rod(length, vsr.Circular(radius), vsr.Material(2e5, poisson=0.4))
    tendons = [vsr.Tendon(vsr.Parallel(y, z)) for y, z in ((0.003, 0.0), (0.0, 0.003))]

    @jax.jit
    @jax.vmap
    def solved(clearance, tensions):
        tube = vsr.Tube(radius + clearance)
        scene = vsr.Scene(arm, tendons, obstacles=tube)
        eq = vsr.solve(scene, tensions, model=vsr.StrainDependent(24))
        return eq.status, eq.stability, eq.position(jnp.linspace(0.0, length, 41))

    tensions = np.array([[0.9546, 0.4999], [0.3255, 0.994], [0.8768, 0.6017]])
    clearance = radius / np.array([0.3998, 0.7068, 0.5322]) - radius
    status, margin, axis = solved(jnp.asarray(clearance), jnp.asarray(tensions))
    assert np.all(status == vsr.Status.CONVERGED)
    assert margin.min() > 0.01
    across = np.stack([-tensions[:, 1], tensions[:, 0]], 1)
    across /= np.linalg.norm(across, axis=1)[:, None]
    aside = np.abs(np.einsum("axi,ai->ax", axis[..., 1:], across)).max(1)
    assert np.all(aside > 0.03 * clearance)
