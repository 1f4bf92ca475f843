r"""The loaded model in a prescribed basis: $K q = B(q) \tau + \int B_q^T \Lambda \, dX$, with given thread lengths and friction.

The load term is the virtual work of the loads, integrated by parts: one pass of rotations up the arm and one of wrenches
down it (see `reaction`), no assembled Jacobian. Unknown are the coordinates and the tension of each tendon driven by its
length; the tangent is taken by forward differentiation of the residual.
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from . import component as c, lu
from .balance import residual
from .cable import path_length
from .component import Vector
from .coupled import Kind, Problem, harmless, pull_of, rounding_of, with_tensions
from .friction import rubbed, turning_rate
from .implicit import change_of, no_derivative
from .newton import LOAD_SHARES, Damped, Solution, damped_newton
from .reaction import react
from .scene import shared


class Unknown(NamedTuple):
    """Coordinates, and tension [N] of each cable."""

    q: Float[Array, " dofs"]
    tension: Float[Array, " cables"]


class Basis(NamedTuple):
    r"""The basis at the nodes, $B_q$, shape (stages, steps, 6, n), and its change along the arm (None without friction)."""

    matrix: Array
    rate: Array | None


def strain(q: Array, basis: Basis, problem: Problem) -> Vector:
    r"""Strain at the nodes, $\xi = B_q q + \xi^*$."""
    return c.add(c.split(basis.matrix @ q), problem.sections.rest)


def shares(xi: Vector, q: Array, basis: Basis, problem: Problem, kind: Kind) -> tuple[Array | None, ...]:
    """Share of each thread's force at the nodes."""
    shares = list(problem.sections.reach)
    if problem.rubbing is None or basis.rate is None:
        return tuple(shares)
    rate = problem.rubbing.sections_rate
    xi_rate = c.add(c.split(basis.rate @ q), rate.rest)
    for place, mu in zip(kind.rubbing, problem.rubbing.coefficients, strict=True):
        shares[place] = rubbed(shares[place], turning_rate(xi, xi_rate, problem.sections, rate, place), mu, problem.grid)
    return tuple(shares)


def imbalance(unknown: Unknown, basis: Basis, problem: Problem, kind: Kind) -> Unknown:
    """Residual: generalised force, and for each cable the lesser of tension and scaled slack [N]."""
    grid, xi = problem.grid, strain(unknown.q, basis, problem)
    share = shares(xi, unknown.q, basis, problem, kind)
    forces = with_tensions(problem.forces, unknown.tension, kind)
    tau = shared(forces, share)
    wrench = None if problem.loads is None else react(xi, grid, problem.loads).wrench
    r = c.join(residual(xi, problem.sections, tau, wrench))
    force = jnp.einsum("ij,ijca,ijc->a", grid.weight, basis.matrix, r)
    rows = []
    for place, cable, tension in zip(kind.cables, problem.cables, unknown.tension, strict=True):
        slack = cable.slack(tension, path_length(xi, problem.sections, place, grid), share[place], grid)
        rows.append(cable.complementarity(tension, slack))
    return Unknown(force, jnp.stack(rows) if rows else unknown.tension)


class Measure(NamedTuple):
    """Sizes of changes of the coordinates: `gram` G with $q^T G q$ the mean square of a change's `shape_size`, and $K^{-1}$."""

    gram: Float[Array, "dofs dofs"]
    compliance: Float[Array, "dofs dofs"]

    def of_change(self, q: Float[Array, " dofs"]) -> Array:
        """Root of the mean square along the arm."""
        return jnp.sqrt(jnp.maximum(q @ self.gram @ q, 0.0))

    def of_force(self, force: Float[Array, " dofs"]) -> Array:
        """Size of the change that a generalised force makes of an arm at rest."""
        return self.of_change(self.compliance @ force)


