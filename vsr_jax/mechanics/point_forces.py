"""Forces of a coupling at places of the arm, in the tangent system.

What is joined of blocks is joined at the end, without the axis of the obstacles: XLA chooses the
block again for every number of a joined array.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, PyTree

from ..numerics.once import once
from ..numerics.stacked import blocks, columns, rows as rows_of, total
from .slip import Slip
from .touch import Touch, motions_at, received, touch_slopes


class PointForces(NamedTuple):
    r"""Part of a coupling whose unknowns are forces at places of the arm, one or more per step, in
    the tangent system: $\delta x = (s - f \, a^T z) / c$ with the motion z of the arm there, and
    the wrench w of a unit force, a without friction. Springs of the stiffness $f w a^T / c$ stand
    for them in the elimination, in place of a border.

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

    wrench: Array
    direction: Array
    cell: Array
    part: Array
    factors: Array
    corner: Array
    handed: Array
    slip: Slip | None = None

    def slopes(self, touch: Touch) -> tuple[Array, Array]:
        """Derivatives (6, 6, stages, steps, ...) of the wrenches by the motions in the cells, those
        of the contacts included, and the part of each cell (stages, steps, ...) before them: of
        several the mean, the stiffest first."""
        stiffness, size = once(self.factors) / self.corner, len(touch.gap)
        cell, push = self.cell[:, :size], once(stiffness * self.wrench)

        def in_cells(block: Array, first: int, second: int) -> Array:
            wrench = rows_of(push, first, first + 3)
            direction = rows_of(self.direction, second, second + 3)
            for place in range(0, wrench.shape[1], size):  # the springs of each direction
                w, a = (columns(x, place, place + size) for x in (wrench, direction))
                block = block - w[:, None] * a
            return total(cell * once(block)[:, :, None], 3)

        by_turn, by_shift, turned, shifted = touch_slopes(touch)
        cells = blocks(
            in_cells(by_turn, 0, 0),
            in_cells(by_shift, 0, 3),
            in_cells(turned, 3, 0),
            in_cells(shifted, 3, 3),
        )
        stiffness, least = self.cell * stiffness, float(jnp.finfo(stiffness.dtype).tiny)
        part = total(stiffness * self.part, 1) / (total(stiffness, 1) + least)
        return cells, part

    def pushes(self, rows: PyTree) -> Array:
        """Changes (6, stages, steps, ...) of the wrenches by given rows (n * steps, ...) alone."""
        force = self._listed(rows) / self.corner
        if self.slip is not None:  # friction on the arm is what its unknown is without the row
            first, *tangents = jnp.split(self._listed(rows), 3)
            force = force - jnp.concatenate([jnp.zeros_like(first), *tangents])
        return total(self.cell * once(force * self.wrench)[:, None], 2)

    def change(self, rows: PyTree, motions: Array) -> PyTree:
        """Changes of the unknowns for given rows and motions in the cells (6, stages, steps,
        ...)."""
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
