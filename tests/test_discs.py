"""Tendons that run straight from disc to disc."""

from itertools import pairwise

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import central_differences, checked_derivative, epsilon
from scipy.integrate import solve_ivp
from scipy.optimize import brentq

import vsr_jax as vsr
from benchmarks import (
    bench_discs,
    disc_search,
    measured_helical,
    rods_between_discs,
    straight_tendons,
)
from vsr_jax.files.scene_file import parse_scene, to_toml

LENGTH, RADIUS, YOUNG = 0.3, 0.01, 1e6
MATERIAL = vsr.Material(YOUNG, poisson=0.45, density=1000.0)
EI = YOUNG * np.pi / 4 * RADIUS**4
STEPS, FINE = vsr.StrainDependent(12), vsr.StrainDependent(36)
TENSIONS = jnp.array([3.0, 2.0])
PATHS = vsr.Parallel(0.007, 0.0), vsr.Helix(0.007, pitch=0.4, phase=2.0)


def arm(discs=None):
    """A rod with discs."""
    if isinstance(discs, int):
        discs = vsr.Discs(discs)
    elif discs is not None and not isinstance(discs, vsr.Discs):
        discs = vsr.Discs(places=discs)
    return vsr.Rod(LENGTH, vsr.Circular(RADIUS), MATERIAL, discs=discs)


def scene(loads=(), discs=None, **options):
    """The arm with two tendons, straight ones if it has discs."""
    straight = discs is not None
    return vsr.Scene(
        arm(discs), [vsr.Tendon(path, straight=straight, **options) for path in PATHS], loads
    )


@pytest.fixture(scope="module")
def weighed():
    """An arm with gravity and two tendons through three discs."""
    return vsr.solve(scene([vsr.Gravity()], discs=3), TENSIONS, model=FINE, throw=True)


def planar_segment(tension, offset, length):
    """Pose (x, y, angle) at the end of an inextensible piece between two discs, by shooting for the
    direction of the chord: $EI \\theta' = T (r - p) \\times e$ with p the first hole."""

    def end(angle):
        along = np.cos(angle), np.sin(angle)

        def rate(_, state):
            x, y, theta = state
            moment = x * along[1] - (y - offset) * along[0]
            return np.cos(theta), np.sin(theta), tension / EI * moment

        return solve_ivp(rate, (0, length), (0, 0, 0), rtol=1e-12, atol=1e-14).y[:, -1]

    def aside(angle):
        x, y, theta = end(angle)
        hole = x - offset * np.sin(theta), y + offset * (np.cos(theta) - 1)
        return hole[1] * np.cos(angle) - hole[0] * np.sin(angle)

    return end(brentq(aside, -0.2, 1.5, xtol=1e-14))


@pytest.mark.slow
@pytest.mark.parametrize(("discs", "tension"), [(1, 0.4), (3, 4.0)])
def test_an_arm_in_a_plane_is_that_of_a_separate_integration(discs, tension):
    tendon = vsr.Tendon(vsr.Parallel(0.007, 0.0), straight=True)
    plane = vsr.Scene(arm(discs), [tendon], free_strains=["bending_z"])
    eq = vsr.solve(plane, [tension], model=vsr.StrainDependent(24), throw=True)
    x, y, angle = planar_segment(tension, 0.007, LENGTH / discs)
    place, turned = np.zeros(2), 0.0
    for _ in range(discs):
        c, s = np.cos(turned), np.sin(turned)
        place = place + np.array([c * x - s * y, s * x + c * y])
        turned += angle
    assert turned > 0.15
    np.testing.assert_allclose(eq.tip[:2, 3], place, atol=1e-8)
    chord = np.hypot(x - 0.007 * np.sin(angle), y + 0.007 * (np.cos(angle) - 1))
    np.testing.assert_allclose(eq.lengths, [discs * chord], rtol=1e-8)


