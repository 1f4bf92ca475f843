r"""Incompressible rubber: materials of arms that stretch far.

All laws here have the energy of a bar that is stretched, and to second order bent, twisted and
sheared. With the stretch $\lambda = 1 + \varepsilon_{u,x}$ and the energy $w(\lambda)$ per volume
in uniaxial tension it is

$$W = A w + \tfrac{w''}{2 \lambda} (J_y k_y^2 + J_z k_z^2) + \tfrac{g}{2 \lambda} J_x k_x^2 +
\tfrac{g}{2} A (u_y^2 + u_z^2), \quad g = \frac{\lambda w'}{\lambda^2 - \lambda^{-1}}.$$

A fibre at the distance $y$ from the axis is at $y / \sqrt\lambda$ in the stretched arm, which
divides the moments of area by $\lambda$; $g$ is the shear modulus of the stretched material.

**Source:** small deformations superposed on a uniaxial stretch, Green, Rivlin & Shield, Proc. R.
Soc. A 211 (1952).
"""

from abc import abstractmethod
from collections.abc import Callable
from functools import reduce
from typing import ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..numerics.component import Matrix, Tree, Vector, add, dot, multiply, scale
from ..typing import Scalar, ScalarLike, VectorLike
from ..validation import concrete, numbers
from .elasticity import Solid
from .material import isotropic_stiffness
from .profile import Limits, Profile, ProfileLike, as_profile
from .section import Section
from .section_law import SectionLaw


class Uniaxial(NamedTuple):
    """Response to a stretch, in units of Young's modulus at rest: `energy` $w$, `slope` $w''$ of
    the nominal stress, and the `shear` modulus $g$."""

    energy: Array
    slope: Array
    shear: Array


class RubberLaw(SectionLaw):
    """The law of a section of rubber: a quadratic form of bending, twist and shear, whose factors
    depend on the stretch. A subclass says how it stretches."""

    @abstractmethod
    def uniaxial(self, stretch: Array) -> Uniaxial:
        """Response to a stretch $\\lambda$ [-]."""

    def _factors(self, stretch: Array) -> Vector:
        """Six factors of `_weights`: those of the stiffness in twist, bending and shear, and as the
        fourth $w(\\lambda)$, which multiplies EA."""
        of = self.uniaxial(stretch)
        bent, sheared = of.slope / stretch, 3 * of.shear
        return (sheared / stretch, bent, bent, of.energy, sheared, sheared)

    def energy(self, strain: Vector, stiffness: Vector) -> Array:
        factors = self._factors(1 + strain[3])
        return dot(factors, _weights(strain, stiffness))

    def wrench(self, strain: Vector, stiffness: Vector) -> Vector:
        factors, slopes = _with_slopes(self._factors)(1 + strain[3])
        found = list(multiply(factors, multiply(stiffness, strain)))
        found[3] = dot(slopes, _weights(strain, stiffness))
        return tuple(found)

    def tangent(self, strain: Vector, stiffness: Vector) -> Matrix:
        (factors, slopes), (_, curvatures) = _with_slopes(_with_slopes(self._factors))(
            1 + strain[3]
        )
        diagonal = list(multiply(factors, stiffness))
        diagonal[3] = dot(curvatures, _weights(strain, stiffness))
        coupling = multiply(slopes, multiply(stiffness, strain))  # of each strain with the stretch
        zero = jnp.zeros_like(strain[0])
        rows = [[zero] * i + [diagonal[i]] for i in range(6)]
        rows[3][:3] = coupling[:3]
        rows[4][3], rows[5][3] = coupling[4:]
        return tuple(map(tuple, rows))


def _weights(strain: Vector, stiffness: Vector) -> Vector:
    """$\\frac12 \\Sigma_{ii} \\varepsilon_i^2$, and $EA$ in the place of the stretch."""
    weights = list(scale(0.5, multiply(stiffness, multiply(strain, strain))))
    weights[3] = stiffness[3]
    return tuple(weights)


def _with_slopes(function: Callable[[Array], Tree]) -> Callable[[Array], tuple[Tree, Tree]]:
    """Values and derivatives of a function of one number, section by section."""
    return lambda x: jax.jvp(function, (x,), (jnp.ones_like(x),))


