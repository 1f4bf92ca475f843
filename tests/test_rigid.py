"""Rigid pieces: against the wrench that a tool exerts, against parts joined by a rigid transform,
and as the limit of stiff material."""

from typing import Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import central_differences, epsilon, with_derivative

import vsr_jax as vsr
from vsr_jax.files import parse_scene
from vsr_jax.files.scene_file import to_toml
from vsr_jax.studies.timing import primitives

LENGTH, START, END = 0.36, 0.1, 0.16
MODEL = vsr.StrainDependent(24)
YOUNG = 6e5
SECTION = vsr.Circular(0.01)
PIECE = vsr.RigidPiece(START, END)
TENDONS = [
    vsr.Tendon(vsr.Helix(0.006, angle=1.0)),
    vsr.Tendon(vsr.Parallel(0.0, 0.006), end=0.25),
]
INPUTS = jnp.array([2.0, 1.5])
SENSES: tuple[Literal["left", "right"], ...] = ("left", "right")
GRAVITY = [vsr.Gravity()]
FOLLOWERS = [
    vsr.Gravity(),
    vsr.PointWrench(0.13, force=(0.0, 0.05, 0.1), frame="body"),  # on the piece
    vsr.TipWrench(force=(0.0, 0.02, 0.05), moment=(0.001, 0.0, 0.0), frame="body"),
]
SPRING = [vsr.Gravity(), vsr.Spring((0.3, 0.0, 0.1), 20.0, X=0.13)]


def rod(*rigid, young=YOUNG, length=LENGTH, **options):
    material = vsr.Material(young, poisson=0.45, density=1000.0)
    return vsr.Rod(length, SECTION, material, rigid=rigid, **options)


def scene(loads=(), actuators=TENDONS, piece=PIECE, **options):
    return vsr.Scene(rod(piece, **options), actuators, loads)


def stiff(young, loads=(), actuators=TENDONS):
    """The arm with stiff material in place of the rigid piece."""
    return vsr.Scene(
        rod(young=vsr.Piecewise([START, END], [YOUNG, young, YOUNG])), actuators, loads
    )


@pytest.mark.slow
def test_a_tool_exerts_its_wrench_at_the_end_of_the_arm():
    """Gravity and a force on a tool are a force and a moment at its start; the tendon through it
    pulls there with the same force."""
    arm, tool, force = 0.3, 0.06, jnp.array([0.02, 0.05, -0.1])
    tendon = vsr.Tendon(vsr.Parallel(0.006, 0.002))
    with_tool = vsr.Scene(
        rod(vsr.RigidPiece(arm), length=arm + tool), tendon, [*GRAVITY, vsr.TipWrench(force)]
    )
    eq = vsr.solve(with_tool, [1.5], model=vsr.StrainDependent(60))
    weight = jnp.array([0.0, 0.0, -9.81 * 1000.0 * np.pi * 0.01**2 * tool])
    start, middle, end = eq.position(jnp.array([arm, arm + tool / 2, arm + tool]))
    moment = jnp.cross(end - start, force) + jnp.cross(middle - start, weight)
    without = vsr.Scene(rod(length=arm), tendon, [*GRAVITY, vsr.TipWrench(force + weight, moment)])
    alone = vsr.solve(without, [1.5], model=vsr.StrainDependent(50))
    assert bool(eq.converged)
    assert np.linalg.norm(alone.tip[:3, 3] - jnp.array([arm, 0.0, 0.0])) > 0.1
    np.testing.assert_allclose(eq.pose(arm), alone.tip, rtol=0, atol=1e-10)
    np.testing.assert_allclose(
        eq.tip, alone.tip @ vsr.se3.exp(jnp.array([0, 0, 0, tool, 0, 0])), rtol=0, atol=1e-10
    )


def test_parts_beside_a_piece_bend_as_if_alone():
    """Without loads the arm is two arms and a rigid transform between them."""
    tendon = vsr.Tendon(vsr.Parallel(0.006, 0.002))
    eq = vsr.solve(scene(actuators=tendon), [4.0], model=MODEL)
    first = vsr.solve(vsr.Scene(rod(length=START), tendon), [4.0]).tip
    last = vsr.solve(vsr.Scene(rod(length=LENGTH - END), tendon), [4.0]).tip
    between = vsr.se3.exp(jnp.array([0.0, 0.0, 0.0, END - START, 0.0, 0.0]))
    np.testing.assert_allclose(eq.tip, first @ between @ last, rtol=0, atol=1e-13)
    np.testing.assert_allclose(eq.pose(END), first @ between, rtol=0, atol=1e-13)


