"""Designs and inverse statics that keep clear of obstacles, or press on them with at most a force:
margins against distances in NumPy, their derivatives against differences."""

import re

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import vsr_jax as vsr
from vsr_jax.analysis.arms import Arms
from vsr_jax.analysis.constraint import Clearance, MaxContactForce
from vsr_jax.optimization.design_file import load_design

L, RADIUS = 0.3, 0.008
MODEL = vsr.StrainDependent(8)
OFFSETS = ((0.006, 0.0), (-0.003, 0.0052), (-0.003, -0.0052))
ROD = vsr.Rod(L, vsr.Circular(vsr.Taper(RADIUS, 0.007)), vsr.Material(8e5, poisson=0.45))
TENDONS = [vsr.Tendon(vsr.Parallel(y, z)) for y, z in OFFSETS]
FREE = vsr.Scene(ROD, TENDONS)
BALL = vsr.Sphere((0.2, 0.06, 0.0), 0.03)
BOX = vsr.Box((0.05, 0.05, 0.05), pose=vsr.pose((0.15, -0.07, 0.05), pointing=(1.0, 0.5, 0.2)))
AMONG = vsr.Scene(ROD, TENDONS, obstacles=[BALL])
BESIDE = jnp.array([0.8, 0.1, 0.6])
INTO = jnp.array([1.0, 0.2, 0.2])
"""Inputs that bend the arm beside the ball, and into it."""


DENSE = np.linspace(0, L, 4001)


@jax.jit
def bare(inputs):
    return vsr.solve(FREE, inputs, model=MODEL)


def gap_to_ball(eq, X=DENSE):
    """Gap between the ball and the outline of an arm."""
    away = np.linalg.norm(np.asarray(eq.position(X)) - [0.2, 0.06, 0.0], axis=1)
    return away - 0.03 - (RADIUS + (0.007 - RADIUS) * X / L)


def gap_to_box(eq, X=DENSE):
    pose = np.asarray(BOX.pose)
    local = np.abs((np.asarray(eq.position(X)) - pose[:3, 3]) @ pose[:3, :3]) - 0.025
    away = np.linalg.norm(np.maximum(local, 0), axis=1) + np.minimum(local.max(axis=1), 0)
    return away - (RADIUS + (0.007 - RADIUS) * X / L)


def gaps_of(eq):
    """Gaps that the margins mean, (obstacles, stations)."""
    return Clearance(0.004, [BALL, BOX])(Arms.of(eq)).reshape(2, 65) * L + 0.004


@pytest.mark.slow
def test_the_clearance_is_that_of_the_nearest_point():
    """Between the 65 stations as well."""
    eq = bare(BESIDE)
    for gaps, dense in zip(gaps_of(eq), (gap_to_ball, gap_to_box), strict=True):
        assert float(jnp.min(gaps)) == pytest.approx(np.min(dense(eq)), abs=1e-5 * L)
        at_stations = dense(eq, np.linspace(0, L, 65))
        np.testing.assert_allclose(gaps, at_stations, atol=L / 128)
        assert np.all(gaps <= at_stations + 1e-12)


@pytest.mark.slow
def test_derivatives_of_the_clearance():
    def least(inputs):
        return jnp.min(gaps_of(vsr.solve(FREE, inputs, model=MODEL)))

    slope = jax.jit(jax.grad(least))(BESIDE)
    h = 1e-4 * np.eye(3)
    ahead, behind = ([np.min(gap_to_ball(bare(BESIDE + s * x))) for x in h] for s in (1, -1))
    differences = (np.array(ahead) - behind) / 2e-4
    np.testing.assert_allclose(slope, differences, rtol=2e-3)


@eqx.filter_jit
def among(inputs):
    """The arm with contact, and its least margins."""
    eq = vsr.solve(AMONG, inputs, model=MODEL)
    arms = Arms.of(eq)
    least = [jnp.min(one(arms)) for one in (Clearance(0.004), MaxContactForce(0.05))]
    return jnp.stack(least), eq


@pytest.mark.slow
def test_margins_of_an_arm_that_touches():
    """Where it presses the clearance is that of the force, by 3 EI / L^3 of the arm; else of the
    gap."""
    margins, eq = among(INTO)
    force = float(jnp.sum(eq.contacts.force))
    assert force > 0.01
    X = np.linspace(0, L, 65)
    stiffness = 3 * np.mean(8e5 * np.pi / 4 * (RADIUS + (0.007 - RADIUS) * X / L) ** 4) / L**3
    pressed = np.min(np.asarray(eq.contacts.gap) - np.asarray(eq.contacts.force) / stiffness)
    worst = (pressed - 0.004) / L
    assert worst < -0.1
    np.testing.assert_allclose(margins, [worst, 1 - force / 0.05], rtol=1e-6)
    margins, eq = among(BESIDE)
    free = (np.min(gap_to_ball(eq)) - 0.004) / L
    np.testing.assert_allclose(margins, [free, 1.0], atol=1e-6)


