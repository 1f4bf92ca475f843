r"""Materials: with a section they define the stiffness $\Sigma = \mathrm{diag}(G J_x, E J_y, E
J_z, E A, \kappa_y G A, \kappa_z G A)$."""

import equinox as eqx
import jax.numpy as jnp

from ..numerics.component import Vector
from ..typing import Scalar, ScalarLike
from .elasticity import Solid
from .profile import Limits, Profile, ProfileLike, as_profile
from .section import Geometry, Section

LEAST_POISSON, MOST_POISSON = -1.0, 0.5
"""Range of Poisson's ratio of a stable isotropic material; the lower bound is excluded."""


class Material(Solid):
    """Linear elastic material, uniform or varying along the arm.

    **Arguments**, each a profile (a number, a `Profile` or a function of X):
    - `young`: Young's modulus $E$ [Pa].
    - `shear` or `poisson`: the shear modulus $G$ [Pa], or Poisson's ratio $-1 < \\nu \\le 0.5$ [-]
      for $G = E / (2 + 2\\nu)$; exactly one of the two.
    - `density`: $\\rho$ [kg/m^3], required only by `Gravity`.
    """

    young: Profile = eqx.field(metadata={"unit": "Pa"})
    shear: Profile | None = eqx.field(metadata={"unit": "Pa"})
    poisson: Profile | None = eqx.field(metadata={"unit": "-"})
    density: Profile | None = eqx.field(metadata={"unit": "kg/m^3"})

    def __init__(
        self,
        young: ProfileLike,
        shear: ProfileLike | None = None,
        poisson: ProfileLike | None = None,
        density: ProfileLike | None = None,
    ):
        if (shear is None) == (poisson is None):
            raise ValueError(
                f"Material: got shear={shear!r} and poisson={poisson!r}, need one of the two"
            )
        self.young = as_profile("Material.young", young, positive=True)
        self.shear = None if shear is None else as_profile("Material.shear", shear, positive=True)
        self.poisson = (
            None
            if poisson is None
            else as_profile("Material.poisson", poisson, above=LEAST_POISSON, most=MOST_POISSON)
        )
        self.density = (
            None if density is None else as_profile("Material.density", density, positive=True)
        )

    def shear_modulus(self, X: ScalarLike, length: ScalarLike) -> Scalar:
        """Shear modulus $G$ [Pa] at X [m]."""
        if self.shear is not None:
            return self.shear(X, length)
        assert self.poisson is not None
        return self.young(X, length) / (2 + 2 * self.poisson(X, length))

    def limits(self, section: Section, X: ScalarLike, length: ScalarLike) -> Limits:
        """The properties at X [m] and their limits."""
        given = {
            name: p
            for name, p in (("young", self.young), ("shear", self.shear), ("density", self.density))
            if p is not None
        }
        values = {name: profile(X, length) for name, profile in given.items()}
        found = {(name, "a number > 0"): (value, value) for name, value in values.items()}
        if self.poisson is not None:
            ratio = self.poisson(X, length)
            room = jnp.where(ratio <= MOST_POISSON, ratio - LEAST_POISSON, MOST_POISSON - ratio)
            found["poisson", f"a ratio > {LEAST_POISSON:g} and <= {MOST_POISSON:g}"] = ratio, room
        return found

    def stiffness(self, section: Section, X: ScalarLike, length: ScalarLike) -> Vector:
        """Diagonal of $\\Sigma(X)$, six scalars [N m^2] and [N]."""
        shape = section.geometry(X, length)
        return isotropic_stiffness(shape, self.young(X, length), self.shear_modulus(X, length))

    def moduli(self, X: ScalarLike, length: ScalarLike) -> tuple[Scalar, Scalar] | None:
        return self.young(X, length), self.shear_modulus(X, length)

    @property
    def breakpoints(self) -> tuple[Scalar, ...]:
        """Abscissas [m] where a property or one of its derivatives jumps."""
        profiles = [
            p for p in (self.young, self.shear, self.poisson, self.density) if p is not None
        ]
        return tuple(x for profile in profiles for x in profile.breakpoints)


def isotropic_stiffness(shape: Geometry, E: Scalar, G: Scalar) -> Vector:
    """Diagonal of $\\Sigma$, six scalars [N m^2] and [N], of a section of one material."""
    angular = (G * shape.torsion, E * shape.moment_y, E * shape.moment_z)
    shear_y, shear_z = (kappa * G * shape.area for kappa in shape.shear_factors)
    return (*angular, E * shape.area, shear_y, shear_z)
