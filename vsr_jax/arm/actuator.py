"""Actuators: the relation of an input and the paper's signed thread force $\\tau$ (negative pulls,
positive pushes)."""

from abc import abstractmethod
from typing import Literal, NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array

from ..typing import Scalar, ScalarLike, real
from ..validation import choice, concrete, instance, numbers
from .description import Part
from .routing import Routing


class ThreadState(NamedTuple):
    """What the law of an actuator may depend on, beside its input.

    **Fields:** the signed `force` $\\tau$ [N] at the start of the thread; the `length` [m] of its
    path, less what the thread itself stretches; the length of the path of the arm at `rest` [m];
    `scale` [N/m]: the stiffness of the arm at rest along the thread, by which lengths compare to
    forces.
    """

    force: Scalar
    length: Scalar
    rest: Scalar
    scale: Scalar


class Actuator(Part):
    r"""A thread along a routing, driven by one input.

    The force in it is `force`(input), or if it depends on the length of the thread too, it follows
    from `law`($\tau$ and length, input) = 0, and `force` is where a solve begins.

    **Arguments shared by all:**
    - `routing`: the thread's path.
    - `start`, `end`: abscissas of its anchors [m], by default the arm's base and tip. It acts only
      between them.
    """

    routing: eqx.AbstractVar[Routing]
    start: eqx.AbstractVar[Scalar | None]
    end: eqx.AbstractVar[Scalar | None]
    effect: eqx.AbstractClassVar[str]
    straight = False
    """Whether the thread runs straight between the discs of the arm, in place of along its path."""

    @property
    @abstractmethod
    def unit(self) -> str:
        """Unit of the input."""

    @property
    def lowest(self) -> float:
        """Smallest admissible input."""
        return float("-inf")

    @property
    def law_driven(self) -> bool:
        """Whether the force is an unknown, which follows from `law`."""
        return type(self).law is not Actuator.law

    @property
    def length_driven(self) -> bool:
        """Whether the input is a change of length."""
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
        """Axial stiffness [N] of a thread with a `law`; None if it cannot be stretched."""
        return None

    def free_length(self, rest: ScalarLike, value: ScalarLike) -> Scalar:
        """Length [m] of the thread without force, for an input."""
        return real(rest)

    @property
    def pressure_area(self) -> Scalar | None:
        """Area [m^2] on which a pressure acts; None for what is no chamber."""
        return None

    @property
    def effects(self) -> tuple[str, ...]:
        """What the actuator adds to `Scene.effects`, its `effect` first."""
        return (self.effect,)

    @abstractmethod
    def force(self, value: ScalarLike) -> Scalar:
        """Signed thread force $\\tau$ [N] for an input."""

    def law(self, thread: ThreadState, value: ScalarLike) -> Scalar:
        r"""A force [N] that is zero where the force of the thread fits its length and the input,
        and that falls as $\tau$ rises; $F(a) - \tau$ by default, with F the `force`."""
        return self.force(value) - thread.force

    def potential(self, thread: ThreadState, value: ScalarLike) -> Scalar:
        r"""Potential [J] of a thread with a `law`, whose derivative by the length is $-\tau$;
        $-\tau l$ by default, as of a given force."""
        return -thread.force * thread.length

    @property
    def breakpoints(self) -> tuple[Scalar, ...]:
        """Abscissas [m] where the path, one of its derivatives or the thread's force jumps."""
        ends = tuple(x for x in (self.start, self.end) if x is not None)
        return (*self.routing.breakpoints, *ends)

    def reach(self, X: ScalarLike) -> Array | None:
        """1 between the thread's ends, 0 elsewhere; None if it extends over the whole arm."""
        return between(self.start, self.end, X)


def between(start: Scalar | None, end: Scalar | None, X: ScalarLike) -> Array | None:
    """1 between two abscissas, 0 elsewhere; None without ends."""
    if start is None and end is None:
        return None
    here = jnp.ones_like(X)
    if start is not None:
        here = jnp.where(start <= X, here, 0.0)
    return here if end is None else jnp.where(end > X, here, 0.0)


