"""What holds an arm and what it touches: support reactions and contacts."""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..elements.contact import Contacts
from ..elements.nearest import lying
from ..elements.supports import Supports
from ..elements.touch import Touch, received
from ..mechanics.arm_balance import ArmUnknown, state_of
from ..mechanics.coupling import ArmProblem
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
    at = state_of(unknown.xi, unknown.coupled, problem)
    found = zip(problem.couplings, unknown.coupled, at.notes, strict=True)
    each = [one.wrenches(x, note) for one, x, note in found if isinstance(one, Supports)]
    return jnp.concatenate(each)


def contacts_of(problem: ArmProblem, unknown: ArmUnknown) -> Contact:
    """The contacts of an arm with obstacles."""
    at, grid = state_of(unknown.xi, unknown.coupled, problem), problem.grid
    found = zip(problem.couplings, at.notes, strict=True)
    ((around, touch),) = [(one, note) for one, note in found if isinstance(one, Contacts)]
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


def _places(touch: Touch, around: Contacts, grid: Grid) -> tuple[Array, Array, Array]:
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
