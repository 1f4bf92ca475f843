"""Solves that start from an equilibrium near by: fewer steps, the same equilibrium, the same
derivatives."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import vsr_jax as vsr
from vsr_jax.studies import paper

MODEL = vsr.StrainDependent(8)


def arm(first=vsr.Tendon, second=vsr.Tendon):
    rod = vsr.Rod(0.3, vsr.Circular(0.01), vsr.Material(1e6, poisson=0.45, density=1000.0))
    tendons = [first(vsr.Parallel(0.007, 0.0)), second(vsr.Helix(0.007, pitch=0.4))]
    return vsr.Scene(rod, tendons, loads=[vsr.Gravity((0.0, 0.0, -2.0))])


@pytest.fixture(scope="module")
def scene():
    return arm()


@pytest.fixture(scope="module")
def near(scene):
    return vsr.solve(scene, [3.0, 1.5], model=MODEL)


def solved(scene, inputs, start=None):
    return vsr.solve(scene, inputs, model=MODEL, start=start)


def agree(warm, cold):
    """Whether two results are the same equilibrium, found."""
    assert bool(warm.converged)
    assert bool(cold.converged)
    np.testing.assert_allclose(warm.tip, cold.tip, atol=1e-11)


@pytest.mark.slow
def test_a_small_change_takes_fewer_steps(scene, near):
    moved = jnp.array([3.03, 1.515])
    warm, cold = solved(scene, moved, near), solved(scene, moved)
    assert int(warm.steps) < int(cold.steps)
    agree(warm, cold)


@pytest.mark.parametrize("loads", [(), vsr.Gravity((0.0, 0.0, -2.0))], ids=["bare", "gravity"])
def test_a_control_loop_is_a_scan_of_three_steps_each(loads):
    """Inputs change by half a percent from one solve to the next; the first one has no start."""
    robot = vsr.Scene(arm().rod, arm().actuators, loads)
    inputs = jnp.array([3.0, 1.5]) * (1 + 0.005 * jnp.arange(20.0)[:, None])

    def following(eq, now):
        eq = solved(robot, now, eq)
        return eq, (eq.steps, eq.tip)

    last, (steps, tips) = jax.lax.scan(following, solved(robot, inputs[0]), inputs[1:])
    assert int(jnp.max(steps)) <= 3
    np.testing.assert_array_equal(tips[-1], last.tip)
    agree(last, solved(robot, inputs[-1]))


@pytest.mark.slow
def test_a_soft_arm_in_its_basin_takes_less_than_half_of_the_steps():
    paper_arm = paper.scene("B1")
    material = vsr.Material(5.93e5, shear=2.0e5, density=1080.0)
    rod = vsr.Rod(paper_arm.rod.length, paper_arm.rod.section, material)
    soft = vsr.Scene(rod, paper_arm.actuators, loads=[vsr.Gravity()])
    model = vsr.StrainDependent(16)
    near = vsr.solve(soft, [-10.0], model=model)
    cold = vsr.solve(soft, [-10.1], model=model)
    warm = vsr.solve(soft, [-10.1], model=model, start=near)
    assert 2 * int(warm.steps) < int(cold.steps)
    agree(warm, cold)


@pytest.mark.slow
def test_tensions_and_turning_rates_start_too():
    scene = arm(partial(vsr.Tendon, control="length"), partial(vsr.Tendon, friction=0.2))
    near, moved = solved(scene, [-0.01, 1.5]), [-0.0101, 1.515]
    warm, cold = solved(scene, moved, near), solved(scene, moved)
    assert int(warm.steps) < int(cold.steps)
    agree(warm, cold)


@pytest.mark.slow
def test_a_hopeless_start_costs_a_step_and_nothing_else(scene):
    far = solved(scene, [20.0, 0.0])
    assert bool(far.converged)
    warm, cold = solved(scene, [0.0, 1.0], far), solved(scene, [0.0, 1.0])
    agree(warm, cold)


@pytest.mark.slow
def test_starts_of_other_models_and_failed_starts_are_of_use_or_harmless(scene, near):
    basis = vsr.Prescribed(vsr.Basis.uniform(vsr.Legendre(3)), steps=8)
    for start in (
        vsr.solve(scene, [3.0, 1.5], model=basis),
        vsr.solve(scene, [3.0, 1.5], model=vsr.StrainDependent(5, order=4)),
        solved(scene, [1e4, 0.0]),  # collapsed
    ):
        agree(solved(scene, [3.1, 1.5], start), solved(scene, [3.1, 1.5]))


@pytest.mark.slow
def test_derivatives_are_those_without_a_start(scene, near):
    def height(inputs, start):
        return solved(scene, inputs, start).tip[2, 3]

    inputs = jnp.array([3.1, 1.4])
    for derivative in (jax.grad, jax.jacfwd):
        cold = derivative(height)(inputs, None)
        assert np.all(np.isfinite(cold))
        np.testing.assert_allclose(derivative(height)(inputs, near), cold, rtol=1e-9)


@pytest.mark.slow
def test_a_batch_starts_from_one_or_from_many(scene, near):
    inputs = jnp.array([[3.0, 1.5], [3.1, 1.4], [2.9, 1.6]])
    batch = jax.jit(jax.vmap(lambda u: solved(scene, u)))
    cold, starts = jax.vmap(lambda eq: eq.tip)(batch(inputs)), batch(inputs + 0.05)
    one = jax.vmap(lambda u: solved(scene, u, near).tip)(inputs)
    many = jax.vmap(lambda u, start: solved(scene, u, start).tip)(inputs, starts)
    assert np.all(np.isfinite(cold))
    np.testing.assert_allclose(one, cold, atol=1e-12)
    np.testing.assert_allclose(many, cold, atol=1e-12)


def test_a_start_of_other_actuators_is_an_error(scene, near, unchecked):
    other = vsr.Scene(scene.rod, scene.actuators[:1], loads=scene.loads)
    with pytest.raises(ValueError, match=r"start: got an equilibrium of a scene with the actuat"):
        solved(other, [3.0], near)
    with pytest.raises(ValueError, match=r"start: got Array"):
        solved(scene, [3.0, 1.5], near.tip)


@pytest.mark.slow
def test_an_arch_that_snaps_says_that_it_left_its_branch():
    """An arch between a clamp and a pin, pushed up; then up by less, and down."""
    arch = vsr.Rod(1.0, vsr.Circular(0.01), vsr.Material(1e9, poisson=0.3))
    unit = 1e9 * np.pi / 4 * 0.01**4

    def pushed(load, start=None):
        load = vsr.DistributedWrench(force=(0.0, 0.0, load * unit))
        scene = vsr.Scene(arch, (), load, held=vsr.Held(position=(0.95, 0.0, 0.0)))
        return vsr.solve(scene, [], model=vsr.StrainDependent(16), start=start, throw=True)

    up = pushed(20.0)
    assert float(up.position(0.5)[2]) > 0.1
    held, snapped = pushed(10.0, up), pushed(-10.0, up)
    assert float(held.position(0.5)[2]) > 0.1
    assert float(snapped.position(0.5)[2]) < -0.1
    assert [bool(eq.restarted) for eq in (up, held, snapped)] == [False, False, True]
    assert "another branch" not in str(held)
    assert "another branch" in str(snapped)
    assert "another branch" in snapped.heading[-1]
