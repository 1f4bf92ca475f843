r"""Where an arm touches obstacles: gaps, contact forces and their derivatives by motions.

The outline of the arm is the surface swept by spheres of radius $\rho(X)$ on its axis. On each step
of the grid and for each obstacle the nearest point of the axis is found,

$$\sigma = \arg\min_s \, d(r(s)) - \rho(s) + \epsilon (2 s - 1)^2, \quad 0 \le s \le 1,$$

with the distance d to the obstacle and the polynomial r(s) through the step. The small $\epsilon$
makes it unique where the arm lies along a surface. Contact keeps the gap $d - \rho$ there, without
the term, from being negative. A step along which the gap changes evenly would pass the surface with
its end, by $\epsilon / 2$ at most: of obstacles that an arm may lie along (`lying`) the
end of each step is a place of contact too. For others two places so near to each other only
slow the solve down. The springs of the soft stages resist the least value: its derivative is that
of the gap at a given place, so that they have an energy.

Where the gap has a clear minimum $\epsilon$ vanishes: with the bulge b of the gap over the step,
its end values on average less the middle one, $\epsilon = \epsilon_0 \exp(-(b / \epsilon_0)^2)$ for
b > 0. The sum is then convex in s at least as much as without bulge. $\epsilon_0$ is 1e-3 of the
outline; where contacts jump without end or a first attempt to solve fails, it is $h^2 / (8 L)$, the
bulge on a step of length h of a gap that curves by 1 / L, with the length L of the arm. The contact
force is $\lambda n$ with $n = \nabla d$, and friction as in `slip`.

As an arm slides, its contact passes from step to step. Where the nearest point of a step is its
end, and the step beyond has a nearest point of its own, that step receives the force.

The position r(s) is an integral of the axis with weights $a_j(s)$ for the nodes of the step. A
force at s acts on node j with the share $a_j(s) / a_j(1)$, so that its work is that of the discrete
positions: but for $\epsilon$ the balance is the gradient of a discrete energy. Positions between
the nodes follow from the polynomial through these shares (`Touch.carried`): a jump of the force at
s kinks the axis of an arm that shears, away from the r(s) whose gap is closed.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array

from ..arm.obstacles import Obstacle
from ..arm.rod import Rod
from ..mechanics.applied_load import AppliedLoad, Exerted, Pose, starts_of
from ..numerics.once import once
from ..numerics.quadrature import gauss_legendre, integral_weights, value_weights
from ..numerics.stacked import cross, matmul, product, rows, skew, total
from .nearest import nearest_points
from .slip import Rough, Slip, slip_of


class Surroundings(AppliedLoad):
    r"""The obstacles around an arm, and the contact forces.

    **Fields:** the `obstacles`, the `rod` and the position of its `base`; `flatness` $\epsilon_0$
    [m]; `lift` [m], added to all gaps alike or to each; `stiffness` [N/m] and `width` [m] of
    penalties; `force` [N] of each contact, shape (contacts of a step * steps, ...); `soft`: None,
    or 1 where penalties stand for the forces; `rough`: friction, None without.
    """

    obstacles: tuple[Obstacle, ...]
    rod: Rod
    base: Array
    flatness: Array
    lift: Array
    stiffness: Array
    width: Array
    force: Array
    soft: Array | None
    rough: Rough | None = None

    @property
    def motion(self) -> int:
        return 6

    def scaled(self, share: Array) -> "Surroundings":
        """The same: the forces are unknowns."""
        return self

    def absent(self) -> "Surroundings":
        return self

    def exerted(self, pose: Pose) -> Exerted:
        touch = touch_of(pose, self)
        return Exerted(contact_wrenches(touch), note=touch)

    def within_step(self, exerted: Exerted, step: Array, sigma: Array, *, smooth: bool) -> Array:
        return exerted.note.carried(step, sigma, smooth)


class Touch(NamedTuple):
    r"""Contact of each obstacle with each step, arrays (..., obstacles, steps, *arms), where each
    obstacle may stand twice: also for the ends of the steps (see `nearest_points`).

    **Fields:** `gap` [m]; `normal` (3) and `place` (3) of the contact in the world; `sigma`, its
    place in the step; `shares` (stages) of a force there for the nodes of the step; `force` [N];
    `slip`: friction, None without; `bend` (3, 3): derivative of the force by the displacement
    there, and `slide` times the product of `moved` (6) with itself that by the motion of the
    section, as the contact slides, at a given force; `cell` (stages): 1 for the node in whose cell
    the contact lies, `part` of the cell before it, and `lever` (3) from the node; `handed`: 1 or -1
    where the force of a step is handed on to the next or the last one, since the nearest point is
    not in it, else 0.
    """

    gap: Array
    normal: Array
    place: Array
    sigma: Array
    shares: Array
    force: Array
    slip: Slip | None
    bend: Array
    moved: Array
    slide: Array
    cell: Array
    part: Array
    lever: Array
    handed: Array

    @property
    def push(self) -> Array:
        """Force on the arm (3)."""
        normal = self.force * self.normal
        return normal if self.slip is None else normal + self.slip.force

    def carried(self, step: Array, sigma: Array, smooth: bool) -> Array:
        """Wrench (6, ...) of the contacts of a step on what lies before a place in it, less that on
        its first node, without the moments of forces: all of it before their own place, or spread
        over the step by the polynomial through their shares."""
        shares = self.shares[:, :, step]
        if smooth:
            before = total(value_weights(sigma, shares.shape[0])[:, None] * shares, 0)
        else:
            before = sigma < self.sigma[:, step]
        moment = jnp.zeros_like(self.push) if self.moment is None else self.moment
        return total((before - shares[0]) * jnp.concatenate([moment, self.push])[:, :, step], 1)

    @property
    def moment(self) -> Array | None:
        """Moment on the arm about its axis (3), None without friction."""
        return None if self.slip is None else self.slip.moment

    @property
    def direction(self) -> Array:
        """Wrench (6) of a unit contact force without friction about the node."""
        return jnp.concatenate([cross(self.lever, self.normal), self.normal])

    @property
    def per_force(self) -> Array:
        """Derivative (6) of the wrench about the node by the contact force."""
        if self.slip is None:
            return self.direction
        return self.direction + self.slip.per_force * self._at_outline(self.slip.first)

    @property
    def sliding(self) -> Array:
        """What gives the change of the slope of the gap by the motion (6) there, about the node."""
        turning, force = rows(self.moved, 0, 3), rows(self.moved, 3, 6)
        return jnp.concatenate([turning + cross(self.lever, force), force])

    @property
    def tangents(self) -> Array:
        """Wrenches (6) of unit friction forces in both directions about the node, those in the
        second one after all in the first."""
        assert self.slip is not None
        both = self.slip.first, self.slip.second
        return jnp.concatenate([self._at_outline(x) for x in both], axis=1)

    @property
    def slips(self) -> Array:
        """As `tangents`, wrenches whose work over a motion is the slip in both directions."""
        slip = self.slip
        assert slip is not None
        both = [
            jnp.concatenate([cross(self.lever, x) + slip.turning(x), x])
            for x in (slip.first, slip.second)
        ]
        return jnp.concatenate(both, axis=1)

    def _at_outline(self, force: Array) -> Array:
        """Wrench of a force at the outline about the node."""
        assert self.slip is not None
        return jnp.concatenate([cross(self.lever + self.slip.lever, force), force])


def touch_of(pose: Pose, around: Surroundings) -> Touch:
    """Contact of an arm in a pose."""
    axis, rotation, grid = pose.axis, pose.rotation, pose.grid
    starts = starts_of(around.base, axis, grid)
    near = nearest_points(around.obstacles, around.rod, around.flatness, starts, axis, grid)
    # empty steps, all at one place, touch nothing
    lift = around.lift + jnp.where(grid.h > 0, 0.0, 1e3 * around.rod.length)
    gap, raised = near.gap + lift, near.raised + lift
    handed = _handed(near.nearer, grid.h > 0)
    force = around.force.reshape(gap.shape)
    if around.soft is not None:
        handed = jnp.where(around.soft > 0, 0.0, handed)
    force = (1 - jnp.abs(handed)) * force + received(handed, force)
    bend = near.bend
    if around.soft is None:
        bend = force * bend
    else:
        root = jnp.sqrt(raised**2 + around.width**2)
        penalty = 0.5 * around.stiffness * (root - raised)
        rate = 0.5 * around.stiffness * (raised / root - 1)
        force = jnp.where(around.soft > 0, penalty, force)
        rate = jnp.where(around.soft > 0, rate, 0.0)
        bend = force * bend + rate * near.normal[:, None] * near.normal
    stages = grid.X.shape[0]
    cumulative = integral_weights(near.sigma, stages)
    slip = None
    if around.rough is not None:
        values = value_weights(near.sigma, stages)
        at = near.place, near.normal, force, near.outline
        slip = slip_of(around.rough, *at, cumulative, values, rotation, grid)
    weights = gauss_legendre(stages)[1].reshape(-1, *(1,) * near.sigma.ndim)
    shares = cumulative / jnp.asarray(weights, cumulative.dtype)
    cell, part = _cell_of(near.sigma, stages)
    along = grid.weight * axis
    nodes = starts[:, None] + jnp.cumsum(along, axis=1) - 0.5 * along
    lever = near.place - total(cell * nodes[:, :, None], 1)
    found = Touch(
        gap,
        near.normal,
        near.place,
        near.sigma,
        shares,
        force,
        slip,
        bend,
        near.moved,
        force * near.slide,
        cell,
        part,
        lever,
        handed,
    )
    return jax.tree.map(once, found)


def contact_wrenches(touch: Touch) -> Array:
    """Wrench by all contacts beyond each node in the world, (6, stages, steps, *arms), without the
    moments of their forces about the node."""

    def beyond(x: Array) -> Array:
        of_step = total(x, 1)
        later = lax.cumsum(of_step, axis=1, reverse=True) - of_step
        return later[:, None] + total(touch.shares[None] * x[:, None], 2)

    push, moment = beyond(touch.push), touch.moment
    return jnp.concatenate([jnp.zeros_like(push) if moment is None else beyond(moment), push])


def motions_at(cell: Array, motions: Array) -> Array:
    """Motions (6, n, steps, *arms) of what lies in given cells, from those of all cells."""
    return total(cell * motions[:, :, None], 1)


def touch_slopes(touch: Touch) -> tuple[Array, ...]:
    """Derivatives of the contact wrenches by the motions of the arm there, about the nodes of their
    cells, in blocks (3, 3, obstacles, steps, *arms): of moments by rotations and displacements,
    then of forces."""
    d = skew(touch.lever)
    turning, force = (once(x) for x in (rows(touch.sliding, 0, 3), rows(touch.sliding, 3, 6)))
    above, below = matmul(d, touch.bend), matmul(touch.bend, d)
    corner = product(skew(touch.push) - above, d)
    moment, push = ((touch.slide * x)[:, None] for x in (turning, force))
    return (
        corner + moment * turning,
        above + moment * force,
        push * turning - below,
        touch.bend + push * force,
    )


def _cell_of(sigma: Array, stages: int) -> tuple[Array, Array]:
    """1 for the node in whose cell a place in the step lies, else 0, and the part of the cell
    before it."""
    weights = gauss_legendre(stages)[1]
    ends = np.cumsum(weights)
    first, last = (
        jnp.asarray(x, sigma.dtype).reshape(-1, *(1,) * sigma.ndim)
        for x in (np.append(-np.inf, ends[:-1]), np.append(ends[:-1], np.inf))
    )
    cell = ((sigma >= first) & (sigma < last)).astype(sigma.dtype)
    starts, widths = (
        total(cell * jnp.asarray(x, sigma.dtype).reshape(first.shape), 0)
        for x in (ends - weights, weights)
    )
    return cell, (sigma - starts) / widths


def _handed(nearer: Array, there: Array) -> Array:
    """1 or -1 where the force of a step belongs to the next or the last one, which has a nearest
    point of its own, else 0, shape (obstacles, steps, *arms).

    Over more steps the forces of an arm that lies along a surface would jump to and fro; where the
    joint of two steps is nearest in both, the second one keeps the force."""
    own = there[None] & jnp.ones(nearer.shape, bool)
    next_own = _beside((own & (nearer <= 0)).astype(nearer.dtype), -1)
    last_own = _beside((own & (nearer == 0)).astype(nearer.dtype), 1)
    return jnp.where(nearer > 0, next_own, jnp.where(nearer < 0, -last_own, 0.0))


def _beside(x: Array, shift: int) -> Array:
    """Values (obstacles, steps, *arms) of the steps before (1) or after (-1) each, zero at the
    end."""
    rest = [(0, 0)] * (x.ndim - 2)
    if shift > 0:
        return jnp.pad(x[:, :-1], [(0, 0), (1, 0), *rest])
    return jnp.pad(x[:, 1:], [(0, 0), (0, 1), *rest])


def received(handed: Array, x: Array) -> Array:
    """What each step receives of numbers (obstacles, steps, *arms) that are handed on."""
    forth, back = jnp.maximum(handed, 0.0) * x, jnp.maximum(-handed, 0.0) * x
    return _beside(forth, 1) + _beside(back, -1)
