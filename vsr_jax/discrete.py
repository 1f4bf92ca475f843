r"""The model with a prescribed basis (eq. 14-18): $K q = B(q) \tau$ by Gauss quadrature and Newton's method."""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from . import component as c
from ._check import choice, count, instance
from ._types import Scalar
from .balance import forces_where, no_derivative, residual, rounding_floor, tangent, thread_direction, thread_wrench
from .basis import AbstractBasis
from .component import Vector
from .kinematics import ORDERS, accumulate_jacobian
from .model import Outcome, SteppedModel, classify
from .newton import Evaluation, newton
from .quadrature import make_grid
from .scene import CrossSections, Scene


class Projection(NamedTuple):
    """A basis and the cross-sections at the quadrature points: `weight` [m] of each, `matrix` $B_q$ (points, 6, n)."""

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
        """Generalised stiffness $\\int B_q^T H B_q \\, dX$ of a symmetric $H$ given by its lower triangle."""
        weighted = self.weight[:, None, None] * (c.join_matrix(c.symmetric(lower)) @ self.matrix)
        return jnp.einsum("xia,xib->ab", self.matrix, weighted)

    def elastic_stiffness(self) -> Float[Array, "dofs dofs"]:
        """$K = \\int B_q^T \\Sigma B_q \\, dX$."""
        weighted = (self.weight[:, None] * c.join(self.sections.stiffness))[..., None] * self.matrix
        return jnp.einsum("xia,xib->ab", self.matrix, weighted)


def project(scene: Scene, basis: AbstractBasis, points: int) -> Projection:
    """Basis and cross-sections at `points` Gauss points on each smooth piece of the arm."""
    length = scene.rod.length
    grid = make_grid(scene.edges(basis.breakpoints(length)), 1, points)
    X = grid.X.reshape(-1)
    matrix = jax.vmap(lambda x: basis.matrix(x, length))(X)
    return Projection(scene.sections(X), grid.weight.reshape(-1), matrix)


def _solve(matrix: Array, right: Array) -> Array:
    return jax.scipy.linalg.cho_solve((jnp.linalg.cholesky(matrix), True), right)


@jax.custom_jvp
def solve_projected(projection: Projection, tau: Vector) -> tuple[Float[Array, " dofs"], Array, Array, Array]:
    r"""Coordinates q with $K q = B(q) \tau$ (eq. 18), by Newton's method on the symmetric tangent $K - \partial (B \tau) / \partial q$.

    **Returns:** q, whether the residual is balanced, whether the tangent is positive definite, and the Newton steps.
    Derivatives of any order are implicit.
    """
    K = projection.elastic_stiffness()
    K_factor = jnp.linalg.cholesky(K)
    axial = jnp.sum(projection.weight * projection.sections.stiffness[3])

    def norm(force: Array) -> Array:
        return jnp.linalg.norm(jax.scipy.linalg.solve_triangular(K_factor, force, lower=True)) / jnp.sqrt(axial)

    def imbalance(q: Array) -> Array:
        return projection.integrate(residual(projection.strain(q), projection.sections, tau))

    def evaluate(q: Array) -> Evaluation:
        r = imbalance(q)
        step = _solve(projection.stiffness(tangent(projection.strain(q), projection.sections, tau)), r)
        definite = ~jnp.any(jnp.isnan(step))
        step = jnp.where(definite, step, jax.scipy.linalg.cho_solve((K_factor, True), r))
        return Evaluation(step, norm(K @ step), norm(r), definite)

    floor = jnp.max(rounding_floor(projection.sections.stiffness, tau)) * K.shape[0] ** 0.5
    q, definite, steps = newton(evaluate, jnp.zeros(K.shape[0], K.dtype), floor)
    return q, norm(imbalance(q)) <= 16 * floor, definite, steps


@solve_projected.defjvp
def _solve_projected_jvp(primals: tuple, tangents: tuple) -> tuple:
    projection, tau = primals
    q, balanced, definite, steps = solve_projected(projection, tau)
    sound = balanced & definite
    q_sound = jnp.where(sound, q, 0.0)

    def imbalance(projection: Projection, tau: Vector) -> Array:
        return projection.integrate(residual(projection.strain(q_sound), projection.sections, forces_where(sound, tau)))

    _, change = jax.jvp(imbalance, primals, tangents)
    H = projection.stiffness(tangent(projection.strain(q_sound), projection.sections, forces_where(sound, tau)))
    return (q, balanced, definite, steps), (-_solve(H, change), *no_derivative(balanced, definite, steps))


