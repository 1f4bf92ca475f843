"""Derivatives of the tip with respect to numbers, inputs and wrenches: against finite differences
and exact solutions of beams."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import vsr_jax as vsr
from vsr_jax.analysis.derivatives import ellipsoid
from vsr_jax.arm.scene_numbers import replaced
from vsr_jax.models.base import SteppedModel

MODEL, FINER = vsr.StrainDependent(8), vsr.StrainDependent(12)
LENGTH = 0.3


@pytest.fixture(scope="module")
def eq():
    arm = vsr.Rod(LENGTH, vsr.Circular(vsr.Taper(0.012, 0.010)), vsr.Material(8e5, poisson=0.45))
    threads = [
        vsr.Tendon(vsr.Helix(0.006, 1.5)),
        vsr.Tendon(vsr.Parallel(0.0, -0.006)),
        vsr.Tendon(vsr.Polynomial([0.001, 0.01], [0.005])),
    ]
    return vsr.solve(vsr.Scene(arm, threads), jnp.array([4.0, 2.0, 1.0]), model=MODEL)


@pytest.fixture(scope="module")
def table(eq):
    return vsr.sensitivity(eq)


@pytest.fixture(scope="module")
def tip_of():
    return jax.jit(lambda scene, inputs: vsr.solve(scene, inputs, model=FINER).tip)


def motion(ahead, behind, step):
    """Rotation and displacement per unit, by central differences of poses."""
    turn = (
        (ahead[:3, :3] - behind[:3, :3]) / (2 * step) @ (0.5 * (ahead[:3, :3] + behind[:3, :3])).T
    )
    turn = 0.5 * np.array(
        [turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]]
    )
    return turn, (ahead[:3, 3] - behind[:3, 3]) / (2 * step)


@pytest.mark.slow
@pytest.mark.parametrize(
    "name",
    [
        "rod.material.young",
        "rod.section.radius.tip",
        "actuators[0].routing.angle",
        "actuators[1].routing.z",
    ],
)
def test_rows_against_differences_of_finer_solves(eq, table, tip_of, name):
    value = float(vsr.parameters(eq.scene)[name].value)
    step = 1e-5 * abs(value)
    ahead, behind = (
        np.asarray(tip_of(replaced(eq.scene, {name: jnp.array(value + d)}), eq.inputs))
        for d in (step, -step)
    )
    turn, place = motion(ahead, behind, step)
    row = table[name]
    np.testing.assert_allclose(row.place, place, atol=2e-6 * np.linalg.norm(place))
    np.testing.assert_allclose(row.turn, turn, atol=2e-6 * np.linalg.norm(turn))


def test_rows_of_the_inputs_are_the_jacobian(eq, table, tip_of):
    J = vsr.tip_jacobian(eq)
    for i in range(3):
        step = np.eye(3)[i] * 1e-4
        ahead, behind = (np.asarray(tip_of(eq.scene, eq.inputs + sign * step)) for sign in (1, -1))
        np.testing.assert_allclose(
            J[:, i], np.concatenate(motion(ahead, behind, 1e-4)), atol=1e-6 * np.abs(J).max()
        )
        np.testing.assert_allclose(table[f"inputs[{i}]"].place, J[3:, i], atol=1e-12)
    assert table["inputs[0]"].unit == "N"


def test_the_printed_table_has_the_largest_effects_first(table):
    *rows, legend, folded = str(table).splitlines()[1:]
    names = [row.split()[0] for row in rows]
    effects = dict(zip(table.names, np.asarray(table.per_percent), strict=True))
    assert names == sorted(effects, key=effects.__getitem__)[::-1][:10]
    assert "inputs[0]" in names
    assert float(rows[0].split()[-1]) == pytest.approx(1e3 * max(effects.values()), rel=1e-2)
    assert legend == "dx, dy, dz: displacement of the tip [m] per unit of the number"
    zeros = np.count_nonzero(table.values == 0)
    counts = [int(word) for word in folded.split() if word.isdecimal()]
    assert counts[0] + counts[-1] == len(table.names) - 10
    assert counts[-1] == zeros
    with pytest.raises(KeyError, match="known are"):
        table["rod.lenght"]


def test_a_table_of_all_rows_ends_with_numbers_that_are_zero():
    names = ("small", "zero", "large")
    place = jnp.array([[0.1, 0.0, 0.0], [0.0, 5.0, 0.0], [0.0, 0.0, -2.0]])
    table = vsr.Sensitivity(names, ("m", "", "m"), jnp.array([1.0, 0.0, -3.0]), place, place)
    rows = table.text(all=True).splitlines()[1:-1]
    assert [row.split() for row in rows] == [
        ["large", "-3", "m", "0", "0", "-2", "60"],
        ["small", "1", "m", "0.1", "0", "0", "1"],
        ["zero", "0", "?", "0", "5", "0", "-"],
    ]
    assert str(table) == table.text(all=True)


@pytest.mark.slow
def test_compliance_of_a_straight_beam_is_exact():
    """Timoshenko cantilever: L^3 / 3EI + L / kGA in bending, L / EA in tension, L / GJ in torsion,
    L^2 / 2EI coupling."""
    arm = vsr.Rod(LENGTH, vsr.Circular(0.01), vsr.Material(8e5, shear=3e5))
    scene = vsr.Scene(arm, [vsr.Thread(vsr.Parallel(0.0, 0.0))])
    C = np.asarray(vsr.compliance(vsr.solve(scene, jnp.zeros(1), model=MODEL)))
    S = [float(x) for x in arm.stiffness(jnp.array(0.0))]
    expected = np.zeros((6, 6))
    expected[range(3), range(3)] = [LENGTH / S[0], LENGTH / S[1], LENGTH / S[2]]
    expected[3, 3] = LENGTH / S[3]
    expected[4, 4] = LENGTH**3 / (3 * S[2]) + LENGTH / S[4]
    expected[5, 5] = LENGTH**3 / (3 * S[1]) + LENGTH / S[5]
    expected[2, 4] = expected[4, 2] = LENGTH**2 / (2 * S[2])
    expected[1, 5] = expected[5, 1] = -(LENGTH**2) / (2 * S[1])
    np.testing.assert_allclose(C, expected, atol=1e-12 * np.abs(expected).max())


@pytest.mark.slow
def test_compliance_against_differences_of_solves(eq):
    """The quadrature along a bent arm against solves under a wrench, an independent algorithm."""
    C = vsr.compliance(eq)
    pushed = jax.jit(
        lambda w: (
            vsr.solve(
                vsr.Scene(eq.scene.rod, eq.scene.actuators, [vsr.TipWrench(w[3:], w[:3])]),
                eq.inputs,
                model=FINER,
            ).tip
        )
    )
    for i, step in ((1, 1e-5), (4, 1e-4)):
        ahead, behind = (
            np.asarray(pushed(jnp.asarray(sign * step * np.eye(6)[i]))) for sign in (1, -1)
        )
        np.testing.assert_allclose(
            C[:, i], np.concatenate(motion(ahead, behind, step)), atol=1e-4 * np.abs(C[:, i]).max()
        )
    np.testing.assert_allclose(C, C.T, atol=1e-9 * np.abs(C).max())


class Approximate(SteppedModel):
    """A third-party model with only the required methods: constant strains."""

    steps: int = eqx.field(static=True, default=8)
    order: int = eqx.field(static=True, default=4)

    @property
    def inner(self):
        return vsr.Prescribed(
            vsr.Basis.uniform(vsr.Legendre(0)), points=8, steps=self.steps, order=self.order
        )

    def solve(self, scene, inputs):
        return self.inner.solve(scene, inputs)

    def strain(self, scene, forces, state, X):
        return self.inner.strain(scene, forces, state, X)

    def nodes(self, scene, forces, state):
        return self.inner.nodes(scene, forces, state)

    def node_strain(self, scene, state):
        return self.inner.node_strain(scene, state)


@pytest.mark.slow
def test_compliance_of_a_third_party_model_is_the_derivative_of_its_solve(eq):
    """Its sections are not balanced, so the integral of their compliances is a different matrix."""
    found = vsr.solve(eq.scene, eq.inputs, model=Approximate())
    C, balanced = vsr.compliance(found), vsr.compliance(eq)
    pushed = jax.jit(
        lambda w: (
            vsr.solve(
                vsr.Scene(eq.scene.rod, eq.scene.actuators, [vsr.TipWrench(w[3:], w[:3])]),
                eq.inputs,
                model=Approximate(),
            ).tip
        )
    )
    step = 1e-4
    ahead, behind = (
        np.asarray(pushed(jnp.asarray(sign * step * np.eye(6)[4]))) for sign in (1, -1)
    )
    np.testing.assert_allclose(
        C[:, 4], np.concatenate(motion(ahead, behind, step)), atol=1e-5 * np.abs(C[:, 4]).max()
    )
    assert np.abs(C - balanced)[:, 4].max() > 0.05 * np.abs(C[:, 4]).max()


@pytest.mark.slow
def test_compliance_under_loads_and_of_a_basis(eq):
    scene = vsr.Scene(eq.scene.rod, eq.scene.actuators, [vsr.TipWrench(force=(0.0, 0.0, -0.01))])
    models = (MODEL, vsr.Prescribed(vsr.Basis.uniform(vsr.Legendre(4))))
    loaded, other = (
        np.asarray(vsr.compliance(vsr.solve(scene, eq.inputs, model=model))) for model in models
    )
    np.testing.assert_allclose(loaded, other, atol=1e-3 * np.abs(loaded).max())
    np.testing.assert_allclose(loaded, loaded.T, atol=0.02 * np.abs(loaded).max())


def test_ellipsoids(eq):
    J = np.asarray(vsr.tip_jacobian(eq))[3:]
    found = vsr.manipulability(eq, [2] * len(J.T))
    np.testing.assert_allclose(found.measure, np.sqrt(np.linalg.det(4 * J @ J.T)), rtol=1e-9)
    np.testing.assert_allclose(found.axes @ found.axes.T, 4 * J @ J.T, atol=1e-12)
    np.testing.assert_allclose(found.centre, eq.tip[:3, 3])
    softest = vsr.compliance_ellipsoid(eq)
    np.testing.assert_allclose(
        np.linalg.norm(softest.axes[:, 0]), np.linalg.norm(vsr.compliance(eq)[3:, 3:], 2), rtol=1e-9
    )


@pytest.mark.parametrize("columns", [1, 2, 3, 5])
def test_an_ellipsoid_of_any_number_of_inputs_has_derivatives(columns):
    A, centre = np.random.default_rng(0).normal(size=(3, columns)), jnp.zeros(3)
    found = ellipsoid(jnp.asarray(A), centre)
    np.testing.assert_allclose(found.axes @ found.axes.T, A @ A.T, atol=1e-14)
    slope = jax.grad(lambda A: ellipsoid(A, centre).measure)(jnp.asarray(A))
    volume = np.sqrt(max(np.linalg.det(A @ A.T), 0.0))
    expected = volume * np.linalg.pinv(A).T if columns >= 3 else np.zeros_like(A)
    np.testing.assert_allclose(slope, expected, atol=1e-13)


@pytest.mark.slow
def test_under_vmap_jit_and_grad_and_in_single_precision(eq):
    scene = eq.scene.astype(jnp.float32)

    def measure(inputs):
        return jnp.sum(vsr.tip_jacobian(vsr.solve(scene, inputs, model=MODEL))[3:] ** 2)

    inputs = jnp.array([[4.0, 2.0, 1.0], [1.0, 0.0, 3.0]], jnp.float32)
    slopes = jax.jit(jax.vmap(jax.grad(measure)))(inputs)
    assert slopes.dtype == jnp.float32
    assert np.all(np.isfinite(slopes))
    rows = jax.vmap(lambda u: vsr.sensitivity(vsr.solve(scene, u, model=MODEL)))(inputs)
    assert rows.place.shape == (2, len(rows.names), 3)


def test_a_failed_solve_gives_nan(eq):
    failed = vsr.solve(eq.scene, jnp.array([1e6, 0.0, 0.0]), model=MODEL)
    assert np.all(np.isnan(vsr.tip_jacobian(failed)))
    assert np.all(np.isnan(vsr.compliance(failed)))
