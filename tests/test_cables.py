"""Tendons driven by their length, tendons that end on the way, friction and free strains."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree

import vsr_jax as vsr
from vsr_jax.arm.routing import Routing
from vsr_jax.mechanics import arm_tangent

ARM = vsr.Rod(0.3, vsr.Circular(0.01), vsr.Material(1e6, poisson=0.45, density=1000.0))
STEPS = vsr.StrainDependent(8)
TENSIONS = jnp.array([3.0, 1.5])


def scene(loads=(), **options):
    paths = vsr.Parallel(0.007, 0.0), vsr.Helix(0.007, pitch=0.4, phase=2.0)
    return vsr.Scene(ARM, [vsr.Tendon(path, **options) for path in paths], loads)


@pytest.fixture(scope="module")
def pulled():
    """A tension-driven solution and the changes of length it makes."""
    given = scene()
    eq = vsr.solve(given, TENSIONS, model=STEPS)
    return eq, eq.lengths - vsr.solve(given, jnp.zeros(2), model=STEPS).lengths


def test_lengths_give_back_the_tensions(pulled):
    eq, changes = pulled
    driven = vsr.solve(scene(control="length"), changes, model=STEPS, throw=True)
    np.testing.assert_allclose(-driven.forces, TENSIONS, rtol=1e-9)
    np.testing.assert_allclose(driven.tip, eq.tip, atol=1e-11)
    np.testing.assert_allclose(driven.slack, 0.0)


@pytest.mark.slow
def test_prescribed_lengths_are_slack_or_taut(pulled):
    """On both sides of the switch: the second cable is let out to 1 um short of, and 1 um past,
    where it goes slack."""
    driven = scene(control="length")
    model = vsr.Prescribed(vsr.Basis.uniform(vsr.Legendre(3)), steps=8)
    alone = vsr.solve(scene(), jnp.array([3.0, 0.0]), model=model)
    changes = alone.lengths - vsr.solve(scene(), jnp.zeros(2), model=model).lengths
    taut = vsr.solve(driven, changes - jnp.array([0.0, 1e-6]), model=model, throw=True)
    slack = vsr.solve(driven, changes + jnp.array([0.0, 1e-6]), model=model, throw=True)
    assert -taut.forces[1] > 0
    assert taut.slack[1] == 0
    assert slack.forces[1] == 0
    np.testing.assert_allclose(slack.slack[1], 1e-6, rtol=1e-6)
    np.testing.assert_allclose(-slack.forces[0], 3.0, rtol=1e-9)


def test_strain_dependent_slack_is_the_tendon_left_out(pulled):
    _, changes = pulled
    loose = vsr.solve(scene(control="length"), changes.at[1].set(0.05), model=STEPS, throw=True)
    assert loose.forces[1] == 0
    assert loose.slack[1] > 0.04
    by_tension = vsr.solve(scene(), -loose.forces, model=STEPS)
    np.testing.assert_allclose(by_tension.tip, loose.tip, atol=1e-11)


def test_elastic_cable_gives_way(pulled):
    """The cable's stretch makes up for the stretch that the tension needs: T = k (l / c - 1) at the
    solution."""
    _, changes = pulled
    eq = vsr.solve(scene(control="length", stiffness=500.0), changes, model=STEPS, throw=True)
    rest = vsr.solve(scene(), jnp.zeros(2), model=STEPS).lengths
    np.testing.assert_allclose(-eq.forces, 500 * (eq.lengths / (rest + changes) - 1), rtol=1e-8)
    assert np.all(-eq.forces < TENSIONS)


def test_friction_along_an_arc_is_the_closed_form():
    """One tendon at distance d bends by k = T d / EI, so T' = -mu k T gives T = T_0 / (1 + mu d T_0
    X / EI)."""
    d, mu, tension = 0.007, 0.3, 2.0
    EI = 1e6 * np.pi / 4 * 0.01**4
    X = np.array([0.0, 0.1, 0.21, 0.3])
    for motion, sign in (("pull", 1), ("release", -1)):
        tendon = vsr.Tendon(vsr.Parallel(d, 0.0), friction=mu, motion=motion)
        eq = vsr.solve(
            vsr.Scene(ARM, [tendon]), [tension], model=vsr.StrainDependent(16), throw=True
        )
        want = tension / (1 + sign * mu * d * tension * X / EI)
        np.testing.assert_allclose(np.abs(eq.strain(X)[:, 2]) * EI / d, want, rtol=1e-7)


class Corner(Routing):
    """Two straight lines of opposite slope."""

    slope: jax.Array
    place: jax.Array

    def __init__(self, slope, place):
        self.slope, self.place = jnp.asarray(slope), jnp.asarray(place)

    def __call__(self, X):
        return self.slope * (self.place - jnp.abs(X - self.place)), jnp.zeros_like(X)

    @property
    def breakpoints(self):
        return (self.place,)


@pytest.mark.slow
def test_a_corner_of_the_path_holds_tension_back():
    r"""Over a corner of angle $\Delta$ a tendon keeps $e^{-\mu \Delta}$ of its tension, or the
    inverse when it is let go."""
    modulus, angle = 1e13, 2 * np.arctan(0.05)
    rod = vsr.Rod(0.3, vsr.Circular(0.02), vsr.Material(modulus, poisson=0.3))
    for motion, factor in (("pull", np.exp(-0.3 * angle)), ("release", np.exp(0.3 * angle))):
        tendon = vsr.Tendon(Corner(0.05, 0.1), friction=0.3, motion=motion)
        eq = vsr.solve(vsr.Scene(rod, [tendon]), [2.0], model=STEPS, throw=True)
        tension = (
            (1 - np.asarray(eq.strain(jnp.array([0.05, 0.2]))[:, 3]))
            * modulus
            * np.pi
            * 0.02**2
            / np.cos(angle / 2)
        )
        np.testing.assert_allclose(tension, [2.0, 2.0 * factor], rtol=1e-6)


@pytest.mark.slow
def test_friction_of_an_arm_that_is_twisted_and_cannot_untwist():
    r"""Its locked strains turn the path too. The angle of the path is that between its chords in
    space, and the tension at the tip, from the curvature there, is $T_0 e^{-\mu \varphi}$."""
    d, mu, EI = 0.007, 0.3, 1e6 * np.pi / 4 * 0.01**4
    rest = (lambda X: 60 * X * (1 + 3 * X), 0.0, 0.0, 1.0, 0.0, 0.0)
    twisted = vsr.Rod(0.3, vsr.Circular(0.01), ARM.material, rest_strain=rest)
    tendon = vsr.Tendon(vsr.Parallel(d, 0.0), friction=mu)
    bending = vsr.Scene(twisted, [tendon], free_strains=("bending_y", "bending_z"))
    eq = vsr.solve(bending, [2.0], model=vsr.StrainDependent(16), throw=True)

    X = np.linspace(0.0, 0.3, 3001)
    frames = np.asarray(eq.pose(X))
    chords = np.diff(frames[:, :3, 3] + d * frames[:, :3, 1], axis=0)
    sine = np.linalg.norm(np.cross(chords[:-1], chords[1:]), axis=1)
    rate = np.arctan2(sine, np.sum(chords[:-1] * chords[1:], axis=1)) / X[1]
    angle = np.sum(rate) * X[1] + (rate[0] + rate[-1]) * X[1] / 2

    kx, _, kz, stretch, _, _ = np.asarray(eq.strain(0.3))
    along = (stretch - d * kz) / np.hypot(stretch - d * kz, d * kx)
    np.testing.assert_allclose(EI * kz / (d * along), 2.0 * np.exp(-mu * angle), rtol=1e-6)


@pytest.mark.slow
def test_the_kink_where_another_tendon_ends_is_that_of_finer_steps():
    helices = (
        vsr.Tendon(vsr.Helix(0.007, pitch=0.3), friction=0.3),
        vsr.Tendon(vsr.Helix(0.007, pitch=0.15, phase=2.0), end=0.15),
    )
    kinked = vsr.Scene(ARM, helices, [vsr.Gravity()])
    coarse, fine = (
        vsr.solve(kinked, [4.0, 8.0], model=vsr.StrainDependent(steps), throw=True).tip[:3, 3]
        for steps in (16, 64)
    )
    shot = vsr.solve(
        kinked, [4.0, 8.0], model=vsr.Continuum(derivative=vsr.StrainDependent(64)), throw=True
    ).tip[:3, 3]
    np.testing.assert_allclose(coarse, fine, atol=2e-6)
    np.testing.assert_allclose(shot, fine, atol=2e-8)


@pytest.mark.slow
def test_friction_agrees_between_the_models():
    rubbing = scene([vsr.Gravity()], friction=0.2)
    tips = [
        vsr.solve(rubbing, TENSIONS, model=model, throw=True).tip[:3, 3]
        for model in (
            vsr.StrainDependent(24),
            vsr.Prescribed(vsr.Basis.uniform(vsr.Legendre(7)), steps=16),
        )
    ]
    np.testing.assert_allclose(tips[1], tips[0], atol=2e-7)


@pytest.mark.slow
def test_a_thread_that_ends_leaves_the_rest_straight():
    """Beyond its end the arm is straight; before it, it is the arm with a whole thread."""
    ends = vsr.Scene(ARM, [vsr.Tendon(vsr.Parallel(0.007, 0.0), start=0.05, end=0.2)])
    eq = vsr.solve(ends, [2.0], model=STEPS)
    whole = vsr.solve(vsr.Scene(ARM, [vsr.Tendon(vsr.Parallel(0.007, 0.0))]), [2.0], model=STEPS)
    strain = eq.strain(jnp.array([0.02, 0.1, 0.25]))
    np.testing.assert_allclose(strain[1], whole.strain(0.1), atol=1e-13)
    np.testing.assert_allclose(strain[::2], np.tile([0, 0, 0, 1.0, 0, 0], (2, 1)), atol=1e-13)
    bent = whole.strain(0.1)
    np.testing.assert_allclose(eq.lengths, 0.15 * (bent[3] - 0.007 * bent[2]), rtol=1e-12)
    turn = np.arctan2(eq.tip[1, 0], eq.tip[0, 0])
    np.testing.assert_allclose(turn, 0.15 * bent[2], rtol=1e-12)


@pytest.mark.slow
def test_jumps_in_everything_agree_with_the_continuum():
    rod = vsr.Rod(
        0.3,
        vsr.Joined([0.12], [vsr.Circular(0.01), vsr.Rectangular(0.015, 0.018)]),
        vsr.Material(vsr.Piecewise([0.12], [1e6, 6e5]), poisson=0.45),
        rest_strain=(0.0, vsr.Piecewise([0.2], [0.5, -2.0]), 0.0, 1.0, 0.0, 0.0),
    )
    threads = [
        vsr.Thread(vsr.Helix(0.006, pitch=0.3), end=0.23),
        vsr.Thread(vsr.Parallel(0.0, 0.005), start=0.07),
    ]
    jumps = vsr.Scene(rod, threads)
    tips = [
        vsr.solve(jumps, [-2.0, -1.0], model=model, throw=True).tip
        for model in (
            vsr.StrainDependent(40),
            vsr.Continuum(rtol=1e-10, atol=1e-12, derivative=STEPS),
        )
    ]
    np.testing.assert_allclose(tips[1], tips[0], atol=1e-8)


@pytest.mark.slow
def test_locked_strains_keep_their_rest_value():
    loads = [vsr.TipWrench((0.0, 0.05, -0.1))]
    bending = vsr.Scene(ARM, scene().actuators, loads, free_strains=("bending_y", "bending_z"))
    eq = vsr.solve(bending, TENSIONS, model=STEPS, throw=True)
    np.testing.assert_array_equal(eq.strain(0.1)[jnp.array([0, 3, 4, 5])], [0, 1, 0, 0])


EFFECTS = {
    "dead load, length and end": ([vsr.TipWrench((0.0, 0.0, 0.03))], {}),
    "all": (
        [
            vsr.Gravity(),
            vsr.PointWrench(0.15, force=(0.0, 0.05, 0.0), frame="body"),
            vsr.TipWrench((0.0, 0.0, 0.03)),
        ],
        {"friction": 0.2},
    ),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", EFFECTS)
def test_gradients_through_effects(name):
    """Reverse mode = central differences, by every number of the scene and by the inputs."""
    loads, options = EFFECTS[name]
    tendons = [
        vsr.Tendon(vsr.Parallel(0.007, 0.0), control="length", stiffness=2e3),
        vsr.Tendon(vsr.Helix(0.007, pitch=0.4), end=0.2, **options),
    ]
    numbers, rebuild = ravel_pytree((vsr.Scene(ARM, tendons, loads), jnp.array([-0.01, 2.0])))

    def height(x):
        eq = vsr.solve(*rebuild(x), model=STEPS)
        return eq.tip[2, 3] + eq.tip[0, 1] + 0.01 * eq.forces[0]

    both = jax.jit(jax.value_and_grad(height))
    reverse = both(numbers)[1]
    assert np.all(np.isfinite(reverse))
    assert numbers.size > 15
    for i, x in enumerate(np.asarray(numbers)):
        unit, h = jnp.zeros_like(numbers).at[i].set(1.0), 1e-4 * abs(x) or 1e-5
        difference = (both(numbers + h * unit)[0] - both(numbers - h * unit)[0]) / (2 * h)
        np.testing.assert_allclose(
            reverse[i],
            difference,
            rtol=1e-4,
            atol=1e-7 * (1 + abs(reverse[i])),
            err_msg=f"number {i}, value {x}",
        )


def test_reverse_mode_by_the_lengths_alone_is_traced():
    """Only the cables' rows of the tangent system move then."""

    def height(x):
        return vsr.solve(scene([vsr.Gravity()], control="length"), x, model=STEPS).tip[2, 3]

    assert jax.eval_shape(jax.grad(height), jnp.array([-0.01, -0.005])).shape == (2,)


