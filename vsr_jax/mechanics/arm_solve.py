r"""Solution of the coupled balance (see `arm_balance`): damped Newton steps with a nearly exact
tangent, and implicit derivatives."""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array

from ..arm.scene import CrossSections
from ..numerics import component as c
from ..numerics.batching import arms_in, side_by_side
from ..numerics.component import Vector
from ..numerics.implicit import implicit_root
from ..numerics.newton import LOAD_INCREMENTS, MAX_TURN, Damped, Measures, Root, damped_newton
from ..numerics.quadrature import Grid
from ..typing import cast
from .arm_balance import (
    ArmImbalance,
    ArmProblem,
    ArmState,
    ArmUnknown,
    Kind,
    imbalance_of,
    pull_of,
    rounding_of,
    shape_of,
    shape_size,
    state_of,
    with_tensions,
)
from .arm_tangent import approximate_solve, tangent_solve
from .balance import (
    completed,
    free_components,
    largest_force_scale,
    residual,
    spread,
    strain_norm,
    with_locked,
)

_START_STEPS = 4
"""Fixed-point steps to the start: each gains a factor of the strains that threads cause."""


def solve_arm(problem: ArmProblem, kind: Kind, guess: ArmUnknown | None = None) -> Root:
    """Equilibrium of the arm; its point is an `ArmUnknown`. Newton's method starts from a guess, if
    one is given, else or where that fails from the balance without loads and with slack cables.

    Derivatives are implicit, of any order, in forward and reverse mode: the exact tangent system is
    solved by iterative refinement of `approximate_solve`.
    """

    def find(problem: ArmProblem, guess: ArmUnknown | None) -> Root:
        if guess is not None:  # the iteration does not change the locked strains
            guess = guess._replace(xi=with_locked(guess.xi, problem.sections.rest, kind.free))
        root = side_by_side(partial(_solve, kind))(_start(problem, kind), guess, problem)
        return root._replace(x=root.x._replace(xi=free_components(root.x.xi, kind.free)))

    def whole(x: ArmUnknown, problem: ArmProblem) -> ArmUnknown:
        return x._replace(xi=completed(x.xi, problem.sections.rest, kind.free))

    def imbalance(x: ArmUnknown, problem: ArmProblem, _: ArmUnknown | None) -> ArmImbalance:
        unknown = whole(x, problem)
        return imbalance_of(unknown, state_of(unknown, problem, kind), problem, kind)

    def linear_solve(
        x: ArmUnknown, problem: ArmProblem, guess: ArmUnknown | None, right: ArmImbalance
    ) -> ArmUnknown:
        _, apply = jax.linearize(lambda x: imbalance(x, problem, guess), x)
        return tangent_solve(apply, whole(x, problem), problem, right, kind)

    def at_rest(x: ArmUnknown, problem: ArmProblem, guess: ArmUnknown | None) -> tuple:
        zero = jax.tree.map(jnp.zeros_like, x)
        rest = free_components(problem.sections.rest, kind.free)
        return zero._replace(xi=rest), problem.at_rest(), guess

    root = implicit_root(find, imbalance, linear_solve, at_rest, problem, guess)
    return root._replace(x=whole(root.x, problem))


def _start(problem: ArmProblem, kind: Kind) -> ArmUnknown:
    r"""Nearly the balance of each section alone, without loads and friction and with slack cables:
    some fixed-point steps $\xi = \Sigma^{-1} B_\tau(\xi) \tau + \xi^*$, in single precision. The
    rest strain where they do not halve the residual, on average."""
    tension = (jnp.zeros_like(problem.grid.h[0]),) * len(kind.cables)
    tau = problem.sections.carry(with_tensions(problem.forces, tension, kind))
    sections, tau = c.single((problem.sections, tau))
    shape = problem.grid.X.shape
    rest = tuple(jnp.broadcast_to(x, shape) for x in sections.rest)

    def closer(i: Array, state: tuple) -> tuple:
        xi, first, _ = state
        off = spread(free_components(residual(xi, sections, tau), kind.free), kind.free)
        size = jnp.max(strain_norm(off, sections.stiffness))
        step = tuple(r / s for r, s in zip(off, sections.stiffness, strict=True))
        return c.subtract(xi, step), jnp.where(i == 0, size, first), size

    none = jnp.zeros((), rest[0].dtype)
    xi, first, last = lax.fori_loop(0, _START_STEPS, closer, (rest, none, none))
    near = last <= 0.5 ** (_START_STEPS - 1) * first
    xi = tuple(
        jnp.where(near, x, x0).astype(exact.dtype)
        for x, x0, exact in zip(xi, rest, problem.sections.rest, strict=True)
    )
    return ArmUnknown(
        with_locked(xi, problem.sections.rest, kind.free),
        tension,
        (jnp.zeros_like(problem.grid.X),) * len(kind.frictional),
    )


