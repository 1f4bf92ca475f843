"""Contact against closed forms, free bodies and finite differences."""

import re
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import central_differences, with_derivative

import vsr_jax as vsr
from vsr_jax.arm.rod import STRAINS
from vsr_jax.elements.nearest import lying
from vsr_jax.elements.touch import Touch, _handed
from vsr_jax.files.scene_file import parse_scene, to_toml
from vsr_jax.solution.bearing import _at_ends
from vsr_jax.viz.annotate import rows_of

L = 0.2
NO_INPUTS = jnp.zeros(0)
MODEL = vsr.StrainDependent(12)


def rod(radius=0.005, young=1e6, density=1000.0, **more):
    material = vsr.Material(young=young, poisson=0.3, density=density)
    return vsr.Rod(length=L, section=vsr.Circular(radius=radius), material=material, **more)


def stiffness(radius=0.005, young=1e6):
    return young * np.pi * radius**4 / 4


def solved(*loads, model=MODEL, start=None, free_strains=STRAINS, arm=None, **around):
    scene = vsr.Scene(arm or rod(), (), loads, free_strains=free_strains, **around)
    return vsr.solve(scene, NO_INPUTS, model=model, start=start)


SPHERE = vsr.Sphere((0.1, 0.012, -0.03), 0.02)
PRESS = vsr.TipWrench(force=(0, 0.005, -0.03))


@pytest.fixture(scope="module")
def pressed():
    return solved(PRESS, obstacles=SPHERE)


@pytest.mark.slow
def test_contact_pushes_only_where_the_gap_is_closed(pressed):
    contacts = pressed.contacts
    assert float(contacts.force.max()) > 0.02
    assert float(contacts.gap.min()) > -1e-9
    scale = 3 * stiffness() / L**2
    smaller = jnp.minimum(jnp.abs(contacts.gap) / L, jnp.abs(contacts.force) / scale)
    assert float(smaller.max()) < 1e-8
    X = jnp.linspace(0, L, 801)
    gap = jax.vmap(SPHERE.distance)(pressed.position(X)) - 0.005
    assert float(gap.min()) > -1e-4 * 0.005


@pytest.mark.slow
def test_soft_arms_do_not_pass_what_they_touch():
    """Pressed across a pillar at many places of a step, the arm shears and bends within the step;
    positions between the contacts too stay outside."""
    soft = vsr.Rod(L, vsr.Circular(0.005), vsr.Material(2e5, poisson=0.4))

    @jax.jit
    @jax.vmap
    def lowest(X):
        pillar = vsr.Cylinder(
            0.02, pose=vsr.pose(jnp.stack([X, 0.0, -0.03]), pointing=(0.0, 1.0, 0.0))
        )
        load = vsr.TipWrench(force=(0, 0, -0.03))
        eq = vsr.solve(
            vsr.Scene(soft, (), load, obstacles=pillar),
            jnp.zeros(0),
            model=vsr.StrainDependent(24),
        )
        gaps = jax.vmap(pillar.distance)(eq.position(jnp.linspace(0, L, 801))) - 0.005
        return eq.status, jnp.min(gaps), jnp.max(eq.contacts.force)

    status, gap, force = lowest(jnp.linspace(0.1, 0.1 + L / 24, 6))
    assert np.all(status == vsr.Status.CONVERGED)
    assert float(force.min()) > 0.03
    assert float(gap.min()) > -1e-4 * 0.005


def test_a_tip_rests_on_what_it_presses():
    """Nothing but rounding and the smoothing of contact, 1e-9 of the length, is between them."""
    height, radius = -0.02, 0.005
    floor = vsr.Plane((0, 0, 1), (0, 0, height))
    eq = solved(vsr.TipWrench(force=(0, 0, -0.02)), obstacles=floor, model=vsr.StrainDependent(24))
    assert bool(eq.converged)
    assert float(jnp.max(eq.contacts.force)) > 1e-3
    np.testing.assert_allclose(eq.tip[2, 3], height + radius, atol=1e-8 * L)


