r"""Contacts in the tangent system: springs in the cells of the chain, and how contacts slide.

The nearest point of a step is where the slope g' of the gap vanishes, and it depends on the shear
strains $\upsilon_j$ at the nodes of the step. As the point slides by $-\delta g' / g''$, the shares
of its force $\lambda n$ at the nodes change, and by that the shear strains. With the values
$\ell_j(\sigma)$ of the polynomials of the nodes, their weights $w_j$, the length h of the step and
the compliance c of shear,

$$\delta g' = m \cdot z + h \sum_j \ell_j \, n \cdot \upsilon_j, \quad
\upsilon_j = c \, (r_j + f_j), \quad
f_j = -\frac{\lambda}{g''} \frac{\ell_j}{w_j} n \, \delta g',$$

where z is the motion of the arm there and r a residual, all in the world's axes. The elimination
along the arm knows the motions only, so this is solved for each contact alone:

$$\delta g' = \frac{m \cdot z + h \sum_j \ell_j \, n \cdot c \, r_j}
{1 + h \tfrac{\lambda}{g''} \sum_j \tfrac{c}{w_j} \ell_j^2}.$$

Without it the steps of Newton's method shrink by a factor of 0.4 to 0.7 only where a soft arm is
pressed against an obstacle.

What is joined of blocks is concatenated last, without the axis of the obstacles: XLA chooses the
block again for every number of a joined array.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, PyTree

from ..chain import Coupled
from ..mechanics.applied_load import Pose
from ..mechanics.coupling import ArmProblem
from ..numerics.component import Vector
from ..numerics.once import once
from ..numerics.quadrature import gauss_legendre, value_weights
from ..numerics.stacked import (
    blocks,
    columns,
    components,
    matvec,
    rows as rows_of,
    stack,
    total,
    transpose,
)
from .slip import Slip
from .touch import Touch, motions_at, received, touch_slopes


class ContactSprings(NamedTuple):
    r"""Contacts in the tangent system: their forces act at places of the arm, one or more per step,
    and change by $\delta x = (s - f \, a^T z) / c$ with the motion z of the arm there, and
    the wrench w of a unit force, a without friction. Springs of the stiffness $f w a^T / c$ stand
    for them in the elimination, in place of a border.

    - `touch`: the contacts; `sliding`: how they slide by shear, None where nothing shears.
    - `wrench`, `direction`: w and a, in the world frame about the node in whose cell they act,
      shape (6, n, steps, ...).
    - `cell`: 1 for that node, else 0, shape (stages, n, steps, ...); `part` of the cell before
      them, shape (n, steps, ...).
    - `factors`, `corner`: f and c, shape (n, steps, ...).
    - `handed`: 1 or -1 where the unknown of a step is part of the force of the next or the last
      one, else 0, shape (n, steps, ...); f is zero and c is 1 for it.
    - `slip`: friction of the first n / 3 of them, which acts along the others; None without. Rows
      and unknowns then are pairs: of contact forces (n / 3 * steps, ...) and of friction (3, n / 3
      * steps, ...). Friction of pairs without `slip` is zero.
    """

    touch: Touch
    sliding: "Sliding | None"
    wrench: Array
    direction: Array
    cell: Array
    part: Array
    factors: Array
    corner: Array
    handed: Array
    slip: Slip | None = None

    def symmetric(self) -> "ContactSprings":
        """With the contact forces that friction follows held."""
        return self._replace(wrench=self.direction)

    def added_to(self, coupled: Coupled) -> Coupled:
        """With the derivatives of the wrenches by the motions in the cells, those of the contacts
        included, and the part of each cell before them: of several the mean, the stiffest first."""
        stiffness, size = once(self.factors) / self.corner, len(self.touch.gap)
        cell, push = self.cell[:, :size], once(stiffness * self.wrench)

        def in_cells(block: Array, first: int, second: int) -> Array:
            wrench = rows_of(push, first, first + 3)
            direction = rows_of(self.direction, second, second + 3)
            for place in range(0, wrench.shape[1], size):  # the springs of each direction
                w, a = (columns(x, place, place + size) for x in (wrench, direction))
                block = block - w[:, None] * a
            return total(cell * once(block)[:, :, None], 3)

        by_turn, by_shift, turned, shifted = touch_slopes(self.touch)
        cells = blocks(
            in_cells(by_turn, 0, 0),
            in_cells(by_shift, 0, 3),
            in_cells(turned, 3, 0),
            in_cells(shifted, 3, 3),
        )
        stiffness, least = self.cell * stiffness, float(jnp.finfo(stiffness.dtype).tiny)
        part = total(stiffness * self.part, 1) / (total(stiffness, 1) + least)
        return coupled._replace(cells=cells, part=part)

    def driven(self, right: Vector, rows: PyTree) -> tuple[Vector, Array]:
        """A right side for the strains, with what the sliding that it causes adds, and the changes
        (6, stages, steps, ...) of the wrenches in the cells by rows (n * steps, ...) and sliding.
        """
        push = self._pushes(rows)
        if self.sliding is None:
            return right, push
        right, more = self.sliding.driven(right)
        return right, push + more

    def followed(self, strain: Vector, rows: PyTree, motions: Array) -> tuple[Vector, PyTree]:
        """The change of strain, with the shear by motions in the cells (6, stages, steps, ...), and
        the changes of the forces by these and by rows."""
        changes = self._changes(rows, motions)
        if self.sliding is None:
            return strain, changes
        return self.sliding.followed(strain, motions), changes

    def _pushes(self, rows: PyTree) -> Array:
        force = self._listed(rows) / self.corner
        if self.slip is not None:  # friction on the arm is what its unknown is without the row
            first, *tangents = jnp.split(self._listed(rows), 3)
            force = force - jnp.concatenate([jnp.zeros_like(first), *tangents])
        return total(self.cell * once(force * self.wrench)[:, None], 2)

    def _changes(self, rows: PyTree, motions: Array) -> PyTree:
        moved = self.factors * total(self.direction * motions_at(self.cell, motions), 0)
        change = (self._listed(rows) - moved) / self.corner
        change = change - received(self.handed, change)
        if self.slip is None:
            none = isinstance(rows, tuple)
            return (change.reshape(rows[0].shape), rows[1]) if none else change.reshape(rows.shape)
        force, first, second = jnp.split(change, 3)
        friction = self.slip.change(force, first, second, rows[1].reshape(3, *force.shape))
        return force.reshape(rows[0].shape), friction.reshape(rows[1].shape)

    def _listed(self, rows: PyTree) -> Array:
        """Rows (n, steps, ...)."""
        if self.slip is None:
            return (rows[0] if isinstance(rows, tuple) else rows).reshape(self.corner.shape)
        along = self.slip.along(rows[1].reshape(self.slip.force.shape))
        return jnp.concatenate([rows[0].reshape(along.shape[1:]), *along])


class Sliding(NamedTuple):
    r"""Sliding by shear.

    **Fields:** the `touch`, whose `slide` includes shear; `values` $\ell$ (stages, obstacles,
    steps, *arms); `shares` $h / w$ of the nodes of a step (stages, 1, ...), and the `compliance` c,
    of the shear strains that are `free`, (stages, steps, *arms); the `rotation` of the nodes and
    the lengths `h`.
    """

    touch: Touch
    values: Array
    shares: Array
    compliance: Array
    free: tuple[int, ...]
    rotation: Array
    h: Array

    def driven(self, right: Vector) -> tuple[Vector, Array]:
        """A residual (six components) with the forces by sliding that it causes, and the change of
        the wrenches (6, stages, steps, *arms) by these in the cells."""
        touch = self.touch
        shear = self.compliance * matvec(self.rotation, stack(right[3:]))
        slope = total(self.values * shear[:, :, None], 1)
        slope = once(touch.slide * self.h * total(touch.normal * slope, 0))
        push = total(touch.cell * (slope * touch.sliding)[:, None], 2)
        return _with_force(right, self._forces(slope)), push

    def followed(self, strain: Vector, motions: Array) -> Vector:
        """A change of strain with the shear by motions in the cells."""
        touch = self.touch
        slope = once(touch.slide * total(touch.sliding * motions_at(touch.cell, motions), 0))
        return _with_force(strain, self.compliance * self._forces(slope))

    def _forces(self, slope: Array) -> Array:
        """Forces f in the axes of the nodes (3, stages, steps, *arms), those of locked strains
        zero."""
        force = total(self.values * (slope * self.touch.normal)[:, None], 2)
        force = self.shares * matvec(transpose(self.rotation), force)
        zero = jnp.zeros_like(force[0])
        return stack(tuple(x if i in self.free else zero for i, x in enumerate(force, 3)))


def sliding_of(
    touch: Touch, pose: Pose, problem: ArmProblem, free: tuple[int, ...]
) -> tuple[Touch, Sliding | None]:
    """The contacts whose `slide` includes shear, and how they slide by it; None where nothing
    shears."""
    stiffness, grid, sheared = problem.sections.stiffness, problem.grid, [i for i in free if i > 3]
    if not sheared:
        return touch, None
    compliance = 1 / stiffness[sheared[0]]
    for i in sheared[1:]:
        compliance = jnp.maximum(compliance, 1 / stiffness[i])
    if problem.sections.flexible is not None:
        compliance = compliance * problem.sections.flexible
    stages = grid.X.shape[0]
    values, weights = value_weights(touch.sigma, stages), gauss_legendre(stages)[1]
    shares = jnp.asarray(1 / weights, grid.h.dtype).reshape(-1, *(1,) * grid.h.ndim)
    gain = total(values**2 * (shares * compliance)[:, None], 0)
    touch = touch._replace(slide=touch.slide / (1 - grid.h * touch.slide * gain))
    return touch, Sliding(touch, values, shares, compliance, tuple(sheared), pose.rotation, grid.h)


def _with_force(wrench: Vector, force: Array) -> Vector:
    """Six components and a force more."""
    return (
        *wrench[:3],
        *(x + more for x, more in zip(wrench[3:], components(force), strict=True)),
    )
