r"""Sections of several materials: bores, wires and layers."""

from collections.abc import Callable, Sequence
from typing import Union

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..numerics.component import Vector, norm
from ..typing import Scalar, ScalarLike, real
from ..validation import ROUNDING, instance, instances, numbers
from .actuator import Actuator, between
from .description import Part
from .elasticity import Elasticity
from .material import Material
from .profile import Limits, Profile, ProfileLike, as_profile
from .routing import Routing
from .section import Geometry, Section
from .section_law import CoupledLaw, SectionLaw

_Room = Callable[[Scalar, Scalar], Scalar]
"""Distance [m] from a point (y, z) to what an inclusion around it must not touch."""


class Region(eqx.Module):
    """A part of a section: its `shape` about its own centre, and where that is (y, z) [m]."""

    shape: Geometry
    y: Scalar
    z: Scalar

    def stiffness(self, E: ScalarLike, G: ScalarLike) -> Float[Array, "6 6"]:
        """Its stiffness about the axis of the arm, where it is filled with one material: a point
        (y, z) is strained by $u_x + k_y z - k_z y$ along the arm and by $(u_y - k_x z, u_z + k_x
        y)$ across."""
        shape, zero, one = self.shape, jnp.zeros_like(self.y), jnp.ones_like(self.y)
        axial = jnp.stack((zero, self.z, -self.y, one, zero, zero))
        across_y = jnp.stack((-self.z, zero, zero, zero, one, zero))
        across_z = jnp.stack((self.y, zero, zero, zero, zero, one))
        own = (G * shape.torsion, E * shape.moment_y, E * shape.moment_z, zero, zero, zero)
        shear_y, shear_z = (factor * G * shape.area for factor in shape.shear_factors)
        return (
            jnp.diag(jnp.stack(own))
            + E * shape.area * jnp.outer(axial, axial)
            + shear_y * jnp.outer(across_y, across_y)
            + shear_z * jnp.outer(across_z, across_z)
        )


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
        self.routing = instance("Inclusion.routing", routing, Routing, "a routing such as Parallel")
        self.radius = as_profile("Inclusion.radius", radius, positive=True)
        if material is not None:
            needed = "a Material, a Composite or None"
            instance("Inclusion.material", material, (Material, Composite), needed)
        self.material = material
        self.start = None if start is None else numbers("Inclusion.start", start, least=0.0)
        self.end = None if end is None else numbers("Inclusion.end", end, positive=True)

    @staticmethod
    def of(chamber: Actuator) -> "Inclusion":
        """The bore that a `Chamber` fills: of its path, its ends and its area."""
        area = chamber.pressure_area
        if area is None:
            raise ValueError(f"Inclusion.of: got a {type(chamber).__name__}, need a Chamber")
        radius = jnp.sqrt(area / jnp.pi)
        return Inclusion(chamber.routing, radius, start=chamber.start, end=chamber.end)

    def region(self, factors: Array, X: ScalarLike, length: ScalarLike) -> Region:
        """The disc at X [m], of no size beyond the ends, with given shear factors."""
        radius, (y, z) = self.radius(X, length), self.routing(X)
        share = between(self.start, self.end, real(X))
        area = jnp.pi * radius**2 if share is None else share * jnp.pi * radius**2
        moment = 0.25 * area * radius**2
        return Region(Geometry(area, moment, moment, 2 * moment, factors), real(y), real(z))

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

    Sections stay plane and do not warp; the slope of an inclusion to the axis is left out. The mass
    acts in the axis. A layer is an inclusion that has one: `Inclusion(axis, 2e-3, Composite(liner,
    Inclusion(axis, 1e-3)))` is a lumen with its liner.

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
        return _content(self, _whole(section, X, length), X, length)[0]

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
        return _content(self, _whole(section, X, length), X, length)[1]

    def limits(self, section: Section, X: ScalarLike, length: ScalarLike) -> Limits:
        """The numbers of all materials, and the room that each inclusion has [m]."""

        def room(y: Scalar, z: Scalar) -> Scalar:
            hole = section.inner_radius(X, length)
            aside = jnp.where(hole > 0, norm((y, z)) - hole, jnp.inf)
            return jnp.minimum(section.clearance(y, z, X, length), aside)

        return self._limits_in(room, section, X, length)

    def _limits_in(
        self, room: _Room, section: Section, X: ScalarLike, length: ScalarLike
    ) -> Limits:
        """Limits in a region, of which `room` is the distance [m] from a point to the edge."""
        found = _below("material", self.material.limits(section, X, length))
        for i, inclusion in enumerate(self.inclusions):
            radius, (y, z) = inclusion.radius(X, length), map(real, inclusion.routing(X))
            rooms = [room(y, z)]
            for other in self.inclusions[:i]:
                v, w = other.routing(X)
                rooms.append(norm((y - v, z - w)) - other.radius(X, length))
            share = between(inclusion.start, inclusion.end, real(X))
            spare = jnp.stack(rooms).min() - radius + ROUNDING * length
            spare = spare if share is None else jnp.where(share > 0, spare, jnp.inf)
            own = {
                ("radius", "a size > 0"): (radius, radius),
                ("radius", "a disc inside what is around it and clear of others"): (radius, spare),
            }
            if isinstance(inclusion.material, Composite):
                inner = lambda v, w, y=y, z=z, r=radius: r - norm((v - y, w - z))  # noqa: E731
                inside = inclusion.material._limits_in(inner, section, X, length)
                own |= _below("material", inside)
            elif inclusion.material is not None:
                own |= _below("material", inclusion.material.limits(section, X, length))
            found |= _below(f"inclusions[{i}]", own)
        return found

    @property
    def breakpoints(self) -> tuple[Scalar, ...]:
        inner = [x for inclusion in self.inclusions for x in inclusion.breakpoints]
        return (*self.material.breakpoints, *inner)


def _whole(section: Section, X: ScalarLike, length: ScalarLike) -> Region:
    shape = section.geometry(X, length)
    return Region(shape, jnp.zeros_like(shape.area), jnp.zeros_like(shape.area))


def _content(
    material: Material | Composite, region: Region, X: ScalarLike, length: ScalarLike
) -> tuple[Array, Array]:
    """Stiffness about the axis of the arm (6, 6) and mass per length [kg/m] of a region that is
    made of a material; without mass where its density is not known."""
    if isinstance(material, Composite):
        bulk = material.material
        stiffness, mass = _content(bulk, region, X, length)
        for inclusion in material.inclusions:
            disc = inclusion.region(region.shape.shear_factors, X, length)
            less, lighter = _content(bulk, disc, X, length)
            stiffness, mass = stiffness - less, mass - lighter
            if inclusion.material is not None:
                more, heavier = _content(inclusion.material, disc, X, length)
                stiffness, mass = stiffness + more, mass + heavier
        return stiffness, mass
    young, shear = material.young(X, length), material.shear_modulus(X, length)
    density = 0.0 if material.density is None else material.density(X, length)
    return region.stiffness(young, shear), density * region.shape.area


def _below(name: str, limits: Limits) -> Limits:
    return {(f"{name}.{inner}", needed): found for (inner, needed), found in limits.items()}
