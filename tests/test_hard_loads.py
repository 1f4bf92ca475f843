"""Hard arms under loads: a table with what must come out of each, arms of all sizes, and the
two-section arm with six tendons.

All arms of the table are one structure, in which everything may jump: two radii, two materials, a
thread that ends, and a load of each kind, so that one compiled program a precision solves them all.
Loads are without unit: forces by $EI / L^2$.
"""

import math
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import central_differences, epsilon

import vsr_jax as vsr

MODEL = vsr.StrainDependent(8)
LENGTH = 0.3
AXIAL = 1e6 * math.pi * 0.01**2
BENDING = AXIAL * 0.01**2 / 4


def arm(
    *,
    weight=0.0,
    down=(0.0, 0.0, -1.0),
    dead=(0.0, 0.0, 0.0),
    follower=(0.0, 0.0, 0.0),
    middle=(0.0, 0.0, 0.0),
    jumps=1.0,
):
    """A clamped arm with its weight $\\rho g A L^3 / EI$, forces at its tip and a force at 0.25 m;
    radius and modulus jump by a factor."""
    force = BENDING / LENGTH**2
    gravity = weight * force / LENGTH / (1000 * math.pi * 0.01**2)
    section = vsr.Circular(vsr.Piecewise((0.1,), (0.01, 0.01 * jumps)))
    rod = vsr.Rod(
        LENGTH,
        section,
        vsr.Material(vsr.Piecewise((0.15,), (1e6, 1e6 * jumps)), poisson=0.45, density=1000.0),
    )
    loads = [
        vsr.Gravity(tuple(gravity * x for x in down)),
        vsr.PointWrench(0.25, force=tuple(force * x for x in middle)),
        vsr.TipWrench(force=tuple(force * x for x in dead)),
        vsr.TipWrench(force=tuple(force * x for x in follower), frame="body"),
    ]
    return vsr.Scene(rod, [vsr.Thread(vsr.Parallel(0.0, 0.005), end=0.2)], loads)


class Case(NamedTuple):
    """A hard arm: its tension [N], the status that must come out, the tip [1/L] where it is known,
    and the error of eight steps."""

    scene: vsr.Scene
    tension: float = 0.0
    tip: tuple[float, float, float] | None = None
    status: vsr.Status = vsr.Status.CONVERGED
    coarse: float = 1e-11


SHORT = BENDING / LENGTH**2 / AXIAL
"""Strain by a force of $EI / L^2$ along the axis."""
UP = (-1.0, 0.0, 0.0)
UNSTABLE, COLLAPSED, NOT_FINITE = vsr.Status.UNSTABLE, vsr.Status.COLLAPSED, vsr.Status.NOT_FINITE

