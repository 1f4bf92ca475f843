r"""Sections of several materials: bores, wires and layers."""

from collections.abc import Callable, Sequence
from typing import Union

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..numerics.component import Vector, add, norm, scale, times
from ..typing import Scalar, ScalarLike, real
from ..validation import ROUNDING, instance, instances
from .actuator import Actuator, between, checked_path
from .description import Part
from .elasticity import Elasticity
from .material import Material
from .profile import Limits, Profile, ProfileLike, as_profile
from .routing import Routing
from .section import Section
from .section_law import CoupledLaw, SectionLaw
from .stiffness import least_eigenvalue

_Room = Callable[[Scalar, Scalar], Scalar]
"""Distance [m] from a point (y, z) to what an inclusion around it must not touch."""


class Region(eqx.Module):
    """A part of a section: its area [m^2] and second moments [m^4] about its own centre, and where
    that is (y, z) [m]."""

    area: Scalar
    moment_y: Scalar
    moment_z: Scalar
    y: Scalar
    z: Scalar

    def stiffness(
        self, E: ScalarLike, G: ScalarLike, kappa: Float[Array, "2"], turn: Scalar
    ) -> Float[Array, "6 6"]:
        r"""Its stiffness about the axis of the arm, where it is filled with one material: a point
        (y, z) is strained by $u_x + k_y z - k_z y$ along the arm and by $(\sqrt{\kappa_y} u_y - t
        k_x z, \sqrt{\kappa_z} u_z + t k_x y)$ across. Since $t^2$ is the torsion constant of the
        section over its polar moment, the whole section has that constant."""
        y, z, zero, one = self.y, self.z, jnp.zeros_like(self.y), jnp.ones_like(self.y)
        shear_y, shear_z = jnp.sqrt(kappa)
        axial = jnp.stack((zero, z, -y, one, zero, zero))
        across_y = jnp.stack((-turn * z, zero, zero, zero, shear_y, zero))
        across_z = jnp.stack((turn * y, zero, zero, zero, zero, shear_z))
        torsion = G * turn**2 * (self.moment_y + self.moment_z)
        own = jnp.stack((torsion, E * self.moment_y, E * self.moment_z, zero, zero, zero))
        across = jnp.outer(across_y, across_y) + jnp.outer(across_z, across_z)
        return jnp.diag(own) + self.area * (E * jnp.outer(axial, axial) + G * across)


class Inclusion(Part):
    """What takes the place of a material in a disc around a path along the arm: a bore, a wire, a
    layer. See `Composite`.

    **Arguments:**
    - `routing`: path of its centre; `Inclusion.of(chamber)` has that of a chamber.
    - `radius`: of the disc [m], a profile.
    - `material`: a `Material` or another `Composite`; a bore without.
    - `start`, `end`: abscissas of its ends [m], by default the arm's base and tip.
    """

    routing: Routing
    radius: Profile = eqx.field(metadata={"unit": "m"})
    material: Union[Material, "Composite", None]
    start: Scalar | None = eqx.field(metadata={"unit": "m"})
    end: Scalar | None = eqx.field(metadata={"unit": "m"})

    def __init__(
        self,
        routing: Routing,
        radius: ProfileLike,
        material: Union[Material, "Composite", None] = None,
        *,
        start: ScalarLike | None = None,
        end: ScalarLike | None = None,
    ):
        self.routing, self.start, self.end = checked_path("Inclusion", routing, start, end)
        self.radius = as_profile("Inclusion.radius", radius, positive=True)
        if material is not None:
            needed = "a Material, a Composite or None"
            instance("Inclusion.material", material, (Material, Composite), needed)
        self.material = material

    @staticmethod
    def of(chamber: Actuator) -> "Inclusion":
        """The bore that a `Chamber` fills: of its path, its ends and its area as they are now. If
        these numbers change later, those of the bore do not."""
        needed = "a Chamber"
        area = instance("Inclusion.of", chamber, Actuator, needed).pressure_area
        if area is None:
            raise ValueError(f"Inclusion.of: got a {type(chamber).__name__}, need {needed}")
        radius = jnp.sqrt(area / jnp.pi)
        return Inclusion(chamber.routing, radius, start=chamber.start, end=chamber.end)

    def disc(self, X: ScalarLike, length: ScalarLike) -> Region:
        """The disc at X [m], as if it had no ends."""
        radius, (y, z) = self.radius(X, length), self.routing(X)
        area = jnp.pi * radius**2
        moment = 0.25 * area * radius**2
        return Region(area, moment, moment, real(y), real(z))

    def present(self, X: ScalarLike) -> Array | None:
        """1 between its ends, 0 elsewhere; None without ends."""
        return between(self.start, self.end, real(X))

    @property
    def breakpoints(self) -> tuple[Scalar, ...]:
        """Abscissas [m] where its path, its size or its material jumps."""
        ends = tuple(x for x in (self.start, self.end) if x is not None)
        inner = () if self.material is None else self.material.breakpoints
        return (*self.routing.breakpoints, *self.radius.breakpoints, *ends, *inner)


