"""Profiles: scalar functions of X along an arm, for sizes and rest strains.

A profile is called as `profile(X, length)` with scalars and is differentiable in both and in each
of its numbers. Wherever a profile is expected a plain number means `Constant` and a Python function
of X means `FunctionProfile`.
"""

from abc import abstractmethod
from collections.abc import Callable, Sequence
from operator import attrgetter
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..typing import Scalar
from ..validation import concrete, numbers
from .description import Part, describe
from .fields import OF_OWNER, in_unit
from .spline import spline_breakpoints, spline_points, spline_value

Limits = dict[tuple[str, str], tuple[Array, Array]]
"""Numbers that have limits, by their name and by what is needed of them; each with its room, how
far it is inside of them."""


class FunctionOfX(eqx.Module):
    """A user's function of X with parameters that can be differentiated.

    **Arguments:**
    - `owner`: who asks for it, for error messages.
    - `function`: takes the scalar X [m] and the parameters; written with `jax.numpy`.
    - `parameters`: any pytrees of arrays; derivatives with respect to them flow. An equinox module
      may be one.
    """

    function: Callable = eqx.field(static=True)
    parameters: tuple

    def __init__(self, owner: str, function: Callable, *parameters: Any):
        if not callable(function):
            raise ValueError(f"{owner}.function: got {function!r}, need a function of X")
        self.function = function
        self.parameters = jax.tree.map(
            lambda leaf: jnp.asarray(leaf) if eqx.is_array_like(leaf) else leaf, parameters
        )

    def __call__(self, X: Scalar) -> Any:
        """Whatever the function returns at X [m]."""
        return self.function(X, *self.parameters)

    def __repr__(self) -> str:
        name = getattr(self.function, "__name__", type(self.function).__name__)
        return f"{name}({', '.join(('X', *map(describe, self.parameters)))})"


class Profile(Part):
    """A scalar function of X on an arm of a given length."""

    @abstractmethod
    def __call__(self, X: Scalar, length: Scalar) -> Scalar:
        """Value at X [m]."""

    @property
    def breakpoints(self) -> tuple[Scalar, ...]:
        """Abscissas [m] where a derivative jumps: quadrature and steps break there."""
        return ()


class Constant(Profile):
    """$f(X) = c$."""

    value: Scalar = in_unit(OF_OWNER, named=False)

    def __init__(self, value: Any):
        self.value = numbers("Constant.value", value)

    def __call__(self, X: Scalar, length: Scalar) -> Scalar:
        return self.value


class Taper(Profile):
    """$f(X) = f_b + (f_t - f_b) X / L$: from `base` at X = 0 to `tip` at X = L."""

    base: Scalar = in_unit(OF_OWNER)
    tip: Scalar = in_unit(OF_OWNER)

    def __init__(self, base: Any, tip: Any):
        self.base = numbers("Taper.base", base)
        self.tip = numbers("Taper.tip", tip)

    def __call__(self, X: Scalar, length: Scalar) -> Scalar:
        return self.base + (self.tip - self.base) * (X / length)


class PolynomialProfile(Profile):
    """$f(X) = \\sum_i c_i X^i$, `coefficients` in rising order, units of $f$ per m^i."""

    coefficients: Float[Array, " terms"] = in_unit(OF_OWNER, powers=True)

    def __init__(self, coefficients: Any):
        self.coefficients = rising_coefficients("PolynomialProfile.coefficients", coefficients)

    def __call__(self, X: Scalar, length: Scalar) -> Scalar:
        return jnp.polyval(self.coefficients[::-1], X)


class SplineProfile(Profile):
    """Cubic not-a-knot spline through `values` at the abscissas `X` [m], see
    `spline_value`."""

    X: Float[Array, " points"] = in_unit("m")
    values: Float[Array, " points"] = in_unit(OF_OWNER)

    def __init__(self, X: Any, values: Any):
        self.X = spline_points("SplineProfile.X", X)
        self.values = numbers("SplineProfile.values", values, self.X.shape)

    @property
    def breakpoints(self) -> tuple[Scalar, ...]:
        return spline_breakpoints(self.X)

    def __call__(self, X: Scalar, length: Scalar) -> Scalar:
        return spline_value(X, self.X, self.values)


