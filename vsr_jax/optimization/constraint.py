r"""Constraints of a design: dimensionless margins, $g_k \ge 0$ where satisfied."""

import dataclasses
from abc import abstractmethod

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from ..typing import Scalar
from ..validation import numbers, positive
from .objective import Arms

_STATIONS = 65
"""Stations along the arm at which margins are sampled, less than 2 % of the length apart."""


class Constraint(eqx.Module):
    """Margins that must not be negative."""

    @abstractmethod
    def __call__(self, arms: Arms) -> Float[Array, " margins"]:
        """Margins, shape (margins,)."""

    def __str__(self) -> str:
        fields = (f"{field.name}={getattr(self, field.name)}" for field in dataclasses.fields(self))
        return f"{type(self).__name__}({', '.join(fields)})"


def _stations(arms: Arms) -> Float[Array, " stations"]:
    return arms.scene.rod.length * jnp.linspace(0, 1, _STATIONS, dtype=arms.inputs.dtype)


class Inside(Constraint):
    """Threads inside the section, or inside the rod's guides: (distance to the wall - `wall`) /
    distance of the axis to the wall.

    **Arguments:** `wall` [m]: least distance between a thread and the wall.
    """

    wall: Scalar

    def __init__(self, wall: ArrayLike = 0.0):
        self.wall = numbers("Inside.wall", wall, least=0.0)

    def __call__(self, arms: Arms) -> Float[Array, " margins"]:
        rod, X = arms.scene.rod, _stations(arms)
        zero = jnp.zeros_like(self.wall)
        middle = jax.vmap(lambda x: rod.clearance(zero, zero, x))(X)
        rows = []
        for actuator in arms.scene.actuators:
            inside = jax.vmap(lambda x, a=actuator: rod.clearance(*a.routing(x), x))(X)
            rows.append(_where_laid((inside - self.wall) / middle, jax.vmap(actuator.reach)(X)))
        return jnp.concatenate(rows) if rows else jnp.ones(1, X.dtype)


class MinSpacing(Constraint):
    r"""Least distance between threads: $|d_i - d_j|^2 / g^2 - 1$ at stations along the arm, for
    every pair.

    **Arguments:** `gap`: g [m], between the centre lines of two threads.
    """

    gap: float = eqx.field(static=True)

    def __init__(self, gap: float):
        self.gap = positive("MinSpacing.gap", gap)

    def __call__(self, arms: Arms) -> Float[Array, " margins"]:
        X, threads = _stations(arms), arms.scene.actuators
        paths = [jax.vmap(actuator.routing)(X) for actuator in threads]
        reach = [jax.vmap(actuator.reach)(X) for actuator in threads]
        rows = []
        for i in range(len(threads)):
            for j in range(i):
                square = (paths[i][0] - paths[j][0]) ** 2 + (paths[i][1] - paths[j][1]) ** 2
                rows.append(_where_laid(_where_laid(square / self.gap**2 - 1, reach[i]), reach[j]))
        return jnp.concatenate(rows) if rows else jnp.ones(1, X.dtype)


def _where_laid(margins: Array, reach: Array | None) -> Array:
    return margins if reach is None else jnp.where(reach > 0, margins, 1.0)


class MaxTension(Constraint):
    r"""Bounded thread forces: $1 - |\tau_i| / \tau_1$. For free inputs that are forces, bounds have
    the same effect.

    **Arguments:** `force`: $\tau_1$ [N].
    """

    force: float = eqx.field(static=True)

    def __init__(self, force: float):
        self.force = positive("MaxTension.force", force)

    def __call__(self, arms: Arms) -> Float[Array, " margins"]:
        return 1 - jnp.abs(arms.each(lambda eq: eq.forces)).reshape(-1) / self.force


class BendRadius(Constraint):
    r"""Least bending radius of the axis: $1 - R^2 (k_y^2 + k_z^2)$ at stations along the arm.

    **Arguments:** `least`: R [m].
    """

    least: float = eqx.field(static=True)

    def __init__(self, least: float):
        self.least = positive("BendRadius.least", least)

    def __call__(self, arms: Arms) -> Float[Array, " margins"]:
        strain = arms.each(lambda eq: eq.strain(_stations(arms)))
        return (1 - self.least**2 * (strain[..., 1] ** 2 + strain[..., 2] ** 2)).reshape(-1)


class StabilityMargin(Constraint):
    """Least stability margin: `eq.stability - least`.

    **Arguments:** `least`: between 0, the limit of stability, and 1, an arm without forces.
    """

    least: float = eqx.field(static=True)

    def __init__(self, least: float):
        self.least = positive("StabilityMargin.least", least)

    def __call__(self, arms: Arms) -> Float[Array, " margins"]:
        return arms.each(lambda eq: eq.stability) - self.least
