"""Paths of inputs: the hysteresis of friction against an independent integration along the cable,
and paths without friction."""

import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import vsr_jax as vsr
from vsr_jax.arm.scene_numbers import replaced

MODEL = vsr.StrainDependent(12)
LENGTH, MU = 0.3, 0.3
UP_AND_DOWN = np.concatenate([np.linspace(0, 6, 4), np.linspace(5, 0.5, 6), np.linspace(2, 6, 3)])


def stiff_sheath(name):
    """An arm that keeps its rest shape under these tensions, straight and then bent, or with a
    helical tendon; and the turning angle of the tendon's path over X."""
    material = vsr.Material(1e14, poisson=0.3)
    if name == "helix":
        radius, angle = 0.006, 1.2
        routing, curvature = vsr.Helix(radius, angle), None
        rate = np.cos(angle) ** 2 / radius / np.sin(angle)  # curvature times arc length over X

        def turned(X):
            return rate * X
    else:
        routing = vsr.Parallel(0.004, 0.0)
        curvature = vsr.Piecewise((0.1,), (0.0, 15.0))

        def turned(X):
            return 15.0 * np.maximum(X - 0.1, 0.0)

    rest = None if curvature is None else (0.0, 0.0, curvature, 1.0, 0.0, 0.0)
    rod = vsr.Rod(LENGTH, vsr.Circular(0.01), material, rest_strain=rest)
    return vsr.Scene(rod, [vsr.Tendon(routing, friction=MU)]), turned


def pulled_in_small_steps(tensions, angle):
    """Tension along a cable in a rigid sheath, by a chain of short pieces: each piece slips where
    the ratio of the tensions at its ends would leave the cone of friction, else keeps its own."""
    along, history = np.zeros(angle.size), []
    cone = np.exp(MU * np.diff(angle, prepend=0.0))
    for tension in tensions:
        before = tension
        for i, ratio in enumerate(cone):
            before = along[i] = np.clip(along[i], before / ratio, before * ratio)
        history.append(along.copy())
    return np.array(history)


@pytest.mark.parametrize(
    "name", [pytest.param("straight, then bent", marks=pytest.mark.slow), "helix"]
)
def test_tensions_in_a_rigid_sheath(name):
    scene, turned = stiff_sheath(name)
    path = vsr.follow(scene, UP_AND_DOWN[:, None], model=MODEL)
    assert np.all(path.status == 0)
    tension = -jax.vmap(lambda eq: eq.nodes.tau(eq.sound_forces)[0])(path)
    X = np.asarray(MODEL.grid(scene).X)
    order = np.argsort(X.ravel())
    expected = pulled_in_small_steps(UP_AND_DOWN, turned(X.ravel()[order]))
    found = np.asarray(tension).reshape(len(UP_AND_DOWN), -1)[:, order]
    np.testing.assert_allclose(found, expected, atol=1e-6)
    stuck = (np.abs(np.diff(expected, axis=0)) < 1e-12) & (expected[1:] > 0)
    assert stuck.any(), "no part of the cable sticks: the test shows nothing"


def soft(**options):
    rod = vsr.Rod(LENGTH, vsr.Circular(0.01), vsr.Material(6e5, poisson=0.45, density=300.0))
    loads = options.pop("loads", ())
    return vsr.Scene(rod, [vsr.Tendon(vsr.Helix(0.005, 1.5), friction=0.2, **options)], loads)


def tips(scene, tensions, **options):
    path = vsr.follow(scene, jnp.asarray(tensions)[:, None], model=MODEL, **options)
    assert np.all(path.status == 0)
    return jax.vmap(lambda eq: eq.tip[:3, 3])(path)


@pytest.mark.slow
def test_a_closed_cycle_returns_to_its_turning_point():
    """The hysteresis of a play operator: inner loops close, and the outer one ends where the first
    pull ended."""
    found = tips(soft(), [2.0, 4.0, 3.0, 4.0, 6.0, 3.5, 4.0, 6.0])
    pulled = [vsr.solve(soft(), [t], model=MODEL).tip[:3, 3] for t in (2.0, 4.0, 6.0)]
    for place, expected in zip((0, 1, 3, 4, 7), np.array(pulled)[[0, 1, 1, 2, 2]], strict=True):
        np.testing.assert_allclose(found[place], expected, atol=1e-9)
    assert np.linalg.norm(found[6] - pulled[1]) > 1e-3  # on the way back up, within the loop


def test_far_from_a_reversal_it_is_the_law_of_releasing():
    found = tips(soft(), [8.0] * 7 + [1.0])[-1]
    released = vsr.solve(soft(motion="release"), [1.0], model=MODEL)
    np.testing.assert_allclose(found, released.tip[:3, 3], atol=1e-9)


