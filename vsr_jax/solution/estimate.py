"""Discretisation error of a solution: its tip and its strain are compared with those of another
one, see `Model.refined`."""

from typing import Any, NamedTuple

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from ..arm.scene import Scene
from ..models.base import Model
from ..numerics import component as c
from ..numerics.component import Vector
from ..typing import Scalar

_SAFETY = 1.5
"""Safety factor on the estimated differences: a finer solution is itself off by up to a third where
steps are few."""

_ROUNDED = 8
"""Bound on rounding, in units of machine epsilon: products of rotations along an arm lose a few."""


class Error(NamedTuple):
    """Estimated errors of a solution.

    **Fields:** `tip`: of the tip position [m]; `strain`: largest error along the arm of each
    strain, angular first ([1/m], [-]).
    """

    tip: Scalar
    strain: Float[Array, " 6"]


def error_of(model: Model, scene: Scene, inputs: Array, forces: Vector, state: Any) -> Error:
    """Estimated errors of a solution: 1.5 times the error that its difference from another one
    shows, plus a bound on rounding.

    **Arguments:** as `Model.tip`, and `inputs`, those of the solve.
    """
    scene, inputs, forces, state = lax.stop_gradient((scene, inputs, forces, state))
    found = model.refined(scene, inputs, forces, state)
    distance = (found.tip - model.tip(scene, forces, state))[:3, 3]
    moved = found.tip_factor * c.norm(c.split(distance))
    pairs = zip(found.given, found.other, strict=True)
    change = found.strain_factor * jnp.stack([jnp.max(jnp.abs(a - b)) for a, b in pairs])
    size = jnp.stack([jnp.max(jnp.abs(x)) for x in found.other])
    least = _ROUNDED * jnp.finfo(moved.dtype).eps
    sections = scene.sections(found.X)
    slender = sections.stiffness[3] / jnp.minimum(sections.stiffness[1], sections.stiffness[2])
    slender = scene.rod.length * jnp.sqrt(jnp.max(c.times(sections.flexible, slender)))
    bend = jnp.array([slender / scene.rod.length] * 3 + [1.0] * 3, size.dtype)
    return Error(
        _SAFETY * moved + least * scene.rod.length * (1 + slender),
        _SAFETY * change + least * (size + bend),
    )
