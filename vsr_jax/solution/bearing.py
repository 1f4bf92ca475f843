"""What holds an arm and what it touches: support reactions, contacts, and the tangent of an arm
that they constrain."""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float

from ..arm.scene import CrossSections
from ..mechanics.arm_balance import ArmUnknown, imbalance_of, state_of
from ..mechanics.balance import ALL, free_components, spread
from ..mechanics.contact import Contacts
from ..mechanics.coupling import ArmProblem
from ..mechanics.held import Holds
from ..mechanics.nearest import lying
from ..mechanics.touch import Surroundings, Touch, received
from ..numerics import lu
from ..numerics.component import Vector
from ..numerics.lanczos import Operator
from ..numerics.quadrature import Grid
from ..typing import DTypeLike


class Contact(NamedTuple):
    """Contact of each obstacle with each step along the arm, where the gap is least, and in scenes
    with planes or tubes without friction with the end of each step too (of other obstacles, and
    where a section is held, the same place once more, without force). Of places that coincide, as
    at a tip, one has the force, so that the sum is that of all contacts.

    **Fields:** with the obstacles in the first axis and the places, one or two per step, in the
    second, the abscissa `X` [m]; `position` [m] of the axis in the world; `normal` of the obstacle;
    `gap` [m] between the outline and the obstacle; `force` [N] along the normal, nearly 0 where
    they do not touch; `friction` [N] on the arm, a vector of the world along the surface, zero
    unless the arm follows a path of inputs (`vsr_jax.follow`).
    """

    X: Float[Array, "obstacles places"]
    position: Float[Array, "obstacles places 3"]
    normal: Float[Array, "obstacles places 3"]
    gap: Float[Array, "obstacles places"]
    force: Float[Array, "obstacles places"]
    friction: Float[Array, "obstacles places 3"]


def no_contact(dtype: DTypeLike) -> Contact:
    """That of an arm without obstacles."""
    none, vectors = jnp.zeros((0, 0), dtype), jnp.zeros((0, 0, 3), dtype)
    return Contact(none, vectors, vectors, none, none, vectors)


def supports_of(problem: ArmProblem, unknown: ArmUnknown) -> Float[Array, "supports 6"]:
    """Moment and force in the world frame by which each held section is held."""
    found = zip(problem.couplings, unknown.coupled, strict=True)
    return jnp.concatenate([one.wrenches(x) for one, x in found if isinstance(one, Holds)])


def contacts_of(problem: ArmProblem, unknown: ArmUnknown) -> Contact:
    """The contacts of an arm with obstacles."""
    at, grid = state_of(unknown.xi, unknown.coupled, problem), problem.grid
    assert at.along is not None
    assert at.loads is not None
    touch, around = at.along.touch, at.loads.around
    assert touch is not None
    assert around is not None
    friction = jnp.zeros_like(touch.normal) if touch.slip is None else touch.slip.force
    which, pushes, force = _places(touch, around, grid)
    steps = jnp.arange(len(grid.h))[:, None]

    def listed(x: Array) -> Array:
        """Numbers (..., contacts of a step, steps) as (..., obstacles, places)."""
        return x[..., which, steps].reshape(*x.shape[:-2], len(around.obstacles), -1)

    def vectors(x: Array) -> Array:
        return jnp.moveaxis(listed(x), 0, -1)

    return Contact(
        listed(grid.start + touch.sigma * grid.h),
        vectors(touch.place),
        vectors(touch.normal),
        listed(touch.gap),
        force,
        jnp.where(pushes[..., None], vectors(friction), 0.0),
    )


def _places(touch: Touch, around: Surroundings, grid: Grid) -> tuple[Array, Array, Array]:
    """The contacts of a step at its places (obstacles, steps, 1 or 2), whether they are those of
    the places (obstacles, places), and their forces there: an obstacle without a contact at the end
    of a step has the nearest one twice."""
    count, ends = len(around.obstacles), lying(around.obstacles)
    first = jnp.broadcast_to(jnp.arange(count)[:, None], (count, touch.gap.shape[1]))
    if not ends:
        return first[..., None], jnp.ones_like(first, bool), touch.force
    second = np.array([count + ends.index(i) if i in ends else i for i in range(count)])
    lifted = jnp.broadcast_to(around.lift, touch.gap.shape)[second] > 0
    there = ~lifted & (second >= count)[:, None]
    which = jnp.stack([first, jnp.where(there, second[:, None], first)], -1)
    pushes = jnp.stack([jnp.ones_like(there), there], -1).reshape(count, -1)
    force = _at_ends(touch, second, there & (grid.h > 0))
    return which, pushes, force.reshape(count, -1)


def _at_ends(touch: Touch, second: np.ndarray, there: Array) -> Array:
    """Forces of nearest points and of ends of steps (obstacles, steps, 2), with those of nearest
    points that are ends at the ends."""
    sigma, near = touch.sigma[: len(second)], touch.force[: len(second)]
    before = received(jnp.ones_like(near), there.astype(near.dtype))
    at_end, at_start = there & (sigma >= 1), (before > 0) & (sigma <= 0)
    end = jnp.where(there, touch.force[second], 0.0) + jnp.where(at_end, near, 0.0)
    end += received(-at_start.astype(near.dtype), near)
    return jnp.stack([jnp.where(at_end | at_start, 0.0, near), end], -1)