def test_a_robot_of_two_sections_is_that_of_rods_between_its_discs():
    discs, length = 3, 2 * straight_tendons.LENGTH
    places = jnp.linspace(0, length, 2 * discs + 1)
    for case in list(straight_tendons.ROBOT_CASES.values())[-2:]:
        robot = straight_tendons.robot(discs).replace("loads[0].force", case.force)
        found = vsr.solve(robot, case.tensions, throw=True).position(places)
        expected = rods_between_discs.solve(straight_tendons.rods(discs, case), axial=True)
        np.testing.assert_allclose(found, expected, atol=2e-6 * length)


@pytest.mark.slow
@pytest.mark.parametrize("discs", [1, 3])
def test_a_central_tendon_buckles_the_arm_between_its_discs(discs):
    r"""At $T = \pi^2 EI / s^2$, with sines between discs at distance s and the margin $1 - T s^2 /
    (\pi^2 EI)$. A tendon along the section never does."""
    critical = np.pi**2 * EI / (LENGTH / discs) ** 2
    names = ["bending_y", "bending_z"]
    tendon = vsr.Tendon(vsr.Parallel(0.0, 0.0), straight=True)
    pressed = vsr.Scene(arm(discs), [tendon], free_strains=names)
    eq = vsr.solve(pressed, [0.98 * critical], model=STEPS, throw=True)
    np.testing.assert_allclose(eq.stability, 0.02, atol=1e-5)
    np.testing.assert_allclose(eq.tip[:3, 3], [LENGTH, 0, 0], atol=1e-12)
    beyond = vsr.solve(pressed, [1.02 * critical], model=STEPS)
    assert beyond.status == vsr.Status.UNSTABLE
    along = vsr.Scene(arm(), [vsr.Tendon(vsr.Parallel(0.0, 0.0))], free_strains=names)
    assert vsr.solve(along, [1.02 * critical], model=STEPS).converged


@pytest.mark.slow
def test_many_discs_approach_the_path_at_second_order():
    usual = vsr.solve(scene(), TENSIONS / 3, model=vsr.StrainDependent(20), throw=True)
    errors = []
    for discs in (5, 10, 20):
        eq = vsr.solve(scene(discs=discs), TENSIONS / 3, model=vsr.StrainDependent(20), throw=True)
        errors.append(np.linalg.norm(eq.tip[:3, 3] - usual.tip[:3, 3]))
    orders = np.log2(np.divide(errors[:-1], errors[1:]))
    np.testing.assert_allclose(orders, 2.0, atol=0.1)


@pytest.mark.slow
def test_few_steps_between_discs_converge_with_their_order():
    fine = vsr.solve(scene(discs=3), TENSIONS, model=FINE, throw=True)
    errors = []
    for steps in (3, 6, 12):
        eq = vsr.solve(scene(discs=3), TENSIONS, model=vsr.StrainDependent(steps), throw=True)
        errors.append(np.linalg.norm(eq.tip[:3, 3] - fine.tip[:3, 3]))
    assert np.all(np.log2(np.divide(errors[:-1], errors[1:])) > 5.0), errors


@pytest.mark.slow
def test_the_derivative_of_the_energy_by_a_tension_is_the_sum_of_chords(weighed):
    def energy(change):
        return vsr.solve(weighed.scene, TENSIONS + 1e-2 * change, model=FINE).energy.total

    slope = central_differences(energy, 2) / 1e-2
    np.testing.assert_allclose(slope, weighed.lengths, rtol=1e-9)


@pytest.mark.slow
def test_a_moment_at_the_tip_leaves_an_arm_with_discs_stable():
    """The pivots of its tangent without the turning of the chords miss pairs of its negative
    eigenvalues, since a moment has no potential."""
    moment = vsr.TipWrench(force=(0.0, 0.3 * EI / LENGTH**2, 0.0), moment=(0.4 * EI / LENGTH, 0, 0))
    tendon = vsr.Tendon(vsr.Parallel(0.0, -0.007), straight=True)
    turned = vsr.Scene(arm(4), [tendon], [moment])
    tensions = jnp.array([[1.0], [2.0]]) * 0.25 * EI / (LENGTH * 0.007)

    @jax.jit
    @jax.vmap
    def solved(tension):
        eq = vsr.solve(turned, tension, model=STEPS)
        return eq.status, eq.stability

    status, margin = solved(tensions)
    assert jnp.all(status == vsr.Status.CONVERGED)
    assert jnp.all(margin > 0.5)


