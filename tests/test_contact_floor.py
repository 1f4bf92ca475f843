r"""Heavy arms that lie partly on a floor against shooting along the elastica by SciPy, and against
a beam of small slope.

Lengths are per length of the arm, forces in $EI / L^2$, with z above the height at which the axis
touches the floor. Nothing pulls along the floor, so that the force beyond a section is vertical:

$$\theta'' = -(R - w (\ell - s)) \cos\theta, \quad x' = \cos\theta, \quad z' = \sin\theta,$$

up to the touch-down at $s = \ell$. From there the arm is straight and the floor bears its weight:
at the touch-down $\theta = \kappa = z = 0$, and the floor exerts a point force R.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.optimize import fsolve

import vsr_jax as vsr

L, RADIUS, YOUNG, DENSITY = 0.2, 0.001, 5e7, 1000.0
EI = YOUNG * np.pi * RADIUS**4 / 4
FORCE = EI / L**2
S = np.linspace(0, 1, 201)


class Lying(NamedTuple):
    """Height and pitch [rad] of the clamp and weight; curvature at the clamp, abscissa and force of
    the touch-down; positions (samples, 2)."""

    height: float
    pitch: float
    weight: float
    bend: float
    touch_down: float
    push: float
    axis: np.ndarray

    @property
    def floor_force(self):
        return self.weight * (1 - self.touch_down) + self.push


def shot(height, pitch, weight, first):
    """The solution of the boundary value problem."""

    def free(unknown, **more):
        bend, end, push = unknown

        def slope(s, y):
            force = push - weight * (end - s)
            return [y[1], -force * np.cos(y[0]), np.cos(y[0]), np.sin(y[0])]

        return solve_ivp(slope, (0, end), [pitch, bend, 0, height], rtol=1e-11, atol=1e-13, **more)

    def misses(unknown):
        return free(unknown).y[[0, 1, 3], -1]

    unknown = fsolve(misses, first, xtol=1e-13)
    assert np.abs(misses(unknown)).max() < 1e-10
    found, end = free(unknown, dense_output=True), unknown[1]
    axis = found.sol(np.minimum(S, end))[2:].T
    axis[:, 0] += np.maximum(S - end, 0)
    return Lying(height, pitch, weight, *unknown, axis)


def low():
    return shot(0.01, 0.0, 100.0, [-1.4, 0.3, 10.0])


def high():
    return shot(0.1, 0.0, 60.0, [-3.5, 0.6, 12.0])


def raised():
    return shot(0.1, np.pi / 3, 100.0, [-10.5, 0.7, 19.0])


def solved(height, pitch, weight, *, steps):
    g = weight * FORCE / L / (DENSITY * np.pi * RADIUS**2)
    base = vsr.pose((0, 0, height * L + RADIUS), pointing=(np.cos(pitch), 0, np.sin(pitch)))
    material = vsr.Material(YOUNG, poisson=0.4, density=DENSITY)
    scene = vsr.Scene(
        vsr.Rod(L, vsr.Circular(RADIUS), material, base=base),
        loads=[vsr.Gravity((0, 0, -g))],
        obstacles=vsr.Plane((0, 0, 1)),
        free_strains=("bending_y",),
    )
    return vsr.solve(scene, jnp.zeros(0), model=vsr.StrainDependent(steps), throw=True)


def distance(eq, lying):
    """Largest distance of the axes."""
    axis = np.asarray(eq.position(S * L))[:, [0, 2]] / L - [0, RADIUS / L]
    return np.linalg.norm(axis - lying.axis, axis=1).max()


@pytest.mark.slow
@pytest.mark.parametrize("case", [low, high, raised])
def test_the_shape_and_the_touch_down_of_an_arm_on_a_floor(case):
    lying, steps = case(), 48
    eq = solved(*lying[:3], steps=steps)
    force, X = np.asarray(eq.contacts.force[0]) / FORCE, np.asarray(eq.contacts.X[0]) / L
    assert distance(eq, lying) < 1e-5
    np.testing.assert_allclose(force.sum(), lying.floor_force, atol=1e-3 * lying.push)
    np.testing.assert_allclose(-eq.reaction(0.0)[1] * L / EI, lying.bend, rtol=1e-3)
    np.testing.assert_allclose(X[force > 1e-3 * force.max()][0], lying.touch_down, atol=1 / steps)


@pytest.mark.slow
@pytest.mark.parametrize("case", [high, raised])
def test_shapes_on_a_floor_converge_with_the_number_of_steps(case):
    """With half the step to a third of the error, nearly down to the thousandth of the radius,
    5e-6, that decides where an arm that lies along a surface touches it."""
    lying = case()
    coarse, fine = (distance(solved(*lying[:3], steps=steps), lying) for steps in (24, 48))
    assert coarse < 2.5e-5
    assert fine < min(coarse / 2.5, 8e-6)


@pytest.mark.slow
def test_a_low_arm_lifts_off_as_a_beam_of_small_slope():
    r"""$EI\,z'''' = -w$ with $z' = 0$ at the clamp and $z' = z'' = 0$ at the floor: the free length
    is $x = (72\,EI\,h / w)^{1/4}$, and the clamp bears $\tfrac23 w x$ and the moment
    $\tfrac16 w x^2$."""
    height, weight = 0.003, 100.0
    free = (72 * height / weight) ** 0.25
    eq = solved(height, 0.0, weight, steps=48)
    moment, force = np.asarray(eq.reaction(0.0)[1]) * L / EI, float(eq.reaction(0.0)[5]) / FORCE
    np.testing.assert_allclose(-force, 2 / 3 * weight * free, rtol=2e-3)
    np.testing.assert_allclose(moment, weight * free**2 / 6, rtol=2e-3)


def soft_arm(density, *, floor=-0.02, held=(), steps=24):
    """The equilibrium under its weight of an arm clamped at or above a floor."""
    material = vsr.Material(young=2e5, poisson=0.4, density=density)
    rod = vsr.Rod(0.2, section=vsr.Circular(0.005), material=material)
    plane = vsr.Plane([0.0, 0.0, 1.0], [0.0, 0.0, floor])
    scene = vsr.Scene(rod, loads=vsr.Gravity(), obstacles=plane, held=held)
    return vsr.solve(scene, jnp.zeros(0), model=vsr.StrainDependent(steps))


@pytest.mark.slow
def test_an_arm_that_lies_along_a_floor_hardly_passes_it():
    """Steps that lie flat touch the floor at their ends too: with their nearest points alone most
    arms passed it by 5e-4 of the radius, and some by 1.4e-3."""

    def lowest(density):
        eq = soft_arm(density)
        return jnp.min(eq.position(jnp.linspace(0, 0.2, 401))[:, 2]), eq.status

    height, status = jax.jit(jax.vmap(lowest))(jnp.linspace(500.0, 2500.0, 12))
    passed = (-0.015 - height) / 0.005
    assert np.all(status == vsr.Status.CONVERGED)
    assert np.median(passed) < 1e-4
    assert passed.max() < 5e-4


@pytest.mark.slow
def test_a_section_held_on_a_floor_does_not_touch_it_too():
    end = vsr.Held(position=[0.2, 0.0, 0.0])
    eq = soft_arm(1000.0, floor=-0.005, held=end, steps=12)
    force, gap = eq.contacts.force[0], eq.contacts.gap[0]
    assert eq.status == vsr.Status.CONVERGED
    assert force[-1] == 0
    np.testing.assert_allclose(gap, 0, atol=1e-8)
    weight = 1000.0 * np.pi * 0.005**2 * 0.2 * 9.81
    held = eq.supports[0, 5] - eq.reaction(0.0)[5] + force.sum()
    np.testing.assert_allclose(held, weight, rtol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("density", [1200.0, pytest.param(700.0, marks=pytest.mark.slow)])
def test_an_arm_that_lies_along_a_floor_is_differentiated(density):
    """Half of the steps lie on the floor, where the place of a contact in its step is given by the
    term in epsilon alone. The lighter arm is solved by a second attempt, with a larger one."""

    def forces(density):
        eq = soft_arm(density)
        found = jnp.sort(eq.contacts.force.reshape(-1))[-11:]
        return found, (found, eq.status)

    step = 1e-3 * density
    at = density + step * jnp.array([-2.0, -1.0, 0.0, 1.0, 2.0])
    rate, (found, status) = jax.jit(jax.vmap(jax.jacfwd(forces, has_aux=True)))(at)
    assert np.all(status == vsr.Status.CONVERGED)
    assert np.all(found > 0)
    expected = (found[0] - found[4] + 8 * (found[3] - found[1])) / (12 * step)
    assert np.max(np.abs(rate[2] - expected)) < 1e-6 * np.max(np.abs(expected))
