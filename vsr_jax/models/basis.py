r"""Strain bases: $\xi(X) = B_q(X) q + \xi^*(X)$ (eq. 14), $B_q$ of shape (6, n).

A `Basis` assigns to each strain a `Family` of scalar functions of $s = X / L$ or of X; a strain
without one is locked at its rest value. `FunctionBasis` is the whole matrix as a function of X.
"""

from abc import abstractmethod
from collections.abc import Callable, Mapping
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..arm.profile import FunctionOfX
from ..arm.rod import STRAINS
from ..arm.scene import Scene
from ..typing import Scalar, ScalarLike, VectorLike, real
from ..validation import concrete, count, instance, numbers


def unnamed(size: int) -> tuple[tuple[str, str], ...]:
    """Name and unit of coordinates of which nothing is known."""
    return tuple((f"q_{i}", "unknown") for i in range(size))


class Family(eqx.Module):
    """A family of scalar functions of X."""

    @property
    @abstractmethod
    def size(self) -> int:
        """Number of functions."""

    @abstractmethod
    def __call__(self, X: ScalarLike, length: ScalarLike) -> Float[Array, " size"]:
        """Their values at X [m] on an arm of `length` [m]."""

    def breakpoints(self, length: ScalarLike) -> tuple[Scalar, ...]:
        """Abscissas [m] where a function or its derivative jumps."""
        return ()


class Monomial(Family):
    """$1, s, \\dots, s^{order}$ with $s = X / L$."""

    order: int = eqx.field(static=True)

    def __init__(self, order: int):
        self.order = count("Monomial.order", order, least=0)

    @property
    def size(self) -> int:
        return self.order + 1

    def __call__(self, X: ScalarLike, length: ScalarLike) -> Float[Array, " size"]:
        s = real(X) / length
        values = [jnp.ones_like(s)]
        for _ in range(self.order):
            values.append(values[-1] * s)
        return jnp.stack(values)


class Legendre(Family):
    """Legendre polynomials $P_0, \\dots, P_{order}$ of $2 X / L - 1$: orthogonal on the arm, and
    well conditioned at every order."""

    order: int = eqx.field(static=True)

    def __init__(self, order: int):
        self.order = count("Legendre.order", order, least=0)

    @property
    def size(self) -> int:
        return self.order + 1

    def __call__(self, X: ScalarLike, length: ScalarLike) -> Float[Array, " size"]:
        x = 2 * real(X) / length - 1
        values = [jnp.ones_like(x), x]
        for i in range(1, self.order):
            values.append(((2 * i + 1) * x * values[i] - i * values[i - 1]) / (i + 1))
        return jnp.stack(values[: self.size])


class Trigonometric(Family):
    """$1, \\sin \\omega_i X, \\cos \\omega_i X$ for given angular frequencies; each
    group is optional.

    **Arguments:**
    - `frequencies`: $\\omega_i$ [rad/m], a number or several.
    - `constant`, `sine`, `cosine`: which functions belong to the family.
    """

    frequencies: Float[Array, " frequencies"]
    constant: bool = eqx.field(static=True)
    sine: bool = eqx.field(static=True)
    cosine: bool = eqx.field(static=True)

    def __init__(
        self,
        frequencies: VectorLike,
        *,
        constant: bool = True,
        sine: bool = True,
        cosine: bool = True,
    ):
        self.frequencies = jnp.atleast_1d(numbers("Trigonometric.frequencies", frequencies, None))
        self.constant, self.sine, self.cosine = bool(constant), bool(sine), bool(cosine)
        if self.frequencies.ndim != 1:
            raise ValueError(
                f"Trigonometric.frequencies: got shape {self.frequencies.shape}, need one number "
                f"or a list of numbers"
            )
        if self.size == 0:
            raise ValueError(
                "Trigonometric: got no function, need at least one of constant, sine and cosine, "
                "and frequencies for the last two"
            )

    @property
    def size(self) -> int:
        return int(self.constant) + self.frequencies.size * (int(self.sine) + int(self.cosine))

    def __call__(self, X: ScalarLike, length: ScalarLike) -> Float[Array, " size"]:
        phase = self.frequencies * X
        groups = [jnp.ones_like(phase[:1])] if self.constant else []
        groups += [jnp.sin(phase)] if self.sine else []
        groups += [jnp.cos(phase)] if self.cosine else []
        return jnp.concatenate(groups)


class PiecewiseConstant(Family):
    """Indicators of sections of the arm (PCS): one constant strain in each.

    **Arguments:**
    - `sections`: number of sections of equal length, or the inner ends of the sections as ascending
      fractions of the length.
    """

    ends: Float[Array, " inner"]

    def __init__(self, sections: VectorLike):
        if isinstance(sections, int | np.integer):
            sections = np.arange(1, count("PiecewiseConstant.sections", sections)) / sections
        self.ends = numbers("PiecewiseConstant.sections", sections, None)
        known = concrete(self.ends)
        if self.ends.ndim != 1 or (
            known is not None and not np.all(np.diff(known, prepend=0.0, append=1.0) > 0)
        ):
            raise ValueError(
                f"PiecewiseConstant.sections: got {sections!r}, need an integer, or "
                f"ascending fractions between 0 and 1"
            )

    @property
    def size(self) -> int:
        return self.ends.size + 1

    def __call__(self, X: ScalarLike, length: ScalarLike) -> Float[Array, " size"]:
        section = jnp.searchsorted(self.ends * length, X, side="right")
        return (jnp.arange(self.size) == section).astype(self.ends.dtype)

    def breakpoints(self, length: ScalarLike) -> tuple[Scalar, ...]:
        return tuple(end * length for end in self.ends)