@pytest.mark.slow
def test_derivatives_of_the_margins_of_an_arm_that_touches():
    slope = jax.jit(jax.jacrev(lambda u: among(u)[0]))(INTO)
    h = 1e-4 * np.eye(3)
    differences = [(among(INTO + x)[0] - among(INTO - x)[0]) / 2e-4 for x in h]
    np.testing.assert_allclose(slope, np.transpose(differences), rtol=1e-4, atol=1e-6)


@pytest.mark.slow
def test_a_design_comes_free_of_an_obstacle():
    """The tip is to go where only an arm inside the ball brings it."""
    aim = vsr.objective.TipError(bare(INTO).tip[None, :3, 3])
    found = vsr.design(
        FREE,
        {"inputs": (0.0, 3.0)},
        aim,
        INTO[None],
        constraints=[Clearance(0.004, BALL)],
        model=MODEL,
        search=vsr.Search(starts=2, steps=150, candidates=4),
        progress=False,
    )
    assert np.min(gap_to_ball(bare(INTO))) < -0.02
    assert found.feasible
    assert "Clearance(distance=0.004, obstacles=[Sphere])" in found.margins
    # the constraint binds
    assert 0.004 <= np.min(gap_to_ball(bare(found.inputs[0]))) < 0.0041


@pytest.mark.slow
def test_a_design_comes_free_of_an_obstacle_that_it_touches():
    eq = vsr.solve(AMONG, INTO, model=MODEL)
    for kept, least, most in (
        (Clearance(0.004), 0.004, 0.0042),
        (MaxContactForce(0.01), -1e-5, 1e-5),
    ):
        found = vsr.design(
            AMONG,
            {"inputs": (0.0, 3.0)},
            vsr.objective.TipError(eq.tip[None, :3, 3]),
            INTO[None],
            constraints=[kept],
            model=MODEL,
            search=vsr.Search(starts=1, steps=150, candidates=1),
            progress=False,
        )
        assert found.feasible
        there = vsr.solve(AMONG, found.inputs[0], model=MODEL)
        assert least <= np.min(gap_to_ball(there)) < most
        assert float(jnp.sum(there.contacts.force)) < 0.01


@pytest.fixture(scope="module")
def two_parts():
    """Six tendons, three of them up to the middle: more than a position of the tip needs."""
    half = [vsr.Tendon(vsr.Parallel(y, z), end=L / 2) for y, z in OFFSETS]
    return vsr.Scene(ROD, [*half, *TENDONS])


@pytest.mark.slow
def test_an_arm_reaches_past_an_obstacle(two_parts):
    """A target that the arm reaches through a ball with the least effort, and one out of reach."""
    targets = jnp.array([[0.271, 0.102, -0.006], [0.5, 0.0, 0.0], [0.271, 0.102, -0.006]])
    here, away = [0.193, 0.037, 0.003], [0.0, 0.0, -0.5]
    centres = jnp.array([here, here, away])

    def reach(target, centre):
        kept = Clearance(0.003, vsr.Sphere(centre, 0.02))
        return vsr.reach(two_parts, target, (0.0, 3.0), constraints=[kept], model=MODEL)

    found = jax.vmap(reach)(targets, centres)
    np.testing.assert_array_equal(found.reached, [True, False, True])
    np.testing.assert_array_equal(found.violation, 0)
    places = jax.vmap(lambda eq: eq.position(DENSE))(found.equilibrium)
    radius = RADIUS + (0.007 - RADIUS) * DENSE / L
    away_from = np.linalg.norm(np.asarray(places) - here, axis=-1) - 0.02 - radius
    past, nearest, through = np.min(away_from, axis=1)
    assert through < -0.01
    assert 0.003 < past < 0.0031
    assert nearest > 0.003