@pytest.mark.slow
def test_an_arm_with_discs_under_gravity_is_not_probed():
    """The pivots leave no doubt where the loads have a potential: probing would take as many steps
    again."""
    weighed = scene([vsr.Gravity()], discs=4)

    @jax.jit
    @jax.vmap
    def solved(tensions):
        eq = vsr.solve(weighed, tensions, model=STEPS)
        return eq.status, eq.stability, eq.steps

    status, margin, steps = solved(jnp.array([[1.0, 0.0], [2.0, 1.0]]))
    assert jnp.all(status == vsr.Status.CONVERGED)
    assert jnp.all(margin > 0.4)
    assert jnp.all(steps <= 12), steps


@pytest.mark.slow
def test_lengths_give_back_the_tensions(weighed):
    driven = scene([vsr.Gravity()], discs=3, control="length")
    changes = weighed.lengths - jnp.array([driven.rest_length(i) for i in range(2)])
    eq = vsr.solve(driven, changes, model=FINE, throw=True)
    np.testing.assert_allclose(-eq.forces, TENSIONS, rtol=1e-9)
    np.testing.assert_allclose(eq.tip, weighed.tip, atol=1e-10)
    loose = vsr.solve(driven, changes.at[1].set(0.03), model=FINE, throw=True)
    assert loose.forces[1] == 0
    np.testing.assert_allclose(
        loose.slack[1], driven.rest_length(1) + 0.03 - loose.lengths[1], rtol=1e-9
    )


BACKBONE = vsr.Rod(
    0.245,
    vsr.Circular(0.002),
    vsr.Material(2.31e9, shear=849e6, density=742.7),
    discs=vsr.Discs(places=(0.07667, 0.08167, 0.15833, 0.16333, 0.24, 0.245), radius=0.022),
    base=vsr.pose(pointing="up"),
)


@pytest.mark.slow
@pytest.mark.parametrize("share", [0.7, 1.0, 1.5])
def test_three_lengths_that_pull_against_each_other(share):
    """All are taut: the chords between the sections, measured in space, have the lengths of the
    stretched cables."""
    angles = np.radians([0, 120, 240])
    paths = 0.021 * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    tendons = [
        vsr.Tendon(vsr.Parallel(y, z), control="length", stiffness=2474.0, straight=True)
        for y, z in paths
    ]
    scene = vsr.Scene(BACKBONE, tendons, vsr.Gravity())
    changes = share * np.array([-7.5e-3, 2.3642e-3, 1.4824e-3])
    eq = vsr.solve(scene, changes)
    assert eq.status == vsr.Status.CONVERGED
    assert eq.stability > 0.2
    tensions = -np.asarray(eq.forces)
    assert np.all(tensions > 0.5)
    poses = np.asarray(eq.pose(np.array([0.0, *BACKBONE.discs.places])))
    for (y, z), change, tension in zip(paths, changes, tensions, strict=True):
        holes = poses[:, :3, :3] @ [0, y, z] + poses[:, :3, 3]
        length = np.linalg.norm(np.diff(holes, axis=0), axis=1).sum()
        np.testing.assert_allclose(length, (0.245 + change) * (1 + tension / 2474.0), atol=1e-9)


@pytest.mark.slow
def test_a_tendon_is_drawn_as_chords(weighed):
    corners = weighed.thread(1, jnp.array([0.0, 0.1, 0.2, 0.3]))
    lengths = np.linalg.norm(np.diff(corners, axis=0), axis=1)
    np.testing.assert_allclose(np.sum(lengths), weighed.lengths[1], rtol=1e-7)
    between = weighed.thread(1, jnp.array([0.125]))
    np.testing.assert_allclose(between[0], 0.75 * corners[1] + 0.25 * corners[2], atol=1e-12)
    drawn = weighed.summary(jnp.array([0.0, 0.125, 0.3])).threads
    np.testing.assert_allclose(drawn[1, 1], between[0], atol=1e-12)


