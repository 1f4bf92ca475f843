"""Actuators: the relation of an input and the paper's signed thread force $\\tau$ (negative pulls,
positive pushes)."""

from abc import abstractmethod
from typing import Literal

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool

from ..typing import ArrayLike, Scalar
from ..validation import choice, concrete, instance, numbers
from .description import Part
from .routing import Routing


class Actuator(Part):
    """A thread along a routing, driven by one input.

    **Arguments shared by all:**
    - `routing`: the thread's path.
    - `start`, `end`: abscissas of its anchors [m], by default the arm's base and tip. It acts only
      between them.
    """

    routing: eqx.AbstractVar[Routing]
    start: eqx.AbstractVar[Scalar | None]
    end: eqx.AbstractVar[Scalar | None]
    effect: eqx.AbstractClassVar[str]

    @property
    @abstractmethod
    def unit(self) -> str:
        """Unit of the input."""

    @property
    def lowest(self) -> float:
        """Smallest admissible input."""
        return float("-inf")

    @property
    def length_driven(self) -> bool:
        """Whether the input is a change of length, so that the force is an unknown."""
        return False

    @property
    def signed_friction(self) -> Scalar | None:
        """Coefficient of friction [-], positive while the thread is pulled and negative while it is
        released; None if its force is the same everywhere."""
        return None

    @property
    def frictional(self) -> bool:
        """Whether the force changes along the thread."""
        return self.signed_friction is not None

    @property
    def cable_stiffness(self) -> Scalar | None:
        """Axial stiffness [N] of a thread that is driven by its length; None if it cannot be
        stretched."""
        return None

    @property
    def pressure_area(self) -> Scalar | None:
        """Area [m^2] on which a pressure acts; None if the input is no pressure."""
        return None

    @property
    def effects(self) -> tuple[str, ...]:
        """What the actuator adds to `Scene.effects`, its `effect` first."""
        return (self.effect,)

    @abstractmethod
    def force(self, value: Scalar) -> Scalar:
        """Signed thread force $\\tau$ [N] for an input."""

    def admits(self, value: Scalar) -> Bool[Array, ""]:
        """Whether the input is finite and in the actuator's range."""
        return jnp.isfinite(value) & (value >= self.lowest)

    @property
    def breakpoints(self) -> tuple[Scalar, ...]:
        """Abscissas [m] where the path, one of its derivatives or the thread's force jumps."""
        ends = tuple(x for x in (self.start, self.end) if x is not None)
        return (*self.routing.breakpoints, *ends)

    def reach(self, X: Scalar) -> Array | None:
        """1 between the thread's ends, 0 elsewhere; None if it extends over the whole arm."""
        if self.start is None and self.end is None:
            return None
        here = jnp.ones_like(X)
        if self.start is not None:
            here = jnp.where(self.start <= X, here, 0.0)
        return here if self.end is None else jnp.where(self.end > X, here, 0.0)


def _checked(
    actuator: str, routing: Routing, start: ArrayLike | None, end: ArrayLike | None
) -> tuple[Routing, Scalar | None, Scalar | None]:
    needed = "a routing such as Parallel, Linear, Helix, Polynomial, Spline or Function"
    path = instance(f"{actuator}.routing", routing, Routing, needed)
    first = None if start is None else numbers(f"{actuator}.start", start, least=0.0)
    last = None if end is None else numbers(f"{actuator}.end", end, positive=True)
    if first is not None and last is not None:
        known = concrete(first), concrete(last)
        if known[0] is not None and known[1] is not None and not known[0] < known[1]:
            raise ValueError(
                f"{actuator}.end: got end = {known[1]:g} m and start = {known[0]:g} m, need an "
                f"end beyond the start"
            )
    return path, first, last


class Thread(Actuator):
    """The paper's actuator: the input is $\\tau$ itself [N], negative for a tendon, positive for a
    fluidic chamber."""

    routing: Routing
    start: Scalar | None = eqx.field(metadata={"unit": "m"})
    end: Scalar | None = eqx.field(metadata={"unit": "m"})
    effect = "threads"

    def __init__(
        self, routing: Routing, *, start: ArrayLike | None = None, end: ArrayLike | None = None
    ):
        self.routing, self.start, self.end = _checked("Thread", routing, start, end)

    @property
    def unit(self) -> str:
        return "N"

    def force(self, value: Scalar) -> Scalar:
        return value