class Supported(eqx.Module):
    """An arm with what holds it and what it touches; `units` scales changes of the free strains,
    and `ties` are the scaled changes that held sections, contacts and taut cables prevent: rows C,
    and `share`, $(C C^T)^{-1} C$."""

    problem: ArmProblem
    unknown: ArmUnknown
    units: Float[Array, "strains stages steps"]
    ties: Float[Array, "ties changes"]
    share: Float[Array, "ties changes"]
    free: tuple[int, ...] = eqx.field(static=True)

    def tangent(self) -> "SupportedTangent":
        """The scaled tangent as an operator."""
        return SupportedTangent(self)

    def form(self, v: Array) -> Array:
        """$v^T S v$ with S the scaled tangent."""
        x = self.allowed(v)
        return jnp.sum(x * self.times(x))

    def times(self, v: Array) -> Array:
        """The scaled tangent, where the wrenches of supports and contacts keep their sizes."""
        weight = self.problem.grid.weight

        def imbalance(v: Array) -> Array:
            change = spread(tuple(self.units * v), self.free)
            xi = tuple(x + y for x, y in zip(self.unknown.xi, change, strict=True))
            unknown = self.unknown._replace(xi=xi)
            at = state_of(xi, unknown.coupled, self.problem)
            return jnp.stack(imbalance_of(unknown, at, self.problem, self.free).wrench)

        return weight * self.units * jax.jvp(imbalance, (jnp.zeros_like(v),), (v,))[1]

    def allowed(self, v: Array) -> Array:
        """Orthogonal projection onto the changes that nothing prevents."""
        v = jnp.where(self.units > 0, v, 0.0)
        return v - (self.ties.T @ (self.share @ v.reshape(-1))).reshape(v.shape)


class SupportedTangent(Operator):
    """Symmetric part of the scaled tangent of a `Supported` arm."""

    arm: Supported

    @property
    def like(self) -> Array:
        return self.arm.units

    def allowed(self, v: Array) -> Array:
        return self.arm.allowed(v)

    def times(self, v: Array) -> Array:
        back = jax.linear_transpose(self.arm.times, self.like)
        v = self.allowed(v)
        return self.allowed(0.5 * (self.arm.times(v) + back(v)[0]))


def units_of(
    sections: CrossSections, grid: Grid, free: tuple[int, ...]
) -> Float[Array, "strains stages steps"]:
    r"""Units of changes of the free strains, $\Sigma^{-1/2} W^{-1/2}$ with W the weights of the
    nodes; zero on rigid pieces and at nodes of zero weight, where nothing changes."""
    stiffness = jnp.stack(
        [jnp.broadcast_to(s, grid.X.shape) for s in free_components(sections.stiffness, free)]
    )
    there = grid.weight > 0
    if sections.flexible is not None:
        there &= sections.flexible > 0
    return jnp.where(there, 1 / jnp.sqrt(jnp.where(there, grid.weight, 1.0) * stiffness), 0.0)


def supported(problem: ArmProblem, unknown: ArmUnknown, free: tuple[int, ...]) -> Supported:
    """The arm of a solution with what holds it."""
    units = units_of(problem.sections, problem.grid, ALL)
    at = state_of(unknown.xi, unknown.coupled, problem)
    ties = []
    for coupling, x, note in zip(problem.couplings, unknown.coupled, at.notes, strict=True):
        if isinstance(coupling, Contacts):
            points = coupling.points(x, at, note, problem)
            # friction, of the points behind, does not hold an arm
            rows = coupling.rows(at, note, problem.grid)
            corner = points.corner[: coupling.per_step].reshape(-1)
        else:
            border = coupling.border(x, at, note, problem)
            if border is None:
                continue
            rows, corner = border.rows, border.corner
        ties.append(_ties(rows, corner < _HOLDING, problem.grid.weight * units, free))
    tied = jnp.concatenate(ties)
    return Supported(problem, unknown, units[np.asarray(free)], tied, _shares(tied), free)


def _ties(
    rows: Vector, holds: Bool[Array, " ties"], scale: Array, free: tuple[int, ...]
) -> Float[Array, "ties changes"]:
    """Unit rows over the scaled changes of the free strains, zero for rows that do not hold the
    arm: also where the free strains have no more than rounding of what all six have, as in the turn
    about its axis of a straight arm without torsion."""
    every = jnp.stack(rows, axis=1) * scale
    row = every[:, np.asarray(free)].reshape(len(every), -1)
    size, whole = (
        jnp.linalg.norm(lax.stop_gradient(x).reshape(len(x), -1), axis=1) for x in (row, every)
    )
    holds &= size > jnp.sqrt(jnp.finfo(size.dtype).eps) * whole
    return jnp.where(holds, 1 / jnp.where(holds, size, 1.0), 0.0)[:, None] * row


_HOLDING = 0.5
"""Entry in the corner of a tangent system below which its row holds the arm: 1 where it does
not."""


def _shares(ties: Array) -> Array:
    """The matrix $(C C^T)^{-1} C$ of rows C, some of them zero, some nearly the same."""
    gram, eps = ties @ ties.T, jnp.finfo(ties.dtype).eps
    gram = gram + jnp.diag(jnp.where(jnp.any(ties != 0, axis=1), 16 * eps, 1.0))
    factors = lu.factor(gram)
    return jax.vmap(lambda b: lu.substitute(factors, b), 1, 1)(ties)
