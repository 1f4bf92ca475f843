"""Profiles: scalar functions of X along an arm, for sizes, material properties and rest strains.

A profile is called as `profile(X, length)` with scalars and is differentiable in both and in each
of its numbers. Arguments that are profiles also accept a plain number, which is converted to
`Constant`, and a Python function of X, which is converted to `FunctionProfile`.
"""

import math
from abc import abstractmethod
from collections.abc import Callable, Sequence
from functools import partial
from operator import attrgetter

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PyTree
from typing_extensions import TypeAliasType

from ..typing import Scalar, ScalarLike, Tree, VectorLike, real
from ..validation import concrete, numbers
from .description import Part, describe
from .fields import OF_OWNER
from .spline import spline_breakpoints, spline_points, spline_value

Limits = dict[tuple[str, str], tuple[Array, Array]]
"""Numbers that have limits: by name and requirement, the value and its distance to the limit, which
is positive where the requirement is met."""


class FunctionOfX(eqx.Module):
    """A user's function of X with parameters that can be differentiated.

    **Arguments:**
    - `owner`: name of the class that takes the function, for error messages.
    - `function`: takes the scalar X [m] and the parameters; written with `jax.numpy`. An equinox
      module with a method `__call__(X, *parameters)` is a parameter too: its arrays can be
      differentiated.
    - `parameters`: pytrees of arrays, for example equinox modules; differentiable.

    **Raises:** `ValueError` for what is no function.
    """

    function: Callable = eqx.field(static=True)
    parameters: tuple

    def __init__(self, owner: str, function: Callable, *parameters: PyTree):
        if not callable(function):
            raise ValueError(f"{owner}.function: got {function!r}, need a function of X")
        if isinstance(function, eqx.Module):
            function, parameters = _call, (function, *parameters)
        self.function = function
        self.parameters = jax.tree.map(
            lambda leaf: jnp.asarray(leaf) if eqx.is_array_like(leaf) else leaf, parameters
        )

    def __call__(self, X: ScalarLike) -> PyTree:
        """Value of the function at X [m], its numbers as arrays in the precision of X."""
        X = real(X)
        value = self.function(X, *self.parameters)
        return jax.tree.map(lambda number: jnp.asarray(number, X.dtype), value)

    def __repr__(self) -> str:
        function, parameters = self.function, self.parameters
        if function is _call:
            function, *parameters = parameters
        name = getattr(function, "__name__", type(function).__name__)
        return f"{name}({', '.join(('X', *map(describe, parameters)))})"


def _call(X: ScalarLike, function: Callable, *parameters: PyTree) -> PyTree:
    """Value of a function that is itself a parameter."""
    return function(X, *parameters)


class Profile(Part):
    """A scalar function of X on an arm of a given length."""

    @abstractmethod
    def __call__(self, X: ScalarLike, length: ScalarLike) -> Scalar:
        """Value at X [m]."""

    @property
    def breakpoints(self) -> tuple[Scalar, ...]:
        """Abscissas [m] where a derivative jumps. Quadrature intervals and steps end there."""
        return ()


ProfileLike = TypeAliasType("ProfileLike", Profile | ScalarLike | Callable[..., ScalarLike])
"""What is converted to a profile: a number, or a function of X."""

ProfilesLike = TypeAliasType(
    "ProfilesLike", jax.typing.ArrayLike | Sequence[ProfileLike] | Callable[..., VectorLike]
)
"""What is converted to several profiles: one for each, or one function of X that returns a number
for each."""


class Constant(Profile):
    """$f(X) = c$."""

    value: Scalar = eqx.field(metadata={"unit": OF_OWNER, "named": False})

    def __init__(self, value: ScalarLike):
        self.value = numbers("Constant.value", value)

    def __call__(self, X: ScalarLike, length: ScalarLike) -> Scalar:
        return self.value


