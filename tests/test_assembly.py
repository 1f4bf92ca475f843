"""Assemblies against single arms with the same meaning, closed forms, and shooting in SciPy."""

import re

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import vsr_jax as vsr
from benchmarks.six_rods import (
    HEIGHT,
    LENGTHS,
    UP,
    WEIGHT,
    anchors,
    at,
    guess_from,
    hexapod,
    shooting,
)

L, MODEL = 0.2, vsr.StrainDependent(16)


def rod(length=L, base=None, young=1e6):
    material = vsr.Material(young, poisson=0.45, density=1080.0)
    return vsr.Rod(length, vsr.Circular(0.004), material, base=base)


def loaded(young=1e6):
    arm = vsr.Scene(rod(young=young), loads=vsr.Gravity())
    plate = vsr.Body(at([L, 0, 0]), mass=0.001, centre=(0.01, 0.0, 0.0), moment=(0, 0, 2e-5))
    return vsr.Assembly(arm, plate, vsr.Joint(0, 0, pose=np.eye(4)))


def with_payload(young=1e6):
    loads = [vsr.Gravity(), vsr.Payload(0.001, offset=(0.01, 0.0, 0.0))]
    return vsr.Scene(rod(young=young), loads=[*loads, vsr.TipWrench(moment=(0, 0, 2e-5))])


@pytest.mark.slow
def test_a_plate_on_an_arm_is_a_payload():
    eq, same = (
        vsr.solve_assembly(loaded(), [], model=MODEL),
        vsr.solve(with_payload(), [], model=MODEL),
    )
    assert eq.converged
    np.testing.assert_allclose(eq.poses[0], same.tip, atol=1e-7)
    np.testing.assert_allclose(eq.arms[0].tip, eq.poses[0], atol=1e-7)
    weight = 0.001 * 9.81
    np.testing.assert_allclose(eq.arms[0].supports[0, 3:], [0, 0, -weight], atol=1e-9 * weight)
    # stiffness of a tip against wrenches: the inverse of its compliance, turns in its own axes
    turn = np.eye(6)
    turn[:3, :3] = same.tip[:3, :3]
    compliance = turn.T @ np.asarray(vsr.compliance(same)) @ turn
    np.testing.assert_allclose(np.linalg.inv(eq.stiffness), compliance, rtol=1e-4, atol=1e-3)


@pytest.mark.slow
def test_derivatives_are_those_of_the_payload():
    def height(young):
        return vsr.solve_assembly(loaded(young), [], model=MODEL).poses[0, 2, 3]

    def same(young):
        return vsr.solve(with_payload(young), [], model=MODEL).tip[2, 3]

    found = jax.jvp(height, (1e6,), (1.0,))[1]  # backwards: with the six rods below
    np.testing.assert_allclose(found, jax.grad(same)(1e6), rtol=1e-6)


@pytest.mark.slow
def test_two_arms_one_after_the_other_are_a_long_one():
    """The second arm has its base on a body without mass at the tip of the first."""
    arm = vsr.Scene(rod(), loads=vsr.Gravity())
    second = vsr.Scene(rod(base=at([L, 0, 0])), loads=vsr.Gravity())
    clamp = vsr.Body(at([L, 0, 0]))
    chain = vsr.Assembly([arm, second], clamp, [vsr.Joint(0, 0), vsr.Joint(1, 0, X=0.0)])
    eq = vsr.solve_assembly(chain, [], model=MODEL)
    whole = vsr.solve(vsr.Scene(rod(2 * L), loads=vsr.Gravity()), [], model=MODEL)
    assert eq.converged
    np.testing.assert_allclose(eq.arms[1].tip, whole.tip, atol=2e-6)
    np.testing.assert_allclose(eq.poses[0], whole.pose(L), atol=2e-6)


