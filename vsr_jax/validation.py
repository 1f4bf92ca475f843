"""Input validation: every error is a `ValueError` that names the argument, the value received and
what is needed."""

from collections.abc import Iterable, Sequence
from types import UnionType
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array

ROUNDING = 1e-6
"""Tolerance of abscissas beyond an arm's ends, relative to its length, for rounding in single
precision."""


def is_traced(value: Any) -> bool:
    """Whether `value` is traced, as under `jax.jit`, so that only its shape is known."""
    return isinstance(value, Tracer)


def concrete(value: Any) -> np.ndarray | None:
    """`value` as a NumPy array, or None if it is traced."""
    return None if is_traced(value) else np.asarray(value)


def _error(name: str, value: Any, needed: str) -> ValueError:
    return ValueError(f"{name}: got {value!r}, need {needed}")


def numbers(
    name: str,
    value: Any,
    shape: tuple[int, ...] | None = (),
    *,
    positive: bool = False,
    above: float = -np.inf,
    least: float = -np.inf,
    most: float = np.inf,
    finite: bool = True,
) -> Array:
    """`value` as a floating-point array of `shape` (any shape for None).

    Known numbers are checked: `finite`, `positive`, greater than `above`, at least `least` and at
    most `most`.
    """
    above = max(above, 0.0) if positive else above
    kind = (
        "a finite number"
        if shape == ()
        else "finite numbers"
        if shape is None
        else f"finite numbers of shape {shape}"
    )
    limits = [
        (above > -np.inf, f"> {above:g}"),
        (least > -np.inf, f">= {least:g}"),
        (most < np.inf, f"<= {most:g}"),
    ]
    needed = f"{kind} {' and '.join(text for asked, text in limits if asked)}".rstrip()
    if isinstance(value, str):
        raise _error(name, value, needed)
    try:
        array = jnp.asarray(value)
    except (TypeError, ValueError, OverflowError):  # an integer beyond 64 bits overflows
        raise _error(name, value, needed) from None
    if jnp.issubdtype(array.dtype, jnp.complexfloating) or array.dtype == bool:
        raise _error(name, value, needed)
    array = (
        precise(name, array) if jnp.issubdtype(array.dtype, jnp.floating) else array.astype(float)
    )
    if shape is not None and array.shape != shape:
        raise ValueError(f"{name}: got shape {array.shape}, need {needed}")
    known = concrete(array)
    if known is None:
        return array
    if (finite and not np.all(np.isfinite(known))) or np.any(
        (known <= above) & (above > -np.inf) | (known < least) | (known > most)
    ):
        raise _error(name, value, needed)
    return array


def precise(name: str, array: Array) -> Array:
    """`array` if it is in single or double precision; the solvers support no other."""
    if array.dtype not in (jnp.float32, jnp.float64):
        raise ValueError(f"{name}: got {array.dtype}, need float32 or float64")
    return array


def interval(name: str, pair: Any, size: int) -> tuple[Array, Array]:
    """Lower and upper bounds of `size` numbers, one per actuator, from a pair of numbers or arrays;
    the order of known bounds is checked."""
    if not isinstance(pair, tuple | list) or len(pair) != 2:
        raise _error(name, pair, "a pair, the least and the greatest inputs")
    ends = [numbers(f"{name}[{i}]", end, None) for i, end in enumerate(pair)]
    for i, end in enumerate(ends):
        if end.shape not in ((), (size,)):
            raise ValueError(
                f"{name}[{i}]: got shape {end.shape}, need one number or {size}, one per actuator"
            )
    low, high = (jnp.broadcast_to(end, (size,)) for end in ends)
    known = concrete(low), concrete(high)
    if known[0] is not None and known[1] is not None and np.any(known[0] > known[1]):
        raise ValueError(f"{name}: got {known[0]} to {known[1]}, need the least inputs first")
    return low, high