class Functions(Family):
    """Any scalar functions: values = `function(X, *parameters)`, an array of `size` numbers, X in
    metres."""

    function: FunctionOfX
    _size: int = eqx.field(static=True)

    def __init__(self, function: Callable, *parameters: Any, size: int):
        self.function = FunctionOfX("Functions", function, *parameters)
        self._size = count("Functions.size", size)

    @property
    def size(self) -> int:
        return self._size

    def __call__(self, X: ScalarLike, length: ScalarLike) -> Float[Array, " size"]:
        return _of_shape("Functions", self.function(X), (self.size,))


class AbstractBasis(eqx.Module):
    """A basis of the strain field."""

    @property
    @abstractmethod
    def size(self) -> int:
        """Number of degrees of freedom n."""

    @abstractmethod
    def matrix(self, X: ScalarLike, length: ScalarLike) -> Float[Array, "6 dofs"]:
        """$B_q(X)$, shape (6, n)."""

    @property
    def strains(self) -> tuple[str, ...]:
        """Names of the strains that it frees."""
        return STRAINS

    @property
    def labels(self) -> tuple[tuple[str, str], ...]:
        """Name and unit of each coordinate."""
        return unnamed(self.size)

    def breakpoints(self, length: ScalarLike) -> tuple[Scalar, ...]:
        """Abscissas [m] where the basis or its derivative jumps."""
        return ()

    def check(self, scene: Scene, owner: str) -> None:
        """Raises `ValueError` if the basis frees a strain that the scene locks.

        **Arguments:** `owner`: name of the model, for the message.
        """
        locked = [name for name in self.strains if name not in scene.free_strains]
        if locked:
            raise ValueError(
                f"{owner}.basis: got one that frees {', '.join(locked)}, need only "
                f"{', '.join(scene.free_strains)}, as the scene"
            )


class Basis(AbstractBasis):
    """Each strain with its own family; coordinates are ordered strain by strain.

    **Arguments:** `families`: maps strain names (torsion, bending_y, bending_z, elongation,
    shear_y, shear_z) to families. Strains that are not named are locked at their rest value.

    **Raises:** `ValueError` for an unknown strain name or for no strain at all.
    """

    families: dict[str, Family]
    _distinct: tuple[str, ...] = eqx.field(static=True)

    def __init__(self, families: Mapping[str, Family]):
        for name, family in families.items():
            if name not in STRAINS:
                raise ValueError(
                    f"Basis: got an unknown strain {name!r}, need names among {', '.join(STRAINS)}"
                )
            instance(
                f"Basis[{name!r}]",
                family,
                Family,
                "a family such as Legendre, Monomial or Trigonometric",
            )
        if not families:
            raise ValueError("Basis: got no strain, need at least one")
        self.families = dict(families)
        # a family that several strains share breaks the steps once; copies of it are not the same
        first: dict[int, str] = {}
        for name, family in self.families.items():
            first.setdefault(id(family), name)
        self._distinct = tuple(first.values())

    @property
    def strains(self) -> tuple[str, ...]:
        return tuple(self.families)

    @property
    def labels(self) -> tuple[tuple[str, str], ...]:
        return tuple(
            (f"{name}_{i}", "1/m" if place < 3 else "1")
            for place, name in enumerate(STRAINS)
            if name in self.families
            for i in range(self.families[name].size)
        )

    @classmethod
    def uniform(cls, family: Family, strains: tuple[str, ...] = STRAINS) -> "Basis":
        """The same family for each of `strains`, all six by default."""
        return cls({name: family for name in strains})

    @property
    def size(self) -> int:
        return sum(family.size for family in self.families.values())

    def matrix(self, X: ScalarLike, length: ScalarLike) -> Float[Array, "6 dofs"]:
        blocks = []
        for row, name in enumerate(STRAINS):
            if name in self.families:
                values = self.families[name](X, length)
                blocks.append(jnp.zeros((6, values.size), values.dtype).at[row].set(values))
        return jnp.concatenate(blocks, axis=1)

    def breakpoints(self, length: ScalarLike) -> tuple[Scalar, ...]:
        distinct = (self.families[name] for name in self._distinct)
        return tuple(x for family in distinct for x in family.breakpoints(length))


class FunctionBasis(AbstractBasis):
    """Any matrix: $B_q(X) =$ `function(X, *parameters)`, shape (6, `size`), X in metres."""

    function: FunctionOfX
    _size: int = eqx.field(static=True)

    def __init__(self, function: Callable, *parameters: Any, size: int):
        self.function = FunctionOfX("FunctionBasis", function, *parameters)
        self._size = count("FunctionBasis.size", size)

    @property
    def size(self) -> int:
        return self._size

    def matrix(self, X: ScalarLike, length: ScalarLike) -> Float[Array, "6 dofs"]:
        return _of_shape("FunctionBasis", self.function(X), (6, self.size))


def _of_shape(owner: str, value: Any, shape: tuple[int, ...]) -> Array:
    array = jnp.asarray(value)
    if array.shape != shape:
        raise ValueError(f"{owner}.function: got values of shape {array.shape}, need {shape}")
    return array