class NeoHookeanLaw(RubberLaw):
    r"""$w = \frac{E}{6} (\lambda^2 + 2 \lambda^{-1} - 3)$."""

    def uniaxial(self, stretch: Array) -> Uniaxial:
        energy = (stretch**2 + 2 / stretch - 3) / 6
        return Uniaxial(energy, (1 + 2 / stretch**3) / 3, jnp.full_like(stretch, 1 / 3))


class OgdenLaw(RubberLaw):
    r"""$w = \sum_i \frac{\mu_i}{\alpha_i} (\lambda^{\alpha_i} + 2 \lambda^{-\alpha_i / 2} - 3)$,
    with `moduli` $\mu_i / E$ and `exponents` $\alpha_i$."""

    moduli: tuple[Scalar, ...]
    exponents: tuple[Scalar, ...]

    def uniaxial(self, stretch: Array) -> Uniaxial:
        terms = zip(self.moduli, self.exponents, strict=True)
        found = [scale(modulus, _ogden_term(stretch, exponent)) for modulus, exponent in terms]
        return reduce(add, found)


def _ogden_term(stretch: Array, exponent: Array) -> Uniaxial:
    r"""Response of a term with $\mu_i = 1$. With $s = \ln \lambda$ the shear modulus is
    $e^{(\alpha - 2) s / 4} \sinh(3 \alpha s / 4) / \sinh(3 s / 2)$, finite at $s = 0$."""
    log = jnp.log(stretch)
    along, across = jnp.exp(exponent * log), jnp.exp(-0.5 * exponent * log)
    energy = (along + 2 * across - 3) / exponent
    slope = ((exponent - 1) * along + (0.5 * exponent + 1) * across) / stretch**2
    ratio = _sinh_share(0.75 * exponent * log) / _sinh_share(1.5 * log)
    return Uniaxial(energy, slope, 0.5 * exponent * jnp.exp(0.25 * (exponent - 2) * log) * ratio)


def _sinh_share(x: Array) -> Array:
    """$\\sinh(x) / x$."""
    square, small = x * x, jnp.abs(x) < 0.3
    apart = jnp.where(small, 1.0, x)
    series = 1 + square / 6 * (
        1 + square / 20 * (1 + square / 42 * (1 + square / 72 * (1 + square / 110)))
    )
    return jnp.where(small, series, jnp.sinh(apart) / apart)


class Rubber(Solid):
    """Incompressible material, $G = E / 3$, whose sections become smaller as the arm stretches. Its
    stretch counts from the rest strain."""

    effect = "rubber"
    _modulus_name: ClassVar[str] = "young"

    @abstractmethod
    def modulus(self, X: ScalarLike, length: ScalarLike) -> Scalar:
        """Young's modulus at rest [Pa]."""

    def stiffness(self, section: Section, X: ScalarLike, length: ScalarLike) -> Vector:
        """Diagonal of $\\Sigma(X)$ at rest, six scalars [N m^2] and [N]."""
        young = self.modulus(X, length)
        return isotropic_stiffness(section.geometry(X, length), young, young / 3)

    def limits(self, section: Section, X: ScalarLike, length: ScalarLike) -> Limits:
        young = self.modulus(X, length)
        found = {(self._modulus_name, "a number > 0"): (young, young)}
        if self.density is not None:
            density = self.density(X, length)
            found["density", "a number > 0"] = density, density
        return found

    @property
    def breakpoints(self) -> tuple[Scalar, ...]:
        return () if self.density is None else self.density.breakpoints


