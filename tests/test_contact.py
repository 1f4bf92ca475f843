"""Held sections and contact against closed forms, free bodies and finite differences."""

import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import brentq
from scipy.spatial.transform import Rotation
from scipy.special import ellipe, ellipk

import vsr_jax as vsr
from vsr_jax.arm.rod import STRAINS
from vsr_jax.files.scene_file import parse_scene, to_toml
from vsr_jax.mechanics.touch import _handed

L = 0.2
NO_INPUTS = jnp.zeros(0)
MODEL = vsr.StrainDependent(12)
BENDING = ("bending_y", "bending_z")


def rod(radius=0.005, young=1e6, density=1000.0, **more):
    material = vsr.Material(young=young, poisson=0.3, density=density)
    return vsr.Rod(length=L, section=vsr.Circular(radius=radius), material=material, **more)


def stiffness(radius=0.005, young=1e6):
    return young * np.pi * radius**4 / 4


def solved(*loads, model=MODEL, start=None, free_strains=STRAINS, arm=None, **around):
    scene = vsr.Scene(arm or rod(), (), loads, free_strains=free_strains, **around)
    return vsr.solve(scene, NO_INPUTS, model=model, start=start)


def test_a_propped_cantilever_is_held_by_three_eighths_of_its_load():
    q = 1e-4
    prop = vsr.Held(position=(L, 0, 0), along=(1, 0, 0))
    eq = solved(vsr.DistributedWrench(force=(0, 0, -q)), held=prop, free_strains=BENDING)
    np.testing.assert_allclose(eq.supports[0], [0, 0, 0, 0, 0, 3 / 8 * q * L], atol=1e-6 * q * L)
    np.testing.assert_allclose(eq.tip[2, 3], 0, atol=1e-12)


@pytest.mark.parametrize(
    ("orientation", "load"),
    [(np.eye(3), 4 * np.pi**2), (None, 20.190728556426629)],
    ids=["clamped", "pinned"],
)
def test_the_margin_of_a_held_column_vanishes_at_its_buckling_load(orientation, load):
    """The pinned end: tan x = x at x^2 = 20.19."""
    force = 0.5 * load * stiffness() / L**2
    end = vsr.Held(position=(L, 0, 0), orientation=orientation, along=(1, 0, 0))
    eq = solved(
        vsr.TipWrench(force=(-force, 0, 0)),
        held=end,
        free_strains=BENDING,
        model=vsr.StrainDependent(24),
    )
    np.testing.assert_allclose(eq.stability, 0.5, atol=1e-7)


@pytest.mark.parametrize("free", [("bending_y",), ("bending_y", "elongation")])
def test_an_arm_in_a_plane_may_be_held_across_it(free):
    """Clamped at one end, in a slide at the other: it sags by F L^3 / (192 EI) in the middle."""
    held = vsr.Held(position=(L, 0, 0), orientation=np.eye(3), along=(1, 0, 0))
    load = vsr.PointWrench(L / 2, force=(0, 0, -1e-4))
    eq = solved(load, held=held, free_strains=free)
    assert eq.status == vsr.Status.CONVERGED
    sag = -1e-4 * L**3 / (192 * stiffness())
    np.testing.assert_allclose(eq.position(L / 2)[2], sag, rtol=1e-4)
    np.testing.assert_allclose(eq.supports[0, 5], 5e-5, rtol=1e-4)


