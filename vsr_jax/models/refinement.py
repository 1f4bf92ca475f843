r"""Better solutions than a given one, against which its error is estimated.

- Without loads, on an arm that is one smooth piece, a model with balanced sections has no error but
  that of its steps. Pairs of steps are merged into one, with the strain at the new nodes
  interpolated by the polynomial through the old ones: no balance is solved, and the tip moves by
  $2^p - 1$ times its error for steps of order p.
- Otherwise a finer solution starts from the given one, which saves a full solve. Without loads its
  cross-sections are balanced at twice as many steps of order 6. With loads, lengths or friction the
  strain there is corrected by Newton steps of the whole arm with the approximate tangent, which
  leave a tenth of the error or less.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array

from ..arm.scene import Scene
from ..mechanics.arm_balance import ArmUnknown, imbalance_of, problem_of, state_of
from ..mechanics.arm_tangent import approximate_solve
from ..mechanics.balance import solve_balance
from ..numerics import component as c
from ..numerics.component import Forces, Vector
from ..numerics.magnus import tip_pose
from ..numerics.quadrature import Grid, merging
from ..typing import Pose, cast

CORRECTIONS = 3
"""Newton steps that correct the strain on a finer grid: each gains one to two digits, and the
strain that they begin with has about four."""


class Refinement(NamedTuple):
    """A solution beside the given one: the pose of its tip, the strain of both at the abscissas X
    [m] (of any shape), and by what the distance of the tips is multiplied to bound the error."""

    tip: Pose
    X: Array
    given: Vector
    better: Vector
    factor: float


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


def corrected_strain(
    scene: Scene, inputs: Array, forces: Forces, xi: Vector, turning: Vector, grid: Grid
) -> Vector:
    """Strain of a coupled arm on a grid, corrected from xi and the turning rates there."""
    problem, kind = problem_of(scene, inputs, grid)

    def correct(_: Array, unknown: ArmUnknown) -> ArmUnknown:
        at = state_of(unknown, problem, kind)
        step, _, _ = approximate_solve(
            unknown, at, imbalance_of(unknown, at, problem, kind), problem, kind
        )
        return c.subtract(unknown, cast(step, xi[0].dtype))

    start = ArmUnknown(xi, tuple(-forces[place] for place in kind.cables), turning)
    return lax.fori_loop(0, CORRECTIONS, correct, start).xi
