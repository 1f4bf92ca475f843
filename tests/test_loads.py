"""Loads: every model against the independent reference, and what is refused."""

import json
import pathlib

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import vsr_jax as vsr
from vsr_jax.studies import paper

REFERENCE = json.loads((pathlib.Path(__file__).parent / "data" / "loaded_cases.json").read_text())
CASES = {case["name"]: case for case in REFERENCE["cases"]}
ARM = vsr.Rod(0.5, vsr.Circular(0.01), vsr.Material(1e6, poisson=0.5, density=1000.0))


def loaded_scene(case):
    """The paper's arm of a reference case with its loads."""
    plain = paper.scene(case["name"].split()[0])
    arm = vsr.Rod(
        0.75, plain.rod.section, vsr.Material(5.93e5, shear=2e5, density=case["density"] or None)
    )
    loads = [] if case["gravity"] is None else [vsr.Gravity(case["gravity"])]
    if any(case["tip_force"]) or any(case["tip_moment"]):
        loads.append(
            vsr.TipWrench(
                case["tip_force"], case["tip_moment"], "body" if case["follower"] else "world"
            )
        )
    return vsr.Scene(arm, plain.actuators, loads)


def tip_error(name, model):
    case = CASES[name]
    eq = vsr.solve(loaded_scene(case), np.array(case["tau"], float), model=model, throw=True)
    return eq, float(np.linalg.norm(eq.tip[:3, 3] - np.array(case["tip"])[:3, 3]))


def some(*quick):
    """All cases, those that are not quick marked as slow: every scene is compiled anew."""
    return [
        pytest.param(name, marks=[] if name[:2] in quick else pytest.mark.slow) for name in CASES
    ]


@pytest.mark.slow
@pytest.mark.parametrize("name", some("B1"))
def test_strain_dependent_is_the_reference(name):
    eq, error = tip_error(name, vsr.StrainDependent(32))
    assert error < 1e-7
    case = CASES[name]
    scale = np.maximum(1, np.abs(case["strain"]).max(axis=0))
    assert (
        np.max(np.abs(np.asarray(eq.strain(np.array(case["X"]))) - case["strain"]) / scale) < 1e-5
    )


@pytest.mark.slow
def test_loaded_tips_have_the_order_of_the_steps():
    """Sixth order needs the nodes' own rotations to sixth order: with first commutators alone it
    was 4.5."""
    errors = [
        tip_error("B1 gravity and tip force", vsr.StrainDependent(steps))[1] for steps in (6, 12)
    ]
    assert errors[1] < 2.0**-5.5 * errors[0]


@pytest.mark.slow
@pytest.mark.parametrize("name", CASES)
def test_continuum_is_the_reference(name):
    assert (
        tip_error(name, vsr.Continuum(rtol=1e-10, atol=1e-12, derivative=vsr.StrainDependent(16)))[
            1
        ]
        < 1e-7
    )


@pytest.mark.slow
def test_prescribed_converges_with_its_basis():
    errors = [
        tip_error("A2 tip force", vsr.Prescribed(vsr.Basis.uniform(vsr.Legendre(n)), steps=24))[1]
        for n in (4, 8)
    ]
    assert errors[0] < 1e-4
    assert errors[1] < min(1e-7, 1e-3 * errors[0])


HEAVY = vsr.Scene(
    vsr.Rod(0.5, vsr.Circular(0.01), vsr.Material(5e5, poisson=0.45, density=1100.0)),
    [vsr.Tendon(vsr.Parallel(0.006, 0.0))],
    [vsr.Gravity()],
)
BENDING = vsr.Prescribed(vsr.Basis.uniform(vsr.Legendre(3), ("bending_y", "bending_z")))


@pytest.mark.slow
def test_a_prescribed_basis_takes_few_steps_under_gravity():
    """10 to 123 Newton steps, before anything bounded how far one turns the arm."""

    def one(tension):
        eq = vsr.solve(HEAVY, tension, model=BENDING)
        return eq.status, eq.steps

    status, steps = jax.jit(jax.vmap(one))(jnp.linspace(0.0, 5.0, 21)[:, None])
    assert np.all(status == vsr.Status.CONVERGED)
    assert np.max(steps) <= 15


