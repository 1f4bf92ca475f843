r"""Pseudo-arclength continuation of branches of equilibria, through limit points, stable or not.

$r(y, s) = 0, \quad t \cdot (y - y_0, s - s_0) = h$

With $y$ the unknowns of an arm and $s$ the parameter of a path of scenes and inputs, the equilibria
$r(y, s) = 0$ form a curve. From the point $(y_0, s_0)$ with unit tangent $t$, Newton's method finds
the intersection of the curve with the plane at distance $h$ along $t$. Its matrix stays regular
where $\partial r / \partial y$ is singular.

**Source:** H. B. Keller, Numerical solution of bifurcation and nonlinear eigenvalue problems
(1977).
"""

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float

from ..arm.scene import Scene
from ..elements.problem import problem_of
from ..mechanics.arm_balance import ArmSolution, ArmUnknown, imbalance_of, state_of
from ..mechanics.balance import with_locked
from ..mechanics.coupling import ArmProblem, forces_at
from ..models.base import Outcome, Status, SteppedModel, resolved
from ..models.strain_dependent import StrainDependent
from ..numerics.compiling import program
from ..numerics.component import add, free_components, multiply, spread, subtract
from ..numerics.loops import while_loop
from ..numerics.quadrature import Grid
from ..solution.equilibrium import Equilibrium
from ..solution.solver import solve, status_of_inputs
from ..typing import ArrayLike, Scalar, cast
from ..validation import count, instance, numbers

_MOST_CORRECTIONS = 8
"""Newton corrections per step; a step that needs more is cut, since it began too far from the
curve."""
_FEW_CORRECTIONS = 3
"""Corrections up to which the next step is doubled: quadratic convergence from a good start."""
_MOST_CUTS = 12
"""Halvings after which the branch counts as lost, at 1 / 4096 of the step."""
_LEAST_COSINE = 0.9
"""Least cosine between successive tangents; a step that turns more is cut, so that it does not jump
to another branch."""

SceneOrPath = Scene | Callable[[Scalar], Scene]
InputPath = Callable[[Scalar], ArrayLike]


class Branch(eqx.Module):
    """Equilibria along a path, in the order of the arc length.

    **Fields:** `parameter` s of each, shape (points,); `equilibria`, an `Equilibrium` with a batch
    axis of that size, for use with `jax.vmap`, as in `jax.vmap(lambda eq:
    eq.tip)(branch.equilibria)`. Unstable equilibria count as converged here; their `stability` is
    negative.
    """

    parameter: Float[Array, " points"]
    equilibria: Equilibrium


class _Walk(NamedTuple):
    """State of the continuation: the last point u (unknowns and parameter in one vector), the unit
    tangent there, the length of the next step and how often it was cut; all points so far, their
    number, the corrections of each, and whether the end of the path is reached."""

    u: Array
    tangent: Array
    length: Array
    cuts: Array
    points: Array
    found: Array
    corrections: Array
    ended: Array


def follow_branch(
    scene: SceneOrPath,
    path: InputPath,
    *,
    model: SteppedModel | None = None,
    points: int = 100,
    step: float = 0.1,
) -> Branch:
    r"""Branch of equilibria $r(y(\sigma), s(\sigma)) = 0$ along a path of inputs, or of scenes,
    with the parameter s from 0 to 1.

    It starts at the equilibrium that `solve` finds at s = 0 and follows the curve by its arc length
    $\sigma$, in which the whole path counts 1 and bending counts its angle in radians (root mean
    square along the arm). At a limit point s reverses. The branch ends at s = 1, or at s = 0 where
    the curve returns to it; remaining points repeat the end. Derivatives of the equilibria are
    taken at fixed s and are unbounded at a limit point.

    **Arguments:**
    - `scene`: a `Scene`, or a function of s that returns one, for loads or dimensions that change
      along the path.
    - `path`: function of s that returns the inputs.
    - `model`: a `StrainDependent`, by default with 12 steps: each correction solves a dense system
      of all its unknowns.
    - `points`: largest number of points. `branch.parameter[-1] < 1` means that they did not reach
      the end.
    - `step`: largest arc length between points; steps are shortened where the curve bends.

    **Returns:** a `Branch`. Points with inputs that an actuator cannot exert are `INADMISSIBLE`.
    Points after the last one that could be found have the status `BRANCH_LOST`; without an
    equilibrium at s = 0 all points have the status of that solve.

    **Raises:** `ValueError` for another model, and the errors of `solve` at s = 0.
    """
    model = StrainDependent(12) if model is None else model
    if not (isinstance(model, SteppedModel) and model.on_nodes):
        raise ValueError(
            f"model: got {model!r}, need a StrainDependent, whose branches can be followed"
        )
    count("points", points, least=2)
    numbers("step", step, positive=True)
    start = solve(*lax.stop_gradient(_at(scene, path, jnp.zeros(()))), model=model)
    return _follow(scene, path, start, points, jnp.asarray(step, start.inputs.dtype))


