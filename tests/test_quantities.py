"""The table of quantities, the energy, and everything along an arm from one program."""

import copy
import pickle

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import central_differences

import vsr_jax as vsr
from vsr_jax.analysis.arms import Arms
from vsr_jax.solution import QUANTITIES, quantity
from vsr_jax.solution.quantities import along_arm

LENGTH = 0.3
MODEL = vsr.StrainDependent(16)
INPUTS = jnp.array([2.0, -0.004, 1.0])


def arm(loads=(), weight=9.81):
    """Tendons by tension, by the length of an elastic cable, and a thread, under dead loads."""
    rod = vsr.Rod(
        LENGTH,
        vsr.Circular(0.01),
        vsr.Material(1e6, poisson=0.45, density=1000.0),
        rest_strain=(0.2, 0.5, -0.4, 1.0, 0.0, 0.0),
        base=vsr.se3.exp(jnp.array([0.1, 0.2, 0.3, 0.02, -0.01, 0.1])),
    )
    threads = [
        vsr.Tendon(vsr.Helix(0.007, pitch=0.4)),
        vsr.Tendon(vsr.Parallel(0.007, 0.0), control="length", stiffness=2e3),
        vsr.Thread(vsr.Parallel(0.0, 0.006), end=0.2),
    ]
    return vsr.Scene(rod, threads, [vsr.Gravity((0.0, 0.0, -weight)), *loads])


X = jnp.linspace(0, LENGTH, 2001)
VALUES = ("tip", "lengths", "forces", "slack")


@jax.jit
def loaded(numbers):
    """Energy, status and summary by changes of the inputs, the weight and the tip force."""
    inputs, weight = INPUTS + 1e-3 * numbers[:3], 9.81 + 0.1 * numbers[3]
    force = jnp.array([0.02, 0.1, -0.05]) + 1e-3 * numbers[4:]
    eq = vsr.solve(arm([vsr.TipWrench(force=force)], weight), inputs, model=MODEL)
    return eq.energy.total, (eq.status, eq.summary(X, VALUES))


@pytest.mark.slow
def test_the_energy_is_stationary():
    r"""By the envelope theorem $d\Pi / d\tau_i = -l_i$, $d\Pi / dT = l$, $d\Pi / dF = -r(L)$; by
    the weight the moment of the arm's mass; by a given length the tension, less what is stored in
    the cable that is added. The error is that of the steps."""
    slopes = central_differences(lambda x: loaded(jnp.asarray(x))[0], 7)
    status, found = loaded(jnp.zeros(7))[1]
    assert status == vsr.Status.CONVERGED
    lengths, tension = found.lengths, -found.forces[1]
    assert float(found.slack[1]) == 0.0
    assert tension > 0.1
    # of a stretched cable of free length s the energy T^2 s / (2 k) has its own derivative by s
    wanted = [lengths[0], -tension - tension**2 / (2 * 2e3), -lengths[2]]
    np.testing.assert_allclose(slopes[:3] / 1e-3, wanted, rtol=2e-6)
    np.testing.assert_allclose(slopes[4:] / 1e-3, -found.tip[:3, 3], atol=3e-7)
    weight = 1000.0 * np.pi * 0.01**2 * 9.81
    moment = weight / 9.81 * np.trapezoid(found.position[:, 2], X)
    np.testing.assert_allclose(slopes[3] / 0.1, moment, rtol=1e-4)
    carried = found.pose[0, :3, :3] @ found.reaction[0, 3:]
    np.testing.assert_allclose(carried, [0.02, 0.1, -0.05 - weight * LENGTH], rtol=1e-9)


@pytest.fixture(scope="module")
def solved():
    """An arm without loads, whose programs are small."""
    scene = arm(weight=0.0)
    threads = [scene.actuators[0], scene.actuators[2]]
    return vsr.solve(vsr.Scene(scene.rod, threads), INPUTS[jnp.array([0, 2])], model=MODEL)


