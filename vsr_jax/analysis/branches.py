r"""Branches of equilibria, followed by their arc length: through limit points, stable or not.

With $y$ the unknowns of an arm and $s$ the parameter of a path of scenes and inputs, the equilibria
$r(y, s) = 0$ are a curve. From a point on it with the unit tangent $t$ the next is where the curve
meets the plane at the distance $h$ along $t$,

$$r(y, s) = 0, \quad t \cdot (y - y_0, s - s_0) = h,$$

by Newton's method, whose matrix stays regular where $\partial r / \partial y$ alone is singular
(Keller's pseudo-arclength, 1977).
"""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from ..arm.scene import Scene
from ..mechanics.arm_balance import (
    ArmProblem,
    ArmUnknown,
    Kind,
    imbalance_of,
    problem_of,
    state_of,
    with_tensions,
)
from ..mechanics.balance import free_components, spread, with_locked
from ..models.base import Outcome, Status, resolved
from ..models.strain_dependent import StrainDependent
from ..solution.equilibrium import Equilibrium
from ..solution.solver import solve
from ..typing import Scalar, cast
from ..validation import count, instance, numbers

_MOST_CORRECTIONS = 8
_FEW_CORRECTIONS = 3
_MOST_CUTS = 12
_LEAST_COSINE = 0.9
"""How far the tangents of neighbours may differ; a step that turns more is cut, so that it lands on
no other branch."""


class Branch(eqx.Module):
    """Equilibria along a path, in the order in which they were met.

    **Fields:** `parameter` s of each, shape (points,); `equilibria`, an `Equilibrium` with a batch
    axis of that size: ask it under `jax.vmap`, as in `jax.vmap(lambda eq:
    eq.tip)(branch.equilibria)`. Unstable ones are converged here; their `stability` is below 0.
    """

    parameter: Float[Array, " points"]
    equilibria: Equilibrium


class _Walk(NamedTuple):
    """Where the walk along the curve is: the last point (unknowns and parameter in one vector), the
    unit tangent there, the length of the next step and how often it was cut; all points so far, how
    many, the corrections taken for each, and whether the end of the path is reached."""

    u: Array
    tangent: Array
    length: Array
    cuts: Array
    points: Array
    found: Array
    corrections: Array
    ended: Array


def follow_branch(
    scene: Scene | Callable[[Scalar], Scene],
    path: Callable[[Scalar], Any],
    *,
    model: StrainDependent | None = None,
    points: int = 100,
    step: float = 0.1,
) -> Branch:
    r"""Branch of equilibria $r(y(\sigma), s(\sigma)) = 0$ along a path of inputs, or of scenes,
    with the parameter s from 0 to 1.

    It starts at the equilibrium that `solve` finds at s = 0 and follows the curve by its arc length
    $\sigma$, on which the whole path counts 1 and the bending of the arm its angle in radians (root
    mean square along the arm). Where the curve turns back at a limit point s falls again. It ends
    at s = 1, or where the curve comes back to s = 0; points that are left repeat the end.
    Derivatives of the equilibria are those at fixed s, and grow without bound towards a limit
    point.

    **Arguments:**
    - `scene`: a `Scene`, or a function of s that gives one, for loads or dimensions that change
      along the path.
    - `path`: function of s that gives the inputs.
    - `model`: a `StrainDependent`, by default with 12 steps: each correction solves a dense system
      of all its unknowns.
    - `points`: how many points at most. `branch.parameter[-1] < 1` means that they did not reach
      the end.
    - `step`: longest arc between neighbours; steps are cut where the curve bends.

    **Returns:** a `Branch`. Points after one from which the curve could not be followed have the
    status `BRANCH_LOST`; if there is no equilibrium at s = 0 all have the status of that solve.

    **Raises:** `ValueError` for another model, and what `solve` raises at s = 0.
    """
    model = StrainDependent(12) if model is None else model
    instance(
        "model",
        model,
        StrainDependent,
        "a StrainDependent, the model whose branches can be followed",
    )
    count("points", points, least=2)
    numbers("step", step, positive=True)
    start = solve(*lax.stop_gradient(_at(scene, path, jnp.zeros(()))), model=model)
    return _follow(scene, path, start, points, jnp.asarray(step, start.inputs.dtype))