class NeoHookean(Rubber):
    r"""Rubber of the energy $\frac{E}{6} (I_1 - 3)$ per volume. A bar carries $N = \frac{EA}{3}
    (\lambda - \lambda^{-2})$, and resists bending with $\frac{EJ}{3} (\lambda^{-1} + 2
    \lambda^{-4})$ and twist with $GJ / \lambda$, where $G = E / 3$.

    Small strains are those of a `Material` with `poisson=0.5`. Valid where the strain by bending,
    twist and shear is moderate; a stretch may be of any size. The paths of threads and the areas of
    chambers stay as they are when the section becomes smaller.

    **Arguments**, profiles: `young` $E$ [Pa] at rest; `density` [kg/m^3], required only by
    `Gravity`.

    **Source:** see `vsr_jax.arm.rubber`.
    """

    young: Profile = eqx.field(metadata={"unit": "Pa"})
    density: Profile | None = eqx.field(metadata={"unit": "kg/m^3"})

    def __init__(self, young: ProfileLike, density: ProfileLike | None = None):
        self.young = as_profile("NeoHookean.young", young, positive=True)
        self.density = _density("NeoHookean", density)

    def modulus(self, X: ScalarLike, length: ScalarLike) -> Scalar:
        return self.young(X, length)

    def law(self, section: Section, X: ScalarLike, length: ScalarLike) -> SectionLaw:
        return NeoHookeanLaw()

    @property
    def breakpoints(self) -> tuple[Scalar, ...]:
        return (*self.young.breakpoints, *super().breakpoints)


class Ogden(Rubber):
    r"""Rubber of the energy $\sum_i \frac{\mu_i}{\alpha_i} (\lambda_1^{\alpha_i} +
    \lambda_2^{\alpha_i} + \lambda_3^{\alpha_i} - 3)$ per volume in the principal stretches, as
    fitted to tension tests. At rest $E = \frac32 \sum_i \mu_i \alpha_i$.

    A Mooney-Rivlin material of constants $C_1, C_2$ is `Ogden((2 * C1, -2 * C2), (2, -2))`, and
    `NeoHookean` is one term of exponent 2, valid for the same strains. The tension of a bar,
    $A \sum_i \mu_i (\lambda^{\alpha_i - 1} - \lambda^{-\alpha_i / 2 - 1})$, has to rise with
    $\lambda$: beyond its largest value there is no equilibrium.

    **Arguments:**
    - `shear_moduli`: $\mu_i$ [Pa], any number of them.
    - `exponents`: $\alpha_i$ [-], as many, not 0.
    - `density`: a profile [kg/m^3], required only by `Gravity`.

    **Source:** see `vsr_jax.arm.rubber`.
    """

    shear_moduli: Float[Array, " terms"] = eqx.field(metadata={"unit": "Pa"})
    exponents: Float[Array, " terms"] = eqx.field(metadata={"unit": "-"})
    density: Profile | None = eqx.field(metadata={"unit": "kg/m^3"})
    _modulus_name = "young (3/2 of the sum of shear_moduli times exponents)"

    def __init__(
        self, shear_moduli: VectorLike, exponents: VectorLike, density: ProfileLike | None = None
    ):
        self.shear_moduli = numbers("Ogden.shear_moduli", shear_moduli, None)
        if self.shear_moduli.ndim != 1 or self.shear_moduli.size == 0:
            raise ValueError(
                f"Ogden.shear_moduli: got shape {self.shear_moduli.shape}, need a list of numbers"
            )
        self.exponents = numbers("Ogden.exponents", exponents, self.shear_moduli.shape)
        known = concrete(self.exponents)
        if known is not None and not known.all():
            raise ValueError(f"Ogden.exponents: got {known.tolist()}, need numbers other than 0")
        young = concrete(self.modulus(0.0, 1.0))
        if young is not None and not young > 0:
            raise ValueError(
                f"Ogden: got a Young's modulus of {young:g} Pa, 1.5 times the sum of shear_moduli "
                f"times exponents; need a positive one"
            )
        self.density = _density("Ogden", density)

    def modulus(self, X: ScalarLike, length: ScalarLike) -> Scalar:
        return 1.5 * jnp.dot(self.shear_moduli, self.exponents)

    def limits(self, section: Section, X: ScalarLike, length: ScalarLike) -> Limits:
        least = jnp.min(jnp.abs(self.exponents))
        return {
            **super().limits(section, X, length),
            ("exponents (the least in size)", "a number other than 0"): (least, least),
        }

    def law(self, section: Section, X: ScalarLike, length: ScalarLike) -> SectionLaw:
        shares = self.shear_moduli / self.modulus(X, length)
        return OgdenLaw(tuple(shares), tuple(self.exponents))


def _density(owner: str, density: ProfileLike | None) -> Profile | None:
    return None if density is None else as_profile(f"{owner}.density", density, positive=True)