def test_an_arm_on_a_floor_says_that_its_contacts_are_loosened():
    """The tip of a light arm touches the floor, a heavy one lies along it; contacts stay loosened
    in a solve that starts from such a one."""

    def on_floor(density, start=None):
        return solved(
            vsr.Gravity(),
            arm=rod(young=2e5, density=density),
            obstacles=vsr.Plane((0, 0, 1), (0, 0, -0.02)),
            free_strains=("bending_y",),
            model=vsr.StrainDependent(8),
            start=start,
        )

    eqs = jax.jit(jax.vmap(on_floor))(jnp.array([30.0, 6000.0]))
    heavy = jax.tree.map(lambda x: x[1], eqs)
    lighter = jax.jit(on_floor)(jnp.array(4000.0), heavy)
    assert np.all(eqs.converged)
    assert bool(lighter.converged)
    np.testing.assert_array_equal(eqs.loosened, [False, True])
    assert bool(lighter.loosened)
    assert lighter.steps < heavy.steps


@pytest.mark.slow
def test_contacts_of_an_arm_along_a_wall_push_only_where_the_gap_is_closed():
    """In a bent tube, and on a floor from a solution near by: a first solve there fails, and only
    loosened contacts keep to their places."""
    arm = rod(young=2e5)
    line = [[0, 0, 0], [0.07, 0, 0], [0.13, 0.02, 0.01], [0.22, 0.06, 0.04]]
    push = vsr.TipWrench(force=(-0.02, 0, 0))
    model = vsr.StrainDependent(24)
    eq = solved(vsr.Gravity(), push, obstacles=vsr.Tube(0.01, line), arm=arm, model=model)
    floor = {"obstacles": vsr.Plane((0, 0, 1), (0, 0, -0.02)), "model": model}
    near = solved(vsr.Gravity(), arm=rod(young=2e5, density=630.0), **floor)
    lying = solved(vsr.Gravity(), arm=rod(young=2e5, density=636.3), start=near, **floor)
    for found in (eq, near, lying):
        assert bool(found.converged)
        force = np.asarray(found.contacts.force) * L**2 / (3 * stiffness(young=2e5))
        gap = np.abs(found.contacts.gap) / L
        assert np.sum(force > 1e-6) > 5
        assert np.max(np.minimum(gap, force)) < 1e-8


@pytest.mark.slow
def test_a_touching_arm_is_the_free_arm_under_its_contact_force(pressed):
    """The same arm without obstacle, loaded by the contact force: other code, with the force at a
    breakpoint."""
    contacts = pressed.contacts
    at = int(jnp.argmax(contacts.force[0]))
    force = contacts.force[0, at] * contacts.normal[0, at]
    free = solved(
        PRESS, vsr.PointWrench(contacts.X[0, at], force=force), model=vsr.StrainDependent(48)
    )
    np.testing.assert_allclose(pressed.tip[:3, 3], free.tip[:3, 3], atol=2e-5 * L)
    whole = force + jnp.array([0, 0.005, -0.03])
    base = pressed.pose(0.0)[:3, :3] @ pressed.reaction(0.0)[3:]
    np.testing.assert_allclose(base, whole, atol=1e-12)


@pytest.mark.slow
def test_a_solve_may_start_from_the_free_arm(pressed):
    free = solved(vsr.TipWrench(force=(0, 0.005, -0.005)))
    np.testing.assert_allclose(
        solved(PRESS, obstacles=SPHERE, start=free).tip, pressed.tip, atol=1e-9
    )
    np.testing.assert_allclose(
        solved(PRESS, obstacles=SPHERE, start=pressed).tip, pressed.tip, atol=1e-9
    )


@pytest.mark.slow
@pytest.mark.parametrize("round_first", [True, False])
def test_a_solve_may_start_from_an_arm_among_other_obstacles(round_first):
    """A plane has another number of contacts than a sphere."""
    floor = vsr.Plane((0, 0, 1), (0, 0, -0.03))
    before, here = (SPHERE, floor) if round_first else (floor, SPHERE)
    cold = solved(PRESS, obstacles=here)
    warm = solved(PRESS, obstacles=here, start=solved(PRESS, obstacles=before))
    assert warm.status == vsr.Status.CONVERGED
    np.testing.assert_allclose(warm.tip, cold.tip, atol=1e-8)


