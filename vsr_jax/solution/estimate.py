r"""Discretisation error of a solution: its tip and its strain are compared with those of a coarser
or a finer solution.

- Without loads, on an arm that is one smooth piece, a model with balanced sections has no error but
  that of its steps. Pairs of steps are merged into one, with the strain at the new nodes
  interpolated by the polynomial through the old ones: no balance is solved, and the tip moves by
  $2^p - 1$ times its error for steps of order p. The estimate is four times that error, because a
  few steps are not yet in the asymptotic regime.
- Otherwise a finer solution starts from the given one, which saves a full solve. Without loads its
  cross-sections are balanced at twice as many steps of order 6. With loads, lengths or friction the
  strain there follows from the reaction of the given solution. It is then corrected by Newton steps
  of the whole arm with the approximate tangent, which leave a tenth of the error or less.
- For `Continuum` the reference is an integration with tolerances a hundred times tighter.
"""

from typing import Any, NamedTuple

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from ..arm.scene import Scene
from ..mechanics.arm_balance import ArmUnknown, imbalance_of, problem_of, state_of
from ..mechanics.arm_tangent import approximate_solve
from ..mechanics.balance import solve_balance
from ..models.base import Model, SteppedModel
from ..models.strain_dependent import StrainDependent
from ..numerics import component as c
from ..numerics.component import Vector
from ..numerics.magnus import tip_pose
from ..numerics.quadrature import Grid, make_grid, merging
from ..typing import Pose, Scalar, cast

_SAFETY = 1.5
"""Safety factor on the estimated differences."""

_ROUNDED = 8
"""Bound on rounding, in units of machine epsilon."""

_PASSES = 3
"""Newton steps that correct the finer strain."""

_UNSETTLED = 4
"""Factor by which the ratio of the errors of steps and of steps twice as long may differ from that
of their order."""


class Error(NamedTuple):
    """Estimated errors of a solution.

    **Fields:** `tip`: of the tip position [m]; `strain`: largest error along the arm of each
    strain, angular first ([1/m], [-]).
    """

    tip: Scalar
    strain: Float[Array, " 6"]


def error_of(model: Model, scene: Scene, inputs: Array, forces: Vector, state: Any) -> Error:
    """Estimated errors of a solution: 1.5 times its estimated difference from a finer one, plus a
    bound on rounding.

    **Arguments:** as `Model.tip`, and `inputs`, those of the solve.
    """
    scene, inputs, forces, state = lax.stop_gradient((scene, inputs, forces, state))
    share = 1.0
    if isinstance(model, SteppedModel) and model.balanced_everywhere and _by_pairs(model, scene):
        grid, xi = model.grid(scene), model.node_strain(scene, state)
        tip, fine = _paired_tip(xi, grid, scene), xi
        share = _UNSETTLED * model.steps / (model.steps // 2 * 2) / (2**model.order - 1)
    elif isinstance(model, SteppedModel):
        xi, fine, grid = _corrected(model, scene, inputs, forces, state)
        tip = tip_pose(fine, grid.h, scene.rod.base)
    else:
        grid, finer = make_grid(scene.edges(), 32, 3), model.finer()
        found, X = finer.solve(scene, inputs), grid.X.reshape(-1)
        tip = finer.tip(scene, found.forces, found.state)
        xi, fine = (
            m.strain(scene, f, s, X)
            for m, f, s in ((model, forces, state), (finer, found.forces, found.state))
        )
    moved = share * c.norm(c.split((tip - model.tip(scene, forces, state))[:3, 3]))
    change = jnp.stack([jnp.max(jnp.abs(a - b)) for a, b in zip(xi, fine, strict=True)])
    size = jnp.stack([jnp.max(jnp.abs(x)) for x in fine])
    least = _ROUNDED * jnp.finfo(moved.dtype).eps
    sections = scene.sections(grid.X)
    slender = scene.rod.length * jnp.sqrt(
        jnp.max(sections.stiffness[3] / jnp.minimum(sections.stiffness[1], sections.stiffness[2]))
    )
    bend = jnp.array([slender / scene.rod.length] * 3 + [1.0] * 3, size.dtype)
    return Error(
        _SAFETY * moved + least * scene.rod.length * (1 + slender),
        _SAFETY * change + least * (size + bend),
    )


def _by_pairs(model: SteppedModel, scene: Scene) -> bool:
    """Whether pairs of steps can be merged."""
    return not scene.coupled and scene.edges().size == 2 and model.steps > 1


def _paired_tip(xi: Vector, grid: Grid, scene: Scene) -> Pose:
    """Pose of the tip by steps twice as long; an odd last step keeps its length."""
    pairs = grid.h.size // 2 * 2
    merged = tuple(
        jnp.asarray(merging(len(x)), x.dtype) @ jnp.concatenate([x[:, 0:pairs:2], x[:, 1:pairs:2]])
        for x in xi
    )
    end = tip_pose(merged, 2 * grid.h[:pairs:2], scene.rod.base)
    return (
        end
        if pairs == grid.h.size
        else tip_pose(tuple(x[:, pairs:] for x in xi), grid.h[pairs:], end)
    )


def _corrected(
    model: SteppedModel, scene: Scene, inputs: Array, forces: Vector, state: Any
) -> tuple[Vector, Vector, Grid]:
    """Strain of a solution at the nodes of a finer grid, the balanced strain there, and the
    grid."""
    grid = make_grid(scene.edges(model.breakpoints(scene)), 2 * model.steps, 3)
    xi = model.strain(scene, forces, state, grid.X.reshape(-1))
    xi = tuple(x.reshape(grid.X.shape) for x in xi)
    if scene.coupled:
        return xi, _together(model, scene, inputs, forces, state, xi, grid), grid
    if model.balanced_everywhere:
        return xi, xi, grid
    sections = scene.sections(grid.X)
    return xi, solve_balance(sections, sections.carry(forces), None, scene.free, xi).xi, grid


def _together(
    model: SteppedModel,
    scene: Scene,
    inputs: Array,
    forces: Vector,
    state: Any,
    xi: Vector,
    grid: Grid,
) -> Vector:
    problem, kind = problem_of(scene, inputs, grid)
    turning: Vector = (jnp.zeros_like(grid.X),) * len(kind.frictional)
    if isinstance(model, StrainDependent):
        X = model.grid(scene).X.T.reshape(-1)
        turning = tuple(jnp.interp(grid.X, X, x.T.reshape(-1)) for x in state.turning)

    def correct(_: Any, unknown: ArmUnknown) -> ArmUnknown:
        at = state_of(unknown, problem, kind)
        step, _ = approximate_solve(
            unknown, at, imbalance_of(unknown, at, problem, kind), problem, kind
        )
        return c.subtract(unknown, cast(step, xi[0].dtype))

    start = ArmUnknown(xi, tuple(-forces[place] for place in kind.cables), turning)
    return lax.fori_loop(0, _PASSES, correct, start).xi
