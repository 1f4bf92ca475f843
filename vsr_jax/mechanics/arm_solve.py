r"""Solution of the coupled balance (see `arm_balance`): damped Newton steps with a nearly exact
tangent, and implicit derivatives."""

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, PyTree

from ..numerics import component as c
from ..numerics.batching import (
    TOGETHER,
    Iteration,
    arms_in,
    iterated,
    known,
    lanes,
    queued,
    side_by_side,
)
from ..numerics.component import Vector, free_components, spread
from ..numerics.damped_newton import (
    FIRST_DAMPING,
    HARDENING_STAGES,
    LOAD_INCREMENTS,
    MAX_TURN,
    SOFT_STAGES,
    Damped,
    Measures,
    Schedule,
    Stage,
    damped_newton,
)
from ..numerics.implicit import implicit_root
from ..numerics.loops import fori_loop
from ..numerics.newton import Root
from ..numerics.once import once
from ..numerics.stacked import components, stack, total
from ..typing import Shape, cast
from .arm_balance import ArmImbalance, ArmUnknown, imbalance_of, rounding_of, state_of
from .arm_tangent import approximate_solve, followed, tangent_solve
from .balance import completed, residual, shortened, strain_norm, with_locked, without_force
from .coupling import ArmProblem, ArmState, clear_of, forces_at
from .sizes import shape_of, shape_size

_QUEUED = 1024
"""Arms that wait in one queue on a CPU, at most."""
_UNEVEN = 48
"""Arms that are solved side by side on a CPU, at most, where some need four times as many steps as
most; others by `TOGETHER`."""
_SLOW = 1 / 8
"""Share of even arms that may go on beside the next ones: one that fails takes ten times as many
steps as most."""

_BOW = 0.05
"""Angle [rad] by which an arm with constraints is bent and twisted at rest until these are exact,
where contacts are loosened, and in the second attempt of an arm without contacts. Otherwise
symmetric shapes that are unstable are found in place of those beside them
(`test_an_arm_held_with_slack_finds_its_stable_shape` in tests/test_held.py). With contacts, a solve
from a `start` is not bent: that might take the arm to another side of an obstacle
(`test_an_arm_that_has_buckled_in_a_tube` in tests/test_contact_tube.py)."""

_START_STEPS = 4
"""Fixed-point steps to the start: each gains a factor of the strains that threads cause."""


def solve_arm(
    problem: ArmProblem,
    free: tuple[int, ...],
    guess: ArmUnknown | None = None,
    *,
    solved: bool = False,
) -> Root:
    """Equilibrium of the arm; its point is an `ArmUnknown`. Newton's method starts from a guess, if
    one is given, else or where that fails from the balance without loads and couplings. With
    `solved` the guess is the equilibrium, of which only derivatives are wanted.

    Where only a loosened problem was solved, it is that of `problem.loosened`.

    Derivatives are implicit, of any order, in forward and reverse mode: the exact tangent system is
    solved by iterative refinement of `approximate_solve`.
    """

    def find(problem: ArmProblem, guess: ArmUnknown | None) -> Root:
        if guess is not None:  # the iteration does not change the locked strains
            guess = guess._replace(xi=with_locked(guess.xi, problem.sections, free))
        if guess is not None and solved:
            yes = jnp.array(True)
            found = guess._replace(xi=free_components(guess.xi, free))
            return Root(found, yes, yes, jnp.array(0, jnp.int32))
        root = side_by_side(partial(_solve, free), _QUEUED)(_start(problem, free), guess, problem)
        point = root.x._replace(xi=free_components(root.x.xi, free))
        # as from a guess, so that a solve without one begins a scan of those from the last
        restarted = jnp.zeros_like(root.restarted) if guess is None else root.restarted
        return root._replace(x=point, restarted=restarted)

    def whole(x: ArmUnknown, problem: ArmProblem) -> ArmUnknown:
        return x._replace(xi=completed(x.xi, problem.sections, free))

    def with_state(x: ArmUnknown, problem: ArmProblem) -> tuple[ArmImbalance, ArmState]:
        unknown = whole(x, problem)
        at = state_of(unknown.xi, unknown.coupled, problem)
        return imbalance_of(unknown, at, problem, free), at

    def imbalance(x: ArmUnknown, problem: ArmProblem, _: ArmUnknown | None) -> ArmImbalance:
        return with_state(x, problem)[0]

    def linear_solve(
        x: ArmUnknown, problem: ArmProblem, guess: ArmUnknown | None, right: ArmImbalance
    ) -> ArmUnknown:
        prepared = problem.prepared()
        _, apply, at = jax.linearize(lambda x: with_state(x, prepared), x, has_aux=True)
        return tangent_solve(apply, whole(x, problem), at, problem, right, free)

    def at_rest(x: ArmUnknown, problem: ArmProblem, guess: ArmUnknown | None) -> tuple:
        zero = jax.tree.map(jnp.zeros_like, x)
        rest = free_components(problem.sections.rest, free)
        return zero._replace(xi=rest), problem.at_rest(), guess

    def settle(found: Root, problem: ArmProblem, guess: ArmUnknown | None) -> tuple:
        return problem.loosened(found.loose), guess

    root = implicit_root(find, imbalance, linear_solve, at_rest, problem, guess, settle=settle)
    return root._replace(x=whole(root.x, problem))


