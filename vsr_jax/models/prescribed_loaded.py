r"""The Galerkin balance in a prescribed basis: $K q = B(q) \tau + \int B_q^T \Lambda \, dX$, with
prescribed thread lengths and friction.

The load term is the virtual work of the loads, integrated by parts: one pass of rotations to the
tip and one of wrenches to the base (see `reaction`), without assembling a Jacobian. The unknowns
are the coordinates and the tension of each tendon with prescribed length. Newton's method uses the
tangent $\int B_q^T (H B_q - \delta\Lambda) dX$ in single precision; derivatives of the solution use
the exact tangent of the discrete residual, by forward differentiation.
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..arm.scene import shared
from ..mechanics.arm_balance import ArmProblem, Kind, pull_of, rounding_of, with_tensions
from ..mechanics.balance import (
    largest_force_scale,
    residual,
    tangent,
    thread_direction,
    thread_wrench,
)
from ..mechanics.cable import path_length
from ..mechanics.friction import kinks_of, share_left, turning_rate
from ..mechanics.reaction import Reaction, react, reaction_change, slopes_of
from ..numerics import component as c, lu
from ..numerics.batching import arms_in, side_by_side
from ..numerics.component import Forces, Vector
from ..numerics.implicit import implicit_root
from ..numerics.newton import LOAD_INCREMENTS, MAX_TURN, Damped, Measures, Root, damped_newton
from ..numerics.quadrature import Grid
from ..numerics.stacked import components, stack

_ASYMMETRIC = 0.2
"""Asymmetry of two coordinates of the tangent, as a fraction of their elastic stiffness, above
which its pivots may miss a pair of negative eigenvalues."""


class GalerkinUnknown(NamedTuple):
    """Coordinates, and tension [N] of each cable."""

    q: Float[Array, "dofs *arms"]
    tension: Float[Array, "cables *arms"]


class NodalBasis(NamedTuple):
    r"""The basis at the nodes, $B_q$, shape (stages, steps, 6, n), and its derivative along the arm
    (None without friction)."""

    matrix: Array
    rate: Array | None


class GalerkinState(NamedTuple):
    """Quantities computed from the unknowns: strain at the nodes, share of each thread's force
    there, its force, the reaction, and the slack of each cable [m]."""

    xi: Vector
    shares: tuple[Array | None, ...]
    tau: Forces
    along: Reaction | None
    slack: Vector


def strain(q: Array, basis: NodalBasis, problem: ArmProblem) -> Vector:
    r"""Strain at the nodes, $\xi = B_q q + \xi^*$."""
    return c.add(_combined(basis.matrix, q), problem.sections.rest)


def _combined(matrix: Array, q: Array) -> Vector:
    """$B_q q$, six component arrays at the nodes."""
    return tuple(jnp.einsum("cija...,a...->cij...", jnp.moveaxis(matrix, 2, 0), q))


def _projected(matrix: Array, wrench: Vector, grid: Grid) -> Array:
    r"""Generalised force $\int B_q^T F \, dX$."""
    weighted = jnp.stack([grid.weight * f for f in jnp.broadcast_arrays(*wrench)])
    return jnp.einsum("ijca...,cij...->a...", matrix, weighted)


def _gathered(matrix: Array, wrenches: Vector, grid: Grid) -> Array:
    r"""Generalised forces, in columns, of wrenches stacked in an axis behind those of the nodes."""
    weighted = jnp.stack(
        [jnp.expand_dims(grid.weight, 2) * f for f in jnp.broadcast_arrays(*wrenches)]
    )
    return jnp.einsum("ijca...,cijb...->ab...", matrix, weighted)


def shares(
    xi: Vector, q: Array, basis: NodalBasis, problem: ArmProblem, kind: Kind
) -> tuple[Array | None, ...]:
    """Share of each thread's force at the nodes."""
    shares = list(problem.sections.reach)
    if problem.friction is None or basis.rate is None:
        return tuple(shares)
    rate = problem.friction.sections_rate
    xi_rate = c.add(_combined(basis.rate, q), rate.rest)
    for place, mu in zip(kind.frictional, problem.friction.coefficients, strict=True):
        kinks = kinks_of(xi, problem.sections, problem.friction.breaks, place, problem.grid)
        turning = turning_rate(xi, xi_rate, problem.sections, rate, place)
        shares[place] = share_left(shares[place], turning, kinks, mu, problem.grid)
    return tuple(shares)


def state_of(
    unknown: GalerkinUnknown, basis: NodalBasis, problem: ArmProblem, kind: Kind
) -> GalerkinState:
    """Quantities computed from the unknowns."""
    grid, xi = problem.grid, strain(unknown.q, basis, problem)
    share = shares(xi, unknown.q, basis, problem, kind)
    tau = shared(with_tensions(problem.forces, unknown.tension, kind), share)
    along = None if problem.loads is None else react(xi, grid, problem.loads)
    slack = tuple(
        cable.slack(tension, path_length(xi, problem.sections, place, grid), share[place], grid)
        for place, cable, tension in zip(kind.cables, problem.cables, unknown.tension, strict=True)
    )
    return GalerkinState(xi, share, tau, along, slack)