@pytest.mark.slow
@pytest.mark.parametrize("where", ["one load at the tip's abscissa", "two loads at one place"])
def test_steps_of_no_length_touch_nothing(pressed, where):
    """Both leave a step without length in the grid, and other steps a little longer."""
    loads, same = [vsr.PointWrench(L, PRESS.force)], pressed
    if where == "two loads at one place":
        loads = [vsr.PointWrench(0.15, force) for force in ((0, 0.005, -0.01), (0, 0, -0.02))]
        same = solved(vsr.PointWrench(0.15, PRESS.force), obstacles=SPHERE)
    eq = solved(*loads, obstacles=SPHERE)
    assert eq.steps < 30
    np.testing.assert_allclose(eq.tip[:3, 3], same.tip[:3, 3], rtol=0, atol=1e-4 * L)
    np.testing.assert_allclose(jnp.sum(eq.contacts.force), jnp.sum(same.contacts.force), rtol=2e-3)


@pytest.mark.slow
def test_a_base_of_six_digits_is_a_base():
    """An arm that lies along a floor: with such a base as it is, hundreds of Newton steps."""
    turn = vsr.se3.exp(jnp.array([0.3, -1.1, 0.7, 0.0, 0.0, 0.0]))
    R = turn[:3, :3]
    floor = vsr.Plane(R[:, 2], -0.03 * R[:, 2])
    weight, push = vsr.Gravity(-9.81 * R[:, 2]), vsr.TipWrench(force=R @ jnp.array(PRESS.force))
    exact, rounded = (
        solved(weight, push, arm=rod(base=base), obstacles=floor)
        for base in (turn, jnp.round(turn, 6))
    )
    assert rounded.steps <= exact.steps + 3
    np.testing.assert_allclose(rounded.tip[:3, 3], exact.tip[:3, 3], rtol=0, atol=2e-6 * L)


def test_the_force_jumps_at_the_contact(pressed):
    contacts = pressed.contacts
    at = int(jnp.argmax(contacts.force[0]))
    X, force = contacts.X[0, at], contacts.force[0, at] * contacts.normal[0, at]
    sides = [pressed.pose(x)[:3, :3] @ pressed.reaction(x)[3:] for x in (X - 1e-5, X + 1e-5)]
    np.testing.assert_allclose(sides[0] - sides[1], force, atol=1e-6)


def test_contact_has_exact_derivatives_and_batches(pressed):
    def height(radius, force):
        obstacle = vsr.Sphere((0.1, 0.012, -0.03), radius)
        load = vsr.TipWrench(force=jnp.stack([0 * force, 0.005 + 0 * force, -force]))
        return solved(load, obstacles=obstacle).tip[2, 3]

    at, h = jnp.array([0.02, 0.03]), 1e-6
    found = with_derivative(lambda x: height(*x))
    forward, reverse = found(at)[1], jax.jit(jax.grad(lambda x: height(*x)))(at)
    difference = central_differences(lambda unit: found(at + h * unit)[0], 2) / h
    np.testing.assert_allclose(forward, difference, rtol=1e-6)
    np.testing.assert_allclose(reverse, forward, rtol=1e-8)
    many = jax.jit(jax.vmap(height))(jnp.full(3, 0.02), jnp.array([0.0, 0.01, 0.03]))
    np.testing.assert_allclose(many[2], pressed.tip[2, 3], atol=1e-10)
    np.testing.assert_allclose(many[1], found(jnp.array([0.02, 0.01]))[0], atol=1e-10)
    assert abs(float(many[0])) < 1e-3  # 5 mN aside alone


