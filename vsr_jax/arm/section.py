"""Cross-sections: their shapes, areas and second moments.

The y and z axes lie in the section, x along the arm. Sizes are profiles: a number, a `Profile` or a
function of X.
"""

import math
from abc import abstractmethod
from collections.abc import Sequence
from typing import Literal

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..numerics.component import norm
from ..typing import ArrayLike, Scalar, ScalarLike, VectorLike, real
from ..validation import choice, concrete, instance, numbers
from .description import Part
from .profile import Constant, Limits, Profile, ProfileLike, as_profile, pick, rising_ends, scaled

Torsion = Literal["saint_venant", "polar"]


class Geometry(eqx.Module):
    """Area [m^2], second moments about y and z and torsion constant [m^4], and shear factors [-] of
    one cross-section."""

    area: Scalar = eqx.field(metadata={"unit": "m^2"})
    moment_y: Scalar = eqx.field(metadata={"unit": "m^4"})
    moment_z: Scalar = eqx.field(metadata={"unit": "m^4"})
    torsion: Scalar = eqx.field(metadata={"unit": "m^4"})
    shear_factors: Float[Array, "2"] = eqx.field(metadata={"unit": "-"})


class Section(Part):
    """A cross-section, uniform or varying along the arm.

    **Arguments shared by the shapes:**
    - `torsion`: `"saint_venant"` is the torsion constant of the shape, `"polar"` the polar moment
      $J_y + J_z$ (as in the paper). Both agree for circular and annular sections.
    - `shear_correction`: factors $(\\kappa_y, \\kappa_z)$ of the shear stiffness [-], one number
      for both; 1 in the paper.
    """

    @abstractmethod
    def geometry(self, X: ScalarLike, length: ScalarLike) -> Geometry:
        """Area, second moments and torsion constant at X [m]."""

    @abstractmethod
    def clearance(self, y: ScalarLike, z: ScalarLike, X: ScalarLike, length: ScalarLike) -> Scalar:
        """Distance [m] from (y, z) to the outer wall at X: positive inside, negative outside."""

    @abstractmethod
    def outline(self, angle: ArrayLike, X: ScalarLike, length: ScalarLike) -> tuple[Array, Array]:
        """Points (y, z) [m] of the outer wall at X, a closed curve for `angle` [rad] from 0 (on the
        y axis) to 2 pi."""

    @abstractmethod
    def outer_radius(self, X: ScalarLike, length: ScalarLike) -> Scalar:
        """Distance [m] from the axis to the farthest point of the outer wall at X."""

    def inner_radius(self, X: ScalarLike, length: ScalarLike) -> Scalar:
        """Radius [m] of the central hole at X, 0 for a solid section."""
        return jnp.zeros_like(real(X))

    @property
    @abstractmethod
    def sizes(self) -> dict[str, Profile]:
        """The size profiles by name."""

    def limits(self, X: ScalarLike, length: ScalarLike) -> Limits:
        """The sizes at X [m] and their limits."""
        sizes = {name: size(X, length) for name, size in self.sizes.items()}
        return {(name, "a size > 0"): (size, size) for name, size in sizes.items()}

    @property
    def breakpoints(self) -> tuple[Scalar, ...]:
        """Abscissas [m] where a size or one of its derivatives jumps."""
        return tuple(x for size in self.sizes.values() for x in size.breakpoints)


def _size(section: str, name: str, value: ProfileLike) -> Profile:
    return as_profile(f"{section}.{name}", value, positive=True)


def _options(torsion: Torsion, shear_correction: VectorLike) -> tuple[Torsion, Float[Array, "2"]]:
    factor = numbers("shear_correction", shear_correction, None, positive=True)
    if factor.shape not in ((), (2,)):
        raise ValueError(f"shear_correction: got shape {factor.shape}, need one number or two")
    return choice("torsion", torsion, ("saint_venant", "polar")), jnp.broadcast_to(factor, (2,))


