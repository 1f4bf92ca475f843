r"""The model with a prescribed basis (eq. 14-18): $K q = B(q) \tau$ by Gauss quadrature and
Newton's method."""

from dataclasses import replace
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..arm.scene import CrossSections, Scene
from ..elements.problem import problem_of
from ..mechanics.balance import (
    force_scale,
    forces_where,
    residual,
    rounding_floor,
    tangent,
    unit_wrench,
    without_force,
)
from ..mechanics.coupling import ArmProblem, forces_at
from ..numerics import component as c, lu
from ..numerics.component import Forces, Vector
from ..numerics.implicit import implicit_root
from ..numerics.magnus import ORDERS, accumulate_jacobian
from ..numerics.newton import Evaluation, Root, newton
from ..numerics.quadrature import make_grid, onto
from ..typing import Scalar, ScalarLike, VectorLike, real
from ..validation import ROUNDING, choice, count, instance, on_arm
from . import prescribed_loaded
from .base import Nodes, Outcome, Status, SteppedModel, classify
from .basis import AbstractBasis
from .prescribed_loaded import solve_prescribed


class Projection(NamedTuple):
    """A basis and the cross-sections at the quadrature points, with the quadrature `weight` [m] and
    the `matrix` $B_q$, shape (points, 6, n)."""

    sections: CrossSections
    weight: Float[Array, " points"]
    matrix: Float[Array, "points 6 dofs"]

    def strain(self, q: Float[Array, " dofs"]) -> Vector:
        """Strain $B_q q + \\xi^*$ at the points, six component arrays (eq. 14)."""
        return c.add(c.split(self.matrix @ q), self.sections.rest)

    def integrate(self, wrench: Vector) -> Float[Array, " dofs"]:
        """Generalised force $\\int B_q^T F \\, dX$."""
        return jnp.einsum("x,xia,xi->a", self.weight, self.matrix, c.join(wrench))

    def stiffness(self, lower: c.Matrix) -> Float[Array, "dofs dofs"]:
        """Generalised stiffness $\\int B_q^T H B_q \\, dX$ from the lower triangle of $H$."""
        weighted = self.weight[:, None, None] * (c.join_matrix(c.symmetric(lower)) @ self.matrix)
        return jnp.einsum("xia,xib->ab", self.matrix, weighted)

    def elastic_stiffness(self) -> Float[Array, "dofs dofs"]:
        """$K = \\int B_q^T \\Sigma B_q \\, dX$."""
        weighted = (self.weight[:, None] * c.join(self.sections.stiffness))[..., None] * self.matrix
        return jnp.einsum("xia,xib->ab", self.matrix, weighted)


def basis_at(scene: Scene, basis: AbstractBasis, X: Scalar) -> Float[Array, "6 dofs"]:
    """The basis $B_q(X)$ on the arm of a scene, zero on rigid pieces."""
    return c.times(scene.rod.flexible(X), basis.matrix(X, scene.rod.length))


def project(scene: Scene, basis: AbstractBasis, points: int) -> Projection:
    """Basis and cross-sections at `points` Gauss points on each smooth piece of the arm."""
    length = scene.rod.length
    grid = make_grid(scene.edges(basis.breakpoints(length)), 1, points)
    X = grid.X.reshape(-1)
    matrix = jax.vmap(lambda x: basis_at(scene, basis, x))(X)
    return Projection(scene.sections(X), grid.weight.reshape(-1), matrix)


def solve_projected(projection: Projection, tau: Forces) -> Root:
    r"""Coordinates q with $K q = B(q) \tau$ (eq. 18), by Newton's method on the symmetric tangent
    $K - \partial (B \tau) / \partial q$. Derivatives of any order are implicit."""

    def linear_solve(q: Array, projection: Projection, tau: Forces, right: Array) -> Array:
        return lu.solve(_tangent(q, projection, tau), right)

    def at_rest(q: Array, projection: Projection, tau: Forces) -> tuple:
        return jnp.zeros_like(q), projection, without_force(tau)

    return implicit_root(_find_projected, _imbalance, linear_solve, at_rest, projection, tau)


def _imbalance(q: Array, projection: Projection, tau: Forces) -> Array:
    """$K q - B(q) \\tau$."""
    return projection.integrate(residual(projection.strain(q), projection.sections, tau))


def _tangent(q: Array, projection: Projection, tau: Forces) -> Array:
    lower = tangent(projection.strain(q), projection.sections, tau)
    return _regular(projection.stiffness(lower), projection)


def _regular(K: Array, projection: Projection) -> Array:
    """A stiffness matrix with ones for the coordinates of rigid pieces alone, which stay zero."""
    if projection.sections.flexible is None:
        return K
    return K + jnp.diag(jnp.all(projection.matrix == 0, axis=(0, 1)).astype(K.dtype))


