"""Forces of grippers and obstacles as measurements of a fit."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import vsr_jax as vsr

MODEL = vsr.StrainDependent(6)
OFFSET, TURN, PLACE = [0.02, -0.01, 0.03], [0.1, -0.2, 0.15], [0.01, 0.0, -0.02]
MOMENT_OFFSET = [1e-3, -2e-3, 5e-4]


def rod(young=1e6):
    return vsr.Rod(0.2, vsr.Circular(0.004), vsr.Material(young, poisson=0.45, density=1080.0))


def gripped(young=1e6):
    held = vsr.Held(position=(0.19, 0.0, 0.02), orientation=np.eye(3))
    inputs = [vsr.Input("held[0].position"), vsr.Input("held[0].orientation")]
    return vsr.Scene(rod(young), loads=vsr.Gravity(), held=held, driven=inputs)


def grips():
    rng = np.random.default_rng(0)
    places = np.array([0.18, 0.0, 0.01]) + rng.uniform(-0.01, 0.01, (6, 3))
    return np.concatenate([places, rng.uniform(-0.4, 0.4, (6, 3))], axis=1)


def shown(inputs, wrenches):
    """What a sensor behind the gripper shows, by free-body statics in NumPy: forces and moments."""
    forces, moments = [], []
    for u, wrench in zip(inputs, np.asarray(wrenches), strict=True):
        grip = Rotation.from_rotvec(u[3:]).as_matrix()
        sensor = grip @ Rotation.from_rotvec(TURN).as_matrix()
        lever = -grip @ np.array(PLACE)  # from the sensor to the section
        moments.append(sensor.T @ (wrench[:3] + np.cross(lever, wrench[3:])) + MOMENT_OFFSET)
        forces.append(sensor.T @ wrench[3:] + OFFSET)
    return np.array(forces), np.array(moments)


@pytest.mark.slow
def test_a_sensor_in_a_gripper_tells_stiffness_frame_and_offset():
    inputs = grips()
    eqs = jax.vmap(lambda u: vsr.solve(gripped(), u, model=MODEL))(jnp.asarray(inputs))
    forces, moments = shown(inputs, jax.vmap(lambda eq: eq.supports[0])(eqs))
    sensor = vsr.Reactions(forces, moments, sd=1e-3, sd_moment=1e-4, name="gripper")
    assert sensor.labels == ("gripper[0]", "gripper[0] moment")
    assert sensor.units == ("N", "N m")
    free = {
        "rod.material.young": (5e5, 2e6),
        "gripper.offset": (-0.1, 0.1),
        "gripper.moment_offset": (-0.01, 0.01),
        "gripper.turn": (-0.5, 0.5),
        "gripper.place": (-0.05, 0.05),
    }
    data = vsr.Measurements(inputs, sensor)
    found = vsr.fit(gripped(8e5), free, data, model=MODEL, progress=False)
    assert found.converged
    wanted = [1e6, *OFFSET, *MOMENT_OFFSET, *TURN, *PLACE]
    np.testing.assert_allclose(found.x, wanted, rtol=1e-4, atol=1e-6)


@pytest.mark.slow
def test_a_force_plate_tells_the_weight_that_lies_on_it():
    """An arm that is pressed on a floor: the plate bears what the base does not."""
    floor = vsr.Plane(point=(0, 0, -0.02), normal=(0, 0, 1))
    inputs = [vsr.Input("loads[1].force[2]"), vsr.Input("loads[1].force[1]")]

    def scene(young):
        loads = [vsr.Gravity(), vsr.TipWrench(force=(0.0, 0.0, 0.0))]
        return vsr.Scene(rod(young), loads=loads, obstacles=floor, driven=inputs)

    pushes = np.array([[-0.1, 0.0], [-0.2, 0.02], [-0.3, -0.02], [-0.15, 0.05]])
    seen = []
    for push in pushes:
        eq = vsr.solve(scene(1e6), push, model=MODEL)
        base = np.asarray(eq.reaction(0.0))[3:]  # in the axes of the base, which are the world's
        weight = 1080.0 * np.pi * 0.004**2 * 9.81 * 0.2
        plate = np.array([0.0, -push[1], weight - push[0]]) + base
        np.testing.assert_allclose(plate[:2], 0, atol=1e-8)
        seen.append(Rotation.from_rotvec([0.1, 0.0, 0.0]).as_matrix().T @ plate + OFFSET)
    plate = vsr.ContactForces(np.array(seen), sd=1e-3, name="plate")
    free = {
        "rod.material.young": (5e5, 2e6),
        "plate.offset": (-0.1, 0.1),
        "plate.turn": ([[-0.5, 0.0, 0.0]], [[0.5, 0.0, 0.0]]),
    }
    found = vsr.fit(
        scene(1.2e6), free, vsr.Measurements(pushes, plate), model=MODEL, progress=False
    )
    assert found.converged
    np.testing.assert_allclose(found.x[:5], [1e6, *OFFSET, 0.1], rtol=1e-3, atol=1e-5)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((np.zeros((4, 2, 3)),), "reactions.force: got 2 rows, need 1, one for each held section"),
        ((np.zeros((4, 3)), np.zeros((3, 3))), "reactions.moment: got shape"),
    ],
)
def test_reactions_refuse(arguments, message):
    with pytest.raises(ValueError, match=message):
        vsr.Reactions(*arguments)


def test_reactions_need_a_deviation_for_each():
    for given in ({"sd": 1.0}, {"sd_moment": 1.0}):
        with pytest.raises(ValueError, match=r"reactions.sd: got"):
            vsr.Reactions(np.zeros((4, 3)), np.zeros((4, 3)), **given)
    with pytest.raises(ValueError, match=r"contacts.force: got 1 rows, need 2"):
        vsr.ContactForces(np.zeros((4, 3)), obstacles=(0, 1))
