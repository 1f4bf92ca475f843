"""Checks of what a user hands over: every refusal is a `ValueError` that names the argument, what came and what is needed."""

from collections.abc import Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array


def is_traced(value: Any) -> bool:
    """Whether only the shape of `value` is known, as under `jax.jit`."""
    return isinstance(value, Tracer)


def concrete(value: Any) -> np.ndarray | None:
    """`value` as a NumPy array, or None while it is traced (then only its shape is known)."""
    return None if is_traced(value) else np.asarray(value)


def _refuse(name: str, value: Any, needed: str) -> ValueError:
    return ValueError(f"{name}: got {value!r}, need {needed}")


def numbers(
    name: str, value: Any, shape: tuple[int, ...] | None = (), *, positive: bool = False, least: float = -np.inf, finite: bool = True
) -> Array:
    """`value` as a floating-point array of `shape` (any shape for None), finite, positive and at `least`, as wanted, where it is known."""
    kind = "a finite number" if shape == () else "finite numbers" if shape is None else f"finite numbers of shape {shape}"
    needed = kind + (" > 0" if positive else f" >= {least:g}" if least > -np.inf else "")
    if isinstance(value, str):
        raise _refuse(name, value, needed)
    try:
        array = jnp.asarray(value)
    except (TypeError, ValueError):
        raise _refuse(name, value, needed) from None
    if jnp.issubdtype(array.dtype, jnp.complexfloating) or array.dtype == bool:
        raise _refuse(name, value, needed)
    array = precise(name, array) if jnp.issubdtype(array.dtype, jnp.floating) else array.astype(float)
    if shape is not None and array.shape != shape:
        raise ValueError(f"{name}: got shape {array.shape}, need {needed}")
    known = concrete(array)
    if known is None:
        return array
    if (finite and not np.all(np.isfinite(known))) or (positive and not np.all(known > 0)) or np.any(known < least):
        raise _refuse(name, value, needed)
    return array


def precise(name: str, array: Array) -> Array:
    """`array` if it is in single or double precision, in which alone equilibria can be found."""
    if array.dtype not in (jnp.float32, jnp.float64):
        raise ValueError(f"{name}: got {array.dtype}, need float32 or float64")
    return array


def interval(name: str, pair: Any, size: int) -> tuple[Array, Array]:
    """Least and greatest of `size` numbers, one an actuator, from a pair of numbers or arrays; in order, where they are known."""
    if not isinstance(pair, tuple | list) or len(pair) != 2:
        raise _refuse(name, pair, "a pair, the least and the greatest inputs")
    ends = [numbers(f"{name}[{i}]", end, None) for i, end in enumerate(pair)]
    for i, end in enumerate(ends):
        if end.shape not in ((), (size,)):
            raise ValueError(f"{name}[{i}]: got shape {end.shape}, need one number or {size}, one an actuator")
    low, high = (jnp.broadcast_to(end, (size,)) for end in ends)
    known = concrete(low), concrete(high)
    if known[0] is not None and known[1] is not None and np.any(known[0] > known[1]):
        raise ValueError(f"{name}: got {known[0]} to {known[1]}, need the least inputs first")
    return low, high


def positive(name: str, value: Any) -> float:
    """`value` as a Python float, finite and > 0."""
    if isinstance(value, bool) or not isinstance(value, int | float | np.number | np.ndarray | Array) or is_traced(value):
        raise _refuse(name, value, "a finite number > 0")
    if np.ndim(value) or not (np.isfinite(value) and value > 0):
        raise _refuse(name, value, "a finite number > 0")
    return float(value)


def count(name: str, value: Any, *, least: int = 1) -> int:
    """`value` as an integer of at least `least`."""
    if isinstance(value, bool) or not isinstance(value, int | np.integer) or value < least:
        raise _refuse(name, value, f"an integer >= {least}")
    return int(value)


def choice(name: str, value: Any, allowed: Sequence[Any]) -> Any:
    """`value` if it is one of `allowed`."""
    if value not in allowed:
        raise _refuse(name, value, "one of " + ", ".join(repr(a) for a in allowed))
    return value


def instance(name: str, value: Any, kind: type | tuple[type, ...], needed: str) -> Any:
    """`value` if it is an instance of `kind`, which the message calls `needed`."""
    if not isinstance(value, kind):
        raise _refuse(name, value, needed)
    return value
