r"""A straight heavy arm pressed along a narrow tube, ends clamped and one sliding along the
tube, against the theory of small deflections.

Lengths are per length L of the arm, forces in $EI / L^2$; r is the clearance, by which the axis may
move aside."""

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