@pytest.mark.slow
def test_the_roll_of_a_round_arm_on_a_body_does_not_matter():
    """The base of the second arm is driven: its wrench is that of the turned section."""
    arm = vsr.Scene(rod(), loads=vsr.Gravity())
    roll = vsr.Input("rod.base.turn_x")
    second = vsr.Scene(rod(base=at([L, 0, 0])), loads=vsr.Gravity(), driven=roll)
    joints = [vsr.Joint(0, 0), vsr.Joint(1, 0, X=0.0)]
    chain = vsr.Assembly([arm, second], vsr.Body(at([L, 0, 0])), joints)
    rolls = jnp.array([[0.0], [1.0], [np.pi]])
    eqs = jax.vmap(lambda u: vsr.solve_assembly(chain, u, model=vsr.StrainDependent(8)))(rolls)
    assert np.all(np.asarray(eqs.converged))
    tips = jax.vmap(lambda eq: eq.arms[1].tip[:3, 3])(eqs)
    np.testing.assert_allclose(tips, np.broadcast_to(tips[0], (3, 3)), atol=1e-9)


@pytest.mark.slow
def test_refused_inputs_have_their_status_and_leave_the_others_alone():
    place = at([0.17, 0.01, 0.02])
    arm = vsr.Scene(rod(), vsr.Tendon(vsr.Parallel(0.003, 0.0)), vsr.Gravity())
    assembly, model = vsr.Assembly(arm, joints=vsr.Joint(0, kind="ball", pose=place)), MODEL

    def mean(young, tensions):
        there = eqx.tree_at(lambda a: a.arms[0].rod.material.young.value, assembly, young)
        eqs = jax.vmap(lambda u: vsr.solve_assembly(there, u[None], model=model))(tensions)
        tips = jax.vmap(lambda eq: eq.arms[0].position(0.1)[2])(eqs)
        return jnp.sum(jnp.where(eqs.converged, tips, 0.0)), eqs

    tensions = jnp.array([0.3, -1.0, jnp.nan])
    slope, eqs = jax.grad(mean, has_aux=True)(jnp.asarray(1e6), tensions)
    wanted = [vsr.Status.CONVERGED, vsr.Status.INADMISSIBLE, vsr.Status.NOT_FINITE]
    np.testing.assert_array_equal(eqs.status, wanted)
    np.testing.assert_array_equal(eqs.arms[0].status, wanted)
    assert np.isfinite(slope)


@pytest.mark.slow
def test_a_body_that_is_free_to_turn_is_not_stable():
    ball = vsr.Body(at([L, 0, 0]), mass=0.001)
    arm = vsr.Scene(rod(), loads=vsr.Gravity())
    whole = vsr.Assembly(arm, ball, vsr.Joint(0, 0, "ball", pose=np.eye(4)))
    eq = vsr.solve_assembly(whole, [], model=vsr.StrainDependent(8))
    assert eq.status == vsr.Status.UNSTABLE


@pytest.mark.slow
def test_an_arm_joined_to_the_ground_is_held():
    place = at([0.17, 0.01, 0.02], Rotation.from_rotvec([0.1, 0.2, 0.3]))
    held = vsr.Held(position=place[:3, 3], orientation=place)
    arm, tendon = rod(), vsr.Tendon(vsr.Parallel(0.003, 0.0))
    same = vsr.solve(vsr.Scene(arm, tendon, vsr.Gravity(), held=held), [0.3], model=MODEL)
    joint = vsr.Joint(0, pose=place)
    eq = vsr.solve_assembly(
        vsr.Assembly(vsr.Scene(arm, tendon, vsr.Gravity()), joints=joint), [0.3], model=MODEL
    )
    assert eq.converged
    np.testing.assert_allclose(eq.arms[0].supports, same.supports, rtol=1e-8, atol=1e-10)
    np.testing.assert_allclose(eq.stability, same.stability, rtol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["ball", "hinge", "slider"])