def _start(problem: ArmProblem, free: tuple[int, ...]) -> ArmUnknown:
    r"""Nearly the balance of each section alone, without loads and with couplings that exert no
    force: some fixed-point steps $\xi = \Sigma^{-1} B_\tau(\xi) \tau + \xi^*$, in single precision.
    The rest strain where they do not halve the residual, on average."""
    none = without_force(problem.forces)
    coupled = tuple(coupling.guess(none, problem.grid) for coupling in problem.couplings)
    tau = problem.sections.carry(forces_at(problem.couplings, coupled, problem.forces))
    sections, tau = c.single((problem.sections, tau))
    shape = problem.grid.X.shape
    rest = tuple(jnp.broadcast_to(x, shape) for x in sections.rest)

    def closer(i: Array, state: tuple) -> tuple:
        xi, first, _ = state
        off = spread(free_components(residual(xi, sections, tau), free), free)
        size = jnp.max(strain_norm(off, sections.stiffness))
        step = tuple(r / s for r, s in zip(off, sections.stiffness, strict=True))
        return c.subtract(xi, step), jnp.where(i == 0, size, first), size

    none = jnp.zeros((), rest[0].dtype)
    xi, first, last = fori_loop(0, _START_STEPS, closer, (rest, none, none))
    near = last <= 0.5 ** (_START_STEPS - 1) * first
    xi = tuple(
        jnp.where(near, x, x0).astype(exact.dtype)
        for x, x0, exact in zip(xi, rest, problem.sections.rest, strict=True)
    )
    for constraint in problem.constraints:
        xi = constraint.start(xi, problem)
    return ArmUnknown(with_locked(xi, problem.sections, free), coupled)


class _Point(NamedTuple):
    """Unknowns or a step in the iteration: the free strains as one array (free, stages, steps,
    *arms), a program smaller by their number, and the unknowns of each coupling."""

    xi: Array
    coupled: tuple[PyTree, ...]


def _point(unknown: ArmUnknown, free: tuple[int, ...]) -> _Point:
    return _Point(stack(free_components(unknown.xi, free)), unknown.coupled)


def _unknown(point: _Point, problem: ArmProblem, free: tuple[int, ...]) -> ArmUnknown:
    return ArmUnknown(completed(components(point.xi), problem.sections, free), point.coupled)


