"""Sections whose law is not linear: closed forms, other models, shooting, gradients."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.optimize import brentq

import vsr_jax as vsr
from vsr_jax.arm import LinearLaw, SectionLaw
from vsr_jax.typing import Scalar

LENGTH, RADIUS, YOUNG = 0.3, 0.006, 1e6
BENDING = YOUNG * np.pi * RADIUS**4 / 4


class Stiffening(SectionLaw):
    r"""A moment $EI \kappa (1 + \kappa^2 / \kappa_0^2)$ for the curvature $\kappa$."""

    curvature: Scalar

    def energy(self, strain, stiffness):
        linear = 0.5 * sum(s * x**2 for s, x in zip(stiffness, strain, strict=True))
        bent = stiffness[1] * strain[1] ** 2 + stiffness[2] * strain[2] ** 2
        return linear + 0.25 * bent * (strain[1] ** 2 + strain[2] ** 2) / self.curvature**2


class Rubber(vsr.Material):
    """A material that stiffens as it bends."""

    curvature: Scalar

    def __init__(self, young, curvature, **options):
        super().__init__(young, **options)
        self.curvature = jnp.asarray(curvature)

    def law(self, section, X, length):
        return Stiffening(self.curvature)


def arm(curvature=8.0, actuators=(), loads=(), density=None):
    material = Rubber(YOUNG, curvature, poisson=0.45, density=density)
    return vsr.Scene(vsr.Rod(LENGTH, vsr.Circular(RADIUS), material), actuators, loads)


def bent(moment, curvature):
    """Curvature by a moment."""
    return brentq(lambda k: BENDING * k * (1 + (k / curvature) ** 2) - moment, 0.0, 1e3)


@pytest.mark.parametrize("model", [vsr.StrainDependent(8), vsr.Continuum(rtol=1e-10, atol=1e-12)])
def test_a_moment_that_follows_bends_an_arm_into_the_circle_of_its_law(model):
    moment = 3.0 * BENDING / LENGTH
    scene = arm(loads=[vsr.TipWrench(moment=(0.0, moment, 0.0), frame="body")])
    eq = vsr.solve(scene, [], model=model, throw=True)
    k = bent(moment, 8.0)
    angle = k * LENGTH
    np.testing.assert_allclose(
        eq.tip[:3, 3], [np.sin(angle) / k, 0.0, -(1 - np.cos(angle)) / k], atol=1e-9
    )
    energy = LENGTH * BENDING * (k**2 / 2 + k**4 / (4 * 8.0**2))
    np.testing.assert_allclose(eq.energy.elastic, energy, rtol=1e-9)


def test_the_linear_law_takes_six_products_and_nothing_for_its_tangent():
    """What arms took before sections had a law."""
    strain = stiffness = tuple(jnp.zeros(4) for _ in range(6))
    wrench = jax.make_jaxpr(LinearLaw().wrench)(strain, stiffness)
    assert [equation.primitive.name for equation in wrench.eqns] == ["mul"] * 6
    tangent = jax.make_jaxpr(LinearLaw().tangent)(strain, stiffness)
    assert {equation.primitive.name for equation in tangent.eqns} <= {"broadcast_in_dim"}


def test_a_tendon_bends_it_by_less_than_a_linear_arm():
    tendon = vsr.Tendon(vsr.Parallel(0.0, 0.004))
    stiff, linear = (
        vsr.solve(arm(curvature, [tendon]), [2.0], model=vsr.StrainDependent(8), throw=True)
        for curvature in (8.0, 1e6)
    )
    # the tendon shortens the axis, by which the moment of its force is what it is
    assert abs(float(stiff.strain(0.1)[1])) == pytest.approx(bent(2.0 * 0.004, 8.0), rel=1e-9)
    assert abs(float(linear.strain(0.1)[1])) == pytest.approx(2.0 * 0.004 / BENDING, rel=1e-6)


def heavy_tip(force, curvature):
    """Tip of an inextensible cantilever under a dead force across it, by shooting."""

    def along(k0):
        def rate(_, y):
            angle, moment = y[2:]
            k = np.sign(moment) * bent(abs(moment), curvature)
            return np.cos(angle), np.sin(angle), k, -force * np.cos(angle)

        start = [0.0, 0.0, 0.0, k0]
        return solve_ivp(rate, (0.0, LENGTH), start, rtol=1e-10, atol=1e-13).y[:, -1]

    root = brentq(lambda m: along(m)[3], 0.2 * force * LENGTH, force * LENGTH, xtol=1e-16)
    return along(root)[:2]


@pytest.mark.slow
def test_a_cantilever_under_a_dead_force_is_that_of_shooting():
    force = 4.0 * BENDING / LENGTH**2
    scene = arm(loads=[vsr.TipWrench((0.0, 0.0, force))])
    stiff = vsr.Scene(scene.rod, loads=scene.loads, free_strains=["bending_y", "bending_z"])
    eq = vsr.solve(stiff, [], model=vsr.StrainDependent(24), throw=True)
    np.testing.assert_allclose(eq.tip[[0, 2], 3], heavy_tip(force, 8.0), atol=1e-8)
    basis = vsr.Basis.uniform(vsr.Legendre(6))
    projected = vsr.solve(scene, [], model=vsr.Prescribed(basis, steps=16), throw=True)
    whole = vsr.solve(scene, [], model=vsr.StrainDependent(24), throw=True)
    np.testing.assert_allclose(projected.tip, whole.tip, atol=1e-6)


@pytest.mark.slow
def test_friction_depends_on_how_far_it_bends():
    """The capstan equation in a plane: $T(L) = T_0 e^{-\\mu \\theta}$ with the angle of the tip."""
    tendon = vsr.Tendon(vsr.Parallel(0.0, 0.004), friction=0.4)
    eq = vsr.solve(arm(8.0, [tendon]), [2.0], model=vsr.StrainDependent(16), throw=True)
    angle = np.arctan2(-eq.tip[2, 0], eq.tip[0, 0])
    k = abs(float(eq.strain(0.999999 * LENGTH)[1]))
    assert k == pytest.approx(bent(0.004 * 2.0 * np.exp(-0.4 * abs(angle)), 8.0), rel=1e-5)


def tip(curvature, force):
    loads = [vsr.Gravity(), vsr.TipWrench(jnp.stack([0.0, 0.0, force]))]
    scene = arm(8.0, [vsr.Tendon(vsr.Parallel(0.0, 0.004))], loads, density=1000.0)
    scene = eqx.tree_at(lambda scene: scene.rod.material.curvature, scene, curvature)
    eq = vsr.solve(scene, [0.5], model=vsr.StrainDependent(8))
    return eq.tip[2, 3], eq.stability


@pytest.mark.slow
def test_it_is_differentiated_by_the_numbers_of_its_law_batched():
    at, h = jnp.array([8.0, 0.02]), 1e-3
    both = jax.jit(jax.vmap(jax.jacrev(lambda x: jnp.stack(tip(*x)))))
    forward = jax.jit(jax.jacfwd(lambda x: jnp.stack(tip(*x))))
    value = jax.jit(lambda x: jnp.stack(tip(*x)))
    found = both(jnp.stack([at, at + 0.1]))[0]
    np.testing.assert_allclose(found, forward(at), rtol=1e-8)
    for i, unit in enumerate(np.diag([1.0, 1e-3])):
        steps = [value(at + n * h * unit) for n in (1, -1, 2, -2)]
        slope = (8 * (steps[0] - steps[1]) - (steps[2] - steps[3])) / (12 * h * unit[i])
        np.testing.assert_allclose(found[:, i], slope, rtol=1e-5)