def checked_path(
    owner: str, routing: Routing, start: ScalarLike | None, end: ScalarLike | None
) -> tuple[Routing, Scalar | None, Scalar | None]:
    """A path and its ends, checked."""
    needed = "a routing such as Parallel, Linear, Helix, Polynomial, Spline or Function"
    path = instance(f"{owner}.routing", routing, Routing, needed)
    first = None if start is None else numbers(f"{owner}.start", start, least=0.0)
    last = None if end is None else numbers(f"{owner}.end", end, positive=True)
    if first is not None and last is not None:
        known = concrete(first), concrete(last)
        if known[0] is not None and known[1] is not None and not known[0] < known[1]:
            raise ValueError(
                f"{owner}.end: got end = {known[1]:g} m and start = {known[0]:g} m, need an "
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
        self, routing: Routing, *, start: ScalarLike | None = None, end: ScalarLike | None = None
    ):
        self.routing, self.start, self.end = checked_path("Thread", routing, start, end)

    @property
    def unit(self) -> str:
        return "N"

    def force(self, value: ScalarLike) -> Scalar:
        return real(value)


class Tendon(Actuator):
    r"""A cable that only pulls, driven by its tension or by its length.

    With `control="tension"` the input is $T \ge 0$ [N] and $\tau = -T$. With `control="length"` the
    input is the change of length $\delta$ [m] of the cable between its ends, negative when the
    motor shortens it, and the tension is an unknown:

    $$T \ge 0, \quad (l^* + \delta)(1 + T / k) - l \ge 0, \quad \text{one of the two is zero},$$

    with $l^*$ the length of the path at rest, $l$ that of the deformed arm and $k$ the cable's
    axial stiffness $EA$ (infinite by default). A motor winds the cable on a spool of radius r: then
    the input is the angle $\alpha$ [rad] of the motor, $\delta = \delta_0 - r \alpha$.

    With friction the tension decays with the turning angle $\varphi$ of the cable from its start,
    $T(X) = T e^{\mp \mu \varphi(X)}$ (the capstan equation): minus while the motor pulls, plus
    while it releases. The angle includes the kinks of the path: corners of its routing, and places
    where the strain jumps, for example at the end of another tendon. With such kinks the order of
    convergence is that of the nodes of a step, third for steps of order 6. The input and the
    computed tension are those at the start.

    A `straight` one runs in straight lines through the holes of the rod's `Discs`, as the tendons
    of most arms with a thin backbone do. The holes are where the routing crosses the base and the
    discs, $p_i = r(D_i) + R(D_i) d(D_i)$. Then $l = \sum_i |p_{i+1} - p_i|$, and a section between
    two discs carries the wrench of the chord there, $\tau e$ through $p_i$ with $e = (p_{i+1} -
    p_i) / |p_{i+1} - p_i|$. With friction the tension changes at each hole between its ends by
    $e^{\mp \mu \varphi}$, with the angle $\varphi$ between the chords there. Each disc is the end
    of a step. The model is `StrainDependent`.

    **Arguments:**
    - `routing`, `start`, `end`: as for every actuator; a straight one starts and ends in discs, by
      default at the base and in the last disc.
    - `control`: `"tension"` or `"length"`.
    - `stiffness`: $k$ [N], `spool`: r [m], `offset`: $\delta_0$ [m], by default zero; for
      `control="length"` only. A negative radius winds the other way.
    - `friction`: coefficient $\mu$ [-], none by default.
    - `motion`: `"pull"` or `"release"`, the direction in which friction acts.
    - `straight`: whether it runs straight between the discs of the rod, not along its path.
    """

    routing: Routing
    start: Scalar | None = eqx.field(metadata={"unit": "m"})
    end: Scalar | None = eqx.field(metadata={"unit": "m"})
    stiffness: Scalar | None = eqx.field(metadata={"unit": "N"})
    spool: Scalar | None = eqx.field(metadata={"unit": "m"})
    offset: Scalar | None = eqx.field(metadata={"unit": "m"})
    friction: Scalar | None = eqx.field(metadata={"unit": "-"})
    straight: bool = eqx.field(static=True)
    control: Literal["tension", "length"] = eqx.field(static=True)
    motion: Literal["pull", "release"] = eqx.field(static=True)
    effect = "tendons"

    def __init__(
        self,
        routing: Routing,
        *,
        start: ScalarLike | None = None,
        end: ScalarLike | None = None,
        control: Literal["tension", "length"] = "tension",
        stiffness: ScalarLike | None = None,
        spool: ScalarLike | None = None,
        offset: ScalarLike | None = None,
        friction: ScalarLike | None = None,
        motion: Literal["pull", "release"] = "pull",
        straight: bool = False,
    ):
        self.routing, self.start, self.end = checked_path("Tendon", routing, start, end)
        self.control = choice("Tendon.control", control, ("tension", "length"))
        of_lengths = {"stiffness": stiffness, "spool": spool, "offset": offset}
        for name, value in of_lengths.items():
            if value is not None and control == "tension":
                raise ValueError(
                    f"Tendon.{name}: got {value!r} with control='tension', need control='length' "
                    f"(a given tension does not use it)"
                )
        self.stiffness = (
            None if stiffness is None else numbers("Tendon.stiffness", stiffness, positive=True)
        )
        self.spool = None if spool is None else numbers("Tendon.spool", spool)
        self.offset = None if offset is None else numbers("Tendon.offset", offset)
        self.friction = (
            None if friction is None else numbers("Tendon.friction", friction, least=0.0)
        )
        self.motion = choice("Tendon.motion", motion, ("pull", "release"))
        self.straight = bool(straight)

    @property
    def unit(self) -> str:
        if self.control == "tension":
            return "N"
        return "m" if self.spool is None else "rad"

    @property
    def lowest(self) -> float:
        return float("-inf") if self.length_driven else 0.0

    @property
    def law_driven(self) -> bool:
        return self.length_driven

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
    def breakpoints(self) -> tuple[Scalar, ...]:
        return () if self.straight else super().breakpoints

    @property
    def effects(self) -> tuple[str, ...]:
        options = (
            ("length control", self.length_driven),
            ("elastic tendons", self.stiffness is not None),
            ("friction", self.frictional),
            ("straight tendons", self.straight),
        )
        return (self.effect, *(name for name, present in options if present))

    def force(self, value: ScalarLike) -> Scalar:
        """$\\tau = -T$; zero, the first iterate, for a tendon driven by its length."""
        value = real(value)
        return -value if self.control == "tension" else jnp.zeros_like(value)

    def free_length(self, rest: ScalarLike, value: ScalarLike) -> Scalar:
        if not self.length_driven:
            return real(rest)
        change = real(value) if self.spool is None else -self.spool * real(value)
        return real(rest) + (change if self.offset is None else change + self.offset)

    def law(self, thread: ThreadState, value: ScalarLike) -> Scalar:
        """The smaller of tension and slack, as a force."""
        if not self.length_driven:
            return super().law(thread, value)
        slack = thread.scale * (self.free_length(thread.rest, value) - thread.length)
        return jnp.where(-thread.force < slack, -thread.force, slack)