class Circular(Section):
    """Solid disc: $A = \\pi r^2$, $J_y = J_z = \\pi r^4 / 4$, $J_x = \\pi r^4 / 2$.

    **Arguments:** `radius` or `diameter` [m], exactly one of the two; the radius is stored.
    """

    radius: Profile = eqx.field(metadata={"unit": "m"})
    torsion: Torsion = eqx.field(static=True)
    shear_correction: Float[Array, "2"] = eqx.field(metadata={"unit": "-"})

    def __init__(
        self,
        radius: ProfileLike | None = None,
        *,
        diameter: ProfileLike | None = None,
        shear_correction: VectorLike = 1.0,
    ):
        if (radius is None) == (diameter is None):
            raise ValueError(
                f"Circular: got radius={radius!r} and diameter={diameter!r}, need one of the two"
            )
        if radius is not None:
            self.radius = _size("Circular", "radius", radius)
        elif diameter is not None:
            self.radius = scaled(0.5, _size("Circular", "diameter", diameter))
        self.torsion, self.shear_correction = _options("saint_venant", shear_correction)

    def geometry(self, X: ScalarLike, length: ScalarLike) -> Geometry:
        r = self.radius(X, length)
        moment = math.pi / 4 * r**4
        return Geometry(math.pi * r**2, moment, moment, 2 * moment, self.shear_correction)

    def clearance(self, y: ScalarLike, z: ScalarLike, X: ScalarLike, length: ScalarLike) -> Scalar:
        return self.radius(X, length) - norm((real(y), real(z)))

    def outline(self, angle: ArrayLike, X: ScalarLike, length: ScalarLike) -> tuple[Array, Array]:
        r, angle = self.radius(X, length), real(angle)
        return r * jnp.cos(angle), r * jnp.sin(angle)

    def outer_radius(self, X: ScalarLike, length: ScalarLike) -> Scalar:
        return self.radius(X, length)

    @property
    def sizes(self) -> dict[str, Profile]:
        return {"radius": self.radius}


class Annular(Section):
    """Tube of radii $r < R$: $A = \\pi (R^2 - r^2)$, $J_y = J_z = \\pi (R^4 - r^4) / 4$, $J_x = 2
    J_y$."""

    outer: Profile = eqx.field(metadata={"unit": "m"})
    inner: Profile = eqx.field(metadata={"unit": "m"})
    torsion: Torsion = eqx.field(static=True)
    shear_correction: Float[Array, "2"] = eqx.field(metadata={"unit": "-"})

    def __init__(
        self, outer: ProfileLike, inner: ProfileLike, *, shear_correction: VectorLike = 1.0
    ):
        self.outer = _size("Annular", "outer", outer)
        self.inner = _size("Annular", "inner", inner)
        if isinstance(self.outer, Constant) and isinstance(self.inner, Constant):
            known = concrete(self.inner.value), concrete(self.outer.value)
            if known[0] is not None and known[1] is not None and not known[0] < known[1]:
                raise ValueError(
                    f"Annular.inner: got {known[0]:g} m, need less than the outer radius, "
                    f"{known[1]:g} m"
                )
        self.torsion, self.shear_correction = _options("saint_venant", shear_correction)

    def geometry(self, X: ScalarLike, length: ScalarLike) -> Geometry:
        outer, inner = self.outer(X, length), self.inner(X, length)
        moment = math.pi / 4 * (outer**4 - inner**4)
        return Geometry(
            math.pi * (outer**2 - inner**2), moment, moment, 2 * moment, self.shear_correction
        )

    def clearance(self, y: ScalarLike, z: ScalarLike, X: ScalarLike, length: ScalarLike) -> Scalar:
        return self.outer(X, length) - norm((real(y), real(z)))

    def outline(self, angle: ArrayLike, X: ScalarLike, length: ScalarLike) -> tuple[Array, Array]:
        r, angle = self.outer(X, length), real(angle)
        return r * jnp.cos(angle), r * jnp.sin(angle)

    def outer_radius(self, X: ScalarLike, length: ScalarLike) -> Scalar:
        return self.outer(X, length)

    def inner_radius(self, X: ScalarLike, length: ScalarLike) -> Scalar:
        return self.inner(X, length)

    @property
    def sizes(self) -> dict[str, Profile]:
        return {"outer": self.outer, "inner": self.inner}

    def limits(self, X: ScalarLike, length: ScalarLike) -> Limits:
        inner = self.inner(X, length)
        return {
            **super().limits(X, length),
            ("inner", "less than the outer radius"): (inner, self.outer(X, length) - inner),
        }


