"""The rod: a slender arm with its section, material, rest strain and base."""

from collections.abc import Sequence

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array

from ..numerics.component import Vector, norm
from ..numerics.se3 import nearest_pose
from ..typing import ArrayLike, MatrixLike, Pose, Scalar, ScalarLike, real
from ..validation import instance, instances, numbers, rigid as rigid_transform
from .description import Part
from .discs import Discs
from .elasticity import Elasticity
from .profile import (
    Limits,
    ProfilesLike,
    ProfileVector,
    as_profiles,
    breakpoints_of,
    values_at,
)
from .rest_shape import rest_shape
from .rigid_piece import RigidPiece
from .section import Section
from .section_law import SectionLaw

STRAINS = ("torsion", "bending_y", "bending_z", "elongation", "shear_y", "shear_z")
"""Names of the six strains $(k_x, k_y, k_z, u_x, u_y, u_z)$ in order."""

STRAIGHT = (0.0, 0.0, 0.0, 1.0, 0.0, 0.0)
"""Strain of a straight rod without twist, stretch and shear."""


_STRAIN_UNITS = ("1/m", "1/m", "1/m", "-", "-", "-")


class Rod(Part):
    """A Cosserat rod, clamped at its base.

    **Arguments:**
    - `length`: $L$ [m].
    - `section`, `material`: a `Material` and the shape of the section define the stiffness, see
      `Material.stiffness`; a `Stiffness` gives it as it was measured.
    - `rest_strain`: $\\xi^*(X) = (k^*, u^*)$: six profiles (numbers, `Profile` or functions of X),
      or one function of X that returns six numbers. The default (0, 0, 0, 1, 0, 0) is straight. The
      elongation $u_x^*$ must be positive.
    - `base`: pose of the section at X = 0, a rigid transform of shape (4, 4), of which six digits
      are enough; the identity by default.
    - `discs`: the `Discs` that guide the threads outside the section; by default the threads are
      inside the section.
    - `rigid`: the `RigidPiece`s of the arm, parts of it that do not bend.
    """

    length: Scalar = eqx.field(metadata={"unit": "m"})
    section: Section
    material: Elasticity
    rest_strain: ProfileVector = eqx.field(metadata={"unit": _STRAIN_UNITS})
    base: Pose | None = eqx.field(metadata={"unit": "-", "pose": True})
    discs: Discs | None
    rigid: tuple[RigidPiece, ...]

    def __init__(
        self,
        length: ScalarLike,
        section: Section,
        material: Elasticity,
        *,
        rest_strain: ProfilesLike | None = STRAIGHT,
        base: MatrixLike | None = None,
        discs: Discs | None = None,
        rigid: Sequence[RigidPiece] | RigidPiece = (),
    ):
        self.length = numbers("Rod.length", length, positive=True)
        self.section = instance(
            "Rod.section",
            section,
            Section,
            "a section such as Circular, Annular, Rectangular or Elliptic",
        )
        self.material = instance("Rod.material", material, Elasticity, "a Material or a Stiffness")
        self.rest_strain = as_profiles(
            "Rod.rest_strain",
            STRAIGHT if rest_strain is None else rest_strain,
            [f"Rod.rest_strain ({name})" for name in STRAINS],
            f"six profiles in the order {', '.join(STRAINS)}, or a function of X",
        )
        self.base = None if base is None else rigid_transform("Rod.base", base)
        self.discs = None if discs is None else instance("Rod.discs", discs, Discs, "Discs or None")
        self.rigid = instances("Rod.rigid", rigid, RigidPiece, "a RigidPiece")

    @classmethod
    def through(
        cls,
        points: MatrixLike,
        section: Section,
        material: Elasticity,
        *,
        frames: ArrayLike | None = None,
        roll: ScalarLike = 0.0,
        discs: Discs | None = None,
        rigid: Sequence[RigidPiece] | RigidPiece = (),
    ) -> "Rod":
        r"""A rod whose axis at rest is a smooth curve through points: a precurved tube, a coil, a
        shape that was measured or drawn.

            t = jnp.linspace(0, 1, 50)
            arc = jnp.stack([jnp.sin(t), 0 * t, 1 - jnp.cos(t)], axis=1) * 0.2
            rod = vsr.Rod.through(arc, vsr.Circular(0.005), material)

        X is the arc length of the curve. The curve has the error of a cubic spline, of fourth order
        in the distance of the points, and is differentiable by them. It is not smoothed: a noisy
        measurement needs few points or to be smoothed before.

        **Arguments:**
        - `points`: in the world [m], from the base to the tip, shape (points, 3).
        - `section`, `material`, `discs`, `rigid`: as of `Rod`.
        - `frames`: rotations of the sections at the points, with their x axes along the curve,
          shape (points, 3, 3); by default the sections do not turn about the curve.
        - `roll`: without frames, the angle [rad] of the base about the curve, as of `pose`.

        **Raises:** `ValueError` for fewer than two points, the same point twice in a row, and for
        frames that are not rotations or whose x axes point against the curve.
        """
        shape = rest_shape(points, frames, roll)
        return cls(
            shape.length,
            section,
            material,
            rest_strain=shape.strain,
            base=shape.base,
            discs=discs,
            rigid=rigid,
        )

    @property
    def frame(self) -> Pose | None:
        """Pose of the section at X = 0: the base with its rotation orthonormal to rounding. With
        one of six digits the residual would have no energy, and arms that lie along a wall would
        take many more steps, or not be solved."""
        return None if self.base is None else nearest_pose(self.base)

    def rest(self, X: ScalarLike) -> Vector:
        """Rest strain $\\xi^*$ at X [m], six scalars."""
        return values_at(self.rest_strain, X, self.length)

    def stiffness(self, X: ScalarLike) -> Vector:
        """Diagonal of $\\Sigma$ at X [m], six scalars [N m^2] and [N]."""
        return self.material.stiffness(self.section, X, self.length)

    def law(self, X: ScalarLike) -> SectionLaw:
        """Law of the section at X [m]."""
        return self.material.law(self.section, X, self.length)

    def flexible(self, X: ArrayLike) -> Array | None:
        """0 where X [m], of any shape, lies on a rigid piece or in a disc with a thickness and 1
        elsewhere; None without these."""
        if not self.stiffened:
            return None
        X = real(X)
        here = [piece.covers(X) for piece in self.rigid]
        here += [] if self.discs is None else [self.discs.stiffen(X, self.length)]
        return jnp.where(jnp.any(jnp.stack(here), axis=0), jnp.zeros_like(X), jnp.ones_like(X))

    @property
    def stiffened(self) -> bool:
        """Whether parts of the arm do not bend: rigid pieces, and discs with a thickness."""
        return bool(self.rigid) or (self.discs is not None and self.discs.thickness is not None)

    def limits(self, X: ScalarLike) -> Limits:
        """Sizes, material properties and rest elongation at X [m] and their limits."""
        parts = {
            "section": self.section.limits(X, self.length),
            "material": self.material.limits(self.section, X, self.length),
        }
        found = {
            (f"{part}.{name}", needed): pair
            for part, limits in parts.items()
            for (name, needed), pair in limits.items()
        }
        elongation = self.rest(X)[3]
        return {
            **found,
            ("rest_strain (elongation)", "a number > 0, which is 1 at the length of the rod,"): (
                elongation,
                elongation,
            ),
        }

    @property
    def rim(self) -> Scalar | None:
        """Radius [m] of the discs; None without discs of a known one."""
        return None if self.discs is None else self.discs.radius

    def clearance(self, y: ScalarLike, z: ScalarLike, X: ScalarLike) -> Array:
        """Distance [m] from (y, z) to the section's wall or the guide at X: positive inside."""
        inside = self.section.clearance(y, z, X, self.length)
        return (
            inside if self.rim is None else jnp.maximum(inside, self.rim - norm((real(y), real(z))))
        )

    def outline(self, X: ScalarLike) -> Scalar:
        """Radius [m] of the round outline of the arm about its axis at X: that of the section, of
        its corners where it is not round, or of the discs if that is greater."""
        radius = self.section.outer_radius(X, self.length)
        return radius if self.rim is None else jnp.maximum(radius, self.rim)

    @property
    def breakpoints(self) -> tuple[Scalar, ...]:
        """Abscissas [m] where a size, a material property, the rest strain or one of their
        derivatives jumps, and the ends of rigid pieces."""
        return (
            *self.section.breakpoints,
            *self.material.breakpoints,
            *breakpoints_of(self.rest_strain),
            *(x for piece in self.rigid for x in piece.breakpoints),
        )