@pytest.mark.parametrize("along", [None, (1.0, 0.0, 0.5)])
def test_an_arm_in_a_plane_is_held_alike_wherever_the_plane_lies(along):
    """Nothing can move across the plane; no support then pushes there, about no axis in it."""
    place, turn = np.array([0.7 * L, 0, -0.4 * L]), Rotation.from_rotvec([0, 0.8, 0]).as_matrix()

    def held(turned):
        base = jnp.eye(4).at[:3, :3].set(turned)
        way = None if along is None else turned @ jnp.array(along)
        end = vsr.Held(position=turned @ place, orientation=turned @ turn, along=way)
        aside = vsr.DistributedWrench(force=turned @ jnp.array([0, 0, 0.05]))
        arm = rod(base=base)
        scene = vsr.Scene(arm, loads=aside, held=end, free_strains=("bending_y", "elongation"))
        eq = vsr.solve(scene, jnp.zeros(0), model=vsr.StrainDependent(8))
        support = eq.supports[0].reshape(2, 3) @ turned
        return eq.status, turned.T @ eq.position(0.6 * L), support, eq.stability

    ways = np.concatenate([np.eye(3)[None], Rotation.random(7, random_state=1).as_matrix()])
    status, middle, support, margin = jax.jit(jax.vmap(held))(jnp.asarray(ways))
    assert np.all(status == vsr.Status.CONVERGED)
    np.testing.assert_allclose(middle, np.broadcast_to(middle[0], middle.shape), atol=1e-10 * L)
    np.testing.assert_allclose(support, np.broadcast_to(support[0], support.shape), atol=2e-8)
    np.testing.assert_allclose(margin, np.full(8, margin[0]), rtol=1e-6)
    np.testing.assert_allclose(support[0][[0, 0, 1], [0, 2, 1]], 0, atol=1e-12)
    assert np.abs(support[0][[0, 1, 1], [1, 0, 2]]).min() > 1e-4


def test_a_rigid_piece_may_be_held_twice():
    """Both supports exert together what the one at its end exerts alone."""
    arm = rod(rigid=[vsr.RigidPiece(0.12, L)])
    turn = Rotation.from_rotvec([0, 0.4, 0]).as_matrix()

    def held(*abscissas):
        places = [np.array([0.17, 0, -0.05]) - (L - X) * turn[:, 0] for X in abscissas]
        ends = [
            vsr.Held(X, position=place, orientation=turn)
            for X, place in zip(abscissas, places, strict=True)
        ]
        eq = solved(vsr.Gravity(), held=ends, arm=arm)
        assert eq.status == vsr.Status.CONVERGED
        moments = eq.supports[:, :3] + np.cross(places, eq.supports[:, 3:])
        return eq, np.concatenate([moments.sum(0), eq.supports[:, 3:].sum(0)])

    once, alone = held(L)
    twice, together = held(L, 0.15)
    np.testing.assert_allclose(together, alone, rtol=2e-3, atol=1e-12)
    np.testing.assert_allclose(twice.position(0.1), once.position(0.1), atol=5e-5 * L)


def test_a_clamped_elastica_has_the_force_of_the_elliptic_integrals():
    """Both ends clamped, brought to 0.8 L: four quarter waves, 2 E / K - 1 = 0.8 and
    P = (4 K)^2 EI / L^2."""
    m = brentq(lambda m: 2 * ellipe(m) / ellipk(m) - 1.8, 1e-6, 0.9)
    force = (4 * ellipk(m)) ** 2 * stiffness() / L**2
    end = vsr.Held(position=(0.8 * L, 0, 0), orientation=np.eye(3))
    aside = vsr.PointWrench(L / 2, force=(0, 0, 0.05 * force))
    more = {"held": end, "free_strains": BENDING, "model": vsr.StrainDependent(24)}
    bent = solved(aside, **more)
    eq = solved(start=bent, **more)
    np.testing.assert_allclose(eq.supports[0, 3], -force, rtol=1e-6)
    assert float(eq.position(L / 2)[2]) > 0.2 * L


def test_held_sections_have_exact_derivatives():
    def height(shortened):
        end = vsr.Held(position=jnp.array([1.0, 0, 0]) * L * (1 - shortened))
        scene = vsr.Scene(rod(), (), [vsr.TipWrench(moment=(0, 0.01, 0))], held=end)
        return vsr.solve(scene, NO_INPUTS, model=MODEL).position(L / 2)[2]

    h, at = 1e-5, 0.1
    difference = (height(at + h) - height(at - h)) / (2 * h)
    np.testing.assert_allclose(jax.grad(height)(at), difference, rtol=1e-6)
    forward = jax.jvp(height, (at,), (1.0,))[1]
    np.testing.assert_allclose(forward, difference, rtol=1e-6)