def imbalance(
    unknown: GalerkinUnknown, at: GalerkinState, basis: NodalBasis, problem: ArmProblem
) -> GalerkinUnknown:
    """Residual: generalised force, and for each cable the smaller of tension and scaled slack
    [N]."""
    wrench = None if at.along is None else components(at.along.wrench)
    r = residual(at.xi, problem.sections, at.tau, wrench)
    rows = [
        cable.complementarity(tension, slack)
        for cable, tension, slack in zip(problem.cables, unknown.tension, at.slack, strict=True)
    ]
    return GalerkinUnknown(
        _projected(basis.matrix, r, problem.grid), jnp.stack(rows) if rows else unknown.tension
    )


def approximate_tangent(
    unknown: GalerkinUnknown, at: GalerkinState, basis: NodalBasis, problem: ArmProblem, kind: Kind
) -> Array:
    """Derivative of the residual without the tangent of friction, to the order of the quadrature
    and in single precision."""
    unknown, at, basis, problem = c.single((unknown, at, basis, problem))
    sections, grid, matrix = problem.sections, problem.grid, basis.matrix
    columns = tuple(
        matrix[:, :, i] for i in range(6)
    )  # with the coordinates in an axis behind those of the nodes
    behind = grid.h.ndim - 1

    def beside(tree: c.Tree) -> c.Tree:
        return jax.tree.map(lambda x: jnp.expand_dims(x, x.ndim - behind), tree)

    change = c.matvec(c.symmetric(beside(tangent(at.xi, sections, at.tau))), columns)
    if at.along is not None and problem.loads is not None:
        slopes = slopes_of(at.along, problem.loads)
        moved = reaction_change(stack(columns), *beside((at.along, slopes, grid)))
        change = c.subtract(change, components(moved))
    K = _gathered(matrix, change, grid)
    if not kind.cables:
        return K
    units = [
        thread_wrench(thread_direction(at.xi, sections.paths[i])[0], sections.paths[i])
        for i in kind.cables
    ]
    pulls = [
        _projected(matrix, c.times(at.shares[i], unit), grid)
        for i, unit in zip(kind.cables, units, strict=True)
    ]
    lengths = [
        _projected(matrix, c.times(sections.reach[i], unit), grid)
        for i, unit in zip(kind.cables, units, strict=True)
    ]
    rows = []
    for i, (place, cable, tension, slack) in enumerate(
        zip(kind.cables, problem.cables, unknown.tension, at.slack, strict=True)
    ):
        loose, unit = (
            tension < cable.scale * slack,
            (jnp.arange(len(units)) == i).astype(K.dtype).reshape(-1, *(1,) * behind),
        )
        by_q = jnp.where(loose, 0.0, -cable.scale * lengths[i])
        by_tension = unit * jnp.where(
            loose, 1.0, cable.scale * cable.stretch(at.shares[place], grid)
        )
        rows.append(jnp.concatenate([by_q, by_tension]))
    return jnp.concatenate(
        [jnp.concatenate([K, jnp.stack(pulls, axis=1)], axis=1), jnp.stack(rows)]
    )


class _Sizes(NamedTuple):
    """Dimensionless sizes of changes and residuals.

    - `gram`: G, where $q^T G q$ is the mean square of `shape_size` along the arm.
    - `factors`: of K.
    - `pulls`: `pull_of` each cable [1/N].
    - `axial`: stiffness [N] that scales the residual of cables.
    """

    gram: Float[Array, "dofs dofs *arms"]
    factors: Float[Array, "dofs dofs *arms"]
    pulls: Float[Array, "cables *arms"]
    axial: Array

    def turn(self, q: Array) -> Array:
        """Root mean square of the change of shape along the arm."""
        return jnp.sqrt(jnp.maximum(jnp.sum(q * jnp.sum(self.gram * q, axis=1), axis=0), 0.0))

    def of_step(self, step: GalerkinUnknown) -> Array:
        """Size of a change of the unknowns."""
        return self.turn(step.q) + jnp.sum(self.pulls * jnp.abs(step.tension), axis=0)

    def of_imbalance(self, r: GalerkinUnknown) -> Array:
        """Size of the change of an arm at rest under a residual."""
        square = self.turn(lu.substitute(self.factors, r.q)) ** 2
        return jnp.sqrt(square + jnp.sum((r.tension / self.axial) ** 2, axis=0))


