r"""Loads that depend on the pose of their section: springs, payloads, magnetic moments, and the
centrifugal load of an arm on a base that turns.

Such a load is defined by its potential energy $V(R, r)$ as a function of the rotation R and the
position r of its section. Its wrench in the world frame, with the moment about the section's point
of the axis, is

$$F = -\frac{\partial V}{\partial r}, \quad
M \cdot \theta = -\frac{d}{d\epsilon} V((1 + \epsilon \tilde\theta) R, r).$$

Both, and their derivatives in the tangent of the arm, come from automatic differentiation.
"""

from collections.abc import Callable
from typing import Literal

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float
from typing_extensions import TypeAliasType

from ..numerics.stacked import cross, dot, matmul, matvec, skew
from ..typing import MatrixLike, Scalar, ScalarLike, Twist, VectorLike, real
from ..validation import choice, numbers
from .functions import Position, function_of_position
from .loads import THREE_PROFILES, Frame, Load, mass_per_length, need_density
from .profile import (
    ProfilesLike,
    ProfileVector,
    as_profiles,
    breakpoints_of,
    values_at,
)
from .rod import Rod

Needs = Literal["rotation", "pose"]

Rotation = Float[Array, "3 3"]
FieldLike = TypeAliasType("FieldLike", VectorLike | Callable[[Position], VectorLike])
"""A field in space: a uniform one, or a function of the position."""


class PoseLoad(Load):
    """A load that depends on the pose of its section, at a point or per reference length.

    A subclass defines `potential`, or for a load without one `wrench`. `needs` is what of the pose
    the wrench depends on: with "rotation" the positions of the sections are not computed, and
    `wrench` gets zeros in their place.
    """

    frame: Frame = eqx.field(static=True, default="world", init=False)

    @property
    def needs(self) -> Needs:
        """What of the pose of the section the wrench depends on."""
        return "pose"

    @property
    def conservative(self) -> bool:
        """Whether it has a potential."""
        return type(self).potential is not PoseLoad.potential

    def place(self, rod: Rod) -> Scalar | None:
        """Abscissa [m] where it acts; None for a load per length."""
        return None

    def potential(
        self, rod: Rod, X: ScalarLike, rotation: MatrixLike, position: VectorLike
    ) -> Scalar | None:
        """Potential energy [J], or [J/m] of a load per length, of the section at X; None for a load
        without one."""
        return None

    def wrench(self, rod: Rod, X: ScalarLike, rotation: MatrixLike, position: VectorLike) -> Twist:
        """Wrench $(M, F)$ [N m, N], or density $(c, f)$ [N, N/m], in the world frame, of the
        section at X; by default from `potential`."""
        R, r = real(rotation), real(position)

        def energy(turn: Array, shift: Array) -> Array:
            turned = R + matmul(skew(turn), R)
            energy = self.potential(rod, X, turned, r + shift)
            if energy is None:
                raise NotImplementedError(f"{type(self).__name__}: need a potential or a wrench")
            return energy

        zero = jnp.zeros_like(r)
        return -jnp.concatenate(jax.grad(energy, (0, 1))(zero, zero))

    def scaled(self, factor: ScalarLike) -> Load:
        return _ScaledPoseLoad(self, factor)


class _ScaledPoseLoad(PoseLoad):
    load: PoseLoad
    factor: Scalar
    effect = "scaled load"

    def __init__(self, load: PoseLoad, factor: ScalarLike):
        self.load, self.factor, self.frame = load, real(factor), "world"

    @property
    def needs(self) -> Needs:
        return self.load.needs

    @property
    def conservative(self) -> bool:
        return self.load.conservative

    def place(self, rod: Rod) -> Scalar | None:
        return self.load.place(rod)

    def potential(
        self, rod: Rod, X: ScalarLike, rotation: MatrixLike, position: VectorLike
    ) -> Scalar | None:
        whole = self.load.potential(rod, X, rotation, position)
        return None if whole is None else self.factor * whole

    def wrench(self, rod: Rod, X: ScalarLike, rotation: MatrixLike, position: VectorLike) -> Twist:
        return self.factor * self.load.wrench(rod, X, rotation, position)

    def breakpoints(self, rod: Rod) -> tuple[Scalar, ...]:
        return self.load.breakpoints(rod)


class _AtPoint(PoseLoad):
    """A load on the section at `X`, None for the tip."""

    X: eqx.AbstractVar[Scalar | None]

    def place(self, rod: Rod) -> Scalar:
        return rod.length if self.X is None else self.X

    def breakpoints(self, rod: Rod) -> tuple[Scalar, ...]:
        return () if self.X is None else (self.X,)


def _abscissa(name: str, X: ScalarLike | None) -> Scalar | None:
    return None if X is None else numbers(name, X, least=0.0)