def _at(
    scene: Scene | Callable[[Scalar], Scene], path: Callable[[Scalar], Any], s: Scalar
) -> tuple[Scene, Array]:
    """Scene and inputs at a place of the path."""
    there = (
        scene
        if isinstance(scene, Scene)
        else instance("scene", scene(s), Scene, "a Scene or a function that gives one")
    )
    values = there.check_inputs(path(s))
    return cast(there, values.dtype), values


class _System(NamedTuple):
    """The balance as a function of one vector: the unknowns times `scale`, so that bending counts
    in radians, and s."""

    scene: Any
    path: Any
    model: StrainDependent
    scale: Array

    def problem(self, s: Array) -> tuple[ArmProblem, Kind]:
        scene, inputs = _at(self.scene, self.path, s)
        return problem_of(scene, inputs, self.model.grid(scene))

    def unknown(self, u: Array, problem: ArmProblem, kind: Kind) -> ArmUnknown:
        """The unknowns in their own form; locked strains have their rest value."""
        shape, size = problem.grid.X.shape, problem.grid.X.size
        values = u[:-1] / self.scale
        strain = values[: len(kind.free) * size].reshape(-1, *shape)
        xi = with_locked(spread(tuple(strain), kind.free), problem.sections.rest, kind.free)
        rest = values[strain.size :]
        tension, turning = rest[: len(kind.cables)], rest[len(kind.cables) :].reshape(-1, *shape)
        return ArmUnknown(xi, tuple(tension), tuple(turning))

    def residual(self, u: Array) -> Array:
        """Imbalance as the gradient of an energy without unit by `u`."""
        problem, kind = self.problem(u[-1])
        unknown = self.unknown(u, problem, kind)
        rows = imbalance_of(unknown, state_of(unknown, problem, kind), problem, kind)
        wrench = tuple(problem.grid.weight * r for r in rows.wrench)
        flat = jnp.concatenate([jnp.ravel(x) for x in (*wrench, *rows.cable, *rows.turning)])
        bending = jnp.sum(problem.grid.weight * problem.sections.stiffness[1])
        return flat / self.scale * jnp.sum(problem.grid.h) ** 2 / bending


def _system(scene: Any, path: Any, start: Equilibrium) -> tuple[_System, Array]:
    """The system and its vector at the start of the path."""
    model = start.model
    assert isinstance(model, StrainDependent)
    problem, kind = problem_of(start.scene, start.inputs, model.grid(start.scene))
    length, share = jnp.sum(problem.grid.h), jnp.sqrt(problem.grid.weight / jnp.sum(problem.grid.h))
    axial = jnp.sum(problem.grid.weight * problem.sections.stiffness[3]) / length
    tension = tuple(-start._forces[place] for place in kind.cables)
    turning = start._state.turning
    parts = [
        (x, share * length if i < 3 else share)
        for i, x in zip(kind.free, free_components(start._state.xi, kind.free), strict=True)
    ]
    parts += [(x, 1 / axial) for x in tension] + [(x, share * length) for x in turning]
    values, scale = (
        jnp.concatenate([jnp.ravel(x) for x in column]) for column in zip(*parts, strict=True)
    )
    return _System(scene, path, model, lax.stop_gradient(scale)), lax.stop_gradient(
        jnp.append(values * scale, 0.0)
    )


@eqx.filter_jit
def _follow(scene: Any, path: Any, start: Equilibrium, points: int, step: Array) -> Branch:
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

    walk = lax.while_loop(proceed, partial(_attempt, system, step), walk)
    place = jnp.minimum(jnp.arange(points), jnp.maximum(walk.found - 1, 0))
    lost = (walk.cuts == _MOST_CUTS) & (jnp.arange(points) >= walk.found)
    status = jnp.where(lost & start.converged, Status.BRANCH_LOST, start.status).astype(jnp.int32)
    us = walk.points[place]
    return Branch(
        us[:, -1], jax.vmap(partial(_equilibrium, system))(us, status, walk.corrections[place])
    )