@pytest.mark.slow
def test_two_batches_of_prescribed_solves_stand_in_one_program():
    """LAPACK's batched routines side by side in one program waited for each other without end."""
    tensions = jnp.linspace(0.0, 2.5, 1024)[:, None]

    def tips(tensions):
        return jax.vmap(lambda tension: vsr.solve(HEAVY, tension, model=BENDING).tip[:3, 3])(
            tensions
        )

    first, second = jax.jit(lambda x: (tips(x), tips(2 * x)))(tensions)
    np.testing.assert_allclose(second[:512:64], first[::128], atol=1e-9)


@pytest.mark.slow
def test_single_precision_holds_a_ten_thousandth_of_the_length():
    case = CASES["B1 gravity and tip force"]
    eq = vsr.solve(
        loaded_scene(case),
        jnp.asarray(case["tau"], jnp.float32),
        model=vsr.StrainDependent(16),
        throw=True,
    )
    assert eq.tip.dtype == jnp.float32
    assert np.linalg.norm(eq.tip[:3, 3] - np.array(case["tip"])[:3, 3]) < 1e-4 * 0.75


def test_point_distributed_and_tip_loads_add_up():
    """A load per length on the second half is a point force at its middle as far as the first half
    is concerned."""
    density = vsr.Piecewise([0.25], [0.0, 0.2])
    scene = vsr.Scene(
        ARM,
        [],
        [
            vsr.DistributedWrench(force=(0.0, 0.0, density)),
            vsr.PointWrench(0.125, moment=(0.0, 0.01, 0.0)),
        ],
    )
    eq = vsr.solve(scene, [], model=vsr.StrainDependent(12), throw=True)
    X = np.linspace(0.25, 0.5, 201)
    position = eq.position(X)
    reaction = eq.reaction(jnp.array([0.0, 0.2, 0.3]))
    np.testing.assert_allclose(
        reaction[:, 3:] @ np.eye(3), [[0, 0, 0.05], *reaction[1:, 3:]], atol=1e-14
    )
    np.testing.assert_allclose(
        jnp.linalg.norm(reaction[:, 3:], axis=1), [0.05, 0.05, 0.04], rtol=1e-12
    )
    # moment at the base: the point's, and the force's with its arm; the weight's centre is that of
    # the second half
    centre = np.trapezoid(position, X, axis=0) / 0.25
    np.testing.assert_allclose(
        reaction[0, :3], np.array([0, 0.01, 0]) + np.cross(centre, [0, 0, 0.05]), atol=1e-8
    )
    assert position[-1, 2] > position[0, 2] > 0


@pytest.mark.slow
def test_buoyancy_of_the_same_density_floats():
    eq = vsr.solve(
        vsr.Scene(ARM, [], [vsr.Gravity(fluid_density=1000.0)]), [], model=vsr.StrainDependent(8)
    )
    np.testing.assert_allclose(eq.tip[:3, 3], [0.5, 0, 0], atol=1e-13)