def _sizes_of(basis: NodalBasis, K: Array, problem: ArmProblem, kind: Kind) -> _Sizes:
    grid, sections = problem.grid, problem.sections
    length = jnp.sum(grid.h, axis=0)
    gram = [
        w * jnp.einsum("ija...,ijb...,ij...->ab...", m, m, grid.weight / length)
        for m, w in _by_strain(basis.matrix, length)
    ]
    pulls = [jnp.max(pull_of(sections, place, length), axis=(0, 1)) for place in kind.cables]
    return _Sizes(
        sum(gram[1:], gram[0]),
        lu.factor(K),
        jnp.stack(pulls) if pulls else jnp.zeros((0, *length.shape), K.dtype),
        largest_force_scale(sections.stiffness),
    )


def _by_strain(matrix: Array, length: Array) -> list[tuple[Array, Array | float]]:
    return [(matrix[:, :, i], length**2 if i < 3 else 1.0) for i in range(6)]


def solve_prescribed(basis: NodalBasis, problem: ArmProblem, kind: Kind) -> Root:
    """Equilibrium in the basis, by damped Newton steps from rest; its point is a `GalerkinUnknown`.

    Derivatives are implicit, of any order, in forward and reverse mode.
    """

    def row(unknown: GalerkinUnknown, basis: NodalBasis, problem: ArmProblem) -> Array:
        """Residual as one vector."""
        return jnp.concatenate(
            imbalance(unknown, state_of(unknown, basis, problem, kind), basis, problem)
        )

    def linear_solve(
        unknown: GalerkinUnknown, basis: NodalBasis, problem: ArmProblem, right: Array
    ) -> GalerkinUnknown:
        split = partial(_split, size=unknown.q.size)
        J = jax.jacfwd(lambda z: row(split(z), basis, problem))(jnp.concatenate(unknown))
        return split(lu.solve(J, right))

    def at_rest(unknown: GalerkinUnknown, basis: NodalBasis, problem: ArmProblem) -> tuple:
        return jax.tree.map(jnp.zeros_like, unknown), basis, problem.at_rest()

    find = side_by_side(partial(_solve, kind))
    return implicit_root(find, row, linear_solve, at_rest, basis, problem)


def _split(z: Array, size: int) -> GalerkinUnknown:
    """Coordinates and tensions from a row of both."""
    return GalerkinUnknown(z[:size], z[size:])


def _solve(kind: Kind, basis: NodalBasis, problem: ArmProblem) -> Root:
    stiffness = problem.sections.stiffness
    behind = problem.grid.h.ndim - 1
    arms = arms_in((basis, problem), behind)
    columns = tuple(basis.matrix[:, :, i] for i in range(6))
    strained = tuple(
        jnp.expand_dims(s, s.ndim - behind) * column
        for s, column in zip(stiffness, columns, strict=True)
    )
    K = _gathered(basis.matrix, strained, problem.grid)
    sizes = _sizes_of(basis, K, problem, kind)
    size = K.shape[0]
    elastic = c.single(lu.diagonal(K))

    def evaluate(unknown: GalerkinUnknown, damping: Array, share: Array) -> Damped:
        part = problem.with_share(share)
        at = state_of(unknown, basis, part, kind)
        r = imbalance(unknown, at, basis, part)
        J = approximate_tangent(unknown, at, basis, part, kind)
        factors = lu.factor(J.at[:size, :size].add((damping * K).astype(J.dtype)))
        step = _split(lu.substitute(factors, jnp.concatenate(c.single(r))).astype(K.dtype), size)
        turn = sizes.turn(step.q)
        moved = sizes.of_step(step)
        cut = MAX_TURN / jnp.maximum(turn, MAX_TURN)
        falling = (
            lu.diagonal(factors) <= 0
        )  # taut cables prevent as many unstable motions as their own rows have negative pivots
        definite = jnp.sum(falling[:size], axis=0) == jnp.sum(falling[size:], axis=0)
        size_of = jnp.sqrt(elastic[:, None] * elastic[None])
        apart = jnp.abs(J - J.swapaxes(0, 1))[:size, :size] > _ASYMMETRIC * size_of
        return Damped(
            jax.tree.map(lambda x: cut * x, step),
            moved,
            r.q,
            sizes.of_imbalance(r),
            definite,
            jnp.any(apart, axis=(0, 1)),
        )

    def work(force: Array, step: GalerkinUnknown) -> Array:
        return jnp.sum(force * step.q, axis=0)

    def turn(step: GalerkinUnknown) -> Array:
        return sizes.turn(step.q)

    start = GalerkinUnknown(
        jnp.zeros((size, *arms), K.dtype), jnp.zeros((len(kind.cables), *arms), K.dtype)
    )
    floor = jnp.broadcast_to(rounding_of(problem), arms)
    shares = 1 if problem.loads is None else LOAD_INCREMENTS
    return damped_newton(evaluate, Measures(work, turn), start, floor, shares)