@pytest.mark.slow
@pytest.mark.parametrize("first", [True, False])
def test_a_plane_may_touch_the_ends_of_steps_too(pressed, first):
    floor = vsr.Plane((0, 0, 1), (0, 0, -0.2))
    ball, plane = (1, 0) if first else (0, 1)
    assert lying((SPHERE, floor, replace(floor, friction=0.1), vsr.Tube(0.1))) == [1, 3]
    eq = solved(PRESS, obstacles=[floor, SPHERE] if first else [SPHERE, floor])
    contacts = eq.contacts
    assert contacts.force.shape == (2, 24)
    assert contacts.position.shape == (2, 24, 3)
    np.testing.assert_allclose(eq.tip, pressed.tip, atol=1e-9)
    np.testing.assert_allclose(contacts.force[ball, ::2], pressed.contacts.force[0], atol=1e-8)
    np.testing.assert_array_equal(contacts.force[ball, 1::2], 0.0)
    np.testing.assert_array_equal(contacts.X[ball, 1::2], contacts.X[ball, ::2])
    np.testing.assert_allclose(contacts.X[plane, 1::2], np.arange(1, 13) * L / 12, atol=1e-12)
    places = eq.position(contacts.X[plane, 1::2])
    np.testing.assert_allclose(contacts.position[plane, 1::2], places, atol=1e-9)
    np.testing.assert_allclose(contacts.gap[plane], contacts.position[plane, :, 2] + 0.195)


def test_a_contact_at_the_tip_has_one_row():
    """The nearest point of the last step is its end: one contact, with the force of the balance,
    in the data and in figures."""
    floor = vsr.Plane((0, 0, 1), (0, 0, -0.03))
    eq = solved(PRESS, obstacles=floor, model=vsr.StrainDependent(4))
    force = np.asarray(eq.contacts.force[0])
    np.testing.assert_allclose(eq.contacts.X[0, force > 1e-9], [L])
    (row,) = [row for row in rows_of(eq) if row.name == "contact with plane"]
    np.testing.assert_allclose(row.vectors, [[0, 0, force.sum()]], atol=1e-12)
    base = eq.reaction(jnp.zeros(1))[0, 3:]
    np.testing.assert_allclose(base, np.array([0, 0.005, -0.03 + force.sum()]), atol=1e-9)


def test_forces_at_joints_of_steps_are_added():
    """Nearest points at an end of a step hand their forces to it, of the step before too, but not
    to one that is not there."""
    touch = Touch(*[None] * len(Touch._fields))._replace(
        sigma=jnp.array([[1.0, 0.0, 0.5, 0.0, 1.0], [1.0, 0.0, 0.5, 0.0, 1.0]]),
        force=jnp.arange(10.0).reshape(2, 5),
    )
    there = jnp.array([[True, True, False, True, True]])
    near, end = jnp.moveaxis(_at_ends(touch, np.array([1]), there)[0], -1, 0)
    np.testing.assert_array_equal(near, [0, 0, 2, 3, 0])
    np.testing.assert_array_equal(end, [0 + 5 + 1, 6, 0, 8, 4 + 9])


@pytest.mark.slow
def test_many_arms_wait_in_a_queue():
    """More arms than are solved at a time, and each is the arm alone."""

    def tip(force):
        eq = solved(vsr.TipWrench(force=force), obstacles=SPHERE, model=vsr.StrainDependent(4))
        return eq.status, eq.steps, eq.tip[:3, 3]

    random = np.random.default_rng(3)
    forces = jnp.asarray(random.normal(size=(61, 3)) * [0.0, 0.01, 0.03])
    status, steps, tips = jax.jit(jax.vmap(tip))(forces)
    assert np.ptp(steps) > 5
    one = jax.jit(tip)
    for i in (0, 17, 48, 60):
        assert one(forces[i])[0] == status[i]
        np.testing.assert_allclose(tips[i], one(forces[i])[2], atol=1e-9)
    assert int(jnp.sum(status == vsr.Status.CONVERGED)) == 61


def test_of_two_steps_at_a_contact_one_has_its_force():
    """Each step of which the nearest point is its end hands its force on, but not to one that would
    hand it back: forces would change places for ever."""
    handed = _handed(jnp.array([[1.0, -1.0, 0.0, 1.0, 1.0, 0.0]]), jnp.ones(6, bool))
    np.testing.assert_array_equal(handed, [[1.0, 0.0, 0.0, 0.0, 1.0, 0.0]])


