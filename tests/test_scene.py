"""Scenes and inputs: what is refused, which numbers are taken, and what rest strain and base do."""

import inspect

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import vsr_jax as vsr
from vsr_jax.numerics import se3

ARM = vsr.Rod(0.5, vsr.Circular(0.01), vsr.Material(1e6, poisson=0.5))
SCENE = vsr.Scene(
    ARM,
    [
        vsr.Tendon(vsr.Parallel(0.005, 0.0)),
        vsr.Chamber(vsr.Parallel(0.0, 0.005), area=2e-5),
        vsr.Thread(vsr.Parallel(0.0, -0.005)),
    ],
)


def test_inputs_become_thread_forces():
    np.testing.assert_allclose(SCENE.forces(jnp.array([3.0, 2e4, -1.5])), [-3.0, 0.4, -1.5])


@pytest.mark.parametrize(
    ("inputs", "message"),
    [
        (
            [1.0, 2.0],
            r"inputs: got shape \(2,\), need \(3,\), one number each for Tendon, Chamber, Thread",
        ),
        (np.ones((4, 3)), "for a batch use jax.vmap"),
        ([-1.0, 0.0, 0.0], r"inputs\[0\]: got -1, need a finite number >= 0 \[N\] for a Tendon"),
        ([1.0, np.nan, 0.0], r"inputs\[1\]: got nan, need a finite number \[Pa\] for a Chamber"),
        ([1.0, 0.0, np.inf], r"inputs\[2\]: got inf"),
        (["1", 0.0, 0.0], "inputs: got .*, need finite numbers"),
        ("1 2 3", "inputs: got '1 2 3'"),
        ({"a": 1.0}, "inputs: got .*need finite numbers"),
    ],
)
@pytest.mark.usefixtures("unchecked")
def test_bad_inputs_are_named(inputs, message):
    with pytest.raises(ValueError, match=message):
        vsr.solve(SCENE, inputs)