def _at(scene: SceneOrPath, path: InputPath, s: Scalar) -> tuple[Scene, Array]:
    """Scene and inputs at the parameter s."""
    here = (
        scene
        if isinstance(scene, Scene)
        else instance("scene", scene(s), Scene, "a Scene or a function that returns one")
    )
    values = here.check_inputs(path(s))
    return cast(here, values.dtype), values


class _System(NamedTuple):
    """The balance as a function of one vector u: the unknowns times `scale`, so that bending counts
    in radians, then s."""

    scene: SceneOrPath
    path: InputPath
    model: SteppedModel
    scale: Array

    def problem(self, s: Array) -> tuple[ArmProblem, tuple[int, ...]]:
        """The balance at s, and its free strains."""
        given, inputs = _at(self.scene, self.path, s)
        scene = given.at(inputs)
        return problem_of(scene, inputs, self.model.grid(scene)), scene.free

    def unknown(self, u: Array, problem: ArmProblem, free: tuple[int, ...]) -> ArmUnknown:
        """The unknowns as a structure; locked strains have their rest value."""
        found = self._free_unknown(u, problem, free)
        return found._replace(xi=with_locked(spread(found.xi, free), problem.sections, free))

    def _free_unknown(self, u: Array, problem: ArmProblem, free: tuple[int, ...]) -> ArmUnknown:
        coupled = tuple(one.guess(problem.forces, problem.grid) for one in problem.couplings)
        like = ArmUnknown(free_components(problem.sections.rest, free), coupled)
        return ravel_pytree(_at_nodes(like, problem.grid))[1](u[:-1] / self.scale)

    def residual(self, u: Array) -> Array:
        """Gradient of a dimensionless energy with respect to the unknowns in `u`."""
        problem, free = self.problem(u[-1])
        unknown = self.unknown(u, problem, free)
        at = state_of(unknown.xi, unknown.coupled, problem)
        rows = imbalance_of(unknown, at, problem, free)
        if problem.sections.flexible is not None:  # rows that keep the matrix regular there
            given = self._free_unknown(u, problem, free).xi
            off = subtract(given, free_components(unknown.xi, free))
            held = multiply(free_components(problem.sections.stiffness, free), off)
            rows = rows._replace(wrench=add(rows.wrench, held))
        wrench = tuple(problem.grid.weight * r for r in rows.wrench)
        flat, _ = ravel_pytree(rows._replace(wrench=wrench))
        bending = jnp.sum(problem.grid.weight * problem.sections.stiffness[1])
        return flat / self.scale * jnp.sum(problem.grid.h) ** 2 / bending


def _system(scene: SceneOrPath, path: InputPath, start: Equilibrium) -> tuple[_System, Array]:
    """The system, and its vector at the start of the path."""
    model = start.model
    assert isinstance(model, SteppedModel)
    free, problem = start.scene.free, problem_of(start.scene, start.inputs, model.grid(start.scene))
    length, share = problem.length, jnp.sqrt(problem.grid.weight / problem.length)
    unknown = ArmUnknown(free_components(start.state.xi, free), start.state.coupled)
    scale = ArmUnknown(
        tuple(share * length if i < 3 else share for i in free),
        tuple(
            jax.tree.map(jnp.broadcast_to, one.scales(problem).radians, jax.tree.map(jnp.shape, x))
            for one, x in zip(problem.couplings, unknown.coupled, strict=True)
        ),
    )
    values, scale = (ravel_pytree(_at_nodes(x, problem.grid))[0] for x in (unknown, scale))
    return _System(scene, path, model, lax.stop_gradient(scale)), lax.stop_gradient(
        jnp.append(values * scale, 0.0)
    )


def _at_nodes(unknown: ArmUnknown, grid: Grid) -> ArmUnknown:
    """The same with all strains as arrays over the nodes."""
    xi = tuple(jnp.broadcast_to(x, grid.X.shape) for x in unknown.xi)
    return unknown._replace(xi=xi)


@program("follow_branch")
def _follow(
    scene: SceneOrPath, path: InputPath, start: Equilibrium, points: int, step: Array
) -> Branch:
    system, u = _system(scene, path, start)
    zero = jnp.zeros((), jnp.int32)
    everywhere = jnp.broadcast_to(u, (points, u.size))
    walk = _Walk(
        u,
        _last_axis(u),
        step,
        zero,
        everywhere,
        zero,
        jnp.zeros(points, jnp.int32),
        ~start.converged,
    )

    def proceed(walk: _Walk) -> Array:
        return (walk.found < points) & (walk.cuts < _MOST_CUTS) & ~walk.ended

    walk = while_loop(proceed, partial(_attempt, system, step), walk)
    place = jnp.minimum(jnp.arange(points), jnp.maximum(walk.found - 1, 0))
    lost = (walk.cuts == _MOST_CUTS) & (jnp.arange(points) >= walk.found)
    status = jnp.where(lost & start.converged, Status.BRANCH_LOST, start.status).astype(jnp.int32)
    us = walk.points[place]
    return Branch(
        us[:, -1], jax.vmap(partial(_equilibrium, system))(us, status, walk.corrections[place])
    )