class Tendon(Actuator):
    r"""A cable that only pulls, driven by its tension or by its length.

    With `control="tension"` the input is $T \ge 0$ [N] and $\tau = -T$. With `control="length"` the
    input is the change of length $\delta$ [m] of the cable between its ends, negative when the
    motor shortens it, and the tension is an unknown:

    $$T \ge 0, \quad (l^* + \delta)(1 + T / k) - l \ge 0, \quad \text{one of the two is zero},$$

    with $l^*$ the length of the path at rest, $l$ that of the deformed arm and $k$ the cable's
    axial stiffness $EA$ (infinite by default).

    With friction the tension decays with the turning angle $\varphi$ of the cable from its start,
    $T(X) = T e^{\mp \mu \varphi(X)}$ (the capstan equation): minus while the motor pulls, plus
    while it releases. The angle includes the kinks of the path: corners of its routing, and places
    where the strain jumps, for example at the end of another tendon. With such kinks the order of
    convergence is that of the nodes of a step, third for steps of order 6. The input and the
    computed tension are those at the start.

    **Arguments:**
    - `routing`, `start`, `end`: as for every actuator.
    - `control`: `"tension"` or `"length"`.
    - `stiffness`: $k$ [N], for `control="length"` only.
    - `friction`: coefficient $\mu$ [-], none by default.
    - `motion`: `"pull"` or `"release"`, the direction in which friction acts.
    """

    routing: Routing
    start: Scalar | None = eqx.field(metadata={"unit": "m"})
    end: Scalar | None = eqx.field(metadata={"unit": "m"})
    stiffness: Scalar | None = eqx.field(metadata={"unit": "N"})
    friction: Scalar | None = eqx.field(metadata={"unit": "-"})
    control: Literal["tension", "length"] = eqx.field(static=True)
    motion: Literal["pull", "release"] = eqx.field(static=True)
    effect = "tendons"

    def __init__(
        self,
        routing: Routing,
        *,
        start: ArrayLike | None = None,
        end: ArrayLike | None = None,
        control: Literal["tension", "length"] = "tension",
        stiffness: ArrayLike | None = None,
        friction: ArrayLike | None = None,
        motion: Literal["pull", "release"] = "pull",
    ):
        self.routing, self.start, self.end = _checked("Tendon", routing, start, end)
        self.control = choice("Tendon.control", control, ("tension", "length"))
        if stiffness is not None and control == "tension":
            raise ValueError(
                "Tendon.stiffness: got a stiffness with control='tension', need control='length' "
                "(a given tension does not use it)"
            )
        self.stiffness = (
            None if stiffness is None else numbers("Tendon.stiffness", stiffness, positive=True)
        )
        self.friction = (
            None if friction is None else numbers("Tendon.friction", friction, least=0.0)
        )
        self.motion = choice("Tendon.motion", motion, ("pull", "release"))

    @property
    def unit(self) -> str:
        return "N" if self.control == "tension" else "m"

    @property
    def lowest(self) -> float:
        return float("-inf") if self.length_driven else 0.0

    @property
    def length_driven(self) -> bool:
        return self.control == "length"

    @property
    def signed_friction(self) -> Scalar | None:
        if self.friction is None or self.motion == "pull":
            return self.friction
        return -self.friction

    @property
    def cable_stiffness(self) -> Scalar | None:
        return self.stiffness

    @property
    def effects(self) -> tuple[str, ...]:
        options = (
            ("length control", self.length_driven),
            ("elastic tendons", self.stiffness is not None),
            ("friction", self.frictional),
        )
        return (self.effect, *(name for name, present in options if present))

    def force(self, value: Scalar) -> Scalar:
        """$\\tau = -T$; zero, the first iterate, for a tendon driven by its length."""
        return -value if self.control == "tension" else jnp.zeros_like(value)


class Chamber(Actuator):
    """A slender fluidic chamber: the input is the gauge pressure $p$ [Pa], $\\tau = p a$.
    A negative pressure is a vacuum.

    **Arguments:**
    - `routing`: the chamber's centre line.
    - `area`: cross-sectional area $a$ of the chamber [m^2], positive.
    - `start`, `end`: as for every actuator.
    """

    routing: Routing
    area: Scalar = eqx.field(metadata={"unit": "m^2"})
    start: Scalar | None = eqx.field(metadata={"unit": "m"})
    end: Scalar | None = eqx.field(metadata={"unit": "m"})
    effect = "chambers"

    def __init__(
        self,
        routing: Routing,
        area: ArrayLike,
        *,
        start: ArrayLike | None = None,
        end: ArrayLike | None = None,
    ):
        self.routing, self.start, self.end = _checked("Chamber", routing, start, end)
        self.area = numbers("Chamber.area", area, positive=True)

    @property
    def unit(self) -> str:
        return "Pa"

    @property
    def pressure_area(self) -> Scalar:
        return self.area

    def force(self, value: Scalar) -> Scalar:
        return value * self.area