BENT = vsr.Rod(
    0.5,
    vsr.Joined([0.1], [vsr.Circular(lambda X: 0.01), vsr.Elliptic(0.01, vsr.Taper(0.01, 0.009))]),
    vsr.Material(1e6, poisson=0.5, density=1e3),
    rest_strain=lambda X: (0.0, X, 0.0, 1.0, 0.0, 0.0),
    rigid=vsr.RigidPiece(0.4),
    discs=vsr.Discs(10, radius=0.03),
)
SMOOTH, FORWARD = vsr.Spline([0.0, 0.2, 0.5], [0.0, 0.01, 0.0], [0.0, 0.0, 0.0]), [1.0, 0.0, 0.0]
PARTS = [
    *(vsr.Parallel(0.01, 0.0), vsr.Linear(0.01, 0.0, 0.1), vsr.Helix(0.01, 1.5), SMOOTH),
    *(vsr.Polynomial([0.01], [0.0, 0.1]), vsr.Function(lambda X: (0.01, X))),
    *(vsr.Constant(1.0), vsr.Taper(1.0, 2.0), vsr.PolynomialProfile([1.0, 2.0])),
    *(vsr.Piecewise([0.1], [1.0, lambda X: 2.0]), vsr.SplineProfile([0.0, 0.5], [1.0, 2.0])),
    *(vsr.Annular(0.01, 0.005), vsr.Rectangular(0.01, 0.02), BENT.section, BENT.material, BENT),
    *(BENT.rigid[0], vsr.Scene(BENT, SCENE.actuators, [vsr.DistributedWrench(FORWARD)])),
    *(
        vsr.Tendon(SMOOTH, end=0.4),
        vsr.Tendon(SMOOTH, straight=True),
        vsr.Tendon(SMOOTH, control="length"),
    ),
    *(
        vsr.Discs(3),
        vsr.Discs(places=[0.1], mass=0.1),
        vsr.Thread(SMOOTH),
        vsr.Chamber(SMOOTH, area=1e-5),
    ),
    *(vsr.Gravity(), vsr.DistributedWrench(lambda X: (X, 0.0, 0.0)), vsr.TipWrench(FORWARD)),
    *(vsr.Spring(FORWARD, 1.0), vsr.Payload(0.1), vsr.Spinning(FORWARD)),
    *(vsr.MagneticMoment(FORWARD, lambda r: r), vsr.MagneticDensity(lambda X: (X, 0, 0), FORWARD)),
    *(
        vsr.Gravity().scaled(2),
        vsr.Payload(0.1).scaled(2),
        vsr.Held(position=FORWARD, along=FORWARD),
    ),
    *(
        vsr.Plane(FORWARD),
        vsr.Sphere(FORWARD, 0.1),
        vsr.Cylinder(0.1),
        vsr.Cylinder(0.1, length=1.0),
    ),
    *(vsr.Box(FORWARD[:1] * 3), vsr.Field(lambda r: 1), vsr.Tube(0.1)),
    vsr.Tube(lambda s: 0.1, [[0.0, 0.0, 0.0], [0.3, 0.1, 0.0], FORWARD], pose=vsr.pose()),
    *(vsr.Monomial(2), vsr.Legendre(2), vsr.Trigonometric(2.0), vsr.PiecewiseConstant(3)),
    *(vsr.Functions(lambda X: (1, X), size=2), vsr.Basis({"torsion": vsr.Legendre(1)})),
    vsr.FunctionBasis(lambda X: [[1, X]] * 6, size=2),
]
NUMBERS = {
    **{"X": 0.1, "length": 0.5, "y": 0.001, "z": 0.0, "angle": 1.0, "value": 2.0, "factor": 0.5},
    **{"point": [0.1, 0.0, 0.2], "position": (0.1, 0.0, 0.2), "heading": FORWARD},
    **{"lengths": [0.1, 0.2], "inputs": [1.0, 2.0, 3.0], "rotation": np.eye(3).tolist()},
    **{"base": np.eye(4).tolist(), "rod": BENT, "frame": "world", "rest": 0.5},
}
INTEGERS = {
    **NUMBERS,
    **{"X": 0, "length": 1, "y": 0, "z": 0, "angle": 1, "value": 2, "factor": 2},
    **{"point": [1, 0, 2], "position": (1, 0, 2), "heading": [1, 0, 0], "lengths": [1, 2]},
    **{"inputs": [1, 2, 3], "rotation": np.eye(3, dtype=int).tolist()},
}


@pytest.mark.parametrize("part", PARTS, ids=lambda part: type(part).__name__)
@pytest.mark.parametrize("numbers", [NUMBERS, INTEGERS], ids=["floats", "integers"])
def test_methods_take_numbers_of_python(part, numbers):
    """All methods of numbers, places and inputs return what they return for arrays."""

    def shapes(method, *arguments):
        found = jax.eval_shape(lambda: method(part, *arguments))
        return jax.tree.map(lambda x: (x.shape, x.dtype), found)

    for name, method in inspect.getmembers(type(part), inspect.isfunction):
        takes = [x for x in inspect.signature(method).parameters if x != "self"]
        if name in ("__call__", name.lstrip("_")) and takes and {*takes} <= {*numbers}:
            given = [numbers[x] for x in takes]
            arrays = [x if isinstance(x, vsr.Rod | str) else jnp.asarray(x, float) for x in given]
            assert shapes(method, *given) == shapes(method, *arrays), name


def test_discs_and_edges_of_plain_numbers():
    discs = vsr.Discs(2)
    np.testing.assert_allclose(jax.jit(lambda: discs.along(0.215))(), [0.1075, 0.215])
    np.testing.assert_allclose(jax.jit(lambda: SCENE.edges([0.1]))(), [0.0, 0.1, 0.5])