@pytest.mark.slow
def test_the_reaction_is_that_to_the_loads(weighed):
    """The chords pull on both ends of an arm: the reaction at the base is the weight alone."""
    weight = 1000.0 * np.pi * RADIUS**2 * LENGTH * 9.81
    np.testing.assert_allclose(weighed.reaction(0.0)[3:], [0, 0, -weight], rtol=1e-4, atol=1e-9)


PLACED = [0.08, 0.19]


def coordinate(p):
    """A number of a loaded arm by five others: two tensions, two discs, the offset of a tendon."""
    tendons = [
        vsr.Tendon(vsr.Parallel(p[4], 0.0), end=0.25, straight=True),
        vsr.Tendon(PATHS[1], straight=True),
    ]
    rod = arm(jnp.concatenate([p[2:4], jnp.array([0.25, LENGTH])]))
    force = vsr.TipWrench(force=(0.0, 0.05, -0.1))
    eq = vsr.solve(vsr.Scene(rod, tendons, [force]), p[:2], model=vsr.StrainDependent(8))
    return eq.tip[:3, 3] @ jnp.array([1.0, -2.0, 3.0])


def test_gradients_in_both_modes_are_finite_differences():
    p, scale = jnp.array([3.0, 2.0, *PLACED, 0.007]), jnp.array([1e-2, 1e-2, 1e-3, 1e-3, 1e-4])
    _, forward = checked_derivative(coordinate, p, scale, atol=1e-9)
    assert np.all(np.abs(forward) > 1e-4)


@pytest.mark.slow
@pytest.mark.parametrize("friction", [None, 0.2])
@pytest.mark.parametrize("loads", [(), (vsr.Gravity(),)])
def test_a_batch_is_its_arms(loads, friction):
    guided = scene(loads, discs=3, friction=friction)

    def tip(inputs):
        return vsr.solve(guided, inputs, model=STEPS).tip[:3, 3]

    inputs = jnp.array([[3.0, 2.0], [0.0, 0.0], [1.0, 4.0]])
    np.testing.assert_allclose(
        jax.vmap(tip)(inputs), jnp.stack([tip(x) for x in inputs]), atol=1e-10
    )


@pytest.mark.slow
def test_precision_is_that_of_the_inputs(dtype):
    exact = vsr.solve(scene(discs=3), TENSIONS, model=STEPS, throw=True)
    eq = vsr.solve(scene(discs=3), TENSIONS.astype(dtype), model=STEPS, throw=True)
    assert eq.tip.dtype == dtype
    np.testing.assert_allclose(eq.tip[:3, 3], exact.tip[:3, 3], atol=50 * epsilon(dtype))


@pytest.mark.slow
def test_places_of_even_discs_are_their_number():
    by_number = vsr.solve(scene(discs=3), TENSIONS, model=FINE, throw=True)
    by_places = vsr.solve(scene(discs=[0.1, 0.2, 0.3]), TENSIONS, model=FINE, throw=True)
    np.testing.assert_allclose(by_places.tip, by_number.tip, atol=1e-7)
    assert scene(discs=3).edges().size == 4  # shared by both tendons


@pytest.mark.slow
def test_a_slack_tendon_with_discs_does_nothing():
    straight = vsr.solve(scene([vsr.Gravity()], discs=3), [0.0, 0.0], model=STEPS, throw=True)
    bare = vsr.solve(vsr.Scene(arm(), loads=[vsr.Gravity()]), [], model=STEPS, throw=True)
    np.testing.assert_allclose(straight.tip, bare.tip, atol=1e-8)