def _find_projected(projection: Projection, tau: Forces) -> Root:
    K = _regular(projection.elastic_stiffness(), projection)
    elastic = lu.factor(K)
    axial = jnp.sum(projection.weight * force_scale(projection.sections.stiffness))

    def norm(force: Array, change: Array) -> Array:
        return jnp.sqrt(jnp.maximum(force @ change, 0.0) / axial)

    def evaluate(q: Array) -> Evaluation:
        r = _imbalance(q, projection, tau)
        factors = lu.factor(_tangent(q, projection, tau))
        definite, relaxed = jnp.all(lu.diagonal(factors) > 0), lu.substitute(elastic, r)
        step = jnp.where(definite, lu.substitute(factors, r), relaxed)
        return Evaluation(step, norm(K @ step, step), norm(r, relaxed), definite)

    floor = jnp.max(rounding_floor(projection.sections.stiffness, tau)) * K.shape[0] ** 0.5
    q, definite, steps = newton(evaluate, jnp.zeros(K.shape[0], K.dtype), floor)
    left = _imbalance(q, projection, tau)
    return Root(q, norm(left, lu.substitute(elastic, left)) <= 16 * floor, definite, steps)


class Prescribed(SteppedModel):
    r"""Strain in a given basis, $\xi = B_q(X) q + \xi^*$, with $K q = B(q) \tau$ (eq. 18).

    On rigid pieces the strain is $\xi^*$; the basis counts on the other parts of the arm only, and
    the coordinates of functions that are zero there are zero.

    **Arguments:**
    - `basis`: an `AbstractBasis`, such as `Basis.uniform(Legendre(4))`.
    - `points`: Gauss points of the quadrature of $K$ and $B(q)$ on each smooth piece of the arm.
      With loads, prescribed thread lengths or friction the quadrature is that of the pose steps.
    - `steps`, `order`: pose steps as for `StrainDependent`.

    **Raises:** `ValueError` on solving a scene that locks a strain which the basis frees, that has
    held sections or obstacles, or whose tendons run straight from disc to disc.
    """

    basis: AbstractBasis
    points: int = eqx.field(static=True)
    steps: int = eqx.field(static=True)
    order: int = eqx.field(static=True)

    def __init__(self, basis: AbstractBasis, points: int = 32, steps: int = 32, order: int = 6):
        self.basis = instance(
            "Prescribed.basis", basis, AbstractBasis, "a basis such as Basis.uniform(Legendre(4))"
        )
        self.points = count("Prescribed.points", points)
        self.steps = count("Prescribed.steps", steps)
        self.order = choice("Prescribed.order", order, ORDERS)

    def breakpoints(self, scene: Scene) -> tuple[Array, ...]:
        return self.basis.breakpoints(scene.rod.length)

    def solve(self, scene: Scene, inputs: Float[Array, " inputs"]) -> Outcome:
        self.refuse_whole_arm(scene)
        self.basis.check(scene, type(self).__name__)
        if scene.coupled:
            return self._solve_together(scene, inputs)
        projection, forces = project(scene, self.basis, self.points), scene.forces(inputs)
        tau = projection.sections.carry(forces)
        q, balanced, definite, steps, *_ = solve_projected(projection, tau)
        status = classify(projection.strain(q), projection.sections, tau, balanced, definite)
        return Outcome(jnp.where(status == Status.CONVERGED, q, 0.0), forces, status, steps)

    def _solve_together(self, scene: Scene, inputs: Float[Array, " inputs"]) -> Outcome:
        problem = problem_of(scene, inputs, self.grid(scene))
        basis = self._at_nodes(scene, problem)
        unknown, balanced, definite, steps, *_ = solve_prescribed(basis, problem)
        q, coupled = unknown.q, prescribed_loaded.coupled_of(unknown, basis, problem)
        forces = forces_at(problem.couplings, coupled, problem.forces)
        at = prescribed_loaded.state_of(unknown, basis, problem)
        status = classify(at.xi, problem.sections, at.tau, balanced, definite, loaded=scene.loaded)
        sound = status == Status.CONVERGED
        return Outcome(jnp.where(sound, q, 0.0), forces_where(sound, forces), status, steps)

    def _at_nodes(self, scene: Scene, problem: ArmProblem) -> prescribed_loaded.NodalBasis:
        X = problem.grid.X.reshape(-1)
        rated = problem.follows_rate

        def at(x: Scalar) -> Array:
            return basis_at(scene, self.basis, x)

        def with_rate(x: Scalar) -> tuple[Array, Array]:
            return jax.jvp(at, (x,), (jnp.ones_like(x),))

        matrix, rate = jax.vmap(with_rate)(X) if rated else (jax.vmap(at)(X), None)
        shape = (*problem.grid.X.shape, 6, self.basis.size)
        return prescribed_loaded.NodalBasis(
            matrix.reshape(shape), None if rate is None else rate.reshape(shape)
        )

    def coordinates(self, scene: Scene, forces: Forces, state: Array) -> Float[Array, " dofs"]:
        return state

    def finer(self) -> "Prescribed":
        return replace(self, steps=2 * self.steps, points=2 * self.points)

    def dofs(self, scene: Scene) -> int:
        return self.basis.size

    def dof_labels(self, size: int) -> tuple[tuple[str, str], ...]:
        return self.basis.labels

    def node_strain(self, scene: Scene, state: Array) -> Vector:
        X = self.grid(scene).X
        return tuple(x.reshape(X.shape) for x in self._strain(scene, state, X.reshape(-1)))

    def nodes(self, scene: Scene, forces: Forces, state: Array) -> Nodes:
        grid = self.grid(scene)
        xi, sections = self.node_strain(scene, state), scene.sections(grid.X)
        if not scene.frictional:
            return Nodes(grid, xi, sections, sections.reach)
        problem = problem_of(scene, jnp.zeros(len(scene.actuators), grid.h.dtype), grid)
        basis, unknown = self._at_nodes(scene, problem), prescribed_loaded.start(state, problem)
        carried = prescribed_loaded.state_of(unknown, basis, problem).carried
        return Nodes(grid, xi, sections, carried.shares)

    def strain(
        self, scene: Scene, forces: Forces, state: Array, X: Float[Array, " stations"]
    ) -> Vector:
        return self._strain(scene, state, X)

    def _strain(self, scene: Scene, state: Array, X: Float[Array, " stations"]) -> Vector:
        def at(x: Scalar) -> Vector:
            return c.add(c.split(basis_at(scene, self.basis, x) @ state), scene.rod.rest(x))

        return jax.vmap(at)(X)