class Spring(_AtPoint):
    r"""A spring between a point of a section and a point of the world,
    $V = \tfrac12 k (d - d_0)^2$ with d their distance.

    **Arguments:**
    - `anchor`: the point of the world [m].
    - `stiffness`: k [N/m], at least 0.
    - `X`: abscissa of the section [m], the tip by default.
    - `length`: $d_0$ [m], 0 by default: the force is then $k$ times the distance.
    - `offset`: the point of the section [m] in the section's axes, the axis of the arm by default.
    - `kind`: `"both"` pulls and pushes; `"cord"` is slack while it is shorter than `length`.
    """

    anchor: Position = eqx.field(metadata={"unit": "m"})
    stiffness: Scalar = eqx.field(metadata={"unit": "N/m"})
    X: Scalar | None = eqx.field(metadata={"unit": "m"})
    length: Scalar = eqx.field(metadata={"unit": "m"})
    offset: Position = eqx.field(metadata={"unit": "m"})
    kind: Literal["both", "cord"] = eqx.field(static=True)
    effect = "spring"

    def __init__(
        self,
        anchor: VectorLike,
        stiffness: ScalarLike,
        X: ScalarLike | None = None,
        length: ScalarLike = 0.0,
        offset: VectorLike = (0.0, 0.0, 0.0),
        kind: Literal["both", "cord"] = "both",
    ):
        self.anchor = numbers("Spring.anchor", anchor, (3,))
        self.stiffness = numbers("Spring.stiffness", stiffness, least=0.0)
        self.X = _abscissa("Spring.X", X)
        self.length = numbers("Spring.length", length, least=0.0)
        self.offset = numbers("Spring.offset", offset, (3,))
        self.kind = choice("Spring.kind", kind, ("both", "cord"))
        self.frame = "world"

    def potential(
        self, rod: Rod, X: ScalarLike, rotation: MatrixLike, position: VectorLike
    ) -> Scalar:
        apart = real(position) + matvec(real(rotation), self.offset) - self.anchor
        square = dot(apart, apart)
        away = square > 0  # the distance has no derivative at zero
        stretch = jnp.where(away, jnp.sqrt(jnp.where(away, square, 1.0)), 0.0) - self.length
        if self.kind == "cord":
            stretch = jnp.maximum(stretch, 0.0)
        return 0.5 * self.stiffness * jnp.where(away | (self.length > 0), stretch**2, square)


class Payload(_AtPoint):
    r"""A rigid mass on a section, $V = -(m - \rho_f v) \, g \cdot (r + R o)$: its weight, less the
    buoyancy of its volume, acts at a point that turns with the section.

    **Arguments:**
    - `mass`: m [kg], at least 0.
    - `X`: abscissa of the section [m], the tip by default.
    - `offset`: o [m], the centre of mass and of the volume in the section's axes.
    - `acceleration`: g [m/s^2] in the world frame, (0, 0, -9.81) by default.
    - `volume`: v [m^3], `fluid_density`: $\rho_f$ [kg/m^3] of a fluid around it, both 0 by default.
    """

    mass: Scalar = eqx.field(metadata={"unit": "kg"})
    X: Scalar | None = eqx.field(metadata={"unit": "m"})
    offset: Position = eqx.field(metadata={"unit": "m"})
    acceleration: Float[Array, "3"] = eqx.field(metadata={"unit": "m/s^2"})
    volume: Scalar = eqx.field(metadata={"unit": "m^3"})
    fluid_density: Scalar = eqx.field(metadata={"unit": "kg/m^3"})
    effect = "payload"

    def __init__(
        self,
        mass: ScalarLike,
        X: ScalarLike | None = None,
        offset: VectorLike = (0.0, 0.0, 0.0),
        acceleration: VectorLike = (0.0, 0.0, -9.81),
        volume: ScalarLike = 0.0,
        fluid_density: ScalarLike = 0.0,
    ):
        self.mass = numbers("Payload.mass", mass, least=0.0)
        self.X = _abscissa("Payload.X", X)
        self.offset = numbers("Payload.offset", offset, (3,))
        self.acceleration = numbers("Payload.acceleration", acceleration, (3,))
        self.volume = numbers("Payload.volume", volume, least=0.0)
        self.fluid_density = numbers("Payload.fluid_density", fluid_density, least=0.0)
        self.frame = "world"

    @property
    def needs(self) -> Needs:
        return "rotation"

    def potential(
        self, rod: Rod, X: ScalarLike, rotation: MatrixLike, position: VectorLike
    ) -> Scalar:
        mass = self.mass - self.fluid_density * self.volume
        return -mass * dot(self.acceleration, real(position) + matvec(real(rotation), self.offset))