class Taper(Profile):
    """$f(X) = f_b + (f_t - f_b) X / L$: from `base` at X = 0 to `tip` at X = L."""

    base: Scalar = eqx.field(metadata={"unit": OF_OWNER})
    tip: Scalar = eqx.field(metadata={"unit": OF_OWNER})

    def __init__(self, base: ScalarLike, tip: ScalarLike):
        self.base = numbers("Taper.base", base)
        self.tip = numbers("Taper.tip", tip)

    def __call__(self, X: ScalarLike, length: ScalarLike) -> Scalar:
        return self.base + (self.tip - self.base) * (real(X) / length)


class PolynomialProfile(Profile):
    """$f(X) = \\sum_i c_i X^i$, `coefficients` in ascending order, in units of $f$ per m^i."""

    coefficients: Float[Array, " terms"] = eqx.field(metadata={"unit": OF_OWNER, "powers": True})

    def __init__(self, coefficients: VectorLike):
        self.coefficients = rising_coefficients("PolynomialProfile.coefficients", coefficients)

    def __call__(self, X: ScalarLike, length: ScalarLike) -> Scalar:
        return jnp.polyval(self.coefficients[::-1], X)


class SplineProfile(Profile):
    """Cubic not-a-knot spline through `values` at the abscissas `X` [m], see
    `spline_value`."""

    X: Float[Array, " points"] = eqx.field(metadata={"unit": "m"})
    values: Float[Array, " points"] = eqx.field(metadata={"unit": OF_OWNER})

    def __init__(self, X: VectorLike, values: VectorLike):
        self.X = spline_points("SplineProfile.X", X)
        self.values = numbers("SplineProfile.values", values, self.X.shape)

    @property
    def breakpoints(self) -> tuple[Scalar, ...]:
        return spline_breakpoints(self.X)

    def __call__(self, X: ScalarLike, length: ScalarLike) -> Scalar:
        return spline_value(X, self.X, self.values)


class Piecewise(Profile):
    """Consecutive profiles, with jumps between them.

    **Arguments:**
    - `ends`: abscissas [m] where the profiles end, except the last; increasing.
    - `values`: profiles (or numbers, or functions of X), one more than `ends`. The argument of each
      is X from the base of the arm.
    """

    ends: Float[Array, " inner"] = eqx.field(metadata={"unit": "m"})
    values: tuple[Profile, ...] = eqx.field(metadata={"unit": OF_OWNER})

    def __init__(self, ends: VectorLike, values: Sequence[ProfileLike]):
        self.ends = rising_ends("Piecewise", ends, values)
        self.values = tuple(
            as_profile(f"Piecewise.values[{i}]", value) for i, value in enumerate(values)
        )

    def __call__(self, X: ScalarLike, length: ScalarLike) -> Scalar:
        return pick(X, self.ends, [value(X, length) for value in self.values])

    @property
    def breakpoints(self) -> tuple[Scalar, ...]:
        return (
            *(end for end in self.ends),
            *(x for value in self.values for x in value.breakpoints),
        )


def rising_coefficients(name: str, value: VectorLike) -> Float[Array, " terms"]:
    """`value` as the coefficients of a polynomial, at least one."""
    array = numbers(name, value, None)
    if array.ndim != 1 or array.size == 0:
        raise ValueError(f"{name}: got shape {array.shape}, need an array of at least one number")
    return array


def rising_ends(owner: str, ends: VectorLike, parts: Sequence[object]) -> Float[Array, " inner"]:
    """Inner ends of consecutive `parts`, checked."""
    array = numbers(f"{owner}.ends", ends, None)
    known = concrete(array)
    if array.ndim != 1 or (known is not None and not np.all(np.diff(known, prepend=0.0) > 0)):
        raise ValueError(f"{owner}.ends: got {ends!r}, need an array of increasing abscissas > 0")
    if len(parts) != array.size + 1:
        raise ValueError(
            f"{owner}: got {array.size} ends and {len(parts)} parts, need one more part than ends"
        )
    return array


def pick(X: ScalarLike, ends: Float[Array, " inner"], values: Sequence[Tree]) -> Tree:
    """The item of `values`, numbers or pytrees, for the part that contains X."""
    result = values[-1]
    for i in reversed(range(ends.size)):
        result = jax.tree.map(
            lambda here, later, end=ends[i]: jnp.where(end > X, here, later), values[i], result
        )
    return result


