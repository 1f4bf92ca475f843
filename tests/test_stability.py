"""The stability margin: the tangent of all nodes against the derivative of the residual, and
Lanczos' method against dense eigenvalues."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import epsilon

import vsr_jax as vsr
from vsr_jax.elements.problem import loading
from vsr_jax.mechanics.balance import residual, thread_direction, thread_wrench, with_locked
from vsr_jax.mechanics.reaction import react
from vsr_jax.models.base import Nodes
from vsr_jax.numerics import lanczos
from vsr_jax.numerics.component import free_components, spread
from vsr_jax.numerics.lanczos import Operator, extreme_pairs
from vsr_jax.solution.stability import arm_of, extreme

MODEL = vsr.StrainDependent(8)
LENGTH = 0.4
DEAD = [vsr.Gravity(), vsr.TipWrench(force=(0.01, 0.02, 0.1))]
FOLLOWERS = [
    vsr.PointWrench(0.17, force=(0.02, 0.1, 0.2), moment=(0.01, 0.02, 0.01), frame="body"),
    vsr.TipWrench(force=(0.0, 0.02, 0.05), moment=(0.01, 0.01, 0.0), frame="body"),
    vsr.DistributedWrench(force=(0.0, 0.1, 0.2), moment=(0.0, 0.01, 0.01), frame="body"),
]


def arm(loads, *, end=None, control="tension", count=2, **options):
    rod = vsr.Rod(
        LENGTH, vsr.Circular(vsr.Taper(0.008, 0.006)), vsr.Material(6e5, shear=2e5, density=1080.0)
    )
    threads = [
        vsr.Tendon(vsr.Helix(0.004, 1.5, phase=2.0 * i), end=end, control=control)
        for i in range(count)
    ]
    return vsr.Scene(rod, threads, loads, **options)


def bent(scene, size=1.0, model=MODEL):
    """Nodes of a bent arm, not in balance: the tangent is defined there too."""
    grid = model.grid(scene)
    sections, X = scene.sections(grid.X), grid.X / scene.rod.length
    waves = [
        2 * jnp.sin(3 * X),
        3 * jnp.cos(2 * X),
        4 * X,
        0.05 * X,
        0.03 * jnp.sin(X),
        0.02 * jnp.cos(X),
    ]
    moving = spread(free_components(tuple(waves), scene.free), scene.free)
    xi = tuple(
        jnp.broadcast_to(rest, X.shape) + size * wave
        for rest, wave in zip(sections.rest, moving, strict=True)
    )
    return Nodes(grid, xi, sections, sections.reach)


def dense(scene, forces, nodes):
    """The whole scaled tangent by forward differentiation of the residual, symmetric part, where
    changes of strain are allowed."""
    grid, free = nodes.grid, scene.free
    loads, tau = loading(scene, grid), nodes.tau(forces)
    still = jnp.stack(free_components(nodes.xi, free))
    held = nodes.sections._replace(rest=nodes.xi)

    def imbalance(values):
        xi = with_locked(spread(tuple(values), free), held, free)
        wrench = tuple(react(xi, grid, loads).wrench)
        return jnp.stack(free_components(residual(xi, nodes.sections, tau, wrench), free))

    jacobian = np.asarray(jax.jit(jax.jacfwd(imbalance))(still)).reshape(still.size, still.size)
    weight = np.broadcast_to(grid.weight, still.shape).reshape(-1)
    root = np.sqrt(
        weight
        * np.stack(
            [
                np.broadcast_to(s, grid.X.shape)
                for s in free_components(nodes.sections.stiffness, free)
            ]
        ).reshape(-1)
    )
    there = weight > 0
    scaled = (weight[:, None] * jacobian)[there][:, there] / np.outer(root[there], root[there])
    forbidden = [np.zeros((there.sum(), 0))]
    for place in scene.length_driven:
        path, reach = nodes.sections.paths[place], nodes.sections.reach[place]
        unit = np.stack(
            free_components(thread_wrench(thread_direction(nodes.xi, path)[0], path), free)
        ) * (1.0 if reach is None else reach)
        if forces[place] < 0:
            forbidden.append(
                ((np.asarray(grid.weight) * unit).reshape(-1)[there] / root[there])[:, None]
            )
    forbidden = np.concatenate(forbidden, axis=1)
    allowed = np.linalg.svd(forbidden)[0][:, forbidden.shape[1] :]
    return allowed.T @ (0.5 * (scaled + scaled.T)) @ allowed


CASES = {
    "dead loads": (arm(DEAD), (-1.0, -2.0)),
    "followers": (arm(FOLLOWERS), (-1.0, -2.0)),
    "dead moment, locked strains": (
        arm(
            [vsr.TipWrench(moment=(0.02, 0.01, 0.03))],
            free_strains=["torsion", "bending_y", "bending_z"],
        ),
        (-1.0, -2.0),
    ),
    # two of the pieces between their ends are empty: the scaled tangent was 0 / 0 there
    "threads that end at one place": (
        arm([vsr.Gravity()], end=LENGTH / 2, count=3),
        (-1.0, -2.0, -1.0),
    ),
    "cables, one of them slack": (arm(DEAD, control="length", count=3), (-1.0, 0.0, -2.0)),
    "hanging from its end": (arm([vsr.TipWrench(force=(20.0, 0.0, 0.0))]), (0.0, 0.0)),
}


@pytest.mark.slow
@pytest.mark.parametrize(
    "name",
    [
        "cables, one of them slack",
        "followers",
        "dead moment, locked strains",
        *(
            pytest.param(name, marks=pytest.mark.slow)
            for name in ("threads that end at one place", "hanging from its end", "dead loads")
        ),
    ],
)
def test_the_ends_of_the_spectrum_are_those_of_the_dense_tangent(name):
    scene, forces = CASES[name]
    forces, nodes = tuple(jnp.asarray(f) for f in forces), bent(scene)

    @eqx.filter_jit
    def found(scene, forces, nodes):
        operator = arm_of(scene, jnp.zeros(len(forces)), forces, nodes)
        pairs = extreme_pairs(operator)
        products = jax.vmap(operator.product())(pairs.vectors)
        return pairs, products, jax.vmap(operator.allowed)(pairs.vectors)

    pairs, products, allowed = jax.tree.map(np.asarray, found(scene, forces, nodes))
    expected = np.linalg.eigvalsh(dense(scene, forces, nodes))
    np.testing.assert_allclose(pairs.values[0], expected[0], atol=1e-11 * max(1, expected[-1]))
    np.testing.assert_allclose(pairs.values[1], expected[-1], rtol=1e-9)
    np.testing.assert_allclose(np.sum(pairs.vectors**2, axis=(1, 2, 3)), 1, rtol=1e-12)
    np.testing.assert_allclose(allowed, pairs.vectors, atol=1e-12)
    np.testing.assert_allclose(
        products[0], pairs.values[0] * pairs.vectors[0], atol=1e-9 * max(1, expected[-1])
    )


def margin(p):
    """Least eigenvalue as a function of the size of bend, load and tension."""
    scene, forces = CASES["cables, one of them slack"]
    scene = eqx.tree_at(
        lambda scene: scene.loads[1].force, scene, scene.loads[1].force * p[1]
    ).astype(p.dtype)
    nodes = bent(scene, p[0], vsr.StrainDependent(12, 2))
    pulls = tuple(jnp.asarray(f, p.dtype) * p[2] for f in forces)
    return extreme(scene, jnp.zeros(len(pulls)), pulls, nodes)


POINT = np.array([1.0, 2.0, 1.5])


@pytest.fixture(scope="module")
def slopes():
    return jax.jit(jax.vmap(jax.value_and_grad(margin)))


@pytest.mark.slow
def test_derivatives_are_those_of_differences(slopes):
    steps = np.concatenate([np.zeros((1, 3)), *(h * np.eye(3) for h in (1e-3, -1e-3, 2e-3, -2e-3))])
    value, slope = (np.asarray(x) for x in slopes(jnp.asarray(POINT + steps)))
    ahead, behind, further, back = (value[1 + 3 * i : 4 + 3 * i] for i in range(4))
    np.testing.assert_allclose(
        slope[0],
        (8 * (ahead - behind) - (further - back)) / 12e-3,
        atol=1e-8 * np.abs(slope[0]).max(),
    )


@pytest.mark.slow
def test_second_derivatives_are_those_of_differences(slopes):
    direction = np.array([0.3, -0.5, 0.7])
    slope = np.asarray(
        slopes(jnp.asarray(POINT + 1e-3 * np.outer([1, -1, 2, -2] + [0] * 9, direction)))[1]
    )
    expected = (8 * (slope[0] - slope[1]) - (slope[2] - slope[3])) @ direction / 12e-3

    def rate(p):
        return jax.jvp(margin, (p,), (jnp.asarray(direction),))[1]

    found = jax.jit(lambda p: jax.jvp(rate, (p,), (jnp.asarray(direction),))[1])(jnp.asarray(POINT))
    np.testing.assert_allclose(found, expected, rtol=1e-7)


@pytest.mark.slow
def test_side_by_side_each_is_what_it_is_alone(slopes):
    """One that is not a number changes no other."""
    p = np.concatenate([[POINT, [0.5, 1.0, 1.0], [np.nan, 1.0, 1.0]], np.ones((10, 3))])
    value, slope = slopes(jnp.asarray(p))
    np.testing.assert_allclose(value[0], jax.jit(margin)(jnp.asarray(POINT)), rtol=1e-12)
    assert np.all(np.isnan(value[2]))
    assert np.all(np.isfinite(slope[np.array([0, 1, *range(3, 13)])]))


@pytest.mark.slow
def test_in_single_precision(slopes):
    p = jnp.asarray(np.concatenate([[POINT], np.ones((12, 3))]))
    value, slope = slopes(p)
    single, single_slope = slopes(p.astype(jnp.float32))
    assert single.dtype == single_slope.dtype == jnp.float32
    np.testing.assert_allclose(single, value, atol=2e-5)
    np.testing.assert_allclose(single_slope, slope, atol=5e-3 * np.abs(slope).max())


class Matrix(Operator):
    """A symmetric matrix as an operator."""

    matrix: jax.Array

    @property
    def like(self):
        return self.matrix[0]

    def allowed(self, v):
        return v

    def product(self):
        return lambda v: self.matrix @ v


class Diagonal(Operator):
    """A diagonal matrix."""

    matrix: jax.Array

    @property
    def like(self):
        return self.matrix

    def allowed(self, v):
        return v

    def product(self):
        return lambda v: self.matrix * v


SPECTRA = {
    "near the limit": np.concatenate([[1e-9], np.linspace(0.3, 2.0, 199)]),
    "below the limit": np.concatenate([[-1e-9], np.linspace(0.3, 2.0, 199)]),
    "all one": np.ones(100),
    "clustered at one": 1 + np.concatenate([np.zeros(100), 1 / np.arange(1, 201.0) ** 2]),
    "two alike": np.array([0.2, 0.2, 0.7, 0.9, 1.0, 3.0]),
    "great and small": np.concatenate([[0.05, 900.0, 870.0, 130.0], 1 + 1 / np.arange(1, 197.0)]),
    "negative": np.concatenate([[-40.0, -39.0], np.linspace(0.5, 1.5, 50)]),
    "a single number": np.array([0.7]),
}


@pytest.mark.parametrize("name", SPECTRA)
def test_spectra_that_are_hard(name, dtype):
    spectrum = SPECTRA[name]
    found = jax.jit(extreme_pairs)(Diagonal(jnp.asarray(spectrum, dtype))).values
    near = (
        max(1e-10, 50 * epsilon(dtype) * np.abs(spectrum).max())
        if dtype == "float64"
        else 1e-4 * np.abs(spectrum).max()
    )
    np.testing.assert_allclose(found, [spectrum.min(), spectrum.max()], atol=near)


def test_what_is_not_found_is_not_given(monkeypatch):
    """The ends of a spectrum without gaps are not reached in a few products."""
    monkeypatch.setattr(lanczos, "_MOST", 16)
    assert np.all(np.isnan(extreme_pairs(Diagonal(jnp.linspace(0.0, 1.0, 64))).values))


@pytest.mark.slow
def test_derivatives_of_both_ends_of_any_order():
    random = np.random.default_rng(3)
    A, B, C = (x + x.T for x in random.standard_normal((3, 12, 12)))

    def ends(p, of):
        return of(A + p[0] * B + p[0] * p[1] * C + p[1] ** 2 * B)

    def dense_ends(S):
        return jnp.linalg.eigvalsh(S)[jnp.array([0, -1])]

    p = jnp.array([0.3, -0.2])
    for derivative in (jax.jacfwd, jax.jacrev, jax.hessian, lambda f: jax.jacfwd(jax.hessian(f))):
        found, expected = (
            jax.jit(derivative(lambda p, f=f: ends(p, f)))(p)
            for f in (lambda S: extreme_pairs(Matrix(S)).values, dense_ends)
        )
        np.testing.assert_allclose(found, expected, atol=1e-8 * np.abs(expected).max())


def test_an_arm_without_loads_is_judged_section_by_section():
    """Whether threads are driven by their tension or hold their length: no finite number of cables
    steadies every section."""
    given, held = (arm([], control=control) for control in ("tension", "length"))
    forces = tuple(jnp.asarray(f) for f in (-1.0, -2.0))
    none = jnp.zeros(2)
    values = [eqx.filter_jit(extreme)(scene, none, forces, bent(scene)) for scene in (given, held)]
    np.testing.assert_allclose(*values, rtol=1e-14)
    assert values[0] > 1 - 1e-12