def test_scene_files_keep_discs():
    for discs in (
        vsr.Discs(4, radius=0.02, thickness=0.005),
        vsr.Discs(places=PLACED, mass=[1e-3, 2e-3]),
    ):
        rod = vsr.Rod(LENGTH, vsr.Circular(RADIUS), MATERIAL, discs=discs)
        robot = vsr.Scene(rod, [vsr.Tendon(PATHS[0], straight=True, end=discs.along(LENGTH)[0])])
        text = to_toml(robot)
        assert "straight = true" in text
        read = parse_scene(text).scene
        assert repr(read) == repr(robot)
        thick = () if discs.thickness is None else ("rigid pieces",)
        assert read.effects == ("tendons", "sections", *thick, "straight tendons")
        for name in ("places", "radius", "mass", "number", "thickness"):
            np.testing.assert_array_equal(getattr(read.rod.discs, name), getattr(discs, name))


@pytest.mark.parametrize(
    ("arguments", "options", "message"),
    [
        ((0,), {}, "Discs.number: got 0, need an integer >= 1"),
        ((), {}, "Discs: got number=None and places=None, need one of the two"),
        ((2,), {"places": [0.1]}, "Discs: got number=2 and places=.*, need one of the two"),
        ((), {"places": 0.1}, r"Discs.places: got shape \(\), need abscissas in a row"),
        ((), {"places": [0.2, 0.1]}, "Discs.places: got .*, need ascending abscissas"),
        ((), {"places": [-0.1]}, "Discs.places: got .*, need finite numbers > 0"),
        ((3,), {"radius": 0.0}, "Discs.radius: got 0.0, need"),
        ((3,), {"mass": -1.0}, "Discs.mass: got -1.0, need"),
        ((3,), {"thickness": 0.0}, "Discs.thickness: got 0.0, need"),
        ((3,), {"mass": [1.0, 2.0]}, r"Discs.mass: got shape \(2,\), need one mass or 3"),
    ],
)
def test_wrong_discs_are_refused(arguments, options, message):
    with pytest.raises(ValueError, match=message):
        vsr.Discs(*arguments, **options)


@pytest.mark.parametrize(
    ("discs", "options", "message"),
    [
        ([0.1, 0.4], {}, r"Scene.rod.discs: got a disc at 0.4 m, need places on the arm of 0.3 m"),
        (
            vsr.Discs(places=[0.1, 0.12], thickness=0.02),
            {},
            r"Scene.rod.discs.thickness: got 0.02 m, need less than the 0.02 m from disc to disc",
        ),
        (None, {}, r"actuators\[0\].straight: got True on a rod without discs, need Rod\(discs"),
        (3, {"end": 0.15}, r"actuators\[0\].end: got 0.15 m, need the place of a disc, such as"),
        (3, {"start": 0.05}, r"actuators\[0\].start: got 0.05 m, need the place of a disc"),
    ],
)
def test_straight_tendons_without_the_discs_they_need_are_refused(discs, options, message):
    with pytest.raises(ValueError, match=message):
        vsr.Scene(arm(discs), [vsr.Tendon(PATHS[0], straight=True, **options)])


def test_the_weight_of_discs_is_that_of_payloads():
    """One mass for all, and one for each."""
    for mass in (0.02, [0.01, 0.0, 0.03]):
        rod = vsr.Rod(
            LENGTH,
            vsr.Circular(RADIUS),
            MATERIAL,
            discs=vsr.Discs(places=[0.1, 0.2, 0.3], mass=mass),
        )
        found = vsr.solve(vsr.Scene(rod, [], [vsr.Gravity()]), [], model=STEPS, throw=True)
        each = zip([0.1, 0.2, 0.3], np.broadcast_to(mass, 3), strict=True)
        loads = [vsr.Gravity(), *(vsr.Payload(float(m), X) for X, m in each)]
        expected = vsr.solve(vsr.Scene(arm(), [], loads), [], model=STEPS, throw=True)
        np.testing.assert_allclose(found.tip, expected.tip, atol=1e-9)
        np.testing.assert_allclose(found.energy.total, expected.energy.total, rtol=1e-9)