def test_joints_bear_nothing_where_they_move(kind):
    """An arm under gravity whose tip is joined to the ground."""
    place = at([0.18, 0.01, 0.0], Rotation.from_rotvec([0.0, 0.2, 0.1]))
    axis = None if kind == "ball" else (0.0, 1.0, 0.2)
    joint = vsr.Joint(0, kind=kind, pose=place, axis=axis)
    assembly = vsr.Assembly(vsr.Scene(rod(), loads=vsr.Gravity()), joints=joint)
    eq = vsr.solve_assembly(assembly, [], model=MODEL)
    assert eq.converged
    tip, (wrench,) = np.asarray(eq.arms[0].tip), np.asarray(eq.arms[0].supports)
    a = place[:3, :3] @ np.array([0.0, 1.0, 0.2]) / np.hypot(1.0, 0.2)
    if kind == "ball":
        np.testing.assert_allclose(wrench[:3], 0, atol=1e-12)
    elif kind == "hinge":
        np.testing.assert_allclose(wrench[:3] @ a, 0, atol=1e-9)
        along = np.array([0.0, 1.0, 0.2]) / np.hypot(1.0, 0.2)
        np.testing.assert_allclose(tip[:3, :3] @ along, a, atol=1e-9)
        assert np.linalg.norm(wrench[:3]) > 1e-5
    if kind == "slider":
        np.testing.assert_allclose(wrench[3:] @ a, 0, atol=1e-9)
        np.testing.assert_allclose(tip[:3, :3], place[:3, :3], atol=1e-6)
        off = tip[:3, 3] - place[:3, 3]
        np.testing.assert_allclose(np.cross(off, a), 0, atol=1e-6)
    else:
        np.testing.assert_allclose(tip[:3, 3], place[:3, 3], atol=1e-6)


@pytest.mark.slow
def test_six_rods_with_a_plate_are_those_of_shooting_in_space():
    """Pose and reactions; and the derivative of the height by an anchor against a difference of
    solutions by shooting."""
    model = vsr.StrainDependent(16)
    assembly, places = hexapod(), [q for _, q in anchors()]
    eq = vsr.solve_assembly(assembly, LENGTHS, model=model)
    assert eq.converged
    assert eq.stability > 0
    z, rest = shooting(assembly, LENGTHS, guess_from(eq), places)
    assert np.max(np.abs(rest)) < 1e-9
    np.testing.assert_allclose(eq.poses[0, :3, 3], z[39:], atol=1e-6 * HEIGHT)
    R = Rotation.from_rotvec(z[36:39]).as_matrix()
    np.testing.assert_allclose(eq.poses[0, :3, :3], R, atol=1e-6)
    np.testing.assert_allclose(guess_from(eq)[:36], z[:36], atol=1e-5 * WEIGHT)

    def height(q):
        moved = [q, *places[1:]]
        return vsr.solve_assembly(hexapod(moved), LENGTHS, model=model, start=eq).poses[0, 2, 3]

    slope = jax.grad(height)(jnp.asarray(places[0]))
    step, along = 1e-4, np.array([0.6, -0.5, 0.62])
    ends = [
        shooting(assembly, LENGTHS, z, [places[0] + h * along, *places[1:]])[0][41]
        for h in (step, -step)
    ]
    np.testing.assert_allclose(slope @ along, (ends[0] - ends[1]) / (2 * step), rtol=1e-4)


@pytest.mark.slow
def test_batches_and_warm_starts():
    assembly, model = hexapod(), vsr.StrainDependent(8)
    first = vsr.solve_assembly(assembly, LENGTHS, model=model)
    further = jnp.array([LENGTHS + 0.002, LENGTHS - 0.002])
    one = jax.jit(lambda u: vsr.solve_assembly(assembly, u, model=model, start=first))
    eqs = jax.vmap(one)(further)
    assert np.all(np.asarray(eqs.converged))
    again = vsr.solve_assembly(assembly, further[0], model=model)
    np.testing.assert_allclose(eqs.poses[0], again.poses, atol=1e-9)