@pytest.mark.slow
def test_a_turned_base_turns_dead_loads_the_other_way():
    turn = vsr.se3.exp(jnp.array([0.3, -0.8, 0.5, 0.0, 0.1, 0.2]))
    force = jnp.array([0.05, 0.1, -0.1])
    plain = vsr.solve(vsr.Scene(ARM, [], [vsr.TipWrench(force)]), [], model=vsr.StrainDependent(8))
    rod = vsr.Rod(0.5, ARM.section, ARM.material, base=turn)
    turned = vsr.solve(
        vsr.Scene(rod, [], [vsr.TipWrench(turn[:3, :3] @ force)]), [], model=vsr.StrainDependent(8)
    )
    np.testing.assert_allclose(turned.tip, turn @ plain.tip, atol=1e-11)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (
            lambda: vsr.Scene(ARM, [], [vsr.PointWrench(0.6)]),
            r"Scene\.loads\[0\]\.X: got 0\.6 m, need a place on the arm of 0\.5 m",
        ),
        (lambda: vsr.PointWrench(-0.1), r"PointWrench\.X: got -0\.1, need a finite number >= 0"),
        (lambda: vsr.TipWrench(force=(1.0, 2.0)), r"TipWrench\.force: got shape \(2,\)"),
        (
            lambda: vsr.TipWrench(frame="tip"),
            r"TipWrench\.frame: got 'tip', need one of 'world', 'body'",
        ),
        (
            lambda: vsr.DistributedWrench(force=(1.0, 2.0)),
            r"DistributedWrench\.force: got \(1\.0, 2\.0\), need three profiles",
        ),
        (
            lambda: vsr.Gravity(fluid_density=-1.0),
            r"Gravity\.fluid_density: got -1\.0, need a finite number >= 0",
        ),
        (
            lambda: vsr.Scene(
                vsr.Rod(0.5, ARM.section, vsr.Material(1e6, poisson=0.5)), [], [vsr.Gravity()]
            ),
            r"a Gravity and a rod whose material has no density, need Material\(\.\.\., "
            r"density=\.\.\.\)",
        ),
        (lambda: vsr.Scene(ARM, [], [3.0]), r"Scene\.loads\[0\]: got 3\.0, need a Gravity"),
        (
            lambda: vsr.Scene(ARM, [], free_strains=["twist"]),
            r"Scene\.free_strains: got \['twist'\], need some of torsion, bending_y",
        ),
        (
            lambda: vsr.Tendon(vsr.Parallel(0.0, 0.0), start=0.3, end=0.2),
            r"Tendon\.end: got end = 0\.2 m and start = 0\.3 m",
        ),
        (
            lambda: vsr.Scene(ARM, [vsr.Thread(vsr.Parallel(0.0, 0.0), end=0.7)]),
            r"Scene\.actuators\[0\]\.end: got 0\.7 m",
        ),
        (
            lambda: vsr.Tendon(vsr.Parallel(0.0, 0.0), friction=-0.1),
            r"Tendon\.friction: got -0\.1, need a finite number >= 0",
        ),
        (
            lambda: vsr.Tendon(vsr.Parallel(0.0, 0.0), stiffness=1e4),
            r"Tendon\.stiffness: got 10000.0 with control='tension'",
        ),
        (
            lambda: vsr.Tendon(vsr.Parallel(0.0, 0.0), control="speed"),
            r"Tendon\.control: got 'speed', need one of 'tension', 'length'",
        ),
        (
            lambda: vsr.solve(
                vsr.Scene(ARM, [vsr.Tendon(vsr.Parallel(0.0, 0.0), control="length")]), [-0.6]
            ),
            r"inputs\[0\]: got -0\.6 m, need a change of length > -0\.5 m",
        ),
        (
            lambda: vsr.solve(
                vsr.Scene(ARM, [], free_strains=["bending_y"]),
                [],
                model=vsr.Prescribed(vsr.Basis({"torsion": vsr.Legendre(1)})),
            ),
            r"Prescribed\.basis: got one that frees torsion, need only bending_y",
        ),
        (
            lambda: vsr.Piecewise([0.2, 0.1], [1.0, 2.0, 3.0]),
            r"Piecewise\.ends: got \[0\.2, 0\.1\], need an array of increasing",
        ),
        (lambda: vsr.Joined([0.2], [ARM.section]), r"Joined: got 1 ends and 1 parts"),
    ],
)
def test_bad_scenes_are_refused(make, message, unchecked):
    with pytest.raises(ValueError, match=message):
        make()


@pytest.mark.slow
def test_batches_in_batches_are_the_single_solves_and_bad_lanes_harm_none():
    lengths = jnp.array([0.5, 0.4])
    forces = jnp.array([[0.0, 0.0, 0.1], [0.0, 0.1, 0.0], [-0.2, 0.0, 0.05]])

    def tip(length, force):
        arm = vsr.Rod(length, ARM.section, ARM.material)
        return vsr.solve(
            vsr.Scene(arm, [], [vsr.TipWrench(force)]), [], model=vsr.StrainDependent(8)
        ).tip

    batch = jax.jit(jax.vmap(jax.vmap(tip, (None, 0)), (0, None)))
    tips = batch(lengths, forces)
    np.testing.assert_allclose(tips[1, 2], tip(lengths[1], forces[2]), atol=1e-11)
    np.testing.assert_allclose(tips[0, 0, [0, 2], 3], tips[0, 1, [0, 1], 3], atol=1e-11)
    spoiled = batch(lengths, forces.at[1].set(jnp.array([jnp.nan, 1e300, 0.0])))
    assert np.all(np.isnan(spoiled[:, 1]))
    np.testing.assert_array_equal(spoiled[:, [0, 2]], tips[:, [0, 2]])