@pytest.mark.usefixtures("unchecked")
def test_a_scene_without_actuators_takes_no_inputs():
    message = r"inputs: got shape \(1,\), need \(0,\), an empty list: the scene has no actuators;"
    with pytest.raises(ValueError, match=message):
        vsr.solve(vsr.Scene(ARM), [1.0])


@pytest.mark.slow
def test_traced_inputs_get_a_status_instead():
    def status(inputs):
        return vsr.solve(SCENE, inputs).status

    rows = jnp.array([[1.0, 0.0, 0.0], [-1.0, 0.0, 0.0], [1.0, jnp.nan, 0.0]])
    np.testing.assert_array_equal(
        jax.vmap(status)(rows),
        [vsr.Status.CONVERGED, vsr.Status.INADMISSIBLE, vsr.Status.NOT_FINITE],
    )


@pytest.mark.slow
def test_throw_raises_with_the_status_in_words():
    with pytest.raises(vsr.SolveError, match="collapsed"):
        vsr.solve(SCENE, [1e4, 0.0, 0.0], throw=True)
    with pytest.raises(RuntimeError, match="collapsed"):
        jax.block_until_ready(
            jax.jit(lambda x: vsr.solve(SCENE, x, throw=True).tip)(jnp.array([1e4, 0.0, 0.0]))
        )


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (
            lambda: vsr.Scene(ARM, [vsr.Thread(vsr.Parallel(0.02, 0.0))]),
            r"actuators\[0\]\.routing: the thread is 0\.01 m outside the section",
        ),
        (
            lambda: vsr.Scene(ARM, [vsr.Thread(vsr.Linear(0.0, 0.0, 0.1))]),
            r"0\.04 m outside the section at X = 0\.5 m",
        ),
        (
            lambda: vsr.Scene(ARM, [vsr.Parallel(0.0, 0.0)]),
            r"Scene\.actuators\[0\]: got .*, need a Thread, Tendon or Chamber",
        ),
        (lambda: vsr.Scene("arm", []), "Scene.rod: got 'arm', need a Rod"),
        (lambda: vsr.Thread(0.005), r"Thread\.routing: got 0\.005, need a routing"),
        (lambda: vsr.Chamber(vsr.Parallel(0.0, 0.0), area=0.0), r"Chamber\.area: got 0\.0"),
        (lambda: vsr.solve("scene", []), "scene: got 'scene', need a Scene"),
        (
            lambda: vsr.solve(SCENE, [0.0, 0.0, 0.0], model="exact"),
            "model: got 'exact', need StrainDependent",
        ),
        (
            lambda: vsr.StrainDependent(order=3),
            r"StrainDependent\.order: got 3, need one of 2, 4, 6",
        ),
        (
            lambda: vsr.StrainDependent(steps=0),
            r"StrainDependent\.steps: got 0, need an integer >= 1",
        ),
        (lambda: vsr.Prescribed(3), r"Prescribed\.basis: got 3, need a basis"),
        (
            lambda: vsr.Continuum(solver="rk4"),
            r"Continuum\.solver: got 'rk4', need a diffrax solver",
        ),
        (lambda: vsr.solve(SCENE, [0.0, 0.0, 0.0]).pose(np.zeros((2, 2))), "X: got shape"),
    ],
)
@pytest.mark.usefixtures("unchecked")
def test_refusals_say_what_and_where(make, message):
    with pytest.raises(ValueError, match=message):
        make()


def test_a_size_that_vanishes_somewhere_is_refused():
    arm = vsr.Rod(
        0.5, vsr.Circular(vsr.PolynomialProfile([0.01, -0.03])), vsr.Material(1e6, poisson=0.5)
    )
    with pytest.raises(
        ValueError,
        match=r"section\.radius: got -0\.005 m at X = 0\.5 m, need a size > 0 everywhere",
    ):
        vsr.Scene(arm, [])


TUBE = vsr.Annular(vsr.Taper(0.02, 0.01), 0.015)