class Composite(Elasticity):
    r"""Sections of several materials that are bonded to each other: $\Sigma = \Sigma_0 + \sum_i
    (\Sigma_i - \Sigma_{0,i})$, where $\Sigma_0$ is of the section filled with one material,
    $\Sigma_i$ of the disc of an inclusion and $\Sigma_{0,i}$ of that disc filled with the material
    around it, all about the axis. What lies to one side couples stretch and bending.

        silicone, steel = vsr.Material(1e6, poisson=0.5), vsr.Material(2e11, poisson=0.3)
        bores = [vsr.Inclusion.of(chamber) for chamber in chambers]
        wire = vsr.Inclusion(vsr.Parallel(0.0, 0.0), 2e-4, steel)
        rod = vsr.Rod(0.2, vsr.Circular(0.01), vsr.Composite(silicone, [*bores, wire]))

    Sections stay plane. In those that are not round, inclusions change the torsional stiffness in
    proportion to their share of the polar moment. What lies to one side couples twist and shear
    too. The slope of an inclusion to the axis is left out, and the mass acts in the axis. A layer
    is an inclusion that has one: `Inclusion(axis, 2e-3, Composite(liner, Inclusion(axis, 1e-3)))`
    is a lumen with its liner.

    **Arguments:**
    - `material`: the `Material` around the inclusions.
    - `inclusions`: each inside the section, clear of the others and of the section's own hole.

    **Source:** transformed sections of composite beams, with the parallel axis theorem.
    """

    material: Material
    inclusions: tuple[Inclusion, ...]
    effect = "inclusions"

    def __init__(self, material: Material, inclusions: Sequence[Inclusion] | Inclusion):
        self.material = instance("Composite.material", material, Material, "a Material")
        self.inclusions = instances("Composite.inclusions", inclusions, Inclusion, "an Inclusion")

    def matrix(self, section: Section, X: ScalarLike, length: ScalarLike) -> Float[Array, "6 6"]:
        r"""$\Sigma(X)$ in the order of `vsr_jax.STRAINS` [N m^2, N m, N]."""
        return _content(self, section, X, length)[0]

    def stiffness(self, section: Section, X: ScalarLike, length: ScalarLike) -> Vector:
        """Diagonal of $\\Sigma(X)$, six scalars [N m^2] and [N]."""
        return tuple(jnp.diagonal(self.matrix(section, X, length)))

    def law(self, section: Section, X: ScalarLike, length: ScalarLike) -> SectionLaw:
        """The law of a section at X [m], linear."""
        return CoupledLaw.of(self.matrix(section, X, length))

    @property
    def weighs(self) -> bool:
        fillings = [x.material for x in self.inclusions if x.material is not None]
        return all(material.weighs for material in (self.material, *fillings))

    def mass_per_length(self, section: Section, X: ScalarLike, length: ScalarLike) -> Array:
        return _content(self, section, X, length)[1]

    def limits(self, section: Section, X: ScalarLike, length: ScalarLike) -> Limits:
        """The numbers of all materials, the room that each inclusion has [m], and the least
        eigenvalue of $\\Sigma$."""

        def wall(y: Scalar, z: Scalar) -> Scalar:
            return section.clearance(y, z, X, length)

        def hole(y: Scalar, z: Scalar) -> Scalar:
            radius = section.inner_radius(X, length)
            return jnp.where(radius > 0, norm((y, z)) - radius, jnp.inf)

        rooms = {"a disc inside the section": wall, "a disc clear of the section's hole": hole}
        least = least_eigenvalue(self.matrix(section, X, length))
        return {
            **self._limits_in(rooms, section, X, length),
            ("stiffness (its least eigenvalue, scaled)", "a number > 0"): (least, least),
        }

    def _limits_in(
        self, rooms: dict[str, _Room], section: Section, X: ScalarLike, length: ScalarLike
    ) -> Limits:
        """Limits in a region, with its `rooms` by what is needed of an inclusion in it."""
        found = _below("material", self.material.limits(section, X, length))
        for i, inclusion in enumerate(self.inclusions):
            radius, (y, z) = inclusion.radius(X, length), map(real, inclusion.routing(X))
            spare = {needed: room(y, z) - radius for needed, room in rooms.items()}
            others = [self._apart(other, y, z, X, length) for other in self.inclusions[:i]]
            if others:
                spare["a disc clear of the other inclusions"] = jnp.stack(others).min() - radius
            own = {("radius", "a size > 0"): (radius, radius)}
            for needed, value in spare.items():
                own["radius", needed] = radius, value + ROUNDING * length
            if isinstance(inclusion.material, Composite):

                def around(v: Scalar, w: Scalar, y: Scalar = y, z: Scalar = z, r: Scalar = radius):
                    return r - norm((v - y, w - z))

                inner = {"a disc inside the inclusion around it": around}
                own |= _below("material", inclusion.material._limits_in(inner, section, X, length))
            elif inclusion.material is not None:
                own |= _below("material", inclusion.material.limits(section, X, length))
            here = inclusion.present(X)
            if here is not None:
                own = {k: (v, jnp.where(here > 0, left, jnp.inf)) for k, (v, left) in own.items()}
            found |= _below(f"inclusions[{i}]", own)
        return found

    @staticmethod
    def _apart(other: Inclusion, y: Scalar, z: Scalar, X: ScalarLike, length: ScalarLike) -> Scalar:
        """Distance [m] from a point to another inclusion, endless where that is not present."""
        v, w = other.routing(X)
        apart, here = norm((y - v, z - w)) - other.radius(X, length), other.present(X)
        return apart if here is None else jnp.where(here > 0, apart, jnp.inf)

    @property
    def places(self) -> dict[str, Scalar]:
        found = {}
        for i, inclusion in enumerate(self.inclusions):
            ends = {"start": inclusion.start, "end": inclusion.end}
            if isinstance(inclusion.material, Composite):
                ends |= {f"material.{k}": x for k, x in inclusion.material.places.items()}
            found |= {f"inclusions[{i}].{k}": x for k, x in ends.items() if x is not None}
        return found

    @property
    def breakpoints(self) -> tuple[Scalar, ...]:
        inner = [x for inclusion in self.inclusions for x in inclusion.breakpoints]
        return (*self.material.breakpoints, *inner)


