"""Friction of contact along paths of inputs, against an elastica with Coulomb's law by shooting."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.optimize import root

import vsr_jax as vsr
from vsr_jax.studies import effects

LENGTH, RADIUS, YOUNG, ARM, FLOOR = 0.2, 0.005, 1e6, 0.004, -0.03
BENDING = YOUNG * np.pi * RADIUS**4 / 4
MODEL = vsr.StrainDependent(24)
UP = np.linspace(0.0, 1.0, 11)
PATH = np.concatenate([UP, UP[-2:3:-1]])


def arm(friction, *, normal=(0.0, 0.0, 1.0)):
    """An arm that a tendon bends down onto a floor."""
    rod = vsr.Rod(LENGTH, vsr.Circular(RADIUS), vsr.Material(YOUNG, poisson=0.3))
    floor = vsr.Plane(normal, (0.0, 0.0, FLOOR), friction=friction)
    return vsr.Scene(
        rod, [vsr.Tendon(vsr.Parallel(0.0, -ARM))], free_strains="bending_y", obstacles=[floor]
    )


@jax.jit
def followed(friction, path):
    """Tips, contact forces and friction (samples, ...) along a path of tensions."""

    def seen(eq):
        contacts = eq.contacts
        return eq.status, eq.tip[:3, 3], contacts.force.sum(), contacts.friction.sum((0, 1))

    return jax.vmap(seen)(vsr.follow(arm(friction), path[:, None], model=MODEL))


class Elastica:
    """An inextensible planar elastica whose tip is on the floor, with Coulomb's law for the lowest
    point of its last section. A state is x and angle of the end, and the force there."""

    def __init__(self, friction):
        self.friction = friction

    def base(self, tension, height, angle, force):
        """Where the elastica starts, integrated from its end at x = 0 and a given height."""
        moment = -RADIUS * force[0] + ARM * tension  # of friction below the axis, of the tendon

        def rate(s, y):
            x, z, turn = y
            bend = moment + (height - z) * force[0] + x * force[1]
            return -np.cos(turn), np.sin(turn), -bend / BENDING

        start = (0.0, height, angle)
        return solve_ivp(rate, (0, LENGTH), start, method="DOP853", rtol=1e-11, atol=1e-13).y[:, -1]

    def solved(self, tension, before, law):
        """The state at which the end is on the floor; `law` of a state is the last condition. None
        where there is none: an arm cannot stick where it is too short."""
        scale = np.array([1.0, *2 * [BENDING / LENGTH**2]])

        def gaps(q):
            x, z, turn = self.base(tension, FLOOR + RADIUS, q[0], scale[1:] * q[1:])
            return z / LENGTH, turn, law(-x, q[0], scale[1:] * q[1:])

        q = root(gaps, np.array([before[1], *before[2]]) / scale, tol=1e-12).x
        if np.max(np.abs(gaps(q))) > 1e-9:
            return None
        x, _, _ = self.base(tension, FLOOR + RADIUS, q[0], scale[1:] * q[1:])
        return -x, q[0], scale[1:] * q[1:]

    def step(self, tension, before):
        """The next state of a path."""
        angle = ARM * tension * LENGTH / BENDING
        x, z, _ = self.base(tension, 0.0, angle, np.zeros(2))
        if -z > FLOOR + RADIUS:
            return -x, angle, np.zeros(2)
        unit = BENDING / LENGTH**2

        def moved(x, angle):
            return (x - before[0] + RADIUS * np.sin(before[1] - angle)) / LENGTH

        sticking = self.solved(tension, before, lambda x, angle, f: moved(x, angle))
        if sticking is not None and abs(sticking[2][0]) <= self.friction * sticking[2][1]:
            return sticking
        for sign in (1.0, -1.0):
            slipping = self.solved(
                tension,
                before,
                lambda x, angle, f, s=sign: (f[0] + s * self.friction * f[1]) / unit,
            )
            if slipping is not None and sign * moved(*slipping[:2]) > 0:
                return slipping
        raise AssertionError("neither sticks nor slips")

    def path(self, tensions):
        """Places x of the end and forces there along a path."""
        states = [(LENGTH, 0.0, np.zeros(2))]
        for tension in tensions:
            states.append(self.step(tension, states[-1]))
        return np.array([x for x, _, _ in states[1:]]), np.array([f for _, _, f in states[1:]])


@pytest.mark.slow
@pytest.mark.parametrize(("friction", "sticking"), [(0.3, 0), (1.0, 2)])
def test_a_finger_sticks_and_slips_on_a_floor(friction, sticking):
    status, tips, force, rubbing = followed(friction, PATH)
    ends, forces = Elastica(friction).path(PATH)
    assert np.all(status == vsr.Status.CONVERGED)
    sticks = np.abs(forces[:, 0]) < 0.999 * friction * forces[:, 1]
    assert sticks.sum() == sticking
    assert np.unique(np.sign(np.round(forces[~sticks, 0], 6))).size == 3, (
        "it does not slip both ways"
    )
    np.testing.assert_allclose(tips[:, 0], ends, atol=4e-5 * LENGTH)
    scale = 3 * BENDING / LENGTH**2
    np.testing.assert_allclose(force, forces[:, 1], atol=1e-3 * scale)
    np.testing.assert_allclose(rubbing[:, 0], forces[:, 0], atol=1e-3 * scale)
    np.testing.assert_allclose(rubbing[:, 1:], 0.0, atol=1e-9 * scale)


def test_friction_keeps_to_coulombs_law():
    _, _, force, rubbing = followed(0.3, PATH)
    size = np.linalg.norm(rubbing, axis=1)
    assert np.all(size <= 0.3 * force * (1 + 1e-6) + 1e-12)
    assert size.max() > 1e-3 * force.max()


def test_without_friction_a_path_has_no_memory():
    _, tips, _, rubbing = followed(0.0, PATH)
    np.testing.assert_allclose(tips[len(UP)], tips[len(UP) - 2], atol=1e-9)
    np.testing.assert_allclose(rubbing, 0.0, atol=1e-15)


@pytest.mark.slow
def test_one_equilibrium_has_no_friction():
    tension = jnp.array([0.8])
    rough, smooth = (vsr.solve(arm(friction), tension, model=MODEL) for friction in (0.5, None))
    np.testing.assert_allclose(rough.tip, smooth.tip, atol=1e-10)
    assert not np.any(rough.contacts.friction)


@pytest.mark.slow
def test_a_path_goes_on_from_an_equilibrium():
    whole = vsr.follow(arm(0.3), PATH[:, None], model=MODEL)
    middle = jax.tree.map(lambda x: x[7], whole)
    rest = vsr.follow(arm(0.3), PATH[8:, None], model=MODEL, start=middle)
    tips = [jax.vmap(lambda eq: eq.tip)(one) for one in (whole, rest)]
    np.testing.assert_allclose(tips[0][8:], tips[1], atol=1e-10)


@pytest.mark.slow
def test_random_paths_on_a_pillar_are_solved():
    """Each bends and straightens in 12 samples; halved steps were taken for linear convergence, and
    contacts that slipped far were first taken to stick: 11 of the 384 failed."""
    rough, samples = effects.scenes()[-1], 12
    model = vsr.StrainDependent(8)
    share = np.minimum(np.arange(1, samples + 1), np.arange(samples, 0, -1)) / (samples / 2)

    @jax.jit
    @jax.vmap
    def path(inputs):
        found = vsr.follow(rough.scene, share[:, None] * inputs, model=model)
        return found.status, found.steps

    scale = np.random.default_rng(1).uniform(0.5, 1.5, (32, 2))
    status, steps = path(scale * np.array(rough.inputs))
    assert np.all(status == vsr.Status.CONVERGED)
    assert steps.mean() < 15


@pytest.mark.slow
def test_derivatives_by_friction_and_past_inputs():
    def height(values):
        return followed(values[0], values[1:])[1][-1, 0]

    at = jnp.concatenate([jnp.array([0.3]), PATH])
    back, forth = jax.grad(height)(at), jax.jacfwd(height)(at)
    np.testing.assert_allclose(back, forth, rtol=1e-6, atol=1e-9)
    for i in (0, 6, len(UP), len(at) - 1):
        e = 1e-5 * jnp.eye(len(at))[i]
        slope = (height(at + e) - height(at - e)) / 2e-5
        np.testing.assert_allclose(back[i], slope, rtol=1e-4, atol=1e-7)


@pytest.mark.slow
def test_a_batch_and_single_precision():
    frictions = jnp.array([0.1, 0.3, 1.0])
    together = jax.vmap(lambda mu: followed(mu, PATH)[1])(frictions)
    for mu, tips in zip(frictions, together, strict=True):
        np.testing.assert_allclose(tips, followed(mu, PATH)[1], atol=1e-9)
    status, single, _, _ = followed(jnp.float32(0.3), PATH.astype(np.float32))
    assert single.dtype == jnp.float32
    assert np.all(status == vsr.Status.CONVERGED)
    error = np.max(np.abs(single - together[1]), axis=1) / LENGTH
    assert np.median(error) < 1e-6
    # where slip turns round it is less exact: 5e-4 with the compiler options of these tests
    assert np.max(error) < 1e-3


@pytest.mark.parametrize("friction", [-0.1, np.nan])
def test_a_coefficient_that_is_none(friction):
    with pytest.raises(ValueError, match=r"Sphere\.friction: got .* need a finite number >= 0"):
        vsr.Sphere((0.0, 0.0, 0.0), 0.01, friction=friction)