class _Magnetic(PoseLoad):
    """What magnetic loads share: a field B, uniform or a function of the position."""

    field: eqx.AbstractVar[Array | Callable]

    @property
    def needs(self) -> Needs:
        return "pose" if callable(self.field) else "rotation"

    def check(self, rod: Rod) -> None:
        if not callable(self.field):
            return
        shape = jax.eval_shape(self._field_at, jnp.zeros(3)).shape
        if shape != (3,):
            raise ValueError(
                f"{type(self).__name__}.field: got a function that returns shape {shape}, need (3,)"
            )

    def _energy(self, moment: Array, rotation: MatrixLike, position: VectorLike) -> Scalar:
        return -dot(matvec(real(rotation), moment), self._field_at(real(position)))

    def _field_at(self, position: Position) -> Array:
        return jnp.asarray(self.field(position) if callable(self.field) else self.field)


def _field(name: str, field: FieldLike) -> Array | Callable:
    if not callable(field):
        return numbers(name, field, (3,))
    return function_of_position(field)


class MagneticMoment(_Magnetic, _AtPoint):
    r"""A magnetic dipole on a section in a magnetic field, $V = -R \mu \cdot B(r)$.

    **Arguments:**
    - `moment`: $\mu$ [A m^2] in the section's axes.
    - `field`: B [T] in the world frame: three numbers, or a function of the position [m] that
      returns them, written with `jax.numpy`. The numbers of an equinox module are differentiable.
    - `X`: abscissa of the section [m], the tip by default.
    """

    moment: Float[Array, "3"] = eqx.field(metadata={"unit": "A m^2"})
    field: Array | Callable = eqx.field(metadata={"unit": "T"})
    X: Scalar | None = eqx.field(metadata={"unit": "m"})
    effect = "magnetic moment"

    def __init__(self, moment: VectorLike, field: FieldLike, X: ScalarLike | None = None):
        self.moment = numbers("MagneticMoment.moment", moment, (3,))
        self.field = _field("MagneticMoment.field", field)
        self.X = _abscissa("MagneticMoment.X", X)
        self.frame = "world"

    def potential(
        self, rod: Rod, X: ScalarLike, rotation: MatrixLike, position: VectorLike
    ) -> Scalar:
        return self._energy(self.moment, rotation, position)


class MagneticDensity(_Magnetic):
    r"""A magnetic moment per reference length in a magnetic field, $V = -R \mu(X) \cdot B(r)$,
    as of a rod of magnetised particles: the magnetisation times the area of the section.

    **Arguments:**
    - `moment`: $\mu$ [A m] in the section's axes, three profiles (numbers, `Profile` or functions
      of X) or one function of X that returns three numbers.
    - `field`: B [T], as for `MagneticMoment`.
    """

    moment: ProfileVector = eqx.field(metadata={"unit": "A m"})
    field: Array | Callable = eqx.field(metadata={"unit": "T"})
    effect = "magnetic density"

    def __init__(self, moment: ProfilesLike, field: FieldLike):
        name = "MagneticDensity.moment"
        self.moment = as_profiles(name, moment, [f"{name}[{i}]" for i in range(3)], THREE_PROFILES)
        self.field = _field("MagneticDensity.field", field)
        self.frame = "world"

    def potential(
        self, rod: Rod, X: ScalarLike, rotation: MatrixLike, position: VectorLike
    ) -> Scalar:
        moment = jnp.stack(jnp.broadcast_arrays(*values_at(self.moment, X, rod.length)))
        return self._energy(moment, rotation, position)

    def breakpoints(self, rod: Rod) -> tuple[Scalar, ...]:
        return breakpoints_of(self.moment)


class Spinning(PoseLoad):
    r"""Centrifugal load of an arm on a base that turns at a constant rate, in the frame that turns
    with it: $V = -\tfrac12 \rho A |\omega \times (r - c)|^2$ per reference length.

    The mass of a section is taken to lie on its axis. The rod's material needs a `density`.

    **Arguments:**
    - `rate`: $\omega$ [rad/s] in the world frame.
    - `centre`: c [m], a point of the axis of rotation, the origin by default.
    """

    rate: Float[Array, "3"] = eqx.field(metadata={"unit": "rad/s"})
    centre: Position = eqx.field(metadata={"unit": "m"})
    effect = "spinning"

    def __init__(self, rate: VectorLike, centre: VectorLike = (0.0, 0.0, 0.0)):
        self.rate = numbers("Spinning.rate", rate, (3,))
        self.centre = numbers("Spinning.centre", centre, (3,))
        self.frame = "world"

    def check(self, rod: Rod) -> None:
        need_density(self, rod)

    def potential(
        self, rod: Rod, X: ScalarLike, rotation: MatrixLike, position: VectorLike
    ) -> Scalar:
        speed = cross(self.rate, real(position) - self.centre)
        return -0.5 * mass_per_length(rod, X) * dot(speed, speed)