@pytest.mark.parametrize(
    ("section", "material", "rest", "message"),
    [
        (
            TUBE,
            {},
            None,
            r"rod\.section\.inner: got 0\.015 m at X = 0\.5 m, need less than the outer radius "
            r"everywhere",
        ),
        (
            vsr.Joined([0.2], [vsr.Circular(0.02), TUBE]),
            {},
            None,
            r"rod\.section\.sections\[1\]\.inner: got 0\.015 m at X = 0\.5 m",
        ),
        (
            None,
            {"poisson": lambda x: 0.4 + x},
            None,
            r"rod\.material\.poisson: got 0\.9 at X = 0\.5 m, need a ratio > -1 and <= 0\.5",
        ),
        (
            None,
            {"young": lambda x: 1e6 - 4e6 * x},
            None,
            r"rod\.material\.young: got -1e\+06 at X = 0\.5 m, need a number > 0",
        ),
        (
            None,
            {"density": lambda x: 1e3 - 4e3 * x},
            None,
            r"rod\.material\.density: got -1000 at X = 0\.5 m",
        ),
        (
            None,
            {},
            (0.0, 0.0, 4.0, 0.0, 0.0, 0.0),
            r"rod\.rest_strain \(elongation\): got 0 at X = 0 m, need a number > 0",
        ),
    ],
    ids=["tube", "joined tube", "poisson", "young", "density", "elongation"],
)
def test_numbers_of_the_rod_out_of_their_range_somewhere_are_refused(
    section, material, rest, message
):
    numbers = {"young": 1e6, "poisson": 0.5, **material}
    arm = vsr.Rod(0.5, section or vsr.Circular(0.02), vsr.Material(**numbers), rest_strain=rest)
    with pytest.raises(ValueError, match=message):
        vsr.Scene(arm)


def test_a_section_keeps_to_its_limits_where_it_is_laid():
    joined = vsr.Joined([0.2], [TUBE, vsr.Circular(0.01)])
    vsr.Scene(vsr.Rod(0.5, joined, vsr.Material(1e6, poisson=0.5)))


BENT = vsr.Scene(
    ARM,
    [vsr.Tendon(vsr.Parallel(0.005, 0.0), start=0.1, end=0.3)],
    [vsr.TipWrench(force=(0.0, 0.1, 0.0))],
)
STEPS = vsr.StrainDependent(8)


@pytest.fixture(scope="module")
def bent():
    return vsr.solve(BENT, [1.0], model=STEPS)


@pytest.mark.slow
@pytest.mark.parametrize(
    "X", [0.7, -0.1, [0.1, 0.7], np.nan], ids=["beyond", "before", "one of two", "nan"]
)
@pytest.mark.parametrize("quantity", ["pose", "position", "strain", "reaction"])
def test_places_beyond_the_arm_are_refused(bent, quantity, X):
    with pytest.raises(
        ValueError, match=r"X: got (0\.7|-0\.1|nan) m, need 0 to 0\.5 m, the ends of the arm"
    ):
        getattr(bent, quantity)(X)


@pytest.mark.parametrize(
    ("index", "X", "message"),
    [
        (0, 0.4, r"X: got 0\.4 m, need 0\.1 to 0\.3 m, the ends of thread 0"),
        (0, [0.2, 0.05], r"X: got 0\.05 m, need 0\.1 to 0\.3 m, the ends of thread 0"),
        (1, 0.2, r"index: got 1, need the index of one of the scene's 1 actuators"),
        (-1, 0.2, r"index: got -1, need"),
        (0.0, 0.2, r"index: got 0\.0, need"),
    ],
)
@pytest.mark.usefixtures("unchecked")
def test_places_off_a_thread_are_refused(bent, index, X, message):
    with pytest.raises(ValueError, match=message):
        bent.thread(index, X)