def test_thick_discs_are_rigid_pieces_with_holes_at_both_faces():
    """Weighed in their middles by `Payload`."""
    places, half = np.array([0.1, 0.2, 0.3]), 0.004
    faces = np.stack([places - 2 * half, places], axis=1)
    thick = vsr.Discs(3, mass=0.02, thickness=2 * half)
    thin, pieces = vsr.Discs(places=faces.ravel()), [vsr.RigidPiece(*x) for x in faces]
    weights = [vsr.Payload(0.02, X) for X in places - half]

    def solved(loads, discs, rigid=()):
        rod = vsr.Rod(LENGTH, vsr.Circular(RADIUS), MATERIAL, discs=discs, rigid=rigid)
        tendons = [vsr.Tendon(path, straight=True) for path in PATHS]
        robot = vsr.Scene(rod, tendons, [vsr.Gravity(), *loads])
        return vsr.solve(robot, TENSIONS, model=vsr.StrainDependent(48), throw=True)

    found, expected = solved([], thick), solved(weights, thin, pieces)
    np.testing.assert_allclose(found.tip, expected.tip, atol=5e-9)
    np.testing.assert_allclose(found.lengths, expected.lengths, atol=5e-9)
    assert "rigid pieces" in found.scene.effects
    np.testing.assert_allclose(found.strain(places - half), np.tile([0, 0, 0, 1, 0, 0], (3, 1)))


@pytest.mark.parametrize(
    "model", [vsr.Prescribed(vsr.Basis.uniform(vsr.Legendre(2))), vsr.Continuum()]
)
def test_other_models_name_the_one_for_discs(model):
    with pytest.raises(ValueError, match=r"actuators\[0\].straight.*need StrainDependent"):
        vsr.solve(scene(discs=3), TENSIONS, model=model)


PULLED = straight_tendons.ROBOT_CASES["6, 4 and 3 N, 0.12 N at the tip"]
SEVERAL = 5  # discs of each section


def rubbing(friction, motion="pull", **options):
    """The robot of two sections, with friction in the holes of its discs."""
    robot = straight_tendons.robot(SEVERAL).replace("loads[0].force", PULLED.force)
    tendons = [
        vsr.Tendon(
            one.routing, end=one.end, straight=True, friction=friction, motion=motion, **options
        )
        for one in robot.actuators
    ]
    return vsr.Scene(robot.rod, tendons, robot.loads)


def chords(eq):
    """Lengths and tensions of all chords, (tendons, spans)."""
    X = np.linspace(0, 2 * straight_tendons.LENGTH, 2 * SEVERAL + 1)
    nodes, forces, lengths = eq.nodes, np.asarray(eq.forces), np.zeros((6, 2 * SEVERAL))
    tensions = np.zeros_like(lengths)
    for i, sections in enumerate(straight_tendons.SECTIONS):
        inside = X[: SEVERAL * sections + 1]
        corners = np.asarray(eq.thread(i, inside))
        lengths[i, : len(inside) - 1] = np.linalg.norm(np.diff(corners, axis=0), axis=1)
        share = np.interp(0.5 * (X[1:] + X[:-1]), nodes.grid.X.T.ravel(), nodes.shares[i].T.ravel())
        tensions[i] = -forces[i] * share
    return lengths, tensions


@pytest.mark.slow
@pytest.mark.parametrize(("friction", "motion"), [(0.2, "pull"), (0.2, "release"), (0.3, "pull")])
def test_friction_in_holes_is_that_of_a_chain_of_pulleys(friction, motion):
    places = jnp.linspace(0, 2 * straight_tendons.LENGTH, 2 * SEVERAL + 1)
    eq = vsr.solve(
        rubbing(friction, motion), PULLED.tensions, model=vsr.StrainDependent(40), throw=True
    )
    pulleys = straight_tendons.rods(SEVERAL, PULLED)._replace(
        friction=friction if motion == "pull" else -friction
    )
    expected = rods_between_discs.solve(pulleys, axial=True)
    length = 2 * straight_tendons.LENGTH
    np.testing.assert_allclose(eq.position(places), expected, atol=3e-8 * length)
    without = rods_between_discs.solve(pulleys._replace(friction=0.0), axial=True)
    assert np.abs(expected - without).max() > 0.01 * length


