"""Actuators with a law of force, length and input, and supports of one's own."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import central_differences, with_derivative
from scipy.optimize import brentq

import vsr_jax as vsr
from vsr_jax.arm import Actuator, Routing, Support
from vsr_jax.typing import Scalar

LENGTH, OFFSET, RADIUS, YOUNG = 0.3, 0.005, 0.006, 1e6
EI = YOUNG * np.pi / 4 * RADIUS**4
ARM = vsr.Rod(LENGTH, vsr.Circular(RADIUS), vsr.Material(YOUNG, poisson=0.45, density=1000.0))
MODEL = vsr.StrainDependent(8)


class Muscle(Actuator):
    r"""$T = a F (1 - c (l / l_0 - 1))$: with c above 0 it becomes stronger as it shortens."""

    routing: Routing
    peak: Scalar
    slope: Scalar
    start: Scalar | None = None
    end: Scalar | None = None
    effect = "muscle"
    unit = "-"

    def force(self, value):
        return -value * self.peak

    def law(self, thread, value):
        return -thread.force - value * self.peak * (
            1 - self.slope * (thread.length / thread.rest - 1)
        )


def muscle(slope, peak=2.0, **options):
    return Muscle(vsr.Parallel(OFFSET, 0.0), jnp.asarray(peak), jnp.asarray(slope), **options)


def planar(slope, **options):
    return vsr.Scene(ARM, [muscle(slope)], free_strains=["bending_z"], **options)


@pytest.mark.parametrize("slope", [-4.0, 6.0])
def test_a_muscle_that_bends_an_arm_alone(slope):
    """Uniform bending: $EI \\kappa = T d$ and $l = L (1 - \\kappa d)$. The margin is that of the
    bending of the whole arm, $1 + T'(l) L d^2 / EI$, if that is the softest."""
    eq = vsr.solve(planar(slope), [0.5], model=MODEL, throw=True)
    tension = brentq(lambda T: T - 1.0 * (1 + slope * T * OFFSET**2 / EI), 0, 50, xtol=1e-14)
    np.testing.assert_allclose(-eq.forces[0], tension, rtol=1e-12)
    np.testing.assert_allclose(abs(eq.curvature(0.1)), tension * OFFSET / EI, rtol=1e-12)
    gain = -0.5 * 2.0 * slope / LENGTH
    np.testing.assert_allclose(
        eq.stability, min(1.0, 1 + gain * LENGTH * OFFSET**2 / EI), rtol=1e-9
    )


def test_a_muscle_that_overcomes_the_arm_is_unstable():
    """The fold of $T = a F (1 + c T d^2 / EI)$ is where $a F c d^2 = EI$."""
    slope = EI / OFFSET**2 / 2.0
    below, above = (vsr.solve(planar(slope), [x], model=MODEL) for x in (0.9, 1.1))
    assert below.status == vsr.Status.CONVERGED
    np.testing.assert_allclose(below.stability, 0.1, rtol=1e-6)
    assert above.status != vsr.Status.CONVERGED


def test_a_muscle_with_an_elastic_tendon():
    """A tendon of the stiffness k [N] in series: $T = a F (1 - c e)$, $l / l_0 - 1 = e + T / k$."""

    class Series(Muscle):
        cable_stiffness = 30.0

    slope, peak = 6.0, 1.0
    pull = Series(vsr.Parallel(OFFSET, 0.0), jnp.asarray(2 * peak), jnp.asarray(slope))
    scene = vsr.Scene(ARM, [pull], free_strains=["bending_z"])
    eq = vsr.solve(scene, [0.5], model=MODEL, throw=True)
    give = OFFSET**2 / EI + 1 / 30.0
    np.testing.assert_allclose(-eq.forces[0], peak / (1 - peak * slope * give), rtol=1e-9)
    gain = -peak * slope / LENGTH / (1 - peak * slope / 30.0)
    np.testing.assert_allclose(eq.stability, 1 + gain * LENGTH * OFFSET**2 / EI, rtol=1e-9)


@pytest.mark.slow
def test_the_law_of_a_cable_is_that_of_a_tendon_of_given_length():
    """A linear spring of a cable that only pulls, beside `Tendon(stiffness=...)`."""

    class Cable(Muscle):
        def law(self, thread, value):
            free = thread.rest + value
            return -thread.force - jnp.maximum(self.peak * (thread.length - free) / free, 0.0)

    def scene(first):
        return vsr.Scene(ARM, [first, vsr.Tendon(vsr.Helix(0.005, pitch=0.4))], [vsr.Gravity()])

    own = scene(Cable(vsr.Parallel(OFFSET, 0.0), jnp.asarray(40.0), jnp.asarray(0.0)))
    ours = scene(vsr.Tendon(vsr.Parallel(OFFSET, 0.0), control="length", stiffness=40.0))
    for inputs in ([-0.01, 0.4], [0.02, 0.4]):
        one, other = (vsr.solve(x, inputs, model=MODEL, throw=True) for x in (own, ours))
        np.testing.assert_allclose(one.tip, other.tip, atol=1e-9)
        np.testing.assert_allclose(one.forces, other.forces, atol=1e-7)