LOADS = {"none": (), "gravity": GRAVITY, "followers": FOLLOWERS, "spring": SPRING}


@pytest.mark.slow
@pytest.mark.parametrize(
    "loads",
    [
        "none",
        *(pytest.param(x, marks=pytest.mark.slow) for x in ("gravity", "followers")),
        "spring",
    ],
)
def test_stiff_material_comes_close_as_its_compliance_does(loads):
    """Tip, lengths of threads and stability margin, with an error of first order."""

    @eqx.filter_jit
    def found(scene):
        eq = vsr.solve(scene, INPUTS, model=MODEL)
        margin = eq.stability if LOADS[loads] else eq.condition
        return jnp.concatenate([eq.tip[:3].ravel(), eq.lengths, margin[None]])

    exact = found(scene(LOADS[loads]))
    off = [found(stiff(young, LOADS[loads])) - exact for young in (1e10, 1e11)]
    moved = slice(0, 14)
    assert np.abs(off[0][moved]).max() < 1e-4
    np.testing.assert_allclose(
        10 * off[1][moved], off[0][moved], rtol=0, atol=0.01 * np.abs(off[0][moved]).max()
    )
    np.testing.assert_allclose(off[1][-1], 0, atol=1e-4 * abs(exact[-1]))


@pytest.mark.slow
def test_rigid_pieces_take_no_more_steps_than_stiff_ones():
    near = vsr.solve(stiff(1e9, FOLLOWERS), INPUTS, model=MODEL)
    assert int(vsr.solve(scene(FOLLOWERS), INPUTS, model=MODEL).steps) <= int(near.steps)


@pytest.mark.slow
@pytest.mark.parametrize("loads", [(), SPRING], ids=["bare", "spring"])
def test_the_strain_is_that_at_rest_to_the_last_bit(loads, dtype):
    bow = (0.3, 2.0, 0.0, 1.02, 0.0, 0.01)
    bowed = scene(loads, rest_strain=bow).astype(dtype)
    X = jnp.linspace(START + 1e-3, END - 1e-3, 5, dtype=dtype)
    eq = vsr.solve(bowed, INPUTS.astype(dtype), model=MODEL)
    assert bool(eq.converged)
    np.testing.assert_array_equal(eq.strain(X), np.tile(np.asarray(bow, dtype), (5, 1)))
    assert np.abs(eq.strain(START / 2) - jnp.array(bow)).max() > 0.01
    assert float(eq.energy.elastic) > 0
    if dtype == jnp.float32:
        exact = vsr.solve(bowed.astype("float64"), INPUTS, model=MODEL).tip
        np.testing.assert_allclose(eq.tip, exact, atol=300 * epsilon(dtype))


LENGTHS = [vsr.Tendon(vsr.Helix(0.006, angle=1.0), control="length", stiffness=3e3), TENDONS[1]]
RUBBING = [vsr.Tendon(vsr.Helix(0.006, angle=1.0), friction=0.3), TENDONS[1]]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("actuators", "loads", "inputs"),
    [
        pytest.param(LENGTHS, (), (-0.01, 1.5), marks=pytest.mark.slow, id="lengths"),
        pytest.param(LENGTHS, GRAVITY, (-0.01, 1.5), id="lengths and gravity"),
        pytest.param(RUBBING, (), (3.0, 1.5), id="friction"),
    ],
)
def test_couplings_pass_through(actuators, loads, inputs):
    eq = vsr.solve(scene(loads, actuators), inputs, model=MODEL)
    near = vsr.solve(stiff(1e12, loads, actuators), inputs, model=MODEL)
    assert bool(eq.converged)
    np.testing.assert_allclose(eq.tip, near.tip, rtol=0, atol=1e-6)
    np.testing.assert_allclose(eq.forces, near.forces, rtol=1e-5)


@pytest.mark.slow
def test_a_batch_of_pieces_is_that_of_single_solves():
    starts = jnp.array([0.05, 0.1, 0.2])

    def tip(start):
        return vsr.solve(
            scene(SPRING, piece=vsr.RigidPiece(start, start + 0.06)), INPUTS, model=MODEL
        ).tip

    each = [tip(start) for start in starts]
    assert np.abs(each[0] - each[2]).max() > 0.005
    np.testing.assert_allclose(jax.vmap(tip)(starts), jnp.stack(each), rtol=0, atol=1e-10)