@pytest.mark.slow
def test_single_precision_may_round_a_place_off_the_arm(bent):
    single = vsr.solve(BENT, np.float32([1.0]), model=STEPS)
    above = np.nextafter(np.float32(0.5), np.float32(1))
    np.testing.assert_array_equal(single.position(above), single.position(np.float32(0.5)))
    np.testing.assert_array_equal(bent.position([0.5 + 4e-7, -4e-7]), bent.position([0.5, 0.0]))
    np.testing.assert_array_equal(bent.thread(0, [0.3 + 4e-7, 0.1]), bent.thread(0, [0.3, 0.1]))


@pytest.mark.slow
def test_discs_may_guide_threads_outside_the_section():
    arm = vsr.Rod(
        0.4,
        vsr.Circular(0.0007),
        vsr.Material(54e9, poisson=0.3),
        discs=vsr.Discs(10, radius=0.012),
    )
    eq = vsr.solve(vsr.Scene(arm, [vsr.Tendon(vsr.Parallel(0.01, 0.0))]), [2.0])
    EA, EI = 54e9 * np.pi * 0.0007**2, 54e9 * np.pi / 4 * 0.0007**4
    np.testing.assert_allclose(
        eq.strain(0.2), [0, 0, 0.02 / EI, 1 - 2 / EA, 0, 0], rtol=1e-9, atol=1e-9
    )


def test_no_discs_are_advised_to_a_rod_that_has_them():
    wire, steel = vsr.Circular(0.0007), vsr.Material(54e9, poisson=0.3)
    thread = vsr.Tendon(vsr.Parallel(0.01, 0.0))
    with pytest.raises(ValueError, match=r"the section \(or give the rod discs with a radius\)$"):
        vsr.Scene(vsr.Rod(0.4, wire, steel), [thread])
    with pytest.raises(ValueError, match=r"inside the discs' radius of 0\.008 m$"):
        vsr.Scene(vsr.Rod(0.4, wire, steel, discs=vsr.Discs(10, radius=0.008)), [thread])


@pytest.mark.slow
def test_base_and_rest_strain_place_the_arm_at_rest():
    base = se3.exp(jnp.array([0.1, 0.2, 0.3, 1.0, 2.0, 3.0]))
    rest = (0.0, 0.0, 4.0, 1.0, 0.0, 0.0)
    arm = vsr.Rod(
        0.5, vsr.Circular(0.01), vsr.Material(1e6, poisson=0.5), rest_strain=rest, base=base
    )
    eq = vsr.solve(vsr.Scene(arm, [vsr.Thread(vsr.Parallel(0.005, 0.0))]), [0.0])
    np.testing.assert_allclose(eq.tip, base @ se3.exp(0.5 * jnp.asarray(rest)), atol=1e-12)


@pytest.mark.slow
def test_rest_strain_may_be_a_function_of_X():
    arm = vsr.Rod(
        0.5,
        vsr.Circular(0.01),
        vsr.Material(1e6, poisson=0.5),
        rest_strain=lambda x: (0.0, 0.0, 8 * x, 1.0, 0.0, 0.0),
    )
    eq = vsr.solve(vsr.Scene(arm, [vsr.Thread(vsr.Parallel(0.005, 0.0))]), [0.0])
    turn = np.arctan2(eq.tip[1, 0], eq.tip[0, 0])
    np.testing.assert_allclose(turn, 8 * 0.5**2 / 2, rtol=1e-12)


@pytest.mark.slow
def test_a_scene_without_actuators_is_at_rest():
    eq = vsr.solve(vsr.Scene(ARM, []), [])
    assert bool(eq.converged)
    np.testing.assert_allclose(eq.position(0.5), [0.5, 0.0, 0.0], atol=1e-15)
    assert eq.q.shape == eq.lengths.shape == (0,)


def test_repr_tells_the_outcome():
    assert "converged in 2 steps, tip=(" in repr(vsr.solve(SCENE, [1.0, 0.0, 0.0]))
    assert "collapsed" in repr(vsr.solve(SCENE, [1e4, 0.0, 0.0]))