TABLE = {
    "nothing": Case(arm(), 0.0, (1.0, 0.0, 0.0)),
    "jumps in everything": Case(
        arm(
            weight=9.0,
            dead=(0.0, 1.0, 0.0),
            follower=(0.0, 0.0, 1.0),
            middle=(0.0, -2.0, 0.0),
            jumps=0.7,
        ),
        2.0,
        coarse=3e-5,
    ),
    "hangs down from its clamp": Case(arm(weight=100.0), coarse=2e-4),
    "falls over and hangs through itself": Case(arm(weight=100.0, down=UP), 0.1, coarse=1e-3),
    "column below its weight's limit": Case(
        arm(weight=7.0, down=UP), 0.0, (1 - 3.5 * SHORT, 0.0, 0.0)
    ),
    "column beyond its weight's limit": Case(arm(weight=8.5, down=UP), status=UNSTABLE),
    "two radii and moduli beyond their weight's limit": Case(
        arm(weight=30.0, down=UP, jumps=0.5), status=UNSTABLE
    ),
    "strut below Euler's load": Case(arm(dead=(-2.3, 0.0, 0.0)), 0.0, (1 - 2.3 * SHORT, 0.0, 0.0)),
    "strut beyond Euler's load": Case(arm(dead=(-2.7, 0.0, 0.0)), status=UNSTABLE),
    "strut beyond Euler's load, nudged": Case(arm(dead=(-2.7, 0.0, 0.0)), 0.05, coarse=1e-6),
    "strut at eight times Euler's load, nudged": Case(
        arm(dead=(-20.0, 0.0, 0.0)), 0.05, coarse=1e-4
    ),
    "strut at eight times Euler's load, nudged from the side": Case(
        arm(dead=(-20.0, 1e-3, 0.0)), 0.05, coarse=1e-4
    ),
    "falls over sideways": Case(arm(weight=100.0, down=(-1.0, 1e-4, 0.0)), 0.1, coarse=1e-3),
    "follower beyond its first critical value": Case(
        arm(follower=(-25.0, 0.0, 0.0)), 0.0, (1 - 25 * SHORT, 0.0, 0.0)
    ),
    "follower from the side": Case(arm(follower=(0.0, 0.0, 20.0)), coarse=1e-4),
    "tension of 1e-300": Case(arm(weight=9.0), 1e-300, coarse=1e-5),
    "tension past collapse": Case(
        arm(weight=9.0), 1.1 / (1 / AXIAL + 0.005**2 / BENDING), status=COLLAPSED
    ),
    "tension of 1e300": Case(arm(weight=9.0), 1e300, status=COLLAPSED),
    "not a number": Case(arm(weight=9.0), math.nan, status=NOT_FINITE),
}


def solved(scene, tension, v):
    """The equilibrium at a change v of tension and weight, and a number made from its tip [1/L]."""
    unit = jnp.where(jnp.abs(tension) > 1e-200, 1e-4 * jnp.abs(tension), 1e-4)
    gravity = scene.loads[0].acceleration
    changed = eqx.tree_at(lambda scene: scene.loads[0].acceleration, scene, gravity + 1e-3 * v[1])
    eq = vsr.solve(changed, -(tension + unit * v[0])[None], model=MODEL)
    tip = eq.tip[:3, 3] / scene.rod.length
    return eq, tip, tip @ jnp.array([0.3, 0.5, 0.8], tip.dtype)


@jax.jit
def answer(scene, tension, v):
    """The number, and tip [1/L], status and margin."""
    eq, tip, number = solved(scene, tension, v)
    return number, (tip, eq.status, eq.stability)


def number(scene, tension, v):
    return solved(scene, tension, v)[2]


def value(scene, tension, v):
    return answer(scene, tension, v)[0]


gradient = jax.jit(jax.grad(number, argnums=2))
hessian = jax.jit(jax.hessian(number, argnums=2))


def at(function, case, dtype, change=(0.0, 0.0)):
    """What a function of scene, tension and change gives for a case."""
    with np.errstate(over="ignore"):
        tension = np.array(case.tension).astype(dtype)
    return jax.tree.map(
        np.asarray,
        function(case.scene.astype(dtype), jnp.asarray(tension), jnp.array(change, dtype)),
    )


def differences(function, case):
    """Derivative of a function by both changes, by central differences of fourth order."""
    return central_differences(lambda change: at(function, case, "float64", change), 2)


CONVERGED = [name for name, case in TABLE.items() if case.status == vsr.Status.CONVERGED]


PRECISIONS = pytest.mark.parametrize(
    "dtype", ["float64", pytest.param("float32", marks=pytest.mark.slow)]
)


@pytest.mark.slow
@PRECISIONS
@pytest.mark.parametrize("name", TABLE)
def test_status_and_shape_are_what_they_must_be(name, dtype):
    case = TABLE[name]
    _, (tip, status, margin) = at(answer, case, dtype)
    assert status == (NOT_FINITE if dtype == "float32" and case.tension > 1e38 else case.status)
    if status != vsr.Status.CONVERGED:
        assert np.all(np.isnan([*tip, margin]))
        return
    assert margin > 0 or "follower" in name or "everything" in name
    near = max(1e-4 if dtype == "float32" else 1e-11, rounding(margin, dtype))
    if case.tip is not None:
        np.testing.assert_allclose(tip, case.tip, atol=near)
    np.testing.assert_allclose(tip, at(answer, case, "float64")[1][0], atol=near)