@pytest.mark.slow
def test_a_heavy_arm_lies_on_the_floor():
    """Far from the lift-off the floor carries the weight of each step."""
    floor = vsr.Plane((0, 0, 1), (0, 0, -0.02))
    g = 30.0
    eq = solved(
        vsr.Gravity(acceleration=(0, 0, -g)), obstacles=floor, model=vsr.StrainDependent(24)
    )
    force, of_step = eq.contacts.force.reshape(24, 2).sum(1), 1000.0 * np.pi * 0.005**2 * g * L / 24
    np.testing.assert_allclose(force[18:21], of_step, rtol=1e-2)
    np.testing.assert_allclose(eq.tip[2, 3], -0.015, atol=1e-3 * 0.005)
    assert int(jnp.sum(force > 1e-2 * of_step)) in range(9, 12)


@pytest.mark.slow
def test_single_precision(pressed):
    scene = pressed.scene.astype(jnp.float32)
    eq = vsr.solve(scene, NO_INPUTS.astype(jnp.float32), model=MODEL)
    assert eq.tip.dtype == jnp.float32
    np.testing.assert_allclose(eq.tip, pressed.tip, atol=2e-4)


@pytest.mark.slow
@pytest.mark.parametrize("obstacle", [vsr.Plane((0, 0, 1), (0, 0, -1)), vsr.Sphere((0, 1, 0), 0.1)])
def test_what_a_limp_rope_does_not_touch_changes_nothing(obstacle):
    r"""In single precision; it hangs by its weight alone, $L + \rho g L^2 / 2 E$."""
    length, young, density = 0.61, 0.3e6, 1000.0
    material = vsr.Material(young, shear=young / 3, density=density)
    rope = vsr.Rod(length, vsr.Circular(1e-3), material)
    scene = vsr.Scene(rope, loads=vsr.Gravity((9.81, 0, 0)), obstacles=obstacle)
    eq = vsr.solve(scene, jnp.zeros(0, jnp.float32), model=vsr.StrainDependent(64))
    assert eq.status == vsr.Status.CONVERGED
    assert not eq.loosened
    expected = length * (1 + density * 9.81 * length / (2 * young))
    np.testing.assert_allclose(eq.tip[:3, 3], [expected, 0, 0], atol=1e-6)


def test_scene_files_keep_held_sections(pressed):
    end = vsr.Held(0.1, position=(0.1, 0, 0.01), along=(0, 1, 0))
    scene = vsr.Scene(rod(), held=end, obstacles=SPHERE)
    again = parse_scene(to_toml(scene)).scene
    assert "held section" in scene.effects
    for x, y in zip(jax.tree.leaves(scene), jax.tree.leaves(again), strict=True):
        np.testing.assert_array_equal(x, y)


def test_scenes_without_obstacles_have_no_contacts():
    eq = solved(PRESS)
    assert eq.contacts.force.shape == (0, 0)
    assert eq.supports.shape == (0, 6)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: vsr.Held(0.1), "Held: got neither a position nor an orientation"),
        (lambda: vsr.Held(0.1, orientation=2 * np.eye(3)), "Held.orientation: got columns"),
        (lambda: vsr.Held(position=(0, 0, 0), along=(0, 0, 0)), "Held.along: got (0, 0, 0)"),
        (lambda: vsr.Held(orientation=np.eye(3), along=(1, 0, 0)), "Held.along: got a direction"),
        (
            lambda: vsr.Scene(rod(), held=vsr.Held(0.3, position=(0, 0, 0))),
            "Scene.held[0].X: got 0.3 m, need a place on the arm of 0.2 m",
        ),
        (
            lambda: vsr.Scene(rod(), held=[vsr.Held(0.1, position=(0.1, 0, z)) for z in (0, 0.1)]),
            "Scene.held[1].X: got 0.1 m, where Scene.held[0] holds the arm already",
        ),
        (
            lambda: solved(PRESS, obstacles=SPHERE, model=vsr.Continuum()),
            "model: got Continuum for a scene with obstacles, need StrainDependent",
        ),
        (
            lambda: solved(
                PRESS,
                held=vsr.Held(position=(0.2, 0, 0)),
                model=vsr.Prescribed(vsr.Basis.uniform(vsr.Legendre(2))),
            ),
            "model: got Prescribed for a scene with held sections, need StrainDependent",
        ),
    ],
)
def test_errors_say_what_is_needed(make, message):
    with pytest.raises(ValueError, match=re.escape(message)):
        make()