@pytest.mark.slow
def test_forward_mode_is_reverse_mode():
    loads = [vsr.Gravity(), vsr.PointWrench(0.15, force=(0.0, 0.05, 0.0), frame="body")]

    def height(x):
        eq = vsr.solve(scene(loads, control="length", friction=0.2), x, model=STEPS)
        return eq.tip[2, 3] + eq.forces[0]

    at = jnp.array([-0.01, -0.005])
    np.testing.assert_allclose(
        jax.jit(jax.jacfwd(height))(at), jax.jit(jax.jacrev(height))(at), rtol=1e-8
    )


@pytest.mark.slow
def test_reverse_mode_with_friction_takes_few_refinement_steps(monkeypatch):
    """Twenty here, and sixty on a soft arm, where its unknowns did not follow the strain."""
    monkeypatch.setattr(arm_tangent, "_REFINEMENTS", 12)
    model, at = vsr.StrainDependent(5), jnp.array([6.0, 2.0])  # a program of its own

    def height(x):
        return vsr.solve(scene([vsr.Gravity()], friction=0.6), x, model=model).tip[2, 3]

    value, slopes = jax.jit(jax.value_and_grad(height))(at)
    assert np.isfinite(value)
    expected = [(height(at + h) - height(at - h)) / 2e-4 for h in 1e-4 * jnp.eye(2)]
    np.testing.assert_allclose(slopes, expected, rtol=1e-6)