class _Sizes(NamedTuple):
    """Dimensionless sizes of steps and residuals, one entry per arm of a batch (see
    `shape_size`)."""

    problem: ArmProblem
    free: tuple[int, ...]
    arms: Shape

    def of_step(self, step: ArmUnknown, at: ArmState) -> Array:
        """Largest change of the shape, plus those of the couplings."""
        step = cast(step, self.problem.grid.h.dtype)
        moved = self._largest(shape_size(step.xi, self.problem.length))
        for coupling, x in zip(self.problem.couplings, step.coupled, strict=True):
            moved = sum(map(self._largest, coupling.sizes(x, at, self.problem)), moved)
        return moved

    def of_imbalance(self, imbalance: ArmImbalance, at: ArmState) -> Array:
        """Root mean square of all rows."""
        grid, length = self.problem.grid, self.problem.length
        wrench = spread(imbalance.wrench, self.free)
        bent = shape_of(wrench, self.problem.sections, length)
        square = _over_nodes(grid.weight * bent**2) / length
        for coupling, rows in zip(self.problem.couplings, imbalance.coupled, strict=True):
            for size in coupling.row_sizes(rows, at, self.problem):
                square = square + jnp.mean(once(size**2, summed=True), axis=self._inner(size))
        return jnp.sqrt(square)

    def turn(self, step: _Point) -> Array:
        """Total angle by which the step bends and twists the arm [rad]."""
        bending = step.xi[: sum(i < 3 for i in self.free)]
        angle = total(jnp.abs(cast(bending, self.problem.grid.h.dtype)), 0)
        return _over_nodes(self.problem.grid.weight * angle)

    def stirs(self, like: _Point) -> _Point:
        """A step that bends and twists the arm in all directions, in no symmetric way."""
        place, bending = self.problem.grid.X / self.problem.length, sum(i < 3 for i in self.free)
        index = np.arange(len(self.free), dtype=place.dtype).reshape(-1, *(1,) * place.ndim)
        some = jnp.where(index < bending, 1.0 - (0.4 + 0.5 * index) * place, 0.0)
        some = c.times(self.problem.sections.flexible, some)
        return _Point(some / self.problem.length, jax.tree.map(jnp.zeros_like, like.coupled))

    def work(self, wrench: Vector, step: _Point) -> Array:
        """Work of the residual over a step, in single precision: only its sign and rough size
        matter."""
        per_length = c.dot(wrench, components(step.xi))
        work = _over_nodes(c.single(self.problem.grid.weight) * per_length)
        return work.astype(self.problem.grid.h.dtype)

    def dot(self, one: _Point, other: _Point) -> Array:
        """Scalar product of two steps by their elastic energy, in single precision."""
        stiffness, weight = c.single((self.problem.sections.stiffness, self.problem.grid.weight))
        elastic = weight * stack(free_components(stiffness, self.free))
        work = _over_nodes(elastic * one.xi * other.xi, 3)
        return work.astype(self.problem.grid.h.dtype)

    def _inner(self, x: Array) -> tuple[int, ...]:
        return tuple(range(x.ndim - len(self.arms)))

    def _largest(self, x: Array) -> Array:
        return jnp.max(once(jnp.abs(x)), axis=self._inner(x))


def _over_nodes(x: Array, axes: int = 2) -> Array:
    """Sum over all nodes, in the first axes. The terms are an array of their own: in the loop of a
    sum XLA computes them one by one, with all that leads to them."""
    return jnp.sum(once(x, summed=True), axis=tuple(range(axes)))


def _linearized(
    unknown: ArmUnknown, problem: ArmProblem, free: tuple[int, ...]
) -> tuple[ArmImbalance, Callable[[ArmUnknown], tuple], ArmState]:
    """The residual, the changes of the rows of all couplings by the strain of a step alone, and the
    state."""

    def rows(xi: Vector) -> tuple:
        at = state_of(xi, unknown.coupled, problem)
        imbalance = imbalance_of(ArmUnknown(xi, unknown.coupled), at, problem, free)
        return imbalance.coupled, (imbalance, at)

    if not problem.follows_rate:
        _, (imbalance, at) = rows(unknown.xi)
        return jax.tree.map(once, imbalance), lambda step: (), at
    _, change, (imbalance, at) = jax.linearize(rows, unknown.xi, has_aux=True)

    def changes(step: ArmUnknown) -> tuple:
        return jax.tree.map(once, change(cast(step.xi, problem.grid.h.dtype)))

    return jax.tree.map(once, imbalance), changes, at