class Rectangular(Section):
    r"""Rectangle of width $w$ along y and height $h$ along z: $J_y = w h^3 / 12$, $J_z = h w^3 /
    12$.

    The Saint-Venant constant with $a \ge b$ the sides is $\frac{a b^3}{3} \left(1 -
    \frac{192}{\pi^5} \frac b a \sum_{n\,odd} \frac{1}{n^5} \tanh\frac{n \pi a}{2 b}\right)$; the
    part of the sum with tanh = 1 is exact, so nine terms are accurate to rounding. **Source:**
    Timoshenko & Goodier, Theory of Elasticity, art. 109.
    """

    width: Profile = eqx.field(metadata={"unit": "m"})
    height: Profile = eqx.field(metadata={"unit": "m"})
    torsion: Torsion = eqx.field(static=True)
    shear_correction: Float[Array, "2"] = eqx.field(metadata={"unit": "-"})

    def __init__(
        self,
        width: ProfileLike,
        height: ProfileLike,
        *,
        torsion: Torsion = "saint_venant",
        shear_correction: VectorLike = 1.0,
    ):
        self.width = _size("Rectangular", "width", width)
        self.height = _size("Rectangular", "height", height)
        self.torsion, self.shear_correction = _options(torsion, shear_correction)

    def geometry(self, X: ScalarLike, length: ScalarLike) -> Geometry:
        w, h = self.width(X, length), self.height(X, length)
        moment_y, moment_z = w * h**3 / 12, h * w**3 / 12
        torsion = moment_y + moment_z if self.torsion == "polar" else _rectangle_torsion(w, h)
        return Geometry(w * h, moment_y, moment_z, torsion, self.shear_correction)

    def clearance(self, y: ScalarLike, z: ScalarLike, X: ScalarLike, length: ScalarLike) -> Scalar:
        return jnp.minimum(
            self.width(X, length) / 2 - jnp.abs(y), self.height(X, length) / 2 - jnp.abs(z)
        )

    def outline(self, angle: ArrayLike, X: ScalarLike, length: ScalarLike) -> tuple[Array, Array]:
        angle = real(angle)
        cosine, sine = jnp.cos(angle), jnp.sin(angle)
        square = jnp.maximum(jnp.abs(cosine), jnp.abs(sine))
        return self.width(X, length) / 2 * cosine / square, self.height(
            X, length
        ) / 2 * sine / square

    def outer_radius(self, X: ScalarLike, length: ScalarLike) -> Scalar:
        return 0.5 * norm((self.width(X, length), self.height(X, length)))

    @property
    def sizes(self) -> dict[str, Profile]:
        return {"width": self.width, "height": self.height}


def _rectangle_torsion(w: Scalar, h: Scalar) -> Scalar:
    a, b = jnp.maximum(w, h), jnp.minimum(w, h)
    total = jnp.full_like(
        a, 31 / 32 * 1.0369277551433699
    )  # the sum of 1 / n^5 over odd n, 31/32 zeta(5)
    for n in range(1, 19, 2):
        decay = jnp.exp(-n * math.pi * a / b)
        total = total - 2 * decay / (1 + decay) / n**5  # 1 - tanh(x/2) = 2 e^-x / (1 + e^-x)
    return a * b**3 / 3 * (1 - 192 / math.pi**5 * (b / a) * total)