@pytest.mark.slow
def test_vmap_over_lengths(pulled):
    _, changes = pulled
    driven, batch = (
        scene(control="length"),
        jnp.stack([changes, changes.at[1].set(0.05), 0.5 * changes]),
    )
    tips = jax.jit(jax.vmap(lambda change: vsr.solve(driven, change, model=STEPS).tip))(batch)
    np.testing.assert_allclose(tips[0], vsr.solve(driven, changes, model=STEPS).tip, atol=1e-10)


def test_a_scene_names_its_effects():
    full = vsr.Scene(
        ARM,
        [vsr.Tendon(vsr.Parallel(0.0, 0.005), control="length", friction=0.1)],
        [vsr.Gravity(), vsr.TipWrench(frame="body")],
    )
    assert full.effects == (
        "tendons",
        "gravity",
        "follower tip wrench",
        "length control",
        "friction",
    )
    assert scene().effects == ("tendons",)
    assert eqx.tree_equal(vsr.Scene(ARM, []).effects, ())


def test_motors_wind_cables_on_spools():
    """By angle in place of length, from a slack of 1 mm; and the derivative by the radius."""
    rod = vsr.Rod(0.2, vsr.Circular(0.005), vsr.Material(1e6, poisson=0.45))
    path = vsr.Parallel(0.004, 0.0)

    def tip(spool, angle):
        tendon = vsr.Tendon(path, control="length", spool=spool, offset=1e-3)
        return vsr.solve(vsr.Scene(rod, [tendon]), jnp.stack([angle])).tip[:3, 3]

    by_length = vsr.Scene(rod, [vsr.Tendon(path, control="length")])
    expected = vsr.solve(by_length, [1e-3 - 0.008 * 0.5], throw=True).tip[:3, 3]
    np.testing.assert_allclose(tip(jnp.array(0.008), jnp.array(0.5)), expected, atol=1e-12)
    slopes = jax.jacfwd(tip, (0, 1))(jnp.array(0.008), jnp.array(0.5))
    np.testing.assert_allclose(slopes[0] / 0.5, slopes[1] / 0.008, atol=1e-9)
    assert vsr.Tendon(path, control="length", spool=0.008).unit == "rad"
    wound = vsr.Scene(rod, [vsr.Tendon(path, control="length", spool=0.008)])
    with pytest.raises(
        ValueError, match=r"inputs\[0\]: got 30 rad, need a change of length > -0.2"
    ):
        vsr.solve(wound, [30.0])
    with pytest.raises(ValueError, match=r"Tendon.spool: got 0.01 with control='tension'"):
        vsr.Tendon(path, spool=0.01)