@pytest.mark.slow
def test_a_path_continues_in_parts():
    scene = soft(loads=[vsr.Gravity((0.0, 0.0, -2.0))])
    tensions = [1.0, 5.0, 3.0, 2.0, 4.0]
    whole = tips(scene, tensions)
    first = vsr.follow(scene, np.array(tensions[:3])[:, None], model=MODEL)
    last = jax.tree.map(lambda x: x[-1], first)
    np.testing.assert_allclose(tips(scene, tensions[3:], start=last), whole[3:], atol=1e-9)


@pytest.mark.slow
def test_gradients_by_the_past_and_by_the_friction():
    """Of a sample whose cable partly sticks: against differences, in both modes."""
    scene = soft()

    def height(tensions, mu):
        one = replaced(scene, {"actuators[0].friction": mu})
        path = vsr.follow(one, tensions[:, None], model=MODEL)
        return jax.vmap(lambda eq: eq.tip[2, 3])(path)[-1]

    at = jnp.array([2.0, 6.0, 5.2]), jnp.array(0.2)
    backward = jax.grad(height, argnums=(0, 1))(*at)
    ways = [(jnp.eye(3)[i], jnp.zeros(())) for i in range(3)] + [(jnp.zeros(3), jnp.ones(()))]
    run = jax.jit(height)
    for way, found in zip(ways, [*backward[0], backward[1]], strict=True):
        forward = jax.jvp(height, at, way)[1]
        np.testing.assert_allclose(forward, found, atol=1e-10)
        ends = [run(*jax.tree.map(lambda x, w, s=s: x + s * w, at, way)) for s in (1e-5, -1e-5)]
        np.testing.assert_allclose(found, (ends[0] - ends[1]) / 2e-5, atol=3e-7)
    assert abs(float(backward[0][1])) > 1e-4  # the past counts
    assert abs(float(backward[0][0])) < 1e-12  # except where it was overrun


@pytest.mark.slow
def test_lengths_with_friction():
    """Cable paid out and taken in again: the tension at the motor is lower on the way out."""
    scene = soft(control="length")
    path = vsr.follow(scene, jnp.array([-0.004, -0.010, -0.008, -0.006, -0.010])[:, None])
    assert np.all(path.status == 0)
    tension = -jax.vmap(lambda eq: eq.forces[0])(path)
    pulled = vsr.solve(scene, [-0.008])
    assert float(tension[2]) < -float(pulled.forces[0])
    np.testing.assert_allclose(tension[4], tension[1], rtol=1e-8)


@pytest.mark.slow
def test_paths_batch_and_in_single_precision():
    scene = soft()
    paths = jnp.array([[1.0, 4.0, 2.0], [3.0, 1.0, 2.0]])[..., None]
    both = jax.vmap(lambda u: vsr.follow(scene, u, model=MODEL).status)(paths)
    assert np.all(both == 0)
    ends = [
        jax.vmap(
            lambda u: jax.vmap(lambda eq: eq.tip[:3, 3])(vsr.follow(scene, u, model=MODEL))[-1]
        )(paths.astype(dtype))
        for dtype in ("float32", "float64")
    ]
    assert ends[0].dtype == jnp.float32
    np.testing.assert_allclose(*ends, atol=2e-6)
    np.testing.assert_allclose(ends[1][0], tips(scene, [1.0, 4.0, 2.0])[-1], atol=1e-9)


@pytest.mark.slow
def test_without_friction_the_arm_stays_in_its_equilibrium():
    """A soft column in gravity, bent to one side and let go, hangs over that side: the same inputs,
    two equilibria."""
    rod = vsr.Rod(0.3, vsr.Elliptic(0.006, 0.009), vsr.Material(3e5, poisson=0.45, density=1000.0))
    tendons = [vsr.Tendon(vsr.Parallel(y, 0.0)) for y in (0.004, -0.004)]
    scene = vsr.Scene(rod, tendons, [vsr.Gravity((-9.81, 0.0, 0.0))])
    path = jnp.array([[1.0, 0.0], [0.3, 0.0], [0.0, 0.0]])
    ends = []
    for inputs in (path, path[:, ::-1]):
        found = vsr.follow(scene, inputs, model=MODEL)
        assert np.all(found.status == 0)
        ends.append(jax.vmap(lambda eq: eq.tip[:3, 3])(found)[-1])
    np.testing.assert_allclose(ends[0], ends[1] * jnp.array([1.0, -1.0, 1.0]), atol=1e-8)
    assert abs(float(ends[0][1])) > 0.05