def test_a_clamp_within_the_arm_exerts_the_wrench_that_bends_it_there():
    """A section of an arm on a turned base is clamped in the pose to which a wrench brings it."""
    base = vsr.pose((0.01, 0.0, 0.02), pointing=(1.0, 0.2, 0.1))
    material = vsr.Material(1e6, poisson=0.3, density=1000.0)
    arm = vsr.Rod(L, vsr.Circular(0.005), material, base=base)
    force, moment = np.array([0.01, 0.01, 0.02]), np.array([1e-4, -2e-4, 5e-4])
    bent = solved(vsr.Gravity(), vsr.PointWrench(0.12, force=force, moment=moment), arm=arm)
    pose = bent.pose(0.12)
    hold = vsr.Held(0.12, position=pose[:3, 3], orientation=pose)
    eq = solved(vsr.Gravity(), held=hold, arm=arm)
    np.testing.assert_allclose(eq.supports[0, 3:], force, atol=1e-5 * 0.02)
    np.testing.assert_allclose(eq.supports[0, :3], moment, atol=1e-5 * 5e-4)
    np.testing.assert_allclose(eq.tip, bent.tip, atol=1e-7)


def test_the_margin_of_a_held_arm_can_be_differentiated():
    def margin(push):
        end = vsr.Held(position=jnp.array([L, 0, 0.0]), along=(1, 0, 0))
        load = vsr.TipWrench(force=jnp.array([-1.0, 0, 0]) * push)
        return solved(load, held=end, free_strains=BENDING).stability

    euler = 20.190728556426629 * stiffness() / L**2
    np.testing.assert_allclose(jax.grad(margin)(0.3 * euler), -1 / euler, rtol=1e-5)


SPHERE = vsr.Sphere((0.1, 0.012, -0.03), 0.02)
PRESS = vsr.TipWrench(force=(0, 0.005, -0.03))


@pytest.fixture(scope="module")
def pressed():
    return solved(PRESS, obstacles=SPHERE)


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


def test_a_solve_may_start_from_the_free_arm(pressed):
    free = solved(vsr.TipWrench(force=(0, 0.005, -0.005)))
    np.testing.assert_allclose(
        solved(PRESS, obstacles=SPHERE, start=free).tip, pressed.tip, atol=1e-9
    )
    np.testing.assert_allclose(
        solved(PRESS, obstacles=SPHERE, start=pressed).tip, pressed.tip, atol=1e-9
    )


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

    at, h = (0.02, 0.03), 1e-6
    gradient = jax.grad(height, (0, 1))(*at)
    for i in range(2):
        up, down = (tuple(x + s * h * (i == j) for j, x in enumerate(at)) for s in (1, -1))
        difference = (height(*up) - height(*down)) / (2 * h)
        np.testing.assert_allclose(gradient[i], difference, rtol=1e-6)
    tangent = jax.jvp(height, at, (1.0, 0.0))[1]
    np.testing.assert_allclose(tangent, gradient[0], rtol=1e-8)
    many = jax.vmap(lambda force: height(0.02, force))(jnp.array([0.0, 0.01, 0.03]))
    np.testing.assert_allclose(many[2], pressed.tip[2, 3], atol=1e-10)
    np.testing.assert_allclose(many[1], height(0.02, 0.01), atol=1e-10)
    assert abs(float(many[0])) < 1e-3  # 5 mN aside alone


@pytest.mark.parametrize("first", [True, False])
def test_a_plane_may_touch_the_ends_of_steps_too(pressed, first):
    floor = vsr.Plane((0, 0, 1), (0, 0, -0.2))
    ball, plane = (1, 0) if first else (0, 1)
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


def test_single_precision(pressed):
    scene = pressed.scene.astype(jnp.float32)
    eq = vsr.solve(scene, NO_INPUTS.astype(jnp.float32), model=MODEL)
    assert eq.tip.dtype == jnp.float32
    np.testing.assert_allclose(eq.tip, pressed.tip, atol=2e-4)


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