@pytest.mark.slow
def test_chords_stick_and_slip_along_a_path_and_close_their_cycle():
    """Against a chain of pulleys, chord by chord; then the energy of a closed cycle: the arm keeps
    none, so that the chords do no work on it, and what the motors give is lost in the holes."""
    shares = np.concatenate(
        [np.linspace(0.2, 1, 17), np.linspace(1, 0.2, 17)[1:], np.linspace(0.2, 1, 17)[1:]]
    )
    path = shares[:, None] * np.array(PULLED.tensions)
    eqs = vsr.follow(rubbing(0.2), path, model=vsr.StrainDependent(20))
    assert np.all(eqs.status == vsr.Status.CONVERGED)
    pulleys = straight_tendons.rods(SEVERAL, PULLED)._replace(friction=0.2)
    found = []
    for i, expected in enumerate(rods_between_discs.follow(pulleys, path)):
        lengths, tensions = chords(jax.tree.map(lambda x, i=i: x[i], eqs))
        np.testing.assert_allclose(tensions, expected.tension, atol=1e-5)
        np.testing.assert_allclose(lengths, expected.length, atol=1e-7)
        found.append((lengths, tensions))
    cycle = found[16:]
    work, given, lost = 0.0, 0.0, 0.0
    for (before, pull), (after, more) in pairwise(cycle):
        mean, change = 0.5 * (pull + more), after - before
        work -= np.sum(mean * change)
        given -= np.sum(mean[:, 0] * np.sum(change, axis=1))
        beyond = np.cumsum(change[:, ::-1], axis=1)[:, ::-1]
        lost -= np.sum((mean[:, :-1] - mean[:, 1:]) * beyond[:, 1:])
    assert given > 1e-4
    np.testing.assert_allclose(work, 0.0, atol=1e-2 * given)
    np.testing.assert_allclose(given, lost, rtol=1e-2)


@pytest.mark.slow
def test_elastic_lengths_with_friction_in_holes_give_back_the_tensions():
    """The stretch of each chord is that by its own tension."""
    model, stiffness = vsr.StrainDependent(20), 5e3
    eq = vsr.solve(rubbing(0.2), PULLED.tensions, model=model, throw=True)
    _, tensions = chords(eq)
    driven = rubbing(0.2, control="length", stiffness=stiffness)
    rest = np.array([driven.rest_length(i) for i in range(6)])
    per_chord = 2 * straight_tendons.LENGTH / (2 * SEVERAL)
    mean = np.sum(tensions, axis=1) * per_chord / rest
    changes = eq.lengths / (1 + mean / stiffness) - rest
    found = vsr.solve(driven, changes, model=model, throw=True)
    np.testing.assert_allclose(-found.forces, PULLED.tensions, atol=1e-6)


def test_gradients_by_friction_and_discs():
    """In both modes, of a number by the friction, a disc, the offset, a tension, the mass and the
    thickness of the discs."""

    def number(p):
        places = jnp.stack([p[1], 0.17 + 0 * p[1], 0.3 + 0 * p[1]])
        discs = vsr.Discs(places=places, mass=p[4], thickness=p[5])
        rod = vsr.Rod(LENGTH, vsr.Circular(RADIUS), MATERIAL, discs=discs)
        paths = vsr.Parallel(p[2], 0.001), PATHS[1]
        tendons = [vsr.Tendon(path, straight=True, friction=p[0]) for path in paths]
        robot = vsr.Scene(rod, tendons, [vsr.Gravity()])
        eq = vsr.solve(robot, jnp.stack([p[3], 1.0 + 0 * p[3]]), model=vsr.StrainDependent(6))
        return eq.tip[:3, 3] @ jnp.array([1.0, -2.0, 3.0])

    p = jnp.array([0.2, 0.08, 0.007, 2.0, 2e-3, 4e-3])
    scale = jnp.array([1e-2, 1e-3, 1e-4, 1e-2, 1e-4, 1e-4])
    _, forward = checked_derivative(number, p, scale, atol=1e-9)
    assert np.all(np.abs(forward) > 1e-4)