class FunctionProfile(Profile):
    """Any function of X: $f(X) =$ `function(X, *parameters)`, a scalar. Arguments as for
    `FunctionOfX`."""

    function: FunctionOfX

    def __init__(self, function: Callable[..., ScalarLike], *parameters: PyTree):
        self.function = FunctionOfX("FunctionProfile", function, *parameters)

    def __call__(self, X: ScalarLike, length: ScalarLike) -> Scalar:
        return jnp.asarray(self.function(X))


class _Scaled(Profile):
    """A factor times a profile."""

    factor: float = eqx.field(static=True)
    profile: Profile = eqx.field(metadata={"unit": OF_OWNER})

    def __call__(self, X: ScalarLike, length: ScalarLike) -> Scalar:
        return self.factor * self.profile(X, length)

    @property
    def breakpoints(self) -> tuple[Scalar, ...]:
        return self.profile.breakpoints


def as_profile(
    name: str,
    value: ProfileLike,
    *,
    positive: bool = False,
    above: float = -math.inf,
    most: float = math.inf,
) -> Profile:
    """`value` as a profile, from a `Profile`, a function of X or a number. The limits of
    known numbers are checked as in `numbers`."""
    check = partial(numbers, positive=positive, above=above, most=most)
    if isinstance(value, Taper):
        check(f"{name} (Taper.base)", value.base)
        check(f"{name} (Taper.tip)", value.tip)
    if isinstance(value, Constant):
        check(name, value.value)
    if isinstance(value, Piecewise):
        for i, part in enumerate(value.values):
            label = f"{name} (Piecewise.values[{i}])"
            as_profile(label, part, positive=positive, above=above, most=most)
    if isinstance(value, Profile):
        return value
    if callable(value):
        return FunctionProfile(value)
    return Constant(check(name, value))


ProfileVector = tuple[Profile, ...] | FunctionOfX
"""Several profiles, or one function of X that returns as many numbers."""


def as_profiles(name: str, value: ProfilesLike, labels: Sequence[str], need: str) -> ProfileVector:
    """`value` as profiles, one per label, from a sequence of what `as_profile` accepts or from one
    function of X.

    **Arguments:** `labels`: name of each profile in messages; `need`: what is needed, in words.
    """
    if isinstance(value, FunctionOfX):
        return value
    if callable(value):
        return FunctionOfX(name, value)
    if (
        isinstance(value, str)
        or not isinstance(value, Sequence | np.ndarray | Array)
        or len(value) != len(labels)
    ):
        raise ValueError(f"{name}: got {value!r}, need {need}")
    return tuple(as_profile(label, x) for label, x in zip(labels, value, strict=True))


def values_at(profiles: ProfileVector, X: ScalarLike, length: ScalarLike) -> tuple[Scalar, ...]:
    """Value of each profile at X [m]."""
    if isinstance(profiles, FunctionOfX):
        return tuple(profiles(X))
    return tuple(profile(X, length) for profile in profiles)


def breakpoints_of(profiles: ProfileVector) -> tuple[Scalar, ...]:
    """Abscissas [m] where a profile or its derivative jumps; none for a function of X."""
    if isinstance(profiles, FunctionOfX):
        return ()
    return tuple(x for profile in profiles for x in profile.breakpoints)


_LINEAR_IN = {
    Constant: ("value",),
    Taper: ("base", "tip"),
    PolynomialProfile: ("coefficients",),
    SplineProfile: ("values",),
}
"""Fields in which a profile is linear."""


def scaled(factor: float, profile: Profile) -> Profile:
    """$c f(X)$, of the same class as the profile if that is linear in its numbers."""
    if type(profile) is Piecewise:
        return Piecewise(profile.ends, [scaled(factor, part) for part in profile.values])
    if type(profile) not in _LINEAR_IN:
        return _Scaled(factor, profile)
    fields = attrgetter(*_LINEAR_IN[type(profile)])
    return eqx.tree_at(fields, profile, replace_fn=lambda number: factor * number)