def test_a_sample_that_fails_is_passed_over():
    scene = soft()
    tensions = [2.0, -1.0, 5.0, jnp.nan, 3.0, 1.0, 4.0, 2.0]
    path = vsr.follow(scene, jnp.array(tensions)[:, None], model=MODEL)
    np.testing.assert_array_equal(
        path.status,
        [0, vsr.Status.INADMISSIBLE, 0, vsr.Status.NOT_FINITE, 0, 0, 0, 0],
    )
    found = jax.vmap(lambda eq: eq.tip[:3, 3])(path)
    alone = tips(scene, [2.0, 2.0, 5.0, 5.0, *tensions[4:]])
    for place in (0, 2, 4, 5, 6, 7):
        np.testing.assert_allclose(found[place], alone[place], atol=1e-9)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"inputs": [1.0, 2.0]}, r"inputs: got shape \(2,\), need \(samples, 1\)"),
        ({"inputs": np.zeros((0, 1))}, "inputs: got shape"),
    ],
)
def test_what_is_wrong_is_said(options, message):
    with pytest.raises(ValueError, match=message):
        vsr.follow(soft(), **{"inputs": [[1.0]], **options})


def test_a_start_of_another_model_is_refused():
    start = vsr.solve(soft(), [1.0], model=vsr.StrainDependent(8))
    with pytest.raises(ValueError, match="start: got an equilibrium by StrainDependent"):
        vsr.follow(soft(), [[1.0]], model=MODEL, start=start)


CRITICAL = 17.3
"""Angle [rad] at which a shaft between clamps buckles with T L^2 / EI = 31.8: M L / EI = 13.3."""


def hinged(angle):
    """An arm with a rubbing tendon whose tip a gripper turns and moves, from a base that turns."""
    rod = vsr.Rod(
        LENGTH,
        vsr.Circular(0.01),
        vsr.Material(1e6, poisson=0.45, density=1000.0),
        base=vsr.pose(pointing=jnp.stack([jnp.cos(angle), 0.0 * angle, jnp.sin(angle)])),
    )
    tendon = vsr.Tendon(vsr.Parallel(0.007, 0.0), friction=MU)
    load = vsr.TipWrench(force=(0.0, 0.1 * angle, 0.0))
    return vsr.Scene(rod, tendon, [vsr.Gravity(), load])


def test_a_path_of_one_scene_is_a_path_of_equal_scenes():
    angle, tensions = jnp.full(5, 0.3), jnp.array([0.0, 2.0, 4.0, 3.0, 1.0])[:, None]
    one = vsr.follow(hinged(angle[0]), tensions, model=MODEL)
    each = vsr.follow(jax.vmap(hinged)(angle), tensions, model=MODEL)
    tips = jax.vmap(lambda eq: eq.tip)
    np.testing.assert_allclose(tips(each), tips(one), atol=1e-13)


@pytest.mark.slow
def test_turns_are_counted_along_a_path_of_held_orientations():
    """A rod under tension between two clamps, the far one turned by three whole turns: its moment
    is G J times the twist, where a solve from rest finds no twist at whole turns. Beyond the
    critical angle the straight rod snaps, and the path says so."""
    rod = vsr.Rod(1.0, vsr.Circular(0.02), vsr.Material(1e9, poisson=0.3))
    turns = jnp.linspace(0, 6 * jnp.pi, 25)

    def scene_of(angle):
        c, s = jnp.cos(angle), jnp.sin(angle)
        one, zero = jnp.ones_like(angle), jnp.zeros_like(angle)
        turned = jnp.stack([one, zero, zero, zero, c, -s, zero, s, c]).reshape(3, 3)
        held = vsr.Held(position=(1.0, 0.0, 0.0), orientation=turned, along=(1.0, 0.0, 0.0))
        pull = vsr.TipWrench(force=(4e3, 0.0, 0.0))
        return vsr.Scene(rod, (), pull, held=held)

    scenes = jax.vmap(scene_of)(turns)
    path = vsr.follow(scenes, jnp.zeros((25, 0)), model=vsr.StrainDependent(8))
    assert np.all(path.status == 0)
    stiffness = 1e9 / 2.6 * np.pi / 2 * 0.02**4
    moment = jax.vmap(lambda eq: eq.supports[0, 0])(path)
    straight = turns < CRITICAL
    np.testing.assert_allclose(moment[straight], stiffness * turns[straight], atol=1e-6)
    assert not np.any(path.restarted[straight])
    assert path.restarted[np.sum(straight)]


def test_scenes_and_inputs_of_a_path_are_as_many():
    scenes = jax.vmap(hinged)(jnp.linspace(0, 0.2, 3))
    with pytest.raises(ValueError, match=r"got one for each of \(3,\) samples, need .* 4"):
        vsr.follow(scenes, jnp.zeros((4, 1)), model=MODEL)