def _content(
    material: Material | Composite, section: Section, X: ScalarLike, length: ScalarLike
) -> tuple[Array, Array]:
    """Stiffness about the axis of the arm (6, 6) and mass per length [kg/m] of a section; without
    mass where its density is not known."""
    shape = section.geometry(X, length)
    turn = jnp.sqrt(shape.torsion / (shape.moment_y + shape.moment_z))

    def filled(material: Material, region: Region) -> tuple[Array, Array]:
        young, shear = material.young(X, length), material.shear_modulus(X, length)
        density = 0.0 if material.density is None else material.density(X, length)
        stiffness = region.stiffness(young, shear, shape.shear_factors, turn)
        return stiffness, density * region.area

    def of(material: Material | Composite, region: Region) -> tuple[Array, Array]:
        if isinstance(material, Material):
            return filled(material, region)
        total = filled(material.material, region)
        for inclusion in material.inclusions:
            disc, here = inclusion.disc(X, length), inclusion.present(X)
            change = scale(-1.0, filled(material.material, disc))
            if inclusion.material is not None:
                change = add(change, of(inclusion.material, disc))
            total = add(total, times(here, change))
        return total

    zero = jnp.zeros_like(shape.area)
    return of(material, Region(shape.area, shape.moment_y, shape.moment_z, zero, zero))


def _below(name: str, limits: Limits) -> Limits:
    return {(f"{name}.{inner}", needed): found for (inner, needed), found in limits.items()}