def _attempt(system: _System, longest: Array, walk: _Walk) -> _Walk:
    """One step: a prediction along the tangent and its correction. If the step was too long, the
    next attempt uses half of it."""
    first = walk.found == 0
    goal, row, length, over = _aim(walk, first)
    u, J, size, count = _corrected(system, goal, row)
    tangent = jnp.linalg.solve(jnp.concatenate([J, walk.tangent[None]]), _last_axis(u))
    tangent = tangent / jnp.linalg.norm(tangent)
    inside = (u[-1] >= 0) & (u[-1] <= 1)  # a step beyond an end is cut, the next one lands on it
    near = inside & (tangent @ walk.tangent > _LEAST_COSINE)
    sound = (size <= _small(u)) & (first | near)
    longer = jnp.minimum(jnp.where(count <= _FEW_CORRECTIONS, 2 * length, length), longest)
    points, corrections = (
        walk.points.at[walk.found].set(u),
        walk.corrections.at[walk.found].set(count),
    )
    new = _Walk(
        u,
        tangent,
        longer,
        jnp.zeros_like(walk.cuts),
        points,
        walk.found + 1,
        corrections,
        over,
    )
    cut = walk._replace(length=length / 2, cuts=walk.cuts + 1)
    return jax.tree.map(lambda a, b: jnp.where(sound, a, b), new, cut)


def _aim(walk: _Walk, first: Array) -> tuple[Array, Array, Array, Array]:
    """Prediction of the next point, normal of the plane it lies in, length of the step, and whether
    it is the end of the path.

    The first point and the ends of the path, s = 0 and s = 1, lie in planes of fixed s.
    """
    s, slope = walk.u[-1], walk.tangent[-1]
    ahead = s + walk.length * slope
    over = ~first & ((ahead >= 1) | ((ahead <= 0) & (slope < 0)))
    end = jnp.where(slope < 0, 0.0, 1.0)
    length = jnp.where(over, (end - s) / jnp.where(over, slope, 1.0), walk.length)
    goal = jnp.where(first, walk.u, walk.u + length * walk.tangent)
    goal = goal.at[-1].set(jnp.where(over, end, goal[-1]))
    return goal, jnp.where(first | over, _last_axis(walk.u), walk.tangent), length, over


def _last_axis(u: Array) -> Array:
    """Unit vector along the axis of s."""
    return jnp.zeros_like(u).at[-1].set(1.0)


def _small(u: Array) -> Array:
    """Size of a change of the unknowns whose square is below rounding error."""
    return jnp.asarray(jnp.finfo(u.dtype).eps ** 0.6, u.dtype)


def _corrected(system: _System, goal: Array, row: Array) -> tuple[Array, Array, Array, Array]:
    """Intersection of the curve with a plane, by Newton's method: the point, the matrix, the size
    of the last change, the number of corrections."""

    def proceed(state: tuple) -> Array:
        _, _, size, count = state
        return (size > _small(goal)) & (count < _MOST_CORRECTIONS)  # NaN ends the loop

    def correct(state: tuple) -> tuple:
        u, _, _, count = state
        r, J = lax.stop_gradient((system.residual(u), jax.jacfwd(system.residual)(u)))
        change = jnp.linalg.solve(jnp.concatenate([J, row[None]]), jnp.append(r, row @ (u - goal)))
        return u - change, J, jnp.linalg.norm(change), count + 1

    J = jnp.zeros((goal.size - 1, goal.size), goal.dtype)
    return while_loop(
        proceed, correct, (goal, J, jnp.array(jnp.inf, goal.dtype), jnp.zeros((), jnp.int32))
    )


def _equilibrium(system: _System, u: Array, status: Array, steps: Array) -> Equilibrium:
    """Equilibrium at a point of the curve, with derivatives at fixed s."""
    s = u[-1]

    def solved(matvec: Callable, right: Array) -> Array:
        return jnp.linalg.solve(jax.jacfwd(matvec)(right), right)

    y = lax.custom_root(
        lambda y: system.residual(jnp.append(y, s)), u[:-1], lambda _, guess: guess, solved
    )
    scene, inputs = _at(system.scene, system.path, s)
    problem, free = system.problem(s)
    unknown = system.unknown(jnp.append(y, s), problem, free)
    forces = forces_at(problem.couplings, unknown.coupled, problem.forces)
    state = ArmSolution(*unknown, problem.couplings)
    outcome = resolved(system.model, scene.at(inputs), Outcome(state, forces, status, steps))
    found = outcome.status == Status.CONVERGED
    status = jnp.where(found, status_of_inputs(scene, inputs), outcome.status)
    outcome = outcome._replace(status=status)
    return Equilibrium(scene, inputs, system.model, outcome)
