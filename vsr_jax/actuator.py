"""Actuators: what an input means as the paper's signed thread force $\\tau$ (negative pulls, positive pushes)."""

from abc import abstractmethod
from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool

from ._check import instance, numbers
from ._types import Scalar
from .routing import Routing


class Actuator(eqx.Module):
    """A thread laid along a routing and driven by one input."""

    routing: eqx.AbstractVar[Routing]
    unit: eqx.AbstractClassVar[str]
    lowest: eqx.AbstractClassVar[float]

    @abstractmethod
    def force(self, value: Scalar) -> Scalar:
        """Signed thread force $\\tau$ [N] for an input."""

    def admits(self, value: Scalar) -> Bool[Array, ""]:
        """Whether the input is one this actuator can exert: finite and in its range."""
        return jnp.isfinite(value) & (value >= self.lowest)


def _routing(actuator: str, routing: Any) -> Routing:
    return instance(f"{actuator}.routing", routing, Routing, "a routing such as Parallel, Linear, Helix, Polynomial, Spline or Function")


class Thread(Actuator):
    """The paper's actuator: the input is $\\tau$ itself [N], negative for a tendon, positive for a fluidic chamber."""

    routing: Routing
    unit = "N"
    lowest = float("-inf")

    def __init__(self, routing: Routing):
        self.routing = _routing("Thread", routing)

    def force(self, value: Scalar) -> Scalar:
        return value


class Tendon(Actuator):
    """A cable that can only pull: the input is its tension $T \\ge 0$ [N], $\\tau = -T$."""

    routing: Routing
    unit = "N"
    lowest = 0.0

    def __init__(self, routing: Routing):
        self.routing = _routing("Tendon", routing)

    def force(self, value: Scalar) -> Scalar:
        return -value


class Chamber(Actuator):
    """A slender fluidic chamber: the input is the gauge pressure $p$ [Pa], $\\tau = p a$.

    **Arguments:**
    - `routing`: the chamber's centre line.
    - `area`: the chamber's bore $a$ [m^2], positive. A negative pressure is a vacuum.
    """

    routing: Routing
    area: Scalar
    unit = "Pa"
    lowest = float("-inf")

    def __init__(self, routing: Routing, area: Any):
        self.routing = _routing("Chamber", routing)
        self.area = numbers("Chamber.area", area, positive=True)

    def force(self, value: Scalar) -> Scalar:
        return value * self.area