def rigid(name: str, value: Any) -> Array:
    r"""`value` as a pose $((R, r), (0, 0, 0, 1))$, shape (4, 4). If its numbers are known,
    $R^T R = 1$ and $\det R = 1$ are checked.

    The tolerance is 1e-5, in single precision 1e-3, so that six digits are enough.
    """
    array = numbers(name, value, (4, 4))
    known = concrete(array)
    fault = None if known is None else _fault(known)
    if fault is not None:
        raise ValueError(
            f"{name}: got {fault}, need a rigid transform, a rotation and a position above the "
            f"row 0 0 0 1"
        )
    return array


def _near(matrix: np.ndarray) -> float:
    """How far a rotation may be from a given matrix: six digits are enough."""
    return 1e-5 if matrix.dtype == np.float64 else 1e-3


def _fault(g: np.ndarray) -> str | None:
    """The property of a pose that a matrix lacks; None for a pose."""
    row = g[3].astype(float)
    if np.max(np.abs(row - (0, 0, 0, 1))) > _near(g):
        return f"a last row of {' '.join(f'{x:g}' for x in row)}"
    return rotation_fault(g[:3, :3])


def rotation_fault(matrix: np.ndarray) -> str | None:
    """The property of a rotation that a known matrix lacks; None for a rotation."""
    R, tolerance = matrix.astype(float), _near(matrix)
    off = np.max(np.abs(R.T @ R - np.eye(3)))
    if off > tolerance:
        return (
            f"columns of a rotation that are not orthonormal (R^T R differs from 1 by {off:.2g})"
            if np.any(R)
            else "a rotation of zeros"
        )
    return "a reflection (the rotation has determinant -1)" if np.linalg.det(R) < 0 else None


def on_arm(
    name: str, X: Any, length: Any, ends: tuple[Any, Any] | None = None, what: str = "the arm"
) -> None:
    """Raises `ValueError` for abscissas [m] beyond the arm, or beyond the `ends` of `what`, if all
    numbers are known."""
    low, high = (0.0, length) if ends is None else ends
    if any(is_traced(value) for value in (X, length, low, high)):
        return
    x, slack = np.atleast_1d(np.asarray(X)), ROUNDING * float(length)
    off = ~((x >= float(low) - slack) & (x <= float(high) + slack))
    if np.any(off):
        raise ValueError(
            f"{name}: got {x[off][0]:.9g} m, need {low:g} to {high:g} m, the ends of {what}"
        )


def positive(name: str, value: Any) -> float:
    """`value` as a Python float, finite and > 0."""
    if (
        isinstance(value, bool)
        or not isinstance(value, int | float | np.number | np.ndarray | Array)
        or is_traced(value)
    ):
        raise _error(name, value, "a finite number > 0")
    try:
        number = np.nan if np.ndim(value) else float(value)
    except OverflowError:
        number = np.inf
    if not (np.isfinite(number) and number > 0):
        raise _error(name, value, "a finite number > 0")
    return number


def count(name: str, value: Any, *, least: int = 1) -> int:
    """`value` as an integer of at least `least`."""
    if isinstance(value, bool) or not isinstance(value, int | np.integer) or value < least:
        raise _error(name, value, f"an integer >= {least}")
    return int(value)


def choice(name: str, value: Any, allowed: Sequence[Any]) -> Any:
    """`value` if it is one of `allowed`."""
    if value not in allowed:
        raise _error(name, value, "one of " + ", ".join(repr(a) for a in allowed))
    return value


def instances(name: str, values: Any, kind: type, needed: str) -> tuple:
    """`values`, or one of them alone, as a tuple, if each is an instance of `kind`."""
    values = (values,) if isinstance(values, kind) else values
    if not isinstance(values, Iterable):
        raise _error(name, values, f"{needed}, or several of them")
    return tuple(instance(f"{name}[{i}]", value, kind, needed) for i, value in enumerate(values))


def instance(name: str, value: Any, kind: type | UnionType | tuple[type, ...], needed: str) -> Any:
    """`value` if it is an instance of `kind`, described as `needed` in the message."""
    if not isinstance(value, kind):
        raise _error(name, value, needed)
    return value
