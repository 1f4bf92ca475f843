r"""Another solution beside a given one, against which its error is estimated.

- On an arm that is one smooth piece, a model with balanced sections has no error but that of its
  steps of order p, and steps twice as long have $2^p$ times that error. Without loads, pairs of
  steps are merged into one, with the strain at the new nodes interpolated by the polynomial through
  the old ones: no balance is solved. With loads, lengths or friction, the strain is corrected on
  half as many steps by one Newton step of the whole arm, which leaves far less than the difference.
- Otherwise a finer solution starts from the given one, which saves a full solve. Without loads its
  cross-sections are balanced at twice as many steps of order 6. With loads, lengths or friction the
  strain there is corrected by one Newton step.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array

from ..arm.scene import Scene
from ..mechanics.arm_balance import ArmUnknown, imbalance_of, state_of
from ..mechanics.arm_tangent import approximate_solve
from ..mechanics.balance import solve_balance
from ..mechanics.coupling import ArmProblem
from ..numerics import component as c
from ..numerics.component import Forces, Vector
from ..numerics.magnus import tip_pose
from ..numerics.quadrature import Grid, merging
from ..typing import Pose, cast


class Refinement(NamedTuple):
    """A solution beside the given one.

    **Fields:** the pose of its tip; the strain of the given and of the other one at abscissas X [m]
    (of any shape); by what the distance of the tips and that of the strains are multiplied to bound
    the errors of the given one.
    """

    tip: Pose
    X: Array
    given: Vector
    other: Vector
    tip_factor: float = 1.0
    strain_factor: float = 1.0


def merged_tip(xi: Vector, grid: Grid, base: Pose | None) -> Pose:
    """Pose of the tip by steps twice as long; an odd last step keeps its length."""
    pairs = grid.h.size // 2 * 2
    merged = tuple(
        jnp.asarray(merging(len(x)), x.dtype) @ jnp.concatenate([x[:, 0:pairs:2], x[:, 1:pairs:2]])
        for x in xi
    )
    end = tip_pose(merged, 2 * grid.h[:pairs:2], base)
    return (
        end
        if pairs == grid.h.size
        else tip_pose(tuple(x[:, pairs:] for x in xi), grid.h[pairs:], end)
    )


def balanced_strain(scene: Scene, forces: Forces, xi: Vector, grid: Grid) -> Vector:
    """Strain balanced at each node of a grid alone, from the strain xi there."""
    sections = scene.sections(grid.X)
    return solve_balance(sections, sections.carry(forces), None, scene.free, xi).xi


def corrected_strain(problem: ArmProblem, unknown: ArmUnknown, free: tuple[int, ...]) -> Vector:
    """Strain of a coupled arm, corrected by a Newton step from the given unknowns."""
    at = state_of(unknown.xi, unknown.coupled, problem)
    imbalance = imbalance_of(unknown, at, problem, free)
    step, _, _ = approximate_solve(unknown, at, imbalance, problem, free)
    return c.subtract(unknown, cast(step, unknown.xi[0].dtype)).xi