def _solve(
    free: tuple[int, ...], origin: ArmUnknown, guess: ArmUnknown | None, whole: ArmProblem
) -> Root:
    arms = arms_in((origin, guess, whole), whole.grid.h.ndim - 1)
    given = whole, origin, guess, jnp.broadcast_to(rounding_of(whole), arms)
    side = lanes(arms[0], _UNEVEN if whole.constrained else TOGETHER) if arms else 0
    if arms and known(arms[0]) and side < arms[0]:
        slow = side - 1 if whole.constrained else int(_SLOW * side)
        root = queued(partial(_iteration, free, (side,)), given, arms[0], side, slow)
    else:
        root = iterated(_iteration(free, arms, given))
    root = root._replace(x=_unknown(root.x, whole, free))
    if whole.dissipates is None:
        return root
    whole = whole.loosened(root.loose)
    at = state_of(root.x.xi, root.x.coupled, whole)
    imbalance = imbalance_of(root.x, at, whole, free)
    _, definite, _ = approximate_solve(root.x, at, imbalance, whole, free, symmetric=True)
    return root._replace(definite=definite)


def _iteration(
    free: tuple[int, ...],
    arms: Shape,
    given: tuple[ArmProblem, ArmUnknown, ArmUnknown | None, Array],
) -> Iteration:
    """Newton's method for a batch of arms: their problem, where it begins, a guess, and the
    rounding of its residual."""
    whole, origin, guess, floor = given
    start, origin = jax.tree.map(
        lambda x: jnp.broadcast_to(x, (*x.shape[: x.ndim - len(arms)], *arms)),
        (_point(origin if guess is None else guess, free), _point(origin, free)),
    )
    sizes, schedule = _Sizes(whole, free, arms), schedule_of(whole, guess)

    def evaluate(point: _Point, damping: Array, stage: Stage) -> Damped:
        problem = whole.loosened(stage.loose)
        problem = problem.with_share(stage.share)
        if whole.constrained and (guess is None or not whole.begins_soft):
            bent = stage.loose if whole.begins_soft else stage.restarted
            soft = jnp.clip(2.0 - stage.share, 0.0, 1.0)
            problem = problem.bowed(jnp.where(bent, _BOW * soft, 0.0))
        unknown = _unknown(point, whole, free)
        imbalance, changes, at = _linearized(unknown, problem, free)
        step, definite, doubtful = approximate_solve(unknown, at, imbalance, problem, free, damping)
        slides = problem.dissipates
        if slides is not None:  # no pivot tells then
            definite, doubtful = definite | slides, doubtful & ~slides
        step = followed(step, imbalance, changes, problem)
        size, point = sizes.of_step(step, at), jax.tree.map(once, _point(step, free))
        # A step that coils the arm may lower the residual without approaching a solution.
        cut = jnp.minimum(1.0, MAX_TURN / jnp.maximum(sizes.turn(point), MAX_TURN))
        point = jax.tree.map(lambda x: cut.astype(x.dtype) * x, point)
        merit = sizes.of_imbalance(imbalance, at)
        clear = clear_of(at, problem)
        wrench = c.single(imbalance.wrench)
        out = None
        if not whole.couplings:
            # Under given forces an arm does not come back from there. One that lengths drive may:
            # two of 339 random ones are solved on such a way (benchmarks/false_failures.py).
            out = jnp.any(shortened(unknown.xi, whole.sections_of_threads), axis=(0, 1))
        return Damped(point, size, wrench, merit, definite, doubtful, clear, slides, out)

    dot = sizes.dot if whole.follows_rate or whole.constrained else None
    return damped_newton(
        evaluate,
        Measures(sizes.work, sizes.turn, sizes.stirs(start), dot),
        start,
        floor,
        schedule,
        None if guess is None else origin,
    )


def schedule_of(problem: ArmProblem, guess: ArmUnknown | None = None) -> Schedule:
    """Load increments and stages of a problem that begins from a guess or from rest."""
    begins_whole = not problem.begins_soft
    loaded = begins_whole and problem.by_increments
    return Schedule(
        LOAD_INCREMENTS if loaded else 1,
        HARDENING_STAGES if problem.constrained else 0,
        SOFT_STAGES,
        direct=guess is not None or loaded or (begins_whole and problem.constrained),
        damping=0.0 if guess is not None or loaded else FIRST_DAMPING,
    )
