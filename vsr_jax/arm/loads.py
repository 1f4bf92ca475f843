r"""External loads: wrenches per length along the arm and wrenches at points, dead or follower.

A load is given in the world frame (dead: its direction is constant) or in the body frame (follower:
it rotates with its section). Wrenches have the angular part first, $(c, f)$ [N m/m, N/m] per
reference length and $(M, F)$ [N m, N] at a point. Moments are about the point of the axis where the
load acts.
"""

from typing import Literal

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..numerics.component import Vector3, Wrench, scale, split
from ..typing import Scalar, ScalarLike, VectorLike, real
from ..validation import choice, numbers
from .description import Part
from .profile import ProfilesLike, ProfileVector, as_profiles, breakpoints_of, values_at
from .rod import Rod

Frame = Literal["world", "body"]


class Load(Part):
    """A load on the arm: a wrench per length or a wrench at a point, constant in the world frame or
    in the body frame. One that depends on the pose of its section is a `PoseLoad`."""

    frame: eqx.AbstractVar[Frame]
    effect: eqx.AbstractClassVar[str]

    @property
    def effects(self) -> tuple[str, ...]:
        """What the load adds to `Scene.effects`, its kind first."""
        return (f"follower {self.effect}" if self.frame == "body" else self.effect,)

    def check(self, rod: Rod) -> None:
        """Raises `ValueError` if the load cannot act on `rod`. A scene calls this once."""

    def density(self, rod: Rod, X: ScalarLike) -> Wrench | None:
        """Wrench per length $(c, f)$ at X, six scalars; None for a load at a point."""
        return None

    def point(self, rod: Rod) -> tuple[Scalar, Wrench] | None:
        """Abscissa [m] and wrench $(M, F)$ of a load at a point; None for a load per length."""
        return None

    def points(self, rod: Rod) -> tuple[tuple[Scalar, Wrench], ...]:
        """Abscissas [m] and wrenches $(M, F)$ of all that the load exerts at points."""
        point = self.point(rod)
        return () if point is None else (point,)

    def place(self, rod: Rod) -> Scalar | None:
        """Abscissa [m] of a load at a point; None for a load per length."""
        point = self.point(rod)
        return None if point is None else point[0]

    def breakpoints(self, rod: Rod) -> tuple[Scalar, ...]:
        """Abscissas [m] where the load or a derivative of it jumps."""
        return ()

    def scaled(self, factor: ScalarLike) -> "Load":
        """The load times a factor."""
        return _ScaledLoad(self, factor)


class _ScaledLoad(Load):
    load: Load
    factor: Scalar
    frame: Frame = eqx.field(static=True)
    effect = "scaled load"

    def __init__(self, load: Load, factor: ScalarLike):
        self.load, self.factor, self.frame = load, real(factor), load.frame

    def density(self, rod: Rod, X: ScalarLike) -> Wrench | None:
        whole = self.load.density(rod, X)
        return None if whole is None else scale(self.factor, whole)

    def point(self, rod: Rod) -> tuple[Scalar, Wrench] | None:
        point = self.load.point(rod)
        return None if point is None else (point[0], scale(self.factor, point[1]))

    def points(self, rod: Rod) -> tuple[tuple[Scalar, Wrench], ...]:
        return tuple((X, scale(self.factor, wrench)) for X, wrench in self.load.points(rod))

    def breakpoints(self, rod: Rod) -> tuple[Scalar, ...]:
        return self.load.breakpoints(rod)


def need_density(load: Load, rod: Rod) -> None:
    """Raises `ValueError` if the mass of `rod` is not known."""
    if not rod.material.weighs:
        raise ValueError(
            f"Scene.loads: got a {type(load).__name__} and a rod whose material has no density, "
            "need Material(..., density=...) or Stiffness(..., mass=...)"
        )


def mass_per_length(rod: Rod, X: ScalarLike, displaced: Scalar | None = None) -> Scalar:
    """Mass per reference length [kg/m], less that of a displaced fluid of a given density."""
    mass = rod.material.mass_per_length(rod.section, X, rod.length)
    if displaced is None:
        return mass
    return mass - displaced * rod.section.geometry(X, rod.length).area


class Gravity(Load):
    r"""Weight minus buoyancy: $f = (\rho - \rho_f) A g$ per length, in the world frame, and the
    weights of the rod's discs, if they have a mass.

    **Arguments:**
    - `acceleration`: $g$ [m/s^2] in the world frame, (0, 0, -9.81) by default.
    - `fluid_density`: $\rho_f$ [kg/m^3] of a fluid around the arm, 0 by default. The fluid wets the
      whole surface, the tip included, so that the buoyancy of every slice is the weight of the
      fluid that it displaces at rest.

    The rod's material needs a `density`.
    """

    acceleration: Float[Array, "3"] = eqx.field(metadata={"unit": "m/s^2"})
    fluid_density: Scalar | None = eqx.field(metadata={"unit": "kg/m^3"})
    frame: Frame = eqx.field(static=True, default="world", init=False)
    effect = "gravity"

    def __init__(
        self, acceleration: VectorLike = (0.0, 0.0, -9.81), fluid_density: ScalarLike | None = None
    ):
        self.acceleration = numbers("Gravity.acceleration", acceleration, (3,))
        self.fluid_density = (
            None
            if fluid_density is None
            else numbers("Gravity.fluid_density", fluid_density, least=0.0)
        )
        self.frame = "world"

    @property
    def effects(self) -> tuple[str, ...]:
        return (self.effect,) if self.fluid_density is None else (self.effect, "buoyancy")

    def check(self, rod: Rod) -> None:
        need_density(self, rod)

    def density(self, rod: Rod, X: ScalarLike) -> Wrench:
        weight = mass_per_length(rod, X, self.fluid_density)
        return _force(weight, self.acceleration)

    def points(self, rod: Rod) -> tuple[tuple[Scalar, Wrench], ...]:
        """The weights of the discs, half of it at each face of those with a thickness."""
        discs = rod.discs
        if discs is None or discs.mass is None:
            return ()
        X, mass = discs.faces(rod.length), jnp.broadcast_to(discs.mass, (discs.size,))
        share = X.size // discs.size
        mass = jnp.repeat(mass / share, share)
        return tuple((X[i], _force(mass[i], self.acceleration)) for i in range(X.size))