@pytest.mark.slow
@pytest.mark.parametrize("name", [name for name in CONVERGED if TABLE[name].coarse > 1e-11])
def test_twice_the_steps_give_the_same_shape(name):
    case = TABLE[name]
    np.testing.assert_allclose(
        at(answer, case, "float64")[1][0], at(finer, case, "float64"), atol=case.coarse
    )


@jax.jit
def finer(scene, tension, _):
    return vsr.solve(scene, -tension[None], model=MODEL.finer()).tip[:3, 3] / scene.rod.length


def rounding(margin, dtype):
    """Error [L] of the shape in its softest motion: a balance to rounding, 64 epsilon, over the
    margin."""
    return 64 * epsilon(dtype) / max(margin, 1e-4) * (margin > 0)


@pytest.mark.slow
@pytest.mark.parametrize("name", CONVERGED)
def test_gradients_are_those_of_differences(name):
    case, found = TABLE[name], at(gradient, TABLE[name], "float64")
    np.testing.assert_allclose(
        found, differences(value, case), atol=3e-6 * np.max(np.abs(found)) + 1e-13
    )


@pytest.mark.slow  # compiling takes minutes
@pytest.mark.parametrize("name", CONVERGED)
def test_derivatives_in_both_precisions_are_those_of_differences(name, dtype):
    case = TABLE[name]
    found, bend = at(gradient, case, dtype), at(hessian, case, dtype)
    margin = at(answer, case, dtype)[1][2]
    near = max(3e-5 if dtype == "float64" else 3e-3, rounding(margin, dtype))
    slope, curve = differences(value, case), differences(gradient, case)
    largest = np.max(np.abs(slope))
    np.testing.assert_allclose(found, slope, atol=near * largest)
    np.testing.assert_allclose(
        bend, curve, atol=near * np.max(np.abs(curve)) + 100 * epsilon(dtype) * largest
    )


def similar_arm(length, young):
    """An arm that hangs from the horizontal, whose numbers without unit do not depend on its size:
    weight $\\rho g A L^3 / EI = 9$."""
    radius = length / 30
    density = 9 * young * radius**2 / (4 * 9.81 * length**3)
    rod = vsr.Rod(length, vsr.Circular(radius), vsr.Material(young, poisson=0.45, density=density))
    return vsr.Scene(
        rod, [vsr.Tendon(vsr.Parallel(0.7 * radius, 0.0))], [vsr.Gravity()]
    ), 0.01 * young * math.pi * radius**2


@jax.jit
def shape_of(scene, inputs):
    eq = vsr.solve(scene, inputs, model=MODEL)
    return eq.tip[:3, 3] / scene.rod.length, eq.stability, eq.status


@pytest.mark.slow
@PRECISIONS
@pytest.mark.parametrize("young", [1e3, 1e6, 2e11])
@pytest.mark.parametrize("length", [1e-3, 0.3, 10.0])
def test_arms_of_all_sizes_and_stiffnesses_behave_alike(length, young, dtype):
    scene, tension = similar_arm(length, young)
    tip, margin, status = shape_of(scene.astype(dtype), jnp.array([tension], dtype))
    like, like_tension = similar_arm(1.0, 1.0)
    expected, expected_margin, _ = shape_of(like.astype("float64"), jnp.array([like_tension]))
    assert status == vsr.Status.CONVERGED
    close = 1e-10 if dtype == "float64" else 1e-4
    np.testing.assert_allclose(tip, expected, atol=close)
    np.testing.assert_allclose(margin, expected_margin, atol=100 * close)