@pytest.mark.slow
def test_gradients_by_the_spool_and_the_rim():
    """In both modes, of an arm that motors press with its discs onto a floor: by the radius of the
    spools, that of the discs and an angle."""

    def number(p):
        rod = vsr.Rod(LENGTH, vsr.Circular(RADIUS), MATERIAL, discs=vsr.Discs(3, radius=p[1]))
        tendons = [
            vsr.Tendon(path, straight=True, control="length", stiffness=2e3, spool=p[0])
            for path in PATHS
        ]
        floor = vsr.Plane((0, 0, 1), (0, 0, -0.035))
        robot = vsr.Scene(rod, tendons, [vsr.Gravity()], obstacles=[floor])
        eq = vsr.solve(robot, jnp.stack([p[2], 0.2 + 0 * p[2]]), model=vsr.StrainDependent(6))
        return jnp.stack([eq.tip[:3, 3] @ jnp.array([1.0, -2.0, 3.0]), eq.contacts.force.sum()])

    p, scale = jnp.array([5e-3, 0.012, 0.4]), jnp.array([1e-4, 1e-4, 1e-2])
    solve, forward = checked_derivative(number, p, scale, atol=1e-9)
    assert solve(p)[0][1] > 1e-3  # touched
    assert np.all(np.abs(forward) > 1e-4)


@pytest.mark.slow
@pytest.mark.parametrize(("kind", "draw"), [(0, 10), (2, 3), (5, 3)])
def test_lengths_of_a_shape_give_back_its_tensions(kind, draw):
    """Draws of `disc_search` whose cables make each other slack in turn, without friction and with:
    they are solved on the way with springs that harden."""
    kind = disc_search.KINDS[kind]
    drawn = disc_search.drawn(kind, np.random.default_rng((0, draw)))
    draws = jax.tree.map(lambda x: jnp.asarray(x)[None], drawn)
    found = disc_search.by_tensions(kind, draws)
    status, tensions = disc_search.by_lengths(kind, draws, disc_search.lengths(draws, found))
    assert status[0] == vsr.Status.CONVERGED
    np.testing.assert_allclose(tensions[0], drawn.tension, atol=1e-4)


@pytest.mark.slow
def test_lengths_that_rub_start_from_one_another():
    """The measured robot with its zeros as commanded: in the eighth step three tendons pull against
    each other, of which two let out 0.15 to 0.24 mm from the one before."""
    robot = measured_helical.arm()
    inputs = measured_helical.measurements(robot).inputs
    model = measured_helical.MODEL
    near = vsr.solve(robot, inputs[7], model=model, throw=True)
    found = vsr.solve(robot, inputs[8], model=model, start=near)
    assert bool(found.converged)
    assert not bool(found.restarted)
    assert int(found.steps) <= 10
    expected = vsr.solve(robot, inputs[8], model=model)
    np.testing.assert_allclose(found.tip, expected.tip, atol=1e-10)


@pytest.mark.slow
def test_lengths_that_rub_along_a_path():
    """Six cables that bend an arm there and back, in 26 samples."""
    robot = bench_discs.robot(True, "length")
    tendons = [
        vsr.Tendon(
            one.routing, end=one.end, control="length", stiffness=5e3, friction=0.1, straight=True
        )
        for one in robot.actuators
    ]
    path = np.interp(np.arange(27), [0, 13, 26], [0.0, 1.0, 0.0])[1:, None]
    eqs = vsr.follow(
        vsr.Scene(robot.rod, tendons, robot.loads),
        path * bench_discs.inputs("length", 1),
        model=vsr.StrainDependent(20),
    )
    assert np.all(eqs.status == vsr.Status.CONVERGED)
    assert np.sum(eqs.steps) < 700