def _force(mass: Scalar, acceleration: Array) -> Wrench:
    """The wrench of a weight."""
    zero = jnp.zeros_like(mass)
    x, y, z = (mass * g for g in acceleration)
    return zero, zero, zero, x, y, z


class PointWrench(Load):
    """A force and a moment on the section at one abscissa.

    **Arguments:**
    - `X`: abscissa where it acts [m], on the arm.
    - `force` [N], `moment` [N m]: three numbers each.
    - `frame`: `"world"` for a dead wrench, `"body"` for one that rotates with the section.
    """

    X: Scalar = eqx.field(metadata={"unit": "m"})
    force: Float[Array, "3"] = eqx.field(metadata={"unit": "N"})
    moment: Float[Array, "3"] = eqx.field(metadata={"unit": "N m"})
    frame: Frame = eqx.field(static=True)
    effect = "point wrench"

    def __init__(
        self,
        X: ScalarLike,
        force: VectorLike = (0.0, 0.0, 0.0),
        moment: VectorLike = (0.0, 0.0, 0.0),
        frame: Frame = "world",
    ):
        self.X = numbers("PointWrench.X", X, least=0.0)
        self.force = numbers("PointWrench.force", force, (3,))
        self.moment = numbers("PointWrench.moment", moment, (3,))
        self.frame = choice("PointWrench.frame", frame, ("world", "body"))

    def point(self, rod: Rod) -> tuple[Scalar, Wrench]:
        return self.X, (*_three(self.moment), *_three(self.force))

    def breakpoints(self, rod: Rod) -> tuple[Scalar, ...]:
        return (self.X,)


class TipWrench(Load):
    """A force and a moment at the arm's tip; arguments as for `PointWrench`."""

    force: Float[Array, "3"] = eqx.field(metadata={"unit": "N"})
    moment: Float[Array, "3"] = eqx.field(metadata={"unit": "N m"})
    frame: Frame = eqx.field(static=True)
    effect = "tip wrench"

    def __init__(
        self,
        force: VectorLike = (0.0, 0.0, 0.0),
        moment: VectorLike = (0.0, 0.0, 0.0),
        frame: Frame = "world",
    ):
        self.force = numbers("TipWrench.force", force, (3,))
        self.moment = numbers("TipWrench.moment", moment, (3,))
        self.frame = choice("TipWrench.frame", frame, ("world", "body"))

    def point(self, rod: Rod) -> tuple[Scalar, Wrench]:
        return rod.length, (*_three(self.moment), *_three(self.force))


THREE_PROFILES = "three profiles, or a function of X that returns three numbers"


class DistributedWrench(Load):
    """A force and a moment per reference length.

    **Arguments:**
    - `force` [N/m], `moment` [N m/m]: three profiles each (numbers, `Profile` or functions of X),
      or one function of X that returns three numbers.
    - `frame`: `"world"` for a dead load, `"body"` for one that rotates with the sections.
    """

    force: ProfileVector = eqx.field(metadata={"unit": "N/m"})
    moment: ProfileVector = eqx.field(metadata={"unit": "N"})
    frame: Frame = eqx.field(static=True)
    effect = "distributed wrench"

    def __init__(
        self,
        force: ProfilesLike = (0.0, 0.0, 0.0),
        moment: ProfilesLike = (0.0, 0.0, 0.0),
        frame: Frame = "world",
    ):
        self.force, self.moment = (
            as_profiles(name, value, [f"{name}[{i}]" for i in range(3)], THREE_PROFILES)
            for name, value in (
                ("DistributedWrench.force", force),
                ("DistributedWrench.moment", moment),
            )
        )
        self.frame = choice("DistributedWrench.frame", frame, ("world", "body"))

    def density(self, rod: Rod, X: ScalarLike) -> Wrench:
        mx, my, mz = values_at(self.moment, X, rod.length)
        fx, fy, fz = values_at(self.force, X, rod.length)
        return mx, my, mz, fx, fy, fz

    def breakpoints(self, rod: Rod) -> tuple[Scalar, ...]:
        return breakpoints_of(self.force) + breakpoints_of(self.moment)


def _three(array: Float[Array, "3"]) -> Vector3:
    x, y, z = split(array)
    return x, y, z