class Elliptic(Section):
    r"""Ellipse of half axes $a$ along y and $b$ along z.

    $A = \pi a b$, $J_y = \frac\pi4 a b^3$, $J_z = \frac\pi4 a^3 b$, Saint-Venant $J_x = \frac{\pi
    a^3 b^3}{a^2 + b^2}$.
    """

    semi_axis_y: Profile = eqx.field(metadata={"unit": "m"})
    semi_axis_z: Profile = eqx.field(metadata={"unit": "m"})
    torsion: Torsion = eqx.field(static=True)
    shear_correction: Float[Array, "2"] = eqx.field(metadata={"unit": "-"})

    def __init__(
        self,
        semi_axis_y: ProfileLike,
        semi_axis_z: ProfileLike,
        *,
        torsion: Torsion = "saint_venant",
        shear_correction: VectorLike = 1.0,
    ):
        self.semi_axis_y = _size("Elliptic", "semi_axis_y", semi_axis_y)
        self.semi_axis_z = _size("Elliptic", "semi_axis_z", semi_axis_z)
        self.torsion, self.shear_correction = _options(torsion, shear_correction)

    def geometry(self, X: ScalarLike, length: ScalarLike) -> Geometry:
        a, b = self.semi_axis_y(X, length), self.semi_axis_z(X, length)
        moment_y, moment_z = math.pi / 4 * a * b**3, math.pi / 4 * a**3 * b
        torsion = (
            moment_y + moment_z
            if self.torsion == "polar"
            else math.pi * a**3 * b**3 / (a**2 + b**2)
        )
        return Geometry(math.pi * a * b, moment_y, moment_z, torsion, self.shear_correction)

    def clearance(self, y: ScalarLike, z: ScalarLike, X: ScalarLike, length: ScalarLike) -> Scalar:
        a, b = self.semi_axis_y(X, length), self.semi_axis_z(X, length)
        return (1 - norm((real(y) / a, real(z) / b))) * jnp.minimum(a, b)

    def outline(self, angle: ArrayLike, X: ScalarLike, length: ScalarLike) -> tuple[Array, Array]:
        a, b, angle = self.semi_axis_y(X, length), self.semi_axis_z(X, length), real(angle)
        return a * jnp.cos(angle), b * jnp.sin(angle)

    def outer_radius(self, X: ScalarLike, length: ScalarLike) -> Scalar:
        return jnp.maximum(self.semi_axis_y(X, length), self.semi_axis_z(X, length))

    @property
    def sizes(self) -> dict[str, Profile]:
        return {"semi_axis_y": self.semi_axis_y, "semi_axis_z": self.semi_axis_z}


class Joined(Section):
    """Consecutive sections along the arm, with jumps between them.

    **Arguments:**
    - `ends`: abscissas [m] where the sections end, except the last; increasing.
    - `sections`: one more than `ends`, of any shape.
    """

    ends: Float[Array, " inner"] = eqx.field(metadata={"unit": "m"})
    sections: tuple[Section, ...]

    def __init__(self, ends: VectorLike, sections: Sequence[Section]):
        self.ends = rising_ends("Joined", ends, sections)
        self.sections = tuple(
            instance(f"Joined.sections[{i}]", s, Section, "a section")
            for i, s in enumerate(sections)
        )

    def geometry(self, X: ScalarLike, length: ScalarLike) -> Geometry:
        return pick(X, self.ends, [section.geometry(X, length) for section in self.sections])

    def clearance(self, y: ScalarLike, z: ScalarLike, X: ScalarLike, length: ScalarLike) -> Scalar:
        return pick(X, self.ends, [section.clearance(y, z, X, length) for section in self.sections])

    def outline(self, angle: ArrayLike, X: ScalarLike, length: ScalarLike) -> tuple[Array, Array]:
        return pick(X, self.ends, [section.outline(angle, X, length) for section in self.sections])

    def outer_radius(self, X: ScalarLike, length: ScalarLike) -> Scalar:
        return pick(X, self.ends, [section.outer_radius(X, length) for section in self.sections])

    def inner_radius(self, X: ScalarLike, length: ScalarLike) -> Scalar:
        return pick(X, self.ends, [section.inner_radius(X, length) for section in self.sections])

    @property
    def sizes(self) -> dict[str, Profile]:
        return {
            f"sections[{i}].{name}": size
            for i, section in enumerate(self.sections)
            for name, size in section.sizes.items()
        }

    def limits(self, X: ScalarLike, length: ScalarLike) -> Limits:
        here, found = pick(X, self.ends, list(range(len(self.sections)))), {}
        for i, section in enumerate(self.sections):
            for (name, needed), (value, room) in section.limits(X, length).items():
                found[f"sections[{i}].{name}", needed] = value, jnp.where(here == i, room, jnp.inf)
        return found

    @property
    def breakpoints(self) -> tuple[Scalar, ...]:
        return (
            *(end for end in self.ends),
            *(x for section in self.sections for x in section.breakpoints),
        )