@pytest.mark.slow
@pytest.mark.parametrize(
    "loads",
    [
        pytest.param((), marks=pytest.mark.slow, id="bare"),
        pytest.param(GRAVITY, marks=pytest.mark.slow, id="gravity"),
        pytest.param(SPRING, id="spring"),
    ],
)
def test_derivatives(loads):
    """By the ends of the piece, the tension, the weight and the rest strain, which is the strain of
    the piece."""

    def tip(x):
        piece = vsr.RigidPiece(x[0], x[1])
        bow = (0.0, x[4], 0.0, 1.0, 0.0, 0.0)
        found = scene(loads, piece=piece, rest_strain=bow)
        found = found.replace("rod.material.density", 1e3 * x[3])
        return vsr.solve(found, jnp.array([x[2], 1.5]), model=MODEL).tip[:3]

    x, solved = jnp.array([START, END, 2.0, 1.0, 2.0]), with_derivative(tip)
    forward, reverse = solved(x)[1], jax.jit(jax.jacrev(tip))(x)
    h = 1e-4 * x
    changes = central_differences(lambda unit: solved(x + h * unit)[0], 5) / h[:, None, None]
    for i, change in enumerate(changes):
        scale = np.abs(change).max() + 1e-9
        np.testing.assert_allclose(forward[..., i] / scale, change / scale, atol=1e-6)
    np.testing.assert_allclose(reverse, forward, rtol=0, atol=1e-9)
    assert np.abs(forward[..., 0]).max() > 1e-3


@pytest.mark.slow
@pytest.mark.parametrize("force", [-20.0, 20.0], ids=["pull", "push"])
def test_the_margin_leaves_rigid_pieces_out(force):
    """Threads in all directions stiffen every section that bends, or soften it; a rigid one, whose
    eigenvalues would be 1, does not count."""
    paths = [vsr.Helix(0.006, angle=0.8, phase=2.0 * i, hand=h) for i in range(3) for h in SENSES]
    threads, inputs = [vsr.Thread(path) for path in paths], jnp.full(6, force)
    free = vsr.solve(vsr.Scene(rod(), threads), inputs, model=MODEL)
    held = vsr.solve(scene(actuators=threads), inputs, model=MODEL)
    if force < 0:
        assert float(free.stability) > 1 + 1e-2
    else:
        assert float(free.condition * free.stability) < 1 - 1e-2
    np.testing.assert_allclose(held.stability, free.stability, rtol=1e-3)
    np.testing.assert_allclose(held.condition, free.condition, rtol=1e-3)


@pytest.mark.slow
def test_compliance_is_that_of_a_small_wrench():
    eq = vsr.solve(scene(), INPUTS, model=MODEL)

    def tip(force):
        pushed = scene([vsr.TipWrench(jnp.array([0.0, 0.0, 1.0]) * force)])
        return vsr.solve(pushed, INPUTS, model=MODEL).tip[:3, 3]

    change = (tip(1e-4) - tip(-1e-4)) / 2e-4
    np.testing.assert_allclose(vsr.compliance(eq)[3:, 5], change, rtol=1e-5, atol=1e-7)


@pytest.mark.slow
def test_energy_is_stationary_with_the_tension():
    """The derivative of the potential by a given tension is the length of its path."""

    def energy(tension):
        values = jnp.array([tension, 1.5])
        return vsr.solve(scene(GRAVITY), values, model=MODEL).energy.total

    eq = vsr.solve(scene(GRAVITY), INPUTS, model=MODEL)
    slope = (energy(2.0 + 1e-3) - energy(2.0 - 1e-3)) / 2e-3
    np.testing.assert_allclose(slope, eq.lengths[0], rtol=1e-6)