@pytest.mark.slow
def test_models_agree_on_a_muscle_under_gravity():
    scene = vsr.Scene(ARM, [muscle(3.0), muscle(-2.0, end=jnp.asarray(0.2))], [vsr.Gravity()])
    fine = vsr.solve(scene, [0.5, 0.2], model=vsr.StrainDependent(24), throw=True)
    continuum = vsr.solve(scene, [0.5, 0.2], model=vsr.Continuum(), throw=True)
    np.testing.assert_allclose(continuum.tip, fine.tip, atol=1e-6)
    basis = vsr.Basis.uniform(vsr.Legendre(12))
    projected = vsr.solve(scene, [0.5, 0.2], model=vsr.Prescribed(basis, steps=24), throw=True)
    np.testing.assert_allclose(projected.tip[:3, 3], fine.tip[:3, 3], atol=2e-4)


@pytest.mark.slow
def test_gradients_by_every_number_of_a_muscle():
    def height(p):
        pull = Muscle(vsr.Parallel(p[0], 0.001), p[1], p[2])
        scene = vsr.Scene(ARM, [pull, vsr.Thread(vsr.Parallel(0.0, 0.004))], [vsr.Gravity()])
        return vsr.solve(scene, [p[3], -0.3], model=MODEL).tip[2, 3]

    p = jnp.array([OFFSET, 2.0, 3.0, 0.5])
    both, h = with_derivative(height), 1e-3 * p
    reverse, forward = jax.jit(jax.grad(height))(p), both(p)[1]
    np.testing.assert_allclose(reverse, forward, rtol=1e-9, atol=1e-12)
    differences = central_differences(lambda z: both(p + h * z)[0], len(p)) / h
    np.testing.assert_allclose(forward, differences, rtol=1e-7)
    many = jax.jit(jax.vmap(height))(p * jnp.linspace(0.8, 1.1, 5)[:, None])
    each = [height(p * s) for s in np.linspace(0.8, 1.1, 5)]
    np.testing.assert_allclose(many, each, rtol=1e-9)


class Strut(Support):
    """A strut of given length between the tip and a point of the world."""

    anchor: jax.Array
    length: Scalar
    X: Scalar | None = None
    effect = "strut"
    units = ("m",)

    def deviation(self, base, rotation, position):
        apart = position - self.anchor
        return (jnp.sqrt(apart @ apart) - self.length)[None]


@pytest.mark.slow
def test_a_strut_is_a_spring_without_end():
    """Beside springs that are stiffer and stiffer, extrapolated in their compliance."""
    anchor, length, fine = jnp.array([0.25, 0.1, 0.1]), 0.16, vsr.StrainDependent(32)

    def scene(loads=(), held=()):
        tendon = vsr.Tendon(vsr.Parallel(OFFSET, 0.0))
        return vsr.Scene(ARM, [tendon], [vsr.Gravity(), *loads], held=held)

    def held(p):
        return vsr.solve(scene(held=[Strut(anchor, p)]), [0.3], model=fine)

    def distance(eq):
        return jnp.linalg.norm(eq.tip[:3, 3] - anchor)

    def limit(values):
        """Of a polynomial of second order in the compliance."""
        soft, middle, stiff = values
        return (soft - 6 * middle + 8 * stiff) / 3

    eq, stiffness = held(length), (5e2, 1e3, 2e3)
    assert eq.status == vsr.Status.CONVERGED
    # the constraint holds for the positions of the steps, whose error is of sixth order
    np.testing.assert_allclose(distance(eq), length, rtol=5e-10)
    springs = [
        vsr.solve(scene([vsr.Spring(anchor, k, length=length)]), [0.3], model=fine, throw=True)
        for k in stiffness
    ]
    np.testing.assert_allclose(eq.tip, limit([x.tip for x in springs]), atol=1e-9)
    np.testing.assert_allclose(eq.stability, limit([x.stability for x in springs]), rtol=1e-5)
    force, along = np.asarray(eq.supports[0, 3:]), (eq.tip[:3, 3] - anchor) / length
    pull = limit([k * (distance(x) - length) for k, x in zip(stiffness, springs, strict=True)])
    np.testing.assert_allclose(force, -pull * along, rtol=1e-5)
    slope, h = jax.jit(jax.grad(lambda p: held(p).tip[2, 3]))(length), 1e-5
    apart = held(length + h).tip[2, 3] - held(length - h).tip[2, 3]
    np.testing.assert_allclose(slope, apart / (2 * h), rtol=1e-6)


def test_supports_of_one_place_are_refused():
    strut = Strut(jnp.zeros(3), jnp.asarray(0.2))
    with pytest.raises(ValueError, match=r"Scene.held\[1\].X: got 0.3 m"):
        vsr.Scene(ARM, held=[strut, vsr.Held(position=(0.3, 0, 0))])
    assert isinstance(strut, eqx.Module)