@pytest.mark.slow
def test_a_plate_too_heavy_for_its_column_is_found_where_it_hangs():
    """A column far above its buckling load, with a force to one side: the search begins where the
    whole is unstable. The same arm with the loads at its tip is stable there."""
    arm = vsr.Scene(rod(base=at([0, 0, 0], UP)))
    plate = vsr.Body(at([0, 0, L], UP), mass=0.02, force=(0.02, 0.005, 0.0))
    assembly = vsr.Assembly(arm, plate, vsr.Joint(0, 0, pose=np.eye(4)))
    eq = vsr.solve_assembly(assembly, [], model=MODEL)
    assert eq.converged
    assert eq.stability > 0
    loads = vsr.TipWrench(force=(0.02, 0.005, -0.02 * 9.81))
    same = vsr.solve(vsr.Scene(arm.rod, loads=loads), [], model=MODEL)
    np.testing.assert_allclose(eq.poses[0], same.tip, atol=1e-5)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda a, b: vsr.Assembly([]), "Assembly.arms: got none"),
        (lambda a, b: vsr.Assembly(a, b), "bodies[0]: got no joint, need one that holds it"),
        (lambda a, b: vsr.Assembly(a, b, vsr.Joint(1, 0)), "joints[0].arm: got 1, need the index"),
        (lambda a, b: vsr.Assembly(a, b, vsr.Joint(0, 2)), "joints[0].body: got 2, need the index"),
        (lambda a, b: vsr.Assembly(a, b, vsr.Joint(0, 0, X=0.3)), "joints[0].X: got 0.3 m, need"),
        (
            lambda a, b: vsr.Assembly(a, b, [vsr.Joint(0, 0), vsr.Joint(0, None, "ball")]),
            "joints[1]: got the section of joints[0] again",
        ),
        (
            lambda a, b: vsr.Assembly(a, b, [vsr.Joint(0, 0), vsr.Joint(0, None, "ball", X=L)]),
            "joints[1]: got the section of joints[0] again",
        ),
        (lambda a, b: vsr.Joint(0, None, "ball", X=0.0), "Joint.kind: got 'ball' at X = 0"),
        (lambda a, b: vsr.Assembly(a, (), vsr.Joint(0, X=0.0)), "got a base on the ground"),
        (lambda a, b: vsr.Joint(0, axis=(1, 0, 0)), "Joint.axis: got (1, 0, 0) with kind='fixed'"),
        (lambda a, b: vsr.Joint(0, kind="hinge", axis=(0, 0, 0)), "Joint.axis: got (0, 0, 0)"),
    ],
)
def test_what_an_assembly_refuses(make, message):
    with pytest.raises(ValueError, match=re.escape(message)):
        make(vsr.Scene(rod()), vsr.Body(at([L, 0, 0])))


def test_inputs_of_an_assembly():
    assembly = hexapod()
    assert [one.name for one in assembly.inputs][5] == "arms[5] rod.length"
    np.testing.assert_allclose(assembly.rest_inputs, HEIGHT)
    for u, message in ((LENGTHS[:5], "need (6,)"), ([*LENGTHS[:5], 0.7], "arms[5]: inputs[0]")):
        with pytest.raises(ValueError, match=re.escape(message)):
            vsr.solve_assembly(assembly, u)


@pytest.mark.slow
def test_lengths_that_cannot_meet_have_a_status():
    """An inextensible arm that is joined to the ground beyond its length."""
    arm = vsr.Scene(rod(), free_strains=("torsion", "bending_y", "bending_z"))
    assembly = vsr.Assembly(arm, joints=vsr.Joint(0, pose=at([1.1 * L, 0.0, 0.0])))
    eq = vsr.solve_assembly(assembly, [], model=vsr.StrainDependent(8))
    assert not eq.converged
    assert np.isnan(eq.stability)