def _attempt(system: _System, longest: Array, walk: _Walk) -> _Walk:
    """One step along the tangent, corrected, to the next point; a shorter step next time if it was
    too long."""
    first = walk.found == 0
    goal, row, length, over = _aim(walk, first)
    u, J, size, count = _corrected(system, goal, row)
    tangent = jnp.linalg.solve(jnp.concatenate([J, walk.tangent[None]]), _last_axis(u))
    tangent = tangent / jnp.linalg.norm(tangent)
    sound = (size <= _small(u)) & (first | (tangent @ walk.tangent > _LEAST_COSINE))
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
        over | (~first & (u[-1] <= 0)),
    )
    cut = walk._replace(length=length / 2, cuts=walk.cuts + 1)
    return jax.tree.map(lambda a, b: jnp.where(sound, a, b), new, cut)


def _aim(walk: _Walk, first: Array) -> tuple[Array, Array, Array, Array]:
    """Where the next point is looked for, the normal of the plane it lies in, the step's length,
    and whether it is the path's end.

    The first point and the end of the path lie in planes of fixed s.
    """
    over = ~first & (walk.u[-1] + walk.length * walk.tangent[-1] >= 1)
    length = jnp.where(over, (1 - walk.u[-1]) / jnp.where(over, walk.tangent[-1], 1.0), walk.length)
    goal = jnp.where(first, walk.u, walk.u + length * walk.tangent)
    return goal, jnp.where(first | over, _last_axis(walk.u), walk.tangent), length, over


def _last_axis(u: Array) -> Array:
    """Unit vector of the parameter's axis."""
    return jnp.zeros_like(u).at[-1].set(1.0)


def _small(u: Array) -> Array:
    """A change of the unknowns whose square is rounding."""
    return jnp.asarray(jnp.finfo(u.dtype).eps ** 0.6, u.dtype)


def _corrected(system: _System, goal: Array, row: Array) -> tuple[Array, Array, Array, Array]:
    """Where the curve meets a plane, by Newton's method: the point, the matrix, the size of the
    last change, the corrections."""

    def proceed(state: tuple) -> Array:
        _, _, size, count = state
        return (size > _small(goal)) & (count < _MOST_CORRECTIONS)  # NaN ends it

    def correct(state: tuple) -> tuple:
        u, _, _, count = state
        r, J = lax.stop_gradient((system.residual(u), jax.jacfwd(system.residual)(u)))
        change = jnp.linalg.solve(jnp.concatenate([J, row[None]]), jnp.append(r, row @ (u - goal)))
        return u - change, J, jnp.linalg.norm(change), count + 1

    J = jnp.zeros((goal.size - 1, goal.size), goal.dtype)
    return lax.while_loop(
        proceed, correct, (goal, J, jnp.array(jnp.inf, goal.dtype), jnp.zeros((), jnp.int32))
    )


def _equilibrium(system: _System, u: Array, status: Array, steps: Array) -> Equilibrium:
    """The equilibrium at a point, with derivatives at fixed s."""
    s = u[-1]

    def solved(matvec: Callable, right: Array) -> Array:
        return jnp.linalg.solve(jax.jacfwd(matvec)(right), right)

    y = lax.custom_root(
        lambda y: system.residual(jnp.append(y, s)), u[:-1], lambda _, guess: guess, solved
    )
    scene, inputs = _at(system.scene, system.path, s)
    problem, kind = system.problem(s)
    unknown = system.unknown(jnp.append(y, s), problem, kind)
    forces = with_tensions(problem.forces, unknown.tension, kind)
    outcome = resolved(
        system.model, scene, Outcome(unknown._replace(tension=()), forces, status, steps)
    )
    return Equilibrium(scene, inputs, system.model, outcome)
