"""How the sections of an arm resist strain, and what they weigh: the interface of materials."""

from abc import abstractmethod
from typing import ClassVar

import equinox as eqx
from jaxtyping import Array

from ..numerics.component import Vector
from ..typing import Scalar, ScalarLike
from .description import Part
from .profile import Limits, Profile
from .section import Section
from .section_law import LinearLaw, SectionLaw


class Elasticity(Part):
    """What a `Rod` is made of: a `Material`, which with the shape of the section gives its
    stiffness, or a `Stiffness` as it was measured. All methods take X and the arm's length [m]."""

    effect: ClassVar[str | None] = None
    """Its name in `Scene.effects`; None for what is linear and of one material."""

    @abstractmethod
    def stiffness(self, section: Section, X: ScalarLike, length: ScalarLike) -> Vector:
        r"""Diagonal of $\Sigma(X)$, six scalars [N m^2] and [N]."""

    def law(self, section: Section, X: ScalarLike, length: ScalarLike) -> SectionLaw:
        """The law of a section, linear and without couplings unless a subclass says otherwise."""
        return LinearLaw()

    @property
    @abstractmethod
    def weighs(self) -> bool:
        """Whether the mass is known."""

    @abstractmethod
    def mass_per_length(self, section: Section, X: ScalarLike, length: ScalarLike) -> Array:
        """Mass per reference length [kg/m], where it is known."""

    def moduli(self, X: ScalarLike, length: ScalarLike) -> tuple[Scalar, Scalar] | None:
        """Young's and the shear modulus [Pa], None where stress in a section is not known."""
        return None

    @property
    def locked(self) -> tuple[str, ...]:
        """Names of the strains that do not change."""
        return ()

    @abstractmethod
    def limits(self, section: Section, X: ScalarLike, length: ScalarLike) -> Limits:
        """Its numbers and their limits, in a section."""

    @property
    def places(self) -> dict[str, Scalar]:
        """Abscissas [m] by name that must be on the arm."""
        return {}

    @property
    @abstractmethod
    def breakpoints(self) -> tuple[Scalar, ...]:
        """Abscissas [m] where a property or one of its derivatives jumps."""


class Solid(Elasticity):
    """A material that fills its sections, whose mass follows from its density."""

    density: eqx.AbstractVar[Profile | None]

    @property
    def weighs(self) -> bool:
        return self.density is not None

    def mass_per_length(self, section: Section, X: ScalarLike, length: ScalarLike) -> Array:
        assert self.density is not None  # see `weighs`
        return self.density(X, length) * section.geometry(X, length).area
