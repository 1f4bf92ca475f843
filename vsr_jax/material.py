r"""Materials: with a section they make the stiffness $\Sigma = \mathrm{diag}(G J_x, E J_y, E J_z, E A, \kappa_y G A, \kappa_z G A)$."""

from typing import Any

import equinox as eqx

from ._types import Scalar
from .component import Vector
from .profile import Profile, as_profile
from .section import Section


class Material(eqx.Module):
    """Linear elastic material; its numbers may vary along the arm.

    **Arguments**, each a profile (a number, a `Profile` or a function of X):
    - `young`: Young's modulus $E$ [Pa].
    - `shear` or `poisson`: the shear modulus $G$ [Pa], or Poisson's ratio $\\nu$ [-] for $G = E / (2 + 2\\nu)$; one of the two.
    - `density`: $\\rho$ [kg/m^3], needed by `Gravity` only.
    """

    young: Profile
    shear: Profile | None
    poisson: Profile | None
    density: Profile | None

    def __init__(self, young: Any, shear: Any = None, poisson: Any = None, density: Any = None):
        if (shear is None) == (poisson is None):
            raise ValueError(f"Material: got shear={shear!r} and poisson={poisson!r}, need one of the two")
        self.young = as_profile("Material.young", young, positive=True)
        self.shear = None if shear is None else as_profile("Material.shear", shear, positive=True)
        self.poisson = None if poisson is None else as_profile("Material.poisson", poisson)
        self.density = None if density is None else as_profile("Material.density", density, positive=True)

    def shear_modulus(self, X: Scalar, length: Scalar) -> Scalar:
        """Shear modulus $G$ [Pa] at X [m]."""
        if self.shear is not None:
            return self.shear(X, length)
        assert self.poisson is not None
        return self.young(X, length) / (2 + 2 * self.poisson(X, length))

    def stiffness(self, section: Section, X: Scalar, length: Scalar) -> Vector:
        """Diagonal of $\\Sigma(X)$, six scalars [N m^2] and [N]."""
        shape, E, G = section.geometry(X, length), self.young(X, length), self.shear_modulus(X, length)
        angular = (G * shape.torsion, E * shape.moment_y, E * shape.moment_z)
        shear_y, shear_z = (kappa * G * shape.area for kappa in shape.shear_factors)
        return (*angular, E * shape.area, shear_y, shear_z)

    @property
    def breakpoints(self) -> tuple[Scalar, ...]:
        """Abscissas [m] where a number of the material or a derivative of it jumps."""
        profiles = [p for p in (self.young, self.shear, self.poisson, self.density) if p is not None]
        return tuple(x for profile in profiles for x in profile.breakpoints)