def six_tendon_arm(loads=()):
    """Two sections of 0.2 m; tendons at 10 mm, at 90, -30 and 210 degrees, three to the middle and
    three to the end."""
    rod = vsr.Rod(
        0.4,
        vsr.Circular(0.0007),
        vsr.Material(54e9, poisson=0.3),
        discs=vsr.Discs(10, radius=0.0101),
    )
    places = [
        (0.01 * math.cos(angle), 0.01 * math.sin(angle))
        for angle in (math.pi / 2, -math.pi / 6, 7 * math.pi / 6)
    ]
    return vsr.Scene(
        rod,
        [vsr.Tendon(vsr.Parallel(*place), end=end) for end in (0.2, None) for place in places],
        loads,
    )


@pytest.fixture(scope="module")
def draws():
    random = np.random.default_rng(0)
    sizes = [
        (0, 5, 6),
        (-0.1, 0.1, 3),
        (-5e-3, 5e-3, 3),
    ]  # tensions [N], tip forces [N] and moments [N m]
    return [jnp.asarray(random.uniform(low, high, (200, count))) for low, high, count in sizes]


def test_six_tendons_pulled_at_random_converge(draws):
    scene = six_tendon_arm()
    status, margin = jax.jit(
        jax.vmap(lambda t: (lambda eq: (eq.status, eq.stability))(vsr.solve(scene, t, model=MODEL)))
    )(draws[0])
    assert np.all(status == vsr.Status.CONVERGED)
    assert np.all(margin > 1 - 1e-9)


@pytest.mark.slow
def test_six_tendons_with_random_tip_wrenches_converge(draws):
    def solved(tensions, force, moment):
        return vsr.solve(
            six_tendon_arm([vsr.TipWrench(force=force, moment=moment)]), tensions, model=MODEL
        )

    eqs = jax.jit(jax.vmap(solved))(*draws)
    assert np.all(eqs.converged)
    margin = np.asarray(jax.jit(jax.vmap(lambda eq: eq.stability))(eqs))
    assert np.all(np.isfinite(margin))
    assert np.all(margin > 0)


RATIOS, SIZES = (10.0, 40.0, 80.0, 200.0, 400.0, 1000.0, 3000.0), (1.0, 3.0, 10.0, 30.0)
"""Length by radius, and force by $EI / L^2$."""


def tip_loads(directions):
    """Radius [m] and tip force [N] of an arm of 0.4 m and 10 MPa for all ratios, sizes and
    directions."""
    vectors = np.random.default_rng(0).normal(size=(directions, 3))
    vectors /= np.linalg.norm(vectors, axis=1, keepdims=True)
    ratio, size, place = (
        x.reshape(-1) for x in np.meshgrid(RATIOS, SIZES, np.arange(directions), indexing="ij")
    )
    radius = 0.4 / ratio
    return radius, vectors[place] * (size * 1e7 * math.pi * radius**4 / 4 / 0.4**2)[:, None]


def under_tip_loads(dtype, steps, directions):
    """Status, tip [1/L] and evaluations of every arm."""

    def one(radius, force):
        rod = vsr.Rod(0.4, vsr.Circular(radius), vsr.Material(1e7, poisson=0.4))
        eq = vsr.solve(
            vsr.Scene(rod, [], [vsr.TipWrench(force)]),
            jnp.zeros(0, dtype),
            model=vsr.StrainDependent(steps),
        )
        return eq.status, eq.tip[:3, 3] / 0.4, eq.steps

    return [
        np.asarray(x)
        for x in jax.jit(jax.vmap(one))(*(jnp.asarray(x, dtype) for x in tip_loads(directions)))
    ]


def test_arms_of_every_slenderness_bear_a_tip_force():
    """Thin arms were refused while their solve still converged. How many steps it takes does not
    depend on the slenderness."""
    status, _, taken = under_tip_loads("float64", 16, 5)
    assert np.all(status == vsr.Status.CONVERGED)
    mean = np.mean(taken.reshape(len(RATIOS), -1), axis=1)
    assert np.ptp(mean) < 0.5