@pytest.mark.slow
def test_a_branch_leads_to_the_solution():
    def path(s):
        return s * INPUTS

    branch = vsr.follow_branch(scene(GRAVITY), path, points=40, model=vsr.StrainDependent(8))
    last = jax.tree.map(lambda x: x[-1], branch.equilibria)
    exact = vsr.solve(scene(GRAVITY), INPUTS, model=vsr.StrainDependent(8))
    assert float(branch.parameter[-1]) == 1.0
    np.testing.assert_allclose(last.tip, exact.tip, rtol=0, atol=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("order", [*(pytest.param(n, marks=pytest.mark.slow) for n in (2, 4)), 6])
def test_jumps_of_the_curvature_are_no_lack_of_steps(order):
    """Discs along an arm: the strain between them is exact without loads, and with gravity the
    estimated error is at least the true one."""
    discs = [vsr.RigidPiece(x, x + 0.01) for x in (0.05, 0.1, 0.15, 0.2, 0.25, 0.3)]
    arm = vsr.Scene(rod(*discs), vsr.Tendon(vsr.Parallel(0.006, 0.0)), GRAVITY)
    eq = vsr.solve(arm, [4.0], model=vsr.StrainDependent(39, order))
    assert eq.message == "converged"
    bare = vsr.Scene(arm.rod, arm.actuators)
    assert vsr.solve(bare, [16.0], model=vsr.StrainDependent(13, order)).message == "converged"
    exact = vsr.solve(arm, [4.0], model=vsr.StrainDependent(130)).tip[:3, 3]
    error = np.linalg.norm(eq.tip[:3, 3] - exact)
    assert error <= float(eq.error.tip) < 30 * error + 1e-10


@pytest.mark.slow
def test_the_continuous_model_agrees():
    continuum = vsr.Continuum(segments=6, derivative=vsr.StrainDependent(48))
    eq = vsr.solve(scene(FOLLOWERS), INPUTS, model=continuum)
    exact = vsr.solve(scene(FOLLOWERS), INPUTS, model=vsr.StrainDependent(96))
    np.testing.assert_allclose(eq.tip, exact.tip, rtol=0, atol=1e-7)
    np.testing.assert_array_equal(eq.strain(0.13), [0.0, 0.0, 0.0, 1.0, 0.0, 0.0])


BARE_OR_HEAVY = [
    pytest.param((), marks=pytest.mark.slow, id="bare"),
    pytest.param(GRAVITY, id="gravity"),
]


@pytest.mark.slow
@pytest.mark.parametrize("loads", BARE_OR_HEAVY)
def test_a_basis_counts_beside_the_pieces(loads):
    """Smooth on the part that bends, so that a higher degree converges fast."""
    arm = scene(loads, vsr.Tendon(vsr.Parallel(0.006, 0.002)), piece=vsr.RigidPiece(0.3))
    exact = vsr.solve(arm, [3.0], model=vsr.StrainDependent(48))

    def solved(degree):
        basis = vsr.Basis.uniform(vsr.Legendre(degree))
        return vsr.solve(arm, [3.0], model=vsr.Prescribed(basis, points=12, steps=48))

    def off(eq):
        return np.abs(eq.tip - exact.tip).max()

    coarse, fine = solved(4), solved(8)
    assert off(fine) < 0.01 * off(coarse) + 1e-12 < 1e-4
    assert off(fine) < 1e-7
    np.testing.assert_array_equal(fine.strain(0.33), [0.0, 0.0, 0.0, 1.0, 0.0, 0.0])


@pytest.mark.slow
@pytest.mark.parametrize("loads", BARE_OR_HEAVY)
def test_a_section_of_a_basis_may_be_a_rigid_piece(loads):
    """Its coordinates are zero, and the others are those of an arm with stiff material there."""
    basis = vsr.Basis.uniform(vsr.PiecewiseConstant([0.1, START / LENGTH, END / LENGTH, 0.7]))
    model, sections = vsr.Prescribed(basis, points=8, steps=16), slice(2, 30, 5)

    q = with_derivative(lambda inputs: vsr.solve(scene(loads), inputs, model=model).q)
    found, jacobian = q(INPUTS)
    near = vsr.solve(stiff(1e13, loads), INPUTS, model=model).q
    np.testing.assert_array_equal(found[sections], 0)
    np.testing.assert_allclose(found, near, rtol=0, atol=1e-5)
    assert np.abs(found).max() > 1
    h = jnp.array([1e-4, 0.0])
    change = (q(INPUTS + h)[0] - q(INPUTS - h)[0]) / 2e-4
    np.testing.assert_allclose(jacobian[:, 0], change, rtol=0, atol=1e-6)


def test_an_arm_without_rigid_pieces_computes_nothing_for_them():
    def operations(arm):
        values = jnp.zeros(len(arm.actuators))
        return primitives(jax.make_jaxpr(lambda x: MODEL.solve(arm, x).state.xi)(values))

    def masked(arm):
        return arm.sections(jnp.array([0.05, START, 0.13, END, 0.2])).flexible

    none = vsr.Scene(rod(), TENDONS, GRAVITY)
    assert masked(none) is None
    np.testing.assert_array_equal(masked(scene()), [1, 0, 0, 0, 1])
    for loads in ((), GRAVITY):
        rigid, plain = operations(scene(loads)), operations(vsr.Scene(rod(), TENDONS, loads))
        assert rigid["while"] == plain["while"]
        assert rigid["scan"] == plain["scan"]
        assert rigid["select_n"] > plain["select_n"]


@pytest.mark.parametrize(
    ("rigid", "message"),
    [
        ([vsr.RigidPiece(0.3, 0.4)], r"rod\.rigid\[0\]\.end: got 0\.4 m, need a place on the arm"),
        ([vsr.RigidPiece(0.5)], r"rod\.rigid\[0\]\.start: got 0\.5 m, need a place on the arm"),
        ([vsr.RigidPiece(LENGTH)], r"rod\.rigid\[0\]\.end: .* need an end beyond the start"),
        (
            [PIECE, vsr.RigidPiece(0.15, 0.2)],
            r"rod\.rigid\[1\]\.start: got 0\.15 m within Scene\.rod\.rigid\[0\]",
        ),
        ([PIECE, vsr.RigidPiece(end=0.11)], r"rod\.rigid\[0\]\.start: got 0\.1 m within"),
        ([vsr.RigidPiece()], r"rod\.rigid: got pieces that cover all of the arm"),
        ([vsr.RigidPiece(0.1), vsr.RigidPiece(end=0.1)], r"need a part of it that bends"),
    ],
)
def test_pieces_that_no_arm_has_are_refused(rigid, message):
    with pytest.raises(ValueError, match=message):
        vsr.Scene(rod(*rigid))


def test_wrong_arguments_are_named(unchecked):
    with pytest.raises(ValueError, match=r"RigidPiece\.end: got end = 0\.1 m and start = 0\.2 m"):
        vsr.RigidPiece(0.2, 0.1)
    with pytest.raises(ValueError, match=r"RigidPiece\.start: got -0\.1"):
        vsr.RigidPiece(-0.1, 0.1)
    with pytest.raises(ValueError, match=r"Rod\.rigid\[0\]: got 0\.1, need a RigidPiece"):
        rod(0.1)
    material = vsr.Material(1e6, poisson=0.5)
    with pytest.raises(ValueError, match=r"Rod\.rigid: got 0\.1, need a RigidPiece"):
        vsr.Rod(0.3, SECTION, material, rigid=0.1)  # pyright: ignore[reportArgumentType]


@pytest.mark.slow
def test_pieces_side_by_side_are_one():
    halves = rod(vsr.RigidPiece(0.13, END), vsr.RigidPiece(START, 0.13))
    joined = vsr.solve(vsr.Scene(halves, TENDONS, GRAVITY), INPUTS, model=vsr.StrainDependent(48))
    whole = vsr.solve(scene(GRAVITY), INPUTS, model=vsr.StrainDependent(48))
    distance = np.linalg.norm((joined.tip - whole.tip)[:3, 3])
    assert distance <= float(joined.error.tip + whole.error.tip) < 1e-7


def test_numbers_of_a_piece_have_names():
    moved = scene().replace("rod.rigid[0].end", 0.2)
    assert float(moved.rod.rigid[0].end) == 0.2
    assert "rigid pieces" in moved.effects
    with pytest.raises(ValueError, match=r"rod\.rigid\[0\]\.end: got end = 0\.05 m and start"):
        scene().replace("rod.rigid[0].end", 0.05)
    with pytest.raises(ValueError, match=r"rod\.rigid\[0\]\.end: got 0\.16 m, need a place"):
        scene().replace("rod.length", 0.15)


def test_scene_files_keep_pieces():
    arm = vsr.Scene(rod(PIECE, vsr.RigidPiece(0.3)), TENDONS)
    text = to_toml(arm)
    assert "rigid = [" in text
    found = parse_scene(text).scene
    assert to_toml(found) == text
    assert found.rod.rigid[1].end is None
    assert "rigid" not in to_toml(vsr.Scene(rod(), TENDONS))
