r"""The Galerkin balance in a prescribed basis: $K q = B(q) \tau + \int B_q^T \Lambda \, dX$, with
couplings.

The load term is the virtual work of the loads, integrated by parts: one pass of rotations to the
tip and one of wrenches to the base (see `reaction`), without assembling a Jacobian. The unknowns
are the coordinates and those of the couplings that do not follow from the strain and its derivative
along the arm, which the basis gives. The tangent is the derivative of the discrete residual, in
single precision for the steps of Newton's method, where unknowns that follow are held.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PyTree

from ..mechanics.arm_balance import rounding_of, state_of as arm_state_of
from ..mechanics.arm_solve import schedule_of
from ..mechanics.balance import ALL, residual, without_force
from ..mechanics.coupling import ArmProblem, ArmState, borders_of
from ..numerics import component as c, lu
from ..numerics.batching import arms_in, iterated, side_by_side
from ..numerics.component import Vector
from ..numerics.damped_newton import MAX_TURN, Damped, Measures, Stage, damped_newton
from ..numerics.implicit import implicit_root
from ..numerics.newton import Root
from ..numerics.quadrature import Grid
from ..numerics.stacked import components
from ..typing import Shape

_ASYMMETRIC = 0.2
"""Asymmetry of two coordinates of the tangent, as a fraction of their elastic stiffness, above
which its pivots may miss a pair of negative eigenvalues."""


class GalerkinUnknown(NamedTuple):
    """Coordinates, and the unknowns of each coupling, one array; None where they follow from the
    coordinates."""

    q: Float[Array, "dofs *arms"]
    coupled: tuple[Array | None, ...]


class NodalBasis(NamedTuple):
    r"""The basis at the nodes, $B_q$, shape (stages, steps, 6, n), and its derivative along the
    arm, None where no coupling needs it."""

    matrix: Array
    rate: Array | None


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


def _idle(basis: NodalBasis, problem: ArmProblem) -> Array | None:
    """1 for coordinates of rigid pieces alone, which stay zero, and 0 for the others, shape (n,
    *arms); None without rigid pieces."""
    if problem.sections.flexible is None:
        return None
    return jnp.all(basis.matrix == 0, axis=(0, 1, 2)).astype(basis.matrix.dtype)


def _regular(K: Array, idle: Array | None) -> Array:
    """A stiffness matrix (n, n, *arms) with ones for idle coordinates."""
    if idle is None:
        return K
    unit = jnp.eye(K.shape[0], dtype=K.dtype).reshape(*K.shape[:2], *(1,) * (K.ndim - 2))
    return K + unit * idle


def start(q: Array, problem: ArmProblem) -> GalerkinUnknown:
    """Coordinates, and couplings that exert no force."""
    none = without_force(problem.forces)
    coupled = tuple(
        None if coupling.follows_rate else coupling.guess(none, problem.grid)
        for coupling in problem.couplings
    )
    return GalerkinUnknown(q, coupled)


def coupled_of(
    unknown: GalerkinUnknown, basis: NodalBasis, problem: ArmProblem
) -> tuple[PyTree, ...]:
    """Unknowns of all couplings."""
    if basis.rate is None:
        return unknown.coupled
    xi = strain(unknown.q, basis, problem)

    rate = _combined(basis.rate, unknown.q)
    return tuple(
        coupling.from_rate(xi, rate, problem.sections) if x is None else x
        for coupling, x in zip(problem.couplings, unknown.coupled, strict=True)
    )


def state_of(unknown: GalerkinUnknown, basis: NodalBasis, problem: ArmProblem) -> ArmState:
    """Quantities computed from the unknowns."""
    xi = strain(unknown.q, basis, problem)
    return arm_state_of(xi, coupled_of(unknown, basis, problem), problem)


def imbalance(
    unknown: GalerkinUnknown, at: ArmState, basis: NodalBasis, problem: ArmProblem
) -> GalerkinUnknown:
    """Residual: generalised force, and the rows of the couplings with unknowns."""
    rows = tuple(
        None if x is None else coupling.residual(x, at, note, problem, ALL)
        for coupling, x, note in zip(problem.couplings, unknown.coupled, at.notes, strict=True)
    )
    force = _projected(basis.matrix, _wrench(at, problem), problem.grid)
    idle = _idle(basis, problem)
    return GalerkinUnknown(force if idle is None else force + idle * unknown.q, rows)


def _wrench(at: ArmState, problem: ArmProblem) -> Vector:
    """Residual of the cross-sections."""
    wrench = None if at.along is None else components(at.along.wrench)
    return residual(at.xi, problem.sections, at.tau, wrench)


def approximate_tangent(
    unknown: GalerkinUnknown, at: ArmState, basis: NodalBasis, problem: ArmProblem
) -> Array:
    """Derivative of the residual without that of the unknowns that follow from the coordinates, in
    single precision."""
    unknown, at, basis, problem = c.single((unknown, at, basis, problem))
    grid, matrix, behind = problem.grid, basis.matrix, problem.grid.h.ndim - 1
    coupled = coupled_of(unknown, basis, problem)

    def wrench(xi: Vector) -> Vector:
        return _wrench(arm_state_of(xi, coupled, problem), problem)

    _, change_of = jax.linearize(wrench, at.xi)
    shape = (*at.xi[0].shape[:2], matrix.shape[3], *at.xi[0].shape[2:])
    columns = tuple(jnp.broadcast_to(matrix[:, :, i], shape) for i in range(6))
    change = jax.vmap(change_of, 2, 2)(columns)
    K = _regular(_gathered(matrix, change, grid), _idle(basis, problem))
    _, border = borders_of(problem, unknown.coupled, at)
    if border is None:
        return K
    size = len(border.factors)
    unit = jnp.eye(size, dtype=K.dtype).reshape(size, size, *(1,) * behind)
    project = jax.vmap(lambda wrench: _projected(matrix, wrench, grid))
    by_q = border.factors[:, None] * project(border.rows)
    pulls = jnp.moveaxis(project(border.columns), 0, 1)
    corner = jnp.broadcast_to(unit * border.corner, (size, size, *pulls.shape[2:]))
    return jnp.concatenate(
        [
            jnp.concatenate([K, pulls], axis=1),
            jnp.concatenate([by_q, corner], axis=1),
        ]
    )


class _Sizes(NamedTuple):
    """Dimensionless sizes of changes and residuals.

    - `gram`: G, where $q^T G q$ is the mean square of `shape_size` along the arm.
    - `factors`: of K.
    """

    gram: Float[Array, "dofs dofs *arms"]
    factors: Float[Array, "dofs dofs *arms"]
    problem: ArmProblem

    def turn(self, q: Array) -> Array:
        """Root mean square of the change of shape along the arm."""
        return jnp.sqrt(jnp.maximum(jnp.sum(q * jnp.sum(self.gram * q, axis=1), axis=0), 0.0))

    def of_step(self, step: GalerkinUnknown, at: ArmState) -> Array:
        """Size of a change of the unknowns."""
        moved = self.turn(step.q)
        for coupling, x in zip(self.problem.couplings, step.coupled, strict=True):
            if x is not None:
                for size in coupling.sizes(x, at, self.problem):
                    moved = moved + jnp.max(jnp.abs(size), axis=self._inner(size))
        return moved

    def of_imbalance(self, r: GalerkinUnknown, at: ArmState) -> Array:
        """Size of the change of an arm at rest under a residual."""
        square = self.turn(lu.substitute(self.factors, r.q)) ** 2
        for coupling, rows in zip(self.problem.couplings, r.coupled, strict=True):
            if rows is not None:
                for size in coupling.row_sizes(rows, at, self.problem):
                    square = square + jnp.sum(size**2, axis=self._inner(size))
        return jnp.sqrt(square)

    def _inner(self, x: Array) -> tuple[int, ...]:
        """The axes in front of those of the arms."""
        return tuple(range(x.ndim - self.problem.grid.h.ndim + 1))


def _sizes_of(basis: NodalBasis, K: Array, problem: ArmProblem) -> _Sizes:
    length = problem.length
    gram = [
        w * jnp.einsum("ija...,ijb...,ij...->ab...", m, m, problem.grid.weight / length)
        for m, w in _by_strain(basis.matrix, length)
    ]
    return _Sizes(sum(gram[1:], gram[0]), lu.factor(K), problem)


def _by_strain(matrix: Array, length: Array) -> list[tuple[Array, Array | float]]:
    return [(matrix[:, :, i], length**2 if i < 3 else 1.0) for i in range(6)]


def solve_prescribed(basis: NodalBasis, problem: ArmProblem) -> Root:
    """Equilibrium in the basis, by damped Newton steps from rest; its point is a `GalerkinUnknown`.

    Derivatives are implicit, of any order, in forward and reverse mode.
    """

    def row(unknown: GalerkinUnknown, basis: NodalBasis, problem: ArmProblem) -> Array:
        """Residual as one vector."""
        return _row(imbalance(unknown, state_of(unknown, basis, problem), basis, problem))

    def linear_solve(
        unknown: GalerkinUnknown, basis: NodalBasis, problem: ArmProblem, right: Array
    ) -> GalerkinUnknown:
        J = jax.jacfwd(lambda z: row(_split(z, unknown), basis, problem))(_row(unknown))
        return _split(lu.solve(J, right), unknown)

    def at_rest(unknown: GalerkinUnknown, basis: NodalBasis, problem: ArmProblem) -> tuple:
        return jax.tree.map(jnp.zeros_like, unknown), basis, problem.at_rest()

    return implicit_root(side_by_side(_solve), row, linear_solve, at_rest, basis, problem)


def _row(unknown: GalerkinUnknown) -> Array:
    """Unknowns or rows in one axis."""
    return jnp.concatenate(jax.tree.leaves(unknown))


def _split(z: Array, like: GalerkinUnknown) -> GalerkinUnknown:
    """The inverse of `_row`."""
    leaves, tree = jax.tree.flatten(like)
    parts, first = [], 0
    for leaf in leaves:
        parts.append(z[first : first + len(leaf)])
        first += len(leaf)
    return jax.tree.unflatten(tree, parts)


def _solve(basis: NodalBasis, problem: ArmProblem) -> Root:
    stiffness = problem.sections.stiffness
    behind = problem.grid.h.ndim - 1
    arms = arms_in((basis, problem), behind)
    columns = tuple(basis.matrix[:, :, i] for i in range(6))
    strained = tuple(
        jnp.expand_dims(s, s.ndim - behind) * column
        for s, column in zip(stiffness, columns, strict=True)
    )
    K = _regular(_gathered(basis.matrix, strained, problem.grid), _idle(basis, problem))
    sizes = _sizes_of(basis, K, problem)
    size = K.shape[0]
    elastic, schedule = c.single(lu.diagonal(K)), schedule_of(problem)

    def evaluate(unknown: GalerkinUnknown, damping: Array, stage: Stage) -> Damped:
        part = problem.with_share(stage.share)
        at = state_of(unknown, basis, part)
        r = imbalance(unknown, at, basis, part)
        J = approximate_tangent(unknown, at, basis, part)
        factors = lu.factor(J.at[:size, :size].add((damping * K).astype(J.dtype)))
        step = _split(lu.substitute(factors, _row(c.single(r))).astype(K.dtype), unknown)
        turn = sizes.turn(step.q)
        cut = MAX_TURN / jnp.maximum(turn, MAX_TURN)
        return Damped(
            jax.tree.map(lambda x: cut * x, step),
            sizes.of_step(step, at),
            r.q,
            sizes.of_imbalance(r, at),
            *_definiteness(factors, J, elastic),
        )

    def work(force: Array, step: GalerkinUnknown) -> Array:
        return jnp.sum(force * step.q, axis=0)

    def turn(step: GalerkinUnknown) -> Array:
        return sizes.turn(step.q)

    def dot(one: GalerkinUnknown, other: GalerkinUnknown) -> Array:
        return jnp.sum(elastic * c.single(one.q) * c.single(other.q), axis=0)

    first = start(jnp.zeros((size, *arms), K.dtype), problem)
    first = jax.tree.map(lambda x: jnp.broadcast_to(x, (len(x), *arms)), first)
    floor = jnp.broadcast_to(rounding_of(problem), arms)
    stirs = jax.tree.map(jnp.zeros_like, first)._replace(q=_stirs(K, arms))
    measures = Measures(work, turn, stirs, dot if problem.follows_rate else None)
    return iterated(damped_newton(evaluate, measures, first, floor, schedule))


def _stirs(K: Array, arms: Shape) -> Array:
    """A step of all coordinates, in no symmetric way."""
    some = jnp.cos(jnp.arange(len(K), dtype=K.dtype)).reshape(-1, *(1,) * len(arms))
    return some * jnp.sqrt(K[0, 0] / lu.diagonal(K))


def _definiteness(factors: Array, J: Array, elastic: Array) -> tuple[Array, Array]:
    """Whether the tangent is positive definite for the changes of shape that the couplings allow,
    and whether that is doubtful."""
    size = len(elastic)
    # couplings prevent as many unstable motions as their own rows have negative pivots
    falling = lu.diagonal(factors) <= 0
    unlike = jnp.sum(falling[:size], axis=0) - jnp.sum(falling[size:], axis=0)
    doubtful = _doubtful(J[:size, :size], elastic)
    # a pair of negative pivots means nothing if the tangent is far from symmetric
    return (unlike == 0) | (doubtful & (unlike % 2 == 0)), doubtful


def _doubtful(J: Array, elastic: Array) -> Array:
    """Whether the tangent is so asymmetric that its pivots may miss unstable motions."""
    apart = jnp.abs(J - J.swapaxes(0, 1)) > _ASYMMETRIC * jnp.sqrt(elastic[:, None] * elastic[None])
    return jnp.any(apart, axis=(0, 1))