class Prescribed(SteppedModel):
    r"""Strain in a given basis, $\xi = B_q(X) q + \xi^*$, with $K q = B(q) \tau$ (eq. 18).

    **Arguments:**
    - `basis`: an `AbstractBasis`, such as `Basis.uniform(Legendre(4))`.
    - `points`: Gauss points of the quadrature of $K$ and $B(q)$ on each smooth piece of the arm.
    - `steps`, `order`: pose steps as for `StrainDependent`.
    """

    basis: AbstractBasis
    points: int = eqx.field(static=True)
    steps: int = eqx.field(static=True)
    order: int = eqx.field(static=True)

    def __init__(self, basis: AbstractBasis, points: int = 32, steps: int = 32, order: int = 6):
        self.basis = instance("Prescribed.basis", basis, AbstractBasis, "a basis such as Basis.uniform(Legendre(4))")
        self.points = count("Prescribed.points", points)
        self.steps = count("Prescribed.steps", steps)
        self.order = choice("Prescribed.order", order, ORDERS)

    def breakpoints(self, scene: Scene) -> tuple[Array, ...]:
        return self.basis.breakpoints(scene.rod.length)

    def solve(self, scene: Scene, inputs: Float[Array, " inputs"]) -> Outcome:
        projection = project(scene, self.basis, self.points)
        tau = scene.forces(inputs)
        q, balanced, definite, steps = solve_projected(projection, tau)
        status = classify(projection.strain(q), projection.sections, tau, balanced, definite)
        return Outcome(jnp.where(status == 0, q, 0.0), status, steps)

    def coordinates(self, scene: Scene, inputs: Float[Array, " inputs"], state: Array) -> Float[Array, " dofs"]:
        return state

    def node_strain(self, scene: Scene, inputs: Float[Array, " inputs"], state: Array) -> Vector:
        X = self.grid(scene).X
        return tuple(x.reshape(X.shape) for x in self.strain(scene, inputs, state, X.reshape(-1)))

    def strain(self, scene: Scene, inputs: Float[Array, " inputs"], state: Any, X: Float[Array, " stations"]) -> Vector:
        def at(x: Scalar) -> Vector:
            return c.add(c.split(self.basis.matrix(x, scene.rod.length) @ state), scene.rod.rest(x))

        return jax.vmap(at)(X)


def stiffness_matrix(scene: Scene, basis: AbstractBasis, *, points: int = 32) -> Float[Array, "dofs dofs"]:
    r"""Generalised stiffness (eq. 18): $K = \int_0^L B_q^T \Sigma B_q \, dX$.

    **Arguments:** `points`: Gauss points on each smooth piece of the arm.

    **Returns:** symmetric matrix, shape (n, n), positive definite if the basis is linearly independent.
    """
    return project(scene, basis, points).elastic_stiffness()


def actuation_matrix(scene: Scene, basis: AbstractBasis, q: Float[Array, " dofs"], *, points: int = 32) -> Float[Array, "dofs threads"]:
    r"""Generalised actuation matrix (eq. 18): $B(q) = \int_0^L B_q^T B_\tau(q) \, dX$, the transpose of $\partial l / \partial q$.

    **Arguments:**
    - `q`: coordinates, shape (n,).
    - `points`: Gauss points on each smooth piece of the arm.

    **Returns:** shape (n, threads).
    """
    projection = project(scene, basis, points)
    xi = projection.strain(q)
    columns = [projection.integrate(thread_wrench(thread_direction(xi, path)[0], path)) for path in projection.sections.paths]
    return jnp.stack(columns, axis=1)


def jacobian(
    scene: Scene, basis: AbstractBasis, q: Float[Array, " dofs"], X: Any = None, *, steps: int = 32, order: int = 6
) -> Float[Array, "6 dofs"]:
    r"""Geometric Jacobian (eq. 15): $J(q, X) = \mathrm{Ad}_g^{-1} \int_0^X \mathrm{Ad}_g B_q \, ds$.

    The body twist of the section at X is $\eta = J \dot q$. It is the exact derivative of the pose steps, hence of their order.

    **Arguments:**
    - `q`: coordinates, shape (n,).
    - `X`: abscissa [m], the tip by default.
    - `steps`, `order`: steps on [0, X] and their order.

    **Returns:** shape (6, n), angular part first.
    """
    length = scene.rod.length
    end = length if X is None else jnp.asarray(X, length.dtype)
    edges = jnp.minimum(scene.edges(basis.breakpoints(length)), end)
    grid = make_grid(edges, steps, choice("order", order, ORDERS) // 2)
    nodes = grid.X.T.reshape(-1)
    matrix = jax.vmap(lambda x: basis.matrix(x, length))(nodes)
    xi = matrix @ q + c.join(scene.sections(nodes).rest)
    shape = grid.X.T.shape
    return accumulate_jacobian(xi.reshape(*shape, 6), matrix.reshape(*shape, 6, -1), grid.h)
