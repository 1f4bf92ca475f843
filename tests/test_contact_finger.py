"""A soft finger that closes on a fixed ball and opens again: Coulomb's law, and its balance from
the strain of its base."""

import pathlib

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import vsr_jax as vsr

FILE = pathlib.Path(__file__).parents[1] / "notebooks/scenes/finger.toml"
SCENE = vsr.load(FILE).scene
RADIUS, YOUNG, POISSON, OFFSET = 0.006, 1e6, 0.45, np.array([0.0, 0.0, -0.005])
FRICTION, CENTRE, BALL = 0.7, np.array([0.036, 0.0, -0.06]), 0.02
UP = np.arange(0.6, 7.3, 0.6)
PATH = np.concatenate([UP, UP[-2:3:-1]])


@jax.jit
def followed(friction):
    """Status, contacts, strain of the base and 201 points of the axis at every tension."""
    scene = SCENE.replace("obstacles[0].friction", friction)
    path = vsr.follow(scene, jnp.asarray(PATH)[:, None], model=vsr.StrainDependent(12))

    def seen(eq):
        axis = eq.position(jnp.linspace(0.0, 0.1, 201))
        return eq.status, eq.contacts, eq.strain(jnp.zeros(1))[0], axis

    return jax.vmap(seen)(path)


@pytest.fixture(scope="module")
def rough():
    return jax.tree.map(np.asarray, followed(FRICTION))


def totals(contacts):
    """Force [N] by the ball and its moment [N m] about the base: friction acts on the surface."""
    pushes = contacts.force[..., None] * contacts.normal + contacts.friction
    points = contacts.position - RADIUS * contacts.normal
    return pushes.sum((1, 2)), np.cross(points, pushes).sum((1, 2))


def carried(strain, tension):
    """Force and moment through the base, by rod and tendon, from the strain there."""
    area, inertia = np.pi * RADIUS**2, np.pi * RADIUS**4 / 4
    shear = YOUNG / (2 * (1 + POISSON))
    moment = np.array([2 * shear, YOUNG, YOUNG]) * inertia * strain[:3]
    force = np.array([YOUNG, shear, shear]) * area * (strain[3:] - np.array([1.0, 0.0, 0.0]))
    along = strain[3:] + np.cross(strain[:3], OFFSET)
    pull = tension * along / np.linalg.norm(along)
    return force + pull, moment + np.cross(OFFSET, pull)


@pytest.mark.slow
def test_base_and_ball_are_in_balance(rough):
    status, contacts, strain, _ = rough
    assert np.all(status == vsr.Status.CONVERGED)
    forces, moments = totals(contacts)
    at_base = [carried(x, tension) for x, tension in zip(strain, PATH, strict=True)]
    assert np.linalg.norm(forces, axis=1).max() > 0.5
    np.testing.assert_allclose([f for f, _ in at_base], forces, atol=1e-6)
    np.testing.assert_allclose([m for _, m in at_base], moments, atol=1e-7)


@pytest.mark.slow
def test_the_finger_stays_outside_the_ball(rough):
    gap = np.linalg.norm(rough[3] - CENTRE, axis=-1).min(axis=1) - BALL - RADIUS
    touches = rough[1].force.sum((1, 2)) > 1e-3
    assert np.all(gap > -1e-4 * RADIUS)
    assert np.all(gap[touches] < 1e-4 * RADIUS)
    assert touches.any()
    assert np.all(gap[~touches] > 1e-3)


@pytest.mark.slow
def test_friction_is_within_its_cone_and_the_finger_sticks_and_slips(rough):
    contacts = rough[1]
    push, rub = contacts.force[:, 0], contacts.friction[:, 0]
    assert np.all(np.linalg.norm(rub, axis=-1) <= FRICTION * push * (1 + 1e-6) + 1e-9)
    np.testing.assert_allclose(np.sum(rub * contacts.normal[:, 0], -1), 0.0, atol=1e-9)
    used = np.linalg.norm(rub.sum(1), axis=1) / (FRICTION * push.sum(1) + 1e-12)
    closing, opening = slice(8, UP.size), slice(UP.size, UP.size + 3)
    np.testing.assert_allclose(used[closing], 1.0, atol=1e-3)  # slips
    assert np.all(used[opening] < 0.99)  # sticks
    tips = rough[3][:, -1]
    assert np.linalg.norm(tips[UP.size + 2] - tips[UP.size - 1]) < 3e-4
    assert np.linalg.norm(tips[UP.size - 1] - tips[UP.size - 4]) > 1e-3


@pytest.mark.slow
def test_it_presses_less_while_opening(rough):
    pressed = rough[1].force.sum((1, 2))
    closing, opening = pressed[5 : UP.size - 1], pressed[UP.size : -1][::-1]
    np.testing.assert_array_equal(PATH[5 : UP.size - 1], PATH[UP.size : -1][::-1])
    lost = (closing - opening) / closing
    assert np.all(lost[1:] > 0.1)
    np.testing.assert_allclose(lost[0], 0.0, atol=1e-6)  # it slips back to where it first touched


@pytest.mark.slow
def test_without_friction_it_slips_off():
    status, contacts, _, _ = jax.tree.map(np.asarray, followed(0.0))
    pressed = contacts.force.sum((1, 2))
    assert np.all(status[:7] == vsr.Status.CONVERGED)
    assert status[7] == vsr.Status.UNSTABLE
    assert np.nanmax(pressed[:7]) < 0.2