class _Sizes(NamedTuple):
    """Dimensionless sizes of steps and residuals, one entry per arm of a batch (see
    `shape_size`)."""

    grid: Grid
    sections: CrossSections
    kind: Kind
    arms: tuple[int, ...]

    @property
    def length(self) -> Array:
        return jnp.sum(self.grid.h, axis=0)

    def of_step(self, step: ArmUnknown, at: ArmState) -> Array:
        """Largest change of the shape, plus that by tensions and by friction."""
        step = cast(step, self.grid.h.dtype)
        tensions = [
            tension * pull_of(self.sections, place, self.length)
            for place, tension in zip(self.kind.cables, step.tension, strict=True)
        ]
        moved = self._largest(shape_size(step.xi, self.length))
        return sum((self._largest(x) for x in (*tensions, *self._rubbed(step.turning, at))), moved)

    def of_imbalance(self, imbalance: ArmImbalance, at: ArmState) -> Array:
        """Root mean square of all rows; that of a cable is its slack per length of the arm."""
        wrench = spread(imbalance.wrench, self.kind.free)
        bent = shape_of(wrench, self.sections.stiffness, self.length)
        square = jnp.sum(self.grid.weight * bent**2, axis=(0, 1)) / self.length
        axial = largest_force_scale(self.sections.stiffness)
        others = (
            *(force / axial for force in imbalance.cable),
            *self._rubbed(imbalance.turning, at),
        )
        return jnp.sqrt(sum((jnp.mean(x**2, axis=self._inner(x)) for x in others), square))

    def turn(self, step: ArmUnknown) -> Array:
        """Total angle by which the step bends and twists the arm [rad]."""
        x, y, z = (jnp.abs(k) for k in cast(step.xi[:3], self.grid.h.dtype))
        return jnp.sum(self.grid.weight * (x + y + z), axis=(0, 1))

    def work(self, wrench: Vector, step: ArmUnknown) -> Array:
        """Work of the residual over a step, in single precision: only its sign and rough size
        matter."""
        work = jnp.sum(
            c.single(self.grid.weight) * c.dot(wrench, free_components(step.xi, self.kind.free)),
            axis=(0, 1),
        )
        return work.astype(self.grid.h.dtype)

    def _rubbed(self, rates: Vector, at: ArmState) -> list[Array]:
        """Changes of turning rates, scaled by their effect on the tensions."""
        pulls = [pull_of(self.sections, place, self.length) for place in self.kind.frictional]
        return [
            self.length * at.tau[p] * rate * pull
            for p, rate, pull in zip(self.kind.frictional, rates, pulls, strict=True)
        ]

    def _inner(self, x: Array) -> tuple[int, ...]:
        return tuple(range(x.ndim - len(self.arms)))

    def _largest(self, x: Array) -> Array:
        return jnp.max(jnp.abs(x), axis=self._inner(x))


def _solve(kind: Kind, origin: ArmUnknown, guess: ArmUnknown | None, whole: ArmProblem) -> Root:
    arms = arms_in((origin, guess, whole), whole.grid.h.ndim - 1)
    start, origin = jax.tree.map(
        lambda x: jnp.broadcast_to(x, (*x.shape[: x.ndim - len(arms)], *arms)),
        (origin if guess is None else guess, origin),
    )
    sizes = _Sizes(whole.grid, whole.sections, kind, arms)

    def evaluate(unknown: ArmUnknown, damping: Array, share: Array) -> Damped:
        problem = whole.with_share(share)
        at = state_of(unknown, problem, kind)
        imbalance = imbalance_of(unknown, at, problem, kind)
        step, definite, doubtful = approximate_solve(unknown, at, imbalance, problem, kind, damping)
        size = sizes.of_step(step, at)
        # A step that coils the arm may lower the residual without approaching a solution.
        cut = jnp.minimum(1.0, MAX_TURN / jnp.maximum(sizes.turn(step), MAX_TURN))
        step = jax.tree.map(lambda x: cut.astype(x.dtype) * x, step)
        merit = sizes.of_imbalance(imbalance, at)
        return Damped(step, size, c.single(imbalance.wrench), merit, definite, doubtful)

    shares = 1 if whole.loads is None else LOAD_INCREMENTS
    floor = jnp.broadcast_to(rounding_of(whole), arms)
    again = None if guess is None else origin
    return damped_newton(evaluate, Measures(sizes.work, sizes.turn), start, floor, shares, again)