ATMOSPHERE = 101_325.0
"""Standard atmosphere [Pa]."""


class Chamber(Actuator):
    r"""A slender fluidic chamber of constant cross-section, driven by its pressure, by the volume
    that a syringe pushes in, or by an amount of gas. The gauge pressure $p$ acts on its ends, $\tau
    = p a$; a negative one is a vacuum.

    With `control="pressure"` the input is $p$ [Pa]. Otherwise the pressure is an unknown, $p = \tau
    / a$ with $\tau$ from `Equilibrium.forces`. With the lengths $l^*$ of the chamber at rest and
    $l$ in the deformed arm:

    - `control="volume"`: the input is the volume $V$ [m^3] of liquid pushed in beyond that at rest,
      $a (l - l^*) + C p = V$.
    - `control="gas"`: the input is the volume $V_n$ [m^3] that the gas in the chamber and its
      supply has at the atmospheric pressure $p_0$ and the same temperature, $(p_0 + p)(V_d + a l) =
      p_0 V_n$. At rest without gauge pressure it is $V_d + a l^*$.

    **Arguments:**
    - `routing`: the chamber's centre line.
    - `area`: cross-sectional area $a$ of the chamber [m^2], positive: that of its fluid, on which
      the pressure pushes lengthways.
    - `start`, `end`: as for every actuator.
    - `control`: `"pressure"`, `"volume"` or `"gas"`.
    - `compliance`: $C$ [m^3/Pa] of the syringe and its tube, 0 by default; for volumes only.
    - `dead_volume`: $V_d$ [m^3] of the supply, 0 by default, `atmosphere`: $p_0$ [Pa], 101,325 by
      default; for gas only.
    """

    routing: Routing
    area: Scalar = eqx.field(metadata={"unit": "m^2"})
    start: Scalar | None = eqx.field(metadata={"unit": "m"})
    end: Scalar | None = eqx.field(metadata={"unit": "m"})
    compliance: Scalar | None = eqx.field(metadata={"unit": "m^3/Pa"})
    dead_volume: Scalar | None = eqx.field(metadata={"unit": "m^3"})
    atmosphere: Scalar | None = eqx.field(metadata={"unit": "Pa"})
    control: Literal["pressure", "volume", "gas"] = eqx.field(static=True)
    effect = "chambers"

    def __init__(
        self,
        routing: Routing,
        area: ScalarLike,
        *,
        start: ScalarLike | None = None,
        end: ScalarLike | None = None,
        control: Literal["pressure", "volume", "gas"] = "pressure",
        compliance: ScalarLike | None = None,
        dead_volume: ScalarLike | None = None,
        atmosphere: ScalarLike | None = None,
    ):
        self.routing, self.start, self.end = checked_path("Chamber", routing, start, end)
        self.area = numbers("Chamber.area", area, positive=True)
        self.control = choice("Chamber.control", control, ("pressure", "volume", "gas"))
        for name, value, needed in (
            ("compliance", compliance, "volume"),
            ("dead_volume", dead_volume, "gas"),
            ("atmosphere", atmosphere, "gas"),
        ):
            if value is not None and control != needed:
                raise ValueError(
                    f"Chamber.{name}: got {value!r} with control={control!r}, need "
                    f"control={needed!r}"
                )
        self.compliance = (
            None if compliance is None else numbers("Chamber.compliance", compliance, least=0.0)
        )
        self.dead_volume = (
            None if dead_volume is None else numbers("Chamber.dead_volume", dead_volume, least=0.0)
        )
        self.atmosphere = (
            None if atmosphere is None else numbers("Chamber.atmosphere", atmosphere, positive=True)
        )

    @property
    def unit(self) -> str:
        return "Pa" if self.control == "pressure" else "m^3"

    @property
    def lowest(self) -> float:
        return 0.0 if self.control == "gas" else float("-inf")

    @property
    def law_driven(self) -> bool:
        return self.control != "pressure"

    @property
    def pressure_area(self) -> Scalar:
        return self.area

    @property
    def effects(self) -> tuple[str, ...]:
        return (self.effect, *([f"{self.control} control"] if self.law_driven else []))

    def force(self, value: ScalarLike) -> Scalar:
        """$\\tau = p a$; zero, the first iterate, where the pressure is an unknown."""
        value = real(value)
        return jnp.zeros_like(value) if self.law_driven else value * self.area

    def free_length(self, rest: ScalarLike, value: ScalarLike) -> Scalar:
        change = real(value) / self.area if self.control == "volume" else 0.0
        return real(rest) + change

    def law(self, thread: ThreadState, value: ScalarLike) -> Scalar:
        """The volume that lacks room, or the force of the gas beyond that of the thread."""
        if self.control == "volume":
            missing = self.free_length(thread.rest, value) - thread.length
            if self.compliance is not None:
                missing -= self.compliance * thread.force / self.area**2
            return thread.scale * missing
        if self.control == "gas":
            room = self.amount(thread.length)
            return self.area * self._outside * (real(value) / room - 1) - thread.force
        return super().law(thread, value)

    def potential(self, thread: ThreadState, value: ScalarLike) -> Scalar:
        r"""$\frac12 C p^2$ of a syringe, and $p_0 (v - V_n \ln v)$ of gas in the atmosphere, with
        its volume $v = V_d + a l$."""
        if self.control == "volume":
            pressure = thread.force / self.area
            squared = pressure * pressure
            return 0 * squared if self.compliance is None else 0.5 * self.compliance * squared
        if self.control == "gas":
            room = self.amount(thread.length)
            return self._outside * (room - real(value) * jnp.log(room))
        return super().potential(thread, value)

    def amount(self, length: ScalarLike) -> Scalar:
        """The input [m^3] at which gas in a chamber of a given length [m] has no gauge pressure:
        the volume of the chamber and its supply."""
        room = self.area * real(length)
        return room if self.dead_volume is None else room + self.dead_volume

    @property
    def _outside(self) -> Scalar | float:
        return ATMOSPHERE if self.atmosphere is None else self.atmosphere
