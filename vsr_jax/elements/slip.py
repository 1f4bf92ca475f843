r"""Friction of contact: stick and slip where an arm touches obstacles, along a path of inputs.

A contact force $\lambda n$ comes with a friction force f at the outline of the arm, at the lever
$b = -\rho n$ from the axis. Since the inputs before, the material point that is in contact there
has moved by the tangential part of

$$\Delta = r + b - (r_0 + R_0 R^T b),$$

with the pose $(R_0, r_0)$ that its section had. It sticks, $\Delta = 0$ with $|f| \le \mu \lambda$,
or slips, $f = -\mu \lambda \Delta / |\Delta|$. Both are one equation,

$$f = P(y), \quad y = f - c \Delta, \quad P(y) = y \min(1, \mu \lambda / |y|),$$

the projection onto the disc of Coulomb's law, for any $c > 0$. Newton's method solves it with the
unknown f, in the directions $t_1$ of y and $t_2 = n \times t_1$. The force on the arm is P(y), so
that it keeps to Coulomb's law on the way, too. c is ten times the stiffness of the arm up to the
contact: with a much smaller one contacts that slip far are first taken to stick, which demands
forces far beyond Coulomb's limit.

**Source:** P. Alart and A. Curnier, A mixed formulation for frictional contact problems prone to
Newton like solution methods, Computer Methods in Applied Mechanics and Engineering 92 (1991).
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array

from ..mechanics.applied_load import starts_of
from ..numerics.quadrature import Grid
from ..numerics.stacked import cross, matmul, matvec, transpose

_AT_LIMIT = 1 - 1e-6
"""Share of Coulomb's limit from which a contact slips: one that slipped before is at the limit, but
for rounding."""


class Traces(NamedTuple):
    """What contacts remember of the inputs before: position of the base (3,), the axis p' (3,
    stages, steps) and the rotations (3, 3, stages, steps) at the nodes."""

    base: Array
    axis: Array
    rotation: Array


class Rough(NamedTuple):
    """Friction of obstacles.

    **Fields:** the coefficients (obstacles, ...); the stiffness c [N/m] on each step, `grip`
    (steps, ...); the friction [N] that counts as none, `least`; the unknown `force` [N] of each
    obstacle on each step (3, obstacles * steps, ...); and what is remembered.
    """

    friction: Array
    grip: Array
    least: Array
    force: Array
    traces: Traces


class Slip(NamedTuple):
    r"""Friction of all contacts, arrays (..., obstacles, steps, *arms).

    **Fields:** `force` P(y) (3) and the `row` $f - P(y)$ (3); `lever` b (3); the directions `first`
    and `second` (3); `per_force`: derivative of f along the first one by the contact force, $\mu$
    where it slips; `kept` (2): in both directions the derivative of P(y) by y; `back` (3, 3):
    $R_0 R^T$.
    """

    force: Array
    row: Array
    lever: Array
    first: Array
    second: Array
    per_force: Array
    kept: Array
    back: Array

    def along(self, rows: Array) -> Array:
        """Components (2, ...) of vectors (3, ...) in both directions."""
        return jnp.stack([jnp.sum(x * rows, axis=0) for x in (self.first, self.second)])

    def change(self, force: Array, first: Array, second: Array, rows: Array) -> Array:
        """Change of the friction (3, ...) by those of the contact force and of the friction in both
        directions at a given one; across them it is that of the `rows`."""
        one, other = self.along(rows)
        first, second = first + self.per_force * force - one, second - other
        return rows + first * self.first + second * self.second

    @property
    def moment(self) -> Array:
        """Moment about the axis (3)."""
        return cross(self.lever, self.force)

    def turning(self, x: Array) -> Array:
        r"""What gives the change of $\Delta$ in a direction (3, ...) as the section turns (3, ...)
        about the axis."""
        return cross(self.lever, matvec(transpose(self.back), x))


def slip_of(
    rough: Rough,
    place: Array,
    normal: Array,
    force: Array,
    outline: Array,
    cumulative: Array,
    values: Array,
    rotation: Array,
    grid: Grid,
) -> Slip:
    r"""Friction of contacts (..., obstacles, steps, *arms).

    **Arguments:** `place` (3), `normal` (3), `force` $\lambda$ and `outline` $\rho$ of the
    contacts; `cumulative` (stages): weights of the nodes in integrals from the start of the step to
    each place, `values` (stages) in the polynomial there; `rotation` (3, 3, stages, steps, *arms)
    at the nodes.
    """
    lever, friction = -outline * normal, rough.force.reshape(3, *force.shape)
    back = matmul(rough.traces.rotation, transpose(rotation))
    back = jnp.sum(values * back[:, :, :, None], axis=2)
    moved = place - _old_place(rough.traces, cumulative, grid) + lever - matvec(back, lever)
    y = friction - rough.grip * moved
    y = y - jnp.sum(normal * y, axis=0) * normal
    limit = rough.friction[:, None] * jnp.maximum(force, 0.0)
    square = jnp.sum(y**2, axis=0)
    there = square > 0
    size = jnp.sqrt(jnp.where(there, square, 1.0))
    pressed = limit > rough.least
    slips = there & (size > _AT_LIMIT * limit)
    share = jnp.where(slips, limit / size, 1.0)
    share = jnp.where(pressed, jnp.minimum(share, 1.0), 0.0)
    first = jnp.where(there, y / size, _across(normal))
    return Slip(
        share * y,
        friction - share * y,
        lever,
        first,
        cross(normal, first),
        jnp.where(slips & pressed, rough.friction[:, None], 0.0),
        jnp.stack([jnp.where(slips, 0.0, share), share]),
        back,
    )


def _across(normal: Array) -> Array:
    """A direction across a unit vector (3, ...)."""
    x, y, z = normal
    zero, steep = jnp.zeros_like(x), jnp.abs(z) > 0.5
    across = jnp.where(steep, jnp.stack([zero, -z, y]), jnp.stack([-y, x, zero]))
    square = jnp.sum(across**2, axis=0)
    return across / jnp.sqrt(jnp.where(square > 0, square, 1.0))


def _old_place(traces: Traces, cumulative: Array, grid: Grid) -> Array:
    """Where the points of the axis at the contacts were (3, obstacles, steps, *arms)."""
    starts = starts_of(traces.base, traces.axis, grid)
    within = jnp.sum(cumulative * traces.axis[:, :, None], axis=1)
    return starts[:, None] + grid.h * within


def moved_to(traces: Traces, X: Array, grid: Grid) -> Traces:
    """Traces at the nodes of a grid from those at the nodes X, by linear interpolation."""
    nodes = X.T.reshape(-1)

    def at_nodes(y: Array) -> Array:
        flat = jnp.swapaxes(y, -1, -2).reshape(-1, nodes.size)
        found = [jnp.interp(grid.X, nodes, one) for one in flat]
        return jnp.stack(found).reshape(*y.shape[:-2], *grid.X.shape)

    return Traces(traces.base, at_nodes(traces.axis), at_nodes(traces.rotation))