class Piecewise(Profile):
    """One profile after another, with jumps between them.

    **Arguments:**
    - `ends`: where each profile but the last ends [m], rising.
    - `values`: profiles (or numbers, or functions of X), one more than `ends`. Each is a function
      of X on the whole arm.
    """

    ends: Float[Array, " inner"] = in_unit("m")
    values: tuple[Profile, ...] = in_unit(OF_OWNER)

    def __init__(self, ends: Any, values: Sequence[Any]):
        self.ends = rising_ends("Piecewise", ends, values)
        self.values = tuple(
            as_profile(f"Piecewise.values[{i}]", value) for i, value in enumerate(values)
        )

    def __call__(self, X: Scalar, length: Scalar) -> Scalar:
        return pick(X, self.ends, [value(X, length) for value in self.values])

    @property
    def breakpoints(self) -> tuple[Scalar, ...]:
        return (
            *(end for end in self.ends),
            *(x for value in self.values for x in value.breakpoints),
        )


def rising_coefficients(name: str, value: Any) -> Float[Array, " terms"]:
    """`value` as the coefficients of a polynomial, at least one."""
    array = numbers(name, value, None)
    if array.ndim != 1 or array.size == 0:
        raise ValueError(f"{name}: got shape {array.shape}, need at least one number in a row")
    return array


def rising_ends(owner: str, ends: Any, parts: Sequence[Any]) -> Float[Array, " inner"]:
    """Inner ends of `parts` laid one after another, checked."""
    array = numbers(f"{owner}.ends", ends, None)
    known = concrete(array)
    if array.ndim != 1 or (known is not None and not np.all(np.diff(known, prepend=0.0) > 0)):
        raise ValueError(f"{owner}.ends: got {ends!r}, need rising abscissas > 0 in a row")
    if len(parts) != array.size + 1:
        raise ValueError(
            f"{owner}: got {array.size} ends and {len(parts)} parts, need one part more than ends"
        )
    return array


def pick(X: Scalar, ends: Float[Array, " inner"], values: Sequence[Any]) -> Any:
    """The one of `values`, numbers or pytrees of them, in whose part X lies."""
    result = values[-1]
    for i in reversed(range(ends.size)):
        result = jax.tree.map(
            lambda here, later, end=ends[i]: jnp.where(end > X, here, later), values[i], result
        )
    return result


class FunctionProfile(Profile):
    """Any function of X: $f(X) =$ `function(X, *parameters)`, a scalar; see `FunctionOfX` for the
    arguments."""

    function: FunctionOfX

    def __init__(self, function: Callable, *parameters: Any):
        self.function = FunctionOfX("FunctionProfile", function, *parameters)

    def __call__(self, X: Scalar, length: Scalar) -> Scalar:
        return jnp.asarray(self.function(X), X.dtype)


class _Scaled(Profile):
    """A factor times a profile."""

    factor: float = eqx.field(static=True)
    profile: Profile = in_unit(OF_OWNER)

    def __call__(self, X: Scalar, length: Scalar) -> Scalar:
        return self.factor * self.profile(X, length)

    @property
    def breakpoints(self) -> tuple[Scalar, ...]:
        return self.profile.breakpoints


def as_profile(name: str, value: Any, **limits: Any) -> Profile:
    """`value` as a profile: a `Profile` itself, a function of X, or a number; its numbers within
    `limits`, as for `numbers`."""
    if isinstance(value, Taper):
        numbers(f"{name} (Taper.base)", value.base, **limits)
        numbers(f"{name} (Taper.tip)", value.tip, **limits)
    if isinstance(value, Constant):
        numbers(name, value.value, **limits)
    if isinstance(value, Piecewise) and limits:
        for i, part in enumerate(value.values):
            as_profile(f"{name} (Piecewise.values[{i}])", part, **limits)
    if isinstance(value, Profile):
        return value
    if callable(value):
        return FunctionProfile(value)
    return Constant(numbers(name, value, **limits))


_LINEAR_IN = {
    Constant: ("value",),
    Taper: ("base", "tip"),
    PolynomialProfile: ("coefficients",),
    SplineProfile: ("values",),
}
"""The fields that a profile is proportional to."""


def scaled(factor: float, profile: Profile) -> Profile:
    """$c f(X)$, of the same kind as the profile where its own numbers can hold the factor."""
    if type(profile) is Piecewise:
        return Piecewise(profile.ends, [scaled(factor, part) for part in profile.values])
    if type(profile) not in _LINEAR_IN:
        return _Scaled(factor, profile)
    fields = attrgetter(*_LINEAR_IN[type(profile)])
    return eqx.tree_at(fields, profile, replace_fn=lambda number: factor * number)