def measure(matrix: Array, weight: Array, K: Float[Array, "dofs dofs"]) -> Measure:
    """The `Measure` of a basis, from its matrix (points, 6, n) and the weight [m] of each point."""
    length = jnp.sum(weight)
    sizes = jnp.concatenate([jnp.full(3, length), jnp.ones(3, length.dtype)])
    scaled = sizes[:, None] * matrix
    return Measure(jnp.einsum("x,xia,xib->ab", weight / length, scaled, scaled), lu.inverse(K))


@partial(jax.custom_jvp, nondiff_argnums=(2,))
def solve_prescribed(basis: Basis, problem: Problem, kind: Kind) -> Solution:
    """Equilibrium in the basis, by damped Newton steps from rest. Derivatives are implicit, of any order."""
    sections, weight = problem.sections, problem.grid.weight
    K = jnp.einsum("ij,ijca,cij,ijcb->ab", weight, basis.matrix, jnp.stack(jnp.broadcast_arrays(*sections.stiffness)), basis.matrix)
    size, length = K.shape[0], jnp.sum(problem.grid.h)
    sizes = measure(basis.matrix.reshape(-1, 6, size), weight.reshape(-1), K)
    axial = jnp.max(sections.stiffness[3])
    pulls = jnp.stack([jnp.max(pull_of(sections, place, length)) for place in kind.cables]) if kind.cables else jnp.zeros(0, K.dtype)

    def evaluate(unknown: Unknown, damping: Array, share: Array) -> Damped:
        part = problem.with_share(share)
        r = imbalance(unknown, basis, part, kind)
        J = _jacobian(unknown, basis, part, kind)
        factors = lu.factor(J.at[:size, :size].add(damping * K))
        flat = lu.substitute(factors, jnp.concatenate(r))
        step = Unknown(flat[:size], flat[size:])
        definite = jnp.all(jnp.diag(factors)[:size] > 0)
        moved = sizes.of_change(step.q) + jnp.sum(pulls * jnp.abs(step.tension))
        jax.debug.print("d {d} share {s} size {m} merit {r} def {e}", d=damping, s=share, m=moved, r=jnp.sqrt(sizes.of_force(r.q) ** 2 + jnp.sum((r.tension / axial) ** 2)), e=definite)
        return Damped(step, moved, r.q, jnp.sqrt(sizes.of_force(r.q) ** 2 + jnp.sum((r.tension / axial) ** 2)), definite)

    def work(force: Array, step: Unknown) -> Array:
        return jnp.dot(force, step.q)

    start = Unknown(jnp.zeros_like(K[0]), jnp.zeros(len(kind.cables), K.dtype))
    return damped_newton(evaluate, work, start, rounding_of(problem), 1 if problem.loads is None else LOAD_SHARES)


def _jacobian(unknown: Unknown, basis: Basis, problem: Problem, kind: Kind) -> Array:
    """Derivative of the residual by the coordinates and the tensions."""
    size = unknown.q.size

    def flat(z: Array) -> Array:
        return jnp.concatenate(imbalance(Unknown(z[:size], z[size:]), basis, problem, kind))

    return jax.jacfwd(flat)(jnp.concatenate(unknown))


@partial(solve_prescribed.defjvp, symbolic_zeros=True)
def _solve_prescribed_jvp(kind: Kind, primals: tuple, tangents: tuple) -> tuple[Solution, Solution]:
    solution = solve_prescribed(*primals, kind)
    sound = solution.balanced & solution.definite
    unknown = Unknown(*(jnp.where(sound, x, 0.0) for x in solution.unknown))

    def residual_of(basis: Basis, problem: Problem) -> Array:
        return jnp.concatenate(imbalance(unknown, basis, harmless(problem, sound), kind))

    change = change_of(residual_of, primals, tangents)
    J = _jacobian(unknown, primals[0], harmless(primals[1], sound), kind)
    flat, size = -lu.solve(J, change), unknown.q.size
    return solution, Solution(Unknown(flat[:size], flat[size:]), *no_derivative(*solution[1:]))
