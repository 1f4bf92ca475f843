"""Poses of a base by the direction in which the arm points."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import vsr_jax as vsr
from vsr_jax.validation import rigid

WORDS = {
    "forward": (1, 0, 0),
    "back": (-1, 0, 0),
    "left": (0, 1, 0),
    "right": (0, -1, 0),
    "up": (0, 0, 1),
    "down": (0, 0, -1),
}


@pytest.mark.slow
@pytest.mark.parametrize(("word", "direction"), WORDS.items())
def test_a_word_is_a_direction(word, direction):
    g = vsr.pose(pointing=word)
    rigid("g", g)
    np.testing.assert_allclose(g[:3, 0], direction, atol=1e-15)
    np.testing.assert_array_equal(g, vsr.pose(pointing=[3 * x for x in direction]))


def test_the_arm_points_there_and_starts_at_the_position():
    base = vsr.pose((0.1, 0.2, 0.3), pointing="down")
    arm = vsr.Rod(0.3, vsr.Circular(0.01), vsr.Material(8e5, poisson=0.45), base=base)
    eq = vsr.solve(vsr.Scene(arm, [vsr.Tendon(vsr.Parallel(0.0, 0.005))]), jnp.array([0.0]))
    np.testing.assert_allclose(eq.tip[:3, 3], (0.1, 0.2, 0.0), atol=1e-12)
    np.testing.assert_allclose(eq.thread(0, 0.0), (0.105, 0.2, 0.3), atol=1e-12)


@pytest.mark.parametrize("near_back", [0.0, 1e-3, 1e-9, 1e-160])
def test_every_direction_gives_a_rotation_by_the_least_angle(near_back):
    t = np.array([-1.0, near_back, -2 * near_back])
    R = np.asarray(vsr.pose(pointing=t))[:3, :3]
    t = t / np.linalg.norm(t)
    np.testing.assert_allclose(R.T @ R, np.eye(3), atol=4e-15)
    np.testing.assert_allclose(R[:, 0], t, atol=1e-15)
    np.testing.assert_allclose((np.trace(R) - 1) / 2, t[0], atol=1e-14)  # cosine of the angle
    np.testing.assert_allclose(np.linalg.det(R), 1)


def test_single_precision_is_a_rigid_transform():
    for t in np.random.default_rng(0).normal(size=(50, 3)).astype(np.float32):
        g = vsr.pose(np.zeros(3, np.float32), pointing=t, roll=np.float32(0.3))
        assert g.dtype == jnp.float32
        R = np.asarray(g)[:3, :3].astype(float)
        np.testing.assert_allclose(R.T @ R, np.eye(3), atol=1e-6)


def test_roll_rotates_the_section_about_the_arm():
    g = vsr.pose(pointing="up", roll=np.pi / 2)
    flat = vsr.pose(pointing="up")
    np.testing.assert_allclose(g[:3, 0], (0, 0, 1), atol=1e-15)
    np.testing.assert_allclose(g[:3, 1], flat[:3, 2], atol=1e-15)


def test_derivatives_exist_in_every_direction():
    for t in [*WORDS.values(), (0.3, -0.4, 0.5)]:
        slope = jax.jacobian(lambda t: vsr.pose(pointing=t, roll=0.2))(jnp.array(t, float))
        assert np.all(np.isfinite(slope))
    t, h = jnp.array([-0.3, 0.4, 0.5]), 1e-6
    difference = (vsr.pose(pointing=t + h) - vsr.pose(pointing=t - h)) / (2 * h)
    _, slope = jax.jvp(lambda t: vsr.pose(pointing=t), (t,), (jnp.ones(3),))
    np.testing.assert_allclose(slope, difference, atol=1e-9)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"pointing": "sideways"}, "pose.pointing: got 'sideways', need one of 'forward', 'back'"),
        ({"pointing": (0, 0, 0)}, r"pose.pointing: got \(0, 0, 0\), need a direction, not zeros"),
        ({"pointing": (0, 1)}, r"pose.pointing: got shape \(2,\), need .*\(3,\)"),
        ({"position": (0, np.nan, 0)}, "pose.position: got .*, need finite"),
        ({"roll": (0, 1)}, r"pose.roll: got shape \(2,\), need a finite number"),
    ],
)
def test_errors(unchecked, arguments, message):
    with pytest.raises(ValueError, match=message):
        vsr.pose(**arguments)