@pytest.mark.slow
def test_a_path_leads_round_an_obstacle():
    """The straight line leads through a ball; with the ball elsewhere it is the path."""
    first, last = jnp.array([0.2, 0.05, 1.0]), jnp.array([0.2, 1.0, 0.05])
    middle = bare((first + last) / 2).tip[:3, 3] + jnp.array([0.0, 0.0, 0.002])

    def found(centre):
        kept = [Clearance(0.003, vsr.Sphere(centre, 0.012))]
        return vsr.find_path(FREE, first, last, (0.0, 3.0), kept, samples=17, model=MODEL)

    path = found(middle)
    assert bool(path.feasible)
    assert float(path.violation) == 0
    assert str(path) == "17 samples from 0.2, 0.05, 1 to 0.2, 1, 0.05: all constraints hold"
    np.testing.assert_allclose(path.inputs[0], first, atol=1e-12)
    np.testing.assert_allclose(path.inputs[-1], last, atol=1e-12)
    assert np.all((path.inputs >= 0) & (path.inputs <= 3))
    again = jax.vmap(bare)(path.inputs)
    places = np.asarray(jax.vmap(lambda eq: eq.position(DENSE))(again))
    radius = RADIUS + (0.007 - RADIUS) * DENSE / L
    gaps = np.linalg.norm(places - np.asarray(middle), axis=-1) - 0.012 - radius
    assert 0.003 < np.min(gaps) < 0.004
    free = found(jnp.array([0.0, 0.0, 0.3]))
    straight = first + jnp.linspace(0, 1, 17)[:, None] * (last - first)
    np.testing.assert_allclose(free.inputs, straight, atol=1e-6)
    shut = found(bare(first).tip[:3, 3])
    assert not bool(shut.feasible)
    assert "NO PATH FOUND" in str(shut)


def test_a_reach_prints_a_violation():
    zero, one = jnp.zeros(()), jnp.ones(())
    found = vsr.Reach(jnp.ones(3), bare(BESIDE), zero, jnp.array(False), one, jnp.array(0.02))
    assert str(found).splitlines()[1:] == [
        "miss       0 m, within the 1 m allowed",
        "violation  0.02, the constraints do not hold",
    ]


def test_a_design_file_has_obstacles(tmp_path):
    vsr.save(AMONG, tmp_path / "arm.toml", INTO)
    file = tmp_path / "design.toml"
    file.write_text(
        """
        scene = "arm.toml"
        free.inputs = [0.0, 3.0]
        objectives = [{ type = "Tension", scale = 1.0 }]
        [[constraints]]
        type = "MaxContactForce"
        force = 0.1
        [[constraints]]
        type = "Clearance"
        distance = 0.002
        obstacles = [{ type = "Sphere", centre = [0.2, 0.06, 0.0], radius = 0.03 }]
        """
    )
    force, kept = load_design(file).constraints
    assert str(force) == "MaxContactForce(force=0.1)"
    assert str(kept) == "Clearance(distance=0.002, obstacles=[Sphere])"
    assert str(Clearance(0.002)) == "Clearance(distance=0.002)"
    np.testing.assert_array_equal(kept.obstacles[0].centre, BALL.centre)
    file.write_text(file.read_text().replace('"Sphere"', '"Ball"'))
    with pytest.raises(ValueError, match=r"constraints\[1\].obstacles\[0\]: unknown type 'Ball'"):
        load_design(file)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Clearance(-0.1), "Clearance.distance: got -0.1, need"),
        (lambda: Clearance(0.1, []), "Clearance.obstacles: got none, need a Plane, Sphere, Tube"),
        (lambda: Clearance(0.1, [1.0]), "Clearance.obstacles[0]: got 1.0, need a Plane, Sphere"),
        (lambda: MaxContactForce(0.0), "MaxContactForce.force: got 0.0, need a finite number > 0"),
        (
            lambda: Clearance(0.1)(Arms.of(bare(BESIDE))),
            "Clearance: got a scene without obstacles, need obstacles in the scene or in "
            "Clearance(distance, obstacles)",
        ),
        (
            lambda: MaxContactForce(0.1)(Arms.of(bare(BESIDE))),
            "MaxContactForce: got a scene without obstacles, need obstacles in the scene",
        ),
        (
            lambda: vsr.reach(FREE, jnp.zeros(3), (0.0, 1.0), constraints=[BALL]),
            "constraints[0]: got Sphere(",
        ),
        (
            lambda: vsr.find_path(FREE, BESIDE, INTO, (0.0, 3.0), []),
            "constraints: got none, need at least one",
        ),
        (
            lambda: vsr.find_path(FREE, BESIDE, INTO, (0.0, 0.9), Clearance(0.1, BALL)),
            "last: got [1.  0.2 0.2], need inputs between [0. 0. 0.] and [0.9 0.9 0.9]",
        ),
        (
            lambda: vsr.find_path(FREE, BESIDE, INTO, (0.0, 3.0), Clearance(0.1, BALL), samples=2),
            "samples: got 2, need an integer >= 3",
        ),
    ],
)
def test_errors_name_the_value_and_the_requirement(unchecked, make, message):
    with pytest.raises(ValueError, match=re.escape(message)):
        make()