def stiffness_matrix(
    scene: Scene, basis: AbstractBasis, *, points: int = 32
) -> Float[Array, "dofs dofs"]:
    r"""Generalised stiffness (eq. 18): $K = \int_0^L B_q^T \Sigma B_q \, dX$.

    **Arguments:** `points`: Gauss points on each smooth piece of the arm.

    **Returns:** symmetric matrix, shape (n, n), positive definite if the basis is linearly
    independent.
    """
    return project(scene, basis, points).elastic_stiffness()


def actuation_matrix(
    scene: Scene, basis: AbstractBasis, q: VectorLike, *, points: int = 32
) -> Float[Array, "dofs threads"]:
    r"""Generalised actuation matrix (eq. 18): $B(q) = \int_0^L B_q^T B_\tau(q) \, dX$, the
    transpose of $\partial l / \partial q$.

    **Arguments:**
    - `q`: coordinates, shape (n,).
    - `points`: Gauss points on each smooth piece of the arm.

    **Returns:** shape (n, threads).
    """
    q, projection = real(q), project(scene, basis, points)
    xi = projection.strain(q)
    ones = tuple(jnp.ones((), q.dtype) for _ in scene.actuators)
    sections = projection.sections
    columns = []
    for path, share in zip(sections.paths, sections.carry(ones), strict=True):
        columns.append(projection.integrate(c.scale(share, unit_wrench(xi, path))))
    return jnp.stack(columns, axis=1) if columns else jnp.zeros((q.size, 0), q.dtype)


def jacobian(
    scene: Scene,
    basis: AbstractBasis,
    q: VectorLike,
    X: ScalarLike | None = None,
    *,
    steps: int = 32,
    order: int = 6,
) -> Float[Array, "6 dofs"]:
    r"""Geometric Jacobian (eq. 15): $J(q, X) = \mathrm{Ad}_g^{-1} \int_0^X \mathrm{Ad}_g B_q \,
    ds$.

    The body twist of the section at X is $\eta = J \dot q$. J is the exact derivative of the pose
    steps and has their order.

    **Arguments:**
    - `q`: coordinates, shape (n,).
    - `X`: abscissa [m], the tip by default.
    - `steps`, `order`: steps on [0, X] and their order.

    **Returns:** shape (6, n), angular part first; NaN for a traced X beyond the arm.

    **Raises:** `ValueError` for X beyond the arm.
    """
    length = scene.rod.length
    on_arm("X", length if X is None else X, length)
    end, near = onto(
        length if X is None else jnp.asarray(X, length.dtype), 0.0, length, ROUNDING * length
    )
    edges = jnp.minimum(scene.edges(basis.breakpoints(length)), end)
    grid = make_grid(edges, steps, choice("order", order, ORDERS) // 2)
    nodes = grid.X.T.reshape(-1)
    matrix = jax.vmap(lambda x: basis_at(scene, basis, x))(nodes)
    xi = matrix @ real(q) + c.join(scene.sections(nodes).rest)
    shape = grid.X.T.shape
    J = accumulate_jacobian(xi.reshape(*shape, 6), matrix.reshape(*shape, 6, -1), grid.h)
    return jnp.where(near, J, jnp.nan)