@pytest.mark.slow
@pytest.mark.parametrize("steps", [16, 32])
def test_arms_of_every_slenderness_bear_a_tip_force_in_a_hundred_directions(steps):
    """In single precision too, where the tips of slender arms were wrong by up to a hundredth of
    the length."""
    status, tips, _ = under_tip_loads("float64", steps, 100)
    assert np.all(status == vsr.Status.CONVERGED)
    rough_status, rough_tips, _ = under_tip_loads("float32", steps, 100)
    converged = rough_status == vsr.Status.CONVERGED
    assert np.mean(~converged) <= 0.01
    assert np.max(np.linalg.norm(rough_tips - tips, axis=1)[converged]) < 5e-6


@pytest.mark.slow
def test_a_catheter_bears_a_tip_force_in_any_direction():
    """Two of a hundred were refused: four tendons in a wire of 1 mm and 60 GPa, 0.5 N at its
    tip."""
    random = np.random.default_rng(1)
    forces = random.normal(size=(200, 3))
    forces *= 0.5 / np.linalg.norm(forces, axis=1, keepdims=True)
    rod = vsr.Rod(0.2, vsr.Circular(diameter=0.001), vsr.Material(60e9, poisson=0.3))
    places = [
        (0.0004 * math.cos(angle), 0.0004 * math.sin(angle)) for angle in np.arange(4) * math.pi / 2
    ]
    threads = [vsr.Tendon(vsr.Parallel(*place)) for place in places]

    def status(tensions, force):
        return vsr.solve(
            vsr.Scene(rod, threads, [vsr.TipWrench(force)]), tensions, model=vsr.StrainDependent(16)
        ).status

    found = jax.jit(jax.vmap(status))(
        jnp.asarray(random.uniform(0, 3, (200, 4))), jnp.asarray(forces)
    )
    assert np.all(found == vsr.Status.CONVERGED)


@pytest.mark.slow
def test_a_tapered_arm_of_silicone_upright_under_its_weight_is_unstable():
    """At exactly zero pressure nothing tips it over; the straight equilibrium is found, and is none
    that stays."""

    def status(pressure):
        rod = vsr.Rod(
            0.3,
            vsr.Circular(vsr.Taper(0.010, 0.004)),
            vsr.Material(1e5, poisson=0.45, density=1080.0),
        )
        scene = vsr.Scene(
            rod,
            [vsr.Chamber(vsr.Parallel(0.0, 0.003), area=1e-5)],
            [vsr.Gravity((-9.81, 0.0, 0.0))],
        )
        return vsr.solve(scene, pressure[None], model=MODEL).status

    found = jax.jit(jax.vmap(status))(jnp.array([0.0, 100.0]))
    assert list(found) == [UNSTABLE, vsr.Status.CONVERGED]


@pytest.mark.slow
@pytest.mark.parametrize(("force", "moment"), [((5.59, 0.48), 5.37), ((1.4, -2.7), 5.7)])
def test_an_arm_in_a_plane_that_is_unstable_across_it_is_found_out(force, moment):
    """A dead moment bends the arm in the plane of all loads. Its tangent has a pair of eigenvalues
    with the real part -0.69 or -0.23, of motions across that plane, which no step contains and the
    pivots miss."""
    rod = vsr.Rod(LENGTH, vsr.Circular(0.01), vsr.Material(1e6, poisson=0.45))
    unit = BENDING / LENGTH**2
    load = vsr.TipWrench(
        force=(force[0] * unit, force[1] * unit, 0.0), moment=(0.0, 0.0, moment * unit * LENGTH)
    )
    eq = vsr.solve(vsr.Scene(rod, loads=[load]), jnp.zeros(0), model=vsr.StrainDependent(12))
    assert eq.status == vsr.Status.UNSTABLE
