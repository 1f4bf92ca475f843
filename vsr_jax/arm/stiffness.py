"""Stiffness as it was measured or computed elsewhere."""

from collections.abc import Callable

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from ..numerics.component import Vector
from ..typing import MatrixLike, Scalar, ScalarLike, real
from ..validation import concrete, numbers
from .elasticity import Elasticity
from .profile import FunctionOfX, Limits, Profile, ProfileLike, as_profile
from .section import Section
from .section_law import CoupledLaw, SectionLaw

_SYMMETRY = 1e-6
"""Difference of two entries of a matrix, as a share of its diagonal, that is taken for rounding."""

MatrixFunctionLike = MatrixLike | Callable[[Scalar], Array] | FunctionOfX
"""A matrix, or a function of X that returns one."""


class Stiffness(Elasticity):
    r"""Stiffness of the sections, in place of a `Material`: $\Sigma = \mathrm{diag}(GJ, EI_y, EI_z,
    EA, GA_y, GA_z)$, or a full matrix. The rod's section then is its outline only.

        shaft = vsr.Rod(1.0, vsr.Circular(2e-3), vsr.Stiffness(EI_y=3e-3, mass=0.01))

    **Arguments**, profiles (a number, a `Profile` or a function of X) but for the matrix:
    - `EI_y`, `EI_z`: bending stiffness about y and z [N m^2], by default the same for both.
    - `GJ`: torsional stiffness [N m^2]; without it the arm does not twist.
    - `EA`: axial stiffness [N]; without it the arm does not stretch.
    - `GA_y`, `GA_z`: shear stiffness along y and z [N], by default the same; without both the arm
      does not shear.
    - `matrix`: in place of all these, $\Sigma$ as a symmetric positive definite matrix of shape
      (6, 6), or a function of X that returns one, in the order of `vsr_jax.STRAINS`: moments x, y,
      z, forces x, y, z by curvatures [1/m] and strains [-]. A neutral axis off the centre couples
      stretch and bending, fibres couple stretch and twist.
    - `mass`: mass per length [kg/m], required only by `Gravity`.
    """

    EI_y: Profile | None = eqx.field(metadata={"unit": "N m^2"})
    EI_z: Profile | None = eqx.field(metadata={"unit": "N m^2"})
    GJ: Profile | None = eqx.field(metadata={"unit": "N m^2"})
    EA: Profile | None = eqx.field(metadata={"unit": "N"})
    GA_y: Profile | None = eqx.field(metadata={"unit": "N"})
    GA_z: Profile | None = eqx.field(metadata={"unit": "N"})
    matrix: Array | FunctionOfX | None = eqx.field(metadata={"unit": "N, N m, N m^2"})
    mass: Profile | None = eqx.field(metadata={"unit": "kg/m"})

    def __init__(
        self,
        EI_y: ProfileLike | None = None,
        EI_z: ProfileLike | None = None,
        GJ: ProfileLike | None = None,
        EA: ProfileLike | None = None,
        GA_y: ProfileLike | None = None,
        GA_z: ProfileLike | None = None,
        *,
        matrix: MatrixFunctionLike | None = None,
        mass: ProfileLike | None = None,
    ):
        given = {"EI_y": EI_y, "EI_z": EI_z, "GJ": GJ, "EA": EA, "GA_y": GA_y, "GA_z": GA_z}
        named = [name for name, value in given.items() if value is not None]
        if (EI_y is None) == (matrix is None) or (matrix is not None and named):
            raise ValueError(
                f"Stiffness: got {', '.join(named) or 'no stiffness'}"
                f"{'' if matrix is None else ' and a matrix'}, need EI_y and others, or a matrix"
            )
        for first, second in (("EI_y", "EI_z"), ("GA_y", "GA_z")):
            given[second] = given[first] if given[second] is None else given[second]
        if given["GA_y"] is None and given["GA_z"] is not None:
            raise ValueError("Stiffness: got GA_z without GA_y, need both or neither")
        for name, value in given.items():
            profile = (
                None if value is None else as_profile(f"Stiffness.{name}", value, positive=True)
            )
            setattr(self, name, profile)
        self.matrix = None if matrix is None else _checked(matrix)
        self.mass = None if mass is None else as_profile("Stiffness.mass", mass, positive=True)

    @property
    def _profiles(self) -> dict[str, Profile]:
        """The profiles that are given, by name."""
        names = "GJ", "EI_y", "EI_z", "EA", "GA_y", "GA_z", "mass"
        found = {name: getattr(self, name) for name in names}
        return {name: profile for name, profile in found.items() if profile is not None}

    def _matrix(self, X: ScalarLike) -> Array:
        matrix = self.matrix(X) if isinstance(self.matrix, FunctionOfX) else self.matrix
        found = jnp.asarray(matrix)
        return 0.5 * (found + found.T)

    def stiffness(self, section: Section, X: ScalarLike, length: ScalarLike) -> Vector:
        """Diagonal of $\\Sigma(X)$, six scalars [N m^2] and [N]. In place of what is not given are
        those of a round bar of the same bending stiffness, as scales of convergence tests."""
        if self.matrix is not None:
            return tuple(jnp.diagonal(self._matrix(X)))
        known = {name: profile(X, length) for name, profile in self._profiles.items()}
        bending, axial = known["EI_y"], 4 * known["EI_y"] / section.outer_radius(X, length) ** 2
        usual = {"GJ": bending, "EA": axial, "GA_y": axial, "GA_z": axial} | known
        return tuple(usual[name] for name in ("GJ", "EI_y", "EI_z", "EA", "GA_y", "GA_z"))

    def law(self, section: Section, X: ScalarLike, length: ScalarLike) -> SectionLaw:
        """The law of a section at X [m], linear."""
        if self.matrix is None:
            return super().law(section, X, length)
        return CoupledLaw.of(self._matrix(X))

    @property
    def weighs(self) -> bool:
        return self.mass is not None

    def mass_per_length(self, section: Section, X: ScalarLike, length: ScalarLike) -> Array:
        assert self.mass is not None  # see `weighs`
        return real(self.mass(X, length))

    @property
    def locked(self) -> tuple[str, ...]:
        if self.matrix is not None:
            return ()
        strains = {"torsion": self.GJ, "elongation": self.EA}
        strains |= {"shear_y": self.GA_y, "shear_z": self.GA_z}
        return tuple(name for name, stiffness in strains.items() if stiffness is None)

    def limits(self, section: Section, X: ScalarLike, length: ScalarLike) -> Limits:
        values = {name: profile(X, length) for name, profile in self._profiles.items()}
        found = {(name, "a number > 0"): (value, value) for name, value in values.items()}
        if self.matrix is not None:
            least = least_eigenvalue(self._matrix(X))
            found["matrix (its least eigenvalue, scaled)", "a number > 0"] = least, least
        return found

    @property
    def breakpoints(self) -> tuple[Scalar, ...]:
        return tuple(x for profile in self._profiles.values() for x in profile.breakpoints)


def least_eigenvalue(matrix: Array) -> Array:
    """The least eigenvalue of a matrix whose diagonal is scaled to 1: units do not matter."""
    size = jnp.sqrt(jnp.abs(jnp.diagonal(matrix)))
    return jnp.linalg.eigvalsh(matrix / (size[:, None] * size))[0]


def _checked(matrix: MatrixFunctionLike) -> Array | FunctionOfX:
    name = "Stiffness.matrix"
    if isinstance(matrix, FunctionOfX):
        return matrix
    if callable(matrix):
        return FunctionOfX(name, matrix)
    found = numbers(name, matrix, (6, 6))
    known = concrete(found)
    if known is not None:
        size = np.sqrt(np.abs(np.diagonal(known)))
        if np.any(np.abs(known - known.T) > _SYMMETRY * size[:, None] * size):
            raise ValueError(f"{name}: got a matrix that is not symmetric, need a symmetric one")
    return found
