"""The prescribed-basis model: K, B(q), eq. 18 and eq. 20."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import vsr_jax as vsr
from tests.conftest import epsilon
from vsr_jax.mechanics.balance import residual, tangent
from vsr_jax.models.prescribed import project
from vsr_jax.studies import paper

BASES = {
    "monomial": vsr.Basis.uniform(vsr.Monomial(2)),
    "legendre": vsr.Basis.uniform(vsr.Legendre(3)),
    "trigonometric": vsr.Basis.uniform(vsr.Trigonometric([4.8, 3.2])),
    "piecewise constant": vsr.Basis.uniform(vsr.PiecewiseConstant([0.2, 0.7])),
    "functions": vsr.Basis.uniform(
        vsr.Functions(lambda x: jnp.stack([jnp.exp(-x), jnp.exp(x)]), size=2)
    ),
    "mixed, four strains": vsr.Basis(
        {
            "torsion": vsr.Monomial(0),
            "bending_y": vsr.Legendre(2),
            "bending_z": vsr.PiecewiseConstant(2),
            "elongation": vsr.Legendre(1),
        }
    ),
    "matrix": vsr.FunctionBasis(
        lambda x: jnp.stack([jnp.full(6, 1.0), jnp.arange(6) * x], axis=1), size=2
    ),
}


@pytest.fixture(params=BASES, ids=lambda name: name.replace(" ", "-"))
def basis(request):
    return BASES[request.param]


@pytest.mark.slow
def test_B_is_the_transposed_derivative_of_the_thread_lengths(basis):
    """B(q)^T = d l / d q, with the lengths summed on another rule: 400 Simpson panels on each
    smooth piece."""
    scene = paper.scene("C2")
    q = jnp.asarray(np.random.default_rng(0).normal(size=basis.size)) * 0.05

    edges = np.sort(np.array([0.0, *map(float, basis.breakpoints(scene.rod.length)), 0.75]))

    def lengths(q):
        total = 0.0
        for a, b in itertools.pairwise(edges):
            X = jnp.linspace(a, b, 801)
            inside = jnp.clip(X, a + 1e-13, b - 1e-13)
            xi = jax.vmap(lambda x: basis.matrix(x, scene.rod.length) @ q)(inside) + jnp.eye(6)[3]

            def speed(x, xi, actuator):
                (y, z), (dy, dz) = jax.jvp(actuator.routing, (x,), (1.0,))
                d = jnp.stack([jnp.zeros_like(y), y, z])
                return jnp.linalg.norm(
                    jnp.cross(xi[:3], d) + xi[3:] + jnp.stack([0.0 * dy, dy, dz])
                )

            weights = np.ones(801)
            weights[1:-1:2], weights[2:-1:2] = 4, 2
            total += (
                jnp.stack(
                    [
                        jnp.sum(weights * jax.vmap(lambda x, s, t=t: speed(x, s, t))(X, xi))
                        for t in scene.actuators
                    ]
                )
                * (b - a)
                / 2400
            )
        return total

    B = vsr.actuation_matrix(scene, basis, q)
    np.testing.assert_allclose(
        B.T, jax.jit(jax.jacfwd(lengths))(q), atol=1e-10 * np.abs(B).max() + 1e-10
    )


def test_K_is_symmetric_positive_definite(basis):
    K = vsr.stiffness_matrix(paper.scene("C1"), basis)
    np.testing.assert_allclose(K, K.T, atol=1e-14 * np.abs(K).max())
    scale = np.sqrt(np.diag(K))
    assert np.linalg.eigvalsh(K / np.outer(scale, scale)).min() > 1e-6


def test_K_holds_the_integral_of_the_taper():
    """Elongation alone, one constant: K = int E A dX = E pi L (R^2 + R r + r^2) / 3 for a cone."""
    K = vsr.stiffness_matrix(paper.scene("C1"), vsr.Basis({"elongation": vsr.Monomial(0)}))
    np.testing.assert_allclose(
        K, [[5.93e5 * np.pi * 0.75 * (0.012**2 + 0.012 * 0.01 + 0.01**2) / 3]], rtol=1e-13
    )


@pytest.mark.parametrize("name", ["piecewise constant", "mixed, four strains", "matrix"])
def test_solution_satisfies_eq_18(name):
    scene, basis, tau = paper.scene("C2"), BASES[name], jnp.array([-6.0, -2.0])
    eq = vsr.solve(scene, tau, model=vsr.Prescribed(basis))
    assert bool(eq.converged)
    K, B = vsr.stiffness_matrix(scene, basis), vsr.actuation_matrix(scene, basis, eq.q)
    np.testing.assert_allclose(K @ eq.q, B @ tau, atol=1e-12 * np.abs(K @ eq.q).max())


def test_tangent_is_symmetric_and_the_derivative_of_the_residual():
    scene, basis = paper.scene("A3"), BASES["legendre"]
    projection, tau = project(scene, basis, 16), tuple(jnp.array([-15.0, 4.0, -5.0]))
    q = jnp.asarray(np.random.default_rng(1).normal(size=basis.size)) * 0.1

    def force(q):
        return projection.integrate(residual(projection.strain(q), projection.sections, tau))

    T = projection.stiffness(tangent(projection.strain(q), projection.sections, tau))
    np.testing.assert_allclose(T, jax.jacfwd(force)(q), atol=1e-11 * np.abs(T).max())
    np.testing.assert_allclose(T, T.T, atol=1e-13 * np.abs(T).max())


def strain_dependent_basis(scene, eq):
    """Eq. 19 at a solution: B_q = Sigma^-1 B_tau, with d~ written as a matrix and eq. 11 and 17
    term by term."""

    def matrix(x):
        xi = eq.strain(x)
        stiffness = jnp.stack(scene.rod.stiffness(x))
        columns = []
        for actuator in scene.actuators:
            (y, z), (dy, dz) = jax.jvp(actuator.routing, (x,), (jnp.ones_like(x),))
            d = jnp.stack([jnp.zeros_like(y), y, z])
            t_c = jnp.cross(xi[:3], d) + xi[3:] + jnp.stack([0.0 * dy, dy, dz])
            t = t_c / jnp.linalg.norm(t_c)
            columns.append(jnp.concatenate([jnp.cross(d, t), t]) / stiffness)
        return jnp.stack(columns, axis=1)

    return matrix


@pytest.mark.slow
@pytest.mark.parametrize(
    "case",
    [
        pytest.param(case, marks=[] if case in ("A3", "C1") else pytest.mark.slow)
        for case in paper.CASES
    ],
)
def test_eq_20_gives_q_equal_tau(case):
    """With the basis of eq. 19 the strain found by the model has coordinates tau, and K q = B tau
    gives them back."""
    scene, tau = paper.scene(case), jnp.asarray(paper.reference(case)[0].tau)
    eq = vsr.solve(scene, tau)
    matrix = strain_dependent_basis(scene, eq)
    X = jnp.linspace(0.01, 0.74, 40)
    B_q, xi = jax.jit(jax.vmap(matrix))(X), eq.strain(X)
    stiffness = jax.vmap(lambda x: jnp.stack(scene.rod.stiffness(x)))(X)
    K = jnp.einsum("xia,xi,xib->ab", B_q, stiffness, B_q)
    elastic = jnp.einsum("xia,xi,xi->a", B_q, stiffness, xi - jnp.eye(6)[3])
    np.testing.assert_allclose(jnp.linalg.solve(K, elastic), tau, rtol=1e-12)
    np.testing.assert_allclose(eq.q, tau, rtol=0)
    assert np.linalg.eigvalsh(K).min() > 0


@pytest.mark.slow
def test_legendre_bases_converge_geometrically(capsys):
    """Tip error on B1 by order, 0 to 10: from order 4 on, every two orders gain at least a factor
    of four."""
    scene, reference = paper.scene("B1"), paper.reference("B1")[0]
    orders, errors = (0, 2, 4, 6, 8, 10), []
    for order in orders:
        model = vsr.Prescribed(vsr.Basis.uniform(vsr.Legendre(order)), points=24, steps=64)
        errors.append(
            float(
                np.linalg.norm(
                    vsr.solve(scene, reference.tau, model=model).tip[:3, 3] - reference.tip[:3, 3]
                )
            )
        )
    with capsys.disabled():
        print(
            "\nB1, Prescribed, tip error [m] by Legendre order:",
            ", ".join(f"{n}: {e:.1e}" for n, e in zip(orders, errors, strict=True)),
        )
    assert errors[-1] < 2e-5
    for coarse, fine in itertools.pairwise(errors[2:]):
        assert fine < coarse / 4


@pytest.mark.parametrize("angle", [2.5, 5.0])
def test_a_dead_moment_bends_an_arm_to_an_arc(angle):
    """Its tangent is far from symmetric: two of its pivots are negative, the real parts of all its
    eigenvalues above 0.9 of the elastic stiffness."""
    length, young, radius = 0.3, 1e6, 0.01
    rod = vsr.Rod(length, vsr.Circular(radius), vsr.Material(young, poisson=0.45))
    moment = angle * young * np.pi / 4 * radius**4 / length
    scene = vsr.Scene(rod, loads=[vsr.TipWrench(moment=(0.0, 0.0, moment))])
    model = vsr.Prescribed(vsr.Basis.uniform(vsr.Legendre(3)), steps=16)
    eq = vsr.solve(scene, jnp.zeros(0), model=model, throw=True)
    arc = length / angle * np.array([np.sin(angle), 1 - np.cos(angle), 0.0])
    np.testing.assert_allclose(eq.tip[:3, 3], arc, atol=1e-10)


def test_only_the_named_strains_move():
    basis = vsr.Basis({"bending_z": vsr.Legendre(2)})
    eq = vsr.solve(paper.scene("A2"), jnp.array([-10.0]), model=vsr.Prescribed(basis))
    strain = eq.strain(jnp.linspace(0, 0.75, 5))
    np.testing.assert_array_equal(strain[:, [0, 1, 3, 4, 5]], np.tile([0, 0, 1, 0, 0], (5, 1)))
    assert eq.q.shape == (3,)
    assert np.abs(strain[:, 2]).min() > 0


def test_pcs_breaks_the_quadrature_at_its_sections():
    basis = vsr.Basis({"bending_z": vsr.PiecewiseConstant([0.3])})
    K = vsr.stiffness_matrix(paper.scene("A1"), basis, points=1)
    np.testing.assert_allclose(
        K, 5.93e5 * np.pi / 4 * 1e-8 * 0.75 * np.diag([0.3, 0.7]), rtol=1e-12
    )


@pytest.mark.slow
def test_precision_follows_the_inputs(dtype):
    model = vsr.Prescribed(paper.basis("B1"))
    reference = paper.reference("B1")[0]
    eq = vsr.solve(paper.scene("B1"), jnp.asarray(reference.tau, dtype), model=model)
    assert bool(eq.converged)
    assert eq.tip.dtype == eq.q.dtype == dtype
    assert np.linalg.norm(eq.tip[:3, 3] - reference.tip[:3, 3]) < max(300 * epsilon(dtype), 1e-7)


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize(
    ("make", "message"),
    [
        (
            lambda: vsr.Basis({"twist": vsr.Monomial(0)}),
            "unknown strain 'twist', need names among torsion, bending_y",
        ),
        (lambda: vsr.Basis({}), "Basis: got no strain"),
        (lambda: vsr.Basis({"torsion": 1}), r"Basis\['torsion'\]: got 1, need a family"),
        (lambda: vsr.Monomial(-1), r"Monomial\.order: got -1, need an integer >= 0"),
        (lambda: vsr.Legendre(2.5), r"Legendre\.order: got 2\.5"),
        (lambda: vsr.Trigonometric([], constant=False), "got no function"),
        (lambda: vsr.PiecewiseConstant(0), r"PiecewiseConstant\.sections: got 0"),
        (lambda: vsr.PiecewiseConstant([0.7, 0.3]), "or ascending fractions between 0 and 1"),
        (lambda: vsr.FunctionBasis(lambda x: x, size=0), r"FunctionBasis\.size: got 0"),
    ],
)
def test_refusals_say_what_and_where(make, message):
    with pytest.raises(ValueError, match=message):
        make()


def test_actuation_matrix_knows_where_a_thread_ends():
    scene = vsr.Scene(paper.scene("A1").rod, [vsr.Thread(vsr.Parallel(0.004, 0.0), end=0.25)])
    basis = vsr.Basis.uniform(vsr.Legendre(1))
    eq = vsr.solve(scene, jnp.array([-0.01]), model=vsr.Prescribed(basis))
    K, B = vsr.stiffness_matrix(scene, basis), vsr.actuation_matrix(scene, basis, eq.q)
    np.testing.assert_allclose(K @ eq.q, B @ eq.forces, atol=1e-14)


def test_a_family_that_several_strains_share_breaks_the_steps_once():
    basis = vsr.Basis.uniform(vsr.PiecewiseConstant(4))
    copy = jax.tree.map(lambda leaf: leaf, basis)  # as every solve makes one
    assert len(basis.breakpoints(jnp.array(1.0))) == len(copy.breakpoints(jnp.array(1.0))) == 3


def test_a_basis_of_functions_has_the_shape_that_was_promised():
    arm = vsr.Rod(0.3, vsr.Circular(0.01), vsr.Material(1e6, poisson=0.4))
    scene = vsr.Scene(arm, [vsr.Tendon(vsr.Parallel(0.005, 0.0))])
    lists = vsr.Basis({"bending_z": vsr.Functions(lambda X: [1.0, X], size=2)})
    line = vsr.Basis({"bending_z": vsr.Monomial(1)})
    tips = [vsr.solve(scene, [1.0], model=vsr.Prescribed(basis)).tip for basis in (lists, line)]
    np.testing.assert_allclose(*tips, atol=1e-12)
    short = vsr.Basis({"bending_z": vsr.Functions(lambda X: [1.0], size=2)})
    with pytest.raises(ValueError, match=r"Functions\.function: got values of shape \(1,\)"):
        vsr.solve(scene, [1.0], model=vsr.Prescribed(short))


def test_the_actuation_matrix_of_an_arm_without_actuators_has_no_columns():
    arm = vsr.Rod(0.3, vsr.Circular(0.01), vsr.Material(1e6, poisson=0.4))
    basis = vsr.Basis.uniform(vsr.PiecewiseConstant(np.int64(2)))
    assert vsr.actuation_matrix(vsr.Scene(arm), basis, [0.0] * 12).shape == (12, 0)


def test_finer_is_finer_in_its_quadrature_too():
    finer = vsr.Prescribed(vsr.Basis.uniform(vsr.Legendre(2)), points=8, steps=16).finer()
    assert (finer.points, finer.steps) == (16, 32)