@pytest.mark.slow
def test_a_summary_is_what_the_attributes_are(solved):
    eq, X = solved, jnp.array([0.0, 0.1, 0.2, 0.3])
    found = eq.summary(X, ("tip", "lengths", "stability"))
    for name in ("pose", "position", "strain", "curvature", "reaction"):
        np.testing.assert_allclose(getattr(found, name), getattr(eq, name)(X), atol=1e-13)
    for name in ("tip", "lengths", "stability"):
        np.testing.assert_allclose(found.values[name], getattr(eq, name), rtol=1e-10)
    np.testing.assert_allclose(found.threads[0], eq.thread(0, X), atol=1e-13)
    assert np.isnan(found.threads[1][3]).all()  # this thread ends at 0.2 m
    around = np.linalg.norm(found.wall - found.position[:, None], axis=-1)
    np.testing.assert_allclose(around, 0.01, rtol=1e-12)
    np.testing.assert_allclose(found.curvature, np.hypot(*np.asarray(found.strain)[:, 1:3].T))


def test_a_summary_can_be_copied_and_pickled(solved):
    found = jax.tree.map(np.asarray, solved.summary(3, ("tip",)))
    for again in (copy.deepcopy(found), pickle.loads(pickle.dumps(found))):
        np.testing.assert_array_equal(again.strain, found.strain)
        np.testing.assert_array_equal(again.tip, found.tip)
    with pytest.raises(AttributeError, match="it has curvature, pose, position"):
        found.lengths  # noqa: B018


def test_values_are_those_of_a_summary_without_its_program(solved, monkeypatch):
    expected = solved.summary(2, ("tip", "condition")).values
    with pytest.raises(ValueError, match="values: got 'strain', need one of 'tip'"):
        solved.summary(2, ("strain",))
    monkeypatch.setattr(type(solved), "summary", None)
    for name, value in expected.items():
        np.testing.assert_allclose(solved.value(name), value, rtol=1e-10, atol=1e-15)
    assert "stability margin" in str(solved)


def test_every_entry_says_what_it_is():
    for name, entry in QUANTITIES.items():
        assert entry.name == name
        assert entry.unit
        assert len(entry.description) > 10


@pytest.mark.slow
def test_a_new_quantity_is_one_entry(solved):
    eq = solved
    try:

        @quantity("m")
        def height(eq):
            """Height of the tip above the base [m]."""
            return eq.tip[2, 3] - eq.position(0.0)[2]

        assert eq.value("height") == eq.tip[2, 3] - eq.position(0.0)[2]
        assert eq.summary(jnp.zeros(1), ["height"]).height == eq.value("height")
        swept = vsr.sweep(eq.scene, eq.inputs[None], outputs="height", model=MODEL, progress=False)
        np.testing.assert_allclose(swept["height"], [eq.value("height")], rtol=1e-12)
        with pytest.raises(ValueError, match="quantity: got 'tip', need a name that the table"):
            quantity("1")(type("tip", (), {"__call__": lambda eq: 0, "__name__": "tip"})())
    finally:
        QUANTITIES.pop("height", None)
    with pytest.raises(ValueError, match="name: got 'height', need one of tip, pose"):
        eq.value("height")


def test_a_quantity_of_another_names_one_along_the_arm():
    for name in ("strian", "tip"):
        with pytest.raises(ValueError, match=f"of: got '{name}', need one of 'pose', 'position'"):
            along_arm("1", of=name)(lambda eq, value: value)
    assert "<lambda>" not in QUANTITIES


@pytest.mark.slow
def test_a_failed_solve_has_no_energy(solved):
    eq = vsr.solve(solved.scene, [1e300, 1.0], model=MODEL)
    assert np.isnan(eq.energy).all()
    assert np.isnan(eq.summary(4).curvature).all()


def test_an_equilibrium_prints_what_a_person_asks_first(solved):
    text = str(solved)
    for part in ("converged", "float64", "tip", "estimated error", "stability margin"):
        assert part in text


def test_an_equilibrium_says_whether_it_is_loosened(solved):
    loosened = vsr.Equilibrium(
        solved.scene, solved.inputs, solved.model, solved.outcome._replace(loosened=jnp.array(True))
    )
    assert not solved.loosened
    assert str(loosened).splitlines() == [
        *str(solved).splitlines(),
        "  loosened         constraints, on the way to the solution",
    ]
    assert loosened.heading[2:] == ("  loosened   constraints, on the way to the solution",)
    assert len(solved.heading) == 2
    assert Arms.of(loosened).each(lambda eq: eq.loosened).all()