@pytest.mark.slow
def test_a_base_that_turns_leaves_the_friction_of_its_way():
    """As the arm becomes straighter its tendon slips, and keeps that tension on the way back."""
    angle, tension = jnp.array([0.8, 0.4, 0.0, 0.4, 0.8]), jnp.full((5, 1), 3.0)
    path = vsr.follow(jax.vmap(hinged)(angle), tension, model=MODEL)
    assert np.all(path.status == 0)
    at_tip = -jax.vmap(lambda eq: eq.nodes.tau(eq.sound_forces)[0][-1, -1])(path)
    assert np.all(np.diff(at_tip[:3]) > 1e-3)
    np.testing.assert_allclose(at_tip[2:], at_tip[2], rtol=1e-9)


@pytest.mark.slow
def test_gradients_by_a_path_of_scenes():
    """Where nothing remembers the past, each sample is one solve."""
    t, weight = jnp.linspace(0.0, 1.0, 3), jnp.array([[1.0, 2, 3], [2, -1, 1], [0.5, 3, 2]])
    rod = vsr.Rod(0.3, vsr.Circular(0.005), vsr.Material(1e7, poisson=0.3, density=1000.0))

    def scene_of(t, way):
        end = jnp.stack([0.27 - 0.02 * t * way, 0.02 * way, 0.01 + 0 * t])
        return vsr.Scene(rod, loads=vsr.Gravity(), held=vsr.Held(position=end))

    def one(t, way):
        return vsr.solve(scene_of(t, way), [], model=vsr.StrainDependent(4)).pose(0.15)[:3, 3]

    def followed(way):
        scenes = jax.vmap(lambda t: scene_of(t, way))(t)
        path = vsr.follow(scenes, jnp.zeros((3, 0)), model=vsr.StrainDependent(4))
        return jnp.sum(weight * jax.vmap(lambda eq: eq.pose(0.15)[:3, 3])(path))

    alone = jax.jit(lambda way: jnp.sum(weight * jax.vmap(lambda t: one(t, way))(t)))
    np.testing.assert_allclose(followed(1.0), alone(1.0), rtol=1e-9)
    step = 1e-4
    difference = (alone(1 + step) - alone(1 - step)) / (2 * step)
    np.testing.assert_allclose(jax.grad(followed)(1.0), difference, rtol=1e-7)
    np.testing.assert_allclose(jax.jvp(followed, (1.0,), (1.0,))[1], difference, rtol=1e-7)


@pytest.mark.slow
def test_samples_that_are_not_solved_are_approached_in_smaller_steps():
    """Six elastic cables that rub bend an arm there and back: some samples are not solved at once.
    The path with smaller steps there is the same."""
    rod = vsr.Rod(
        0.2,
        vsr.Circular(5e-4),
        vsr.Material(60e9, poisson=0.3, density=6450.0),
        discs=vsr.Discs(20, radius=0.0088, mass=2e-4),
    )
    angles, whole = np.pi / 3 * np.arange(6), np.array([False, True] * 3)
    tendons = [
        vsr.Tendon(
            vsr.Parallel(0.008 * np.cos(a), 0.008 * np.sin(a)),
            end=None if to_tip else 0.1,
            control="length",
            stiffness=5e3,
            friction=0.1,
        )
        for a, to_tip in zip(angles, whole, strict=True)
    ]
    robot = vsr.Scene(rod, tendons, [vsr.Gravity(), vsr.Payload(0.02)])
    random = np.random.default_rng(0)
    bends, towards = random.uniform(0.3, 1.2, 2), random.uniform(0, 2 * np.pi, 2)
    pulls = 0.008 * bends[:, None] * np.cos(towards[:, None] - angles)
    pull = pulls[0] + np.where(whole, pulls[1], 0.0)
    path = -np.interp(np.arange(26), [0, 13, 25], [0.0, 1.0, 0.0])[:, None] * pull
    model = vsr.StrainDependent(20)
    with pytest.warns(UserWarning, match=r"follow: samples were approached .*: 3 in 2") as said:
        found = vsr.follow(robot, path, model=model)
    smaller = re.findall(r"(\d+) in (\d+)", str(said[0].message))
    parts = np.ones(len(path), int)
    for sample, number in smaller:
        parts[int(sample)] = int(number)
    assert np.all(found.status == vsr.Status.CONVERGED)
    under_jit = jax.jit(lambda u: vsr.follow(robot, u, model=model).status)(path)
    assert np.flatnonzero(under_jit).tolist() == [3]
    ends = np.cumsum(parts) - 1
    more = np.stack([np.interp(np.arange(ends[-1] + 1), ends, one) for one in path.T], axis=1)
    expected = vsr.follow(robot, more, model=model)
    forces, others = (jax.vmap(lambda eq: eq.forces)(eqs) for eqs in (found, expected))
    np.testing.assert_allclose(forces, others[ends], atol=1e-6)
